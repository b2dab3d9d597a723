"""Models imported from SymPy: equations of motion, parameters and errors."""

import builtins
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from sympy import cos, sin
from sympy.physics import mechanics
from sympy.physics.mechanics import dynamicsymbols

import nhjax
from benchmarks import _sympy_models as sympy_models
from nhjax import from_sympy, LobattoIIIAB, systems


T = sympy.Symbol("t")
X, Y, A = dynamicsymbols("x y a")
DX, DY, DA = (q.diff() for q in (X, Y, A))
M, K = sympy.symbols("m k")
FREE = M * (DX**2 + DY**2) / 2


def numbers(expression, model, y, acceleration):
    """An expression of SymPy at a state, with an acceleration."""
    symbols: list[Any] = [dynamicsymbols(name) for name in model.coordinates]
    values = {}
    for order, given in ((2, acceleration), (1, y.v), (0, y.q)):
        values |= {
            q.diff(T, order) if order else q: float(x)
            for q, x in zip(symbols, given, strict=True)
        }
    values |= {sympy.Symbol(name): float(x) for name, x in model.args.items()}
    # Replace derivatives first, because they contain coordinates.
    for part in (2, 1, 0):
        some = {
            key: value
            for key, value in values.items()
            if getattr(key, "derivative_count", 0) == part
        }
        expression = expression.subs(some)
    return np.array(expression.subs(T, 0.7).evalf(), float).reshape(-1)


def test_lagranges_method_imported_agrees_with_its_own_equations():
    """With both kinds of constraints, loads, an explicit time and a factor 1/2."""
    z: Any = dynamicsymbols("z")
    frame, point = mechanics.ReferenceFrame("N"), mechanics.Point("P")
    velocity = DX * frame.x + DY * frame.y + z.diff() * frame.z
    point.set_vel(frame, velocity)
    lagrangian = M * velocity.dot(velocity) / 2 - K * X**2 * cos(T) - Y * z / 3
    method = mechanics.LagrangesMethod(
        lagrangian,
        [X, Y, z],
        forcelist=[(point, -K * (1 + Y**2) * velocity)],
        frame=frame,
        hol_coneqs=[X**2 + Y**2 - 1 - sin(T) / 5],
        nonhol_coneqs=[z.diff() - Y * DX - T],
    )
    model = from_sympy(method, parameters={"m": 1.7, K: 0.4})
    y = model.initial_state(
        jnp.array([0.8, 0.6, 0.1]), jnp.array([0.1, 0.2, 0.3]), t=0.7, project=True
    )
    found = nhjax.motion(model.system, 0.7, y, model.args)
    equations: Any = method.form_lagranges_equations()
    names: Any = method.lam_vec
    # In SymPy holonomic constraints come first, and multipliers have the other sign.
    signed = [-found.multiplier[1], -found.multiplier[0]]
    multipliers = dict(zip(names, map(float, signed), strict=True))
    residual = numbers(equations.subs(multipliers), model, y, found.acceleration)
    np.testing.assert_allclose(residual, 0, atol=1e-12)
    slopes = numbers(method.coneqs.diff(T), model, y, found.acceleration)
    np.testing.assert_allclose(slopes, 0, atol=1e-12)
    values = numbers(method.coneqs, model, y, found.acceleration)
    np.testing.assert_allclose(values, 0, atol=1e-13)


def test_sympy_projection_keeps_coordinates_chosen_by_name_or_symbol():
    model = from_sympy(
        (DX**2 + DY**2 + A.diff() ** 2) / 2, [X, Y, A], nonholonomic=DX - 2 * DY
    )
    v = {X: 1.0, "y": 3.0}
    for chosen in (X, "x", [X, "a"], (0,)):
        y = model.initial_state({}, v, project=True, keep_v=chosen, keep_q=[X, Y])
        np.testing.assert_array_equal(y.v, [1.0, 0.5, 0.0])
    with pytest.raises(ValueError, match=r"`keep_v` has the name 'm'.* are x, y, a\."):
        model.initial_state({}, v, project=True, keep_v=[M])


def skate(**options):
    """A skate for Kane's method, with forward, sideways and turning speeds."""
    forward, aside, turn = dynamicsymbols("u1 u2 u3")
    frame = mechanics.ReferenceFrame("N")
    body = frame.orientnew("B", "Axis", [A, frame.z])
    origin, centre = mechanics.Point("O"), mechanics.Point("C")
    origin.set_vel(frame, 0)
    centre.set_pos(origin, X * frame.x + Y * frame.y)
    body.set_ang_vel(frame, turn * frame.z)
    velocity = forward * body.x + aside * body.y
    ahead = centre.locatenew("G", body.x / 5)
    centre.set_vel(frame, velocity)
    ahead.v2pt_theory(centre, frame, body)
    moments = mechanics.inertia(body, 0, 0, K), ahead
    rigid = mechanics.RigidBody("skate", ahead, body, M, moments)
    rates = [
        forward - DX * cos(A) - DY * sin(A),
        aside + DX * sin(A) - DY * cos(A),
        turn - DA,
    ]
    method = mechanics.KanesMethod(
        frame,
        q_ind=[X, Y, A],
        u_ind=[forward, turn],
        u_dependent=[aside],
        kd_eqs=rates,
        velocity_constraints=[aside],
        bodies=[rigid],
        forcelist=[(centre, 3 * frame.x), (body, -turn * frame.z)],
        **options,
    )
    return method, (forward, turn, aside)


def test_kanes_method_imported_agrees_with_its_own_equations():
    method, speeds = skate()
    model = from_sympy(method, parameters={M: 1.3, K: 0.2})
    y = model.initial_state(
        {A: 0.3}, {"a": 1.5, X: 2 * np.cos(0.3), Y: 2 * np.sin(0.3)}
    )
    found = nhjax.motion(model.system, 0.0, y, model.args)
    method.kanes_equations()
    values = {A: 0.3, speeds[0]: 2.0, speeds[1]: 1.5, speeds[2]: 0.0, M: 1.3, K: 0.2}
    rates = method.mass_matrix.subs(values).LUsolve(method.forcing.subs(values))
    forward, turn, aside = np.array(rates, float).reshape(-1)
    assert abs(aside) < 1e-15
    expected = [
        forward * np.cos(0.3) - 2 * 1.5 * np.sin(0.3),
        forward * np.sin(0.3) + 2 * 1.5 * np.cos(0.3),
        turn,
    ]
    np.testing.assert_allclose(found.acceleration, expected, rtol=1e-12)


def slider(loads=(), energy=0, pushed=False):
    """One or two bodies on a line for Kane's method, joined if there are two."""
    u, w = dynamicsymbols("u w")
    frame = mechanics.ReferenceFrame("N")
    bodies = []
    for name, speed in (("P", u), ("Q", w))[: 2 if pushed else 1]:
        point = mechanics.Point(name)
        point.set_vel(frame, speed * frame.x)
        bodies.append(mechanics.Particle(name, point, M))
    bodies[0].potential_energy = energy
    joined: dict[str, Any] = {
        "q_dependent": [Y],
        "u_dependent": [w],
        "configuration_constraints": [X - Y],
        "velocity_constraints": [u - w],
    }
    rates = [DX - u, DY - w] if pushed else [DX - u]
    forces = [(bodies[0].point, x * frame.x) for x in loads]
    return mechanics.KanesMethod(
        frame,
        [X],
        [u],
        rates,
        bodies=bodies,
        forcelist=forces,
        **(joined if pushed else {}),
    )


@pytest.mark.parametrize(("pushed", "expected"), [(False, [-1.5]), (True, [-0.75] * 2)])
def test_kanes_method_with_or_without_holonomic_constraints_imports(pushed, expected):
    model = from_sympy(slider([-K * X], pushed=pushed), parameters={M: 2.0, K: 3.0})
    assert (model.system.nonholonomic, model.system.holonomic is None) == (
        None,
        not pushed,
    )
    y = model.initial_state(dict.fromkeys(model.coordinates, 1.0), {})
    found = nhjax.motion(model.system, 0.0, y, model.args).acceleration
    np.testing.assert_allclose(found, expected, rtol=1e-14)


def test_kanes_method_with_potential_and_loads_requires_potential_argument():
    method = slider([-K * X], energy=K * X**2 / 2)
    with pytest.raises(ValueError, match=r"and there are loads.* pass `potential=0`"):
        from_sympy(method)
    model = from_sympy(method, potential=0, parameters={M: 2.0, K: 3.0})
    y = model.initial_state({X: 1.0}, {})
    found = nhjax.motion(model.system, 0.0, y, model.args).acceleration
    np.testing.assert_allclose(found, [-1.5], rtol=1e-14)


def test_sympy_numbers_imported_keep_all_digits():
    for number in (np.pi, 5.972e24, 10**25):
        system = from_sympy(sympy.sympify(number) * X + DX**2, [X]).system
        one, zero = jnp.ones(1), jnp.zeros(1)
        assert float(system.lagrangian(jnp.zeros(()), one, zero, None)) == float(number)


@pytest.fixture(scope="module")
def particle():
    return sympy_models.particle()


def test_sympy_particle_integrated_agrees_with_gallery(particle):
    example = systems.NonholonomicParticle()
    options = {"dt": 0.1, "num_steps": 20}
    ours = nhjax.integrate(
        particle.system,
        LobattoIIIAB(3),
        particle.initial_state(example.q0, example.v0),
        args=particle.args,
        **options,
    )
    y0 = example.initial_state()
    theirs = nhjax.integrate(example.system, LobattoIIIAB(3), y0, **options)
    for got, expected in zip(
        jax.tree.leaves(ours.ys), jax.tree.leaves(theirs.ys), strict=True
    ):
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-13)
    assert ours.coordinates == ("x", "y", "z")


def test_sympy_parameters_differentiated_give_gradients(particle):
    y0 = particle.initial_state({"x": 1.0, "y": 0.5}, {"y": 1.0})

    def end(k):
        sol = nhjax.integrate(
            particle.system, LobattoIIIAB(2), y0, dt=0.1, num_steps=3, args={"k": k}
        )
        return jnp.sum(sol.ys.q)

    slope = jax.jit(jax.value_and_grad(end))
    difference = (slope(1.0 + 1e-6)[0] - slope(1.0 - 1e-6)[0]) / 2e-6
    np.testing.assert_allclose(slope(1.0)[1], difference, rtol=1e-8)


def test_sympy_model_in_single_precision_keeps_dtype(particle):
    q, v = jnp.ones(3, jnp.float32), jnp.zeros(3, jnp.float32)
    y = particle.initial_state(q, v)
    assert y.p.dtype == jnp.float32
    assert nhjax.motion(particle.system, 0.0, y, particle.args).multiplier.shape == (1,)


def test_sympy_parameters_wrong_at_run_time_raise_naming_them(particle):
    for args, message in (
        (None, r"of the model's parameters by name, as strings \(k\), such as"),
        ({}, "`args` lacks the parameters k"),
        ({"k": 1.0, "g": 2.0}, "`args` has the unknown parameters g"),
        ({"k": "1"}, r"`args\['k'\]` must be a real number, got '1'"),
        ({sympy.Symbol("k"): 1.0}, "by name, as strings \\(k\\)"),
        ({"k": jnp.ones(2)}, r"`args\['k'\]` has shape \(2,\)"),
    ):
        with pytest.raises((ValueError, TypeError), match=message):
            nhjax.initial_state(particle.system, jnp.ones(3), jnp.zeros(3), args=args)
    with pytest.raises(ValueError, match="`q` has w, but the coordinates are x, y, z"):
        particle.initial_state({"w": 1.0}, {})
    with pytest.raises(ValueError, match="`q` has x twice"):
        particle.initial_state({"x": 1.0, X: 2.0}, {})
    with pytest.raises(
        nhjax.ShapeError, match=r"`q` has 2 coordinates, .*'x', 'y', 'z'"
    ):
        nhjax.initial_state(
            particle.system, jnp.ones(2), jnp.zeros(2), args=particle.args
        )


def test_sympy_forces_in_four_forms_give_equal_systems():
    frame, point = mechanics.ReferenceFrame("N"), mechanics.Point("P")
    point.set_vel(frame, DX * frame.x + DY * frame.y)
    forms = (
        ([-K * DX, 0], None),
        ({X: -K * DX}, None),
        ({"x": -K * DX}, None),
        ([(point, -K * DX * frame.x)], frame),
    )
    for forces, inertial in forms:
        model = from_sympy(
            FREE, [X, Y], forces=forces, frame=inertial, parameters={M: 2, K: 0.5}
        )
        y = model.initial_state({}, {X: 3.0})
        found = nhjax.motion(model.system, 0.0, y, model.args).acceleration
        np.testing.assert_allclose(found, [-0.75, 0.0], rtol=1e-15)


def test_sympy_equations_and_product_derivatives_are_imported():
    model = from_sympy(
        FREE, [X, Y], nonholonomic=sympy.Eq((X * Y).diff(T, evaluate=False), 0)
    )
    zero = jnp.zeros(())
    value = model.system.constraint(
        zero, jnp.array([2.0, 3.0]), jnp.array([5.0, 7.0]), {"m": 1.0}
    )
    np.testing.assert_allclose(value, [29.0])


OTHER = sympy.Function("f")
WRONG = {
    "`lagrangian` contains f\\(t\\), which is not one of the coordinates": (
        {"lagrangian": FREE + OTHER(T)}
    ),
    "contains Derivative\\(x\\(t\\), \\(t, 2\\)\\), .* not on accelerations": (
        {"lagrangian": FREE + X.diff(T, 2)}
    ),
    "contains Derivative\\(a\\(t\\), t\\), but a\\(t\\) is not a coordinate": (
        {"lagrangian": FREE + DA**2}
    ),
    "contains Integral\\(.*\\) \\(Integral\\), which JAX or SymPy's printer": (
        {"lagrangian": FREE + sympy.Integral(sin(K**2 * Y), (K, 0, 1))}
    ),
    "contains besselj\\(1, x\\(t\\)\\) \\(besselj\\), which JAX or SymPy's printer": (
        {"lagrangian": FREE + sympy.besselj(1, X)}
    ),
    "`lagrangian` contains f\\(x\\(t\\)\\), which": {"lagrangian": FREE + OTHER(X)},
    "`lagrangian` contains infinity": {"lagrangian": FREE + sympy.oo * X},
    "(?s)got Matrix.* of type": {"lagrangian": sympy.Matrix([FREE, FREE])},
    "`coordinates` is a set, which has no order": {"coordinates": {X, Y}},
    "two symbols of the name t": (
        {"lagrangian": FREE + X * sympy.Symbol("t", real=True)}
    ),
    "`parameters` must be a dictionary": {"parameters": [("m", 1.0)]},
    "`parameters\\['m'\\]` must be a real number, got 1j": {"parameters": {M: 1j}},
    "`parameters` has m \\+ 1, but": {"parameters": {M + 1: 1.0}},
    "`lagrangian` contains the imaginary unit": {"lagrangian": FREE + sympy.I * X},
    "the coordinate x is given twice": {"coordinates": [X, X]},
    "the coordinate k is not a function of the time": {"coordinates": [X, K]},
    "`holonomic\\[1\\]`, k - 1, contains no coordinate": {"holonomic": [X, K - 1]},
    "contains velocities: pass it as `nonholonomic`": {"holonomic": DX},
    "contains no velocity: pass it as `holonomic`": {"nonholonomic": X},
    "`forces` has 1 entries, but there are 2 coordinates": {"forces": [X]},
    "`forces` has a\\(t\\), which is not one of the coordinates": {"forces": {A: X}},
    "`forces` has z, which is not one of the coordinates": {"forces": {"z": X}},
    "`forces` has x\\(t\\) twice": {"forces": {X: 1, "x": 2}},
    "`parameters` has q, but the symbols of the model are m": {"parameters": {"q": 1}},
    "`parameters` has m twice": {"parameters": {"m": 1, M: 2}},
    "`parameters\\['m'\\]` has shape \\(2,\\)": {"parameters": {"m": np.ones(2)}},
    "`parameters\\['m'\\]` must be a real number": {"parameters": {"m": K}},
    "`parameters\\['m'\\]` is nan": {"parameters": {"m": float("nan")}},
    "two symbols of the name m": (
        {"lagrangian": FREE + sympy.Symbol("m", positive=True) * X}
    ),
    "must consist of scalar SymPy expressions, got 'x' of": {"lagrangian": "x"},
    "`potential` is for a KanesMethod only": {"potential": X},
    "need `frame`, the inertial ReferenceFrame": (
        {"forces": [(mechanics.Point("P"), mechanics.ReferenceFrame("N").x)]}
    ),
}


@pytest.mark.parametrize("message", WRONG)
def test_from_sympy_with_unsupported_input_raises_naming_it(message):
    given = {"lagrangian": FREE, "coordinates": [X, Y]} | WRONG[message]
    with pytest.raises((ValueError, TypeError), match=message):
        from_sympy(**given)


def test_from_sympy_method_with_extra_arguments_raises():
    with pytest.raises(ValueError, match="`coordinates` is given together with a Kan"):
        from_sympy(skate()[0], [X])


def rolling_for_kane(speeds):
    """A wheel on a line whose point of contact has the velocity zero."""
    frame = mechanics.ReferenceFrame("N")
    wheel = frame.orientnew("B", "Axis", [A, frame.y])
    wheel.set_ang_vel(frame, speeds[0] * frame.y)
    contact = mechanics.Point("contact")
    contact.set_vel(frame, 0)
    centre = contact.locatenew("centre", frame.z)
    centre.v2pt_theory(contact, frame, wheel)
    moments = mechanics.inertia(wheel, 0, K, 0), centre
    return mechanics.KanesMethod(
        frame,
        q_ind=[A],
        u_ind=speeds,
        kd_eqs=[DA - speeds[0]],
        bodies=[mechanics.RigidBody("wheel", centre, wheel, M, moments)],
    )


def test_kanes_method_with_substituted_rolling_raises():
    u, w = dynamicsymbols("u w")
    with pytest.raises(ValueError, match="centre relative to contact is not the rate"):
        from_sympy(rolling_for_kane([u]))
    with pytest.raises(ValueError, match=r"2 speeds \(u\(t\), w\(t\)\) for 1 coord"):
        from_sympy(rolling_for_kane([u, w]))


def test_from_sympy_without_sympy_raises_naming_the_extra(monkeypatch):
    imported = builtins.__import__

    def without(name, *args, **kwargs):
        if name.startswith("sympy"):
            raise ImportError(name)
        return imported(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImportError, match=r'pip install "nhjax\[sympy\]"'):
        from_sympy(FREE, [X, Y])
