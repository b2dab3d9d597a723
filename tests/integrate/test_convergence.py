"""Observed orders of convergence, against exact solutions and against SciPy.

A run of N steps of size T/N is compared with the reference at each of its nodes, and
slopes are taken from the root mean square of these errors from one N to the next. The
mean over nodes matters for multipliers: a single node may lie where the error passes
through zero, and for even s the parasitic part of a propagated multiplier alternates.
The steps are as large as the asymptotic regime allows (1/2 to 1/8 at s >= 5), which
keeps errors above a floor of at least 20 times the error of the reference.
"""

from functools import cache
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import nhjax
from nhjax.systems import ChaplyginSleigh, NonholonomicParticle
from support import helpers, paper_mechanics as paper
from support.driven import FIELD, FRICTION
from support.long import exhaustive_but
from support.orders import assert_order, rms, SCIPY_FLOOR, trajectories


PARTICLE, SLEIGH = NonholonomicParticle(), ChaplyginSleigh()
PARTS = {"particle": (PARTICLE, slice(0, 3), 0), "sleigh": (SLEIGH, slice(3, 6), 1)}
MECHANICS = {
    "particle": paper.Particle(1.0, 1.0),
    "sleigh": paper.Sleigh(1.0, 0.1, 0.3),
}


def solved_lagrangian(t, q, v, args):
    particle = PARTICLE.lagrangian(t, q[:3], v[:3], args)
    return particle + SLEIGH.lagrangian(t, q[3:], v[3:], args)


def solved_constraint(t, q, v, args):
    particle = PARTICLE.constraint(t, q[:3], v[:3], args)
    return jnp.stack([particle, SLEIGH.constraint(t, q[3:], v[3:], args)])


# Two systems with exact solutions side by side, one program for both.
SOLVED = nhjax.LagrangianSystem(solved_lagrangian, nonholonomic=solved_constraint)
COUNTS = {
    2: (32, 64, 128),
    3: (16, 32, 64),
    4: (8, 16, 32),
    5: (4, 8, 16),
    6: (4, 6, 8, 12, 24),
}
STATE_COUNTS = COUNTS | {6: (4, 6, 8)}  # Beyond these the state is at round-off.
# The error of a propagated multiplier is larger by a factor h^(2-s) or more, and it
# reaches its slope only at smaller h: between h = 1/2 and 1/4 the slope is 4.3 at s = 5
# on the particle, and 4.7 on the particle and 7.8 on the sleigh at s = 6.
MULTIPLIER_COUNTS = COUNTS | {5: (8, 16), 6: (12, 24)}


@cache
def solved_runs(stages, closure):
    start = [PARTICLE.initial_state(), SLEIGH.initial_state()]
    y0 = jax.tree.map(lambda *x: jnp.concatenate(x), *start)
    method = nhjax.LobattoIIIAB(stages, closure)
    return trajectories(SOLVED, method, y0, COUNTS[stages])


@cache
def solved_errors(part, stages, closure):
    """Errors of q, v, p, and of both multipliers, by number of steps."""
    example, at, row = PARTS[part]
    errors = {}
    for ts, y, continuous in solved_runs(stages, closure):
        q, v, multiplier = map(np.stack, zip(*map(example.exact, ts), strict=True))
        p = MECHANICS[part].d2l(ts, q, v)
        errors[len(ts)] = {
            "q": rms(y.q[:, at] - q),
            "v": rms(y.v[:, at] - v),
            "p": rms(y.p[:, at] - p),
            "multiplier": rms(y.multiplier[:, row : row + 1] - multiplier),
            "continuous": rms(continuous[:, row : row + 1] - multiplier),
        }
    return errors


every_part = pytest.mark.parametrize("part", PARTS)
every_stages = pytest.mark.parametrize("stages", exhaustive_but((2, 3, 4), COUNTS))
# Four stages behave like two, as their number is even: the quick suite tests them only
# with the closure that depends on the parity.
every_method = pytest.mark.parametrize(
    ("stages", "closure"),
    exhaustive_but(
        [*product((2, 3), helpers.CLOSURES), (4, "propagated")],
        product(COUNTS, helpers.CLOSURES),
    ),
)
# For tests without multipliers: each number of stages and each closure occurs once.
some_methods = pytest.mark.parametrize(
    ("stages", "closure"), [(2, "symmetric"), (3, "propagated"), (4, "consistent")]
)


@every_method
@every_part
@pytest.mark.parametrize("quantity", ["q", "v", "p", "continuous"])
def test_state_and_continuous_multiplier_converge_with_order_2s_minus_2(
    quantity, part, closure, stages
):
    counts = STATE_COUNTS[stages]
    errors = solved_errors(part, stages, closure)
    assert_order(2 * stages - 2, counts, [errors[n][quantity] for n in counts])


@every_stages
@every_part
def test_propagated_multiplier_converges_with_order_s_or_s_minus_1(part, stages):
    # The corollary on the global error: R_A(∞) = (-1)^(s-1).
    counts = MULTIPLIER_COUNTS[stages]
    errors = solved_errors(part, stages, "propagated")
    order = stages if stages % 2 == 0 else stages - 1
    assert nhjax.LobattoIIIAB(stages, "propagated").multiplier_order == order
    assert_order(order, counts, [errors[n]["multiplier"] for n in counts])


@pytest.mark.parametrize(
    ("stages", "closure"),
    exhaustive_but(
        product((2, 3), ("consistent", "symmetric")),
        product(COUNTS, ("consistent", "symmetric")),
    ),
)
@every_part
def test_multiplier_of_other_closures_converges_with_order_2s_minus_2(
    part, closure, stages
):
    counts = STATE_COUNTS[stages]
    errors = solved_errors(part, stages, closure)
    assert nhjax.LobattoIIIAB(stages, closure).multiplier_order == 2 * stages - 2
    assert_order(2 * stages - 2, counts, [errors[n]["multiplier"] for n in counts])


def reference(acceleration, q0, v0, ts):
    """(q, v) at `ts` by SciPy on q'' = acceleration(t, q, v)."""

    def field(t, y):
        q, v = np.split(y, 2)
        return np.concatenate([v, acceleration(t, q, v)])

    solution = solve_ivp(
        field,
        (0.0, ts[-1] * (1 + 1e-12)),
        np.concatenate([q0, v0]),
        method="DOP853",
        t_eval=ts,
        rtol=3e-14,
        atol=1e-15,
    )
    return np.split(solution.y.T, 2, axis=1)


def assert_order_against_scipy(
    order, system, method, y0, counts, acceleration, args=None
):
    errors = {"q": [], "v": []}
    for ts, y, _ in trajectories(system, method, y0, counts, args):
        q, v = reference(acceleration, np.asarray(y0.q), np.asarray(y0.v), ts)
        errors["q"].append(rms(y.q - q))
        errors["v"].append(rms(y.v - v))
    for values in errors.values():
        assert_order(order, counts, values, SCIPY_FLOOR)


def pendulum_lagrangian(t, q, v, args):
    """An oscillator and a pendulum, uncoupled."""
    return 0.5 * (v @ v) - 0.5 * q[0] ** 2 + jnp.cos(q[1])


def pendulum_friction(t, q, v, args):
    return -args * v**3


PENDULUM = nhjax.LagrangianSystem(pendulum_lagrangian, force=pendulum_friction)


def pendulum_problem(friction):
    args = jnp.asarray(friction)
    q, v = jnp.array([0.8, 1.0]), jnp.array([0.6, 1.5])
    y0 = nhjax.initial_state(PENDULUM, q, v=v, args=args)

    def acceleration(t, q, v):
        return np.array([-q[0], -np.sin(q[1])]) - friction * v**3

    return y0, acceleration, args


# The cubic friction shortens the time scale at the start: at step sizes where order 8
# is asymptotic with friction, it is at round-off without friction.
PENDULUM_COUNTS = {
    0.0: {2: (32, 64, 128), 4: (8, 16, 32), 6: (12, 16, 24), 8: (6, 8, 12)},
    0.3: {2: (32, 64, 128), 4: (8, 16, 32), 6: (12, 16, 24), 8: (12, 16)},
}
every_friction = pytest.mark.parametrize("friction", PENDULUM_COUNTS)


@pytest.mark.parametrize("stages", [1, 2, 3, 4])
@every_friction
def test_gauss_without_constraints_converges_with_order_2s(friction, stages):
    y0, acceleration, args = pendulum_problem(friction)
    method = nhjax.Gauss(stages)
    assert method.order == 2 * stages
    counts = PENDULUM_COUNTS[friction][method.order]
    assert_order_against_scipy(
        method.order, PENDULUM, method, y0, counts, acceleration, args
    )


@pytest.mark.parametrize("stages", [2, 3, 4, 5])
@every_friction
def test_lobatto_without_constraints_converges_with_order_2s_minus_2(friction, stages):
    y0, acceleration, args = pendulum_problem(friction)
    method = nhjax.LobattoIIIAB(stages)
    assert method.order == 2 * stages - 2
    counts = PENDULUM_COUNTS[friction][method.order]
    assert_order_against_scipy(
        method.order, PENDULUM, method, y0, counts, acceleration, args
    )


@some_methods
def test_lobatto_with_affine_rheonomic_constraint_and_friction_keeps_order(
    stages, closure
):
    system, y0, args = helpers.problem("driven")
    mechanics = paper.Driven(FIELD, FRICTION)
    method = nhjax.LobattoIIIAB(stages, closure)
    assert_order_against_scipy(
        method.order, system, method, y0, COUNTS[stages], mechanics.acceleration, args
    )


class SpringAppell(paper.AppellSystem):
    """Appell's constraint in the potential m g z + ½ (x² + 2 y²) + x y z."""

    def d1l(self, t, q, v):
        """Minus the gradient of the potential."""
        x, y, z = np.moveaxis(q, -1, 0)
        weight = self.m * self.g
        return -np.stack([x + y * z, 2 * y + x * z, weight + x * y], axis=-1)


def spring_appell_lagrangian(t, q, v, args):
    springs = 0.5 * (q[0] ** 2 + 2.0 * q[1] ** 2) + q[0] * q[1] * q[2]
    return helpers.GALLERY["Appell"].lagrangian(t, q, v, args) - springs


@some_methods
def test_lobatto_with_constraint_nonlinear_in_velocities_keeps_order(stages, closure):
    appell = helpers.GALLERY["Appell"]
    system = nhjax.LagrangianSystem(
        spring_appell_lagrangian, nonholonomic=appell.constraint
    )
    y0 = nhjax.initial_state(system, appell.q0, v=appell.v0)
    mechanics = SpringAppell(
        float(appell.mass), float(appell.gravity), float(appell.ratio)
    )
    method = nhjax.LobattoIIIAB(stages, closure)
    assert_order_against_scipy(
        method.order, system, method, y0, COUNTS[stages], mechanics.acceleration
    )
