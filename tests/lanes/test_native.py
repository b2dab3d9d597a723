"""Native code: the machines it is generated for, and where it is available."""

import re
import subprocess
import sys

import jax.numpy as jnp
import pytest

from nhjax import lanes
from nhjax.lanes import _handler, _native
from support import lane_processes
from support.lane_kernels import VECTORS


LINUX = "x86_64-unknown-linux-gnu"
# Machines that every machine must be able to compile for, and for each a register of
# its widest vectors in the product of eight numbers.
TARGETS = {
    "x86-64": (_native.Target(LINUX, "x86-64"), r"mulpd\t%xmm\d"),
    "x86-64-v3": (_native.Target(LINUX, "x86-64-v3"), r"mulpd\t%ymm\d"),
    "x86-64-v4": (_native.Target(LINUX, "x86-64-v4"), r"mulpd\t%zmm\d"),
    "aarch64": (
        _native.Target("aarch64-unknown-linux-gnu", "generic"),
        r"fmul\tv\d+\.2d",
    ),
    "apple": (_native.Target("arm64-apple-darwin", "apple-m1"), r"fmul\.2d\tv\d"),
}


@pytest.mark.parametrize("name", TARGETS)
def test_lanes_kernel_and_handler_compile_for_each_platform(name):
    target, register = TARGETS[name]
    texts = [VECTORS, _handler.handler_ir(1, 1, 8, True), _handler.shared_handler_ir()]
    made = texts, _handler.HANDLER, target
    text = _native.assembly(*made)
    assert _handler.HANDLER in text
    assert re.search(register, text)
    assert len(_native.object_code(*made)) > 1000


@pytest.mark.parametrize("cpu", ["skylake-avx512", "sapphirerapids", "znver4"])
def test_lanes_kernel_with_avx512_uses_512_bit_vectors(cpu):
    """These prefer 256-bit vectors where the compiler itself vectorises."""
    machine = _native.Target(LINUX, cpu)
    text = _native.assembly([VECTORS], "kernel", machine)
    assert "%zmm" in text
    assert "%ymm" not in text


def test_lanes_kernel_with_fma_contracts_products_and_sums():
    for name, has_fma in [("x86-64", False), ("x86-64-v3", True), ("aarch64", True)]:
        text = _native.assembly([VECTORS], "kernel", TARGETS[name][0])
        assert bool(re.search(r"\bvfmadd|\bfmla", text)) == has_fma


def test_lanes_host_width_equals_elements_of_vector_registers():
    width = lanes.host_width(jnp.float64)
    assert width in (2, 4, 8)
    assert lanes.host_width(jnp.float32) == 2 * width
    text = VECTORS.replace("<8 x double>", f"<{width} x double>")
    made = _native.assembly([text], "kernel", _native.host())
    # One product of this width is one instruction.
    assert len(re.findall(r"\bv?f?mul(?:pd)?\b", made)) == 1


def run(*command):
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_lanes_compiler_on_this_machine_is_available():
    assert lanes.is_available()


@pytest.mark.parametrize(
    ("system", "machine"), [("win32", "AMD64"), ("linux", "riscv64"), ("linux", "i686")]
)
def test_lanes_compiler_on_other_platforms_is_not_available(
    monkeypatch, system, machine
):
    monkeypatch.setattr(_native.sys, "platform", system)
    monkeypatch.setattr(_native.platform, "machine", lambda: machine)
    assert not _native.is_available.__wrapped__()


def test_lanes_import_without_llvmlite_has_no_compiler():
    """Where llvmlite is installed, importing nhjax does not import it."""
    out = run(sys.executable, lane_processes.__file__, "without_llvmlite")
    assert out == "imported: False available: False\n"
