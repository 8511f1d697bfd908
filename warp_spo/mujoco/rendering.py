"""Pictures of shapes on the ground by MuJoCo's renderer, without a display where EGL is at hand."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..reference.rotations import rotation

GROUND = """
<mujoco>
  <visual>
    <global offwidth="{width}" offheight="{height}" fovy="{view}"/>
    <quality shadowsize="8192" offsamples="4"/>
    <headlight ambient="0.38 0.38 0.4" diffuse="0.25 0.25 0.25" specular="0 0 0"/>
    <map znear="0.02" zfar="20" shadowclip="10"/>
    <rgba haze="0.93 0.95 0.97 1"/>
  </visual>
  <statistic extent="1.5" center="0 0 0"/>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1="0.93 0.95 0.97" rgb2="0.72 0.79 0.88"
             width="64" height="384"/>
    <texture name="squares" type="2d" builtin="checker" rgb1="0.84 0.86 0.88" rgb2="0.78 0.81 0.84"
             width="512" height="512"/>
    <material name="squares" texture="squares" texuniform="true" texrepeat="1 1"/>
  </asset>
  <worldbody>
    <light directional="true" dir="-0.35 0.25 -0.9" diffuse="0.65 0.65 0.63" specular="0.15 0.15 0.15"
           castshadow="true"/>
  </worldbody>
</mujoco>
"""
TOWARDS_LIGHT = np.array([0.35, -0.25, 0.9])
KINDS = {"sphere": "mjGEOM_SPHERE", "capsule": "mjGEOM_CAPSULE", "box": "mjGEOM_BOX"}
DEEP = 0.5  # of a height field below its lowest point [m]


def make_context(width: int, height: int) -> Any:
    """Return an OpenGL context to draw in: EGL's on Linux, with or without a display; elsewhere MuJoCo's choice."""
    if sys.platform == "linux":
        from mujoco.egl import GLContext
    else:
        from mujoco import GLContext
    return GLContext(width, height)


class Stage:
    """Flat ground or a height field under a sun, and a renderer that draws shapes on it.

    Args:
        ground: of a scene; anything but a height field is drawn as the plane z = 0.
        width, height: of a picture [pixel]. view: vertical opening [rad].

    Raises:
        ImportError, RuntimeError, AttributeError: MuJoCo, or a way to render without a display, is missing.
    """

    def __init__(self, ground: Any, width: int, height: int, view: float):
        import mujoco as mj

        spec = mj.MjSpec.from_string(GROUND.format(width=width, height=height, view=float(np.degrees(view))))
        if hasattr(ground, "heights"):
            heights = np.asarray(ground.heights)
            heights = heights if heights.ndim == 2 else heights[0]
            low, high = float(heights.min()), float(heights.max())
            half = 0.5 * np.array(ground.cells) * (np.array(heights.shape) - 1)
            rows = ((heights - low) / max(high - low, 1e-6)).T
            spec.add_hfield(
                name="field", nrow=rows.shape[0], ncol=rows.shape[1], userdata=rows.ravel(),
                size=[*half, max(high - low, 1e-6), DEEP],
            )  # fmt: skip
            x, y, z = ground.origin
            spec.worldbody.add_geom(
                type=mj.mjtGeom.mjGEOM_HFIELD, hfieldname="field", material="squares",
                pos=[x + half[0], y + half[1], z + low],
            )  # fmt: skip
        else:
            spec.worldbody.add_geom(type=mj.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], material="squares")
        self.mujoco, self.model = mj, spec.compile()
        self.data = mj.MjData(self.model)
        mj.mj_forward(self.model, self.data)
        self.scene, self.options = mj.MjvScene(self.model, maxgeom=2000), mj.MjvOption()
        self.picture = np.empty((height, width, 3), np.uint8)
        self.gl = make_context(width, height)
        self.gl.make_current()
        self.context = mj.MjrContext(self.model, mj.mjtFontScale.mjFONTSCALE_100)
        mj.mjr_setBuffer(mj.mjtFramebuffer.mjFB_OFFSCREEN, self.context)

    def draw(
        self, shapes: Sequence[Any], poses: np.ndarray, target: np.ndarray, distance: float, azimuth: float,
        elevation: float,
    ) -> np.ndarray:  # fmt: skip
        """Return a picture [row, column, 3], uint8.

        Args:
            shapes: kind, body, size, pose and color each, as ``warp_spo.env.robots.Primitive``.
            poses: of the bodies [body, 7]. target: point that the camera looks at [3], from ``distance`` [m] and the
            direction ``azimuth``, ``elevation`` [rad].
        """
        mj, scene = self.mujoco, self.scene
        camera = mj.MjvCamera()
        camera.lookat, camera.distance = target, distance
        camera.azimuth, camera.elevation = float(np.degrees(azimuth)) + 180.0, -float(np.degrees(elevation))
        self.data.light_xpos[0] = target + 4.0 * TOWARDS_LIGHT
        seen, drawn = mj.mjtCatBit.mjCAT_ALL, mj.MjrRect(0, 0, *self.picture.shape[1::-1])
        mj.mjv_updateScene(self.model, self.data, self.options, None, camera, seen, scene)
        for shape in shapes:
            position, turn = np.array(shape.pose[:3], np.float64), rotation(shape.pose[3:])
            if shape.body >= 0:
                frame = rotation(poses[shape.body, 3:])
                position, turn = frame @ position + poses[shape.body, :3], frame @ turn
            size = np.array([*shape.size, 0.0, 0.0], np.float64)[:3]
            geom = scene.geoms[scene.ngeom]
            color = np.array([*shape.color, 1.0], np.float32)
            mj.mjv_initGeom(geom, getattr(mj.mjtGeom, KINDS[shape.kind]), size, position, turn.ravel(), color)
            geom.specular, geom.shininess = 0.3, 0.4
            scene.ngeom += 1
        self.gl.make_current()
        mj.mjr_render(drawn, scene, self.context)
        mj.mjr_readPixels(self.picture, None, drawn, self.context)
        return self.picture[::-1].copy()

    def close(self) -> None:
        """Free what the graphics driver holds."""
        self.gl.make_current()
        self.context.free()
        self.gl.free()
