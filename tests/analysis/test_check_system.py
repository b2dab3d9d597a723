"""The report of `check_system` for systems with known properties."""

import jax
import jax.numpy as jnp
import pytest

import nhjax
from nhjax.systems import HeavyTop, RollingDisc, SphericalPendulum, VerticalRollingDisc
from support.driven import ARGS, DRIVEN
from support.forms import in_space


def report_of(example):
    return nhjax.check_system(example.system, example.q0, example.v0)


def test_check_system_of_a_disc_reports_its_invariances():
    report = report_of(VerticalRollingDisc())
    assert report.dimension == 4
    assert (report.num_nonholonomic, report.num_holonomic) == (2, 0)
    assert report.degrees_of_freedom == 2
    # Position and roll angle are ignorable; the constraints depend on the heading.
    assert report.ignorable == (0, 1, 2)
    assert report.constant == ("mass matrix",)
    assert report.depends_on_time == report.dependent == ()
    # On the group no function depends on the configuration.
    report = report_of(RollingDisc())
    assert report.ignorable == (0, 1, 2, 3)
    assert len(report.constant) == 2


def test_check_system_of_a_spherical_pendulum_reports_its_constraint():
    pendulum = SphericalPendulum(2.0, q0=(0.0, 0.6, -0.8), v0=(1.0, 0.0, 0.0))
    report = report_of(pendulum)
    assert (report.num_nonholonomic, report.num_holonomic) == (0, 1)
    assert report.ignorable == ()
    assert set(report.violations) == {"dΓ[0]/dt", "Γ[0]"}
    report = nhjax.check_system(
        pendulum.system, jnp.asarray([0.0, 0.6, -0.7]), pendulum.v0
    )
    assert report.violations["Γ[0]"] == pytest.approx(0.6**2 + 0.7**2 - 1)
    assert "largest violation              Γ[0] = -0.15" in str(report)


def test_check_system_reports_functions_that_depend_on_time():
    report = nhjax.check_system(
        DRIVEN.system, jnp.ones(3), jnp.ones(3), t=0.3, args=ARGS
    )
    assert report.depends_on_time == ("lagrangian", "nonholonomic")
    # The mass grows and the constraint rotates.
    assert report.constant == ()
    assert report.ignorable == ()


@pytest.mark.parametrize("name", ["lagrangian", "force"])
def test_check_system_of_a_function_that_is_not_finite_names_it(name):
    def root(q):
        return jnp.sqrt(-1 - q[0])

    functions = {
        "lagrangian": lambda t, q, v, args: 0.5 * v @ v,
        "force": lambda t, q, v, args: -v,
    }
    good = functions[name]
    functions[name] = lambda t, q, v, args: good(t, q, v, args) + root(q)
    system = nhjax.LagrangianSystem(functions["lagrangian"], force=functions["force"])
    with pytest.raises(nhjax.NonFiniteError, match=rf"`{name}\(t, q, v, args\)` is"):
        nhjax.check_system(system, jnp.ones(2), jnp.ones(2))


def test_check_system_reports_the_condition_of_the_mass_matrix():
    body = HeavyTop()
    assert report_of(body).mass_condition == pytest.approx(1.0)

    def coupled(t, q, v, args):
        return 0.5 * (v @ v) + 0.999 * v[0] * v[1]

    system = nhjax.LagrangianSystem(coupled)
    report = nhjax.check_system(system, jnp.zeros(2), jnp.ones(2))
    assert report.mass_condition == pytest.approx(1.999 / 0.001)
    assert report.compatibility_condition == 1.0


def test_check_system_reports_singular_mass_and_dependent_constraints():
    def lagrangian(t, q, v, args):
        return 0.5 * v[0] ** 2 - q @ q

    def twice(t, q, v, args):
        return jnp.stack([v[0] - v[2], v[1], 2 * v[0] - 2 * v[2]])

    system = nhjax.LagrangianSystem(lagrangian, nonholonomic=twice)
    report = nhjax.check_system(system, jnp.zeros(3), jnp.ones(3))
    assert report.mass_condition == float("inf")
    assert report.dependent == ("Φ[0]", "Φ[2]")
    assert "dependent constraints          Φ[0], Φ[2]" in str(report)


def test_check_system_of_a_hamiltonian_agrees_with_its_lagrangian():
    start = in_space("nonholonomic", in_time=True)
    y = start.y0
    one = nhjax.check_system(start.forms["lagrangian"], y.q, y.v, t=0.3)
    p = start.forms["lagrangian"].momentum(jnp.asarray(0.3), y.q, y.v, None)
    other = nhjax.check_system(start.forms["hamiltonian"], y.q, p=p, t=0.3)
    assert one.mass_condition > 1
    assert other.depends_on_time == ("hamiltonian", "nonholonomic", "force")
    for name in ("dimension", "num_nonholonomic", "ignorable", "constant"):
        assert getattr(one, name) == getattr(other, name)
    for name in ("mass_condition", "compatibility_condition"):
        assert getattr(one, name) == pytest.approx(getattr(other, name), rel=1e-9)


def test_check_system_with_wrong_arguments_raises_naming_them():
    disc = VerticalRollingDisc()
    with pytest.raises(ValueError, match="Pass `v`, the fibre coordinate"):
        nhjax.check_system(disc.system, disc.q0, p=disc.v0)
    with pytest.raises(nhjax.ShapeError, match="`v` has shape"):
        nhjax.check_system(disc.system, disc.q0, jnp.ones(3))
    with pytest.raises(TypeError, match="`system` must be"):
        nhjax.check_system(disc, disc.q0, disc.v0)  # pyright: ignore[reportArgumentType]


def test_check_system_with_nonfinite_or_misshaped_values_raises():
    def hidden(t, q, v, args):
        return jnp.stack([v[0] - 1, v[1] + 0 * jnp.sqrt(q[0] - 5)])

    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * (v @ v), nonholonomic=hidden
    )
    report = nhjax.check_system(system, jnp.zeros(2), jnp.zeros(2))
    assert "largest violation              Φ[1] = nan" in str(report)
    with pytest.raises(nhjax.NonFiniteError, match="`q` is not finite"):
        nhjax.check_system(system, jnp.full(2, jnp.nan), jnp.zeros(2))
    vector = nhjax.LagrangianSystem(lambda t, q, v, args: v)
    with pytest.raises(nhjax.ShapeError, match="must return shape"):
        nhjax.check_system(vector, jnp.zeros(2), jnp.zeros(2))
    with pytest.raises(TypeError, match=r"outside `jax\.jit`"):
        jax.jit(lambda q: nhjax.check_system(system, q, q).dimension)(jnp.zeros(2))
