"""Every figure has labelled axes and shows its data."""

import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib import pyplot as plt, rc_context, rcParams
from matplotlib.figure import Figure
from PIL import Image, ImageSequence

import nhjax
from nhjax import plot


pytestmark = pytest.mark.usefixtures("closed_figures")


@pytest.fixture(scope="module")
def disc():
    return nhjax.systems.VerticalRollingDisc()


def _run(example, y0):
    return nhjax.integrate(
        example.system,
        nhjax.LobattoIIIAB(2),
        y0,
        dt=0.1,
        num_steps=8,
        saveat=nhjax.SaveAt(t0=True, steps=True),
    )


@pytest.fixture(scope="module")
def sol(disc):
    return _run(disc, disc.initial_state())


@pytest.fixture(scope="module")
def batch(disc):
    y0 = jax.tree.map(lambda x: jnp.stack([x, x, x]), disc.initial_state())
    return jax.vmap(lambda y: _run(disc, y))(y0)


def test_plot_trajectory_draws_coordinates_with_labels(sol):
    ax = plot.trajectory(sol, (0, -1), names=("east", "heading"), color="k")
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("east", "heading")
    (line,) = ax.lines
    np.testing.assert_array_equal(line.get_ydata(), sol.ys.q[:, 3])
    assert line.get_color() == "k"


def test_plot_trajectory_of_three_coordinates_draws_in_space(sol):
    ax: Any = plot.trajectory(sol, (0, 1, 2))
    assert ax.get_zlabel() == "$q_3$"
    ax.figure.canvas.draw()
    limits = [ax.get_xlim(), ax.get_ylim(), ax.get_zlim()]
    sizes = np.ptp(limits, axis=1) / ax._box_aspect
    np.testing.assert_allclose(sizes, sizes[0])


def test_plot_trajectory_with_ground_draws_a_plane_inside_the_axes(sol):
    ax: Any = plot.trajectory(sol, (0, 1, 2), ground=-50.0)
    (_,) = ax.collections
    low, high = ax.get_zlim()
    assert low <= -50 < high
    with pytest.raises(ValueError, match="`ground` needs three coordinates"):
        plot.trajectory(sol, ground=0.0)


def test_plot_style_in_with_statement_is_restored():
    before = dict(rcParams)
    with plot.style(dark=True):
        figure, ax = plt.subplots()
        assert figure.get_facecolor() == (0, 0, 0, 0)
        assert ax.plot([0, 1])[0].get_color() == "#56B4E9"
        assert rcParams["text.color"] == "0.9"
    assert dict(rcParams) == before


def test_plot_style_as_function_lasts_until_its_context_is_closed():
    before = dict(rcParams)
    restoration = plot.style()
    try:
        assert rcParams["axes.grid"]
        assert plt.figure().subplots().plot([0, 1])[0].get_color() == "#0072B2"
    finally:
        restoration.close()
    assert dict(rcParams) == before


def test_plot_uses_the_style_only_for_figures_that_it_creates(disc, sol):
    before = dict(rcParams)
    assert plot.energy(disc.system, sol).lines[0].get_color() == "#0072B2"
    given = Figure().add_subplot()
    assert plot.energy(disc.system, sol, ax=given).lines[0].get_color() != "#0072B2"
    with rc_context({"lines.linewidth": 7.0}):
        assert plot.energy(disc.system, sol).lines[0].get_linewidth() == 7.0
    with plot.style(dark=True):
        assert plot.energy(disc.system, sol).lines[0].get_color() == "#56B4E9"
    assert dict(rcParams) == before


@pytest.mark.parametrize("kind", ["trajectory", "energy", "multiplier", "constraint"])
def test_plot_of_a_batch_draws_a_line_for_each_member(kind, disc, batch):
    given = Figure().add_subplot()
    if kind in ("energy", "constraint"):
        ax = getattr(plot, kind)(disc.system, batch, ax=given)
    else:
        ax = getattr(plot, kind)(batch, ax=given)
    assert ax is given
    # The disc has two constraints.
    assert len(ax.lines) == (6 if kind in ("multiplier", "constraint") else 3)
    assert ax.get_xlabel()
    assert ax.get_ylabel()


def test_plot_energy_draws_the_energy_error(disc, sol):
    ax = plot.energy(disc.system, sol)
    assert ax.get_xlabel() == "time $t$"
    assert ax.get_ylabel() == "$E(t) - E(t_0)$"
    np.testing.assert_array_equal(ax.lines[0].get_xdata(), sol.ts)


def test_plot_multiplier_draws_its_values(sol):
    ax = plot.multiplier(sol)
    assert ax.get_ylabel() == "multiplier"
    legend = ax.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.texts] == [
        r"$\lambda_1$",
        r"$\lambda_2$",
    ]


def test_plot_multiplier_without_constraints_raises():
    oscillator = nhjax.systems.HarmonicOscillator()
    free = _run(oscillator, oscillator.initial_state())
    with pytest.raises(ValueError, match="no constraints"):
        plot.multiplier(free)


def test_plot_convergence_draws_errors_and_reference_slope():
    h = np.array([0.4, 0.2, 0.1])
    errors = np.array([1e-2, 6e-4, 0.0])
    ax = plot.convergence(h, errors, order=4, label="s = 3")
    data, reference = ax.lines
    np.testing.assert_array_equal(data.get_xdata(), h[:2])
    x, y = np.asarray(reference.get_xdata()), np.asarray(reference.get_ydata())
    assert np.log2(y[0] / y[1]) == pytest.approx(4 * np.log2(x[0] / x[1]))
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    assert ax.get_xlabel()
    assert ax.get_ylabel()


def test_plot_with_invalid_argument_raises(sol):
    with pytest.raises(ValueError, match="two or three indices"):
        plot.trajectory(sol, (0,))
    with pytest.raises(ValueError, match="`names` must have 2"):
        plot.trajectory(sol, names=("x",))
    with pytest.raises(ValueError, match="vectors of the same length"):
        plot.convergence([0.1, 0.2], [1.0])
    with pytest.raises(ValueError, match="positive number"):
        plot.convergence([0.1], [0.0])


def test_plot_import_does_not_import_matplotlib():
    code = "import sys, nhjax, nhjax.plot; sys.exit('matplotlib' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


TIMES = np.array([0.0, 0.1, 0.5, 2.0])
SLIDER = {
    "hub": np.stack([TIMES, 0 * TIMES], axis=1),
    "end": np.stack([TIMES, 1 + TIMES], axis=1),
}


def in_space(points):
    return {
        name: np.concatenate([x, np.ones((*x.shape[:-1], 1))], axis=-1)
        for name, x in points.items()
    }


@pytest.mark.parametrize("spatial", [False, True])
def test_plot_animation_has_constant_frame_rate(tmp_path, spatial):
    wheel = np.array([[-1.0, 0.0], [0.0, 1.0], [1.0, 0.0]])
    points = SLIDER | {"wheel": SLIDER["hub"][:, None] + wheel}
    points = in_space(points) if spatial else points
    animation = plot.animate(
        TIMES, points, [("hub", "end")], traced=["end"], speed=0.5, frame_rate=5
    )
    animation.save(tmp_path / "motion.gif", dpi=20)
    with Image.open(tmp_path / "motion.gif") as picture:
        # Two seconds at half the speed, including the first and the last frame.
        assert picture.info["duration"] == 200
        assert len(list(ImageSequence.Iterator(picture))) == 21
    (ax,) = animation._fig.axes  # pyright: ignore[reportAttributeAccessIssue]
    body, rod, path = (
        np.stack(line.get_data_3d() if spatial else line.get_data(), axis=1)
        for line in ax.lines
    )
    np.testing.assert_allclose(body, points["wheel"][-1])
    np.testing.assert_allclose(rod, [points["hub"][-1], points["end"][-1]])
    # Positions are interpolated linearly between the saved times.
    assert path.shape == (21, 3 if spatial else 2)
    np.testing.assert_allclose(path[:, 0], np.linspace(0, 2, 21), atol=1e-15)
    np.testing.assert_allclose(path[:, 1], np.linspace(1, 3, 21), atol=1e-15)
    low, high = ax.get_xlim()
    assert low <= -1
    assert high >= 3


def test_plot_animation_backwards_in_time_follows_a_point(tmp_path):
    points = {name: x[::-1] for name, x in SLIDER.items()}
    ax = Figure().subplots()
    animation = plot.animate(
        TIMES[::-1], points, [("hub", "end")], follow="hub", frame_rate=2, ax=ax
    )
    animation.save(tmp_path / "motion.gif", dpi=20)
    x, y = map(np.asarray, ax.lines[0].get_data())
    np.testing.assert_allclose((x, y), [[0, 0], [0, 1]])
    # The end is up to three units from the hub, which stays in the centre.
    np.testing.assert_allclose(ax.get_xlim(), (-3.15, 3.15))
    np.testing.assert_allclose(ax.get_ylim(), (-3.15, 3.15))


@pytest.mark.parametrize("spatial", [False, True])
def test_plot_animation_fills_wheels_and_marks_their_rim(tmp_path, spatial):
    turn = 3 * TIMES
    spoke = 0.5 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    points = SLIDER | {"rim": SLIDER["hub"] + spoke}
    wheel = ("hub", "rim")
    if spatial:
        points = in_space(points)
        points["axle"], wheel = points["hub"] + [0, 0, 2.0], (*wheel, "axle")
    animation = plot.animate(TIMES, points, wheels=[wheel], ground=-0.5, frame_rate=1)
    animation.save(tmp_path / "motion.gif", dpi=20)
    show: Any = animation._func  # pyright: ignore[reportAttributeAccessIssue]
    outline, mark, filled = show(2)
    x = np.stack(outline.get_data_3d() if spatial else outline.get_data(), axis=1)
    hub = np.array([2.0, 0, 1])[: x.shape[1]]
    np.testing.assert_allclose(np.linalg.norm(x - hub, axis=1), 0.5)
    np.testing.assert_allclose(np.ptp(x[:, :2], axis=0), 1, rtol=1e-2)
    ends = np.stack(mark.get_data_3d() if spatial else mark.get_data(), axis=1)
    np.testing.assert_allclose(ends, [hub, points["rim"][-1]])
    if not spatial:
        np.testing.assert_allclose(filled.get_xy()[: len(x)], x)
    (ax,) = animation._fig.axes  # pyright: ignore[reportAttributeAccessIssue]
    # Units are equal on all axes, and the wheel stands on the ground.
    limits = [ax.get_xlim(), ax.get_ylim(), *([ax.get_zlim()] if spatial else [])]
    np.testing.assert_allclose(np.ptp(limits, axis=1), np.ptp(limits[0]))


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"wheels": [("hub", "head")]}, ValueError, "`wheels` must name points"),
        (
            {"wheels": [("hub",)]},
            ValueError,
            "`wheels` must have 2 names each: the hub",
        ),
        ({"ts": np.zeros((2, 4))}, ValueError, r"`ts` .* got shape \(2, 4\)"),
        ({"ts": [0, 2, 1, 3]}, ValueError, "`ts` must increase"),
        ({"ts": "now"}, TypeError, "`ts` must be an array of real numbers"),
        ({"points": {}}, TypeError, "`points` must be positions by name, .* got dict"),
        ({"points": {"a": np.ones((3, 2))}}, ValueError, r"shape \(4, 2\), .*\(3, 2\)"),
        ({"points": {"a": np.ones((4, 5))}}, ValueError, r"got shapes .*\(4, 5\)"),
        ({"points": {"hub": SLIDER["hub"] * np.nan}}, ValueError, r"`points\['hub'\]`"),
        ({"rods": [("hub", "head")]}, ValueError, "`rods` .* hub, end, got 'head'"),
        ({"rods": ["hub"]}, ValueError, r"got 'h'\. It is a list of chains"),
        ({"traced": ["head"]}, ValueError, "`traced` must name points"),
        ({"follow": "head"}, ValueError, "`follow` must name points"),
        ({"speed": 0.0}, ValueError, "`speed` and `frame_rate` must be positive"),
        ({"frame_rate": -1}, ValueError, "`speed` and `frame_rate` must be positive"),
    ],
)
def test_plot_animation_with_invalid_argument_raises(changes, error, message):
    with pytest.raises(error, match=message):
        plot.animate(**({"ts": TIMES, "points": SLIDER} | changes))


def test_plot_trajectory_takes_names_of_coordinates_and_labels_axes():
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * (v @ v), coordinates=("east", "north", "heading")
    )
    y0 = nhjax.initial_state(system, jnp.zeros(3), jnp.array([1.0, 2.0, 3.0]))
    saveat = nhjax.SaveAt(t0=True, steps=True)
    sol = nhjax.integrate(
        system, nhjax.Gauss(1), y0, dt=0.5, num_steps=4, saveat=saveat
    )
    ax = plot.trajectory(sol, ("heading", "east"))
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("heading", "east")
    (line,) = ax.lines
    np.testing.assert_allclose(np.asarray(line.get_xydata())[-1], [6.0, 2.0])
    assert plot.trajectory(sol, (0, 1), names=("x", "y")).get_xlabel() == "x"
    with pytest.raises(ValueError, match="has 'up', but the names are east, north"):
        plot.trajectory(sol, ("east", "up"))


def test_plot_trajectory_of_system_without_names_refuses_a_name(sol):
    with pytest.raises(ValueError, match="has 'x', but there are no names"):
        plot.trajectory(sol, ("x", 1))


def test_animation_of_flat_motion_in_space_has_a_flat_box(tmp_path):
    ts = np.linspace(0, 1, 5)
    flat = np.stack([ts, 0 * ts, 0.02 * ts], axis=1)
    animation = plot.animate(ts, {"a": flat}, traced=["a"], ground=0.0)
    animation.save(tmp_path / "motion.gif", dpi=20)
    (ax,) = animation._fig.axes  # pyright: ignore[reportAttributeAccessIssue]
    (x0, x1), (z0, z1) = ax.get_xlim(), ax.get_zlim()
    assert z1 - z0 == pytest.approx(0.5 * (x1 - x0))
    assert z0 <= 0.0 <= z1
