"""The Whipple bicycle by Kane's method, and the linear equations of the benchmark.

Vectors and their rates are written out in NumPy, without a Lagrangian or automatic
derivatives. The rolling of the rear wheel and the force of the ground on the front
wheel replace constraints and multipliers.
"""

import math

import numpy as np

from support.flow import flow


# Meijaard et al. (2007), table 1.
BENCHMARK = {
    "w": 1.02,
    "c": 0.08,
    "tilt": math.pi / 10,
    "g": 9.81,
    "rR": 0.3,
    "mR": 2.0,
    "IR": (0.0603, 0.12),
    "mB": 85.0,
    "cB": (0.3, -0.9),
    "IB": (9.2, 11.0, 2.8, 2.4),
    "mH": 4.0,
    "cH": (0.9, -0.7),
    "IH": (0.05892, 0.06, 0.00708, -0.00756),
    "rF": 0.35,
    "mF": 3.0,
    "IF": (0.1405, 0.28),
}
DOWN = np.array([0.0, 0.0, 1.0])


def parameters_of(bicycle):
    """The parameters of a bicycle of the gallery, named as in `BENCHMARK`."""
    b = bicycle
    values = (b.wheelbase, b.trail, b.tilt, b.gravity)
    values += (b.rear_radius, b.rear_wheel_mass, b.rear_wheel_inertia)
    values += (b.rear_frame_mass, b.rear_frame_centre, b.rear_frame_inertia)
    values += (b.front_frame_mass, b.front_frame_centre, b.front_frame_inertia)
    values += (b.front_radius, b.front_wheel_mass, b.front_wheel_inertia)
    named = zip(BENCHMARK, values, strict=True)
    return {name: np.asarray(value, dtype=np.float64) for name, value in named}


def _turn(axis, angle):
    """Turn vectors about a unit axis (Rodrigues)."""
    x, y, z = axis
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * skew + (1 - math.cos(angle)) * skew @ skew


def _inertia(values):
    xx, yy, zz, xz = values if len(values) == 4 else (*values, values[0], 0.0)
    return np.array([[xx, 0, xz], [0, yy, 0], [xz, 0, zz]])


def _arm(radius, axle, axle_rate):
    """The vector from a hub to the contact, and its rate."""
    below = DOWN - axle[2] * axle
    rate = -axle_rate[2] * axle - axle[2] * axle_rate
    size = math.sqrt(below @ below)
    size_rate = below @ rate / size
    return radius * below / size, radius * (rate / size - below * size_rate / size**2)


def accelerations(parameters, q, v, torque=0.0):
    """(accelerations of q, forces on both wheels at the ground) at a state."""
    P = parameters
    yaw, lean, pitch, steer = q[2:6]
    u = v[2:]
    # Axes of the six angles in space; each axis turns with the angles before it.
    x, y, z = np.eye(3)
    R1 = _turn(z, yaw)
    R2 = R1 @ _turn(x, lean)
    R = R2 @ _turn(y, pitch)
    axis = np.array([math.sin(P["tilt"]), 0.0, math.cos(P["tilt"])])
    F = R @ _turn(axis, steer)
    axes = np.stack([z, R1 @ x, R[:, 1], R @ axis, R[:, 1], F[:, 1]])
    # Angular velocities of yaw frame, rear frame, front frame, rear and front wheel.
    yawing = u[0] * axes[0]
    rear = yawing + u[1] * axes[1] + u[2] * axes[2]
    front = rear + u[3] * axes[3]
    spins = {"R": rear + u[4] * axes[4], "F": front + u[5] * axes[5]}
    spins |= {"B": rear, "H": front}
    carriers = (np.zeros(3), yawing, rear, rear, rear, front)
    rates = np.cross(carriers, axes)
    members = {
        "B": [1, 1, 1, 0, 0, 0],
        "R": [1, 1, 1, 0, 1, 0],
        "H": [1, 1, 1, 1, 0, 0],
        "F": [1, 1, 1, 1, 0, 1],
    }
    partial = {k: axes * np.array(m)[:, None] for k, m in members.items()}
    bias = {k: u @ (rates * np.array(m)[:, None]) for k, m in members.items()}

    def along(points, body, arm, arm_rate):
        """Move (partial velocities, bias of acceleration) along an arm of a body."""
        partials, extra = points
        extra = extra + np.cross(bias[body], arm) + np.cross(spins[body], arm_rate)
        return partials + np.cross(partial[body], arm), extra

    def fixed(body, arm):
        return arm, np.cross(spins[body], arm)

    def plane(point):
        return np.array([point[0], 0.0, point[1]])

    hub_R, hub_F = plane((0.0, -P["rR"])), plane((P["w"], -P["rF"]))
    foot = plane((P["w"] + P["c"], 0.0))
    arm_R, arm_R_rate = _arm(P["rR"], R[:, 1], np.cross(rear, R[:, 1]))
    arm_F, arm_F_rate = _arm(P["rF"], F[:, 1], np.cross(front, F[:, 1]))
    still = (np.zeros((6, 3)), np.zeros(3))
    at = {"R": along(still, "R", -arm_R, -arm_R_rate)}
    at["B"] = along(at["R"], "B", *fixed("B", R @ (plane(P["cB"]) - hub_R)))
    joint = along(at["R"], "B", *fixed("B", R @ (foot - hub_R)))
    at["H"] = along(joint, "H", *fixed("H", F @ (plane(P["cH"]) - foot)))
    at["F"] = along(joint, "H", *fixed("H", F @ (hub_F - foot)))
    contact, contact_bias = along(at["F"], "F", arm_F, arm_F_rate)

    mass, force = np.zeros((6, 6)), np.zeros(6)
    force[3] = torque
    inertias = {"R": P["IR"], "B": P["IB"], "H": P["IH"], "F": P["IF"]}
    for k, (velocity, extra) in at.items():
        turned = R if k in "RB" else F
        inertia = turned @ _inertia(inertias[k]) @ turned.T
        gyro = inertia @ bias[k] + np.cross(spins[k], inertia @ spins[k])
        mass += P[f"m{k}"] * velocity @ velocity.T + partial[k] @ inertia @ partial[k].T
        force += P[f"m{k}"] * velocity @ (P["g"] * DOWN - extra) - partial[k] @ gyro
    matrix = np.block([[mass, -contact], [contact.T, np.zeros((3, 3))]])
    solution = np.linalg.solve(matrix, np.concatenate([force, -contact_bias]))
    udot, on_front = solution[:6], solution[6:]
    total = sum(
        P[f"m{k}"] * (udot @ velocity + extra - P["g"] * DOWN)
        for k, (velocity, extra) in at.items()
    )
    pace, change = P["rR"] * (u[2] + u[4]), P["rR"] * (udot[2] + udot[4])
    heading = np.array([math.cos(yaw), math.sin(yaw)])
    turning = u[0] * np.array([-heading[1], heading[0]])
    path = -change * heading - pace * turning
    return np.concatenate([path, udot]), (total - on_front, on_front)


def rear_path_velocity(parameters, q, v):
    """The velocity of the contact of the rear wheel along its track."""
    pace = -parameters["rR"] * (v[4] + v[6])
    return pace * np.array([math.cos(q[2]), math.sin(q[2])])


def trajectory(parameters, q0, v0, times, torque=lambda t, q, v: 0.0):
    """(q, v) at the times, by SciPy."""

    def field(t, y):
        q, v = y[:8], y[8:]
        return np.concatenate([v, accelerations(parameters, q, v, torque(t, q, v))[0]])

    y = flow(field, [*q0, *v0], times)
    return y[:, :8], y[:, 8:]


def canonical(parameters):
    """M, C1, K0 and K2 of the linear equations, by the paper's appendix A."""
    P = parameters
    w, c, tilt = P["w"], P["c"], P["tilt"]
    sin, cos = math.sin(tilt), math.cos(tilt)
    (IRxx, IRyy), (IFxx, IFyy) = P["IR"], P["IF"]
    (xB, zB), (xH, zH) = P["cB"], P["cH"]
    IBxx, _, IBzz, IBxz = P["IB"]
    IHxx, _, IHzz, IHxz = P["IH"]
    mR, mB, mH, mF = P["mR"], P["mB"], P["mH"], P["mF"]
    mT = mR + mB + mH + mF
    xT = (xB * mB + xH * mH + w * mF) / mT
    zT = (-P["rR"] * mR + zB * mB + zH * mH - P["rF"] * mF) / mT
    ITxx = IRxx + IBxx + IHxx + IFxx + mR * P["rR"] ** 2 + mB * zB**2
    ITxx += mH * zH**2 + mF * P["rF"] ** 2
    ITxz = IBxz + IHxz - mB * xB * zB - mH * xH * zH + mF * w * P["rF"]
    ITzz = IRxx + IBzz + IHzz + IFxx + mB * xB**2 + mH * xH**2 + mF * w**2
    mA = mH + mF
    xA, zA = (xH * mH + w * mF) / mA, (zH * mH - P["rF"] * mF) / mA
    IAxx = IHxx + IFxx + mH * (zH - zA) ** 2 + mF * (P["rF"] + zA) ** 2
    IAxz = IHxz - mH * (xH - xA) * (zH - zA) + mF * (w - xA) * (P["rF"] + zA)
    IAzz = IHzz + IFxx + mH * (xH - xA) ** 2 + mF * (w - xA) ** 2
    uA = (xA - w - c) * cos - zA * sin
    IAll = mA * uA**2 + IAxx * sin**2 + 2 * IAxz * sin * cos + IAzz * cos**2
    IAlx = -mA * uA * zA + IAxx * sin + IAxz * cos
    IAlz = mA * uA * xA + IAxz * sin + IAzz * cos
    mu = c / w * cos
    SR, SF = IRyy / P["rR"], IFyy / P["rF"]
    ST, SA = SR + SF, mA * uA + mu * mT * xT
    off = IAlx + mu * ITxz
    M = np.array([[ITxx, off], [off, IAll + 2 * mu * IAlz + mu**2 * ITzz]])
    K0 = np.array([[mT * zT, -SA], [-SA, -SA * sin]])
    K2 = np.array([[0, (ST - mT * zT) / w * cos], [0, (SA + SF * sin) / w * cos]])
    C12 = mu * ST + SF * cos + ITxz / w * cos - mu * mT * zT
    C22 = IAlz / w * cos + mu * (SA + ITzz / w * cos)
    C1 = np.array([[0, C12], [-(mu * ST + SF * cos), C22]])
    return M, C1, K0, K2


def linear_motion(parameters, speed, gains=(0.0, 0.0)):
    """The matrix of (lean, steer, lean rate, steer rate) about straight running.

    `gains` are K and D of a steer torque K φ + D φ̇.
    """
    M, C1, K0, K2 = canonical(parameters)
    stiffness = parameters["g"] * K0 + speed**2 * K2
    damping = speed * C1
    stiffness[1, 0] -= gains[0]
    damping[1, 0] -= gains[1]
    lower = np.linalg.solve(M, np.hstack([-stiffness, -damping]))
    return np.block([[np.zeros((2, 2)), np.eye(2)], [lower]])


def forces(on_wheels):
    """The components of the ground forces that the multipliers represent."""
    rear, front = on_wheels
    return np.concatenate([rear[:2], front])
