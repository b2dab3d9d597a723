"""The films of docs/films.md and of README.

python docs/films.py                writes docs/films/NAME.gif for all films
python docs/films.py bicycle        writes one of them
python docs/films.py --frames 6     writes single frames instead, to look at
"""

import argparse
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
    """An uncontrolled bicycle, pushed sideways at a speed at which it is stable."""
    machine = nhjax.systems.WhippleBicycle.running(5.0, lean_rate=0.45)
    return machine, _run(machine.system, machine.initial_state(), 4.0, 200)


def rattleback() -> tuple[Any, nhjax.Solution]:
    """A stone that is spun in its unstable sense, and turns back."""
    machine = nhjax.systems.Rattleback.spinning(5.0, (0.5, 0.5), damping=1e-4)
    return machine, _run(machine.system, machine.initial_state(), 5.0, 1500)


def mecanum() -> tuple[Any, nhjax.Solution]:
    """A platform whose wheels drive it sideways, turn it, and drive it ahead."""
    # The rates of the wheels, in the order of the model, for each of these motions.
    mixing = jnp.array([[-1.0, 1, 1, -1], [-1, 1, -1, 1], [1, 1, 1, 1]]).T

    def controls(t, qpos, qvel, args):
        """Return torques that track the wheel rates of the three motions."""
        shares = jnp.stack([_pulse(t, 0.0), _pulse(t, 2.0), _pulse(t, 4.0)])
        wanted = mixing @ (jnp.array([6.0, 5.0, 8.0]) * shares)
        return 0.4 * (wanted - qvel[3:])

    robot = nhjax.example_robot("mecanum_platform", controls=controls)
    return robot, _run(robot.system, robot.initial_state(), 6.0, 300, robot.args)


def _pulse(t: Any, start: float) -> Any:
    """A smooth pulse of two seconds."""
    inside = (t > start) & (t < start + 2)
    return jnp.where(inside, jnp.sin(0.5 * math.pi * (t - start)) ** 2, 0.0)


def _run(system: Any, y0: Any, duration: float, steps: int, args: Any = None) -> Any:
    return nhjax.integrate(
        system,
        nhjax.LobattoIIIAB(3),
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
