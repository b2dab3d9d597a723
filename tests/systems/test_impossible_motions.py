"""Constructors of machines name the argument for which no motion exists."""

import numpy as np
import pytest

from nhjax.systems import (
    CarWithTrailers,
    Rattleback,
    RollerRacer,
    RollingTorus,
    Snakeboard,
    SteerTorque,
    WhippleBicycle,
)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: CarWithTrailers.turning(1, steer=1.3, trailer_length=10.0),
            "`steer` = .* too sharp",
        ),
        (
            lambda: RollingTorus.circling(
                1.0, 0.0, tube_radius=5.0, diametral_inertia=0.01, axial_inertia=10.0
            ),
            "no steady motion with `tilt`",
        ),
        (lambda: RollerRacer.rolling(1.0, np.pi, distances=(1.0, 1.0)), "`angle`"),
        (lambda: Snakeboard.rolling(1.0, (0.0, np.pi / 2, 0.1)), "`joints`"),
        (lambda: WhippleBicycle.running(5.0, lean=1.5, steer=1.5), "`lean` = "),
        (lambda: Rattleback(product=5e-4), "No body has `moments`"),
    ],
)
def test_gallery_data_without_a_motion_raise(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_rider_without_torque_adds_no_force():
    bicycle = WhippleBicycle(steering=SteerTorque())
    assert float(bicycle.force(0.0, bicycle.q0, bicycle.v0, None)[5]) == 0.0
