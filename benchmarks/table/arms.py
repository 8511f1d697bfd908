"""Two released arms by their kinematics: Franka's Panda and Universal Robots' UR5, as URDF text without any file.

Placements, axes and limits are those of the URDFs in example-robot-data; a test compares them. Masses are 1 kg each:
inverse kinematics does not read them.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import NamedTuple

import warp_spo as spo

HALF = 1.5707963267948966


class Arm(NamedTuple):
    """Turning joints, base first: (xyz, rpy, axis, lower limit, upper limit), and the tool's pose on the last link."""

    joints: tuple[tuple, ...]
    tool: tuple[float, ...]


Y, Z = (0, 1, 0), (0, 0, 1)
ARMS = {
    "panda": Arm(
        (
            ((0, 0, 0.333), (0, 0, 0), Z, -2.8973, 2.8973),
            ((0, 0, 0), (-HALF, 0, 0), Z, -1.7628, 1.7628),
            ((0, -0.316, 0), (HALF, 0, 0), Z, -2.8973, 2.8973),
            ((0.0825, 0, 0), (HALF, 0, 0), Z, -3.0718, -0.0698),
            ((-0.0825, 0.384, 0), (-HALF, 0, 0), Z, -2.8973, 2.8973),
            ((0, 0, 0), (HALF, 0, 0), Z, -0.0175, 3.7525),
            ((0.088, 0, 0), (HALF, 0, 0), Z, -2.8973, 2.8973),
        ),
        (0.0, 0.0, 0.2104, 0.0, 0.0, -0.3826834323650898, 0.9238795325112867),
    ),
    "ur5": Arm(
        (
            ((0, 0, 0.089159), (0, 0, 0), Z, -6.28318530718, 6.28318530718),
            ((0, 0.13585, 0), (0, 1.57079632679, 0), Y, -6.28318530718, 6.28318530718),
            ((0, -0.1197, 0.425), (0, 0, 0), Y, -3.14159265359, 3.14159265359),
            ((0, 0, 0.39225), (0, 1.57079632679, 0), Y, -6.28318530718, 6.28318530718),
            ((0, 0.093, 0), (0, 0, 0), Z, -6.28318530718, 6.28318530718),
            ((0, 0, 0.09465), (0, 0, 0), Y, -6.28318530718, 6.28318530718),
        ),
        (0.0, 0.0823, 0.0, -0.7071067811865476, 0.0, 0.0, 0.7071067811865476),
    ),
}


def urdf_text(name: str) -> str:
    """Return an arm as URDF; its links are link0, the base, to the last one, which carries the tool."""
    arm, lines = ARMS[name], [f'<robot name="{name}">']
    inertia = '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'
    text = lambda numbers: " ".join(map(repr, numbers))  # noqa: E731
    for k in range(len(arm.joints) + 1):
        lines.append(f'<link name="link{k}"><inertial><mass value="1"/>{inertia}</inertial></link>')
    for k, (xyz, rpy, axis, lower, upper) in enumerate(arm.joints):
        lines.append(
            f'<joint name="joint{k + 1}" type="revolute"><parent link="link{k}"/><child link="link{k + 1}"/>'
            f'<origin xyz="{text(xyz)}" rpy="{text(rpy)}"/><axis xyz="{text(axis)}"/>'
            f'<limit lower="{lower!r}" upper="{upper!r}" effort="100" velocity="10"/></joint>'
        )
    return "\n".join([*lines, "</robot>"])


def scene(name: str) -> spo.Scene:
    """Return an arm on a fixed base."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"{name}.urdf"
        file.write_text(urdf_text(name))
        return spo.load(file, floating=False)


def tool(name: str) -> tuple[str, tuple[float, ...]]:
    """Return the frame of an arm's tool."""
    return f"link{len(ARMS[name].joints)}", ARMS[name].tool
