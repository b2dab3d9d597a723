"""Errors in functions of the user come with a note that names the function."""

import math
import re

import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import LagrangianSystem, LobattoIIIAB


def by_numpy(t, q, v, args):
    return 0.5 * v @ v - np.sin(q[0])


def by_math(t, q, v, args):
    return 0.5 * v @ v - math.sin(q[0])


def by_if(t, q, v, args):
    return v @ v if q[0] > 0 else 0.5 * v @ v


def by_args(t, q, v, args):
    return 0.5 * args["mass"] * v @ v


def note_of(error):
    (note,) = [x for x in error.value.__notes__ if "called by nhjax" in x]
    return note


@pytest.mark.parametrize(
    ("lagrangian", "advice"),
    [
        (by_numpy, "functions of `jax.numpy` in place of those of `numpy` and `math`"),
        (by_math, "functions of `jax.numpy` in place of those of `numpy` and `math`"),
        (by_if, "`jnp.where(condition, a, b)` in place of `if`"),
        (by_args, "has `args=...` been left out of the call?"),
    ],
)
def test_error_in_lagrangian_names_it_with_file_and_line(lagrangian, advice):
    with pytest.raises(Exception) as error:  # noqa: PT011 -- whatever JAX raises
        nhjax.initial_state(LagrangianSystem(lagrangian), jnp.zeros(2), jnp.ones(2))
    note = note_of(error)
    line = lagrangian.__code__.co_firstlineno
    place = re.escape(f"({lagrangian.__name__}, {__file__}:{line})")
    assert re.search(rf"`lagrangian\(t, q, v, args\)` {place}", note)
    assert advice in note


@pytest.mark.parametrize(
    ("options", "called"),
    [
        (
            {"event": nhjax.Event(lambda t, y: y.q[0])},  # pyright: ignore
            "Event 0: cond_fn(t, y, args)",
        ),
        (
            {
                "event": nhjax.Event(
                    lambda t, y, args: y.q[0] - 2,
                    reset=lambda t, y, args: (np.abs(y.q), y.v),
                )
            },
            "Event 0: reset(t, y, args)",
        ),
        (
            {"saveat": nhjax.SaveAt(t1=True, fn=lambda t, y, args: math.cos(y.q[0]))},
            "SaveAt: fn(t, y, args)",
        ),
        (
            {"invariants": lambda t, q, v, args: np.exp(q[0])},
            "invariants(t, q, v, args)",
        ),
    ],
)
def test_error_in_function_of_a_run_names_it(options, called):
    system = LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v)
    y0 = nhjax.initial_state(system, jnp.zeros(2), jnp.ones(2))
    with pytest.raises(Exception) as error:  # noqa: PT011 -- whatever JAX raises
        nhjax.integrate(system, LobattoIIIAB(2), y0, dt=0.1, num_steps=2, **options)
    assert f"`{called}`" in note_of(error)
