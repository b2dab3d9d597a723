"""Values read besides the arguments are never stale, and cost no retrace."""

import types
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import SaveAt
from support.falling import (
    end,
    falling,
    traces,
)


SETTINGS: Any = types.ModuleType("settings")
GRAVITY: Any = 1.0
MASSES = np.array([1.0, 2.0])


def reads_global(t, q, v, args):
    return falling(v, q, GRAVITY)


def helper(q):
    return GRAVITY * q[0]


def reads_global_in_a_helper(t, q, v, args):
    def potential(q):
        return helper(q)

    traces.append(1)
    return 0.5 * v @ v - potential(q)


def reads_numpy(t, q, v, args):
    return falling(v, q, MASSES[0])


def reads_a_class(t, q, v, args):
    return falling(v, q, Planet.share)


def reads_module(t, q, v, args):
    return falling(v, q, SETTINGS.g)


class Planet:
    """A plain object with a method, an attribute and a class attribute."""

    share = 1.0

    def __init__(self):
        self.g = 1.0

    def lagrangian(self, t, q, v, args):
        return falling(v, q, self.g * self.share)


class Slotted:
    """An object without a dictionary."""

    __slots__ = ("g",)

    def __init__(self):
        self.g = 1.0


class Callable(eqx.Module):
    """A module whose array is an argument, and that reads a global besides."""

    scale: jax.Array

    def __call__(self, t, q, v, args):
        return falling(v, q, self.scale * GRAVITY)


def set_global(name, value):
    globals()[name] = value


def in_place(array):
    return lambda value: array.__setitem__(0, value)


def a_dict():
    values = {"a": {"g": [1.0]}}

    def lagrangian(t, q, v, args):
        return falling(v, q, values["a"]["g"][0])

    return lagrangian, lambda value: values["a"]["g"].__setitem__(0, value)


def a_list():
    values = [1.0]
    return lambda t, q, v, args: falling(v, q, values[0]), in_place(values)


def a_cell():
    g = 1.0

    def change(value):
        nonlocal g
        g = value

    return lambda t, q, v, args: falling(v, q, g), change


def an_object():
    planet = Planet()
    return (
        lambda t, q, v, args: falling(v, q, planet.g),
        partial(setattr, planet, "g"),
    )


def an_object_with_slots():
    planet = Slotted()
    return (
        lambda t, q, v, args: falling(v, q, planet.g),
        partial(setattr, planet, "g"),
    )


def a_method():
    planet = Planet()
    return planet.lagrangian, partial(setattr, planet, "g")


def a_class():
    return Planet().lagrangian, partial(setattr, Planet, "share")


def a_class_that_is_named():
    return reads_a_class, partial(setattr, Planet, "share")


def a_partial():
    options = {"g": 1.0}

    def lagrangian(options, t, q, v, args):
        return falling(v, q, options["g"])

    return partial(lagrangian, options), partial(options.__setitem__, "g")


def a_default():
    options = {"g": 1.0}

    def lagrangian(t, q, v, args, options=options):
        return falling(v, q, options["g"])

    return lagrangian, partial(options.__setitem__, "g")


def a_namespace():
    space = types.SimpleNamespace(g=1.0)
    return lambda t, q, v, args: falling(v, q, space.g), partial(setattr, space, "g")


def a_numpy_array():
    return reads_numpy, in_place(MASSES)


def an_array_of_jax():
    return reads_global, lambda value: set_global("GRAVITY", jnp.asarray(value))


def a_global():
    return reads_global, partial(set_global, "GRAVITY")


def a_global_in_a_helper():
    return reads_global_in_a_helper, partial(set_global, "GRAVITY")


def a_mapped_function():
    function = jax.vmap(reads_global, in_axes=(None, 0, 0, None))

    def lagrangian(t, q, v, args):
        return jnp.sum(function(t, q[None], v[None], args))

    return lagrangian, partial(set_global, "GRAVITY")


def a_module_that_is_called():
    return Callable(jnp.asarray(1.0)), partial(set_global, "GRAVITY")


def a_variable_of_a_module():
    SETTINGS.g = 1.0
    return reads_module, partial(setattr, SETTINGS, "g")


def an_equinox_module_that_is_closed_over():
    module = [Callable(jnp.asarray(1.0))]

    def change(value):
        module[0] = Callable(jnp.asarray(value))

    return lambda t, q, v, args: module[0](t, q, v, args), change


READERS = [
    a_global,
    a_global_in_a_helper,
    a_cell,
    a_list,
    a_dict,
    an_object,
    an_object_with_slots,
    a_method,
    a_class,
    a_class_that_is_named,
    a_partial,
    a_default,
    a_namespace,
    a_numpy_array,
    an_array_of_jax,
    a_mapped_function,
    a_module_that_is_called,
    a_variable_of_a_module,
    an_equinox_module_that_is_closed_over,
]


@pytest.fixture(autouse=True)
def unchanged():
    set_global("GRAVITY", 1.0)
    MASSES[0] = Planet.share = 1.0


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.__name__)
def test_tracked_jit_after_changed_value_traces_once(reader):
    lagrangian, change = reader()
    np.testing.assert_allclose(end(lagrangian)[0], -0.5, rtol=1e-13)
    # Every call of `initial_state` also traces the function to check its shapes.
    checks = len(traces)
    nhjax.initial_state(nhjax.LagrangianSystem(lagrangian), jnp.zeros(2), jnp.zeros(2))
    checks = len(traces) - checks
    count = len(traces)
    np.testing.assert_allclose(end(lagrangian)[0], -0.5, rtol=1e-13)
    assert len(traces) - count == checks
    change(3.0)
    np.testing.assert_allclose(end(lagrangian)[0], -1.5, rtol=1e-13)
    count = len(traces)
    end(lagrangian)
    assert len(traces) - count == checks
    change(1.0)
    np.testing.assert_allclose(end(lagrangian)[0], -0.5, rtol=1e-13)


def test_tracked_jit_of_constraint_force_and_output_is_never_stale():
    values = {"slope": 0.0, "push": 0.0, "factor": 1.0}
    parts = {
        "nonholonomic": lambda t, q, v, args: v[1] - values["slope"] * v[0],
        "force": lambda t, q, v, args: jnp.array([values["push"], 0.0]),
    }
    saveat = SaveAt(t1=True, fn=lambda t, y, args: values["factor"] * y.q)

    def lagrangian(t, q, v, args):
        return 0.5 * v @ v

    expected = {"push": (0.5, 0.0), "slope": (0.25, 0.25), "factor": (0.5, 0.5)}
    assert not np.any(end(lagrangian, saveat, **parts))
    for (name, x), value in zip(expected.items(), (1.0, 1.0, 2.0), strict=True):
        values[name] = value
        got = end(lagrangian, saveat, **parts)
        np.testing.assert_allclose(got, x, rtol=1e-12, atol=1e-15)


def test_tracked_jit_of_initial_state_is_never_stale():
    values = [2.0]
    system = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * values[0] * v @ v)
    for mass in (2.0, 3.0):
        values[0] = mass
        y = nhjax.initial_state(system, jnp.zeros(1), jnp.ones(1))
        assert float(y.p[0]) == mass


def test_tracked_jit_of_functions_in_args_is_never_stale():
    values = [1.0]
    system = nhjax.LagrangianSystem(lambda t, q, v, args: falling(v, q, args()))

    def reached():
        args = read_first
        y0 = nhjax.initial_state(system, jnp.zeros(2), jnp.zeros(2), args=args)
        sol = nhjax.integrate(
            system, nhjax.LobattoIIIAB(2), y0, dt=0.1, num_steps=10, args=args
        )
        return float(sol.ys.q[0, 0])

    def read_first():
        return values[0]

    first = reached()
    values[0] = 3.0
    np.testing.assert_allclose([first, reached()], [-0.5, -1.5], rtol=1e-13)
