"""The equations of motion and the constraints, linearised at one state.

A perturbation x = (ξ, w) leads from the state (q, u) to (q τ(ξ), u + w). This file has
the derivatives with respect to x in a frame that moves with the velocity or along
symmetries, bases of the perturbations that the constraints permit, and the checks that
given generators are symmetries of the system and of the motion.
"""

import operator
import reprlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._compile import as_cpu_kernel, tracked_jit
from .._custom_types import Args, BoolScalar, FloatScalar
from .._errors import Check, DependentConstraintsError, ShapeError
from .._numerics import is_deficient, jacobian_and_value, max_norm, unit
from .._system import AbstractMechanicalSystem, linearise, State


Indices = tuple[int, ...]
# The function of a configuration that returns generators, of shape (n,) or (k, n).
Symmetry = Callable[[Any], Array]


class Orbit(NamedTuple):
    """The directions in which generators move a state, and how they act around it.

    - `directions`: the generators, lifted to states.
    - `slopes`: their derivatives with respect to perturbations x = (ξ, w).
    - `motion`, `motion_slopes`: the same for the equations of motion.
    - `nearby`: the derivatives of the equations of motion and of the generators, in
        this order, at the state moved by + and - the `steps` along each generator.
    """

    directions: Float[Array, "k x"]
    slopes: Float[Array, "k x x"]
    motion: Float[Array, " x"]
    motion_slopes: Float[Array, "x x"]
    nearby: Float[Array, "m c x"]
    steps: Float[Array, " k"]

    @property
    def coefficients(self) -> Float[Array, " k"]:
        """Return the c with which the motion goes along Σ c_k (generator k)."""
        return jnp.linalg.solve(
            self.directions @ self.directions.T, self.directions @ self.motion
        )

    @property
    def rates(self) -> Float[Array, "x x"]:
        """Return the derivative of the motion relative to the moving frame."""
        frame = jnp.einsum("k,kxy->xy", self.coefficients, self.slopes)
        return self.motion_slopes - frame


class Slopes(NamedTuple):
    """The derivatives of the equations with respect to perturbations x = (ξ, w).

    - `rates`: those of the rates of x in the frame that moves along.
    - `velocity`: the rates (v, u̇) of the state itself.
    - `on_velocities`, `on_positions`: those of the constraints.
    - `orbit`: what is known of the symmetries along which the frame moves, if any are
        named. Otherwise it moves with the velocity v, as a left translation does.
    """

    rates: Float[Array, "x x"]
    velocity: Float[Array, " x"]
    on_velocities: Float[Array, "l x"]
    on_positions: Float[Array, "k n"]
    orbit: Orbit | None

    @property
    def rows(self) -> Float[Array, "r x"]:
        """Return the derivatives of all constraints."""
        dim = self.on_positions.shape[1]
        on_positions = jnp.pad(self.on_positions, ((0, 0), (0, dim)))
        return jnp.concatenate([self.on_velocities, on_positions])


def size_of(y: State) -> Array:
    """Return the size of the numbers in a state, in which its errors are measured."""
    return unit(max_norm(*jax.tree.leaves(y.q), y.v, y.p))


@tracked_jit("system", "args")
def slopes_along_velocity(system, t, y, args) -> Slopes:
    """Differentiate the equations in the frame that moves with the velocity."""
    dim, count = y.p.shape[0], y.multiplier.shape[0]

    def equations(x):
        rates = rates_of_change(system, t, y, args)(x)
        return jnp.concatenate([rates, _constraints(system, t, y, args, x)])

    slopes, value, _ = jacobian_and_value(
        lambda x: (as_cpu_kernel(equations, x), None), jnp.zeros(2 * dim, y.p.dtype)
    )
    velocity = jnp.concatenate([y.v, value[dim : 2 * dim]])
    rates, on_velocities, rest = jnp.split(slopes, [2 * dim, 2 * dim + count])
    return Slopes(rates, velocity, on_velocities, rest[:, :dim], None)


@tracked_jit("system", "args", "symmetry")
def slopes_along_symmetry(system, t, y, args, symmetry) -> Slopes:
    """Differentiate the equations and the generators of symmetries.

    Both are vector fields on states, in the chart x -> (q τ(ξ), u + w).
    """
    dim, count = y.p.shape[0], y.multiplier.shape[0]
    manifold = system.manifold_of(y.q)

    def fields(x):
        q, u = perturbed(system, y, x)
        xi, change = lifted(system, symmetry, t, q, u, args)
        velocity = system.velocity(t, q, u, args)
        in_chart = jax.vmap(lambda v: manifold.dtau_inv(x[:dim], v))(
            jnp.concatenate([velocity[None], xi])
        )
        rates = linearise(system, t, q, u, args).acceleration
        change = jnp.concatenate([rates[None], change])
        both = jnp.concatenate([in_chart, change], axis=1)
        constraints = _constraints(system, t, y, args, x)
        return jnp.concatenate([both.reshape(-1), constraints])

    def at(x):
        return jacobian_and_value(lambda x: (as_cpu_kernel(fields, x), None), x)[:2]

    zero = jnp.zeros(2 * dim, y.p.dtype)
    u = system.fibre_coordinate(y)
    ways = jnp.concatenate(lifted(system, symmetry, t, y.q, u, args), axis=1)
    steps = steps_along(ways, size_of(y))
    moved = jnp.stack([steps, -steps], axis=1)[:, :, None] * ways[:, None, :]
    places = jnp.concatenate([zero[None], moved.reshape(-1, 2 * dim)])
    # One program serves all places: most of the time goes into compiling it.
    samples, values = jax.lax.map(at, places)
    number = 2 * dim * (1 + len(ways))
    slopes = samples[0, :number].reshape(-1, 2 * dim, 2 * dim)
    found = values[0, :number].reshape(-1, 2 * dim)
    on_velocities, rest = jnp.split(samples[0, number:], [count])
    nearby = samples[1:, :number]
    orbit = Orbit(found[1:], slopes[1:], found[0], slopes[0], nearby, steps)
    return Slopes(orbit.rates, found[0], on_velocities, rest[:, :dim], orbit)


def _constraints(system, t, y, args, x):
    q, u = perturbed(system, y, x)
    on_positions = system.position_constraint(t, q, args)
    return jnp.concatenate([system.constraint(t, q, u, args), on_positions])


def perturbed(
    system: AbstractMechanicalSystem, y: State, x: Float[Array, " x"]
) -> tuple[PyTree[Array], Float[Array, " n"]]:
    """Perturb (q, u) of a state by x = (ξ, w), to (q τ(ξ), u + w)."""
    xi, w = jnp.split(x, 2)
    return system.manifold_of(y.q).act(y.q, xi), system.fibre_coordinate(y) + w


def rates_of_change(
    system: AbstractMechanicalSystem, t: FloatScalar, y: State, args: Args
) -> Callable[[Float[Array, " x"]], Float[Array, " x"]]:
    """Make the function x -> (v - v_0 - ad_v₀ ξ, u̇) of perturbations x = (ξ, w).

    Its derivative at zero is that of the equations of motion: in the frame of a body
    that moves with v_0, a perturbation of the configuration changes at the rate
    ξ̇ = δv - ad_v₀ ξ.
    """
    manifold = system.manifold_of(y.q)
    v0 = system.velocity(t, y.q, system.fibre_coordinate(y), args)

    def turning(xi):
        if manifold.is_flat:
            return jnp.zeros_like(xi)
        # ad_v is the transpose of ad*_v.
        _, transposed = jax.vjp(lambda mu: manifold.ad_dual(v0, mu), jnp.zeros_like(xi))
        return transposed(xi)[0]

    def rates(x):
        q, u = perturbed(system, y, x)
        xi = x[: x.shape[0] // 2]
        change = system.velocity(t, q, u, args) - v0 - turning(xi)
        return jnp.concatenate([change, linearise(system, t, q, u, args).acceleration])

    return rates


def lifted(
    system: AbstractMechanicalSystem,
    symmetry: Symmetry,
    t: FloatScalar,
    q: PyTree[Array],
    u: Float[Array, " n"],
    args: Args,
) -> tuple[Float[Array, "k n"], Float[Array, "k n"]]:
    """Compute the generators ξ at q, and the changes of u that they make.

    The flow of a vector field q ξ(q) carries velocities along by its derivative, and
    momenta by the inverse transpose of that,

    δv = Dξ v + ad_v ξ,    δp = ad*_ξ p - Dξᵀ p,

    with Dξ the derivative of χ -> ξ(q τ(χ)) at zero. A left translation changes
    neither, and a right one by a constant ξ changes v by [v, ξ].
    """
    manifold = system.manifold_of(q)

    def generators(chi):
        found = jnp.asarray(symmetry(manifold.act(q, chi)))
        return jnp.atleast_2d(found).astype(u.dtype)

    zero = jnp.zeros_like(u)
    if system.fibre_coordinate_name == "v":
        xi, along = jax.jvp(generators, (zero,), (u,))
        return xi, along + jax.vmap(lambda xi: manifold.ad(u, xi))(xi)
    xi, slopes = generators(zero), jax.jacfwd(generators)(zero)
    turned = jax.vmap(lambda xi: manifold.ad_dual(xi, u))(xi)
    return xi, turned - jnp.einsum("kij,i->kj", slopes, u)


def steps_along(orbit: Float[Array, "k x"], size: FloatScalar) -> Float[Array, " k"]:
    """Return steps along generators that suit central differences."""
    step = float(jnp.finfo(orbit.dtype).eps) ** (1 / 3) * size
    return step / jax.vmap(lambda way: jnp.maximum(max_norm(way), step))(orbit)


class Permitted(NamedTuple):
    """A basis Z of the perturbations that are permitted, and a W with W Z = 1.

    `determined` tells whether the constraints determine all others.
    """

    basis: Float[Array, "x d"]
    left: Float[Array, "d x"]
    determined: BoolScalar


def orthonormal_basis(rows: Array, orbit: Array) -> Permitted:
    """Compute an orthonormal basis of the kernel of `rows`, at right angles to `orbit`.

    What is picked from perturbations does not depend on how far they go along the
    vectors of `orbit`, which lie in the kernel themselves.

    The basis is defined up to a rotation, which no derivative of a singular value
    decomposition settles: the one that is found is held, and its derivative is that by
    which it stays in the kernel.
    """
    rows = jnp.concatenate([rows, orbit])
    count = rows.shape[0]
    _, _, right = jnp.linalg.svd(jax.lax.stop_gradient(rows), full_matrices=True)
    kernel = right[count:].T
    basis = kernel - _along(rows, kernel)
    beside = (kernel - _along(orbit, kernel)).T
    left = jnp.linalg.solve(beside @ basis, beside)
    return Permitted(basis, left, ~is_deficient(rows))


def _along(rows: Array, vectors: Array) -> Array:
    """Compute the parts of vectors, as columns, in the span of `rows`."""
    return rows.T @ jnp.linalg.solve(rows @ rows.T, rows @ vectors)


def independent_basis(
    on_velocities: Array,
    on_positions: Array,
    positions: tuple[int, ...],
    velocities: tuple[int, ...],
) -> Permitted:
    """Compute a basis of the permitted perturbations, one for each chosen coordinate.

    Each changes its own coordinate by one and no other chosen one; `left` takes the
    chosen coordinates from a perturbation.
    """
    dim, dtype = on_positions.shape[1], on_positions.dtype
    count, others = len(positions), len(velocities)
    unit = jnp.eye(dim, dtype=dtype)
    q_rows, u_rows = (
        unit[jnp.asarray(positions, int)],
        unit[jnp.asarray(velocities, int)],
    )
    # The smallest change of positions: those that no constraint ties stay as they are.
    wanted = jnp.concatenate(
        [jnp.eye(count, dtype=dtype), jnp.zeros((on_positions.shape[0], count), dtype)]
    )
    moved = jnp.concatenate([q_rows, on_positions])
    xi = moved.T @ jnp.linalg.solve(moved @ moved.T, wanted)
    xi = jnp.concatenate([xi, jnp.zeros((dim, others), dtype)], axis=1)
    kept = jnp.eye(count + others, dtype=dtype)[count:]
    right = jnp.concatenate([kept, -on_velocities[:, :dim] @ xi])
    following = jnp.concatenate([u_rows, on_velocities[:, dim:]])
    w = jnp.linalg.solve(following, right)
    zero = jnp.zeros_like
    left = jnp.block([[q_rows, zero(q_rows)], [zero(u_rows), u_rows]])
    regular = ~(is_deficient(moved) | is_deficient(following))
    return Permitted(jnp.concatenate([xi, w]), left, regular)


class Bounded(NamedTuple):
    """Numbers that must vanish, and the sizes up to which they count as zero."""

    value: Array
    allowed: Array

    @property
    def holds(self) -> BoolScalar:
        """Tell whether all numbers vanish; NaN does not."""
        return jnp.all(self.value <= self.allowed)


class Verdict(NamedTuple):
    """How well a motion and the generators of symmetries fit together.

    The arrays have a row for each generator, but `drift` has one entry for each
    component of the motion. Where the constraints are dependent, `determined` is false
    and the other fields mean nothing.
    """

    determined: BoolScalar
    independent: BoolScalar
    on_constraints: Bounded
    drift: Bounded
    bracket: Bounded
    closed: Bounded


def judged(
    orbit: Orbit,
    rows: Float[Array, "l x"],
    permitted: Permitted,
    scale: FloatScalar,
) -> Verdict:
    """Measure what must vanish if the motion goes along with symmetries.

    The bounds are for states that were computed or printed with some digits.

    **Arguments:**

    - `orbit`: the generators around the state.
    - `rows`: the derivatives of the constraints.
    - `permitted`: the perturbations beside the orbit.
    - `scale`: the size of the numbers in the state.
    """
    ways, slopes = orbit.directions, orbit.slopes
    basis, left = permitted.basis, permitted.left
    small = float(jnp.finfo(ways.dtype).eps) ** 0.25
    size = jnp.abs

    def bounded(value, terms):
        return Bounded(size(value), small * (1 + terms))

    rates = orbit.rates
    bends, bend_terms = _bracket_slopes(orbit)
    flat = (len(ways), -1)
    brackets = [
        slopes @ orbit.motion - ways @ orbit.motion_slopes.T,
        (bends @ basis).reshape(flat),
    ]
    terms = [
        size(slopes) @ size(orbit.motion) + size(ways) @ size(orbit.motion_slopes.T),
        (bend_terms @ size(basis)).reshape(flat),
    ]
    return Verdict(
        determined=~is_deficient(rows),
        independent=~is_deficient(ways),
        on_constraints=bounded(ways @ rows.T, size(ways) @ size(rows.T)),
        drift=bounded(
            orbit.motion - orbit.coefficients @ ways, jnp.sum(size(rates), 1) * scale
        ),
        bracket=bounded(*(jnp.concatenate(x, axis=1) for x in (brackets, terms))),
        closed=bounded(
            ways @ (left @ rates).T, size(ways) @ (size(left) @ size(rates)).T
        ),
    )


def _bracket_slopes(
    orbit: Orbit,
) -> tuple[Float[Array, "k x x"], Float[Array, "k x x"]]:
    """Differentiate the brackets of the motion with each generator.

    Second derivatives are central differences: they serve for a check alone, and
    another derivative of the equations would take three times as long to compile.

    **Returns:** the derivatives, and the sum of the sizes of their terms.
    """
    count, dim = orbit.directions.shape
    up, down = orbit.nearby.reshape(count, 2, -1, dim).swapaxes(0, 1)
    second = (up - down) / (2 * orbit.steps[:, None, None])
    of_motion, of_generators = second[:, :dim], second[:, dim:]
    along = jnp.einsum(
        "j,jkxy->kxy",
        orbit.coefficients,
        of_generators.reshape(count, count, dim, dim),
    )
    pulled = orbit.slopes @ orbit.motion_slopes
    pushed = orbit.motion_slopes @ orbit.slopes
    parts = jnp.stack([along, pulled, -of_motion, -pushed])
    return jnp.sum(parts, axis=0), jnp.sum(jnp.abs(parts), axis=0)


def check_symmetry(symmetry: Any, y: State) -> None:
    """Raise unless `symmetry(q)` is a vector field, or several, at the state `y`."""
    if not callable(symmetry):
        raise TypeError(
            "`symmetry` must be a function of q that returns generators, got "
            f"{reprlib.repr(symmetry)} of type {type(symmetry).__name__}. For a "
            "symmetry of the body alone that is `lambda q: xi`."
        )
    out, dim = eqx.filter_eval_shape(symmetry, y.q), y.p.shape[0]
    shape = getattr(out, "shape", None)
    fits = shape == (dim,) or (
        shape is not None and len(shape) == 2 and shape[1] == dim and shape[0] > 0
    )
    if not fits:
        got = f"shape {shape}" if shape is not None else f"type {type(out).__name__}"
        raise ShapeError(
            f"`symmetry(q)` must return shape ({dim},) or (k, {dim}), one component of "
            f"each generator for each velocity, got {got}."
        )


def indices(name: str, values: Sequence[int], dim: int) -> Indices:
    """Return the indices of coordinates as a tuple, or raise a `ValueError`."""
    try:
        found = tuple(operator.index(value) for value in values)
    except TypeError:
        raise TypeError(
            f"`{name}` must be a sequence of integers, got {values!r}."
        ) from None
    wrong = [i for i in found if not 0 <= i < dim]
    if wrong:
        raise ValueError(
            f"`{name}` has the index {wrong[0]}, but indices of {dim} coordinates go "
            f"from 0 to {dim - 1}."
        )
    if len(set(found)) < len(found):
        raise ValueError(f"`{name}` has an index twice: {found}.")
    return found


def checks_of(verdict: Verdict) -> list[Check]:
    """List the conditions for a motion to go along with symmetries, with errors."""
    measures = {
        _off_constraints: verdict.on_constraints,
        _not_along: verdict.drift,
        _no_symmetry: verdict.bracket,
        _not_closed: verdict.closed,
    }
    checks = [Check(x.holds, error, tuple(x)) for error, x in measures.items()]
    constraints = Check(verdict.determined, _dependent_constraints)
    return [constraints, Check(verdict.independent, _dependent), *checks]


def _worst(values: np.ndarray, allowed: np.ndarray) -> tuple[int, str]:
    ratio = np.nan_to_num(values / allowed, nan=np.inf)
    worst = np.unravel_index(np.argmax(ratio), ratio.shape)
    numbers = f"{float(values[worst]):.3g} (allowed {float(allowed[worst]):.1g})"
    return int(worst[0]), numbers


def _dependent_constraints() -> DependentConstraintsError:
    return DependentConstraintsError(
        "The constraints are dependent at `y`, so that nothing tells whether the "
        "generators of `symmetry` are any. Remove redundant constraints."
    )


def _dependent() -> ValueError:
    return ValueError(
        "The generators of `symmetry` are dependent at `y`: several combinations move "
        "the state alike, as a turn of an upright top in space and one on its axis do, "
        "and nothing says with which the frame moves. Leave generators out."
    )


_TRIVIALISED = (
    "On a group generators are left-trivialised like velocities; that of "
    "g -> exp(εξ) g is `manifold.Ad(manifold.inverse(q), xi)`."
)


def _off_constraints(values: np.ndarray, allowed: np.ndarray) -> ValueError:
    worst, numbers = _worst(values, allowed)
    return ValueError(
        f"Generator {worst} of `symmetry` is no symmetry of the constraints: it moves "
        f"`y` off them at the rate {numbers}. {_TRIVIALISED}"
    )


def _no_symmetry(values: np.ndarray, allowed: np.ndarray) -> ValueError:
    worst, numbers = _worst(values, allowed)
    return ValueError(
        f"Generator {worst} of `symmetry` is no symmetry of the system: along it the "
        "equations of motion, or their derivatives at `y`, change at the rate "
        f"{numbers}. {_TRIVIALISED}"
    )


def _not_along(values: np.ndarray, allowed: np.ndarray) -> ValueError:
    _, numbers = _worst(values, allowed)
    return ValueError(
        "The motion is not steady: no combination of the generators of `symmetry` "
        f"moves the state as it moves, {numbers} is left of a velocity or of its rate. "
        "Find a steady motion with `nhjax.steady_motion`, or add the generators that "
        "are missing."
    )


def _not_closed(values: np.ndarray, allowed: np.ndarray) -> ValueError:
    worst, numbers = _worst(values, allowed)
    return ValueError(
        "The generators of `symmetry` are not closed: in the frame of the motion "
        f"generator {worst} moves out of their span, at the rate {numbers}. Add the "
        "generators that are missing, as translations in all directions in which a "
        "rotation takes one."
    )
