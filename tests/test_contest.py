"""The tables of the benchmarks contain the fastest form of each competitor."""

import pytest

from benchmarks._contest import contest_table, contests, Measured, Run


def case_of(ladders):
    """A case with ladders of pairs (seconds, error) by method."""
    runs = [
        Run(method, float(rung), None, seconds=x, fastest=x, error=error)
        for method, ladder in ladders.items()
        for rung, (x, error) in enumerate(ladder)
    ]
    return Measured("chaotic", 20.0, 101, runs)


def test_contest_counts_the_fastest_form_of_each_competitor():
    case = case_of(
        {
            "nhjax s=4": [(2.0, 1e-4), (8.0, 1e-12)],
            "nhjax devices s=4": [(1.0, 1e-4), (4.0, 1e-12)],
            "diffrax Dopri8 vmap": [(4.0, 1e-4), (16.0, 1e-12)],
            "diffrax Tsit5 stacked": [(1.0, 1e-4), (64.0, 1e-12)],
            "heyoka single": [(8.0, 1e-9)],
            "heyoka threads batch": [(2.0, 1e-9)],
        }
    )
    first, second, third = contests(case)
    # Half way between rungs in logarithms, nhjax takes 4 s, and 2 s on devices.
    best = second["best"]
    assert [*best] == [
        *("nhjax", "nhjax devices", "diffrax", "heyoka", "heyoka threads")
    ]
    assert best["nhjax"]["seconds"] == pytest.approx(4.0)
    assert best["diffrax"]["ratio_seconds"] == pytest.approx(4.0 / 8.0)
    assert best["heyoka"]["ratio_fastest"] == pytest.approx(4.0 / 8.0)
    assert second["others"]["method"] == "heyoka threads batch"
    assert second["others"]["ratio_seconds"] == pytest.approx(2.0 / 2.0)
    # Where heyoka is not as accurate, only diffrax is left, with another method.
    assert first["best"]["diffrax"]["method"] == "diffrax Tsit5 stacked"
    assert third["others"]["method"] == "diffrax Dopri8 vmap"
    ours, theirs = 4.0 ** (7 / 8), 4.0 * 4.0 ** (7 / 8)
    assert third["others"]["ratio_seconds"] == pytest.approx(ours / theirs)
    assert contest_table(case).splitlines()[-1].endswith("| 0.25 (0.25) |")


def test_contest_without_competitors_has_a_table():
    case = case_of({"nhjax s=4": [(2.0, 1e-4), (8.0, 1e-12)]})
    assert all(not outcome["others"] for outcome in contests(case))
    assert contest_table(case).count("\n") == 4
