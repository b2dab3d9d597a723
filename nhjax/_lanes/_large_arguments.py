"""The reduction of large arguments of sine and cosine, as Payne and Hanek do it.

A number x = m 2^e, with an integer m of 53 bits, is multiplied by 2 / pi. Of the binary
digits of 2 / pi those are left out that add multiples of 4 to the product, and of what
follows 192 are used, which is enough for the float64 nearest to a multiple of pi / 2.
"""

from ._body import Body, Value, where


# The binary digits of 2 / pi behind the point, 64 in a word, after a word of zeros.
_WORDS = """
    0000000000000000 a2f9836e4e441529 fc2757d1f534ddc0 db6295993c439041
    fe5163abdebbc561 b7246e3a424dd2e0 06492eea09d1921c fe1deb1cb129a73e
    e88235f52ebb4484 e99c7026b45f7e41 3991d639835339f4 9c845f8bbdf9283b
    1ff897ffde05980f ef2f118b5a0a6d1f 6d367ecf27cb09b7 4f463f669e5fea2d
    7527bac7ebe5f17b 3d0739f78a5292ea 6bfb5fb11f8d5d08 56033046fc7b6bab
""".split()  # noqa: SIM905
_TABLE = "nhjax.two_over_pi"
# pi / 2 in units of 2^-63.
_HALF_PI = 14488038916154245684
_LOWEST_BITS = (1 << 11) - 1
NAME = "nhjax.reduced_large"


def _window(exponent: Value) -> list[Value]:
    """Load the 192 digits of 2 / pi that matter, for x with this biased exponent."""
    body = exponent.body
    # With e = exponent - 1075, those of weight 2^(e - i) >= 4 are left out.
    skipped = where(exponent < 1013, 0, exponent - 1013)
    word, shift = skipped >> 6, skipped & 63
    words = []
    for k in range(4):
        index = (word + k).name
        array = f"[{len(_WORDS)} x i64]"
        address = body.value(
            "ptr", f"getelementptr {array}, ptr @{_TABLE}, i64 0, i64 {index}"
        )
        words.append(body.value("i64", f"load i64, ptr {address.name}"))
    return [
        body.call("@llvm.fshl.i64", ("i64",), words[k], words[k + 1], shift)[0]
        for k in range(3)
    ]


def _function() -> str:
    """Return the definition of a function of x that returns n and r as a pair.

    They are as for small arguments: x is n pi / 2 + r up to multiples of 2 pi.
    """
    body = Body(1)
    bits = Value(body, "double", "%x").bits()
    mantissa = (bits & ((1 << 52) - 1)) | (1 << 52)
    digits = _window((bits >> 52) & 0x7FF)
    long = mantissa.cast("zext", "i128")
    # The product modulo 4, in units of 2^-126.
    total = (mantissa * digits[0]).cast("zext", "i128") << 64
    total = total + long * digits[1].cast("zext", "i128")
    total = total + ((long * digits[2].cast("zext", "i128")) >> 64)
    n = (total + (1 << 125)) >> 126
    rest = total - (n << 126)
    is_negative = rest < 0
    size = where(is_negative, -rest, rest)
    text = f"call i128 @llvm.ctlz.i128(i128 {size.name}, i1 false)"
    zeros = body.value("i128", text).cast("trunc", "i64")
    # The first 64 bits of the fraction, times pi / 2, in units of 2^-(125 + zeros).
    leading = (size << zeros.cast("zext", "i128")) >> 64
    angle = leading * _HALF_PI
    upper, lower = (angle >> 64).cast("trunc", "i64"), angle.cast("trunc", "i64")
    scale = ((1023 - 125 + 64 - zeros) << 52).number()
    high = (upper & ~_LOWEST_BITS).cast("uitofp", "double") * scale
    low = ((upper & _LOWEST_BITS) << 53) | (lower >> 11)
    low = low.cast("uitofp", "double") * 2.0**-53 * scale
    # Both signs count: that of r where |n| pi / 2 is more, and that of x.
    is_left = bits < 0
    sign = where(is_negative, -(2**63), 0) ^ (bits & -(2**63))
    quadrant = n.cast("trunc", "i64")
    body.result(
        where(is_left, -quadrant, quadrant),
        (high.bits() ^ sign).number(),
        (low.bits() ^ sign).number(),
    )
    words = ", ".join(f"i64 u0x{word}" for word in _WORDS)
    table = f"@{_TABLE} = private constant [{len(_WORDS)} x i64] [{words}]\n"
    head = (
        f"define internal {{ i64, double, double }} @{NAME}(double %x) "
        "cold noinline nounwind willreturn memory(none)"
    )
    return table + body.text(head)


FUNCTION = _function()
