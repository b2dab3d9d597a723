"""Values that functions close over under transformations, and untracked values."""

from collections import deque
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.core import Tracer

import nhjax
from nhjax._compile._tracked_jit import Captured, MOST_ENTRIES
from support.falling import (
    end,
    falling,
    traces,
)


GRAVITY: Any = 1.0
COUNT = 0


class Scaled(eqx.Module):
    """A module whose array is an argument, and that reads a global besides."""

    scale: jax.Array

    def __call__(self, t, q, v, args):
        return falling(v, q, self.scale * GRAVITY)


class Label:
    """A key that equals all other keys but has its own value."""

    def __init__(self, value):
        self.value = value

    def __hash__(self):
        return 1

    def __eq__(self, other):
        return isinstance(other, Label)


class Planet:
    """A plain object with an attribute."""

    g = 1.0


def reads_global(t, q, v, args):
    return falling(v, q, GRAVITY)


# Transformations ----------------------------------------------------------------------


def test_tracked_jit_of_module_takes_leaves_as_arguments():
    end(Scaled(jnp.asarray(1.0)))
    checks = len(traces)
    end(Scaled(jnp.asarray(1.0)))
    checks = len(traces) - checks
    count = len(traces)
    for scale in (2.0, 3.0):
        got = end(Scaled(jnp.asarray(scale)))
        np.testing.assert_allclose(got[0], -0.5 * scale, rtol=1e-13)
    assert len(traces) - count == 2 * checks


def reached_with(g):
    return reached_of(lambda t, q, v, args: falling(v, q, g))


def reached_of(lagrangian):
    system = nhjax.LagrangianSystem(lagrangian)
    y0 = nhjax.initial_state(system, jnp.zeros(2), jnp.zeros(2))
    sol = nhjax.integrate(system, nhjax.LobattoIIIAB(2), y0, dt=0.1, num_steps=10)
    return sol.ys.q[-1, 0]


def plain(function):
    return function


def one_of_a_batch(function):
    return lambda x: jax.vmap(function)(jnp.stack([x, x]))[1]


def pushed_forward(function):
    return lambda x: jax.jvp(function, (x,), (1.0,))[1]


@pytest.mark.parametrize("transform", [plain, jax.jit, one_of_a_batch])
def test_function_that_closes_over_transformed_value_runs(transform):
    for g in (1.0, 3.0):
        got = transform(reached_with)(jnp.asarray(g))
        np.testing.assert_allclose(got, -0.5 * g, rtol=1e-13)


@pytest.mark.parametrize("transform", [jax.grad, pushed_forward])
def test_function_that_closes_over_differentiated_value_has_gradient(transform):
    def square(x):
        return reached_with(x**2)

    for g in (1.0, 3.0):
        got = transform(square)(jnp.asarray(g))
        np.testing.assert_allclose(got, -g, rtol=1e-13)


def test_tracer_of_earlier_transformation_is_not_reused():
    holder = []

    def lagrangian(t, q, v, args):
        return falling(v, q, holder[-1])

    def loss(g):
        holder.append(g)
        return reached_of(lagrangian)

    for g in (1.0, 3.0):
        value, rate = jax.value_and_grad(loss)(g)
        np.testing.assert_allclose((value, rate), (-0.5 * g, -0.5), rtol=1e-13)


def test_globals_under_jit_of_user_keep_their_values_at_tracing(monkeypatch):
    function = jax.jit(lambda x: x + reached_of(reads_global))
    first = float(function(0.0))
    monkeypatch.setitem(globals(), "GRAVITY", 3.0)
    assert float(function(0.0)) == first


# What is not tracked ------------------------------------------------------------------


def test_value_changed_by_tracing_causes_no_retrace():
    made: dict[str, Any] = {"g": 1.0}
    calls: list[int] = []

    def lagrangian(t, q, v, args):
        global COUNT
        COUNT += 1
        calls.append(COUNT)
        made.setdefault("potential", lambda q: made["g"] * q[0])
        return 0.5 * v @ v - made["potential"](q)

    end(lagrangian)
    count = len(calls)
    end(lagrangian)
    checks = len(calls) - count
    end(lagrangian)
    assert len(calls) - count == 2 * checks
    made["g"] = 3.0
    np.testing.assert_allclose(end(lagrangian)[0], -1.5, rtol=1e-13)


@pytest.mark.parametrize("kind", ["closed-over variable", "list"])
def test_tracer_stored_by_earlier_trace_causes_no_retrace(kind):
    calls, last, kept = [], None, [None]

    def lagrangian(t, q, v, args):
        nonlocal last
        calls.append(1)
        if kind == "list":
            kept[0] = q
        else:
            last = q
        return falling(v, q, 1.0)

    counts = []
    for _ in range(4):
        end(lagrangian)
        counts.append(len(calls))
    first, second, third = np.diff(counts)
    assert first == second == third < counts[0] / 2
    assert isinstance(kept[0] if kind == "list" else last, Tracer)


def test_captured_values_with_cycles_or_without_hash_are_compared():
    circle: list[Any] = [1.0]
    circle.append({"again": circle, 3: {1, 2}, (1, 2): bytearray(b"x")})
    planet: Any = Planet()
    planet.itself, planet.objects = planet, np.array([1, "a", None], object)

    def lagrangian(t, q, v, args):
        return falling(v, q, circle[0] * planet.g)

    first = end(lagrangian)[0]
    planet.g = 3.0
    np.testing.assert_allclose([first, end(lagrangian)[0]], [-0.5, -1.5], rtol=1e-13)


def kinds_of_values():
    """Pairs of a value and a change inside of it."""
    inner, planet = [1.0], Planet()
    objects = np.array([None, None], object)
    objects[1] = inner
    nested: dict[str, Any] = {"a": {"b": 1, "c": 2}}
    pairs: list[Any] = [[1.0], [1.0]]
    zero: list[float] = [0.0]
    whole: list[float] = [1]
    by_sign: dict[float, int] = {0.0: 1}
    by_label = {Label(1.0): 1}

    def replace_key(mapping, key):
        mapping.clear()
        mapping[key] = 1

    return {
        "array of objects": (objects, lambda: inner.append(2.0)),
        "set": (numbers := {1}, lambda: numbers.add(2)),
        "queue": (queue := deque([1]), lambda: queue.append(2)),
        "attribute": (planet, lambda: setattr(planet, "g", 2.0)),
        "sign of zero": (zero, lambda: zero.__setitem__(0, -0.0)),
        "type of number": (whole, lambda: whole.__setitem__(0, 1.0)),
        "identity": (pairs, lambda: pairs.__setitem__(1, pairs[0])),
        "sign of a key": (by_sign, lambda: replace_key(by_sign, -0.0)),
        "key equal to another": (by_label, lambda: replace_key(by_label, Label(2.0))),
        "level of a key": (nested, lambda: nested.update(c=nested["a"].pop("c"))),
    }


@pytest.mark.parametrize("kind", kinds_of_values())
def test_captured_of_value_changed_inside_has_other_atoms(kind):
    value, change = kinds_of_values()[kind]

    def function():
        return value

    before = Captured(function).atoms
    assert Captured(function).atoms == before
    change()
    assert Captured(function).atoms != before


def test_captured_of_global_with_name_of_attribute_is_not_compared(monkeypatch):
    # A global `q` in a notebook is not the position of a state.
    def function(y):
        return y.q

    before = Captured(function).atoms
    monkeypatch.setitem(globals(), "q", 1.0)
    assert Captured(function).atoms == before


def test_captured_values_of_huge_container_are_limited():
    many = [float(i) for i in range(100_000)]
    assert len(Captured(lambda: many).atoms) == MOST_ENTRIES


def test_captured_values_of_library_are_not_searched():
    def function(q):
        return jnp.sin(q) + np.pi + jax.nn.relu(q) + eqx.is_array(q)

    # The function itself and four modules.
    assert len(Captured(function).atoms) <= 6


def test_captured_values_after_list_filled_by_tracing_are_compared():
    log, constants = [], {"g": 9.81}

    def lagrangian(t, q, v, args):
        log.append((q.shape, v.dtype))
        return 0.5 * v @ v - constants["g"] * q[0]

    system = nhjax.LagrangianSystem(lagrangian)

    def height():
        y0 = nhjax.initial_state(system, jnp.zeros(1), jnp.zeros(1))
        sol = nhjax.integrate(system, nhjax.LobattoIIIAB(2), y0, dt=0.1, num_steps=10)
        return float(sol.ys.q[0, 0])

    assert height() == pytest.approx(-0.5 * 9.81)
    constants["g"] = 1.0
    assert height() == pytest.approx(-0.5)
