"""README keeps its word: its code runs as printed, its commands are the CI's, and its
figures are those of the committed results of the benchmarks.
"""

import re

import pytest

from support.pages import assert_agree, blocks, page, quoted, results, ROOT, rows_of


README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.usefixtures("closed_figures")
def test_readme_python_blocks_run_as_printed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace = {}
    for block in blocks(README, "python"):
        exec(compile(block, "README.md", "exec"), namespace)
    assert namespace["sol"].ys.q.shape == (1001, 3)
    assert namespace["sol"].stats["max_constraint_violation"] < 1e-13
    assert namespace["energies"].shape == (100,)
    assert namespace["slope"] > 0
    assert (tmp_path / "energy.png").stat().st_size > 0


def test_readme_commands_are_run_by_continuous_integration():
    commands = [line for block in blocks(README, "bash") for line in block.splitlines()]
    assert commands[-1].startswith("pytest")
    run = (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()
    for command in commands:
        assert command in run
    assert run[-1] == commands[-1]


def test_readme_linked_files_exist():
    for target in re.findall(r"\]\(([^)#:]+)\)|`(notebooks/[^`]+)`", README):
        assert (ROOT / (target[0] or target[1])).is_file()


def claims(start):
    """The claims of the paper in the committed results that begin with some words."""
    parts = results("verdicts")["claims"].values()
    found = [x for part in parts for x in part if x["claim"].startswith(start)]
    assert found
    return found


def test_readme_constraint_violation_agrees_with_the_result():
    (claim,) = claims("Φ = 0 holds at the nodes")
    (measured,) = re.findall(r": (\S+)$", claim["measured"])
    members, time, printed = quoted(
        README, "violation of {} members … over t = {} is {}. If"
    )
    assert f"over {members} members" in claim["measured"]
    assert f"t <= {float(time):g}:" in claim["measured"]
    assert float(printed) == float(measured)


def test_readme_ratios_to_other_libraries_agree_with_the_result():
    (case,) = (
        case
        for case in results("work_precision")["cases"]
        if (case["name"], case["members"], case["t"]) == ("chaotic", 101, 20.0)
    )
    errors = quoted(README, "for errors of {}, {} and {} at t = 20")
    assert [float(x) for x in errors] == [x["accuracy"] for x in case["contest"]]
    best = [x["best"] for x in case["contest"]]
    faster = quoted(README, "{}, {} and {} times faster than diffrax")
    assert_agree(faster, [1 / x["diffrax"]["ratio_seconds"] for x in best])
    slower = quoted(README, "{}, {} and {} times slower than heyoka")
    assert_agree(slower, [x["heyoka"]["ratio_seconds"] for x in best])


def test_readme_ensemble_memory_agrees_with_the_result():
    rows = results("ensembles")["rows"]
    million = next(row for row in rows if row["members"] == 1_000_000)
    steps, memory = quoted(README, "A million members of {} steps take {} MB")
    assert int(steps) == million["num_steps"]
    assert_agree([memory], [million["megabytes"]])


def test_readme_bicycle_eigenvalues_agree_with_the_machines_page():
    sentence = "eigenvalues to {} ([`docs/machines"
    (measured,) = quoted(page("machines"), "eigenvalues {};")
    assert_agree(quoted(README, sentence), [float(measured)])


def test_readme_verdicts_agree_with_the_result():
    verdicts = dict(rows_of(README, "claim of the paper"))
    starts = {
        "q and p are of order": ["NonholonomicParticle", "Unicycle"],
        "CVT: erratic": ["At h = π/10", "At h = 1/10"],
        "chaotic ensemble: the energy error": ["The energy follows a random walk"],
        "its mean square is proportional": ["μ(E) goes as h^4", "μ(E) goes as h^10"],
        "no gain over SPARK and DLA": ["No gain over SPARK and DLA"],
        "ball on a turntable": ["The three linear", "The moving energy"],
    }
    assert len(verdicts) == len(starts)
    for beginning, claimed in starts.items():
        (verdict,) = (x for claim, x in verdicts.items() if claim.startswith(beginning))
        for start in claimed:
            for claim in claims(start):
                assert claim["verdict"] in verdict
    # The figures in them.
    runs = [x for x in results("verdicts")["chaotic"] if x["method"] == "propagated"]
    alpha = [run["alpha"] for run in runs]
    least, most = quoted(README, "mean square ∝ t^{} to t^{} up to t = 1e4")
    assert_agree([least, most], [min(alpha), max(alpha)])
    ratios = [
        [float(x) for x in pair]
        for claim in claims("No gain over SPARK and DLA")
        for pair in re.findall(r"([\d.]+) ± [\d.]+ / ([\d.]+) ±", claim["measured"])
    ]
    early, late = zip(*ratios, strict=True)
    printed = quoted(
        README,
        "{} to {} times their mean square early, {} to {}",
    )
    assert_agree(printed, [min(early), max(early), min(late), max(late)])
