"""Cost and accuracy of kept invariants in two difficult cases.

The first case is a function that is conserved only where the constraints hold, the
second an energy with an indefinite mass matrix.

- A particle with the constraint ż = y ẋ keeps its energy, and the same function with
  y ẋ in the place of ż: the sweeps and the time of a step, for starts at several y.
- 300 motions of L = ½(v₁² + v₂² - v₃²) - ½|q|² with Φ = v₁ - ½ q₂ v₂, plainly and with
  the energy kept: the relative errors of positions at t = 5 against SciPy, the largest
  errors of the energy, and the part of the members that keep it to 1e-12. For many of
  them v·Mv vanishes on the way.

    python -m benchmarks.invariants_on_constraints
"""

import time
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import nhjax
from nhjax import LobattoIIIAB, SaveAt, systems

from ._report import markdown_table, number, write


DURATION, MEMBERS = 5.0, 300
_PLACES = (0.0, 0.3, 1.0, 2.0, 3.0, 5.0, 8.0)
_STEP, _NUM_STEPS, _REPEATED = 0.05, 2000, 7


def particle_at(y: float) -> systems.NonholonomicParticle:
    """The particle with a start at this y."""
    return systems.NonholonomicParticle(q0=(1.0, y, 0.2), v0=(0.4, 0.7, 0.4 * y))


def substituted_energy(t, q, v, args):
    """The energy of the particle, with y v_x in the place of v_z."""
    kinetic = v[0] ** 2 + v[1] ** 2 + (q[1] * v[0]) ** 2
    return 0.5 * kinetic + 0.5 * (q[0] ** 2 + q[1] ** 2)


def particle_row(y: float, stages: int) -> dict[str, Any]:
    """Compare sweeps and times of both functions."""
    system, y0 = particle_at(y).system, particle_at(y).initial_state()
    sweeps, times = [], []
    for kept in ("energy", substituted_energy):

        @jax.jit
        def run(y0, kept=kept):
            return nhjax.integrate(
                *(system, LobattoIIIAB(stages), y0),
                **{"dt": _STEP, "num_steps": _NUM_STEPS, "invariants": kept},
            )

        sol = jax.block_until_ready(run(y0))
        sweeps.append(float(sol.stats["num_iterations"]) / _NUM_STEPS)
        spent = []
        for _ in range(_REPEATED):
            start = time.process_time()
            jax.block_until_ready(run(y0))
            spent.append(time.process_time() - start)
        times.append(1e6 * min(spent) / _NUM_STEPS)
    return {"y": y, "stages": stages, "sweeps": sweeps, "microseconds": times}


def saddle() -> nhjax.LagrangianSystem:
    """A system with an indefinite mass matrix and a nonholonomic constraint."""

    def lagrangian(t, q, v, args):
        return 0.5 * (v[0] ** 2 + v[1] ** 2 - v[2] ** 2) - 0.5 * q @ q

    return nhjax.LagrangianSystem(
        lagrangian, nonholonomic=lambda t, q, v, args: v[0] - 0.5 * q[1] * v[1]
    )


def saddle_rates(t: float, z: np.ndarray) -> np.ndarray:
    """The motion of `saddle` in plain NumPy: M a = -q + λ B with B a = v_2² / 2."""
    q, v = z[:3], z[3:]
    mass, slope = np.array([1.0, 1.0, -1.0]), np.array([1.0, -0.5 * q[1], 0.0])
    free = -q / mass
    multiplier = (0.5 * v[1] ** 2 - slope @ free) / (slope @ (slope / mass))
    return np.concatenate([v, free + multiplier * slope / mass])


@cache
def saddle_starts() -> np.ndarray:
    """States (q, v) on the constraint, with v_3 = 0.9."""
    q, v = np.random.default_rng(0).normal(size=(2, MEMBERS, 3))
    v[:, 2], v[:, 0] = 0.9, 0.5 * q[:, 1] * v[:, 1]
    return np.concatenate([q, v], axis=1)


def ends_by_scipy(rates: Any, starts: np.ndarray) -> np.ndarray:
    """The states after the duration, at tight tolerances."""
    options = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-12}
    ends = [solve_ivp(rates, (0, DURATION), z, **options).y[:, -1] for z in starts]
    return np.array(ends)


def errors_of_members(
    system: Any, starts: np.ndarray, ends: np.ndarray, stages: int, num_steps: int, kept
) -> tuple[np.ndarray, np.ndarray]:
    """The relative error of each member, and the largest error of its energy."""
    n = starts.shape[1] // 2

    @jax.jit
    @jax.vmap
    def run(z):
        y0 = nhjax.initial_state(system, z[:n], v=z[n:])
        sol = nhjax.integrate(
            *(system, LobattoIIIAB(stages), y0),
            **{"dt": DURATION / num_steps, "num_steps": num_steps, "invariants": kept},
            saveat=SaveAt(t0=True, steps=True),
            throw=False,
        )
        energies = jax.vmap(system.energy)(sol.ts, sol.ys)
        off = jnp.max(jnp.abs(energies - energies[0]))
        return sol.ys.q[-1], sol.result == nhjax.RESULTS.successful, off

    q, successful, off = map(np.asarray, run(jnp.asarray(starts)))
    assert np.all(successful)
    misses = np.max(np.abs(q - ends[:, :n]), axis=1)
    return misses / np.max(np.abs(ends[:, :n]), axis=1), off


def saddle_row(stages: int, num_steps: int, kept: Any) -> dict[str, Any]:
    """Measure the motions of `saddle` in one way."""
    starts = saddle_starts()
    ends = ends_by_scipy(saddle_rates, starts)
    errors, off = errors_of_members(saddle(), starts, ends, stages, num_steps, kept)
    return {
        "stages": stages,
        "num_steps": num_steps,
        "kept": kept,
        "errors": np.quantile(errors, [0.5, 0.9, 1.0]),
        "energy": np.max(off),
        "part": np.mean(off < 1e-12),
    }


def main() -> None:
    """Measure both, and write the tables."""
    jax.config.update("jax_enable_x64", True)
    particles = [particle_row(y, stages) for stages in (2, 3) for y in _PLACES]
    saddles = [
        saddle_row(stages, num_steps, kept)
        for stages, counts in ((2, (200, 400)), (3, (50, 100)))
        for num_steps in counts
        for kept in (None, "energy")
    ]
    header = ["s", "y", "sweeps: energy", "substituted", "ratio", "time: ratio"]
    table = []
    for x in particles:
        (first, second), (before, after) = x["sweeps"], x["microseconds"]
        cells = [str(x["stages"]), f"{x['y']:g}", f"{first:.2f}", f"{second:.2f}"]
        table.append([*cells, f"{second / first:.2f}", f"{after / before:.2f}"])
    other = ["s", "h", "kept", "error: median", "90 %", "largest", "energy"]
    other += ["members that keep it"]
    members = [
        [
            str(x["stages"]),
            f"{DURATION / x['num_steps']:g}",
            str(x["kept"]),
            *map(number, x["errors"]),
            number(x["energy"]),
            f"{x['part']:.2f}",
        ]
        for x in saddles
    ]
    text = "\n\n".join(
        [
            f"The particle, h = {_STEP}, {_NUM_STEPS} steps:",
            markdown_table(header, table),
            f"{MEMBERS} motions with an indefinite mass matrix:",
            markdown_table(other, members),
        ]
    )
    title = "Functions kept on constraints, and indefinite mass matrices"
    data = {"particle": particles, "saddle": saddles}
    write("invariants_on_constraints", title, text, data)


if __name__ == "__main__":
    main()
