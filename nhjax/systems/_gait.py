"""Joints that move as given functions of time and thus propel a machine."""

import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._custom_types import Args, FloatScalarLike
from .._system import LagrangianSystem
from ._base import AbstractNonholonomicExample, coordinates


class Sinusoid(eqx.Module):
    """One joint angle or an array of angles: the function a sin(ωt + β) of time."""

    amplitude: Array = eqx.field(converter=coordinates)
    rate: Array = eqx.field(converter=coordinates)
    phase: Array = eqx.field(converter=coordinates)

    def __call__(self, t: Array) -> Array:
        """Compute the angles at `t`, in the precision of `t`."""
        amplitude, rate, phase = jax.tree.map(
            lambda x: x.astype(t.dtype), (self.amplitude, self.rate, self.phase)
        )
        return amplitude * jnp.sin(rate * t + phase)

    def at_start(self) -> tuple[Array, Array]:
        """Compute the angles and their rates at t = 0."""
        start = jnp.zeros((), self.phase.dtype)
        return jax.jvp(self, (start,), (jnp.ones_like(start),))


class AbstractGaitMachine(AbstractNonholonomicExample):
    """A machine whose joints follow a `gait`, or move freely if `gait` is None."""

    gait: eqx.AbstractVar[Callable[[Array], Array] | None]

    @abc.abstractmethod
    def holonomic(self, t: FloatScalarLike, q: Array, args: Args) -> Array:
        """Compute the constraints that hold the joints to the gait."""

    @abc.abstractmethod
    def force(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the generalised force of the torques on the joints."""

    @property
    def system(self) -> LagrangianSystem:
        """Return the system to integrate; its pytree leaves are the parameters."""
        if self.gait is None:
            return LagrangianSystem(
                self.lagrangian, nonholonomic=self.constraint, force=self.force
            )
        return LagrangianSystem(
            self.lagrangian, nonholonomic=self.constraint, holonomic=self.holonomic
        )
