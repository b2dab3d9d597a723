"""Every mistake has an exception that names the argument, its value and the remedy.

Shapes, dtypes and types are known when tracing. Values are known only at run time under
`jit` and `vmap`, where the message comes in a runtime error of the compiled program.
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import SaveAt
from nhjax.systems import Appell, HarmonicOscillator, NonholonomicParticle


PARTICLE = NonholonomicParticle()
SYSTEM = PARTICLE.system
Q, V = PARTICLE.q0, PARTICLE.v0
METHOD = nhjax.LobattoIIIAB(2)
FREE = nhjax.LagrangianSystem(PARTICLE.lagrangian)
EXPLICIT_RK4 = nhjax.PartitionedRungeKutta(
    [[0, 0, 0, 0], [0.5, 0, 0, 0], [0, 0.5, 0, 0], [0, 0, 1, 0]],
    [1 / 6, 1 / 3, 1 / 3, 1 / 6],
)


@pytest.fixture(scope="module")
def y0():
    return PARTICLE.initial_state()


def start(system: Any = SYSTEM, q: Any = Q, v: Any = V, **others):
    return nhjax.initial_state(system, q, v, **others)


def changed(state, **parts):
    names = tuple(parts)
    return eqx.tree_at(
        lambda y: tuple(getattr(y, name) for name in names),
        state,
        tuple(parts.values()),
    )


def kinetic(t, q, v, args):
    return 0.5 * v @ v


def system_with(**functions: Any):
    arguments: dict[str, Any] = {"lagrangian": kinetic} | functions
    return nhjax.LagrangianSystem(**arguments)


# initial_state: what tracing finds ----------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "exception", "message"),
    [
        ({"q": jnp.ones((2, 3))}, nhjax.ShapeError, r"`q`.*\(2, 3\).*jax.vmap"),
        ({"q": jnp.ones(())}, nhjax.ShapeError, r"`q` has shape \(\)"),
        ({"v": jnp.ones(2)}, nhjax.ShapeError, r"`v`.*\(2,\).*`v` of shape \(3,\)"),
        (
            {"v": None, "p": jnp.ones((3, 1))},
            nhjax.ShapeError,
            r"`p`.*\(3, 1\).*`p` of shape \(3,\)",
        ),
        ({"t": jnp.zeros(4)}, nhjax.ShapeError, r"`t` has shape \(4,\).*jax.vmap"),
        ({"q": jnp.array([1, 0, 0])}, nhjax.DTypeError, r"`q`.*int64.*write 1.0 for 1"),
        ({"v": jnp.array([1, 0, 0])}, nhjax.DTypeError, "`v` has dtype int64"),
        (
            {"v": V.astype(jnp.float32)},
            nhjax.DTypeError,
            "`v` has dtype float32, but `q` has float64",
        ),
        (
            {"q": Q.astype(jnp.float32)},
            nhjax.DTypeError,
            "`v` has dtype float64, but `q` has float32",
        ),
        ({"q": Q.astype(complex)}, nhjax.DTypeError, "`q` has dtype complex128"),
        ({"v": jnp.ones(3, bool)}, nhjax.DTypeError, "`v` has dtype bool"),
        ({"q": Q.astype(jnp.float16)}, nhjax.DTypeError, r"`q`.*float16.*float32 or"),
        ({"q": None}, nhjax.DTypeError, "`q` must be an array of floats, got None"),
        ({"q": "rest"}, nhjax.DTypeError, "`q`.*got 'rest' of type str"),
        ({"t": None}, nhjax.DTypeError, "`t` must be a real number, got None"),
        ({"t": 1j}, nhjax.DTypeError, "`t` must be a real number, got 1j"),
        ({"project": "yes"}, TypeError, "`project` must be True or False.*got 'yes'"),
        ({"project": 1}, TypeError, "`project` must be True or False.*got 1 of.*int"),
        (
            {"args": {"mass": 1.0, "names": [2, {"a", "b"}]}},
            TypeError,
            r"`args\['names'\]\[1\]` is .*of type set: .*must be hashable",
        ),
        ({"v": None}, ValueError, "Give either `v` or `p`; got neither"),
        ({"p": V}, ValueError, "Give either `v` or `p`; got both"),
        (
            {"system": kinetic},
            TypeError,
            "`system`.*nhjax.LagrangianSystem.*, got <func",
        ),
        ({"system": PARTICLE}, TypeError, r"NonholonomicParticle; pass .*`\.system`"),
        (
            {"system": nhjax.LagrangianSystem},
            TypeError,
            r"the class itself; write LagrangianSystem\(\.\.\.\)",
        ),
        (
            {"system": system_with(manifold=nhjax.Euclidean(2))},
            nhjax.ShapeError,
            r"`q` has shape \(3,\).*Euclidean\(2\).*\(2,\)",
        ),
    ],
)
def test_initial_state_refuses(arguments, exception, message):
    with pytest.raises(exception, match=message):
        start(**arguments)


@pytest.mark.parametrize(
    ("functions", "exception", "message"),
    [
        (
            {"lagrangian": lambda t, q, v, args: v * v},
            nhjax.ShapeError,
            r"`lagrangian.*shape \(\), a scalar, got shape \(3,\)",
        ),
        (
            {"lagrangian": lambda t, q, v, args: None},
            nhjax.ShapeError,
            r"`lagrangian.*an array of shape \(\).*got None of type NoneType",
        ),
        (
            {"lagrangian": lambda t, q, v, args: jnp.int32(1)},
            nhjax.DTypeError,
            "`lagrangian.*dtype int32, but `q` has float64",
        ),
        (
            {"nonholonomic": lambda t, q, v, args: jnp.concatenate([v, v[:1]])},
            nhjax.ShapeError,
            r"`nonholonomic.*1 <= m <= 3, .*got shape \(4,\)",
        ),
        (
            {"nonholonomic": lambda t, q, v, args: v[None]},
            nhjax.ShapeError,
            r"`nonholonomic.*got shape \(1, 3\)",
        ),
        (
            {"nonholonomic": lambda t, q, v, args: v[:0]},
            nhjax.ShapeError,
            r"`nonholonomic.*got shape \(0,\)",
        ),
        (
            {"nonholonomic": lambda t, q, v, args: [v[0], v[1]]},
            nhjax.ShapeError,
            "`nonholonomic.*of type list",
        ),
        (
            {"force": lambda t, q, v, args: v[0]},
            nhjax.ShapeError,
            r"`force.*must return shape \(3,\), got shape \(\)",
        ),
    ],
)
def test_initial_state_refuses_functions(functions, exception, message):
    with pytest.raises(exception, match=message):
        start(system_with(**functions))


# initial_state: what values decide ----------------------------------------------------


def adjustable_lagrangian(t, q, v, args):
    return 0.5 * args["mass"] @ v**2 - args["well"] * jnp.log(q[2])


# One program in which `args` decides what is wrong.
ADJUSTABLE = nhjax.LagrangianSystem(
    adjustable_lagrangian,
    nonholonomic=lambda t, q, v, args: args["rows"] @ v,
    force=lambda t, q, v, args: args["force"],
)
ROWS = jnp.array([[1.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
GOOD = {
    "q": jnp.array([1.0, 2.0, 3.0]),
    "v": jnp.array([0.5, 0.0, -0.5]),
    "t": jnp.asarray(0.0),
    "args": {
        "mass": jnp.array([1.0, 1.0, 2.0]),
        "well": jnp.asarray(1.0),
        "rows": ROWS,
        "force": jnp.zeros(3),
    },
}


def adjusted(**args):
    return {"args": GOOD["args"] | args}


# What is wrong; the exception; its message, which a compiled program gives as well.
BY_VALUE = {
    "q": (
        {"q": jnp.array([jnp.inf, 2.0, 3.0])},
        nhjax.NonFiniteError,
        r"`q` is not finite: \[inf",
    ),
    "v": (
        {"v": jnp.array([jnp.nan, 0.0, 0.0])},
        nhjax.NonFiniteError,
        r"`v` is not finite: \[nan",
    ),
    "t": (
        {"t": jnp.asarray(jnp.nan)},
        nhjax.NonFiniteError,
        "`t` is not finite: nan",
    ),
    "second of two constraints": (
        {"v": jnp.array([0.5, 0.25, -0.5])},
        nhjax.ConstraintViolationError,
        r"1 of 2 nonholonomic.*: Φ\[1\] = 0\.25 \(allowed .*`project=True`",
    ),
    "both constraints": (
        {"v": jnp.array([0.5, 0.25, 0.0])},
        nhjax.ConstraintViolationError,
        r"2 of 2 .*Φ\[0\] = 0\.5 .*Φ\[1\] = 0\.25 ",
    ),
    "dependent": (
        adjusted(rows=jnp.stack([ROWS[0], 2 * ROWS[0]])),
        nhjax.DependentConstraintsError,
        r"D2Φ has not full rank at q = \[1\. 2\. 3\.\].*admissibility.*fails for "
        r"Φ\[0\] and Φ\[1\]\)\. Remove redundant",
    ),
    "no velocity": (
        adjusted(rows=ROWS.at[1].set(0)),
        nhjax.DependentConstraintsError,
        r"Φ\[1\] does not depend on velocities there; pass .* as `holonomic`",
    ),
    "incompatible": (
        adjusted(mass=jnp.array([1.0, 1.0, -1.0])),
        nhjax.IncompatibleConstraintsError,
        r"C = D2Φ M⁻¹ D2Φᵀ is singular at q = .*compatibility condition",
    ),
    "irregular": (
        adjusted(mass=jnp.array([1.0, 1.0, 0.0])),
        nhjax.IrregularLagrangianError,
        "mass matrix D2D2L is singular at q = .*Give every coordinate a kinetic energy",
    ),
    "Lagrangian": (
        {"q": jnp.array([1.0, 2.0, -3.0])},
        nhjax.NonFiniteError,
        "Lagrangian.* not finite at q = .*L = nan",
    ),
    "mass": (
        adjusted(mass=jnp.array([1.0, 1.0, jnp.nan])),
        nhjax.NonFiniteError,
        "Lagrangian, its second derivatives in v.* not finite at q = ",
    ),
    "force": (
        adjusted(force=jnp.array([0.0, jnp.inf, 0.0])),
        nhjax.NonFiniteError,
        r"forces D1L \+ F.* not finite at q = ",
    ),
}
by_value = pytest.mark.parametrize("case", BY_VALUE.values(), ids=BY_VALUE.keys())


def start_adjustable(q, v, t, args):
    return nhjax.initial_state(ADJUSTABLE, q, v, t=t, args=args)


@pytest.fixture(scope="module")
def started():
    """The same, compiled: for one state, and for a batch of them."""
    batch = eqx.filter_jit(jax.vmap(lambda given: start_adjustable(**given)))
    return jax.jit(start_adjustable), batch


@by_value
def test_initial_state_refuses_values(case):
    wrong, exception, message = case
    with pytest.raises(exception, match=message):
        start_adjustable(**(GOOD | wrong))


@by_value
def test_initial_state_refuses_values_under_jit(case, started):
    wrong, exception, message = case
    with pytest.raises(RuntimeError, match=f"{exception.__name__}: .*{message}"):
        jax.block_until_ready(started[0](**(GOOD | wrong)))


@by_value
def test_initial_state_refuses_one_lane_under_vmap(case, started):
    wrong, exception, message = case
    message = f"{exception.__name__}: lane 1: .*{message}"
    lanes = jax.tree.map(lambda *x: jnp.stack(x), GOOD, GOOD | wrong, GOOD)
    with pytest.raises(RuntimeError, match=message):
        jax.block_until_ready(started[1](lanes))


def test_a_failure_of_a_compiled_program_is_told_in_few_lines(started, caplog):
    wrong = GOOD | {"v": jnp.array([0.5, 0.25, -0.5])}
    with pytest.raises(nhjax.ConstraintViolationError) as eager:
        start_adjustable(**wrong)
    with pytest.raises((RuntimeError, ValueError)) as compiled:
        jax.block_until_ready(started[0](**wrong))
    line = f"ConstraintViolationError: {eager.value}"
    text = str(compiled.value)
    assert f"{line}\n" in f"{text}\n"
    # The frames of Python from the main program to the call-back are left out.
    before = text[: text.index(line)].splitlines()
    assert len(before) == 2
    assert "_within_a_compiled_program" in before[1]
    # What JAX logs of it is that line, without a traceback.
    (record,) = caplog.records
    assert record.getMessage() == line
    assert record.exc_info is None


@pytest.mark.parametrize(
    "transform",
    [
        lambda f: f(Q),
        lambda f: jax.vmap(f)(jnp.stack([Q, Q])),
        lambda f: jax.vmap(jax.jacfwd(f))(jnp.stack([Q, Q])),
        lambda f: jax.jacrev(f)(Q),
    ],
    ids=["plain", "vmap", "vmap of jacfwd", "jacrev"],
)
def test_checks_that_hold_do_not_call_the_host(transform, monkeypatch):
    pure_callback, traced, called = jax.pure_callback, [], []

    def observed(function, *others, **options):
        def call(*arguments):
            called.append(function)
            return function(*arguments)

        traced.append(function)
        return pure_callback(call, *others, **options)

    monkeypatch.setattr(jax, "pure_callback", observed)
    # What was traced before is traced again.
    jax.clear_caches()
    jax.block_until_ready(jax.jit(lambda: transform(lambda q: start(q=q + 0.0).v))())
    assert traced
    assert not called


def test_initial_state_accepts_the_others(started):
    expected = start_adjustable(**GOOD)
    for got in (
        started[0](**GOOD),
        jax.tree.map(lambda x: x[0], started[1](jax.tree.map(lambda x: x[None], GOOD))),
    ):
        jax.tree.map(lambda x, y: np.testing.assert_array_equal(x, y), got, expected)


def relativistic(t, q, v, args):
    return -jnp.sqrt(1.0 - v @ v)


def test_a_momentum_without_a_velocity():
    # L = v - v²/2 + |v|³/6 has p = 1 - v + v²/2 >= 1/2.
    def lagrangian(t, q, v, args):
        return jnp.sum(v - v**2 / 2 + jnp.abs(v) ** 3 / 6)

    with pytest.raises(nhjax.NewtonError, match=r"D2L.*= p.*p = \[0\.1.*Give `v`"):
        start(system_with(lagrangian=lagrangian), v=None, p=0.1 * jnp.ones(3))


def test_a_velocity_beyond_the_domain_is_not_called_irregular():
    with pytest.raises(nhjax.NonFiniteError, match=r"v = \[0\.9.*L = nan"):
        start(system_with(lagrangian=relativistic), v=0.9 * jnp.ones(3))


def test_an_irregular_lagrangian_is_found_from_a_momentum_too():
    system = system_with(lagrangian=lambda t, q, v, args: v[0] ** 2)
    with pytest.raises(nhjax.IrregularLagrangianError, match=r"p = \[1\. 0\. 0\.\]"):
        start(system, v=None, p=jnp.array([1.0, 0.0, 0.0]))


def test_a_projection_that_cannot_succeed():
    system = system_with(nonholonomic=lambda t, q, v, args: v @ v + 1.0)
    with pytest.raises(nhjax.NewtonError, match=r"projected.*v = .*Φ = .*Start nearer"):
        start(system, project=True)


# LagrangianSystem, methods, solvers ---------------------------------------------------


@pytest.mark.parametrize("name", ["lagrangian", "nonholonomic", "force"])
def test_functions_must_be_functions(name):
    with pytest.raises(TypeError, match=rf"`{name}`.*\(t, q, v, args\), got 3"):
        system_with(**{name: 3})


class Methods(eqx.Module):
    """A function of a system may be a method, or the module itself."""

    def short(self, t, q, v):
        return 0.5 * v @ v

    def __call__(self, t, q, v, args, more):
        return 0.5 * v @ v


@pytest.mark.parametrize(
    ("name", "function", "message"),
    [
        ("lagrangian", lambda t, q, v: 0.5 * v @ v, r"\(t, q, v, args\).*\(t, q, v\)`"),
        (
            "nonholonomic",
            lambda t, q, args: q,
            r"\(t, q, v, args\), but `<lambda>\(t, q, args\)`",
        ),
        (
            "holonomic",
            lambda t, q, v, a: q @ q,
            r"\(t, q, args\), but `<lambda>\(t, q, v, a\)` does not",
        ),
        ("force", lambda v: v, r"\(t, q, v, args\), but `<lambda>\(v\)` does not"),
        ("force", jax.jit(lambda t, q, v: v), r".*but `<lambda>\(t, q, v\)` does not"),
        ("lagrangian", Methods().short, r".*but `short\(t, q, v\)` does not"),
        ("lagrangian", Methods(), r".*but `Methods\(t, q, v, args, more\)` does not"),
        (
            "force",
            lambda t, q, v, args, *, gain: v,
            r".*but `<lambda>\(t, q, v, args, \*, gain\)` does not",
        ),
    ],
)
def test_functions_must_take_the_arguments_they_are_called_with(
    name, function, message
):
    with pytest.raises(
        TypeError, match=rf"LagrangianSystem: `{name}` must take {message}"
    ):
        system_with(**{name: function})


def test_functions_of_momenta_must_take_the_arguments_they_are_called_with():
    message = (
        r"HamiltonianSystem: `hamiltonian` must take \(t, q, p, args\), but .*p\)`"
    )
    with pytest.raises(TypeError, match=message):
        nhjax.HamiltonianSystem(lambda t, q, p: 0.5 * p @ p)  # pyright: ignore


def test_functions_whose_arguments_cannot_be_known_are_accepted():
    def without_args(function):
        @functools.wraps(function)
        def called(t, q, v, args):
            return function(t, q, v)

        return called

    for lagrangian in (
        without_args(lambda t, q, v: 0.5 * v @ v),
        functools.partial(lambda mass, t, q, v, args: mass * v @ v, 2.0),
        lambda *anything: kinetic(*anything),
        max,
    ):
        system_with(lagrangian=lagrangian)


def test_an_error_inside_a_function_is_its_own():
    def lagrangian(t, q, v, args):
        return kinetic(t, q, v)  # pyright: ignore[reportCallIssue]

    with pytest.raises(TypeError, match=r"^kinetic\(\) missing 1 required positional"):
        start(system_with(lagrangian=lagrangian))


def test_manifold_must_be_one():
    with pytest.raises(TypeError, match=r"`manifold`.*nhjax\.Euclidean\(3\), got 3"):
        system_with(manifold=3)


@pytest.mark.parametrize("solver", [nhjax.Newton, nhjax.SimplifiedNewton])
@pytest.mark.parametrize("count", [0, 2.5])
def test_max_iterations(solver, count):
    with pytest.raises(ValueError, match=f"{solver.__name__}: `max_iterations`.*got"):
        solver(max_iterations=count)


# SaveAt -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "exception", "message"),
    [
        ({}, ValueError, "nothing is saved. Ask for some of `t0`"),
        ({"steps": 0}, ValueError, "nothing is saved"),
        ({"steps": -3}, ValueError, "`steps` must be a bool or an int >= 1, got -3"),
        ({"steps": 2.0}, ValueError, "`steps`.*got 2.0"),
        ({"steps": None}, ValueError, "`steps`.*got None"),
        ({"ts": [0.1], "steps": 2}, ValueError, "`ts` or `steps`, not both.*dense"),
        ({"ts": [0.1, 0.3, 0.2]}, ValueError, "`ts` must be sorted in the direction"),
        ({"ts": [0.1, np.nan]}, nhjax.NonFiniteError, r"`ts` is not finite: \[0\.1"),
        ({"ts": np.ones((2, 2))}, ValueError, r"`ts`.*shape \(k,\).*got \(2, 2\)"),
        ({"ts": []}, ValueError, r"`ts`.*k >= 1, got \(0,\)"),
        ({"ts": 0.1}, ValueError, r"`ts`.*got \(\)"),
        ({"ts": [1j]}, nhjax.DTypeError, "`ts` must be real, got dtype complex128"),
        ({"t1": True, "fn": 3}, ValueError, r"`fn`.*\(t, y, args\), got 3"),
        # diffrax takes the end of the run where this takes a flag.
        ({"t1": 5.0}, ValueError, "`t1` must be True or False, got 5.0; times belong"),
        ({"t0": 0, "t1": True}, ValueError, "`t0` must be True or False, got 0"),
        ({"dense": "yes"}, ValueError, "`dense` must be True or False, got 'yes'"),
    ],
)
def test_save_at_refuses(arguments, exception, message):
    with pytest.raises(exception, match=f"SaveAt: .*{message}"):
        SaveAt(**arguments)


# integrate: what tracing finds --------------------------------------------------------


def run(y0, system: Any = SYSTEM, method: Any = METHOD, **others):
    arguments: dict[str, Any] = {"dt": 0.1, "num_steps": 4} | others
    return nhjax.integrate(system, method, y0, **arguments)


@pytest.mark.parametrize(
    ("arguments", "exception", "message"),
    [
        ({"num_steps": 0}, ValueError, "`num_steps` must be in 1.*got 0"),
        ({"num_steps": -1}, ValueError, "`num_steps` must be in 1.*got -1"),
        ({"num_steps": 2**31}, ValueError, r"2\^31 - 1, got 2147483648"),
        (
            {"num_steps": 4.0},
            TypeError,
            "`num_steps` must be an int.*got 4.0 of.*float",
        ),
        ({"num_steps": True}, TypeError, "`num_steps` must be an int.*got True"),
        ({"dt": 0.0}, ValueError, "`dt` is zero; give a positive or negative"),
        ({"dt": 0}, ValueError, "`dt` is zero"),
        ({"dt": np.nan}, nhjax.NonFiniteError, "`dt` is not finite: nan"),
        ({"dt": np.inf}, nhjax.NonFiniteError, "`dt` is not finite: inf"),
        ({"dt": jnp.ones(3)}, nhjax.ShapeError, r"`dt`.*\(3,\).*jax.vmap"),
        ({"dt": 0.1j}, nhjax.DTypeError, "`dt` must be a real number, got 0.1j"),
        ({"dt": True}, nhjax.DTypeError, "`dt` must be a real number, got True"),
        ({"dt": "0.1"}, nhjax.DTypeError, "`dt` must be a real number, got '0.1'"),
        ({"dt": None}, nhjax.DTypeError, "`dt` must be a real number, got None"),
        ({"t0": np.nan}, nhjax.NonFiniteError, "`t0` is not finite: nan"),
        ({"t0": jnp.ones((1, 1))}, nhjax.ShapeError, r"`t0` has shape \(1, 1\)"),
        ({"system": kinetic}, TypeError, "`system` must be an nhjax.LagrangianSystem"),
        ({"system": PARTICLE}, TypeError, r"NonholonomicParticle; pass .*`\.system`"),
        ({"method": 3}, TypeError, r"`method`.*got 3 of type int.*LobattoIIIAB\(3\)"),
        (
            {"method": nhjax.LobattoIIIAB},
            TypeError,
            r"`method`.*the class itself; write LobattoIIIAB\(\.\.\.\)",
        ),
        (
            {"stage_solver": "newton"},
            TypeError,
            r"`stage_solver`.*got 'newton'.*nhjax\.Newton\(\)",
        ),
        ({"saveat": True}, TypeError, "`saveat` must be an nhjax.SaveAt, got True"),
        (
            {"progress_meter": True},
            TypeError,
            "`progress_meter`.*got True of type bool",
        ),
        ({"method": nhjax.Gauss(2)}, ValueError, r"Gauss\(stages=2\).*hypothesis H1"),
        (
            {"saveat": SaveAt(steps=5)},
            ValueError,
            "`steps=5` saves nothing in a run of 4 steps. Add `t1=True`",
        ),
        (
            {"saveat": SaveAt(ts=[0.1, 0.5])},
            ValueError,
            "`ts` reaches from 0.1 to 0.5, outside the run from 0.0 to 0.4",
        ),
        ({"saveat": SaveAt(ts=[-0.1, 0.1])}, ValueError, "`ts` reaches from -0.1"),
        (
            {"saveat": SaveAt(ts=[0.2, 0.1])},
            ValueError,
            "`ts` must be sorted in the direction of time, which runs forward",
        ),
        (
            {"saveat": SaveAt(ts=[-0.2, -0.1]), "dt": -0.1},
            ValueError,
            "`ts` must be sorted in the direction of time, which runs backward",
        ),
    ],
)
def test_integrate_refuses(arguments, exception, message, y0):
    with pytest.raises(exception, match=message):
        run(y0, **arguments)


def test_integrate_refuses_args_that_cannot_be_compiled_in(y0):
    with pytest.raises(TypeError, match=r"`args\[0\]` is \{3\} of type set"):
        run(y0, args=({3},))


def test_a_traced_number_of_steps(y0):
    with pytest.raises(TypeError, match=r"known when tracing.*static argument.*Tracer"):
        jax.jit(lambda n: run(y0, num_steps=n, saveat=SaveAt(steps=True)))(4)


@pytest.mark.parametrize("saveat", [SaveAt(dense=True), SaveAt(ts=[0.1])])
def test_dense_output_needs_a_collocation_method(saveat):
    y0 = nhjax.initial_state(FREE, Q, V)
    with pytest.raises(ValueError, match=r"C\(q\) for q >= stages = 4.*q = 1\. Use Lo"):
        run(y0, FREE, EXPLICIT_RK4, saveat=saveat)


@pytest.mark.parametrize(
    ("part", "value", "exception", "message"),
    [
        ("q", jnp.ones(2), nhjax.ShapeError, r"`y0.v`.*\(3,\).*`y0.q` needs \(2,\)"),
        ("q", jnp.ones(()), nhjax.ShapeError, r"`y0.q` has shape \(\)"),
        ("v", jnp.ones(4), nhjax.ShapeError, r"`y0.v`.*\(4,\).*`y0.q` needs \(3,\)"),
        ("p", jnp.ones(4), nhjax.ShapeError, r"`y0.p` has shape \(4,\)"),
        ("multiplier", jnp.ones(2), nhjax.ShapeError, r"`y0.mult.*\(2,\).*\(1,\)"),
        ("q", jnp.ones(3, jnp.float32), nhjax.DTypeError, "`y0.q` has dtype float32"),
        ("v", jnp.ones(3, int), nhjax.DTypeError, "`y0.v` has dtype int64"),
        ("p", jnp.ones(3, jnp.float32), nhjax.DTypeError, "and `y0.p` float32"),
        ("multiplier", jnp.ones(1, complex), nhjax.DTypeError, "`y0.mult.*complex128"),
        ("v", [0.4, 0.7, 0.12], TypeError, "`y0.v` must be an array, got .*float"),
        ("multiplier", None, TypeError, "`y0.multiplier` must be an array, got None"),
        ("q", jnp.full(3, jnp.nan), nhjax.NonFiniteError, r"`y0.q`.*finite: \[nan"),
        ("v", jnp.full(3, jnp.inf), nhjax.NonFiniteError, r"`y0.v`.*finite: \[inf"),
        ("p", jnp.full(3, jnp.nan), nhjax.NonFiniteError, r"`y0.p`.*finite: \[nan"),
        ("multiplier", jnp.full(1, jnp.nan), nhjax.NonFiniteError, r"`y0.mult.*\[nan"),
    ],
)
def test_integrate_refuses_states(part, value, exception, message, y0):
    with pytest.raises(exception, match=message):
        run(changed(y0, **{part: value}))


def test_a_batch_of_states_without_vmap(y0):
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), y0)
    with pytest.raises(nhjax.ShapeError, match=r"`y0.q`.*\(2, 3\).*`jax.vmap` over"):
        run(batch)


def test_a_whole_trajectory_as_a_state(y0):
    sol = run(y0)
    with pytest.raises(
        nhjax.ShapeError, match=r"tree.map\(lambda x: x\[-1\], sol.ys\)"
    ):
        run(sol.ys)
    with pytest.raises(TypeError, match=r"`y0` must be an nhjax.State, got Solution"):
        run(sol)


def test_states_of_another_system(y0):
    oscillator = HarmonicOscillator(q0=(1.0, 0.0, 0.0), v0=(0.0, 1.0, 0.0))
    with pytest.raises(nhjax.ShapeError, match=r"`y0.multiplier`.*\(0,\).*\(1,\). Use"):
        run(oscillator.initial_state())
    with pytest.raises(nhjax.ShapeError, match=r"`y0.multiplier`.*\(1,\).*\(0,\)"):
        run(y0, oscillator.system)
    with pytest.raises(TypeError, match=r"got \(Array.*of type tuple. Make one with"):
        run((Q, V))


# A state that is well-formed, but no state of this system at this time.
INCONSISTENT = {
    "v by hand": lambda y0: changed(y0, v=y0.v + jnp.array([0.0, 0.1, 0.0])),
    "p by hand": lambda y0: changed(y0, p=1.01 * y0.p),
    "q by hand": lambda y0: changed(y0, q=y0.q.at[1].add(0.1)),
    "other mass": lambda y0: NonholonomicParticle(mass=2.0).initial_state(),
}


@pytest.mark.parametrize("change", INCONSISTENT.values(), ids=INCONSISTENT.keys())
def test_inconsistent_initial_states(change, y0):
    with pytest.raises(nhjax.IntegrationError, match="step 0: The initial state viola"):
        run(change(y0))


def test_small_perturbations_are_no_inconsistency(y0):
    # Differences for a derivative take the states off the constraint.
    sol = run(changed(y0, q=y0.q.at[1].add(1e-5)))
    assert sol.result == nhjax.RESULTS.successful
    np.testing.assert_allclose(sol.stats["max_constraint_violation"], 4e-6, rtol=1e-9)


def test_a_start_at_another_time():
    system = nhjax.LagrangianSystem(
        kinetic, nonholonomic=lambda t, q, v, args: v[0] - jnp.cos(t)
    )
    y0 = nhjax.initial_state(system, jnp.zeros(2), jnp.array([1.0, 0.0]))
    with pytest.raises(nhjax.IntegrationError, match="constraints at `t0`"):
        run(y0, system, t0=0.5)


# integrate: what values decide, under jit and vmap ------------------------------------


GIVEN = {"dt": 0.1, "t0": 0.0, "ts": jnp.array([0.1, 0.2, 0.25])}
AT_RUN_TIME = {
    "dt zero": ({"dt": 0.0}, "`dt` is zero; give a positive or negative step size"),
    "dt nan": ({"dt": np.nan}, "`dt` is not finite: nan"),
    "t0 nan": ({"t0": np.nan}, "`t0` is not finite: nan"),
    "ts outside": (
        {"ts": jnp.array([0.1, 0.2, 0.9])},
        r"SaveAt: `ts` reaches from 0\.1 to 0\.9, outside the run from 0\.0 to 0\.4",
    ),
    "ts nan": (
        {"ts": jnp.array([0.1, 0.2, np.nan])},
        r"SaveAt: `ts` reaches from nan to nan, outside the run from 0\.0 to 0\.4",
    ),
    "ts unsorted": (
        {"ts": jnp.array([0.2, 0.1, 0.3])},
        "SaveAt: `ts` must be sorted in the direction of time, which runs forward here",
    ),
    **{
        f"y0.{part} nan": ({part: np.nan}, "step 0: The state became .* from the start")
        for part in ("q", "v", "p", "multiplier")
    },
    "y0.v by hand": ({"v": 2.0}, "step 0: The initial state violates"),
}
at_run_time = pytest.mark.parametrize(
    "case", AT_RUN_TIME.values(), ids=AT_RUN_TIME.keys()
)


def sampled(y0, dt, t0, ts, **factors):
    parts = {name: getattr(y0, name) * factor for name, factor in factors.items()}
    return run(changed(y0, **parts), dt=dt, t0=t0, saveat=SaveAt(ts=ts)).ys.q


@pytest.fixture(scope="module")
def compiled(y0):
    one = dict.fromkeys(("q", "v", "p", "multiplier"), 1.0)
    single = jax.jit(lambda given: sampled(y0, **given))
    batch = jax.jit(jax.vmap(lambda given: sampled(y0, **given)))
    good = jax.tree.map(jnp.asarray, GIVEN | one)
    return single, batch, good


@at_run_time
def test_integrate_refuses_values_under_jit(case, compiled):
    wrong, message = case
    single, _, good = compiled
    with pytest.raises(RuntimeError, match=message):
        jax.block_until_ready(single(good | jax.tree.map(jnp.asarray, wrong)))


@at_run_time
def test_integrate_refuses_one_lane_under_vmap(case, compiled):
    wrong, message = case
    _, batch, good = compiled
    bad = good | jax.tree.map(jnp.asarray, wrong)
    lanes = jax.tree.map(lambda *x: jnp.stack(x), good, bad)
    if message.startswith("step"):
        message = f"Integration failed in lane 1, {message}"
    else:
        message = f"Error: lane 1: {message}"
    with pytest.raises(RuntimeError, match=message):
        jax.block_until_ready(batch(lanes))


def test_integrate_accepts_the_others(compiled, y0):
    single, batch, good = compiled
    expected = sampled(y0, **GIVEN)
    assert jnp.all(jnp.isfinite(expected))
    np.testing.assert_allclose(single(good), expected, rtol=1e-14)
    lanes = jax.tree.map(lambda x: x[None], good)
    np.testing.assert_allclose(batch(lanes)[0], expected, rtol=1e-14)


# Failures along the way ---------------------------------------------------------------


def fall(speed, **others):
    """A particle of Appell's; rising, it comes to the apex where D2Φ vanishes."""
    appell = Appell()
    y0 = nhjax.initial_state(
        appell.system, appell.q0, speed * jnp.asarray([0.3, 0.4, 1])
    )
    return nhjax.integrate(
        appell.system, nhjax.LobattoIIIAB(3), y0, dt=0.05, num_steps=20, **others
    )


def test_a_failure_names_step_and_reason():
    with pytest.raises(
        nhjax.IntegrationError,
        match=r"^Integration failed in step 1[0-2]: .* With `throw=False` the part",
    ):
        fall(jnp.asarray(0.5))


def test_a_failure_names_step_and_reason_under_jit():
    with pytest.raises(RuntimeError, match=r"Integration failed in step 1[0-2]: "):
        jax.block_until_ready(jax.jit(lambda v: fall(v).ys.q)(0.5))


def test_a_failure_names_the_lane_under_vmap():
    speeds = jnp.array([-1.0, 0.5, -0.5, 0.25])
    message = r"Integration failed in lane 1, step 1[0-2] \(1 more lanes failed\): "
    with pytest.raises(RuntimeError, match=message):
        jax.block_until_ready(jax.jit(jax.vmap(fall))(speeds))
    message = (
        r"Integration failed in lane \(0, 1\), step 1[0-2] \(1 more lanes failed\): "
    )
    with pytest.raises(RuntimeError, match=message):
        jax.block_until_ready(jax.jit(jax.vmap(jax.vmap(fall)))(speeds.reshape(2, 2)))


def test_every_part_of_the_solution_waits_for_the_verdict():
    with pytest.raises(RuntimeError, match=r"Integration failed in step 1[0-2]"):
        jax.block_until_ready(jax.jit(lambda v: fall(v).t1)(0.5))


def test_failures_need_a_computed_solution():
    with pytest.raises(RuntimeError, match=r"outside jit and vmap.*`sol.result`"):
        jax.jit(lambda v: fall(v, throw=False).failures())(0.5)


# Solution.evaluate --------------------------------------------------------------------


@pytest.fixture(scope="module")
def dense(y0):
    return run(y0, saveat=SaveAt(dense=True))


@pytest.mark.parametrize(
    ("t", "exception", "message"),
    [
        (0.5, ValueError, r"`t` = 0\.5 lies outside the run, from 0\.0 to 0\.4"),
        (-0.01, ValueError, r"`t` = -0\.01 lies outside the run"),
        (np.nan, ValueError, "`t` = nan lies outside the run"),
        (jnp.array([0.1, 0.2]), nhjax.ShapeError, r"`t` has shape \(2,\).*`jax.vmap`"),
        (None, nhjax.DTypeError, "`t` must be a real number, got None"),
        ("end", nhjax.DTypeError, "`t` must be a real number, got 'end'"),
        (0.1j, nhjax.DTypeError, "`t` must be a real number, got 0.1j"),
    ],
)
def test_evaluate_refuses(t, exception, message, dense):
    with pytest.raises(exception, match=message):
        dense.evaluate(t)


def test_evaluate_without_dense_output(y0):
    with pytest.raises(ValueError, match=r"pass `saveat=nhjax.SaveAt\(dense=True\)`"):
        run(y0).evaluate(0.1)


def test_evaluate_outside_under_jit_and_vmap(dense):
    outside = r"`t` = 0\.5 lies outside the run, from 0\.0 to 0\.4"
    with pytest.raises(RuntimeError, match=outside):
        jax.block_until_ready(jax.jit(lambda t: dense.evaluate(t))(0.5))
    with pytest.raises(RuntimeError, match=f"lane 1: Solution.evaluate: {outside}"):
        jax.block_until_ready(jax.vmap(dense.evaluate)(jnp.array([0.1, 0.5])))


def test_evaluate_of_a_batch(y0):
    batch = jax.vmap(lambda dt: run(y0, dt=dt, saveat=SaveAt(dense=True)))(
        jnp.array([0.1, 0.2])
    )
    with pytest.raises(
        ValueError, match=r"batch of shape \(2,\).*jax.vmap\(lambda sol"
    ):
        batch.evaluate(0.1)
    q = jax.vmap(lambda sol: sol.evaluate(0.1))(batch).q
    assert q.shape == (2, 3)
