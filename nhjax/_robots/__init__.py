"""Robots from files in the formats MJCF and URDF, with wheels that roll."""

from ._read import mujoco_of as mujoco_of
from ._robot import from_mujoco as from_mujoco, Robot as Robot
