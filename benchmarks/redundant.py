"""The cost of redundant constraints.

A parallelogram is a body on two parallel cranks. A third crank adds a constraint that
follows from the other two. The cart is a robot with a free root on two wheels and a
sliding caster. Neither wheel can slip sideways, and these two constraints are the same
condition, because the wheels share an axle.

    python -m benchmarks.redundant
"""

import argparse
import importlib
import json
import time
from typing import Any

import jax
import jax.numpy as jnp

import nhjax

from ._report import from_fresh_process, least_time, markdown_table, write


NUM_STEPS = 2000
CRANKS = (-1.0, 1.0, 0.2)  # where the cranks are attached, m

_CART = """<mujoco><default><geom contype="0" conaffinity="0"/></default><worldbody>
<body name="base" pos="0 0 0.1"><freejoint name="root"/>
<geom type="box" size="0.2 0.13 0.05" pos="0 0 0.06" mass="9"/>
<geom name="caster" type="sphere" size="0.04" pos="0.26 0 -0.06" mass="0.1"/>
<body name="left" pos="0 0.16 0"><joint name="left" axis="0 1 0"/>
<geom name="left" type="cylinder" size="0.1 0.02" euler="90 0 0" mass="0.8"/></body>
<body name="right" pos="0 -0.16 0"><joint name="right" axis="0 1 0"/>
<geom name="right" type="cylinder" size="0.1 0.02" euler="90 0 0" mass="0.8"/></body>
</body></worldbody></mujoco>"""


def parallelogram(cranks: int) -> tuple[Any, Any, Any]:
    """Return a body on cranks of length 1 m, and its position and velocity."""
    at = jnp.asarray(CRANKS[:cranks])

    def lagrangian(t, q, v, args):
        return 0.5 * (v[0] ** 2 + v[1] ** 2 + 0.4 * v[2] ** 2) - 9.81 * q[1]

    def lengths(t, q, args):
        x = q[0] + at * jnp.cos(q[2]) - at
        y = q[1] + at * jnp.sin(q[2])
        return x**2 + y**2 - 1

    system = nhjax.LagrangianSystem(
        lagrangian,
        holonomic=lengths,
        constraints="redundant" if cranks > 2 else "independent",
    )
    angle = jnp.asarray(-0.5)
    q = jnp.stack([jnp.cos(angle), jnp.sin(angle), 0 * angle])
    v = 0.3 * jnp.stack([-jnp.sin(angle), jnp.cos(angle), 0 * angle])
    return system, q, v


def measure(name: str) -> dict[str, float]:
    """Measure processor times of the first calls, and the time of a step."""
    begin = time.process_time()
    if name == "cart":
        mujoco: Any = importlib.import_module("mujoco")
        rolling = {"left": "no slip", "right": "no slip", "caster": "slides"}
        spec = mujoco.MjSpec.from_string(_CART)
        robot = nhjax.from_mujoco(spec, rolling=rolling, constraints="redundant")
        begin, system, stages = time.process_time(), robot.system, 2
        rates = {"root": [0.3, 0, 0, 0, 0, 0.2], "left": 2.68, "right": 3.32}
        y0 = robot.initial_state(qvel=rates, project=True)
    else:
        (system, q, v), stages = parallelogram(int(name)), 3
        y0 = nhjax.initial_state(system, q, v)
    jax.block_until_ready(y0)
    ready = time.process_time()

    @jax.jit
    def run(y):
        method = nhjax.LobattoIIIAB(stages)
        sol = nhjax.integrate(
            system, method, y, dt=0.005, num_steps=NUM_STEPS, throw=False
        )
        return sol.ys.q, sol.stats["num_redundant"]

    _, redundant = jax.block_until_ready(run(y0))
    done = time.process_time()
    return {
        "redundant": int(redundant),
        "state": ready - begin,
        "run": done - ready,
        "step": least_time(lambda: run(y0), 7) / NUM_STEPS,
    }


def main() -> None:
    """Print and save the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--case", help=argparse.SUPPRESS)
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    jax.jit(jnp.sin).lower(0.1).compile()
    if given.case is not None:
        print(json.dumps(measure(given.case)))
        return
    names = {
        "2": "parallelogram, two cranks",
        "3": "parallelogram, three cranks",
        "cart": "cart with a free root",
    }
    rows = {case: from_fresh_process("redundant", "--case", case) for case in names}
    ratio = rows["3"]["step"] / rows["2"]["step"]
    lines = [
        [
            names[case],
            str(row["redundant"]),
            f"{row['state']:.1f}",
            f"{row['run']:.1f}",
            f"{1e6 * row['step']:.1f}",
        ]
        for case, row in rows.items()
    ]
    header = ["system", "redundant", "first state, s", "first run, s", "step, µs"]
    text = (
        "Processor times of the first calls, and the time of a step in a run of "
        f"{NUM_STEPS} steps; three stages, for the cart two. A step with three cranks "
        f"takes {ratio:.1f} times as long as a step with two.\n\n"
        + markdown_table(header, lines)
    )
    write("redundant", "Redundant constraints", text, rows | {"ratio": ratio})


if __name__ == "__main__":
    main()
