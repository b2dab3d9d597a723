"""The paper's experiments as functions; `nhjax run` is their command line."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

from ._arguments import (
    ArgumentError as ArgumentError,
    plan as plan,
    QUICK as QUICK,
    shown as shown,
)
from ._ball_invariants import (
    ball_invariants as ball_invariants,
    BallInvariants as BallInvariants,
)
from ._chaotic_energy import (
    chaotic_energy as chaotic_energy,
    ChaoticEnergy as ChaoticEnergy,
)
from ._cvt_energy import cvt_energy as cvt_energy, CVTEnergy as CVTEnergy
from ._order_study import (
    particle_order as particle_order,
    ParticleOrder as ParticleOrder,
    unicycle_order as unicycle_order,
    UnicycleOrder as UnicycleOrder,
)
from ._result import (
    AbstractStudyResult as AbstractStudyResult,
    colour_blind_safe as colour_blind_safe,
    envelope as envelope,
    write as write,
)


# The studies that `nhjax list` shows. The keyword arguments of a study are the options
# of its command.
STUDIES: Mapping[str, Callable[..., AbstractStudyResult]] = MappingProxyType(
    {
        "particle-order": particle_order,
        "cvt-energy": cvt_energy,
        "chaotic-energy": chaotic_energy,
        "unicycle-order": unicycle_order,
        "ball-invariants": ball_invariants,
    }
)
