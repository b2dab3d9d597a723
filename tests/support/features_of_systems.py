"""Short tests of systems, methods and solvers, as users run them."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import sympy
from sympy.physics.mechanics import dynamicsymbols

import nhjax
from nhjax import LobattoIIIAB, systems
from support.helpers import twice_constrained_pendulum
from support.user_features import assert_exact, close, feature, PARTICLE, run, TWO


@feature
def propagated_closure():
    assert_exact(PARTICLE, run(method=LobattoIIIAB(4, "propagated")))


@feature
def consistent_closure():
    assert_exact(PARTICLE, run(method=LobattoIIIAB(4, "consistent")))


@feature
def symmetric_closure():
    assert_exact(PARTICLE, run())


@feature
def newtons_method():
    close(run(stage_solver=nhjax.Newton()).ys, run().ys)


@feature
def gauss_without_constraints():
    oscillator = systems.HarmonicOscillator()
    assert_exact(oscillator, run(oscillator, nhjax.Gauss(4)))


@feature
def a_constraint_nonlinear_in_velocities():
    appell = systems.Appell()
    assert_exact(appell, run(appell))


@feature
def holonomic_constraints():
    pendulum = systems.SphericalPendulum()
    assert_exact(pendulum, run(pendulum))


@feature
def both_kinds_of_constraints():
    sleigh = systems.RodSleigh()
    assert_exact(sleigh, run(sleigh))


@feature
def redundant_constraints():
    pendulum = systems.SphericalPendulum()
    system, y0 = twice_constrained_pendulum()
    sol = run(pendulum, system=system, y0=y0)
    assert_exact(pendulum, sol)
    assert int(sol.stats["num_redundant"]) == 1
    assert not np.any(nhjax.motion(system, 0.0, y0).is_unique)
    report = nhjax.check_system(system, pendulum.q0, pendulum.v0)
    assert report.degrees_of_freedom == 2


@feature
def many_constraints_that_share_few_coordinates():
    chain = systems.PendulumChain(5)
    sol = run(chain, num_steps=3)
    assert float(sol.stats["max_constraint_violation"]) < 1e-13
    start, y = chain.initial_state(), jax.tree.map(lambda x: x[-1], sol.ys)
    close(chain.energy(0.3, y.q, y.v), chain.energy(0.0, start.q, start.v), 1e-7)


@feature
def a_hamiltonian_system():
    pendulum = systems.SphericalPendulum()
    system = nhjax.HamiltonianSystem(
        lambda t, q, p, args: 0.5 * p @ p + q[2], holonomic=pendulum.holonomic
    )
    y0 = nhjax.initial_state(system, pendulum.q0, p=pendulum.v0)
    assert_exact(pendulum, run(pendulum, system=system, y0=y0))


@feature
def a_group():
    suslov = systems.Suslov()
    assert_exact(suslov, run(suslov), 1e-6)


@feature
def a_group_with_the_chart_of_the_paper():
    suslov = systems.Suslov()
    assert_exact(suslov, run(suslov, LobattoIIIAB(4, chart="start")))


@feature
def a_product_of_groups():
    ball = systems.TurntableBall(retraction=nhjax.Exponential())
    assert_exact(ball, run(ball), 1e-6)


@feature
def a_projected_start():
    q = PARTICLE.q0 + 0.1
    y = nhjax.initial_state(PARTICLE.system, q, PARTICLE.v0, project=True)
    assert abs(float(PARTICLE.constraint(0.0, y.q, y.v, None))) < 1e-14


@feature
def a_projected_start_with_kept_components():
    disc = systems.RollingDisc(radius=0.5)
    v = jnp.array([3.0, 0.1, 0.2, 0.0])
    y = nhjax.initial_state(disc.system, disc.q0, v, project=True, keep_v=(0, 2))
    np.testing.assert_array_equal(y.v[::2], v[::2])
    close(y.v, jnp.array([3.0, 0.0, 0.2, 6.0]))
    q = PARTICLE.q0 + 0.1
    y = nhjax.initial_state(
        PARTICLE.system, q, p=PARTICLE.v0, project=True, keep_q=1, keep_p=(0,)
    )
    assert abs(float(PARTICLE.constraint(0.0, y.q, y.v, None))) < 1e-14
    np.testing.assert_array_equal(y.p[0], PARTICLE.v0[0])


@feature
def time_force_and_args():
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v,
        nonholonomic=lambda t, q, v, args: v[1] - jnp.cos(t),
        force=lambda t, q, v, args: -args["friction"] * v,
    )
    args = {"friction": 0.5}
    y0 = nhjax.initial_state(system, jnp.zeros(2), jnp.ones(2), args=args)
    sol = run(system=system, y0=y0, args=args)
    close(sol.ys.v[-1], jnp.array([np.exp(-0.5), np.cos(1.0)]), 1e-9)


@feature
def a_model_from_sympy():
    x, y, _ = coordinates = dynamicsymbols("x y z")
    speeds = [q.diff() for q in coordinates]
    k = sympy.Symbol("k")
    model = nhjax.from_sympy(
        sum(u**2 for u in speeds) / 2 - k * (x**2 + y**2) / 2,
        coordinates,
        nonholonomic=speeds[2] - y * speeds[0],
        parameters={k: 1.0},
    )
    y0 = model.initial_state(PARTICLE.q0, PARTICLE.v0)
    assert_exact(PARTICLE, run(system=model.system, y0=y0, args=model.args))


@feature
def accelerations_and_a_report():
    pendulum = systems.SphericalPendulum()
    y0 = pendulum.initial_state()
    motion = nhjax.motion(pendulum.system, 0.0, y0)
    close(motion.multiplier, pendulum.exact(0.0)[2])
    report = nhjax.check_system(pendulum.system, pendulum.q0, pendulum.v0)
    assert report.degrees_of_freedom == 2
    close(motion.constraint_jacobian[0], 2 * y0.q)
    assert motion.constrained_mass_matrix.shape == (4, 4)
    close(motion.reaction_of_each[0], motion.reaction)
    assert motion.compatibility_matrix.shape == (1, 1)


@feature
def a_steady_motion_and_its_stability():
    pendulum = systems.SphericalPendulum.swinging(0.3, gravity=4.0)
    y0 = pendulum.initial_state()
    hanging: dict[str, Any] = {"positions": (0, 1), "velocities": (0, 1)}
    y = nhjax.steady_motion(pendulum.system, 0.0, y0, **hanging)
    for chosen in ({}, hanging):
        stability = nhjax.linear_stability(pendulum.system, 0.0, y, **chosen)
        close(jnp.sort(jnp.abs(stability.eigenvalues)), jnp.full(4, 2.0), 1e-12)


@feature
def stability_up_to_a_symmetry():
    cosine = 0.25
    radius, speed = (1 - cosine**2) ** 0.5, (1 / cosine - cosine) ** 0.5
    cone = systems.SphericalPendulum(q0=(0, radius, -cosine), v0=(speed, 0, 0))
    stability = nhjax.linear_stability(
        cone.system,
        0.0,
        cone.initial_state(),
        symmetry=lambda q: jnp.stack([-q[1], q[0], 0 * q[2]]),
    )
    assert stability.basis.shape == (6, 3)
    y0 = nhjax.initial_state(cone.system, cone.q0, 1.1 * cone.v0)
    y, rates = nhjax.steady_motion(
        cone.system,
        0.0,
        y0,
        symmetry=lambda q: jnp.stack([-q[1], q[0], 0 * q[2]]),
        held_positions=(2,),
    )
    close([*rates, y.q[2]], [-2.0, -cosine])
    frequency = (1 / cosine + 3 * cosine) ** 0.5
    close([*jnp.sort(stability.eigenvalues.imag)], [-frequency, 0.0, frequency])


@feature
def motions_in_the_plane_and_in_space():
    for example in (systems.Unicycle(), systems.HeavyTopSE3()):
        y0 = example.initial_state()
        y = jax.tree.map(lambda x: x[-1], run(example).ys)
        expected = example.energy(0.0, y0.q, y0.v)
        close(
            example.energy(1.0, y.q, y.v), expected, 1e-6 * (1 + abs(float(expected)))
        )


@feature
def a_tableau_of_ones_own():
    trapezoidal = [[0.0, 0.0], [0.5, 0.5]], [0.5, 0.5]
    method = nhjax.PartitionedRungeKutta(*trapezoidal, closure="symmetric")
    close(run(method=method).ys, run(method=TWO).ys)


@feature
def settings_of_the_iteration():
    for solver in (
        nhjax.SimplifiedNewton(fallback=True),
        nhjax.SimplifiedNewton(jacobian="leading"),
        nhjax.SimplifiedNewton(tolerance=1e-14),
    ):
        close(run(stage_solver=solver).ys, run().ys)


@feature
def a_bad_member_among_starts():
    starts = jnp.stack([PARTICLE.v0, PARTICLE.v0 + 1.0])
    y = jax.vmap(
        lambda v: nhjax.initial_state(PARTICLE.system, PARTICLE.q0, v, throw=False)
    )(starts)
    close(y.p[0], PARTICLE.initial_state().p)
    assert jnp.all(jnp.isnan(y.p[1]))
