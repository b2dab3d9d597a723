"""Forces that depend on the reactions: the equations, their order, laws and motions."""

from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import nhjax
from nhjax import forces, friction, rolling
from nhjax.systems._frames import about_y, about_z


SE3, SO3 = nhjax.SE3(), nhjax.SO3()
G = 9.81


def _last(sol):
    return jax.tree.map(lambda x: x[-1], sol.ys)


# --- A system with a mass that depends on the position, for all kinds of constraints -


def _mass(q):
    return jnp.diag(jnp.array([1.2, 0.9, 1.5])) + 0.3 * jnp.outer(
        jnp.sin(q), jnp.sin(q)
    )


def _lagrangian(t, q, v, args):
    return 0.5 * v @ _mass(q) @ v - 0.5 * q @ q - 0.7 * jnp.cos(q[0])


def _hamiltonian(t, q, p, args):
    kinetic = 0.5 * p @ jnp.linalg.solve(_mass(q), p)
    return kinetic + 0.5 * q @ q + 0.7 * jnp.cos(q[0])


def _blade(t, q, v, args):
    return v[2] - q[1] * v[0] - 0.1 * jnp.sin(q[2]) * v[1]


def _surface(t, q, args):
    return q[2] + 0.3 * q[0] ** 2 - 0.2 * jnp.sin(q[1]) - 0.1 * q[0]


def _rubbing(t, q, v, multipliers, args):
    """A force that depends on the multipliers in a nonlinear way."""
    weights = jnp.arange(1.0, multipliers.shape[0] + 1)
    load = jnp.sum(jnp.sqrt(multipliers**2 + 1.0) * weights)
    push = jnp.array([0.1, 0.2, -0.1]) * jnp.tanh(multipliers[0])
    return push - args * load * jnp.tanh(v)


MU = 0.4
KINDS = {
    "nonholonomic": {"nonholonomic": _blade},
    "holonomic": {"holonomic": _surface},
    "both": {"nonholonomic": _blade, "holonomic": _surface},
}


def _lagrangian_form(kind):
    return nhjax.LagrangianSystem(_lagrangian, force=_rubbing, **KINDS[kind])


def _hamiltonian_form(kind):
    def of_momentum(function):
        def converted(t, q, p, *rest):
            return function(t, q, jnp.linalg.solve(_mass(q), p), *rest)

        return converted

    given = dict(KINDS[kind])
    if "nonholonomic" in given:
        blade = of_momentum(_blade)
        given["nonholonomic"] = lambda t, q, p, args: blade(t, q, p, args)
    rubbing = of_momentum(_rubbing)

    def force(t, q, p, multipliers, args):
        return rubbing(t, q, p, multipliers, args)

    return nhjax.HamiltonianSystem(_hamiltonian, force=force, **given)


def _start(kind):
    return nhjax.initial_state(
        _lagrangian_form(kind),
        jnp.array([0.4, -0.3, 0.1]),
        jnp.array([1.0, 0.6, -0.2]),
        args=MU,
        project=True,
    )


def _equations(kind, q, v, multiplier):
    """Return q̈ and the rate of the constraints, without the library."""

    def on_velocities(q, v):
        rows = []
        if "nonholonomic" in KINDS[kind]:
            rows.append(_blade(0.0, q, v, None))
        if "holonomic" in KINDS[kind]:
            rows.append(jax.grad(_surface, 1)(0.0, q, None) @ v)
        return jnp.stack(rows)

    jacobian = jax.jacfwd(on_velocities, 1)(q, v)
    force = jax.grad(_lagrangian, 1)(0.0, q, v, None) + jacobian.T @ multiplier
    force = force + _rubbing(0.0, q, v, multiplier, MU)
    force = force - jax.jvp(lambda q: _mass(q) @ v, (q,), (v,))[1]
    acceleration = jnp.linalg.solve(_mass(q), force)
    rate = jax.jvp(lambda q: on_velocities(q, v), (q,), (v,))[1]
    return acceleration, jacobian @ acceleration + rate


def _solved(kind, count):
    """Return the function (q, v) -> (v, q̈, λ) by Newton's method, in one array."""

    @jax.jit
    def solved(z):
        q, v = z[:3], z[3:]
        multiplier = jnp.zeros(count)
        for _ in range(12):
            rate = lambda m: _equations(kind, q, v, m)[1]  # noqa: E731
            slope = jax.jacfwd(rate)(multiplier)
            multiplier = multiplier - jnp.linalg.solve(slope, rate(multiplier))
        acceleration = _equations(kind, q, v, multiplier)[0]
        return jnp.concatenate([v, acceleration, multiplier])

    return solved


@pytest.mark.parametrize("kind", KINDS)
def test_multiplier_of_initial_state_solves_the_equations_with_its_force(kind):
    for system in (_lagrangian_form(kind), _hamiltonian_form(kind)):
        y = _start(kind)
        if isinstance(system, nhjax.LagrangianSystem):
            y = nhjax.initial_state(system, y.q, y.v, args=MU)
        else:
            y = nhjax.initial_state(system, y.q, p=y.p, args=MU)
        acceleration, rate = _equations(kind, y.q, y.v, y.multiplier)
        np.testing.assert_allclose(rate, 0, atol=3e-15)
        motion = nhjax.motion(system, 0.0, y, MU)
        np.testing.assert_allclose(motion.acceleration, acceleration, atol=1e-14)
        np.testing.assert_allclose(motion.multiplier, y.multiplier, atol=1e-14)


ORDER_CASES = [
    ("nonholonomic", _lagrangian_form, 3, "symmetric", None),
    ("both", _lagrangian_form, 3, "symmetric", "full"),
    ("both", _hamiltonian_form, 3, "propagated", None),
    # Every pair of values of two arguments occurs.
    *(
        pytest.param(
            kind,
            form,
            s,
            ("symmetric", "propagated")[(i + s) % 2],
            (None, "full")[(k + i) % 2],
            marks=pytest.mark.long,
        )
        for k, kind in enumerate(KINDS)
        for i, form in enumerate((_lagrangian_form, _hamiltonian_form))
        for s in (2, 3)
    ),
]


@pytest.mark.parametrize(("kind", "form", "s", "closure", "jacobian"), ORDER_CASES)
def test_run_with_force_of_multipliers_has_the_order_of_the_method(
    kind, form, s, closure, jacobian
):
    y0, system = _start(kind), form(kind)
    solved, count = _solved(kind, y0.multiplier.size), y0.multiplier.size
    end = solve_ivp(
        lambda t, z: np.asarray(solved(jnp.asarray(z)))[:6],
        (0.0, 0.8),
        np.concatenate([y0.q, y0.v]),
        rtol=1e-13,
        atol=1e-14,
        method="DOP853",
    ).y[:, -1]
    expected = np.concatenate([end, np.asarray(solved(jnp.asarray(end)))[-count:]])
    method = nhjax.LobattoIIIAB(s, closure=closure)
    solver = nhjax.SimplifiedNewton(jacobian=jacobian)
    errors = []
    for num_steps in (8, 16):
        sol = nhjax.integrate(
            system,
            method,
            y0,
            dt=0.8 / num_steps,
            num_steps=num_steps,
            args=MU,
            stage_solver=solver,
        )
        y = _last(sol)
        found = np.concatenate([y.q, y.v, y.multiplier])
        difference = np.abs(found - expected)
        errors.append([difference[:6].max(), difference[6:].max()])
        assert int(sol.stats["num_iterations"]) <= 14 * num_steps
    slopes = np.log2(np.divide(*errors))
    carried = method.multiplier_order if closure == "propagated" else method.order
    if kind == "holonomic":
        carried = method.order
    np.testing.assert_allclose(slopes, [method.order, carried], atol=0.35)


@pytest.mark.parametrize(
    "solver", [nhjax.Newton(), nhjax.SimplifiedNewton(jacobian="leading")]
)
def test_solvers_agree_on_force_of_multipliers(solver):
    y0, system = _start("both"), _lagrangian_form("both")

    def run(solver):
        method = nhjax.LobattoIIIAB(3)
        return _last(
            nhjax.integrate(
                system, method, y0, dt=0.05, num_steps=4, args=MU, stage_solver=solver
            )
        )

    for one, other in zip(
        *map(jax.tree.leaves, (run(solver), run(nhjax.SimplifiedNewton()))), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=0, atol=2e-13)


@pytest.mark.parametrize(
    "adjoint", [nhjax.RecursiveCheckpointAdjoint(), nhjax.DirectAdjoint()]
)
def test_gradient_through_friction_equals_differences(adjoint):
    system, q0 = _lagrangian_form("both"), _start("both").q
    v0 = _start("both").v

    @jax.jit
    def end(mu):
        y0 = nhjax.initial_state(system, q0, v0, args=mu)
        sol = nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(3),
            y0,
            dt=0.05,
            num_steps=10,
            args=mu,
            adjoint=adjoint,
        )
        y = _last(sol)
        return jnp.sum(y.q * jnp.array([1.0, 2.0, 3.0])) + jnp.sum(y.multiplier)

    h, weights = 1e-2, np.array([3 / 4, -3 / 20, 1 / 60])
    steps = h * np.arange(1, 4)
    pairs = [float(end(MU + x) - end(MU - x)) for x in steps]
    expected = weights @ pairs / h
    np.testing.assert_allclose(jax.grad(end)(MU), expected, rtol=1e-8)


def test_second_derivative_of_multiplier_with_its_force_equals_differences():
    system, y = _lagrangian_form("nonholonomic"), _start("nonholonomic")

    def multiplier(mu):
        return nhjax.continuous_multiplier(system, 0.0, y, mu)[0]

    h = 1e-3
    slope = jax.grad(multiplier)
    expected = (slope(MU + h) - slope(MU - h)) / (2 * h)
    np.testing.assert_allclose(jax.grad(slope)(MU), expected, rtol=1e-5)


def test_force_of_multipliers_under_vmap_equals_single_runs():
    system, y0 = _lagrangian_form("both"), _start("both")

    def run(mu):
        y = nhjax.initial_state(system, y0.q, y0.v, args=mu)
        method = nhjax.LobattoIIIAB(2)
        return _last(
            nhjax.integrate(system, method, y, dt=0.05, num_steps=4, args=mu)
        ).q

    many = jax.jit(jax.vmap(run))(jnp.array([0.1, 0.4]))
    np.testing.assert_allclose(many, [run(0.1), run(0.4)], rtol=0, atol=1e-14)


def test_force_of_multipliers_keeps_float32():
    def force(t, q, v, multipliers, args):
        return -args * jnp.abs(multipliers[0]) * jnp.tanh(v)

    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v, nonholonomic=_rotating, force=force
    )
    y0 = nhjax.initial_state(
        system, jnp.zeros(3, "float32"), jnp.array([1, 0, 1], "float32"), args=0.3
    )
    method = nhjax.LobattoIIIAB(3)
    sol = nhjax.integrate(system, method, y0, dt=0.1, num_steps=10, args=0.3)
    assert sol.ys.q.dtype == jnp.float32
    assert float(sol.stats["max_constraint_violation"]) < 1e-6


def _rotating(t, q, v, args):
    return jnp.cos(q[2]) * v[1] - jnp.sin(q[2]) * v[0]


def test_run_without_constraints_passes_no_multipliers():
    def force(t, q, v, multipliers, args):
        assert multipliers.shape == (0,)
        return -v

    system = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v, force=force)
    y0 = nhjax.initial_state(system, jnp.zeros(1), jnp.ones(1))
    sol = nhjax.integrate(system, nhjax.LobattoIIIAB(4), y0, dt=0.1, num_steps=10)
    np.testing.assert_allclose(_last(sol).v, np.exp(-1.0), atol=1e-9)


def test_check_system_reports_on_a_force_of_multipliers():
    y0 = _start("both")
    system = _lagrangian_form("both")
    report = nhjax.check_system(system, y0.q, y0.v, args=MU)
    assert report.depends_on_time == ()
    assert report.ignorable == ()


def test_linear_stability_with_force_of_multipliers_equals_damping():
    """A bead on the line y = 0 with a load of 2 N has the friction -μ 2 tanh(v)."""

    def force(t, q, v, multipliers, args):
        return jnp.array([-0.3, 0.0]) * jnp.abs(multipliers[0]) * jnp.tanh(v[0])

    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v - 2.0 * q[1] - 2.0 * q[0] ** 2,
        holonomic=lambda t, q, args: q[1],
        force=force,
    )
    y0 = nhjax.initial_state(system, jnp.zeros(2), jnp.zeros(2))
    found = nhjax.linear_stability(system, 0.0, y0)
    expected = np.roots([1.0, 0.6, 4.0])
    np.testing.assert_allclose(
        np.sort_complex(np.asarray(found.eigenvalues)), np.sort_complex(expected)
    )


# --- Refusals ------------------------------------------------------------------------


def test_redundant_constraints_with_force_of_multipliers_are_refused():
    with pytest.raises(ValueError, match="multipliers of redundant constraints"):
        nhjax.LagrangianSystem(
            _lagrangian, nonholonomic=_blade, force=_rubbing, constraints="redundant"
        )


def test_force_with_args_before_multipliers_is_refused():
    with pytest.raises(TypeError, match="in this order"):
        nhjax.LagrangianSystem(
            _lagrangian,
            nonholonomic=_blade,
            force=lambda t, q, v, args, multipliers: v,
        )


def test_force_of_multipliers_with_wrong_shape_is_refused_by_name():
    system = nhjax.LagrangianSystem(
        _lagrangian,
        nonholonomic=_blade,
        force=lambda t, q, v, multipliers, args: multipliers,
    )
    with pytest.raises(ValueError, match=r"force\(t, q, v, multipliers, args\)`"):
        nhjax.initial_state(system, jnp.zeros(3), jnp.zeros(3))


def test_friction_that_jams_a_rigid_contact_is_refused():
    """Painlevé's paradox: with enough friction no reaction solves the equations."""

    def force(t, q, v, multipliers, args):
        return args * jnp.abs(multipliers[0]) * jnp.array([1.0, -1.0])

    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v - q[1],
        holonomic=lambda t, q, args: q[0] + q[1],
        force=force,
    )
    q, v = jnp.zeros(2), jnp.zeros(2)
    nhjax.initial_state(system, q, v, args=0.5)

    def jammed(t, q, v, multipliers, args):
        return -(jnp.sqrt(multipliers[0] ** 2 + 1) + multipliers[0]) * jnp.ones(2)

    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v - q[1],
        holonomic=lambda t, q, args: q[0] + q[1],
        force=jammed,
    )
    with pytest.raises(nhjax.NonFiniteError, match="multiplier"):
        nhjax.initial_state(system, q, v)


def test_friction_with_a_jump_is_refused_with_advice():
    def force(t, q, v, multipliers, args):
        return jnp.array([-0.5, 0.0]) * jnp.abs(multipliers[0]) * jnp.sign(v[0])

    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v - G * q[1],
        holonomic=lambda t, q, args: q[1],
        force=force,
    )
    y0 = nhjax.initial_state(system, jnp.zeros(2), jnp.array([0.1, 0.0]))
    with pytest.raises(nhjax.IntegrationError, match="tanh"):
        nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(3),
            y0,
            dt=0.013,
            num_steps=10,
            stage_solver=nhjax.Newton(),
        )


# --- Laws ----------------------------------------------------------------------------


def _in_long_double(law, u):
    """Evaluate the formulas of the documentation in extended precision."""
    u = np.asarray(u, np.longdouble)
    if isinstance(law, friction.Coulomb):
        return 0.5 * np.tanh(u / np.longdouble(0.125))
    if isinstance(law, friction.Stribeck):
        drop = np.longdouble(0.25) * np.exp(-((u / np.longdouble(0.5)) ** 2))
        return (np.longdouble(0.5) + drop) * np.tanh(u / np.longdouble(0.125)) + u / 4
    if isinstance(law, friction.LinearSlip):
        return 2 * u
    b = 8 * u
    b = b - np.longdouble(0.75) * (b - np.arctan(b))
    return np.longdouble(1.25) * np.sin(np.longdouble(1.5) * np.arctan(b))


LAWS = [
    friction.Coulomb(0.5, smoothing=0.125),
    friction.Stribeck(0.75, 0.5, stribeck_speed=0.5, smoothing=0.125, viscous=0.25),
    friction.LinearSlip(2.0),
    friction.MagicFormula(8.0, 1.5, 1.25, 0.75),
]


@pytest.mark.parametrize("law", LAWS, ids=lambda law: type(law).__name__)
def test_friction_law_equals_its_formula_to_round_off_at_all_speeds(law):
    speeds = np.concatenate([-np.logspace(-14, 2, 200), np.logspace(-14, 2, 200)])
    found = jax.vmap(law.coefficient)(jnp.asarray(speeds))
    expected = _in_long_double(law, speeds).astype(float)
    np.testing.assert_allclose(found, expected, rtol=2e-15)
    assert float(law.coefficient(0.0)) == 0.0


@pytest.mark.parametrize("law", LAWS, ids=lambda law: type(law).__name__)
def test_derivatives_of_friction_law_are_accurate_near_rest(law):
    """The derivative of the slope in u² is smooth, from zero to beyond the series."""

    def slope(square):
        return law.slope(square)

    squares = jnp.asarray([0.0, 1e-30, 1e-12, 1e-5, 1e-3, 0.1])
    rate = jax.vmap(jax.grad(slope))(squares)
    h = np.longdouble(1e-6)
    for square, found in zip(np.asarray(squares, np.longdouble), rate, strict=True):
        one, two = square + h, square + 2 * h
        ratio = [_in_long_double(law, x**0.5) / x**0.5 for x in (one, two)]
        at = (two - one) / 2 + one
        between = float((ratio[1] - ratio[0]) / h)
        near = float(jax.grad(slope)(jnp.asarray(float(at))))
        np.testing.assert_allclose(near, between, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(found, near, rtol=2e-3, atol=1e-9)


# --- Motions with closed forms -------------------------------------------------------


def _block(friction_coefficient, angle, smoothing):
    """A block on a slope: q = (along the slope, away from it)."""
    law = friction.Coulomb(friction_coefficient, smoothing=smoothing)
    slider = friction.JointFriction(
        lambda t, q, args: q[0],
        law,
        lambda t, q, v, multipliers, args: multipliers[0],
    )
    weight = 2.0 * G * jnp.array([np.sin(angle), -np.cos(angle)])
    return nhjax.LagrangianSystem(
        lambda t, q, v, args: v @ v + weight @ q,
        holonomic=lambda t, q, args: q[1],
        force=slider,
    )


def test_block_that_slides_down_a_slope_keeps_the_closed_form():
    system = _block(0.3, 0.5, 1e-3)
    y0 = nhjax.initial_state(system, jnp.zeros(2), jnp.array([1.0, 0.0]))
    sol = nhjax.integrate(system, nhjax.LobattoIIIAB(3), y0, dt=0.1, num_steps=10)
    a = G * (np.sin(0.5) - 0.3 * np.cos(0.5))
    np.testing.assert_allclose(_last(sol).q, [1 + 0.5 * a, 0.0], atol=1e-13)
    np.testing.assert_allclose(_last(sol).v, [1 + a, 0.0], atol=1e-13)
    np.testing.assert_allclose(_last(sol).multiplier, [2 * G * np.cos(0.5)], rtol=1e-14)


def test_block_that_sticks_on_a_slope_creeps_as_the_smooth_law_says():
    system = _block(0.7, 0.5, 1e-3)
    y0 = nhjax.initial_state(system, jnp.zeros(2), jnp.array([0.0, 0.0]))
    sol = nhjax.integrate(system, nhjax.LobattoIIIAB(3), y0, dt=1e-4, num_steps=200)
    creep = 1e-3 * np.arctanh(np.tan(0.5) / 0.7)
    np.testing.assert_allclose(_last(sol).v[0], creep, rtol=1e-10)


def _sleigh_with_friction():
    def pose(t, q, args):
        return jnp.append(q[:2], 0.0), about_z(q[2])

    contacts = rolling.Contacts(blade=rolling.Blade(pose, touches=False))
    law = friction.Coulomb(0.3, smoothing=0.02)
    rubbing = friction.Sliding(
        contacts, "blade", law, load=lambda t, q, v, multipliers, args: multipliers[0]
    )
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ (jnp.array([1.3, 1.3, 0.4]) * v),
        nonholonomic=contacts.nonholonomic,
        force=rubbing,
    )
    return system, contacts


@pytest.mark.parametrize("s", [2, 3])
def test_sleigh_with_friction_of_its_side_force_has_the_order_of_the_method(s):
    """The side force is m u ω, so that u = u₀ exp(-μ ω t) with constant ω."""
    system, contacts = _sleigh_with_friction()
    y0 = nhjax.initial_state(system, jnp.zeros(3), jnp.array([2.0, 0.0, 1.1]))
    np.testing.assert_allclose(y0.multiplier, [1.3 * 2.0 * 1.1], rtol=1e-14)
    errors = []
    for num_steps in (10, 20):
        method = nhjax.LobattoIIIAB(s)
        dt = 1.0 / num_steps
        sol = nhjax.integrate(system, method, y0, dt=dt, num_steps=num_steps)
        y = _last(sol)
        u = np.cos(1.1) * y.v[0] + np.sin(1.1) * y.v[1]
        speed = 2.0 * np.exp(-0.3 * 1.1)
        side = contacts.forces(1.0, y)["blade"]
        errors.append([abs(u - speed), abs(np.linalg.norm(side) - 1.3 * speed * 1.1)])
    slopes = np.log2(np.divide(*errors))
    np.testing.assert_allclose(slopes, method.order, atol=0.1)


def test_energy_lost_by_a_sleigh_equals_the_work_of_its_friction():
    system, _ = _sleigh_with_friction()
    y0 = nhjax.initial_state(system, jnp.zeros(3), jnp.array([2.0, 0.0, 1.1]))

    def power(t, y, args):
        return y.v @ system.external_force(t, y.q, y.v, y.multiplier, args)

    work = []
    sol = nhjax.integrate(
        system,
        nhjax.LobattoIIIAB(5),
        y0,
        dt=0.02,
        num_steps=50,
        saveat=nhjax.SaveAt(
            t0=True, steps=True, fn=lambda t, y, args: (y, power(t, y, args))
        ),
    )
    states, powers = sol.ys
    # Boole's rule over blocks of five times has the order 6.
    weights = np.array([7, 32, 12, 32, 7]) * 2 / 45 * 0.02
    powers = np.asarray(powers)[:49]
    work = sum(weights @ powers[i : i + 5] for i in range(0, 48, 4))
    energy = jax.vmap(system.energy)(sol.ts, states)
    np.testing.assert_allclose(energy[48] - energy[0], work, atol=1e-10)


def _free_pose(t, q, args):
    return q[4:], SO3.matrix(q[:4])


def _ball(no_slip, *forces_on):
    """A ball of 1 kg and radius 0.1 m on a plane, on SE(3)."""
    if no_slip:
        ball = rolling.Ellipsoid(_free_pose, 0.1, manifold=SE3)
    else:
        # A torus whose core has the radius zero is a ball.
        ball = rolling.Wheel(_free_pose, 0.0, tube_radius=0.1, no_slip=(), manifold=SE3)
    contacts = rolling.Contacts(ball=ball)
    made: Any = sum(make(contacts) for make in forces_on)
    inertia = 0.4 * 0.1**2
    return contacts, nhjax.LagrangianSystem(
        lambda t, q, v, args: (
            0.5 * v[:3] @ v[:3] + 0.5 * inertia * v[3:] @ v[3:] - G * q[6]
        ),
        nonholonomic=contacts.nonholonomic,
        holonomic=contacts.holonomic,
        force=made,
        manifold=SE3,
    )


def _ball_start(system, v):
    q0 = SE3.identity().at[6].set(0.1)
    return nhjax.initial_state(system, q0, jnp.asarray(v))


def test_ball_that_slides_and_spins_keeps_the_closed_form():
    """A ball with back spin slows down by μ g, and gains the spin 5/2 μ g t / r."""
    mu = 0.2
    law = friction.Coulomb(mu, smoothing=1e-3)
    contacts, system = _ball((), lambda c: friction.Sliding(c, "ball", law))
    y0 = _ball_start(system, [3.0, 0.0, 0.0, 0.0, -8.0, 3.0])
    sol = nhjax.integrate(system, nhjax.LobattoIIIAB(5), y0, dt=0.01, num_steps=20)
    y, t = _last(sol), 0.2
    rotation = SO3.matrix(y.q[:4])
    np.testing.assert_allclose(
        y.q[4:], [3 * t - 0.5 * mu * G * t * t, 0.0, 0.1], atol=1e-12
    )
    spin = [0.0, -8.0 + 2.5 * mu * G * t / 0.1, 3.0]
    np.testing.assert_allclose(rotation @ y.v[3:], spin, atol=1e-10)
    np.testing.assert_allclose(contacts.load("ball", y.multiplier), G, rtol=1e-13)


def test_ball_with_rolling_and_pivoting_friction_keeps_the_closed_form():
    arm = 2e-3
    _, system = _ball(
        ("along", "across"),
        lambda c: friction.RollingResistance(c, "ball", arm, smoothing=0.05),
        lambda c: friction.PivotingFriction(c, "ball", 0.5 * arm, smoothing=0.05),
    )
    y0 = _ball_start(system, [3.0, 0.0, 0.0, 0.0, 30.0, 20.0])
    sol = nhjax.integrate(system, nhjax.LobattoIIIAB(5), y0, dt=0.005, num_steps=100)
    y, t = _last(sol), 0.5
    rotation = SO3.matrix(y.q[:4])
    slowing = arm * G / 0.1 / 1.4
    np.testing.assert_allclose(y.q[4], 3 * t - 0.5 * slowing * t * t, rtol=1e-9)
    spin = rotation @ y.v[3:]
    pivoting = 0.5 * arm * G / (0.4 * 0.1**2)
    np.testing.assert_allclose(spin[1:], [30 - slowing * t / 0.1, 20 - pivoting * t])


def test_tyre_force_equals_the_formula_of_its_slip():
    """A wheel that brakes and drifts: slip (κ, tan α) from hub speed and turn rate."""
    rng = np.random.default_rng(5)
    tyre_law = friction.MagicFormula(10.0, 1.9, 1.0, 0.97)

    def pose(t, q, args):
        return q[:3], about_y(q[3])

    wheel = rolling.Wheel(pose, 0.3, no_slip=(), touches=False)
    contacts = rolling.Contacts(wheel=wheel)
    tyre = friction.Tyre(contacts, "wheel", tyre_law, slowest=0.01, load=400.0)
    for _ in range(5):
        vx, vy, turn = rng.uniform(0.5, 3.0, 3)
        v = jnp.array([vx, vy, 0.0, turn / 0.3])
        found = tyre(0.0, jnp.array([0.0, 0.0, 0.3, 0.4]), v, jnp.zeros(0), None)
        speed = np.sqrt(vx**2 + vy**2 + 0.01**2)
        slip = np.array([vx - turn, vy]) / speed
        size = np.linalg.norm(slip)
        x = 10.0 * size
        mu = np.sin(1.9 * np.arctan(x - 0.97 * (x - np.arctan(x))))
        force = -400.0 * mu * slip / size
        expected = [force[0], force[1], 0.0, -0.3 * force[0]]
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-10)


# --- Does it still roll? -------------------------------------------------------------


RADIUS, INERTIA, MASS = 0.3, 0.05, 2.0


def _driven_wheel(no_slip, *terms):
    """A wheel on a line, q = (x, z, turn), that a torque of 4 t N m drives."""

    def pose(t, q, args):
        return jnp.stack([q[0], 0 * q[0], q[1]]), about_y(q[2])

    wheel = rolling.Wheel(pose, RADIUS, no_slip=no_slip)
    contacts = rolling.Contacts(wheel=wheel)
    drive = forces.PointForce(lambda t, q, args: q[2], lambda t, q, v, args: 4.0 * t)
    made: Any = drive
    for make in terms:
        made = made + make(contacts)
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: (
            0.5 * v @ (jnp.array([MASS, MASS, INERTIA]) * v) - MASS * G * q[1]
        ),
        nonholonomic=contacts.nonholonomic,
        holonomic=contacts.holonomic,
        force=made,
    )
    return contacts, system


SLIP_TIME = 0.5 * G * (INERTIA + MASS * RADIUS**2) / (4.0 * RADIUS)


def test_pivoting_friction_vanishes_on_a_ball_that_turns_with_its_turntable():
    rate, group = 3.0, nhjax.SE3()
    table = rolling.Plane(
        velocity=lambda t, x, args: rate * jnp.stack([-x[1], x[0], 0.0 * x[2]])
    )
    contacts = rolling.Contacts(
        ball=rolling.Ellipsoid(
            lambda t, q, args: (q[4:], nhjax.SO3().matrix(q[:4])),
            0.1,
            ground=table,
            manifold=group,
        )
    )
    force = friction.PivotingFriction(contacts, "ball", 0.01, smoothing=1e-3, load=10.0)
    q = group.identity().at[6].set(0.1)
    for spin, torque in ((rate, 0.0), (0.0, 0.1), (2 * rate, -0.1)):
        v = jnp.zeros(6).at[5].set(spin)
        found = force(0.0, q, v, jnp.zeros(3), None)
        np.testing.assert_allclose(found[5], torque, atol=1e-15)


def test_slip_event_ends_the_run_when_the_friction_is_used_up():
    contacts, system = _driven_wheel(("along",))
    y0 = nhjax.initial_state(system, jnp.array([0.0, RADIUS, 0.0]), jnp.zeros(3))
    event = rolling.slips(contacts, "wheel", 0.5)
    sol = nhjax.integrate(
        system, nhjax.LobattoIIIAB(3), y0, dt=0.1, num_steps=20, event=event
    )
    np.testing.assert_allclose(float(sol.events.ts[0]), SLIP_TIME, rtol=1e-12)


def test_run_goes_on_with_friction_after_the_slip_event_as_in_the_closed_form():
    contacts, system = _driven_wheel(("along",))
    y0 = nhjax.initial_state(system, jnp.array([0.0, RADIUS, 0.0]), jnp.zeros(3))
    event = rolling.slips(contacts, "wheel", 0.5)
    method = nhjax.LobattoIIIAB(3)
    first = nhjax.integrate(system, method, y0, dt=0.1, num_steps=20, event=event)
    at, t = _last(first), first.events.ts[0]
    law = friction.Coulomb(0.5, smoothing=1e-3)
    _, sliding = _driven_wheel((), lambda c: friction.Sliding(c, "wheel", law))
    y1 = nhjax.initial_state(sliding, at.q, at.v, t=t)
    dt, num_steps = 2e-4, 3000
    sol = nhjax.integrate(sliding, method, y1, t0=t, dt=dt, num_steps=num_steps)
    end, duration = float(t) + dt * num_steps, dt * num_steps
    # Up to an error of u₀, the speed follows Coulomb's law without smoothing.
    speed = float(at.v[0]) + 0.5 * G * duration
    np.testing.assert_allclose(_last(sol).v[0], speed, atol=2e-3)
    drive = 2.0 * (end**2 - float(t) ** 2) - 0.5 * MASS * G * RADIUS * duration
    turn = float(at.v[2]) + drive / INERTIA
    np.testing.assert_allclose(_last(sol).v[2], turn, atol=2e-2)


def test_lift_off_event_ends_the_run_when_the_normal_force_vanishes():
    pull = forces.PointForce(
        lambda t, q, args: q[1], lambda t, q, v, args: 0.25 * MASS * G * t
    )
    contacts, system = _driven_wheel(("along",), lambda c: pull)
    y0 = nhjax.initial_state(system, jnp.array([0.0, RADIUS, 0.0]), jnp.zeros(3))
    event = rolling.lifts_off(contacts, "wheel")
    sol = nhjax.integrate(
        system, nhjax.LobattoIIIAB(3), y0, dt=0.3, num_steps=20, event=event
    )
    np.testing.assert_allclose(float(sol.events.ts[0]), 4.0, rtol=1e-12)


# --- Refusals of parts ---------------------------------------------------------------


def _skate(**options):
    blade = rolling.Blade(lambda t, q, args: (q, jnp.eye(3)), **options)
    return rolling.Contacts(skate=blade)


COULOMB = friction.Coulomb(0.3, smoothing=0.01)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: friction.Sliding(_skate(), "wheel", COULOMB), "one of 'skate'"),
        (
            lambda: friction.Sliding(_skate(touches=False), "skate", COULOMB),
            "pass its load",
        ),
        (
            lambda: friction.Sliding(_skate(), "skate", cast(Any, 0.3)),
            "AbstractFrictionLaw",
        ),
        (
            lambda: friction.Sliding(cast(Any, "skate"), "skate", COULOMB),
            "Contacts",
        ),
        (
            lambda: friction.Sliding(
                rolling.Contacts(ball=rolling.Ellipsoid(_free_pose, 0.1)),
                "ball",
                COULOMB,
            ),
            "does not slip in any direction",
        ),
        (
            lambda: friction.Sliding(
                _skate(), "skate", COULOMB, load=cast(Any, lambda t, q, v, args: 1.0)
            ),
            "multipliers",
        ),
        (lambda: rolling.slips(_skate(touches=False), "skate", 0.3), "pass its load"),
        (lambda: rolling.slips(_skate(no_slip=()), "skate", 0.3), "so that it slips"),
        (
            lambda: rolling.slips(_skate(), "skate", cast(Any, COULOMB)),
            "`friction` must be a number",
        ),
        (lambda: rolling.slips(cast(Any, "skate"), "skate", 0.3), "Contacts"),
        (lambda: friction.Coulomb(-0.3, smoothing=0.01), "positive or zero"),
        (lambda: friction.Coulomb(0.3, smoothing=0.0), "must be positive"),
        (lambda: forces.Sum(cast(Any, [lambda t, q, v, args: v])), r"Sum\(\*forces\)"),
        (lambda: rolling.lifts_off(_skate(touches=False), "skate"), "not a multiplier"),
        (lambda: rolling.lifts_off(_skate(), "wheel"), "one of 'skate'"),
    ],
)
def test_friction_with_wrong_argument_is_refused_by_name(make, message):
    with pytest.raises((TypeError, ValueError), match=message):
        make()


def test_friction_of_a_contact_with_another_manifold_is_refused():
    law = friction.Coulomb(0.2, smoothing=1e-3)
    contacts = rolling.Contacts(ball=rolling.Ellipsoid(_free_pose, 0.1, no_slip=()))
    with pytest.raises(ValueError, match="manifold"):
        nhjax.LagrangianSystem(
            lambda t, q, v, args: 0.5 * v @ v,
            holonomic=contacts.holonomic,
            force=friction.Sliding(contacts, "ball", law),
            manifold=SE3,
        )


@pytest.mark.parametrize("holonomic", [None, lambda t, q, args: q[2], "other"])
def test_friction_in_a_system_with_other_constraints_is_refused(holonomic):
    contacts = _skate()
    if holonomic == "other":
        holonomic = _skate().holonomic
    with pytest.raises(ValueError, match=r"holonomic=contacts\.holonomic"):
        nhjax.LagrangianSystem(
            lambda t, q, v, args: 0.5 * v @ v,
            nonholonomic=contacts.nonholonomic,
            holonomic=holonomic,
            force=friction.Sliding(contacts, "skate", COULOMB),
        )


def test_friction_of_a_contact_followed_by_a_rod_keeps_the_closed_form():
    # q = (x, z) of a block of 1 kg that rubs, and x of one of 2 kg that does not.
    def pose(t, q, args):
        return jnp.stack([q[0], jnp.zeros_like(q[0]), q[1]]), jnp.eye(3)

    contacts = rolling.Contacts(block=rolling.Blade(pose, no_slip=()))

    heights = contacts.holonomic
    assert heights is not None

    def holonomic(t, q, args):
        return jnp.append(heights(t, q, args), q[2] - q[0] - 1.0)

    law = friction.Coulomb(0.3, smoothing=1e-3)
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ (jnp.array([1.0, 1.0, 2.0]) * v) - G * q[1],
        holonomic=holonomic,
        force=friction.Sliding(contacts.followed_by(1), "block", law),
    )
    y0 = nhjax.initial_state(
        system, jnp.array([0.0, 0.0, 1.0]), jnp.array([2.0, 0.0, 2.0])
    )
    sol = nhjax.integrate(system, nhjax.LobattoIIIAB(3), y0, dt=0.1, num_steps=10)
    a = 0.3 * G / 3.0
    np.testing.assert_allclose(
        _last(sol).q, [2 - 0.5 * a, 0.0, 3 - 0.5 * a], atol=1e-13
    )
    np.testing.assert_allclose(_last(sol).multiplier, [G, -2 * a], rtol=1e-13)


@pytest.mark.filterwarnings("ignore:HamiltonianSystem")
def test_friction_in_a_hamiltonian_system_is_refused():
    contacts = _skate()
    with pytest.raises(ValueError, match="use a LagrangianSystem"):
        nhjax.HamiltonianSystem(
            lambda t, q, p, args: 0.5 * p @ p,
            force=friction.Sliding(contacts, "skate", COULOMB),
        )


def test_contacts_with_another_number_of_multipliers_are_refused():
    with pytest.raises(nhjax.ShapeError, match="have 2 multipliers"):
        _skate().reactions(0.0, jnp.zeros(3), jnp.zeros(3))


@pytest.mark.parametrize("args", [{}, {"args": None}])
def test_force_with_multipliers_and_default_args_receives_multipliers(args):
    """A fourth argument called `multipliers` is found even if `args` has a default."""

    def force(t, q, v, multipliers, args=None):
        return -0.3 * jnp.abs(multipliers[0]) * jnp.tanh(v / 1e-3)

    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v - G * q[1],
        holonomic=lambda t, q, args: q[1],
        force=force,
    )
    y0 = nhjax.initial_state(system, jnp.zeros(2), jnp.array([1.0, 0.0]))
    found = nhjax.motion(system, 0.0, y0).acceleration
    np.testing.assert_allclose(found, [-0.3 * G, 0.0], atol=1e-13)


def test_force_without_args_after_multipliers_is_refused():
    with pytest.raises(TypeError, match=r"must take \(t, q, v, multipliers, args\)"):
        nhjax.LagrangianSystem(
            _lagrangian, nonholonomic=_blade, force=lambda t, q, v, multipliers: v
        )


def test_multipliers_of_a_block_in_a_slot_are_found_where_newton_cycles():
    """Friction at two guides turns the block, so that |λ| changes its branch."""
    mu, a, b = 0.7, 0.1, 0.15

    def force(t, q, v, multipliers, args):
        push = -mu * jnp.abs(multipliers) * jnp.tanh(v[0] / 1e-3)
        moment = 0.1 - b * (push[0] - push[1])
        return jnp.stack([push[0] + push[1], jnp.asarray(-10.0), moment])

    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v,
        holonomic=lambda t, q, args: jnp.stack([q[1] + a * q[2], q[1] - a * q[2]]),
        force=force,
    )
    y0 = nhjax.initial_state(system, jnp.zeros(3), jnp.array([-1.0, 0.0, 0.0]))
    one, two = y0.multiplier
    np.testing.assert_allclose(one + two, 10.0, rtol=1e-12)
    turning = 0.1 - b * mu * (abs(one) - abs(two)) + a * (one - two)
    np.testing.assert_allclose(turning, 0.0, atol=1e-12)


@pytest.mark.parametrize("takes_multipliers", [False, True])
def test_force_with_args_that_are_not_arrays_receives_them_as_given(takes_multipliers):
    def drag(t, q, v, args):
        return -{"steel": args["mu"]}[args["name"]] * args["law"](v)

    def drag_by_load(t, q, v, multipliers, args):
        return drag(t, q, v, args) * multipliers[0]

    def holonomic(t, q, args):
        return q[1] if args["is_flat"] and len(range(args["n"])) == 2 else q[0]

    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v - q[1],
        holonomic=holonomic,
        force=drag_by_load if takes_multipliers else drag,
    )
    args = {"mu": 0.1, "name": "steel", "law": jnp.tanh, "is_flat": True, "n": 2}
    y0 = nhjax.initial_state(system, jnp.zeros(2), jnp.array([1.0, 0.0]), args=args)
    np.testing.assert_allclose(y0.multiplier, [1.0], rtol=1e-15)
    moving = nhjax.motion(system, 0.0, y0, args)
    np.testing.assert_allclose(
        moving.acceleration, [-0.1 * np.tanh(1.0), 0.0], rtol=1e-14, atol=1e-15
    )
    sol = nhjax.integrate(
        system, nhjax.LobattoIIIAB(3), y0, dt=0.1, num_steps=2, args=args
    )
    assert float(_last(sol).v[0]) < 1.0
