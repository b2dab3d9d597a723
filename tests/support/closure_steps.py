"""Single steps of the closures in 50 digits, and the motions they approximate.

The equations are those of `docs/closures.md` and, on SO(3), of `docs/groups.md`, with
derivatives by hand or by SymPy. Nothing of the library is used.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import sympy

from support.collocation import Collocation, inverse, motion, MP, newton, numbers


class Errors(NamedTuple):
    """The errors of a step at its stages and at its end."""

    stages: np.ndarray  # of velocities, forces and multipliers: one row for each stage
    end: np.ndarray  # of positions and momenta
    nu: np.ndarray | None
    consistency: np.ndarray | None = None  # of the momentum the stages start from


# --- a vector space -------------------------------------------------------------------

T0 = MP.mpf(0)
Q0 = numbers(["0.5", "0.4", "-0.3", "0.2"])
FREE = "0.7", "-0.6"  # v_1 and v_2; the constraints give the others
SIZE, COUNT = 4, 2


def symbolic() -> tuple[Any, ...]:
    """L and Φ: the mass depends on q, and Φ on t and on squares of velocities."""
    t, q, v = sympy.Symbol("t"), sympy.symbols("q:4"), sympy.symbols("v:4")
    x, y, z, w = q
    number = sympy.Rational
    mass = sympy.Matrix(
        [
            [2 + number(3, 10) * y**2, sympy.sin(x) / 5, 0, x / 10],
            [sympy.sin(x) / 5, 1 + x**2 / 5, z / 7, 0],
            [0, z / 7, number(3, 2) + sympy.cos(y) / 5, 0],
            [x / 10, 0, 0, 1 + z**2 / 3],
        ]
    )
    velocity = sympy.Matrix(v)
    potential = x**2 / 2 + y**2 + z**2 / 4 + w**2 / 2 + x * y * z / 5
    lagrangian = (velocity.T * mass * velocity)[0] / 2 - potential
    lagrangian += x * sympy.sin(t) / 10
    constraint = sympy.Matrix(
        [
            v[2] - y * v[0] - v[0] * v[1] / 5 - sympy.sin(t) / 10,
            v[3] - sympy.sin(x) * v[1] - v[0] ** 2 / 10 - z * v[2] * v[1] / 6,
        ]
    )
    return t, q, v, mass, lagrangian, constraint


def functions(modules: Any) -> tuple[Any, Any, Any, Any]:
    """Functions of the stages, the mass, Φ and the reduced equations, by SymPy."""
    t, q, v, mass, lagrangian, constraint = symbolic()
    multiplier = sympy.symbols("l:2")
    velocity, weights = sympy.Matrix(v), sympy.Matrix(multiplier)
    momentum = mass * velocity
    reaction = constraint.jacobian(v).T * weights
    force = sympy.Matrix([lagrangian.diff(x) for x in q])
    right = force - momentum.jacobian(q) * velocity
    rate = constraint.diff(t) + constraint.jacobian(q) * velocity

    def compiled(arguments: list, expression: Any) -> Any:
        return sympy.lambdify(arguments, expression, modules=modules, cse=True)

    return (
        compiled([t, q, v, multiplier], [list(momentum), list(force + reaction)]),
        compiled([t, q], mass.tolist()),
        compiled([t, q, v], list(constraint)),
        compiled(
            [t, q, v],
            [
                mass.tolist(),
                constraint.jacobian(v).tolist(),
                list(right),
                list(rate),
            ],
        ),
    )


@cache
def in_digits() -> tuple[Any, Any, Any, Any]:
    """The functions in 50 digits."""
    return functions([{"sin": MP.sin, "cos": MP.cos, "mpf": MP.mpf}, "mpmath"])


def stage(t: Any, q: Any, v: Any, multiplier: Any) -> tuple[np.ndarray, np.ndarray]:
    """D2L and D1L + D2Φᵀ Λ."""
    p, w = in_digits()[0](t, q, v, multiplier)
    return np.array(p, dtype=object), np.array(w, dtype=object)


def reduced(t: Any, q: Any, v: Any) -> tuple[np.ndarray, np.ndarray]:
    """The multiplier λ_c and the acceleration."""
    mass, rows, right, rate = (
        np.array(x, dtype=object) for x in in_digits()[3](t, q, v)
    )
    unmass = inverse(mass)
    drift = rows @ (unmass @ right) + rate
    multiplier = -inverse(rows @ unmass @ rows.T) @ drift
    return multiplier, unmass @ (right + rows.T @ multiplier)


@cache
def initial_velocity() -> np.ndarray:
    """A velocity that satisfies the constraints."""
    x, y, z, _ = Q0
    a, b = numbers(FREE)
    third = y * a + a * b / 5 + MP.sin(T0) / 10
    fourth = MP.sin(x) * b + a**2 / 10 + z * third * b / 6
    return np.array([a, b, third, fourth], dtype=object)


class Step:
    """The equations of one step of size h from (Q0, initial_velocity()).

    If `sign` is given, the closure is symmetric; if it is None, Λ^1 is given.
    """

    def __init__(self, method: Collocation, h: Any, sign: int | None = None):
        self.method, self.h, self.sign = method, h, sign
        self.t = T0 + h * method.c
        self.v0 = initial_velocity()
        self.p0 = stage(T0, Q0, self.v0, [MP.mpf(0)] * COUNT)[0]
        self.lambda0 = reduced(T0, Q0, self.v0)[0]
        self.inverse_jacobian = None

    def unpack(self, x: np.ndarray, first: Any) -> tuple[Any, ...]:
        """Stage quantities (Q, P, V, W, p, v, Λ) and ν of a vector of unknowns."""
        s, method, h = self.method.stages, self.method, self.h
        V, rest = x[: s * SIZE].reshape(s, SIZE), x[s * SIZE :]
        y, nu = rest[: (s - 1) * COUNT].reshape(s - 1, COUNT), None
        Q = Q0 + h * (method.a @ V)
        if self.sign is None:
            multipliers = np.concatenate([[first], y])
        else:
            nu, end = y[0], reduced(self.t[-1], Q[-1], rest[(s - 1) * COUNT :])[0]
            ends = [self.lambda0 + nu], [end + self.sign * nu]
            multipliers = np.concatenate([ends[0], y[1:], ends[1]])
        pairs = [stage(*z) for z in zip(self.t, Q, V, multipliers, strict=True)]
        P, W = (np.stack(z) for z in zip(*pairs, strict=True))
        p = self.p0 + h * (method.a @ W)
        v = np.stack(
            [
                np.array(MP.lu_solve(MP.matrix(in_digits()[1](*z)), list(momentum)))
                for *z, momentum in zip(self.t, Q, p, strict=True)
            ]
        )
        return Q, P, V, W, p, v, multipliers, nu

    def solve(self, first: Any = None, guess: np.ndarray | None = None) -> tuple:
        """Solve the equations, starting from a guess or from constant velocities."""
        s = self.method.stages
        first = self.lambda0 if first is None else first

        def residual(x: np.ndarray) -> np.ndarray:
            Q, P, _, W, _, v, _, _ = self.unpack(x, first)
            momenta = P - self.p0 - self.h * (self.method.a_hat @ W)
            conditions = [
                np.array(in_digits()[2](*z)) / self.h
                for z in zip(self.t[1:], Q[1:], v[1:], strict=True)
            ]
            rows = [momenta.ravel(), *conditions]
            if self.sign is not None:
                rows.append(v[-1] - x[-SIZE:])
            return np.concatenate(rows)

        if guess is None:
            guess = np.tile(self.v0, s)
            if self.sign is None:
                guess = np.concatenate([guess, np.tile(first, s - 1)])
            else:
                inner = np.tile(self.lambda0, s - 2)
                zero = numbers([0] * COUNT)
                guess = np.concatenate([guess, zero, inner, self.v0])
        x, self.inverse_jacobian = newton(residual, guess, self.inverse_jacobian)
        return *self.unpack(x, first), x

    def errors(self, first: Any = None) -> Errors:
        """Compare the step with the motion."""
        Q, _, V, W, p, _, multipliers, nu, _ = self.solve(first)
        rows, end = [], np.array([])
        for i, t in enumerate(self.t):
            q, v = exact(t - T0)
            multiplier, _ = reduced(t, q, v)
            momentum, force = stage(t, q, v, multiplier)
            off = V[i] - v, W[i] - force, multipliers[i] - multiplier
            rows.append(np.concatenate(off))
            end = np.concatenate([Q[-1] - q, p[-1] - momentum])
        return Errors(np.stack(rows), end, nu)

    def end(self, first: Any) -> np.ndarray:
        """(q_1, p_1) as a function of Λ^1."""
        Q, _, _, _, p, *_ = self.solve(first)
        return np.concatenate([Q[-1], p[-1]])


@cache
def exact(duration: Any) -> tuple[np.ndarray, np.ndarray]:
    """(q, v) of the motion."""

    def field(t: Any, y: np.ndarray) -> np.ndarray:
        return np.concatenate([y[SIZE:], reduced(t, y[:SIZE], y[SIZE:])[1]])

    y = motion(field, T0, np.concatenate([Q0, initial_velocity()]), duration)
    return y[:SIZE], y[SIZE:]


# --- rotations ------------------------------------------------------------------------

INERTIA = numbers([["1", ".1", ".2"], [".1", "1.4", "-.15"], [".2", "-.15", ".8"]])
UNINERTIA = inverse(INERTIA)
IDENTITY = numbers(np.eye(3, dtype=int))
CUBIC, TILT = MP.mpf("0.2"), MP.mpf("0.3")


def hat(x: np.ndarray) -> np.ndarray:
    """The matrix of the cross product with x."""
    zero = MP.mpf(0)
    rows = [[zero, -x[2], x[1]], [x[2], zero, -x[0]], [-x[1], x[0], zero]]
    return np.array(rows, dtype=object)


def cayley(y: np.ndarray) -> np.ndarray:
    """Cayley's map."""
    return IDENTITY + 4 / (4 + y @ y) * (hat(y) + hat(y) @ hat(y) / 2)


def uncayley(rotation: np.ndarray) -> np.ndarray:
    """The inverse of Cayley's map."""
    x = 2 * (rotation - IDENTITY) @ inverse(rotation + IDENTITY)
    return np.array([x[2, 1], x[0, 2], x[1, 0]], dtype=object)


def tangent(y: np.ndarray) -> np.ndarray:
    """The map from the velocity of y to the body velocity."""
    return 2 / (4 + y @ y) * (2 * IDENTITY - hat(y))


def curvature(y: np.ndarray, H: np.ndarray, momentum: np.ndarray) -> np.ndarray:
    """The derivative of <momentum, tangent(y) H> with respect to y."""
    size, turn = 4 + y @ y, hat(H) @ momentum
    return -4 * y / size**2 * (2 * momentum @ H - y @ turn) - 2 / size * turn


def torque(R: np.ndarray) -> np.ndarray:
    """The torque of the potential 0.3 R_33 + 0.2 R_12."""
    turns = [R @ hat(axis) for axis in IDENTITY]
    third, fifth = MP.mpf("0.3"), MP.mpf("0.2")
    return np.array([-third * D[2, 2] - fifth * D[0, 1] for D in turns], dtype=object)


def condition(R: np.ndarray, w: np.ndarray) -> Any:
    """Veselova's constraint with two more terms, one of them quadratic."""
    return (R @ w)[2] - CUBIC * w[0] * w[1] + TILT * R[0, 0] * w[2]


def direction(R: np.ndarray, w: np.ndarray) -> np.ndarray:
    """The derivative of the constraint with respect to w."""
    more = [-CUBIC * w[1], -CUBIC * w[0], TILT * R[0, 0]]
    return R[2] + np.array(more, dtype=object)


def turning(R: np.ndarray, w: np.ndarray) -> tuple[Any, np.ndarray]:
    """The multiplier λ_c and the acceleration of the body."""
    b, free = direction(R, w), hat(INERTIA @ w) @ w + torque(R)
    rate = TILT * (R[0, 1] * w[2] - R[0, 2] * w[1]) * w[2]
    multiplier = -(b @ UNINERTIA @ free + rate) / (b @ UNINERTIA @ b)
    return multiplier, UNINERTIA @ (free + multiplier * b)


R0 = cayley(numbers(["0.2", "-0.4", "0.5"]))


@cache
def initial_turning() -> np.ndarray:
    """A velocity of the body that satisfies the constraint."""
    a, b = numbers(["0.6", "-0.9"])
    rest = R0[2, 0] * a + R0[2, 1] * b - CUBIC * a * b
    return np.array([a, b, -rest / (R0[2, 2] + TILT * R0[0, 0])], dtype=object)


@cache
def exact_turning(duration: Any) -> tuple[np.ndarray, np.ndarray]:
    """The rotation and the velocity of the body."""

    def field(t: Any, y: np.ndarray) -> np.ndarray:
        R, w = y[:9].reshape(3, 3), y[9:]
        return np.concatenate([(R @ hat(w)).ravel(), turning(R, w)[1]])

    start = np.concatenate([R0.ravel(), initial_turning()])
    y = motion(field, MP.mpf(0), start, duration)
    return y[:9].reshape(3, 3), y[9:]


class Turn(NamedTuple):
    """The stages of a step on SO(3)."""

    H: np.ndarray
    F: np.ndarray
    n: np.ndarray
    multipliers: np.ndarray
    R: np.ndarray  # at the end
    w: np.ndarray  # at the end
    nu: Any
    origin: np.ndarray
    consistency: np.ndarray


def turn_of(method: Collocation, h: Any, sign: int, chart: str) -> Turn:
    """One step on SO(3) with the symmetric closure from (R0, initial_turning())."""
    s, w0 = method.stages, initial_turning()
    m0, lambda0 = INERTIA @ w0, turning(R0, w0)[0]

    def rows(values: list) -> np.ndarray:
        return np.stack(values)

    def evaluated(x: np.ndarray) -> tuple[np.ndarray, Turn]:
        H, nu, guess = x[: 3 * s].reshape(s, 3), x[3 * s], x[-3:]
        xi = h * (method.b @ H)
        start = 0 * xi if chart == "start" else -xi / 2
        origin = R0 @ cayley(start).T
        y = start + h * (method.a @ H)
        tangents, turns = [tangent(z) for z in y], [cayley(z) for z in y]
        R = [origin @ turn for turn in turns]
        end = turning(R[-1], guess)[0] + sign * nu
        multipliers = np.array([lambda0 + nu, *x[3 * s + 1 : -3], end], dtype=object)
        eta = [T @ z for T, z in zip(tangents, H, strict=True)]
        forces = [
            torque(a) + z * direction(a, e)
            for a, z, e in zip(R, multipliers, eta, strict=True)
        ]
        F = rows(
            [
                T.T @ f + curvature(z, v, INERTIA @ e)
                for T, f, z, v, e in zip(tangents, forces, y, H, eta, strict=True)
            ]
        )
        n = rows([turn @ f for turn, f in zip(turns, forces, strict=True)])
        M = turns[0] @ m0 + h * (method.a @ n)
        mu = [turn.T @ z for turn, z in zip(turns, M, strict=True)]
        w = [UNINERTIA @ z for z in mu]
        first, last = tangents[0].T @ m0, tangents[-1].T @ mu[-1]
        if chart == "start":
            base = last - h * (method.b @ F)
        else:
            base = (first + last - h * (method.b @ F)) / 2
        momenta = rows([T.T @ INERTIA @ e for T, e in zip(tangents, eta, strict=True)])
        off = momenta - base - h * (method.a_hat @ F)
        rates = [condition(a, e) / h for a, e in zip(R[1:], w[1:], strict=True)]
        residual = np.concatenate([off.ravel(), rates, w[-1] - guess])
        found = Turn(H, F, n, multipliers, R[-1], w[-1], nu, origin, base - first)
        return residual, found

    zero, inner = numbers([0]), np.tile(np.array([lambda0]), s - 2)
    guess = np.concatenate([np.tile(w0, s), zero, inner, w0])
    x, _ = newton(lambda x: evaluated(x)[0], guess)
    return evaluated(x)[1]


def turn_errors(method: Collocation, h: Any, sign: int, chart: str) -> Errors:
    """Compare a step on SO(3) with the motion, in the chart of the step."""
    turn, rows, end = turn_of(method, h, sign, chart), [], np.array([])
    for i, c in enumerate(method.c):
        R, w = exact_turning(h * c)
        y, multiplier = uncayley(turn.origin.T @ R), turning(R, w)[0]
        T, force = tangent(y), torque(R) + multiplier * direction(R, w)
        H = inverse(T) @ w
        F = T.T @ force + curvature(y, H, INERTIA @ w)
        n = cayley(y) @ force
        found = turn.H[i] - H, turn.F[i] - F, turn.n[i] - n
        rows.append(np.concatenate([*found, [turn.multipliers[i] - multiplier]]))
        end = np.concatenate([(turn.R - R).ravel(), turn.w - w])
    return Errors(np.stack(rows), end, np.array([turn.nu]), turn.consistency)
