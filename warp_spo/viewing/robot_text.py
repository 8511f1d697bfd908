"""What the library has read of a robot, as tables in Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import shown
from ..scene.parts import UNLIMITED
from ..scene.scene import Scene
from .curves import table


def describe_robot(scene: Scene, notes: Sequence[str] = ()) -> str:
    """Return what a scene holds, and in words what was left out of it or warned of."""
    values, moving = scene.values, scene.dof_count
    mass = float(values["body_mass"][0].sum())
    lines = [
        f"**{scene.body_count} bodies, {moving} degrees of freedom, {mass:.4g} kg**",
        f"{len(scene.contacts)} contacts: {len(scene.contact_points)} points with the ground, "
        f"{len(scene.contact_pairs)} pairs of bodies. {len(scene.actuators)} actuators. "
        f"{len(scene.loops)} loops, {len(scene.couplings)} couplings.",
        f"Gravity {[round(float(x), 4) for x in values['gravity'][0]]} m/s².",
        "### Left out and warned of",
        *([f"* {_plain(note)}" for note in notes] or ["Nothing."]),
        "### Bodies",
        table(
            ("body", "mass [kg]", "centre of mass [m]", "principal moments [kg m²]"),
            [_body(scene, body) for body in range(scene.body_count)],
        ),
        "### Joints",
        table(
            ("dof", "lower", "upper", "effort", "ke", "kd", "damping", "friction", "armature"),
            [_dof(scene, dof) for dof in range(moving)],
        ),
    ]
    if scene.actuators:
        rows = [
            (shown(actuator.label) or f"actuator {i}", float(values["actuator_gain"][0, i]),
             _triple(values["actuator_bias"][0, i]), _range(*values["actuator_ctrl_range"][0, i]),
             _range(*values["actuator_force_range"][0, i]))
            for i, actuator in enumerate(scene.actuators)
        ]  # fmt: skip
        lines += ["### Actuators", table(("actuator", "gain", "bias", "control", "force"), rows)]
    if scene.contacts:
        found = [
            (shown(each.label) or f"contact {i}", shown(scene.body_labels[each.body]).rpartition("/")[2],
             *(float(values[f"contact_{name}"][0, i]) for name in ("friction", "stiffness", "damping")))
            for i, each in enumerate(scene.contacts)
        ]  # fmt: skip
        lines += ["### Contacts", table(("contact", "body", "friction", "N/m", "N s/m"), found)]
    return "\n\n".join(lines)


def _plain(text: str) -> str:
    return "".join(f"\\{c}" if c in "\\`*_<>[]#|" else c for c in " ".join(text.split()))


def _triple(numbers: Any) -> str:
    return ", ".join(f"{float(x):.3g}" for x in numbers)


def _range(low: float, high: float) -> str:
    return "any" if abs(low) >= UNLIMITED and abs(high) >= UNLIMITED else f"{low:.3g} to {high:.3g}"


def _body(scene: Scene, body: int) -> tuple:
    moments = np.linalg.eigvalsh(scene.values["body_inertia"][0, body])
    label, values = shown(scene.body_labels[body]).rpartition("/")[2], scene.values
    return label, float(values["body_mass"][0, body]), _triple(values["body_com"][0, body]), _triple(moments)


def _dof(scene: Scene, dof: int) -> tuple:
    names = ("limit_lower", "limit_upper", "effort_limit", "target_ke", "target_kd", "damping", "friction", "armature")
    numbers = [float(scene.values[f"joint_{name}"][0, dof]) for name in names]
    cells = ["none" if abs(x) >= UNLIMITED else x for x in numbers[:3]]
    return shown(scene.dof_labels[dof]).rpartition("/")[2], *cells, *numbers[3:]
