"""Mistakes in initial states: an exception names the argument, its value, the remedy.

Values are known only at run time under `jit` and `vmap`, where the message comes in a
runtime error of the compiled program. Shapes, dtypes and types are known when tracing:
`tests/test_mistakes.py` has these.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from support.mistakes import (
    Q,
    start,
    system_with,
)


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
        r"D2Φ does not have full rank at q = \[1\. 2\. 3\.\].*admissibility.*fails for "
        r"nonholonomic\[0\] and nonholonomic\[1\]\)\. Remove redundant",
    ),
    "no velocity": (
        adjusted(rows=ROWS.at[1].set(0)),
        nhjax.DependentConstraintsError,
        r"nonholonomic\[1\] with respect to velocities are zero .* as `holonomic`",
    ),
    "incompatible": (
        adjusted(mass=jnp.array([1.0, 1.0, -1.0])),
        nhjax.IncompatibleConstraintsError,
        r"C = D2Φ M⁻¹ D2Φᵀ is singular at q = .*compatibility condition fails "
        r"for nonholonomic\[0\]; reciprocal",
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
def test_initial_state_with_wrong_values_is_refused(case):
    wrong, exception, message = case
    with pytest.raises(exception, match=message):
        start_adjustable(**(GOOD | wrong))


@by_value
def test_initial_state_with_wrong_values_under_jit_is_refused(case, started):
    wrong, exception, message = case
    with pytest.raises(RuntimeError, match=f"{exception.__name__}: .*{message}"):
        jax.block_until_ready(started[0](**(GOOD | wrong)))


@by_value
def test_initial_state_with_one_wrong_member_under_vmap_is_refused(case, started):
    wrong, exception, message = case
    message = f"{exception.__name__}: member 1: .*{message}"
    members = jax.tree.map(lambda *x: jnp.stack(x), GOOD, GOOD | wrong, GOOD)
    with pytest.raises(RuntimeError, match=message):
        jax.block_until_ready(started[1](members))


def test_error_of_compiled_initial_state_has_few_lines(started, caplog):
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
    # JAX would log the message as well.
    assert caplog.records == []


def test_error_of_user_callback_is_logged_as_by_jax(caplog):
    def fail(x):
        raise ValueError("my own words")

    def program(x):
        return jax.pure_callback(fail, jax.ShapeDtypeStruct((), float), x)

    with pytest.raises((RuntimeError, ValueError), match="my own words"):
        jax.block_until_ready(jax.jit(program)(1.0))
    assert any(record.exc_info for record in caplog.records)


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
def test_initial_state_with_correct_values_does_not_call_host(transform, monkeypatch):
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


def test_initial_state_in_compiled_programs_passes_few_arrays_to_host(monkeypatch):
    """XLA compiles a kernel for each array that is passed."""
    pure_callback, numbers = jax.pure_callback, []

    def observed(function, shape, *arrays, **options):
        numbers.append(len(arrays))
        return pure_callback(function, shape, *arrays, **options)

    monkeypatch.setattr(jax, "pure_callback", observed)
    # No other test has traced this system, so that it is traced here.
    system = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v - q[0])
    q = jnp.ones((2, 3))
    jax.make_jaxpr(jax.vmap(lambda q: nhjax.initial_state(system, q, q)))(q)
    # The failed conditions, and the numbers of each dtype.
    assert 1 <= max(numbers) <= 5


def test_first_member_with_any_error_is_named_under_vmap():
    """An input that is not finite, in a later member, is not reported first."""
    q = jnp.array([[1.0, 2.0, 3.0], [1.0, 2.0, 3.0], [jnp.nan, 2.0, 3.0]])
    v = jnp.array([[0.5, 0.0, -0.5], [0.5, 1.0, -0.5], [0.5, 0.0, -0.5]])

    def started(q, v):
        args = GOOD["args"]
        return nhjax.initial_state(ADJUSTABLE, q, v, args=args).v

    with pytest.raises((RuntimeError, ValueError), match="member 1: 1 of 2"):
        jax.block_until_ready(jax.jit(jax.vmap(started))(q, v))
    with pytest.raises((RuntimeError, ValueError), match="member 1: `q` is not finite"):
        jax.block_until_ready(jax.jit(jax.vmap(started))(q[::2], v[::2]))


def test_initial_state_with_correct_values_is_accepted(started):
    expected = start_adjustable(**GOOD)
    for got in (
        started[0](**GOOD),
        jax.tree.map(lambda x: x[0], started[1](jax.tree.map(lambda x: x[None], GOOD))),
    ):
        jax.tree.map(lambda x, y: np.testing.assert_array_equal(x, y), got, expected)


def relativistic(t, q, v, args):
    return -jnp.sqrt(1.0 - v @ v)


def test_initial_state_from_momentum_without_velocity_is_refused():
    # L = v - v²/2 + |v|³/6 has p = 1 - v + v²/2 >= 1/2.
    def lagrangian(t, q, v, args):
        return jnp.sum(v - v**2 / 2 + jnp.abs(v) ** 3 / 6)

    with pytest.raises(nhjax.NewtonError, match=r"D2L.*= p.*p = \[0\.1.*Give `v`"):
        start(system_with(lagrangian=lagrangian), v=None, p=0.1 * jnp.ones(3))


def test_velocity_outside_domain_of_lagrangian_is_reported_as_not_finite():
    with pytest.raises(nhjax.NonFiniteError, match=r"v = \[0\.9.*L = nan"):
        start(system_with(lagrangian=relativistic), v=0.9 * jnp.ones(3))


def test_irregular_lagrangian_is_refused_from_momentum():
    system = system_with(lagrangian=lambda t, q, v, args: v[0] ** 2)
    with pytest.raises(nhjax.IrregularLagrangianError, match=r"p = \[1\. 0\. 0\.\]"):
        start(system, v=None, p=jnp.array([1.0, 0.0, 0.0]))


def test_projection_onto_empty_constraint_is_refused():
    system = system_with(nonholonomic=lambda t, q, v, args: v @ v + 1.0)
    with pytest.raises(nhjax.NewtonError, match=r"projected.*v = .*Φ = .*Start nearer"):
        start(system, project=True)


HEADINGS = np.linspace(0.1, 1.5, 15)


def _skate(constraint):
    def lagrangian(t, q, v, args):
        along = 0.25 * v[2]
        centre = v[:2] + along * jnp.stack([-jnp.sin(q[2]), jnp.cos(q[2])])
        return 0.5 * (centre @ centre) + 0.2 * v[2] ** 2

    return nhjax.LagrangianSystem(lagrangian, nonholonomic=constraint)


def _slip(q, v):
    return v[1] * jnp.cos(q[2]) - v[0] * jnp.sin(q[2])


@pytest.mark.parametrize("speed", [1e-6, 1.0, 300.0])
def test_square_of_constraint_raises_although_its_derivative_is_only_nearly_zero(speed):
    skate = _skate(lambda t, q, v, args: _slip(q, v) ** 2)
    starts = [
        (
            jnp.array([0.0, 0.0, heading]),
            speed * jnp.array([np.cos(heading), np.sin(heading), 1.0]),
        )
        for heading in HEADINGS
    ]
    for q, v in starts:
        with pytest.raises(nhjax.DependentConstraintsError, match="In place of a sq"):
            nhjax.initial_state(skate, q, v)
    report = nhjax.check_system(skate, *starts[0])
    assert report.dependent == ("Φ[0]",)
    assert report.compatibility_condition == np.inf


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_constraint_of_any_scale_is_accepted_at_all_headings(scale):
    skate = _skate(lambda t, q, v, args: scale * _slip(q, v))
    for heading in [*HEADINGS, 0.0]:
        for speed in (0.0, 1e-9, 1.0):
            v = speed * jnp.array([np.cos(heading), np.sin(heading), 1.0])
            q = jnp.array([0.0, 0.0, heading])
            y0 = nhjax.initial_state(skate, q, v)
            assert np.all(np.isfinite(y0.multiplier))


def test_nearly_slow_nonlinear_constraint_is_accepted():
    """The speed is constant, but its derivative is small if the speed is small."""
    for speed in (1e-10, 1e-3, 1.0):
        system = nhjax.LagrangianSystem(
            lambda t, q, v, args: 0.5 * (v @ v),
            nonholonomic=lambda t, q, v, speed: v @ v - speed**2,
        )
        v = speed * jnp.array([0.6, 0.8])
        nhjax.initial_state(system, jnp.zeros(2), v, args=jnp.asarray(speed))


@pytest.mark.parametrize("project", [False, True])
@pytest.mark.parametrize("kind", ["nonholonomic", "holonomic"])
def test_length_as_constraint_raises_because_its_derivative_is_not_finite(
    kind, project
):
    functions = {
        "nonholonomic": lambda t, q, v, args: jnp.linalg.norm(v[:2]),
        "holonomic": lambda t, q, args: jnp.linalg.norm(q[:2]),
    }
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * (v @ v), **{kind: functions[kind]}
    )
    v = jnp.array([0.0, 0.0, 1.0])
    with pytest.raises(nhjax.NonFiniteError, match=r"\[0\], or its derivative with"):
        nhjax.initial_state(system, jnp.zeros(3), v, project=project)
