"""The energies of the CVT, over short and long times."""

import math

import jax
import jax.numpy as jnp
import numpy as np

import nhjax
from nhjax import studies
from nhjax.studies import CVTEnergy
from nhjax.systems import ContinuouslyVariableTransmission as CVT

from .. import _baselines
from ._claim import (
    Claim,
    command,
    CONFIRMED,
    DEPENDS,
    Found,
    RECONSTRUCTED,
    REFUTED,
)
from ._figures import transmission_figure
from ._orders import baseline_steps


PART = "transmission"
H, LARGE = 0.1, math.pi / 10
REGIMES = {"low": CVT.low, "high": CVT.high}


def fifths(error: np.ndarray) -> np.ndarray:
    """Return the largest |error| in each fifth of a run; a lost run counts as inf."""
    parts = np.array_split(np.abs(error), 5)
    return np.array([np.max(np.where(np.isfinite(x), x, np.inf)) for x in parts])


def others(final_time: float, epsilon: float, h: float) -> dict[str, np.ndarray]:
    """Run the methods of others on both regimes; E - E_0, of shape (2, steps)."""
    cvt = CVT(epsilon)
    system, num_steps = cvt.system, round(final_time / h)
    starts = [make(epsilon).initial_state() for make in REGIMES.values()]
    q, v = (jnp.stack([getattr(y, name) for y in starts]) for name in "qv")

    def energy(q, v):
        return system.energy(0.0, nhjax.State(q, v, v, v[:1]))

    def errors(step, q, v):
        run = _baselines.run(step, q, v, h, num_steps, observe=energy)
        return run - energy(q, v)

    return {
        name: np.asarray(jax.jit(jax.vmap(lambda q, v, f=f: errors(f, q, v)))(q, v))
        for name, f in baseline_steps(system).items()
    }


def found(quick: bool) -> Found:
    """Measure all claims about the transmission."""
    final_time = 500.0 if quick else 5000.0
    options = {"final_time": final_time, "dt": (H, LARGE)}
    by_epsilon = {e: studies.cvt_energy(epsilon=e, **options) for e in (0.0, 0.5)}
    # What the paper does not show: more stages, and the closures.
    high = {
        (s, closure): studies.cvt_energy(
            regimes=("high",), stages=(s,), dt=(H,), final_time=final_time,
            closure=closure,
        ).runs[0]
        for s in ((3,) if quick else (3, 4))
        for closure in ("propagated", "symmetric")
    }  # fmt: skip
    baselines = {e: others(final_time, e, H) for e in (0.0, 0.5)}
    claims = [
        _large_step(by_epsilon),
        *(_small_step(e, by_epsilon[e]) for e in (0.5, 0.0)),
        _more_stages(high),
        _others(by_epsilon, baselines),
    ]
    data = {
        f"epsilon_{e:g}": study.summary()["runs"] for e, study in by_epsilon.items()
    }
    for e, errors in baselines.items():
        data[f"others_epsilon_{e:g}"] = {
            f"{name} {regime}": fifths(errors[name][i]).tolist()
            for name in errors
            for i, regime in enumerate(REGIMES)
        }
    data["high"] = {f"s{s} {c}": run.by_fifths() for (s, c), run in high.items()}
    study = by_epsilon[0.5]
    figures = {
        name: figure
        for name, figure in study.figures().items()
        if name.endswith(f"h{H:.4g}")
    }
    figures["cvt-others"] = transmission_figure(
        {run.regime: run for run in study.runs if run.dt == H},
        baselines[0.5],
        high.get((3, "propagated")),
        high.get((3, "symmetric")),
    )
    return Found(claims, {"transmission": data}, figures)


def _run(study: CVTEnergy, regime: str, h: float):
    (run,) = (run for run in study.runs if (run.regime, run.dt) == (regime, h))
    return run


def _large_step(by_epsilon: dict[float, CVTEnergy]) -> Claim:
    texts, ratios, growth = [], [], []
    for e, study in by_epsilon.items():
        for regime in REGIMES:
            large, small = (_run(study, regime, h).by_fifths() for h in (LARGE, H))
            ratios.append(max(large) / max(small))
            growth.append(max(large) / large[0])
            texts.append(f"{regime}, ε = {e:g}: {max(large):.2f} ({ratios[-1]:.0f} x)")
    erratic = min(ratios) > 1.5 * (LARGE / H) ** 2
    return Claim(
        "At h = π/10 the energy is erratic, the step too big (7.2; Lobatto-2)",
        "largest |E - E_0| (in brackets: ratio to the error at h = 1/10): "
        + "; ".join(texts),
        "nhjax run cvt-energy",
        CONFIRMED if erratic else REFUTED,
        f"order 2 explains a factor {(LARGE / H) ** 2:.1f}, and all four errors "
        f"grow by more; but there is no drift: the largest error of the run is "
        f"at most {max(growth):.2f} times the largest error of its first fifth",
    )


def _small_step(epsilon: float, study: CVTEnergy) -> Claim:
    texts, growth = [], []
    for regime in REGIMES:
        run = _run(study, regime, H)
        short = run.deviations()[run.times <= study.short_time]
        parts = []
        for i, name in enumerate(("E", "E_d", "E_p")):
            long = fifths(run.deviations()[1:, i])
            growth.append(max(long) / long[0])
            parts.append(f"{name} {np.max(np.abs(short[:, i])):.1e} / {max(long):.1e}")
        texts.append(f"{regime}: " + ", ".join(parts))
    command_line = "nhjax run cvt-energy"
    if epsilon != study.epsilon or epsilon == 0:
        command_line += f" --epsilon {epsilon:g}"
    return Claim(
        "At h = 1/10 the energies of the whole, of driver and of passenger behave "
        f"excellently, over short and long times (7.2; Lobatto-2, ε = {epsilon:g})",
        f"largest error for t <= {study.short_time:g} / t <= {study.final_time:g}: "
        + "; ".join(texts),
        command_line,
        CONFIRMED if max(growth) < 1.2 else REFUTED,
        f"bounded: the whole run has at most {max(growth):.2f} times the error of its "
        "first fifth",
    )


def _more_stages(high: dict) -> Claim:
    by_fifths = {key: run.by_fifths() for key, run in high.items()}
    growth = {key: max(x) / x[0] for key, x in by_fifths.items()}
    text = "; ".join(
        f"s = {s}, {closure}: {x[0]:.1e} / {x[-1]:.1e}"
        for (s, closure), x in by_fifths.items()
    )
    drifting = growth[3, "propagated"] > 1.5
    return Claim(
        "The same with more stages (not in the paper, which shows s = 2 here)",
        f"high, ε = 0.5, first / last fifth of the run: {text}",
        "nhjax run cvt-energy --stages 3 4",
        DEPENDS if drifting else CONFIRMED,
        f"with the paper's closure the energy grows {growth[3, 'propagated']:.1f}-fold "
        "at s = 3, where R_A(∞) = +1 lets errors of λ add up; with the symmetric "
        f"closure {growth[3, 'symmetric']:.1f}-fold",
    )


def _others(by_epsilon: dict[float, CVTEnergy], baselines: dict) -> Claim:
    texts, drifts = [], []
    for e, errors in baselines.items():
        for i, regime in enumerate(REGIMES):
            ours = _run(by_epsilon[e], regime, H).by_fifths()
            parts = {"Lobatto-2": np.asarray(ours)}
            parts |= {name: fifths(errors[name][i]) for name in errors}
            for name, x in parts.items():
                if max(x) > 1.2 * x[0]:
                    drifts.append(f"{name} ({regime}, ε = {e:g})")
            if e > 0:
                texts.append(
                    f"{regime}: "
                    + ", ".join(
                        f"{k} {x[0]:.1e} / {x[-1]:.1e}" for k, x in parts.items()
                    )
                )
    gains = "DLA (high, ε = 0.5)" in drifts and not any("Lob" in x for x in drifts)
    return Claim(
        "Against DLA, SPARK and RK4 with projection on the CVT (no claim of the paper)",
        "|E - E_0| in the first / last fifth, h = 1/10, ε = 1/2: " + "; ".join(texts),
        command(PART),
        DEPENDS,
        ("the paper's method does not drift where the rotating driver is perturbed"
         if gains else "none is better throughout")
        + f"; drifting: {', '.join(drifts)}; {RECONSTRUCTED}",
    )  # fmt: skip
