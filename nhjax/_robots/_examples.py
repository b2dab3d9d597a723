"""Robots that come with nhjax, as model files."""

import math
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from .._errors import check_choice
from ..rolling import Plane
from ._robot import from_mujoco, Robot


_FOLDER = Path(__file__).parent / "models"

_LEFT_ROLLERS, _RIGHT_ROLLERS = -math.pi / 4, math.pi / 4
# The front wheel on the right of the car slips sideways, because a trapezoid does not
# turn both wheels exactly about one centre. A wheel opposite to another one of the
# quadruped would repeat its constraint when all wheels are parallel.
_OPTIONS: Mapping[str, tuple[str, dict[str, Any]]] = MappingProxyType(
    {
        "ackermann_car": (
            "ackermann_car.xml",
            {
                "rolling": {
                    "rear_left_tread": "no slip",
                    "rear_right_tread": "no longitudinal slip",
                    "front_left_tread": "no slip",
                    "front_right_tread": "no longitudinal slip",
                }
            },
        ),
        "balancing_robot": (
            "balancing_robot.xml",
            {"rolling": ("left_tread", "right_tread")},
        ),
        "differential_drive": (
            "differential_drive.urdf",
            {
                "rolling": ("left_tread", "right_tread", "caster_tread"),
                "root": "planar",
                "ground": -0.1,
                "ignore": ("contacts",),
            },
        ),
        "mecanum_platform": (
            "mecanum_platform.xml",
            {
                "rolling": {
                    "front_left_tread": _LEFT_ROLLERS,
                    "front_right_tread": _RIGHT_ROLLERS,
                    "rear_left_tread": _RIGHT_ROLLERS,
                    "rear_right_tread": _LEFT_ROLLERS,
                }
            },
        ),
        "wheeled_quadruped": (
            "wheeled_quadruped.xml",
            {
                "rolling": {
                    "front_left_tread": "no slip",
                    "front_right_tread": "no longitudinal slip",
                    "rear_left_tread": "no slip",
                    "rear_right_tread": "no longitudinal slip",
                }
            },
        ),
    }
)


def example_robot_file(name: str) -> Path:
    """Return the path of the model file of a robot that comes with nhjax.

    **Arguments:**

    - `name`: as for `example_robot`.

    **Raises:** `ValueError` if there is no such robot.

    !!! example

        >>> import nhjax
        >>> nhjax.example_robot_file("mecanum_platform").name
        'mecanum_platform.xml'
    """
    check_choice("example_robot: `name`", name, tuple(_OPTIONS))
    return _FOLDER / _OPTIONS[name][0]


def example_robot(name: str, **options: Any) -> Robot:
    """Read a robot that comes with nhjax.

    | name | the robot | velocities |
    | --- | --- | --- |
    | `"ackermann_car"` | a car, whose steering has a tie rod that closes a loop | 10 |
    | `"balancing_robot"` | a body on two wheels that falls without control | 6 |
    | `"differential_drive"` | two driven wheels and a caster; a URDF file | 7 |
    | `"mecanum_platform"` | a platform on four mecanum wheels | 7 |
    | `"wheeled_quadruped"` | four legs with springs and a wheel each | 20 |

    **Arguments:**

    - `name`: the name of the robot.
    - `options`: options of `from_mujoco`, such as `parameters` and `controls`. They
        replace the options that belong to the robot, such as `rolling`.

    **Returns:** a `Robot`.

    **Raises:** `ValueError` if there is no such robot; otherwise as `from_mujoco`.

    !!! example

        >>> import nhjax
        >>> robot = nhjax.example_robot("balancing_robot")
        >>> robot.coordinates
        ('x', 'y', 'heading', 'pitch', 'left', 'right')
    """
    path = example_robot_file(name)
    own: dict[str, Any] = dict(_OPTIONS[name][1])
    if "ground" in own:
        # The plane has the precision of this call.
        own["ground"] = Plane(height=own["ground"])
    own |= options
    return from_mujoco(path, **own)
