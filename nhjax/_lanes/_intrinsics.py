"""The functions of vectors of float64 that are instructions of every processor."""

from ._body import Value


def absolute(x: Value) -> Value:
    """Return |x|."""
    return _intrinsic("fabs", x)


def with_sign(x: Value, sign: Value) -> Value:
    """Return |x| with the sign of another value, also of zeros."""
    return _intrinsic("copysign", x, sign)


def square_root(x: Value) -> Value:
    """Return the square root of x, rounded correctly."""
    return _intrinsic("sqrt", x)


def _intrinsic(name: str, *arguments: Value) -> Value:
    body = arguments[0].body
    lanes = "" if body.width == 1 else f"v{body.width}"
    return body.call(f"@llvm.{name}.{lanes}f64", ("double",), *arguments)[0]
