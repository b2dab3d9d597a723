from typing import ClassVar, Literal

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
from .._manifold import AbstractLieGroup
from ._abstract import AbstractMechanicalSystem
from ._state import check_time_and_state, State


class LagrangianSystem(AbstractMechanicalSystem):
    """A Lagrangian system with constraints and external forces.

    Its motion obeys, with multipliers λ, ν and Chetaev's rule for the reaction (paper,
    sections 3 and 6),

    d/dt D2L = ad*_v D2L + L_q^* D1L + F + λᵀ D2Φ + νᵀ L_q^* DΓ,

    Φ(t, q, v) = 0,    Γ(t, q) = 0,    q̇ = q v,

    which on R^n is the familiar d/dt D2L = D1L + F + λᵀ D2Φ + νᵀ DΓ with q̇ = v. All
    derivatives are taken by automatic differentiation. Array leaves of the functions
    (if they are `equinox.Module`s) are parameters that gradients reach. A system holds
    functions, so that a function that is given one as an argument is compiled by
    `equinox.filter_jit`: `jax.jit` takes arrays alone.

    Values that the functions read beside their arguments (globals, variables of
    enclosing functions, attributes of objects) are compiled in. `integrate` and
    `initial_state` compare them from call to call and compile anew if one has changed.
    A `jax.jit` of your own does not do so: pass a value that is to change as `args`, or
    as an array field of an `equinox.Module`, for which nothing is ever compiled anew.
    `docs/systems.md` has the details.

    **Arguments:**

    - `lagrangian`: L, called as `lagrangian(t, q, v, args)`, a scalar. On a group it is
        left-trivialised: `q` is an element, `v` the body velocity in the Lie algebra.
    - `nonholonomic`: Φ, called as `nonholonomic(t, q, v, args)`, of shape () or (m,):
        linear, affine or nonlinear in v, and it may depend on time.
    - `holonomic`: Γ, called as `holonomic(t, q, args)`, of shape () or (k,).
    - `force`: an external covector F, called as `force(t, q, v, args)`, of shape (n,);
        on a group in left-trivialised components.
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
        >>> blade = lambda t, q, v, args: -jnp.sin(q[2]) * v[0] + jnp.cos(q[2]) * v[1]
        >>> skate = nhjax.LagrangianSystem(
        ...     lambda t, q, v, args: 0.5 * v @ v, nonholonomic=blade)
    """

    lagrangian: PhaseFunction
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

    generator: ClassVar[Literal["lagrangian", "hamiltonian"]] = "lagrangian"
    fibre_coordinate_name: ClassVar[Literal["v", "p"]] = "v"

    def momentum(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        u: Float[Array, " n"],
        args: Args = None,
    ) -> Float[Array, " n"]:
        """Compute the momentum p = D2L(t, q, u), the Legendre transform of u."""
        return jax.grad(self.call, argnums=3)("lagrangian", t, q, u, args)

    def velocity(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        u: Float[Array, " n"],
        args: Args = None,
    ) -> Float[Array, " n"]:
        """Return the velocity v, which is the fibre coordinate `u` itself."""
        return u

    def metric(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        u: Float[Array, " n"],
        args: Args = None,
    ) -> Float[Array, "n n"]:
        """Compute the mass matrix M = D2D2L, the metric on velocities."""
        return jax.jacfwd(self.momentum, argnums=2)(t, q, u, args)

    def free_force(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        u: Float[Array, " n"],
        args: Args = None,
    ) -> Float[Array, " n"]:
        """Compute the force without the reaction of the constraints, L_q^* D1L + F."""
        manifold = self.manifold_of(q)
        d1l = manifold.left_gradient(
            lambda g: self.call("lagrangian", t, g, u, args), q
        )
        return d1l if self.force is None else d1l + self.call("force", t, q, u, args)

    def flat(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        u: Float[Array, " n"],
        derivative: Float[Array, " n"],
        args: Args = None,
    ) -> Float[Array, " n"]:
        """Return the derivative D2Φ itself, which is a covector already."""
        return derivative

    def energy(self, t: FloatScalarLike, y: State, args: Args = None) -> FloatScalar:
        """Compute the energy E = D2L(t, q, v)·v - L of a state.

        **Arguments:**

        - `t`: the time.
        - `y`: a state, such as an entry of `Solution.ys`. For a whole trajectory use
            `jax.vmap(system.energy)(sol.ts, sol.ys)`.
        - `args`: passed on to the Lagrangian.

        **Returns:** a scalar.

        !!! example

            >>> import jax.numpy as jnp, nhjax
            >>> free = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v)
            >>> y = nhjax.initial_state(free, q=jnp.zeros(2), v=jnp.array([3.0, 4.0]))
            >>> float(free.energy(0.0, y))
            12.5
        """
        check_time_and_state("energy", t, y)
        p = self.momentum(t, y.q, y.v, args)
        return jnp.sum(p * y.v) - self.call("lagrangian", t, y.q, y.v, args)
