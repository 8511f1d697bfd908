"""Released robots of the package example-robot-data: an arm (7 dof), a quadruped (18), a humanoid (35), and others.

Only the URDF text is needed. Its masses, joints and their placements are used as they are. Shapes, damping, friction
and mimics of joints are removed, and the joints under ``locked`` are fixed at zero.
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
    """Path of a robot's file in the package, whether its root floats, and names of joints that are fixed at zero."""

    path: str
    floating: bool
    locked: tuple[str, ...] = ()


ROBOTS = {
    "panda": Robot("panda_description/urdf/panda.urdf", False, ("panda_finger_joint1", "panda_finger_joint2")),
    "go2": Robot("go2_description/urdf/go2.urdf", True),
    "g1": Robot("g1_description/urdf/g1_29dof_rev_1_0.urdf", True),
}
"""Those that tables compare with other libraries."""

UNLIKE = {
    "b1_z1": Robot("b1_description/urdf/b1-z1.urdf", True),
    "centauro": Robot("centauro_description/urdf/centauro.urdf", True),
}
"""Legs and arms on one body: a quadruped with an arm (25 dof), a centaur (45 dof)."""

ALL = ROBOTS | UNLIKE


def urdf_file(name: str) -> Path:
    """Return the path of a robot's URDF file.

    Raises:
        ValueError: there is no robot of this name.
        ImportError: the environment variable FOLDER is not set, and the package is not installed.
        FileNotFoundError: FOLDER is set, and the folder does not have the robot.
    """
    folder = os.environ.get(FOLDER)
    if folder:
        file = Path(folder) / f"{name}.urdf"
        if not file.is_file():
            raise FileNotFoundError(
                f"robots: there is no file {str(file)!r}; expected {name}.urdf in the folder that {FOLDER} names"
            )
        return file
    if name not in ALL:
        raise ValueError(f"robots: there is no robot {name!r}; expected one of {', '.join(ALL)}")
    try:
        return Path(str(metadata.distribution(PACKAGE).locate_file(f"{INSTALLED}/{ALL[name].path}")))
    except metadata.PackageNotFoundError:
        raise ImportError(
            f"robots: {name!r} needs the package {PACKAGE}; pip install warp_spo[robots], or set {FOLDER} to a "
            f"folder with {name}.urdf"
        ) from None


def is_available(name: str) -> bool:
    """Return whether a robot's file exists."""
    try:
        return urdf_file(name).is_file()
    except (ImportError, FileNotFoundError):
        return False


def urdf_text(name: str) -> str:
    """Return the URDF text of a robot, without the elements that this module's docstring lists.

    Raises:
        ImportError, FileNotFoundError: as :func:`urdf_file`.
    """
    root = ET.parse(urdf_file(name)).getroot()
    _strip(root, ALL[name].locked)
    return ET.tostring(root, encoding="unicode") + "\n"


def remove_shapes(root: ET.Element) -> None:
    """Remove from a URDF all but links and joints, and the shapes of the links."""
    for child in list(root):
        if child.tag not in ("link", "joint"):
            root.remove(child)
    for link in root.findall("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)


def _strip(root: ET.Element, locked: tuple[str, ...]) -> None:
    remove_shapes(root)
    for joint in root.findall("joint"):
        if joint.get("name") in locked:
            joint.set("type", "fixed")
        for tag in ("dynamics", "mimic", "safety_controller", "calibration"):
            for element in joint.findall(tag):
                joint.remove(element)


def scene(name: str) -> spo.Scene:
    """Return a robot of :data:`ALL`, without armature, in gravity of 9.81 m/s^2 along -z.

    Raises:
        ImportError, FileNotFoundError: as :func:`urdf_file`.
    """
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"{name}.urdf"
        file.write_text(urdf_text(name))
        loaded = spo.load(file, floating=ALL[name].floating)
    return loaded.with_values(joint_armature=0.0 * loaded.values["joint_armature"])
