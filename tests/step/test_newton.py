"""Newton's method: its linear equations, and how fast it converges."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import nhjax
from nhjax import systems
from nhjax._numerics import solve_by_rows, uneven_perturbations
from nhjax._step import first_step_state
from nhjax._step._equations import stage_residuals
from nhjax._step._invariants import Invariants
from nhjax._step._jacobian import NewtonFactors
from nhjax._step._solvers import _solved
from nhjax._step._step import equations_of_step, starting_values, StepArguments
from support.forms import in_rotation, in_space
from support.helpers import twice_constrained_pendulum
from support.long import exhaustive_but


LOBATTO = nhjax.LobattoIIIAB


def equations_near_start(system, y0, method, h, invariants=None, args=None):
    """Return the equations of a step and unknowns away from their solution."""
    t = jnp.zeros(())
    start = first_step_state(system, method, t, y0, args)
    given = StepArguments(system, t, h, start, args, invariants)
    stages = equations_of_step(given, method)
    x = starting_values(stages, system.fibre_coordinate(y0), start.lin)
    z, unravel = ravel_pytree(x)
    z = z + 1e-2 * (uneven_perturbations(z) + jnp.sin(jnp.arange(len(z))))
    return stages, unravel(z), start.lin


def dense_and_by_blocks(system, y0, method, h, invariants=None):
    """Return the changes of x by a dense solve and by blocks."""

    @jax.jit
    def both(h):
        stages, x, lin = equations_near_start(system, y0, method, h, invariants)
        z, unravel = ravel_pytree(x)
        r, push = jax.linearize(lambda x: stage_residuals(stages, x)[0], x)
        dx = NewtonFactors.at(stages, x, lin, push).solve(stages, push, r)

        def residual(z):
            return ravel_pytree(stage_residuals(stages, unravel(z))[0])[0]

        return jax.jacfwd(residual)(z), residual(z), ravel_pytree(dx)[0]

    jacobian, r, found = map(np.asarray, both(jnp.asarray(h)))
    return np.linalg.solve(jacobian, r), found, np.linalg.cond(jacobian)


def energy_at_start(system, y0):
    """Return the energy as an invariant that a step keeps."""
    energy = system.energy(jnp.zeros(()), y0, None)
    zero = jnp.zeros(())
    return Invariants(None, energy[None], jnp.zeros(1), zero)


def of_example(example):
    return example.system, example.initial_state()


def of_start(start, form):
    return start.forms[form], start.y0


CASES = {
    "flat": (of_example(systems.NonholonomicParticle()), LOBATTO(3)),
    "linkage": (of_example(systems.FourBar()), LOBATTO(3)),
    "group": (of_example(systems.Suslov()), LOBATTO(3)),
    "group, chart at start": (
        of_example(systems.Suslov()),
        LOBATTO(2, "propagated", chart="start"),
    ),
    "both constraints on group": (of_example(systems.BallInBowl()), LOBATTO(2)),
    "consistent": (of_example(systems.RodSleigh()), LOBATTO(3, "consistent")),
    "collocation": (of_example(systems.HeavyTop()), nhjax.Gauss(2)),
    "hamiltonian": (of_start(in_space("none", True), "hamiltonian"), LOBATTO(3)),
    "hamiltonian, holonomic": (
        of_start(in_space("holonomic", True), "hamiltonian"),
        LOBATTO(2),
    ),
    "hamiltonian, nonholonomic": (
        of_start(in_space("nonholonomic", True), "hamiltonian"),
        LOBATTO(3),
    ),
    "hamiltonian on group": (
        of_start(in_rotation("nonholonomic", True), "hamiltonian"),
        LOBATTO(3),
    ),
}


SHORT = ("flat", "linkage", "hamiltonian, nonholonomic")


def assert_equal_to_dense(system, y0, method, invariants=None):
    given = system, y0, method, 0.05, invariants
    expected, found, condition = dense_and_by_blocks(*given)
    size = np.abs(expected).max()
    assert condition < 1e7
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-15 * condition * size)


@pytest.mark.parametrize("case", exhaustive_but(SHORT, CASES))
def test_newton_update_by_blocks_equals_dense_solve(case):
    (system, y0), method = CASES[case]
    assert_equal_to_dense(system, y0, method)


def test_newton_update_with_redundant_constraints_equals_dense_solve():
    assert_equal_to_dense(*twice_constrained_pendulum(), LOBATTO(3))


@pytest.mark.parametrize("case", exhaustive_but(["flat"], ["flat", "group"]))
def test_newton_update_with_kept_energy_equals_dense_solve(case):
    (system, y0), method = CASES[case]
    assert_equal_to_dense(system, y0, method, energy_at_start(system, y0))


@pytest.mark.parametrize(
    "case", exhaustive_but(["flat"], ["flat", "group", "hamiltonian"])
)
def test_newton_update_converges_quadratically(case):
    (system, y0), method = CASES[case]

    @jax.jit
    def update(z, h):
        stages, x, lin = equations_near_start(system, y0, method, h)
        _, unravel = ravel_pytree(x)
        x = unravel(z)
        r, push = jax.linearize(lambda x: stage_residuals(stages, x)[0], x)
        dx = NewtonFactors.at(stages, x, lin, push).solve(stages, push, r)
        return z - ravel_pytree(dx)[0]

    h = jnp.asarray(0.2)
    z = ravel_pytree(equations_near_start(system, y0, method, h)[1])[0]
    iterates = [z := update(z, h) for _ in range(7)]
    errors = [np.abs(np.asarray(z - iterates[-1])).max() for z in iterates]
    large = [error for error in errors if error > 1e-12]
    for before, after in pairwise(large):
        assert after < 20 * before**2
    assert errors[-2] < 1e-12


def amplified(rate):
    """A particle whose force pushes it along its velocity."""
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v, force=lambda t, q, v, args: rate * v
    )
    return system, nhjax.initial_state(system, jnp.zeros(2), jnp.array([1.0, -0.5]))


def test_newton_step_with_singular_diagonal_block_is_solved():
    # The block 1 - h â_11 c of the first stage vanishes, but 1 - h c Â does not.
    h, method = 0.1, LOBATTO(3)
    rate = 1 / (h * method.a_hat[0, 0])
    system, y0 = amplified(rate)
    options = {"dt": h, "num_steps": 1, "stage_solver": nhjax.Newton()}
    sol = nhjax.integrate(system, method, y0, **options)
    matrix = np.eye(3) - h * rate * method.a_hat
    growth = 1 + h * rate * method.b @ np.linalg.solve(matrix, np.ones(3))
    np.testing.assert_allclose(sol.ys.v[-1], growth * np.asarray(y0.v), rtol=1e-14)


def test_newton_equations_are_solved_by_rows_only_if_a_block_is_singular(monkeypatch):
    # With h = 0.1 a diagonal block is singular.
    method, counted = LOBATTO(3), []
    system, y0 = amplified(1 / (0.1 * method.a_hat[0, 0]))

    def by_rows(matrix, rights):
        jax.debug.callback(lambda: counted.append(1))
        return solve_by_rows(matrix, rights)

    monkeypatch.setattr("nhjax._step._solvers.solve_by_rows", by_rows)

    def solved(h):
        stages, x, lin = equations_near_start(system, y0, method, h)
        r, push = jax.linearize(lambda x: stage_residuals(stages, x)[0], x)
        z, unravel = ravel_pytree(x)
        rows = jax.vmap(lambda z: ravel_pytree(push(unravel(z)))[0])
        jacobian = rows(jnp.eye(len(z))).T
        return _solved(stages, x, lin, push, [r, r])[0], jacobian, ravel_pytree(r)[0]

    cases = [
        (solved, 0.1, True),
        (jax.vmap(solved), [0.1, 0.07], True),
        (jax.vmap(solved), [0.08, 0.07], False),
    ]
    for function, h, is_singular in cases:
        counted.clear()
        found, jacobian, r = map(np.asarray, jax.jit(function)(jnp.asarray(h)))
        jax.effects_barrier()
        expected = np.linalg.solve(jacobian, r[..., None])[..., 0]
        np.testing.assert_allclose(found, expected, rtol=1e-13)
        assert bool(counted) == is_singular


@pytest.mark.parametrize("size", [1, 2, 7, 40])
def test_solve_by_rows_of_matrix_without_diagonal_equals_numpy(size):
    random = np.random.default_rng(size)
    matrix = random.normal(size=(3, size, size))
    if size > 1:
        matrix[:, np.arange(size), np.arange(size)] = 0
    rights = random.normal(size=(3, size, 2))
    found = jax.jit(jax.vmap(solve_by_rows))(matrix, rights)
    expected = np.linalg.solve(matrix, rights)
    condition = np.linalg.cond(matrix).max()
    size = np.abs(expected).max()
    np.testing.assert_allclose(found, expected, rtol=0, atol=4e-16 * condition * size)


def test_newton_of_a_machine_is_compiled_without_a_library():
    system, y0 = of_example(systems.FourBar())

    def run(y0):
        options = {"dt": 0.02, "num_steps": 2, "stage_solver": nhjax.Newton()}
        return nhjax.integrate(system, LOBATTO(3), y0, throw=False, **options).ys

    assert {use.engine for use in nhjax.engines(run, y0)} == {"lanes"}
