"""States near the constraints are projected onto them, however large the violation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import systems


OFFSETS = [0.0, 1e-16, 1e-15, 1e-14, 1e-13, 1e-12, 1e-11, 1e-10, 1e-9, 1e-6, 1e-4]
CONSTRAINED = [
    systems.Appell(),
    systems.ChaoticSystem(),
    systems.ChaplyginSleigh(),
    systems.ContinuouslyVariableTransmission(),
    systems.DoublePendulum(),
    systems.HeavyTopSE3(),
    systems.KnifeEdge(),
    systems.NonholonomicParticle(),
    systems.RodSleigh(),
    systems.RollingDisc(),
    systems.SphericalPendulum(),
    systems.Suslov(),
    systems.TurntableBall(),
    systems.Unicycle(),
    systems.UnicycleInCoordinates(),
    systems.VerticalRollingDisc(),
]
SPHERE = nhjax.LagrangianSystem(
    lambda t, q, v, args: 0.5 * v @ v - 9.81 * q[2],
    holonomic=lambda t, q, args: q @ q - 1.0,
)


def projector(system):
    return jax.jit(lambda q, v: nhjax.initial_state(system, q, v, project=True))


def directions(rng, like):
    parts = jax.tree.map(lambda x: rng.normal(size=x.shape), like)
    size = np.sqrt(sum(np.sum(x**2) for x in jax.tree.leaves(parts)))
    return jax.tree.map(lambda x: jnp.asarray(x / size), parts)


def moved(tree, offset, rng):
    return jax.tree.map(lambda x, d: x + offset * d, tree, directions(rng, tree))


@pytest.mark.parametrize("example", CONSTRAINED, ids=lambda x: type(x).__name__)
def test_projection_accepts_states_near_constraints(example):
    start, rng = projector(example.system), np.random.default_rng(0)
    y = start(example.q0, example.v0)
    # Appell's constraint, a cone of velocities, is not regular at rest.
    is_cone = isinstance(example, systems.Appell)
    rest = y.v if is_cone else start(y.q, jnp.zeros_like(y.v)).v
    for offset in OFFSETS:
        for v in (y.v, rest):
            for _ in range(4):
                start(moved(y.q, offset, rng), v)
                near = start(y.q, moved(v, offset, rng))
                assert jnp.max(jnp.abs(near.v - v)) <= 10 * offset + 1e-13


def test_projection_in_float32_accepts_states_near_constraints():
    start, rng = projector(SPHERE), np.random.default_rng(0)
    rest = jnp.zeros(3, jnp.float32)
    q = start(jnp.array([0.6, 0.3, 0.7], jnp.float32), rest).q
    for offset in [0.0, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4]:
        for _ in range(10):
            start(moved(q.astype(float), offset, rng).astype(jnp.float32), rest)


def test_projection_accepts_rounded_unit_vectors():
    start, rng = projector(SPHERE), np.random.default_rng(0)
    for _ in range(60):
        q = np.round(np.asarray(directions(rng, jnp.zeros(3))), 10)
        y = start(jnp.asarray(q), jnp.zeros(3))
        np.testing.assert_allclose(y.q @ y.q, 1.0, rtol=1e-15)
        np.testing.assert_allclose(y.q, q, atol=1e-10)


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_projection_does_not_depend_on_unit_of_length(size):
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v, holonomic=lambda t, q, args: q @ q - size**2
    )
    start, rng = projector(system), np.random.default_rng(0)
    y = start(size * jnp.array([0.6, 0.0, 0.8]), jnp.zeros(3))
    for offset in OFFSETS:
        for _ in range(10):
            start(moved(y.q, offset * size, rng), jnp.zeros(3))


def test_projection_accepts_tiny_velocities():
    start, rng = projector(SPHERE), np.random.default_rng(0)
    for size in [1e-300, 1e-30, 1e-16, 1e-8]:
        q, v = (np.asarray(directions(rng, jnp.zeros(3))) for _ in range(2))
        y = start(jnp.asarray(q), jnp.asarray(size * v))
        np.testing.assert_allclose(y.v / size, v - (v @ q) * q, atol=1e-14)


def test_velocity_from_momentum_near_rest_is_exact():
    # In a magnetic field p = M v + A, and v is what remains of their difference.
    field = jnp.array([1.0, -2.0, 0.5]) / 3
    mass = jnp.array([[3.0, 1.0, 0.5], [1.0, 2.0, 0.3], [0.5, 0.3, 0.7]])
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ mass @ v + field @ v
    )
    start = jax.jit(lambda p: nhjax.initial_state(system, jnp.zeros(3), p=p))
    rng = np.random.default_rng(0)
    for offset in OFFSETS:
        for _ in range(5):
            p = moved(field, offset, rng)
            expected = np.linalg.solve(mass, p - field)
            np.testing.assert_allclose(start(p).v, expected, atol=1e-15)


# Constraints that depend on each other ------------------------------------------------


def redundant(t, q, args):
    return jnp.stack([q @ q - 1.0, q[0] - q[1], 2.0 * (q @ q) - 2.0])


THREE = nhjax.LagrangianSystem(
    lambda t, q, v, args: 0.5 * v @ v - 9.81 * q[2], holonomic=redundant
)
NAMED = (
    r"dependent: DΓ does not have full rank at q = \[0\.6 0\.6 0\.3\], v = .*"
    r"admissibility condition fails for holonomic\[0\] and holonomic\[2\]\)\. "
    r"Remove redundant"
)


def test_redundant_constraints_are_named_before_projection():
    with pytest.raises(nhjax.DependentConstraintsError, match=NAMED):
        nhjax.initial_state(
            THREE, jnp.array([0.6, 0.6, 0.3]), jnp.zeros(3), project=True
        )


def test_redundant_constraints_under_jit_are_named():
    with pytest.raises(RuntimeError, match=f"DependentConstraintsError: .*{NAMED}"):
        jax.block_until_ready(
            projector(THREE)(jnp.array([0.6, 0.6, 0.3]), jnp.zeros(3))
        )


@pytest.mark.parametrize("project", [False, True])
def test_redundant_constraint_given_in_both_kinds_is_named(project):
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v,
        nonholonomic=lambda t, q, v, args: jnp.stack([v[0], q @ v]),
        holonomic=lambda t, q, args: q @ q - 1.0,
    )
    message = (
        r"D2Φ and DΓ do not have full rank .* fails for nonholonomic\[1\] and "
        r"holonomic\[0\]\)"
    )
    with pytest.raises(nhjax.DependentConstraintsError, match=message):
        nhjax.initial_state(
            system, jnp.array([0.6, 0.0, 0.8]), jnp.zeros(3), project=project
        )


def test_redundant_constraints_that_are_three_are_listed():
    system = nhjax.HamiltonianSystem(
        lambda t, q, p, args: 0.5 * p @ p,
        nonholonomic=lambda t, q, p, args: jnp.stack([p[0], p[1], p[2], p[0] - p[2]]),
    )
    message = (
        r"D2Ψ does not have full rank.*fails for nonholonomic\[0\], "
        r"nonholonomic\[2\] and nonholonomic\[3\]\)"
    )
    with pytest.raises(nhjax.DependentConstraintsError, match=message):
        nhjax.initial_state(system, jnp.zeros(4), p=jnp.zeros(4), project=True)


def test_projection_from_zero_gradient_of_constraint_is_refused():
    message = (
        r"DΓ does not have full rank at .*0\. 0\. 0\.\].*holonomic\[0\] has no gradi"
    )
    with pytest.raises(nhjax.DependentConstraintsError, match=message):
        nhjax.initial_state(SPHERE, jnp.zeros(3), jnp.zeros(3), project=True)


def test_initial_state_with_cancelling_terms_at_origin_is_accepted():
    # 0.1 + 0.2 - 0.3 is one unit of round-off, and nothing shows the scale of q.
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * (v @ v),
        holonomic=lambda t, q, args: q[0] - q[1] + (0.1 + 0.2 - 0.3),
    )
    y = nhjax.initial_state(system, jnp.zeros(2), jnp.ones(2))
    np.testing.assert_array_equal(y.q, 0)
    with pytest.raises(nhjax.ConstraintViolationError, match="holonomic"):
        nhjax.initial_state(system, jnp.asarray([1e-11, 0.0]), jnp.ones(2))


def test_initial_state_at_rest_with_constraint_rate_of_round_off_is_accepted():
    racer = systems.RollerRacer(
        gait=lambda t: 0.6 * jnp.sin(4 * t + 0.5 * jnp.pi),
        q0=(0.0, 0.0, 0.0, 0.6),
        v0=(0.0, 0.0, 0.0, 0.0),
    )
    np.testing.assert_array_equal(racer.initial_state().v, 0)
