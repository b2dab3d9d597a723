"""Every primitive that may occur in a kernel, in lanes against JAX.

The data have NaN, infinities, both zeros, and the extremes of integers.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from nhjax._compile import started_like, write_row
from nhjax._numerics import inverse, kept_function, small_einsum
from nhjax.lanes import _jaxprs, _program, Unsupported
from support import lanes_run
from support.random_steps import Kind, numbers


MEMBERS = 11


def _of(dtype, shape=(3,)):
    return Kind(dtype, shape)


def _unary(function, dtypes=("float64", "float32")):
    return [(function, [_of(dtype)]) for dtype in dtypes]


def _binary(function, dtypes):
    return [(function, [_of(dtype)] * 2) for dtype in dtypes]


FLOATS = ("float64", "float32")
INTEGERS = ("int64", "int32", "int8", "uint8", "uint32", "uint64")
NUMBERS = (*FLOATS, *INTEGERS)
BITS = (*INTEGERS, "bool")
MATRIX = ("float64", (2, 3))


def _like_zeros(x):
    (out,) = jax.jvp(lambda x: (x, lax.stop_gradient(x)), (x,), (x,))[1][1:]
    return out


def _reduced(name, dtypes):
    return [
        (lambda x: getattr(lax, name)(x, axes=(0,)), [Kind(dtype, (2, 3))])
        for dtype in dtypes
    ]


def _kernel(x):
    # A program that is compiled into one kernel within another one.
    from nhjax._compile import as_cpu_kernel

    return as_cpu_kernel(lambda x: x * 2, x)


def _kept(x):
    function = kept_function(lambda x: x * 2, x)
    assert function is not None
    return function(x)


def _custom_jvp(x):
    return jax.nn.relu(x)


@jax.custom_vjp
def _doubled(x):
    return x * 2


_doubled.defvjp(lambda x: (x * 2, None), lambda _, t: (t * 2,))


def _solved(x):
    return lax.custom_linear_solve(lambda y: y * 4, x, lambda _, b: b / 4)


def _root(x):
    """Solve y + tanh y = x; since JAX 0.12 this is expanded when it is compiled."""

    def residual(y):
        return y + jnp.tanh(y) - x

    def newton(residual, y):
        for _ in range(3):
            value, slope = jax.jvp(residual, (y,), (jnp.ones_like(y),))
            y = y - value / slope
        return y

    return lax.custom_root(
        residual, x, newton, lambda linear, b: b / linear(jnp.ones_like(b))
    )


_polynomial = getattr(lax, "polynomial", lambda x, c: (x * c[2] + c[1]) * x + c[0])

# Functions with these names in `lax`, their numbers of operands, and their dtypes.
_SIMPLE = {
    **dict.fromkeys(("add", "sub", "mul", "div", "max", "min", "rem"), (2, NUMBERS)),
    **dict.fromkeys(("eq", "ne", "lt", "le", "gt", "ge"), (2, (*NUMBERS, "bool"))),
    **dict.fromkeys(("abs", "neg", "sign"), (1, (*FLOATS, "int64", "int8"))),
    **dict.fromkeys(("atan2", "pow"), (2, FLOATS)),
    **dict.fromkeys(
        (
            "acos", "acosh", "asin", "asinh", "atan", "atanh", "cbrt", "ceil", "cos",
            "cosh", "erf", "exp", "exp2", "expm1", "floor", "is_finite", "log",
            "log1p", "logistic", "rsqrt", "sin", "sinh", "sqrt", "tan", "tanh",
        ),
        (1, FLOATS),
    ),
}  # fmt: skip
_CASES = {
    **{
        name: [(getattr(lax, name), [_of(dtype)] * count) for dtype in dtypes]
        for name, (count, dtypes) in _SIMPLE.items()
    },
    "and": _binary(lax.bitwise_and, BITS),
    "or": _binary(lax.bitwise_or, BITS),
    "xor": _binary(lax.bitwise_xor, BITS),
    "not": _unary(lax.bitwise_not, BITS),
    "nextafter": _binary(lax.nextafter, FLOATS),
    "square": _unary(lax.square, NUMBERS),
    # Operations since JAX 0.12; before, these functions consisted of others.
    "log2": _unary(jnp.log2, FLOATS),
    "one_minus_square": _unary(
        getattr(lax, "one_minus_square", lambda x: (1 + x) * (1 - x)), FLOATS
    ),
    "polynomial": _unary(lambda x: _polynomial(x, [-1.0, 0.5, 2.0]), FLOATS),
    "integer_pow": [
        *_unary(lambda x: lax.integer_pow(x, 5), NUMBERS),
        *_unary(lambda x: lax.integer_pow(x, -3)),
    ],
    "round": [
        *_unary(lambda x: lax.round(x, lax.RoundingMethod.TO_NEAREST_EVEN)),
        *_unary(lambda x: lax.round(x, lax.RoundingMethod.AWAY_FROM_ZERO)),
    ],
    "convert_element_type": [
        (lambda x, new=new: lax.convert_element_type(x, new), [_of(old)])
        for old in (*NUMBERS, "bool")
        for new in (*NUMBERS, "bool")
    ],
    "bitcast_convert_type": [
        (lambda x: lax.bitcast_convert_type(x, jnp.int64), [_of("float64")]),
        (lambda x: lax.bitcast_convert_type(x, jnp.uint32), [_of("float32")]),
        (lambda x: lax.bitcast_convert_type(x, jnp.float64), [_of("int64")]),
    ],
    "clamp": [(lax.clamp, [_of(dtype)] * 3) for dtype in NUMBERS],
    "select_n": [
        (lax.select_n, [_of("bool"), _of("float64"), _of("float64")]),
        (
            lambda x, y: lax.select_n(jnp.asarray([0, 2, 1], jnp.int32), x, y, -x),
            [_of("float64")] * 2,
        ),
    ],
    "stop_gradient": _unary(lambda x: jax.grad(lambda y: lax.stop_gradient(y) @ y)(x)),
    "zeros_like": _unary(_like_zeros),
    "add_any": _unary(lambda x: jax.grad(lambda y: (y * y) @ (y + 1))(x)),
    "copy": _unary(jnp.copy),
    "copy_p": _unary(jnp.array),
    **{
        name: [
            (lambda x, f=f: f(x, 0, jnp.int32), [Kind(dtype, (2, 3))])
            for dtype in NUMBERS
        ]
        for name, f in (("argmax", lax.argmax), ("argmin", lax.argmin))
    },
    "reduce_and": _reduced("reduce_and", ("bool", "int32")),
    "reduce_or": _reduced("reduce_or", ("bool", "int32")),
    "reduce_max": _reduced("reduce_max", NUMBERS),
    "reduce_min": _reduced("reduce_min", NUMBERS),
    "reduce_prod": _reduced("reduce_prod", NUMBERS),
    "reduce_sum": _reduced("reduce_sum", NUMBERS),
    "concatenate": [(lambda x, y: jnp.concatenate([x, y, x]), [_of("float64")] * 2)],
    "expand_dims": _unary(lambda x: x[:, None]),
    "pad": [
        (
            lambda x: lax.pad(x, x[0, 0], [(2, -1, 1), (-1, 1, 2)]),
            [Kind(*MATRIX)],
        )
    ],
    "rev": _unary(lambda x: x[::-1]),
    "slice": _unary(lambda x: x[::2]),
    # A sum, an index that stays in both operands, and an empty result.
    "loop_start": [
        (lambda x: started_like((x * 0.0, 2.0 * x), (x, x + 1)), [_of("float64")])
    ],
    "small_inverse": [
        (
            lambda x: inverse(
                jnp.eye(9) + jnp.sin(x[0] + jnp.arange(81.0)).reshape(9, 9) / 9
            ),
            [_of("float64")],
        )
    ],
    "small_product": [
        # The loop over the first index of the result reads columns of an array that is
        # in memory.
        (
            lambda x: small_einsum("ca,cb->ab", jnp.exp(jnp.sin(x)), jnp.tanh(x) ** 2),
            [Kind("float64", (13, 12))],
        ),
        (partial(small_einsum, "ab,cb->ca"), [Kind("float32", (2, 3))] * 2),
        (partial(small_einsum, "ia,ib->bai"), [Kind(*MATRIX)] * 2),
        (
            lambda x, y: small_einsum("ab,b->a", x[:0], y),
            [Kind(*MATRIX), _of("float64")],
        ),
    ],
    "split": [(lambda x: lax.split(x, (1, 2), 1), [Kind(*MATRIX)])],
    "squeeze": [(lambda x: lax.squeeze(x[:1], (0,)), [Kind(*MATRIX)])],
    "stack": [(lambda x, y: jnp.stack([x, y], 1), [_of("float64")] * 2)],
    "unstack": [(lambda x: list(x), [Kind(*MATRIX)])],
    "transpose": [(jnp.transpose, [Kind(*MATRIX)])],
    "broadcast_in_dim": _unary(lambda x: jnp.broadcast_to(x[:, None], (3, 70))),
    "dynamic_slice": [
        (
            lambda x, i: lax.dynamic_slice(x, (i, i), (1, 2)),
            [Kind(*MATRIX), _of("int64", ())],
        )
    ],
    "dynamic_update_slice": [
        (
            lambda x, y, i: lax.dynamic_update_slice(x, y[None], (i, i)),
            [Kind(*MATRIX), _of("float64"), _of("int32", ())],
        )
    ],
    "write_row": [
        (
            lambda x, row, i: write_row(x, row, jnp.abs(i) % 2),
            [Kind(*MATRIX), _of("float64"), _of("int32", ())],
        ),
        # In a batch, the axis of the rows is the second one.
        (
            lambda x, rows, i: jax.vmap(write_row, (None, 0, None))(
                x, rows, jnp.abs(i) % 2
            ),
            [Kind(*MATRIX), _of("float64", (2, 3)), _of("int32", ())],
        ),
    ],
    "empty": _unary(lambda x: lax.full_like(x, 2)),
    "empty2": _unary(lambda x: lax.full_like(x, 2)),
    "iota": _unary(lambda x: x + jnp.arange(3, dtype=x.dtype)),
    "reshape": [(lambda x: x.reshape(3, 2), [Kind(*MATRIX)])],
    "checkpoint": _unary(jax.checkpoint(lambda x: x * 2)),
    "remat2": _unary(jax.checkpoint(lambda x: x * 2)),
    "closed_call": _unary(lambda x: jax.jvp(jax.checkpoint(jnp.square), (x,), (x,))),
    "custom_jvp_call": _unary(_custom_jvp),
    "custom_vjp_call": _unary(_doubled),
    "jit": _unary(jax.jit(lambda x: x * 2)),
    "kept_call": _unary(_kept),
    "cond": [
        (
            lambda p, x: lax.cond(p, lambda: x * 2, lambda: x[::-1]),
            [_of("bool", ()), _of("float64")],
        ),
        (
            lambda i, x: lax.switch(i, [lambda: x, lambda: x * 2, lambda: -x]),
            [_of("int32", ()), _of("float64")],
        ),
    ],
    "custom_linear_solve": _unary(_solved),
    "custom_root": _unary(_root),
    "cpu_kernel": _unary(_kernel),
    "batched_call": _unary(
        lambda x: jax.vmap(_kernel)(jnp.outer(x, jnp.arange(1.0, 4.0, dtype=x.dtype)))
    ),
    "scan": [
        (
            lambda x: lax.scan(lambda c, y: (c + y, c * y), x, jnp.outer(x, x)),
            [_of("float64")],
        ),
        (
            lambda x, n=20: lax.scan(
                lambda c, y: (c * 0.5 + y, c), x[0], jnp.tile(x, n), reverse=True
            ),
            [_of("float32")],
        ),
    ],
    "while": [
        (
            lambda i, x: lax.while_loop(
                lambda s: s[0] < lax.rem(i, jnp.int8(9)),
                lambda s: (s[0] + jnp.int8(1), s[1] * 0.5),
                (jnp.int8(0), x),
            ),
            [_of("int8", ()), _of("float64")],
        )
    ],
}
# Primitives without correct rounding; XLA is the least accurate.
_INEXACT = """
    acos acosh asin asinh atan atan2 atanh cbrt cos cosh custom_root erf exp exp2 expm1
    log log1p log2 logistic one_minus_square polynomial pow rsqrt sin sinh tan tanh
    reduce_sum reduce_prod add_any scan stop_gradient small_product small_inverse
""".split()  # noqa: SIM905


def test_lanes_primitives_in_kernels_all_have_cases():
    names = [
        *_jaxprs.ELEMENTWISE,
        *_jaxprs._REDUCING,
        *_jaxprs._SHAPING,
        *_jaxprs._MOVING,
        *_jaxprs._CONTAINING,
        _jaxprs.SMALL_PRODUCT,
    ]
    assert set(names) <= set(_CASES)


@pytest.mark.parametrize("name", sorted(_CASES))
def test_primitive_in_lanes_equals_jax(name):
    for number, (function, kinds) in enumerate(_CASES[name]):
        operands = [numbers(kind, MEMBERS, number + i) for i, kind in enumerate(kinds)]
        expected = jax.tree.leaves(jax.jit(jax.vmap(function))(*operands))
        for width in (1, 8):
            got = lanes_run.run_batched(function, width, *operands, contract=False)
            for one, other in zip(jax.tree.leaves(got), expected, strict=True):
                message = f"{name}, case {number}, {width} lanes"
                _assert_close(one, np.asarray(other), name in _INEXACT, message)


def _assert_close(got, expected, is_inexact, message):
    assert got.dtype == expected.dtype
    rtol = atol = 0.0
    if is_inexact and got.dtype.kind == "f":
        limits = np.finfo(got.dtype)
        # XLA's cube root is off by 60 ulp, and its arcsine of tiny numbers is zero.
        rtol, atol = 100 * limits.eps, 2 * limits.smallest_normal
    np.testing.assert_allclose(got, expected, rtol=rtol, atol=atol, err_msg=message)
    if got.dtype.kind == "f" and not is_inexact:
        signs = (np.signbit(x) & ~np.isnan(x) for x in (got, expected))
        np.testing.assert_array_equal(*signs, err_msg=message)


@pytest.mark.parametrize(
    ("function", "reason"),
    [
        (lambda x: jnp.linalg.solve(jnp.eye(33) * x[0], jnp.tile(x, 11)), "lu"),
        (lambda x: lax.sort(jnp.tile(x, 11)), "sort"),
        (lambda x: x.astype(jnp.float16), "float16"),
        (lambda x: x.astype(complex), "complex128"),
        (lambda x: jnp.tile(x, 9000) * jnp.arange(27000.0), "one by one"),
    ],
)
def test_lanes_unsupported_program_raises_with_reason(function, reason):
    with pytest.raises(Unsupported, match=reason):
        lanes_run.run_batched(function, 4, np.ones((2, 3)))


def test_lanes_program_with_too_many_nodes_raises(monkeypatch):
    monkeypatch.setattr(_program, "MOST_NODES", 100)
    lanes_run.run_batched(lambda x: jnp.sin(x), 4, np.ones((2, 10)))
    with pytest.raises(Unsupported, match="more than 120 operations"):
        lanes_run.run_batched(lambda x: jnp.outer(x, x), 4, np.ones((2, 20)))


def test_lanes_primitive_with_unknown_parameters_is_named():
    program = jax.make_jaxpr(lambda x: lax.rev(x, (0,)))(np.zeros(3))
    (equation,) = program.eqns
    params = {f"{key}_elsewhere": value for key, value in equation.params.items()}
    equation = equation.replace(params=params)
    jaxpr = program.jaxpr.replace(eqns=[equation])
    with pytest.raises(Unsupported, match="rev without its dimensions"):
        _program.build_graph(program.replace(jaxpr=jaxpr))


def test_lanes_program_with_effects_raises():
    def function(x):
        jax.debug.print("{}", x)
        return x

    with pytest.raises(Unsupported, match="effects"):
        lanes_run.run_batched(function, 4, np.ones((2, 3)))
