"""Gradients of whole runs of the gallery against finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from docs.machines import machines
from nhjax import LobattoIIIAB, systems
from support import helpers
from support.gradients import split, STEPS
from support.helpers import (
    central_difference,
    direction,
    dot,
    moved,
    scalar,
    SideBySide,
)
from support.long import exhaustive_but


def assert_gradients_of_examples(examples, method, turning):
    """Differentiate each example in its own parameters, state and force, all in dt.

    The force is gyroscopic, of size `turning`: it depends on velocities and does no
    work.
    """
    given, joined = zip(*map(split, examples), strict=True)
    given = [part | {"turning": jnp.asarray(turning)} for part in given]

    def losses(given, dt):
        pairs = zip(joined, given, strict=True)
        beside = SideBySide(tuple(join(part) for join, part in pairs))

        def force(t, q, v, args):
            pairs = zip(args, beside.parts(v), strict=True)
            return jnp.concatenate(
                [turning * (jnp.roll(u, 1) - jnp.roll(u, -1)) for turning, u in pairs]
            )

        args = [part["turning"] for part in given]
        system = beside.system(force=force)
        y0 = beside.initial_state(system, args=args, project=True)
        ys = nhjax.integrate(system, method, y0, dt=dt, num_steps=STEPS, args=args).ys
        fibres = beside.parts(ys.v), beside.parts(ys.p)
        parts = zip(ys.q, *fibres, beside.multipliers(ys.multiplier), strict=True)
        each = jnp.stack([scalar(part) for part in parts])
        return jnp.sum(each), each

    dt, along = jnp.asarray(0.05), direction(given)
    # `moved` by 0 makes the types as strong as below, so that one program suffices.
    given = moved(given, along, 0.0)
    program = jax.jit(jax.value_and_grad(losses, argnums=(0, 1), has_aux=True))
    _, (gradients, in_dt) = program(given, dt)
    # Smaller differences are lost in the rounding errors of propagated multipliers,
    # which the sleigh amplifies.
    expected = central_difference(
        lambda eps: program(moved(given, along, eps), dt)[0][1], 5e-4
    )
    assert np.all(np.abs(expected) > 1e-2)
    got = [dot(g, d) for g, d in zip(gradients, along, strict=True)]
    np.testing.assert_allclose(got, expected, rtol=1e-8)
    expected = central_difference(lambda eps: program(given, dt + eps)[0][0], 1e-5)
    np.testing.assert_allclose(in_dt, expected, rtol=1e-8)


# Systems side by side are one program, as long as their matrices stay small.
BESIDE = {
    "attracting and linear": [
        helpers.GALLERY[name]
        for name in ("particle", "sleigh", "knife edge", "rolling disc", "Appell")
    ],
    "chaotic and integrable": [
        *(helpers.GALLERY[name] for name in ("CVT low", "CVT high", "chaotic")),
        systems.UnicycleInCoordinates(),
    ],
    "rod sleigh": [systems.RodSleigh()],
    "oscillator and pendulums": [
        systems.HarmonicOscillator(),
        systems.SphericalPendulum(),
        systems.DoublePendulum(),
    ],
    "unicycle": [systems.Unicycle()],
    "disc": [systems.RollingDisc()],
    "ball": [systems.TurntableBall()],
    "Suslov": [systems.Suslov()],
    "Veselova": [systems.Veselova()],
    "rigid body": [systems.FreeRigidBody()],
    "heavy top": [systems.HeavyTop()],
    "heavy top on SE(3)": [systems.HeavyTopSE3()],
}


# On a vector space and on each kind of group, with each closure.
QUICK = (
    ("unicycle", 2, "propagated"),
    ("Suslov", 2, "consistent"),
    ("oscillator and pendulums", 2, "symmetric"),
    ("heavy top", 2, "symmetric"),
)


@pytest.mark.parametrize(
    ("name", "stages", "closure"),
    exhaustive_but(
        QUICK,
        [
            ("attracting and linear", 2, "propagated"),
            ("chaotic and integrable", 3, "symmetric"),
            ("rod sleigh", 2, "propagated"),
            ("unicycle", 2, "propagated"),
            ("disc", 2, "propagated"),
            ("ball", 2, "symmetric"),
            ("Suslov", 2, "consistent"),
            ("Veselova", 2, "symmetric"),
            # Without nonholonomic constraints no closure is needed.
            ("oscillator and pendulums", 2, "symmetric"),
            ("rigid body", 2, "symmetric"),
            ("heavy top", 2, "symmetric"),
            ("heavy top on SE(3)", 2, "symmetric"),
        ],
    ),
)
def test_gradient_of_each_gallery_system_matches_finite_differences(
    name, stages, closure
):
    # The sleigh amplifies rounding errors of propagated multipliers; with a force of
    # this sign, its gradient is large compared with them.
    turning = -0.05 if name == "attracting and linear" else 0.05
    method = LobattoIIIAB(stages, closure)
    assert_gradients_of_examples(BESIDE[name], method, turning)


def test_gradient_tests_cover_every_gallery_system():
    kinds = {
        value
        for name, value in vars(systems).items()
        if isinstance(value, type) and hasattr(value, "lagrangian")
    }
    here = {type(x) for examples in BESIDE.values() for x in examples}
    # Gradients of machines take long to compile: a benchmark compares them.
    assert here | {type(machine.example) for machine in machines()} >= kinds
