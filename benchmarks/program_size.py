"""The size of the compiled time loop: what a manifold, a form, a constraint cost.

Instructions and fusions of the optimised HLO of `integrate` by XLA, s = 3. On R^n a
group must cost nothing: the first three lines are to be compared with those of a
revision without groups, which had 2990, 4112 and 1296 instructions.
"""

import argparse
import os
import re

import jax

import nhjax
from nhjax import systems
from nhjax.systems._base import AbstractExample

from ._report import markdown_table, write


def examples() -> tuple:
    """The systems, made once the precision has been chosen."""
    return (
        systems.NonholonomicParticle(),
        systems.ChaplyginSleigh(),
        systems.HarmonicOscillator(),
        systems.SphericalPendulum(),
        systems.RodSleigh(),
        systems.UnicycleInCoordinates(),
        systems.Unicycle(),
        systems.Unicycle(retraction=nhjax.Exponential()),
        systems.FreeRigidBody(),
        systems.Suslov(),
        systems.TurntableBall(),
        systems.HeavyTopSE3(),
    )


def program(example: AbstractExample, stages: int) -> str:
    """The optimised HLO of 100 steps."""
    y0 = example.initial_state()

    def loop(y0, dt):
        sol = nhjax.integrate(
            example.system,
            nhjax.LobattoIIIAB(stages),
            y0,
            dt=dt,
            num_steps=100,
            throw=False,
        )
        return sol.ys, sol.stats

    return str(jax.jit(loop).lower(y0, 0.1).compile().as_text())


def main() -> None:
    """Print and save the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stages", type=int, default=3)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    # In the lanes of vectors a run is one instruction.
    os.environ["NHJAX_ENGINE"] = "kernels"
    rows, data = [], []
    for example in examples():
        text = program(example, options.stages)
        count = len(re.findall(r"^\s+(?:ROOT )?%?\S+ = ", text, re.MULTILINE))
        fusions = text.count(" fusion(")
        manifold = repr(example.system.manifold_of(example.q0))
        name = type(example).__name__
        rows.append([name, manifold, str(count), str(fusions)])
        data.append({"system": name, "manifold": manifold, "instructions": count})
        print(*rows[-1], sep="\t", flush=True)
        jax.clear_caches()
    header = ["system", "manifold", "instructions", "fusions"]
    note = f"s = {options.stages}; optimised HLO for the CPU.\n\n"
    text = note + markdown_table(header, rows)
    write("program_size", "Size of the compiled time loop", text, {"rows": data})


if __name__ == "__main__":
    main()
