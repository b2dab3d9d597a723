"""Observed orders on groups and with holonomic constraints."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import systems
from support import group_oracle
from support.helpers import SideBySide
from support.long import exhaustive_but, long
from support.orders import assert_order, DURATION, rms, SCIPY_FLOOR, trajectories


RETRACTIONS = {"cayley": nhjax.Cayley(), "exponential": nhjax.Exponential()}

# The dense solver takes long to compile for systems side by side.
SOLVER = nhjax.SimplifiedNewton()

every_retraction = pytest.mark.parametrize("retraction", RETRACTIONS)
COUNTS = {
    2: (32, 64, 128),
    3: (16, 32, 64),
    4: (8, 12, 16, 24, 32),
    5: (6, 8, 12, 16, 24),
}
FLOOR = 2e-14
every_stages = pytest.mark.parametrize("stages", exhaustive_but((2, 3), COUNTS))


@eqx.filter_jit
def matrix_of_each(group, q):
    return jax.vmap(group.matrix)(q)


def matrices(group, q):
    """Elements as flat rows of matrices: q and -q are the same rotation."""
    rows = matrix_of_each(group, jax.tree.map(jnp.asarray, q))
    return np.asarray(rows).reshape(rows.shape[0], -1)


def exact_nodes(example, ts):
    q, v, multiplier = zip(*map(example.exact, ts), strict=True)
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *q)
    return stacked, np.stack(v), np.stack(multiplier)


def errors_by_part(beside, runs, multiplier_rows):
    """For each example the errors of q, v, λ and λ_c by number of steps."""
    errors = [{} for _ in beside.examples]
    for ts, y, continuous in runs:
        velocities = beside.parts(y.v)
        for k, example in enumerate(beside.examples):
            q, v, multiplier = exact_nodes(example, ts)
            group = beside.manifold.factors[k]
            found = errors[k][len(ts)] = {
                "q": rms(matrices(group, y.q[k]) - matrices(group, q)),
                "v": rms(velocities[k] - v),
            }
            rows = multiplier_rows[k]
            if rows:
                found["multiplier"] = rms(y.multiplier[:, rows] - multiplier)
                found["continuous"] = rms(continuous[:, rows] - multiplier)
    return errors


ON_GROUPS = ("unicycle", "Suslov")


@cache
def errors_on_groups(retraction, stages, closure):
    tau = RETRACTIONS[retraction]
    beside = SideBySide(
        (
            systems.Unicycle(retraction=tau),
            systems.Suslov(v0=(0.6, 1.3, 0.0), retraction=tau),
        )
    )
    system = beside.system()
    y0 = beside.initial_state(system)
    # The paper's chart with the paper's closure.
    chart = "start" if closure == "propagated" else "middle"
    method = nhjax.LobattoIIIAB(stages, closure, chart)
    runs = trajectories(system, method, y0, COUNTS[stages], stage_solver=SOLVER)
    return errors_by_part(beside, runs, ([0], [1]))


def assert_finest_order(order, errors, quantity):
    """The slope between the two finest runs that are above round-off."""
    counts, found = zip(
        *((n, by[quantity]) for n, by in errors.items() if by[quantity] > FLOOR),
        strict=True,
    )
    assert_order(order, counts[-2:], found[-2:])


# The stages do not depend on the retraction: an even and an odd number are enough.
@pytest.mark.parametrize(
    ("retraction", "stages"),
    exhaustive_but(
        [("cayley", 3), ("exponential", 4)],
        [*(("cayley", s) for s in COUNTS), ("exponential", 3), ("exponential", 4)],
    ),
)
@pytest.mark.parametrize("part", range(2), ids=ON_GROUPS)
def test_state_on_a_group_converges_with_order_2s_minus_2(part, retraction, stages):
    errors = errors_on_groups(retraction, stages, "symmetric")[part]
    for quantity in errors[COUNTS[stages][0]]:
        assert_finest_order(2 * stages - 2, errors, quantity)


# Closures do not depend on the retraction, so one retraction is enough.
@every_stages
@pytest.mark.parametrize("part", range(2), ids=ON_GROUPS)
def test_propagated_multiplier_on_a_group_converges_with_order_s_or_s_minus_1(
    part, stages
):
    errors = errors_on_groups("cayley", stages, "propagated")[part]
    for quantity in ("q", "v"):
        assert_finest_order(2 * stages - 2, errors, quantity)
    order = stages if stages % 2 == 0 else stages - 1
    assert_finest_order(order, errors, "multiplier")


def errors_of(example, method, counts):
    """Errors of q, v and λ of one example by number of steps."""
    group, errors = example.manifold, {}
    y0 = example.initial_state()
    runs = trajectories(example.system, method, y0, counts, stage_solver=SOLVER)
    for ts, y, _ in runs:
        q, v, multiplier = exact_nodes(example, ts)
        errors[len(ts)] = {
            "q": rms(matrices(group, y.q) - matrices(group, q)),
            "v": rms(y.v - v),
        }
        if multiplier.size:
            errors[len(ts)]["multiplier"] = rms(y.multiplier - multiplier)
    return errors


COUNTS_BY_ORDER = {2: (32, 64), 4: (16, 32), 6: (16, 24)}


@pytest.mark.parametrize(
    "method",
    [
        long(nhjax.Gauss(1)),
        nhjax.Gauss(2),
        *map(long, map(nhjax.LobattoIIIAB, (2, 3, 4))),
    ],
    ids=["Gauss(1)", "Gauss(2)", "Lobatto(2)", "Lobatto(3)", "Lobatto(4)"],
)
@every_retraction
def test_free_rigid_body_on_a_group_converges_with_method_order(method, retraction):
    body = systems.FreeRigidBody(v0=(0.5, 1.5, 0.8), retraction=RETRACTIONS[retraction])
    errors = errors_of(body, method, COUNTS_BY_ORDER[method.order])
    for quantity in ("q", "v"):
        assert_finest_order(method.order, errors, quantity)


@pytest.mark.parametrize("stages", [long(2), 3, long(4)])
def test_ball_on_a_product_of_groups_converges_with_order_2s_minus_2(stages):
    ball = systems.TurntableBall.rolling((0.3, -0.2), (0.5, 0.3))
    method = nhjax.LobattoIIIAB(stages)
    # With the step counts of the others it would turn by up to a radian in a step.
    counts = {2: (32, 64), 4: (32, 64), 6: (32, 48)}[method.order]
    errors = errors_of(ball, method, counts)
    for quantity in ("q", "v"):
        assert_finest_order(method.order, errors, quantity)


@cache
def tops(retraction):
    top = systems.HeavyTop(
        1.3, (0.3, 0.5, 0.6), (0.2, -0.1, 0.4), 2.0, retraction=RETRACTIONS[retraction]
    )
    return top, top.on_se3()


@cache
def top_oracle(count):
    ts = np.linspace(0.0, DURATION, count + 1)[1:]
    states = group_oracle.oracle(tops("cayley")[0], ts)[3]
    q, v = zip(*states, strict=True)
    return np.stack(q), np.stack(v)


@pytest.mark.parametrize(
    ("stages", "retraction"),
    [long(2, "cayley"), long(3, "cayley"), long(4, "cayley"), (3, "exponential")],
)
@pytest.mark.parametrize("kind", ["on SO(3)", "on SE(3) with a fixed point"])
def test_heavy_top_on_a_group_converges_with_order_2s_minus_2(kind, retraction, stages):
    top = tops(retraction)[0 if kind == "on SO(3)" else 1]
    counts = {2: (64, 128, 256), 3: (32, 64, 128), 4: (24, 32, 48)}[stages]
    method = nhjax.LobattoIIIAB(stages)
    runs = trajectories(top.system, method, top.initial_state(), counts)
    so3, errors = nhjax.SO3(), {"q": [], "v": []}
    for ts, y, _ in runs:
        q, v = top_oracle(len(ts))
        errors["q"].append(rms(matrices(so3, y.q[:, :4]) - matrices(so3, q)))
        errors["v"].append(rms(y.v[:, -3:] - v))
    for found in errors.values():
        assert_order(2 * stages - 2, counts, found, SCIPY_FLOOR)


@cache
def holonomic_errors(stages, closure):
    beside = SideBySide((systems.RodSleigh(), systems.SphericalPendulum()))
    system = beside.system()
    y0 = beside.initial_state(system)
    # The paper's chart with the paper's closure.
    chart = "start" if closure == "propagated" else "middle"
    method = nhjax.LobattoIIIAB(stages, closure, chart)
    runs = trajectories(system, method, y0, COUNTS[stages], stage_solver=SOLVER)
    return errors_by_part(beside, runs, ([0, 1], [2]))


@pytest.mark.parametrize(
    ("stages", "closure"),
    exhaustive_but(
        [(3, "symmetric"), (4, "propagated")],
        [*((s, "symmetric") for s in COUNTS), (3, "propagated"), (4, "propagated")],
    ),
)
@pytest.mark.parametrize(
    ("part", "quantities"),
    [(0, ("q", "v", "continuous")), (1, ("q", "v", "multiplier"))],
    ids=["with a nonholonomic one", "alone"],
)
def test_holonomic_constraints_on_a_group_keep_order_2s_minus_2(
    part, quantities, closure, stages
):
    errors = holonomic_errors(stages, closure)[part]
    for quantity in quantities:
        assert_finest_order(2 * stages - 2, errors, quantity)


def test_group_and_coordinates_converge_to_the_same_motion():
    on_group = systems.Unicycle()
    in_coordinates = on_group.in_coordinates()
    counts, method = COUNTS[3], nhjax.LobattoIIIAB(3)
    nodes = [
        trajectories(example.system, method, example.initial_state(), counts)
        for example in (on_group, in_coordinates)
    ]
    differences = [
        rms(here.q - there.q)
        for (_, here, _), (_, there, _) in zip(*nodes, strict=True)
    ]
    assert_order(method.order, counts, differences)
