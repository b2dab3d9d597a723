from abc import abstractmethod
from collections.abc import Callable
from functools import partial
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
from .._errors import naming
from .._manifold import AbstractLieGroup, Euclidean
from ._signatures import (
    check_constraints,
    check_coordinates,
    check_manifold,
    check_signature,
)
from ._state import check_time_and_state, State


class AbstractMechanicalSystem(eqx.Module):
    """A mechanical system with constraints, written on TQ or on T*Q.

    The two kinds differ in the fibre coordinate u, the velocity of a Lagrangian and the
    momentum of a Hamiltonian system. In terms of (t, q, u) both are `velocity`,
    `momentum`, `free_force`, `constraint` and the metric K, which turns constraint
    derivatives into reactions. The equations of a step are written in these alone.
    """

    nonholonomic: eqx.AbstractVar[PhaseFunction | None]
    holonomic: eqx.AbstractVar[PositionFunction | None]
    force: eqx.AbstractVar[PhaseFunction | None]
    manifold: eqx.AbstractVar[AbstractLieGroup | None]
    constraints: eqx.AbstractVar[Literal["independent", "redundant"]]
    coordinates: eqx.AbstractVar[tuple[str, ...] | None]

    # The name of the function L or H that generates the motion, and the letter of the
    # fibre coordinate.
    generator: eqx.AbstractClassVar[Literal["lagrangian", "hamiltonian"]]
    fibre_coordinate_name: eqx.AbstractClassVar[Literal["v", "p"]]

    def __check_init__(self):
        for name, arguments in self.signatures().items():
            function = getattr(self, name)
            if function is not None or name == self.generator:
                check_signature(type(self).__name__, name, function, arguments)
        check_constraints(self)
        check_manifold(self)
        check_coordinates(self)

    @abstractmethod
    def momentum(
        self, t: FloatScalarLike, q: PyTree[Array], u: Float[Array, " n"], args: Args
    ) -> Float[Array, " n"]:
        """Compute the momentum p at (t, q, u)."""

    @abstractmethod
    def velocity(
        self, t: FloatScalarLike, q: PyTree[Array], u: Float[Array, " n"], args: Args
    ) -> Float[Array, " n"]:
        """Compute the velocity v at (t, q, u), left-trivialised on a group."""

    @abstractmethod
    def metric(
        self, t: FloatScalarLike, q: PyTree[Array], u: Float[Array, " n"], args: Args
    ) -> Float[Array, "n n"]:
        """Compute the metric K on the fibre, which is D2D2L or D2D2H."""

    @abstractmethod
    def free_force(
        self, t: FloatScalarLike, q: PyTree[Array], u: Float[Array, " n"], args: Args
    ) -> Float[Array, " n"]:
        """Compute the force on the system without the reaction of the constraints."""

    @abstractmethod
    def flat(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        u: Float[Array, " n"],
        derivative: Float[Array, " n"],
        args: Args,
    ) -> Float[Array, " n"]:
        """Turn a constraint's derivative in u into a force: D2Φ itself, or ♭_H D2Ψ."""

    @abstractmethod
    def energy(self, t: FloatScalarLike, y: State, args: Args = None) -> FloatScalar:
        """Compute the energy of the system in the state `y` at time `t`."""

    @classmethod
    def signatures(cls) -> dict[str, tuple[str, ...]]:
        """Map the name of each function of the system to the names of its arguments."""
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
        """Map the name of each function of the system to its `call` and arguments."""
        values = {"t": t, "q": q, self.fibre_coordinate_name: u, "args": args}
        return {
            name: (partial(self.call, name), tuple(values[x] for x in arguments))
            for name, arguments in self.signatures().items()
            if getattr(self, name) is not None
        }

    def call(self, name: str, *arguments: Any) -> Any:
        """Call a function of the system; errors that it raises get a note.

        The note names the function, which JAX and Python cannot know.
        """
        function = getattr(self, name)
        called = f"{name}({', '.join(self.signatures()[name])})"
        with naming(called, function, arguments[-1]):
            return function(*arguments)

    def fibre_coordinate(self, y: State) -> Float[Array, " n"]:
        """Return the fibre coordinate u of a state, which is its v or its p."""
        return getattr(y, self.fibre_coordinate_name)

    def fibre_derivative(
        self, t: FloatScalarLike, q: PyTree[Array], u: Float[Array, " n"], args: Args
    ) -> Float[Array, " n"]:
        """Compute the fibre derivative D2L(t, q, v) = p or D2H(t, q, p) = v."""
        other = self.momentum if self.fibre_coordinate_name == "v" else self.velocity
        return other(t, q, u, args)

    def manifold_of(self, q: PyTree[Array]) -> AbstractLieGroup:
        """Return the configuration manifold; without one, R^n with n = len(q)."""
        return Euclidean(q.shape[0]) if self.manifold is None else self.manifold

    def position_constraint(
        self, t: FloatScalarLike, q: PyTree[Array], args: Args = None
    ) -> Float[Array, " k"]:
        """Compute the holonomic constraints Γ(t, q), of shape (k,), k = 0 if none."""
        if self.holonomic is None:
            return jnp.zeros((0,), jax.tree.leaves(q)[0].dtype)
        return jnp.atleast_1d(self.call("holonomic", t, q, args))

    def kinematic_constraint(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        u: Float[Array, " n"],
        args: Args = None,
    ) -> Float[Array, " m"]:
        """Compute the nonholonomic constraints, of shape (m,) with m = 0 if none."""
        if self.nonholonomic is None:
            return jnp.zeros((0,), u.dtype)
        return jnp.atleast_1d(self.call("nonholonomic", t, q, u, args))

    def holonomic_rate(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        u: Float[Array, " n"],
        args: Args = None,
    ) -> Float[Array, " k"]:
        """Compute the rates dΓ/dt of the holonomic constraints, of shape (k,)."""
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
        """Compute all constraints on velocities, of shape (l,) with l = m + k.

        The m nonholonomic constraints come first, then the rates dΓ/dt of the k
        holonomic ones (their rates). By Chetaev's rule the reaction of a holonomic
        constraint is that of its rate: these rows determine all multipliers.
        """
        if self.holonomic is None:
            return self.kinematic_constraint(t, q, u, args)
        if self.nonholonomic is None:
            return self.holonomic_rate(t, q, u, args)
        return jnp.concatenate(
            [
                self.kinematic_constraint(t, q, u, args),
                self.holonomic_rate(t, q, u, args),
            ]
        )

    def reaction(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        u: Float[Array, " n"],
        multiplier: Float[Array, " l"],
        args: Args = None,
    ) -> Float[Array, " n"]:
        """Compute the reaction force of all constraints, given their multipliers."""
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
        """Compute all constraint functions at a state, of shape (m + 2k,).

        They are the m nonholonomic constraints, the time derivatives of the k holonomic
        ones and these themselves. All of them vanish at a consistent state.
        """
        check_time_and_state("constraint_violation", t, y)
        on_velocities = self.constraint(t, y.q, self.fibre_coordinate(y), args)
        return jnp.concatenate([on_velocities, self.position_constraint(t, y.q, args)])
