"""Figures that pages quote are those of the committed results of the benchmarks."""

import numpy as np
import pytest

from support.pages import assert_agree, page, quoted, results, rows_of


@pytest.mark.parametrize(
    ("printed", "value"), [("0.72", 0.7249), ("9e-16", 8.6e-16), ("600", 598.0)]
)
def test_a_rounded_number_agrees_with_its_value(printed, value):
    assert_agree([printed], [value])


@pytest.mark.parametrize(
    ("printed", "value"), [("0.72", 0.7251), ("9e-16", 9.6e-16), ("60", 55.0)]
)
def test_another_number_does_not_agree(printed, value):
    with pytest.raises(AssertionError):
        assert_agree([printed], [value])


def test_a_figure_that_is_not_found_once_is_refused():
    with pytest.raises(AssertionError, match="found 2 times"):
        quoted("3 s and\n4 s", r"(\d) s")


# The columns of the contest with others: members, and the library.
COLUMNS = [(1, "diffrax"), (1, "heyoka"), (101, "diffrax"), (101, "heyoka")]


def test_ratios_of_the_contest_are_those_of_the_result():
    contests = {
        (case["name"], case["members"], case["t"], line["accuracy"]): line["best"]
        for case in results("work_precision")["cases"]
        for line in case["contest"]
    }
    for label, *cells in rows_of(page("performance"), "end error"):
        *case, error = label.split(", ")
        name = case[0] if case else "chaotic"
        time = float(case[1].removeprefix("t = ")) if case[1:] else 20.0
        for cell, (members, library) in zip(cells, COLUMNS, strict=True):
            if cell:
                best = contests[name, members, time, float(error)]
                assert_agree([cell], [best[library]["ratio_seconds"]])


def test_the_floor_is_that_of_the_result():
    one, many = results("floor")["rows"]
    text = page("performance")
    single, batch = rows_of(text, "chaotic system, n = 7, s = 3, h = 0.1")
    alone, scalar = one["micros"]["one core"], one["micros"]["C++, 1"]
    assert_agree([single[1], single[3]], [alone, alone / scalar])
    assert_agree(quoted(single[2], r"([\d.]+) \(scalar\)"), [scalar])
    ours, vectors = many["micros"]["one core"], many["micros"]["C++, 8"]
    assert_agree([batch[1], batch[3]], [ours, ours / vectors])
    assert_agree(quoted(batch[2], r"([\d.]+) \(8"), [vectors])
    both = many["micros"]["all cores"]
    pattern = r"On both cores the 1000 members take ([\d.]+) µs, ([\d.]+) times as fast"
    assert_agree(quoted(text, pattern), [both, ours / both])


def test_ratios_of_engines_are_those_of_the_result():
    rows = results("engines")["rows"]
    ratios = {row["system"]: row["ratio"] for row in rows}
    snakeboard = ratios.pop("Snakeboard")
    compiled = [row["compile"][1] / row["compile"][0] for row in rows]
    text = page("performance")
    pattern = r"state at the end it is ([\d.]+) to ([\d.]+) on (\d+) systems"
    measured = [min(ratios.values()), max(ratios.values()), len(ratios)]
    assert_agree(quoted(text, pattern), measured)
    assert_agree(quoted(text, r"([\d.]+) on the snakeboard"), [snakeboard])
    pattern = r"Compiling takes ([\d.]+) to ([\d.]+) of the time"
    assert_agree(quoted(text, pattern), [min(compiled), max(compiled)])


def test_times_with_many_constraints_are_those_of_the_result():
    found = results("constraints")
    rows = rows_of(page("performance"), "constraints")
    columns = {3: found["chain"], 5: found["star"]}
    for i, column in columns.items():
        assert [row[0] for row in rows[:-1]] == [str(x["n"]) for x in column]
        steps = [x["step"] for x in column]
        assert_agree([row[i - 1] for row in rows[:-1]], steps)
        ends = np.log(steps[-1] / steps[0]) / np.log(column[-1]["n"] / column[0]["n"])
        assert_agree([rows[-1][i - 1]], [ends])


def test_the_growth_with_coordinates_is_that_of_the_result():
    pattern = r"from 7 to 101 coordinates of the chaotic system it grows as n\^([\d.]+)"
    fitted = results("scaling")["n"]["step"]["fitted"]
    assert_agree(quoted(page("performance"), pattern), [fitted])


def test_operations_of_a_sweep_are_those_of_the_result():
    kinds = ("products", "sums", "divisions", "sin, cos", "arctan")
    measured = results("sweep_operations")["rows"]
    printed = rows_of(page("performance"), "system", "products")
    assert [[int(cell or 0) for cell in row[1:]] for row in printed] == [
        [row[kind] for kind in kinds] for row in measured
    ]


def test_costs_of_ensembles_are_those_of_the_result():
    found = results("ensembles")
    text = page("ensembles")
    million = next(row for row in found["rows"] if row["members"] == 1_000_000)
    pattern = (
        r"a million members of (\d+) steps with a mean and a variance take ([\d.]+) "
        r"times as long as a bare `vmap` .*?, in (\d+) MB of memory; ten thousand"
    )
    steps, ratio, memory = quoted(text, pattern)
    assert int(steps) == million["num_steps"]
    assert_agree([ratio, memory], [million["ratio"], million["megabytes"]])
    assert_agree([memory], [found["rows"][0]["megabytes"]])
    one, two = (np.array(found["processes"][k])[:, 1] for k in ("one", "two"))
    pattern = (
        r"each need ([\d.]+) times the processor time of one for ([\d ]+) members of "
        r"1000 steps \(the median of (\d+) pairs of runs, from ([\d.]+) to ([\d.]+)\)"
    )
    median, members, pairs, least, most = quoted(text, pattern)
    assert int(members.replace(" ", "")) == found["processes"]["members"]
    assert int(pairs) == len(one)
    ratios = two / one
    assert_agree([median, least, most], [np.median(ratios), min(ratios), max(ratios)])


def test_costs_of_derivatives_are_those_of_the_result():
    found = results("gradients")
    text = page("derivatives")
    times = [row[1] for row in rows_of(text, "derivative", "time")]
    assert_agree(times, list(found["modes"].values())[1:])
    batch = found["batch"]["batch of gradients"] / found["batch"]["gradient"]
    assert_agree(quoted(text, r"takes the time of (\d+) single ones"), [batch])
    cases = {(x["system"], x["num_steps"]): x["rows"] for x in found["cases"]}
    systems = (
        "chaotic",
        "sleigh",
        "CVT",
        "Suslov",
        "Suslov in a potential",
        "heavy top",
    )
    for name, *cells in rows_of(text, "adjoint", "chaotic"):
        rows = [cases[system, 10_000] for system in systems]
        measured = [x[name]["seconds"] / x["forward"]["seconds"] for x in rows]
        assert_agree(cells[:-1], measured)
        assert_agree(cells[-1:], [1e-6 * rows[0][name]["temp"]])
    for system, *cells in rows_of(text, "$N$", "100"):
        for steps, cell in zip((100, 1000, 10_000), cells, strict=True):
            error = cases[system, steps]["reversible"]["error"]
            assert (cell == "NaN") == (error is None)
            if error is not None:
                assert_agree([cell], [error])


def test_the_worst_ratios_of_closures_are_those_of_the_result():
    last = {}
    for row in results("closures")["rows"]:
        energy = row["energy_last"]
        last.setdefault((row["system"], row["stages"]), {})[row["closure"]] = (
            np.inf if energy is None else energy
        )
    worst = {
        closure: max(
            (energies[closure] / min(energies.values()), case)
            for case, energies in last.items()
        )
        for closure in ("symmetric", "consistent", "propagated")
    }
    pattern = (
        r"The largest ratio is (\S+) for `\"symmetric\"` \(the (.*?) at s = (\d)\), "
        r"(\S+) for `\"consistent\"` \(the (.*?) at s = (\d)\), and unbounded for "
        r"`\"propagated\"` \(the (.*?) at s = (\d) does not finish\)"
    )
    found = quoted(page("closures"), pattern)
    for closure, ratio, *case in (
        ("symmetric", *found[:3]),
        ("consistent", *found[3:6]),
        ("propagated", "inf", *found[6:]),
    ):
        assert worst[closure][1] == (case[0], int(case[1]))
        if ratio == "inf":
            assert np.isinf(worst[closure][0])
        else:
            assert_agree([ratio], [worst[closure][0]])


def test_what_invariants_cost_is_what_the_result_has():
    found = results("invariants")
    rows, text = found["rows"], page("invariants")
    kept = [row["energy"][1] for row in rows]
    pattern = (
        r"largest relative error is (\S+) \(.*?\), where plain runs have between (\S+) "
        r"\(Suslov's, s = 2, t = 1e5\) and (\S+)\. Constraints are violated by as "
        r"little as before, at most (\S+)\."
    )
    plain = [row["energy"][0] for row in rows]
    worst = max(rows, key=lambda row: row["energy"][0])
    assert (worst["stages"], worst["duration"]) == (2, 1e5)
    assert worst["system"].startswith("Suslov")
    violation = max(max(row["violation"]) for row in rows)
    measured = [max(kept), max(plain), min(plain), violation]
    assert_agree(quoted(text, pattern), measured)
    sweeps = [row["iterations"][1] - row["iterations"][0] for row in rows]
    pattern = r"Between ([\d.]+) sweeps a step more and ([\d.]+) fewer"
    assert_agree(quoted(text, pattern), [max(sweeps), -min(sweeps)])
    times = {}
    for row in rows:
        kind = "flat" if row["system"] in ("chaotic", "CVT") else "group"
        ratio = row["microseconds"][1] / row["microseconds"][0]
        times.setdefault(kind, []).append(ratio)
    pattern = (
        r"Time is ([\d.]+) to ([\d.]+) times .*? and at most ([\d.]+) times on groups"
    )
    measured = [min(times["flat"]), max(times["flat"]), max(times["group"])]
    assert_agree(quoted(text, pattern), measured)


def test_long_runs_of_machines_are_those_of_the_result():
    columns = ("dt", "duration", "first tenth", "all", "violation")
    rows = rows_of(page("machines"), "machine", "power of")
    for row, measured in zip(rows, results("long_runs")["rows"], strict=True):
        assert row[0].replace("`", "") == measured["machine"]
        assert row[1] == measured["power"]
        assert_agree(row[2:], [measured[column] for column in columns])


def test_forms_of_the_bicycle_are_those_of_the_result():
    flat, rotation, pose = results("bicycle_forms")["rows"]
    pattern = (
        r"the same to (\S+), and the error at dt = 0.02 s is half as large, (\S+) for "
        r"(\S+); but a step takes (\S+) and (\S+) µs instead of (\S+), the"
    )
    measured = [pose["accelerations"], rotation["error"], flat["error"]]
    measured += [x["step"] for x in (rotation, pose, flat)]
    assert_agree(quoted(page("machines"), pattern), measured)


def test_first_calls_of_models_from_sympy_are_those_of_the_result():
    rows = rows_of(page("sympy"), "model", "n")
    for row, measured in zip(rows, results("sympy_models")["rows"], strict=True):
        assert (row[0], row[2]) == (measured["model"], measured["kind"])
        by_hand, imported = map(min, zip(*measured["seconds"], strict=True))
        ratio = imported / by_hand
        assert_agree(row[3:], [by_hand, imported, ratio, measured["import"]])


# Systems of `benchmarks.acceptance` with random starts in steep potentials, or in a
# chart that a body may leave.
STEEP = ("Kepler", "Morse", "wall", "body, exponential")


def test_accepted_steps_are_as_near_to_solutions_as_the_result_has():
    kinds = [
        f"{x} {y}" for x in ("simplified", "newton") for y in ("residual", "violation")
    ]
    ordinary, steep = [], []
    for row in results("acceptance")["rows"]:
        (steep if row["system"] in STEEP else ordinary).append(row)
    largest = [
        max(row[k] or 0.0 for row in rows for k in kinds) for rows in (ordinary, steep)
    ]
    text = page("solvers")
    pattern = (
        r"has a residual or a violation above (\S+) of its scale\. Two of some "
        r"(\d+ \d+) ends differ from `Newton`'s by more than 1e-11 \((\S+) and (\S+)\)"
    )
    violation, ends, *distances = quoted(text, pattern)
    apart = [row["distance"] for row in ordinary if row["apart"]]
    assert_agree(distances, apart)
    assert len(apart) == sum(row["apart"] for row in ordinary) == 2
    assert_agree([violation], largest[:1])
    accepted = sum(row["simplified accepted"] for row in ordinary)
    assert accepted == pytest.approx(int(ends.replace(" ", "")), rel=0.05)
    assert_agree(
        quoted(text, r"potentials residuals reach (\S+), and four"), largest[1:]
    )
    assert sum(row["apart"] for row in steep) == 4


def test_steps_near_rest_are_judged_as_the_result_has():
    rows = results("near_rest")["rows"]
    text = page("solvers")
    systems = {row["system"] for row in rows}
    assert_agree(quoted(text, r"so far for (\d+) systems"), [len(systems)])
    assert sum(row["wrongly accepted"] for row in rows) == 0
    assert "Of the refused steps that were judged one was solved" in " ".join(
        text.split()
    )
    assert sum(row["wrongly refused"] for row in rows) == 1


def test_what_the_chart_in_the_middle_gains_is_what_the_result_has():
    energies = {}
    for row in results("charts")["rows"]:
        key = row["system"], row["retraction"], row["stages"]
        energies.setdefault(key, {})[row["chart"]] = row["energy"]
    gains = [
        energy["start"] / energy["middle"]
        for (system, _, stages), energy in energies.items()
        if system == "unicycle" and stages > 2
    ]
    pattern = r"over t = 1e4 is up to (\d+) times smaller"
    assert_agree(quoted(page("groups"), pattern), [max(gains)])
