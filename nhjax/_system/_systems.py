"""Lagrangian and Hamiltonian systems with constraints, and their states.

A system is written on TQ or on T*Q: its state has a position q and a fibre coordinate
u, which is the velocity v of a Lagrangian and the momentum p of a Hamiltonian system.
`_initial`, `_step` and `_integrate` use only the common interface of both kinds of
systems, `AbstractMechanicalSystem`.
"""

from abc import abstractmethod
from collections.abc import Callable
from types import BuiltinFunctionType, FunctionType
from typing import Any, ClassVar, Literal, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._custom_types import (
    Args,
    FloatScalar,
    FloatScalarLike,
    ForceFunction,
    PhaseFunction,
    PositionFunction,
)
from .._errors import naming, ShapeError
from .._manifold import AbstractLieGroup, Euclidean, framed, is_framed, unframed
from .._numerics import ClosureConverted, kept_function, square_jacobian
from ._arguments import (
    check_constraints,
    check_coordinates,
    check_manifold,
    check_signature,
    check_third_argument,
    check_type,
    takes_multipliers,
)


class State(eqx.Module):
    """The state of a mechanical system at one time, or the states of a trajectory.

    - `q`: the configuration, shape (n,); on a group an element, on a product of groups
        a tuple of elements.
    - `v`: the velocity, shape (n,); on a group the body velocity.
    - `p`: the momentum, shape (n,), with p = D2L(t, q, v) or v = D2H(t, q, p).
    - `multiplier`: shape (m + k,): λ of the m nonholonomic constraints, then ν of the k
        holonomic ones. With the constraints Φ = 0 and Γ = 0, the reaction on the system
        is λᵀ D2Φ + νᵀ L_q^* DΓ, where L_q^* gives the components in the body frame (the
        identity on R^n). A Hamiltonian system with Ψ = 0 has ♭_H D2Ψ in place of D2Φ,
        with ♭_H = (D2D2H)⁻¹.

    Create a state with `nhjax.initial_state`, which makes the four parts consistent.
    """

    q: PyTree[Array]
    v: Float[Array, " n"]
    p: Float[Array, " n"]
    multiplier: Float[Array, " l"]


def check_time_and_state(function: str, t: Any, y: Any, first: str = "") -> None:
    """Raise if `y` is not a `State` at one time, or if `t` is a `State`."""
    advice = f"Call it as `{function}({first}t, y, args)`."
    if isinstance(t, State):
        raise TypeError(f"`t` must be a time, got an nhjax.State. {advice}")
    check_type("y", y, State, advice)
    if jnp.ndim(y.p) > 1:
        raise ShapeError(
            f"`y.p` has shape {y.p.shape}, but the state at one time has shape (n,). "
            f"For a trajectory use `jax.vmap` over `t` and `y`."
        )


class StaticFunction(eqx.Module):
    """A Python function as a part of the structure of a pytree, not as a leaf.

    All leaves of a system are then arrays, so that `jax.jit`, `jax.vmap` and `jax.grad`
    accept a system as an argument.
    """

    function: Callable[..., Any] = eqx.field(static=True)

    def __call__(self, *arguments: Any) -> Any:
        """Call the function."""
        return self.function(*arguments)


_PYTHON_FUNCTIONS = (FunctionType, BuiltinFunctionType, type(jax.jit(lambda: None)))


def static_function(function: Any) -> Any:
    """Convert a Python function, whose arrays are constants, to a `StaticFunction`.

    Other callables, such as `equinox.Module`s, stay as they are: their arrays are
    parameters.
    """
    is_plain = isinstance(function, _PYTHON_FUNCTIONS)
    return StaticFunction(function) if is_plain else function


def as_given(function: Any) -> Any:
    """Return the function that the user gave to `static_function`."""
    return function.function if isinstance(function, StaticFunction) else function


class NamedFunction(eqx.Module):
    """A function of a system; a note is added to the errors that it raises.

    The note says which function of the system raised the error.
    """

    function: Callable[..., Any]
    called: str = eqx.field(static=True)

    def __call__(self, *arguments: Any) -> Any:
        """Call the function."""
        function = as_given(self.function)
        with naming(self.called, function, arguments[-1]):
            return function(*arguments)


def value_and_rate(
    function: Callable[[Any, Any], Any],
    manifold: AbstractLieGroup | None,
    t: FloatScalarLike,
    q: PyTree[Array],
    v: Float[Array, " n"],
) -> tuple[Any, Any]:
    """Evaluate x(t, q) and its rate dx/dt along the velocity v.

    Without a manifold, q is an element of R^n.
    """
    t = jnp.asarray(t, v.dtype)
    tangent = v if manifold is None else manifold.tangent(q, v)
    return jax.jvp(function, (t, q), (jnp.ones_like(t), tangent))


class AbstractOfSystem(eqx.Module):
    """A function of a system that must fit the other parts of the system."""

    @abstractmethod
    def check_system(self, system: Any) -> None:
        """Raise a `ValueError` if the function does not fit the system."""


class AbstractMechanicalSystem(eqx.Module):
    """A mechanical system with constraints, written on TQ or on T*Q.

    Lagrangian and Hamiltonian systems differ in the fibre coordinate u, which is the
    velocity of a Lagrangian and the momentum of a Hamiltonian system. Both kinds
    provide the functions `velocity`, `momentum`, `conservative_force`, `constraint` and
    `metric` of (t, q, u). The equations of a step use these functions, and
    `free_force`, which may depend on the multipliers too.
    """

    nonholonomic: eqx.AbstractVar[PhaseFunction | None]
    holonomic: eqx.AbstractVar[PositionFunction | None]
    force: eqx.AbstractVar[ForceFunction | None]
    force_takes_multipliers: eqx.AbstractVar[bool]
    manifold: eqx.AbstractVar[AbstractLieGroup | None]
    constraints: eqx.AbstractVar[Literal["independent", "redundant"]]
    coordinates: eqx.AbstractVar[tuple[str, ...] | None]

    # The name of the function L or H, and the letter of the fibre coordinate.
    generator: eqx.AbstractClassVar[Literal["lagrangian", "hamiltonian"]]
    fibre_coordinate_name: eqx.AbstractClassVar[Literal["v", "p"]]

    def __post_init__(self):
        # The signature of the force is read once, here, because programs replace the
        # functions by traced functions with other signatures.
        self.force_takes_multipliers = takes_multipliers(as_given(self.force))

    def __check_init__(self):
        owner, letter = type(self).__name__, self.fibre_coordinate_name
        for name, arguments in self.signatures().items():
            function = as_given(getattr(self, name))
            if function is not None or name == self.generator:
                check_signature(owner, name, function, arguments)
                check_third_argument(owner, name, function, arguments, letter)
        check_constraints(self)
        check_manifold(self)
        check_coordinates(self)
        for name in self.signatures():
            function = getattr(self, name)
            if isinstance(function, AbstractOfSystem):
                function.check_system(self)

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
        """Compute the metric K on the fibre: the Hessian D2D2L or D2D2H."""

    @abstractmethod
    def conservative_force(
        self, t: FloatScalarLike, q: PyTree[Array], u: Float[Array, " n"], args: Args
    ) -> Float[Array, " n"]:
        """Compute the force that comes from L or H, L_q^* D1L or -L_q^* D1H."""

    @abstractmethod
    def flat(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        u: Float[Array, " n"],
        derivative: Float[Array, " n"],
        args: Args,
    ) -> Float[Array, " n"]:
        """Convert a constraint's derivative in u to a covector: D2Φ, or ♭_H D2Ψ."""

    @abstractmethod
    def energy(self, t: FloatScalarLike, y: State, args: Args = None) -> FloatScalar:
        """Compute the energy of the system in the state `y` at time `t`."""

    def signatures(self) -> dict[str, tuple[str, ...]]:
        """Map the name of each function of the system to the names of its arguments."""
        before = ("t", "q", self.fibre_coordinate_name)
        multipliers = ("multipliers",) if self.force_takes_multipliers else ()
        return {
            self.generator: (*before, "args"),
            "nonholonomic": (*before, "args"),
            "holonomic": ("t", "q", "args"),
            "force": (*before, *multipliers, "args"),
        }

    def functions(
        self, t: Any, q: PyTree[Any], u: Any, multiplier: Any, args: Args
    ) -> dict[str, tuple["NamedFunction", tuple[Any, ...]]]:
        """Map the name of each function to a callable and its arguments."""
        letter = self.fibre_coordinate_name
        values = {"t": t, "q": q, letter: u, "multipliers": multiplier, "args": args}
        return {
            name: (self.named(name), tuple(values[x] for x in arguments))
            for name, arguments in self.signatures().items()
            if getattr(self, name) is not None
        }

    def named(self, name: str) -> "NamedFunction":
        """Return a function of the system whose errors name the function."""
        called = f"{name}({', '.join(self.signatures()[name])})"
        return NamedFunction(getattr(self, name), called)

    def external_force(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        u: Float[Array, " n"],
        multiplier: Float[Array, " l"],
        args: Args,
    ) -> Float[Array, " n"]:
        """Compute the user's force F; the system must have a force."""
        given = (multiplier,) if self.force_takes_multipliers else ()
        force = self.named("force")(t, q, u, *given, args)
        # A scalar would act on all coordinates. `initial_state` detects this error, but
        # a run may use another system.
        if jnp.shape(force) != u.shape:
            raise ShapeError(
                f"`force({', '.join(self.signatures()['force'])})` must return shape "
                f"{u.shape}, got shape {jnp.shape(force)}. Give one component for each "
                "coordinate."
            )
        return force

    def free_force(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        u: Float[Array, " n"],
        multiplier: Float[Array, " l"],
        args: Args,
    ) -> Float[Array, " n"]:
        """Compute the conservative force plus F, without the constraint reactions."""
        conservative = self.conservative_force(t, q, u, args)
        if self.force is None:
            return conservative
        return conservative + self.external_force(t, q, u, multiplier, args)

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
        return jnp.atleast_1d(self.named("holonomic")(t, q, args))

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
        return jnp.atleast_1d(self.named("nonholonomic")(t, q, u, args))

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
        holonomic constraints. By Chetaev's rule a holonomic constraint and its rate
        have the same reaction, so that these rows determine all multipliers.
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

        The order is: the m nonholonomic constraints, the time derivatives of the k
        holonomic constraints, and the k holonomic constraints themselves. All of them
        vanish at a consistent state.
        """
        check_time_and_state("constraint_violation", t, y)
        on_velocities = self.constraint(t, y.q, self.fibre_coordinate(y), args)
        return jnp.concatenate([on_velocities, self.position_constraint(t, y.q, args)])


class LagrangianSystem(AbstractMechanicalSystem):
    """A Lagrangian system with constraints and external forces.

    Its motion obeys, with multipliers λ, ν and Chetaev's rule for the reaction (paper,
    sections 3 and 6),

    d/dt D2L = ad*_v D2L + L_q^* D1L + F + λᵀ D2Φ + νᵀ L_q^* DΓ,

    Φ(t, q, v) = 0,    Γ(t, q) = 0,    q̇ = q v,

    which on R^n is the familiar d/dt D2L = D1L + F + λᵀ D2Φ + νᵀ DΓ with q̇ = v.
    Automatic differentiation computes all derivatives. If a function is an
    `equinox.Module`, its array leaves are parameters of the system, and gradients with
    respect to the system include them. A system can be an argument of `jax.jit`,
    `jax.vmap` and `jax.grad`. Python functions are a part of its structure: a system
    with another function is compiled again.

    Values that the functions read besides their arguments (globals, variables of
    enclosing functions, attributes of objects) are compiled in. `integrate` and
    `initial_state` compare them from call to call and compile again if one has changed.
    Your own `jax.jit` does not compare them. Put values that change into `args`, or
    into array fields of an `equinox.Module`: new values there never recompile.
    `docs/systems.md` has the details.

    **Arguments:**

    - `lagrangian`: L, called as `lagrangian(t, q, v, args)`, a scalar. On a group it is
        left-trivialised: `q` is an element, and `v` is the body velocity in the Lie
        algebra.
    - `nonholonomic`: Φ, called as `nonholonomic(t, q, v, args)`, of shape () or (m,):
        linear, affine or nonlinear in v, and it may depend on time.
    - `holonomic`: Γ, called as `holonomic(t, q, args)`, of shape () or (k,).
    - `force`: an external covector F, called as `force(t, q, v, args)`, of shape (n,);
        on a group in left-trivialised components. A force that depends on the reactions
        of the constraints, such as friction, is called as
        `force(t, q, v, multipliers, args)`, with the λ and ν of all constraints in the
        order of `State.multiplier`. Such a force must have a forward-mode derivative
        with respect to the multipliers, and the constraints must be independent.
    - `manifold`: the configuration manifold; by default R^n with the n of the state.
    - `constraints`: `"independent"` refuses dependent constraints. `"redundant"` allows
        constraints that follow from others, including nonholonomic constraints that
        follow from holonomic ones. Different multipliers then give the same reaction.
        nhjax chooses the multipliers with the least Σ |λ_a B_a|², where |λ_a B_a| is
        the size of the reaction of one constraint in the metric M⁻¹. The multiplier of
        a nonholonomic constraint is zero if the constraint follows from holonomic
        constraints. `nhjax.Motion.is_unique` says which multipliers the equations
        determine. `docs/systems.md` has the details.
    - `coordinates`: a tuple of the names of the n coordinates, for
        `Solution.to_xarray` and for `keep_q`, `keep_v` and `keep_p` of `initial_state`;
        None by default.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> blade = lambda t, q, v, args: -jnp.sin(q[2]) * v[0] + jnp.cos(q[2]) * v[1]
        >>> skate = nhjax.LagrangianSystem(
        ...     lambda t, q, v, args: 0.5 * v @ v, nonholonomic=blade)
    """

    lagrangian: PhaseFunction = eqx.field(converter=static_function)
    nonholonomic: PhaseFunction | None = eqx.field(
        default=None, kw_only=True, converter=static_function
    )
    holonomic: PositionFunction | None = eqx.field(
        default=None, kw_only=True, converter=static_function
    )
    force: ForceFunction | None = eqx.field(
        default=None, kw_only=True, converter=static_function
    )
    manifold: AbstractLieGroup | None = eqx.field(default=None, kw_only=True)
    constraints: Literal["independent", "redundant"] = eqx.field(
        default="independent", kw_only=True, static=True
    )
    coordinates: tuple[str, ...] | None = eqx.field(
        default=None, kw_only=True, static=True
    )
    force_takes_multipliers: bool = eqx.field(init=False, static=True)

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
        return jax.grad(self.named("lagrangian"), argnums=2)(t, q, u, args)

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

    def conservative_force(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        u: Float[Array, " n"],
        args: Args = None,
    ) -> Float[Array, " n"]:
        """Compute L_q^* D1L, the derivative of L with respect to the position."""
        return self.manifold_of(q).left_gradient(
            lambda g: self.named("lagrangian")(t, g, u, args), q
        )

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
        return jnp.sum(p * y.v) - self.named("lagrangian")(t, y.q, y.v, args)


class HamiltonianSystem(AbstractMechanicalSystem):
    """A Hamiltonian system with constraints and external forces.

    Its motion obeys (paper, section 3)

    ṗ = ad*_v p - L_q^* D1H + F + λᵀ ♭_H D2Ψ + νᵀ L_q^* DΓ,    q̇ = q v,    v = D2H,

    Ψ(t, q, p) = 0,    Γ(t, q) = 0,

    where ♭_H = (D2D2H)⁻¹ maps velocities to momenta. The paper's Hamiltonian equations
    are integrated, with the stage momenta as unknowns, so that no Legendre transform
    has to be inverted. Values that the functions read besides their arguments are
    compiled in, as for a `LagrangianSystem`.

    **Arguments:**

    - `hamiltonian`: H, called as `hamiltonian(t, q, p, args)`, a scalar. On a group it
        is left-trivialised: `q` is an element, and `p` is a covector of the Lie
        algebra.
    - `nonholonomic`: Ψ, called as `nonholonomic(t, q, p, args)`, of shape () or (m,).
    - `holonomic`: Γ, called as `holonomic(t, q, args)`, of shape () or (k,).
    - `force`: an external covector F, called as `force(t, q, p, args)`, or as
        `force(t, q, p, multipliers, args)` if it depends on the reactions, of shape
        (n,).
    - `manifold`: the configuration manifold; by default R^n with the n of the state.
    - `constraints`: `"independent"` refuses dependent constraints. `"redundant"` allows
        constraints that follow from others, as in a `LagrangianSystem`.
    - `coordinates`: a tuple of the names of the n coordinates, as in a
        `LagrangianSystem`; None by default.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> oscillator = nhjax.HamiltonianSystem(
        ...     lambda t, q, p, args: 0.5 * p @ p + 0.5 * q @ q)
        >>> y = nhjax.initial_state(oscillator, jnp.array([1.0]), p=jnp.array([0.0]))
        >>> float(oscillator.energy(0.0, y))
        0.5
    """

    hamiltonian: PhaseFunction = eqx.field(converter=static_function)
    nonholonomic: PhaseFunction | None = eqx.field(
        default=None, kw_only=True, converter=static_function
    )
    holonomic: PositionFunction | None = eqx.field(
        default=None, kw_only=True, converter=static_function
    )
    force: ForceFunction | None = eqx.field(
        default=None, kw_only=True, converter=static_function
    )
    manifold: AbstractLieGroup | None = eqx.field(default=None, kw_only=True)
    constraints: Literal["independent", "redundant"] = eqx.field(
        default="independent", kw_only=True, static=True
    )
    coordinates: tuple[str, ...] | None = eqx.field(
        default=None, kw_only=True, static=True
    )
    force_takes_multipliers: bool = eqx.field(init=False, static=True)

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
        return jax.grad(self.named("hamiltonian"), argnums=2)(t, q, u, args)

    def metric(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        u: Float[Array, " n"],
        args: Args = None,
    ) -> Float[Array, "n n"]:
        """Compute the metric D2D2H on momenta, the inverse of the mass matrix."""
        return jax.jacfwd(self.velocity, argnums=2)(t, q, u, args)

    def conservative_force(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        u: Float[Array, " n"],
        args: Args = None,
    ) -> Float[Array, " n"]:
        """Compute -L_q^* D1H from the derivative of H with respect to the position."""
        return -self.manifold_of(q).left_gradient(
            lambda g: self.named("hamiltonian")(t, g, u, args), q
        )

    def flat(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        u: Float[Array, " n"],
        derivative: Float[Array, " n"],
        args: Args = None,
    ) -> Float[Array, " n"]:
        """Compute ♭_H D2Ψ = (D2D2H)⁻¹ D2Ψ from a constraint's derivative D2Ψ."""
        metric = square_jacobian(lambda u: self.velocity(t, q, u, args), u)
        return metric.inverse().matvec(derivative)

    def energy(self, t: FloatScalarLike, y: State, args: Args = None) -> FloatScalar:
        """Compute the energy H(t, q, p) of a state.

        The arguments are the same as for `LagrangianSystem.energy`.
        """
        check_time_and_state("energy", t, y)
        return self.named("hamiltonian")(t, y.q, y.p, args)


S = TypeVar("S", bound=AbstractMechanicalSystem)


def with_kept_functions(
    system: S, t: FloatScalar, q: PyTree[Array], u: Float[Array, " n"], args: Args
) -> S:
    """Return the system with functions that are traced and differentiated once.

    The arrays that the functions read become leaves of the system, because the
    derivative rules of a step cover only the leaves of its arguments.
    """
    multiplier = None
    if system.force_takes_multipliers:
        # `eval_shape` does not get `args`, which may have objects that are not arrays.
        shape = jax.eval_shape(lambda: system.constraint(t, q, u, args)).shape
        multiplier = jnp.zeros(shape, u.dtype)
    functions = system.functions(t, q, u, multiplier, args)
    return eqx.tree_at(
        lambda system: [getattr(system, name) for name in functions],
        system,
        [
            kept_function(function, *example) or ClosureConverted(function, *example)
            for function, example in functions.values()
        ],
    )


def with_frames(system: S, q: PyTree[Array]) -> tuple[S, PyTree[Array]]:
    """Return the system and the configuration q with precomputed frames.

    A frame holds the sine and cosine of an angle. With it, the methods of the system
    rotate vectors between body and plane without trigonometric functions. These methods
    accept positions with and without frames; the user's functions receive positions
    without frames. On a manifold without frames the system and q are returned
    unchanged.
    """
    # The methods of a subclass might not support frames.
    if type(system) not in (LagrangianSystem, HamiltonianSystem):
        return system, q
    position = framed(system.manifold_of(q), q)
    if not any(map(is_framed, jax.tree.leaves(position, is_leaf=is_framed))):
        return system, q
    names = [name for name in system.signatures() if getattr(system, name) is not None]
    functions = [getattr(system, name) for name in names]
    system = eqx.tree_at(
        lambda system: [getattr(system, name) for name in names],
        system,
        [_OfPosition(function) for function in functions],
    )
    return system, position


class _OfPosition(eqx.Module):
    """A function of (t, q, ...) that accepts q with frames, and removes them."""

    function: PhaseFunction | PositionFunction | ForceFunction

    def __call__(self, t, q, *rest):
        return self.function(t, unframed(q), *rest)
