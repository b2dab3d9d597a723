"""The torque on the steer axis of a bicycle."""

import equinox as eqx
from jaxtyping import Array

from .._custom_types import Args, FloatScalarLike
from ._base import given_forces, parameter


class SteerTorque(eqx.Module):
    """The torque of a rider on the handlebar: `args`, in N m, positive to the right.

    Without `args` there is none.

    !!! example

        >>> from nhjax.systems import SteerTorque, WhippleBicycle
        >>> bicycle = WhippleBicycle(steering=SteerTorque())
        >>> float(bicycle.force(0.0, bicycle.q0, bicycle.v0, 1.5)[5])
        1.5
    """

    def __call__(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Return the torque, which is `args`, or zero where that is None."""
        return given_forces(args, (), v.dtype, "a torque on the steer axis")


class LeanToSteer(eqx.Module):
    """A rider who steers into the fall: the torque K φ + D φ̇ of the lean angle φ.

    **Parameters:** `lean_gain` K [N m/rad] and `lean_rate_gain` D [N m s/rad]. The
    default keeps the bicycle of `WhippleBicycle` upright at 2 to 6 m/s.

    **Source:** Schwab, Kooijman and Meijaard, *Some recent developments in bicycle
    dynamics and control* (2008).

    !!! example

        >>> from nhjax.systems import LeanToSteer, WhippleBicycle
        >>> bicycle = WhippleBicycle(steering=LeanToSteer(lean_rate_gain=10.0))
        >>> y0 = bicycle.initial_state()
        >>> round(float(y0.multiplier[4]), 1)
        -302.2
    """

    lean_gain: Array = eqx.field(converter=parameter, default=0.0)
    lean_rate_gain: Array = eqx.field(converter=parameter, default=20.0)

    def __call__(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the torque K φ + D φ̇."""
        return self.lean_gain * q[3] + self.lean_rate_gain * v[3]
