"""The equations of motion and the constraints, linearised at one state.

A perturbation x = (ξ, w) changes the state (q, u), where u is v or p, to
(q τ(ξ), u + w). This file differentiates the equations with respect to x, in a frame
that moves with the velocity of the state or along symmetries. It also computes bases of
the perturbations that the constraints permit. It checks that given generators are
symmetries of the system, and that the motion is an orbit of these symmetries.
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
from .._errors import Check, DependentConstraintsError, naming, ShapeError
from .._numerics import is_deficient, jacobian_and_value, max_norm, nonzero_or_one
from .._system import AbstractMechanicalSystem, linearise, State, with_kept_functions


Indices = tuple[int, ...]
# A function of the configuration that returns generators, of shape (n,) or (k, n).
Symmetry = Callable[[Any], Array]


class Orbit(NamedTuple):
    """The generators of symmetries and the equations of motion near a state.

    - `directions`: the generators at the state, each as a perturbation x = (ξ, w).
    - `jacobians`: their derivatives with respect to x.
    - `motion`, `motion_jacobian`: the vector field of the equations of motion at the
        state, and its derivative.
    - `nearby`: the derivatives of the equations of motion and of the generators, in
        this order, at the state displaced by ± `steps` along each generator.
    """

    directions: Float[Array, "k x"]
    jacobians: Float[Array, "k x x"]
    motion: Float[Array, " x"]
    motion_jacobian: Float[Array, "x x"]
    nearby: Float[Array, "m c x"]
    steps: Float[Array, " k"]

    @property
    def coefficients(self) -> Float[Array, " k"]:
        """Return the c for which Σ c_k (generator k) is closest to the motion."""
        return jnp.linalg.solve(
            self.directions @ self.directions.T, self.directions @ self.motion
        )

    @property
    def rates(self) -> Float[Array, "x x"]:
        """Return the derivative of motion - Σ c_k (generator k) for fixed c_k."""
        frame = jnp.einsum("k,kxy->xy", self.coefficients, self.jacobians)
        return self.motion_jacobian - frame


class LinearisedEquations(NamedTuple):
    """The derivatives of the equations with respect to perturbations x = (ξ, w).

    - `rates`: the derivatives of the rates of x in the moving frame.
    - `velocity`: the rates (v, u̇) of the state itself.
    - `constraint_jacobian`: the derivatives of the velocity constraints, including the
        rates of the holonomic constraints.
    - `position_jacobian`: the derivatives of the holonomic constraints.
    - `orbit`: the symmetries along which the frame moves. If it is None, the frame
        moves with the velocity v, by left translation.
    """

    rates: Float[Array, "x x"]
    velocity: Float[Array, " x"]
    constraint_jacobian: Float[Array, "l x"]
    position_jacobian: Float[Array, "k n"]
    orbit: Orbit | None

    @property
    def all_constraints(self) -> Float[Array, "r x"]:
        """Return the derivatives of all constraints."""
        dim = self.position_jacobian.shape[1]
        position_jacobian = jnp.pad(self.position_jacobian, ((0, 0), (0, dim)))
        return jnp.concatenate([self.constraint_jacobian, position_jacobian])


def state_size(y: State) -> Array:
    """Return a scale for errors: the largest absolute value in a state, or 1 if 0."""
    return nonzero_or_one(max_norm(*jax.tree.leaves(y.q), y.v, y.p))


@tracked_jit("system", "args")
def linearise_along_velocity(system, t, y, args) -> LinearisedEquations:
    """Differentiate the equations in a frame that moves with the velocity."""
    dim, count = y.p.shape[0], y.multiplier.shape[0]
    system = with_kept_functions(system, t, y.q, system.fibre_coordinate(y), args)

    def equations(x):
        rates = rates_of_change(system, t, y, args)(x)
        return jnp.concatenate([rates, _constraints(system, t, y, args, x)])

    jacobians, value, _ = jacobian_and_value(
        lambda x: (as_cpu_kernel(equations, x), None), jnp.zeros(2 * dim, y.p.dtype)
    )
    velocity = jnp.concatenate([y.v, value[dim : 2 * dim]])
    rates, constraint_jacobian, rest = jnp.split(jacobians, [2 * dim, 2 * dim + count])
    return LinearisedEquations(
        rates, velocity, constraint_jacobian, rest[:, :dim], None
    )


@tracked_jit("system", "args", "symmetry")
def linearise_along_symmetry(system, t, y, args, symmetry) -> LinearisedEquations:
    """Differentiate the equations and the generators of symmetries.

    Both are vector fields on states. Their components are taken in the chart
    x = (ξ, w) -> (q τ(ξ), u + w).
    """
    dim, count = y.p.shape[0], y.multiplier.shape[0]
    manifold = system.manifold_of(y.q)
    system = with_kept_functions(system, t, y.q, system.fibre_coordinate(y), args)

    def fields(x):
        q, u = perturb(system, y, x)
        xi, change = lift_generators(system, symmetry, t, q, u, args)
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
    directions = jnp.concatenate(
        lift_generators(system, symmetry, t, y.q, u, args), axis=1
    )
    steps = difference_steps(directions, state_size(y))
    moved = jnp.stack([steps, -steps], axis=1)[:, :, None] * directions[:, None, :]
    points = jnp.concatenate([zero[None], moved.reshape(-1, 2 * dim)])
    # `map` compiles the function once for all points, which saves time, because
    # compilation takes most of the time.
    samples, values = jax.lax.map(at, points)
    number = 2 * dim * (1 + len(directions))
    jacobians = samples[0, :number].reshape(-1, 2 * dim, 2 * dim)
    found = values[0, :number].reshape(-1, 2 * dim)
    constraint_jacobian, rest = jnp.split(samples[0, number:], [count])
    nearby = samples[1:, :number]
    orbit = Orbit(found[1:], jacobians[1:], found[0], jacobians[0], nearby, steps)
    return LinearisedEquations(
        orbit.rates, found[0], constraint_jacobian, rest[:, :dim], orbit
    )


def _constraints(system, t, y, args, x):
    q, u = perturb(system, y, x)
    positions = system.position_constraint(t, q, args)
    return jnp.concatenate([system.constraint(t, q, u, args), positions])


def perturb(
    system: AbstractMechanicalSystem, y: State, x: Float[Array, " x"]
) -> tuple[PyTree[Array], Float[Array, " n"]]:
    """Return (q τ(ξ), u + w), the state perturbed by x = (ξ, w)."""
    xi, w = jnp.split(x, 2)
    return system.manifold_of(y.q).act(y.q, xi), system.fibre_coordinate(y) + w


def rates_of_change(
    system: AbstractMechanicalSystem, t: FloatScalar, y: State, args: Args
) -> Callable[[Float[Array, " x"]], Float[Array, " x"]]:
    """Return the function x -> (v - v_0 - ad_v₀ ξ, u̇) of perturbations x = (ξ, w).

    v and u̇ belong to the perturbed state, and v_0 is the velocity of `y`. The
    derivative at zero gives the linearised equations of motion: in the frame of a body
    that moves with v_0, a perturbation of the configuration changes at the rate
    ξ̇ = δv - ad_v₀ ξ.
    """
    manifold = system.manifold_of(y.q)
    v0 = system.velocity(t, y.q, system.fibre_coordinate(y), args)

    def ad_v0(xi):
        if manifold.is_flat:
            return jnp.zeros_like(xi)
        # ad_v is the transpose of ad*_v.
        _, transposed = jax.vjp(lambda mu: manifold.ad_dual(v0, mu), jnp.zeros_like(xi))
        return transposed(xi)[0]

    def rates(x):
        q, u = perturb(system, y, x)
        xi = x[: x.shape[0] // 2]
        change = system.velocity(t, q, u, args) - v0 - ad_v0(xi)
        return jnp.concatenate([change, linearise(system, t, q, u, args).acceleration])

    return rates


def lift_generators(
    system: AbstractMechanicalSystem,
    symmetry: Symmetry,
    t: FloatScalar,
    q: PyTree[Array],
    u: Float[Array, " n"],
    args: Args,
) -> tuple[Float[Array, "k n"], Float[Array, "k n"]]:
    """Compute generators ξ at q, and the rates δu of u (v or p) under their flows.

    The flow of a vector field q ξ(q) transports velocities by its derivative, and
    momenta by the inverse transpose of this derivative,

    δv = Dξ v + ad_v ξ,    δp = ad*_ξ p - Dξᵀ p,

    where Dξ is the derivative of χ -> ξ(q τ(χ)) at zero. A left translation changes
    neither velocities nor momenta. A right translation, with constant ξ, changes v at
    the rate [v, ξ].
    """
    manifold = system.manifold_of(q)

    def generators(chi):
        found = jnp.asarray(symmetry(manifold.act(q, chi)))
        return jnp.atleast_2d(found).astype(u.dtype)

    zero = jnp.zeros_like(u)
    if system.fibre_coordinate_name == "v":
        xi, along = jax.jvp(generators, (zero,), (u,))
        return xi, along + jax.vmap(lambda xi: manifold.ad(u, xi))(xi)
    xi, jacobians = generators(zero), jax.jacfwd(generators)(zero)
    turned = jax.vmap(lambda xi: manifold.ad_dual(xi, u))(xi)
    return xi, turned - jnp.einsum("kij,i->kj", jacobians, u)


def difference_steps(
    orbit: Float[Array, "k x"], size: FloatScalar
) -> Float[Array, " k"]:
    """Return steps along generators for central differences."""
    step = float(jnp.finfo(orbit.dtype).eps) ** (1 / 3) * size
    return step / jax.vmap(lambda way: jnp.maximum(max_norm(way), step))(orbit)


class PermittedPerturbations(NamedTuple):
    """A basis Z of the permitted perturbations, and a left inverse W with W Z = 1.

    `determined` is true if the equations that define the basis are independent.
    """

    basis: Float[Array, "x d"]
    left: Float[Array, "d x"]
    determined: BoolScalar


def orthonormal_basis(rows: Array, orbit: Array) -> PermittedPerturbations:
    """Compute an orthonormal basis of the kernel of `rows`, orthogonal to `orbit`.

    The vectors of `orbit` lie in the kernel themselves. The left inverse ignores the
    components of a perturbation along `orbit`.

    The basis is unique only up to a rotation, and the derivative of a singular value
    decomposition does not exist for equal singular values. Therefore the computed basis
    is treated as constant, and derivatives come only from a correction that keeps the
    basis in the kernel.
    """
    rows = jnp.concatenate([rows, orbit])
    count = rows.shape[0]
    _, _, right = jnp.linalg.svd(jax.lax.stop_gradient(rows), full_matrices=True)
    kernel = right[count:].T
    basis = kernel - _project_onto(rows, kernel)
    beside = (kernel - _project_onto(orbit, kernel)).T
    left = jnp.linalg.solve(beside @ basis, beside)
    return PermittedPerturbations(basis, left, ~is_deficient(rows))


def _project_onto(rows: Array, vectors: Array) -> Array:
    """Project vectors, given as columns, onto the span of `rows`."""
    return rows.T @ jnp.linalg.solve(rows @ rows.T, rows @ vectors)


def independent_basis(
    constraint_jacobian: Array,
    position_jacobian: Array,
    positions: tuple[int, ...],
    velocities: tuple[int, ...],
) -> PermittedPerturbations:
    """Compute the basis of the permitted perturbations for chosen coordinates.

    Each basis vector changes one chosen coordinate by one, and no other chosen
    coordinate. The left inverse extracts the chosen coordinates of a perturbation.
    """
    dim, dtype = position_jacobian.shape[1], position_jacobian.dtype
    count, others = len(positions), len(velocities)
    unit = jnp.eye(dim, dtype=dtype)
    q_rows, u_rows = (
        unit[jnp.asarray(positions, int)],
        unit[jnp.asarray(velocities, int)],
    )
    # These changes have the least norm, so that positions that are neither chosen nor
    # constrained do not change.
    wanted = jnp.concatenate(
        [
            jnp.eye(count, dtype=dtype),
            jnp.zeros((position_jacobian.shape[0], count), dtype),
        ]
    )
    moved = jnp.concatenate([q_rows, position_jacobian])
    xi = moved.T @ jnp.linalg.solve(moved @ moved.T, wanted)
    xi = jnp.concatenate([xi, jnp.zeros((dim, others), dtype)], axis=1)
    kept = jnp.eye(count + others, dtype=dtype)[count:]
    right = jnp.concatenate([kept, -constraint_jacobian[:, :dim] @ xi])
    following = jnp.concatenate([u_rows, constraint_jacobian[:, dim:]])
    w = jnp.linalg.solve(following, right)
    zero = jnp.zeros_like
    left = jnp.block([[q_rows, zero(q_rows)], [zero(u_rows), u_rows]])
    regular = ~(is_deficient(moved) | is_deficient(following))
    return PermittedPerturbations(jnp.concatenate([xi, w]), left, regular)


class BoundedResidual(NamedTuple):
    """Values that must vanish, and the bounds up to which they count as zero."""

    value: Array
    allowed: Array

    @property
    def holds(self) -> BoolScalar:
        """Return whether all values are within their bounds; NaN counts as outside."""
        return jnp.all(self.value <= self.allowed)


class SymmetryConditions(NamedTuple):
    """The conditions for a motion to be an orbit of symmetries of the system.

    - `determined`: whether the constraints are independent. Otherwise the other fields
        are not defined.
    - `independent`: whether the generators are independent.
    - `on_constraints`: the rates at which generators violate the constraints.
    - `drift`: the rates of the state minus the closest combination of generators, one
      entry for each component.
    - `bracket`: the Lie brackets of the equations of motion with each generator, and
      their derivatives.
    - `closed`: the rates at which generators leave their span in the moving frame.

    Except for `drift`, the arrays have one row for each generator.
    """

    determined: BoolScalar
    independent: BoolScalar
    on_constraints: BoundedResidual
    drift: BoundedResidual
    bracket: BoundedResidual
    closed: BoundedResidual


def check_relative_equilibrium(
    orbit: Orbit,
    rows: Float[Array, "l x"],
    permitted: PermittedPerturbations,
    scale: FloatScalar,
) -> SymmetryConditions:
    """Compute the residuals that vanish if the motion is an orbit of symmetries.

    The bounds allow for states that are accurate to only a few digits.

    **Arguments:**

    - `orbit`: the generators and the equations of motion near the state.
    - `rows`: the derivatives of the constraints.
    - `permitted`: the permitted perturbations that are not along the orbit.
    - `scale`: the largest absolute value in the state.
    """
    directions, jacobians = orbit.directions, orbit.jacobians
    basis, left = permitted.basis, permitted.left
    small = float(jnp.finfo(directions.dtype).eps) ** 0.25
    size = jnp.abs

    def bounded(value, terms):
        return BoundedResidual(size(value), small * (1 + terms))

    rates = orbit.rates
    bends, bend_terms = _bracket_derivatives(orbit)
    flat = (len(directions), -1)
    brackets = [
        jacobians @ orbit.motion - directions @ orbit.motion_jacobian.T,
        (bends @ basis).reshape(flat),
    ]
    terms = [
        size(jacobians) @ size(orbit.motion)
        + size(directions) @ size(orbit.motion_jacobian.T),
        (bend_terms @ size(basis)).reshape(flat),
    ]
    return SymmetryConditions(
        determined=~is_deficient(rows),
        independent=~is_deficient(directions),
        on_constraints=bounded(directions @ rows.T, size(directions) @ size(rows.T)),
        drift=bounded(
            orbit.motion - orbit.coefficients @ directions,
            jnp.sum(size(rates), 1) * scale,
        ),
        bracket=bounded(*(jnp.concatenate(x, axis=1) for x in (brackets, terms))),
        closed=bounded(
            directions @ (left @ rates).T,
            size(directions) @ (size(left) @ size(rates)).T,
        ),
    )


def _bracket_derivatives(
    orbit: Orbit,
) -> tuple[Float[Array, "k x x"], Float[Array, "k x x"]]:
    """Differentiate the Lie brackets of the equations of motion with each generator.

    Second derivatives are central differences, which are accurate enough for a check.
    Automatic second derivatives would make the compile time three times as long.

    **Returns:** the derivatives, and the sums of the absolute values of their terms.
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
    pulled = orbit.jacobians @ orbit.motion_jacobian
    pushed = orbit.motion_jacobian @ orbit.jacobians
    parts = jnp.stack([along, pulled, -of_motion, -pushed])
    return jnp.sum(parts, axis=0), jnp.sum(jnp.abs(parts), axis=0)


def check_symmetry(symmetry: Any, y: State) -> None:
    """Raise if `symmetry(q)` does not return one or several generators at `y`."""
    if not callable(symmetry):
        raise TypeError(
            "`symmetry` must be a function of q that returns generators, got "
            f"{reprlib.repr(symmetry)} of type {type(symmetry).__name__}. For a "
            "symmetry of the body, pass `lambda q: xi`."
        )
    dim = y.p.shape[0]
    with naming("symmetry(q)", symmetry):
        out = eqx.filter_eval_shape(symmetry, y.q)
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
    """Return the indices of coordinates as a tuple; raise if they are not valid."""
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


def symmetry_checks(verdict: SymmetryConditions) -> list[Check]:
    """Return the conditions as checks, each with its error."""
    measures = {
        _off_constraints: verdict.on_constraints,
        _not_steady: verdict.drift,
        _not_a_symmetry: verdict.bracket,
        _not_closed: verdict.closed,
    }
    checks = [Check(x.holds, error, tuple(x)) for error, x in measures.items()]
    constraints = Check(verdict.determined, _dependent_constraints)
    return [constraints, Check(verdict.independent, _dependent_generators), *checks]


def _worst(values: np.ndarray, allowed: np.ndarray) -> tuple[int, str]:
    ratio = np.nan_to_num(values / allowed, nan=np.inf)
    worst = np.unravel_index(np.argmax(ratio), ratio.shape)
    numbers = f"{float(values[worst]):.3g} (allowed {float(allowed[worst]):.1g})"
    return int(worst[0]), numbers


def _dependent_constraints() -> DependentConstraintsError:
    return DependentConstraintsError(
        "The constraints are dependent at `y`, so that the generators of `symmetry` "
        "cannot be checked. Remove redundant constraints."
    )


def _dependent_generators() -> ValueError:
    return ValueError(
        "The generators of `symmetry` are dependent at `y`: several combinations move "
        "the state in the same way, like rotations of an upright top about the "
        "vertical and about its axis, so that the moving frame is not determined. "
        "Omit generators."
    )


_TRIVIALISED = (
    "On a group, generators are left-trivialised like velocities; the generator of "
    "g -> exp(εξ) g is `manifold.Ad(manifold.inverse(q), xi)`."
)


def _off_constraints(values: np.ndarray, allowed: np.ndarray) -> ValueError:
    worst, numbers = _worst(values, allowed)
    return ValueError(
        f"Generator {worst} of `symmetry` is not a symmetry of the constraints: it "
        f"violates them at the rate {numbers}. {_TRIVIALISED}"
    )


def _not_a_symmetry(values: np.ndarray, allowed: np.ndarray) -> ValueError:
    worst, numbers = _worst(values, allowed)
    return ValueError(
        f"Generator {worst} of `symmetry` is not a symmetry of the system: along it, "
        "the equations of motion or their derivatives at `y` change at the rate "
        f"{numbers}. {_TRIVIALISED}"
    )


def _not_steady(values: np.ndarray, allowed: np.ndarray) -> ValueError:
    _, numbers = _worst(values, allowed)
    return ValueError(
        "The motion is not steady: no combination of the generators of `symmetry` "
        f"equals the motion; the largest difference is {numbers}. Find a steady motion "
        "with `nhjax.steady_motion`, or add the missing generators."
    )


def _not_closed(values: np.ndarray, allowed: np.ndarray) -> ValueError:
    worst, numbers = _worst(values, allowed)
    return ValueError(
        "The generators of `symmetry` are not closed: in the moving frame, "
        f"generator {worst} leaves their span at the rate {numbers}. Add the missing "
        "generators, such as translations in all directions into which a rotation "
        "turns a translation."
    )
