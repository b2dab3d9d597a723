"""Where the print is wrong: the equations as printed, tried."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import nhjax
from nhjax import systems

from .. import _baselines, _tableaux
from ._claim import (
    Claim,
    command,
    DEPENDS,
    Found,
    orders_text,
    PRINT,
    slope,
    stages_text,
)


PART = "errata"
# Nodes of collocation methods other than Lobatto's.
NODES = "0, 1/3, 2/3, 1", "0, .25, .5, .75, 1"


def body_step(stages: int, form: str):
    """Make a step of the free rigid body by the Hamiltonian equations on a group.

    With N = 0 they are μ_{k+1} = Ad*_{τ(ξ)} μ_k and, for every stage,

        (dτ_ξ)* μ_{k+1} = Π^i + h Σ_j (b_j a_ji / b_i) (ddτ)*(H^j, Π^j),
        H^i = dτ⁻¹ D₂h((dτ⁻¹)* Π^i),  with dτ and ddτ at Ξ^i.

    `form` is "right", or one of two slips: "dual", where H^i = (dτ)* D₂h as in the
    paper's summary, and "base", (ddτ)*(Ξ^j, ·) as in the remark that follows the
    theorem.
    """
    method = nhjax.LobattoIIIAB(stages)
    a, b = jnp.asarray(method.a, float), jnp.asarray(method.b, float)
    weights = b[None, :] * a.T / b[:, None]
    group = nhjax.SO3(nhjax.Cayley())
    over = jax.vmap

    def step(inertia: Array, mu: Array, h: Array) -> Array:
        def residual(x):
            H, Pi = x[:stages], x[stages:]
            Xi, xi = h * (a @ H), h * (b @ H)
            end = group.Ad_dual(group.retract(xi), mu)
            body = over(group.dtau_inv_dual)(Xi, Pi)
            back = group.dtau_dual if form == "dual" else group.dtau_inv
            velocities = over(back)(Xi, body / inertia)
            turning = over(group.ddtau_dual)(Xi, Xi if form == "base" else H, Pi)
            momenta = group.dtau_dual(xi, end) - h * (weights @ turning)
            return x - jnp.concatenate([velocities, momenta]), end

        start = jnp.concatenate(
            [jnp.tile(mu / inertia, (stages, 1)), jnp.tile(mu, (stages, 1))]
        )
        return _baselines.solved(residual, start)

    return step


def found(quick: bool) -> Found:
    """Try what is printed."""
    del quick
    body = systems.FreeRigidBody()
    inertia = jnp.asarray(body.moments, float)
    mu0 = inertia * body.v0
    exact = np.asarray(inertia) * body.exact(2.0)[1]
    stages, counts = (2, 3), (40, 80)
    orders: dict[str, list[float]] = {}
    for form in ("right", "dual", "base"):
        orders[form] = []
        for s in stages:
            step = body_step(s, form)

            @jax.jit
            def end(h, step=step):
                def following(mu, _):
                    mu = step(inertia, mu, h)
                    return mu, mu

                return jax.lax.scan(following, mu0, length=counts[-1])[1]

            errors = [
                float(np.max(np.abs(np.asarray(end(2.0 / n))[n - 1] - exact)))
                for n in counts
            ]
            orders[form].append(slope([1 / n for n in counts], errors))
    stability = {s: nhjax.LobattoIIIAB(s).stability_at_infinity for s in range(2, 7)}
    right = orders_text(orders["right"])
    claims = []
    for form, printed, instead in (
        ("dual", "H = (dτ)* D₂h (summary, Hamiltonian on groups)", "H = dτ⁻¹ D₂h"),
        ("base", "(ddτ)*(Ξ, ·) (remark after the theorem on groups)", "(ddτ)*(H, ·)"),
    ):
        falls = orders[form][-1] < 2 * stages[-1] - 2.5
        claims.append(
            Claim(
                printed,
                f"order on the free rigid body, cay, {stages_text(stages)}: "
                f"{orders_text(orders[form])}"
                f"; with {instead}: {right}",
                command(PART),
                PRINT if falls else DEPENDS,
                "(dτ)* maps covectors, D₂h is a vector: η = dτ H = D₂h gives H"
                if form == "dual"
                else "the derivative of dτ_Ξ H by Ξ is meant, as in the theorem itself",
            )
        )
    signs = all(abs(x - (-1) ** (s - 1)) < 1e-6 for s, x in stability.items())
    claims.append(
        Claim(
            "“q >= 1 if R_A(∞)” (5, global convergence)",
            "R_A(∞): " + ", ".join(f"{x:+.3f} (s = {s})" for s, x in stability.items()),
            command(PART),
            PRINT if signs else DEPENDS,
            "“= 1” is missing: this is the case of odd s, where λ loses an order",
        )
    )
    general, tableaux = order_of_tableaux()
    constrained, with_constraint = order_with_constraint()
    assumption, assumptions = mixed_assumption()
    claims += [general, constrained, assumption]
    numbers = {
        "orders": orders,
        "stability": stability,
        "tableaux": tableaux,
        "with constraint": with_constraint,
        "assumptions": assumptions,
    }
    return Found(claims, {"errata": numbers})


def printed_order(method: nhjax.PartitionedRungeKutta) -> int:
    """Compute the order of p as printed."""
    p, q, r, _ = method.orders
    return min(p, 2 * q, q + r)


def order_of_tableaux() -> tuple[Claim, dict[str, dict[str, float]]]:
    """Compare the printed order of general tableaux with that of runs."""
    methods = {
        f"nodes {name}": _tableaux.collocation(_tableaux.CLOSED[name]) for name in NODES
    } | {"RK4 and its conjugate": _tableaux.RK4}
    numbers = {}
    for name, method in methods.items():
        counts = (40, 80) if method.order < 4 else (20, 40)
        observed = _tableaux.observed(*_tableaux.pendulum(), method, counts, 2.0)
        numbers[name] = {"printed": printed_order(method), "observed": observed.q}
    differ = all(abs(x["printed"] - x["observed"]) > 0.5 for x in numbers.values())
    text = "; ".join(
        f"{name}: {x['observed']:.2f} (printed: {x['printed']}"
        + (", a lower bound)" if x["printed"] < x["observed"] - 0.5 else ")")
        for name, x in numbers.items()
    )
    claim = Claim(
        "order min(p, 2q, q + r), the same for the pair as for (a, b)",
        f"order of a pendulum on a slide, without constraints, {text}",
        command(PART),
        PRINT if differ else DEPENDS,
        "the pair has its own order conditions, for trees with two colours",
    )
    return claim, numbers


def order_with_constraint() -> tuple[Claim, dict[str, dict[str, float]]]:
    """Compare the printed orders of p and λ, with the paper's closure, with runs."""
    numbers, texts = {}, []
    for name in NODES:
        method = _tableaux.collocation(_tableaux.CLOSED[name], "propagated")
        loses_one = abs(method.stability_at_infinity - 1) < 1e-6
        observed = _tableaux.observed(*_tableaux.rolling(), method, (80, 160), 2.0)
        row = {
            "printed p": printed_order(method),
            "observed p": float(observed.p),
            "printed multiplier": method.orders.C - loses_one,
            "observed multiplier": float(observed.multiplier),
        }
        numbers[name] = row
        texts.append(
            f"nodes {name}: p {row['observed p']:.2f} (printed: {row['printed p']}), "
            f"λ {row['observed multiplier']:.2f} (printed: {row['printed multiplier']})"
        )
    differ = all(
        row[f"printed {x}"] - row[f"observed {x}"] > 0.5
        for row in numbers.values()
        for x in ("p", "multiplier")
    )
    claim = Claim(
        "p is of order min(p, 2q, q + r), λ of order q, or q - 1 if R_A(∞) = 1 (5, "
        "global convergence)",
        "orders with a nonlinear constraint, " + "; ".join(texts),
        command(PART),
        PRINT if differ else DEPENDS,
        "the pair satisfies fewer conditions than (a, b), see the next row",
    )
    return claim, numbers


def mixed_assumption() -> tuple[Claim, dict[str, dict[str, int]]]:
    """Compare the printed Q of the assumption CĈ(Q) with that of tableaux."""
    numbers = {}
    for name in NODES:
        p, _, r, mixed = _tableaux.collocation(_tableaux.CLOSED[name]).orders
        numbers[f"nodes {name}"] = {"printed": p - r, "found": mixed}
    for stages in (3, 4):
        p, _, r, mixed = nhjax.LobattoIIIAB(stages).orders
        numbers[f"Lobatto, s = {stages}"] = {"printed": p - r, "found": mixed}
    differ = any(x["printed"] != x["found"] for x in numbers.values())
    claim = Claim(
        "Q = R = p - r for conjugated methods (appendix)",
        "Q of "
        + "; ".join(
            f"{name}: {x['found']} (printed: {x['printed']})"
            for name, x in numbers.items()
        ),
        command(PART),
        PRINT if differ else DEPENDS,
        "it holds for Lobatto's pairs, not for all conjugated methods",
    )
    return claim, numbers
