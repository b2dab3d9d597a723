"""Friction in contacts, joints and tyres, proportional to the load that they carry.

The load of a contact is a reaction, so that these forces depend on the multipliers. All
laws are smooth: near rest, the friction is proportional to the velocity. A contact that
should rest on an incline therefore creeps. If holding it takes the fraction r < 1 of
the largest friction, a contact with the law `Coulomb` creeps at the speed u₀ artanh(r),
where u₀ is the parameter `smoothing`. Near rest, the iteration of a step converges fast
for time steps up to about u₀ · mass / friction.
"""

import abc
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, PyTree

from ._custom_types import (
    Args,
    FloatScalar,
    FloatScalarLike,
    ForceFunction,
    PositionFunction,
)
from ._errors import ShapeError
from ._manifold import AbstractLieGroup, Euclidean
from ._system import check_same_manifold, check_type, value_and_rate
from .forces import (
    AbstractForceOfReactions,
    in_precision_of,
    not_negative,
    position_function,
    positive,
    scalar,
    value_at,
)
from .rolling import (
    absolute_load,
    AbstractContact,
    checked_contacts,
    checked_load,
    Contacts,
    ContactState,
    load_on,
)


# --- Laws -----------------------------------------------------------------------------


class AbstractFrictionLaw(eqx.Module):
    """A friction coefficient μ(u) that depends on the sliding speed u.

    To define a law, write a subclass with this method:

    - `slope(square)`: μ(u) / u, as a smooth function of u² >= 0.
    """

    @abc.abstractmethod
    def slope(self, square: FloatScalar) -> FloatScalar:
        """Compute μ(u) / u from u²."""

    def coefficient(self, speed: ArrayLike) -> Array:
        """Compute μ(u), with the sign of u."""
        speed = jnp.asarray(speed)
        return speed * self.slope(speed * speed)


def _check_law(law: Any) -> None:
    advice = "For example, pass nhjax.friction.Coulomb(0.5, smoothing=0.001)."
    check_type("law", law, AbstractFrictionLaw, advice)


class Coulomb(AbstractFrictionLaw):
    """Coulomb's law, made smooth: μ(u) = μ tanh(u / u₀).

    **Arguments:**

    - `friction`: μ, the coefficient of friction.
    - `smoothing`: u₀ [m/s]. At 3 u₀ the friction is 99.5 percent of μ; at 20 u₀ it
        equals μ up to round-off.

    !!! example

        >>> from nhjax import friction
        >>> float(friction.Coulomb(0.5, smoothing=0.01).coefficient(1.0))
        0.5
    """

    friction: ArrayLike = eqx.field(converter=not_negative)
    smoothing: ArrayLike = eqx.field(converter=positive, kw_only=True)

    def slope(self, square: FloatScalar) -> FloatScalar:
        """Compute μ(u) / u from u²."""
        return _coulomb_slope(self.friction, self.smoothing, square)


class Stribeck(AbstractFrictionLaw):
    """Stribeck's law: the friction falls from static to kinetic as the speed grows.

    μ(u) = (μ_k + (μ_s - μ_k) exp(-(u / u_s)²)) tanh(u / u₀) + c u.

    **Arguments:**

    - `static`, `kinetic`: μ_s and μ_k.
    - `stribeck_speed`: u_s [m/s].
    - `smoothing`: u₀ [m/s], smaller than u_s.
    - `viscous`: c [s/m].

    !!! example

        >>> from nhjax import friction
        >>> law = friction.Stribeck(0.6, 0.4, stribeck_speed=0.1, smoothing=0.001)
        >>> [round(float(law.coefficient(u)), 3) for u in (0.02, 1.0)]
        [0.592, 0.4]
    """

    static: ArrayLike = eqx.field(converter=not_negative)
    kinetic: ArrayLike = eqx.field(converter=not_negative)
    stribeck_speed: ArrayLike = eqx.field(converter=positive, kw_only=True)
    smoothing: ArrayLike = eqx.field(converter=positive, kw_only=True)
    viscous: ArrayLike = eqx.field(default=0.0, converter=scalar, kw_only=True)

    def slope(self, square: FloatScalar) -> FloatScalar:
        """Compute μ(u) / u from u²."""
        static, kinetic, stribeck, viscous = in_precision_of(
            square, self.static, self.kinetic, self.stribeck_speed, self.viscous
        )
        friction = kinetic + (static - kinetic) * jnp.exp(-square / stribeck**2)
        return _coulomb_slope(friction, self.smoothing, square) + viscous


class LinearSlip(AbstractFrictionLaw):
    """The law of a tyre that slips a little: μ(σ) = C σ, with the dimensionless slip σ.

    **Arguments:**

    - `stiffness`: C, the tyre's slip stiffness divided by its load; about 10 to 20 for
        a car.

    !!! example

        >>> from nhjax import friction
        >>> float(friction.LinearSlip(10.0).coefficient(0.05))
        0.5
    """

    stiffness: ArrayLike = eqx.field(converter=scalar)

    def slope(self, square: FloatScalar) -> FloatScalar:
        """Compute C, the slope of the law."""
        return in_precision_of(square, self.stiffness)[0]


class MagicFormula(AbstractFrictionLaw):
    """Pacejka's formula: μ(σ) = D sin(C atan(B σ - E (B σ - atan B σ))).

    **Arguments:**

    - `stiffness`, `shape`, `peak`, `curvature`: B, C, D and E, numbers without unit. D
        is the largest friction coefficient, and B C D the slope at σ = 0.

    !!! example

        >>> from nhjax import friction
        >>> tyre = friction.MagicFormula(10.0, 1.9, 1.0, 0.97)
        >>> [round(float(tyre.coefficient(x)), 3) for x in (0.01, 0.15, 1.0)]
        [0.188, 0.997, 0.915]
    """

    stiffness: ArrayLike = eqx.field(converter=scalar)
    shape: ArrayLike = eqx.field(converter=scalar)
    peak: ArrayLike = eqx.field(converter=scalar)
    curvature: ArrayLike = eqx.field(converter=scalar)

    def slope(self, square: FloatScalar) -> FloatScalar:
        """Compute μ(σ) / σ from σ²."""
        b, c, d, e = in_precision_of(
            square, self.stiffness, self.shape, self.peak, self.curvature
        )
        # The functions sin and atan are odd, and are evaluated as x f(x²).
        first = b * (1 - e * (1 - _atan_slope(b * b * square)))
        second = c * first * _atan_slope(first * first * square)
        return d * second * _sin_slope(second * second * square)


# --- Forces on contacts ---------------------------------------------------------------


def _require_velocities(force: Any, system: Any) -> None:
    """Raise a `ValueError` for a Hamiltonian system, whose forces receive momenta."""
    if system.fibre_coordinate_name == "p":
        raise ValueError(
            f"`force` has a {type(force).__name__}, which depends on velocities, but a "
            "HamiltonianSystem passes momenta: use a LagrangianSystem."
        )


class _AbstractOnContact(AbstractForceOfReactions):
    """A force -|N| f(r) r at a contact with the normal force N.

    r, a velocity or an angular velocity of the contact, is linear in v, and f > 0. The
    generalised force is (∂r/∂v)ᵀ times this force, so that its power is
    -|N| f(r) r².
    """

    contacts: eqx.AbstractVar[Contacts]
    contact: eqx.AbstractVar[str]
    load: eqx.AbstractVar[ArrayLike | ForceFunction | None]

    def __check_init__(self) -> None:
        self.contacts.check_load(self.contact, self.load)

    @abc.abstractmethod
    def _rate(self, contact: AbstractContact, at: ContactState) -> Array:
        """Return the velocity or angular velocity r."""

    @abc.abstractmethod
    def _slope(self, at: ContactState, rate: Array) -> Array:
        """Return f(r), the magnitude of the force divided by |N| and by |r|."""

    def check_system(self, system: Any) -> None:
        """Raise a `ValueError` unless the contact and its load fit the system."""
        _require_velocities(self, system)
        contact = self.contacts[self.contact]
        check_same_manifold("force", contact, contact.manifold, system.manifold)
        if self.load is None:
            self.contacts.check_constraints_of(system)

    def __call__(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        v: Float[Array, " n"],
        multipliers: Float[Array, " l"],
        args: Args,
    ) -> Float[Array, " n"]:
        """Compute the generalised force."""
        contact = self.contacts[self.contact]

        def rate(v):
            at = contact.state(t, q, v, args)
            return self._rate(contact, at), at

        r, pull_back, at = jax.vjp(rate, v, has_aux=True)
        given = self.contacts, self.contact, self.load, t, q, v, multipliers, args
        return pull_back(-load_on(*given) * self._slope(at, r) * r)[0]


class Sliding(_AbstractOnContact):
    """Friction of a sliding contact, in the directions in which it slips.

    The force on the body is -|N| μ(u) in the direction of the velocity u at which the
    contact slides. u is the part of the contact's velocity that its constraints leave
    free: all of the velocity along the plane if `no_slip=()`, or the velocity along the
    edge of a blade.

    **Arguments:**

    - `contacts`, `contact`: the contacts of the system, and the name of one of them.
    - `law`: μ(u), such as `Coulomb(0.5, smoothing=0.001)`.
    - `load`: N, a number [N] or a function of (t, q, v, multipliers, args). By default
        N is the multiplier of the height; if the height of the contact is not a
        constraint, `load` is required.

    **Raises:** `ValueError` if there is no contact of this name, no load, or no
    direction in which the contact slips.

    !!! example

        >>> import jax.numpy as jnp
        >>> from nhjax import friction, rolling
        >>> contacts = rolling.Contacts(skate=rolling.Blade(
        ...     lambda t, q, args: (q, jnp.eye(3)), touches=False))
        >>> law = friction.Coulomb(0.25, smoothing=0.01)
        >>> force = friction.Sliding(contacts, "skate", law, load=8.0)
        >>> v = jnp.array([3.0, 0.0, 0.0])
        >>> force(0.0, jnp.zeros(3), v, jnp.zeros(1), None)
        Array([-2.,  0.,  0.], dtype=float64)
    """

    contacts: Contacts = eqx.field(converter=checked_contacts)
    contact: str = eqx.field(static=True)
    law: AbstractFrictionLaw
    load: ArrayLike | ForceFunction | None = eqx.field(
        default=None, converter=checked_load, kw_only=True
    )

    def __check_init__(self) -> None:
        _check_law(self.law)
        if self.contacts[self.contact].num_directions > 1:
            raise ValueError(
                f"The contact {self.contact!r} does not slip in any direction: give "
                "it fewer directions `no_slip`."
            )

    def _rate(self, contact: AbstractContact, at: ContactState) -> Array:
        return _sliding(contact, at)

    def _slope(self, at: ContactState, rate: Array) -> Array:
        return self.law.slope(rate @ rate)


class Tyre(_AbstractOnContact):
    """A tyre that slips a little: its force depends on the slip σ.

    The slip is σ = u / (V² + V₀²)^½, with the velocity u at which the contact slides
    and the speed V of the hub. The force on the wheel is -|N| μ(|σ|) σ / |σ|. The
    vector σ has the slips along and across the wheel, so that the longitudinal and the
    lateral force share the friction μ(|σ|).

    **Arguments:**

    - `contacts`, `contact`: the contacts of the system, and the name of one of them.
    - `law`: μ(σ), a `LinearSlip` or a `MagicFormula`.
    - `slowest`: V₀ [m/s], which keeps the slip defined at rest. Below V₀ the tyre acts
        like a damper.
    - `load`: as for `Sliding`.

    **Raises:** as `Sliding`.

    !!! example

        >>> import jax.numpy as jnp
        >>> from nhjax import friction, rolling
        >>> ball = rolling.Wheel(lambda t, q, args: (q, jnp.eye(3)), 0.3,
        ...     no_slip=(), touches=False)
        >>> tyre = friction.Tyre(rolling.Contacts(wheel=ball), "wheel",
        ...     friction.LinearSlip(2.0), slowest=1e-3, load=10.0)
        >>> v = jnp.array([0.0, 4.0, 0.0])
        >>> tyre(0.0, jnp.zeros(3), v, jnp.zeros(0), None).round(4)
        Array([  0., -20.,   0.], dtype=float64)
    """

    contacts: Contacts = eqx.field(converter=checked_contacts)
    contact: str = eqx.field(static=True)
    law: AbstractFrictionLaw
    slowest: ArrayLike = eqx.field(converter=positive, kw_only=True)
    load: ArrayLike | ForceFunction | None = eqx.field(
        default=None, converter=checked_load, kw_only=True
    )

    def __check_init__(self) -> None:
        Sliding(self.contacts, self.contact, self.law, load=0.0)

    def _rate(self, contact: AbstractContact, at: ContactState) -> Array:
        return _sliding(contact, at)

    def _slope(self, at: ContactState, rate: Array) -> Array:
        (slowest,) = in_precision_of(rate, self.slowest)
        travel = _along_plane(at.travel, at)
        square = travel @ travel + slowest * slowest
        return self.law.slope(rate @ rate / square) / jnp.sqrt(square)


class RollingResistance(_AbstractOnContact):
    """Rolling resistance: a torque against the rolling of a wheel or a ball.

    The torque is -|N| e tanh(|ω| / ω₀) in the direction of ω, the component of the
    body's angular velocity parallel to the plane. This law does not describe the
    friction of a spinning coin, whose contact runs along the rim. Write your own force
    for it.

    **Arguments:**

    - `contacts`, `contact`: the contacts of the system, and the name of one of them.
    - `arm`: e [m], the distance of the normal force ahead of the contact. It is the
        coefficient of rolling resistance times the radius.
    - `smoothing`: ω₀ [rad/s].
    - `load`: as for `Sliding`.

    **Raises:** `ValueError` if there is no contact of this name, or no load.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> from nhjax import friction, rolling
        >>> group = nhjax.SO3()
        >>> contacts = rolling.Contacts(ball=rolling.Ellipsoid(
        ...     lambda t, q, args: (jnp.array([0.0, 0.0, 0.5]), group.matrix(q)), 0.5,
        ...     touches=False, manifold=group))
        >>> force = friction.RollingResistance(
        ...     contacts, "ball", 0.01, smoothing=0.1, load=50.0)
        >>> force(0.0, group.identity(), jnp.array([9.0, 0.0, 0.0]), jnp.zeros(2), None)
        Array([-0.5,  0. ,  0. ], dtype=float64)
    """

    contacts: Contacts = eqx.field(converter=checked_contacts)
    contact: str = eqx.field(static=True)
    arm: ArrayLike = eqx.field(converter=not_negative)
    smoothing: ArrayLike = eqx.field(converter=positive, kw_only=True)
    load: ArrayLike | ForceFunction | None = eqx.field(
        default=None, converter=checked_load, kw_only=True
    )

    def _rate(self, contact: AbstractContact, at: ContactState) -> Array:
        return _along_plane(at.angular_velocity, at)

    def _slope(self, at: ContactState, rate: Array) -> Array:
        return _coulomb_slope(self.arm, self.smoothing, rate @ rate)


class PivotingFriction(_AbstractOnContact):
    """Friction against spinning about the normal of the plane.

    The torque about the normal n is -|N| e tanh(ω · n / ω₀), with the body's angular
    velocity ω. For a circular contact area of radius a with uniform pressure,
    e = 2/3 μ a.

    **Arguments:** as for `RollingResistance`, but `arm` is the length e [m] in the
    formula above, and `smoothing` is ω₀ [rad/s] for the spin ω · n.

    **Raises:** as `RollingResistance`.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> from nhjax import friction, rolling
        >>> group = nhjax.SO3()
        >>> contacts = rolling.Contacts(top=rolling.Ellipsoid(
        ...     lambda t, q, args: (jnp.array([0.0, 0.0, 0.5]), group.matrix(q)), 0.5,
        ...     touches=False, manifold=group))
        >>> force = friction.PivotingFriction(
        ...     contacts, "top", 0.01, smoothing=0.1, load=50.0)
        >>> force(0.0, group.identity(), jnp.array([9.0, 0.0, 7.0]), jnp.zeros(2), None)
        Array([ 0. ,  0. , -0.5], dtype=float64)
    """

    contacts: Contacts = eqx.field(converter=checked_contacts)
    contact: str = eqx.field(static=True)
    arm: ArrayLike = eqx.field(converter=not_negative)
    smoothing: ArrayLike = eqx.field(converter=positive, kw_only=True)
    load: ArrayLike | ForceFunction | None = eqx.field(
        default=None, converter=checked_load, kw_only=True
    )

    def _rate(self, contact: AbstractContact, at: ContactState) -> Array:
        return (at.angular_velocity @ at.normal)[None]

    def _slope(self, at: ContactState, rate: Array) -> Array:
        return _coulomb_slope(self.arm, self.smoothing, rate @ rate)


class JointFriction(AbstractForceOfReactions):
    """Friction in a joint, proportional to the load of the joint.

    A joint that slides along x has the force -|N| μ(ẋ). A bearing of radius r has the
    torque -r |N| μ(r φ̇) on its angle φ.

    **Arguments:**

    - `coordinate`: x [m] or φ [rad], called as `coordinate(t, q, args)`, of shape ().
    - `law`: μ(u), such as `Coulomb(0.1, smoothing=0.001)`.
    - `load`: N [N], a number or a function of (t, q, v, multipliers, args).
    - `radius`: r [m]; 1 for a joint that slides.
    - `manifold`: the `manifold` of the system, required if it has one.

    **Raises:** `TypeError` if an argument has a wrong type; when called, `ShapeError`
    if the coordinate is not a scalar.

    !!! example

        >>> import jax.numpy as jnp
        >>> from nhjax import friction
        >>> law = friction.Coulomb(0.2, smoothing=0.01)
        >>> slider = friction.JointFriction(lambda t, q, args: q[0], law,
        ...     lambda t, q, v, multipliers, args: multipliers[0])
        >>> slider(0.0, jnp.zeros(2), jnp.ones(2), jnp.array([-5.0]), None)
        Array([-1.,  0.], dtype=float64)
    """

    coordinate: PositionFunction = eqx.field(converter=position_function)
    law: AbstractFrictionLaw
    load: ArrayLike | ForceFunction = eqx.field(converter=checked_load)
    radius: ArrayLike = eqx.field(default=1.0, converter=scalar, kw_only=True)
    manifold: AbstractLieGroup | None = eqx.field(default=None, kw_only=True)

    def __check_init__(self) -> None:
        _check_law(self.law)

    def check_system(self, system: Any) -> None:
        """Raise a `ValueError` unless the system has the manifold of this force."""
        _require_velocities(self, system)
        check_same_manifold("force", self, self.manifold, system.manifold)

    def __call__(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        v: Float[Array, " n"],
        multipliers: Float[Array, " l"],
        args: Args,
    ) -> Float[Array, " n"]:
        """Compute the generalised force."""

        def coordinate(t, q):
            return value_at("coordinate", self.coordinate, t, q, args)

        x, rate = value_and_rate(coordinate, self.manifold, t, q, v)
        if x.shape != ():
            raise ShapeError(f"`coordinate` must have shape (), got {x.shape}.")
        load = absolute_load(self.load, t, q, v, multipliers, args)
        (radius,) = in_precision_of(x, self.radius)
        force = -radius * load * self.law.coefficient(radius * rate)
        manifold = Euclidean(q.shape[0]) if self.manifold is None else self.manifold
        return manifold.left_gradient(lambda q: force * coordinate(t, q), q)


def _along_plane(vector: Array, at: ContactState) -> Array:
    return vector - (vector @ at.normal) * at.normal


def _sliding(contact: AbstractContact, at: ContactState) -> Array:
    """Return the part of the velocity along the plane that is not constrained."""
    velocity = _along_plane(at.velocity, at)
    for direction in contact.directions(at.rotation, at.normal):
        velocity = velocity - (velocity @ direction) * direction
    return velocity


# --- f(x) / x as a function of x², for odd functions f --------------------------------

# The series of these functions are used for x² below this number. With the terms listed
# here, the error is smaller than the unit round-off.
_SMALL = 0.01
_SIN = [(-1) ** k / math.factorial(2 * k + 1) for k in range(5)]
_ATAN = [(-1) ** k / (2 * k + 1) for k in range(9)]
_TANH = [1, -1 / 3, 2 / 15, -17 / 315, 62 / 2835, -1382 / 155925, 21844 / 6081075]


def _slope_of(
    function: Callable[[Array], Array], coefficients: list[float], square: Array
) -> Array:
    """Compute f(x) / x from x², with accurate derivatives at x = 0 too."""
    is_small = square < _SMALL
    near = jnp.where(is_small, square, 0)
    series = jnp.zeros_like(square)
    for coefficient in reversed(coefficients):
        series = coefficient + near * series
    x = jnp.sqrt(jnp.where(is_small, 1, square))
    return jnp.where(is_small, series, function(x) / x)


def _coulomb_slope(friction: ArrayLike, smoothing: ArrayLike, square: Array) -> Array:
    """Compute μ tanh(u / u₀) / u from u²."""
    friction, smoothing = in_precision_of(square, friction, smoothing)
    return friction / smoothing * _tanh_slope(square / smoothing**2)


def _tanh_slope(square: Array) -> Array:
    return _slope_of(jnp.tanh, _TANH, square)


def _atan_slope(square: Array) -> Array:
    return _slope_of(jnp.arctan, _ATAN, square)


def _sin_slope(square: Array) -> Array:
    return _slope_of(jnp.sin, _SIN, square)
