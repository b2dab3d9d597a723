"""Infinitesimal symmetries of a system, and the motion that goes along with them."""

import reprlib
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._custom_types import Args, BoolScalar, FloatScalar
from .._errors import Check, DependentConstraintsError, naming, ShapeError
from .._numerics import is_deficient, max_norm
from .._system import AbstractMechanicalSystem, State
from ._permitted import Permitted


# The function of a configuration that returns generators, of shape (n,) or (k, n).
Symmetry = Callable[[Any], Array]


def check_symmetry(symmetry: Any, y: State) -> None:
    """Raise unless `symmetry(q)` is a vector field, or several, at the state `y`."""
    if not callable(symmetry):
        raise TypeError(
            "`symmetry` must be a function of q that returns generators, got "
            f"{reprlib.repr(symmetry)} of type {type(symmetry).__name__}. For a "
            "symmetry of the body alone that is `lambda q: xi`."
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


def steps_along(orbit: Float[Array, "k x"], size: FloatScalar) -> Float[Array, " k"]:
    """Return steps along generators that suit central differences."""
    step = float(jnp.finfo(orbit.dtype).eps) ** (1 / 3) * size
    return step / jax.vmap(lambda way: jnp.maximum(max_norm(way), step))(orbit)


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
