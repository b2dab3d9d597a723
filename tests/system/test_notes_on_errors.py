"""Errors in functions of the user come with a note that names the function."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import HamiltonianSystem, LagrangianSystem, LobattoIIIAB
from support.mistakes import kinetic


METHOD = LobattoIIIAB(2)
Q, V = jnp.array([0.0, 1.0]), jnp.array([1.0, 0.0])
QUATERNION = jnp.array([1.0, 0.0, 0.0, 0.0])


# Each takes (t, q, v, args); a function of the system passes what it receives.
def by_numpy(t, q, v, args):
    return np.sin(q[0])


def by_math(t, q, v, args):
    return math.sin(q[0])


def by_if(t, q, v, args):
    return q[0] if q[0] > 0 else -q[0]


def by_max(t, q, v, args):
    return max(q[0], 0.0)


def by_args(t, q, v, args):
    return args["mass"] * q[0]


def by_list(t, q, v, args):
    return [1.0, 2.0][q[0].astype(int)]


def by_mask(t, q, v, args):
    return jnp.sum(q[q > 0])


NUMPY = "functions of `jax.numpy` in place of `numpy` and `math`"
ADVICE = {
    by_numpy: NUMPY,
    by_math: NUMPY,
    by_if: "`jnp.where(condition, a, b)` in place of `if`",
    by_max: "`jnp.maximum`, `jnp.minimum` in place of `max`, `min`",
    by_args: "has `args=...` been left out of the call?",
    by_list: "`jnp.asarray(table)[i]`",
    by_mask: "`jnp.where(condition, a, 0.0)` in place of `a[condition]`",
}


def note_of(error):
    (note,) = [x for x in error.value.__notes__ if "called by nhjax" in x]
    return note


def place_of(function):
    return f"{function.__qualname__}, {__file__}:{function.__code__.co_firstlineno})"


def system_of(name, mistake, manifold=None):
    """Make a system whose function `name` makes a mistake, and return the function."""

    def of_velocities(t, q, v, args):
        term = mistake(t, q, v, args)
        return kinetic(t, q, v, args) + term if name == "lagrangian" else v[1] + term

    def of_momenta(t, q, p, args):
        return kinetic(t, q, p, args) + mistake(t, q, p, args)

    def of_positions(t, q, args):
        return q[1] - 1 + mistake(t, q, q, args)

    def force(t, q, v, args):
        return mistake(t, q, v, args) * v

    if name == "hamiltonian":
        return HamiltonianSystem(of_momenta, manifold=manifold), of_momenta
    if name == "lagrangian":
        return LagrangianSystem(of_velocities, manifold=manifold), of_velocities
    function = {
        "nonholonomic": of_velocities,
        "holonomic": of_positions,
        "force": force,
    }[name]
    system = LagrangianSystem(kinetic, manifold=manifold, **{name: function})
    return system, function


SIGNATURES = {
    "lagrangian": "(t, q, v, args)",
    "nonholonomic": "(t, q, v, args)",
    "holonomic": "(t, q, args)",
    "force": "(t, q, v, args)",
    "hamiltonian": "(t, q, p, args)",
}
TRANSFORMATIONS = {"plain": lambda f: f, "jit": jax.jit}


@pytest.mark.parametrize("mistake", ADVICE, ids=lambda f: f.__name__)
@pytest.mark.parametrize("name", SIGNATURES)
@pytest.mark.parametrize("how", TRANSFORMATIONS)
def test_note_on_function_of_system_names_it_with_line_and_remedy(how, name, mistake):
    system, function = system_of(name, mistake)
    start = TRANSFORMATIONS[how](lambda q: nhjax.initial_state(system, q, V).q)
    with pytest.raises(Exception) as error:  # noqa: PT011 -- whatever JAX raises
        start(Q)
    note = note_of(error)
    assert f"`{name}{SIGNATURES[name]}` (" in note
    assert place_of(function) in note
    assert ADVICE[mistake] in note


@pytest.mark.parametrize("mistake", [by_numpy, by_args], ids=lambda f: f.__name__)
@pytest.mark.parametrize("name", ["lagrangian", "force", "hamiltonian"])
def test_note_on_function_of_system_on_group_names_it(name, mistake):
    system, function = system_of(name, mistake, nhjax.SO3())
    with pytest.raises(Exception) as error:  # noqa: PT011 -- whatever JAX raises
        nhjax.initial_state(system, QUATERNION, jnp.ones(3))
    assert place_of(function) in note_of(error)
    assert ADVICE[mistake] in note_of(error)


# Where `args` is forgotten after the start --------------------------------------------


def massive(t, q, u, args):
    return 0.5 * args["mass"] * u @ u


def leaning(t, q, v, args):
    return v[1] - args["slope"] * v[0]


FREE = LagrangianSystem(massive)
SKATE = LagrangianSystem(kinetic, nonholonomic=leaning)
MOMENTA = HamiltonianSystem(massive)


def started(system, args):
    return nhjax.initial_state(system, Q, V, args=args)


CALLS = {
    "integrate": lambda system, y: nhjax.integrate(
        system, METHOD, y, dt=0.1, num_steps=2
    ),
    "step": lambda system, y: nhjax.step(system, METHOD, 0.0, 0.1, y),
    "energy": lambda system, y: system.energy(0.0, y),
    "motion": lambda system, y: nhjax.motion(system, 0.0, y),
    "linear_stability": lambda system, y: nhjax.linear_stability(system, 0.0, y),
    "steady_motion": lambda system, y: nhjax.steady_motion(
        system, 0.0, y, positions=(), velocities=(0, 1)
    ),
    "check_system": lambda system, y: nhjax.check_system(system, y.q, y.v),
}


@pytest.mark.parametrize("how", TRANSFORMATIONS)
@pytest.mark.parametrize("call", CALLS)
def test_note_on_forgotten_args_is_added_by_every_function_of_a_system(call, how):
    y = started(FREE, {"mass": 2.0})
    with pytest.raises(TypeError) as error:
        TRANSFORMATIONS[how](lambda y: CALLS[call](FREE, y) and None)(y)
    # Only `check_system` does not run inside of jit, and says so first.
    if (call, how) == ("check_system", "jit"):
        assert "outside `jax.jit`" in str(error.value)
        return
    assert place_of(massive) in note_of(error)
    assert ADVICE[by_args] in note_of(error)


@pytest.mark.parametrize(
    "call",
    [
        lambda y: nhjax.integrate(SKATE, METHOD, y, dt=0.1, num_steps=2),
        lambda y: SKATE.constraint_violation(0.0, y),
        lambda y: nhjax.continuous_multiplier(SKATE, 0.0, y),
    ],
)
def test_note_on_forgotten_args_names_constraint(call):
    with pytest.raises(TypeError) as error:
        call(started(SKATE, {"slope": 0.0}))
    assert "`nonholonomic(t, q, v, args)`" in note_of(error)
    assert ADVICE[by_args] in note_of(error)


def test_note_on_forgotten_args_names_hamiltonian():
    y = started(MOMENTA, {"mass": 2.0})
    with pytest.raises(TypeError) as error:
        nhjax.integrate(MOMENTA, METHOD, y, dt=0.1, num_steps=2)
    assert "`hamiltonian(t, q, p, args)`" in note_of(error)
    assert ADVICE[by_args] in note_of(error)


@pytest.mark.parametrize(
    ("args", "exception", "advice"),
    [
        ({"m": 1.0, "g": 9.81}, KeyError, "Here `args` has the keys 'g', 'm'."),
        ((1.0,), TypeError, "Here `args` is a tuple of 1."),
    ],
)
def test_note_on_wrong_args_describes_them(args, exception, advice):
    with pytest.raises(exception) as error:
        started(FREE, args)
    assert note_of(error).endswith(advice)


# Functions of a run -------------------------------------------------------------------


def wrong_event(t, y, args):
    return np.sin(y.q[0])


def wrong_reset(t, y, args):
    return (np.abs(y.q), y.v)


def wrong_output(t, y, args):
    return math.cos(y.q[0])


def wrong_invariant(t, q, v, args):
    return q[0] if v[0] > 0 else v[0]


RUNS = {
    "Event 1: cond_fn(t, y, args)": (
        wrong_event,
        {"event": [nhjax.Event(lambda t, y, args: t - 5), nhjax.Event(wrong_event)]},
    ),
    "Event 0: reset(t, y, args)": (
        wrong_reset,
        {"event": nhjax.Event(lambda t, y, args: y.q[0] - 2, reset=wrong_reset)},
    ),
    "SaveAt: fn(t, y, args)": (
        wrong_output,
        {"saveat": nhjax.SaveAt(t1=True, fn=wrong_output)},
    ),
    "invariants(t, q, v, args)": (wrong_invariant, {"invariants": wrong_invariant}),
}


@pytest.mark.parametrize("how", TRANSFORMATIONS)
@pytest.mark.parametrize("called", RUNS)
def test_note_on_function_of_run_names_it_with_line_and_remedy(called, how):
    function, options = RUNS[called]
    system = LagrangianSystem(kinetic)

    def end(y):
        given = {"dt": 0.1, "num_steps": 2} | options
        return nhjax.integrate(system, METHOD, y, **given).t1

    with pytest.raises(Exception) as error:  # noqa: PT011 -- whatever JAX raises
        TRANSFORMATIONS[how](end)(nhjax.initial_state(system, Q, V))
    assert f"`{called}`" in note_of(error)
    assert place_of(function) in note_of(error)
    assert "JAX arrays without values" in note_of(error)


def test_note_on_partial_function_names_the_function_inside():
    def lagrangian(mass, t, q, v, args):
        return mass * np.sin(q[0])

    system = LagrangianSystem(functools.partial(lagrangian, 2.0))
    with pytest.raises(jax.errors.TracerArrayConversionError) as error:
        nhjax.initial_state(system, Q, V)
    assert place_of(lagrangian) in note_of(error)


def test_note_on_error_of_own_function_keeps_the_message():
    def lagrangian(t, q, v, args):
        raise RuntimeError("my own words")

    with pytest.raises(RuntimeError) as error:
        nhjax.initial_state(LagrangianSystem(lagrangian), Q, V)
    assert error.value.args == ("my own words",)
    assert note_of(error).endswith(", called by nhjax.")
