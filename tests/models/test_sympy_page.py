"""The page about SymPy is right: its code runs as printed."""

import numpy as np

from support.pages import run_page


def test_sympy_page_code_when_run_gives_the_printed_results():
    namespace = run_page("sympy")
    sol, model = namespace["sol"], namespace["model"]
    assert sol.coordinates == ("x", "y", "θ")
    assert float(sol.stats["max_constraint_violation"]) < 1e-13
    # Friction at the centre of mass takes energy.
    energies = [
        model.system.energy(0.0, y, model.args)
        for y in (namespace["y0"], sol.ys.__class__(*(_last(sol.ys))))
    ]
    assert 0 < energies[1] < energies[0]
    assert np.isfinite(energies[0])


def _last(ys):
    return [x[-1] for x in (ys.q, ys.v, ys.p, ys.multiplier)]
