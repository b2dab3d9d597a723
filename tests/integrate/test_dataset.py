"""Solutions as data sets of xarray: names, axes, labels, and what is refused."""

import builtins
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import LobattoIIIAB, SaveAt, systems


BALL = systems.TurntableBall()
NAMES = ("x", "y")


def falling(**options):
    return nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v - q[1],
        nonholonomic=lambda t, q, v, args: v[0] - 1.0,
        **options,
    )


def run(system, **options):
    y0 = nhjax.initial_state(system, jnp.zeros(2), jnp.ones(2))
    options = {"saveat": SaveAt(t0=True, steps=True), "dt": 0.25} | options
    return nhjax.integrate(system, LobattoIIIAB(2), y0, num_steps=4, **options)


@pytest.fixture(scope="module")
def sol():
    return run(falling(coordinates=NAMES))


@pytest.mark.parametrize("name", ["q", "v", "p"])
def test_dataset_with_names_of_the_system_labels_coordinates(sol, name):
    data = sol.to_xarray(units={"time": "s", "x": "m"})
    got = data[name].sel(coordinate="y", time=0.75)
    np.testing.assert_array_equal(got, getattr(sol.ys, name)[3, 1])
    assert data[name].dims == ("time", "coordinate")
    assert data.multiplier.dims == ("time", "constraint")
    assert data.time.attrs["units"] == "s"
    assert data.coordinate_unit.sel(coordinate="x") == "m"
    assert data.velocity_unit.sel(coordinate="x") == "m/s"
    assert data.velocity_unit.sel(coordinate="y") == ""
    assert str(data.result.values) == "successful"
    assert int(data.stats_num_steps) == 4


def test_dataset_velocity_with_units_of_time_and_coordinate_has_a_unit(sol):
    assert "velocity_unit" not in sol.to_xarray(units={"x": "m"}).coords
    data = sol.to_xarray(units={"time": "10 s", "x": "rad", "y": "m"})
    assert data.velocity_unit.values.tolist() == ["rad/(10 s)", "m/(10 s)"]
    assert sol.to_xarray(units={"p": "N s"}).p.attrs == {"units": "N s"}


def test_dataset_of_a_batch_has_trajectories_as_first_dimension():
    system = falling()
    same = jax.vmap(lambda v: run(system, args=v))(jnp.arange(3.0))
    data = same.to_xarray(coordinates=NAMES, units={"q": "m"})
    assert data.q.dims == ("trajectory", "time", "coordinate")
    assert data.q.attrs["units"] == "m"
    assert data.time.shape == (5,)
    assert data.result.values.tolist() == ["successful"] * 3
    others = jax.vmap(lambda dt: run(system, dt=dt))(jnp.array([0.1, 0.2]))
    data = others.to_xarray()
    assert "time" not in data.coords
    np.testing.assert_allclose(data.t.sel(trajectory=1), 0.2 * np.arange(5))


def test_dataset_of_a_group_product_has_a_variable_for_each_factor():
    sol = nhjax.integrate(
        BALL.system,
        LobattoIIIAB(2),
        BALL.initial_state(),
        dt=0.1,
        num_steps=2,
        saveat=SaveAt(steps=True),
    )
    data = sol.to_xarray(coordinates=("ω1", "ω2", "ω3", "x", "y"))
    assert dict(data.q0.sizes) == {"time": 2, "q0_0": 4}
    assert dict(data.q1.sizes) == {"time": 2, "q1_0": 2}
    np.testing.assert_array_equal(data.v.sel(coordinate="ω2"), sol.ys.v[:, 1])


def test_dataset_of_saved_functions_is_named_by_tree_paths():
    def fn(t, y, args):
        return {"energy": y.v @ y.v, "more": (y.q, [t])}

    data = run(falling(), saveat=SaveAt(steps=2, fn=fn)).to_xarray()
    dims = {name: data[name].dims for name in data if "stats" not in str(name)}
    assert dims == {
        "energy": ("time",),
        "more_0": ("time", "more_0_0"),
        "more_1_0": ("time",),
        "result": (),
    }
    one = run(falling(), saveat=SaveAt(steps=2, fn=lambda t, y, args: y.q))
    assert one.to_xarray().value.dims == ("time", "value_0")


@pytest.mark.parametrize(
    ("fn", "message"),
    [
        (lambda t, y, args: {"result": t}, "an array named 'result', which"),
        (lambda t, y, args: {"time": t}, "an array named 'time', which"),
        (lambda t, y, args: {"a_b": t, "a": {"b": t}}, "have the name 'a_b'"),
    ],
)
def test_dataset_with_clashing_function_names_raises(fn, message):
    with pytest.raises(ValueError, match=message):
        run(falling(), saveat=SaveAt(steps=2, fn=fn)).to_xarray()


def test_dataset_of_a_solution_without_labels_raises(sol, monkeypatch):
    with pytest.raises(ValueError, match="no saved times"):
        dataclasses.replace(sol, ts=None, ys=None).to_xarray()
    with pytest.raises(ValueError, match="2 different names are needed"):
        sol.to_xarray(coordinates=("x",))
    with pytest.raises(ValueError, match=r"has the name 'z', but .* x, y"):
        sol.to_xarray(units={"z": "m"})
    with pytest.raises(TypeError, match="`units` must be a dictionary"):
        sol.to_xarray(units=["m"])
    with pytest.raises(TypeError, match="must be a tuple of names, got 'xy'"):
        sol.to_xarray(coordinates="xy")
    with pytest.raises(RuntimeError, match="outside jit and vmap"):
        jax.jit(lambda sol: sol.to_xarray().q.values)(sol)
    imported = builtins.__import__

    def without(name, *args, **kwargs):
        if name == "xarray":
            raise ImportError(name)
        return imported(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImportError, match=r'pip install "nhjax\[xarray\]"'):
        sol.to_xarray()


def test_dataset_with_wrong_coordinate_names_raises():
    with pytest.raises(TypeError, match="`coordinates` must be a tuple of names"):
        falling(coordinates="xy")
    with pytest.raises(ValueError, match="has a name twice"):
        falling(coordinates=("x", "x"))
    with pytest.raises(nhjax.ShapeError, match="3 names of `coordinates`"):
        run(falling(coordinates=("x", "y", "z")))
