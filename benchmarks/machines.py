"""The cost of the first call of each machine of the gallery, with a test of gradients.

The table has the processor time to trace, lower and compile a run with three stages,
and the same for its gradient. The derivative of a run with respect to the step size is
compared with finite differences.

    python -m benchmarks.machines
"""

import argparse
from typing import Any

import jax
import jax.numpy as jnp

from docs.machines import Machine, machines

from ._report import markdown_table, number, write
from .compile_time import compiled, program


def of_machine(machine: Machine) -> dict[str, Any]:
    """Measure a machine, and return its row of the table."""
    system, y0 = machine.example.system, machine.example.initial_state()
    dt = jnp.asarray(machine.duration / machine.num_steps)
    run, run_parts = compiled(program(system, 3, "run"), y0, dt)
    gradient, gradient_parts = compiled(program(system, 3, "gradient"), y0, dt)

    def loss(dt):
        return sum(float(jnp.sum(leaf**2)) for leaf in jax.tree.leaves(run(y0, dt)))

    step = 1e-4 * dt
    ahead, behind = loss(dt + step), loss(dt - step)
    far_ahead, far_behind = loss(dt + 2 * step), loss(dt - 2 * step)
    near, far = (ahead - behind) / (2 * step), (far_ahead - far_behind) / (4 * step)
    expected, found = (4 * near - far) / 3, gradient(y0, dt)[1]
    return {
        "machine": machine.name,
        "run": sum(run_parts),
        "gradient": sum(gradient_parts),
        "error of the derivative": abs(float(found / expected) - 1),
    }


def main() -> None:
    """Print and save the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--machines", nargs="+", help="a part of the names")
    names = parser.parse_args().machines
    jax.config.update("jax_enable_x64", True)
    jax.jit(jnp.sin).lower(0.1).compile()
    rows, data = [], []
    for machine in machines():
        if names and machine.name not in names:
            continue
        row = of_machine(machine)
        print(*row.values(), sep="\t", flush=True)
        data.append(row)
        rows.append(
            [
                machine.name,
                f"{row['run']:.1f}",
                f"{row['gradient']:.1f}",
                number(row["error of the derivative"]),
            ]
        )
        jax.clear_caches()
    header = ["machine", "run", "gradient", "error of the derivative"]
    text = (
        "Seconds of the processor to trace and compile a run with three stages and its "
        "gradient, and the relative error of the derivative of the sum of squares of "
        "the end with respect to the step size.\n\n"
    )
    text += markdown_table(header, rows)
    write("machines", "First calls of the machines", text, {"rows": data})


if __name__ == "__main__":
    main()
