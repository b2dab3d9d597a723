"""What is refused on groups, with holonomic constraints and in Hamiltonian form."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import systems
from support.long import long


BODY = systems.FreeRigidBody()
BALL = systems.TurntableBall()
PENDULUM = systems.SphericalPendulum()
IDENTITY = jnp.array([1.0, 0.0, 0.0, 0.0])
SPIN = jnp.array([0.1, 0.2, 0.3])
METHOD = nhjax.LobattoIIIAB(3)


def started(system, q=IDENTITY, v=SPIN, **options):
    return nhjax.initial_state(system, q, v, **options)


# Elements of the group ----------------------------------------------------------------


def test_initial_state_off_group_is_refused():
    with pytest.raises(
        nhjax.ConstraintViolationError,
        match=r"`q` = \[1\.1 .*not an element of the group SO3.*off by 0\.1.*normalise",
    ):
        started(BODY.system, 1.1 * IDENTITY)


def test_initial_state_off_group_under_jit_is_refused():
    start = jax.jit(lambda q: started(BODY.system, q))
    with pytest.raises(
        RuntimeError,
        match=r"`q` = \[1\.1 .*not an element of the group SO3.*off by 0\.1",
    ):
        jax.block_until_ready(start(1.1 * IDENTITY))


def test_projection_of_element_off_group_returns_to_group():
    y = started(BODY.system, 1.1 * IDENTITY, project=True)
    np.testing.assert_allclose(y.q, IDENTITY, rtol=3e-16)


def test_integrate_from_state_off_group_is_refused():
    y0 = started(BODY.system)
    y0 = nhjax.State(1.1 * y0.q, y0.v, y0.p, y0.multiplier)
    with pytest.raises(
        nhjax.IntegrationError, match=r"step 0: .*q is not an element of"
    ):
        nhjax.integrate(BODY.system, METHOD, y0, dt=0.1, num_steps=1)


@pytest.mark.parametrize(
    ("q", "message"),
    [
        (IDENTITY, r"tuple of 2 elements.*ProductGroup"),
        ((IDENTITY, jnp.zeros(3)), r"q\[1\].*\(3,\).*\(2,\)"),
        ((IDENTITY, jnp.zeros(2), jnp.zeros(1)), r"2 .*got.*3|3.*2"),
    ],
)
def test_initial_state_on_group_with_wrong_shape_is_refused(q, message):
    with pytest.raises((nhjax.ShapeError, TypeError), match=message):
        nhjax.initial_state(BALL.system, q, jnp.zeros(5))


def test_tuple_as_configuration_without_manifold_is_refused():
    free = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v)
    with pytest.raises(nhjax.ShapeError, match=r"tuple.*manifold"):
        nhjax.initial_state(free, (jnp.zeros(2), jnp.zeros(1)), jnp.zeros(3))


def test_initial_state_on_product_with_mixed_dtypes_is_refused():
    q = (BALL.q0[0], BALL.q0[1].astype(jnp.float32))
    with pytest.raises(nhjax.DTypeError, match="float32"):
        nhjax.initial_state(BALL.system, q, BALL.v0)


# Leaving the chart --------------------------------------------------------------------


def spinning_up(retraction):
    """A round body under a constant torque: it turns by t²/2 about its third axis."""

    def torque(t, q, v, args):
        return jnp.array([0.0, 0.0, 1.0])

    return nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v, force=torque, manifold=nhjax.SO3(retraction)
    )


@pytest.mark.parametrize(
    ("retraction", "chart", "largest"),
    [
        long(nhjax.Exponential(), "start", 2 * np.pi),
        (nhjax.Exponential(), "middle", 4 * np.pi),
        long(nhjax.Cayley(), "start", np.pi),
    ],
    ids=["exponential, start", "exponential, middle", "cayley, start"],
)
def test_step_that_rotates_beyond_chart_is_named_by_index(retraction, chart, largest):
    system, h = spinning_up(retraction), 0.5
    y0 = started(system, v=jnp.zeros(3))
    run = partial(
        nhjax.integrate,
        system,
        nhjax.LobattoIIIAB(4, chart=chart),
        y0,
        dt=h,
        num_steps=60,
        stage_solver=nhjax.Newton(),
    )
    sol = run(throw=False, saveat=nhjax.SaveAt(t0=True, steps=True))
    step = int(sol.stats["failed_step"])
    assert sol.result == nhjax.RESULTS.left_chart
    # At its initial rate, the failed step would turn by less than the chart allows, but
    # by more than 0.4 of this limit.
    turned = h * float(sol.ys.v[step, 2])
    assert 0.4 * largest < turned < largest
    assert step == int(sol.stats["num_steps"])
    with pytest.raises(nhjax.IntegrationError, match=f"step {step}: .*smaller `dt`"):
        run()


# Holonomic constraints ----------------------------------------------------------------


def test_initial_state_off_holonomic_constraint_is_refused():
    with pytest.raises(
        nhjax.ConstraintViolationError,
        match=r"1 of 1 holonomic .* at q = .*Γ\[0\] = .*`project=True`",
    ):
        started(PENDULUM.system, 1.1 * PENDULUM.q0, PENDULUM.v0)


def test_initial_state_with_velocity_off_holonomic_constraint_is_refused():
    with pytest.raises(nhjax.ConstraintViolationError, match=r"dΓ\[0\]/dt = .*proje"):
        started(PENDULUM.system, PENDULUM.q0, PENDULUM.v0 + PENDULUM.q0)


@pytest.mark.parametrize("kind", ["lagrangian", "hamiltonian"])
def test_projection_onto_holonomic_constraint_corrects_positions_and_velocities(kind):
    system, name = PENDULUM.system, "v"
    if kind == "hamiltonian":
        name = "p"
        system = nhjax.HamiltonianSystem(
            lambda t, q, p, args: 0.5 * p @ p + q[2], holonomic=PENDULUM.holonomic
        )
    u = jnp.array([0.5, 0.1, 0.7])
    v, p = (u, None) if name == "v" else (None, u)
    y = nhjax.initial_state(system, 1.3 * PENDULUM.q0, v, p, project=True)
    np.testing.assert_allclose(y.q, PENDULUM.q0, atol=1e-15)
    expected = u - (u @ PENDULUM.q0) * PENDULUM.q0
    np.testing.assert_allclose(getattr(y, name), expected, atol=1e-15)
    assert np.max(np.abs(system.constraint_violation(0.0, y))) < 1e-15


def test_projection_on_group_is_nearest_in_kinetic_metric():
    top = systems.HeavyTopSE3()
    q = top.q0 + jnp.array([0.0, 0.0, 0.0, 0.0, 0.1, 0.0, -0.1])
    y = nhjax.initial_state(top.system, q, top.v0, project=True)
    assert np.max(np.abs(top.system.constraint_violation(0.0, y))) < 1e-14
    assert float(jnp.max(jnp.abs(y.q - q))) < 0.15


def test_projection_onto_unreachable_constraint_is_refused():
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v, holonomic=lambda t, q, args: q @ q + 1.0
    )
    with pytest.raises(nhjax.NewtonError, match=r"could not be projected.*Γ = "):
        nhjax.initial_state(system, jnp.ones(2), jnp.zeros(2), project=True)


def test_initial_state_with_redundant_holonomic_constraints_is_refused():
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v,
        holonomic=lambda t, q, args: jnp.stack([q[0], 2.0 * q[0]]),
    )
    with pytest.raises(nhjax.DependentConstraintsError, match="Remove redundant"):
        nhjax.initial_state(system, jnp.zeros(2), jnp.array([0.0, 1.0]))


def test_holonomic_constraint_of_wrong_shape_is_refused():
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v, holonomic=lambda t, q, args: jnp.eye(2)
    )
    with pytest.raises(
        nhjax.ShapeError, match=r"`holonomic\(t, q, args\)` must return .*\(2, 2\)"
    ):
        nhjax.initial_state(system, jnp.zeros(2), jnp.zeros(2))


def test_method_without_hypotheses_is_refused_for_holonomic_constraints():
    with pytest.raises(ValueError, match="H1"):
        nhjax.integrate(
            PENDULUM.system,
            nhjax.Gauss(2),
            PENDULUM.initial_state(),
            dt=0.1,
            num_steps=1,
        )


# Hamiltonian systems ------------------------------------------------------------------


@pytest.mark.parametrize("name", ["hamiltonian", "nonholonomic", "force"])
def test_function_of_hamiltonian_system_that_is_a_number_is_refused(name):
    functions = {"hamiltonian": lambda t, q, p, args: 0.5 * p @ p} | {name: 3}
    with pytest.raises(
        TypeError, match=rf"HamiltonianSystem: `{name}`.*\(t, q, p, args\), got 3"
    ):
        nhjax.HamiltonianSystem(**functions)  # pyright: ignore


def test_initial_state_of_irregular_hamiltonian_is_refused():
    system = nhjax.HamiltonianSystem(lambda t, q, p, args: 0.5 * p[0] ** 2 + q[1])
    with pytest.raises(
        nhjax.IrregularLagrangianError, match=r"Hamiltonian is not regular.*D2D2H"
    ):
        nhjax.initial_state(system, jnp.zeros(2), p=jnp.ones(2))


def test_initial_state_from_velocity_without_momentum_is_refused():
    def relativistic(t, q, p, args):
        return jnp.sum(jnp.sqrt(1.0 + p**2))

    system = nhjax.HamiltonianSystem(relativistic)
    y = nhjax.initial_state(system, jnp.zeros(2), jnp.array([0.6, 0.0]))
    np.testing.assert_allclose(y.p, [0.75, 0.0], atol=1e-15)
    with pytest.raises(
        nhjax.NewtonError, match=r"No momentum with D2H.*v = .*Give `p`"
    ):
        nhjax.initial_state(system, jnp.zeros(2), jnp.array([1.5, 0.0]))


def test_initial_state_with_momentum_off_constraint_is_refused():
    system = nhjax.HamiltonianSystem(
        lambda t, q, p, args: 0.5 * p @ p,
        nonholonomic=lambda t, q, p, args: p[2] - q[1] * p[0],
    )
    with pytest.raises(
        nhjax.ConstraintViolationError, match=r"p = .*Ψ\[0\] = 1 .*`project=True`"
    ):
        nhjax.initial_state(system, jnp.zeros(3), p=jnp.ones(3))


def test_constraint_as_positional_argument_is_refused():
    with pytest.raises(TypeError):
        nhjax.LagrangianSystem(BALL.lagrangian, BALL.constraint)  # pyright: ignore
