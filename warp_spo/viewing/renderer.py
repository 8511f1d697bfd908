"""Pictures of shapes on the ground in the sun, ray traced by Newton's camera on any Warp device, without a display."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from ..scene.ground import HeightField, Plane
from .shapes import Primitive
from .surfaces import Triangles

ROUND = ("radius", "half_height")
SIZES = {"sphere": ("radius",), "capsule": ROUND, "cylinder": ROUND, "cone": ROUND, "box": ("hx", "hy", "hz"),
         "ellipsoid": ("rx", "ry", "rz")}  # fmt: skip
"""Kind of a primitive -> Newton's names of its sizes."""
SUN = (-0.36, 0.26, -0.9)  # direction of the light
SUNLIGHT, SKYLIGHT, GROUNDLIGHT = (0.9, 0.89, 0.87), (0.25, 0.26, 0.28), (0.1, 0.1, 0.1)  # linear RGB
ZENITH, HORIZON = np.array([[184, 201, 224], [237, 242, 247]], np.float32)  # colours of the sky
SQUARES = (200, 207, 214), (214, 219, 224)  # colours of the ground
SQUARE = 1.0  # edge of one [m]
EDGE = 200.0  # how far the ground goes on [m]
HAZE = 8.0  # where the ground has faded to 37 %, over the distance of the camera
NEAR = 3.0  # how far about what is looked at a field has all its lines, over the distance of the camera
COARSE = 8  # farther away it has one of so many
GROWTH = 2e-4  # of a shape over the one before
SAMPLES = 4  # rays a pixel
AWAY = (0.0, 0.0, -1e3, 0.0, 0.0, 0.0, 1.0)  # pose of a marker that a picture does not show


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

    def pose(self, target: np.ndarray) -> np.ndarray:
        """Return the pose [7] of the camera that looks at a point (3,) [m]: along its -z axis, with y up."""
        turn, tilt = 0.5 * (self.azimuth + 0.5 * np.pi), 0.5 * (0.5 * np.pi - self.elevation)
        back = [np.cos(self.elevation) * np.cos(self.azimuth), np.cos(self.elevation) * np.sin(self.azimuth)]
        place = target + self.distance * np.array([*back, np.sin(self.elevation)])
        c, s = np.cos(turn), np.sin(turn)
        return np.array([*place, c * np.sin(tilt), s * np.sin(tilt), s * np.cos(tilt), c * np.cos(tilt)])


class Renderer:
    """Bodies with shapes on the ground, and a camera.

    Args:
        shapes: primitives and triangles fixed to bodies or to the world. bodies: how many there are.
        ground: of a scene; anything but a plane or a height field is drawn as the plane z = 0.
        camera: from where; pictures have its size.
        markers: primitives of the world that some pictures show.
        device: Warp device that draws.
        around: points that pictures look at [point, 3] [m]; far from them a field of heights is coarse. None: nowhere.
    """

    def __init__(
        self, shapes: Sequence[Primitive | Triangles], bodies: int, ground: Any, camera: Camera,
        markers: Sequence[Primitive] = (), device: Any = "cpu", around: np.ndarray | None = None,
    ):  # fmt: skip
        import newton
        from newton.sensors import SensorCamera

        builder = newton.ModelBuilder()
        mesh = _ground_mesh(ground, around, NEAR * camera.distance)
        builder.add_shape_mesh(-1, mesh=mesh, color=(1.0, 1.0, 1.0))
        first = [builder.add_body() for _ in range(bodies + len(markers))][bodies:]
        self.markers = dict(zip(markers, first, strict=True))
        for i, (shape, body) in enumerate([*((each, each.body) for each in shapes), *self.markers.items()]):
            if isinstance(shape, Triangles):
                mesh = newton.Mesh(shape.vertices, shape.faces.ravel(), compute_inertia=False)
                builder.add_shape_mesh(body, mesh=mesh, color=shape.color)
                continue
            # Each a little thicker than the one before: rays would hit either of two surfaces that coincide.
            size = (shape.size[0] * (1.0 + GROWTH * i), *shape.size[1:])
            add = getattr(builder, f"add_shape_{shape.kind}")
            sizes = dict(zip(SIZES[shape.kind], size, strict=True))
            add(body, xform=wp.transform(*shape.pose), color=shape.color, **sizes)
        self.camera, pixels = camera, (camera.width, camera.height)
        self.model = builder.finalize(device=device)
        self.state: Any = self.model.state()
        self.sensor = SensorCamera(self.model)
        self._light()
        self.rays = self.sensor.compute_camera_rays_pinhole(
            *pixels, camera_fov=camera.view, sample_count=SAMPLES, device=device
        )
        self.color: Any = self.sensor.allocate_image_color(1, *pixels)
        self.depth: Any = self.sensor.allocate_image_depth(1, *pixels)
        self.options: dict[str, Any] = dict(
            clear_data=SensorCamera.ClearData(
                clear_color=int.from_bytes((*HORIZON.astype(np.uint8), 255), "little"), clear_depth=1e6
            ),
            render_config=SensorCamera.RenderConfig(
                enable_textures=True, enable_shadows=True, anti_aliasing=SensorCamera.AntiAliasing.MSAA
            ),
        )
        up = np.sin(0.5 * camera.view * np.linspace(1.0, -1.0, camera.height) - camera.elevation)  # of rays
        self.sky = HORIZON + np.clip(2.0 * up, 0.0, 1.0, dtype=np.float32)[:, None, None] * (ZENITH - HORIZON)

    def _light(self) -> None:
        """Set the sun and the light of the sky, which Newton marks as experimental."""
        direction = wp.vec3f(*(np.array(SUN) / np.linalg.norm(SUN)))
        self.sensor.create_default_light(enable_shadows=True, direction=direction, color=SUNLIGHT)
        self.sensor.set_ambient_light(SKYLIGHT, GROUNDLIGHT)

    def draw(self, poses: np.ndarray, target: np.ndarray, markers: Sequence[Primitive] = ()) -> np.ndarray:
        """Return a picture [row, column, 3], uint8.

        Args:
            poses: of the bodies [body, 7]. target: point that the camera looks at (3,) [m].
            markers: those that are shown.
        """
        shown = [(*np.zeros(6), 1.0) if marker in markers else AWAY for marker in self.markers]
        if self.model.body_count > 0:
            self.state.body_q.assign(np.array([*poses, *shown], np.float32))
        self.model.bvh_refit_shapes(self.state)
        place: Any = wp.array(self.camera.pose(target)[None], dtype=wp.transformf, device=self.model.device)
        self.sensor.update(self.state, place, self.rays, color_image=self.color, depth_image=self.depth, **self.options)
        color = self.color.numpy()[0].view(np.uint8).reshape(*self.depth.shape[1:], 4)[..., :3]
        clear = np.exp(-((self.depth.numpy()[0, ..., None] / (HAZE * self.camera.distance)) ** 2))
        return (self.sky + clear * (color - self.sky)).astype(np.uint8)


def _ground_mesh(ground: Any, around: np.ndarray | None = None, near: float = 0.0) -> Any:
    """Return a mesh of the ground, with squares; a field goes on as it is at its edges, like a plane.

    Farther than ``near`` [m] from the points ``around``, if there are any, a field has one of COARSE lines, because
    Newton prepares a million points for 20 s.
    """
    import newton

    table, origin, cells = np.zeros((1, 1)), (0.0, 0.0, 0.0), (1.0, 1.0)
    if isinstance(ground, HeightField):
        table, origin, cells = ground.heights, ground.origin, ground.cells
    heights = np.pad(table if table.ndim == 2 else table[0], 1, mode="edge") + origin[2]
    lines = [origin[axis] + cells[axis] * np.arange(-1.0, heights.shape[axis] - 1.0) for axis in (0, 1)]
    if around is not None:
        kept = [_lines_kept(line, each, near) for line, each in zip(lines, around.T, strict=False)]
        lines, heights = [line[each] for line, each in zip(lines, kept, strict=True)], heights[np.ix_(*kept)]
    for line in lines:
        line[[0, -1]] += -EDGE, EDGE
    x, y = np.meshgrid(*lines, indexing="ij")
    if isinstance(ground, Plane) and ground.normal[2] > 0.0:
        heights = (ground.height - ground.normal[0] * x - ground.normal[1] * y) / ground.normal[2]
    corners = np.stack([x, y, heights], axis=-1).reshape(-1, 3)
    index = np.arange(len(corners)).reshape(x.shape)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.stack([a, b, c, a, c, d], axis=-1).ravel()
    squares = np.full((128, 128, 3), SQUARES[1], np.uint8)
    squares[:64, :64] = squares[64:, 64:] = SQUARES[0]
    places = corners[:, :2] / (2.0 * SQUARE)
    return newton.Mesh(corners, faces, uvs=places, compute_inertia=False, texture=squares)


def _lines_kept(line: np.ndarray, around: np.ndarray, near: float) -> np.ndarray:
    """Return the numbers of a grid's lines that are drawn: those near some places, one of COARSE beyond, both ends."""
    count = len(line)
    close = (line > around.min() - near) & (line < around.max() + near)
    ends = (np.arange(count) < 2) | (np.arange(count) > count - 3)  # the last two are as high as each other
    return np.flatnonzero(close | ends | (np.arange(count) % COARSE == 0))
