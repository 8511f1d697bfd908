"""Robots of the tasks: MJCF files of our own, which name the source and the licence of their figures.

A file has joints, inertias, armature, effort limits, servos and primitives; MuJoCo reads the same file. Primitives of
class "touch" touch the ground, those of class "look" are drawn.
"""

from __future__ import annotations

import dataclasses
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from ... import Contact, Plane, Scene, from_mujoco
from ...viewing.shapes import Primitive

FILES = Path(__file__).parent
NAMES = ("cartpole", "ant", "panda", "go2", "g1")
LOOK, TOUCH = 2, 3  # groups of geoms in the files
MATERIALS = {
    "ant": {"": (1314.0784722587514, 8.64930599634681)},
    "go2": {"trunk": (23204.977941176476, 108.00058885600804), "": (23204.977941176476, 152.73589750444714)},
    "g1": {"sole": (101495.18626132794, 325.1905892840616), "": (48099.5004729706, 316.5924308515969)},
}
"""Stiffness [N/m] and damping [N s/m] of contacts by robot and part of their name, the first that fits. They are softer
than what Contact chooses, because the tasks' policies and results of training are of these."""
EPS = 1e-3  # speed [m/s] below which friction of these contacts is a damper
SHAPES = {2: ("sphere", 1), 3: ("capsule", 2), 6: ("box", 3)}
"""MuJoCo's number of a kind of geom -> its name and how many sizes it has."""


@dataclasses.dataclass(frozen=True)
class Robot:
    """A scene with contacts and actuators, its standing pose, and what it looks like.

    Attributes:
        name: of the file. path: of the file, which MuJoCo reads, too.
        scene: with contacts that carry the names of the file's shapes, and servos or motors as actuators.
        q: coordinates of the pose "stand" [coordinate]. ctrl: its controls [actuator].
        primitives: shapes to draw.
    """

    name: str
    path: Path
    scene: Scene
    q: np.ndarray
    ctrl: np.ndarray
    primitives: tuple[Primitive, ...]

    def points(self, *names: str) -> list[int]:
        """Return the rows of contact points, as in ``contact_f``, whose contact's label contains one of the names."""
        labels = [self.scene.contacts[point.contact].label for point in self.scene.contact_points]
        found = [i for i, label in enumerate(labels) if any(name in label for name in names)]
        if not found:
            raise ValueError(f"Robot.points: no contact of {self.name!r} is named like {names}; it has {labels}")
        return found


def load(
    name: str, ground: Any = None, contacts: tuple[str, ...] | None = None, walls: tuple[str, ...] | None = None
) -> Robot:
    """Return a robot by name, on the ground.

    Args:
        name: one of ``NAMES``.
        ground: spo.Plane or spo.HeightField; None: the plane z = 0.
        contacts: parts of the names of contacts to keep; None keeps all.
        walls: parts of the names of contacts that see walls of a field, see :class:`warp_spo.Contact`; None: all.

    Raises:
        ValueError: the name is unknown.
    """
    if name not in NAMES:
        raise ValueError(
            f"robots.load: {name!r} is unknown; expected one of {', '.join(NAMES)}; a file of yours is read by "
            "spo.load(path, contacts='ground'), as python -m warp_spo.tasks --new TASK.py --robot ROBOT.xml writes"
        )
    from ...mujoco.mjcf import compiled

    path = FILES / f"{name}.xml"
    model, *_ = compiled(path)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*left out: contacts")  # which are added here
        scene = from_mujoco(model)
    touch = [_contact(model, geom, name) for geom in range(model.ngeom) if model.geom_group[geom] == TOUCH]
    if contacts is not None:
        touch = [contact for contact in touch if any(part in contact.label for part in contacts)]
    if walls is not None:
        seen = {contact.label: any(part in contact.label for part in walls) for contact in touch}
        touch = [dataclasses.replace(contact, walls=seen[contact.label]) for contact in touch]
    if touch:
        scene = scene.with_contacts(touch, Plane() if ground is None else ground)
    look = [_primitive(model, geom) for geom in range(model.ngeom) if model.geom_group[geom] == LOOK]
    feet = [_primitive(model, geom) for geom in range(model.ngeom) if "_foot" in model.geom(geom).name]
    stand = scene.keyframes["stand"]
    return Robot(name, path, scene, np.array(stand.q), np.array(stand.ctrl), (*look, *feet))


def _contact(model: Any, geom: int, robot: str) -> Contact:
    """Return a contact with the shape of a geom, a sphere or a capsule, and the material of the robot's contacts."""
    kind, body, size, pose, _ = _primitive(model, geom)
    centre = np.array(pose[:3])
    shape: dict[str, Any] = {"sphere": (centre, size[0])}
    if kind == "capsule":
        half = size[1] * _z_axis(pose[3:])
        shape = {"capsule": (centre - half, centre + half, size[0])}
    label, friction = model.geom(geom).name, float(model.geom_friction[geom, 0])
    k, d = next((value for part, value in MATERIALS.get(robot, {}).items() if part in label), (None, None))
    return Contact(body, **shape, friction=friction, stiffness=k, damping=d, eps=EPS, label=label)


def _primitive(model: Any, geom: int) -> Primitive:
    kind, used = SHAPES[int(model.geom_type[geom])]
    w, x, y, z = model.geom_quat[geom].tolist()
    pose = (*model.geom_pos[geom].tolist(), x, y, z, w)
    color = tuple(model.geom_rgba[geom, :3].tolist())
    return Primitive(kind, int(model.geom_bodyid[geom]) - 1, tuple(model.geom_size[geom, :used].tolist()), pose, color)


def _z_axis(quaternion: Any) -> np.ndarray:
    x, y, z, w = quaternion
    return np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
