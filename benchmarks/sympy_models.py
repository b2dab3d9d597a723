"""The cost of the first call of a SymPy model, compared with the model by hand.

The table has the processor time to trace, lower and compile a run with three stages,
and its gradient. The models are a particle with three coordinates, and the bicycle of
SymPy's tests with eight coordinates, both with constraints. The models by hand are from
the gallery. Each first call runs in its own process, because a later call could reuse
programs of an earlier call. The table has the least of several times.

    python -m benchmarks.sympy_models
"""

import argparse
import itertools
import json
import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

import nhjax
from nhjax import systems

from . import _sympy_models as sympy_models
from ._report import from_fresh_process, markdown_table, write
from .compile_time import compiled, program


BOUND = 1.5
SPEED = 5.0


class Pair(NamedTuple):
    """The same model by hand and from SymPy: systems with their initial states."""

    name: str
    size: int
    by_hand: tuple[Any, nhjax.State]
    imported: tuple[Any, nhjax.State]
    import_seconds: float


def particles() -> Pair:
    """Create both models of the particle of the gallery."""
    before = time.process_time()
    model = sympy_models.particle()
    importing = time.process_time() - before
    example = systems.NonholonomicParticle()
    by_hand = example.system, example.initial_state()
    start = model.initial_state(example.q0, example.v0)
    return Pair("particle", 3, by_hand, (_fixed(model), start), importing)


def bicycles() -> Pair:
    """Create both models of the upright bicycle of Meijaard et al."""
    before = time.process_time()
    model = sympy_models.bicycle()
    importing = time.process_time() - before
    riding = systems.WhippleBicycle.running(speed=SPEED)
    by_hand = riding.system, riding.initial_state()
    rolling = {"x": SPEED, "q3": SPEED / 0.3, "q6": SPEED / 0.35}
    start = model.initial_state({}, rolling)
    return Pair("bicycle", 8, by_hand, (_fixed(model), start), importing)


def _fixed(model: nhjax.SymPyModel) -> nhjax.LagrangianSystem:
    """Return the system of a model with fixed parameters, in place of `args`."""
    system, args = model.system, model.args
    force, holonomic, nonholonomic = system.force, system.holonomic, system.nonholonomic
    assert force is None
    assert nonholonomic is not None
    return nhjax.LagrangianSystem(
        lambda t, q, v, _: system.lagrangian(t, q, v, args),
        nonholonomic=lambda t, q, v, _: nonholonomic(t, q, v, args),
        holonomic=None if holonomic is None else lambda t, q, _: holonomic(t, q, args),
    )


def seconds(system: Any, y0: nhjax.State, kind: str) -> float:
    """Measure the processor time of a first call, in seconds."""
    _, parts = compiled(program(system, 3, kind), y0, jnp.asarray(0.05))
    return sum(parts)


PAIRS = {"particle": particles, "bicycle": bicycles}
FORMS = "by hand", "from SymPy"


def measure(name: str, form: str, kind: str) -> None:
    """Print the times of a first call and of `from_sympy`, in this process."""
    jax.jit(jnp.sin).lower(0.1).compile()
    pair = PAIRS[name]()
    model = pair.by_hand if form == FORMS[0] else pair.imported
    found = {"size": pair.size, "import": pair.import_seconds}
    print(json.dumps(found | {"seconds": seconds(*model, kind)}))


def main() -> None:
    """Print and save the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--kinds", nargs="+", default=["run", "gradient"])
    parser.add_argument("--case", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.case is not None:
        measure(*options.case)
        return
    rows, data = [], []
    for name, kind in itertools.product(PAIRS, options.kinds):
        found = [
            [
                from_fresh_process("sympy_models", "--case", name, form, kind)
                for form in FORMS
            ]
            for _ in range(options.repeats)
        ]
        times = [[one["seconds"] for one in pair] for pair in found]
        least = [min(column) for column in zip(*times, strict=True)]
        importing = min(one["import"] for pair in found for one in pair)
        ratio, size = least[1] / least[0], found[0][0]["size"]
        row = [name, str(size), kind, *(f"{x:.2f}" for x in (*least, ratio))]
        print(*row, sep="\t", flush=True)
        rows.append([*row, f"{importing:.2f}"])
        data.append(
            {"model": name, "kind": kind, "seconds": times, "import": importing}
        )
    header = ["model", "n", "program", *FORMS, "ratio", "import"]
    text = (
        "Seconds of the processor, the least of each. The ratio is to be at most "
        f"{BOUND}. The last column is what `from_sympy` itself takes, with the "
        "derivation in SymPy.\n\n"
    )
    text += markdown_table(header, rows)
    write("sympy_models", "First calls of models from SymPy", text, {"rows": data})


if __name__ == "__main__":
    main()
