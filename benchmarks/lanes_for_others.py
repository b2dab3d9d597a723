"""Programs that do not use nhjax, by `lanes.vmap` and `lanes.jit`, compared with JAX.

- Ensembles of the paper's chaotic system, written as 14 explicit equations, which
    diffrax integrates with adaptive steps.
- A Kalman filter, and the classical Runge-Kutta method with fixed steps.
- The mass matrix of a chain of joints, written out joint by joint, as in issue 26021 of
    JAX, and the gradient of a scan that carries many scalars, as in issue 40150. Both
    programs follow the descriptions in these issues.

Each program is compiled by JAX and by nhjax, and both versions are run in turn. The
table has the wall time of the fastest run, with all cores. The compile time is the time
of the first call, including the trace. The table also has the largest difference
between the results of both, relative to the largest number of its array.

    python -m benchmarks.lanes_for_others
"""

import argparse
import os
import time
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

import nhjax
from nhjax import lanes, systems

from ._report import markdown_table, write


REPEATS = 15
TOLERANCE = 1e-8


class Program(NamedTuple):
    """A function of one member, with operands for all members.

    - `members`: the number of members along the first axis of the operands, or `None`
        for a single run.
    """

    function: Callable[..., Any]
    operands: tuple[Any, ...]
    members: int | None


# diffrax


def chaotic_field(t: Any, y: Any, args: Any) -> Any:
    """Compute the explicit equations of `nhjax.systems.ChaoticSystem`, with m = 3.

    The multiplier follows from the derivative of the constraint.
    """
    del t, args
    q, v = y[:7], y[7:]
    first, second = q[1:4], q[4:7]
    squares = jnp.concatenate([jnp.zeros(1), second**2, first**2])
    # The product of the first two squares of the second group of coordinates.
    pair = jnp.array([0, 0, 0, 0, q[5] ** 2, q[4] ** 2, 0])
    slope = q * (1 + squares + pair)
    row = jnp.concatenate([jnp.array([1.0, 0.0, 0.0, 0.0]), second])
    multiplier = (row @ slope - v[4:] @ v[4:]) / (row @ row)
    return jnp.concatenate([v, multiplier * row - slope])


def diffrax_ensemble(solver: str, members: int, end: float) -> Program:
    """Integrate an ensemble of the chaotic system with adaptive steps."""
    import diffrax

    def run(y0: Any) -> Any:
        sol = diffrax.diffeqsolve(
            diffrax.ODETerm(chaotic_field),
            getattr(diffrax, solver)(),
            t0=0.0,
            t1=end,
            dt0=None,
            y0=y0,
            stepsize_controller=diffrax.PIDController(rtol=TOLERANCE, atol=TOLERANCE),
            max_steps=100_000,
        )
        return sol.ys

    q0, v0 = systems.ChaoticSystem().ensemble(members - 1)
    return Program(run, (jnp.concatenate([q0, v0], axis=1),), members)


# Filters and integrators


def kalman_filter(members: int, length: int) -> Program:
    """Filter noisy positions in a plane; each member has its own noise and data."""
    transition = jnp.eye(4) + 0.1 * jnp.eye(4, k=2)
    observed = jnp.eye(2, 4)

    def run(noise: Any, data: Any) -> Any:
        def step(carry: Any, measured: Any) -> Any:
            mean, covariance = carry
            mean = transition @ mean
            covariance = transition @ covariance @ transition.T + 0.01 * jnp.eye(4)
            innovation = observed @ covariance @ observed.T + noise * jnp.eye(2)
            gain = jnp.linalg.solve(innovation, observed @ covariance).T
            mean = mean + gain @ (measured - observed @ mean)
            covariance = (jnp.eye(4) - gain @ observed) @ covariance
            return (mean, covariance), mean

        return lax.scan(step, (jnp.zeros(4), jnp.eye(4)), data)[1]

    rng = np.random.default_rng(0)
    data = np.cumsum(rng.normal(size=(members, length, 2)), axis=1)
    noise = jnp.linspace(0.1, 1.0, members)
    return Program(run, (noise, jnp.asarray(data)), members)


def runge_kutta(members: int, length: int) -> Program:
    """Integrate van der Pol's oscillator with the classical Runge-Kutta method."""

    def field(y: Any, stiffness: Any) -> Any:
        return jnp.stack([y[1], stiffness * (1 - y[0] ** 2) * y[1] - y[0]])

    def run(stiffness: Any, dt: Any) -> Any:
        def step(_: Any, y: Any) -> Any:
            k1 = field(y, stiffness)
            k2 = field(y + dt / 2 * k1, stiffness)
            k3 = field(y + dt / 2 * k2, stiffness)
            k4 = field(y + dt * k3, stiffness)
            return y + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

        return lax.fori_loop(0, length, step, jnp.array([2.0, 0.0]))

    dt = jnp.full(members, 10.0 / length)
    return Program(run, (jnp.linspace(0.1, 2.0, members), dt), members)


# Issues of JAX


def mass_matrix(joints: int, members: int | None) -> Program:
    """Compute the mass matrix of a chain of joints, which are placed one by one."""
    tilt = jnp.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    carries = jnp.tril(jnp.ones((joints, joints)))

    def run(q: Any) -> Any:
        position, rotation = jnp.zeros(3), jnp.eye(3)
        axes, places, centres = [], [], []
        for k in range(joints):
            c, s = jnp.cos(q[k]), jnp.sin(q[k])
            turn = jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            axes.append(rotation[:, 2])
            places.append(position)
            rotation = rotation @ turn @ tilt
            centres.append(position + 0.05 * rotation[:, 0])
            position = position + 0.1 * rotation[:, 0]
        arms = jnp.stack(centres)[:, None] - jnp.stack(places)[None]
        jacobians = jnp.cross(jnp.stack(axes)[None], arms) * carries[:, :, None]
        return jnp.einsum("kia,kja->ij", jacobians, jacobians)

    shape = (joints,) if members is None else (members, joints)
    q = np.random.default_rng(0).uniform(-1.0, 1.0, size=shape)
    return Program(run, (jnp.asarray(q),), members)


def gradient_of_scan(leaves: int, length: int) -> Program:
    """Differentiate a scan that carries many scalars, each in a leaf of its own."""

    def run(rates: Any, data: Any) -> Any:
        def step(carry: Any, x: Any) -> Any:
            new = {}
            for k in range(leaves):
                parent = carry[f"node{(k - 1) % leaves}"]
                pull = jnp.tanh(parent * rates[k]) + x
                new[f"node{k}"] = carry[f"node{k}"] + 0.1 * (pull - carry[f"node{k}"])
            return new, new["node0"] ** 2

        start = {f"node{k}": jnp.asarray(0.1 * k / leaves) for k in range(leaves)}
        return jnp.sum(lax.scan(step, start, data)[1])

    data = jnp.asarray(np.random.default_rng(0).normal(size=length))
    return Program(jax.grad(run), (jnp.linspace(0.5, 1.5, leaves), data), None)


def programs(scale: float = 1.0) -> dict[str, Callable[[], Program]]:
    """Return all programs by their names; `scale` shortens them, for tests."""

    def scaled(number: int) -> int:
        return max(2, round(scale * number))

    cases: dict[str, Callable[[], Program]] = {}
    if find_spec("diffrax") is not None:
        for solver, end in (("Tsit5", 20.0), ("Dopri8", 20.0), ("Kvaerno5", 5.0)):
            cases[f"diffrax {solver}, adaptive"] = partial(
                diffrax_ensemble, solver, scaled(101), scale * end
            )
    return cases | {
        "Kalman filter, 200 data": partial(kalman_filter, scaled(1000), scaled(200)),
        "RK4, 1000 steps": partial(runge_kutta, scaled(101), scaled(1000)),
        "mass matrix, 35 joints": partial(mass_matrix, scaled(35), None),
        "mass matrix, 7 joints": partial(mass_matrix, scaled(7), scaled(1000)),
        "gradient of a scan, 60 leaves": partial(
            gradient_of_scan, scaled(60), scaled(614)
        ),
    }


# Measurements


def measure(program: Program, repeats: int = REPEATS) -> dict[str, Any]:
    """Compile and run a program with JAX and with nhjax."""
    function, operands, members = program
    if members is None:
        by_jax, by_nhjax = jax.jit(function), lanes.jit(function)
    else:
        by_jax = jax.jit(jax.vmap(function))
        by_nhjax = jax.jit(lanes.vmap(function))
    runs, compile_times, results = (by_jax, by_nhjax), [], []
    for run in runs:
        start = time.perf_counter()
        results.append(jax.block_until_ready(run(*operands)))
        compile_times.append(time.perf_counter() - start)
    best = [np.inf, np.inf]
    for _ in range(repeats):
        for k, run in enumerate(runs):
            start = time.perf_counter()
            jax.block_until_ready(run(*operands))
            best[k] = min(best[k], time.perf_counter() - start)
    use, *_ = nhjax.engines(by_nhjax, *operands)
    return {
        "members": members,
        "engine": use.engine,
        "reason": use.reason,
        "seconds": best,
        "ratio": best[1] / best[0],
        "compile": compile_times,
        "difference": difference(results[1], results[0]),
    }


def difference(got: Any, expected: Any) -> float:
    """Return the largest difference, relative to the largest number of each array."""
    worst = 0.0
    for x, y in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        x, y = np.asarray(x), np.asarray(y)
        worst = max(worst, float(np.max(np.abs(x - y)) / np.max(np.abs(y))))
    return worst


def main() -> None:
    """Print and save the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--programs", nargs="+", default=list(programs()))
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows, data = [], []
    for name in options.programs:
        x = measure(programs()[name]())
        data.append({"program": name} | x)
        rows.append(
            [name, str(x["members"] or 1), x["engine"]]
            + [f"{1e3 * seconds:.3g}" for seconds in x["seconds"]]
            + [f"{x['ratio']:.3f}", *(f"{seconds:.1f}" for seconds in x["compile"])]
            + [f"{x['difference']:.0e}"]
        )
        print(*rows[-1], x["reason"], sep="\t", flush=True)
    header = ["program", "members", "engine", "JAX [ms]", "lanes [ms]", "ratio"]
    header += ["compile JAX [s]", "compile lanes [s]", "difference"]
    text = (
        f"Double precision, {os.cpu_count()} cores. diffrax has a tolerance of "
        f"{TOLERANCE:g}.\n\n{markdown_table(header, rows)}"
    )
    write("lanes_for_others", "Programs of others", text, {"rows": data})


if __name__ == "__main__":
    main()
