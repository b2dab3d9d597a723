"""The paper's experiments as functions; `nhjax run` is their command line."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

from ._arguments import ArgumentError as ArgumentError
from ._ball_invariants import (
    ball_invariants as ball_invariants,
    BallInvariants as BallInvariants,
)
from ._chaotic_energy import (
    chaotic_energy as chaotic_energy,
    ChaoticEnergy as ChaoticEnergy,
)
from ._cvt_energy import cvt_energy as cvt_energy, CVTEnergy as CVTEnergy
from ._envelope import envelope as envelope
from ._particle_order import (
    particle_order as particle_order,
    ParticleOrder as ParticleOrder,
)
from ._plan import plan as plan, QUICK as QUICK, shown as shown
from ._result import AbstractStudyResult as AbstractStudyResult, write as write
from ._style import colour_blind_safe as colour_blind_safe
from ._unicycle_order import (
    unicycle_order as unicycle_order,
    UnicycleOrder as UnicycleOrder,
)


# What `nhjax list` shows. The keyword arguments of a study are its options.
STUDIES: Mapping[str, Callable[..., AbstractStudyResult]] = MappingProxyType(
    {
        "particle-order": particle_order,
        "cvt-energy": cvt_energy,
        "chaotic-energy": chaotic_energy,
        "unicycle-order": unicycle_order,
        "ball-invariants": ball_invariants,
    }
)
