"""URDF files with attributes at random: ``ATTRIBUTES`` are all that concern motion, and what becomes of each.

A file is a root link with five links on joints: a hinge, a slide, one without bounds, one that follows, and one on a
fixed joint; a sphere touches the ground. Shapes themselves are compared in test_file_contacts.py.
"""

import dataclasses
import re
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Callable

import mujoco
import numpy as np

import warp_spo as spo
from benchmarks.robot_files import PinocchioFile, compare_urdf
from support.mjcf_attributes import direction, number, vector, word


@dataclasses.dataclass(frozen=True)
class Attribute:
    """An attribute that a file may have.

    Args:
        element: path of the element, from "link NAME" or "joint NAME". name: its name. draw: returns a value.
        words: of the warning that names it, "": it is right.
    """

    element: str
    name: str
    draw: Callable
    words: str = ""

    def drawn(self, rng):
        """Return the attribute with one value for good."""
        value = self.draw(rng)
        return dataclasses.replace(self, draw=lambda _: value)

    @property
    def named(self):
        """Tags and attribute, without names of links and joints."""
        first, _, rest = self.element.partition("/")
        return f"{first.split()[0]}{'/' if rest else ''}{rest}.{self.name}"


def _of(element, words="", **draws):
    return [Attribute(element, name, draw, words) for name, draw in draws.items()]


MOVING = ("turn", "slide", "endless", "follower")
LINKS = ("root", *MOVING, "held")
MOMENTS = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
TURN, PLACE = vector(3, -2, 2), vector()
ATTRIBUTES = []
for _link in LINKS:
    ATTRIBUTES += _of(f"link {_link}/inertial/origin", xyz=PLACE, rpy=TURN)
    ATTRIBUTES += _of(f"link {_link}/inertial/mass", value=number(0.5, 3))
    ATTRIBUTES += _of(f"link {_link}/inertial/inertia", **dict.fromkeys(MOMENTS, number(0.001, 0.01)))
for _joint in (*MOVING, "held"):
    ATTRIBUTES += _of(f"joint {_joint}/origin", xyz=PLACE, rpy=TURN)
for _joint in MOVING:
    ATTRIBUTES += _of(f"joint {_joint}/axis", xyz=direction())
    ATTRIBUTES += _of(f"joint {_joint}/dynamics", damping=number(0.5, 2), friction=number(0.1, 2))
    ATTRIBUTES += _of(f"joint {_joint}/limit", effort=number(1, 9), velocity=number(1, 9))
    ATTRIBUTES += _of(f"joint {_joint}/parent", link=word("root"))
    SAFETY = dict.fromkeys(("soft_lower_limit", "soft_upper_limit", "k_position", "k_velocity"), number(0.1, 1))
    ATTRIBUTES += _of(f"joint {_joint}/safety_controller", f"<safety_controller> of joints .*'{_joint}'", **SAFETY)
for _joint in ("turn", "slide"):
    ATTRIBUTES += _of(f"joint {_joint}/limit", lower=number(-2, -1), upper=number(1, 2))
ATTRIBUTES += _of("joint follower/mimic", multiplier=number(-3, -1.5), offset=number(0.2, 1), joint=word("slide"))
ATTRIBUTES += _of("link slide/contact/lateral_friction", value=number(0.1, 0.6))


ALWAYS = {
    "link slide/collision/geometry/sphere": {"radius": ".1"},
    "joint follower/mimic": {"joint": "turn"},
}
KINDS = {"turn": "revolute", "slide": "prismatic", "endless": "continuous", "follower": "revolute", "held": "fixed"}
PARENTS = {"turn": "root", "slide": "turn", "endless": "turn", "follower": "slide", "held": "slide"}


def text(rng, chosen):
    """Return the text of a file with some of ``ATTRIBUTES``, of values that a generator draws."""
    robot = ET.Element("robot", name="r")
    parts = {f"link {link}": ET.SubElement(robot, "link", name=link) for link in LINKS}
    for joint, kind in KINDS.items():
        parts[f"joint {joint}"] = ET.SubElement(robot, "joint", name=joint, type=kind)
    always = {f"link {link}/inertial/mass": {"value": "1"} for link in LINKS}
    always |= {
        f"link {link}/inertial/inertia": dict(zip(MOMENTS, (".1", ".12", ".13", "0", "0", "0"), strict=True))
        for link in LINKS
    }
    always |= {f"joint {joint}/parent": {"link": parent} for joint, parent in PARENTS.items()}
    always |= {f"joint {joint}/child": {"link": joint} for joint in PARENTS}
    always |= {f"joint {joint}/axis": {"xyz": "1 0 0"} for joint in MOVING}
    always |= {f"joint {joint}/limit": {"effort": "99", "velocity": "99"} for joint in MOVING}
    always["joint turn/limit"] = {"effort": "99", "velocity": "99", "lower": "-3", "upper": "3"}
    always["joint slide/limit"] = {"effort": "99", "velocity": "99", "lower": "-4", "upper": "4"}
    for path, values in {**always, **ALWAYS}.items():
        _element(parts, path).attrib.update(values)
    for one in chosen:
        _element(parts, one.element).set(one.name, one.draw(rng))
    for controller in robot.iter("safety_controller"):
        controller.attrib.setdefault("k_velocity", "1")  # which Pinocchio wants
    return ET.tostring(robot, encoding="unicode")


def _element(parts, path):
    """Return the element of a path, made if it is not there."""
    if path not in parts:
        above, _, tag = path.rpartition("/")
        parts[path] = ET.SubElement(_element(parts, above), tag)
    return parts[path]


def random_files(seed, files):
    """Yield a generator and a choice of attributes for each of some files; each attribute is in half of them."""
    rng = np.random.default_rng(seed)
    inside = np.array([rng.permutation(files) < (files + 1) // 2 for _ in ATTRIBUTES])
    for file in range(files):
        yield rng, [one for one, within in zip(ATTRIBUTES, inside[:, file], strict=True) if within]


def misreadings(file, chosen):
    """Return in words where the scene of a file is not what Pinocchio and MuJoCo read in it, or does not say so."""
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        scene = spo.load(file, floating=True, repair=False, contacts="ground")
    said = " ".join(str(one.message) for one in found)
    wrong = [f"{one.named} of {one.element} is not named" for one in chosen if not re.search(one.words, said)]
    row = compare_urdf(file)
    wrong += [] if row.agrees else [str(row)]
    content = file.read_text()
    theirs = PinocchioFile(scene, content).model
    of_joint = {label.split("/")[-1]: index for index, label in enumerate(scene.dof_labels)}
    for joint in MOVING:
        dof, one = of_joint[joint], theirs.joints[theirs.getJointId(joint)]
        pairs = {
            "joint_damping": theirs.damping[one.idx_v],
            "joint_friction": theirs.friction[one.idx_v],
            "joint_effort_limit": theirs.effortLimit[one.idx_v],
            "joint_velocity_limit": theirs.velocityLimit[one.idx_v],
        }
        if joint in ("turn", "slide"):
            pairs["joint_limit_lower"] = theirs.lowerPositionLimit[one.idx_q]
            pairs["joint_limit_upper"] = theirs.upperPositionLimit[one.idx_q]
        for name, value in pairs.items():
            if not np.isclose(scene.values[name][0, dof], value, rtol=1e-14):
                wrong.append(f"{name} of {joint}: {scene.values[name][0, dof]}, in Pinocchio {value}")
    model = mujoco.MjModel.from_xml_string(
        re.sub(r"<(collision|inertia) .*?/>|<collision>.*?</collision>", _simplify, content)
    )
    equality, (coupling,) = model.eq_data[0], scene.couplings
    names = [scene.hinges[hinge].label.split("/")[-1] for hinge in (coupling.hinge, coupling.reference)]
    if names != [model.joint(model.eq_obj1id[0]).name, model.joint(model.eq_obj2id[0]).name]:
        wrong.append(f"mimic: {names}")
    if not np.allclose([coupling.offset, coupling.ratio], equality[:2], rtol=1e-14):
        wrong.append(f"mimic: {coupling}, in MuJoCo {equality[:2]}")
    friction = [float(one.draw(None)) for one in chosen if one.name == "value" and "friction" in one.element]
    if not np.allclose([contact.friction for contact in scene.contacts], friction or [0.8]):
        wrong.append("friction of contacts")
    return wrong


def _simplify(found):
    """Collision shapes go; a moment of inertia becomes one that MuJoCo takes."""
    whole = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0" />'
    return whole if found[0].startswith("<inertia") else ""
