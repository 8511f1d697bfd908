"""Films and strips of pictures."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..scene.scene import Scene
from .renderer import Camera, Renderer
from .shapes import Primitive, size_of
from .surfaces import Triangles

LONGEST_SILENCE, PERIOD = 5.0, 10.0  # a film says how far it is if it takes longer than this, and as often as this [s]
STEADY = 0.25  # a camera that follows keeps its height where the robot's changes less, over the camera's distance


def camera_of(scene: Scene, q: np.ndarray) -> Camera:
    """Return a camera that sees all of a robot."""
    return Camera(distance=1.0 + 1.6 * size_of(scene, q))


def pictures(
    scene: Scene, shapes: Sequence[Primitive | Triangles], q: np.ndarray, camera: Camera, follow: bool = True,
    markers: Sequence[Sequence[Primitive]] = (), captions: Sequence[str] = (), device: Any = "cpu",
) -> list:  # fmt: skip
    """Return a picture (PIL image) of each state.

    Args:
        scene: whose bodies and ground are drawn. shapes: of the bodies, and of the world.
        q: coordinates [picture, coordinate].
        follow: whether the camera moves with the first body; otherwise it looks at the first body's first place.
        markers, captions: for each picture, or none. Markers are fixed to the world.
        device: Warp device that draws.

    What takes longer than five seconds says on stderr how far it is, what a picture costs on this machine, as measured
    from the second one on, and how much time is left.
    """
    from PIL import Image, ImageDraw

    from .. import Dynamics

    poses = Dynamics(scene.with_contacts([]), len(q), "cpu", "float64").body_poses(np.asarray(q, np.float64))
    looked = poses[:, 0, :3] + np.array([0.0, 0.0, camera.above])
    if not follow:
        looked[:] = looked[0]
    elif np.ptp(looked[:, 2]) < STEADY * camera.distance:
        looked[:, 2] = looked[:, 2].mean()
    beside = list(dict.fromkeys(marker for some in markers for marker in some))
    renderer = Renderer(shapes, scene.body_count, scene.ground, camera, beside, device, looked)
    found, progress = [], FilmProgress(len(q))
    for i in range(len(q)):
        picture = Image.fromarray(renderer.draw(poses[i], looked[i], markers[i] if len(markers) else ()))
        if len(captions):
            ImageDraw.Draw(picture).text((8, 6), captions[i], fill=(40, 44, 52))
        found.append(picture)
        progress.show(i + 1)
    return found


class FilmProgress:
    """The progress of a film, on stderr: what a picture costs here, as measured, and how long the others will take.

    The first picture, which loads kernels, does not count. A film that is done within LONGEST_SILENCE says nothing.

    Args:
        count: of pictures. clock: returns the time [s].
    """

    def __init__(self, count: int, clock: Callable[[], float] = time.perf_counter):
        self.count, self.clock = count, clock
        self.began = self.told = math.nan

    def show(self, done: int) -> None:
        """Print a line after so many pictures, if it is time for one."""
        now = self.clock()
        if done == 1:
            self.began, self.told = now, -math.inf
            return
        each = (now - self.began) / (done - 1)
        left = each * (self.count - done)
        if now - self.told > PERIOD and left > (LONGEST_SILENCE if self.told == -math.inf else 0.0):
            print(f"picture {done} of {self.count}: {each:.2f} s each, {left:.0f} s left", file=sys.stderr, flush=True)
            self.told = now


def save(frames: Sequence[Any], path: str | Path, seconds: float) -> Path:
    """Write pictures, ``seconds`` apart, as a film: ``.gif`` and ``.webp`` repeat for ever; ``.mp4`` is H.264.

    Raises:
        ImportError: a ``.mp4`` needs the package imageio-ffmpeg. ValueError: another suffix.
    """
    path = Path(path)
    if path.suffix == ".gif":
        reduced = [frame.quantize(64) for frame in frames]
        reduced[0].save(path, save_all=True, append_images=reduced[1:], duration=round(1000 * seconds), loop=0)
    elif path.suffix == ".webp":
        frames[0].save(
            path, save_all=True, append_images=frames[1:], duration=round(1000 * seconds), loop=0, quality=55, method=4
        )
    elif path.suffix == ".mp4":
        import imageio_ffmpeg

        writer = imageio_ffmpeg.write_frames(
            str(path), frames[0].size, fps=1.0 / seconds, codec="libx264", pix_fmt_out="yuv420p", macro_block_size=2,
            quality=None, output_params=["-crf", "26", "-preset", "slow", "-movflags", "+faststart"],
        )  # fmt: skip
        writer.send(None)
        for frame in frames:
            writer.send(np.ascontiguousarray(frame.convert("RGB")).tobytes())
        writer.close()
    else:
        raise ValueError(f"films.save: {path.name!r}; expected a name that ends in .gif, .webp or .mp4")
    return path


def save_strip(frames: Sequence[Any], path: str | Path, columns: int = 5, gap: int = 0) -> Path:
    """Write pictures side by side, in rows, as one PNG; ``gap``: between them [pixel]."""
    from PIL import Image

    width, height = frames[0].size
    rows = -(-len(frames) // columns)
    across, down = width + gap, height + gap
    sheet = Image.new("RGB", (columns * across - gap, rows * down - gap), "white")
    for i, frame in enumerate(frames):
        sheet.paste(frame, (i % columns * across, i // columns * down))
    sheet.save(path)
    return Path(path)
