"""How round-off grows: Brouwer's law says as the square root of the number of steps.

Energy errors of ensembles, at steps so small (or orders so high) that truncation does
not show. A slope of 1/2 means that rounding errors are random, 1 that they are biased.
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

import nhjax
from nhjax import systems
from nhjax._method import AbstractMethod
from nhjax.systems._base import AbstractExample

from ._report import markdown_table, number, write


Problem = tuple[nhjax.LagrangianSystem, PyTree[Array], Array]


def in_coordinates(example: AbstractExample) -> Problem:
    """Return the system of an example with its initial position and velocity."""
    return example.system, example.q0, example.v0


def with_a_heading_on_a_circle(disc: systems.VerticalRollingDisc) -> Problem:
    """Return the disc on R^3 x SO(2): with the exponential map its steps are the same.

    Whoever models it on R^4 does not say that one of the coordinates is an angle.
    """
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: disc.lagrangian(t, jnp.concatenate(q), v, args),
        nonholonomic=lambda t, q, v, args: disc.constraint(
            t, jnp.concatenate(q), v, args
        ),
        manifold=nhjax.ProductGroup(nhjax.Euclidean(3), nhjax.SO2(nhjax.Exponential())),
    )
    return system, (disc.q0[:3], disc.q0[3:]), disc.v0


def energy_rms(
    problem: Problem,
    method: AbstractMethod,
    dt: float,
    counts: list[int],
    members: int,
) -> np.ndarray:
    """Root mean square over the ensemble of (E_k - E_0)/E_0 after each of `counts`."""
    system, q0, v0 = problem
    flat, unravel = ravel_pytree(q0)
    noise = np.random.default_rng(0).uniform(-0.1, 0.1, (2, members, len(flat)))
    q0 = jax.vmap(unravel)(flat + jnp.asarray(noise[0]))
    v0 = v0 * (1 + jnp.asarray(noise[1]))
    stride = counts[0]

    @jax.jit
    @jax.vmap
    def errors(q, v):
        y0 = nhjax.initial_state(system, q, v, project=True)
        saveat = nhjax.SaveAt(steps=stride, fn=system.energy)
        sol = nhjax.integrate(
            system,
            method,
            y0,
            dt=dt,
            num_steps=counts[-1],
            saveat=saveat,
        )
        start = system.energy(0.0, y0)
        return (sol.ys - start) / start

    error = np.asarray(errors(q0, v0))
    rms = np.sqrt(np.mean(error**2, axis=0))
    return rms[[count // stride - 1 for count in counts]]


def main() -> None:
    """Print and save the slopes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--members", type=int, default=64)
    parser.add_argument("--doublings", type=int, default=9)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    counts = [64 * 2**k for k in range(options.doublings)]
    lobatto = nhjax.LobattoIIIAB
    oscillator = in_coordinates(systems.HarmonicOscillator())
    particle = in_coordinates(systems.NonholonomicParticle())
    disc = systems.VerticalRollingDisc()
    on_circle = with_a_heading_on_a_circle(disc)
    cases = [
        ("harmonic oscillator", oscillator, lobatto(6), 0.1),
        ("harmonic oscillator", oscillator, nhjax.Gauss(5), 0.1),
        ("particle", particle, lobatto(6), 0.1),
        ("particle", particle, lobatto(6, "propagated"), 0.1),
        ("rolling disc on R^4", in_coordinates(disc), lobatto(5), 0.1),
        ("rolling disc, heading on SO(2)", on_circle, lobatto(5), 0.1),
        ("unicycle on SE(2)", in_coordinates(systems.Unicycle()), lobatto(6), 0.1),
    ]
    rows, data = [], []
    for name, problem, method, dt in cases:
        rms = energy_rms(problem, method, dt, counts, options.members)
        slope = float(np.polyfit(np.log(counts[2:]), np.log(rms[2:]), 1)[0])
        label = f"{type(method).__name__}({method.stages})"
        label += f", {method.closure}" if method.closure else ""
        rows.append([name, label, f"{slope:.2f}"])
        rows[-1] += [number(x) for x in rms[[0, len(rms) // 2, -1]]]
        data.append(
            {
                "system": name,
                "method": label,
                "dt": dt,
                "steps": counts,
                "rms": rms.tolist(),
                "slope": slope,
            }
        )
        print(*rows[-1], sep="\t", flush=True)
        jax.clear_caches()
    header = ["system", "method", "slope"]
    header += [f"rms at {counts[k]}" for k in (0, len(counts) // 2, -1)]
    text = (
        f"Relative energy error, root mean square over {options.members} members, "
        "slope fitted from the third entry on.\n\n" + markdown_table(header, rows)
    )
    write("brouwer", "Growth of round-off", text, {"cases": data})


if __name__ == "__main__":
    main()
