"""Every step satisfies the paper's equations, checked by an independent residual."""

import numpy as np
import pytest

import nhjax
from support import helpers, paper_equations as paper, paper_mechanics as mechanics
from support.driven import FIELD, FRICTION
from support.helpers import CLOSURES, GALLERY, recorded
from support.long import long


TOLERANCE = 1e-14


def parameters(example, *names):
    """Parameters of a gallery example as Python floats."""
    return [float(getattr(example, name)) for name in names]


MECHANICS = {
    "particle": mechanics.Particle(
        *parameters(GALLERY["particle"], "mass", "stiffness")
    ),
    "chaotic": mechanics.Chaotic(),
    "sleigh": mechanics.Sleigh(
        *parameters(GALLERY["sleigh"], "mass", "inertia", "offset"),
    ),
    "Appell": mechanics.AppellSystem(
        *parameters(GALLERY["Appell"], "mass", "gravity", "ratio")
    ),
    "rolling disc": mechanics.Disc(
        *parameters(
            GALLERY["rolling disc"],
            "mass",
            "roll_inertia",
            "heading_inertia",
            "radius",
        )
    ),
    "driven": mechanics.Driven(FIELD, FRICTION),
}
SIZES = {"particle": 3, "chaotic": 7, "sleigh": 3, "Appell": 3, "rolling disc": 4}
SIDE_BY_SIDE = (*helpers.BESIDE, "driven")
MECHANICS["side by side"] = mechanics.SideBySide(
    [(MECHANICS[name], SIZES.get(name, 3)) for name in SIDE_BY_SIDE]
)


def run_of(sol, h=helpers.RECORDED_STEP):
    """Nodes from the saved states, stages from the records of dense output."""
    records = sol.interpolation.records
    return paper.Run(
        t=np.asarray(sol.ts),
        h=h,
        q=np.asarray(sol.ys.q),
        v=np.asarray(sol.ys.v),
        p=np.asarray(sol.ys.p),
        multiplier=np.asarray(sol.ys.multiplier),
        V=np.asarray(records.velocity),
        W=np.asarray(records.force),
        Lambda=np.asarray(records.multiplier),
    )


def part_of(run, name):
    """Return the part of a run that belongs to one of the systems side by side."""
    sizes = [SIZES.get(part, 3) for part in SIDE_BY_SIDE]
    k = SIDE_BY_SIDE.index(name)
    at = slice(sum(sizes[:k]), sum(sizes[: k + 1]))
    rows = slice(k, k + 1)
    return paper.Run(
        t=run.t,
        h=run.h,
        q=run.q[:, at],
        v=run.v[:, at],
        p=run.p[:, at],
        multiplier=run.multiplier[:, rows],
        V=run.V[..., at],
        W=run.W[..., at],
        Lambda=run.Lambda[..., rows],
    )


def assert_equations_hold(name, run, closure, tolerance=TOLERANCE):
    for equation, residual in paper.residuals(MECHANICS[name], run, closure).items():
        assert residual <= tolerance, f"{name}: {equation}: {residual:.1e}"


every_closure = pytest.mark.parametrize("closure", CLOSURES)


# The equations do not depend on the solver. The dense solver takes long to compile, so
# it runs with each number of stages and each closure, but not with each pair of them.
@pytest.mark.parametrize(
    ("stages", "solver", "closure"),
    [
        *((s, "simplified", closure) for s in (2, 3) for closure in CLOSURES),
        *(long(s, "simplified", closure) for s in (4, 5) for closure in CLOSURES),
        (2, "dense", "propagated"),
        (3, "dense", "consistent"),
        (3, "dense", "symmetric"),
        long(4, "dense", "symmetric"),
        long(4, "dense", "propagated"),
        long(5, "dense", "consistent"),
    ],
)
def test_equations_of_the_paper_on_vector_space_hold_to_round_off(
    stages, solver, closure
):
    run = run_of(recorded("side by side", stages, closure, solver))
    for name in SIDE_BY_SIDE:
        assert_equations_hold(name, part_of(run, name), closure)


@pytest.mark.parametrize(
    ("name", "closure"),
    [
        *((name, closure) for name in ("particle", "sleigh") for closure in CLOSURES),
        ("chaotic", "symmetric"),
        ("Appell", "symmetric"),
        ("rolling disc", "symmetric"),
        ("driven", "symmetric"),
    ],
)
def test_equations_of_the_paper_for_one_system_alone_hold_to_round_off(name, closure):
    run = run_of(recorded(name, 3, closure, "simplified"))
    assert_equations_hold(name, run, closure)


def test_equations_of_the_paper_for_negative_steps_hold_to_round_off():
    system, y0, args = helpers.problem("driven")
    later = nhjax.initial_state(system, y0.q, y0.v, t=0.7, args=args, project=True)
    sol = helpers.integrate_recorded(
        "driven", 3, "symmetric", "simplified", later, dt=-0.08, t0=0.7
    )
    assert_equations_hold("driven", run_of(sol, h=-0.08), "symmetric")


@pytest.mark.long
def test_equations_of_the_paper_for_large_steps_hold_to_round_off():
    start = helpers.problem("side by side")[1]
    sol = helpers.integrate_recorded(
        "side by side", 4, "symmetric", "dense", start, dt=0.4
    )
    for name in ("particle", "chaotic", "sleigh"):
        run = part_of(run_of(sol, h=0.4), name)
        # Round-off grows with the size of the step: with three releases of JAX and of
        # its compiler the largest residual is 0.9e-14, 1.0e-14 and 1.5e-14.
        assert_equations_hold(name, run, "symmetric", tolerance=3e-14)


@every_closure
def test_step_records_start_at_saved_nodes(closure):
    sol = recorded("sleigh", 3, closure, "simplified")
    assert sol.interpolation is not None
    starts = sol.interpolation.records.start
    for name in ("q", "v", "p", "multiplier"):
        nodes = getattr(sol.ys, name)
        np.testing.assert_array_equal(getattr(starts, name), nodes[:-1], err_msg=name)


@every_closure
@pytest.mark.parametrize("array", ["q", "v", "p", "multiplier", "V", "W", "Lambda"])
def test_stage_residuals_of_a_record_with_an_error_are_above_round_off(array, closure):
    run = run_of(recorded("particle", 3, closure, "simplified"))
    wrong = run.perturbed(array, 1e-11)
    assert max(paper.residuals(MECHANICS["particle"], wrong, closure).values()) > 1e-13


def test_stage_residuals_with_another_closure_are_above_round_off():
    runs = {c: run_of(recorded("sleigh", 3, c, "simplified")) for c in CLOSURES}
    for taken in CLOSURES:
        for claimed in CLOSURES:
            found = paper.residuals(MECHANICS["sleigh"], runs[taken], claimed)
            assert (max(found.values()) <= TOLERANCE) == (taken == claimed)


def test_lobatto_coefficients_from_definitions_equal_published_ones():
    # Hairer, Lubich and Wanner, "Geometric Numerical Integration", tables II.1.1, 1.2.
    a = [[0, 0, 0], [5 / 24, 1 / 3, -1 / 24], [1 / 6, 2 / 3, 1 / 6]]
    a_hat = [[1 / 6, -1 / 6, 0], [1 / 6, 1 / 3, 0], [1 / 6, 5 / 6, 0]]
    pair = paper.lobatto(3)
    np.testing.assert_allclose(pair.a, a, rtol=0, atol=5e-16)
    np.testing.assert_allclose(pair.a_hat, a_hat, rtol=0, atol=5e-16)
    np.testing.assert_allclose(paper.lobatto(2).a, [[0, 0], [0.5, 0.5]], atol=5e-16)
    np.testing.assert_allclose(paper.lobatto(2).a_hat, [[0.5, 0], [0.5, 0]], atol=5e-16)


@pytest.mark.parametrize("stages", range(2, 8))
def test_lobatto_coefficients_of_library_equal_definitions(stages):
    pair, method = paper.lobatto(stages), nhjax.LobattoIIIAB(stages)
    for name in ("a", "a_hat", "b", "c"):
        np.testing.assert_allclose(
            getattr(method, name), getattr(pair, name), rtol=0, atol=1e-15, err_msg=name
        )
