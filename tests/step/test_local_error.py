"""The estimated error of a step that controllers of step sizes use."""

import functools
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import Gauss, LobattoIIIAB, SaveAt
from nhjax._integrate._step_sizes import AbstractStepSizeController, Decision
from nhjax._results import RESULTS
from nhjax._step import local_error


class Probe(AbstractStepSizeController):
    """Takes equal steps; the memory is the estimated error of the last step."""

    position: float = 1.0
    fibre: float = 1.0

    def init(self, context: Any, t: Any, start: Any) -> Any:
        """Start with `dt`."""
        size = jnp.abs(context.dt) * context.direction
        return size, jnp.zeros_like(t), RESULTS.successful

    def adapt(self, context: Any, attempt: Any, memory: Any) -> Decision:
        """Accept each step, and estimate its error in units of the scales."""
        del memory
        ones = jnp.ones_like(attempt.start.state.p)
        error, _ = local_error(
            *(context.system, context.method, attempt.t, attempt.h),
            *(attempt.start, attempt.outcome),
            (self.position * ones, self.fibre * ones),
            context.args,
            jnp.full(2, jnp.inf),
        )
        result = attempt.outcome.result
        return Decision(attempt.is_solved, result, attempt.chosen, error)


PROBE = Probe()


def estimate_of(system, method, y, h, probe=PROBE, **options):
    """Return the estimated error of one step, and the state after it."""
    sol = nhjax.integrate(
        system,
        method,
        y,
        dt=h,
        num_steps=1,
        stepsize_controller=probe,
        saveat=SaveAt(t1=True, checkpoint=True),
        throw=False,
        **options,
    )
    return sol.checkpoint.clock[-1], jax.tree.map(lambda x: x[0], sol.ys)


# A motor drives the pendulum, so that no step is symmetric.
PENDULUM = nhjax.LagrangianSystem(
    lambda t, q, v, args: 0.6 * v @ v + 1.3 * jnp.cos(q[0]) + 0.4 * q[0]
)
# The slope of the constraint grows with y, as on a helical slide.
SLIDE = nhjax.LagrangianSystem(
    lambda t, q, v, args: (
        0.5 * v @ (jnp.array([1.0, 1.4, 0.8]) * v)
        - 0.9 * q[0] ** 2
        - 0.4 * (q[1] - 0.2) ** 4
        - 0.3 * q[2]
    ),
    nonholonomic=lambda t, q, v, args: (v[2] - jnp.sin(q[1]) * v[0])[None],
)
TOP = nhjax.LagrangianSystem(
    lambda t, q, v, args: (
        0.5 * v @ (jnp.array([1.1, 2.0, 2.7]) * v)
        - jnp.array([0.3, -0.5, 1.2]) @ nhjax.SO3().matrix(q)[2]
    ),
    manifold=nhjax.SO3(),
)
CHAIN = nhjax.HamiltonianSystem(
    lambda t, q, p, args: (
        0.5 * p[0] ** 2 / 1.5
        + 0.5 * p[1] ** 2 / 0.7
        + 0.2 * p[0] * p[1]
        + 0.5 * q @ q
        + 0.25 * (q[0] - q[1]) ** 4
    )
)
ROD = nhjax.LagrangianSystem(
    lambda t, q, v, args: 0.5 * v @ v - 1.7 * q[1] + 0.2 * q[0],
    holonomic=lambda t, q, args: (q @ q - 1.0)[None],
)
STARTS = {
    "pendulum": (PENDULUM, [0.7], [1.3]),
    "slide": (SLIDE, [0.4, 0.7, 0.0], [0.9, 0.8, 0.0]),
    "top": (TOP, [0.8, 0.3, -0.1, 0.5], [0.7, -0.5, 1.1]),
    "chain": (CHAIN, [0.9, -0.6], [0.4, 1.1]),
    "rod": (ROD, [0.6, 0.8], [1.2, -0.9]),
}


@functools.cache
def states_of(name):
    """Return states along a motion, as a batch."""
    system, q, u = STARTS[name]
    q, u = jnp.array(q), jnp.array(u)
    if name == "top":
        q = q / jnp.linalg.norm(q)
    if name == "chain":
        y0 = nhjax.initial_state(system, q, p=u)
    else:
        y0 = nhjax.initial_state(system, q, u, project=True)
    return nhjax.integrate(
        system, LobattoIIIAB(5), y0, dt=0.27, num_steps=12, saveat=SaveAt(steps=True)
    ).ys


def displacement(name, q, other):
    """Return the displacement from one position to another one."""
    if name != "top":
        return other - q
    # The vector part of conj(q) other, which is half of the rotation vector.
    w, x = q[0], q[1:]
    return 2 * (w * other[1:] - other[0] * x - jnp.cross(x, other[1:]))


@functools.cache
def both_of(name, method):
    """Return a function of h: estimated and true errors of a step from each state."""
    system = STARTS[name][0]
    fine = LobattoIIIAB(method.stages + 2)

    def one(y, h):
        estimate, end = estimate_of(system, method, y, h)
        sol = nhjax.integrate(system, fine, y, dt=h / 8, num_steps=8, throw=False)
        q, u = sol.ys.q[0], system.fibre_coordinate(sol.ys)[0]
        both = displacement(name, q, end.q), system.fibre_coordinate(end) - u
        return estimate, jnp.sqrt(jnp.mean(jnp.concatenate(both) ** 2))

    return jax.jit(jax.vmap(one, in_axes=(0, None)))


# Sizes for which errors are small, but well above round-off.
SIZES = {2: 0.05, 3: 0.12, 4: 0.25}


def assert_near_true_errors(run, name, h, order):
    """The estimate has the order and, except for rare states, the size of the error."""
    (one, true), (half, true_half) = (run(states_of(name), x) for x in (h, 0.5 * h))
    slopes = np.log2(np.median(one / half)), np.log2(np.median(true / true_half))
    np.testing.assert_allclose(slopes, order, rtol=0, atol=0.3)
    ratios = np.concatenate([one / true, half / true_half])
    assert 1e-2 < np.median(ratios) < 1e2
    assert np.percentile(ratios, 90) < 1e2
    # To underestimate an error is worse than to overestimate it.
    assert np.min(ratios) > 1e-2


QUICK = {("pendulum", 2), ("slide", 3), ("rod", 4)}
CASES = [
    pytest.param(*case, marks=[] if case in QUICK else pytest.mark.long)
    for case in itertools.product(STARTS, SIZES)
]


@pytest.mark.parametrize(("name", "stages"), CASES)
def test_local_error_along_a_motion_has_the_size_and_order_of_the_true_error(
    name, stages
):
    run = both_of(name, LobattoIIIAB(stages))
    assert_near_true_errors(run, name, SIZES[stages], 2 * stages - 1)


# With two stages, the estimate may vanish, as the documentation says.
@pytest.mark.parametrize(
    "name", ["pendulum", *(pytest.param(x, marks=pytest.mark.long) for x in ("top",))]
)
def test_local_error_of_gauss_method_has_the_size_and_order_of_the_true_error(name):
    assert_near_true_errors(both_of(name, Gauss(3)), name, 0.2, 7)


# With constraints, an estimate takes the reactions at the start of its step.
@pytest.mark.parametrize(
    ("name", "rtol"),
    [
        ("pendulum", 1e-10),
        pytest.param("top", 1e-10, marks=pytest.mark.long),
        pytest.param("chain", 1e-10, marks=pytest.mark.long),
        ("slide", 0.1),
    ],
)
def test_local_error_of_a_step_and_of_the_step_back_is_the_same(name, rtol):
    system, method, h = STARTS[name][0], LobattoIIIAB(3), 0.12

    @jax.jit
    @jax.vmap
    def both(y):
        forward, end = estimate_of(system, method, y, h)
        return forward, estimate_of(system, method, end, -h, t0=h)[0]

    forward, back = both(states_of(name))
    np.testing.assert_allclose(back, forward, rtol=rtol)


def test_local_error_of_both_signs_of_h_at_a_symmetric_state_is_the_same():
    # The swing through the lowest point looks the same backward in time.
    system = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v + jnp.cos(q[0]))
    y = nhjax.initial_state(system, jnp.array([0.0]), jnp.array([1.5]))
    ahead, back = (estimate_of(system, LobattoIIIAB(4), y, h)[0] for h in (0.3, -0.3))
    np.testing.assert_allclose(ahead, back, rtol=1e-12)


def test_local_error_of_a_hamiltonian_system_scales_positions_and_momenta():
    mass = jnp.array(3.0)
    lagrangian = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * mass * v @ v + jnp.cos(q[0])
    )
    hamiltonian = nhjax.HamiltonianSystem(
        lambda t, q, p, args: 0.5 * p @ p / mass - jnp.cos(q[0])
    )
    q, v, method = jnp.array([0.4]), jnp.array([0.9]), LobattoIIIAB(3)
    y = nhjax.initial_state(lagrangian, q, v)
    z = nhjax.initial_state(hamiltonian, q, p=mass * v)
    # An error of v equals an error of p = m v in units that are m times larger.
    one = estimate_of(lagrangian, method, y, 0.2, Probe(0.7, 0.2))[0]
    other = estimate_of(hamiltonian, method, z, 0.2, Probe(0.7, 0.6))[0]
    np.testing.assert_allclose(one, other, rtol=1e-12)


def test_local_error_with_scales_of_ten_is_a_tenth():
    y, method = jax.tree.map(lambda x: x[3], states_of("slide")), LobattoIIIAB(3)
    one = estimate_of(SLIDE, method, y, 0.2)[0]
    tenth = estimate_of(SLIDE, method, y, 0.2, Probe(10.0, 10.0))[0]
    np.testing.assert_allclose(tenth, 0.1 * one, rtol=1e-12)


def test_local_error_at_equilibrium_is_zero():
    system = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v + jnp.cos(q[0]))
    y = nhjax.initial_state(system, jnp.array([0.0]), jnp.array([0.0]))
    assert float(estimate_of(system, LobattoIIIAB(3), y, 0.5)[0]) < 1e-60
