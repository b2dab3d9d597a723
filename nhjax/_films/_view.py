"""Machines in a browser, with a slider for the time."""

import importlib
import sys
import threading
from typing import Any

import numpy as np

from .._integrate import Solution
from .._robots import mujoco_of
from ._sampling import check_solution, frame_times
from ._scene import PLAIN, round_length, Scene, visible_geoms


class Show:
    """The result of `nhjax.view`: a machine in a browser.

    - `url`: the address of the page.
    - `server`: the `viser.ViserServer`, to which you can add shapes and controls.
        Shapes whose names start with `/scene/` stay in place on the ground.
    """

    def __init__(self, server: Any, scene: Scene, speed: float):
        self.server, self._scene, self._speed = server, scene, speed
        self.url = f"http://localhost:{server.get_port()}"
        self._stopped, self._lock = threading.Event(), threading.Lock()
        self._ground = server.scene.add_frame("/scene", show_axes=False)
        self._frames = _add_shapes(server, scene)
        times = scene.times
        low, high = sorted((float(times[0]), float(times[-1])))
        # The step of the slider is a round length of time, so that the slider shows
        # round times.
        self._step = round_length((high - low) / max(1, len(times) - 1) or 1.0)
        self._slider = server.gui.add_slider(
            "time [s]",
            min=low,
            max=max(high, low + self._step),
            step=self._step,
            initial_value=low,
        )
        self._play = server.gui.add_checkbox("play", initial_value=len(times) > 1)
        # With "follow", the program moves the ground instead of the camera, because the
        # user moves the camera with the mouse.
        self._follow = server.gui.add_checkbox("follow", initial_value=True)
        self._follow.on_update(lambda _: self.show(self._slider.value))
        self._slider.on_update(lambda _: self.show(self._slider.value))
        self.show(float(times[0]))
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def __repr__(self) -> str:
        """Return a text with the address of the page."""
        return f"<machine at {self.url}>"

    def show(self, t: float) -> None:
        """Show the machine at the frame nearest to a time."""
        k = int(np.argmin(np.abs(self._scene.times - t)))
        data = self._scene.data
        # Locked, because callbacks of the slider and the playback use two threads.
        with self._lock, self.server.atomic():
            self._scene.place(k)
            moved = self._scene.centres[k] - self._scene.centres[0]
            self._ground.position = -moved if self._follow.value else 0 * moved
            for body, handle in self._frames.items():
                handle.position = data.xpos[body].copy()
                handle.wxyz = data.xquat[body].copy()

    def stop(self) -> None:
        """Close the page and end the server."""
        if not self._stopped.is_set():
            self._stopped.set()
            self._thread.join()
            self.server.stop()

    def wait(self) -> None:
        """Wait until the user presses Ctrl-C, and then call `stop`."""
        try:
            while not self._stopped.wait(1.0):
                pass
        except KeyboardInterrupt:
            self.stop()

    def _run(self) -> None:
        """Move the slider while the switch "play" is on."""
        slider, pause, rest = self._slider, 1 / 30, 0.0
        while not self._stopped.wait(pause):
            if self._play.value:
                following = slider.value + self._speed * pause + rest
                if following > slider.max:
                    following = slider.min
                steps = round((following - slider.min) / self._step)
                slider.value = float(f"{slider.min + steps * self._step:.9g}")
                rest = following - slider.value
                self.show(slider.value)


def view(
    machine: Any,
    sol: Solution,
    *,
    port: int = 8080,
    speed: float = 1.0,
    block: bool | None = None,
) -> Show:
    """Show a run in a browser, with a slider for the time and a switch that plays it.

    The machine stays in the middle of the picture while the ground moves past, unless
    the switch "follow" is off.

    viser prints the address of the page. `view` needs neither a window nor OpenGL,
    because the browser draws the machine.

    **Arguments:**

    - `machine`, `sol`: as for `nhjax.render`.
    - `port`: the port of the server; if it is taken, the next free one is used.
    - `speed`: the number of seconds of the motion that are shown in one second.
    - `block`: whether `view` waits until Ctrl-C. The default is True in a script, which
        would otherwise end at once, and False in an interactive session.

    **Returns:** a `Show` with the fields `url` and `server` and the methods `show(t)`
    and `stop()`.

    **Raises:** `ImportError` without viser (`pip install "nhjax[view]"`), and otherwise
    the errors of `nhjax.render` for the machine and the solution.

    !!! example

        >>> import nhjax
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> sol = nhjax.integrate(disc.system, nhjax.LobattoIIIAB(2),
        ...     disc.initial_state(), dt=0.1, num_steps=20,
        ...     saveat=nhjax.SaveAt(dense=True))
        >>> show = nhjax.view(disc, sol, block=False)  # doctest: +SKIP
    """
    if not speed > 0:
        raise ValueError(f"view: `speed` must be positive, got {speed!r}.")
    check_solution("view", sol)
    try:
        viser = importlib.import_module("viser")
    except ImportError as error:
        raise ImportError('view needs viser: pip install "nhjax[view]".') from error
    times = frame_times("view", sol, speed / 60)
    scene = Scene("view", machine, sol, times, True)
    show = Show(viser.ViserServer(port=port, verbose=False), scene, speed)
    if not hasattr(sys, "ps1") if block is None else block:
        show.wait()
    return show


def _add_shapes(server: Any, scene: Scene) -> dict[int, Any]:
    """Add all geoms and trails; return a coordinate frame for each body number."""
    mujoco, model = mujoco_of("nhjax.view", "view"), scene.model
    server.scene.set_up_direction("+z")
    extent = float(model.stat.extent)
    frames: dict[int, Any] = {}
    for body in range(1, model.nbody):
        name = f"/scene/bodies/{body}"
        frames[body] = server.scene.add_frame(name, show_axes=False)
    for geom in visible_geoms(model):
        body = int(model.geom_bodyid[geom])
        name = f"/scene/bodies/{body}/{geom}" if body else f"/scene/world/{geom}"
        _add_geom(mujoco, server.scene, scene, geom, name)
    for k, path in enumerate(scene.trails):
        if len(path) > 1:
            server.scene.add_line_segments(
                f"/scene/trails/{k}",
                points=np.stack([path[:-1], path[1:]], axis=1).astype(np.float32),
                # The trail is slightly above the ground, because a trail in the plane
                # of the ground would flicker.
                position=(0.0, 0.0, 0.004 * extent),
                colors=(217, 64, 38),
                thickness=0.006 * extent,
            )
    centre = scene.centres[0]
    server.initial_camera.look_at = tuple(centre)
    away = 2.6 * extent * np.array([0.5, -0.8, 0.4])
    server.initial_camera.position = tuple(centre + away)
    return frames


def _add_ground(
    space: Any, scene: Scene, name: str, position: np.ndarray, wxyz: np.ndarray
) -> None:
    """Add a grid that is large enough for the whole path of the machine."""
    extent = float(scene.model.stat.extent)
    section = 2.5 * extent
    width = 40 * extent + 2 * float(np.max(np.ptp(scene.centres, axis=0)))
    if wxyz[0] == 1:
        away = np.mean(scene.centres, axis=0) - position
        position[:2] += section * np.round(away[:2] / section)
    space.add_grid(
        name,
        width=width,
        height=width,
        cell_size=section / 5,
        section_size=section,
        plane_color=(225, 228, 232),
        plane_opacity=1.0,
        shadow_opacity=0.35,
        position=position,
        wxyz=wxyz,
    )


def _add_geom(mujoco: Any, space: Any, scene: Scene, geom: int, name: str) -> None:
    model = scene.model
    kinds, size = mujoco.mjtGeom, model.geom_size[geom]
    rgba = model.geom_rgba[geom]
    if model.geom_matid[geom] >= 0 and np.allclose(rgba, PLAIN):
        rgba = model.mat_rgba[model.geom_matid[geom]]
    if rgba[3] == 0:
        return
    options: dict[str, Any] = {
        "position": model.geom_pos[geom].copy(),
        "wxyz": model.geom_quat[geom].copy(),
    }
    if model.geom_type[geom] == kinds.mjGEOM_PLANE:
        _add_ground(space, scene, name, **options)
        return
    color = tuple(int(255 * x) for x in rgba[:3])
    options |= {"color": color, "opacity": None if rgba[3] == 1 else float(rgba[3])}
    kind = model.geom_type[geom]
    if kind == kinds.mjGEOM_BOX:
        space.add_box(name, dimensions=tuple(2 * size), **options)
    elif kind == kinds.mjGEOM_CYLINDER:
        space.add_cylinder(name, radius=size[0], height=2 * size[1], **options)
    elif kind == kinds.mjGEOM_SPHERE:
        space.add_icosphere(name, radius=size[0], **options)
    elif kind == kinds.mjGEOM_ELLIPSOID:
        space.add_icosphere(name, radius=1.0, scale=tuple(size), **options)
    elif kind == kinds.mjGEOM_CAPSULE:
        vertices, faces = _capsule(*size[:2])
        space.add_mesh_simple(name, vertices, faces, **options)
    elif kind == kinds.mjGEOM_MESH:
        which = model.geom_dataid[geom]
        start, count = model.mesh_vertadr[which], model.mesh_vertnum[which]
        first, number = model.mesh_faceadr[which], model.mesh_facenum[which]
        space.add_mesh_simple(
            name,
            model.mesh_vert[start : start + count].copy(),
            model.mesh_face[first : first + number].copy(),
            side="double",
            **options,
        )


def _capsule(radius: float, half: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a cylinder along z with round ends, as vertices and triangles."""
    around, up = 16, 5
    angle = 2 * np.pi * np.arange(around) / around
    lifts = np.linspace(-np.pi / 2, np.pi / 2, 2 * up)
    rows = []
    for lift in lifts:
        ring = radius * np.cos(lift) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        z = radius * np.sin(lift) + np.copysign(half, lift)
        rows.append(np.concatenate([ring, np.full((around, 1), z)], axis=1))
    faces = []
    for i in range(2 * up - 1):
        for k in range(around):
            a, b = i * around + k, i * around + (k + 1) % around
            faces += [(a, b, b + around), (a, b + around, a + around)]
    return np.concatenate(rows).astype(np.float32), np.asarray(faces, np.uint32)
