"""Films and strips of pictures, without a display: shaded primitives, drawn by MuJoCo's renderer or in NumPy."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..reference.rotations import rotation
from ..scene.ground import HeightField
from .robots import Primitive, Robot

SUN = np.array([0.35, -0.25, 0.9]) / np.linalg.norm([0.35, -0.25, 0.9])  # direction to the light
SKY, GROUND, GROUND_DARK, SHADOW = (236, 240, 245), (214, 219, 224), (203, 209, 215), (160, 167, 175)
CELL, FIELD_CELL = 0.5, 0.1  # edge of a square of flat ground, and of a height field [m]
FINE = 2  # pictures are drawn so many times as large, then made smaller
AROUND = 12  # corners of a circle


@dataclasses.dataclass(frozen=True)
class Camera:
    """A camera that looks at a point from a distance.

    Attributes:
        distance: [m]. azimuth: direction from the point to the camera, about the vertical, from x. elevation: above the
            horizontal [rad]. width, height: of a picture [pixel]. view: vertical opening [rad]. above: height of the
            point over the first body [m].
    """

    distance: float = 2.0
    azimuth: float = -1.1
    elevation: float = 0.3
    width: int = 480
    height: int = 300
    view: float = 0.6
    above: float = 0.0

    def project(self, points: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the places [pixel] of points [n, 3] in the picture, and their depths [m]."""
        ce, se, ca, sa = np.cos(self.elevation), np.sin(self.elevation), np.cos(self.azimuth), np.sin(self.azimuth)
        back, right = np.array([ce * ca, ce * sa, se]), np.array([-sa, ca, 0.0])
        offset = points - (target + self.distance * back)
        depth = -(offset @ back)
        scale = 0.5 * self.height / np.tan(0.5 * self.view) / np.maximum(depth, 0.05)
        x, y = offset @ right * scale, offset @ np.cross(back, right) * scale
        return np.stack([0.5 * self.width + x, 0.5 * self.height - y], axis=1), depth


@functools.cache
def mesh(kind: str, size: tuple[float, ...]) -> tuple[np.ndarray, list[list[int]]]:
    """Return the corners [n, 3] of a primitive, and its faces: lists of corners, outward ones counter-clockwise."""
    if kind == "box":
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size
        return corners, [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    radius, half = size[0], size[1] if kind == "capsule" else 0.0
    rings = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 8)
    rows = [(angle, -half) for angle in rings[:4]] + [(angle, half) for angle in rings[4:]]
    turn = np.linspace(0.0, 2.0 * np.pi, AROUND, endpoint=False)
    corners = np.array(
        [
            [radius * np.cos(up) * np.cos(t), radius * np.cos(up) * np.sin(t), radius * np.sin(up) + shift]
            for up, shift in rows
            for t in turn
        ]
    )
    faces = [
        [i * AROUND + j, i * AROUND + (j + 1) % AROUND, (i + 1) * AROUND + (j + 1) % AROUND, (i + 1) * AROUND + j]
        for i in range(len(rows) - 1)
        for j in range(AROUND)
    ]
    return corners, faces


def draw(
    robot: Robot, poses: np.ndarray, camera: Camera, target: np.ndarray, markers: Sequence[Primitive] = ()
) -> Any:  # fmt: skip
    """Return a picture (PIL image) of a robot.

    Args:
        robot: what to draw, and its ground.
        poses: of its bodies [body, 7].
        camera: from where. target: point that it looks at (3,) [m].
        markers: shapes to draw beside the robot's, such as a target.
    """
    from PIL import Image, ImageDraw

    camera = dataclasses.replace(camera, width=FINE * camera.width, height=FINE * camera.height)
    picture = Image.new("RGB", (camera.width, camera.height), SKY)
    pen = ImageDraw.Draw(picture)
    ground = robot.scene.ground
    faces: list[tuple[float, Any, tuple[int, int, int]]] = []
    squares = list(_ground_faces(ground, target, camera))
    if isinstance(ground, HeightField):
        faces += squares
    else:
        for _, places, color in squares:
            pen.polygon(places, fill=color)
    for shape in (*robot.primitives, *markers):
        corners, sides = mesh(shape.kind, shape.size)
        corners = corners @ rotation(shape.pose[3:]).T + shape.pose[:3]
        if shape.body >= 0:
            corners = corners @ rotation(poses[shape.body, 3:]).T + poses[shape.body, :3]
        if not isinstance(ground, HeightField) and shape not in markers:
            fallen = corners - corners[:, 2:] / SUN[2] * SUN
            places, depth = camera.project(fallen, target)
            if depth.min() > 0.1:
                for side in sides:
                    pen.polygon([tuple(places[i]) for i in side], fill=SHADOW)
        places, depth = camera.project(corners, target)
        if depth.min() < 0.1:
            continue
        for side in sides:
            a, b, c = places[side[0]], places[side[1]], places[side[2]]
            if (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) > 0.0:
                continue  # seen from behind
            normal = np.cross(corners[side[2]] - corners[side[0]], corners[side[-1]] - corners[side[1]])
            size = float(np.linalg.norm(normal))
            light = 0.55 + 0.45 * max(0.0, float(normal @ SUN) / size) if size > 0.0 else 0.8
            color = tuple(int(255 * min(1.0, light * part)) for part in shape.color)
            faces.append((depth[side].mean(), [tuple(places[i]) for i in side], color))
    for _, places, color in sorted(faces, key=lambda face: -face[0]):
        pen.polygon(places, fill=color)
    return picture.resize((camera.width // FINE, camera.height // FINE), Image.Resampling.LANCZOS)


def _ground_faces(ground: Any, target: np.ndarray, camera: Camera) -> Any:
    """Yield (depth, places, colour) of the squares of the ground about the target."""
    uneven = isinstance(ground, HeightField)
    reach, cell = (1.3 * camera.distance, FIELD_CELL) if uneven else (2.5 * camera.distance, CELL)
    first = np.floor((target[:2] - reach) / cell).astype(int)
    count = int(np.ceil(2 * reach / cell)) + 1
    x, y = np.meshgrid(*(cell * (start + np.arange(count + 1)) for start in first), indexing="ij")
    corners = np.stack([x, y, _heights(ground, x, y) if uneven else np.zeros_like(x)], axis=-1)
    places, depth = camera.project(corners.reshape(-1, 3), target)
    places, depth = places.reshape(*x.shape, 2), depth.reshape(x.shape)
    for i in range(count):
        for j in range(count):
            at = ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1))
            depths = [depth[k] for k in at]
            if min(depths) < 0.1:
                continue
            color: tuple[int, ...] = GROUND if (first[0] + i + first[1] + j) % 2 else GROUND_DARK
            if uneven:
                normal = np.cross(corners[at[2]] - corners[at[0]], corners[at[3]] - corners[at[1]])
                light = 0.45 + 0.55 * max(0.0, float(normal @ SUN / np.linalg.norm(normal)))
                color = tuple(int(light * part) for part in GROUND)
            yield sum(depths) / 4.0 + 0.05, [tuple(places[k]) for k in at], color


def _heights(ground: HeightField, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the heights [m] of a field at points near its own."""
    table, origin, cells = np.asarray(ground.heights), np.asarray(ground.origin), ground.cells
    i = np.clip(np.round((x - origin[0]) / cells[0]).astype(int), 0, table.shape[0] - 1)
    j = np.clip(np.round((y - origin[1]) / cells[1]).astype(int), 0, table.shape[1] - 1)
    return table[i, j] + origin[2]


def pictures(
    robot: Robot, q: np.ndarray, camera: Camera, follow: bool = True, markers: Sequence[Any] = (),
    captions: Sequence[str] = (), renderer: str | None = None,
) -> list:  # fmt: skip
    """Return a picture of each state.

    Args:
        q: coordinates [picture, coordinate].
        follow: whether the camera moves with the first body; otherwise it looks at the first body's first place.
        markers, captions: for each picture, or none.
        renderer: "mujoco", "numpy", or None: MuJoCo's if it works here.
    """
    from PIL import Image, ImageDraw

    from .. import Dynamics

    poses = Dynamics(robot.scene.with_contacts([]), len(q), "cpu", "float64").body_poses(np.asarray(q, np.float64))
    looked = poses[:, 0, :3] + np.array([0.0, 0.0, camera.above])
    if not follow:
        looked[:] = looked[0]
    elif not isinstance(robot.scene.ground, HeightField):
        looked[:, 2] = looked[:, 2].mean()
    stage = _stage(robot.scene.ground, camera, renderer)
    found = []
    for i in range(len(q)):
        beside = tuple(markers[i]) if len(markers) else ()
        if stage is None:
            picture = draw(robot, poses[i], camera, looked[i], beside)
        else:
            seen = (camera.distance, camera.azimuth, camera.elevation)
            drawn = Image.fromarray(stage.draw((*robot.primitives, *beside), poses[i], looked[i], *seen))
            picture = drawn.resize((camera.width, camera.height), Image.Resampling.LANCZOS)
        if len(captions):
            ImageDraw.Draw(picture).text((8, 6), captions[i], fill=(40, 44, 52))
        found.append(picture)
    if stage is not None:
        stage.close()
    return found


def _stage(ground: Any, camera: Camera, renderer: str | None) -> Any:
    """Return what draws with MuJoCo's renderer, or None: this file draws."""
    if renderer not in (None, "mujoco", "numpy"):
        raise ValueError(f"film: renderer {renderer!r}; expected 'mujoco', 'numpy' or None")
    if renderer == "numpy":
        return None
    try:
        from ..mujoco.rendering import Stage

        return Stage(ground, FINE * camera.width, FINE * camera.height, camera.view)
    except (ImportError, RuntimeError, AttributeError, OSError):
        if renderer == "mujoco":
            raise
        return None


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
        raise ValueError(f"film.save: {path.name!r}; expected a name that ends in .gif, .webp or .mp4")
    return path


def save_strip(frames: Sequence[Any], path: str | Path, columns: int = 5) -> Path:
    """Write pictures side by side, in rows, as one PNG."""
    from PIL import Image

    width, height = frames[0].size
    rows = -(-len(frames) // columns)
    sheet = Image.new("RGB", (columns * width, rows * height), SKY)
    for i, frame in enumerate(frames):
        sheet.paste(frame, (i % columns * width, i // columns * height))
    sheet.save(path)
    return Path(path)
