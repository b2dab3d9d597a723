"""What users do wrong, as a table: the mistake, the error, and what its message says.

A message names the argument or the function, says what was wrong, and what to do. The
phrases occur in the message or in the notes below it. Further values of the same
mistakes are in the tests of the rooms.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.errors import (
    ConcretizationTypeError,
    TracerArrayConversionError,
    TracerBoolConversionError,
    TracerIntegerConversionError,
)

import nhjax
from nhjax import (
    ConstraintViolationError,
    DependentConstraintsError,
    DTypeError,
    Event,
    HamiltonianSystem,
    IncompatibleConstraintsError,
    IntegrationError,
    IrregularLagrangianError,
    LagrangianSystem,
    NonFiniteError,
    plot,
    SaveAt,
    ShapeError,
    systems,
)
from support.mistakes import (
    EXPLICIT_RK4,
    FREE,
    kinetic,
    METHOD,
    PARTICLE,
    Q,
    run,
    start,
    SYSTEM,
    system_with,
    V,
)


# The type is Any because type checkers would report the wrong types of mistakes.
NHJAX: Any = nhjax
ANY_EVENT: Any = Event
ANY_SAVEAT: Any = SaveAt
ANY_PLOT: Any = plot
Y0 = PARTICLE.initial_state()
QUATERNION = jnp.array([1.0, 0.0, 0.0, 0.0])
TURNING = LagrangianSystem(kinetic, manifold=nhjax.SO3())
MEMBERS = np.ones(3)


class Mistake(NamedTuple):
    """What the user did, how, the error, and phrases of its message and notes."""

    what: str
    do: Callable[..., Any]
    error: type[Exception]
    says: tuple[str, ...]


def row(what: str, do: Callable[..., Any], error: type[Exception], *says: str):
    """Make a row of the table."""
    return Mistake(what, do, error, says)


def trajectory():
    """Make a solution of two steps by hand, so that nothing is compiled."""
    zeros = jnp.zeros((3, 3))
    states = nhjax.State(zeros, zeros, zeros, jnp.zeros((3, 1)))
    times = jnp.arange(3.0)
    result = nhjax.RESULTS.successful
    return NHJAX.Solution(times[0], times[2], times, states, {}, result, None)


def falls(event: Any, **others):
    return run(Y0, event=event, **others)


def massive(t, q, v, args):
    return 0.5 * args["mass"] * v @ v


def stacked(*parts):
    return lambda t, q, v, args: jnp.stack([part(t, q, v) for part in parts])


SYSTEMS = [
    row(
        "gave a number as Lagrangian",
        lambda: system_with(lagrangian=3),
        TypeError,
        "LagrangianSystem: `lagrangian` must be a function of (t, q, v, args), got 3",
    ),
    row(
        "gave the value of the Lagrangian in place of the function",
        lambda: NHJAX.LagrangianSystem(kinetic(0.0, Q, V, None)),
        TypeError,
        "`lagrangian` must be a function of (t, q, v, args), got Array",
    ),
    row(
        "left `args` out of the arguments of the Lagrangian",
        lambda: system_with(lagrangian=lambda t, q, v: 0.5 * v @ v),
        TypeError,
        "`lagrangian` must take (t, q, v, args), but `<lambda>(t, q, v)` does not",
    ),
    row(
        "left `t` out of the arguments of a constraint",
        lambda: system_with(nonholonomic=lambda q, v, args: v[0]),
        TypeError,
        "`nonholonomic` must take (t, q, v, args), but `<lambda>(q, v, args)`",
    ),
    row(
        "gave a holonomic constraint the velocity",
        lambda: system_with(holonomic=lambda t, q, v, args: q @ q - 1),
        TypeError,
        "`holonomic` must take (t, q, args), but `<lambda>(t, q, v, args)` does not",
    ),
    row(
        "took the velocity instead of args in a holonomic constraint",
        lambda: system_with(holonomic=lambda t, q, v: q @ q - 1),
        TypeError,
        "`holonomic` must take (t, q, args), but `<lambda>(t, q, v)` takes v",
        "nhjax passes `args` as the third argument",
        "Pass a constraint on velocities as `nonholonomic`",
    ),
    row(
        "took the velocity in a function of a Hamiltonian system",
        lambda: HamiltonianSystem(
            lambda t, q, p, args: 0.5 * p @ p, nonholonomic=lambda t, q, v, args: v[0]
        ),
        UserWarning,
        "HamiltonianSystem: `nonholonomic` must take (t, q, p, args)",
        "`<lambda>(t, q, v, args)` takes v",
        "nhjax passes the momentum p as the third argument",
        "Write the function in terms of p",
    ),
    row(
        "took the momentum in a function of a Lagrangian system",
        lambda: system_with(force=lambda t, q, p, args: -p),
        UserWarning,
        "LagrangianSystem: `force` must take (t, q, v, args)",
        "nhjax passes the velocity v as the third argument",
        "Write the function in terms of v",
    ),
    row(
        "wrote a Hamiltonian in terms of the velocity",
        lambda: HamiltonianSystem(lambda t, q, v, args: 0.5 * v @ v),
        TypeError,
        "HamiltonianSystem: `hamiltonian` must take (t, q, p, args)",
        "nhjax passes the momentum p as the third argument",
    ),
    row(
        "gave a list of functions as constraints",
        lambda: system_with(
            nonholonomic=[lambda t, q, v, args: v[0], lambda t, q, v, args: v[1]]
        ),
        TypeError,
        "`nonholonomic` must be one function of (t, q, v, args), got a list of 2",
        "returns `jnp.hstack([f(t, q, v, args), g(t, q, v, args)])`",
    ),
    row(
        "gave a list of forces",
        lambda: system_with(force=[lambda t, q, v, args: v, lambda t, q, v, args: q]),
        TypeError,
        "`force` must be one function of (t, q, v, args), got a list of 2",
        "Add forces f and g: `nhjax.forces.Sum(f, g)`.",
    ),
    row(
        "took the time last in the Lagrangian",
        lambda: system_with(lagrangian=lambda q, v, t, args: 0.5 * v @ v),
        TypeError,
        "`lagrangian` must take (t, q, v, args), in this order",
        "`<lambda>(q, v, t, args)` has another order",
        "nhjax passes arguments by position",
    ),
    row(
        "took the velocity before the position",
        lambda: system_with(force=lambda t, v, q, args: -v),
        TypeError,
        "`force` must take (t, q, v, args), in this order, but `<lambda>(t, v, q",
    ),
    row(
        "took the momentum before the position in a Hamiltonian",
        lambda: HamiltonianSystem(lambda t, p, q, args: 0.5 * p @ p),
        TypeError,
        "HamiltonianSystem: `hamiltonian` must take (t, q, p, args), in this order",
    ),
    row(
        "took the time after the position in a holonomic constraint",
        lambda: system_with(holonomic=lambda q, t, args: q @ q - 1),
        TypeError,
        "`holonomic` must take (t, q, args), in this order, but `<lambda>(q, t, args)`",
    ),
    row(
        "gave the class of a group as manifold",
        lambda: system_with(manifold=nhjax.SO3),
        TypeError,
        "`manifold` must be an nhjax manifold",
        "got the class; write SO3()",
    ),
    row(
        "gave the name of a group as manifold",
        lambda: system_with(manifold="SO3"),
        TypeError,
        "`manifold` must be an nhjax manifold such as nhjax.Euclidean(3), got 'SO3'",
    ),
    row(
        "misspelled the option for redundant constraints",
        lambda: system_with(constraints="dependent"),
        ValueError,
        "`constraints` must be one of 'independent', 'redundant', got 'dependent'",
    ),
    row(
        "gave names of coordinates as one string",
        lambda: system_with(coordinates="xyz"),
        TypeError,
        "`coordinates` must be a tuple of names, such as ('x', 'y'), got 'xyz'",
    ),
    row(
        "gave two names to three coordinates",
        lambda: start(system_with(coordinates=("x", "y"))),
        ShapeError,
        "`q` has 3 coordinates, but the system has 2 names of `coordinates`",
        "give one name for each coordinate",
    ),
    row(
        "gave a manifold of another dimension than the state",
        lambda: start(system_with(manifold=nhjax.Euclidean(2))),
        ShapeError,
        "`q` has shape (3,)",
        "Euclidean(2)",
    ),
]

VALUES_OF_FUNCTIONS = [
    row(
        "forgot to sum the Lagrangian over the coordinates",
        lambda: start(system_with(lagrangian=lambda t, q, v, args: 0.5 * v * v)),
        ShapeError,
        "`lagrangian(t, q, v, args)` must return shape (), a scalar, got shape (3,)",
        "Sum over the coordinates, as in `0.5 * v @ v`",
    ),
    row(
        "forgot the return of the Lagrangian",
        lambda: start(system_with(lagrangian=lambda t, q, v, args: None)),
        ShapeError,
        "`lagrangian(t, q, v, args)` must return an array of shape ()",
        "got None: is a `return` missing?",
    ),
    row(
        "returned an integer from the Lagrangian",
        lambda: start(system_with(lagrangian=lambda t, q, v, args: jnp.int32(1))),
        DTypeError,
        "`lagrangian(t, q, v, args)` returns dtype int32, but `q` has float64",
        "write 1.0 instead of 1",
    ),
    row(
        "returned a complex number from the Lagrangian",
        lambda: start(
            system_with(
                lagrangian=lambda t, q, v, args: kinetic(t, q, v, args).astype(complex)
            )
        ),
        DTypeError,
        "returns dtype complex128, but `q` has float64: take its real part",
    ),
    row(
        "used constants of single precision",
        lambda: start(
            system_with(
                lagrangian=lambda t, q, v, args: kinetic(t, q, v, args).astype("f")
            )
        ),
        DTypeError,
        "returns dtype float32",
        "write its constants in the precision of the state",
    ),
    row(
        "gave more constraints than coordinates",
        lambda: start(
            system_with(nonholonomic=lambda t, q, v, args: jnp.concatenate([v, v[:1]]))
        ),
        ShapeError,
        "`nonholonomic(t, q, v, args)` must return shape () or (m,) with 1 <= m <= 3",
        "got shape (4,)",
    ),
    row(
        "gave constraints as rows of a matrix",
        lambda: start(system_with(nonholonomic=lambda t, q, v, args: v[None])),
        ShapeError,
        "`nonholonomic(t, q, v, args)` must return",
        "got shape (1, 3). For constraints A(q) v = 0 return `A @ v`.",
    ),
    row(
        "gave no constraint at all",
        lambda: start(system_with(nonholonomic=lambda t, q, v, args: v[:0])),
        ShapeError,
        "`nonholonomic(t, q, v, args)` must return",
        "1 <= m <= 3, the number of coordinates, got shape (0,)",
    ),
    row(
        "returned constraints in a list",
        lambda: start(system_with(nonholonomic=lambda t, q, v, args: [v[0], v[1]])),
        ShapeError,
        "`nonholonomic(t, q, v, args)` must return an array",
        "got a list of 2: join its parts with `jnp.stack`",
    ),
    row(
        "compared the two sides of a constraint",
        lambda: start(system_with(nonholonomic=lambda t, q, v, args: v[0] == q[0])),
        DTypeError,
        "`nonholonomic(t, q, v, args)` returns dtype bool",
        "return the number that must vanish, `a - b` instead of `a == b`",
    ),
    row(
        "gave a force on one coordinate alone",
        lambda: start(system_with(force=lambda t, q, v, args: -v[0])),
        ShapeError,
        "`force(t, q, v, args)` must return shape (3,), got shape ()",
        "Give one component for each coordinate",
    ),
    row(
        "gave a constraint on positions as a nonholonomic one",
        lambda: start(system_with(nonholonomic=lambda t, q, v, args: q[1] - Q[1])),
        DependentConstraintsError,
        "nonholonomic[0] with respect to velocities are zero there",
        "Pass a constraint on positions as `holonomic`",
    ),
    row(
        "wrote a holonomic constraint as a square",
        lambda: start(system_with(holonomic=lambda t, q, args: (q[1] - Q[1]) ** 2)),
        DependentConstraintsError,
        "holonomic[0] has no gradient there",
    ),
    row(
        "wrote the same constraint twice",
        lambda: start(
            system_with(
                nonholonomic=stacked(
                    lambda t, q, v: v[1] - V[1], lambda t, q, v: 2 * (v[1] - V[1])
                )
            )
        ),
        DependentConstraintsError,
        "nonholonomic[0] and nonholonomic[1]",
        "Remove redundant constraints",
        'constraints="redundant"',
    ),
    row(
        "left a coordinate without kinetic energy",
        lambda: start(system_with(lagrangian=lambda t, q, v, args: v[0] ** 2 - q @ q)),
        IrregularLagrangianError,
        "the mass matrix D2D2L is singular",
        "Give every coordinate a kinetic energy, or remove the coordinates without one",
    ),
    row(
        "gave a kinetic energy with a sign that cancels the constraint",
        lambda: start(
            system_with(
                lagrangian=lambda t, q, v, args: v[0] ** 2 - v[1] ** 2 + v[2] ** 2,
                nonholonomic=lambda t, q, v, args: v[0] - v[1],
            ),
            v=jnp.ones(3),
        ),
        IncompatibleConstraintsError,
        "The constraints are not compatible with the Lagrangian",
        "nonholonomic[0]",
    ),
    row(
        "started where the Lagrangian is not a number",
        lambda: start(
            system_with(
                lagrangian=lambda t, q, v, args: (
                    kinetic(t, q, v, args) + jnp.log(q[0] - 5)
                )
            )
        ),
        NonFiniteError,
        "L = nan",
        "Check the functions of the system at this state",
    ),
    row(
        "took the norm of a vector that is zero",
        lambda: start(
            system_with(
                lagrangian=lambda t, q, v, args: (
                    kinetic(t, q, v, args) - jnp.linalg.norm(q)
                )
            ),
            q=jnp.zeros(3),
        ),
        NonFiniteError,
        "The forces D1L + F, or the derivatives of Φ, are not finite at q = [0. 0. 0.]",
    ),
]

TRACING = [
    row(
        "used NumPy in the Lagrangian",
        lambda: start(system_with(lagrangian=lambda t, q, v, args: np.cos(q[0]))),
        TracerArrayConversionError,
        "This was raised by `lagrangian(t, q, v, args)`",
        "test_mistakes.py:",
        "functions of `jax.numpy` in place of `numpy` and `math`",
    ),
    row(
        "used `math` in a constraint",
        lambda: start(
            system_with(nonholonomic=lambda t, q, v, args: v[0] - math.sin(q[0]))
        ),
        ConcretizationTypeError,
        "`nonholonomic(t, q, v, args)`",
        "functions of `jax.numpy` in place of `numpy` and `math`",
    ),
    row(
        "wrote an `if` on a position in a force",
        lambda: start(system_with(force=lambda t, q, v, args: v if q[0] > 0 else -v)),
        TracerBoolConversionError,
        "`force(t, q, v, args)`",
        "`jnp.where(condition, a, b)` in place of `if`",
    ),
    row(
        "used Python's `max` in a holonomic constraint",
        lambda: start(system_with(holonomic=lambda t, q, args: max(q[0], q[1]))),
        TracerBoolConversionError,
        "`holonomic(t, q, args)`",
        "`jnp.maximum`",
    ),
    row(
        "looked a value up in a list by a position",
        lambda: start(
            system_with(lagrangian=lambda t, q, v, args: [1.0][q[0].astype(int)])
        ),
        TracerIntegerConversionError,
        "`lagrangian(t, q, v, args)`",
        "`jnp.asarray(table)[i]`",
    ),
    row(
        "changed an array in place",
        lambda: start(
            system_with(force=lambda t, q, v, args: v.__setitem__(0, 0.0) or v)
        ),
        TypeError,
        "immutable",
        ".at[",
        "`force(t, q, v, args)`",
    ),
    row(
        "read more coordinates than there are",
        lambda: start(system_with(lagrangian=lambda t, q, v, args: q[0, 1])),
        IndexError,
        "Too many indices",
        "`lagrangian(t, q, v, args)`",
    ),
    row(
        "forgot `args` for the initial state",
        lambda: start(LagrangianSystem(massive)),
        TypeError,
        "`lagrangian(t, q, v, args)` (massive, ",
        "Here `args` is None: has `args=...` been left out of the call?",
    ),
    row(
        "forgot `args` for the run",
        lambda: run(
            nhjax.State(Q, V, V, jnp.zeros(0)), system=LagrangianSystem(massive)
        ),
        TypeError,
        "`lagrangian(t, q, v, args)` (massive, ",
        "has `args=...` been left out of the call?",
    ),
    row(
        "forgot `args` for the energy",
        lambda: LagrangianSystem(massive).energy(0.0, Y0),
        TypeError,
        "`lagrangian(t, q, v, args)` (massive, ",
        "has `args=...` been left out of the call?",
    ),
    row(
        "forgot `args` for the accelerations of a Hamiltonian system",
        lambda: nhjax.motion(
            HamiltonianSystem(lambda t, q, p, args: p @ p / args["mass"]),
            0.0,
            nhjax.State(Q, V, V, jnp.zeros(0)),
        ),
        TypeError,
        "`hamiltonian(t, q, p, args)`",
        "has `args=...` been left out of the call?",
    ),
    row(
        "misspelled a parameter in `args`",
        lambda: start(LagrangianSystem(massive), args={"Mass": 1.0}),
        KeyError,
        "'mass'",
        "Here `args` has the keys 'Mass'",
    ),
    row(
        "gave parameters as a tuple where names are read",
        lambda: start(LagrangianSystem(massive), args=(1.0,)),
        TypeError,
        "Here `args` is a tuple of 1",
    ),
    row(
        "put what cannot be compiled into `args`",
        lambda: start(args={"mass": 1.0, "names": [2, {"a", "b"}]}),
        TypeError,
        "`args['names'][1]` is ",
        "of type set",
        "must be hashable",
    ),
    row(
        "used NumPy in the condition of an event",
        lambda: falls(Event(lambda t, y, args: np.sin(y.q[0]))),
        TracerArrayConversionError,
        "`Event 0: cond_fn(t, y, args)`",
        "functions of `jax.numpy`",
    ),
    row(
        "wrote an `if` in what is saved",
        lambda: run(
            Y0, saveat=SaveAt(t1=True, fn=lambda t, y, args: 1.0 if t > 0 else 0.0)
        ),
        TracerBoolConversionError,
        "`SaveAt: fn(t, y, args)`",
        "in place of `if`",
    ),
    row(
        "used `math` in an invariant",
        lambda: run(Y0, invariants=lambda t, q, v, args: math.exp(q[0])),
        ConcretizationTypeError,
        "`invariants(t, q, v, args)`",
        "functions of `jax.numpy`",
    ),
    row(
        "used NumPy in a symmetry",
        lambda: NHJAX.linear_stability(
            SYSTEM, 0.0, Y0, symmetry=lambda q: np.array([q[1], q[0], 0.0])
        ),
        TracerArrayConversionError,
        "`symmetry(q)`",
        "functions of `jax.numpy`",
    ),
    row(
        "used NumPy in a generator along a trajectory",
        lambda: NHJAX.momentum_map(
            trajectory().ys, lambda q: np.array([q[1], q[0], 0.0])
        ),
        TracerArrayConversionError,
        "`generator(q)`",
        "functions of `jax.numpy`",
    ),
    row(
        "wrote an `if` in the run of an ensemble",
        lambda: nhjax.ensemble(lambda x: x if x > 0 else -x, MEMBERS),
        TracerBoolConversionError,
        "`run(member)`",
        "`jnp.where(condition, a, b)` in place of `if`",
    ),
    row(
        "gave the run of an ensemble two arguments",
        lambda: NHJAX.ensemble(lambda x, y: x, MEMBERS),
        TypeError,
        "missing 1 required positional argument: 'y'",
        "`run(member)`",
    ),
]

STATES = [
    row(
        "gave many positions at once",
        lambda: start(q=jnp.ones((2, 3))),
        ShapeError,
        "`q` has shape (2, 3)",
        "use `jax.vmap`",
    ),
    row(
        "gave a number as position",
        lambda: start(q=jnp.ones(())),
        ShapeError,
        "`q` has shape (), but a configuration has shape (n,)",
    ),
    row(
        "gave too few velocities",
        lambda: start(v=jnp.ones(2)),
        ShapeError,
        "`v` has shape (2,), but `q` has shape (3,)",
        "needs a `v` of shape (3,)",
    ),
    row(
        "gave momenta as a column",
        lambda: start(v=None, p=jnp.ones((3, 1))),
        ShapeError,
        "`p` has shape (3, 1)",
        "needs a `p` of shape (3,)",
    ),
    row(
        "gave several times",
        lambda: start(t=jnp.zeros(4)),
        ShapeError,
        "`t` has shape (4,)",
        "for several values use `jax.vmap`",
    ),
    row(
        "gave integers as position",
        lambda: start(q=jnp.array([1, 0, 0])),
        DTypeError,
        "`q` has dtype int64",
        "write 1.0 instead of 1",
    ),
    row(
        "gave integers as velocity, in a list",
        lambda: start(v=[1, 0, 0]),
        DTypeError,
        "`v` has dtype int64",
        "write 1.0 instead of 1",
    ),
    row(
        "gave velocities of single precision to positions of double",
        lambda: start(v=V.astype(jnp.float32)),
        DTypeError,
        "`v` has dtype float32, but `q` has float64: they must agree",
    ),
    row(
        "gave positions of single precision to velocities of double",
        lambda: start(q=Q.astype(jnp.float32)),
        DTypeError,
        "`v` has dtype float64, but `q` has float32",
    ),
    row(
        "gave complex positions",
        lambda: start(q=Q.astype(complex)),
        DTypeError,
        "`q` has dtype complex128, but float32 or float64 is needed",
    ),
    row(
        "gave truth values as velocity",
        lambda: start(v=jnp.ones(3, bool)),
        DTypeError,
        "`v` has dtype bool",
    ),
    row(
        "gave positions of half precision",
        lambda: start(q=Q.astype(jnp.float16)),
        DTypeError,
        "`q` has dtype float16, but float32 or float64",
    ),
    row(
        "gave no position",
        lambda: start(q=None),
        DTypeError,
        "`q` must be an array of floats, got None",
    ),
    row(
        "gave a word as position",
        lambda: start(q="rest"),
        DTypeError,
        "`q` must be an array of floats, got 'rest' of type str",
    ),
    row(
        "gave a state as position",
        lambda: start(q=Y0, v=None),
        TypeError,
        "`q` must be a configuration, got an nhjax.State",
        "pass `y.q` and `y.v`",
    ),
    row(
        "gave a tuple of arrays to a system on R^n",
        lambda: start(q=(Q, Q)),
        ShapeError,
        "`q` is a tuple of 2, but the system has no `manifold`",
        "make one array of `q`",
    ),
    row(
        "gave no time",
        lambda: start(t=None),
        DTypeError,
        "`t` must be a real number, got None",
    ),
    row(
        "gave a complex time",
        lambda: start(t=1j),
        DTypeError,
        "`t` must be a real number, got 1j",
    ),
    row(
        "gave a word as option",
        lambda: start(project="yes"),
        TypeError,
        "`project` must be True or False",
        "got 'yes' of type str",
    ),
    row(
        "gave a number as option",
        lambda: start(project=1),
        TypeError,
        "`project` must be True or False",
        "got 1 of type int",
    ),
    row(
        "gave neither velocity nor momentum",
        lambda: start(v=None),
        ValueError,
        "Give either `v` or `p`, got neither of them",
    ),
    row(
        "gave velocity and momentum",
        lambda: start(p=V),
        ValueError,
        "Give either `v` or `p`, got both of them",
    ),
    row(
        "gave the Lagrangian in place of the system",
        lambda: start(kinetic),
        TypeError,
        "`system` must be an nhjax.LagrangianSystem",
        "got <func",
    ),
    row(
        "gave a machine of the gallery in place of its system",
        lambda: start(PARTICLE),
        TypeError,
        "got NonholonomicParticle; pass its attribute `.system`",
    ),
    row(
        "gave the class of systems",
        lambda: start(LagrangianSystem),
        TypeError,
        "the class itself; write LagrangianSystem(...)",
    ),
    row(
        "gave the method where the system belongs",
        lambda: start(METHOD),
        TypeError,
        "`system` must be an nhjax.LagrangianSystem",
        "got LobattoIIIAB",
    ),
    row(
        "gave a position that is not a number",
        lambda: start(q=jnp.full(3, jnp.nan)),
        NonFiniteError,
        "`q` is not finite: [nan nan nan]",
    ),
    row(
        "gave a velocity that violates the constraint",
        lambda: start(v=jnp.ones(3)),
        ConstraintViolationError,
        "1 of 1 nonholonomic constraints violated",
        "choose a velocity on the constraints, or pass `project=True`",
    ),
    row(
        "gave Euler angles as an element of SO3",
        lambda: start(TURNING, q=jnp.zeros(3)),
        ShapeError,
        "`q` has shape (3,), but the manifold SO3 needs shape (4,)",
    ),
    row(
        "gave a quaternion as angular velocity",
        lambda: start(TURNING, q=QUATERNION, v=jnp.ones(4)),
        ShapeError,
        "needs a `v` of shape (3,)",
    ),
    row(
        "gave a quaternion that is not of unit length",
        lambda: start(TURNING, q=2 * QUATERNION),
        ConstraintViolationError,
        "is not an element of the group SO3",
        "or `manifold.normalise(q)` as `q`",
    ),
    row(
        "gave one array to a product of groups",
        lambda: start(
            system_with(manifold=nhjax.ProductGroup(nhjax.SO2(), nhjax.SO2()))
        ),
        ShapeError,
        "`q` must be a tuple of 2 elements, one for each factor",
    ),
]

METHODS = [
    row(
        "asked for one stage",
        lambda: nhjax.LobattoIIIAB(1),
        ValueError,
        "stages of LobattoIIIAB must be >= 2, got 1",
    ),
    row(
        "gave the stages as a float",
        lambda: NHJAX.LobattoIIIAB(3.0),
        TypeError,
        "stages of LobattoIIIAB must be an int, got 3.0 of type float",
    ),
    row(
        "asked for a hundred stages",
        lambda: nhjax.Gauss(100),
        ValueError,
        "must be <= 32, got 100: more stages gain no accuracy",
    ),
    row(
        "misspelled a closure",
        lambda: NHJAX.LobattoIIIAB(3, closure="Symmetric"),
        ValueError,
        "closure must be one of 'propagated', 'consistent', 'symmetric'",
        "got 'Symmetric'",
    ),
    row(
        "misspelled a chart",
        lambda: NHJAX.LobattoIIIAB(3, chart="end"),
        ValueError,
        "chart must be one of 'middle', 'start', got 'end'",
    ),
    row(
        "gave weights that do not sum to one",
        lambda: nhjax.PartitionedRungeKutta([[0.0, 0.0], [0.5, 0.6]], [0.5, 0.6]),
        ValueError,
        "b must sum to 1, got 1.1",
    ),
    row(
        "gave the class of a retraction",
        lambda: NHJAX.SO3(retraction=nhjax.Exponential),
        TypeError,
        "`retraction` must be one of Cayley()",
        "It is a class; call it",
    ),
    row(
        "gave a negative tolerance",
        lambda: nhjax.Newton(tolerance=-1e-9),
        ValueError,
        "`tolerance` must be finite and >= 0, got -1e-09",
    ),
    row(
        "allowed no iteration",
        lambda: nhjax.SimplifiedNewton(max_iterations=0),
        ValueError,
        "SimplifiedNewton: `max_iterations`",
        "got 0",
    ),
    row(
        "misspelled the terms of a Jacobian",
        lambda: NHJAX.SimplifiedNewton(jacobian="exact"),
        ValueError,
        "jacobian must be one of 'leading', 'first_order', 'full', got 'exact'",
    ),
    row(
        "asked for one checkpoint",
        lambda: nhjax.RecursiveCheckpointAdjoint(1),
        ValueError,
        "`checkpoints` must be an int >= 2 or None, got 1",
    ),
]

SAVING = [
    row(
        "asked to save nothing",
        SaveAt,
        ValueError,
        "nothing is saved",
        "at least one of `t0`",
    ),
    row(
        "asked to save every minus third step",
        lambda: SaveAt(steps=-3),
        ValueError,
        "SaveAt: `steps` must be a bool or an int >= 1, got -3",
    ),
    row(
        "gave a number of steps as a float",
        lambda: ANY_SAVEAT(steps=2.0),
        ValueError,
        "SaveAt: `steps` must be a bool or an int >= 1, got 2.0",
    ),
    row(
        "asked for every step zero",
        lambda: SaveAt(steps=0),
        ValueError,
        "SaveAt: nothing is saved",
    ),
    row(
        "gave None as a number of steps",
        lambda: ANY_SAVEAT(steps=None),
        ValueError,
        "SaveAt: `steps` must be a bool or an int >= 1, got None",
    ),
    row(
        "asked for times and for steps",
        lambda: SaveAt(ts=[0.1], steps=2),
        ValueError,
        "SaveAt: give `ts` or `steps`, not both",
        "`dense=True`",
    ),
    row(
        "gave times in no order",
        lambda: SaveAt(ts=[0.1, 0.3, 0.2]),
        ValueError,
        "SaveAt: `ts` must be sorted in the direction of time",
    ),
    row(
        "gave a time that is not a number",
        lambda: SaveAt(ts=[0.1, np.nan]),
        NonFiniteError,
        "SaveAt: `ts` is not finite: [0.1",
    ),
    row(
        "gave a matrix of times",
        lambda: SaveAt(ts=np.ones((2, 2))),
        ValueError,
        "SaveAt: `ts` must have shape (k,), k >= 1, got (2, 2)",
    ),
    row(
        "gave an empty list of times",
        lambda: SaveAt(ts=[]),
        ValueError,
        "SaveAt: `ts` must have shape (k,), k >= 1, got (0,)",
    ),
    row(
        "gave one time without a list",
        lambda: ANY_SAVEAT(ts=0.1),
        ValueError,
        "SaveAt: `ts` must have shape (k,), k >= 1, got ()",
    ),
    row(
        "gave complex times",
        lambda: ANY_SAVEAT(ts=[1j]),
        DTypeError,
        "SaveAt: `ts` must be real, got dtype complex128",
    ),
    row(
        "gave words as times",
        lambda: ANY_SAVEAT(ts=["0.1", "0.2"]),
        DTypeError,
        "SaveAt: `ts` must be a vector of real numbers",
    ),
    row(
        "gave the end of the run where a flag belongs, as in diffrax",
        lambda: ANY_SAVEAT(t1=5.0),
        ValueError,
        "SaveAt: `t1` must be True or False, got 5.0",
        "To save at given times, pass `ts`",
    ),
    row(
        "gave the start of the run where a flag belongs",
        lambda: ANY_SAVEAT(t0=0, t1=True),
        ValueError,
        "SaveAt: `t0` must be True or False, got 0",
    ),
    row(
        "gave a word where a flag belongs",
        lambda: ANY_SAVEAT(dense="yes"),
        ValueError,
        "SaveAt: `dense` must be True or False, got 'yes'",
    ),
    row(
        "gave a number as what is saved",
        lambda: ANY_SAVEAT(t1=True, fn=3),
        TypeError,
        "SaveAt: `fn` must be a function of (t, y, args), got 3",
    ),
    row(
        "gave what is saved the state alone",
        lambda: ANY_SAVEAT(t1=True, fn=lambda y: y.q),
        TypeError,
        "SaveAt: `fn` must take (t, y, args), but `<lambda>(y)` does not",
    ),
    row(
        "gave what is saved the state before the time",
        lambda: SaveAt(t1=True, fn=lambda y, t, args: y),
        TypeError,
        "SaveAt: `fn` must take (t, y, args), in this order, but `<lambda>(y, t, args)",
    ),
    row(
        "forgot the return of what is saved",
        lambda: run(Y0, saveat=SaveAt(t1=True, fn=lambda t, y, args: None)),
        TypeError,
        "SaveAt: `fn(t, y, args)` must return an array",
        "got None: is a `return` missing?",
    ),
]

RUNS = [
    row(
        "asked for no step",
        lambda: run(Y0, num_steps=0),
        ValueError,
        "`num_steps` must be in 1..2^31 - 1, got 0",
    ),
    row(
        "asked for minus one steps",
        lambda: run(Y0, num_steps=-1),
        ValueError,
        "`num_steps` must be in 1..2^31 - 1, got -1",
    ),
    row(
        "asked for more steps than can be counted",
        lambda: run(Y0, num_steps=2**31),
        ValueError,
        "`num_steps` must be in 1..2^31 - 1, got 2147483648",
    ),
    row(
        "divided times for the number of steps",
        lambda: run(Y0, num_steps=0.4 / 0.1),
        TypeError,
        "`num_steps` must be an int",
        "got 4.0 of type float",
    ),
    row(
        "gave a truth value as number of steps",
        lambda: run(Y0, num_steps=True),
        TypeError,
        "`num_steps` must be an int",
        "got True",
    ),
    row(
        "gave a traced number of steps where all are saved",
        lambda: jax.jit(lambda n: run(Y0, num_steps=n, saveat=SaveAt(steps=True)))(4),
        TypeError,
        "`num_steps` must be an int known when tracing",
        "static argument",
        "`SaveAt(steps=...)` depends on it",
    ),
    row(
        "gave a step of size zero",
        lambda: run(Y0, dt=0.0),
        ValueError,
        "`dt` is zero; give a positive or negative step size",
    ),
    row(
        "gave a step of size zero, as an integer",
        lambda: run(Y0, dt=0),
        ValueError,
        "`dt` is zero; give a positive or negative step size",
    ),
    row(
        "gave a step that is not a number",
        lambda: run(Y0, dt=np.nan),
        NonFiniteError,
        "`dt` is not finite: nan",
    ),
    row(
        "gave an infinite step",
        lambda: run(Y0, dt=np.inf),
        NonFiniteError,
        "`dt` is not finite: inf",
    ),
    row(
        "gave several step sizes",
        lambda: run(Y0, dt=jnp.ones(3)),
        ValueError,
        "`dt` has 3 sizes, but `num_steps` is",
        "`jax.vmap`",
    ),
    row(
        "gave a complex step",
        lambda: run(Y0, dt=0.1j),
        DTypeError,
        "`dt` must be a real number, got 0.1j",
    ),
    row(
        "gave a truth value as step",
        lambda: run(Y0, dt=True),
        DTypeError,
        "`dt` must be a real number, got True",
    ),
    row(
        "gave the step as a string",
        lambda: run(Y0, dt="0.1"),
        DTypeError,
        "`dt` must be a real number, got '0.1' of type str",
    ),
    row(
        "gave no step",
        lambda: run(Y0, dt=None),
        TypeError,
        "`dt` is missing",
        "nhjax.PIDController(rtol=1e-6, atol=1e-6)",
    ),
    row(
        "started at a time next to which a step is nothing",
        lambda: run(Y0, t0=1e20),
        ValueError,
        "`dt` = 0.1 is below the round-off of the time `t0` = 1e+20",
        "Measure time from a later origin, or take larger steps",
    ),
    row(
        "started at a time that is not a number",
        lambda: run(Y0, t0=np.nan),
        NonFiniteError,
        "`t0` is not finite: nan",
    ),
    row(
        "gave a matrix as time",
        lambda: run(Y0, t0=jnp.ones((1, 1))),
        ShapeError,
        "`t0` has shape (1, 1)",
    ),
    row(
        "gave the Lagrangian in place of the system",
        lambda: run(Y0, system=kinetic),
        TypeError,
        "`system` must be an nhjax.LagrangianSystem",
    ),
    row(
        "gave a machine of the gallery in place of its system",
        lambda: run(Y0, system=PARTICLE),
        TypeError,
        "got NonholonomicParticle; pass its attribute `.system`",
    ),
    row(
        "gave a machine of the gallery in place of its state",
        lambda: run(PARTICLE),
        TypeError,
        "`y0` must be an nhjax.State",
        "`machine.initial_state()`",
    ),
    row(
        "gave positions in place of a state",
        lambda: run(Q),
        TypeError,
        "`y0` must be an nhjax.State",
        "Create one with nhjax.initial_state",
    ),
    row(
        "went on from a solution in place of its last state",
        lambda: run(trajectory()),
        TypeError,
        "`y0` must be an nhjax.State or nhjax.Checkpoint, got Solution",
        "`jax.tree.map(lambda x: x[-1], sol.ys)`",
    ),
    row(
        "went on from all states of a solution",
        lambda: run(trajectory().ys),
        ShapeError,
        "`y0.q` has shape (3, 3), but a state has shape (n,)",
        "For many trajectories use `jax.vmap` over `y0`",
    ),
    row(
        "went on from the state of another system",
        lambda: run(systems.HarmonicOscillator().initial_state()),
        ShapeError,
        "`y0.multiplier` has shape (0,), but the constraints of the system have shape",
        "Use `initial_state` with this system",
    ),
    row(
        "exchanged method and state",
        lambda: NHJAX.integrate(SYSTEM, Y0, METHOD, dt=0.1, num_steps=2),
        TypeError,
        "`method` must be an nhjax.LobattoIIIAB",
        "got State",
    ),
    row(
        "gave a number as method",
        lambda: run(Y0, method=3),
        TypeError,
        "`method` must be an nhjax.LobattoIIIAB",
        "got 3 of type int",
        "For example, pass nhjax.LobattoIIIAB(3)",
    ),
    row(
        "gave the class of a method",
        lambda: run(Y0, method=nhjax.LobattoIIIAB),
        TypeError,
        "got the class itself; write LobattoIIIAB(...)",
    ),
    row(
        "gave the name of a solver",
        lambda: run(Y0, stage_solver="newton"),
        TypeError,
        "`stage_solver` must be",
        "got 'newton'",
        "nhjax.Newton()",
    ),
    row(
        "gave the name of an adjoint",
        lambda: run(Y0, adjoint="direct"),
        TypeError,
        "`adjoint` must be an nhjax.AbstractAdjoint, got 'direct'",
        "For example, pass nhjax.DirectAdjoint()",
    ),
    row(
        "gave True as what is saved",
        lambda: run(Y0, saveat=True),
        TypeError,
        "`saveat` must be an nhjax.SaveAt, got True",
        "For example, pass nhjax.SaveAt(t0=True, steps=True)",
    ),
    row(
        "gave True as progress meter",
        lambda: run(Y0, progress_meter=True),
        TypeError,
        "`progress_meter` must be",
        "got True of type bool",
    ),
    row(
        "gave a word as `throw`",
        lambda: run(Y0, throw="no"),
        TypeError,
        "`throw` must be True or False",
        "got 'no' of type str",
    ),
    row(
        "took a method that cannot keep constraints",
        lambda: run(Y0, method=nhjax.Gauss(2)),
        ValueError,
        "Gauss(stages=2) cannot integrate a constrained system: hypothesis H1",
        "use LobattoIIIAB",
    ),
    row(
        "asked for dense output of a method without polynomials",
        lambda: run(
            nhjax.State(Q, V, V, jnp.zeros(0)),
            FREE,
            EXPLICIT_RK4,
            saveat=SaveAt(dense=True),
        ),
        ValueError,
        "C(q) for q >= stages = 4",
        "Use LobattoIIIAB or Gauss",
    ),
    row(
        "saved every fifth of four steps",
        lambda: run(Y0, saveat=SaveAt(steps=5)),
        ValueError,
        "SaveAt: `steps=5` saves nothing in a run of 4 steps. Add `t1=True`",
    ),
    row(
        "saved at times after the end of the run",
        lambda: run(Y0, saveat=SaveAt(ts=[0.1, 0.5])),
        ValueError,
        "SaveAt: `ts` reaches from 0.1 to 0.5, outside the run from 0.0 to 0.4",
    ),
    row(
        "saved at times before the start of the run",
        lambda: run(Y0, saveat=SaveAt(ts=[-0.1, 0.1])),
        ValueError,
        "SaveAt: `ts` reaches from -0.1",
    ),
    row(
        "saved at falling times in a run forward",
        lambda: run(Y0, saveat=SaveAt(ts=[0.2, 0.1])),
        ValueError,
        "`ts` must be sorted in the direction of time, which runs forward",
    ),
    row(
        "saved at rising times in a run backward",
        lambda: run(Y0, saveat=SaveAt(ts=[-0.2, -0.1]), dt=-0.1),
        ValueError,
        "`ts` must be sorted in the direction of time, which runs backward",
    ),
    row(
        "put a set into `args`",
        lambda: run(Y0, args=({3},)),
        TypeError,
        "`args[0]` is {3} of type set",
    ),
    row(
        "changed the velocity of a state by hand",
        lambda: run(nhjax.State(Y0.q, 2 * Y0.v + 1, Y0.p, Y0.multiplier)),
        IntegrationError,
        "step 0: The initial state violates the constraints",
        "Create `y0` with `nhjax.initial_state`",
    ),
    row(
        "gave one step its arguments in the order of `integrate`",
        lambda: NHJAX.step(SYSTEM, METHOD, Y0, 0.0, 0.1),
        TypeError,
        "`y` must be an nhjax.State, got 0.1",
        "Call it as `step(system, method, t, dt, y, args)`",
    ),
    row(
        "asked for a state between steps that were not saved",
        lambda: trajectory().evaluate(0.1),
        ValueError,
        "pass `saveat=nhjax.SaveAt(dense=True)` to `integrate`",
    ),
    row(
        "asked to keep an invariant by an unknown name",
        lambda: run(Y0, invariants="momentum"),
        TypeError,
        '`invariants` must be None, "energy" or a function of (t, q, v, args)',
        "got 'momentum'",
    ),
    row(
        "gave an invariant the state",
        lambda: run(Y0, invariants=lambda t, y, args: y.q[0]),
        TypeError,
        "integrate: `invariants` must take (t, q, v, args)",
        "`<lambda>(t, y, args)` does not",
    ),
    row(
        "asked to keep the energy of a system with a force",
        lambda: run(
            nhjax.State(Q, V, V, jnp.zeros(0)),
            system_with(force=lambda t, q, v, args: -v),
            invariants="energy",
        ),
        ValueError,
        "the system has a `force`, which may do work, so that its energy is not",
        "If it conserves another quantity, pass that as a function",
    ),
    row(
        "asked to keep the energy of a system that depends on time",
        lambda: run(
            nhjax.State(Q, V, V, jnp.zeros(0)),
            system_with(lagrangian=lambda t, q, v, args: 0.5 * v @ v - t * q[0]),
            invariants="energy",
        ),
        ValueError,
        "has a `lagrangian` that depends on time",
    ),
    row(
        "asked to keep more invariants than there are degrees of freedom",
        lambda: run(Y0, invariants=lambda t, q, v, args: jnp.ones(5)),
        ShapeError,
        "`invariants` must return an array of shape () or (k,) with 1 <= k <= 2",
        "got shape (5,)",
    ),
]

EVENTS = [
    row(
        "gave a number as condition",
        lambda: ANY_EVENT(1.0),
        TypeError,
        "Event: `cond_fn` must be a function of (t, y, args), got 1.0",
    ),
    row(
        "left `args` out of a condition",
        lambda: ANY_EVENT(lambda t, y: y.q[0]),
        TypeError,
        "Event: `cond_fn` must take (t, y, args), but `<lambda>(t, y)` does not",
    ),
    row(
        "gave a condition the arguments of a Lagrangian",
        lambda: ANY_EVENT(lambda t, q, v, args: q[0]),
        TypeError,
        "Event: `cond_fn` must take (t, y, args), but `<lambda>(t, q, v, args)`",
    ),
    row(
        "took the state before the time in a condition",
        lambda: Event(lambda y, t, args: y.q[0]),
        TypeError,
        "Event: `cond_fn` must take (t, y, args), in this order",
    ),
    row(
        "left `args` out of a reset",
        lambda: ANY_EVENT(lambda t, y, args: t, reset=lambda t, y: (y.q, -y.v)),
        TypeError,
        "Event: `reset` must take (t, y, args), but `<lambda>(t, y)` does not",
    ),
    row(
        "gave a direction as a word",
        lambda: ANY_EVENT(lambda t, y, args: t, direction="up"),
        TypeError,
        "Event: `direction` must be True or False, for functions that increase or",
        "None for both, got 'up'",
    ),
    row(
        "gave a word as `terminate`",
        lambda: ANY_EVENT(lambda t, y, args: t, terminate="yes"),
        TypeError,
        "`terminate` must be True or False",
        "got 'yes'",
    ),
    row(
        "made room for no event",
        lambda: Event(lambda t, y, args: t, max_events=0),
        ValueError,
        "Event: `max_events` must be an int >= 1, got 0",
    ),
    row(
        "gave a condition where an event belongs",
        lambda: falls(lambda t, y, args: t),
        TypeError,
        "`event` must be an nhjax.Event",
        "For example, pass nhjax.Event(cond_fn)",
    ),
    row(
        "compared in a condition",
        lambda: falls(Event(lambda t, y, args: y.q[0] < 0)),
        DTypeError,
        "Event 0: `cond_fn(t, y, args)` returns dtype bool",
        "return a real number whose zero is the event",
    ),
    row(
        "gave several conditions in one event",
        lambda: falls(Event(lambda t, y, args: y.q)),
        ShapeError,
        "Event 0: `cond_fn(t, y, args)` must return shape (), a scalar, got shape (3,)",
        "give `event` a sequence of events",
    ),
    row(
        "returned the velocity alone from a reset",
        lambda: falls(Event(lambda t, y, args: t - 1, reset=lambda t, y, args: -y.v)),
        TypeError,
        "Event 0: `reset(t, y, args)` must return a pair (q, v) or an nhjax.State",
    ),
    row(
        "asked for dense output of a run with events",
        lambda: falls(Event(lambda t, y, args: t - 1), saveat=SaveAt(dense=True)),
        ValueError,
        "SaveAt: `dense=True` is not available together with `event`",
        "Save at `steps`",
    ),
    row(
        "asked for invariants of a run with events",
        lambda: falls(Event(lambda t, y, args: t - 1), invariants="energy"),
        ValueError,
        "`invariants` are not available together with `event`",
        "Leave out one of the two",
    ),
]

ENSEMBLES = [
    row(
        "gave members of different numbers",
        lambda: nhjax.ensemble(lambda x: x[0], (np.ones(3), np.ones(4))),
        ShapeError,
        "`members[0]` has 3, `members[1]` has 4",
    ),
    row(
        "gave a single number as members",
        lambda: nhjax.ensemble(lambda x: x, 1.0),
        ShapeError,
        "is a single number",
        "`run` can close over shared values",
    ),
    row(
        "gave no members",
        lambda: nhjax.ensemble(lambda x: x, np.ones((0, 2))),
        ShapeError,
        "`members` has no members: it needs arrays with rows",
    ),
    row(
        "gave a word as member",
        lambda: nhjax.ensemble(lambda x: x, ["x"]),
        TypeError,
        "`members[0]` is 'x', but `members` must hold arrays",
    ),
    row(
        "gave a number of members that is not theirs",
        lambda: nhjax.ensemble(lambda x: x, MEMBERS, num_members=4),
        ValueError,
        "`num_members` is 4, but the arrays of `members` have 3 rows: leave it out",
    ),
    row(
        "gave a function of the index without the number of members",
        lambda: nhjax.ensemble(lambda x: x, lambda i: i),
        ValueError,
        "`num_members` is needed if `members` is a function",
    ),
    row(
        "asked for no member",
        lambda: nhjax.ensemble(lambda x: x, lambda i: i, num_members=0),
        ValueError,
        "`num_members` must be at least 1, got 0",
    ),
    row(
        "gave the number of members as a float",
        lambda: NHJAX.ensemble(lambda x: x, lambda i: i, num_members=2.0),
        TypeError,
        "`num_members` must be an int, got 2.0",
    ),
    row(
        "asked for chunks of no member",
        lambda: nhjax.ensemble(lambda x: x, MEMBERS, chunk_size=0),
        ValueError,
        "`chunk_size` must be at least 1, got 0",
    ),
    row(
        "gave the size of chunks as a float",
        lambda: NHJAX.ensemble(lambda x: x, MEMBERS, chunk_size=1.5),
        TypeError,
        "`chunk_size` must be an int, got 1.5",
    ),
    row(
        "gave a solution in place of the run",
        lambda: NHJAX.ensemble(trajectory(), MEMBERS),
        TypeError,
        "`run` must be a function of one member",
        "of type Solution",
    ),
    row(
        "returned a word from the run",
        lambda: nhjax.ensemble(lambda x: "text", MEMBERS),
        TypeError,
        "`run(member)` is 'text', but `run` must return arrays",
    ),
    row(
        "forgot the return of the run",
        lambda: nhjax.ensemble(lambda x: None, MEMBERS),
        TypeError,
        "`run` must return arrays for each member",
        "got None: is a `return` missing?",
    ),
    row(
        "gave the name of a reduction",
        lambda: nhjax.ensemble(lambda x: x, MEMBERS, reduce="mean"),
        TypeError,
        "`reduce` holds 'mean', but it must be a reduction, such as `nhjax.Mean()`",
    ),
    row(
        "gave a number of devices",
        lambda: NHJAX.ensemble(lambda x: x, MEMBERS, devices=2),
        TypeError,
        "`devices` must be a sequence of devices, such as `jax.local_devices()[:2]`",
        "got 2",
    ),
    row(
        "gave a word as progress meter",
        lambda: NHJAX.ensemble(lambda x: x, MEMBERS, progress_meter="bar"),
        TypeError,
        "`progress_meter` must be a progress meter such as `nhjax.TqdmProgressMeter()`",
    ),
    row(
        "gave a word as `resume`",
        lambda: NHJAX.ensemble(lambda x: x, MEMBERS, resume="no"),
        TypeError,
        "`resume` must be True or False",
    ),
    row(
        "gave a solution as name of the store",
        lambda: NHJAX.ensemble(lambda x: x, MEMBERS, out=trajectory()),
        TypeError,
        "`out` must be the name of a folder",
        "of type Solution",
    ),
    row(
        "called it in a compiled function",
        lambda: jax.jit(lambda x: nhjax.ensemble(lambda y: y, x).values)(MEMBERS),
        RuntimeError,
        "call it outside of jit, vmap and grad",
    ),
    row(
        "gave a number of bins in place of their edges",
        lambda: NHJAX.Histogram(10),
        ValueError,
        "`edges` must be a sequence of two or more numbers, got shape ()",
    ),
]

RESULTS_OF_RUNS = [
    row(
        "exchanged state and time in the energy",
        lambda: NHJAX.LagrangianSystem.energy(SYSTEM, Y0, 0.0),
        TypeError,
        "`t` must be a time, got an nhjax.State",
        "Call it as `energy(t, y, args)`",
    ),
    row(
        "took the energy of all states at once",
        lambda: SYSTEM.energy(trajectory().ts, trajectory().ys),
        ShapeError,
        "`y.p` has shape (3, 3), but the state at one time has shape (n,)",
        "For a trajectory use `jax.vmap` over `t` and `y`",
    ),
    row(
        "exchanged system and solution in the energy error",
        lambda: NHJAX.energy_error(trajectory(), SYSTEM),
        TypeError,
        "`system` must be an nhjax.LagrangianSystem",
        "got Solution",
    ),
    row(
        "gave a machine of the gallery to the energy error",
        lambda: NHJAX.energy_error(PARTICLE, trajectory()),
        TypeError,
        "`system` must be",
        "pass its attribute `.system`",
    ),
    row(
        "gave states in place of the solution",
        lambda: NHJAX.energy_error(SYSTEM, trajectory().ys),
        TypeError,
        "`sol` must be an nhjax.Solution, got State",
    ),
    row(
        "gave the solution in place of its states",
        lambda: NHJAX.momentum_map(trajectory(), lambda q: q),
        TypeError,
        "`y` must be an nhjax.State, got Solution",
        "Pass for instance `sol.ys`",
    ),
    row(
        "gave a vector in place of a generator",
        lambda: NHJAX.momentum_map(Y0, Y0.q),
        TypeError,
        "`generator` must be a function of q, got ",
    ),
    row(
        "gave a generator of too few components",
        lambda: nhjax.momentum_map(Y0, lambda q: q[:2]),
        ShapeError,
        "`generator(q)` has shape (2,), expected (3,): one component for each velocity",
    ),
    row(
        "gave one step size to find an order",
        lambda: nhjax.convergence_order([0.1], [1.0]),
        ValueError,
        "`step_sizes` must be a vector of at least two",
    ),
    row(
        "gave an error of zero to find an order",
        lambda: nhjax.convergence_order([0.1, 0.2], [1.0, 0.0]),
        ValueError,
        "errors(1,) = 0.0. Omit this entry",
    ),
    row(
        "gave the position in place of the state",
        lambda: NHJAX.motion(SYSTEM, 0.0, Q),
        TypeError,
        "`y` must be an nhjax.State",
        "Call it as `motion(system, t, y, args)`",
    ),
    row(
        "gave a state to the report on a system",
        lambda: NHJAX.check_system(SYSTEM, Y0),
        TypeError,
        "`q` must be a configuration, got an nhjax.State",
    ),
    row(
        "asked for a steady motion without saying of what",
        lambda: NHJAX.steady_motion(SYSTEM, 0.0, Y0),
        ValueError,
        "`positions` is missing: pass `positions` and `velocities` together",
    ),
    row(
        "named coordinates where indices belong",
        lambda: NHJAX.steady_motion(SYSTEM, 0.0, Y0, positions=("x",), velocities=(0,)),
        TypeError,
        "`positions` must be a sequence of integers, got ('x',)",
    ),
    row(
        "gave a vector in place of a symmetry",
        lambda: NHJAX.linear_stability(SYSTEM, 0.0, Y0, symmetry=V),
        TypeError,
        "`symmetry` must be a function of q that returns generators",
    ),
    row(
        "drew states in place of a solution",
        lambda: ANY_PLOT.trajectory(trajectory().ys),
        TypeError,
        "`sol` must be an nhjax.Solution",
        "`nhjax.integrate` returns one",
    ),
    row(
        "exchanged system and solution in a figure",
        lambda: ANY_PLOT.energy(trajectory(), SYSTEM),
        TypeError,
        "`system` must be an nhjax.LagrangianSystem",
    ),
    row(
        "named the coordinates of a figure, which the system does not name",
        lambda: ANY_PLOT.trajectory(trajectory(), "xy"),
        ValueError,
        "`coordinates` has 'x', but there are no names",
    ),
    row(
        "drew a coordinate that is not there",
        lambda: plot.trajectory(trajectory(), (0, 5)),
        ValueError,
        "`coordinates` must be two or three indices into the 3 coordinates",
    ),
    row(
        "drew into something that is not axes",
        lambda: ANY_PLOT.energy(SYSTEM, trajectory(), ax=SYSTEM),
        TypeError,
        "`ax` must be axes of matplotlib",
    ),
    row(
        "animated an array in place of named points",
        lambda: ANY_PLOT.animate(trajectory().ts, trajectory().ys.q),
        TypeError,
        "`points` must be positions by name",
    ),
    row(
        "gave a machine of the gallery a negative mass",
        lambda: systems.HarmonicOscillator(mass=-1.0),
        ValueError,
        "`mass` must be positive, got -1.0",
    ),
    row(
        "gave the bicycle a number as steering",
        lambda: systems.WhippleBicycle(steering=3.0),  # pyright: ignore
        TypeError,
        "`steering` must be a function of",
    ),
    row(
        "gave the bicycle a steering that returns a force for each coordinate",
        lambda: systems.WhippleBicycle(
            steering=lambda t, q, v, args: 0 * v
        ).initial_state(),
        nhjax.ShapeError,
        "must return one torque of shape (), got shape (8,)",
    ),
    row(
        "gave a machine of the gallery a word as mass",
        lambda: systems.HarmonicOscillator(mass="heavy"),  # pyright: ignore
        TypeError,
        "A parameter must be a number, got 'heavy' of type str",
    ),
    row(
        "named coordinates of a data set that are not there",
        lambda: trajectory().to_xarray(coordinates=("x",)),
        ValueError,
        "`coordinates` has the names ('x',), but 3 different names are needed",
    ),
    row(
        "imported a model without coordinates",
        lambda: NHJAX.from_sympy(1, []),
        ValueError,
        "`coordinates` is empty",
    ),
]

FILES = [
    row(
        "saved under the name of a file of NetCDF",
        lambda folder: nhjax.save(folder / "x.nc", Y0),
        ValueError,
        "'x.nc' has the suffix of another format",
        "use `sol.to_xarray()`",
        "or a name that ends in .npz",
    ),
    row(
        "saved under the name of a pickle",
        lambda folder: nhjax.save(folder / "x.pkl", Y0),
        ValueError,
        "has the suffix of another format",
    ),
    row(
        "exchanged the name and what is saved",
        lambda folder: NHJAX.save(Y0, folder / "x.npz"),
        TypeError,
        "`path` must be the name of a file, got an object of type State",
        "Call it as `save(path, tree)`",
    ),
    row(
        "saved a system",
        lambda folder: nhjax.save(folder / "x.npz", SYSTEM),
        TypeError,
        "of type LagrangianSystem, which cannot be saved",
        "A file holds states, solutions, checkpoints",
    ),
    row(
        "saved in a compiled function",
        lambda folder: jax.jit(lambda q: nhjax.save(folder / "x.npz", q))(Q),
        TypeError,
        "call `nhjax.save` outside of jit, vmap and grad",
    ),
    row(
        "saved into a folder that is not there",
        lambda folder: nhjax.save(folder / "nowhere" / "x.npz", Y0),
        FileNotFoundError,
        "does not exist: create it first",
    ),
    row(
        "loaded a file that is not there",
        lambda folder: nhjax.load(folder / "x.npz"),
        FileNotFoundError,
        "does not exist.",
    ),
    row(
        "loaded a folder",
        nhjax.load,
        IsADirectoryError,
        "is a folder: give the name of a file that `nhjax.save` has written",
        "`xarray.open_zarr`",
    ),
    row(
        "loaded a text",
        lambda folder: nhjax.load(written(folder / "notes.txt")),
        ValueError,
        "is not a file of `nhjax.save`, or is damaged: it is not an .npz",
    ),
    row(
        "gave an ensemble the name of a file of NetCDF",
        lambda folder: nhjax.ensemble(lambda x: x, MEMBERS, out=folder / "x.nc"),
        ValueError,
        "but it names a folder, in which programs that read .nc find no file",
        "`xarray.open_zarr`",
    ),
    row(
        "gave an ensemble a file in place of a folder",
        lambda folder: nhjax.ensemble(
            lambda x: x, MEMBERS, out=written(folder / "notes")
        ),
        FileExistsError,
        "is a file: `out` names a folder",
    ),
]


def written(path: Path) -> Path:
    path.write_text("a text")
    return path


MISTAKES = [
    *SYSTEMS,
    *VALUES_OF_FUNCTIONS,
    *TRACING,
    *STATES,
    *METHODS,
    *SAVING,
    *RUNS,
    *EVENTS,
    *ENSEMBLES,
    *RESULTS_OF_RUNS,
]


def said(error: BaseException) -> str:
    return "\n".join([str(error), *getattr(error, "__notes__", [])])


def check(mistake: Mistake, *given: Any) -> None:
    with pytest.raises(mistake.error) as error:
        mistake.do(*given)
    text = said(error.value)
    assert [phrase for phrase in mistake.says if phrase not in text] == [], text


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.what)
def test_mistake_raises_message_with_remedy(mistake):
    check(mistake)


@pytest.mark.parametrize("mistake", FILES, ids=lambda mistake: mistake.what)
def test_mistake_with_files_raises_message_with_remedy(mistake, tmp_path):
    check(mistake, tmp_path)
    assert [path.name for path in tmp_path.iterdir() if path.suffix == ".nc"] == []


def test_table_of_mistakes_has_many_rows_and_phrases_for_each():
    every = [*MISTAKES, *FILES]
    assert len({(mistake.what, mistake.says) for mistake in every}) >= 200
    assert all(mistake.says for mistake in every)
