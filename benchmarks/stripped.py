"""What XLA makes of the iteration alone: one system, derivatives by hand, no checks.

The chaotic system's step as `SimplifiedNewton` solves it, symmetric closure: the same
unknowns, starting values, factorised structure and order of corrections, without what a
library needs beside them: any system, group or closure, compensated sums, statistics,
failures, reactions in the scale of increments. The iteration ends by nhjax's rule.

It runs in one kernel, as nhjax does: member by member, and with several members along
the last axis of every array, which iterate until the slowest has converged. Times are
of one core, the process pinned to it where the platform lets it be, for the ensemble
that `work_precision` integrates; medians of seven, all in turn, and in brackets the
ratios of the fastest. `--smoke` takes a minute.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import nhjax
from nhjax._compile import as_cpu_kernel
from nhjax._compile._elementary import is_elementary

from ._report import markdown_table, number, write
from .floor import initial_data, one_core


REPEATS, T = 7, 20.0
# s, steps and tolerance: where the ensemble ends within some 1e-5, 1e-8 and 1e-11.
CASES = [(8, 20, 1e-7), (8, 32, 1e-10), (8, 60, 1e-12), (3, 200, 0.0)]
LANES = (1, 4, 8)
Run = Callable[..., tuple[Array, Array, Array]]


def times(weights: np.ndarray, x: Array) -> Array:
    """Σ_j w_ij x_j, term by term, without those that are zero."""
    terms = [
        jnp.asarray(w).reshape((-1,) + (1,) * (x.ndim - 1)) * x[j]
        for j, w in enumerate(weights.T)
        if np.any(w)
    ]
    return sum(terms[1:], terms[0])


def slope(q: Array) -> Array:
    """B = ∂Φ/∂v, with the coordinates as the second axis."""
    constant = jnp.asarray([1.0] + [0.0] * 6)
    linear = jnp.asarray([0.0] * 4 + [1.0] * 3)
    shape = (1, 7) + (1,) * (q.ndim - 2)
    return constant.reshape(shape) + linear.reshape(shape) * q


def force(q: Array) -> Array:
    """-∂V/∂q, with the coordinates as the second axis."""
    nothing = jnp.zeros_like(q[:, :1])
    first = jnp.concatenate([nothing, q[:, 4:], q[:, 1:4]], axis=1)
    rest = jnp.zeros_like(q[:, :4])
    second = jnp.concatenate([rest, q[:, 5:6], q[:, 4:5], nothing], axis=1)
    return -q * (1 + first * first + second * second)


def eliminated(matrix: Array) -> Array:
    """The inverse by elimination in place without pivoting, of each member."""
    size, members = matrix.shape[0], (1,) * (matrix.ndim - 2)
    numbers = jnp.arange(size).reshape(-1, *members)

    def at(x: Array, k: Array) -> Array:
        return jax.lax.dynamic_index_in_dim(x, k, keepdims=False)

    def eliminate(k: Array, table: Array) -> Array:
        row, column = at(table, k), at(jnp.swapaxes(table, 0, 1), k)
        is_k, inverse = numbers == k, 1 / at(row, k)
        scaled = jnp.where(is_k, inverse, row * inverse)
        rest = jnp.where(is_k[:, None] | is_k[None], 0, table)
        return rest - jnp.where(is_k, -1, column)[:, None] * scaled[None]

    return jax.lax.fori_loop(0, size, eliminate, matrix)


def max_norm(x: Array) -> Array:
    """max |x| over all but the members, in integers as nhjax finds it."""
    bits = jax.lax.bitcast_convert_type(jnp.abs(x), jnp.int64)
    return jax.lax.bitcast_convert_type(jnp.max(bits, axis=(0, 1)), x.dtype)


def stripped(s: int) -> Run:
    """(q, v) at the end and the iterations, from (q, v), h, the steps and a tolerance.

    q and v may have one more axis, the last, of members.
    """
    method = nhjax.LobattoIIIAB(s)
    a, a_hat, b, E = method.a, method.a_hat, method.b, method.closure_weights.E
    eps = float(np.finfo(float).eps)

    def hidden(q: Array, v: Array, acceleration: Array) -> Array:
        """dΦ/dt."""
        weights = slope(jnp.ones_like(q)[None])[0] - slope(jnp.zeros_like(q)[None])[0]
        turning = jnp.sum(weights * v * v, axis=0)
        return turning + jnp.sum(slope(q[None])[0] * acceleration, axis=0)

    def at_node(q: Array, v: Array) -> tuple[Array, Array]:
        """The acceleration and λ_c."""
        normal, free = slope(q[None])[0], force(q[None])[0]
        multiplier = -hidden(q, v, free) / jnp.sum(normal * normal, axis=0)
        return free + normal * multiplier, multiplier

    def step(carry: tuple[Array, ...], h: Array, tolerance: Array) -> tuple[Array, ...]:
        q, p, v, acceleration, multiplier, count = carry
        members = q.shape[1:]

        def tangent(weights: np.ndarray) -> Array:
            column = jnp.asarray(np.sum(weights, axis=1))
            return v + h * column.reshape((-1, 1) + (1,) * len(members)) * acceleration

        def multipliers(y: Array, end: Array) -> Array:
            known = jnp.concatenate(
                [multiplier[None], jnp.zeros((s - 2, *members)), end[None]]
            )
            return known + times(E, y)

        velocity, node = tangent(a_hat), tangent(a)[1:]
        normals = slope(q + h * times(a, velocity))
        # Term by term: a kernel may not sum over an array of this size.
        gram = times(
            np.ones((1, 7)),
            jnp.moveaxis(normals[1:, None] * normals[None], 2, 0),
        )[0]
        weights = jnp.asarray(a[1:]).reshape((s - 1, s) + (1,) * len(members))
        schur = times(E.T, jnp.swapaxes(weights * gram, 0, 1))
        schur_inverse = eliminated(jnp.swapaxes(schur, 0, 1))
        last = normals[-1]
        compliance = 1 / jnp.sum(last * last, axis=0)
        scale = max_norm(velocity) + h * max_norm(acceleration[None])
        floor = jnp.maximum(tolerance, eps)
        reach = max_norm(normals)

        def sweep(now: tuple[Array, ...]) -> tuple[Array, ...]:
            velocity, node, y, end, end_acceleration, *progress, _ = now
            smallest, believed, done, count = progress
            position = q + h * times(a, velocity)
            lam = multipliers(y, end)
            forces = force(position) + slope(position) * lam[:, None]
            velocity_next = p + h * times(a_hat, forces)
            node_next = p + h * times(a[1:], forces)
            there = q + h * times(a[1:], velocity_next)
            violation = jnp.sum(slope(there) * node_next, axis=1)
            h_dy = -jnp.sum(schur_inverse * violation[None], axis=1)
            push = normals * times(E, h_dy)[:, None]
            velocity_next = velocity_next + times(a_hat, push)
            node_next = node_next + times(a[1:], push)
            q_end = q + h * times(a[-1:], velocity_next)[0]
            normal, free = slope(q_end[None])[0], force(q_end[None])[0]
            rest = free + normal * end - end_acceleration
            miss = hidden(q_end, node_next[-1], end_acceleration)
            d_end = -compliance * (miss + jnp.sum(last * rest, axis=0))
            end_acceleration = end_acceleration + rest + last * d_end
            y_next, end_next = y + h_dy / h, end + d_end
            change = multipliers(y_next, end_next) - lam
            sizes = [
                max_norm(velocity_next - velocity),
                max_norm(node_next - node),
                h * max_norm(change[:, None]) * reach,
            ]
            size = reduce(jnp.maximum, sizes)
            stalls = size >= smallest
            more = jnp.minimum(2.0 * believed, 400 * eps)
            believed = jnp.where(stalls, more, believed)
            small = (size <= floor * scale) | (stalls & (size <= believed * scale))
            count = count + ~done
            progress = jnp.minimum(size, smallest), believed, done | small, count
            return (
                velocity_next,
                node_next,
                y_next,
                end_next,
                end_acceleration,
                *progress,
                forces,
            )

        free = jnp.asarray([0.0] + [1.0] * (s - 2))
        y = free.reshape((-1,) + (1,) * len(members)) * multiplier
        zero = jnp.zeros(members)
        start = (velocity, node, y, multiplier, acceleration)
        progress = (zero + jnp.inf, zero + 15 * eps, zero > 0, zero)
        found = jax.lax.while_loop(
            lambda now: jnp.any(~now[7]),
            sweep,
            (*start, *progress, jnp.zeros_like(velocity)),
        )
        velocity, node, forces = found[0], found[1], found[-1]
        q = q + h * times(b[None], velocity)[0]
        p = p + h * times(b[None], forces)[0]
        return q, p, node[-1], *at_node(q, node[-1]), count + found[8]

    def run(q, v, h, num_steps, tolerance):
        carry = (q, v, v, *at_node(q, v), jnp.zeros(q.shape[1:]))
        carry = jax.lax.fori_loop(
            0, num_steps, lambda _, carry: step(carry, h, tolerance), carry
        )
        return carry[0], carry[2], carry[-1]

    return run


def nhjax_run(s: int, num_steps: int, tolerance: float) -> Callable[..., Any]:
    """The same by the library, of an ensemble."""
    system, _ = initial_data(1)

    def one(y0: nhjax.State) -> tuple[Array, Array]:
        solver = nhjax.SimplifiedNewton(tolerance=tolerance)
        sol = nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(s),
            y0,
            dt=T / num_steps,
            num_steps=num_steps,
            stage_solver=solver,
            throw=False,
        )
        return sol.ys.q[-1], sol.stats["num_iterations"]

    return jax.jit(jax.vmap(one))


def stripped_run(
    s: int, num_steps: int, tolerance: float, lanes: int
) -> Callable[..., Any]:
    """The same by `stripped`, so many members at once."""
    run, h = stripped(s), T / num_steps

    def whole_run(q: Array, v: Array) -> tuple[Array, ...]:
        return run(q, v, jnp.asarray(h), num_steps, jnp.asarray(tolerance))

    def kernel(q: Array, v: Array) -> tuple[Array, ...]:
        assert is_elementary(jax.make_jaxpr(whole_run)(q, v).jaxpr), "not one kernel"
        return as_cpu_kernel(whole_run, q, v)

    def block(start: tuple[Array, Array]) -> tuple[Array, Array]:
        if lanes == 1:
            q, _, iterations = kernel(start[0][0], start[1][0])
            return q[None], iterations[None]
        q, _, iterations = kernel(start[0].T, start[1].T)
        return q.T, iterations

    def whole(y0: nhjax.State) -> tuple[Array, Array]:
        blocks = y0.q.reshape(-1, lanes, 7), y0.v.reshape(-1, lanes, 7)
        q, iterations = jax.lax.map(block, blocks)
        return q.reshape(-1, 7), iterations.reshape(-1)

    return jax.jit(whole)


def main() -> None:
    """Print and save the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--members", type=int, default=104)
    parser.add_argument("--smoke", action="store_true", help="little, and not saved")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_platforms", "cpu")
    cases = [(3, 20, 1e-9)] if options.smoke else CASES
    members = 16 if options.smoke else options.members
    if members % max(LANES):
        parser.error(f"--members must be a multiple of {max(LANES)}, got {members}")
    lines, data = [], []
    with one_core(True):
        _, y0 = initial_data(members)
        for s, num_steps, tolerance in cases:
            programs = {"nhjax": nhjax_run(s, num_steps, tolerance)} | {
                f"stripped, {lanes}": stripped_run(s, num_steps, tolerance, lanes)
                for lanes in LANES
            }
            ends = {name: run(y0) for name, run in programs.items()}
            seconds: dict[str, list[float]] = {name: [] for name in programs}
            for _ in range(REPEATS):
                for name, run in programs.items():
                    start = time.perf_counter()
                    jax.block_until_ready(run(y0))
                    seconds[name].append(time.perf_counter() - start)
            per_step = 1e6 / num_steps / members
            micros = {
                name: statistics.median(x) * per_step for name, x in seconds.items()
            }
            fastest = {name: min(x) * per_step for name, x in seconds.items()}
            for name, (q, iterations) in ends.items():
                row = {
                    "s": s,
                    "h": T / num_steps,
                    "tolerance": tolerance,
                    "program": name,
                    "micros": micros[name],
                    "fastest": fastest[name],
                    "ratio": micros["nhjax"] / micros[name],
                    "ratio of the fastest": fastest["nhjax"] / fastest[name],
                    "iterations": float(np.mean(iterations)) / num_steps,
                    "difference": float(np.max(np.abs(q - ends["nhjax"][0]))),
                }
                data.append(row)
                shown = f"{row['h']:.3g}", number(tolerance), name
                ratio, other = row["ratio"], row["ratio of the fastest"]
                figures = f"{row['micros']:.2f}", f"{ratio:.2f} ({other:.2f})"
                last = f"{row['iterations']:.1f}", number(row["difference"])
                lines.append([str(s), *shown, *figures, *last])
    header = ["s", "h", "tolerance", "program", "µs/step/member", "nhjax over it"]
    table = markdown_table([*header, "iterations", "difference at the end"], lines)
    note = (
        f"{members} members to t = {T:.0f} on one core. `stripped, k`: k members at "
        "once, along the last axis of every array of one kernel."
    )
    text = f"{table}\n\n{note}"
    if options.smoke:
        print(text)
        return
    write("stripped", "nhjax over its arithmetic in XLA", text, {"rows": data})


if __name__ == "__main__":
    main()
