"""Analysis at one state: accelerations, reactions, steady motions and stability."""

from ._check_system import check_system as check_system, SystemReport as SystemReport
from ._linear_stability import (
    linear_stability as linear_stability,
    LinearStability as LinearStability,
)
from ._motion import Motion as Motion, motion as motion
from ._steady_motion import steady_motion as steady_motion
