"""Systems in both forms and as the oracle describes them, and solved steps."""

from collections.abc import Callable
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import nhjax
from nhjax._step import first_step_state, ImplicitStep, StepArguments
from nhjax._step._equations import StageUnknowns
from nhjax._system import State
from support import group_mechanics as by_hand
from support.group_mechanics import MatrixGroup


FORMS = ("lagrangian", "hamiltonian")
RETRACTIONS = {"cayley": nhjax.Cayley(), "exponential": nhjax.Exponential()}


def both_forms(
    inertia: Callable,
    potential: Callable,
    *,
    inverse: Callable = jnp.linalg.inv,
    shift: Callable | None = None,
    nonholonomic: Callable | None = None,
    holonomic: Callable | None = None,
    force: Callable | None = None,
    manifold=None,
) -> dict[str, nhjax.LagrangianSystem | nhjax.HamiltonianSystem]:
    """L = ½ v·M v + A·v - U with M, A, U of (t, q), and its Legendre transform.

    The constraint and the force are given as functions of (t, q, v, args) for either
    form; `inverse` inverts M.
    """

    def momentum_at_rest(t, q):
        return 0.0 if shift is None else shift(t, q)

    def lagrangian(t, q, v, args):
        linear = jnp.sum(momentum_at_rest(t, q) * v)
        return 0.5 * v @ inertia(t, q) @ v + linear - potential(t, q)

    def velocity(t, q, p):
        return inverse(inertia(t, q)) @ (p - momentum_at_rest(t, q))

    def hamiltonian(t, q, p, args):
        moving = p - momentum_at_rest(t, q)
        return 0.5 * moving @ velocity(t, q, p) + potential(t, q)

    def on_momenta(function):
        if function is None:
            return None
        return lambda t, q, p, args: function(t, q, velocity(t, q, p), args)

    shared = {"holonomic": holonomic, "manifold": manifold}
    return {
        "lagrangian": nhjax.LagrangianSystem(
            lagrangian, nonholonomic=nonholonomic, force=force, **shared
        ),
        "hamiltonian": nhjax.HamiltonianSystem(
            hamiltonian,
            nonholonomic=on_momenta(nonholonomic),
            force=on_momenta(force),
            **shared,
        ),
    }


def inverse_of_three(matrix: Array) -> Array:
    """The inverse of a 3 x 3 matrix, cheap to differentiate and to compile."""
    a, b, c = matrix.T
    rows = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)])
    return rows / (a @ rows[0])


class Problem(NamedTuple):
    """A system in both forms, its copy for the oracle, and a consistent state."""

    mechanics: by_hand.Mechanics
    forms: dict[str, nhjax.LagrangianSystem | nhjax.HamiltonianSystem]
    y0: State

    def element(self, q) -> np.ndarray:
        """The element of a configuration, as the oracle represents it."""
        if self.mechanics.group is None:
            return np.asarray(q)
        return np.asarray(self.forms["lagrangian"].manifold_of(q).matrix(q))


def _problem(
    mechanics: by_hand.Mechanics,
    manifold,
    q0,
    v0,
    *,
    inertia,
    potential,
    shift=None,
    phi=None,
    gamma=None,
) -> Problem:
    """Create a problem from functions of v and g (a matrix, or on R^n a vector).

    A constant inertia may be given as an array; v0 is made consistent.
    """

    def element(q):
        return q if mechanics.group is None else manifold.matrix(q)

    constant = isinstance(inertia, np.ndarray)
    forms = both_forms(
        lambda t, q: jnp.asarray(inertia) if constant else inertia(element(q)),
        lambda t, q: potential(element(q)),
        inverse=(lambda M: np.linalg.inv(inertia)) if constant else inverse_of_three,
        shift=None if shift is None else lambda t, q: shift(element(q)),
        nonholonomic=(
            None if phi is None else lambda t, q, v, args: phi(element(q), v)
        ),
        holonomic=None if gamma is None else lambda t, q, args: gamma(element(q)),
        manifold=manifold,
    )
    q0 = jax.tree.map(jnp.asarray, q0)
    g, v = np.asarray(element(q0)), np.array(v0)
    for _ in range(6):
        rows = np.concatenate([mechanics.d2phi(g, v), mechanics.d_holonomic(g)])
        off = np.append(mechanics.phi(g, v), mechanics.d_holonomic(g) @ v)
        v = v - np.linalg.pinv(rows) @ off
    _, *multipliers = mechanics.acceleration(g, v)
    fibre = [v, mechanics.d2l(g, v), np.concatenate(multipliers)]
    return Problem(mechanics, forms, State(q0, *map(jnp.asarray, fibre)))


E3 = np.array([0.0, 0.0, 1.0])
TURN = np.array([0.3, -0.5, 0.8])
QUATERNION = np.append(
    np.cos(np.linalg.norm(TURN) / 2),
    np.sin(np.linalg.norm(TURN) / 2) / np.linalg.norm(TURN) * TURN,
)
ROTATION = np.asarray(nhjax.SO3().matrix(jnp.asarray(QUATERNION)))
INERTIA = np.array([[1.0, 0.1, 0.15], [0.1, 1.5, 0.25], [0.15, 0.25, 1.1]])
TORQUE = np.array([[-0.5, -0.8, -0.1], [0.2, 0.2, -0.3], [0.1, 0.2, 0.7]])
# A positive definite inertia that couples all six velocities of a body on SE(3).
BODY = 1.5 * np.eye(6) + 0.2 * np.cos(np.add.outer(np.arange(6), np.arange(6)))


def _unicycle(retraction):
    M, spring = np.diag([1.3, 1.3, 0.7]), 1.7
    return _problem(
        by_hand.Unicycle(
            MatrixGroup(by_hand.SE2, retraction),
            M,
            np.array([[0.0, 1, 0]]),
            spring,
        ),
        nhjax.SE2(RETRACTIONS[retraction]),
        np.array([1.0, 0.3, 0.4]),
        [0.5, 0.0, 0.8],
        inertia=M,
        potential=lambda g: 0.5 * spring * jnp.sum(g[:2, 2] ** 2),
        phi=lambda g, v: v[1],
    )


def _rigid(retraction, rows, C, phi=None):
    return _problem(
        by_hand.RigidBody(MatrixGroup(by_hand.SO3, retraction), INERTIA, rows, C),
        nhjax.SO3(RETRACTIONS[retraction]),
        QUATERNION,
        [0.7, -0.4, 1.3],
        inertia=INERTIA,
        potential=lambda g: jnp.sum(C * g),
        phi=phi,
    )


def _suslov(retraction):
    return _rigid(retraction, E3[None], TORQUE, lambda g, v: v[2])


def _heavy_top(retraction):
    return _rigid(retraction, np.zeros((0, 3)), 2.0 * np.outer(E3, [0.1, 0.2, 0.9]))


def _anisotropic(retraction):
    S = np.diag([0.3, 0.1, 0.5]) + 0.05
    B = np.array([[1, 0.2, 0], [0.2, -0.6, 0.1], [0, 0.1, 0.8]])
    b, F = np.array([0.3, 0.1, 0.5]), 0.2 * np.arange(9.0).reshape(3, 3) / 9
    level = 0.9
    group = MatrixGroup(by_hand.SO3, retraction)
    return _problem(
        by_hand.Anisotropic(group, INERTIA, S, TORQUE, B, b, F, level),
        nhjax.SO3(RETRACTIONS[retraction]),
        QUATERNION,
        [0.7, -0.4, 0.5],
        inertia=lambda g: INERTIA + g.T @ S @ g,
        potential=lambda g: jnp.sum(TORQUE * g),
        phi=lambda g, v: 0.5 * v @ B @ v + b @ g @ v + jnp.sum(F * g) - level,
    )


def _ball(retraction):
    r, Omega = 0.8, 0.9
    moments = r**2 * np.array([[0.5, 0.05, 0], [0.05, 0.7, 0.02], [0, 0.02, 0.4]])
    M = np.eye(5)
    M[:3, :3] = moments

    def rolling(g, v):
        w, (x, y) = g[:3, :3] @ v[:3], g[3:5, 5]
        return jnp.stack([v[3] + Omega * y - r * w[1], v[4] - Omega * x + r * w[0]])

    return _problem(
        by_hand.Ball(MatrixGroup(by_hand.SO3_R2, retraction), moments, r, Omega),
        nhjax.ProductGroup(nhjax.SO3(RETRACTIONS[retraction]), nhjax.Euclidean(2)),
        (QUATERNION, np.array([0.5, -0.2])),
        [0.5, 0.2, 0.4, 0.3, 0.6],
        inertia=M,
        potential=lambda g: jnp.zeros(()),
        phi=rolling,
    )


def _top_on_se3(retraction, rows, phi=None):
    X, weight = np.array([0.2, -0.1, 0.7]), 1.2
    omega = np.array([0.6, -0.5, 0.9])
    return _problem(
        by_hand.HeavyTop(MatrixGroup(by_hand.SE3, retraction), BODY, rows, weight, X),
        nhjax.SE3(RETRACTIONS[retraction]),
        np.concatenate([QUATERNION, ROTATION @ X]),
        [*np.cross(omega, X), *omega],
        inertia=BODY,
        potential=lambda g: weight * g[2, 3],
        phi=phi,
        gamma=lambda g: g[:3, 3] - g[:3, :3] @ X,
    )


def _holonomic_top(retraction):
    return _top_on_se3(retraction, np.zeros((0, 6)))


def _suslov_top(retraction):
    row = np.array([0, 0, 0, 0.2, 0.1, 1.0])
    return _top_on_se3(retraction, row[None], lambda g, v: row @ v)


def varying_inertia(q: Array) -> Array:
    """The mass matrix of the oracle's `VaryingMass`."""
    x, y, z = q
    off, zero = jnp.asarray(0.2), jnp.asarray(0.0)
    rows = [1 + y**2, 0.3 * x, zero], [0.3 * x, 2 + jnp.sin(z), off]
    rows = [*rows, [zero, off, 1 + 0.5 * jnp.cos(x)]]
    return jnp.stack([jnp.stack(row) for row in rows])


def _varying_mass(retraction):
    beta, kappa = 0.4, 0.3
    return _problem(
        by_hand.VaryingMass(None, beta, kappa),
        None,
        np.array([0.5, 0.3, -0.2]),
        [0.6, 0.8, 0.0],
        inertia=varying_inertia,
        potential=lambda q: 0.5 * q @ q + 0.25 * q[0] ** 4,
        shift=lambda q: beta * q[0] * jnp.asarray([0.0, 1.0, 0.0]),
        phi=lambda q, v: v[2] - q[1] * v[0] + kappa * jnp.sin(q[0]) * v[1],
    )


def _on_sphere(K, w, B, q0, v0, phi=None):
    mass = 1.2
    return _problem(
        by_hand.Sphere(None, mass, K, w, B),
        None,
        np.array(q0),
        v0,
        inertia=mass * np.eye(len(w)),
        potential=lambda q: 0.5 * q @ K @ q + w @ q,
        phi=phi,
        gamma=lambda q: 0.5 * (q @ q - 1),
    )


def _sphere(retraction):
    K, none = np.diag([0.3, 0, 0.6]), np.zeros((0, 3, 3))
    return _on_sphere(K, 1.5 * E3, none, [0.6, 0, -0.8], [0.4, 0.5, 0.3])


def _rolling_sphere(retraction):
    B = np.array([[0, 1, 0.3, 0], [-0.4, 0, 0, 0.2], [0, 0, 0.1, 1], [0, 0.5, -1, 0]])
    return _on_sphere(
        np.diag([0.3, 0, 0.6, 0.2]),
        np.array([0.3, 0.1, -0.4, 0.9]),
        B[None],
        [0.5, 0.5, -0.5, 0.5],
        [0.4, 0.5, 0.3, -0.2],
        lambda q, v: v @ B @ q,
    )


BUILDERS: dict[str, Callable[[str], Problem]] = {
    "unicycle": _unicycle,
    "Suslov": _suslov,
    "anisotropic": _anisotropic,
    "ball": _ball,
    "heavy top": _heavy_top,
    "holonomic top": _holonomic_top,
    "Suslov top": _suslov_top,
    "varying mass": _varying_mass,
    "sphere": _sphere,
    "nonholonomic sphere": _rolling_sphere,
}
ON_SE3 = ("holonomic top", "Suslov top")
ON_VECTOR_SPACES = ("varying mass", "sphere", "nonholonomic sphere")
WITHOUT_CLOSURE = ("heavy top", "holonomic top", "sphere")


@cache
def problem(name: str, retraction: str = "cayley") -> Problem:
    """A problem by name; on vector spaces the retraction does not matter."""
    return BUILDERS[name](retraction)


class SolvedStep(NamedTuple):
    """One step: its ends, the unknowns, and the forces and multipliers of stages."""

    start: State
    end: State
    stages: StageUnknowns
    force: Array
    multiplier: Array


def solved_steps(
    system, method, solver, y0: State, h: float, num_steps: int = 3
) -> list[SolvedStep]:
    """Consecutive steps from a state at t = 0, as NumPy arrays."""
    never = jnp.asarray(False)
    step = ImplicitStep(method=method, stage_solver=solver, skip=never)

    def advance(step_state, t):
        arguments = StepArguments(system, t, jnp.asarray(h), step_state, None)
        outcome = step.solve(arguments)
        x, record = outcome.stages, outcome.record
        taken = SolvedStep(
            step_state.state,
            outcome.step_state.state,
            x,
            record.force,
            record.multiplier,
        )
        return outcome.step_state, (taken, outcome.result == nhjax.RESULTS.successful)

    # Compiling without optimisation takes half the time.
    @partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
    def run(y0):
        step_state = first_step_state(system, method, jnp.zeros(()), y0, None)
        return jax.lax.scan(advance, step_state, h * jnp.arange(float(num_steps)))[1]

    steps, converged = run(y0)
    assert np.all(converged)
    return [
        jax.tree.map(lambda x, k=k: np.asarray(x[k]), steps) for k in range(num_steps)
    ]
