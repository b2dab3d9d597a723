"""Rolling contacts: wheels, balls and blades on the ground, given by their poses.

A contact is given by the pose of a body: its position x(t, q) in space and its rotation
R(t, q). The point c that touches the ground follows from the shape of the body. The
height of c above the ground is the holonomic constraint. The nonholonomic constraints
are the tangential components (along the ground) of the velocity

    u = ẋ + Ṙ Rᵀ (c - x) - w

of the point c of the body relative to the ground, which moves with the velocity w. Each
multiplier is the force in newtons in the direction of its constraint. An optional
constraint prevents the body from spinning about the normal of the ground; its
multiplier is a torque in N m.
"""

import abc
import math
import operator
import reprlib
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from ._custom_types import (
    Args,
    FloatScalar,
    FloatScalarLike,
    ForceFunction,
    PositionFunction,
)
from ._errors import check_choice, naming, ShapeError
from ._integrate import Event
from ._manifold import AbstractLieGroup, cross_matrix
from ._numerics import inverse, max_norm, nan_unless, root
from ._system import (
    AbstractOfSystem,
    as_given,
    check_same_manifold,
    check_signature,
    check_type,
    parameter,
    State,
    static_function,
    value_and_rate,
)


def _vector(value: Any) -> Array:
    vector = jnp.asarray(value, float)
    if vector.shape != (3,):
        raise ShapeError(
            f"A vector in space must have shape (3,), got {reprlib.repr(value)}."
        )
    return vector


def _pose(value: Any) -> Any:
    check_signature("A contact", "pose", value, ("t", "q", "args"))
    return static_function(value)


Length: TypeAlias = ArrayLike | Callable[[Args], ArrayLike]


def _length(name: str) -> Callable[[Any], Any]:
    """Return a converter for a length: numbers, or a function of `args`."""

    def converted(value):
        if callable(value):
            check_signature("A contact", name, value, ("args",))
            return static_function(value)
        return parameter(value) if np.ndim(value) == 0 else jnp.asarray(value)

    return converted


def _length_in(
    args: Args, name: str, value: Any, dtype: Any, shapes: tuple[Any, ...] = ((),)
) -> Array:
    """Evaluate a length that may be a function of `args`, and check its shape."""
    if callable(value):
        with naming(f"{name}(args)", as_given(value), args):
            value = value(args)
    length = jnp.asarray(value)
    if length.shape not in shapes:
        expected = " or ".join(map(str, shapes))
        raise ShapeError(f"`{name}` must have shape {expected}, got {length.shape}.")
    return length.astype(dtype)


def _unit(vector: Array) -> Array:
    return vector * jax.lax.rsqrt(vector @ vector)


class Touch(NamedTuple):
    """The place where a body is nearest to the ground.

    - `point`: the point c of the body.
    - `normal`: the unit normal there, which points away from the ground.
    - `height`: the distance from the ground to the point, negative below the ground.
    """

    point: Float[Array, "3"]
    normal: Float[Array, "3"]
    height: FloatScalar


class AbstractGround(eqx.Module):
    """A ground that bodies roll on.

    To define one, write a subclass with a field `velocity`, as in `Plane`, and this
    method:

    - `touch(support, position, args)`: find where a convex body is nearest to the
        ground. `support(normal)` is the point of the body that is farthest in the
        direction -normal, and `position` is the origin of the body.
    """

    velocity: eqx.AbstractVar[Callable[[Any, Any, Any], Any] | None]

    @abc.abstractmethod
    def touch(
        self,
        support: Callable[[Float[Array, "3"]], Float[Array, "3"]],
        position: Float[Array, "3"],
        args: Args,
    ) -> Touch:
        """Find the point of a convex body that is nearest to the ground."""


def _velocity(function: Any) -> Any:
    if function is None:
        return None
    check_signature("A ground", "velocity", function, ("t", "x", "args"))
    return static_function(function)


class Plane(AbstractGround):
    """A plane that bodies roll on: all points x with n · x = h.

    **Arguments:**

    - `normal`: n, which points away from the ground; its length does not matter.
    - `height`: h [m], the distance of the plane from the origin along n.
    - `velocity`: w [m/s], the velocity of the ground at a point x in space, called as
        `velocity(t, x, args)`, for a turntable or a belt; by default the ground rests.

    !!! example

        >>> from nhjax import rolling
        >>> rolling.Plane(normal=(0.0, 3.0, 4.0)).unit_normal("float64")
        Array([0. , 0.6, 0.8], dtype=float64)
    """

    normal: Float[ArrayLike, "3"] = eqx.field(
        default=(0.0, 0.0, 1.0), converter=_vector
    )
    height: ArrayLike = eqx.field(default=0.0, converter=parameter, kw_only=True)
    velocity: Callable[[Any, Any, Any], Any] | None = eqx.field(
        default=None, converter=_velocity, kw_only=True
    )

    def unit_normal(self, dtype: Any) -> Float[Array, "3"]:
        """Return n / |n| with the given dtype."""
        return _unit(jnp.asarray(self.normal).astype(dtype))

    def touch(
        self,
        support: Callable[[Float[Array, "3"]], Float[Array, "3"]],
        position: Float[Array, "3"],
        args: Args,
    ) -> Touch:
        """Find the point of a body that is farthest in the direction -n."""
        normal = self.unit_normal(position.dtype)
        point = support(normal)
        height = jnp.asarray(self.height).astype(point.dtype)
        return Touch(point, normal, normal @ point - height)


class Surface(AbstractGround):
    """A curved ground, z = f(x, y).

    The body touches where its surface and the ground have opposite normals. This point
    is found by Newton's method in each evaluation, and differentiated by the implicit
    function theorem. Only one such point may exist near the body: in a hollow, the body
    must be more curved than the ground.

    **Arguments:**

    - `elevation`: f, called as `elevation(x, args)` with x of shape (2,) [m]; returns a
        scalar [m]. f must be smooth. `Heightfield` is such a function, which
        interpolates heights on a grid.
    - `velocity`: as for `Plane`.

    !!! example

        >>> import jax.numpy as jnp
        >>> from nhjax import rolling
        >>> bowl = rolling.Surface(lambda x, args: 0.5 * x @ x)
        >>> ball = rolling.Ellipsoid(lambda t, q, args: (q, jnp.eye(3)), 0.25,
        ...     ground=bowl)
        >>> float(ball.height(0.0, jnp.array([0.0, 0.0, 0.5])))
        0.25
    """

    elevation: Callable[[Any, Any], Any] = eqx.field(
        converter=lambda f: static_function(f)
    )
    velocity: Callable[[Any, Any, Any], Any] | None = eqx.field(
        default=None, converter=_velocity, kw_only=True
    )

    def __check_init__(self) -> None:
        function = as_given(self.elevation)
        check_signature("Surface", "elevation", function, ("x", "args"))

    def touch(
        self,
        support: Callable[[Float[Array, "3"]], Float[Array, "3"]],
        position: Float[Array, "3"],
        args: Args,
    ) -> Touch:
        """Find the point where the normals of body and ground are opposite."""

        def ground(x):
            with naming("elevation(x, args)", as_given(self.elevation), args):
                z, slope = jax.value_and_grad(lambda x: self.elevation(x, args))(x)
            return jnp.append(x, z), slope, _unit(jnp.append(-slope, jnp.ones_like(z)))

        def between(x):
            below, slope, normal = ground(x)
            apart = support(normal) - below
            # The vectors (1, 0, ∂f/∂x) and (0, 1, ∂f/∂y) are tangent to the ground.
            return apart[:2] + slope * apart[2]

        def solve(jacobian, b):
            return inverse(jacobian) @ b

        lowest = support(jnp.eye(3, dtype=position.dtype)[2])
        found = root(between, lowest[:2], max_norm(lowest), solve=solve)
        below, _, normal = ground(nan_unless(found.converged, found.x))
        point = support(normal)
        return Touch(point, normal, normal @ (point - below))


class Heightfield(eqx.Module):
    """The elevation of a `Surface` through given heights on a rectangular grid.

    The surface is a cubic spline, which has continuous curvature. Outside of the grid,
    the polynomials at its border are continued. The third derivatives jump at the lines
    of the grid: where a contact crosses a line, no method has an order above 3.

    **Arguments:**

    - `heights`: z [m], of shape (k, l) with k, l >= 4: the entry (i, j) is the height
        at x = x₀ + i d, y = y₀ + j d.
    - `spacing`: d [m].
    - `origin`: (x₀, y₀) [m].

    **Raises:** `ShapeError` if the heights do not have such a shape.

    !!! example

        >>> import numpy as np, jax.numpy as jnp
        >>> from nhjax import rolling
        >>> x = 0.5 * np.arange(8.0)
        >>> hill = rolling.Heightfield(np.sin(x)[:, None] + 0 * x, 0.5)
        >>> round(float(hill(jnp.array([1.5, 0.7]))), 6)
        0.997495
    """

    coefficients: Float[np.ndarray, "k l"]
    spacing: float = eqx.field(static=True)
    origin: tuple[float, float] = eqx.field(static=True)

    def __init__(
        self,
        heights: Any,
        spacing: float,
        origin: tuple[float, float] = (0.0, 0.0),
    ):
        given = np.asarray(heights, float)
        if given.ndim != 2 or min(given.shape) < 4:
            raise ShapeError(
                "`heights` must have the shape (k, l) with k, l >= 4, got "
                f"{given.shape}."
            )
        import scipy.ndimage

        # Mirroring at the border causes an error of the spline, which decreases by a
        # factor of 0.268 from row to row. With 32 extra rows, the error inside the grid
        # is below round-off. Two rows outside of the grid are kept, because the spline
        # needs them at the border.
        padded = np.pad(given, 32, mode="reflect", reflect_type="odd")
        spline = scipy.ndimage.spline_filter(padded, order=3, mode="mirror")
        self.coefficients = spline[30:-30, 30:-30]
        self.spacing = float(spacing)
        self.origin = (float(origin[0]), float(origin[1]))

    def __call__(self, x: Float[Array, "2"], args: Args = None) -> FloatScalar:
        """Compute the height at x."""
        place = (x - jnp.asarray(self.origin, x.dtype)) / self.spacing
        last = jnp.asarray(np.asarray(self.coefficients.shape) - 6, x.dtype)
        cell = jnp.clip(jnp.floor(jax.lax.stop_gradient(place)), 0 * last, last)
        weights = jax.vmap(_spline_weights)(place - cell)
        # The coefficient of row i of the grid has the index i + 2, and the four
        # coefficients of a cell begin one row before the cell.
        first = cell.astype(jnp.int32) + 1
        coefficients = jnp.asarray(self.coefficients, x.dtype)
        near = jax.lax.dynamic_slice(coefficients, first, (4, 4))
        return weights[0] @ near @ weights[1]


def _spline_weights(x: FloatScalar) -> Float[Array, "4"]:
    """Return the cubic B-splines with centres -1, 0, 1, 2 at x in [0, 1]."""
    y = 1 - x
    return jnp.stack([y**3, 4 - 6 * x**2 + 3 * x**3, 4 - 6 * y**2 + 3 * y**3, x**3]) / 6


class ContactState(NamedTuple):
    """The place of a contact and its velocities, as vectors in space.

    - `rotation`: the rotation of the body.
    - `point`: the point of the body that touches.
    - `normal`: the unit normal of the ground.
    - `travel`: the velocity of the origin of the body [m/s], relative to the ground.
    - `velocity`: the velocity u of the point of the body that touches [m/s], relative
        to the ground.
    - `angular_velocity`: the angular velocity of the body [rad/s], relative to the
        ground.
    """

    rotation: Float[Array, "3 3"]
    point: Float[Array, "3"]
    normal: Float[Array, "3"]
    travel: Float[Array, "3"]
    velocity: Float[Array, "3"]
    angular_velocity: Float[Array, "3"]


NoSlip: TypeAlias = tuple[Literal["along", "across", "spin"] | float, ...]


class AbstractContact(eqx.Module):
    """A convex body that touches the ground in one point.

    To define a shape, write a subclass with the fields of `Ellipsoid` except
    `semi_axes`, and two methods:

    - `offset(rotation, normal, args)`: the vector in space from the origin of the body
        to its point that is farthest in the direction -normal.
    - `axes(rotation, normal)`: `along` and `across`, two unit vectors along the ground
        that are perpendicular to each other, of shape (2, 3).
    """

    pose: eqx.AbstractVar[PositionFunction]
    no_slip: eqx.AbstractVar[NoSlip]
    touches: eqx.AbstractVar[bool]
    ground: eqx.AbstractVar[AbstractGround]
    manifold: eqx.AbstractVar[AbstractLieGroup | None]

    def __check_init__(self) -> None:
        check_type("ground", self.ground, AbstractGround)
        names = ("along", "across", "spin")
        if not isinstance(self.no_slip, tuple) or any(
            x not in names if isinstance(x, str) else not isinstance(x, int | float)
            for x in self.no_slip
        ):
            raise ValueError(
                '`no_slip` must be a tuple of "along", "across", "spin" and angles in '
                f"radians, got {self.no_slip!r}."
            )
        weights = [_direction(x) for x in self.no_slip]
        if np.linalg.matrix_rank(np.array(weights)) < len(weights):
            raise ValueError(
                "`no_slip` must name at most two directions that are not parallel, and "
                f'"spin" at most once, got {self.no_slip!r}. Leave out those that '
                "follow from the others."
            )

    @abc.abstractmethod
    def offset(
        self, rotation: Float[Array, "3 3"], normal: Float[Array, "3"], args: Args
    ) -> Float[Array, "3"]:
        """Compute the vector from the origin of the body to the contact, in space."""

    @abc.abstractmethod
    def axes(
        self, rotation: Float[Array, "3 3"], normal: Float[Array, "3"]
    ) -> Float[Array, "2 3"]:
        """Compute the directions `along` and `across`."""

    def place(
        self, t: FloatScalarLike, q: PyTree[Array], args: Args
    ) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
        """Evaluate the pose, and check its shapes."""
        with naming("pose(t, q, args)", as_given(self.pose), args):
            found = self.pose(t, q, args)
        if not isinstance(found, tuple) or len(found) != 2:
            raise ShapeError(
                "`pose` must return a position and a rotation, got "
                f"{type(found).__name__}."
            )
        position, rotation = map(jnp.asarray, found)
        if jnp.shape(position) != (3,) or jnp.shape(rotation) != (3, 3):
            raise ShapeError(
                "`pose` must return a position of shape (3,) and a rotation of shape "
                f"(3, 3), got {jnp.shape(position)} and {jnp.shape(rotation)}."
            )
        return position, rotation

    def touch(self, t: FloatScalarLike, q: PyTree[Array], args: Args = None) -> Touch:
        """Compute where the body is nearest to the ground."""
        position, rotation = self.place(t, q, args)
        return self._touch(position, rotation, args)

    def _touch(self, position: Array, rotation: Array, args: Args) -> Touch:
        def support(normal):
            return position + self.offset(rotation, normal, args)

        return self.ground.touch(support, position, args)

    def point(
        self, t: FloatScalarLike, q: PyTree[Array], args: Args = None
    ) -> Float[Array, "3"]:
        """Compute the point c of the body that touches the ground."""
        return self.touch(t, q, args).point

    def height(
        self, t: FloatScalarLike, q: PyTree[Array], args: Args = None
    ) -> Float[Array, ""]:
        """Compute the height of the point c above the ground."""
        return self.touch(t, q, args).height

    def frame(
        self, t: FloatScalarLike, q: PyTree[Array], args: Args = None
    ) -> Float[Array, "3 3"]:
        """Compute the contact's frame, with the rows `along`, `across` and normal."""
        position, rotation = self.place(t, q, args)
        normal = self._touch(position, rotation, args).normal
        return jnp.concatenate([self.axes(rotation, normal), normal[None]])

    def state(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        v: Float[Array, " n"],
        args: Args = None,
    ) -> ContactState:
        """Compute the place and the velocities of the contact."""
        (position, rotation), (velocity, turning) = value_and_rate(
            lambda t, q: self.place(t, q, args), self.manifold, t, q, v
        )
        point, normal, _ = self._touch(position, rotation, args)
        travel = velocity
        velocity = velocity + turning @ ((point - position) @ rotation)
        spin = turning @ rotation.T
        if self.ground.velocity is not None:
            ground = self.ground.velocity(t, point, args)
            travel, velocity = travel - ground, velocity - ground
            given = self.ground.velocity
            slopes = jax.jacfwd(lambda x: given(t, x, args))(point)
            spin = spin - 0.5 * (slopes - slopes.T)
        angular = jnp.stack([spin[2, 1], spin[0, 2], spin[1, 0]])
        return ContactState(rotation, point, normal, travel, velocity, angular)

    def slip(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        v: Float[Array, " n"],
        args: Args = None,
    ) -> Float[Array, " k"]:
        """Compute the velocity in the directions without slip, which must be zero.

        For `"spin"`, the entry is the angular velocity about the normal, relative to
        the ground.
        """
        at = self.state(t, q, v, args)
        axes = self.axes(at.rotation, at.normal)
        rates = self.weights(axes.dtype) @ (axes @ at.velocity)
        if "spin" not in self.no_slip:
            return rates
        spin = at.angular_velocity @ at.normal
        is_spin = jnp.asarray([x == "spin" for x in self.no_slip], rates.dtype)
        return rates + is_spin * spin

    def directions(
        self, rotation: Float[Array, "3 3"], normal: Float[Array, "3"]
    ) -> Float[Array, "k 3"]:
        """Compute the directions in which the body does not slip; zero for "spin"."""
        axes = self.axes(rotation, normal)
        return self.weights(axes.dtype) @ axes

    def weights(self, dtype: Any) -> Float[Array, "k 2"]:
        """Return the directions without slip, as components along and across."""
        weights = [_direction(x)[:2] for x in self.no_slip]
        return jnp.asarray(weights, dtype).reshape(-1, 2)

    @property
    def num_directions(self) -> int:
        """The number of directions along the ground in which the body does not slip."""
        return sum(x != "spin" for x in self.no_slip)


def _direction(name: str | float) -> tuple[float, float, float]:
    """Return the parts of a direction without slip: along, across and spin."""
    if isinstance(name, str):
        return float(name == "along"), float(name == "across"), float(name == "spin")
    return math.cos(name), math.sin(name), 0.0


class Wheel(AbstractContact):
    """A wheel: a disc with a thin rim, or a tyre in the shape of a torus.

    The direction `along` = axle x n, normalised, is the rolling direction, and `across`
    = n x `along`.

    The axle must not be perpendicular to the ground: the whole rim would then be at the
    same height. A track that runs over a sprocket can be modelled as a wheel that has
    the radius of the sprocket and touches the ground under the middle of the track.

    **Arguments:**

    - `pose`: called as `pose(t, q, args)`; returns the position of the hub [m], of
        shape (3,), and the rotation from the frame of the wheel to space, of shape
        (3, 3). The turn of the wheel about its axle is a part of the rotation.
    - `radius`: the distance from the axle to the thin rim, or to the middle of the tube
        [m]. It is a number, or a function of `args` that returns a number.
    - `tube_radius`: the radius of the tube of a torus [m], given like `radius`.
    - `axle`: the direction of the axle in the frame of the wheel.
    - `no_slip`: the directions in which the wheel does not slip: `"along"`, `"across"`,
        or an angle [rad] from `along` towards `across`; with `"spin"` the wheel does
        not turn about the normal of the ground either. An omni wheel has `("along",)`.
        A mecanum wheel has the angle of the axles of its rollers, π/4 or -π/4. A wheel
        that slides has `()`. If two wheels share an axle, only one of them needs
        `"across"`.
    - `touches`: whether the height of the contact is a constraint. Pass False if the
        coordinates fix the height, as the coordinates (x, y, heading) of a robot do.
    - `ground`: a `Plane` or a `Surface`; by default the plane z = 0.
    - `manifold`: the manifold of the system, if it has one.

    **Raises:** `ValueError` if `no_slip` has an unknown name, or linearly dependent
    directions; when called, `ShapeError` if the pose has other shapes.

    !!! example

        >>> import jax.numpy as jnp
        >>> from nhjax import rolling
        >>> def pose(t, q, args):  # upright, q = (x, turn)
        ...     (x, a), zero = q, 0.0 * q[0]
        ...     turn = [[jnp.cos(a), zero, jnp.sin(a)], [zero, zero + 1, zero],
        ...             [-jnp.sin(a), zero, jnp.cos(a)]]
        ...     return jnp.stack([x, zero, zero + 0.5]), jnp.asarray(turn)
        >>> wheel = rolling.Wheel(pose, 0.5, no_slip=("along",), touches=False)
        >>> wheel.slip(0.0, jnp.array([0.0, 0.3]), jnp.array([1.0, 3.0]))
        Array([-0.5], dtype=float64)
    """

    pose: PositionFunction = eqx.field(converter=_pose)
    radius: Length = eqx.field(converter=_length("radius"))
    tube_radius: Length = eqx.field(
        default=0.0, converter=_length("tube_radius"), kw_only=True
    )
    axle: Float[ArrayLike, "3"] = eqx.field(
        default=(0.0, 1.0, 0.0), converter=_vector, kw_only=True
    )
    no_slip: NoSlip = eqx.field(default=("along", "across"), static=True, kw_only=True)
    touches: bool = eqx.field(default=True, static=True, kw_only=True)
    ground: AbstractGround = eqx.field(default_factory=Plane, kw_only=True)
    manifold: AbstractLieGroup | None = eqx.field(default=None, kw_only=True)

    def offset(
        self, rotation: Float[Array, "3 3"], normal: Float[Array, "3"], args: Args
    ) -> Float[Array, "3"]:
        """Compute the vector from the hub to the lowest point."""
        axle = self._axle(rotation)
        radius = _length_in(args, "radius", self.radius, axle.dtype)
        tube = _length_in(args, "tube_radius", self.tube_radius, axle.dtype)
        # This formula has no cancellation for a disc that lies nearly flat.
        along, _ = self.axes(rotation, normal)
        down = cross_matrix(axle) @ along
        return radius * down - tube * normal

    def axes(
        self, rotation: Float[Array, "3 3"], normal: Float[Array, "3"]
    ) -> Float[Array, "2 3"]:
        """Compute the rolling direction, and the direction across it."""
        turn = cross_matrix(normal)
        along = _unit(self._axle(rotation) @ turn)
        return jnp.stack([along, turn @ along])

    def _axle(self, rotation: Array) -> Array:
        return rotation @ _unit(jnp.asarray(self.axle).astype(rotation.dtype))


class Ellipsoid(AbstractContact):
    """An ellipsoid or a ball that rolls, and can also spin about the normal.

    The directions `along` and `across` do not turn with the body; for a horizontal
    plane with the normal (0, 0, 1) they are x and y.

    **Arguments:**

    - `pose`: called as `pose(t, q, args)`; returns the position of the centre of the
        ellipsoid [m], of shape (3,), and the rotation to space, of shape (3, 3).
    - `semi_axes`: three lengths [m] along the axes of the body, or the radius of a
        ball; or a function of `args` that returns them.
    - `no_slip`: the directions in which the body does not slip; `()` if it slides. With
        `"spin"` the body does not turn about the normal of the ground either, like a
        rubber ball.
    - `touches`, `ground`, `manifold`: as for `Wheel`.

    **Raises:** when called, `ShapeError` if the pose has other shapes.

    !!! example

        >>> import jax.numpy as jnp
        >>> from nhjax import rolling
        >>> egg = rolling.Ellipsoid(lambda t, q, args: (q, jnp.eye(3)), [1.0, 2.0, 3.0])
        >>> egg.point(0.0, jnp.array([0.0, 0.0, 3.0]))
        Array([0., 0., 0.], dtype=float64)
    """

    pose: PositionFunction = eqx.field(converter=_pose)
    semi_axes: Length = eqx.field(converter=_length("semi_axes"))
    no_slip: NoSlip = eqx.field(default=("along", "across"), static=True, kw_only=True)
    touches: bool = eqx.field(default=True, static=True, kw_only=True)
    ground: AbstractGround = eqx.field(default_factory=Plane, kw_only=True)
    manifold: AbstractLieGroup | None = eqx.field(default=None, kw_only=True)

    def __check_init__(self) -> None:
        if not callable(self.semi_axes):
            self._axes_in(None, jnp.result_type(float))

    def _axes_in(self, args: Args, dtype: Any) -> Array:
        shapes = (3,), ()
        return _length_in(args, "semi_axes", self.semi_axes, dtype, shapes)

    def offset(
        self, rotation: Float[Array, "3 3"], normal: Float[Array, "3"], args: Args
    ) -> Float[Array, "3"]:
        """Compute the vector from the centre to the lowest point."""
        axes = self._axes_in(args, rotation.dtype)
        if axes.shape == ():
            return -axes * normal
        # The point of the ellipsoid that is farthest in the direction -n.
        scaled = axes * (rotation.T @ normal)
        return -rotation @ (axes * _unit(scaled))

    def axes(
        self, rotation: Float[Array, "3 3"], normal: Float[Array, "3"]
    ) -> Float[Array, "2 3"]:
        """Return two directions that do not depend on the body."""
        x, y, _ = jnp.eye(3, dtype=normal.dtype)
        first = _unit(jnp.cross(jnp.where(jnp.abs(normal[1]) < 0.9, y, x), normal))
        return jnp.stack([first, jnp.cross(normal, first)])


class Blade(AbstractContact):
    """A blade, a skate or a keel that does not move sideways.

    The direction `across` is the lateral direction of the blade, projected onto the
    ground, and `along` = `across` x n.

    **Arguments:**

    - `pose`: called as `pose(t, q, args)`; returns the position of the point that
        touches [m], of shape (3,), and the rotation of the blade, of shape (3, 3).
    - `lateral`: the direction in which the blade does not move, in the frame of the
        blade.
    - `no_slip`, `touches`, `ground`, `manifold`: as for `Wheel`.

    **Raises:** when called, `ShapeError` if the pose has other shapes.

    !!! example

        >>> import jax.numpy as jnp
        >>> from nhjax import rolling
        >>> blade = rolling.Blade(lambda t, q, args: (q, jnp.eye(3)), touches=False)
        >>> blade.slip(0.0, jnp.zeros(3), jnp.array([1.0, 2.0, 0.0]))
        Array([2.], dtype=float64)
    """

    pose: PositionFunction = eqx.field(converter=_pose)
    lateral: Float[ArrayLike, "3"] = eqx.field(
        default=(0.0, 1.0, 0.0), converter=_vector, kw_only=True
    )
    no_slip: NoSlip = eqx.field(default=("across",), static=True, kw_only=True)
    touches: bool = eqx.field(default=True, static=True, kw_only=True)
    ground: AbstractGround = eqx.field(default_factory=Plane, kw_only=True)
    manifold: AbstractLieGroup | None = eqx.field(default=None, kw_only=True)

    def offset(
        self, rotation: Float[Array, "3 3"], normal: Float[Array, "3"], args: Args
    ) -> Float[Array, "3"]:
        """Return zero: the position of the pose is the point that touches."""
        return jnp.zeros_like(normal)

    def axes(
        self, rotation: Float[Array, "3 3"], normal: Float[Array, "3"]
    ) -> Float[Array, "2 3"]:
        """Compute the direction of the blade and the lateral direction."""
        lateral = rotation @ jnp.asarray(self.lateral).astype(rotation.dtype)
        across = _unit(lateral - (lateral @ normal) * normal)
        return jnp.stack([jnp.cross(across, normal), across])


class Contacts(eqx.Module):
    """The contacts of a machine, as the constraints of a system.

    Pass its attributes `nonholonomic` and `holonomic` to `LagrangianSystem`; each is
    None if there are no such constraints. The multipliers of the directions without
    slip come first, then the multipliers of the heights, both in the order of the
    contacts. `multiplier_names` lists them.

    **Arguments:**

    - keywords: contacts by their names.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> from nhjax import rolling
        >>> group = nhjax.SE3()
        >>> pose = lambda t, q, args: (q[4:], nhjax.SO3().matrix(q[:4]))
        >>> ball = rolling.Ellipsoid(pose, 0.5, manifold=group)
        >>> contacts = rolling.Contacts(ball=ball)
        >>> system = nhjax.LagrangianSystem(
        ...     lambda t, q, v, args: 0.5 * v[:3] @ v[:3] + 0.05 * v[3:] @ v[3:]
        ...     - 9.81 * q[6], nonholonomic=contacts.nonholonomic,
        ...     holonomic=contacts.holonomic, manifold=group)
        >>> y = nhjax.initial_state(
        ...     system, group.identity().at[6].set(0.5), jnp.zeros(6))
        >>> contacts.forces(0.0, y)["ball"].round(6)
        Array([0.  , 0.  , 9.81], dtype=float64)
    """

    # The contacts are not stored in a dictionary, because JAX would sort its keys.
    names: tuple[str, ...] = eqx.field(static=True)
    contacts: tuple[AbstractContact, ...]
    _num_others: int = eqx.field(static=True)

    def __init__(self, **contacts: AbstractContact):
        for name, contact in contacts.items():
            check_type(name, contact, AbstractContact)
        self.names = tuple(contacts)
        self.contacts = tuple(contacts.values())
        self._num_others = 0

    def followed_by(self, num_others: int) -> "Contacts":
        """Return the same contacts, for a system with additional holonomic constraints.

        `num_others` is the number of additional constraints. They must come after the
        heights, so that their multipliers are the last ones. Pass the result to the
        forces of `nhjax.friction` in such a system.
        """
        found = Contacts(**dict(zip(self.names, self.contacts, strict=True)))
        object.__setattr__(found, "_num_others", num_others)
        return found

    @property
    def nonholonomic(self) -> "Slips | None":
        """The velocities of slip that must be zero, or None if all contacts slide."""
        rolling = tuple(x for x in self.contacts if x.no_slip)
        return Slips(rolling) if rolling else None

    @property
    def holonomic(self) -> "Heights | None":
        """The heights of the contacts that touch, or None if there are none."""
        touching = tuple(x for x in self.contacts if x.touches)
        return Heights(touching) if touching else None

    def points(
        self, t: FloatScalarLike, q: PyTree[Array], args: Args = None
    ) -> dict[str, Float[Array, "3"]]:
        """Compute the point of each contact in space [m]."""
        points = [x.point(t, q, args) for x in self.contacts]
        return dict(zip(self.names, points, strict=True))

    def forces(
        self,
        t: FloatScalarLike,
        y: State,
        args: Args = None,
        *,
        frame: Literal["space", "contact"] = "space",
    ) -> dict[str, Float[Array, "3"]]:
        """Compute the force of the ground on each body at its contact [N].

        The forces follow from the multipliers of the state. They are zero in directions
        that are not constrained, even if a law of `nhjax.friction` acts there. For a
        contact with `touches=False`, the normal force is not known and is returned as
        zero, because it has no multiplier.

        **Arguments:**

        - `t`, `y`, `args`: the time, the state and the arguments of the system. The
            system must have the constraints of these contacts, and no additional ones
            except those that `followed_by` describes.
        - `frame`: whether the force is a vector in space, or has the components along,
            across and normal in the frame of the contact.

        **Returns:** vectors of shape (3,), by the names of the contacts.

        **Raises:** `ShapeError` if the number of multipliers does not fit the contacts.
        """
        check_type("y", y, State)
        check_choice("`frame`", frame, ("space", "contact"))
        if frame == "space":
            return self.reactions(t, y.q, y.multiplier, args)
        return self._in_frames(y.multiplier)

    @property
    def multiplier_names(self) -> tuple[str, ...]:
        """The name of each multiplier, such as "wheel along" and "wheel normal"."""
        pairs = list(zip(self.names, self.contacts, strict=True))
        slips = [f"{name} {x}" for name, contact in pairs for x in contact.no_slip]
        return (*slips, *(f"{name} normal" for name, x in pairs if x.touches))

    def reactions(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        multipliers: Float[Array, " l"],
        args: Args = None,
    ) -> dict[str, Float[Array, "3"]]:
        """Compute the forces in space from multipliers, for a force law of your own."""
        parts = self._in_frames(multipliers)
        return {
            name: parts[name] @ contact.frame(t, q, args)
            for name, contact in zip(self.names, self.contacts, strict=True)
        }

    def _in_frames(self, multipliers: Array) -> dict[str, Array]:
        """Compute the components `along`, `across` and normal of each force."""
        self._check_multipliers(multipliers)
        counts = [len(x.no_slip) for x in self.contacts]
        parts = jnp.split(multipliers[: sum(counts)], np.cumsum(counts)[:-1])
        forces = {}
        for name, contact, part in zip(self.names, self.contacts, parts, strict=True):
            normal = jnp.zeros((), multipliers.dtype)
            if contact.touches:
                normal = self.load(name, multipliers)
            forces[name] = jnp.append(part @ contact.weights(part.dtype), normal)
        return forces

    def load(self, name: str, multipliers: Float[Array, " l"]) -> Float[Array, ""]:
        """Return the normal force on a contact that touches [N].

        **Arguments:**

        - `name`: the name of the contact.
        - `multipliers`: the multipliers of the system.

        **Raises:** `ValueError` if the contact has `touches=False`, so that its normal
        force is not a multiplier; `ShapeError` if the number of multipliers does not
        fit the contacts.
        """
        self.check_load(name, None)
        self._check_multipliers(multipliers)
        before = [x.touches for x in self.contacts[: self.names.index(name)]]
        count = sum(len(x.no_slip) for x in self.contacts)
        return multipliers[count + sum(before)]

    def check_load(self, name: str, load: Any) -> None:
        """Raise a `ValueError` unless a load is given or a multiplier represents it."""
        if not self[name].touches and load is None:
            raise ValueError(
                f"The normal force on {name!r} is not a multiplier, since its height "
                "is not a constraint: pass its load [N] as `load=`."
            )

    def check_constraints_of(self, system: Any) -> None:
        """Raise a `ValueError` unless a system has these constraints and no others.

        With these constraints, the multipliers are in the order of the contacts. With
        `followed_by`, the user combines the holonomic constraints in one function,
        which is not checked.
        """
        names = ("nonholonomic", "holonomic")
        for name in names[:1] if self._num_others else names:
            own, given = getattr(self, name), getattr(system, name)
            is_same = own is given is None or (
                type(own) is type(given)
                and len(own.contacts) == len(given.contacts)
                and all(map(operator.is_, own.contacts, given.contacts))
            )
            if not is_same:
                raise ValueError(
                    f"`force` needs the normal force of one of its contacts, but the "
                    f"system has other constraints: pass `{name}=contacts.{name}` to "
                    "the system, or the load [N] of the contact as `load=`. If the "
                    "system has more holonomic constraints than its contacts, put them "
                    "last and pass `contacts.followed_by(number)` to the law."
                )

    def __getitem__(self, name: str) -> AbstractContact:
        """Return the contact with this name."""
        if name not in self.names:
            raise ValueError(
                f"`contact` must be one of {', '.join(map(repr, self.names))}, got "
                f"{name!r}."
            )
        return self.contacts[self.names.index(name)]

    def _check_multipliers(self, multipliers: Array) -> None:
        count = sum(len(x.no_slip) + x.touches for x in self.contacts)
        if multipliers.shape != (count + self._num_others,):
            others = (
                f" and {self._num_others} others follow" if self._num_others else ""
            )
            raise ShapeError(
                f"The contacts have {count} multipliers{others}, got multipliers of "
                f"shape {multipliers.shape}. Pass a state of the system with the "
                "constraints of these contacts. If it has other holonomic constraints "
                "after theirs, use `contacts.followed_by(number)`."
            )


def _check_manifolds(
    name: str, contacts: tuple[AbstractContact, ...], system: Any
) -> None:
    for contact in contacts:
        check_same_manifold(name, contact, contact.manifold, system.manifold)


class Slips(AbstractOfSystem):
    """The nonholonomic constraints of contacts, which are their velocities of slip."""

    contacts: tuple[AbstractContact, ...]

    def check_system(self, system: Any) -> None:
        """Raise a `ValueError` unless all contacts have the manifold of the system."""
        _check_manifolds("nonholonomic", self.contacts, system)

    def __call__(
        self,
        t: FloatScalarLike,
        q: PyTree[Array],
        v: Float[Array, " n"],
        args: Args = None,
    ) -> Float[Array, " m"]:
        """Compute the velocities of all contacts in the directions without slip."""
        return jnp.concatenate([x.slip(t, q, v, args) for x in self.contacts])


class Heights(AbstractOfSystem):
    """The holonomic constraints of contacts: their heights above the ground."""

    contacts: tuple[AbstractContact, ...]

    def check_system(self, system: Any) -> None:
        """Raise a `ValueError` unless all contacts have the manifold of the system."""
        _check_manifolds("holonomic", self.contacts, system)

    def __call__(
        self, t: FloatScalarLike, q: PyTree[Array], args: Args = None
    ) -> Float[Array, " k"]:
        """Compute the heights of all contacts."""
        return jnp.stack([x.height(t, q, args) for x in self.contacts])


def checked_contacts(contacts: Any) -> Contacts:
    """Return the contacts, or raise a `TypeError` if they are not `Contacts`."""
    check_type("contacts", contacts, Contacts, "Make them with rolling.Contacts(...).")
    return contacts


def margin(
    contacts: Contacts,
    contact: str,
    friction: ArrayLike,
    *,
    load: ArrayLike | ForceFunction | None = None,
) -> Callable[[Any, State, Any], FloatScalar]:
    """Return a function that computes the friction reserve of a contact.

    It is the function (t, y, args) -> μ |N| - |F_t| [N], with the friction coefficient
    μ, the normal force N and the force F_t of the constraints along the ground. The
    contact rolls while the value is positive. Pass the function to `SaveAt(fn=)`. To
    stop a run when the value becomes zero, use `slips`.

    **Arguments:** as for `slips`, without `options`.

    **Raises:** as `slips`.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> from nhjax import rolling
        >>> blade = rolling.Blade(lambda t, q, args: (q, jnp.eye(3)), touches=False)
        >>> contacts = rolling.Contacts(blade=blade)
        >>> system = nhjax.LagrangianSystem(
        ...     lambda t, q, v, args: 0.5 * v @ v + 4.0 * q[1],
        ...     nonholonomic=contacts.nonholonomic)
        >>> y = nhjax.initial_state(system, jnp.zeros(3), jnp.zeros(3))
        >>> float(rolling.margin(contacts, "blade", 0.5, load=20.0)(0.0, y, None))
        6.0
    """
    touched = checked_contacts(contacts)[contact]
    if not touched.num_directions:
        raise ValueError(
            f"The contact {contact!r} has no directions `no_slip`, so that it slips."
        )
    contacts.check_load(contact, load)
    return _Margin(contacts, contact, _friction(friction), checked_load(load))


def _friction(value: Any) -> Array:
    if eqx.is_array_like(value) and jnp.shape(value) == ():
        return parameter(value)
    raise TypeError(
        f"`friction` must be a number, the friction coefficient, got "
        f"{reprlib.repr(value)}."
    )


def slips(
    contacts: Contacts,
    contact: str,
    friction: ArrayLike,
    *,
    load: ArrayLike | ForceFunction | None = None,
    **options: Any,
) -> Event:
    """Return the event that a contact starts to slip.

    The event occurs when the `margin` falls to zero. Like every event, it needs a
    change of sign. It does not occur if the `margin` is negative from the start:
    therefore check the `margin` of the first state.

    **Arguments:**

    - `contacts`, `contact`: the contacts of the system, and the name of one of them.
    - `friction`: μ.
    - `load`: N, as for `nhjax.friction.Sliding`: a number [N] or a function of
        (t, q, v, multipliers, args). The default is the multiplier of the height.
    - `options`: passed on to `nhjax.Event`; by default the event ends the run.

    **Raises:** `TypeError` if `friction` is not a number; `ValueError` if there is no
    contact of this name, no load, or no direction without slip.

    !!! example

        >>> import jax.numpy as jnp
        >>> from nhjax import rolling
        >>> blade = rolling.Blade(lambda t, q, args: (q, jnp.eye(3)), touches=False)
        >>> contacts = rolling.Contacts(blade=blade)
        >>> rolling.slips(contacts, "blade", 0.5, load=20.0).direction
        False
    """
    function = margin(contacts, contact, friction, load=load)
    return Event(function, **{"direction": False, **options})


def lifts_off(contacts: Contacts, contact: str, **options: Any) -> Event:
    """Return the event that the normal force N [N] of a contact falls to zero.

    At this time the body would lift off a ground that does not hold it down.

    **Arguments:**

    - `contacts`, `contact`: the contacts of the system, and the name of one of them.
    - `options`: passed on to `nhjax.Event`; by default the event ends the run.

    **Raises:** `ValueError` if there is no contact of this name, or its height is not a
    constraint.

    !!! example

        >>> import jax.numpy as jnp
        >>> from nhjax import rolling
        >>> blade = rolling.Blade(lambda t, q, args: (q, jnp.eye(3)))
        >>> rolling.lifts_off(rolling.Contacts(blade=blade), "blade").terminate
        True
    """
    function = _NormalForce(checked_contacts(contacts), contact)
    return Event(function, **{"direction": False, **options})


def checked_load(load: Any) -> Any:
    """Convert the load of a contact: a number, a function or None."""
    if callable(load):
        arguments = ("t", "q", "v", "multipliers", "args")
        check_signature("A contact", "load", load, arguments)
        return static_function(load)
    return None if load is None else parameter(load)


def load_on(
    contacts: Contacts,
    contact: str,
    load: Any,
    t: Any,
    q: Any,
    v: Array,
    multipliers: Array,
    args: Any,
) -> FloatScalar:
    """Compute the load |N| on a contact [N]."""
    if load is None:
        return jnp.abs(contacts.load(contact, multipliers))
    return absolute_load(load, t, q, v, multipliers, args)


def absolute_load(
    load: Any, t: Any, q: Any, v: Array, multipliers: Array, args: Any
) -> FloatScalar:
    """Compute the load |N| [N] from a number or from a function that the user gives."""
    if callable(load):
        with naming("load(t, q, v, multipliers, args)", as_given(load), args):
            load = load(t, q, v, multipliers, args)
    load = jnp.asarray(load)
    if load.shape != ():
        raise ShapeError(f"`load` must be one number, got shape {load.shape}.")
    return jnp.abs(load.astype(v.dtype))


class _Margin(eqx.Module):
    contacts: Contacts
    contact: str = eqx.field(static=True)
    friction: Array
    load: Any

    def __call__(self, t: Any, y: State, args: Any) -> FloatScalar:
        given = t, y.q, y.v, y.multiplier, args
        load = load_on(self.contacts, self.contact, self.load, *given)
        force = self.contacts.forces(t, y, args, frame="contact")[self.contact]
        square = force[:2] @ force[:2]
        size = jnp.sqrt(jnp.where(square > 0, square, 1))
        friction = self.friction.astype(force.dtype)
        return friction * load - jnp.where(square > 0, size, 0)


class _NormalForce(eqx.Module):
    contacts: Contacts
    contact: str = eqx.field(static=True)

    def __check_init__(self) -> None:
        self.contacts.check_load(self.contact, None)

    def __call__(self, t: Any, y: State, args: Any) -> FloatScalar:
        return self.contacts.load(self.contact, y.multiplier)
