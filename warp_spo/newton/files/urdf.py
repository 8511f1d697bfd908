"""Scenes from URDF files, read in float64.

Bodies, hinges, their order and their labels are those of Newton's ``add_urdf``: joints depth first from the root link,
joints of one parent in the order of the file; bodies in the order of the joints that carry them. Masses, inertias,
origins and axes are the file's numbers. Where Newton 1.8 reads something else than URDF says, URDF counts: a link
without <inertial> has no mass, a "continuous" joint has no limits, and a "planar" joint turns about its normal, too.
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Container
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import UnsupportedError, quoted
from ...scene.collision_shapes import NONE, CollisionShape, ShapeSelection
from ...scene.parts import UNLIMITED, Body, Hinge
from ...scene.scene import Scene
from ..worlds import quote_labels
from .inertia_repair import repair_bodies
from .urdf_masses import mass_of_shapes
from .urdf_mimics import SCALAR, read_mimics
from .urdf_shapes import check_for_mass, urdf_pairs, urdf_shapes
from .urdf_unknown import warn_of_unknown
from .urdf_up_axis import turn_meshes
from .xml_source import XmlElement, read_xml

KINDS = {
    "fixed": "fixed",
    "revolute": "revolute",
    "continuous": "revolute",
    "prismatic": "prismatic",
    "planar": "planar",
    "floating": "free",
    "spherical": "ball",  # of Bullet and MuJoCo, not of URDF
}
"""Hinge of a scene by type of the joint."""
LIMITS = ("lower", "upper", "effort", "velocity")
LIMIT_WARNINGS = {
    "effort": 'effort="0" of joints {} lets no drive, actuator or effort action push them; pass the bound that is '
    "meant, or 1e6 for none, to scene.with_values(joint_effort_limit=...)",
    "velocity": 'velocity="0" of joints {} holds them still; pass the bound that is meant, or 1e6 for none, to '
    "scene.with_values(joint_velocity_limit=...)",
    "span": "lower = upper of joints {} holds them there; pass the range that is meant to "
    "scene.with_values(joint_limit_lower=..., joint_limit_upper=...)",
    "unread": "left out: the <limit> of joints {}, which are planar, floating or spherical; "
    "pass limits of their degrees of freedom to scene.with_values",
    "safety": "left out: the <safety_controller> of joints {}, which bounds what a controller commands; bound it there",
}
"""Words about joints whose <limit> stops them, and whose <limit> or <safety_controller> is not read."""
NO_LIMITS: dict[str, Any] = {"limit_ke": 0.0, "limit_kd": 0.0}  # of free and ball hinges, as in Newton
QUARTER = np.pi / 2
TYPED = 5e-10  # an angle this close to a multiple of a quarter turn [rad] is one that was written with ten digits
Inertial = tuple[float, np.ndarray, np.ndarray]  # mass [kg], centre of mass [m, 3], inertia about it [kg m^2, 3 x 3]


def read_urdf(file: Path, floating: bool | None, repair: bool, selection: ShapeSelection = NONE) -> Scene:
    """Return the scene of a URDF file. See :func:`warp_spo.newton.load`.

    Raises:
        xml.etree.ElementTree.ParseError: The file is not XML.
        ValueError: The file is not a URDF; the message names line and element.
        UnsupportedError: The file needs xacro first.
    """
    robot = read_xml(file)
    _check_robot(robot)
    links, joints = _by_name(robot, "link"), _by_name(robot, "joint")
    root, carried = _sort_joints(robot, links, joints)

    name = robot.get("name")
    label = lambda part: f"{name}/{part}" if name else part  # noqa: E731
    kind, base_name = ("free", "floating_base") if floating else ("fixed", "fixed_base")
    base = Hinge(kind, -1, 0, label=label(base_name), **NO_LIMITS)
    number = {link: index for index, link in enumerate([root, *(_ends(joint)[1] for joint in carried)])}
    couplings, held = read_mimics(carried)
    hinges = [base, *(_hinge(joint, number, label, held.get(index)) for index, joint in enumerate(carried))]
    _warn_of_limits(carried, held)
    warn_of_unknown(file, robot, [*carried, *links.values()])
    inertials = _inertials([links[link] for link in number], hinges, repair)
    masses, inertias = [i[0] for i in inertials], [i[2] for i in inertials]
    try:
        if repair:
            masses, inertias = repair_bodies(list(map(label, number)), masses, inertias, depth=3)
        bodies = [
            Body(mass, com, inertia, label(link), any_inertia=not repair)
            for mass, (_, com, _), inertia, link in zip(masses, inertials, inertias, number, strict=True)
        ]
        scene = Scene(bodies, hinges, couplings=couplings)
    except ValueError as error:
        raise ValueError(f"load: {str(file)!r}: {error}") from error
    ordered = [links[link] for link in number]
    call = f"load: {str(file)!r}"
    turned = list[str]()

    @functools.cache
    def shapes() -> list[CollisionShape]:
        turned.append(turn_meshes(robot, origin_of))
        return urdf_shapes(robot, ordered, list(map(label, number)), origin_of)

    scene, lost = selection.apply(call, scene, shapes, pairs=lambda: urdf_pairs(call, scene, shapes()))
    if any(turned):
        warnings.warn(f"{call}: {turned[0]}", UserWarning, stacklevel=3)
    if lost:
        warnings.warn(f"{call}: left out: {', '.join(lost)}", UserWarning, stacklevel=3)
    return scene


def _check_robot(robot: XmlElement) -> None:
    """Raise an error unless the root element is that of a URDF with links."""
    if robot.tag != "robot":
        raise robot.error("the outermost element; expected <robot>; if it is MJCF, let its name end in .xml")
    for element in robot.iter():
        if element.tag.startswith("xacro:"):
            raise UnsupportedError(
                "load",
                f"{str(robot.file)!r}, line {element.line}: <{element.tag}>",  # type: ignore[attr-defined]
                "expand the file first: xacro FILE > robot.urdf",
            )
    if robot.find("link") is None:
        raise robot.error("no <link>; expected one or more; a file made by xacro is empty if its macro is never called")


def _by_name(robot: XmlElement, tag: str) -> dict[str, XmlElement]:
    """Return the robot's links or joints by name."""
    found: dict[str, XmlElement] = {}
    parts: list[Any] = robot.findall(tag)
    for element in parts:
        if found.setdefault(element.needed("name"), element) is not element:
            earlier = found[element.needed("name")].line
            raise element.error(f"the name is that of line {earlier}, too; expected different names; rename one")
    return found


def _ends(joint: XmlElement) -> tuple[str, str]:
    """Return the names of a joint's parent link and child link."""
    ends = [joint.child(tag) for tag in ("parent", "child")]
    for tag, end in zip(("parent", "child"), ends, strict=True):
        if end is None:
            raise joint.error(f"no <{tag}>; expected the link that it joins; write <{tag} link=...>")
    return ends[0].needed("link"), ends[1].needed("link")  # type: ignore[union-attr]


def _sort_joints(
    robot: XmlElement, links: dict[str, XmlElement], joints: dict[str, XmlElement]
) -> tuple[str, list[XmlElement]]:
    """Return the root link and the joints depth first from it; raise ValueError unless all links form one tree."""
    carriers: dict[str, XmlElement] = {}
    below: dict[str, list[XmlElement]] = {link: [] for link in links}
    for joint in joints.values():
        parent, child = _ends(joint)
        for link in (parent, child):
            if link not in links:
                raise joint.error(f"there is no link {quoted(link)}; expected one of the file's; correct the name")
        if carriers.setdefault(child, joint) is not joint:
            raise joint.error(
                f"link {quoted(child)} is the child of joint {quoted(carriers[child].get('name'))}, too; expected one "
                "joint a link; build a closed loop with Scene(loops=...)"
            )
        below[parent].append(joint)

    roots = [link for link in links if link not in carriers]
    if len(roots) > 1:
        raise links[roots[1]].error(
            f"links {quote_labels(roots)} are the child of no joint; expected one root link, so that all links form "
            "one tree; join them (type='fixed'), or load one file a robot"
        )
    order: list[XmlElement] = []
    rest = [joint for root in roots for joint in reversed(below[root])]
    while rest:
        order.append(rest.pop())
        rest += reversed(below[_ends(order[-1])[1]])
    if len(order) < len(joints):
        lost = next(joint for joint in joints.values() if joint not in order)
        raise lost.error("the joint is part of a directed loop of joints; expected a tree; swap its parent and child")
    return roots[0], order


# -- joints ------------------------------------------------------------------------------------------------------------
def _hinge(joint: XmlElement, number: dict[str, int], label: Callable[[str], str], held: float | None) -> Hinge:
    """Return the hinge of a joint; ``number`` is the index of each link's body.

    ``held`` is the coordinate at which the joint is fixed, None if it moves.
    """
    kind, (parent, child) = joint.needed("type"), _ends(joint)
    if kind not in KINDS:
        raise joint.error(f"the type is {quoted(kind)}; expected one of {', '.join(KINDS)}")
    values: dict[str, Any] = _resistances(joint) if kind != "fixed" else {}
    if kind in ("floating", "spherical"):
        values |= NO_LIMITS
    if kind == "floating" and any(values.values()):
        raise joint.error("has damping or friction; expected none of a floating joint; remove <dynamics>")
    if kind in (*SCALAR, "planar"):
        axis = _axis(joint)
        values["axis"] = _in_plane(axis) if kind == "planar" else axis
    if kind in SCALAR:
        values |= _limits(joint, kind)
    position, turn = origin_of(joint)
    if held is not None:
        position, turn = _move_child(position, turn, kind, _axis(joint), held)
        kind, values = "fixed", {}
    pose = np.concatenate([position, turn])
    try:
        return Hinge(
            KINDS[kind], number[parent], number[child], parent_pose=pose, label=label(joint.needed("name")), **values
        )
    except ValueError as error:
        raise joint.error(str(error)) from error


def origin_of(holder: XmlElement) -> tuple[np.ndarray, np.ndarray]:
    """Return the position [m, 3] and the unit quaternion (xyzw) that an element's <origin> gives."""
    origin = holder.child("origin")
    if origin is None:
        return np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
    if origin.get("quat_xyzw"):
        raise origin.error("quat_xyzw is not read; expected rpy; write the rotation as rpy")
    roll, pitch, yaw = origin.numbers("rpy", 3, (0.0, 0.0, 0.0))
    (x, w), (y, v), (z, u) = (_half(angle) for angle in (roll, pitch, yaw))
    # The product of the turns about z, y and x: each is (sine of the half angle along its axis, cosine).
    quaternion = [u * v * x - z * y * w, u * y * w + z * v * x, z * v * w - u * y * x, u * v * w + z * y * x]
    return origin.numbers("xyz", 3, (0.0, 0.0, 0.0)), np.array(quaternion)


def _move_child(
    position: np.ndarray, turn: np.ndarray, kind: str, axis: np.ndarray, q: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the position and the unit quaternion of a joint's child where the joint's coordinate is ``q``."""
    if kind == "prismatic":
        return position + _rotation(turn) @ axis * q, turn
    (v, w), (sine, cosine) = (turn[:3], turn[3]), _half(q)
    u = sine * axis
    return position, np.append(w * u + cosine * v + np.cross(v, u), w * cosine - v @ u)


def _half(angle: float) -> tuple[float, float]:
    """Return the sine and cosine of half an angle; 1.57079632679 is a quarter turn, so that its zeros are zeros."""
    quarter = round(angle / QUARTER) * QUARTER
    half = 0.5 * (quarter if abs(angle - quarter) < TYPED else angle)
    return float(np.sin(half)), float(np.cos(half))


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation matrix of a unit quaternion (xyzw)."""
    v, w = quaternion[:3], quaternion[3]
    cross = np.cross(np.eye(3), v)  # cross @ a = v x a
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross


def _axis(joint: XmlElement) -> np.ndarray:
    """Return the unit vector along a joint's <axis>; x where there is none."""
    element = joint.child("axis")
    if element is None:
        return np.array([1.0, 0.0, 0.0])
    axis = element.numbers("xyz", 3)
    if not axis.any():
        raise element.error("xyz is the zero vector; expected a direction")
    axis /= np.abs(axis).max()  # so that squares are in range
    return axis / np.linalg.norm(axis)


def _in_plane(normal: np.ndarray) -> list[np.ndarray]:
    """Return two unit vectors that complete a normal to a right-handed frame, those of Newton's planar joint."""
    helper = np.array([1.0, 0.0, 0.0] if np.allclose(normal, [0.0, 1.0, 0.0]) else [0.0, 1.0, 0.0])
    first = np.cross(helper, normal)
    if not first.any():  # the normal is -y
        first = np.array([1.0, 0.0, 0.0])
    first /= np.linalg.norm(first)
    return [first, np.cross(normal, first)]


def _resistances(joint: XmlElement) -> dict[str, float]:
    """Return the damping [N m s/rad or N s/m] and the dry friction [N m or N] of a joint."""
    dynamics = joint.child("dynamics")
    return {} if dynamics is None else {name: dynamics.number(name, 0.0, least=0.0) for name in ("damping", "friction")}


def _limits(joint: XmlElement, kind: str) -> dict[str, float]:
    """Return the limits of a joint, in the names of :class:`Hinge`.

    If one bound is absent it is zero, as URDF says. If both are absent, the joint has no limits, as in Newton.
    """
    limit, found = joint.child("limit"), {}
    if limit is None:
        return {}
    for name in ("effort", "velocity"):
        if limit.get(name) is not None:
            found[f"{name}_limit"] = min(limit.number(name, least=0.0, infinite=True), UNLIMITED)
    if kind != "continuous" and (limit.get("lower") is not None or limit.get("upper") is not None):
        lower, upper = (limit.number(name, 0.0, infinite=True) for name in ("lower", "upper"))
        if lower > upper:
            absent = " (an absent one is 0)" if None in (limit.get("lower"), limit.get("upper")) else ""
            raise limit.error(
                f"of joint {quoted(joint.get('name'))}: lower is {lower:g}, above upper {upper:g}{absent}; "
                "expected lower <= upper; swap them"
            )
        found["limit_lower"], found["limit_upper"] = np.clip([lower, upper], -UNLIMITED, UNLIMITED).tolist()
    return found


def _warn_of_limits(joints: list[XmlElement], held: Container[int]) -> None:
    """Warn once of limits that stop joints or what drives them, and of limits that are not read; name the joints.

    ``held`` are the indices of joints that have no degree of freedom.
    """
    found: dict[str, list[str]] = {name: [] for name in LIMIT_WARNINGS}
    for index, joint in enumerate(joints):
        limit, kind = joint.child("limit"), joint.get("type")
        if kind == "fixed" or index in held:
            continue
        if joint.find("safety_controller") is not None:
            found["safety"].append(str(joint.get("name")))
        if limit is None:
            continue
        given = {name: limit.number(name, infinite=True) for name in LIMITS if limit.get(name) is not None}
        if kind not in SCALAR:
            said = ["unread"] if any(given.values()) else []
        else:
            said = [name for name in ("effort", "velocity") if given.get(name) == 0.0]
            spans = kind != "continuous" and "lower" in given and given["lower"] == given.get("upper")
            said += ["span"] if spans else []
        for name in said:
            found[name].append(str(joint.get("name")))
    parts = [LIMIT_WARNINGS[name].format(quote_labels(names)) for name, names in found.items() if names]
    if parts:
        warnings.warn(f"load: {str(joints[0].file)!r}: {'; '.join(parts)}", UserWarning, stacklevel=4)


# -- links -------------------------------------------------------------------------------------------------------------
def _inertials(links: list[XmlElement], hinges: list[Hinge], repair: bool) -> list[Inertial]:
    """Return mass, centre of mass and inertia of each link, of which hinge k carries link k.

    Links that fixed joints join move as one. If no link of such a group has a mass, and with ``repair`` alone, the
    collision shapes of its links without <inertial> give one, as in Newton. A warning says so if the group moves; if
    it does not move, meshes are left out, so that their files are not needed.
    """
    inertials = [_inertial(link) for link in links]
    group = list(range(len(links)))
    for child, hinge in enumerate(hinges):
        if child and hinge.kind == "fixed":
            group[child] = group[hinge.parent]
    weights = np.bincount(group, [abs(inertial[0]) for inertial in inertials], len(links))
    weighed = []
    for index, link in enumerate(links):
        moves = hinges[group[index]].dof_count > 0
        shapes = link.findall("collision")
        if not repair or weights[group[index]] != 0.0 or not shapes or link.find("inertial") is not None:
            continue
        if moves or link.find("collision//mesh") is None:
            if moves:
                check_for_mass(link)
            inertials[index] = mass_of_shapes(link)
            weighed += [link] * moves
    if weighed:
        names = quote_labels([str(link.get("name")) for link in weighed])
        warnings.warn(
            f"load: {str(links[0].file)!r}, line {weighed[0].line}: links {names} move and have no mass; their "
            "collision shapes give them one, with 1000 kg/m^3 as in Newton; write their <inertial>, or keep them "
            "massless with load(path, repair=False)",
            UserWarning,
            stacklevel=4,
        )
    return inertials


def _inertial(link: XmlElement) -> Inertial:
    """Return the mass, the centre of mass and the inertia about it that a link's <inertial> gives; zeros without."""
    inertial = link.child("inertial")
    if inertial is None:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    parts = [inertial.child(tag) for tag in ("mass", "inertia")]
    for tag, part in zip(("mass", "inertia"), parts, strict=True):
        if part is None:
            raise inertial.error(
                f"of link {quoted(link.get('name'))}: no <{tag}>; expected <mass> and <inertia>; write it"
            )
    mass, tensor = (part for part in parts if part is not None)
    xx, xy, xz, yy, yz, zz = (tensor.number(f"i{name}") for name in ("xx", "xy", "xz", "yy", "yz", "zz"))
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    com, turn = origin_of(inertial)
    rotation = _rotation(turn)
    return mass.number("value"), com, inertia if turn[3] == 1.0 else rotation @ inertia @ rotation.T
