from typing import ClassVar, Literal

import equinox as eqx
import jax
from jaxtyping import Array, Float, PyTree

from .._custom_types import (
    Args,
    FloatScalar,
    FloatScalarLike,
    PhaseFunction,
    PositionFunction,
)
from .._manifold import AbstractLieGroup
from .._numerics import square_jacobian
from ._abstract import AbstractMechanicalSystem
from ._state import check_time_and_state, State


class HamiltonianSystem(AbstractMechanicalSystem):
    """A Hamiltonian system with constraints and external forces.

    Its motion obeys (paper, section 3)

    ṗ = ad*_v p - L_q^* D1H + F + λᵀ ♭_H D2Ψ + νᵀ L_q^* DΓ,    q̇ = q v,    v = D2H,

    Ψ(t, q, p) = 0,    Γ(t, q) = 0,

    where ♭_H = (D2D2H)⁻¹ turns velocities into momenta. It is integrated by the paper's
    Hamiltonian equations, with the stage momenta as unknowns, so that no Legendre
    transform has to be inverted. Values that the functions read beside their arguments
    are compiled in, as for a `LagrangianSystem`.

    **Arguments:**

    - `hamiltonian`: H, called as `hamiltonian(t, q, p, args)`, a scalar. On a group it
        is left-trivialised: `q` is an element, `p` a covector of the Lie algebra.
    - `nonholonomic`: Ψ, called as `nonholonomic(t, q, p, args)`, of shape () or (m,).
    - `holonomic`: Γ, called as `holonomic(t, q, args)`, of shape () or (k,).
    - `force`: an external covector F, called as `force(t, q, p, args)`, of shape (n,).
    - `manifold`: the configuration manifold; R^n with the n of the state if left out.
    - `constraints`: `"independent"`, by which dependent constraints are refused, or
        `"redundant"`, by which some may follow from others, nonholonomic ones from
        holonomic ones too. Of all multipliers with the same reaction the result is then
        the one with the least Σ |λ_a B_a|², the sizes of the reactions of single
        constraints in the metric M⁻¹, and none of a nonholonomic one that follows; it
        marks reactions as not unique. `docs/systems.md` has the details.
    - `coordinates`: a tuple of the names of the n coordinates, for
        `Solution.to_xarray` and for `keep_q`, `keep_v` and `keep_p` of `initial_state`;
        None by default.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> oscillator = nhjax.HamiltonianSystem(
        ...     lambda t, q, p, args: 0.5 * p @ p + 0.5 * q @ q)
        >>> y = nhjax.initial_state(oscillator, jnp.array([1.0]), p=jnp.array([0.0]))
        >>> float(oscillator.energy(0.0, y))
        0.5
    """

    hamiltonian: PhaseFunction
    nonholonomic: PhaseFunction | None = eqx.field(default=None, kw_only=True)
    holonomic: PositionFunction | None = eqx.field(default=None, kw_only=True)
    force: PhaseFunction | None = eqx.field(default=None, kw_only=True)
    manifold: AbstractLieGroup | None = eqx.field(default=None, kw_only=True)
    constraints: Literal["independent", "redundant"] = eqx.field(
        default="independent", kw_only=True, static=True
    )
    coordinates: tuple[str, ...] | None = eqx.field(
        default=None, kw_only=True, static=True
    )

    generator: ClassVar[Literal["lagrangian", "hamiltonian"]] = "hamiltonian"
    fibre_coordinate_name: ClassVar[Literal["v", "p"]] = "p"

    def momentum(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        u: Float[Array, " n"],
        args: Args = None,
    ) -> Float[Array, " n"]:
        """Return the momentum p, which is the fibre coordinate `u` itself."""
        return u

    def velocity(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        u: Float[Array, " n"],
        args: Args = None,
    ) -> Float[Array, " n"]:
        """Compute the velocity v = D2H(t, q, u)."""
        return jax.grad(self.call, argnums=3)("hamiltonian", t, q, u, args)

    def metric(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        u: Float[Array, " n"],
        args: Args = None,
    ) -> Float[Array, "n n"]:
        """Compute the metric D2D2H on momenta, the inverse of the mass matrix."""
        return jax.jacfwd(self.velocity, argnums=2)(t, q, u, args)

    def free_force(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        u: Float[Array, " n"],
        args: Args = None,
    ) -> Float[Array, " n"]:
        """Compute the force without the reaction of the constraints, -L_q^* D1H + F."""
        manifold = self.manifold_of(q)
        d1h = manifold.left_gradient(
            lambda g: self.call("hamiltonian", t, g, u, args), q
        )
        return -d1h if self.force is None else self.call("force", t, q, u, args) - d1h

    def flat(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        u: Float[Array, " n"],
        derivative: Float[Array, " n"],
        args: Args = None,
    ) -> Float[Array, " n"]:
        """Compute ♭_H D2Ψ = (D2D2H)⁻¹ D2Ψ from a constraint's derivative D2Ψ."""
        fibre_hessian = square_jacobian(lambda u: self.velocity(t, q, u, args), u)
        return fibre_hessian.inverse().matvec(derivative)

    def energy(self, t: FloatScalarLike, y: State, args: Args = None) -> FloatScalar:
        """Compute the energy H(t, q, p) of a state.

        The arguments are those of `LagrangianSystem.energy`.
        """
        check_time_and_state("energy", t, y)
        return self.call("hamiltonian", t, y.q, y.p, args)
