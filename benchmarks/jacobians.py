"""Iterations a step with the Jacobian of simplified Newton, and with fuller ones.

`SimplifiedNewton` inverts the leading part of the Jacobian of the stage equations, with
the mass matrix at the start of the step and without the derivatives of forces and of
constraints by velocities and positions, which enter at order h. Beside it are the exact
Jacobian at the starting values, kept for the whole step, which is the most that one
factorisation a step can do, and the exact Jacobian of every iterate (`Newton`). Runs
that fail are shown with the number of steps that they made.

    python -m benchmarks.jacobians
"""

import argparse

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

import nhjax
from nhjax import systems
from nhjax._numerics import iterate, NOISE_UNITS
from nhjax._step._scale import fibre_coordinate_scale
from nhjax._step._stage_iteration import sizes

from ._report import markdown_table, write


NUM_STEPS = 20
CASES = [
    ("Unicycle", 3, 0.1),
    ("Unicycle", 5, 0.25),
    ("Unicycle", 8, 0.5),
    ("Suslov", 3, 0.1),
    ("Veselova", 3, 0.1),
    ("HeavyTop", 3, 0.1),
    ("HeavyTopSE3", 3, 0.1),
    ("TurntableBall", 3, 0.1),
    ("ChaplyginSleigh", 3, 0.1),
    ("ChaplyginSleigh", 5, 0.5),
    ("RollingDisc", 3, 0.1),
    ("CarWithTrailers", 3, 0.1),
    ("ChaoticSystem", 3, 0.1),
    ("NonholonomicParticle", 3, 0.1),
]


class ExactAtStart(nhjax.AbstractStageSolver):
    """Newton's method with the exact Jacobian at the starting values of the step."""

    max_iterations: int = eqx.field(static=True, default=100)
    tolerance: float = 0.0

    def solve(self, stages, x0, lin, skip):
        """Solve the stage equations from `x0`."""
        z0, unravel = ravel_pytree(x0)
        jacobian = jax.jacfwd(lambda z: nhjax.stage_residual(stages, unravel(z))[0])
        jacobian_inverse = jnp.linalg.inv(jacobian(z0))

        def sweep(x):
            residual, evaluation = nhjax.stage_residual(stages, x)
            x_next = unravel(ravel_pytree(x)[0] - jacobian_inverse @ residual)
            return x_next, sizes(stages, x, x_next, lin), evaluation

        return iterate(
            sweep,
            x0,
            fibre_coordinate_scale(stages, x0, lin),
            max_iterations=self.max_iterations,
            tolerance=self.tolerance,
            noise_units=NOISE_UNITS,
            skip=skip,
        )

    def frozen_newton_map(self, stages, lin, x):
        """Make the iteration of `nhjax.Newton`, which has the same solution."""
        return nhjax.Newton().frozen_newton_map(stages, lin, x)


SOLVERS = {
    "leading part": nhjax.SimplifiedNewton(fallback=False),
    "exact at the start": ExactAtStart(),
    "exact": nhjax.Newton(),
}


def iterations(
    name: str, stages: int, dt: float, solver: nhjax.AbstractStageSolver
) -> tuple[int, float]:
    """The number of steps that a run makes, and the iterations of each on average."""
    example = getattr(systems, name)()
    stats = nhjax.integrate(
        example.system,
        nhjax.LobattoIIIAB(stages),
        example.initial_state(),
        dt=dt,
        num_steps=NUM_STEPS,
        stage_solver=solver,
        throw=False,
    ).stats
    steps = int(stats["num_steps"])
    return steps, int(stats["num_iterations"]) / max(steps, 1)


def main() -> None:
    """Print and save the table."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    jax.config.update("jax_enable_x64", True)
    rows, data = [], []
    for name, stages, dt in CASES:
        row = [name, str(stages), f"{dt:g}"]
        for kind, solver in SOLVERS.items():
            steps, mean = iterations(name, stages, dt, solver)
            solved = steps == NUM_STEPS
            row.append(f"{mean:.1f}" if solved else f"fails after {steps} steps")
            data.append(
                {"system": name, "stages": stages, "dt": dt, "jacobian": kind}
                | {"num_steps": steps, "iterations": mean}
            )
        rows.append(row)
    text = (
        f"Iterations a step, mean of {NUM_STEPS} steps.\n\n"
        f"{markdown_table(['system', 's', 'h', *SOLVERS], rows)}"
    )
    write("jacobians", "Jacobians of the stage equations", text, {"rows": data})


if __name__ == "__main__":
    main()
