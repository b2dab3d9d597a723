"""The operations on numbers of one sweep of simplified Newton, in the lanes of a batch.

They are counted in the innermost loop of the program that nhjax compiles, s = 3, before
LLVM joins products and sums. Elementary functions are calls of functions of their own.
With `--jacobian first_order` the sweep has the terms of order h.
"""

import argparse
import re
from collections import Counter
from typing import Literal
from unittest import mock

import jax
import jax.numpy as jnp

import nhjax
from nhjax import systems
from nhjax.lanes import _program

from ._report import markdown_table, write


NAMES = (
    "NonholonomicParticle",
    "ChaoticSystem",
    "UnicycleInCoordinates",
    "Unicycle",
    "Suslov",
    "HeavyTop",
    "TurntableBall",
)
KINDS = {
    "products": ("fmul",),
    "sums": ("fadd", "fsub"),
    "divisions": ("fdiv",),
    "sin, cos": ("nhjax.sin", "nhjax.cos"),
    "arctan": ("nhjax.atan",),
}
_OPERATION = re.compile(r"= (f\w+) ")
_CALL = re.compile(r"@(nhjax\.\w+)\.f64")


def programs(name: str, jacobian: Literal["leading", "first_order"]) -> list[str]:
    """The programs in LLVM's language to which a batch of runs is compiled."""
    example, found = getattr(systems, name)(), []
    compiled = _program.object_code

    def kept(texts, *rest):
        found.extend(texts)
        return compiled(texts, *rest)

    def run(y0):
        return nhjax.integrate(
            example.system,
            nhjax.LobattoIIIAB(3),
            y0,
            dt=0.1,
            num_steps=10,
            stage_solver=nhjax.SimplifiedNewton(fallback=False, jacobian=jacobian),
            throw=False,
        ).ys

    y0 = example.initial_state()
    batch = jax.tree.map(lambda x: jnp.broadcast_to(x, (16, *x.shape)), y0)
    with mock.patch.object(_program, "object_code", kept):
        jax.jit(jax.vmap(run)).lower(batch)
    return found


def operations(text: str) -> Counter:
    """Count the operations of the innermost loop of a program."""
    blocks = re.findall(r"^b(\d+)\.round:\n(.*?)^\S+:$", text, re.MULTILINE | re.DOTALL)
    _, inner = max(blocks, key=lambda block: int(block[0]))
    return Counter(_OPERATION.findall(inner)) + Counter(_CALL.findall(inner))


def main() -> None:
    """Print and save the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--jacobian", choices=("leading", "first_order"), default="leading"
    )
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows, data = [], []
    for name in NAMES:
        counts = operations(max(programs(name, options.jacobian), key=len))
        row = {kind: sum(counts[op] for op in ops) for kind, ops in KINDS.items()}
        data.append({"system": name} | row)
        rows.append([name, *map(str, row.values())])
    text = markdown_table(["system", *KINDS], rows)
    data = {"jacobian": options.jacobian, "rows": data}
    write("sweep_operations", "Operations of a sweep, s = 3", text, data)


if __name__ == "__main__":
    main()
