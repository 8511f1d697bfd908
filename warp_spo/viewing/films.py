"""Films and strips of pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..scene.scene import Scene
from .renderer import Camera, Renderer
from .shapes import Primitive, size_of

STEADY = 0.25  # a camera that follows keeps its height where the robot's changes less, over the camera's distance


def camera_of(scene: Scene, q: np.ndarray) -> Camera:
    """Return a camera that sees all of a robot."""
    return Camera(distance=1.0 + 1.6 * size_of(scene, q))


def pictures(
    scene: Scene, shapes: Sequence[Primitive], q: np.ndarray, camera: Camera, follow: bool = True,
    markers: Sequence[Sequence[Primitive]] = (), captions: Sequence[str] = (), device: Any = "cpu",
) -> list:  # fmt: skip
    """Return a picture (PIL image) of each state.

    Args:
        scene: whose bodies and ground are drawn. shapes: of the bodies, and of the world.
        q: coordinates [picture, coordinate].
        follow: whether the camera moves with the first body; otherwise it looks at the first body's first place.
        markers, captions: for each picture, or none. Markers are fixed to the world.
        device: Warp device that draws.
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
    renderer = Renderer(shapes, scene.body_count, scene.ground, camera, beside, device)
    found = []
    for i in range(len(q)):
        picture = Image.fromarray(renderer.draw(poses[i], looked[i], markers[i] if len(markers) else ()))
        if len(captions):
            ImageDraw.Draw(picture).text((8, 6), captions[i], fill=(40, 44, 52))
        found.append(picture)
    return found


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
