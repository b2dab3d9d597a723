"""Errors of elementary functions against mpmath, in units of the last place.

`PYTHONPATH=.:tests python -m support.ulps 100000` prints the largest error of each
function over that many arguments, and where it is.
"""

import sys
from collections.abc import Callable
from typing import Any

import mpmath
import numpy as np
from mpmath import mp, mpf

from nhjax.lanes._elementary_functions import definitions, SUPPORTED
from nhjax.lanes._writer import symbol
from support.native_lanes import Native


# Numbers of mpmath; before mpmath 1.4 their class is an attribute of a context.
Real = Any


BINARY = ("atan2", "pow", "rem")
# With so many bits, cancellation in the formulas below does not matter.
BITS = 300

_REFERENCES: dict[str, Callable[..., Real]] = {
    "cbrt": lambda x: mpmath.sign(x) * mpmath.cbrt(abs(x)),
    "exp2": lambda x: mpf(2) ** x,
    "logistic": lambda x: 1 / (1 + mpmath.exp(-x)),
    "pow": mpmath.power,
    "rem": lambda x, y: mpmath.sign(x) * mpmath.fmod(abs(x), abs(y)),
}


def reference(op: str, *arguments: float) -> Real:
    """Return the value of a function, to many digits."""
    function = _REFERENCES.get(op) or getattr(mpmath, op)
    # Products of powers of 2 may be of any size in mpmath.
    return function(*map(mpf, arguments))


def error(got: float, exact: Real, dtype: type) -> float:
    """Return the error of a result in units of the last place of the exact one."""
    limits = np.finfo(dtype)
    largest, digits = mpf(float(limits.max)), limits.nmant
    lowest = int(limits.minexp) - digits
    _, exponent = mpmath.frexp(exact)
    unit = mpf(2) ** max(int(exponent) - 1 - digits, lowest)
    if abs(exact) >= largest + unit / 2 and np.isinf(got):
        return 0.0 if (got > 0) == (exact > 0) else np.inf
    if not np.isfinite(got):
        return np.inf
    return float(abs(mpf(float(got)) - exact) / unit)


def _everywhere(rng: np.random.Generator, count: int, dtype: type) -> np.ndarray:
    """Draw numbers of all exponents, subnormal ones included, and of both signs."""
    integers = np.uint64 if dtype is np.float64 else np.uint32
    bits = rng.integers(0, np.iinfo(integers).max, count, integers)
    numbers = bits.view(dtype)
    return np.where(np.isfinite(numbers), numbers, dtype(0.75))


def _powers(rng: np.random.Generator, count: int, low: float, high: float):
    """Draw numbers of both signs with uniformly distributed logarithms to base 2."""
    return rng.choice([-1.0, 1.0], count) * 2.0 ** rng.uniform(low, high, count)


def _near_multiples(rng: np.random.Generator, count: int, dtype: type) -> np.ndarray:
    """Draw numbers next to multiples of pi / 2, small ones and very large ones."""
    highest = 1020 if dtype is np.float64 else 125
    with mp.workprec(1300):
        exponents = rng.uniform(0, rng.choice([8, 16, 24, highest], count))
        multiples = [mpmath.nint(mpf(2) ** mpf(x)) * mp.pi / 2 for x in exponents]
        nearest = np.array([float(x) for x in multiples]).astype(dtype)
    sign = rng.choice([-1, 1], count).astype(dtype)
    return sign * (
        nearest + rng.integers(-1, 2, count).astype(dtype) * np.spacing(nearest)
    )


def _of_one(op: str, rng: np.random.Generator, count: int, dtype: type) -> np.ndarray:
    """Draw arguments of a function of one argument, from several regions."""
    quarter = count // 4
    tiny = -1074.0 if dtype is np.float64 else -149.0
    huge = 1023.0 if dtype is np.float64 else 127.0
    everywhere = _everywhere(rng, quarter, dtype).astype(np.float64)
    near_zero = _powers(rng, quarter, -30, 3)
    rest = count - 2 * quarter
    if op in ("sin", "cos", "tan"):
        special = _near_multiples(rng, quarter, dtype).astype(np.float64)
        special = np.append(special, rng.uniform(-1e5, 1e5, rest - quarter))
    elif op in ("log", "log1p", "acosh"):
        special = (op != "log1p") + _powers(rng, rest, -60, 1)
    elif op in ("asin", "acos", "atanh"):
        everywhere = _powers(rng, quarter, tiny, 0)
        near_zero = rng.uniform(-1, 1, quarter)
        special = rng.choice([-1, 1], rest) * (1 - abs(_powers(rng, rest, -60, -1)))
    elif op in ("erf", "atan", "cbrt", "asinh", "tanh", "logistic"):
        special = rng.uniform(-8, 8, rest)
        if op == "logistic":
            special *= np.where(rng.random(rest) < 0.5, 1, tiny / 11)
    else:
        scale = 1 if op == "exp2" else np.log(2)
        special = rng.uniform(tiny - 2, huge + 2, rest) * scale
        if op in ("sinh", "cosh"):
            special[::2] = rng.uniform(-3, 3, len(special[::2]))
    x = np.concatenate([everywhere, near_zero, special]).astype(dtype)
    x = np.abs(x) if op in ("log", "acosh") else x
    if op == "acosh":
        x = np.where(x < 1, 1 / np.maximum(x, 1 / np.finfo(dtype).max), x)
    x = np.where(x <= -1, -x, x) if op == "log1p" else x
    x = np.where(np.abs(x) >= 1, dtype(0.5), x) if op == "atanh" else x
    return np.where(np.isfinite(x), x, dtype(1.5)).astype(dtype)


def _of_two(op: str, rng: np.random.Generator, count: int, dtype: type):
    """Draw arguments of a function of two arguments, from several regions."""
    x, y = _everywhere(rng, count, dtype), _everywhere(rng, count, dtype)
    a, b = _powers(rng, count, -20, 20), _powers(rng, count, -20, 20)
    if op == "pow":
        # Products y log(x) over the whole range, some with x next to 1.
        a = np.abs(a)
        a[::3] = 1 + _powers(rng, len(a[::3]), -52, -2)
        a[a == 1] = 1.5
        a = a.astype(dtype).astype(np.float64)
        a[a == 1] = 1.5
        limit = 745 if dtype is np.float64 else 104
        b = rng.uniform(-limit, limit, count) / np.log(a)
        whole = rng.random(count) < 0.2
        b = np.where(whole, np.round(b), b)
        a = np.where(whole, rng.choice([-1, 1], count) * a, a)
        x = np.abs(x)
    elif op == "rem":
        b = a / rng.integers(1, 1000, count)
        b = np.where(rng.random(count) < 0.5, b, a * rng.uniform(0.3, 1.2, count))
    is_anywhere = rng.random(count) < 0.5
    first = np.where(is_anywhere, x, a.astype(dtype))
    second = np.where(is_anywhere, y, b.astype(dtype))
    fine = np.isfinite(first) & np.isfinite(second) & (first != 0) & (second != 0)
    return np.where(fine, first, dtype(1.5)), np.where(fine, second, dtype(2.5))


def arguments(op: str, seed: int, count: int, dtype: type) -> list[np.ndarray]:
    """Draw arguments from all of a function's domain but zeros and infinities.

    They are mixed, so that usual and unusual ones share vectors.
    """
    rng = np.random.default_rng(seed)
    with np.errstate(all="ignore"):
        if op in BINARY:
            return list(_of_two(op, rng, count, dtype))
        return [rng.permutation(_of_one(op, rng, count, dtype))]


def exact_values(op: str, given: list[np.ndarray]) -> list[Real]:
    """Return the values of a function to many digits."""
    with mp.workprec(2400 if op == "rem" else BITS):
        return [reference(op, *map(float, x)) for x in zip(*given, strict=True)]


def errors(got: np.ndarray, exact: list[Real]) -> np.ndarray:
    """Return the errors of results in units of the last place."""
    dtype = got.dtype.type
    with mp.workprec(BITS):
        pairs = zip(got, exact, strict=True)
        return np.array([error(x, value, dtype) for x, value in pairs])


def main(count: int, ops: list[str]) -> None:
    """Print the largest error of each function, and the arguments that have it."""
    for dtype in (np.float64, np.float32):
        name = np.dtype(dtype).name
        native = Native(
            definitions([(op, name, 8) for op in ops]),
            [symbol(op, name, 8) for op in ops],
        )
        for op in ops:
            given = arguments(op, 1, count, dtype)
            found = errors(native(symbol(op, name, 8), *given), exact_values(op, given))
            where = int(np.argmax(found))
            point = ", ".join(repr(float(x[where])) for x in given)
            print(f"{op:9}{name:9}{found[where]:7.3f} at {point}", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2:] or sorted(SUPPORTED))
