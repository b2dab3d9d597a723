"""The films of docs/films.md and of README.

python docs/films.py                writes docs/films/NAME.gif for all films
python docs/films.py bicycle        writes one of them
python docs/films.py --frames 6     writes single frames instead, to look at
"""

import argparse
import importlib
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

import nhjax


FILMS = Path(__file__).parent / "films"


class Film(NamedTuple):
    """A machine, its motion, and how it is filmed.

    - `run`: returns the machine and the solution.
    - `speed`, `camera`: as for `nhjax.render`.
    """

    run: Callable[[], tuple[Any, nhjax.Solution]]
    speed: float
    camera: Any
    size: tuple[int, int] = (480, 320)
    fps: float = 20.0


def bicycle() -> tuple[Any, nhjax.Solution]:
    """A bicycle without hands on it, pushed sideways, at a speed where it is stable."""
    machine = nhjax.systems.WhippleBicycle.running(5.0, lean_rate=0.45)
    return machine, _run(machine.system, machine.initial_state(), 4.0, 200)


def rattleback() -> tuple[Any, nhjax.Solution]:
    """A stone that is spun in its unstable sense, and turns back."""
    machine = nhjax.systems.Rattleback.spinning(5.0, (0.5, 0.5), damping=1e-4)
    return machine, _run(machine.system, machine.initial_state(), 5.0, 1500)


def mecanum() -> tuple[Any, nhjax.Solution]:
    """A platform whose wheels drive it sideways, turn it, and drive it ahead."""
    robot = mecanum_robot()
    return robot, _run(robot.system, robot.initial_state(), 6.0, 300, robot.args)


def mecanum_robot() -> nhjax.Robot:
    """Read a platform on four mecanum wheels, with rollers that are only drawn."""
    mujoco: Any = importlib.import_module("mujoco")
    radius, half, lines, angles = 0.1, 0.035, [], {}
    for name, x, y, side in (
        ("front left", 0.22, 0.2, -1),
        ("front right", 0.22, -0.2, 1),
        ("rear left", -0.22, 0.2, 1),
        ("rear right", -0.22, -0.2, -1),
    ):
        angles[name] = side * math.pi / 4
        lines.append(
            f"<body name='{name}' pos='{x} {y} 0'>"
            f"<joint name='{name}' axis='0 1 0' damping='0.05'/>"
            f"<geom name='{name}' type='cylinder' size='{radius} {half}' mass='0.6' "
            f"euler='{-math.pi / 2} 0 0' rgba='0 0 0 0'/>"
            f"<geom type='cylinder' size='{0.62 * radius} {1.1 * half}' mass='0' "
            f"euler='{-math.pi / 2} 0 0' rgba='0.62 0.64 0.67 1'/>"
        )
        for k in range(10):
            turn = 2 * math.pi * k / 10
            color = "0.98 0.58 0.1 1" if k == 0 else "0.13 0.13 0.15 1"
            # The axle of a roller at the lowest point is at the angle of the wheel.
            lines.append(
                f"<frame euler='0 {turn} 0'><geom type='capsule' mass='0' "
                f"size='{0.2 * radius} {0.95 * half}' pos='0 0 {-0.8 * radius}' "
                f"zaxis='1 {side} 0' rgba='{color}'/></frame>"
            )
        lines.append("</body>")
    motors = [f"<motor name='{x}' joint='{x}'/>" for x in angles]
    spec = mujoco.MjSpec.from_string(f"""
        <mujoco><compiler angle="radian"/>
        <default><geom contype="0" conaffinity="0"/></default>
        <worldbody><body name="platform" pos="0 0 {radius}">
          <joint name="x" type="slide" axis="1 0 0"/>
          <joint name="y" type="slide" axis="0 1 0"/>
          <joint name="heading" axis="0 0 1"/>
          <geom type="box" size="0.3 0.15 0.03" mass="8"/>
          <geom type="box" size="0.16 0.1 0.03" pos="-0.05 0 0.06" mass="1"
            rgba="0.9 0.88 0.82 1"/>
          <geom type="cylinder" size="0.04 0.03" pos="0.2 0 0.06" mass="0.2"
            rgba="0.98 0.58 0.1 1"/>
          {"".join(lines)}
        </body></worldbody>
        <actuator>{"".join(motors)}</actuator>
        </mujoco>""")
    patterns = jnp.array([[-1.0, 1, 1, -1], [-1, 1, -1, 1], [1, 1, 1, 1]])
    mixing = patterns.T

    def controls(t, qpos, qvel, args):
        """Return torques that track the speeds of sideways, turning and ahead."""
        shares = jnp.stack([_pulse(t, 0.0), _pulse(t, 2.0), _pulse(t, 4.0)])
        wanted = mixing @ (jnp.array([6.0, 5.0, 8.0]) * shares)
        return 0.4 * (wanted - qvel[3:])

    return nhjax.from_mujoco(spec, rolling=angles, controls=controls)


def _pulse(t: Any, start: float) -> Any:
    """A smooth pulse of two seconds."""
    inside = (t > start) & (t < start + 2)
    return jnp.where(inside, jnp.sin(0.5 * math.pi * (t - start)) ** 2, 0.0)


def _run(system: Any, y0: Any, duration: float, steps: int, args: Any = None) -> Any:
    return nhjax.integrate(
        system,
        nhjax.LobattoIIIAB(2),
        y0,
        dt=duration / steps,
        num_steps=steps,
        saveat=nhjax.SaveAt(t0=True, steps=True),
        args=args,
    )


films = {
    "bicycle": Film(bicycle, 1.0, {"azimuth": 130, "elevation": -12, "distance": 3.1}),
    "mecanum": Film(mecanum, 1.0, {"azimuth": 120, "elevation": -25, "distance": 1.9}),
    "rattleback": Film(
        rattleback, 0.6, {"azimuth": 110, "elevation": -35, "distance": 0.55}
    ),
}


def main() -> None:
    """Write films, or single frames."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help=f"of {', '.join(films)}")
    parser.add_argument("--frames", type=int, help="the number of frames to write")
    parser.add_argument("--to", type=Path, default=FILMS, help="the folder")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    given.to.mkdir(exist_ok=True)
    for name in given.names or films:
        film = films[name]
        machine, sol = film.run()
        options = {"speed": film.speed, "camera": film.camera, "size": film.size}
        if given.frames:
            for k in range(given.frames):
                t = float(sol.ts[0] + (sol.ts[-1] - sol.ts[0]) * k / (given.frames - 1))
                path = given.to / f"{name}{k}.png"
                nhjax.render(machine, sol, path, t=t, fps=film.fps, **options)
            continue
        path = nhjax.render(
            machine, sol, given.to / f"{name}.gif", fps=film.fps, **options
        )
        print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
