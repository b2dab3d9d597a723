"""The elementary functions of vectors: their errors, special values and texts."""

import inspect
import re

import llvmlite.binding as llvm
import numpy as np
import pytest
import scipy.special

from nhjax.lanes import _coefficients
from nhjax.lanes._elementary_functions import definitions, SUPPORTED
from nhjax.lanes._writer import symbol
from support import approximations, ulps
from support.native_lanes import Native


OPS = sorted(SUPPORTED)
DTYPES = {"float64": np.float64, "float32": np.float32}
WIDTHS = (1, 4, 8)
EVERYTHING = [(op, dtype, width) for op in OPS for dtype in DTYPES for width in WIDTHS]


@pytest.fixture(scope="module")
def native():
    return Native(definitions(EVERYTHING), [symbol(*key) for key in EVERYTHING])


@pytest.fixture(scope="module")
def rounded():
    """The same functions where each product is rounded before it is added."""
    keys = [(op, "float64", 4) for op in OPS]
    text = definitions(keys).replace("contract ", "")
    return Native(text, [symbol(*key) for key in keys])


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("op", OPS)
def test_lanes_elementary_function_errs_by_less_than_two_ulps(
    op, dtype, native, rounded
):
    given = ulps.arguments(op, 0, 1500, DTYPES[dtype])
    exact = ulps.exact_values(op, given)
    # For float32, the error is little more than that of the last rounding.
    most = 0.51 if dtype == "float32" else 2
    for width in WIDTHS:
        got = native(symbol(op, dtype, width), *given)
        assert ulps.errors(got, exact).max() < most
    if dtype == "float64":
        got = rounded(symbol(op, dtype, 4), *given)
        assert ulps.errors(got, exact).max() < most


# The float64 numbers nearest to multiples of pi / 2, relative to their size, and
# arguments at which the functions leave the range of float64.
HARD = {
    "sin": [6381956970095103 * 2.0**797, np.pi, 51471.8, 51472.0, 1e300],
    "cos": [6381956970095103 * 2.0**797, np.pi / 2, 51471.8, -51472.0, 2.0**1023],
    "tan": [6381956970095103 * 2.0**797, np.pi / 2, 51471.8, 51472.0, 1e300],
    "exp": [709.782712893384, 709.7827128933841, -745.133219101941, -745.13321910195],
    "exp2": [1023.9999999999999, -1074.0, -1074.9999999999998, -1022.5],
    "expm1": [709.782712893384, 709.7827128933841, -37.5, 5e-324, -1e-310],
    "sinh": [710.4758600739439, 710.475860073944, 5e-324, -1e-310, 22.0],
    "cosh": [710.4758600739439, -710.475860073944, 5e-324],
    "tanh": [19.06154746539849, 19.1, 5e-324, -1e-310],
    "log": [5e-324, 1e-310, 1 - 2.0**-53, 1 + 2.0**-52, 1.7976931348623157e308],
    "log1p": [5e-324, -1e-310, -1 + 2.0**-53, 1.7976931348623157e308],
    "asinh": [5e-324, 2.0**100, 1.1 * 2.0**100, 1.7976931348623157e308],
    "acosh": [1 + 2.0**-52, 2.0**100, 1.7976931348623157e308],
    "atanh": [5e-324, 1 - 2.0**-53, -1 + 2.0**-53],
    "asin": [5e-324, 1 - 2.0**-53, 0.5, np.nextafter(0.5, 1)],
    "acos": [5e-324, 1 - 2.0**-53, -1 + 2.0**-53, 0.5, -0.5],
    "cbrt": [5e-324, 8.0, -27.0, 1.7976931348623157e308],
    "logistic": [-745.0, -744.44, -709.0, 36.8, 5e-324],
    "erf": [5e-324, 1.0, 5.9, 6.1],
}  # fmt: skip


@pytest.mark.parametrize("op", HARD)
def test_lanes_elementary_function_at_hard_arguments_errs_by_less_than_two_ulps(
    op, native
):
    given = [np.array(HARD[op], np.float64)]
    got = native(symbol(op, "float64", 8), *given)
    assert ulps.errors(got, ulps.exact_values(op, given)).max() < 2


@pytest.mark.parametrize("dtype", DTYPES)
def test_lanes_remainder_of_any_arguments_is_exact(dtype, native):
    given = ulps.arguments("rem", 3, 20000, DTYPES[dtype])
    got = native(symbol("rem", dtype, 8), *given)
    np.testing.assert_array_equal(got, np.fmod(*given))


_NUMPY = {
    "acos": np.arccos,
    "acosh": np.arccosh,
    "asin": np.arcsin,
    "asinh": np.arcsinh,
    "atan": np.arctan,
    "atan2": np.arctan2,
    "atanh": np.arctanh,
    "erf": scipy.special.erf,
    "logistic": scipy.special.expit,
    "pow": np.power,
    "rem": np.fmod,
}


def _specials(dtype):
    limits = np.finfo(dtype)
    positive = [0.0, limits.smallest_subnormal, limits.tiny, 0.5, 1.0, 1.5, 2.0, 3.0]
    positive += [2.0 ** (limits.nmant + 1) - 1, 2.0 ** (limits.nmant + 3), limits.max]
    positive = np.array([*positive, np.inf, np.nan], dtype)
    return np.concatenate([positive, -positive])


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("op", OPS)
def test_lanes_elementary_function_at_special_values_equals_c(op, dtype, width, native):
    values = _specials(DTYPES[dtype])
    given = [values]
    if op in ulps.BINARY:
        given = [x.ravel() for x in np.meshgrid(values, values)]
    with np.errstate(all="ignore"):
        wanted = (_NUMPY.get(op) or getattr(np, op))(*given)
    got = native(symbol(op, dtype, width), *given)
    assert got.dtype == wanted.dtype
    np.testing.assert_allclose(got, wanted, rtol=8 * np.finfo(dtype).eps, atol=0)
    numbers = ~np.isnan(wanted)
    np.testing.assert_array_equal(np.signbit(got[numbers]), np.signbit(wanted[numbers]))


# The largest errors that the polynomials may cause in their functions, as powers of 2;
# powers need a more accurate logarithm, and the cube root only a first guess.
LARGEST_ERRORS = {"LOG_LONG": -66, "CBRT": -18}


@pytest.mark.parametrize("name", approximations.APPROXIMATIONS)
def test_lanes_polynomial_coefficients_are_as_accurate_as_float64(name):
    coefficients = getattr(_coefficients, name)
    bound = 2.0 ** LARGEST_ERRORS.get(name, -55)
    assert approximations.worst_error(name, coefficients) < bound


def test_lanes_polynomial_coefficients_equal_computed_ones():
    source = inspect.getsource(_coefficients)
    assert source == approximations.module()


def test_lanes_definitions_of_all_functions_contain_each_once():
    names = re.findall(
        r"^(?:define|declare).*?@([\w.]+)", definitions(EVERYTHING), re.M
    )
    assert len(names) == len(set(names))
    assert all(name.startswith("nhjax.") for name in names)
    assert {symbol(*key) for key in EVERYTHING} <= set(names)


def test_lanes_sine_and_cosine_of_one_argument_are_one_call():
    """LLVM merges the calls: the two cost as much as one."""
    both = "\n".join(
        [
            definitions([("sin", "float64", 4), ("cos", "float64", 4)]),
            "define <4 x double> @sum(<4 x double> %x) {",
            f"  %s = call <4 x double> @{symbol('sin', 'float64', 4)}(<4 x double> %x)",
            f"  %c = call <4 x double> @{symbol('cos', 'float64', 4)}(<4 x double> %x)",
            "  %r = fadd <4 x double> %s, %c",
            "  ret <4 x double> %r",
            "}",
        ]
    )
    module, machine = _parsed(both, llvm.get_default_triple())
    options = llvm.create_pipeline_tuning_options(speed_level=2)
    builder = llvm.create_pass_builder(machine, options)
    builder.getModulePassManager().run(module, builder)
    body = str(module.get_function("sum"))
    assert len(re.findall(r"\bcall\b", body)) == 1


TRIPLES = [
    "x86_64-unknown-linux-gnu",
    "aarch64-unknown-linux-gnu",
    "arm64-apple-darwin",
]


@pytest.mark.parametrize("width", [1, 2, 8])
@pytest.mark.parametrize("triple", TRIPLES)
def test_lanes_elementary_functions_on_any_platform_call_no_library(triple, width):
    """Processors without special instructions need no library either."""
    keys = [(op, dtype, width) for op in OPS for dtype in DTYPES]
    text = definitions(keys).replace("define internal", "define")
    assert _called_outside(text, triple) == set()


@pytest.mark.parametrize("triple", TRIPLES)
def test_lanes_call_of_an_outside_library_is_detected(triple):
    text = """
        define double @other(double %x) {
          %y = call double @llvm.sin.f64(double %x)
          ret double %y
        }
    """
    assert {name.strip("_") for name in _called_outside(text, triple)} == {"sin"}


def _called_outside(text, triple):
    """Return the functions that are called in machine code, and not defined there."""
    module, machine = _parsed(text, triple)
    assembly = machine.emit_assembly(module)
    called = re.findall(r"^\s+(?:callq?|bl|b|jmp)\s+([\w.]+)", assembly, re.M)
    return set(called) - set(re.findall(r"^([\w.]+):", assembly, re.M))


def _parsed(text, triple):
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    # With this code model, calls contain the names of functions.
    machine = llvm.Target.from_triple(triple).create_target_machine(
        opt=1, reloc="pic", codemodel="small"
    )
    module = llvm.parse_assembly(text)
    module.triple = triple
    module.verify()
    return module, machine


def test_lanes_definition_of_one_function_is_complete():
    for op in OPS:
        Native(definitions([(op, "float64", 2)]), [symbol(op, "float64", 2)])


def test_lanes_elementary_function_without_formula_is_not_supported():
    assert "sqrt" not in SUPPORTED
    with pytest.raises(KeyError):
        definitions([("lgamma", "float64", 4)])
