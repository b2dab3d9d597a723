"""The gallery against an independent oracle: the index-reduced ODE, by SciPy."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from nhjax.systems import (
    Appell,
    ChaoticSystem,
    ChaplyginSleigh,
    ContinuouslyVariableTransmission,
    HarmonicOscillator,
    KnifeEdge,
    NonholonomicParticle,
    VerticalRollingDisc,
)


CVT = ContinuouslyVariableTransmission


def blade_velocity(heading, speed, rate):
    return (speed * np.cos(heading), speed * np.sin(heading), rate)


SOLVED = {
    "particle": NonholonomicParticle(),
    "particle heavy": NonholonomicParticle(
        1.7, 0.6, q0=(-0.4, 1.3, 0.1), v0=(0.9, -2.0, 1.3 * 0.9)
    ),
    "particle at rest in y": NonholonomicParticle(
        q0=(1.0, 0.0, 0.0), v0=(0.5, 0.0, 0.0)
    ),
    "sleigh": ChaplyginSleigh(),
    "sleigh backwards": ChaplyginSleigh(
        2.0, 0.3, -0.4, q0=(0.1, 0.2, 2.0), v0=blade_velocity(2.0, 0.7, -1.1)
    ),
    "knife edge": KnifeEdge(),
    "knife edge steep": KnifeEdge(
        1.3, 0.7, 2.5, q0=(0.0, 1.0, -2.0), v0=blade_velocity(-2.0, -0.6, -0.5)
    ),
    "rolling disc": VerticalRollingDisc(),
    "rolling disc wide": VerticalRollingDisc(
        2.0,
        0.7,
        0.4,
        1.5,
        q0=(0.0, 1.0, 0.3, 2.2),
        v0=(*blade_velocity(2.2, 1.8, 1.2), -0.4),
    ),
    "Appell": Appell(),
    "Appell rising": Appell(1.5, 0.3, 1.3, q0=(0.0, 0.0, 1.0), v0=(1.2, -0.5, 1.0)),
    "oscillator": HarmonicOscillator(),
    "oscillator 2d": HarmonicOscillator(2.0, 3.0, q0=(1.0, -0.3), v0=(0.2, 0.8)),
}
GALLERY = SOLVED | {
    "CVT low": CVT.low(),
    "CVT high": CVT.high(),
    "CVT high unperturbed": CVT.high(epsilon=0.0),
    "chaotic": ChaoticSystem(),
    "chaotic 5": ChaoticSystem(m=2),
}
CONSTRAINED = {
    name: example
    for name, example in GALLERY.items()
    if not isinstance(example, HarmonicOscillator)
}


def over(examples):
    return pytest.mark.parametrize("example", examples.values(), ids=examples.keys())


def constraint_of(example, q, v):
    if isinstance(example, HarmonicOscillator):
        return jnp.zeros(0)
    return jnp.atleast_1d(example.constraint(0.0, q, v, None))


@eqx.filter_jit
def acceleration_and_multiplier(example, q, v):
    """Solve d/dt D2L = D1L + λᵀ D2Φ with d/dt Φ = 0 for (a, λ)."""

    def lagrangian(q, v):
        return example.lagrangian(0.0, q, v, None)

    constraint = partial(constraint_of, example)
    momentum = jax.grad(lagrangian, argnums=1)
    M = jax.jacfwd(momentum, argnums=1)(q, v)
    B = jax.jacfwd(constraint, argnums=1)(q, v)
    free = jax.grad(lagrangian)(q, v) - jax.jacfwd(momentum)(q, v) @ v
    hidden = -jax.jacfwd(constraint)(q, v) @ v
    m = B.shape[0]
    matrix = jnp.block([[M, -B.T], [B, jnp.zeros((m, m))]])
    solution = jnp.linalg.solve(matrix, jnp.concatenate([free, hidden]))
    return solution[: q.size], solution[q.size :]


def oracle(example, t):
    """(q, v, λ) at the last of the times `t`, and (q, v) at each of them."""
    q0, v0 = np.asarray(example.q0), np.asarray(example.v0)

    def velocity_field(_, y):
        q, v = np.split(y, 2)
        return np.concatenate([v, acceleration_and_multiplier(example, q, v)[0]])

    times = np.atleast_1d(t)
    solution = solve_ivp(
        velocity_field,
        (0.0, times[-1]),
        np.concatenate([q0, v0]),
        method="DOP853",
        t_eval=times,
        rtol=3e-14,
        atol=1e-14,
    )
    q, v = np.split(solution.y.T, 2, axis=1)
    return q[-1], v[-1], acceleration_and_multiplier(example, q[-1], v[-1])[1], (q, v)


@over(SOLVED)
def test_exact_solution_starts_at_the_initial_data(example):
    q, v, multiplier = example.exact(0.0)
    np.testing.assert_allclose(q, example.q0, rtol=0, atol=1e-15)
    np.testing.assert_allclose(v, example.v0, rtol=0, atol=2e-15)
    expected = acceleration_and_multiplier(example, example.q0, example.v0)[1]
    np.testing.assert_allclose(multiplier, expected, rtol=1e-13, atol=1e-14)


@over(SOLVED)
@pytest.mark.parametrize("t", [3.0, -1.0])
def test_exact_solution_agrees_with_the_index_reduced_ode(example, t):
    q, v, multiplier, _ = oracle(example, t)
    exact_q, exact_v, exact_multiplier = example.exact(t)
    np.testing.assert_allclose(exact_q, q, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(exact_v, v, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(exact_multiplier, multiplier, rtol=1e-11, atol=1e-11)


@over(SOLVED)
def test_exact_velocity_equals_derivative_of_exact_position(example):
    # A long time, where the quadratures take many panels; five-point difference.
    t, h = (3.0 if isinstance(example, Appell) else 40.0), 1e-3
    q = {k: example.exact(t + k * h)[0] for k in (-2, -1, 1, 2)}
    slope = (8 * (q[1] - q[-1]) - (q[2] - q[-2])) / (12 * h)
    np.testing.assert_allclose(slope, example.exact(t)[1], rtol=1e-9, atol=1e-9)


@over(CONSTRAINED)
def test_default_data_satisfy_the_constraint(example):
    violation = constraint_of(example, example.q0, example.v0)
    np.testing.assert_allclose(violation, 0.0, rtol=0, atol=1e-15)


@over(GALLERY)
def test_invariants_are_constant_along_the_motion(example):
    _, _, _, (q, v) = oracle(example, np.linspace(0.0, 3.0, 7))
    values = eqx.filter_vmap(example.invariants, in_axes=(None, 0, 0))(0.0, q, v)
    assert "energy" in values
    for name, value in values.items():
        np.testing.assert_allclose(
            value, value[0] * np.ones(7), rtol=1e-11, atol=1e-11, err_msg=name
        )


@pytest.mark.parametrize("epsilon", [0.0, 0.5])
@pytest.mark.parametrize(
    ("regime", "driver"), [(CVT.low, 0.8), (CVT.high, 3.0)], ids=["low", "high"]
)
def test_cvt_energies_equal_the_paper(regime, driver, epsilon):
    cvt = regime(epsilon=epsilon)
    assert cvt.driver_energy(cvt.q0, cvt.v0) == pytest.approx(driver, abs=1e-15)
    assert cvt.passenger_energy(cvt.q0, cvt.v0) == pytest.approx(1.0, abs=1e-15)
    assert cvt.energy(0.0, cvt.q0, cvt.v0) == pytest.approx(driver + 1.0, abs=1e-15)


def test_cvt_energies_add_up_to_the_total():
    cvt, q, v = CVT(), jnp.array([0.3, 1.2, -0.4]), jnp.array([0.5, -0.7, 0.2])
    total = cvt.driver_energy(q, v) + cvt.passenger_energy(q, v)
    assert total == pytest.approx(float(cvt.energy(0.0, q, v)), abs=1e-15)


@pytest.mark.parametrize(
    ("y", "dy"),
    [
        (0.0, 0.6 * np.sqrt(10.0)),
        (0.0, np.sqrt(8.0)),
        (1.0, -2.5),
        (7.0, 0.3),
        (-5.5, -1.0),
        (2.9, -0.5),
        (0.0, -2.0),
        (-7.0, 3.0),
        (0.0, 0.0),
    ],
)
@pytest.mark.parametrize("t", [3.0, -1.5])
def test_exact_driver_agrees_with_the_index_reduced_ode(y, dy, t):
    cvt = CVT(0.0, q0=(1.0, y, 1.0), v0=(0.0, dy, 0.0))
    q, v, _, _ = oracle(cvt, t)
    np.testing.assert_allclose(cvt.exact_driver(t), (q[1], v[1]), rtol=0, atol=1e-11)


def test_chaotic_ensemble_lies_on_one_energy_surface():
    chaotic = ChaoticSystem()
    q0, v0 = chaotic.ensemble(20)
    assert q0.shape == v0.shape == (21, 7)
    energies = jax.vmap(partial(chaotic.energy, 0.0))(q0, v0)
    np.testing.assert_allclose(energies, 3.06, rtol=0, atol=2e-15)
    violations = jax.vmap(partial(constraint_of, chaotic))(q0, v0)
    np.testing.assert_array_equal(violations, 0.0)


def test_chaotic_ensemble_equals_the_paper():
    q0, v0 = ChaoticSystem().ensemble(2)
    r = np.sqrt(0.5)
    tail = [0.6, 0.4, 0.2, 1.0, 1.0, 1.0]
    np.testing.assert_allclose(
        q0, [[1.0, *tail], [r, *tail], [0.0, *tail]], rtol=0, atol=2e-16
    )
    np.testing.assert_allclose(v0[:, 1], [0.0, r, 1.0], rtol=0, atol=2e-16)
    assert jnp.count_nonzero(v0.at[:, 1].set(0.0)) == 0


def test_chaotic_default_equals_the_middle_of_the_ensemble():
    chaotic = ChaoticSystem(m=4)
    q0, v0 = chaotic.ensemble(2)
    np.testing.assert_allclose(chaotic.q0, q0[1], rtol=0, atol=2e-16)
    np.testing.assert_allclose(chaotic.v0, v0[1], rtol=0, atol=2e-16)


@over(GALLERY)
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_system_computes_in_precision_of_the_state(example, dtype):
    y0 = example.initial_state(dtype)
    assert y0.q.dtype == y0.v.dtype == y0.p.dtype == y0.multiplier.dtype == dtype
    t = jnp.zeros((), dtype)
    assert example.system.lagrangian(t, y0.q, y0.v, None).dtype == dtype
    for value in example.invariants(t, y0.q, y0.v).values():
        assert value.dtype == dtype


@over(GALLERY)
def test_initial_state_has_the_multiplier_of_the_continuous_system(example):
    y0 = example.initial_state()
    assert y0.q.dtype == jnp.float64
    expected = acceleration_and_multiplier(example, example.q0, example.v0)[1]
    np.testing.assert_allclose(y0.multiplier, expected, rtol=1e-12, atol=1e-13)


@over(GALLERY)
def test_parameters_are_leaves_of_the_system(example):
    t, q, v = jnp.zeros(()), example.q0, example.v0
    gradient = jax.grad(lambda system: system.lagrangian(t, q, v, None))(example.system)
    assert jax.tree.structure(gradient) == jax.tree.structure(example.system)
    assert len(jax.tree.leaves(example)) <= len(jax.tree.leaves(example.system))


def test_gradient_in_a_parameter_through_the_system_is_exact():
    t, q, v = jnp.zeros(()), jnp.ones(3), jnp.ones(3)

    def value(stiffness):
        system = NonholonomicParticle(stiffness=stiffness).system
        return system.lagrangian(t, q, v, None)

    assert jax.grad(value)(jnp.array(2.0)) == -1.0


def test_parameter_with_new_value_does_not_recompile():
    traces = 0

    @jax.jit
    def value(system, q, v):
        nonlocal traces
        traces += 1
        return system.lagrangian(0.0, q, v, None)

    for mass in (1, 2.0, np.float32(3.0)):
        sleigh = ChaplyginSleigh(mass=mass)
        value(sleigh.system, sleigh.q0, sleigh.v0)
    assert traces == 1


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: ChaoticSystem(m=1), r"`m` must be at least 2, got 1"),
        (lambda: ChaoticSystem(q0=jnp.ones(5)), r"`q0` must have shape \(7,\)"),
        (lambda: ChaoticSystem().ensemble(0), r"`members` must be at least 1, got 0"),
        (lambda: NonholonomicParticle(stiffness=-1.0), r"`stiffness` .* got -1"),
        (lambda: ChaplyginSleigh(inertia=0.0), r"`inertia` must be positive, got 0"),
        (lambda: KnifeEdge(mass=-2.0), r"`mass` must be positive, got -2"),
        (lambda: VerticalRollingDisc(radius=0.0), r"`radius` must be positive, got 0"),
        (lambda: Appell(ratio=-0.5), r"`ratio` must be positive, got -0\.5"),
        (lambda: HarmonicOscillator(mass=0.0), r"`mass` must be positive, got 0"),
    ],
)
def test_gallery_parameter_out_of_range_raises(build, message):
    with pytest.raises(ValueError, match=message):
        build()


@pytest.mark.parametrize(
    ("example", "message"),
    [
        (ChaplyginSleigh(offset=0.0), r"`offset` must be nonzero"),
        (ChaplyginSleigh(v0=(1.0, 0.0, 0.0)), r"`v0\[2\]` must be nonzero"),
        (KnifeEdge(q0=(0.0,) * 3, v0=(1.0, 0.0, 0.0)), r"`v0\[2\]` must be nonzero"),
        (VerticalRollingDisc(v0=(1.0, 0.0, 1.0, 0.0)), r"`v0\[3\]` must be nonzero"),
        (Appell(v0=(0.0, 0.0, 0.0)), r"`v0\[2\]` must be nonzero"),
        (NonholonomicParticle(v0=(0.4, 0.7, 0.5)), r"`v0` violates the constraint"),
    ],
)
def test_exact_solution_of_unsupported_data_raises(example, message):
    with pytest.raises(ValueError, match=message):
        example.exact(1.0)


def test_exact_solution_of_appell_beyond_singular_instant_raises():
    rising = SOLVED["Appell rising"]
    with pytest.raises(ValueError, match=r"`t` = 9\.0 is beyond the singular instant"):
        rising.exact(9.0)


def test_sleigh_ends_in_uniform_motion_with_the_centre_of_mass_ahead():
    sleigh = ChaplyginSleigh()
    _, v, multiplier = sleigh.exact(2000.0)
    energy = sleigh.energy(0.0, sleigh.q0, sleigh.v0)
    assert np.hypot(v[0], v[1]) == pytest.approx(np.sqrt(2 * energy), rel=1e-14)
    assert v[2] == multiplier[0] == 0.0


def test_exact_driver_of_perturbed_pendulum_raises():
    with pytest.raises(ValueError, match=r"`epsilon` must be 0 .* got 0\.5"):
        CVT().exact_driver(1.0)
