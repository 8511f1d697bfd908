"""A page in a browser that shows bodies: ``Page``, on viser's server, and ``BodyLayer``, bodies of many worlds.

Each body is sent once, as triangles; afterwards the poses of a frame are a few arrays, whatever the number of worlds.
"""

from __future__ import annotations

import contextlib
import io
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from ..scene.ground import HeightField, Plane
from .surfaces import Triangles, field_surface

HOST, PORT = "127.0.0.1", 8080
SKY, SOIL, LINES = (236, 241, 246), (222, 226, 230), (204, 210, 216)  # colours of ground and of its lines
FIELD = (0.80, 0.82, 0.84)  # colour of a height field
SQUARE = 1.0  # edge of the ground's squares [m]
GROUND_SIZE = 60.0  # edge of the part of a plane that is drawn [m]
MANY_FACES = 3000  # from which on a surface far away is drawn with fewer
AZIMUTH, ELEVATION = -1.0, 0.32  # of the first camera, about the vertical from x, and above the horizontal [rad]
BESIDE = 0.25  # by which what is looked at is left of the picture's middle, beside the panel: a share of its size
WORLD = "/world"  # what moves against a robot that the page follows


def load_viser() -> Any:
    """Return the package viser.

    Raises:
        ImportError: it is missing; the error names the extra that installs it.
    """
    try:
        import viser
    except ImportError as error:
        raise ImportError(
            f"a page in a browser needs viser, which is missing ({error}); pip install warp_spo[view]"
        ) from None
    return viser


class Page:
    """A server whose page shows one scene.

    The page has a camera near the robot, plain ground, and a panel of tabs. Whatever lies in the world is a child of
    one node, which :meth:`follow` moves so that a robot that walks stays before the camera.

    Args:
        title: of the panel. host: address to listen on; only this machine's unless told. port: the first to try; the
            next free one is taken. size: of what is looked at [m].

    Attributes:
        server: viser's. gui: its widgets. url: address of the page.

    Raises:
        ImportError: viser is missing. OSError: no port is free, or the address is none of this machine.
    """

    def __init__(self, title: str, host: str = HOST, port: int = PORT, size: float = 1.0):
        viser = load_viser()
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            try:
                self.server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
            except (OSError, RuntimeError, AssertionError) as error:
                raise OSError(f"Page: cannot listen on {host}:{port} ({error}); pass another host or port") from error
        shown_host = "localhost" if host in (HOST, "0.0.0.0") else host
        self.url = f"http://{shown_host}:{self.server.get_port()}"
        self.gui, self.scene = self.server.gui, self.server.scene
        self.scene.set_up_direction("+z")
        self.server.gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False)
        self.scene.configure_environment_map(hdri="warehouse", background=False, environment_intensity=0.35)
        self.root = self.scene.add_frame(WORLD, show_axes=False)
        self.scene.set_background_image(np.full((2, 2, 3), SKY, np.uint8), format="png")
        self.size, self._ground, self._recorded = size, None, None
        self.look_from(size)

    def look_from(self, size: float, middle: Sequence[float] | np.ndarray | None = None) -> None:
        """Put the first camera where something of this size [m], whose middle is at ``middle`` [m], fills the view."""
        self._looked_at = size, np.array([0.0, 0.0, 0.4 * size] if middle is None else middle, np.float64)
        self._place_camera(BESIDE)

    def _place_camera(self, beside: float) -> None:
        size, middle = self._looked_at
        target = middle + beside * size * np.array([-np.sin(AZIMUTH), np.cos(AZIMUTH), 0.0])
        away = 1.6 * size + 0.3
        back = np.array([np.cos(AZIMUTH) * np.cos(ELEVATION), np.sin(AZIMUTH) * np.cos(ELEVATION), np.sin(ELEVATION)])
        camera = self.server.initial_camera
        camera.look_at, camera.position = target, target + away * back
        camera.near, camera.fov = 0.01 * size + 0.002, 0.75

    @property
    def is_watched(self) -> bool:
        """Whether a browser looks, or a recording goes on."""
        return self._recorded is not None or bool(self.server.get_clients())

    @contextlib.contextmanager
    def frame(self) -> Iterator[None]:
        """Send what is set inside at once; a context manager."""
        with self.server.atomic():
            yield

    def follow(self, place: Any) -> None:
        """Move the world so that this place [m] is above the origin; the ground goes along in whole squares."""
        x, y = (float(value) for value in place[:2])
        if not np.isfinite([x, y]).all():
            return
        self.root.position = (-x, -y, 0.0)
        if self._ground is not None and not self._fixed:
            step = 2.0 * SQUARE
            self._ground.position = (step * round(x / step), step * round(y / step), self._level)

    def show_ground(self, ground: Plane | HeightField | None, which: int = 0) -> None:
        """Show a ground in place of the one before; ``which``: of a set of height fields."""
        if self._ground is not None:
            self._ground.remove()
        self._level, self._fixed, self._ground = 0.0, True, None
        if ground is None:
            return
        if isinstance(ground, HeightField):
            surface = field_surface(ground, which, FIELD)
            self._ground = self.scene.add_mesh_simple(
                f"{WORLD}/ground",
                surface.vertices,
                surface.faces,
                color=_bytes(FIELD),
                flat_shading=True,
                side="double",
            )
            return
        normal = np.asarray(ground.normal)
        self._level, self._fixed = ground.height / normal[2] if normal[2] > 0.0 else 0.0, bool(normal[2] < 1.0 - 1e-9)
        half = np.array([normal[0], normal[1], normal[2] + 1.0]) if normal[2] > -1.0 + 1e-9 else np.array([1.0, 0, 0])
        half = half / np.linalg.norm(half)  # half way from z to the normal: twice the turn about z x normal
        turn = (float(half[2]), float(-half[1]), float(half[0]), 0.0)
        self._ground = self.scene.add_grid(
            f"{WORLD}/ground", GROUND_SIZE, GROUND_SIZE, cell_size=SQUARE, section_size=10.0 * SQUARE,
            cell_color=LINES, section_color=LINES, cell_thickness=0.6, section_thickness=0.8, plane_color=SOIL,
            plane_opacity=1.0, fade_distance=GROUND_SIZE, fade_strength=1.5, shadow_opacity=0.3,
            position=(0.0, 0.0, self._level), wxyz=turn,
        )  # fmt: skip

    def record(self) -> None:
        """Begin to record what the page shows, for :meth:`as_html`, whose pages have no panel."""
        self._place_camera(0.0)
        self._recorded = self.server.get_scene_serializer()

    def sleep(self, seconds: float) -> None:
        """Let time pass in the recording [s]."""
        assert self._recorded is not None, "call record() first"
        self._recorded.insert_sleep(seconds)

    def as_html(self) -> str:
        """End the recording and return it as one page with a time slider, which needs no server."""
        assert self._recorded is not None, "call record() first"
        recorded, self._recorded = self._recorded, None
        return str(recorded.as_html())

    def run(self, tick: Callable[[float], None], interval: float = 0.04) -> None:
        """Call ``tick`` with the time since the last call [s], every ``interval`` [s], until Ctrl-C; then close."""
        pace = Pace(interval)
        try:
            while True:
                tick(pace.wait())
        except KeyboardInterrupt:
            pass
        finally:
            self.close()

    def record_frames(self, tick: Callable[[float], None], seconds: float, interval: float) -> None:
        """Record so many seconds, a frame of ``tick`` every ``interval`` [s]; after :meth:`record`."""
        for _ in range(round(seconds / interval)):
            tick(interval)
            self.sleep(interval)

    def close(self) -> None:
        """Close the pages that look, then the server."""
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            with contextlib.suppress(Exception):
                self.server.flush()
            self.server.stop()


class BodyLayer:
    """Bodies of some worlds as instances of their surfaces.

    Args:
        page: where they are shown. name: of the layer. surfaces: of the bodies. worlds: how many are shown.
        opacity: None: opaque. visible: at first. clicked: called with the index of a body that is clicked, or None.

    Attributes:
        handles: viser's handle of each surface, and its body.
    """

    def __init__(
        self, page: Page, name: str, surfaces: Sequence[Triangles], worlds: int = 1, opacity: float | None = None,
        visible: bool = True, clicked: Callable[[int], None] | None = None,
    ):  # fmt: skip
        self.worlds, self.handles = worlds, list[tuple[int, Any]]()
        self._visible = visible
        turns, places = np.tile([1.0, 0.0, 0.0, 0.0], (worlds, 1)), np.zeros((worlds, 3))
        for number, surface in enumerate(surfaces):
            handle = page.scene.add_batched_meshes_simple(
                f"{WORLD}/{name}/{number}", surface.vertices, surface.faces, turns, places,
                batched_colors=_bytes(surface.color), flat_shading=surface.flat, opacity=opacity, visible=visible,
                side="double" if surface.flat else "front", lod="auto" if len(surface.faces) > MANY_FACES else "off",
            )  # fmt: skip
            self.handles.append((surface.body, handle))
            if clicked is not None and surface.body >= 0:
                handle.on_click(lambda _, body=surface.body: clicked(body))

    def place(self, poses: np.ndarray, offsets: np.ndarray | None = None) -> None:
        """Show the poses of the worlds' bodies [world, body, 7]; ``offsets``: added to places [world, 3] [m].

        What is not finite keeps its last place.
        """
        if not self._visible:
            return
        poses = np.asarray(poses, np.float32)
        turns, places = poses[..., [6, 3, 4, 5]], poses[..., :3]
        if offsets is not None:
            places = places + np.asarray(offsets, np.float32)[:, None]
        finite = np.isfinite(poses).all()
        for body, handle in self.handles:
            if body < 0:
                if offsets is not None:
                    handle.batched_positions = offsets
                continue
            if finite:
                handle.batched_positions, handle.batched_wxyzs = places[:, body], turns[:, body]
                continue
            known = np.isfinite(poses[:, body]).all(axis=1, keepdims=True)
            handle.batched_positions = np.where(known, places[:, body], handle.batched_positions)
            handle.batched_wxyzs = np.where(known, turns[:, body], handle.batched_wxyzs)

    @property
    def visible(self) -> bool:
        """Whether the layer is shown; one that is not takes no poses."""
        return self._visible

    @visible.setter
    def visible(self, value: bool) -> None:
        self._visible = value
        for _, handle in self.handles:
            handle.visible = value

    def remove(self) -> None:
        """Take the layer from the page."""
        for _, handle in self.handles:
            handle.remove()
        self.handles.clear()


class Pace:
    """The rhythm of frames: sleeps until the next one is due, and says how much time has passed since the last one.

    Args:
        seconds: from frame to frame [s].
    """

    def __init__(self, seconds: float = 0.04):
        self.seconds, self.last = seconds, time.perf_counter()

    def wait(self) -> float:
        """Sleep until the next frame is due; return the time since the last one, at most 0.2 s [s]."""
        time.sleep(max(0.0, self.last + self.seconds - time.perf_counter()))
        now = time.perf_counter()
        passed, self.last = now - self.last, now
        return min(passed, 0.2)


def _bytes(color: Sequence[float]) -> Any:
    return tuple(round(255 * min(max(float(part), 0.0), 1.0)) for part in color)
