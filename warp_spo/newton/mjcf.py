"""Scenes from MJCF files, read by Newton's importer.

An MJCF tree is searched, includes pasted in, for masses that come from meshes, for gravity, which Newton's importer
does not read, and for features that it misreads. It is written anew where the importer would lose the default class
"main".
"""

from __future__ import annotations

import copy
import dataclasses
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path

import newton
import warp as wp

from ..errors import UnsupportedError
from ..scene.collision_shapes import NONE, Choice, On, Shape, Touches
from ..scene.scene import Scene
from .files.usd import scene_of, unreadable
from .mjcf_differences import MISREAD, find_misread, left_out, mjcf_classes
from .worlds import quote_labels

MASKS = ("contype", "conaffinity")
DEFAULTS = {"contype": 1, "conaffinity": 1, "condim": 3, "geom_priority": 0}
"""Attributes of geoms that the importer reads, and their values where a file gives none."""


def mjcf_tree(file: Path) -> ET.Element:
    """Return the XML tree of an MJCF file with the files that it includes pasted in.

    Raises:
        ET.ParseError: The file, or a file that it includes, is not XML.
        ValueError: The file is XML but not MJCF.
    """
    root = _read_with_includes(file, file.parent)
    if root.tag not in ("mujoco", "mujocoinclude"):
        raise ValueError(
            f"load: {str(file)!r} holds <{root.tag}>; expected <mujoco>; if it is URDF, let its name end in .urdf"
        )
    return root


def _read_with_includes(file: Path, folder: Path, above: tuple[Path, ...] = ()) -> ET.Element:
    """Return the tree of ``file``. Paths in it are relative to ``folder``; the files ``above`` include this one."""
    root = ET.parse(file).getroot()
    for parent in list(root.iter()):
        for index, child in reversed(list(enumerate(parent))):
            included = folder / child.get("file", "") if child.tag == "include" else None
            if included is not None and included.is_file() and included not in above:
                parent[index : index + 1] = list(_read_with_includes(included, folder, (*above, included)))
    return root


def mjcf_needs_meshes(root: ET.Element) -> bool:
    """Whether a body of the MJCF tree takes its mass from meshes: it has a mesh and no <inertial>."""

    def shapes(element: ET.Element) -> list[ET.Element]:
        frames = [shape for frame in element.findall("frame") for shape in shapes(frame)]
        return element.findall("geom") + frames

    always = any(compiler.get("inertiafromgeom") == "true" for compiler in root.findall("compiler"))
    return any(
        (always or body.find("inertial") is None) and any(shape.get("mesh") for shape in shapes(body))
        for body in root.iter("body")
    )


def mjcf_gravity(root: ET.Element) -> list[float] | None:
    """Return the gravity [m/s^2] that the MJCF tree sets, the last one if there are several, None if there is none."""
    if root.find("option/flag[@gravity='disable']") is not None:
        return [0.0, 0.0, 0.0]
    options = root.findall("option[@gravity]")
    return [float(g) for g in options[-1].get("gravity", "").split()] if options else None


def contact_rule(root: ET.Element, builder: newton.ModelBuilder) -> Touches:
    """Return a function that says by MuJoCo's rules whether a shape of an MJCF file touches a ground of it.

    A <pair> of their geoms counts first, then an <exclude> of the body and the world, which Newton 1.8 does not read,
    then the masks of both. Shapes of pairs get a group in the builder, so that they collide whatever their masks say.
    """
    pairs = _pairs(root)
    for i, label in enumerate(builder.shape_label):
        if any(name(label) in pair for pair in pairs):
            builder.shape_collision_group[i] = 1
    excludes = [{exclude.get("body1"), exclude.get("body2")} for exclude in root.iterfind("contact/exclude")]
    parted = {body for bodies in excludes if "world" in bodies for body in bodies}
    own = _attributes(builder)

    def touches(shape: Shape, ground: Shape) -> bool:
        if frozenset((name(shape.label), name(ground.label))) in pairs:
            return True
        if name(shape.label.rpartition("/")[0]) in parted:
            return False
        one, other = ([own(each, mask) for mask in MASKS] for each in (shape, ground))
        return bool(one[0] & other[1] | other[0] & one[1])

    return touches


def material_rule(root: ET.Element, builder: newton.ModelBuilder) -> On:
    """Return a function that gives a shape the friction and the margin that MuJoCo gives it on a ground.

    The friction is that of the geom of higher priority, or the larger of both; zero where a contact has one dimension.
    A <pair> has its own, whatever its geoms have.
    """
    pairs, own = _pairs(root), _attributes(builder)

    def on(shape: Shape, ground: Shape | None) -> Shape:
        both = [shape] if ground is None else [shape, ground]
        pair = pairs.get(frozenset(name(each.label) for each in both))
        if ground is not None and pair is not None:
            value, dimensions = float((pair.get("friction") or "1").split()[0]), int(pair.get("condim", 3))
            rounding = float(pair.get("margin", 0.0)) - ground.rounding  # that of the ground is in its height
            if rounding < 0.0 and (shape.kind not in ("sphere", "capsule") or shape.sizes[0] + rounding < 0.0):
                what = (
                    f"the contact pair of geom {name(shape.label)!r}, whose margin is smaller than that of the ground,"
                )
                raise UnsupportedError("load", what, "install the package mujoco, or give it the ground's")
            shape = dataclasses.replace(shape, rounding=rounding)
        else:
            first = max(own(each, "geom_priority") for each in both)
            count = [each for each in both if own(each, "geom_priority") == first]
            value, dimensions = max(each.friction or 0.0 for each in count), max(own(each, "condim") for each in count)
        return dataclasses.replace(shape, friction=value if dimensions > 1 else 0.0)

    return on


def name(label: str) -> str:
    """Return the name of an element by its label."""
    return label.rpartition("/")[2]


def _pairs(root: ET.Element) -> dict[frozenset[str], dict[str, str]]:
    """Return the attributes of the explicit pairs of an MJCF tree, those of their classes included, by their geoms."""
    classes = mjcf_classes(root)
    found = {}
    for pair in root.iterfind("contact/pair"):
        defaults = classes.get(pair.get("class", "main"), {}).get("pair", {})
        found[frozenset((pair.get("geom1", ""), pair.get("geom2", "")))] = defaults | pair.attrib
    return found


def _attributes(builder: newton.ModelBuilder) -> Callable[[Shape, str], int]:
    """Return a function that returns one of the DEFAULTS of a shape."""
    held = {each: builder.custom_attributes.get(f"mujoco:{each}") for each in DEFAULTS}
    given = {each: {} if one is None else dict(one.values or {}) for each, one in held.items()}
    return lambda shape, each: int(given[each].get(shape.index, DEFAULTS[each]))


def mjcf_disables_contacts(root: ET.Element) -> bool:
    """Whether the options of the MJCF tree disable contacts, or all constraints."""
    return any(root.find(f"option/flag[@{flag}='disable']") is not None for flag in ("contact", "constraint"))


def mjcf_source(file: Path, root: ET.Element) -> str:
    """Return the source for an MJCF importer: the path of the file, or text in which "main" is a class like others.

    Newton 1.8 applies the outermost <default> to all elements only if it has no class, and then it has no class "main"
    by which an element could opt out of its childclass. Of several outermost <default> it forgets elements that a later
    one has, too. The text has one outermost <default> without a class, which holds the elements of all those in the
    file, and an empty class "main" inside it. An importer that reads text has no folder in which to look for meshes.
    """
    named = any(default.get("class") == "main" for default in root.findall("default"))
    asked = any("main" in (element.get("class"), element.get("childclass")) for element in root.iter())
    outermost_defaults = root.findall("default")
    if not named and not (asked and outermost_defaults) and len(outermost_defaults) < 2:
        return str(file)
    root = copy.deepcopy(root)
    outermost = ET.Element("default")
    for default in root.findall("default"):
        root.remove(default)
        for element in default:
            earlier = None if element.tag == "default" else outermost.find(element.tag)
            if earlier is None:
                outermost.append(element)
            else:
                earlier.attrib.update(element.attrib)
    ET.SubElement(outermost, "default", {"class": "main"})
    root.insert(0, outermost)
    return ET.tostring(root, encoding="unicode")


def read_mjcf(file: Path, floating: bool | None, repair: bool, choice: Choice = NONE) -> Scene:
    """Return the scene of an MJCF file; UnsupportedError if it uses a feature that Newton misreads."""
    root = mjcf_tree(file)
    try:
        misread = find_misread(root, floating)
        gravity = mjcf_gravity(root)  # Newton 1.8 does not read it
    except ValueError as error:
        raise ValueError(f"load: {str(file)!r}: {error}; expected numbers; correct them") from error
    if misread:
        features = [f"{feature} ({_holder(feature)} {quote_labels(where)})" for feature, where in misread.items()]
        ways_out = dict.fromkeys(MISREAD[feature] for feature in misread)
        raise UnsupportedError("load", f"{str(file)!r} with {', '.join(features)}", "; ".join(ways_out))
    if choice.contacts is not None and choice.ground is None and root.find("worldbody//geom[@hfield]") is not None:
        what = f"contacts= of {str(file)!r}, which has a height field that Newton's importer does not read,"
        raise UnsupportedError("load", what, "install the package mujoco, or pass ground=spo.HeightField(...)")
    builder = _import(file, root, floating, choice.contacts is not None)
    if gravity is not None:
        builder.gravity = gravity
    lost = [what for what in left_out(root) if choice.contacts is None or "ground plane" not in what]
    choice, disabled = choice.unless(mjcf_disables_contacts(root))
    if disabled:
        warnings.warn(f"load: {str(file)!r}: left out: {disabled[0]}", UserWarning, stacklevel=3)
    if lost:
        warnings.warn(
            f"load: {str(file)!r}: {', '.join(lost)} left out; install the package mujoco, with which load reads "
            "actuators, keyframes and sites",
            UserWarning,
            stacklevel=3,
        )
    return scene_of(file, builder, repair, choice, contact_rule(root, builder), material_rule(root, builder))


def _import(file: Path, root: ET.Element, floating: bool | None, contacts: bool) -> newton.ModelBuilder:
    """Return the builder into which Newton's importer read a file; meshes are read for masses and for contacts."""
    source = mjcf_source(file, root)
    needs_meshes = mjcf_needs_meshes(root) or (contacts and root.find(".//geom[@mesh]") is not None)
    if needs_meshes and source != str(file):
        raise UnsupportedError(
            "load",
            f"{str(file)!r} with a default class 'main' beside masses from meshes, or two outermost <default>,",
            "remove class='main', which the outermost <default> has anyway, put all into one <default>, or write the "
            "<inertial> of each body",
        )

    def import_with(parse_mujoco_options: bool) -> newton.ModelBuilder:
        builder = newton.ModelBuilder()
        for mask in MASKS:  # which the importer reads where the builder knows them
            builder.add_custom_attribute(
                newton.ModelBuilder.CustomAttribute(
                    mask, wp.int64, newton.Model.AttributeFrequency.SHAPE, namespace="mujoco", default=DEFAULTS[mask]
                )
            )
        builder.add_mjcf(
            source,
            floating=floating,
            parse_visuals=False,
            parse_meshes=needs_meshes,
            parse_mujoco_options=parse_mujoco_options,
        )
        return builder

    try:
        return import_with(parse_mujoco_options=True)
    except ValueError as error:
        # Newton 1.8 cannot read some of MuJoCo's options, such as gymnasium's solver="pgs"; a scene needs none of them.
        try:
            return import_with(parse_mujoco_options=False)
        except ValueError:
            raise unreadable(file, error) from error
    except (ImportError, ET.ParseError):
        raise
    except Exception as error:
        raise unreadable(file, error) from error


def _holder(feature: str) -> str:
    """Return what the names stand for that :func:`find_misread` gives for a feature."""
    return "class" if "<default>" in feature else "actuator" if "actuator" in feature else "body"
