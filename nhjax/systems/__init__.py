"""The gallery: mechanical systems with their references."""

from ._andrews_squeezer import AndrewsSqueezer as AndrewsSqueezer
from ._appell import Appell as Appell
from ._ball_in_bowl import BallInBowl as BallInBowl
from ._car_axis import CarAxis as CarAxis
from ._car_with_trailers import CarWithTrailers as CarWithTrailers
from ._chaotic import ChaoticSystem as ChaoticSystem
from ._chaplygin_sphere import ChaplyginSphere as ChaplyginSphere
from ._chaplygin_top import ChaplyginTop as ChaplyginTop
from ._cvt import ContinuouslyVariableTransmission as ContinuouslyVariableTransmission
from ._double_pendulum import DoublePendulum as DoublePendulum
from ._flyball_governor import FlyballGovernor as FlyballGovernor
from ._four_bar import FourBar as FourBar
from ._heavy_top import HeavyTop as HeavyTop, HeavyTopSE3 as HeavyTopSE3
from ._knife_edge import KnifeEdge as KnifeEdge
from ._oscillator import HarmonicOscillator as HarmonicOscillator
from ._particle import NonholonomicParticle as NonholonomicParticle
from ._pendulum_chain import PendulumChain as PendulumChain
from ._rattleback import Rattleback as Rattleback
from ._rigid_body import FreeRigidBody as FreeRigidBody
from ._rod_sleigh import RodSleigh as RodSleigh
from ._roller_racer import RollerRacer as RollerRacer
from ._rolling_disc import VerticalRollingDisc as VerticalRollingDisc
from ._rolling_disc_on_group import RollingDisc as RollingDisc
from ._rolling_torus import RollingTorus as RollingTorus
from ._sleigh import ChaplyginSleigh as ChaplyginSleigh
from ._slider_crank import SliderCrank as SliderCrank
from ._snakeboard import Snakeboard as Snakeboard
from ._spatial_slider_crank import SpatialSliderCrank as SpatialSliderCrank
from ._spherical_pendulum import SphericalPendulum as SphericalPendulum
from ._suslov import Suslov as Suslov
from ._turntable_ball import TurntableBall as TurntableBall
from ._two_wheeled_robot import TwoWheeledRobot as TwoWheeledRobot
from ._unicycle import (
    Unicycle as Unicycle,
    UnicycleInCoordinates as UnicycleInCoordinates,
)
from ._veselova import Veselova as Veselova
from ._whipple_bicycle import (
    LeanToSteer as LeanToSteer,
    SteerTorque as SteerTorque,
    WhippleBicycle as WhippleBicycle,
)
