"""Gallery examples on groups or with holonomic constraints, for several data."""

import jax
import numpy as np
import pytest

from nhjax.systems import (
    DoublePendulum,
    FreeRigidBody,
    HeavyTop,
    HeavyTopSE3,
    RodSleigh,
    RollingDisc,
    SphericalPendulum,
    Suslov,
    TurntableBall,
    Unicycle,
    UnicycleInCoordinates,
    Veselova,
)


def unit(*quaternion):
    return np.asarray(quaternion) / np.linalg.norm(quaternion)


TILTED = unit(0.7, -0.3, 0.5, 0.4)

SOLVED = {
    "unicycle": Unicycle(),
    "unicycle straight": Unicycle(
        1.3, 0.4, 2.0, q0=(0.3, -1.0, 2.0), v0=(-0.7, 0.0, 0.0)
    ),
    "unicycle in coordinates": UnicycleInCoordinates(),
    "ball": TurntableBall(),
    "ball tilted": TurntableBall.rolling(
        (0.7, 0.1), (-0.3, 0.5), -0.8, radius=0.8, rate=-1.5, q0=(TILTED, (0.0, 0.0))
    ),
    "ball in the body frame": TurntableBall.rolling(
        (0.7, 0.1), (-0.3, 0.5), 0.4, frame="body", q0=(TILTED, (0.0, 0.0))
    ),
    "Suslov": Suslov(),
    "Suslov other side": Suslov(
        (1.1, 0.6, 1.4), (-0.2, 0.4), q0=TILTED, v0=(0.5, -1.2, 0.0)
    ),
    "rolling disc": RollingDisc(),
    "rolling disc wide": RollingDisc(
        2.0, 0.7, 0.4, 1.5, q0=((0.0, 1.0, 2.2), (0.3,)), v0=(1.8, 0.0, -0.4, 1.2)
    ),
    "rigid body": FreeRigidBody(),
    "rigid body reversed": FreeRigidBody(
        (3.0, 2.0, 1.5), q0=TILTED, v0=(-0.9, 0.5, -0.2)
    ),
    "rigid body unordered": FreeRigidBody((2.0, 2.5, 1.0), v0=(0.2, 0.4, -1.1)),
    "rigid body symmetric": FreeRigidBody((2.0, 1.0, 1.0), v0=(0.2, 0.4, -1.1)),
    "rigid body round": FreeRigidBody((2.0, 2.0, 2.0)),
    "spherical pendulum": SphericalPendulum(),
    "spherical pendulum heavy": SphericalPendulum.swinging(
        1.2, 0.3, -0.7, 2.0, mass=1.7, length=0.6, gravity=9.81
    ),
    "spherical pendulum conical": SphericalPendulum.swinging(
        0.5, azimuth_rate=np.cos(0.5) ** -0.5
    ),
    "spherical pendulum plane": SphericalPendulum.swinging(0.8, 0.4, 0.5),
    "spherical pendulum over the top": SphericalPendulum.swinging(0.8, 0.4, 2.5),
    "rod sleigh": RodSleigh(),
    "rod sleigh straight blade": RodSleigh.sliding(-0.4, 0.9, angle=0.0),
    "rod sleigh backwards": RodSleigh.sliding(
        0.7, -1.1, (0.3, -0.2), 2.0, mass1=0.6, mass2=1.1, length=1.4, angle=-1.9
    ),
}
UNSOLVED = {
    "ball uneven": TurntableBall.rolling(
        (0.5, -0.2), (0.4, 0.3), 0.7, moments=(0.3, 0.4, 0.5), q0=(TILTED, (0.0, 0.0))
    ),
    "ball uneven in the body frame": TurntableBall.rolling(
        (0.5, -0.2), (0.4, 0.3), 0.7, moments=(0.3, 0.4, 0.5), frame="body"
    ),
    "heavy top": HeavyTop(),
    "heavy top skew": HeavyTop(1.3, (0.3, 0.5, 0.6), (0.2, -0.1, 0.4), 2.0, q0=TILTED),
    "heavy top on SE(3)": HeavyTopSE3(),
    "heavy top skew on SE(3)": HeavyTop(
        1.3, (0.3, 0.5, 0.6), (0.2, -0.1, 0.4), 2.0, q0=TILTED
    ).on_se3(),
    "Veselova": Veselova(),
    "Veselova without weight": Veselova(
        ((2.0, 0.0, 0.3), (0.0, 1.5, 0.2), (0.3, 0.2, 1.0)),
        (0.0, 0.0, 0.0),
        v0=(0.4, -0.9, 0.3),
    ),
    "double pendulum": DoublePendulum(),
    "double pendulum uneven": DoublePendulum.swinging(
        (1.0, -0.5), (0.3, 0.8), masses=(1.0, 0.4), lengths=(0.8, 1.3), gravity=2.0
    ),
}

GALLERY = SOLVED | UNSOLVED
# One example of each class, for tests in which the data do not matter.
KINDS = {type(example).__name__: example for example in reversed(GALLERY.values())}


def over(examples):
    return pytest.mark.parametrize("example", examples.values(), ids=examples.keys())


def assert_close(actual, expected, **tolerances):
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for x, y in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(x, y, **tolerances)
