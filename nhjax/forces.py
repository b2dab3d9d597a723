"""Forces and torques on points and bodies, as generalised forces of a system.

A force f that acts on a point x(t, q) has the power f · ẋ. The generalised force is
F = (∂x/∂q)ᵀ f on a vector space, and F = L_g^* (∂x/∂g)ᵀ f on a group, with the left
translation L_g. Then F · v = f · ẋ if x does not depend explicitly on time.
"""

import abc
import reprlib
from collections.abc import Callable
from typing import Any, cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from ._custom_types import (
    Args,
    FloatScalarLike,
    ForceFunction,
    PhaseFunction,
    PositionFunction,
)
from ._errors import is_traced, naming, ShapeError
from ._manifold import AbstractLieGroup, Euclidean
from ._system import (
    AbstractOfSystem,
    as_given,
    check_same_manifold,
    check_signature,
    parameter,
    static_function,
    takes_multipliers,
    value_and_rate,
)


def positive(value: Any) -> Array:
    """Convert a parameter to an array, or raise unless it is one positive number."""
    return _checked_sign(value, "positive", lambda x: x > 0)


def not_negative(value: Any) -> Array:
    """Convert a parameter to an array, or raise unless it is one number >= 0."""
    return _checked_sign(value, "positive or zero", lambda x: x >= 0)


def _checked_sign(value: Any, sign: str, is_right: Callable[[Any], Any]) -> Array:
    number = scalar(value)
    if not is_traced(number) and not is_right(np.asarray(number)):
        raise ValueError(f"This parameter of a force must be {sign}, got {number}.")
    return number


def _number(value: Any) -> Array:
    """Convert a parameter to an array of floats, or raise if it is not real."""
    if value is None or callable(value):
        raise TypeError(
            f"A parameter of a force must be a number or an array, got "
            f"{reprlib.repr(value)} of type {type(value).__name__}. To change it along "
            f"the motion, write a function of (t, q, v, args)."
        )
    array = parameter(value)
    if jnp.iscomplexobj(array):
        raise TypeError(f"A parameter of a force must be real, got {array.dtype}.")
    if not jnp.issubdtype(array.dtype, jnp.floating):
        array = array.astype(float)
    return array


def scalar(value: Any) -> Array:
    """Convert a parameter to an array, or raise unless it is one real number."""
    number = _number(value)
    if number.shape != ():
        raise ShapeError(
            f"A parameter of a force must be one number, got shape {number.shape}. For "
            f"several values use `jax.vmap`."
        )
    return number


def function_or_numbers(value: Any) -> Any:
    if not callable(value):
        return _number(value)
    check_signature("A force", "its function", value, ("t", "q", "v", "args"))
    return static_function(value)


def function_or_not_negative(value: Any) -> Any:
    """Convert a number >= 0 to an array, or check a function."""
    return function_or_numbers(value) if callable(value) else not_negative(value)


def position_function(value: Any) -> Any:
    """Check a function of (t, q, args) that returns a point, an angle or a rotation."""
    check_signature("A force", "its point or angle", value, ("t", "q", "args"))
    return static_function(value)


def of_phase(name: str, value: Any, like: Array, *arguments: Any) -> Array:
    """Return a parameter, or its value if it is a function, in the dtype of `like`.

    A value of another shape than `like` raises a `ShapeError`. The user's function
    takes (t, q, v, args) or (t, q, v, multipliers, args).
    """
    if callable(value):
        names = ["t", "q", "v", "args"]
        if len(arguments) > len(names):
            names.insert(3, "multipliers")
        with naming(f"{name}({', '.join(names)})", as_given(value), arguments[-1]):
            value = value(*arguments)
    value = jnp.asarray(value)
    if jnp.iscomplexobj(value):
        raise TypeError(f"`{name}` must be real, got {value.dtype}.")
    if value.shape != like.shape:
        raise ShapeError(
            f"`{name}` must have the shape of what it acts on, {like.shape}, got "
            f"shape {value.shape}."
        )
    return value.astype(like.dtype)


class AbstractSummable(AbstractOfSystem):
    """A generalised force that can be added to others and to the user's functions."""

    def check_system(self, system: Any) -> None:
        """Accept every system; forces with requirements override this method."""

    def __add__(self, other: Any) -> "Sum":
        """Add another force, or a function F(t, q, v, args)."""
        return Sum(cast(Any, self), other)

    def __radd__(self, other: Any) -> Any:
        """Add to a function F(t, q, v, args), or to the 0 with which `sum` starts."""
        if type(other) is int and other == 0:
            return self
        return Sum(cast(Any, other), cast(Any, self))

    # Without this, a NumPy array to the left of `+` would add the force elementwise.
    __array_ufunc__ = None


class AbstractForce(AbstractSummable):
    """A generalised force F(t, q, v, args), the `force` of a `LagrangianSystem`.

    Add forces, and functions of (t, q, v, args), with `+`. Parameters that are numbers
    or arrays are pytree leaves: new values cause no recompilation, and derivatives with
    respect to them are available. A new function causes a recompilation.

    A `HamiltonianSystem` passes momenta, not velocities, to its forces. Therefore use
    `Drag`, `Motor`, `Brake` and a `Spring` with a damper only in a `LagrangianSystem`.

    To define a force, write a subclass with this method:

    - `__call__(t, q, v, args)`: the generalised force, of shape (n,); on a group in
        left-trivialised components.
    """

    @abc.abstractmethod
    def __call__(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        v: Float[Array, " n"],
        args: Args = None,
    ) -> Float[Array, " n"]:
        """Compute the generalised force."""


class AbstractForceOfReactions(AbstractSummable):
    """A force F(t, q, v, multipliers, args) that depends on the reactions.

    The forces of `nhjax.friction` are of this kind. Add them like other forces. To
    define one, write a subclass with this method:

    - `__call__(t, q, v, multipliers, args)`: the generalised force, of shape (n,), with
        the multipliers of all constraints of the system in the order of
        `State.multiplier`.
    """

    @abc.abstractmethod
    def __call__(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        v: Float[Array, " n"],
        multipliers: Float[Array, " l"],
        args: Args,
    ) -> Float[Array, " n"]:
        """Compute the generalised force."""


class Sum(AbstractSummable):
    """The sum of forces and of functions F(t, q, v, args).

    If a term depends on the multipliers, the sum is a force F(t, q, v, multipliers,
    args).

    !!! example

        >>> import jax.numpy as jnp
        >>> from nhjax import forces
        >>> tip = lambda t, q, args: q[:2]
        >>> pull = forces.PointForce(tip, jnp.array([1.0, 0.0]))
        >>> (pull + forces.Drag(tip, linear=0.5))(0.0, jnp.zeros(3), jnp.ones(3))
        Array([ 0.5, -0.5,  0. ], dtype=float64)
    """

    terms: tuple[Callable[..., Any], ...]

    def __init__(self, *terms: ForceFunction):
        if len(terms) == 1 and isinstance(terms[0], tuple | list):
            raise TypeError(
                "Sum takes forces as arguments: write `Sum(*forces)` instead of "
                "`Sum(forces)`."
            )
        for number, term in enumerate(terms):
            multipliers = ("multipliers",) if takes_multipliers(term) else ()
            arguments = ("t", "q", "v", *multipliers, "args")
            check_signature("Sum", f"term {number}", term, arguments)
        self.terms = tuple(map(static_function, terms))

    @property
    def takes_multipliers(self) -> bool:
        """Whether the sum is called with the multipliers."""
        return any(takes_multipliers(as_given(term)) for term in self.terms)

    def check_system(self, system: Any) -> None:
        """Raise a `ValueError` unless each term fits the system."""
        for term in self.terms:
            if isinstance(term, AbstractOfSystem):
                term.check_system(system)

    def __call__(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        v: Float[Array, " n"],
        *rest: Any,
    ) -> Float[Array, " n"]:
        """Compute the sum.

        `rest` is (multipliers, args) if a term depends on the multipliers, and (args,)
        otherwise; without `rest`, `args` is None.
        """
        rest = rest or (None,)
        total = jnp.zeros_like(v)
        for term in self.terms:
            given = rest if takes_multipliers(as_given(term)) else rest[-1:]
            total = total + of_phase("force", term, v, t, q, v, *given)
        return total


class _AbstractPulledBack(AbstractForce):
    """A force that acts on x(t, q): a point, an angle or a rotation."""

    manifold: eqx.AbstractVar[AbstractLieGroup | None]

    @abc.abstractmethod
    def _place(self, t: Any, q: Any, args: Any) -> Array:
        """Compute x(t, q)."""

    @abc.abstractmethod
    def _covector(self, t: Any, q: Any, v: Array, args: Any) -> Array:
        """Compute the covector on x, whose product with ẋ is the power of the force."""

    def __call__(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        v: Float[Array, " n"],
        args: Args = None,
    ) -> Float[Array, " n"]:
        """Compute the generalised force (∂x/∂q)ᵀ f of the covector f."""
        covector = self._covector(t, q, v, args)
        manifold = Euclidean(q.shape[0]) if self.manifold is None else self.manifold
        return manifold.left_gradient(
            lambda q: jnp.sum(covector * self._place(t, q, args)), q
        )

    def check_system(self, system: Any) -> None:
        """Raise a `ValueError` unless the system has the manifold of this force."""
        check_same_manifold("force", self, self.manifold, system.manifold)

    def _with_rate(self, t: Any, q: Any, v: Array, args: Any) -> tuple[Array, Array]:
        """Evaluate x(t, q) and ẋ = ∂x/∂t + ∂x/∂q · q̇."""
        return value_and_rate(
            lambda t, q: self._place(t, q, args), self.manifold, t, q, v
        )


class PointForce(_AbstractPulledBack):
    """A force on a point, or a torque on an angle.

    F = (∂x/∂q)ᵀ f, with the point x(t, q, args) and the force f(t, q, v, args).

    If x is an angle [rad], f is the torque [N m] about its axis. A torque between two
    bodies acts on the angle between them, such as `q[3] - q[2]`.

    **Arguments:**

    - `point`: x, called as `point(t, q, args)`: coordinates [m] of shape (d,), or an
        angle of shape ().
    - `vector`: f [N], an array of the shape of x, or a function of (t, q, v, args) that
        returns one.
    - `manifold`: the `manifold` of the system, required if it has one.

    **Raises:** when called, `ShapeError` if the shapes of x and f differ.

    !!! example

        >>> import jax.numpy as jnp
        >>> from nhjax import forces
        >>> tip = lambda t, q, args: 2.0 * jnp.array([jnp.cos(q[0]), jnp.sin(q[0])])
        >>> forces.PointForce(tip, [0.0, 3.0])(0.0, jnp.zeros(1), jnp.zeros(1))
        Array([6.], dtype=float64)
    """

    point: PositionFunction = eqx.field(converter=position_function)
    vector: ArrayLike | PhaseFunction = eqx.field(converter=function_or_numbers)
    manifold: AbstractLieGroup | None = eqx.field(default=None, kw_only=True)

    def _place(self, t: Any, q: Any, args: Any) -> Array:
        return value_at("point", self.point, t, q, args)

    def _covector(self, t: Any, q: Any, v: Array, args: Any) -> Array:
        x = self._place(t, q, args)
        return of_phase("vector", self.vector, x, t, q, v, args)


class Torque(_AbstractPulledBack):
    """A torque on a body in space, whose attitude is a function of (t, q, args).

    F · v = τ · ω with the angular velocity ω of the body, hat(ω) = Ṙ Rᵀ.

    **Arguments:**

    - `rotation`: R, called as `rotation(t, q, args)`, of shape (3, 3): from the frame
        of the body to the frame of space.
    - `vector`: τ [N m] in the frame of space, of shape (3,), or a function of
        (t, q, v, args) that returns one.
    - `manifold`: the `manifold` of the system, required if it has one.

    **Raises:** when called, `ShapeError` if R or τ has another shape.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> group = nhjax.SO3()
        >>> torque = nhjax.forces.Torque(
        ...     lambda t, q, args: group.matrix(q), [0.0, 0.0, 2.0], manifold=group)
        >>> torque(0.0, group.identity(), jnp.zeros(3))
        Array([0., 0., 2.], dtype=float64)
    """

    rotation: PositionFunction = eqx.field(converter=position_function)
    vector: ArrayLike | PhaseFunction = eqx.field(converter=function_or_numbers)
    manifold: AbstractLieGroup | None = eqx.field(default=None, kw_only=True)

    def _place(self, t: Any, q: Any, args: Any) -> Array:
        rotation = value_at("rotation", self.rotation, t, q, args)
        if rotation.shape != (3, 3):
            raise ShapeError(
                f"`rotation` must have shape (3, 3), got {rotation.shape}. For an "
                f"angle use `PointForce`."
            )
        return rotation

    def _covector(self, t: Any, q: Any, v: Array, args: Any) -> Array:
        rotation = self._place(t, q, args)
        torque = of_phase("vector", self.vector, rotation[0], t, q, v, args)
        # The covector is ½ hat(τ) R: its inner product with Ṙ = hat(ω) R is τ · ω.
        return 0.5 * jnp.cross(torque[:, None], rotation, axis=0)


class Spring(_AbstractPulledBack):
    """A spring with a damper between two points.

    The force on the first point is -(k (|d| - l) + c d/dt |d|) d / |d| with
    d = x₁ - x₂, and the opposite force acts on the second point. Where the points
    coincide, the force is zero. With l > 0 the force jumps there: make sure that the
    points stay apart.

    `system.energy` does not include the energy of a `Spring`. To include it, add
    -½ k (|d| - l)² to the Lagrangian instead of using a `Spring`. The computed motion
    is the same. A damper cannot be included in this way.

    **Arguments:**

    - `first`: x₁, called as `first(t, q, args)`, coordinates [m] of shape (d,).
    - `second`: x₂, a function like `first`, or the coordinates of a fixed point.
    - `stiffness`: k [N/m].
    - `rest_length`: l [m].
    - `damping`: c [N s/m].
    - `manifold`: the `manifold` of the system, required if it has one.

    **Raises:** when called, `ShapeError` if the shapes of the points differ, or are not
    of the form (d,).

    !!! example

        >>> import jax.numpy as jnp
        >>> from nhjax import forces
        >>> mass = lambda t, q, args: q
        >>> spring = forces.Spring(mass, [0.0, 0.0], 10.0, rest_length=1.0)
        >>> spring(0.0, jnp.array([1.5, 2.0]), jnp.zeros(2))
        Array([ -9., -12.], dtype=float64)
    """

    first: PositionFunction = eqx.field(converter=position_function)
    second: ArrayLike | PositionFunction = eqx.field(
        converter=lambda x: position_function(x) if callable(x) else _number(x)
    )
    stiffness: ArrayLike = eqx.field(converter=scalar)
    rest_length: ArrayLike = eqx.field(default=0.0, converter=scalar, kw_only=True)
    damping: ArrayLike = eqx.field(default=0.0, converter=scalar, kw_only=True)
    manifold: AbstractLieGroup | None = eqx.field(default=None, kw_only=True)

    def _place(self, t: Any, q: Any, args: Any) -> Array:
        first = value_at("first", self.first, t, q, args)
        second = self.second
        if callable(second):
            second = value_at("second", second, t, q, args)
        second = jnp.asarray(second, first.dtype)
        if second.shape != first.shape or first.ndim != 1:
            raise ShapeError(
                f"The points of a spring must both have a shape (d,), got `first` of "
                f"shape {first.shape} and `second` of shape {second.shape}. Between "
                f"angles use `PointForce`."
            )
        return first - second

    def _covector(self, t: Any, q: Any, v: Array, args: Any) -> Array:
        d, rate = self._with_rate(t, q, v, args)
        length = _length(d)
        apart = length > 0
        direction = jnp.where(apart, d / jnp.where(apart, length, 1), 0)
        k, rest, damping = in_precision_of(
            d, self.stiffness, self.rest_length, self.damping
        )
        return (k * rest - damping * jnp.sum(direction * rate)) * direction - k * d


class Drag(_AbstractPulledBack):
    """A drag force on a point, opposite to its velocity u relative to a medium.

    f = -(c₁ + c₂ |u|) u. The drag of a body of area A in a medium of density ρ has
    c₂ = ½ ρ C A with the drag coefficient C. If the point is an angle, f is a torque,
    such as the viscous friction of a bearing.

    The quadratic part has a kink at u = 0. If a point on a line reverses its motion
    during a step, this step has only order 2.

    **Arguments:**

    - `point`: x, called as `point(t, q, args)`: coordinates [m] of shape (d,), or an
        angle [rad] of shape ().
    - `linear`: c₁ [N s/m].
    - `quadratic`: c₂ [N s²/m²].
    - `medium`: the velocity of the medium [m/s], an array of the shape of x, or a
        function of (t, q, v, args) that returns one; zero by default.
    - `manifold`: the `manifold` of the system, required if it has one.

    **Raises:** when called, `ShapeError` if the shapes of the medium and x differ.

    !!! example

        >>> import jax.numpy as jnp
        >>> from nhjax import forces
        >>> drag = forces.Drag(lambda t, q, args: q, linear=1.0, quadratic=2.0)
        >>> drag(0.0, jnp.zeros(2), jnp.array([3.0, 4.0]))
        Array([-33., -44.], dtype=float64)
    """

    point: PositionFunction = eqx.field(converter=position_function)
    linear: ArrayLike = eqx.field(default=0.0, converter=scalar, kw_only=True)
    quadratic: ArrayLike = eqx.field(default=0.0, converter=scalar, kw_only=True)
    medium: ArrayLike | PhaseFunction | None = eqx.field(
        default=None,
        converter=lambda x: None if x is None else function_or_numbers(x),
        kw_only=True,
    )
    manifold: AbstractLieGroup | None = eqx.field(default=None, kw_only=True)

    def _place(self, t: Any, q: Any, args: Any) -> Array:
        return value_at("point", self.point, t, q, args)

    def _covector(self, t: Any, q: Any, v: Array, args: Any) -> Array:
        _, u = self._with_rate(t, q, v, args)
        if self.medium is not None:
            u = u - of_phase("medium", self.medium, u, t, q, v, args)
        linear, quadratic = in_precision_of(u, self.linear, self.quadratic)
        return -(linear + quadratic * _length(u)) * u


class Motor(_AbstractPulledBack):
    """A geared motor whose torque falls linearly with its speed.

    The torque on the angle φ is i τ₀ (c - i φ̇ / ω₀). This describes a DC motor that
    runs at the fraction c of its full voltage and drives φ through a gear of ratio i.
    Add the inertia J of its rotor to the Lagrangian, as ½ J (i φ̇)².

    **Arguments:**

    - `angle`: φ, called as `angle(t, q, args)` [rad], of shape (): the rotation of the
        driven part relative to the part that carries the motor.
    - `command`: c, a number or a function of (t, q, v, args). Values outside
        [-1, 1] are not limited; `saturated` can limit them.
    - `stall_torque`: τ₀ [N m], the torque of the motor at rest with c = 1.
    - `no_load_speed`: ω₀ [rad/s], the speed of the motor at zero torque and c = 1.
    - `gear`: i, turns of the motor for each turn of the angle.
    - `manifold`: the `manifold` of the system, required if it has one.

    **Raises:** when called, `ShapeError` if φ or c is not a scalar.

    !!! example

        >>> import jax.numpy as jnp
        >>> from nhjax import forces
        >>> wheel = lambda t, q, args: q[1]
        >>> motor = forces.Motor(wheel, 1.0, stall_torque=2.0, no_load_speed=10.0)
        >>> motor(0.0, jnp.zeros(2), jnp.array([0.0, 5.0]))
        Array([0., 1.], dtype=float64)
    """

    angle: PositionFunction = eqx.field(converter=position_function)
    command: ArrayLike | PhaseFunction = eqx.field(converter=function_or_numbers)
    stall_torque: ArrayLike = eqx.field(converter=scalar, kw_only=True)
    no_load_speed: ArrayLike = eqx.field(converter=scalar, kw_only=True)
    gear: ArrayLike = eqx.field(default=1.0, converter=scalar, kw_only=True)
    manifold: AbstractLieGroup | None = eqx.field(default=None, kw_only=True)

    def _place(self, t: Any, q: Any, args: Any) -> Array:
        return _angle(self.angle, t, q, args)

    def _covector(self, t: Any, q: Any, v: Array, args: Any) -> Array:
        phi, rate = self._with_rate(t, q, v, args)
        command = of_phase("command", self.command, phi, t, q, v, args)
        stall, free, gear = in_precision_of(
            phi, self.stall_torque, self.no_load_speed, self.gear
        )
        return gear * stall * (command - gear * rate / free)


class Brake(_AbstractPulledBack):
    """A brake on an angle, with the torque -τ tanh(φ̇ / ω₀).

    **Arguments:**

    - `angle`: φ, called as `angle(t, q, args)` [rad], of shape (): the rotation of the
        wheel relative to the part that carries the brake.
    - `torque`: τ >= 0 [N m], a number or a function of (t, q, v, args). For friction
        that depends on reactions, use `nhjax.friction.JointFriction`.
    - `smoothing`: ω₀ [rad/s]. Below ω₀ the brake acts like a damper, so that a loaded
        wheel creeps instead of standing still.
    - `manifold`: the `manifold` of the system, required if it has one.

    **Raises:** `ValueError` if τ is a negative number; when called, `ShapeError` if φ
    or τ is not a scalar.

    !!! example

        >>> import jax.numpy as jnp
        >>> from nhjax import forces
        >>> brake = forces.Brake(lambda t, q, args: q[1], 3.0, smoothing=0.1)
        >>> brake(0.0, jnp.zeros(2), jnp.array([0.0, -8.0]))
        Array([0., 3.], dtype=float64)
    """

    angle: PositionFunction = eqx.field(converter=position_function)
    torque: ArrayLike | PhaseFunction = eqx.field(converter=function_or_not_negative)
    smoothing: ArrayLike = eqx.field(converter=positive, kw_only=True)
    manifold: AbstractLieGroup | None = eqx.field(default=None, kw_only=True)

    def _place(self, t: Any, q: Any, args: Any) -> Array:
        return _angle(self.angle, t, q, args)

    def _covector(self, t: Any, q: Any, v: Array, args: Any) -> Array:
        phi, rate = self._with_rate(t, q, v, args)
        torque = of_phase("torque", self.torque, phi, t, q, v, args)
        (smoothing,) = in_precision_of(phi, self.smoothing)
        return -torque * jnp.tanh(rate / smoothing)


def _angle(angle: Any, t: Any, q: Any, args: Any) -> Array:
    """Evaluate the angle of a motor or a brake."""
    phi = value_at("angle", angle, t, q, args)
    if phi.shape != ():
        raise ShapeError(f"`angle` must have shape (), got {phi.shape}.")
    return phi


def saturated(x: ArrayLike, limit: ArrayLike) -> Array:
    """Limit a signal smoothly: limit · tanh(x / limit).

    Use this function instead of `jnp.clip` in forces, because each step differentiates
    the forces. `jnp.clip` has a kink at the limit: steps across the kink need more
    iterations, and have a lower order.

    **Arguments:**

    - `x`: the signal, of any shape.
    - `limit`: the positive bound of |result|, in the units of `x`.

    **Returns:** an array of the shape of `x`.

    !!! example

        >>> from nhjax import forces
        >>> float(forces.saturated(0.0, 2.0)), float(forces.saturated(50.0, 2.0))
        (0.0, 2.0)
    """
    limit = _number(limit)
    return limit * jnp.tanh(jnp.asarray(x) / limit)


def value_at(name: str, function: Any, t: Any, q: Any, args: Any) -> Array:
    """Evaluate a user's function of (t, q, args), as an array."""
    with naming(f"{name}(t, q, args)", as_given(function), args):
        return jnp.asarray(function(t, q, args))


def in_precision_of(x: Array, *numbers: ArrayLike) -> list[Array]:
    """Convert numbers to arrays of the dtype of x."""
    return [jnp.asarray(number, x.dtype) for number in numbers]


def _length(x: Array) -> Array:
    """Compute |x|, with the derivative zero at x = 0."""
    square = jnp.sum(x * x)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
