"""The remainder of a division that is rounded towards zero, for vectors of float64."""

import math

from ._body import Value, where
from ._intrinsics import absolute, with_sign
from ._pairs import nearest, two_product


_LARGEST_QUOTIENT = 2.0**50
_NAME = "nhjax.long_remainder"

# The remainder of |x| by |y| for finite x >= y > 0, by a long division of the mantissas
# in which each step shifts the rest by up to 11 bits.
_FUNCTION = f"""\
define internal double @{_NAME}(double %x, double %y) cold noinline nounwind {{
entry:
  %xb = bitcast double %x to i64
  %yb = bitcast double %y to i64
  %xe.raw = lshr i64 %xb, 52
  %ye.raw = lshr i64 %yb, 52
  %xm.low = and i64 %xb, 4503599627370495
  %ym.low = and i64 %yb, 4503599627370495
  %x.subnormal = icmp eq i64 %xe.raw, 0
  %y.subnormal = icmp eq i64 %ye.raw, 0
  %xm.one = or i64 %xm.low, 4503599627370496
  %ym.one = or i64 %ym.low, 4503599627370496
  %xm = select i1 %x.subnormal, i64 %xm.low, i64 %xm.one
  %ym = select i1 %y.subnormal, i64 %ym.low, i64 %ym.one
  %xe = call i64 @llvm.umax.i64(i64 %xe.raw, i64 1)
  %ye = call i64 @llvm.umax.i64(i64 %ye.raw, i64 1)
  %distance = sub i64 %xe, %ye
  %is.zero = icmp eq i64 %ym, 0
  %divisor = select i1 %is.zero, i64 1, i64 %ym
  %first = urem i64 %xm, %divisor
  br label %loop
loop:
  %left = phi i64 [ %distance, %entry ], [ %left.next, %step ]
  %rest = phi i64 [ %first, %entry ], [ %rest.next, %step ]
  %goes.on = icmp sgt i64 %left, 0
  br i1 %goes.on, label %step, label %done
step:
  %shift = call i64 @llvm.umin.i64(i64 %left, i64 11)
  %shifted = shl i64 %rest, %shift
  %rest.next = urem i64 %shifted, %divisor
  %left.next = sub i64 %left, %shift
  br label %loop
done:
  %whole = uitofp i64 %rest to double
  %upper = lshr i64 %ye, 1
  %lower = sub i64 %ye, %upper
  %upper.raw = add i64 %upper, 486
  %lower.raw = add i64 %lower, 485
  %upper.bits = shl i64 %upper.raw, 52
  %lower.bits = shl i64 %lower.raw, 52
  %upper.factor = bitcast i64 %upper.bits to double
  %lower.factor = bitcast i64 %lower.bits to double
  %half = fmul double %whole, %upper.factor
  %result = fmul double %half, %lower.factor
  ret double %result
}}
"""


def rem(x: Value, y: Value) -> Value:
    """Return x - y trunc(x / y), which is exact."""
    a, b = absolute(x), absolute(y)
    ratio = a / b
    whole, _ = nearest(ratio)
    high, low = two_product(whole, b)
    with x.body.exact():
        rest = (a - high) - low
        rest = where(rest < 0.0, rest + b, rest)
    rest = where(a < b, a, rest)
    # The exact product may be beyond the range of float64 for very large and, where
    # subnormal numbers are flushed to 0, for very small numbers.
    is_long = (ratio > _LARGEST_QUOTIENT) | (a > 2.0**1000) | (b < 2.0**-900)
    is_long = is_long & (a < math.inf) & (b > 0.0) & (a >= b)

    def otherwise() -> tuple[Value, ...]:
        x.body.needed[_NAME] = _FUNCTION
        return x.body.lane_by_lane(f"@{_NAME}", ("double",), a, b)

    (rest,) = x.body.with_rare_case(is_long, (rest,), otherwise)
    return with_sign(rest, x)
