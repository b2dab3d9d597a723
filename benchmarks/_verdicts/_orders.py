"""The orders of the particle and of the unicycle, and what they rest on."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import nhjax
from nhjax import studies, systems

from .. import _baselines
from .._tableaux import observed, rolling
from ._claim import (
    Claim,
    command,
    CONFIRMED,
    Found,
    near,
    orders_text,
    RECONSTRUCTED,
    REFUTED,
    slope,
    stages_text,
)


PART = "orders"


def found(quick: bool) -> Found:
    """Measure all claims about orders."""
    options = {"stages": (2, 3), "dt": (0.25, 0.125)} if quick else {}
    particle = studies.particle_order(**options)
    unicycle = studies.unicycle_order(**options)
    claims, data = [], {}
    for study, where in ((particle, "5, corollary; 7.1"), (unicycle, "7.4")):
        claims += _order_claims(study, where)
        data[study.name] = study.summary()
    for part in (_local(quick), _inconsistent(quick), _baseline_orders()):
        claims += part.claims
        data |= part.data
    figures = {name: f for x in (particle, unicycle) for name, f in x.figures().items()}
    return Found(claims, data, figures)


def _order_claims(study, where: str) -> list[Claim]:
    stages, orders = study.stages, study.orders()
    by_name = dict(zip(study.quantities, orders.T, strict=True))
    multipliers = "multiplier", "continuous_multiplier"
    even = 2 * np.asarray(stages) - 2
    motion = {k: x for k, x in by_name.items() if k not in multipliers}
    worst = {k: np.nanmax(np.abs(x - even)) for k, x in motion.items()}
    own = np.asarray(stages) - np.asarray(stages) % 2
    carried, continuous = (by_name[name] for name in multipliers)
    system = type(study.example).__name__
    names = ", ".join(motion)
    return [
        Claim(
            f"{system}: {names} are of order 2s - 2 ({where})",
            f"{stages_text(stages)}: "
            + "; ".join(f"{k} {orders_text(x)}" for k, x in motion.items()),
            f"nhjax run {study.name}",
            CONFIRMED if max(worst.values()) <= 0.5 else REFUTED,
            f"all within {max(worst.values()):.2f} of 2s - 2, against the exact "
            "solution (the paper: against its own runs at h = 1e-4)",
        ),
        Claim(
            f"{system}: λ is of order s for even s, s - 1 for odd s ({where})",
            f"{stages_text(stages)}: {orders_text(carried)}",
            f"nhjax run {study.name}",
            CONFIRMED if near(carried, own) else REFUTED,
            "and λ recomputed from (q, p) is of order 2s - 2: "
            + orders_text(continuous),
        ),
    ]


def plain_step(nat: _baselines.Natural, stages: int):
    """Make the paper's step as printed, without the library, for λ_k given.

    It maps (q, p, λ, h) to the Q^i, P^i, the p^i of the nodes, and Λ^i.
    """
    method = nhjax.LobattoIIIAB(stages)
    a, a_hat = jnp.asarray(method.a, float), jnp.asarray(method.a_hat, float)
    inverse = jnp.linalg.inv(a[1:, 1:])

    def step(q: Array, p: Array, multiplier: Array, h: Array):
        b0 = nat.direction(q)
        first = jnp.zeros(stages).at[0].set(h * multiplier)

        def residual(x):
            impulses, velocities = x[:, 0] + first, x[:, 1:]
            positions = q + h * (a @ velocities)
            b = jax.vmap(nat.direction)(positions)
            kicks = h * jax.vmap(nat.force)(positions) + impulses[:, None] * b
            stage_p, nodes = p + a_hat @ kicks, p + a @ kicks
            change = inverse @ jnp.sum(b * nodes, axis=1)[1:] / (b0 @ b0)
            change = jnp.append(0.0, change)[:, None]
            r = jnp.concatenate([change, velocities - stage_p], axis=1)
            return r, (positions, stage_p, nodes, impulses / h)

        start = jnp.concatenate(
            [jnp.zeros((stages, 1)), jnp.broadcast_to(p, (stages, *p.shape))], axis=1
        )
        return _baselines.solved(residual, start)

    return step


def _local(quick: bool) -> Found:
    """One step from exact data: errors at its end and at its stages."""
    particle = systems.NonholonomicParticle()
    nat = _baselines.natural(particle.system)
    q0, v0, multiplier = particle.exact(0.0)
    stages = (2, 3) if quick else (2, 3, 4)
    names = ("q", "p", "λ", "Q^i", "p^i", "P^i")
    orders = {name: [] for name in names}
    for s in stages:
        step = jax.jit(plain_step(nat, s))
        # As small as round-off allows.
        step_sizes = (0.025, 0.0125) if s < 4 else (0.05, 0.025)
        c = nhjax.LobattoIIIAB(s).c
        errors = {name: [] for name in names}
        for h in step_sizes:
            Q, P, nodes, multipliers = step(q0, v0, multiplier[0], h)
            exact = [particle.exact(h * x) for x in c]
            q, v, lam = (np.stack(x) for x in zip(*exact, strict=True))
            distance = lambda x, y: float(np.max(np.abs(np.asarray(x) - y)))  # noqa: E731
            errors["q"].append(distance(Q[-1], q[-1]))
            errors["p"].append(distance(nodes[-1], v[-1]))
            errors["λ"].append(distance(multipliers[-1], lam[-1, 0]))
            # For s = 2 the ends are the only stages.
            inner = slice(1, -1) if s > 2 else slice(1, None)
            errors["Q^i"].append(distance(Q[inner], q[inner]))
            errors["p^i"].append(distance(nodes[inner], v[inner]))
            errors["P^i"].append(distance(P, v))
        for name in names:
            orders[name].append(slope(step_sizes, errors[name]))
    s = np.asarray(stages)
    expected = {"q": 2 * s - 1, "p": 2 * s - 1, "λ": s}
    ends = {k: orders[k] for k in expected}
    good = all(np.all(np.asarray(x) >= expected[k] - 0.3) for k, x in ends.items())
    stage = {"Q^i": s + 1, "p^i": s + 1, "P^i": s - 1}
    stages_good = all(near(orders[k], e, 0.5) for k, e in stage.items())
    return Found(
        [
            Claim(
                "Local errors: h^{2s-1} of q and p, h^s of λ (5, local convergence)",
                f"{stages_text(stages)}: "
                + "; ".join(f"{k} {orders_text(x)}" for k, x in ends.items()),
                command(PART),
                CONFIRMED if good else REFUTED,
                "one step from exact data on the particle, by the printed equations",
            ),
            Claim(
                "Inside a step Q^i and the new p^i are of order s, the P^i of order "
                "s - 2 only (5.1)",
                "powers of h in the local errors, one more than the order: "
                + "; ".join(f"{k} {orders_text(orders[k])}" for k in stage)
                + f" ({stages_text(stages)})",
                command(PART),
                CONFIRMED if stages_good else REFUTED,
                "so it is right to impose the constraints on the p^i",
            ),
        ],
        {"local_orders": {"stages": stages, **orders}},
    )


# Numbers of steps over two units of time. With a right λ_0, finer steps with more
# stages end at round-off.
COUNTS = {2: (64, 128), 3: (64, 128), 4: (32, 64), 5: (16, 32), 6: (8, 16)}


def orders_from_wrong_multiplier(
    system: nhjax.LagrangianSystem,
    y0: nhjax.State,
    stages: Sequence[int],
    closure: str,
    change: float = 0.3,
) -> list[float]:
    """Measure the order of (q, p) for each s, with λ_0 wrong by `change`."""
    wrong = eqx.tree_at(lambda y: y.multiplier, y0, y0.multiplier + change)
    slopes = [
        observed(system, wrong, nhjax.LobattoIIIAB(s, closure), COUNTS[s], 2.0)
        for s in stages
    ]
    return [min(x.q, x.p) for x in slopes]


def _inconsistent(quick: bool) -> Found:
    """A wrong λ_0, of which the theorem asks that it be that of the problem."""
    particle = systems.NonholonomicParticle()
    cases = {
        "constant mass, linear constraint": (particle.system, particle.initial_state()),
        "M(q), linear constraint": rolling(quadratic=0.0),
        "M(q), constraint quadratic in v": rolling(),
    }
    stages = (3,) if quick else (2, 3, 4, 5, 6)
    propagated = {
        name: orders_from_wrong_multiplier(*case, stages, "propagated")
        for name, case in cases.items()
    }
    s = np.asarray(stages)
    lost = {k: 2 * s - 2 - x for k, x in propagated.items()}
    falls = all(np.all(x[s > 2] > 0.5) for x in lost.values())
    own = [k for k, x in propagated.items() if near(x, s - s % 2)]
    two = [k for k, x in propagated.items() if near(x, 2 + 0 * s) and k not in own]
    rules = {"s (s even) or s - 1 (s odd)": own, "2 for every s": two}
    found = [
        f"order {rule} with {' and with '.join(names)}"
        for rule, names in rules.items()
        if names
    ]
    others = [k for k in propagated if k not in own + two]
    if others:
        found.append(f"no simple rule with {' and with '.join(others)}")
    text = "; ".join(f"{k}: {orders_text(x)}" for k, x in propagated.items())
    rows = [
        {"closure": "propagated", "system": k, "stages": n, "order": x}
        for k, orders in propagated.items()
        for n, x in zip(stages, orders, strict=True)
    ]
    if not quick:
        name = list(cases)[-1]
        ours = orders_from_wrong_multiplier(*cases[name], stages, "symmetric")
        text += (
            "; with the symmetric closure, which does not carry λ from step to step, "
            f"{name}: {orders_text(ours)}"
        )
        rows += [
            {"closure": "symmetric", "system": name, "stages": n, "order": x}
            for n, x in zip(stages, ours, strict=True)
        ]
    claim = Claim(
        "λ_0 must be the multiplier of the continuous problem (5, hypothesis of the "
        "theorems)",
        f"order of (q, p) from λ_0 wrong by 0.3, {stages_text(stages)}: {text}",
        command(PART),
        CONFIRMED if falls else REFUTED,
        "from a wrong λ_0 the paper's method has " + "; ".join(found),
    )
    return Found([claim], {"inconsistent_multiplier": rows})


def baseline_steps(system: nhjax.LagrangianSystem) -> dict[str, _baselines.Step]:
    """Return the steps of the methods of others, by name."""
    nat = _baselines.natural(system)
    return {
        "DLA": _baselines.discrete_lagrange_dalembert(nat),
        "SPARK 2": _baselines.spark(nat, 2),
        "SPARK 3": _baselines.spark(nat, 3),
        "RK4": _baselines.projected_rk4(nat),
    }


BASELINE_ORDERS = {"DLA": 2, "SPARK 2": 2, "SPARK 3": 4, "RK4": 4}


def baseline_orders(counts: tuple[int, int] = (32, 64), time: float = 3.0):
    """Measure the orders of the methods of others on the particle."""
    particle = systems.NonholonomicParticle()
    y0, exact = particle.initial_state(), particle.exact(time)[:2]
    orders = {}
    for name, step in baseline_steps(particle.system).items():
        program = jax.jit(
            lambda h, step=step: _baselines.run(step, y0.q, y0.v, h, counts[-1])
        )
        errors = []
        for n in counts:
            # One program for both: the coarser run goes on beyond the time.
            end = jax.tree.map(lambda x, n=n: x[n - 1], program(time / n))
            pairs = zip(end, exact, strict=True)
            errors.append(float(max(np.max(np.abs(x - y)) for x, y in pairs)))
        orders[name] = slope([1 / n for n in counts], errors)
    return orders


def _baseline_orders() -> Found:
    orders = baseline_orders()
    good = all(near(x, BASELINE_ORDERS[name]) for name, x in orders.items())
    claim = Claim(
        "(the methods of others, written for this comparison, have their orders)",
        ", ".join(f"{k}: {x:.2f} ({BASELINE_ORDERS[k]})" for k, x in orders.items()),
        command(PART),
        CONFIRMED if good else REFUTED,
        "on the particle, against the exact solution; expected orders in brackets; "
        + RECONSTRUCTED,
    )
    return Found([claim], {"baseline_orders": orders})
