"""The programs of the benchmark, in a small form."""

import jax
import jax.numpy as jnp
import pytest

import nhjax
from benchmarks import lanes_for_others


PROGRAMS = lanes_for_others.programs(0.05)


def test_benchmark_has_programs_without_diffrax(monkeypatch):
    monkeypatch.setattr(lanes_for_others, "find_spec", lambda name: None)
    names = list(lanes_for_others.programs())
    assert len(names) == 5
    assert not any("diffrax" in name for name in names)


@pytest.mark.parametrize("name", PROGRAMS)
def test_program_of_others_is_compiled_and_equals_jax(name):
    found = lanes_for_others.measure(PROGRAMS[name](), repeats=1)
    assert found["engine"] == "lanes"
    assert found["difference"] < 1e-10
    jax.clear_caches()


def test_chaotic_equations_equal_those_of_the_gallery():
    example = nhjax.systems.ChaoticSystem()
    y0 = nhjax.initial_state(
        example.system,
        example.q0,
        v=jnp.array([0.2, 0.1, 0.4, -0.3, 0.2, -0.5, 0.1]),
        project=True,
    )
    rates = lanes_for_others.chaotic_field(0.0, jnp.concatenate([y0.q, y0.v]), None)
    motion = nhjax.motion(example.system, 0.0, y0)
    assert jnp.max(jnp.abs(rates[7:] - motion.acceleration)) < 1e-14
