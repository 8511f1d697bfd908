"""Released robots from the package example-robot-data: a 7-dof arm, a quadruped (18 dof), a humanoid (35 dof).

Only the URDF text is needed. What is used of it is masses, hinges and their places: shapes, damping and friction of
joints, and mimics are taken out, joints under ``locked`` are held at zero; the rest of the file is as released.
"""

from __future__ import annotations

import os
import tempfile
import xml.etree.ElementTree as ET
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import warp_spo as spo

PACKAGE = "example-robot-data"
FOLDER = "WARP_SPO_ROBOTS"  # environment variable: a folder with NAME.urdf, used instead of the package
INSTALLED = "cmeel.prefix/share/example-robot-data/robots"


class Robot(NamedTuple):
    """Where a robot is in the package, whether its root floats, and joints that are held at zero."""

    path: str
    floating: bool
    locked: tuple[str, ...] = ()


ROBOTS = {
    "panda": Robot("panda_description/urdf/panda.urdf", False, ("panda_finger_joint1", "panda_finger_joint2")),
    "go2": Robot("go2_description/urdf/go2.urdf", True),
    "g1": Robot("g1_description/urdf/g1_29dof_rev_1_0.urdf", True),
}


def released(name: str) -> Path:
    """The URDF file of a robot.

    Raises:
        ImportError: neither a folder is named nor the package installed; says what installs it.
        FileNotFoundError: the folder that is named holds no such robot.
    """
    folder = os.environ.get(FOLDER)
    if folder:
        file = Path(folder) / f"{name}.urdf"
        if not file.is_file():
            raise FileNotFoundError(f"robots: no file {str(file)!r}; {FOLDER} expects {name}.urdf in that folder")
        return file
    try:
        return Path(str(metadata.distribution(PACKAGE).locate_file(f"{INSTALLED}/{ROBOTS[name].path}")))
    except metadata.PackageNotFoundError:
        raise ImportError(
            f"robots: {name!r} needs the package {PACKAGE}; pip install warp_spo[robots], or set {FOLDER} to a "
            f"folder with {name}.urdf"
        ) from None


def at_hand(name: str) -> bool:
    """Whether a robot's file is there."""
    try:
        return released(name).is_file()
    except (ImportError, FileNotFoundError):
        return False


def urdf(name: str) -> str:
    """URDF text of a robot, stripped as this file says.

    Raises:
        ImportError, FileNotFoundError: as :func:`released`.
    """
    root = ET.parse(released(name)).getroot()
    _strip(root, ROBOTS[name].locked)
    return ET.tostring(root, encoding="unicode") + "\n"


def without_shapes(root: ET.Element) -> None:
    """Leave links and joints, and no shapes on them."""
    for child in list(root):
        if child.tag not in ("link", "joint"):
            root.remove(child)
    for link in root.findall("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)


def _strip(root: ET.Element, locked: tuple[str, ...]) -> None:
    without_shapes(root)
    for joint in root.findall("joint"):
        if joint.get("name") in locked:
            joint.set("type", "fixed")
        for tag in ("dynamics", "mimic", "safety_controller", "calibration"):
            for element in joint.findall(tag):
                joint.remove(element)


def scene(name: str) -> spo.Scene:
    """A robot of :data:`ROBOTS`, no armature, gravity 9.81 m/s^2 along -z.

    Raises:
        ImportError, FileNotFoundError: as :func:`released`.
    """
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"{name}.urdf"
        file.write_text(urdf(name))
        loaded = spo.load(file, floating=ROBOTS[name].floating)
    return loaded.with_values(joint_armature=0.0 * loaded.values["joint_armature"])
