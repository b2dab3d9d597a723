"""The error function, for vectors of float64."""

from ._body import Value, where
from ._coefficients import ERF, ERFC
from ._exponentials import exp
from ._intrinsics import absolute, with_sign
from ._pairs import polynomial


# The polynomial for large arguments is one in 1 / (x + 2) less this.
_CENTRE = 0.229
_TWO_OVER_ROOT_PI = 1.1283791670955126
_ITS_REST = 1.533545961316588e-17


def erf(x: Value) -> Value:
    """Return the error function of x."""
    size = absolute(x)
    z = size * size
    near = size * _TWO_OVER_ROOT_PI + size * (polynomial(z, ERF) + _ITS_REST)
    # It is 1 to the last digit from 6 on.
    size = where(size > 6.0, 6.0, size)
    beyond = polynomial(1.0 / (size + 2.0) - _CENTRE, ERFC) * exp(-(size * size))
    return with_sign(where(z < 1.0, near, 1.0 - beyond), x)
