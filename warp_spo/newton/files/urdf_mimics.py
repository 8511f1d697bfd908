"""Mimics of a URDF: joints that follow another one, ``q = offset + multiplier * q of the other``."""

from __future__ import annotations

import warnings
from typing import NamedTuple

from ...errors import quoted, shown
from ...scene.parts import Coupling
from ..worlds import quote_labels
from .xml_source import XmlElement

SCALAR = ("revolute", "continuous", "prismatic")
"""Types of joints that may follow another one, or be followed."""


class Mimics(NamedTuple):
    """The mimics of a file.

    Attributes:
        couplings: of joints that follow one that moves; hinge 0 is the base, hinge k + 1 that of joint k.
        held: coordinate [rad or m] at which a joint is held, by index of the joint: those that follow a fixed one.
    """

    couplings: list[Coupling]
    held: dict[int, float]


def read_mimics(joints: list[XmlElement]) -> Mimics:
    """Return what the mimics of all joints say.

    A mimic of a mimic is followed to the joint that moves by itself, or to a fixed one, whose coordinate is always
    zero: the joint is then held at its offset, with a warning. A mimic on a fixed joint says nothing. A mimic of a
    joint that is not there is left out, with a warning.
    """
    by_name = {joint.get("name"): index for index, joint in enumerate(joints)}
    mimics = [joint.child("mimic") if joint.get("type") != "fixed" else None for joint in joints]
    found = Mimics([], {})
    for index, mimic in enumerate(mimics):
        if mimic is None:
            continue
        ratio, offset, leader, seen = 1.0, 0.0, index, [index]
        at: XmlElement | None = mimic
        while at is not None:
            offset, ratio = offset + ratio * at.number("offset", 0.0), ratio * at.number("multiplier", 1.0)
            leader = by_name.get(at.needed("joint"), -1)
            if leader < 0:
                break
            if leader in seen:
                names = quote_labels([str(joints[joint].get("name")) for joint in seen])
                raise at.error(f"joints {names} mimic each other in a circle; let one of them move by itself")
            seen.append(leader)
            at = mimics[leader]
        if leader < 0:
            warnings.warn(
                f"load: {str(mimic.file)!r}, line {mimic.line}: joint {quoted(joints[index].get('name'))} mimics "
                f"{quoted(at.get('joint'))}, which is no joint of the file; it moves by itself; correct the name",  # type: ignore[union-attr]
                UserWarning,
                stacklevel=4,
            )
            continue
        stays = joints[leader].get("type") == "fixed"
        for joint in (joints[index], *([] if stays else [joints[leader]])):
            if joint.get("type") not in SCALAR:
                raise mimic.error(
                    f"ties {quoted(joints[index].get('name'))} to {quoted(joints[leader].get('name'))}; joint "
                    f"{quoted(joint.get('name'))} is {shown(str(joint.get('type')))}; expected one of "
                    f"{', '.join(SCALAR)}; remove the mimic, or make both joints fixed"
                )
        if stays:
            found.held[index] = offset
        else:
            found.couplings.append(Coupling(index + 1, leader + 1, ratio, offset))
    if found.held:
        held = [f"'{shown(str(joints[index].get('name')))}' at {value:g}" for index, value in found.held.items()]
        first = next(iter(found.held))
        warnings.warn(
            f"load: {str(joints[first].file)!r}, line {joints[first].line}: joints that mimic a fixed one are held, "
            f"without a degree of freedom: {', '.join(held[:8])}{f' and {len(held) - 8} more' if held[8:] else ''}; "
            "remove their <mimic>, or let it name a joint that moves",
            UserWarning,
            stacklevel=4,
        )
    return found
