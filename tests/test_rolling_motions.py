"""Rolling machines from parts, against motions in closed form."""

import numpy as np
import pytest

from benchmarks import rolling as motions


def _assert_order(rows, stages, *, atol):
    """The errors of q, v and force fall with the order 2s - 2, or are round-off."""
    observed = np.array(rows[-1]["orders"])
    expected = np.where(np.isnan(observed), np.nan, 2 * stages - 2)
    np.testing.assert_allclose(observed, expected, atol=atol)


def test_published_spin_of_the_disc_is_that_of_a_steady_motion():
    _, spin = motions.steady_rates()
    np.testing.assert_allclose(spin, motions.PUBLISHED_SPIN, rtol=1e-14)
    assert motions.unsteadiness() < 1e-13


@pytest.mark.parametrize(("s", "steps"), [(2, 4096), (3, 512), (4, 256)])
def test_disc_on_a_circle_has_the_order_of_the_method(s, steps):
    machine = motions.rolling_disc()
    rows = motions.against_closed_form(
        machine, motions.steady_disc, motions.DISC_DURATION, s, (steps, 2 * steps)
    )
    assert not np.isnan(rows[-1]["orders"]).any()
    _assert_order(rows, s, atol=0.05)
    assert max(row["violation"] for row in rows) < 1e-14


def test_mecanum_robot_with_motors_moves_sideways_as_in_the_closed_form():
    row = motions.run_of_robot(3, 300)
    assert row["violation"] < 1e-14
    assert row["yaw"] < 1e-13
    assert row["ahead"] < 1e-14
    assert row["way"] < 1e-12
    assert row["speed"] < 1e-12


@pytest.mark.parametrize("name", ["incline", "steep incline", "turntable", "bowl"])
def test_ball_keeps_the_closed_form(name):
    machine, motion = motions.balls()[name]
    rows = motions.against_closed_form(
        machine, motion, motions.BALL_DURATION, 3, (128, 256)
    )
    _assert_order(rows, 3, atol=0.1)
    assert max(row["violation"] for row in rows) < 1e-13
    position, velocity, force = rows[-1]["errors"]
    assert position < 5e-5
    assert velocity < 2e-4
    # The force of an incline is constant.
    assert force < (1e-12 if "incline" in name else 2e-5)


@pytest.mark.parametrize("part", ["blade", "wheel"])
def test_snakeboard_from_parts_accelerates_like_that_of_the_gallery(part):
    assert motions.difference_of_boards(part, driven=False, states=3) < 1e-12


def test_driven_snakeboard_from_parts_accelerates_like_that_of_the_gallery():
    assert motions.difference_of_boards("blade", driven=True, states=3) < 1e-12
