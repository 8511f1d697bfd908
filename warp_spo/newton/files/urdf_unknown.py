"""Elements of a URDF, and attributes of its joints and links, that URDF does not define, such as misspelt ones.

They are not read. Names of other programs for shapes, and hints that concern no motion, are left alone.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path

from ...errors import quoted, shown
from .xml_source import XmlElement

JOINT = "name type origin parent child axis calibration dynamics limit mimic safety_controller dont_collapse"
LINK = "name type inertial visual collision contact self_collision_checking collision_checking self_filter surface"
ROBOT = "link joint material gazebo transmission sensor ros2_control mujoco"
"""Elements of a robot that are read, or say nothing about its motion."""
KNOWN = {
    "joint": JOINT,
    "link": LINK,
    "inertial": "origin mass inertia",
    "origin": "xyz rpy quat_xyzw",
    "mass": "value",
    "inertia": "ixx ixy ixz iyy iyz izz",
    "axis": "xyz",
    "dynamics": "damping friction",
    "limit": "lower upper effort velocity",
    "mimic": "joint multiplier offset",
    "parent": "link",
    "child": "link",
}
"""Children and attributes by tag; elements of other tags are not looked into."""
MOST, NAMES = 10, 3  # that the warning shows: things, and joints or links with each


def warn_of_unknown(file: Path, robot: XmlElement, holders: Iterable[XmlElement]) -> None:
    """Warn once of what a robot, its joints and its links hold that URDF does not define.

    ``holders`` are the elements of the joints and links.
    """
    found: dict[str, list[str]] = {}
    for element in robot:
        if element.tag not in ROBOT.split():
            named = [str(element.get("name"))] if element.get("name") else []
            found.setdefault(f"<{shown(element.tag)}>", []).extend(named)
    for holder in holders:
        for words in dict.fromkeys(_unknown(holder)):
            found.setdefault(f"{words} of {holder.tag}s", []).append(str(holder.get("name")))
    if found:
        parts = [f"{words} {_list_some(names)}".rstrip() for words, names in list(found.items())[:MOST]]
        more = f", and {len(found) - MOST} more" if len(found) > MOST else ""
        warnings.warn(
            f"load: {str(file)!r}: left out, because URDF does not define it: {', '.join(parts)}{more}; correct the "
            "names, or pass the values that are meant to scene.with_values",
            UserWarning,
            stacklevel=4,
        )


def _list_some(names: list[str]) -> str:
    more = f" and {len(names) - NAMES} more" if len(names) > NAMES else ""
    return ", ".join(quoted(name) for name in names[:NAMES]) + more


def _unknown(element: XmlElement) -> Iterator[str]:
    """Yield what is unknown in an element and in its known children, such as ``'armature' of <dynamics>``."""
    if element.tag not in KNOWN:
        return
    known = KNOWN[element.tag].split()
    for name in element.keys():
        if name not in known and not name.startswith("xmlns"):
            yield f"'{shown(name)}' of <{element.tag}>" if element.tag not in ("joint", "link") else f"'{shown(name)}'"
    for child in element:
        if child.tag in known:
            yield from _unknown(child)  # type: ignore[arg-type]
        else:
            yield f"<{shown(child.tag)}>"
