"""An ensemble of short runs, some of which fail."""

import numpy as np

import nhjax


SYSTEM = nhjax.systems.NonholonomicParticle()
METHOD = nhjax.LobattoIIIAB(2)
BAD = (3, 8)


def start(x):
    """A short run, which fails if x is NaN."""
    y0 = SYSTEM.initial_state()
    y0 = nhjax.State(y0.q.at[0].set(x), y0.v, y0.p, y0.multiplier)
    saveat = nhjax.SaveAt(steps=True, fn=SYSTEM.system.energy)
    options = {"dt": 0.1, "num_steps": 4, "saveat": saveat, "throw": False}
    return nhjax.integrate(SYSTEM.system, METHOD, y0, **options)


def starts(count=10):
    x = np.linspace(0.5, 1.5, count)
    x[list(BAD)] = np.nan
    return x
