"""Draws a picture of docs/choosing.md: run `python docs/sleigh.py` to write it."""

from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from matplotlib.figure import Figure

import nhjax
from nhjax import plot
from nhjax.diagnostics import energy_error


def main() -> None:
    """Compute and draw."""
    jax.config.update("jax_enable_x64", True)
    everything = nhjax.SaveAt(t0=True, steps=True)
    light = nhjax.systems.ChaplyginSleigh(offset=0.12)

    def path(spin):
        v = jnp.stack([-0.8, 0.0, spin])
        y0 = nhjax.initial_state(light.system, jnp.zeros(3), v)
        method = nhjax.LobattoIIIAB(4)
        return nhjax.integrate(
            light.system, method, y0, dt=0.01, num_steps=800, saveat=everything
        )

    spins = np.linspace(0.2, 2.0, 9)
    paths = jax.vmap(path)(jnp.concatenate([-spins[::-1], spins]))
    plot.style()
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    shades = matplotlib.colormaps["viridis"](np.linspace(0, 0.85, 9))
    left.set_prop_cycle(color=np.concatenate([shades[::-1], shades]))
    plot.trajectory(paths, names=("$x$", "$y$"), ax=left)
    left.set_title("Chaplygin sleighs thrown backwards")
    sleigh = nhjax.systems.ChaplyginSleigh()
    for closure in ("propagated", "consistent", "symmetric"):
        sol = nhjax.integrate(
            sleigh.system,
            nhjax.LobattoIIIAB(4, closure),
            sleigh.initial_state(),
            dt=0.1,
            num_steps=2000,
            saveat=everything,
            throw=False,
        )
        error = np.abs(energy_error(sleigh.system, sol))
        right.semilogy(sol.ts, np.maximum(error, 1e-17), label=closure)
    right.set_ylim(1e-20, 1e1)
    right.set_xlabel("time $t$")
    right.set_ylabel("$|E(t) - E(t_0)|$")
    right.set_title("energy error, s = 4, h = 0.1")
    right.legend(title="closure", loc="lower right")
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)


if __name__ == "__main__":
    main()
