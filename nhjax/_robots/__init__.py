"""Robots from files in the formats MJCF and URDF, with wheels that roll."""

from ._examples import (
    example_robot as example_robot,
    example_robot_file as example_robot_file,
)
from ._robot import from_mujoco as from_mujoco, Robot as Robot
