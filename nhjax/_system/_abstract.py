from abc import abstractmethod
from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._custom_types import (
    Args,
    FloatScalar,
    FloatScalarLike,
    PhaseFunction,
    PositionFunction,
)
from .._manifold import AbstractLieGroup, Euclidean
from ._signatures import check_signature
from ._state import check_time_and_state, State


class AbstractMechanicalSystem(eqx.Module):
    """A mechanical system with constraints, written on TQ or on T*Q.

    What differs between the two is the coordinate u on the fibres: the velocity of a
    Lagrangian system, the momentum of a Hamiltonian one. In terms of (t, q, u) both are
    the functions `velocity`, `momentum`, `free_force`, `constraint` and the metric K
    that turns constraint derivatives into reactions; the equations of a step are
    written with these alone.
    """

    nonholonomic: eqx.AbstractVar[PhaseFunction | None]
    holonomic: eqx.AbstractVar[PositionFunction | None]
    force: eqx.AbstractVar[PhaseFunction | None]
    manifold: eqx.AbstractVar[AbstractLieGroup | None]

    # The name of the generating function, and the letter of the fibre coordinate.
    generator: eqx.AbstractClassVar[Literal["lagrangian", "hamiltonian"]]
    fibre_coordinate_name: eqx.AbstractClassVar[Literal["v", "p"]]

    def __check_init__(self):
        for name, arguments in self.signatures().items():
            if getattr(self, name) is not None or name == self.generator:
                check_signature(self, name, arguments)
        if not isinstance(self.manifold, AbstractLieGroup | None):
            raise TypeError(
                f"{type(self).__name__}: `manifold` must be an nhjax manifold such as "
                f"nhjax.Euclidean(3), got {self.manifold!r}."
            )

    @abstractmethod
    def momentum(
        self, t: FloatScalarLike, q: PyTree[Array], u: Float[Array, " n"], args: Args
    ) -> Float[Array, " n"]:
        """The momentum p."""

    @abstractmethod
    def velocity(
        self, t: FloatScalarLike, q: PyTree[Array], u: Float[Array, " n"], args: Args
    ) -> Float[Array, " n"]:
        """The velocity v, left-trivialised."""

    @abstractmethod
    def metric(
        self, t: FloatScalarLike, q: PyTree[Array], u: Float[Array, " n"], args: Args
    ) -> Float[Array, "n n"]:
        """The metric K on the fibre, D2D2L or D2D2H."""

    @abstractmethod
    def free_force(
        self, t: FloatScalarLike, q: PyTree[Array], u: Float[Array, " n"], args: Args
    ) -> Float[Array, " n"]:
        """The force without the reaction."""

    @abstractmethod
    def flat(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        u: Float[Array, " n"],
        derivative: Float[Array, " n"],
        args: Args,
    ) -> Float[Array, " n"]:
        """The force along a constraint's derivative in u: D2Φ itself, or ♭_H D2Ψ."""

    @abstractmethod
    def energy(self, t: FloatScalarLike, y: State, args: Args = None) -> FloatScalar:
        """The energy of a state."""

    @classmethod
    def signatures(cls) -> dict[str, tuple[str, ...]]:
        """The arguments of each function of the system, by position."""
        of_phase = ("t", "q", cls.fibre_coordinate_name, "args")
        return {
            cls.generator: of_phase,
            "nonholonomic": of_phase,
            "holonomic": ("t", "q", "args"),
            "force": of_phase,
        }

    def functions(
        self, t: Any, q: PyTree[Any], u: Any, args: Args
    ) -> dict[str, tuple[Callable[..., Any], tuple[Any, ...]]]:
        """The functions that the system has, with the arguments to call them with."""
        values = {"t": t, "q": q, self.fibre_coordinate_name: u, "args": args}
        return {
            name: (getattr(self, name), tuple(values[x] for x in arguments))
            for name, arguments in self.signatures().items()
            if getattr(self, name) is not None
        }

    def fibre_coordinate(self, y: State) -> Float[Array, " n"]:
        """The fibre coordinate u of a state, its v or its p."""
        return getattr(y, self.fibre_coordinate_name)

    def fibre_derivative(
        self, t: FloatScalarLike, q: PyTree[Array], u: Float[Array, " n"], args: Args
    ) -> Float[Array, " n"]:
        """The fibre derivative D2L or D2H, which is the other one of v and p."""
        other = self.momentum if self.fibre_coordinate_name == "v" else self.velocity
        return other(t, q, u, args)

    def manifold_of(self, q: PyTree[Array]) -> AbstractLieGroup:
        """The configuration manifold; R^n with the length of `q` if none was given."""
        return Euclidean(q.shape[0]) if self.manifold is None else self.manifold

    def position_constraint(
        self, t: FloatScalarLike, q: PyTree[Array], args: Args = None
    ) -> Float[Array, " k"]:
        """The holonomic constraints Γ(t, q) with shape (k,), k = 0 if none."""
        if self.holonomic is None:
            return jnp.zeros((0,), jax.tree.leaves(q)[0].dtype)
        return jnp.atleast_1d(self.holonomic(t, q, args))

    def kinematic_constraint(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        u: Float[Array, " n"],
        args: Args = None,
    ) -> Float[Array, " m"]:
        """The nonholonomic constraints with shape (m,), m = 0 if there are none."""
        if self.nonholonomic is None:
            return jnp.zeros((0,), u.dtype)
        return jnp.atleast_1d(self.nonholonomic(t, q, u, args))

    def tangency(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        u: Float[Array, " n"],
        args: Args = None,
    ) -> Float[Array, " k"]:
        """dΓ/dt of the holonomic constraints, with shape (k,)."""
        if self.holonomic is None:
            return jnp.zeros((0,), u.dtype)
        v = self.velocity(t, q, u, args)
        manifold, t = self.manifold_of(q), jnp.asarray(t, u.dtype)
        return jax.jvp(
            lambda t, xi: self.position_constraint(t, manifold.act(q, xi), args),
            (t, jnp.zeros_like(v)),
            (jnp.ones_like(t), v),
        )[1]

    def constraint(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        u: Float[Array, " n"],
        args: Args = None,
    ) -> Float[Array, " l"]:
        """All constraints on velocities: the nonholonomic ones, then the tangency.

        The reaction of a holonomic constraint is that of its tangency by Chetaev's
        rule, so that these l = m + k rows determine all multipliers.
        """
        if self.holonomic is None:
            return self.kinematic_constraint(t, q, u, args)
        if self.nonholonomic is None:
            return self.tangency(t, q, u, args)
        return jnp.concatenate(
            [self.kinematic_constraint(t, q, u, args), self.tangency(t, q, u, args)]
        )

    def reaction(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        u: Float[Array, " n"],
        multiplier: Float[Array, " l"],
        args: Args = None,
    ) -> Float[Array, " n"]:
        """The reaction of all constraints to their multipliers."""
        total, m = jnp.zeros_like(u), 0
        if self.nonholonomic is not None:
            phi, pullback = jax.vjp(
                lambda u: self.kinematic_constraint(t, q, u, args), u
            )
            m = phi.shape[0]
            total = self.flat(t, q, u, pullback(multiplier[:m])[0], args)
        if self.holonomic is not None:
            total = total + self.manifold_of(q).left_gradient(
                lambda g: jnp.sum(
                    multiplier[m:] * self.position_constraint(t, g, args)
                ),
                q,
            )
        return total

    def constraint_violation(
        self, t: FloatScalarLike, y: State, args: Args = None
    ) -> Float[Array, " c"]:
        """What should vanish at a state, of shape (m + 2k,).

        The values of the m nonholonomic constraints, of the time derivatives of the k
        holonomic ones, and of the holonomic ones themselves.
        """
        check_time_and_state("constraint_violation", t, y)
        on_velocities = self.constraint(t, y.q, self.fibre_coordinate(y), args)
        return jnp.concatenate([on_velocities, self.position_constraint(t, y.q, args)])
