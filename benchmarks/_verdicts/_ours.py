"""What is not in the paper: which methods are one, closures, charts, derivatives."""

import jax
import jax.numpy as jnp

import nhjax
from nhjax import systems

from .. import _baselines, charts
from ..closures import long_run
from ._claim import (
    Claim,
    command,
    DEPENDS,
    Found,
    orders_text,
    OURS,
    RECONSTRUCTED,
    REFUTED,
    slope,
    stages_text,
)


PART = "ours"
EXAMPLES = {
    "particle": systems.NonholonomicParticle,
    "chaotic": systems.ChaoticSystem,
    "CVT": systems.ContinuouslyVariableTransmission,
}


def found(quick: bool) -> Found:
    """Measure what is ours."""
    parts = [_coincidences(), _closures(quick), _charts(quick), _derivatives(quick)]
    claims = [claim for part in parts for claim in part.claims]
    return Found(claims, {k: x for part in parts for k, x in part.data.items()})


def distances(example, h: float = 0.1, num_steps: int = 100) -> dict[str, float]:
    """Return how far apart the positions of pairs of methods come on a system."""
    system, y0 = example.system, example.initial_state()
    nat = _baselines.natural(system)

    def positions(step, v):
        return jax.jit(lambda: _baselines.run(step, y0.q, v, h, num_steps)[0])()

    def ours(stages):
        sol = nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(stages, "propagated"),
            y0,
            dt=h,
            num_steps=num_steps,
            saveat=nhjax.SaveAt(steps=True),
        )
        return sol.ys.q

    # Half a step before the start, with the multiplier that our first step has.
    kick = nat.force(y0.q) + y0.multiplier[0] * nat.direction(y0.q)
    leapfrog = positions(_baselines.leapfrog_at_nodes(nat), y0.v - 0.5 * h * kick)
    spark = {s: positions(_baselines.spark(nat, s), y0.v) for s in (2, 3)}
    dla = positions(_baselines.discrete_lagrange_dalembert(nat), y0.v)
    pairs = {
        "DLA, SPARK 2": (dla, spark[2]),
        "leapfrog, Lobatto-2": (leapfrog, ours(2)),
        "SPARK 2, Lobatto-2": (spark[2], ours(2)),
        "SPARK 3, Lobatto-3": (spark[3], ours(3)),
    }
    return {name: float(jnp.max(jnp.abs(x - y))) for name, (x, y) in pairs.items()}


def _coincidences() -> Found:
    apart = {name: distances(make()) for name, make in EXAMPLES.items()}
    of = lambda pair: ", ".join(f"{apart[k][pair]:.0e} ({k})" for k in apart)  # noqa: E731
    affine = max(apart[k]["DLA, SPARK 2"] for k in ("particle", "chaotic"))
    one = affine < 1e-11 < apart["CVT"]["DLA, SPARK 2"]
    same = max(x["leapfrog, Lobatto-2"] for x in apart.values()) < 1e-11
    return Found(
        [
            Claim(
                "DLA as a leapfrog and the Lobatto IIIA-B SPARK method with s = 2 are "
                "one method where the constraint is affine in q",
                f"distance of the positions after 100 steps of 0.1: "
                f"{of('DLA, SPARK 2')}",
                command(PART),
                OURS if one else REFUTED,
                "½ (b(q_k) + b(q_{k+1})) = b(½ (q_k + q_{k+1})) if the direction b(q) "
                "of the constraint is affine in q; in the CVT, b contains sin y; "
                f"{RECONSTRUCTED}",
            ),
            Claim(
                "Lobatto-2 of the paper is the leapfrog with the constraint at the "
                "nodes (Ferraro, Iglesias and Martín de Diego 2008), not DLA or SPARK",
                f"from the leapfrog: {of('leapfrog, Lobatto-2')}; from SPARK: "
                f"{of('SPARK 2, Lobatto-2')}; s = 3 from SPARK: "
                f"{of('SPARK 3, Lobatto-3')}",
                command(PART),
                OURS if same else REFUTED,
                "SPARK computes s multipliers in each step, while the paper's method "
                f"carries one multiplier from step to step; their "
                f"results differ by as much as their errors; {RECONSTRUCTED}",
            ),
        ],
        {"coincidences": apart},
    )


def _closures(quick: bool) -> Found:
    sleigh = systems.ChaplyginSleigh()
    y0 = sleigh.initial_state()
    length = 20.0 if quick else 200.0
    rows = {}
    for closure in ("propagated", "consistent", "symmetric"):
        method = nhjax.LobattoIIIAB(4, closure)
        rows[closure] = long_run(sleigh.system, method, y0, 0.1, length)[:2]
    last = {k: x[1] for k, x in rows.items()}
    better = not last["symmetric"] > 1e-3 * last["propagated"]
    return Found(
        [
            Claim(
                "The error of a multiplier that is carried from step to step grows on "
                "attracting motions; the symmetric closure carries only q and p",
                f"Chaplygin's sleigh, s = 4, h = 0.1, |E - E_0| in the last fifth of t "
                f"<= {length:g}: " + ", ".join(f"{k} {x:.1e}" for k, x in last.items()),
                "python -m benchmarks.closures",
                OURS if better else DEPENDS,
                "and the symmetric closure keeps the symmetry of the step, which the "
                "consistent one does not (`docs/closures.md`)",
            )
        ],
        {"closures": rows},
    )


def _charts(quick: bool) -> Found:
    duration = 50.0 if quick else 1000.0
    rows = [
        charts.measure("Suslov in a potential", "cay", 3, chart, duration)
        for chart in charts.CHARTS
    ]
    back = {row.chart: row.there_and_back for row in rows}
    energy = {row.chart: row.energy for row in rows}
    gain = back["middle"] < 1e-13 < back["start"]
    less = energy["middle"] < 0.8 * energy["start"]
    return Found(
        [
            Claim(
                "On groups the step of the paper is not symmetric; with its chart in "
                "the middle of the step it is",
                "50 steps of h = 0.1 and back, Suslov in a potential, cay, s = 3: "
                + ", ".join(f"{k} {x:.0e}" for k, x in back.items())
                + f"; energy error for t <= {duration:g}: "
                + ", ".join(f"{k} {x:.1e}" for k, x in energy.items()),
                "python -m benchmarks.charts",
                OURS if gain else REFUTED,
                "reversible to round-off, and the energy "
                + ("drifts less" if less else "does not drift less"),
            )
        ],
        {"charts": [row._asdict() for row in rows]},
    )


def _derivatives(quick: bool) -> Found:
    """The derivative of x(T) by the stiffness, beside that of the exact solution."""
    final_time = 3.0
    stages = (2, 3) if quick else (2, 3, 4)

    def exact(stiffness):
        return systems.NonholonomicParticle(stiffness=stiffness).exact(final_time)[0][0]

    d = 1e-2
    # The differences are of order 6.
    weights = {1: 3 / 4, 2: -3 / 20, 3: 1 / 60}
    reference = sum(
        w * (exact(1 + k * d) - exact(1 - k * d)) / d for k, w in weights.items()
    )
    orders, gap = [], []
    for s in stages:

        def end(stiffness, num_steps, s=s):
            particle = systems.NonholonomicParticle(stiffness=stiffness)
            sol = nhjax.integrate(
                particle.system,
                nhjax.LobattoIIIAB(s),
                particle.initial_state(),
                dt=final_time / num_steps,
                num_steps=num_steps,
            )
            return sol.ys.q[-1, 0]

        one = jnp.asarray(1.0)
        # Large steps at s = 4, so that errors are above those of the reference.
        counts = (30, 60) if s < 4 else (8, 16)
        slope_of = jax.jit(jax.grad(end), static_argnums=1)
        gradients = [float(slope_of(one, n)) for n in counts]
        errors = [abs(x - reference) for x in gradients]
        _, tangent = jax.jvp(lambda k, f=end, n=counts[-1]: f(k, n), (one,), (one,))
        gap.append(abs(float(tangent) - gradients[-1]))
        orders.append(slope([1 / n for n in counts], errors))
    good = all(x > 2 * s - 2.5 for s, x in zip(stages, orders, strict=True))
    return Found(
        [
            Claim(
                "Derivatives of a run with respect to its parameters are of the order "
                "of the method",
                "order of dx(3)/dk on the particle: "
                + f"{orders_text(orders)} ({stages_text(stages)})"
                + f"; reverse mode minus forward mode: {max(gap):.0e}",
                command(PART),
                OURS if good else REFUTED,
                "by the implicit function theorem at each step, against the derivative "
                "of the exact solution",
            )
        ],
        {"derivatives": {"stages": stages, "orders": orders, "gap": max(gap)}},
    )
