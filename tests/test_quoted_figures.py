"""Figures that pages quote agree with the committed results of the benchmarks."""

import re

import numpy as np
import pytest

from benchmarks.acceptance import JUDGEMENTS
from benchmarks.near_rest import examples
from nhjax._numerics import NOISE_UNITS
from support.pages import assert_agree, page, quoted, results, ROOT, rows_of


@pytest.mark.parametrize(
    ("printed", "value"), [("0.72", 0.7249), ("9e-16", 8.6e-16), ("600", 598.0)]
)
def test_quoted_figure_that_is_rounded_agrees_with_its_value(printed, value):
    assert_agree([printed], [value])


@pytest.mark.parametrize(
    ("printed", "value"), [("0.72", 0.7251), ("9e-16", 9.6e-16), ("60", 55.0)]
)
def test_quoted_figure_of_another_value_does_not_agree(printed, value):
    with pytest.raises(AssertionError):
        assert_agree([printed], [value])


def test_quoted_figure_found_twice_raises():
    with pytest.raises(AssertionError, match="found 2 times"):
        quoted("3 s and\n4 s", "{} s")


FRONT = {
    "README": (ROOT / "README.md").read_text(encoding="utf-8"),
    "index": page("index"),
}


@pytest.mark.parametrize("text", FRONT.values(), ids=FRONT)
def test_front_constraint_violation_agrees_with_the_result(text):
    claims = [x for part in results("verdicts")["claims"].values() for x in part]
    start = "Φ = 0 holds at the nodes"
    (claim,) = (x for x in claims if x["claim"].startswith(start))
    (measured,) = re.findall(r": (\S+)$", claim["measured"])
    members, time, printed = quoted(
        text,
        "({} trajectories up to t = {}), the largest violation of the constraint is {}",
    )
    assert f"over {members} members" in claim["measured"]
    assert f"t <= {float(time):g}:" in claim["measured"]
    assert float(printed) == float(measured)


@pytest.mark.parametrize("text", FRONT.values(), ids=FRONT)
def test_front_ratios_to_other_libraries_agree_with_the_result(text):
    (case,) = (
        case
        for case in results("work_precision")["cases"]
        if (case["name"], case["members"], case["t"]) == ("chaotic", 101, 20.0)
    )
    best = [x["best"] for x in case["contest"]]
    for library in ("diffrax", "heyoka"):
        ratios = [x[library]["ratio_seconds"] for x in best]
        printed = quoted(text, f"{{}} to {{}} times as long as {library}")
        assert_agree(printed, [min(ratios), max(ratios)])


def test_front_ensemble_memory_agrees_with_the_result():
    rows = results("ensembles")["rows"]
    million = next(row for row in rows if row["members"] == 1_000_000)
    sentence = "A million members of {} steps take {} MB"
    steps, memory = quoted(FRONT["index"], sentence)
    assert int(steps) == million["num_steps"]
    assert_agree([memory], [million["megabytes"]])


def test_front_bicycle_eigenvalues_agree_with_the_machines_page():
    (measured,) = quoted(page("machines"), "eigenvalues {};")
    printed = quoted(FRONT["README"], "eigenvalues to {} from the Lagrangian")
    assert_agree(printed, [float(measured)])


# The columns of the contest with others: members, and the library.
COLUMNS = [(1, "diffrax"), (1, "heyoka"), (101, "diffrax"), (101, "heyoka")]


def test_contest_ratios_quoted_agree_with_the_result():
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


def test_times_on_accelerator_quoted_agree_with_the_result():
    measured = {
        (row["name"], row["members"]): (row["accelerator"], row["cpu"])
        for row in results("accelerators")["rows"]
        if row["dtype"] == "float64"
    }
    rows = rows_of(page("performance"), "ensemble", "members")
    assert len(rows) == 6
    for name, members, *times in rows:
        assert_agree(times, measured[name, int(members)])


def test_floor_times_quoted_agree_with_the_result():
    one, many = results("floor")["rows"]
    text = page("performance")
    single, batch = rows_of(text, "chaotic system, n = 7, s = 3, h = 0.1")
    alone, scalar = one["micros"]["one core"], one["micros"]["C++, 1"]
    assert_agree([single[1], single[3]], [alone, alone / scalar])
    assert_agree(quoted(single[2], "{} (scalar)"), [scalar])
    ours, vectors = many["micros"]["one core"], many["micros"]["C++, 8"]
    assert_agree([batch[1], batch[3]], [ours, ours / vectors])
    assert_agree(quoted(batch[2], "{} (8"), [vectors])
    both = many["micros"]["all cores"]
    sentence = (
        "On both cores, nhjax takes {} µs per step and member for the 1000 members, "
        "and is {} times as fast"
    )
    assert_agree(quoted(text, sentence), [both, ours / both])


def test_programs_of_others_quoted_agree_with_the_result():
    rows = {row["program"]: row for row in results("lanes_for_others")["rows"]}
    table = rows_of(page("engines"), "program", "members")
    assert [name for name, *_ in table] == list(rows)
    for name, members, engine, *printed in table:
        row = rows[name]
        assert (members, engine) == (str(row["members"] or 1), row["engine"])
        by_jax, by_nhjax = row["seconds"]
        assert_agree(printed, [1e3 * by_jax, 1e3 * by_nhjax, row["ratio"]])


def test_engine_ratios_quoted_agree_with_the_result():
    rows = results("engines")["rows"]
    ratios = {row["system"]: row["ratio"] for row in rows}
    compiled = [row["compile"][1] / row["compile"][0] for row in rows]
    text = page("performance")
    sentence = "state at the end is returned, this ratio is {} to {} on the {} systems"
    measured = [min(ratios.values()), max(ratios.values()), len(ratios)]
    assert_agree(quoted(text, sentence), measured)
    sentence = "The ratio of the compile times is {} to {}."
    assert_agree(quoted(text, sentence), [min(compiled), max(compiled)])


def test_growth_with_coordinates_quoted_agrees_with_the_result():
    sentence = "On the chaotic system with 7 to 101 coordinates, the cost grows as n^{}"
    fitted = results("scaling")["n"]["step"]["fitted"]
    assert_agree(quoted(page("performance"), sentence), [fitted])


def test_growth_of_costs_quoted_agrees_with_the_result():
    found = results("scaling")
    points = {
        axis: {x["size"]: x for x in found[axis]["rows"]}
        for axis in ("n", "k", "chain", "star")
    }
    for axis, heading in (("n", "coordinates"), ("k", "constraints")):
        rows = rows_of(page("when_not"), heading, "step [µs]")
        for size, *cells in rows:
            point = points[axis][int(size)]
            assert_agree(cells, [point["step"], point["compile"]])
    *rows, last = rows_of(page("performance"), "constraints", "chain", "star")
    for size, *cells in rows:
        steps = [points[axis][int(size)]["step"] for axis in ("chain", "star")]
        assert_agree(cells, steps)
    fitted = [found[axis]["step"]["fitted"] for axis in ("chain", "star")]
    assert_agree(last[1:], fitted)
    sentence = "from {} to {} µs in a chain, and from {} to {} µs in a star"
    printed = quoted(page("when_not"), sentence)
    ends = [points[axis][k]["step"] for axis in ("chain", "star") for k in (10, 100)]
    assert_agree(printed, ends)


def test_first_calls_of_the_bicycle_quoted_agree_with_the_result():
    rows = {row["machine"]: row for row in results("machines")["rows"]}
    row = rows["WhippleBicycle"]
    sentence = "the first call takes {} s for a run and {} s for its gradient"
    assert_agree(quoted(page("when_not"), sentence), [row["run"], row["gradient"]])


def test_ensemble_costs_quoted_agree_with_the_result():
    found = results("ensembles")
    text = page("ensembles")
    million = next(row for row in found["rows"] if row["members"] == 1_000_000)
    sentence = (
        "a million members with {} steps each computed a mean and a variance. Per "
        "member and step it took {} times as long as `jax.vmap` without statistics. "
        "It needed {} MB of memory, as much as an ensemble of ten thousand"
    )
    steps, ratio, memory = quoted(text, sentence)
    assert int(steps) == million["num_steps"]
    assert_agree([ratio, memory], [million["ratio"], million["megabytes"]])
    assert_agree([memory], [found["rows"][0]["megabytes"]])
    one, two = (np.array(found["processes"][k])[:, 1] for k in ("one", "two"))
    sentence = (
        "{} members of 1000 steps were computed by one process and by two …. Each of "
        "the two processes needs {} times the processor time of the single process "
        "(the median of {} pairs of runs, from {} to {})"
    )
    members, median, pairs, least, most = quoted(text, sentence)
    assert int(members.replace(" ", "")) == found["processes"]["members"]
    assert int(pairs) == len(one)
    ratios = two / one
    assert_agree([median, least, most], [np.median(ratios), min(ratios), max(ratios)])


def test_gradient_costs_quoted_agree_with_the_result():
    found = results("gradients")
    text = page("derivatives")
    times = [row[1] for row in rows_of(text, "derivative", "time")]
    assert_agree(times, list(found["modes"].values())[1:])
    batch = found["batch"]["batch of gradients"] / found["batch"]["gradient"]
    assert_agree(quoted(text, "takes the time of {} single gradients"), [batch])
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


def test_closure_worst_ratios_quoted_agree_with_the_result():
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
    sentence = (
        'The largest of these ratios is {} for `"symmetric"` (the %s at s = %d), '
        '{} for `"consistent"` (the %s at s = %d), and unbounded for '
        '`"propagated"` (the %s at s = %d does not finish)'
    )
    cases = [part for _, case in worst.values() for part in case]
    symmetric, consistent, propagated = (ratio for ratio, _ in worst.values())
    assert np.isinf(propagated)
    ratios = quoted(page("closures"), sentence % tuple(cases))
    assert_agree(ratios, [symmetric, consistent])


def test_invariant_costs_and_errors_quoted_agree_with_the_result():
    found = results("invariants")
    rows, text = found["rows"], page("invariants")
    kept = [row["energy"][1] for row in rows]
    sentence = (
        "largest relative error is {} (…). In plain runs it is between {} and {}; {} "
        "occurs for Suslov's problem in a potential with s = 2, t = 1e5. Constraints "
        "are violated by at most {}, as in plain runs."
    )
    plain = [row["energy"][0] for row in rows]
    worst = max(rows, key=lambda row: row["energy"][0])
    assert (worst["stages"], worst["duration"]) == (2, 1e5)
    assert worst["system"].startswith("Suslov")
    violation = max(max(row["violation"]) for row in rows)
    measured = [max(kept), min(plain), max(plain), max(plain), violation]
    assert_agree(quoted(text, sentence), measured)
    sweeps = [row["iterations"][1] - row["iterations"][0] for row in rows]
    sentence = "A step takes between {} sweeps fewer and {} sweeps more"
    assert_agree(quoted(text, sentence), [-min(sweeps), max(sweeps)])
    times = {}
    for row in rows:
        kind = "flat" if row["system"] in ("chaotic", "CVT") else "group"
        ratio = row["microseconds"][1] / row["microseconds"][0]
        times.setdefault(kind, []).append(ratio)
    sentence = "The time is {} to {} times … and at most {} times on groups"
    measured = [min(times["flat"]), max(times["flat"]), max(times["group"])]
    assert_agree(quoted(text, sentence), measured)


def test_long_runs_of_machines_quoted_agree_with_the_result():
    columns = ("dt", "duration", "first tenth", "all", "violation")
    rows = rows_of(page("machines"), "machine", "power of")
    for row, measured in zip(rows, results("long_runs")["rows"], strict=True):
        assert row[0].replace("`", "") == measured["machine"]
        assert row[1] == measured["power"]
        assert_agree(row[2:], [measured[column] for column in columns])


def test_sympy_first_call_times_quoted_agree_with_the_result():
    rows = rows_of(page("sympy"), "model", "n")
    for row, measured in zip(rows, results("sympy_models")["rows"], strict=True):
        assert (row[0], row[2]) == (measured["model"], measured["kind"])
        by_hand, imported = map(min, zip(*measured["seconds"], strict=True))
        ratio = imported / by_hand
        assert_agree(row[3:], [by_hand, imported, ratio, measured["import"]])


def test_accepted_step_errors_quoted_agree_with_the_result():
    rows = results("acceptance")["rows"]
    kinds = [
        f"{x} {y}" for x in ("simplified", "newton") for y in ("residual", "violation")
    ]

    def largest(kinds):
        return max(row[k] or 0.0 for row in rows for k in kinds)

    text = page("solvers")
    assert_agree(quoted(text, "or a violation above {} of its scale"), [largest(kinds)])
    newton = quoted(text, "With `Newton` the largest is {}.")
    assert_agree(newton, [largest(kinds[2:])])
    doubtful = [row["doubtful"] for row in rows if row.get("doubtful")]
    count = {key: sum(row[key] for row in doubtful) for key in JUDGEMENTS}
    number, accepted = quoted(text, "Of about {} accepted steps, {} are doubtful")[::-1]
    assert int(number) == sum(count.values())
    found = sum(row["simplified accepted"] + row["newton accepted"] for row in rows)
    assert int(accepted.replace(" ", "")) == pytest.approx(found, rel=0.01)
    sentence = (
        "For {} steps, the distance between the two states is at most {} times this"
    )
    floor = [count["at the floor"], NOISE_UNITS]
    assert_agree(quoted(text, sentence), floor)
    sentence = "In {} steps both solvers solve the equations and find two different"
    assert_agree(quoted(text, sentence), [count["two solutions"]])
    sentence = "{} steps have a nearly singular Jacobian"
    assert_agree(quoted(text, sentence), [count["nearly singular"]])
    sentence = "In {} steps the coordinates are so large"
    assert_agree(quoted(text, sentence), [count["overflow"]])
    assert count["wrong"] == 0
    least = min(row["least h"] for row in doubtful)
    assert_agree(quoted(text, "their step sizes are {} and more"), [least])


def test_steps_near_rest_quoted_agree_with_the_result():
    rows = results("near_rest")["rows"]
    text = page("solvers")

    def total(key):
        return sum(row[key] for row in rows)

    judged = {(row["system"], row["stages"]) for row in rows}
    names = {name for name, _ in judged}
    assert judged == {(name, s) for name in names for s in range(2, 7)}
    assert set(examples()) == names
    assert_agree(quoted(text, "For all {} systems"), [len(names)])
    counts = [total(f"{x} judged") for x in ("refused", "accepted")]
    assert_agree(
        quoted(
            text,
            "benchmark judges all {} refused steps and a sample of {} accepted steps",
        ),
        counts,
    )
    assert total("wrongly refused") == total("wrongly accepted") == 0
    key = "smallest distance refused"
    closest = min((x for x in rows if x[key] is not None), key=lambda row: row[key])
    assert closest["system"] == "CarWithTrailers"
    assert_agree(quoted(text, "The closest is {} units"), [closest[key]])
    doubtful = [x for x in rows if x["doubtful"]]
    assert {x["system"] for x in doubtful} == {"Rattleback"}
    assert {(x["solver"], x["scale"]) for x in doubtful} == {("simplified", 1e-8)}
    assert_agree(quoted(text, "except {} steps of the"), [total("doubtful")])
    distances = [x["largest distance accepted"] for x in rows if not x["doubtful"]]
    assert_agree(quoted(text, "at most {} units of round-off"), [max(distances)])
    slowest = max(rows, key=lambda row: row["most iterations"])
    assert (slowest["system"], slowest["solver"]) == ("FlyballGovernor", "simplified")
    sentence = "slowest accepted step takes {} iterations of `SimplifiedNewton`"
    assert_agree(quoted(text, sentence), [slowest["most iterations"]])


def test_chart_in_the_middle_gains_quoted_agree_with_the_result():
    energies = {}
    for row in results("charts")["rows"]:
        key = row["system"], row["retraction"], row["stages"]
        energies.setdefault(key, {})[row["chart"]] = row["energy"]
    gains = [
        energy["start"] / energy["middle"]
        for (system, _, stages), energy in energies.items()
        if system == "unicycle" and stages > 2
    ]
    sentence = "over t = 1e4 is up to {} times smaller"
    assert_agree(quoted(page("groups"), sentence), [max(gains)])


def test_robots_quoted_agree_with_the_result():
    found, text = results("robots"), page("robots")
    rows = rows_of(text, "program, step", "largest slip [m/s]")
    for (name, *cells), (measured, row) in zip(
        rows, found["contacts"].items(), strict=True
    ):
        assert name == measured
        change = max(map(abs, row["energy"]))
        assert_agree(cells, [max(row["slip"]), change, row["seconds"]])
    for (_, *cells), key in zip(
        rows_of(text, "model", "read"), ("file", "hand"), strict=True
    ):
        row = found["first_call"][key]
        measured = [row[x] for x in ("load", "state", "run", "again", "megabytes")]
        assert_agree(cells, measured)
    ratio = quoted(
        text,
        "A run of {} mecanum platforms by `jax.vmap` takes {} times as long as a run "
        "of one platform.",
    )
    ensemble = found["ensemble"]
    assert_agree(ratio, [ensemble["members"], ensemble["ratio"]])
    sentence = "agrees with central differences to {}"
    assert_agree(quoted(text, sentence), [found["gradient"]["apart"]])


def test_cost_of_redundant_constraints_quoted_agrees_with_the_result():
    found = results("redundant")
    sentence = "with three cranks takes {} times as long as a step with two cranks"
    assert_agree(quoted(page("systems"), sentence), [found["ratio"]])
    sentence = (
        "takes {} s for its first state and {} s for its first run, and then {} µs"
    )
    cart = found["cart"]
    measured = [cart["state"], cart["run"], 1e6 * cart["step"]]
    assert_agree(quoted(page("robots"), sentence), measured)


def test_limits_of_adapting_quoted_agree_with_the_result():
    found, text = results("adaptive_steps"), page("step_sizes")
    limits = {row["case"]: row["cancelling"] for row in found["limits"]}

    def at_error(case, method, error, what="steps"):
        runs = [x for x in found["rows"] if (x["case"], x["method"]) == (case, method)]
        known = sorted((x["error"], x[what]) for x in runs if x["error"] is not None)
        errors, counts = np.log(np.array(known).T)
        assert errors[0] <= np.log(error) <= errors[-1]
        return np.exp(np.interp(np.log(error), errors, counts))

    def ratio(case, method, error, what="steps"):
        ours, constant = (at_error(case, x, error, what) for x in (method, "constant"))
        return ours / constant

    for label, least, taken in rows_of(text, "motion", "least number"):
        case, error = label.split(", error ")
        assert_agree([least], [limits[case]])
        assert_agree([taken], [ratio(case, "PID", float(error))])
    sentence = "needs {} times the number of constant steps for an error of 1e-6"
    stone = ratio("rattleback that reverses", "reversible", 1e-6)
    assert_agree(quoted(text, sentence), [stone])
    smooth = [
        ratio(case, "PID", error, "seconds")
        for case in ("particle", "chaotic", "CVT")
        for error in (1e-6, 1e-8)
    ]
    times = quoted(text, "a run with `PIDController` takes {} to {} times as long")
    assert_agree(times, [min(smooth), max(smooth)])
    chaotic = next(row for row in found["limits"] if row["case"] == "chaotic")
    percent = quoted(text, "for the chaotic system it is {} percent")
    assert_agree(percent, [100 * chaotic["cancellation"]])
    rows = rows_of(text, "steps over 1000 s", "number")
    assert len(rows) == 3
    for row in rows:
        assert list(row) in found["rattleback"]


def test_errors_over_tolerance_quoted_agree_with_the_result():
    found, text = results("adaptive_steps"), page("step_sizes")
    ours = [float(x) for line in found["tolerances"] for x in line[1:]]
    sentence = "the median error at the end was {} times `rtol`"
    assert_agree(quoted(text, sentence), [np.median(ours)])
    sentence = "ten of `rtol` for {} percent of the runs, and up to {} times `rtol`"

    def percent_within_ten(ratios):
        return 100 * np.mean([0.1 <= x <= 10 for x in ratios])

    assert_agree(quoted(text, sentence), [percent_within_ten(ours), max(ours)])
    rows = [row for row in found["rows"] if row["error"] is not None]
    shared = {row["case"] for row in rows if row["method"] == "diffrax Dopri8"}
    assert len(shared) == 6
    by_library = [
        percent_within_ten(
            row["error"] / row["setting"]
            for row in rows
            if row["case"] in shared and row["method"] == method
        )
        for method in ("PID", "diffrax Dopri8", "IDA, evaluations")
    ]
    sentence = (
        "for {} percent of the runs of nhjax, for {} percent of the runs of diffrax, "
        "and for {} percent of the runs of SUNDIALS IDA"
    )
    assert_agree(quoted(text, sentence), by_library)


def test_parts_of_first_calls_quoted_agree_with_the_result():
    stored = {
        (row["kind"], str(row["stages"])): row
        for row in results("compile_time")["rows"]
        if row["system"] == "bicycle"
    }
    for kind, stages, *cells in rows_of(page("performance"), "call", "stages", "trace"):
        row = stored[kind, stages]
        trace, lower, _ = row["seconds"]
        llvm, total = row["llvm"], sum(row["seconds"])
        assert_agree(cells, [trace, lower - llvm, llvm, total])


def test_times_with_the_full_jacobian_quoted_agree_with_the_result():
    found, text = results("iterations"), page("solvers")
    (row,) = (
        x for x in found["rows"] if (x["name"], x["stages"]) == ("bicycle, 4.6 m/s", 3)
    )
    full, default = row["full"], row["default"]
    more = full["first_call"] - default["first_call"]
    sentence = (
        "takes {} µs with the full Jacobian and {} µs with the default one, but the "
        "first call takes {} s longer"
    )
    assert_agree(quoted(text, sentence), [full["us"], default["us"], more])
    sentence = (
        "takes {} times as long as with the default one for the bicycle, {} times for "
        "the four-bar linkage, {} times for the torus and {} times for the rattleback"
    )
    ratios = {
        x["name"]: x["full"]["single"] / x["default"]["single"] for x in found["errors"]
    }
    names = "bicycle, 4.6 m/s", "FourBar", "RollingTorus", "Rattleback"
    assert_agree(quoted(text, sentence), [ratios[name] for name in names])


def test_times_of_first_calls_agree_with_the_result():
    stored = {
        f"{row['system']}, {row['kind']}": row
        for row in results("compile_time")["rows"]
        if row["stages"] == 3
    }
    rows = rows_of(page("first_calls"), "call", "first call", "later calls")
    assert [row[0] for row in rows] == list(stored)
    for name, first, following in rows:
        row = stored[name]
        assert_agree(quoted(first, "{} s"), [sum(row["seconds"])])
        assert_agree(quoted(following, "{} ms"), [1e3 * row["later"]])
