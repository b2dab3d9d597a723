"""Steps that converge although hardly anything moves; what counts as round-off."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import systems
from oracles.long import long
from oracles.own_groups import SL2


METHOD = nhjax.LobattoIIIAB(3)
SOLVERS = [nhjax.SimplifiedNewton(), nhjax.Newton()]
PULL = (1.3, -4.1, 8.7)


def final(sol):
    return jax.tree.map(lambda x: x[-1], sol.ys)


def on_sphere(form="lagrangian", friction=0.0):
    """A mass on the unit sphere in a constant field of direction -`PULL`."""

    def potential(q):
        return 1.7 * jnp.asarray(PULL, q.dtype) @ q

    def radius(t, q, args):
        return q @ q - 1.0

    if form == "hamiltonian":
        return nhjax.HamiltonianSystem(
            lambda t, q, p, args: 0.3 * p @ p + potential(q), holonomic=radius
        )
    return nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.85 * v @ v - potential(q),
        holonomic=radius,
        force=lambda t, q, v, args: -friction * v,
    )


def below():
    direction = -np.asarray(PULL)
    return jnp.asarray(direction / np.linalg.norm(direction))


@pytest.mark.parametrize("solver", SOLVERS, ids=["simplified", "dense"])
@pytest.mark.parametrize("form", ["lagrangian", "hamiltonian"])
def test_a_pendulum_at_rest_stays_at_rest(form, solver):
    system = on_sphere(form)
    y0 = nhjax.initial_state(system, below(), jnp.zeros(3))
    sol = nhjax.integrate(system, METHOD, y0, dt=0.1, num_steps=20, stage_solver=solver)
    assert float(jnp.max(jnp.abs(final(sol).v))) < 1e-13
    assert float(sol.stats["max_constraint_violation"]) < 1e-13


@pytest.mark.parametrize("speed", [1e-6, 1e-9, 1e-12])
def test_a_pendulum_near_its_rest_is_integrated(speed):
    system = on_sphere()
    across = np.cross(below(), [1.0, 0.0, 0.0])
    y0 = nhjax.initial_state(system, below(), speed * jnp.asarray(across), project=True)
    sol = nhjax.integrate(system, METHOD, y0, dt=0.01, num_steps=50)
    assert float(jnp.max(jnp.abs(final(sol).v))) < 3 * speed


def test_a_damped_pendulum_comes_to_rest():
    system = on_sphere(friction=3.0)
    y0 = nhjax.initial_state(system, below(), jnp.array([0.5, 0.2, 0.3]), project=True)
    sol = nhjax.integrate(system, METHOD, y0, dt=0.1, num_steps=400)
    assert float(jnp.max(jnp.abs(final(sol).v))) < 1e-12


@pytest.mark.parametrize(
    ("dtype", "dt"),
    [(jnp.float64, 1e-5), (jnp.float32, 1e-2), (jnp.float32, 1e-3)],
    ids=str,
)
def test_a_pendulum_released_from_rest(dtype, dt):
    system = on_sphere()
    q = jnp.array([0.8, 0.0, -0.6], dtype)
    y0 = nhjax.initial_state(system, q, jnp.zeros(3, dtype), project=True)
    sol = nhjax.integrate(system, METHOD, y0, dt=dt, num_steps=200)
    tolerance = 100 * float(jnp.finfo(dtype).eps)
    assert float(sol.stats["max_constraint_violation"]) < tolerance / dt


@pytest.mark.parametrize("closure", ["propagated", "consistent", "symmetric"])
def test_a_blade_that_holds_a_skate_against_a_force(closure):
    def blade(t, q, v, args):
        return -jnp.sin(q[2]) * v[0] + jnp.cos(q[2]) * v[1]

    def push(t, q, v, args):
        return 3.7 * jnp.stack([-jnp.sin(q[2]), jnp.cos(q[2]), 0.0 * q[2]])

    skate = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v, nonholonomic=blade, force=push
    )
    y0 = nhjax.initial_state(skate, jnp.array([0.0, 0.0, 0.7]), jnp.zeros(3))
    sol = nhjax.integrate(
        skate, nhjax.LobattoIIIAB(3, closure), y0, dt=0.1, num_steps=10
    )
    assert float(jnp.max(jnp.abs(final(sol).v))) < 1e-14
    np.testing.assert_allclose(final(sol).multiplier, [-3.7], rtol=1e-12)


def test_a_run_goes_on_from_its_last_state_where_a_constraint_is_one_coordinate():
    inertia = jnp.array([1.0, 1.0, 1.0, 0.3, 0.5, 0.7])
    group = nhjax.SE3()
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ (inertia * v),
        manifold=group,
        holonomic=lambda t, q, args: q[6],
    )
    v = jnp.array([0.1, 0.2, 0.0, 0.5, 0.6, 0.7])
    y0 = nhjax.initial_state(system, group.identity(float), v)
    method = nhjax.LobattoIIIAB(2)
    y1 = final(nhjax.integrate(system, method, y0, dt=0.1, num_steps=20))
    nhjax.integrate(system, method, y1, dt=0.1, num_steps=3)
    nhjax.initial_state(system, y1.q, y1.v)


def test_a_users_matrix_group_may_have_a_holonomic_constraint():
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v,
        manifold=SL2(),
        holonomic=lambda t, q, args: jnp.stack([q[0, 1] - q[1, 0], q[0, 1]]),
    )
    y0 = nhjax.initial_state(
        system, jnp.eye(2), jnp.array([0.3, 0.0, 0.0]), project=True
    )
    nhjax.integrate(system, nhjax.LobattoIIIAB(2), y0, dt=0.1, num_steps=3)
    with pytest.raises(nhjax.ConstraintViolationError, match=r"Γ\[0\] = 1"):
        nhjax.initial_state(system, jnp.array([[1.0, 1.0], [0.0, 1.0]]), jnp.zeros(3))


@pytest.mark.parametrize(
    ("constraint", "q"),
    [
        (lambda t, q, args: jnp.log(q[0]) - q[1], [2.0, 5.0]),
        (lambda t, q, args: 1 / (q @ q) - 1.0, [2.0, 0.0]),
    ],
)
def test_a_constraint_that_is_singular_at_zero_is_judged_elsewhere(constraint, q):
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v, holonomic=constraint
    )
    with pytest.raises(nhjax.ConstraintViolationError, match=r"Γ\[0\]"):
        nhjax.initial_state(system, jnp.array(q), jnp.zeros(2))


@pytest.mark.parametrize(
    "method", [long(nhjax.Gauss(1)), nhjax.LobattoIIIAB(2)], ids=str
)
def test_the_end_of_a_step_must_lie_in_the_chart(method):
    body = systems.FreeRigidBody(
        moments=(1.0, 1.0, 1.0), retraction=nhjax.Exponential(), v0=(0.0, 0.0, 13.0)
    )
    sol = nhjax.integrate(
        body.system, method, body.initial_state(), dt=1.0, num_steps=2, throw=False
    )
    assert sol.result == nhjax.RESULTS.left_chart


def test_a_zero_quaternion_cannot_be_projected():
    body = systems.FreeRigidBody()
    with pytest.raises(nhjax.ConstraintViolationError, match=r"`q` = \[0\. .*off by 1"):
        nhjax.initial_state(body.system, jnp.zeros(4), jnp.ones(3), project=True)


def test_a_constraint_without_a_gradient_is_named():
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v,
        holonomic=lambda t, q, args: (q @ q - 1.0) ** 2,
    )
    with pytest.raises(
        nhjax.DependentConstraintsError,
        match=r"DΓ has not.*holonomic\[0\] has no gradient",
    ):
        nhjax.initial_state(system, jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0]))


@pytest.mark.parametrize(("dtype", "size"), [(jnp.float32, 1e-3), (jnp.float64, 1e-10)])
def test_motion_from_rest_is_solved_to_its_own_round_off(dtype, size):
    # At rest under a force that grows from zero: nothing at the start has a size.
    def lagrangian(t, q, v, args):
        potential = size**2 * jnp.sum(jnp.cosh(q / size) - 1)
        return 0.5 * jnp.sum(v**2) - potential + size * jnp.sum(q) * t

    system = nhjax.LagrangianSystem(lagrangian)
    zero = jnp.zeros(1, dtype)
    y0 = nhjax.initial_state(system, q=zero, v=zero)
    sol = nhjax.integrate(system, nhjax.LobattoIIIAB(3), y0, dt=0.2, num_steps=1)
    assert sol.stats["max_residual"] <= 4 * jnp.finfo(dtype).eps


def test_a_heading_of_many_turns_is_felt_in_constraints():
    car = systems.CarWithTrailers.turning(num_trailers=2)
    q0 = jnp.asarray(car.q0).at[jnp.array([2, 4, 5])].add(200 * jnp.pi)
    y0 = nhjax.initial_state(car.system, q0, car.v0)

    @jax.jit
    def run(y0):
        return nhjax.integrate(
            car.system, METHOD, y0, dt=0.04, num_steps=400, throw=False
        )

    sol, before = run(y0), run(car.initial_state())
    assert sol.result == nhjax.RESULTS.successful
    # The circle is that of a heading of the first turn, up to round-off of many.
    eps = 1000 * np.finfo(float).eps
    np.testing.assert_allclose(final(sol).v, final(before).v, rtol=0, atol=400 * eps)


def test_a_tolerance_does_not_grow_with_the_turns_of_a_heading():
    unicycle = systems.Unicycle().in_coordinates()
    start = jnp.asarray(unicycle.q0).at[2].add(200 * jnp.pi)
    y0 = nhjax.initial_state(unicycle.system, start, unicycle.v0, project=True)

    def run(tolerance):
        return nhjax.integrate(
            unicycle.system,
            METHOD,
            y0,
            dt=0.2,
            num_steps=50,
            stage_solver=nhjax.SimplifiedNewton(tolerance=tolerance),
        )

    coarse, exact = run(1e-6), run(0.0)
    error = np.max(np.abs(final(coarse).v - final(exact).v))
    assert 1e-14 < error < 1e-7
    assert coarse.stats["num_iterations"] < exact.stats["num_iterations"]
    assert coarse.stats["max_residual"] < 1e-5


@pytest.mark.long
@pytest.mark.parametrize("solver", SOLVERS, ids=["simplified", "dense"])
def test_a_unit_of_length_does_not_matter_on_the_plane(solver):
    def runs(unit):
        """A particle on a circle, in the plane of SE(2)."""
        system = nhjax.LagrangianSystem(
            lambda t, q, v, args: (
                0.5 * (v[:2] @ v[:2] + (unit * v[2]) ** 2) - 0.3 * unit * q[0]
            ),
            manifold=nhjax.SE2(),
            holonomic=lambda t, q, args: (q[0] ** 2 + q[1] ** 2 - unit**2) / unit,
        )
        q0 = unit * jnp.array([1.0, 0.0, 0.0])
        v0 = unit * jnp.array([0.0, 1.0, 0.0])
        y0 = nhjax.initial_state(system, q0, v0, project=True)
        return nhjax.integrate(
            system, METHOD, y0, dt=0.1, num_steps=50, stage_solver=solver
        )

    small = runs(2.0**-33)
    assert small.stats["max_residual"] < 1e-14
    np.testing.assert_allclose(
        final(small).q[:2] * 2.0**33, final(runs(1.0)).q[:2], rtol=0, atol=1e-10
    )
