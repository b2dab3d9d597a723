"""The gallery: mechanical systems with their references, one file each."""

from ._appell import Appell as Appell
from ._chaotic import ChaoticSystem as ChaoticSystem
from ._cvt import (
    ContinuouslyVariableTransmission as ContinuouslyVariableTransmission,
)
from ._knife_edge import KnifeEdge as KnifeEdge
from ._oscillator import HarmonicOscillator as HarmonicOscillator
from ._particle import NonholonomicParticle as NonholonomicParticle
from ._rolling_disc import VerticalRollingDisc as VerticalRollingDisc
from ._sleigh import ChaplyginSleigh as ChaplyginSleigh
