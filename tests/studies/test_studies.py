"""The studies run with tiny arguments, from Python and from the command line."""

import functools
import json
import math
import re
from pathlib import Path

import jax
import numpy as np
import pytest

import nhjax
from nhjax import studies
from nhjax.__main__ import main
from nhjax.studies import _chaotic_energy
from nhjax.systems import ChaoticSystem, NonholonomicParticle
from support.long import exhaustive_but


PNG = b"\x89PNG\r\n\x1a\n"

TINY = {
    "particle-order": "--stages 2 --dt 0.25 0.125",
    "cvt-energy": "--stages 2 --dt pi/10 --final-time 4",
    "chaotic-energy": "--stages 2 --dt 0.2 --num-steps 10 --members 2",
    "unicycle-order": "--stages 2 --dt 0.25 0.125",
    "ball-invariants": "--stages 2 --dt 0.4 0.2 --num-steps 20",
}


@pytest.fixture(scope="module")
def particle():
    return studies.particle_order(stages=(3, 4), dt=(0.25, 0.125, 0.1875))


@pytest.fixture(scope="module")
def chaotic():
    return studies.chaotic_energy(
        stages=(2, 3), final_time=4.0, members=3, dt=(0.1, 0.2), save_every=2
    )


@pytest.fixture(scope="module")
def ball():
    return studies.ball_invariants(stages=(2, 3), dt=(0.1, 0.2), num_steps=50)


def test_studies_list_prints_all_names(capsys):
    assert main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(studies.STUDIES)


@pytest.mark.parametrize(
    "study",
    exhaustive_but(["particle-order", "cvt-energy", "chaotic-energy"], studies.STUDIES),
)
def test_study_run_writes_figures_data_and_record(study, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["run", study, *TINY[study].split(), "--json", "--progress"]) == 0
    shown = capsys.readouterr()
    assert "100%" in shown.err
    record = json.loads(shown.out)
    out = Path("nhjax-results") / study
    assert json.loads((out / f"{study}.json").read_text()) == record
    assert record["study"] == study
    for name in ("nhjax", "jax", "jaxlib", "equinox", "numpy"):
        assert record["environment"]["versions"][name]
    assert record["environment"]["precision"] == "float64"
    assert record["environment"]["device"]["platform"]
    parameters = record["parameters"]
    for name in (
        "stages",
        "dt",
        "final_time",
        "closure",
        "initial_data",
        "stage_solver",
    ):
        assert parameters[name]
    assert parameters["closure"] == "propagated"
    for run in record["results"]["runs"]:
        assert run["compile_seconds"] > 0
        assert run["run_seconds"] > 0
    pictures = sorted(out.glob("*.png"))
    assert [str(p) for p in pictures] == sorted(record["files"]["figures"])
    for picture in pictures:
        assert picture.read_bytes()[:8] == PNG
        assert picture.stat().st_size > 10_000
    with np.load(out / f"{study}.npz") as data:
        assert len(data.files) > 0


def test_study_run_without_json_prints_plan_table_and_verdict(tmp_path, capsys):
    out = tmp_path / "deep" / "er"
    arguments = "--regimes high --stages 3 --dt 0.1 --num-steps 20 --epsilon 0.25"
    arguments += " --closure symmetric --short-time 1"
    assert main(["run", "cvt-energy", *arguments.split(), "--out", str(out)]) == 0
    shown = capsys.readouterr()
    assert shown.err == ""
    headline, options, seconds, _, header, ruler, row, *rest = shown.out.splitlines()
    assert headline.startswith("Compute the energies of the CVT")
    assert "stages 3, dt 0.1, final_time 2, closure symmetric" in options
    assert seconds == "About 5 seconds on two cores."
    _, verdict, *files = rest
    assert verdict.startswith("Verdict: the energy error ")
    assert "range of ΔE_d" in header
    assert set(ruler) == {"-", " "}
    assert row.split()[:3] == ["high", "3", "0.1"]
    assert [line.split()[0] for line in files] == ["wrote"] * 3
    assert all((out / Path(line.split()[1]).name).is_file() for line in files)
    parameters = json.loads((out / "cvt-energy.json").read_text())["parameters"]
    assert parameters["regimes"] == ["high"]
    assert parameters["epsilon"] == 0.25
    assert parameters["closure"] == "symmetric"
    assert parameters["final_time"] == 2.0
    assert parameters["short_time"] == 1.0


@pytest.mark.parametrize("study", studies.STUDIES)
def test_study_run_quick_is_smaller_and_options_override_it(
    study, monkeypatch, tmp_path, capsys
):
    asked = []

    @functools.wraps(studies.STUDIES[study])
    def recorded(**options):
        asked.append(options)
        raise studies.ArgumentError("dt", "is only recorded")

    monkeypatch.setattr("nhjax.__main__.STUDIES", {study: recorded})
    command = ["run", study, "--out", str(tmp_path), "--quick"]
    for more in ([], ["--closure", "symmetric", "--stages", "5"]):
        with pytest.raises(SystemExit):
            main([*command, *more])
    smaller = studies.QUICK[study]
    assert asked[0] == {"progress": False, **smaller}
    assert asked[1] == asked[0] | {"closure": "symmetric", "stages": [5]}

    def seconds(options):
        told = studies.plan(study, studies.STUDIES[study], options)
        return int(re.findall(r"About (\d+) seconds", told)[0])

    assert seconds(smaller) < seconds({}) < 90
    capsys.readouterr()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("run nonsense", "invalid choice: 'nonsense' (choose from"),
        ("run", "required: STUDY"),
        ("run chaotic-energy --members 0", "--members: must be at least 1, got 0"),
        ("run chaotic-energy --members x", "--members: invalid int value: 'x'"),
        ("run chaotic-energy --stages 1", "--stages: must be at least 2"),
        ("run chaotic-energy --stages 2 2", "--stages: holds a value twice: [2, 2]"),
        ("run chaotic-energy --dt 0.3", "--dt: 0.3 does not divide the final time 200"),
        ("run chaotic-energy --dt -0.1", "--dt: must be positive and finite, got -0.1"),
        ("run chaotic-energy --dt zero", "--dt: invalid number value: 'zero'"),
        ("run chaotic-energy --dt 1/0", "--dt: invalid number value: '1/0'"),
        ("run chaotic-energy --final-time 0", "--final-time: must be positive"),
        ("run chaotic-energy --num-steps 0", "--num-steps: must be at least 1"),
        ("run chaotic-energy --num-steps 5 --final-time 1", "not allowed with"),
        ("run chaotic-energy --times 300", "--times: must lie within the run, got 300"),
        (
            "run chaotic-energy --save-every 90",
            "--save-every: must leave at most 5 units of time between samples, but 90 "
            "steps of",
        ),
        ("run chaotic-energy --closure free", "--closure: invalid choice"),
        ("run cvt-energy --regimes middle", "--regimes: must be among"),
        ("run cvt-energy --epsilon -1", "--epsilon: must be at least 0"),
        ("run cvt-energy --dt 1 --num-steps 3", "--num-steps: must hold 5 steps"),
        (
            "run particle-order --system top",
            "--system: must be one of ['particle', 'sleigh'], got 'top'",
        ),
        ("run particle-order --dt 0.7", "--dt: 0.7 does not divide the final time 3"),
        (
            "run unicycle-order --retraction log",
            "--retraction: must be one of ['cayley', 'exponential'], got 'log'",
        ),
        ("run ball-invariants --retraction log", "--retraction: must be one of"),
        ("run ball-invariants --num-steps 4", "--num-steps: must be at least 5, got 4"),
        ("run ball-invariants --final-time 1", "unrecognized arguments: --final-time"),
        (
            "run ball-invariants --dt 0.1 0.3 --num-steps 10",
            "--dt: 0.3 does not divide",
        ),
    ],
)
def test_study_run_with_invalid_argument_names_it(arguments, message, tmp_path, capsys):
    command = arguments.split()
    if len(command) > 2:
        command += ["--out", str(tmp_path)]
    with pytest.raises(SystemExit) as ended:
        main(command)
    assert ended.value.code == 2
    assert message in capsys.readouterr().err


def test_study_run_of_unknown_name_lists_the_studies(capsys):
    with pytest.raises(SystemExit):
        main(["run", "nonsense"])
    message = capsys.readouterr().err
    assert all(name in message for name in studies.STUDIES)


def test_study_run_with_unusable_folder_names_the_option(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    command = ["run", "chaotic-energy", "--out", str(tmp_path / "file" / "x")]
    with pytest.raises(SystemExit) as ended:
        main(command)
    assert ended.value.code == 2
    assert "argument --out:" in capsys.readouterr().err


def test_study_run_with_unsolvable_step_exits_with_its_message(tmp_path, capsys):
    command = "run chaotic-energy --stages 4 --dt 4 --final-time 40 --members 1"
    assert main([*command.split(), "--out", str(tmp_path)]) == 1
    assert "Integration failed in all 2 members" in capsys.readouterr().err


def test_study_function_with_invalid_argument_raises_with_its_name():
    with pytest.raises(studies.ArgumentError, match="`members` must be at least 1"):
        studies.chaotic_energy(members=0)


def test_particle_order_observes_the_theoretical_orders(particle):
    assert particle.dt == (0.25, 0.1875, 0.125)
    assert particle.errors.shape == (2, 3, 4)
    np.testing.assert_allclose(
        particle.orders(), [[4, 4, 2, 4], [6, 6, 4, 6]], atol=0.15
    )
    assert np.all(np.isnan(particle.slopes()[:, 0]))
    assert "q, p, λ, λ_c agree with theory" in particle.verdict()
    assert (
        particle.table().splitlines()[-1].split()
        == (
            f"4 {particle.orders()[1, 0]:.2f} (6) {particle.orders()[1, 1]:.2f} (6) "
            f"{particle.orders()[1, 2]:.2f} (4) {particle.orders()[1, 3]:.2f} (6)"
        ).split()
    )


def test_particle_order_of_round_off_errors_is_undefined():
    errors = np.full((1, 3, 4), 1e-16)
    errors[0, 0] = 1.0
    result = studies.ParticleOrder(
        stages=(6,),
        dt=(0.4, 0.2, 0.1),
        final_time=1.0,
        closure="propagated",
        example=NonholonomicParticle(),
        errors=errors,
        timings=[],
    )
    assert np.all(np.isnan(result.orders()))
    assert result.verdict().startswith("no order can be observed")
    assert "-" in result.table().splitlines()[-1]


@pytest.mark.long
@pytest.mark.parametrize("retraction", ["cayley", "exponential"])
def test_unicycle_order_observes_the_theoretical_orders(retraction):
    result = studies.unicycle_order(
        stages=(2, 3), dt=(0.125, 0.0625), retraction=retraction
    )
    assert result.errors.shape == (2, 2, 5)
    np.testing.assert_allclose(
        result.orders(), [[2, 2, 2, 2, 2], [4, 4, 4, 2, 4]], atol=0.4
    )
    parameters = result.parameters()["system_parameters"]
    assert parameters["retraction"].lower() == retraction
    assert parameters["mass"] == 1.0
    (figure,) = result.figures().values()
    shown = [ax.get_ylabel() for ax in figure.axes]
    assert shown[:2] == ["relative error of $g$", "relative error of $v$"]


@pytest.mark.long
def test_ball_invariants_of_all_runs_are_conserved(ball):
    for run in ball.runs:
        assert run.integrals.shape == (51, 4)
        np.testing.assert_array_less(run.largest_linear_errors(), 3e-15)
        assert run.max_constraint_violation < 1e-14
        assert len(run.energy_by_fifths()) == 5
    assert re.search(r"conserved to \de-1[56]; the moving energy", ball.verdict())


@pytest.mark.long
def test_ball_invariants_observes_the_theoretical_orders(ball):
    assert ball.dt == (0.2, 0.1)
    assert ball.final_time == 5.0
    for s, order in ((2, 2), (3, 4)):
        assert np.isnan(ball.circle_slopes(s)[0])
        assert float(ball.circle_slopes(s)[1]) == pytest.approx(order, abs=0.15)
        # For even s, the moving energy of a homogeneous ball has an order above 2s - 2.
        assert float(ball.energy_slopes(s)[1]) == pytest.approx(4, abs=0.15)


@pytest.mark.long
def test_ball_invariants_writes_record_and_figures(ball):
    parameters = ball.parameters()
    assert parameters["last_times"] == [10.0, 5.0]
    assert parameters["system_parameters"]["frame"] == "space"
    assert parameters["system_parameters"]["moments"] == [0.4, 0.4, 0.4]
    assert ball.arrays()["s3_h0.1_positions"].shape == (51, 2)
    figures = ball.figures()
    assert list(figures) == ["ball-invariants-s2", "ball-invariants-s3"]
    assert all(len(figure.axes) == 4 for figure in figures.values())
    header = ball.table().splitlines()[0]
    assert "|Δ(ω_ζ)|" in header
    assert "|z-z_exact| t=5" in header


def test_chaotic_energy_observes_the_theoretical_slopes(chaotic):
    assert chaotic.times == (4.0,)
    data = chaotic.arrays()
    assert data["s2_h0.2_mu_error"].shape == (11,)
    assert data["s3_h0.1_mu"].shape == (21,)
    slopes = [float(chaotic.slopes(s)[1, 0]) for s in (2, 3)]
    np.testing.assert_allclose(slopes, [4, 8], atol=0.3)
    assert re.search(r"h\^[34]\.\d for s = 2 \(4\(s - 1\) = 4\)", chaotic.verdict())
    for run in chaotic.runs:
        assert run.max_constraint_violation < 1e-13


def test_chaotic_energy_in_chunks_equals_statistics_of_all_energies(monkeypatch):
    monkeypatch.setattr(_chaotic_energy, "CHUNK", 3)
    options = {"stages": (2,), "dt": (0.2,), "final_time": 4.0, "times": (2.0, 4.0)}
    (run,) = studies.chaotic_energy(members=7, **options).runs
    chaotic = ChaoticSystem()
    q0, v0 = chaotic.ensemble(7)

    def energies(q, v):
        sol = nhjax.integrate(
            chaotic.system,
            nhjax.LobattoIIIAB(2, "propagated"),
            nhjax.initial_state(chaotic.system, q, v),
            dt=0.2,
            num_steps=20,
            saveat=nhjax.SaveAt(t0=True, steps=True, fn=chaotic.system.energy),
        )
        return sol.ts, sol.ys

    times, found = jax.jit(jax.vmap(energies))(q0, v0)
    squares = np.asarray((found - found[:, :1]) ** 2)
    np.testing.assert_allclose(run.times, times[0], rtol=1e-15)
    # The errors are themselves differences of energies.
    np.testing.assert_allclose(run.mu, squares.mean(axis=0), rtol=1e-8, atol=1e-17)
    error = squares.std(axis=0, ddof=1) / np.sqrt(8)
    np.testing.assert_allclose(run.mu_error, error, rtol=1e-8, atol=1e-17)
    # Both windows contain all times.
    windows = squares.mean(axis=1)
    np.testing.assert_allclose(run.windows, [windows.mean()] * 2, rtol=1e-8)
    error = windows.std(ddof=1) / np.sqrt(8)
    np.testing.assert_allclose(run.windows_error, [error] * 2, rtol=1e-8)


def test_chaotic_energy_figure_shows_both_normalisations(chaotic):
    (figure,) = chaotic.figures().values()
    shown = [ax.get_ylabel() for ax in figure.axes]
    assert shown == [rf"$\mu(E, k) / h^{{{power}}}$" for power in (4, 8, 4, 10)]


def test_cvt_energy_of_a_short_run_measures_parts_and_growth():
    result = studies.cvt_energy(dt=(0.1,), final_time=10.0, short_time=5.0)
    low, high = result.runs
    assert low.energies.shape == (101, 3)
    np.testing.assert_allclose(low.energies[0], [1.8, 0.8, 1.0], atol=1e-14)
    np.testing.assert_allclose(high.energies[0], [4.0, 3.0, 1.0], atol=1e-14)
    np.testing.assert_allclose(
        low.energies[:, 0], low.energies[:, 1] + low.energies[:, 2], atol=1e-14
    )
    assert len(low.by_fifths()) == 5
    assert "the energy error grows after the first fifth in: low" in result.verdict()
    least, greatest = high.ranges()["driver"]
    assert least == pytest.approx(-5.3e-3, rel=0.02)
    assert greatest == pytest.approx(1.26e-2, rel=0.02)


def test_cvt_energy_with_fractional_number_of_steps_rounds_it():
    result = studies.cvt_energy(
        regimes=("low",), dt=(math.pi / 10,), final_time=4.0, short_time=1.0
    )
    assert len(result.runs[0].times) == 1 + round(40 / math.pi)


def test_envelope_of_oscillation_with_nan_bounds_all_finite_values():
    times = np.linspace(0.0, 1.0, 1003)
    values = np.sin(300.0 * times)
    values[500] = np.nan
    middles, low, high = studies.envelope(times, values, 10)
    bins = np.array_split(values, 10)
    assert np.all(np.diff(middles) > 0)
    np.testing.assert_allclose(low, [np.nanmin(x) for x in bins], atol=0.2)
    assert (low.min(), high.max()) == (np.nanmin(values), np.nanmax(values))
    assert np.all(low <= high)
