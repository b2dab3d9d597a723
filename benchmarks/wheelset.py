"""The wheelset of the Test Set for IVP Solvers: a run of 10 s, and published numbers.

Two conical wheels on one axle run at 30 m/s on two round rails, and hunt from side to
side. The test set (https://archimede.dm.uniba.it/~testset, problem `wheel`, from
Simeon, Führer and Rentrop 1991) describes this machine by an implicit equation of index
2 with 17 unknowns: five coordinates, six velocities, four variables of the contacts,
and two multipliers. The creep forces of the contacts depend on the normal forces, which
are multipliers. The start is at rest in the moving frame, 1.5 mm beside the middle.

In nhjax the coordinates are q = (x, y, z, θ, φ, β): the position of the centre, the
yaw, the roll, and the turn of the axle beyond V t / r. The two contacts are holonomic
constraints, and the creep force is a force that depends on the multipliers. The
variables of the contacts have no mass. They are computed inside the constraint: the
profiles are a cone and a circle, so that a closed form exists.

Three details are copied from the test set. Its start has gaps of 5e-10 m between wheels
and rails, which stay constant because its constraints are equations on velocities. Here
these gaps are the `args` of the constraint. Creep is evaluated at the yaw θ / cos δ,
and π has eight digits. One detail is different here: the test set does not divide the
yaw torque of the reactions by cos φ. This changes the result by less than 1e-7.

Each error is the largest relative error of the 17 unknowns at the end, compared with
the published numbers and with two references of our own: a run with small steps, and
diffrax's Dopri8 on the equations solved for the accelerations. Errors fall more slowly
than the order of the method predicts, because the creep force has a kink where a wheel
begins to slide, which happens often.

    python -m benchmarks.wheelset
"""

import argparse
import math
import time
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import nhjax

from ._report import markdown_table, number, write


DURATION = 10.0
RUNS = (
    *((2, 20000), (2, 80000)),
    *((3, 10000), (3, 40000), (3, 160000), (3, 640000)),
    *((4, 10000), (4, 40000), (4, 160000)),
    *((5, 10000), (5, 40000)),
)
# The report lists the errors of each unknown for these runs.
SHOWN = ((3, 10000), (3, 40000), (3, 160000), (3, 640000))
REFERENCE = (4, 640000)
TOLERANCE = 1e-12
REPEATS = 3

# --- The wheelset ---------------------------------------------------------------------

MASS, GRAVITY = 16.08, 9.81
AXLE_INERTIA, YAW_INERTIA = 0.0605, 0.366
SPEED = 30.0
RADIUS = 0.1
SPRING_X, SPRING_Z, SPRING_ARM = 6400.0, 6400.0, 0.19
FRICTION = 0.12
# The wheels are cones, the rails are circles. The nominal contacts are at ±HALF_GAUGE.
CONE_ANGLE = 0.0262
HALF_GAUGE = 0.1506
RAIL_RADIUS = 0.06
# Constants of Hertz's formula for the area of contact, and Kalker's creep coefficients.
SHEAR_MODULUS, POISSON = 7.92e10, 0.28
HERTZ_E, HERTZ_G = 1.3537956, 0.7115218
KALKER_11, KALKER_22, KALKER_23 = 4.72772197, 4.27526987, 1.97203505
PI = 3.1415926

SIDES = np.array([1.0, -1.0])
START = np.array([1.4941e-3, 4.0089e-7, 1.1241e-6, -2.8573e-4, 2.6459e-4, 0.0])

# The order of the unknowns in the test set, whose left contact has x > 0.
PUBLISHED = {
    "x": 0.86355386965811e-2,
    "y": 0.13038281022727e-4,
    "z": -0.93635784016818e-4,
    "θ": -0.13642299804033e-1,
    "φ": 0.15292895005422e-2,
    "ẋ": -0.76985374142666e-1,
    "ẏ": -0.25151106429207e-3,
    "ż": 0.20541188079539e-2,
    "θ̇": -0.23904837703692,
    "φ̇": -0.13633468454173e-1,
    "β̇": -0.24421377661131,
    "ψ right": -0.33666751972196e-3,
    "ξ right": -0.15949425684022,
    "ψ left": 0.37839614386969e-3,
    "ξ left": 0.14173214964613,
    "λ left / 1e4": -0.10124044903201e-1,
    "λ right / 1e4": -0.56285630573753e-2,
}
SOLUTION = np.array(list(PUBLISHED.values()))


def lagrangian(t: Array, q: Array, v: Array, args: Any) -> Array:
    """Compute L. The yaw spring is in `force`, since it also acts on the axle."""
    spin = SPEED / RADIUS + v[5] + v[3] * jnp.sin(q[4])
    across = (v[3] * jnp.cos(q[4])) ** 2 + v[4] ** 2
    kinetic = MASS * v[:3] @ v[:3] + YAW_INERTIA * across + AXLE_INERTIA * spin**2
    springs = SPRING_X * q[0] ** 2 + SPRING_Z * q[2] ** 2
    return 0.5 * kinetic - springs - MASS * GRAVITY * q[1]


class Contact(NamedTuple):
    """A contact of wheel and rail, by the variables of the test set.

    `along` is the coordinate ξ of the contact on the axle, and `angle` its angle ψ
    around the axle. `radius` is the radius of the wheel at ξ, `slope` the slope of the
    rail at the contact, and `gap` the height of the rail above the wheel.
    """

    along: Array
    angle: Array
    radius: Array
    slope: Array
    gap: Array


def axes(theta: Array, phi: Array) -> tuple[Array, Array, Array]:
    """Return the axle and two directions across it: down, and back."""
    st, ct, sp, cp = jnp.sin(theta), jnp.cos(theta), jnp.sin(phi), jnp.cos(phi)
    axle = jnp.stack([ct * cp, sp, -st * cp])
    down = jnp.stack([ct * sp, -cp, -st * sp])
    back = jnp.stack([-st, jnp.zeros_like(st), -ct])
    return axle, down, back


def contact(q: Array, side: Array) -> Contact:
    """Find the point where the wheel of a side (1 or -1) is parallel to the rail."""
    axle, down, back = axes(q[3], q[4])
    taper = -side * math.tan(CONE_ANGLE)
    # The normal of the cone is (cos ψ) down + (sin ψ) back - (taper) axle. The rail
    # does not change along z, so that the normal of the contact has no z component.
    size = jnp.hypot(down[2], back[2])
    angle = jnp.arctan2(down[2], -back[2]) - jnp.arcsin(taper * axle[2] / size)
    outwards = jnp.cos(angle) * down + jnp.sin(angle) * back
    normal = outwards - taper * axle
    slope = -normal[0] / normal[1]
    # The circle of the rail has this slope at one point. The contact of the wheel must
    # be at this point.
    sec = jnp.sqrt(1 + slope * slope)
    off = RAIL_RADIUS * (math.sin(CONE_ANGLE) - side * slope / sec)
    rail_x = side * (HALF_GAUGE + off)
    rail_y = RAIL_RADIUS * (1 / sec - math.cos(CONE_ANGLE)) - RADIUS
    at_axis = RADIUS + math.tan(CONE_ANGLE) * HALF_GAUGE
    along = rail_x - q[0] - at_axis * outwards[0]
    along = along / (axle[0] + taper * outwards[0])
    radius = at_axis + taper * along
    wheel_y = q[1] + along * axle[1] + radius * outwards[1]
    return Contact(along, angle, radius, slope, rail_y - wheel_y)


def gaps(t: Array, q: Array, args: Array) -> Array:
    """Compute the two constraints: each gap keeps its value at the start."""
    return jax.vmap(lambda side: contact(q, side).gap)(jnp.asarray(SIDES)) - args


def creep_force(q: Array, v: Array, multiplier: Array, side: Array) -> Array:
    """Compute the generalised creep force of a contact, by Jaschinski's formula."""
    at = contact(q, side)
    sec = jnp.sqrt(1 + at.slope**2)
    sd, cd = at.slope / sec, 1 / sec

    def point(q):
        axle, down, back = axes(q[3], q[4])
        angle = at.angle + q[5]
        outwards = jnp.cos(angle) * down + jnp.sin(angle) * back
        return q[:3] + at.along * axle + at.radius * outwards

    # The velocity is computed for the material point of the wheel that touches the
    # rail, which turns with the axle. No function depends on β itself.
    q = q.at[5].set(0.0)
    yaw = q[3] * sec
    turning = v.at[5].add(SPEED / RADIUS)
    velocity = jax.jvp(point, (q.at[3].set(yaw),), (turning,))[1]
    velocity = velocity.at[2].add(SPEED)
    travel = v[:3].at[2].add(SPEED)
    rolling = 0.5 * jnp.linalg.norm(velocity - 2 * travel)
    st, ct = jnp.sin(yaw), jnp.cos(yaw)
    zero = jnp.zeros_like(st)
    ahead = jnp.stack([st, zero, ct])
    across = jnp.stack([ct * cd, sd, -st * cd])
    creep_ahead, creep_across = ahead @ velocity / rolling, across @ velocity / rolling
    creep_spin = (cd * v[3] - sd * turning[5]) / rolling

    load = jnp.abs(multiplier) * sec
    # `initial_state` calls the force with zero multipliers, for which the area of
    # contact is zero.
    safe = jnp.where(load > 0, load, 1.0)
    curvature = 0.5 * math.cos(CONE_ANGLE) / at.radius + 0.5 / RAIL_RADIUS
    elastic = 2 * PI * SHEAR_MODULUS * math.sqrt(HERTZ_G) * curvature
    area = jnp.cbrt(3 * safe * (1 - POISSON) * HERTZ_E / elastic)
    stiffness = SHEAR_MODULUS * area**2 / (FRICTION * safe)
    fraction_ahead = jnp.tanh(stiffness * KALKER_11 * creep_ahead)
    fraction_across = jnp.tanh(
        stiffness * (KALKER_22 * creep_across + KALKER_23 * area * creep_spin)
    )
    # The resultant of the two creep forces must not exceed the friction. The force has
    # a kink where it reaches this limit.
    square = fraction_ahead**2 + fraction_across**2
    push = -FRICTION * load / jnp.sqrt(jnp.maximum(square, 1.0))
    on_wheel = push * (fraction_ahead * ahead + fraction_across * across)
    return jax.vjp(point, q)[1](on_wheel)[0]


def force(t: Array, q: Array, v: Array, multipliers: Array, args: Any) -> Array:
    """Compute the sum of the creep forces and of the yaw spring about the vertical."""
    creep = jax.vmap(creep_force, (None, None, 0, 0))
    total = jnp.sum(creep(q, v, multipliers, jnp.asarray(SIDES)), axis=0)
    torque = -2 * SPRING_ARM**2 * SPRING_Z * q[3]
    return total.at[3].add(torque).at[5].add(torque * jnp.sin(q[4]))


def wheelset() -> nhjax.LagrangianSystem:
    """Create the system."""
    return nhjax.LagrangianSystem(
        lagrangian,
        holonomic=gaps,
        force=force,
        coordinates=("x", "y", "z", "yaw", "roll", "turn"),
    )


def start(system: nhjax.LagrangianSystem) -> tuple[nhjax.State, Array]:
    """Return the published start, and its gaps."""
    q = jnp.asarray(START)
    kept = gaps(jnp.zeros(()), q, jnp.zeros(2))
    return nhjax.initial_state(system, q, jnp.zeros(6), args=kept), kept


def unknowns(y: nhjax.State) -> np.ndarray:
    """Return the 17 unknowns of the test set, in its order."""
    left, right = (contact(y.q, jnp.asarray(side)) for side in SIDES)
    contacts = [right.angle, right.along, left.angle, left.along]
    parts = [y.q[:5], y.v, jnp.stack(contacts), y.multiplier / 1e4]
    return np.asarray(jnp.concatenate(parts))


# --- Runs -----------------------------------------------------------------------------


def relative(found: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return the relative error of each unknown."""
    return np.abs(found - reference) / np.abs(reference)


class Run(NamedTuple):
    """The state at the end of a run, its iterations for each step, and its time."""

    end: nhjax.State
    iterations: float
    seconds: float

    @property
    def unknowns(self) -> np.ndarray:
        """Return the unknowns at the end."""
        return unknowns(self.end)


class Wheelset:
    """Runs of the wheelset from its published start."""

    def __init__(self) -> None:
        self.system = wheelset()
        self.y0, self.gaps = start(self.system)

    def run(
        self,
        stages: int,
        num_steps: int,
        *,
        duration: float = DURATION,
        repeats: int = 1,
    ) -> Run:
        """Integrate, and report the least time of some runs after compilation."""

        def integrate(length: int) -> nhjax.Solution:
            sol = nhjax.integrate(
                self.system,
                nhjax.LobattoIIIAB(stages),
                self.y0,
                dt=duration / num_steps,
                num_steps=length,
                args=self.gaps,
            )
            return jax.block_until_ready(sol)

        sol, seconds = integrate(1), math.inf  # the compilation, for any length
        for _ in range(repeats):
            begin = time.perf_counter()
            sol = integrate(num_steps)
            seconds = min(seconds, time.perf_counter() - begin)
        end = jax.tree.map(lambda x: x[-1], sol.ys)
        return Run(end, float(sol.stats["num_iterations"]) / num_steps, seconds)

    def reduced_run(self, tolerance: float, duration: float = DURATION) -> Run:
        """Integrate by Dopri8 the equations that are solved for the accelerations."""
        system, kept = self.system, self.gaps

        def state(q, v):
            return nhjax.State(q=q, v=v, p=jnp.zeros_like(v), multiplier=jnp.zeros(2))

        def field(t, y, args):
            q, v = y
            return v, nhjax.motion(system, t, state(q, v), kept).acceleration

        @jax.jit
        def solve(y):
            return diffrax.diffeqsolve(
                diffrax.ODETerm(field),
                diffrax.Dopri8(),
                0.0,
                duration,
                1e-4,
                y,
                stepsize_controller=diffrax.PIDController(
                    rtol=tolerance, atol=1e-3 * tolerance
                ),
                max_steps=None,
                adjoint=diffrax.ForwardMode(),
            )

        begin = time.perf_counter()
        sol = jax.block_until_ready(solve((self.y0.q, self.y0.v)))
        seconds = time.perf_counter() - begin
        assert sol.ys is not None
        q, v = (x[-1] for x in sol.ys)
        found = nhjax.motion(system, duration, state(q, v), kept).multiplier
        end = nhjax.State(q=q, v=v, p=jnp.zeros_like(v), multiplier=found)
        return Run(end, math.nan, seconds)

    def drift_of_published(self) -> np.ndarray:
        """Return by how much the gaps of the published solution have changed."""
        q = jnp.asarray([*SOLUTION[:5], 0.0])
        return np.asarray(gaps(jnp.zeros(()), q, self.gaps))


def main() -> None:
    """Print and save the tables."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    jax.config.update("jax_enable_x64", True)
    machine = Wheelset()
    reference = machine.run(*REFERENCE)
    reduced = machine.reduced_run(TOLERANCE)
    print("references", relative(reduced.unknowns, reference.unknowns), flush=True)
    data, rows, ends = [], [], {}
    for stages, num_steps in RUNS:
        run = machine.run(stages, num_steps, repeats=REPEATS)
        ends[stages, num_steps] = run.unknowns
        found = {
            "stages": stages,
            "steps": num_steps,
            "dt": DURATION / num_steps,
            "published": relative(run.unknowns, SOLUTION),
            "reference": relative(run.unknowns, reference.unknowns),
            "reduced": relative(run.unknowns, reduced.unknowns),
            "iterations": run.iterations,
            "seconds": run.seconds,
        }
        data.append(found)
        errors = [max(found[key]) for key in ("published", "reference", "reduced")]
        print(stages, num_steps, *errors, run.seconds, flush=True)
        cells = [str(stages), str(num_steps), f"{found['dt']:.3g}"]
        cells += [number(error) for error in errors]
        rows.append([*cells, f"{run.iterations:.1f}", f"{run.seconds:.2f}"])
    header = [
        *("s", "steps", "h, s", "against published", "against small steps"),
        *("against Dopri8", "iterations a step", "time, s"),
    ]
    of_each = {
        f"s = {stages}, {num_steps} steps": relative(ends[stages, num_steps], SOLUTION)
        for stages, num_steps in SHOWN
    }
    of_each["Dopri8"] = relative(reduced.unknowns, SOLUTION)
    each = [
        [name, f"{value:.13e}", *(number(errors[i]) for errors in of_each.values())]
        for i, (name, value) in enumerate(PUBLISHED.items())
    ]
    drift = machine.drift_of_published()
    agreement = float(np.max(relative(reduced.unknowns, reference.unknowns)))
    of_published = float(np.max(relative(SOLUTION, reference.unknowns)))
    text = (
        f"Runs of {DURATION:g} s. The errors are relative, the largest of the 17 "
        f"unknowns of the test set. The times are the least of {REPEATS} runs on the "
        "clock, without compilation.\n\n"
        + markdown_table(header, rows)
        + f"\n\nThe small steps are s = {REFERENCE[0]} with {REFERENCE[1]} steps. "
        f"Dopri8 has a tolerance of {TOLERANCE:g}, and its first call took "
        f"{reduced.seconds:.0f} s. Both references agree to {number(agreement)}. The "
        "published numbers differ from the small steps by up to "
        f"{number(of_published)}. Their gaps have drifted by {number(drift[0])} and "
        f"{number(drift[1])} m, which is their error in y.\n\n"
        "Errors against the published numbers, for each unknown:\n\n"
        + markdown_table(["unknown", "published", *of_each], each)
    )
    saved = {
        "unknowns": list(PUBLISHED),
        "published": SOLUTION,
        "small_steps": reference.unknowns,
        "reduced": reduced.unknowns,
        "drift": drift,
        "rows": data,
    }
    write("wheelset", "The wheelset of the Test Set for IVP Solvers", text, saved)


if __name__ == "__main__":
    main()
