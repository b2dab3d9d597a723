"""Robots from files in the formats MJCF and URDF, with wheels that roll."""

from ._read import mujoco_of as mujoco_of
from ._robot import (
    example_robot as example_robot,
    example_robot_file as example_robot_file,
    from_mujoco as from_mujoco,
    Robot as Robot,
)
