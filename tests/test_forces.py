"""Forces on points and bodies: their algebra, closed forms, and runs with them."""

from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import forces


RNG = np.random.default_rng(11)
A, B = RNG.normal(size=(2, 2, 3))


def _point(t, q, args):
    """A point of the plane that depends on three coordinates and on time."""
    return jnp.sin(A @ q) + t * jnp.cos(B @ q)


def _other(t, q, args):
    return 2.0 + jnp.cos(A @ q)


def _jacobian(point, t, q):
    return jax.jacfwd(lambda q: point(t, q, None))(q)


def _velocity(point, t, q, v):
    return _jacobian(point, t, q) @ v + jax.jacfwd(lambda t: point(t, q, None))(t)


@pytest.fixture
def phase():
    return 0.7, jnp.asarray(RNG.normal(size=3)), jnp.asarray(RNG.normal(size=3))


def _integrate(system, q, v, *, s=3, h=0.05, num_steps=20, args=None, keep=False):
    y0 = nhjax.initial_state(system, jnp.asarray(q), jnp.asarray(v), args=args)
    return nhjax.integrate(
        system,
        nhjax.LobattoIIIAB(s),
        y0,
        dt=h,
        num_steps=num_steps,
        args=args,
        saveat=nhjax.SaveAt(t0=True, steps=True) if keep else nhjax.SaveAt(t1=True),
    )


def _kinetic(t, q, v, args):
    return 0.5 * v @ v


# --- The algebra -------------------------------------------------------------------


def test_point_force_equals_transposed_jacobian_times_vector(phase):
    t, q, v = phase
    force = forces.PointForce(_point, lambda t, q, v, args: args * v[:2])
    expected = _jacobian(_point, t, q).T @ (3.0 * v[:2])
    np.testing.assert_allclose(force(t, q, v, 3.0), expected, rtol=1e-14)


def test_spring_equals_gradient_of_its_energy_and_damper_opposes_the_rate(phase):
    t, q, v = phase

    def length(t, q):
        return jnp.linalg.norm(_point(t, q, None) - _other(t, q, None))

    spring = forces.Spring(_point, _other, 3.0, rest_length=0.4, damping=0.7)
    gradient = jax.grad(length, argnums=1)(t, q)
    rate = gradient @ v + jax.grad(length)(t, q)
    tension = 3.0 * (length(t, q) - 0.4) + 0.7 * rate
    np.testing.assert_allclose(spring(t, q, v), -tension * gradient, rtol=1e-13)


def test_spring_with_points_that_coincide_has_finite_derivatives():
    spring = forces.Spring(lambda t, q, args: q, [0.0, 0.0], 2.0, rest_length=0.1)
    zero = jnp.zeros(2)
    assert not spring(0.0, zero, zero).any()
    stiffness = jax.jacfwd(lambda q: spring(0.0, q, zero))(zero)
    np.testing.assert_array_equal(stiffness, -2.0 * jnp.eye(2))


def test_drag_equals_its_formula_in_a_medium_that_moves(phase):
    t, q, v = phase
    wind = jnp.array([0.3, -0.2])
    drag = forces.Drag(_point, linear=0.4, quadratic=1.5, medium=wind)
    u = _velocity(_point, t, q, v) - wind
    vector = -(0.4 + 1.5 * jnp.linalg.norm(u)) * u
    expected = _jacobian(_point, t, q).T @ vector
    np.testing.assert_allclose(drag(t, q, v), expected, rtol=1e-13)


def test_motor_acts_with_its_gear_on_the_relative_angle(phase):
    t, q, v = phase
    motor = forces.Motor(
        lambda t, q, args: q[2] - q[1],
        lambda t, q, v, args: 0.8,
        stall_torque=2.0,
        no_load_speed=30.0,
        gear=5.0,
    )
    torque = 5.0 * 2.0 * (0.8 - 5.0 * (v[2] - v[1]) / 30.0)
    expected = jnp.array([0.0, -torque, torque])
    np.testing.assert_allclose(motor(t, q, v), expected, rtol=1e-14)


GROUPS = {
    "SE2": (nhjax.SE2(), lambda t, g, args: g[:2] + jnp.cos(t + g[2])),
    "SE3": (
        nhjax.SE3(),
        lambda t, g, args: nhjax.SE3().matrix(g)[:3] @ jnp.arange(4.0),
    ),
    "product": (
        nhjax.ProductGroup(nhjax.SO3(), nhjax.Euclidean(2)),
        lambda t, g, args: nhjax.SO3().matrix(g[0])[:2, 1] + g[1],
    ),
}


@pytest.mark.parametrize("name", GROUPS)
def test_force_on_group_has_the_power_of_the_vector_on_the_point(name):
    group, point = GROUPS[name]
    v = jnp.asarray(RNG.normal(size=group.dim))
    g = group.retract(jnp.asarray(0.3 * RNG.normal(size=group.dim)))
    vector = jnp.asarray(RNG.normal(size=point(0.0, g, None).shape))
    force = forces.PointForce(point, vector, manifold=group)

    def along(e):
        return point(0.4, group.compose(g, group.retract(e * v)), None)

    _, rate = jax.jvp(along, (0.0,), (1.0,))
    np.testing.assert_allclose(force(0.4, g, v) @ v, vector @ rate, rtol=1e-12)
    drag = forces.Drag(
        lambda t, q, args: point(0.4, q, args), linear=2.0, manifold=group
    )
    np.testing.assert_allclose(drag(0.4, g, v) @ v, -2.0 * rate @ rate, rtol=1e-12)


@pytest.mark.parametrize("group", [nhjax.SO3(), nhjax.SE3()])
def test_torque_in_space_on_a_body_equals_torque_in_its_frame(group):
    g = group.retract(jnp.asarray(RNG.normal(size=group.dim)))
    torque = jnp.asarray(RNG.normal(size=3))

    def rotation(t, g, args):
        return group.matrix(g)[:3, :3]

    got = forces.Torque(rotation, torque, manifold=group)(0.0, g, jnp.zeros(group.dim))
    # A body velocity is (v, ω) on SE(3) and ω on SO(3), in the frame of the body.
    expected = jnp.zeros(group.dim).at[-3:].set(rotation(0.0, g, None).T @ torque)
    np.testing.assert_allclose(got, expected, atol=1e-14)


def test_forces_are_added_also_to_functions(phase):
    t, q, v = phase
    drag = forces.Drag(lambda t, q, args: q, linear=2.0)

    def other(t, q, v, args):
        return q

    for total in (drag + other, other + drag, forces.Sum(drag, other)):
        np.testing.assert_allclose(total(t, q, v), q - 2.0 * v)
    assert 0 + drag is drag
    np.testing.assert_allclose((0 + drag + drag)(t, q, v), -4.0 * v)


# --- Runs --------------------------------------------------------------------------


def test_run_with_spring_equals_run_with_its_energy_in_the_lagrangian():
    def corner(t, q, args):
        return q[:2] + jnp.array([jnp.cos(q[2]), jnp.sin(q[2])])

    def skate(t, q, v, args):
        return jnp.cos(q[2]) * v[1] - jnp.sin(q[2]) * v[0]

    def with_energy(t, q, v, args):
        length = jnp.linalg.norm(corner(t, q, args) - jnp.array([1.0, 1.0]))
        return _kinetic(t, q, v, args) - 0.5 * 3.0 * (length - 0.5) ** 2

    spring = forces.Spring(corner, [1.0, 1.0], 3.0, rest_length=0.5)
    one = nhjax.LagrangianSystem(_kinetic, nonholonomic=skate, force=spring)
    two = nhjax.LagrangianSystem(with_energy, nonholonomic=skate)
    q, v = [0.0, 0.2, 0.1], [np.cos(0.1), np.sin(0.1), 0.4]
    got, expected = (_integrate(system, q, v, keep=True).ys for system in (one, two))
    np.testing.assert_allclose(got.q, expected.q, atol=1e-13)
    np.testing.assert_allclose(got.v, expected.v, atol=1e-13)
    np.testing.assert_allclose(got.multiplier, expected.multiplier, atol=1e-11)


@pytest.mark.parametrize("s", [2, 3])
def test_sleigh_with_quadratic_drag_at_its_blade_has_the_order_of_the_method(s):
    """The drag acts at the centre of mass: the sleigh turns at a constant rate w.

    The speed obeys u' = -c u², the reaction of the blade is λ = u w, and the path is
    the integral of u (cos wt, sin wt).
    """
    c, w, t1 = 0.8, 1.3, 2.0

    def blade(t, q, v, args):
        return jnp.cos(q[2]) * v[1] - jnp.sin(q[2]) * v[0]

    drag = forces.Drag(lambda t, q, args: q[:2], quadratic=c)
    system = nhjax.LagrangianSystem(_kinetic, nonholonomic=blade, force=drag)
    nodes, weights = np.polynomial.legendre.leggauss(40)
    times = 0.5 * t1 * (nodes + 1)
    path = [
        0.5 * t1 * weights @ (function(w * times) / (1 + c * times))
        for function in (np.cos, np.sin)
    ]
    u = 1 / (1 + c * t1)
    exact_q = np.array([*path, w * t1])
    exact_p = np.array([u * np.cos(w * t1), u * np.sin(w * t1), w])
    errors = []
    for num_steps in (10, 20):
        run = _integrate(
            system, [0.0, 0.0, 0.0], [1.0, 0.0, w], s=s, h=t1 / num_steps,
            num_steps=num_steps,
        )  # fmt: skip
        y = jax.tree.map(lambda x: x[-1], run.ys)
        errors.append(
            [
                np.abs(y.q - exact_q).max(),
                np.abs(y.p - exact_p).max(),
                np.abs(y.multiplier - u * w).max(),
            ]
        )
    slopes = np.log2(np.divide(*errors))
    np.testing.assert_allclose(slopes, 2 * s - 2, atol=0.35)


def test_wheel_with_motor_and_bearing_runs_up_as_in_the_closed_form():
    inertia, stall, free, gear, c = 0.5, 0.2, 60.0, 3.0, 0.9

    def angle(t, q, args):
        return q[0]

    motor = forces.Motor(
        angle, c, stall_torque=stall, no_load_speed=free, gear=gear
    ) + forces.Drag(angle, linear=0.05)
    wheel = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * inertia * v @ v, force=motor
    )
    rate = (gear**2 * stall / free + 0.05) / inertia
    final = gear * stall * c / (inertia * rate)
    run = _integrate(wheel, [0.0], [0.0], s=5, h=0.5, num_steps=10)
    expected = final * -np.expm1(-5.0 * rate)
    np.testing.assert_allclose(run.ys.v[-1], expected, rtol=1e-12)


def test_body_in_space_under_constant_torque_turns_as_in_the_closed_form():
    group = nhjax.SO3()
    torque = forces.Torque(
        lambda t, q, args: group.matrix(q), [0.0, 0.0, 0.6], manifold=group
    )
    body = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ (jnp.array([1.0, 2.0, 3.0]) * v),
        force=torque,
        manifold=group,
    )
    run = _integrate(body, group.identity(), [0.0, 0.0, 0.0], h=0.1, num_steps=20)
    np.testing.assert_allclose(run.ys.v[-1], [0.0, 0.0, 0.4], atol=1e-13)
    (cos, _, _), (sin, _, _), _ = group.matrix(run.ys.q[-1])
    # 20 steps of a method of order 4.
    np.testing.assert_allclose(jnp.arctan2(sin, cos), 0.4, atol=1e-7)


def test_gradient_by_numbers_of_forces_equals_differences():
    def bob(t, q, args):
        return jnp.array([jnp.sin(q[0]), -jnp.cos(q[0])])

    def system(k, c, command):
        force = forces.Spring(bob, [0.5, 0.3], k, rest_length=0.2, damping=c)
        force += forces.Motor(
            lambda t, q, args: q[0], command, stall_torque=1.0, no_load_speed=5.0
        )
        return nhjax.LagrangianSystem(_kinetic, force=force)

    @eqx.filter_jit
    def end(x):
        return _integrate(system(*x), [0.1], [0.2]).ys.q[-1, 0]

    x = jnp.array([3.0, 0.4, 0.6])
    gradient = jax.grad(end)(x)
    for k in range(3):
        step = 1e-5 * jnp.eye(3)[k]
        difference = (end(x + step) - end(x - step)) / 2e-5
        np.testing.assert_allclose(gradient[k], difference, rtol=1e-7)


def test_other_numbers_of_a_force_are_used_and_compile_nothing(caplog):
    def point(t, q, args):
        return q

    def run(k):
        spring = forces.Spring(point, [0.0], k)
        system = nhjax.LagrangianSystem(_kinetic, force=spring)
        return _integrate(system, [1.0], [0.0], s=4, h=0.1, num_steps=10).ys.q[-1, 0]

    with jax.log_compiles():
        np.testing.assert_allclose(run(1.0), np.cos(1.0), atol=1e-9)
        assert [x for x in caplog.messages if "jit(compiled)" in x]
        caplog.clear()
        np.testing.assert_allclose(run(4.0), np.cos(2.0), atol=1e-5)
        assert not [x for x in caplog.messages if "jit(compiled)" in x]


@pytest.mark.parametrize(
    ("on_force", "on_system"), [(None, nhjax.SE2()), (nhjax.SE2(), None)]
)
def test_force_with_another_manifold_than_its_system_is_refused(on_force, on_system):
    force = forces.PointForce(lambda t, q, args: q[:2], [1.0, 0.0], manifold=on_force)
    for total in (force, force + force):
        with pytest.raises(ValueError, match="pass the same `manifold=` to the part"):
            nhjax.LagrangianSystem(_kinetic, force=total, manifold=on_system)


def test_run_with_force_on_a_group_equals_run_in_coordinates():
    def stern(t, q, args):
        return q[:2] - jnp.stack([jnp.cos(q[2]), jnp.sin(q[2])])

    def thrust(t, q, v, args):
        return 3.0 * jnp.stack([jnp.cos(q[2] + 0.1), jnp.sin(q[2] + 0.1)])

    found = []
    for manifold in (None, nhjax.SE2()):
        boat = nhjax.LagrangianSystem(
            lambda t, q, v, args: 0.5 * jnp.array([10.0, 10.0, 4.0]) @ v**2,
            force=forces.PointForce(stern, thrust, manifold=manifold),
            manifold=manifold,
        )
        run = _integrate(boat, [0.0, 0.0, 0.5], [0.0, 0.0, 0.0], s=4)
        found.append(run.ys.q[-1])
    np.testing.assert_allclose(*found, atol=1e-10)


def test_forces_under_vmap_equal_single_runs():
    def end(k):
        spring = forces.Spring(lambda t, q, args: q, [0.0, 0.0], k, rest_length=1.0)
        drag = forces.Drag(lambda t, q, args: q, quadratic=0.2)
        system = nhjax.LagrangianSystem(_kinetic, force=spring + drag)
        return _integrate(system, [1.5, 0.0], [0.0, 1.0]).ys.q[-1]

    stiffness = jnp.array([1.0, 2.0, 5.0])
    many = jax.vmap(end)(stiffness)
    np.testing.assert_allclose(many, jnp.stack([end(k) for k in stiffness]), atol=1e-14)


def test_forces_keep_float32():
    spring = forces.Spring(
        lambda t, q, args: q, np.zeros(2), 2.0, rest_length=0.5, damping=0.1
    )
    force = spring + forces.Drag(lambda t, q, args: q, medium=np.ones(2), linear=1.0)
    system = nhjax.LagrangianSystem(_kinetic, force=force)
    q, v = jnp.ones(2, jnp.float32), jnp.zeros(2, jnp.float32)
    sol = nhjax.integrate(
        system, nhjax.LobattoIIIAB(2), nhjax.initial_state(system, q, v),
        dt=0.1, num_steps=5,
    )  # fmt: skip
    assert sol.ys.q.dtype == jnp.float32


def test_saturated_signal_follows_small_values_and_keeps_below_the_limit():
    x = jnp.linspace(-30.0, 30.0, 101)
    assert jnp.all(jnp.abs(forces.saturated(x, 2.0)) <= 2.0)
    np.testing.assert_allclose(forces.saturated(1e-4, 2.0), 1e-4, rtol=1e-8)


# --- Mistakes ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: forces.PointForce(cast(Any, [1.0, 2.0]), [0.0, 1.0]),
            "must be a function of",
        ),
        (lambda: forces.PointForce(_point, cast(Any, None)), "must be a number"),
        (lambda: forces.PointForce(_point, [1j, 0.0]), "must be real"),
        (lambda: forces.Drag(lambda q, t, args: q), "has another order"),
        (lambda: np.zeros(3) + forces.Drag(_point), "must be a function of"),
        (lambda: forces.Spring(_point, _other, "stiff"), "must be a number"),
        (lambda: forces.Spring(_point, _other, lambda args: 1.0), "must be a number"),
        (lambda: forces.Sum(cast(Any, 3.0)), "must be a function of"),
        (lambda: forces.Drag(_point) + 1.0, "must be a function of"),
    ],
)
def test_force_with_wrong_argument_is_refused_by_name(make, message):
    with pytest.raises(TypeError, match=message):
        make()


@pytest.mark.parametrize(
    ("force", "message"),
    [
        (forces.PointForce(_point, 1.0), r"`vector` must have the shape .*\(2,\)"),
        (
            forces.Torque(_point, [0.0, 0.0, 1.0]),
            r"`rotation` must have shape \(3, 3\)",
        ),
        (forces.Spring(_point, [0.0] * 3, 1.0), r"got `first` of shape \(2,\)"),
        (forces.Drag(_point, medium=1.0), "`medium` must have the shape"),
        (
            forces.Motor(_point, 1.0, stall_torque=1.0, no_load_speed=1.0),
            r"`angle` must have shape \(\)",
        ),
        (forces.Sum(lambda t, q, v, args: q[:1]), "`force` must have the shape"),
    ],
)
def test_force_of_wrong_shape_is_refused_by_name(force, message, phase):
    with pytest.raises(nhjax.ShapeError, match=message):
        force(*phase)


def test_error_in_point_of_a_force_names_the_function():
    def point(t, q, args):
        return q * args["scale"]

    force = forces.PointForce(point, jnp.ones(3))
    with pytest.raises(TypeError) as caught:
        force(0.0, jnp.zeros(3), jnp.zeros(3))
    assert "`point(t, q, args)`" in caught.value.__notes__[0]
    assert "has `args=...` been left out" in caught.value.__notes__[0]


def test_several_numbers_for_one_parameter_are_refused():
    with pytest.raises(nhjax.ShapeError, match="must be one number"):
        forces.Spring(_point, _other, jnp.array([1.0, 2.0]))


def test_brake_with_negative_torque_is_refused():
    with pytest.raises(ValueError, match=r"must be positive or zero, got -3\.0"):
        forces.Brake(lambda t, q, args: q[0], -3.0, smoothing=0.1)


def test_whole_numbers_of_a_force_are_differentiable():
    force = forces.PointForce(_point, np.array([0, 1]))
    assert jnp.issubdtype(cast(Any, force.vector).dtype, jnp.floating)
