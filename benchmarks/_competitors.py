"""What one would use instead of nhjax: the equations by hand, and solvers for them.

The multiplier is eliminated in closed form: where M is a multiple of the identity on
the constrained coordinates, as in all four systems, a = f + Bᵀλ with B a = γ gives
λ = (γ - B f)/(B Bᵀ), and no linear algebra is left. The equations are written on
scalars, so that the same lines serve JAX, plain Python and long double NumPy.
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


# f, the nonzero entries of the one row of B, and γ.
Forces = tuple[list, dict[int, Any], Any]


def _particle(lib: Any, q: Sequence, v: Sequence) -> Forces:
    x, y, _ = q
    return [-x, -y, 0.0], {0: -y, 2: 1.0}, v[1] * v[0]


def _cvt(lib: Any, q: Sequence, v: Sequence) -> Forces:
    x, y, z = q
    sin = lib.sin(y)
    # The default ε = ½; cos 2y = 1 - 2 sin² y spares a cosine.
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
    """(x, y, θ, u, ω) with the sideways velocity left out altogether."""
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
    # Not `f + 0 λ`: it would cost the plain Python form.
    return [*v, *(x + row[i] * multiplier if i in row else x for i, x in enumerate(f))]


class Problem(NamedTuple):
    """One system: nhjax's form of it, and the equations by hand."""

    example: Any
    forces: Callable[..., Forces]
    field: Callable[[Any, Sequence], list]
    to_state: Callable[[Any, Any], Any]  # (q, v) to the state of `field`
    from_state: Callable[[Any], tuple[Any, Any]]
    # By how much q turns the velocity of `forces` against that of nhjax.
    turn: Callable[[np.ndarray], float]

    def members(self, number: int) -> tuple[Array, Array]:
        """Initial (q, v) of so many members; the example's own if it is one."""
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
        """(q, v) at `t` of each member, where a closed form is known."""
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
    """The systems by name, with default parameters."""
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
    """The state of `field` at `t` by Gragg's extrapolation, order 20, in long double.

    It shares neither coefficients nor, where long double is wider, round-off with what
    it is a reference for.
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
            # In increments from y, which keeps round-off far below y's.
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
    """The end state from the initial state and a tolerance, or a step if `fixed`.

    `layout` is "array" for one trajectory; for many "vmap", with a tuple of scalars as
    each member's state, or "stacked": one equation for all, shape (n, members), whose
    members share their steps.
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
            # The fastest of the adjoints in a run without derivatives.
            adjoint=diffrax.ForwardMode(),
            max_steps=None,
            throw=False,
        )
        return jax.tree.map(lambda x: x[-1], sol.ys), sol.stats["num_steps"]

    return jax.vmap(run, in_axes=(0, None)) if layout == "vmap" else run


def diffrax_state(layout: str, y0: np.ndarray) -> Any:
    """`y0`, of shape (members, n), as the state for `layout`."""
    if layout == "array":
        return jnp.asarray(y0[0])
    if layout == "stacked":
        return jnp.asarray(np.ascontiguousarray(y0.T))
    return tuple(jnp.asarray(column) for column in y0.T.copy())


def from_diffrax(layout: str, y: Any) -> np.ndarray:
    """Undo `diffrax_state`."""
    if layout == "array":
        return np.asarray(y)[None]
    return np.stack([np.asarray(column) for column in y], -1)


class HostField(NamedTuple):
    """The right-hand side for SciPy, in its two forms."""

    plain: Callable[[float, np.ndarray], np.ndarray]
    jitted: Callable[[float, np.ndarray], np.ndarray]
    jacobian: Callable[[float, np.ndarray], np.ndarray]

    def microseconds(self, y: np.ndarray) -> dict[str, float]:
        """Of one evaluation, each form."""
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
    """The right-hand side of the problem for SciPy."""

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
    """The end state for a tolerance, or None where the solver gives up."""
    options: dict[str, Any] = {"jac": field.jacobian} if method == "Radau" else {}

    def run(tolerance: float) -> np.ndarray | None:
        out = solve_ivp(
            getattr(field, form),
            (0.0, t),
            y0,
            method=method,
            # SciPy takes no smaller relative tolerance.
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
    """(q, v) at `t` from IDA for a tolerance, or None where it gives up.

    The unknowns are (q, v, λ), the equations q̇ = v, v̇ = f + Bᵀλ, and Φ = B v = 0 for
    index 2 or its derivative B v̇ = γ for index 1.
    """
    n, v0 = len(q0), _turned(v0, problem.turn(q0))

    def residual(t, y, yp, res):
        state, rate = y.tolist(), yp.tolist()
        q, v = state[:n], state[n : 2 * n]
        f, row, gamma = problem.forces(math, q, v)
        multiplier = state[-1]
        out = [a - b for a, b in zip(rate[:n], v, strict=True)]
        out += [a - b for a, b in zip(rate[n : 2 * n], f, strict=True)]
        # The constraint is eliminated with v̇ = f + Bᵀλ, algebraic in λ.
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
        # BDF controls λ of an index-2 system poorly: it must not set the steps.
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
