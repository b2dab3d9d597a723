"""The methods that ours are compared with, and the arithmetic of the verdicts."""

import json
import re

import jax
import numpy as np
import pytest

from benchmarks import _baselines as baselines
from benchmarks._report import RESULTS
from benchmarks._tableaux import rolling
from benchmarks._verdicts._claim import Claim, RECONSTRUCTED
from benchmarks._verdicts._errata import mixed_assumption
from benchmarks._verdicts._growth import Curve, growth, in_stretches
from benchmarks._verdicts._orders import (
    BASELINE_ORDERS,
    baseline_orders,
    orders_from_wrong_multiplier,
)
from benchmarks._verdicts._ours import distances
from benchmarks.verdicts import DOCS, filled, PAGE, table
from nhjax import systems


def test_baseline_methods_converge_with_known_orders():
    orders = baseline_orders(counts=(24, 48), time=2.0)
    assert list(orders) == list(BASELINE_ORDERS)
    np.testing.assert_allclose(
        list(orders.values()), list(BASELINE_ORDERS.values()), atol=0.1
    )


@pytest.mark.parametrize(
    ("closure", "expected"), [("propagated", (2, 2)), ("symmetric", (4, 6))]
)
def test_order_from_wrong_multiplier_is_two_if_propagated(closure, expected):
    found = orders_from_wrong_multiplier(*rolling(), (3, 4), closure)
    np.testing.assert_allclose(found, expected, atol=0.05)


def test_leapfrog_satisfies_the_discrete_lagrange_dalembert_equations():
    cvt = systems.ContinuouslyVariableTransmission.high()
    y0, h = cvt.initial_state(), 0.1
    nat = baselines.natural(cvt.system)
    step = baselines.discrete_lagrange_dalembert(nat)
    q, _ = jax.jit(lambda: baselines.run(step, y0.q, y0.v, h, 3))()

    def action(left, right):
        v = (right - left) / h
        ends = [cvt.lagrangian(0.0, x, v, None) for x in (left, right)]
        return 0.5 * h * (ends[0] + ends[1])

    force = jax.grad(action, 1)(q[0], q[1]) + jax.grad(action, 0)(q[1], q[2])
    b = nat.direction(q[1])
    left_over = force - b * (b @ force) / (b @ b)
    np.testing.assert_allclose(left_over, 0.0, atol=1e-14)
    for left, right in ((q[0], q[1]), (q[1], q[2])):
        assert abs(nat.direction(0.5 * (left + right)) @ (right - left)) < 1e-14


def test_baseline_methods_that_are_equivalent_coincide():
    apart = distances(systems.NonholonomicParticle(), num_steps=20)
    assert apart["DLA, SPARK 2"] < 1e-13
    assert apart["leapfrog, Lobatto-2"] < 1e-13
    assert apart["SPARK 2, Lobatto-2"] > 1e-4


@pytest.mark.parametrize("alpha", [1.0, 2.0])
def test_growth_of_a_power_law_is_its_exponent(alpha):
    times = np.arange(5.0, 1e4, 5.0)
    mu = 1e-5 + 1e-3 * (times / 1e4) ** alpha
    found = growth(in_stretches(times, mu, 0.1 * mu, 1e4))
    assert found.alpha == pytest.approx(alpha, abs=0.05)
    assert found.alpha_error < 0.3
    assert growth(Curve(times, 0 * times + 1.0, times)).alpha == 0.0


def test_verdict_table_escapes_vertical_bars():
    line = table([Claim("|E|", "1", "x", "confirmed", "y")]).splitlines()[-1]
    assert line == "| \\|E\\| | 1 | `x` | **confirmed**: y |"


def test_verdicts_page_has_tables_and_figures_of_the_result():
    record = json.loads((RESULTS / "verdicts.json").read_text(encoding="utf-8"))
    claims = {
        part: [Claim(**claim) for claim in lines]
        for part, lines in record["claims"].items()
    }
    page = PAGE.read_text(encoding="utf-8")
    assert page == filled(page, claims), "run `python -m benchmarks.verdicts`"
    for target in re.findall(r"\]\(([^)#:]+)\)", page):
        found = DOCS / target
        assert found.is_file()
        assert found.suffix != ".png" or found.stat().st_size < 150_000


def test_verdicts_about_spark_state_that_it_is_reconstructed():
    record = json.loads((RESULTS / "verdicts.json").read_text(encoding="utf-8"))
    lines = [line for part in record["claims"].values() for line in part]
    resting = [x for x in lines if "SPARK" in x["claim"] + x["measured"]]
    assert resting
    assert all(RECONSTRUCTED in line["why"] for line in resting)


def test_printed_mixed_assumption_holds_for_lobatto_pairs_alone():
    _, numbers = mixed_assumption()
    assert len(numbers) == 4
    for name, row in numbers.items():
        assert (row["found"] == row["printed"]) == name.startswith("Lobatto")
