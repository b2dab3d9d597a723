"""The chaotic ensemble: the power of h, growth in time, and the methods of others."""

import jax
import numpy as np

import nhjax
from nhjax import studies, systems

from .. import _baselines
from ._claim import (
    Claim,
    command,
    CONFIRMED,
    DEPENDS,
    Found,
    OURS,
    PRINT,
    RECONSTRUCTED,
    REFUTED,
    stages_text,
)
from ._figures import chaotic_figure
from ._growth import Curve, growth, in_stretches
from ._orders import baseline_steps


PART = "chaotic"
CLOSURES = ("propagated", "symmetric", "consistent")
STEP_SIZES = (0.2, 0.1)
# Between the samples, in time.
EVERY = 5.0
PAPER_POWERS = {2: 4, 3: 10}
OTHERS = {2: ("DLA", "SPARK 2"), 3: ("SPARK 3",)}


def energies_of_others(
    members: int, final_time: float, h: float
) -> dict[str, np.ndarray]:
    """Run the ensemble with the methods of others; (E - E_0)², (members, samples)."""
    chaotic = systems.ChaoticSystem()
    every = round(EVERY / h)
    return {
        name: squared_errors(chaotic, step, members, final_time, h, every)
        for name, step in baseline_steps(chaotic.system).items()
    }


def squared_errors(
    chaotic: systems.ChaoticSystem,
    step: _baselines.Step,
    members: int,
    final_time: float,
    h: float,
    every: int,
) -> np.ndarray:
    """Run the ensemble with one of them; (E - E_0)² at every so many steps."""

    def energy(q, v):
        return chaotic.system.energy(0.0, nhjax.State(q, v, v, v[:1]))

    def run(q, v):
        found = _baselines.run(step, q, v, h, round(final_time / h), every, energy)
        return (found - energy(q, v)) ** 2

    return np.asarray(jax.jit(jax.vmap(run))(*chaotic.ensemble(members)))


def _ten_times_as_long(members: int, final_time: float) -> Claim:
    """Run DLA for ten times as long: it costs little."""
    h, chaotic = STEP_SIZES[0], systems.ChaoticSystem()
    step = baseline_steps(chaotic.system)["DLA"]
    long = 10 * final_time
    squares = squared_errors(chaotic, step, members, long, h, round(100.0 / h))
    tenths = [float(np.mean(x)) for x in np.array_split(squares, 10, axis=1)]
    walks = tenths[-1] > 1.5 * tenths[0]
    return Claim(
        "Does the energy of DLA follow a random walk later? (no claim of the paper)",
        f"μ in the tenths of t <= {long:g}, h = {h:g}: "
        + ", ".join(f"{x:.1e}" for x in tenths),
        command(PART),
        OURS,
        "it does" if walks else "no random walk is visible in this time",
    )


def found(quick: bool) -> Found:
    """Measure all claims about the ensemble."""
    final_time, members = (300.0, 10) if quick else (1e4, 100)
    stages = (2, 3) if quick else (2, 3, 4)
    curves: dict[tuple[str, int, float], Curve] = {}
    violation = 0.0
    for closure in CLOSURES:
        for h in STEP_SIZES:
            study = studies.chaotic_energy(
                stages=stages, dt=(h,), final_time=final_time, members=members,
                closure=closure, save_every=round(EVERY / h),
            )  # fmt: skip
            for run in study.runs:
                violation = max(violation, run.max_constraint_violation)
                curves[closure, run.stages, h] = in_stretches(
                    run.times, run.mu, run.mu_error, final_time
                )
    for h in STEP_SIZES:
        for name, squares in energies_of_others(members, final_time, h).items():
            times = EVERY * np.arange(1, squares.shape[1] + 1)
            spread = np.std(squares, axis=0, ddof=1) / np.sqrt(len(squares))
            kind, s = (*name.split(), "0")[:2]
            key = (kind, int(s) or (2 if kind == "DLA" else 4), h)
            curves[key] = in_stretches(
                times, np.mean(squares, axis=0), spread, final_time
            )
    fits = {key: growth(curve) for key, curve in curves.items()}
    claims = [
        Claim(
            "Φ = 0 holds at the nodes, p_{k+1} included (5; eq. of the integrator)",
            f"largest |Φ| over {members + 1} members, all closures, s = "
            f"{', '.join(map(str, stages))}, t <= {final_time:g}: {violation:.0e}",
            command(PART),
            CONFIRMED if violation < 1e-12 else REFUTED,
            "to round-off",
        ),
        *(_power(curves, s) for s in stages),
        _grows(fits, stages),
        _closures(curves, fits, stages, final_time),
        *(_against(curves, fits, s, final_time) for s in OTHERS),
        _ten_times_as_long(members, final_time),
        _projected(fits),
    ]
    data = [
        {
            "method": key[0], "stages": key[1], "h": key[2], **fits[key]._asdict(),
            "times": x.times.tolist(), "mu": x.mu.tolist(), "error": x.error.tolist(),
        }
        for key, x in curves.items()
    ]  # fmt: skip
    h = STEP_SIZES[0]
    names = (*CLOSURES, "DLA", "SPARK")
    drawn = {
        s: {n: curves[n, s, h] for n in names if (n, s, h) in curves} for s in stages
    }
    return Found(
        claims, {"chaotic": data}, {"chaotic-growth": chaotic_figure(drawn, h)}
    )


def _power(curves: dict, s: int) -> Claim:
    coarse, fine = STEP_SIZES
    text, powers = [], []
    for start, end in ((10.0, 200.0), (1e3, 1e4)):
        (large, de), (small, df) = (
            curves["propagated", s, h].mean(start, end) for h in STEP_SIZES
        )
        if not np.isfinite(large * small):
            continue
        powers.append(np.log(large / small) / np.log(coarse / fine))
        spread = np.hypot(de / large, df / small) / np.log(coarse / fine)
        text.append(f"{powers[-1]:.1f} ± {spread:.1f} for {start:g} < t < {end:g}")
    expected = 4 * (s - 1)
    right = abs(powers[0] - expected) < 0.7
    printed = PAPER_POWERS.get(s)
    if printed is None:
        verdict, why = (OURS if right else REFUTED), f"the pattern is h^{expected}"
    elif printed == expected:
        verdict = CONFIRMED if right else REFUTED
        why = "the square of an error of order 2"
    else:
        verdict = PRINT if right else REFUTED
        why = (
            f"the measured power is {expected} = 4(s - 1), the square of an error of "
            f"order {2 * s - 2}; curves divided by h^{printed} cannot coincide"
        )
    shown = f"μ(E) goes as h^{printed or expected}"
    return Claim(
        f"{shown} for Lobatto-{s} "
        + ("(7.3, figure)" if printed else "(not in the paper)"),
        f"measured power, h = {coarse:g} and {fine:g}: " + "; ".join(text),
        "nhjax run chaotic-energy",
        verdict,
        why,
    )


def _exponents(fits: dict, names, stages) -> tuple[str, list[float]]:
    parts, values = [], []
    for name in names:
        for s in stages:
            x = [fits[name, s, h] for h in STEP_SIZES]
            values += [f.alpha for f in x]
            parts.append(
                f"{name} s = {s}: "
                + " and ".join(
                    f"{f.alpha:.2f} ± {f.alpha_error:.2f}" if f.alpha else "none"
                    for f in x
                )
            )
    return "; ".join(parts), values


def _grows(fits: dict, stages) -> Claim:
    text, values = _exponents(fits, ("propagated",), stages)
    walks = all(0.6 < x < 1.3 for x in values)
    return Claim(
        "The energy follows a random walk: its mean squared error grows with time "
        "(7.3)",
        f"α in μ = A + D t^α, t <= 1e4, h = {STEP_SIZES[0]:g} and {STEP_SIZES[1]:g}: "
        + text,
        command(PART),
        CONFIRMED if walks else DEPENDS,
        "close to a random walk, α = 1, on top of an oscillation of constant size"
        if walks
        else "growth at some s and h, within t = 1e4 none at others",
    )


def _closures(curves: dict, fits: dict, stages, final_time: float) -> Claim:
    text, values = _exponents(fits, ("symmetric", "consistent"), stages)
    half = len(values) // 2
    late = {
        (closure, s): curves[closure, s, STEP_SIZES[0]].mean(final_time / 2, final_time)
        for closure in ("symmetric", "propagated")
        for s in stages
    }
    ratios = ", ".join(
        f"{late['symmetric', s][0] / late['propagated', s][0]:.1f}" for s in stages
    )
    return Claim(
        "The same with the other closures (not in the paper)",
        f"α as above: {text}; μ of the symmetric closure divided by μ of the "
        f"paper's closure in the second half, h = {STEP_SIZES[0]:g}, "
        f"{stages_text(stages)}: {ratios}",
        command(PART),
        OURS,
        "the symmetric closure follows a random walk like the paper's closure (α <= "
        f"{max(values[:half]):.1f}), and the consistent closure drifts (α up to "
        f"{max(values[half:]):.1f}; a steady drift has 2)",
    )


def _against(curves: dict, fits: dict, s: int, final_time: float) -> Claim:
    texts, late = [], []
    for h in STEP_SIZES:
        for name in OTHERS[s]:
            kind = name.split()[0]
            parts = []
            for start, end in ((10.0, 200.0), (final_time / 2, final_time)):
                x, dx = curves["propagated", s, h].mean(start, end)
                y, dy = curves[kind, s, h].mean(start, end)
                ratio = x / y
                parts.append(f"{ratio:.2f} ± {ratio * np.hypot(dx / x, dy / y):.2f}")
            late.append(ratio)
            grown = fits[kind, s, h].ratio
            texts.append(f"{name}, h = {h:g}: {parts[0]} / {parts[1]} ({grown:.1f} x)")
    if max(late) > 1.5:
        verdict, why = (
            DEPENDS,
            (
                "early on the paper's method has the smaller error, but its random "
                f"walk is faster: late in the run its μ is up to {max(late):.1f} "
                "times the μ of the other methods"
            ),
        )
    else:
        verdict, why = CONFIRMED, "within a factor 1.5 to the end"
    if s == 2:
        why += "; DLA and SPARK 2 are one and the same method here (see below)"
    why += f"; {RECONSTRUCTED}"
    return Claim(
        f"No gain over SPARK and DLA, but no loss either (7.3), s = {s}",
        "μ of the paper's method divided by μ of the other method, t in 10..200 / the "
        f"second half of t <= {final_time:g} (in brackets: growth of μ of the other "
        "method): " + "; ".join(texts),
        command(PART),
        verdict,
        why,
    )


def _projected(fits: dict) -> Claim:
    x = [fits["RK4", 4, h] for h in STEP_SIZES]
    return Claim(
        "Against RK4 with projection (no claim of the paper)",
        "α: " + " and ".join(f"{f.alpha:.2f} ± {f.alpha_error:.2f}" for f in x)
        + "; μ grows "
        + " and ".join(f"{f.ratio:.0e}-fold" for f in x),
        command(PART),
        OURS,
        "a method without geometric structure drifts, α = 2, and ends with the "
        "largest μ",
    )  # fmt: skip
