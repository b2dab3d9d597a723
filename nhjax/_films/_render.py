"""Films and pictures through MuJoCo's renderer, off screen."""

import contextlib
import importlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import UInt8

from .._errors import check_choice
from .._integrate import Solution
from .._robots import mujoco_of
from ._sampling import check_solution, ends_of_output, frame_times
from ._scene import Scene


SUFFIXES = (".mp4", ".gif", ".png")


def render(
    machine: Any,
    sol: Solution,
    path: str | os.PathLike,
    *,
    camera: str | Mapping[str, Any] = "follow",
    fps: float = 30.0,
    speed: float = 1.0,
    size: tuple[int, int] = (640, 480),
    t: float | None = None,
    trail: bool = True,
) -> Path:
    """Write a film of a run, with light and shadows, or a picture of one time.

    MuJoCo's renderer draws the shapes off screen. Configurations between saved states
    are interpolated, so that the film plays at the speed of the motion for any step
    sizes.

    **Arguments:**

    - `machine`: a robot of `nhjax.from_mujoco`, a machine of `nhjax.systems`, or an
        `nhjax.Looks`.
    - `sol`: the `Solution` of one run with dense output (`SaveAt(dense=True)`) or saved
        states.
    - `path`: the file to write: `.mp4` (H.264), `.gif`, or `.png` for a picture.
    - `camera`: `"follow"` moves with the machine; `"fixed"` shows the whole motion; the
        name of a camera of the model; or a dictionary with some of `"azimuth"` and
        `"elevation"` [degrees], `"distance"` and the point `"lookat"` [m]. If a
        dictionary has no `"lookat"`, the camera follows the machine.
    - `fps`: the number of frames in a second of the film.
    - `speed`: the number of seconds of the motion in a second of the film.
    - `size`: the width and the height in pixels; both must be even for `.mp4`.
    - `t`: the time of the picture, only for `.png`. The default is the end of the run.
    - `trail`: whether to draw the paths of a machine's contact points or, for a
        `Looks`, of its `trails`.

    **Returns:** the path of the file.

    **Raises:** `ImportError` without MuJoCo's renderer or the encoder
    (`pip install "nhjax[render]"`); `RuntimeError` if no OpenGL context can be created,
    or if the encoder fails; `FileNotFoundError` if the folder of `path` does not exist;
    `TypeError` and `ValueError` for a machine without a shape, a batch, a run without
    states or with too few of them, and unknown suffixes and cameras.

    !!! example

        >>> import nhjax
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> sol = nhjax.integrate(disc.system, nhjax.LobattoIIIAB(2),
        ...     disc.initial_state(), dt=0.1, num_steps=20,
        ...     saveat=nhjax.SaveAt(dense=True))
        >>> nhjax.render(disc, sol, "disc.png")  # doctest: +SKIP
    """
    target, shown = _checked(path, fps, speed, size, t)
    check_solution("render", sol)
    times = frame_times("render", sol, speed / fps)
    if target.suffix == ".png":
        # The frames before the time of the picture are needed for the centre of the
        # camera and the trail.
        first, last = ends_of_output("render", sol)
        times = _until(times, (first, last), last if t is None else t)
    scene = Scene("render", machine, sol, times, trail)
    view = view_of(scene, camera, shown)
    if target.suffix == ".png":
        with _renderer(scene, shown) as draw:
            _image().fromarray(draw(view, len(times) - 1)).save(target)
        return target
    write = {".mp4": _write_mp4, ".gif": _write_gif}[target.suffix]
    with _renderer(scene, shown) as draw:
        write(target, (draw(view, k) for k in range(len(times))), shown, fps)
    return target


class View(NamedTuple):
    """A named camera of the model, or a free camera and its target in each frame."""

    name: str | None
    centres: np.ndarray
    azimuth: float
    elevation: float
    distance: float


_FREE = ("azimuth", "elevation", "distance", "lookat")


def view_of(scene: Scene, camera: Any, size: tuple[int, int]) -> View:
    """Return the camera of a film, for the argument `camera`."""
    azimuth, elevation = 120.0, -20.0
    if scene.looks is not None:
        azimuth, elevation = scene.looks.azimuth, scene.looks.elevation
    given: dict[str, Any] = {}
    centres = scene.centres
    if isinstance(camera, Mapping):
        given = dict(camera)
        for key in given:
            check_choice("render: a key of `camera`", key, _FREE)
        if "lookat" in given:
            point = np.asarray(given["lookat"], float)
            if point.shape != (3,):
                raise ValueError(
                    "render: `camera['lookat']` must be a point of shape (3,), got "
                    f"shape {point.shape}."
                )
            centres = np.broadcast_to(point, centres.shape)
    elif camera == "fixed":
        centres = np.broadcast_to(scene.whole, centres.shape)
    elif camera != "follow":
        names = [scene.model.camera(i).name for i in range(scene.model.ncam)]
        if camera not in names:
            known = ", ".join(repr(x) for x in ("follow", "fixed", *names) if x)
            raise ValueError(
                f"render: `camera` must be one of {known}, or a dictionary with some "
                f"of {', '.join(_FREE)}, got {camera!r}."
            )
        return View(camera, centres, 0.0, 0.0, 0.0)
    half_angle = np.deg2rad(scene.model.vis.global_.fovy) / 2
    # The whole machine must fit into the narrower side of the picture.
    half_angle = np.arctan(np.tan(half_angle) * min(1.0, size[0] / size[1]))
    distance = 1.2 * scene.reach(centres) / np.sin(half_angle)
    return View(
        None,
        centres,
        float(given.get("azimuth", azimuth)),
        float(given.get("elevation", elevation)),
        float(given.get("distance", distance)),
    )


@contextlib.contextmanager
def _renderer(scene: Scene, size: tuple[int, int]) -> Iterator[Any]:
    """Create a function that draws the k-th frame with a camera, as pixels."""
    mujoco, model = mujoco_of("nhjax.render", "render"), scene.model
    model.vis.global_.offwidth, model.vis.global_.offheight = size
    context = _gl_context(size)
    context.make_current()
    try:
        pixels = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, pixels)
        drawn = mujoco.MjvScene(model, maxgeom=model.ngeom + 2000 + scene.trails.size)
        option, camera = mujoco.MjvOption(), mujoco.MjvCamera()
        rectangle = mujoco.MjrRect(0, 0, *size)

        def draw(view: View, k: int) -> UInt8[np.ndarray, "height width 3"]:
            scene.place(k)
            if view.name is None:
                camera.type = mujoco.mjtCamera.mjCAMERA_FREE
                camera.lookat[:] = view.centres[k]
                camera.azimuth, camera.elevation = view.azimuth, view.elevation
                camera.distance = view.distance
            else:
                camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
                camera.fixedcamid = model.camera(view.name).id
            mujoco.mjv_updateScene(
                model,
                scene.data,
                option,
                None,
                camera,
                mujoco.mjtCatBit.mjCAT_ALL.value,
                drawn,
            )
            _draw_trails(mujoco, drawn, scene, k)
            mujoco.mjr_render(rectangle, drawn, pixels)
            picture = np.empty((size[1], size[0], 3), np.uint8)
            mujoco.mjr_readPixels(picture, None, rectangle, pixels)
            return picture[::-1].copy()

        yield draw
        pixels.free()
    finally:
        context.free()


def _draw_trails(mujoco: Any, drawn: Any, scene: Scene, k: int) -> None:
    """Add the `trails` of a scene, up to its k-th time, to the shapes of a picture."""
    kind = mujoco.mjtGeom.mjGEOM_CAPSULE
    width = 0.006 * scene.model.stat.extent
    for path in scene.trails:
        for start, end in pairwise(path[: k + 1]):
            if drawn.ngeom == drawn.maxgeom or np.allclose(start, end, atol=1e-9):
                continue
            geom = drawn.geoms[drawn.ngeom]
            mujoco.mjv_initGeom(
                geom,
                kind,
                np.zeros(3),
                np.zeros(3),
                np.eye(3).ravel(),
                np.array([0.85, 0.25, 0.15, 1], np.float32),
            )
            mujoco.mjv_connector(geom, kind, width, start, end)
            geom.category = mujoco.mjtCatBit.mjCAT_DECOR
            drawn.ngeom += 1


def _gl_context(size: tuple[int, int]) -> Any:
    """Create an OpenGL context without a window."""
    chosen = os.environ.get("MUJOCO_GL", "").lower().strip()
    if sys.platform == "linux" and not chosen:
        # MuJoCo's default needs a display, and ends the process if there is no display.
        os.environ["MUJOCO_GL"] = chosen = "egl"
    try:
        if chosen in ("egl", "osmesa"):
            create = importlib.import_module(f"mujoco.{chosen}").GLContext
        else:
            create = importlib.import_module("mujoco.gl_context").GLContext
        return create(*size)
    except ImportError as error:
        if "OpenGL" in str(error) or "No module" in str(error):
            raise ImportError(
                'nhjax.render needs MuJoCo\'s renderer: pip install "nhjax[render]".'
            ) from error
        raise _no_context(chosen, error) from error
    except Exception as error:  # Drivers raise errors of all kinds.
        raise _no_context(chosen, error) from error


def _no_context(chosen: str, error: Exception) -> RuntimeError:
    return RuntimeError(
        f"nhjax.render: no OpenGL context can be created with MUJOCO_GL={chosen!r} "
        f"({type(error).__name__}: {error}). Install a driver with EGL (libegl1), or "
        "OSMesa (libosmesa6) and set the environment variable MUJOCO_GL=osmesa before "
        "Python starts. Without a renderer, use nhjax.view or nhjax.plot.animate."
    )


def _checked(
    path: Any, fps: Any, speed: Any, size: Any, t: Any
) -> tuple[Path, tuple[int, int]]:
    target = Path(path)
    if target.suffix not in SUFFIXES:
        raise ValueError(
            f"render: `path` must end with one of {', '.join(SUFFIXES)}, got "
            f"{str(path)!r}."
        )
    if not target.parent.is_dir():
        raise FileNotFoundError(f"render: there is no folder {target.parent}.")
    for name, value in (("fps", fps), ("speed", speed)):
        if not value > 0:
            raise ValueError(f"render: `{name}` must be positive, got {value!r}.")
    width, height = (int(x) for x in size)
    if width < 16 or height < 16:
        raise ValueError(f"render: `size` must be at least 16 by 16, got {size!r}.")
    if target.suffix == ".mp4" and (width % 2 or height % 2):
        raise ValueError(f"render: `size` must be even for .mp4, got {size!r}.")
    if t is not None and target.suffix != ".png":
        raise ValueError("render: `t` is the time of a picture: use it with .png only.")
    return target, (width, height)


def _until(times: np.ndarray, ends: tuple[float, float], end: float) -> np.ndarray:
    """Return the times of the frames before the time `end`, followed by `end`."""
    low, high = sorted(ends)
    if not low <= end <= high:
        raise ValueError(f"render: `t` must be between {low} and {high}, got {end}.")
    forward = 1 if ends[1] >= ends[0] else -1
    before = times[forward * times < forward * end]
    return np.append(before, end)


def _write_mp4(
    path: Path, frames: Iterator[np.ndarray], size: tuple[int, int], fps: float
) -> None:
    try:
        encoder = importlib.import_module("imageio_ffmpeg")
    except ImportError as error:
        raise ImportError(
            'render needs an encoder for .mp4: pip install "nhjax[render]". A .gif '
            "needs none."
        ) from error
    width, height = size
    command = [
        *(encoder.get_ffmpeg_exe(), "-y", "-loglevel", "error", "-f", "rawvideo"),
        *("-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps}", "-i", "-"),
        # Many players and browsers can show only this pixel format.
        *("-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "23"),
        *("-movflags", "+faststart", str(path)),
    ]
    with tempfile.TemporaryFile() as messages:
        with subprocess.Popen(
            command, stdin=subprocess.PIPE, stderr=messages
        ) as process:
            assert process.stdin is not None
            # If the encoder ends early, its message is raised below.
            with contextlib.suppress(BrokenPipeError):
                for frame in frames:
                    process.stdin.write(frame.tobytes())
                process.stdin.close()
        if process.returncode:
            messages.seek(0)
            said = messages.read().decode(errors="replace").strip()
            raise RuntimeError(f"render: the encoder could not write {path}: {said}")


def _write_gif(
    path: Path, frames: Iterator[np.ndarray], size: tuple[int, int], fps: float
) -> None:
    image = _image()
    pictures = [image.fromarray(frame) for frame in frames]
    # All frames use one palette: with a palette for each frame, colours would flicker.
    some = pictures[:: max(1, len(pictures) // 8)]
    sheet = image.new("RGB", (size[0], size[1] * len(some)))
    for k, picture in enumerate(some):
        sheet.paste(picture, (0, k * size[1]))
    # 176 colours of the palette are the most frequent ones. The other 80 cover the
    # range of all colours, so that small parts keep their colours.
    frequent = sheet.quantize(176, image.Quantize.MEDIANCUT).getpalette()
    apart = sheet.quantize(80, image.Quantize.MAXCOVERAGE).getpalette()
    palette = image.new("P", (1, 1))
    palette.putpalette(frequent[: 3 * 176] + apart[: 3 * 80])
    first, *others = [
        x.quantize(palette=palette, dither=image.Dither.NONE) for x in pictures
    ]
    first.save(
        path,
        save_all=True,
        append_images=others,
        duration=round(1000 / fps),
        loop=0,
    )


def _image() -> Any:
    return importlib.import_module("PIL.Image")
