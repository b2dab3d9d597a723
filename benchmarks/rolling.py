"""Rolling machines from parts, compared with closed forms and published numbers.

All constraints come from `nhjax.rolling`. There are six measurements:

1. A disc rolls steadily on a circle, with the numbers of Le Saux, Leine and Glocker
   (2005): a thin rim, inclined by 5 degrees. The motion is known in closed form. Errors
   of positions, velocities and the contact force must fall with the order 2s - 2.
2. Euler's disc, with the mass 400 g and the radius 37.5 mm, comes to rest at a time
   t_f. Its inclination is β = c (t_f - t)^p near the end. The exponent p depends on the
   law of dissipation. Four laws are run: `friction.RollingResistance`, dry and viscous
   friction of the contact that runs around the rim, and a layer of air, as in Moffatt
   (2000), who found p = 1/3. For each law the balance of energy gives c and p, with
   E = 3/2 m g r β and the precession Ω² = 4 g / (r β). The dissipated power is
   N e 2 (g β / r)^½ for the first law, N e Ω for dry and k Ω² for viscous friction
   along the rim, and π μ r³ Ω² / 4 β for the air.
3. A robot on four mecanum wheels is commanded sideways through four motors. It must not
   turn, and its path is known in closed form.
4. A homogeneous ball on an inclined plane, on a turntable and in a spherical bowl, each
   with a motion in closed form.
5. A snakeboard from blades or from wheels, compared with the snakeboard of the gallery.
6. The bicycle of Meijaard et al. (2007): its eigenvalues compared with the published
   ones, and the time of the first call, compared with the bicycle of the gallery.

An error is the largest error of all components at the end of a run.

    python -m benchmarks.rolling
"""

import argparse
import json
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jax import Array
from scipy.spatial.transform import Rotation

import nhjax
from nhjax import forces, friction, rolling, systems
from nhjax.systems import _whipple_bicycle as bicycle_parts
from nhjax.systems._frames import about_y, about_z

from ._report import from_fresh_process, markdown_table, number, write
from .compile_time import compiled, program


GRAVITY = 9.81
SE3, SO3 = nhjax.SE3(), nhjax.SO3()
X, Y, Z = np.eye(3)
# Errors below this bound are not used for observed orders.
ROUND_OFF = 1e-11


class Machine(NamedTuple):
    """A system, and the contacts that its constraints come from."""

    system: nhjax.LagrangianSystem
    contacts: rolling.Contacts


def pose_of_body(t: Any, q: Array, args: Any) -> tuple[Array, Array]:
    """Return the position and the rotation of a body on SE(3)."""
    return q[4:], SO3.matrix(q[:4])


def body(
    contact: rolling.AbstractContact,
    mass: float,
    moments: Sequence[float],
    force: Any = None,
) -> Machine:
    """Create a rigid body on SE(3) with one contact and weight.

    `force` is a function that creates the force from the contacts.
    """
    contacts = rolling.Contacts(body=contact)
    inertia = np.array([mass, mass, mass, *moments])

    def lagrangian(t, q, v, args):
        return 0.5 * v @ (jnp.asarray(inertia) * v) - mass * GRAVITY * q[6]

    system = nhjax.LagrangianSystem(
        lagrangian,
        nonholonomic=contacts.nonholonomic,
        holonomic=contacts.holonomic,
        force=None if force is None else force(contacts),
        manifold=SE3,
    )
    return Machine(system, contacts)


class Motion(NamedTuple):
    """The motion of a rigid body at a time, with all vectors in space."""

    place: np.ndarray
    rotation: Rotation | None
    velocity: np.ndarray
    angular_velocity: np.ndarray
    force: np.ndarray

    def start(self) -> tuple[Array, Array]:
        """Return the element of SE(3) and the body velocity."""
        turned = Rotation.identity() if self.rotation is None else self.rotation
        x, y, z, w = turned.as_quat()
        back = turned.inv()
        v = [back.apply(self.velocity), back.apply(self.angular_velocity)]
        return jnp.array([w, x, y, z, *self.place]), jnp.asarray(np.concatenate(v))

    def errors(self, machine: Machine, t: float, y: nhjax.State) -> list[float]:
        """Return the errors of position, velocity and contact force of a state.

        If the rotation of the motion is not known, its error is left out.
        """
        found = np.asarray(SO3.matrix(y.q[:4]))
        velocity, angular = np.asarray(y.v).reshape(2, 3) @ found.T
        force = machine.contacts.forces(t, y)["body"]
        turned = np.zeros(1)
        if self.rotation is not None:
            turned = found - self.rotation.as_matrix()
        pairs = [
            (np.asarray(y.q[4:]) - self.place, turned),
            (velocity - self.velocity, angular - self.angular_velocity),
            (np.asarray(force) - self.force,),
        ]
        return [max(float(np.max(np.abs(x))) for x in pair) for pair in pairs]


def end_of(sol: nhjax.Solution) -> nhjax.State:
    """Return the last state of a run."""
    return jax.tree.map(lambda x: x[-1], sol.ys)


def orders(rows: list[list[float]]) -> list[list[float]]:
    """Return the observed orders of errors, each row with half the step size.

    The order is not defined if an error has the size of round-off.
    """
    errors = np.maximum(np.array(rows), ROUND_OFF)
    found = np.log2(errors[:-1] / errors[1:])
    found[errors[1:] == ROUND_OFF] = math.nan
    return [[math.nan] * len(rows[0]), *found.tolist()]


def against_closed_form(
    machine: Machine,
    motion: Callable[[float], Motion],
    duration: float,
    stages: int,
    numbers_of_steps: Sequence[int],
) -> list[dict[str, Any]]:
    """Return errors and orders of runs with different numbers of steps."""
    y0 = nhjax.initial_state(machine.system, *motion(0.0).start())
    errors, violations = [], []
    for num_steps in numbers_of_steps:
        sol = nhjax.integrate(
            machine.system,
            nhjax.LobattoIIIAB(stages),
            y0,
            dt=duration / num_steps,
            num_steps=num_steps,
        )
        errors.append(motion(duration).errors(machine, duration, end_of(sol)))
        violations.append(float(sol.stats["max_constraint_violation"]))
    about = zip(numbers_of_steps, errors, orders(errors), violations, strict=True)
    return [
        {
            "stages": stages,
            "steps": steps,
            "errors": of_run,
            "orders": observed,
            "violation": violation,
        }
        for steps, of_run, observed, violation in about
    ]


def convergence_table(rows: list[dict[str, Any]], *names: str) -> str:
    """Return a table of errors and orders. `names` are the keys of further columns."""
    lines = []
    for row in rows:
        observed = ["" if math.isnan(x) else f"{x:.2f}" for x in row["orders"]]
        pairs = zip(map(number, row["errors"]), observed, strict=True)
        cells = [str(row[name]) for name in (*names, "stages", "steps")]
        lines.append([*cells, *(x for pair in pairs for x in pair)])
    header = [*names, "s", "steps"]
    for name in ("q", "v", "force"):
        header += [f"error of {name}", "order"]
    return markdown_table(header, lines)


# --- 1. A disc that rolls on a circle -------------------------------------------------

DISC_MASS, DISC_RADIUS = 0.3048, 0.05
PATH_RADIUS, INCLINATION = 0.5, math.radians(5.0)
PUBLISHED_SPIN = 10.7364981632612
DISC_DURATION = 6.5536
DISC_RUNS = {
    2: (2048, 4096, 8192, 16384),
    3: (256, 512, 1024, 2048),
    4: (128, 256, 512, 1024),
}


def steady_rates() -> tuple[float, float]:
    """Return the rates of the precession α and of the spin γ about the axle.

    The rotation of the disc is R_z(α) R_x(-β) R_y(γ): its axle is the second axis, and
    β is measured from the vertical. The contact runs on the circle of radius R at the
    rate α', so that R α' = r γ'. The centre of mass runs on the circle of radius R - r
    sin β. With the moments m r² / 4 and m r² / 2, the balance of moments about the
    contact gives α'² = 4 g tan β / (6 R - 5 r sin β).
    """
    size = 6 * PATH_RADIUS - 5 * DISC_RADIUS * math.sin(INCLINATION)
    precession = math.sqrt(4 * GRAVITY * math.tan(INCLINATION) / size)
    return precession, precession * PATH_RADIUS / DISC_RADIUS


def steady_disc(t: float) -> Motion:
    """Return the steady motion of the disc at a time."""
    precession, spin = steady_rates()
    path = PATH_RADIUS - DISC_RADIUS * math.sin(INCLINATION)
    turned = Rotation.from_rotvec(precession * t * Z)
    tilted = turned * Rotation.from_rotvec(-INCLINATION * X)
    height = DISC_RADIUS * math.cos(INCLINATION)
    pull = DISC_MASS * path * precession**2
    return Motion(
        turned.apply([0.0, -path, height]),
        tilted * Rotation.from_rotvec(spin * t * Y),
        turned.apply(path * precession * X),
        precession * Z + spin * tilted.apply(Y),
        DISC_MASS * GRAVITY * Z + pull * turned.apply(Y),
    )


def rolling_disc() -> Machine:
    """Create the disc with a thin rim on the plane z = 0."""
    square = DISC_MASS * DISC_RADIUS**2
    wheel = rolling.Wheel(pose_of_body, DISC_RADIUS, manifold=SE3)
    return body(wheel, DISC_MASS, (square / 4, square / 2, square / 4))


def unsteadiness() -> float:
    """Return the error of the accelerations at the start.

    In the steady motion, the vector of the body velocity rotates about the axle at the
    rate -γ'. This gives the exact accelerations.
    """
    machine = rolling_disc()
    y0 = nhjax.initial_state(machine.system, *steady_disc(0.0).start())
    found = nhjax.motion(machine.system, 0.0, y0).acceleration
    _, spin = steady_rates()
    parts = np.asarray(y0.v).reshape(2, 3)
    expected = np.concatenate([np.cross(part, spin * Y) for part in parts])
    return float(np.max(np.abs(np.asarray(found) - expected)))


def measure_disc() -> tuple[str, dict[str, Any]]:
    """Measure the disc on its circle."""
    machine, rows = rolling_disc(), []
    for stages, numbers_of_steps in DISC_RUNS.items():
        rows += against_closed_form(
            machine, steady_disc, DISC_DURATION, stages, numbers_of_steps
        )
        print(*rows, sep="\n", flush=True)
        jax.clear_caches()
    _, spin = steady_rates()
    off = unsteadiness()
    largest = max(row["violation"] for row in rows)
    text = (
        f"## Disc on a circle\n\nA run of {DISC_DURATION} s, in which the disc turns "
        f"{spin * DISC_DURATION / 2 / math.pi:.1f} times about its axle. The published "
        "spin is γ' about the axle, the inclination is from the vertical, and R is the "
        "radius of the path of the contact: the closed form has γ' = "
        f"{spin:.13f} 1/s, {number(abs(spin - PUBLISHED_SPIN))} from the published "
        f"number. At the start, the accelerations differ from it by {number(off)}. The "
        "errors are in m and entries of the rotation matrix, in m/s and rad/s, and in "
        f"N. Constraints hold to {number(largest)}.\n\n" + convergence_table(rows)
    )
    return text, {"spin": spin, "unsteadiness": off, "rows": rows}


# --- 2. Euler's disc comes to rest ----------------------------------------------------

EULER_MASS, EULER_RADIUS = 0.4, 0.0375
FIRST_BETA = 0.1
AIR_VISCOSITY = 1.8e-5
ROLLING_ARM, RIM_ARM, RIM_DAMPING = 1e-4, 5e-6, 5e-8
# States are saved after this number of steps with the longer step size.
SAVED = 5


def disc_on_its_side(force: Any) -> Machine:
    """Create Euler's disc, whose axle is the third axis, with a force."""
    square = EULER_MASS * EULER_RADIUS**2
    wheel = rolling.Wheel(pose_of_body, EULER_RADIUS, axle=(0, 0, 1), manifold=SE3)
    return body(wheel, EULER_MASS, (square / 4, square / 4, square / 2), force)


def rolling_resistance(contacts: rolling.Contacts) -> Any:
    """Return the torque N e, opposite to the angular velocity along the ground."""
    return friction.RollingResistance(contacts, "body", ROLLING_ARM, smoothing=1e-3)


def rim_rate(q: Array, v: Array) -> Array:
    """Compute the rate at which the contact runs around the rim."""
    normal = SO3.matrix(q[:4])[2]
    turning = jnp.cross(normal, v[3:])
    across = normal[0] * turning[1] - normal[1] * turning[0]
    return across / (normal[:2] @ normal[:2])


def dry_rim(contacts: rolling.Contacts) -> Any:
    """Return friction with the power N e |γ'|, where γ' is the rate along the rim."""

    def force(t, q, v, multipliers, args):
        rate, pull_back = jax.vjp(lambda v: rim_rate(q, v), v)
        load = jnp.abs(contacts.load("body", multipliers))
        return pull_back(-load * RIM_ARM * jnp.tanh(rate))[0]

    return force


def viscous_rim(contacts: rolling.Contacts) -> Any:
    """Return friction with the power k γ'²."""

    def force(t, q, v, args):
        rate, pull_back = jax.vjp(lambda v: rim_rate(q, v), v)
        return pull_back(-RIM_DAMPING * rate)[0]

    return force


def layer_of_air(contacts: rolling.Contacts) -> Any:
    """Return the torque of the air under the disc, with Moffatt's dissipated power.

    The power is π μ r³ Ω² / 4 β. The disc itself turns at the rate Ω β about the
    diameter to the contact. The torque about this diameter is the power divided by the
    rate, and is proportional to the rate with a factor that grows like 1 / β³.
    """
    damping = math.pi * AIR_VISCOSITY * EULER_RADIUS**3 / 4

    def force(t, q, v, args):
        rotation = SO3.matrix(q[:4])
        turning = (rotation @ v[3:]).at[2].set(0.0)
        sine = jnp.sqrt(rotation[2, :2] @ rotation[2, :2])
        torque = rotation.T @ (-damping * turning / sine**3)
        return jnp.concatenate([jnp.zeros_like(torque), torque])

    return force


class Decay(NamedTuple):
    """A law of dissipation: c and p of β = c (t_f - t)^p, and the run that finds them.

    `force` creates the force from the contacts. `dt` is the longer of two step sizes.
    """

    name: str
    force: Any
    constant: float
    power: float
    dt: float

    @property
    def duration(self) -> float:
        """Return the time at which the law predicts rest, plus 3 percent."""
        return 1.03 * (FIRST_BETA / self.constant) ** (1 / self.power)

    @property
    def last_beta(self) -> float:
        """Return the β at which the law requires the vertical acceleration g.

        The law assumes slow changes of a steady motion, and is not valid for smaller β.
        """
        c, p = self.constant, self.power
        if p >= 1:
            return 0.0
        left = (c * p * (1 - p) * EULER_RADIUS / GRAVITY) ** (1 / (2 - p))
        return c * left**p


_r, _m = EULER_RADIUS, EULER_MASS
DECAYS = (
    Decay(
        "rolling resistance",
        rolling_resistance,
        4 * ROLLING_ARM**2 * GRAVITY / (9 * _r**3),
        2.0,
        1e-4,
    ),
    Decay(
        "dry friction of the rim",
        dry_rim,
        (2 * RIM_ARM / _r * math.sqrt(GRAVITY / _r)) ** (2 / 3),
        2 / 3,
        1e-4,
    ),
    Decay(
        "viscous friction of the rim",
        viscous_rim,
        math.sqrt(16 * RIM_DAMPING / (3 * _m * _r**2)),
        1 / 2,
        2e-4,
    ),
    Decay(
        "layer of air",
        layer_of_air,
        math.cbrt(2 * math.pi * AIR_VISCOSITY * _r / _m),
        1 / 3,
        5e-4,
    ),
)


def precession_rate(beta: float) -> float:
    """Return the precession Ω of the disc whose centre rests."""
    return math.sqrt(4 * GRAVITY / (EULER_RADIUS * math.sin(beta)))


class Record(NamedTuple):
    """Times and inclinations of a run up to its last step that was solved."""

    times: np.ndarray
    betas: np.ndarray


def spin_down(decay: Decay, dt: float, saved: int) -> Record:
    """Run the disc from a steady motion with its centre at rest."""
    machine = disc_on_its_side(decay.force)
    half, sine = 0.5 * FIRST_BETA, math.sin(FIRST_BETA)
    precession = precession_rate(FIRST_BETA)
    q0 = jnp.array([math.cos(half), math.sin(half), 0, 0, 0, 0, EULER_RADIUS * sine])
    y0 = nhjax.initial_state(
        machine.system, q0, jnp.zeros(6).at[4].set(precession * sine)
    )
    sol = nhjax.integrate(
        machine.system,
        nhjax.LobattoIIIAB(3),
        y0,
        dt=dt,
        num_steps=round(decay.duration / dt),
        saveat=nhjax.SaveAt(t0=True, steps=saved),
        # Each run ends in a singularity, where Newton's method would fail too.
        stage_solver=nhjax.SimplifiedNewton(fallback=False),
        throw=False,
    )
    count = int(sol.stats["num_steps"]) // saved
    q = np.asarray(sol.ys.q)[:count]
    return Record(np.asarray(sol.ts)[:count], 2 * np.arcsin(np.hypot(q[:, 1], q[:, 2])))


def resolved(coarse: Record, fine: Record) -> float:
    """Return the smallest β up to which both runs agree to one percent."""
    count = min(len(coarse.betas), len(fine.betas))
    coarse_betas, fine_betas = coarse.betas[:count], fine.betas[:count]
    apart = np.abs(coarse_betas / fine_betas - 1) > 0.01
    end = int(np.argmax(apart)) if np.any(apart) else count
    return float(np.min(fine_betas[:end]))


class Fit(NamedTuple):
    """The law β = c (t_f - t)^p that is nearest to a run, and its relative error."""

    power: float
    constant: float
    error: float


def fit(record: Record, smallest: float, largest: float) -> Fit:
    """Fit the law where β is in a range, with points at even distances of log β."""
    inside = (record.betas > smallest) & (record.betas < largest)
    times, logs = record.times[inside], np.log(record.betas[inside])
    grid = np.linspace(logs[0], logs[-1], 300)
    chosen = np.unique(np.clip(np.searchsorted(-logs, -grid), 0, len(logs) - 1))
    times, logs = times[chosen], logs[chosen]
    span = times[-1] - times[0]

    def left(z):
        return np.log(times[-1] + span * math.exp(z[0]) - times)

    def residuals(z):
        return logs - np.polyval(np.polyfit(left(z), logs, 1), left(z))

    # The residuals depend nonlinearly on the time of the end, so that several initial
    # values are tried.
    found = min(
        (
            scipy.optimize.least_squares(residuals, [z], xtol=1e-14, ftol=1e-14)
            for z in (-16.0, -12.0, -8.0, -4.0, -2.0)
        ),
        key=lambda one: one.cost,
    )
    power, log_constant = np.polyfit(left(found.x), logs, 1)
    return Fit(power, math.exp(log_constant), float(np.max(np.abs(found.fun))))


def measure_decay(decay: Decay) -> dict[str, Any]:
    """Run a law with two step sizes, and fit the exponent."""
    coarse = spin_down(decay, decay.dt, SAVED)
    fine = spin_down(decay, decay.dt / 2, 2 * SAVED)
    smallest = resolved(coarse, fine)
    lowest = max(2 * smallest, 3 * decay.last_beta)
    # The fit begins a little after the start, because the friction starts suddenly.
    highest = 0.8 * FIRST_BETA
    found = fit(fine, lowest, highest)
    return {
        "law": decay.name,
        "dt": decay.dt,
        "resolved": smallest,
        "turn": decay.dt * precession_rate(smallest),
        "last": decay.last_beta,
        "range": [lowest, highest],
        "power": found.power,
        "expected_power": decay.power,
        "constant": found.constant,
        "expected_constant": decay.constant,
        "fit_error": found.error,
    }


def measure_decays() -> tuple[str, dict[str, Any]]:
    """Measure Euler's disc with all laws."""
    rows, lines = [], []
    for decay in DECAYS:
        row = measure_decay(decay)
        rows.append(row)
        print(row, flush=True)
        jax.clear_caches()
        low, high = row["range"]
        lines.append(
            [
                row["law"],
                f"{row['dt']:g}",
                number(row["resolved"]),
                f"{row['turn']:.2f}",
                number(row["last"]) if row["last"] else "none",
                f"{number(low)} to {number(high)}",
                f"{row['power']:.4f}",
                f"{row['expected_power']:.4f}",
                f"{row['constant'] / row['expected_constant']:.4f}",
                number(row["fit_error"]),
            ]
        )
    header = [
        "law",
        "h, s",
        "resolved to β",
        "h Ω there",
        "law ends at β",
        "fitted from β",
    ]
    header += ["p", "expected p", "c / expected c", "largest error of the fit"]
    text = (
        f"## Euler's disc\n\nRuns with s = 3 from β = {FIRST_BETA}, with h and h / 2. "
        "They are resolved where both agree to one percent; h Ω is the turn of the "
        "contact in a step there, in rad. A law ends where it needs "
        "the vertical acceleration g. The fit is to the run with h / 2.\n\n"
        + markdown_table(header, lines)
    )
    return text, {"rows": rows}


# --- 3. A mecanum robot ---------------------------------------------------------------

ROBOT_MASS, ROBOT_INERTIA, WHEEL_INERTIA = 10.0, 0.4, 0.01
ROBOT_WHEEL, HALF_LENGTH, HALF_WIDTH = 0.05, 0.2, 0.15
STALL_TORQUE, NO_LOAD_SPEED, GEAR = 0.05, 400.0, 25.0
ROBOT_DURATION, COMMAND, HEADING = 3.0, 0.5, 0.3
# For each wheel, the signs of its position ahead and to the left, of the angle of its
# rollers, and of its turn in a sideways motion.
CORNERS = ((1, 1, -1, -1), (1, -1, 1, 1), (-1, 1, 1, 1), (-1, -1, -1, -1))


def mecanum_robot() -> Machine:
    """Create the robot, q = (x, y, heading, four turns), driven by `args`."""

    def wheel(index, ahead, left, side):
        def pose(t, q, args):
            turned = about_z(q[2])
            corner = jnp.array([ahead * HALF_LENGTH, left * HALF_WIDTH, ROBOT_WHEEL])
            place = jnp.append(q[:2], 0.0) + turned @ corner
            return place, turned @ about_y(q[3 + index])

        roller = side * math.pi / 4
        return rolling.Wheel(pose, ROBOT_WHEEL, no_slip=(roller,), touches=False)

    def motor(index, turn):
        return forces.Motor(
            lambda t, q, args: q[3 + index],
            lambda t, q, v, args: turn * args,
            stall_torque=STALL_TORQUE,
            no_load_speed=NO_LOAD_SPEED,
            gear=GEAR,
        )

    corners = list(enumerate(CORNERS))
    wheels = {f"wheel_{k}": wheel(k, *corner[:3]) for k, corner in corners}
    contacts = rolling.Contacts(**wheels)
    motors: Any = sum(motor(k, corner[3]) for k, corner in corners)
    inertia = np.array([ROBOT_MASS, ROBOT_MASS, ROBOT_INERTIA, *[WHEEL_INERTIA] * 4])

    def lagrangian(t, q, v, args):
        return 0.5 * v @ (jnp.asarray(inertia) * v)

    system = nhjax.LagrangianSystem(
        lagrangian, nonholonomic=contacts.nonholonomic, force=motors
    )
    return Machine(system, contacts)


def sideways(t: float) -> tuple[float, float]:
    """Return the displacement and the speed of the robot to its left, exactly."""
    mass = ROBOT_MASS + 4 * WHEEL_INERTIA / ROBOT_WHEEL**2
    damping = 4 * GEAR**2 * STALL_TORQUE / (NO_LOAD_SPEED * ROBOT_WHEEL**2)
    last, rate = ROBOT_WHEEL * COMMAND * NO_LOAD_SPEED / GEAR, damping / mass
    grown = -math.expm1(-rate * t)
    return last * (t - grown / rate), last * grown


def run_of_robot(stages: int, num_steps: int) -> dict[str, Any]:
    """Drive the robot sideways."""
    machine = mecanum_robot()
    q0 = jnp.zeros(7).at[2].set(HEADING)
    y0 = nhjax.initial_state(machine.system, q0, jnp.zeros(7), args=COMMAND)
    sol = nhjax.integrate(
        machine.system,
        nhjax.LobattoIIIAB(stages),
        y0,
        dt=ROBOT_DURATION / num_steps,
        num_steps=num_steps,
        args=COMMAND,
        saveat=nhjax.SaveAt(steps=True),
    )
    way, speed = sideways(ROBOT_DURATION)
    left = np.array([-math.sin(HEADING), math.cos(HEADING)])
    q, v = np.asarray(sol.ys.q), np.asarray(sol.ys.v)
    return {
        "stages": stages,
        "steps": num_steps,
        "violation": float(sol.stats["max_constraint_violation"]),
        "yaw": float(np.max(np.abs(q[:, 2] - HEADING))),
        "ahead": float(np.max(np.abs(q[:, :2] @ [left[1], -left[0]]))),
        "way": float(np.max(np.abs(q[-1, :2] - way * left))),
        "speed": float(np.max(np.abs(v[-1, :2] - speed * left))),
    }


def measure_robot() -> tuple[str, dict[str, Any]]:
    """Measure the mecanum robot."""
    rows = []
    for stages in (2, 3, 4):
        rows += [run_of_robot(stages, num_steps) for num_steps in (150, 300)]
        print(*rows, sep="\n", flush=True)
    jax.clear_caches()
    keys = ("violation", "yaw", "ahead", "way", "speed")
    lines = [
        [str(row["stages"]), str(row["steps"]), *(number(row[key]) for key in keys)]
        for row in rows
    ]
    header = ["s", "steps", "violation of constraints", "yaw, rad", "way ahead, m"]
    header += ["error of the way to the left, m", "error of the speed, m/s"]
    way, speed = sideways(ROBOT_DURATION)
    text = (
        f"## Mecanum robot\n\nA run of {ROBOT_DURATION:g} s: the robot moves "
        f"{way:.2f} m to its left and reaches {speed:.2f} m/s. Violation, yaw and way "
        "ahead are the largest of the whole run, and should be zero.\n\n"
        + markdown_table(header, lines)
    )
    return text, {"rows": rows}


# --- 4. Balls -------------------------------------------------------------------------

BALL_MASS, BALL_RADIUS = 2.0, 0.1
BALL_INERTIA = 0.4 * BALL_MASS * BALL_RADIUS**2
BALL_DURATION = 0.64
BALL_RUNS = {2: (256, 512), 3: (128, 256), 4: (64, 128)}
INCLINES = {
    "incline": np.array([0.2, -0.3, 1.0]),
    "steep incline": np.array([-3.0, 1.0, 0.5]),
}
TABLE_RATE = 10.0
BOWL_RADIUS, BOWL_ANGLE, BOWL_RATE, BOWL_TURNING = 0.6, 0.7, 3.0, 0.8


def ball_on(ground: rolling.AbstractGround) -> Machine:
    """Create a homogeneous ball."""
    contact = rolling.Ellipsoid(pose_of_body, BALL_RADIUS, ground=ground, manifold=SE3)
    return body(contact, BALL_MASS, (BALL_INERTIA,) * 3)


def on_incline(normal: np.ndarray, t: float) -> Motion:
    """Return the ball on an inclined plane through the origin: a = 5/7 g sin α.

    The ball starts across the slope, with a spin about the normal, which is constant.
    """
    n = normal / np.linalg.norm(normal)
    pull = GRAVITY * (n[2] * n - Z)
    acceleration, first = 5 / 7 * pull, 0.5 * np.cross(n, X)
    velocity = first + acceleration * t
    return Motion(
        BALL_RADIUS * n + first * t + 0.5 * acceleration * t**2,
        None,
        velocity,
        np.cross(n, velocity) / BALL_RADIUS + 4.0 * n,
        BALL_MASS * (acceleration + GRAVITY * Z),
    )


def on_turntable(t: float) -> Motion:
    """Return the ball on a turntable: a circle with the rate 2/7 Ω."""
    rate = 2 / 7 * TABLE_RATE
    turned = Rotation.from_rotvec(rate * t * Z)
    centre, arm = np.array([0.3, -0.2, BALL_RADIUS]), np.array([0.4, 0.1, 0.0])
    place, velocity = centre + turned.apply(arm), rate * np.cross(Z, turned.apply(arm))
    slip = velocity - TABLE_RATE * np.cross(Z, place)
    return Motion(
        place,
        None,
        velocity,
        np.cross(Z, slip) / BALL_RADIUS + 1.5 * Z,
        BALL_MASS * (rate * np.cross(Z, velocity) + GRAVITY * Z),
    )


def in_bowl(t: float) -> Motion:
    """Return the ball that circles in a bowl, which turns about its axis.

    The centre of the sphere is the origin. The balance of moments about the centre of
    the ball determines its spin about the normal.
    """
    turned = Rotation.from_rotvec(BOWL_RATE * t * Z)
    sine, cosine = math.sin(BOWL_ANGLE), math.cos(BOWL_ANGLE)
    first = (BOWL_RADIUS - BALL_RADIUS) * np.array([sine, 0.0, -cosine])
    normal = np.array([-sine, 0.0, cosine])
    velocity = BOWL_RATE * np.cross(Z, first)
    force = BALL_MASS * (BOWL_RATE * np.cross(Z, velocity) + GRAVITY * Z)
    # The contact point of the ball moves with the bowl: ẋ - ω × a n = Ω z × (x - a n).
    slip = velocity - BOWL_TURNING * np.cross(Z, first - BALL_RADIUS * normal)
    angular = np.cross(normal, slip) / BALL_RADIUS
    torque = np.cross(-BALL_RADIUS * normal, force)
    # ω rotates about the z axis at the rate Ω' of the path. Therefore I Ω' z × ω is the
    # torque, which is along the path.
    missing = torque[1] / (BALL_INERTIA * BOWL_RATE) - angular[0]
    angular = angular + missing / normal[0] * normal
    # The rotation is uniform for an observer who moves with the ball.
    own = Rotation.from_rotvec(t * (angular - BOWL_RATE * Z))
    return Motion(
        turned.apply(first),
        turned * own,
        turned.apply(velocity),
        turned.apply(angular),
        turned.apply(force),
    )


def table_velocity(t: Any, x: Array, args: Any) -> Array:
    """Return the velocity of the turntable at a point."""
    return TABLE_RATE * jnp.stack([-x[1], x[0], 0.0 * x[2]])


def bowl_velocity(t: Any, x: Array, args: Any) -> Array:
    """Return the velocity of the bowl at a point."""
    return BOWL_TURNING * jnp.stack([-x[1], x[0], 0.0 * x[2]])


def bowl_elevation(x: Array, args: Any) -> Array:
    """Return the height of the lower half of the sphere."""
    return -jnp.sqrt(BOWL_RADIUS**2 - x @ x)


def balls() -> dict[str, tuple[Machine, Callable[[float], Motion]]]:
    """Return the balls, with their motions in closed form."""
    found = {
        name: (
            ball_on(rolling.Plane(normal)),
            lambda t, normal=normal: on_incline(normal, t),
        )
        for name, normal in INCLINES.items()
    }
    table = rolling.Plane(velocity=table_velocity)
    bowl = rolling.Surface(bowl_elevation, velocity=bowl_velocity)
    return {
        **found,
        "turntable": (ball_on(table), on_turntable),
        "bowl": (ball_on(bowl), in_bowl),
    }


def measure_balls() -> tuple[str, dict[str, Any]]:
    """Measure all balls."""
    rows = []
    for name, (machine, motion) in balls().items():
        for stages, numbers_of_steps in BALL_RUNS.items():
            found = against_closed_form(
                machine, motion, BALL_DURATION, stages, numbers_of_steps
            )
            rows += [{"ball": name, **row} for row in found]
        print(*rows[-6:], sep="\n", flush=True)
        jax.clear_caches()
    largest = max(row["violation"] for row in rows)
    text = (
        f"## Balls\n\nRuns of {BALL_DURATION:g} s. The errors are in m, in m/s and "
        "rad/s, and in N. The rotation is known, and compared, in the bowl alone. The "
        f"bowl is a `Surface`. Constraints hold to {number(largest)}.\n\n"
        + convergence_table(rows, "ball")
    )
    return text, {"rows": rows}


# --- 5. A snakeboard ------------------------------------------------------------------

BOARD_STATES = 10


def snakeboard(board: Any, part: str) -> Machine:
    """Create the snakeboard of the gallery with two blades or two wheels."""

    def axle(index, side):
        def pose(t, q, args):
            radius = 0.03 if part == "wheel" else 0.0
            middle = jnp.append(q[:2], radius)
            ahead = about_z(q[2])[:, 0]
            place = middle + side * board.half_length * ahead
            return place, about_z(q[2] + q[index])

        if part == "blade":
            return rolling.Blade(pose, touches=False)
        return rolling.Wheel(pose, 0.03, no_slip=("across",), touches=False)

    contacts = rolling.Contacts(rear=axle(4, -1.0), front=axle(5, 1.0))
    system = nhjax.LagrangianSystem(
        board.lagrangian,
        nonholonomic=contacts.nonholonomic,
        holonomic=None if board.gait is None else board.holonomic,
        force=board.force if board.gait is None else None,
    )
    return Machine(system, contacts)


def difference_of_boards(part: str, driven: bool, states: int = BOARD_STATES) -> float:
    """Return the largest difference of accelerations, relative to the largest one."""
    rng = np.random.default_rng(7)
    gait: dict[str, Any] = {} if driven else {"gait": None}
    board = systems.Snakeboard(**gait)
    machines = (board.system, snakeboard(board, part).system)
    torques = None if driven else jnp.asarray(rng.normal(size=3))

    @jax.jit
    def accelerations(t, q, v):
        y = nhjax.State(q, v, jnp.zeros(6), jnp.zeros(5 if driven else 2))
        return [nhjax.motion(one, t, y, torques).acceleration for one in machines]

    largest = 0.0
    for _ in range(states):
        t, q, v = rng.uniform(0, 6), rng.uniform(-1, 1, 6), rng.normal(size=6)
        y = nhjax.initial_state(
            board.system,
            jnp.asarray(q),
            jnp.asarray(v),
            t=t,
            args=torques,
            project=True,
        )
        by_hand, from_parts = map(np.asarray, accelerations(t, y.q, y.v))
        apart = np.max(np.abs(from_parts - by_hand)) / np.max(np.abs(by_hand))
        largest = max(largest, float(apart))
    return largest


def measure_boards() -> tuple[str, dict[str, Any]]:
    """Measure the snakeboards."""
    rows, lines = [], []
    for part in ("blade", "wheel"):
        for driven in (False, True):
            found = difference_of_boards(part, driven)
            rows.append({"part": part, "driven": driven, "difference": found})
            joints = "prescribed by a gait" if driven else "free, with torques"
            lines.append([f"two {part}s", joints, number(found)])
    print(*rows, sep="\n", flush=True)
    text = (
        f"## Snakeboard\n\nThe largest difference of accelerations at {BOARD_STATES} "
        "random states from those of `systems.Snakeboard`, relative to the largest "
        "acceleration.\n\n" + markdown_table(["parts", "joints", "difference"], lines)
    )
    return text, {"rows": rows}


# --- 6. The bicycle -------------------------------------------------------------------

# Meijaard et al. (2007), table 2, at 0, 1, ... 10 m/s: two real eigenvalues and a
# complex pair; at rest all four are real. The linear equations, solved in 50 digits,
# give the same numbers up to 1e-13, with one exception: -18.15788466125202 at 7 m/s.
EIGENVALUES = (
    (-5.53094371765393, -3.13164324790656, 3.13164324790656, 5.53094371765393),
    (-7.11008014637442, -3.13423125066578, 3.52696170990070 + 0.8077402751993j),
    (-8.67387984831735, -3.07158645641514, 2.68234517512745 + 1.68066296590675j),
    (-10.35101467245920, -2.63366137253667, 1.70675605663975 + 2.31582447384325j),
    (-12.15861426576447, -1.42944427361326, 0.41325331521125 + 3.07910818603206j),
    (-14.07838969279822, -0.32286642900409, -0.77534188219585 + 4.46486771378823j),
    (-16.0853712309803, -0.00406690076970, -1.52644486584142 + 5.87673060598709j),
    (-18.15788466125262, 0.10268170574766, -2.13875644258362 + 7.19525913329805j),
    (-20.27940894394569, 0.14327879765713, -2.69348683581097 + 8.46037971396931j),
    (-22.43788559040858, 0.15790184030917, -3.21675402252485 + 9.69377351531791j),
    (-24.62459635017404, 0.16105338653172, -3.72016840437287 + 10.90681139476287j),
)
FIRST_CALLS = 3


def published_eigenvalues() -> np.ndarray:
    """Return the four eigenvalues at each speed, in order of their real parts."""
    rows = [[*printed, *np.conj(printed[2:])][:4] for printed in EIGENVALUES]
    return np.sort_complex(np.array(rows))


def bicycle_from_parts() -> Machine:
    """Create the bicycle of the gallery with two wheels of `nhjax.rolling`."""
    bicycle = systems.WhippleBicycle()
    # The third axis points down.
    ground = rolling.Plane((0.0, 0.0, -1.0))

    def wheel(index, radius, touches):
        def pose(t, q, args):
            frame = bicycle_parts._frames(bicycle, q)[index]
            hub = bicycle_parts._wheels(bicycle, q)[index].hub
            return frame.move(hub), frame.rotation @ about_y(q[6 + index])

        return rolling.Wheel(pose, radius, ground=ground, touches=touches)

    # The coordinates are such that the rear wheel is always on the ground.
    contacts = rolling.Contacts(
        rear=wheel(0, bicycle.rear_radius, False),
        front=wheel(1, bicycle.front_radius, True),
    )
    system = nhjax.LagrangianSystem(
        bicycle.lagrangian,
        nonholonomic=contacts.nonholonomic,
        holonomic=contacts.holonomic,
    )
    return Machine(system, contacts)


def errors_of_eigenvalues(system: nhjax.LagrangianSystem) -> list[float]:
    """Return the largest error of an eigenvalue at each speed."""

    @jax.jit
    def eigenvalues(speed):
        start = systems.WhippleBicycle.running(speed)
        y = nhjax.State(start.q0, start.v0, jnp.zeros(8), jnp.zeros(5))
        # The independent coordinates are lean and steer, and the independent velocities
        # their rates and the speed. The motion is steady by construction.
        return nhjax.linear_stability(
            system,
            0.0,
            y,
            positions=(3, 5),
            velocities=(3, 5, 6),
            must_be_steady=False,
        ).eigenvalues

    errors = []
    for speed, printed in enumerate(published_eigenvalues()):
        found = np.asarray(eigenvalues(float(speed)))
        # Perturbations of the speed have the eigenvalue zero, which is removed.
        found = np.sort_complex(np.delete(found, np.argmin(np.abs(found))))
        errors.append(float(np.max(np.abs(found - printed))))
    return errors


def first_call(name: str) -> float:
    """Return the seconds of the processor to trace and compile a run of the bicycle."""
    start = systems.WhippleBicycle.running(speed=5.0, lean_rate=0.5)
    system = start.system if name == "gallery" else bicycle_from_parts().system
    # `initial_state` would trace the functions of the gallery before the clock starts.
    y = nhjax.State(start.q0, start.v0, jnp.zeros(8), jnp.zeros(5))
    _, parts = compiled(program(system, 3, "run"), y, jnp.asarray(0.05))
    return sum(parts)


def measure_bicycle() -> tuple[str, dict[str, Any]]:
    """Measure the bicycle."""
    gallery = systems.WhippleBicycle().system
    errors = {
        "gallery": errors_of_eigenvalues(gallery),
        "parts": errors_of_eigenvalues(bicycle_from_parts().system),
    }
    jax.clear_caches()
    seconds: dict[str, list[float]] = {"gallery": [], "parts": []}
    # The processes run in turn, because the load of the machine changes.
    for _ in range(FIRST_CALLS):
        for name, found in seconds.items():
            found.append(from_fresh_process("rolling", "--first-call", name))
    print(errors, seconds, flush=True)
    best = {name: min(found) for name, found in seconds.items()}
    ratio = best["parts"] / best["gallery"]
    lines = [
        [name, number(max(errors[key])), f"{best[key]:.1f}"]
        for key, name in (("gallery", "gallery"), ("parts", "from parts"))
    ]
    header = ["bicycle", "largest error of an eigenvalue, 1/s", "first call, s"]
    text = (
        "## Bicycle\n\nEigenvalues of the upright bicycle at 0, 1, ... 10 m/s against "
        "those in print, by `linear_stability`. The first call is the time of the "
        "processor to trace and compile a run of three stages, the least of "
        f"{FIRST_CALLS} fresh processes. From parts it takes {ratio:.2f} times as long "
        "as in the gallery.\n\n" + markdown_table(header, lines)
    )
    return text, {"eigenvalues": errors, "first_call": seconds, "ratio": ratio}


def main() -> None:
    """Print and save the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--first-call", choices=("gallery", "parts"), help=argparse.SUPPRESS
    )
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    jax.jit(jnp.sin).lower(0.1).compile()
    if given.first_call is not None:
        print(json.dumps(first_call(given.first_call)))
        return
    measured = {
        "disc": measure_disc(),
        "decays": measure_decays(),
        "robot": measure_robot(),
        "balls": measure_balls(),
        "boards": measure_boards(),
        "bicycle": measure_bicycle(),
    }
    text = "\n\n".join(part for part, _ in measured.values())
    data = {name: found for name, (_, found) in measured.items()}
    write("rolling", "Rolling machines from parts", text, data)


if __name__ == "__main__":
    main()
