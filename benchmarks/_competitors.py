"""Alternatives to nhjax: equations of motion by hand, and solvers of other libraries.

In all four systems, M is the identity on the constrained coordinates. The accelerations
a = f + Bᵀλ with B a = γ then give the multiplier λ = (γ - B f)/(B Bᵀ) in closed form,
without linear algebra. The equations are written in scalars, so that the same functions
work for JAX, plain Python and NumPy's long double.
"""

import math
import statistics
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.integrate import solve_ivp
from sksundae.ida import IDA

from nhjax import systems


# The force f; the nonzero entries of the single row of B, by index; and γ.
Forces = tuple[list, dict[int, Any], Any]


def _particle(lib: Any, q: Sequence, v: Sequence) -> Forces:
    x, y, _ = q
    return [-x, -y, 0.0], {0: -y, 2: 1.0}, v[1] * v[0]


def _cvt(lib: Any, q: Sequence, v: Sequence) -> Forces:
    x, y, z = q
    sin = lib.sin(y)
    # The parameter ε has its default ½. The identity cos 2y = 1 - 2 sin² y saves the
    # evaluation of a cosine.
    f = [-x, -sin - 0.5 * (1 - 2 * sin * sin), -z]
    return f, {0: sin, 2: 1.0}, -lib.cos(y) * v[1] * v[0]


def _chaotic(lib: Any, q: Sequence, v: Sequence) -> Forces:
    s2, s3, s4, s5, s6, s7 = (x * x for x in q[1:])
    f = [
        -q[0],
        -q[1] * (1 + s5),
        -q[2] * (1 + s6),
        -q[3] * (1 + s7),
        -q[4] * (1 + s2 + s6),
        -q[5] * (1 + s3 + s5),
        -q[6] * (1 + s4),
    ]
    gamma = -(v[4] * v[4] + v[5] * v[5] + v[6] * v[6])
    return f, {0: 1.0, 4: q[4], 5: q[5], 6: q[6]}, gamma


def _unicycle(lib: Any, q: Sequence, v: Sequence) -> Forces:
    x, y, heading = q
    cos, sin = lib.cos(heading), lib.sin(heading)
    turn = v[2] * (v[1] * sin + v[0] * cos)
    return [-x, -y, 0.0], {0: -sin, 1: cos}, turn


def _reduced_unicycle(lib: Any, y: Sequence) -> list:
    """Compute the rate of (x, y, θ, u, ω), without a variable for the zero side slip.

    The speed u is along the heading θ, and ω = dθ/dt.
    """
    x1, x2, heading, u, omega = y
    cos, sin = lib.cos(heading), lib.sin(heading)
    return [u * cos, u * sin, omega, -(x1 * cos + x2 * sin), 0.0 * omega]


def _eliminated(forces: Callable[..., Forces], lib: Any, y: Sequence) -> list:
    n = len(y) // 2
    q, v = y[:n], y[n:]
    f, row, gamma = forces(lib, q, v)
    defect, size = gamma, 0.0
    for i, b in row.items():
        defect = defect - b * f[i]
        size = size + b * b
    multiplier = defect / size
    # The terms `0 λ` are omitted, because plain Python would compute them.
    return [*v, *(x + row[i] * multiplier if i in row else x for i, x in enumerate(f))]


class Problem(NamedTuple):
    """One system: its example in nhjax, and its equations by hand."""

    example: Any
    forces: Callable[..., Forces]
    field: Callable[[Any, Sequence], list]
    to_state: Callable[[Any, Any], Any]  # (q, v) to the state of `field`
    from_state: Callable[[Any], tuple[Any, Any]]
    # A function of q: the angle by which the velocity in nhjax is rotated to get the
    # velocity that `forces` takes.
    turn: Callable[[np.ndarray], float]

    def members(self, number: int) -> tuple[Array, Array]:
        """Return the initial (q, v) of `number` members.

        A single member starts from the state of the example.
        """
        q0, v0 = self.example.q0, self.example.v0
        if number == 1:
            return q0[None], v0[None]
        if isinstance(self.example, systems.ChaoticSystem):
            return self.example.ensemble(number - 1)
        scale = jnp.linspace(0.5, 1.5, number)[:, None]
        q, v = q0[None] * scale, v0[None] * scale[::-1]
        if isinstance(self.example, systems.NonholonomicParticle):
            v = v.at[:, 2].set(q[:, 1] * v[:, 0])
        return q, v

    def exact(self, q: np.ndarray, v: np.ndarray, t: float) -> np.ndarray | None:
        """Return (q, v) of each member at the time `t`, or None without closed form."""
        kind = type(self.example)
        if not hasattr(kind, "exact"):
            return None
        ends = [kind(q0=a, v0=b).exact(t) for a, b in zip(q, v, strict=True)]
        return np.array([np.concatenate([end[0], end[1]]) for end in ends])


def _halves(y: Any) -> tuple[Any, Any]:
    n = y.shape[-1] // 2
    return y[..., :n], y[..., n:]


def _from_reduced(y: Any) -> tuple[Any, Any]:
    u, omega = y[..., 3], y[..., 4]
    return y[..., :3], np.stack([u, np.zeros_like(u), omega], -1)


def _on_vector_space(example: Any, forces: Callable[..., Forces]) -> Problem:
    return Problem(
        example,
        forces,
        partial(_eliminated, forces),
        lambda q, v: np.concatenate([q, v], -1),
        _halves,
        lambda q: 0.0,
    )


def problems() -> dict[str, Problem]:
    """Return the systems by name, with default parameters."""
    return {
        "chaotic": _on_vector_space(systems.ChaoticSystem(), _chaotic),
        "particle": _on_vector_space(systems.NonholonomicParticle(), _particle),
        "CVT": _on_vector_space(systems.ContinuouslyVariableTransmission(), _cvt),
        "unicycle": Problem(
            systems.Unicycle(),
            _unicycle,
            _reduced_unicycle,
            lambda q, v: np.concatenate([q, v[..., ::2]], -1),
            _from_reduced,
            lambda q: float(q[2]),
        ),
    }


def extrapolated(problem: Problem, y0: np.ndarray, t: float, step: float) -> np.ndarray:
    """Compute a reference at `t` by Gragg's extrapolation of order 20, in long double.

    The result is the state of `field`. The reference has no coefficients in common with
    the methods that it judges. Its round-off is smaller too, on machines where long
    double has more digits than float64.
    """
    lib, half = np, np.longdouble(0.5)
    y = np.asarray(y0, np.longdouble).T
    number = math.ceil(t / step)
    h = np.longdouble(t) / number
    divisions = [2 * (k + 1) for k in range(10)]

    def field(y: np.ndarray) -> np.ndarray:
        return np.stack(np.broadcast_arrays(*problem.field(lib, list(y))))

    for _ in range(number):
        start = field(y)
        table: list[np.ndarray] = []
        for k, division in enumerate(divisions):
            part = h / division
            # Sums are increments of y, whose round-off is far below the round-off of y.
            before, now = np.zeros_like(y), part * start
            for _ in range(division - 1):
                before, now = now, before + 2 * part * field(y + now)
            row = [half * (before + now + part * field(y + now))]
            for j in range(k):
                ratio = np.longdouble(division) / divisions[k - j - 1]
                row.append(row[j] + (row[j] - table[j]) / (ratio * ratio - 1))
            table = row
        y = y + table[-1]
    return y.T.astype(np.float64)


SOLVERS = {
    "Tsit5": diffrax.Tsit5,
    "Dopri8": diffrax.Dopri8,
    "Kvaerno5": diffrax.Kvaerno5,
}


def diffrax_run(
    problem: Problem, solver: str, layout: str, fixed: bool, t: float
) -> Callable[[Any, Array], Any]:
    """Create a function that integrates by diffrax, and returns the state at the end.

    The function takes the initial state and the tolerance, or the step size if `fixed`.
    `layout` is "array" for one trajectory. For an ensemble it is "vmap", where the
    state of a member is a tuple of scalars, or "stacked", where all members form one
    equation of shape (n, members) and share their steps.
    """

    def field(t, y, args):
        derivative = problem.field(jnp, tuple(y))
        return tuple(derivative) if layout == "vmap" else jnp.stack(derivative)

    def run(y, accuracy):
        controller = diffrax.ConstantStepSize()
        if not fixed:
            controller = diffrax.PIDController(rtol=accuracy, atol=accuracy)
        sol = diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            SOLVERS[solver](),
            0.0,
            t,
            accuracy if fixed else None,
            y,
            saveat=diffrax.SaveAt(t1=True),
            stepsize_controller=controller,
            # Without derivatives, runs with this adjoint are the fastest.
            adjoint=diffrax.ForwardMode(),
            max_steps=None,
            throw=False,
        )
        return jax.tree.map(lambda x: x[-1], sol.ys), sol.stats["num_steps"]

    return jax.vmap(run, in_axes=(0, None)) if layout == "vmap" else run


def diffrax_state(layout: str, y0: np.ndarray) -> Any:
    """Convert `y0`, of shape (members, n), to the state for `layout`."""
    if layout == "array":
        return jnp.asarray(y0[0])
    if layout == "stacked":
        return jnp.asarray(np.ascontiguousarray(y0.T))
    return tuple(jnp.asarray(column) for column in y0.T.copy())


def from_diffrax(layout: str, y: Any) -> np.ndarray:
    """Convert a state of `layout` back to an array of shape (members, n)."""
    if layout == "array":
        return np.asarray(y)[None]
    return np.stack([np.asarray(column) for column in y], -1)


class HostField(NamedTuple):
    """The right-hand side for SciPy, in plain Python and as a compiled JAX function."""

    plain: Callable[[float, np.ndarray], np.ndarray]
    jitted: Callable[[float, np.ndarray], np.ndarray]
    jacobian: Callable[[float, np.ndarray], np.ndarray]

    def microseconds(self, y: np.ndarray) -> dict[str, float]:
        """Measure the microseconds of one evaluation of each form."""
        times = {}
        for name in ("plain", "jitted"):
            field, samples = getattr(self, name), []
            for _ in range(9):
                start = time.perf_counter()
                for _ in range(200):
                    field(0.0, y)
                samples.append((time.perf_counter() - start) / 200)
            times[name] = 1e6 * statistics.median(samples)
        return times


def host_field(problem: Problem) -> HostField:
    """Create the right-hand side of a problem for SciPy."""

    def plain(t: float, y: np.ndarray) -> np.ndarray:
        # Python's floats are several times faster than NumPy's scalars.
        return np.array(problem.field(math, y.tolist()))

    def traced(y):
        return jnp.stack(problem.field(jnp, tuple(y)))

    compiled, jacobian = jax.jit(traced), jax.jit(jax.jacfwd(traced))
    return HostField(
        plain,
        lambda t, y: np.asarray(compiled(y)),
        lambda t, y: np.asarray(jacobian(y)),
    )


def scipy_run(
    field: HostField, form: str, method: str, y0: np.ndarray, t: float
) -> Callable[[float], np.ndarray | None]:
    """Create a function from a tolerance to the state at the end.

    The function returns None if the solver fails.
    """
    options: dict[str, Any] = {"jac": field.jacobian} if method == "Radau" else {}

    def run(tolerance: float) -> np.ndarray | None:
        out = solve_ivp(
            getattr(field, form),
            (0.0, t),
            y0,
            method=method,
            # SciPy does not accept a smaller relative tolerance.
            rtol=max(tolerance, 3e-14),
            atol=tolerance,
            t_eval=(t,),
            **options,
        )
        return out.y[:, -1] if out.success else None

    return run


def _turned(v: np.ndarray, angle: float) -> np.ndarray:
    if angle == 0:
        return v
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([v[0] * cos - v[1] * sin, v[0] * sin + v[1] * cos, *v[2:]])


def ida_run(
    problem: Problem, q0: np.ndarray, v0: np.ndarray, t: float, index: int
) -> Callable[[float], tuple[np.ndarray, np.ndarray] | None]:
    """Create a function from a tolerance to (q, v) at `t`, computed by IDA.

    The function returns None if IDA fails. The unknowns are (q, v, λ). The equations
    are q̇ = v, v̇ = f + Bᵀλ and the constraint: Φ = B v = 0 for index 2, or its
    derivative B v̇ = γ for index 1.
    """
    n, v0 = len(q0), _turned(v0, problem.turn(q0))

    def residual(t, y, yp, res):
        state, rate = y.tolist(), yp.tolist()
        q, v = state[:n], state[n : 2 * n]
        f, row, gamma = problem.forces(math, q, v)
        multiplier = state[-1]
        out = [a - b for a, b in zip(rate[:n], v, strict=True)]
        out += [a - b for a, b in zip(rate[n : 2 * n], f, strict=True)]
        # For index 1, v̇ = f + Bᵀλ is inserted into B v̇ = γ, which is an algebraic
        # equation for λ.
        defect = 0.0 if index == 2 else -gamma
        for i, b in row.items():
            out[n + i] -= b * multiplier
            defect += b * v[i] if index == 2 else b * (f[i] + b * multiplier)
        res[:] = [*out, defect]

    start = _eliminated(problem.forces, math, [*q0.tolist(), *v0.tolist()])
    f, row, _ = problem.forces(math, q0.tolist(), v0.tolist())
    i, b = next((i, b) for i, b in row.items() if b != 0)
    multiplier = (start[n + i] - f[i]) / b
    y0 = np.array([*q0, *v0, multiplier])
    yp0 = np.array([*start, 0.0])

    def run(tolerance: float) -> tuple[np.ndarray, np.ndarray] | None:
        # The error estimates of BDF are poor for λ in a system of index 2. The large
        # tolerance for λ removes its influence on the step sizes.
        atol = np.full(2 * n + 1, tolerance)
        atol[-1] = 1e3 if index == 2 else tolerance
        solver = IDA(
            residual,
            algebraic_idx=[2 * n],
            rtol=tolerance,
            atol=atol,
            max_num_steps=10**7,
        )
        out = solver.solve(np.array([0.0, t]), y0, yp0)
        if not out.success:
            return None
        q, v = out.y[-1, :n], out.y[-1, n : 2 * n]
        return q, _turned(v, -problem.turn(q))

    return run
