import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._custom_types import Args, FloatScalar, FloatScalarLike, PhaseFunction
from ._linearisation import linearise
from ._manifold import AbstractLieGroup, Euclidean
from ._state import State


class LagrangianSystem(eqx.Module):
    """A Lagrangian system with nonholonomic constraints and external forces.

    Its motion obeys, with the multiplier λ and Chetaev's rule for the reaction (paper,
    section 3),

    d/dt D2L = D1L + F + λᵀ D2Φ,    Φ(t, q, v) = 0,    q̇ = v.

    All derivatives are taken by automatic differentiation. Array leaves of the
    functions (if they are `equinox.Module`s) are parameters that gradients reach.

    **Arguments:**

    - `lagrangian`: L, called as `lagrangian(t, q, v, args)`, a scalar.
    - `nonholonomic`: Φ, called as `nonholonomic(t, q, v, args)`, of shape () or (m,):
        linear, affine or nonlinear in v, and it may depend on time.
    - `force`: an external covector F, called as `force(t, q, v, args)`, of shape (n,).
    - `manifold`: the configuration manifold; R^n with the n of the state if left out.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> blade = lambda t, q, v, args: -jnp.sin(q[2]) * v[0] + jnp.cos(q[2]) * v[1]
        >>> skate = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v, blade)
    """

    lagrangian: PhaseFunction
    nonholonomic: PhaseFunction | None = None
    force: PhaseFunction | None = None
    manifold: AbstractLieGroup | None = None

    def __check_init__(self):
        for name in ("lagrangian", "nonholonomic", "force"):
            function = getattr(self, name)
            if not callable(function) and (
                name == "lagrangian" or function is not None
            ):
                raise TypeError(
                    f"LagrangianSystem: `{name}` must be a function of (t, q, v, args),"
                    f" got {function!r}."
                )
        if not isinstance(self.manifold, AbstractLieGroup | None):
            raise TypeError(
                "LagrangianSystem: `manifold` must be an nhjax manifold such as "
                f"nhjax.Euclidean(3), got {self.manifold!r}."
            )

    def manifold_of(self, q: Array) -> AbstractLieGroup:
        """The configuration manifold; R^n with the length of `q` if none was given."""
        return Euclidean(q.shape[0]) if self.manifold is None else self.manifold

    def momentum(
        self, t: FloatScalarLike, q: Array, v: Float[Array, " n"], args: Args = None
    ) -> Float[Array, " n"]:
        """The momentum p = D2L (the Legendre transform)."""
        return jax.grad(self.lagrangian, argnums=2)(t, q, v, args)

    def mass_matrix(
        self, t: FloatScalarLike, q: Array, v: Float[Array, " n"], args: Args = None
    ) -> Float[Array, "n n"]:
        """The mass matrix M = D2D2L."""
        return jax.jacfwd(self.momentum, argnums=2)(t, q, v, args)

    def constraint(
        self, t: FloatScalarLike, q: Array, v: Float[Array, " n"], args: Args = None
    ) -> Float[Array, " m"]:
        """The constraint function Φ with shape (m,), m = 0 if there is none."""
        if self.nonholonomic is None:
            return jnp.zeros((0,), v.dtype)
        return jnp.atleast_1d(self.nonholonomic(t, q, v, args))

    def free_force(
        self, t: FloatScalarLike, q: Array, v: Float[Array, " n"], args: Args = None
    ) -> Float[Array, " n"]:
        """The force without the reaction, D1L + F."""
        manifold = self.manifold_of(q)
        d1l = manifold.left_gradient(lambda g: self.lagrangian(t, g, v, args), q)
        return d1l if self.force is None else d1l + self.force(t, q, v, args)

    def force_and_momentum(
        self,
        t: FloatScalarLike,
        q: Array,
        v: Float[Array, " n"],
        multiplier: Float[Array, " m"],
        args: Args = None,
    ) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """W = D1L + F + λᵀ D2Φ and P = D2L, the two forms of a stage."""
        w = self.free_force(t, q, v, args)
        if self.nonholonomic is not None:
            _, pullback = jax.vjp(lambda u: self.constraint(t, q, u, args), v)
            w = w + pullback(multiplier)[0]
        return w, self.momentum(t, q, v, args)

    def energy(self, t: FloatScalarLike, y: State, args: Args = None) -> FloatScalar:
        """The energy E = D2L(q, v)·v - L of a state.

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
        p = self.momentum(t, y.q, y.v, args)
        return jnp.sum(p * y.v) - self.lagrangian(t, y.q, y.v, args)

    def constraint_violation(
        self, t: FloatScalarLike, y: State, args: Args = None
    ) -> Float[Array, " m"]:
        """The value of Φ(t, q, v) at a state, zero on the constraint manifold."""
        return self.constraint(t, y.q, y.v, args)

    def multiplier(
        self, t: FloatScalarLike, y: State, args: Args = None
    ) -> Float[Array, " m"]:
        """The continuous multiplier λ_c(q, v), from the hidden constraint dΦ/dt = 0.

        Along a trajectory of a Lobatto method it is of order 2s-2, while the
        multiplier that the paper propagates is of order s or s-1.
        """
        t = jnp.asarray(t, y.v.dtype)
        return linearise(self, t, y.q, y.v, args).multiplier
