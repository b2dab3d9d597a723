"""Robots from model files, compared with MuJoCo's contacts and a model by hand.

There are four measurements:

1. A robot on two wheels and two casters that slide moves for 60 s without motors and
   without damping, from the same state in nhjax and in MuJoCo. In MuJoCo the wheels
   are geoms with contacts of the default stiffness on a plane. The centre of mass is
   above the axle, so that the robot runs on a circle. The slip is the sideways velocity
   of the axle. The energy should not change.
2. The first call of a run: the processor time to trace, to compile and to run, and the
   memory of the process. The robot is a tree of 20 degrees of freedom without wheels on
   the ground. The model written by hand describes the same tree: it computes the poses
   of all bodies with `vmap` over the legs, and their velocities with `jax.jvp`.
3. A run of 64 robots by `vmap`, compared with one robot.
4. The gradient with respect to the mass of a link, compared with central differences.

    python -m benchmarks.robots
"""

import argparse
import importlib
import json
import resource
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import nhjax

from ._report import (
    from_fresh_process,
    least_time,
    markdown_table,
    number,
    RESULTS,
    write,
)


mujoco: Any = importlib.import_module("mujoco")

DURATION, STEP = 60.0, 0.02
METHOD = nhjax.LobattoIIIAB(2)
# The index of the state that is saved at t = 2 s.
SETTLED = 10
START = {"x": 0.5, "heading": 0.4}
MEMBERS = 64


# --- 1. Beside MuJoCo's contacts ------------------------------------------------------

_WHEELED = """<mujoco><option gravity="0 0 -9.81" timestep="0.002"/>
<default><geom contype="0" conaffinity="0"/></default><worldbody>
<geom name="floor" type="plane" size="100 100 1" contype="{c}" conaffinity="{c}"/>
<body name="base" pos="0 0 0.1">{root}
<geom type="box" size="0.2 0.13 0.05" pos="0 0 0.06" mass="9"/>
<geom type="sphere" size="0.04" pos="0.26 0 -0.06" mass="0"
  contype="{c}" conaffinity="{c}" {slides}/>
<geom type="sphere" size="0.04" pos="-0.26 0 -0.06" mass="0"
  contype="{c}" conaffinity="{c}" {slides}/>
<body name="left" pos="0 0.16 0"><joint name="left" axis="0 1 0"/>
<geom name="left" type="cylinder" size="0.1 0.02" euler="90 0 0" mass="0.8"
  contype="{c}" conaffinity="{c}"/></body>
<body name="right" pos="0 -0.16 0"><joint name="right" axis="0 1 0"/>
<geom name="right" type="cylinder" size="0.1 0.02" euler="90 0 0" mass="0.8"
  contype="{c}" conaffinity="{c}"/></body>
</body></worldbody></mujoco>"""
_PLANAR = (
    '<joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" '
    'axis="0 1 0"/><joint name="heading" axis="0 0 1"/>'
)
# Casters in front and behind, as spheres without friction.
_SLIDES = 'condim="1" priority="1"'


def wheeled(root: str, has_contacts: bool) -> Any:
    """Compile the robot on two wheels and two sliding casters."""
    text = _WHEELED.format(root=root, c=int(has_contacts), slides=_SLIDES)
    return mujoco.MjSpec.from_string(text).compile()


def beside_mujoco() -> tuple[str, dict[str, Any]]:
    """Measure slip and energy in nhjax and in MuJoCo over the same time."""
    model: Any = wheeled(_PLANAR, False)
    robot = nhjax.from_mujoco(model, rolling=["left", "right"])
    speed, turning = START["x"], START["heading"]
    rates = {
        "x": speed,
        "heading": turning,
        "left": (speed - 0.16 * turning) / 0.1,
        "right": (speed + 0.16 * turning) / 0.1,
    }
    y0 = robot.initial_state(qvel=rates)
    count = round(DURATION / STEP)
    saveat = nhjax.SaveAt(t0=True, steps=count // 300)

    def run():
        return nhjax.integrate(
            robot.system, METHOD, y0, dt=STEP, num_steps=count, saveat=saveat
        )

    sol = run()
    start = time.perf_counter()
    sol = jax.block_until_ready(run())
    seconds = time.perf_counter() - start
    qpos, qvel = np.asarray(robot.qpos(sol)), np.asarray(robot.qvel(sol))
    sideways = qvel[:, 1] * np.cos(qpos[:, 2]) - qvel[:, 0] * np.sin(qpos[:, 2])
    energy = _energies(model, qpos, qvel)
    ours = {
        "times": np.linspace(0, DURATION, len(energy)),
        "slip": np.abs(sideways),
        "energy": energy / energy[0] - 1,
        "seconds": seconds,
        "step": STEP,
    }
    rows = {f"nhjax, {STEP:g} s": ours}
    soft: Any = wheeled('<freejoint name="base"/>', True)
    for timestep in (0.002, 0.0005):
        soft.opt.timestep = timestep
        rows[f"MuJoCo, {timestep:g} s"] = _by_contacts(soft, rates)
    lines = [
        [
            name,
            number(float(np.max(row["slip"]))),
            number(float(np.max(row["slip"][SETTLED:]))),
            number(float(np.max(np.abs(row["energy"])))),
            f"{row['seconds']:.2f}",
        ]
        for name, row in rows.items()
    ]
    header = ["program", "largest slip, m/s", "later", "change of energy", "time, s"]
    text = (
        f"## Beside MuJoCo's contacts\n\nA run of {DURATION:g} s without motors and "
        "damping, with the step sizes in the table. The slip is the velocity of the "
        "axle sideways, in the whole run and after the first 2 s, in which MuJoCo's "
        "contacts settle. The largest change of the kinetic energy is relative to the "
        "start. MuJoCo's contacts are soft, and its wheels could lift off.\n\n"
        + markdown_table(header, lines)
    )
    return text, rows


def _energies(model: Any, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """Return MuJoCo's kinetic energies."""
    data, found = mujoco.MjData(model), []
    mass: Any = np.zeros((model.nv, model.nv))
    for q, v in zip(qpos, qvel, strict=True):
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, mass)
        found.append(0.5 * v @ mass @ v)
    return np.array(found)


def _by_contacts(model: Any, rates: dict[str, float]) -> dict[str, Any]:
    data = mujoco.MjData(model)
    data.qvel[[0, 5, 6, 7]] = [rates[x] for x in ("x", "heading", "left", "right")]
    mujoco.mj_forward(model, data)
    count = round(DURATION / model.opt.timestep)
    qpos, qvel = [data.qpos.copy()], [data.qvel.copy()]
    start = time.perf_counter()
    for k in range(1, count + 1):
        mujoco.mj_step(model, data)
        if k % (count // 300) == 0:
            qpos.append(data.qpos.copy())
            qvel.append(data.qvel.copy())
    seconds = time.perf_counter() - start
    qpos, qvel = np.array(qpos), np.array(qvel)
    w, x, y, z = qpos[:, 3:7].T
    heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    sideways = qvel[:, 1] * np.cos(heading) - qvel[:, 0] * np.sin(heading)
    energy = _energies(model, qpos, qvel)
    return {
        "times": np.linspace(0, DURATION, len(energy)),
        "slip": np.abs(sideways),
        "energy": energy / energy[0] - 1,
        "seconds": seconds,
        "step": model.opt.timestep,
    }


def draw(rows: dict[str, Any]) -> None:
    """Save the figure of slip and energy."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    for name, row in rows.items():
        axes[0].semilogy(row["times"], np.maximum(row["slip"], 1e-17), label=name)
        axes[1].semilogy(
            row["times"], np.maximum(np.abs(row["energy"]), 1e-17), label=name
        )
    axes[0].set(xlabel="time [s]", ylabel="sideways slip [m/s]")
    axes[1].set(xlabel="time [s]", ylabel="change of energy")
    axes[1].legend()
    for folder in (RESULTS, RESULTS.parents[1] / "docs"):
        figure.savefig(folder / "robots.png", dpi=120)
    plt.close(figure)


# --- 2. The first call ----------------------------------------------------------------

_PLACES = np.array([(x, y, 0.0) for x in (0.25, -0.25) for y in (0.1, -0.1)])
_LEG = """<body pos="{x} {y} 0"><joint name="a{n}" axis="1 0 0"/>
<geom type="box" size="0.05 0.03 0.03" mass="0.5"/>
<body pos="0 {side} 0"><joint name="b{n}" axis="0 1 0"/>
<geom type="box" size="0.03 0.03 0.1" pos="0 0 -0.1" mass="0.8"/>
<body pos="0 0 -0.2"><joint name="c{n}" axis="0 1 0"/>
<geom type="box" size="0.02 0.02 0.1" pos="0 0 -0.1" mass="0.4"/>
</body></body></body>"""
_TAIL = """<body pos="-0.3 0 0"><joint name="d" axis="0 1 0"/>
<geom type="box" size="0.08 0.02 0.02" pos="-0.08 0 0" mass="0.3"/>
<body pos="-0.16 0 0"><joint name="e" axis="0 0 1"/>
<geom type="box" size="0.08 0.02 0.02" pos="-0.08 0 0" mass="0.2"/></body></body>"""


def tree_from_file(**options: Any) -> nhjax.Robot:
    """Read the tree of 20 degrees of freedom."""
    legs = "".join(
        _LEG.format(n=n, x=x, y=y, side=y / 2) for n, (x, y, _) in enumerate(_PLACES)
    )
    text = f"""<mujoco><default><geom contype="0" conaffinity="0"/></default>
    <worldbody><body name="trunk" pos="0 0 0.5"><freejoint name="trunk"/>
    <geom type="box" size="0.3 0.15 0.06" mass="6"/>{legs}{_TAIL}
    </body></worldbody></mujoco>"""
    return nhjax.from_mujoco(mujoco.MjSpec.from_string(text), **options)


def _box(mass: float, size: tuple[float, ...]) -> np.ndarray:
    square = np.array(size) ** 2
    return mass / 3 * (square.sum() - square)


def tree_by_hand() -> nhjax.LagrangianSystem:
    """Write the same tree as a user would, with one function for all legs."""
    turns = nhjax.SO3()
    manifold = nhjax.ProductGroup(nhjax.Euclidean(3), turns, nhjax.Euclidean(14))
    sizes = [(0.05, 0.03, 0.03), (0.03, 0.03, 0.1), (0.02, 0.02, 0.1)]
    leg_masses = np.array([0.5, 0.8, 0.4])
    leg_moments = np.array(list(map(_box, leg_masses, sizes)))
    tail_masses = np.array([0.3, 0.2])
    tail_moments = np.array([_box(m, (0.08, 0.02, 0.02)) for m in tail_masses])

    def about(axis, angle):
        cos, sin, zero = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)
        one = zero + 1
        rows = {
            0: [one, zero, zero, zero, cos, -sin, zero, sin, cos],
            1: [cos, zero, sin, zero, one, zero, -sin, zero, cos],
            2: [cos, -sin, zero, sin, cos, zero, zero, zero, one],
        }
        return jnp.stack(rows[axis]).reshape(3, 3)

    def chain(rotation, position, offsets, axes, angles, centres):
        rotations, places = [], []
        for offset, axis, angle, centre in zip(
            offsets, axes, angles, centres, strict=True
        ):
            position = position + rotation @ offset
            rotation = rotation @ about(axis, angle)
            rotations.append(rotation)
            places.append(position + rotation @ centre)
        return jnp.stack(rotations), jnp.stack(places)

    down, back = jnp.array([0.0, 0.0, -0.1]), jnp.array([-0.08, 0.0, 0.0])

    def poses(q):
        position, quaternion, angles = q
        rotation = turns.matrix(quaternion)

        def leg(place, angles):
            offsets = [place, jnp.array([0.0, 0.5, 0.0]) * place, 2 * down]
            centres = [0 * down, down, down]
            return chain(rotation, position, offsets, (0, 1, 1), angles, centres)

        legs = jax.vmap(leg)(jnp.asarray(_PLACES), angles[:12].reshape(4, 3))
        start = jnp.array([-0.3, 0.0, 0.0])
        tail = chain(
            rotation, position, [start, 2 * back], (1, 2), angles[12:], [back, back]
        )
        return (rotation, position), legs, tail

    def energy(pose, rate, mass, moments):
        turn = jnp.swapaxes(pose[0], -1, -2) @ rate[0]
        omega = jnp.stack([turn[..., 2, 1], turn[..., 0, 2], turn[..., 1, 0]], axis=-1)
        moving = jnp.sum(mass * jnp.sum(rate[1] ** 2, axis=-1))
        height = 9.81 * jnp.sum(mass * pose[1][..., 2])
        return 0.5 * (moving + jnp.sum(moments * omega**2)) - height

    def lagrangian(t, q, v, args):
        found, rates = jax.jvp(poses, (q,), (manifold.tangent(q, v),))
        trunk = energy(found[0], rates[0], 6.0, jnp.asarray(_box(6, (0.3, 0.15, 0.06))))
        legs = energy(found[1], rates[1], jnp.asarray(leg_masses), leg_moments)
        return trunk + legs + energy(found[2], rates[2], tail_masses, tail_moments)

    return nhjax.LagrangianSystem(lagrangian, manifold=manifold)


def first_call(name: str) -> dict[str, float]:
    """Measure the first call in this process."""
    start = time.process_time()
    velocity = jnp.linspace(0.1, 0.5, 20)
    qpos = jnp.zeros(21).at[2].set(0.5).at[3].set(1.0)
    robot = tree_from_file()
    q = robot._space.from_qpos(qpos)
    loaded = time.process_time()
    system = robot.system if name == "file" else tree_by_hand()
    y0 = jax.block_until_ready(nhjax.initial_state(system, q, velocity))
    ready = time.process_time()

    def run():
        sol = nhjax.integrate(system, METHOD, y0, dt=0.002, num_steps=1000)
        return jax.block_until_ready(sol.ys)

    end = run()
    done = time.process_time()
    run()
    again = time.process_time()
    return {
        "load": loaded - start if name == "file" else 0.0,
        "state": ready - loaded,
        "run": done - ready,
        "again": again - done,
        "megabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "end": np.asarray(end.v[-1]).tolist(),
    }


def measure_first_calls() -> tuple[str, dict[str, Any]]:
    """Measure the first call of the tree, and of the same tree written by hand."""
    rows = {
        name: from_fresh_process("robots", "--first-call", name)
        for name in ("file", "hand")
    }
    apart = np.abs(np.subtract(rows["file"].pop("end"), rows["hand"].pop("end"))).max()
    sums = {k: row["load"] + row["state"] + row["run"] for k, row in rows.items()}
    ratio = sums["file"] / sums["hand"]
    names = {"file": "from a file", "hand": "by hand"}
    lines = [
        [
            names[k],
            *(f"{row[x]:.1f}" for x in ("load", "state", "run")),
            f"{sums[k]:.1f}",
            f"{row['again']:.2f}",
            f"{row['megabytes']:.0f}",
        ]
        for k, row in rows.items()
    ]
    header = ["model", "read, s", "first state, s", "first run, s", "all, s"]
    text = (
        "## First call\n\nA tree of 20 degrees of freedom: seconds of the processor to "
        "read the model, for the first `initial_state`, and for the first run of 1000 "
        f"steps. From a file it takes {ratio:.2f} times as long as by hand. The "
        f"velocities at the end differ by {number(float(apart))}.\n\n"
        + markdown_table([*header, "second run, s", "memory, MB"], lines)
    )
    return text, rows | {"ratio": ratio, "apart": apart}


# --- 3. and 4. Ensembles and gradients ------------------------------------------------


def measure_ensemble() -> tuple[str, dict[str, Any]]:
    """Measure runs of many robots and of one robot."""
    robot = nhjax.example_robot("mecanum_platform")
    y0 = robot.initial_state()

    def end(torque):
        args = {"controls": torque * jnp.array([1.0, -1.0, -1.0, 1.0])}
        sol = nhjax.integrate(
            robot.system, METHOD, y0, dt=0.02, num_steps=500, args=args, throw=False
        )
        return sol.ys.q[-1]

    def seconds(function, torque):
        function = jax.jit(function)
        jax.block_until_ready(function(torque))
        return least_time(lambda: function(torque), 5)

    torques = jnp.linspace(0.1, 1.0, MEMBERS)
    one, many = seconds(end, torques[0]), seconds(jax.vmap(end), torques)
    text = (
        f"## {MEMBERS} robots\n\n500 steps of the mecanum platform with motors take "
        f"{1e3 * one:.2f} ms. {MEMBERS} platforms by `vmap` take {1e3 * many:.2f} ms, "
        f"{many / one:.1f} times as long."
    )
    return text, {"one": one, "many": many, "members": MEMBERS, "ratio": many / one}


def measure_gradient() -> tuple[str, dict[str, Any]]:
    """Compare the gradient with respect to a mass with finite differences."""
    robot = nhjax.example_robot("balancing_robot", parameters={"mass": ["body"]})
    y0 = robot.initial_state({"pitch": 0.1})

    def pitch(args):
        sol = nhjax.integrate(
            robot.system, METHOD, y0, dt=0.01, num_steps=50, args=args
        )
        return sol.ys.q[-1, 3]

    def at(mass):
        return float(pitch({"mass": {"body": jnp.asarray(mass)}}))

    slope = float(jax.grad(pitch)(robot.args)["mass"]["body"])
    mass, h = float(robot.args["mass"]["body"]), 0.01
    near, far = [(at(mass + k * h) - at(mass - k * h)) / (2 * k * h) for k in (1, 2)]
    by_differences = (4 * near - far) / 3
    apart = abs(slope / by_differences - 1)
    text = (
        "## Gradient\n\nThe balancing robot falls for 0.5 s. The derivative of its "
        f"pitch with respect to the mass of its body is {slope:.6e} rad/kg. Central "
        f"differences of fourth order agree to {number(apart)}, relative to it."
    )
    return text, {"slope": slope, "differences": by_differences, "apart": apart}


def main() -> None:
    """Print and save the tables, and save the figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--first-call", choices=("file", "hand"), help=argparse.SUPPRESS
    )
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    jax.jit(jnp.sin).lower(0.1).compile()
    if given.first_call is not None:
        print(json.dumps(first_call(given.first_call)))
        return
    measured = {"contacts": beside_mujoco()}
    draw(measured["contacts"][1])
    measured["first_call"] = measure_first_calls()
    measured["ensemble"] = measure_ensemble()
    measured["gradient"] = measure_gradient()
    text = "\n\n".join(part for part, _ in measured.values())
    write(
        "robots",
        "Robots from model files",
        text,
        {name: found for name, (_, found) in measured.items()},
    )


if __name__ == "__main__":
    main()
