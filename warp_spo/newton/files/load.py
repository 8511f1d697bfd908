"""Scenes from robot files, by their format, and the files that come with Newton."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from xml.etree.ElementTree import ParseError

import newton

from ...errors import is_bool, quoted
from ...scene.collision_shapes import POINTS, ShapeSelection
from ...scene.ground import HeightField, Plane
from ...scene.scene import Scene
from .urdf import read_urdf
from .usd import read_usd

FORMATS = {".urdf": "urdf", ".xml": "mjcf", ".mjcf": "mjcf"} | dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), "usd")
"""Format by suffix in lower case."""
WORDS = {"urdf": "a URDF file", "mjcf": "an MJCF file", "usd": "a USD file"}
LONGEST_PATH = 300  # characters of a path in a message


SHIPPED = {
    "humanoid": "nv_humanoid.xml",
    "ant": "nv_ant.xml",
    "quadruped": "quadruped.urdf",
    "cartpole": "cartpole.urdf",
}


def shipped(name: str) -> Path:
    """Return the path of a robot file that comes with Newton.

    They are "humanoid" and "ant", which are MJCF, and "quadruped" and "cartpole", which are URDF.

    Raises:
        ValueError: The name is none of these.
    """
    if name not in SHIPPED:
        raise ValueError(
            f"shipped: unknown robot {name!r}; expected one of {', '.join(SHIPPED)}; "
            "call load(path) for a file of your own"
        )
    return Path(newton.__file__).parent / "examples" / "assets" / SHIPPED[name]


def load(
    path: str | os.PathLike[str],
    floating: bool | None = None,
    repair: bool = True,
    contacts: bool | str | Sequence[str] | Mapping[str, int] | None = None,
    ground: Plane | HeightField | None = None,
    points: int = POINTS,
    pairs: str | Sequence[Sequence[str | int]] | None = None,
) -> Scene:
    """Return the scene of a robot file: URDF (.urdf), MJCF (.xml, .mjcf) or USD (.usd, .usda, .usdc, .usdz).

    MJCF is compiled by MuJoCo, and becomes a scene as by :func:`from_mujoco`, in float64. A URDF is read in float64,
    and the scene has its numbers; order, labels and coordinates are those of Newton's model of the file. The unit of a
    COLLADA mesh counts; that y is up in it counts where the robot's joints bear it out, with a warning. USD is read by
    Newton's importer, in float32. Visual shapes are skipped. Collision shapes are read if ``contacts`` asks for them.
    A mesh file is needed only if a body that can move takes its mass from it, or a contact its points.

    Args:
        path: The robot file.
        floating: Whether the root body floats (True) or is fixed to the world (False). None keeps the format's own
            rule: a URDF root is fixed, an MJCF root has the joints that the file gives it, and a USD root floats unless
            a joint fixes it.
        repair: Whether to replace masses and inertias that no rigid body can have, by Newton's rule: negative ones, an
            inertia that is zero beside a mass, and one whose largest principal moment exceeds the sum of the others.
            In a URDF, links that move as one and have no mass then take it from their collision shapes, 1000 kg/m^3.
            MuJoCo refuses an MJCF file that has such. False keeps the file's numbers; where they make the mass matrix
            singular, results are NaN and ``status=`` says so.
        contacts: Which collision shapes touch the ground in :meth:`Dynamics.step`: None, none; "ground", those of all
            bodies that can move, or none, with a warning, where an MJCF file's options disable contacts; True, these,
            and pairs of bodies touch each other as the file says, see ``pairs``; a pattern such as ``"*foot*"``, or a
            list of patterns, those whose name, or that of their body or mesh, matches (``fnmatch``, in any case; a name
            also by what follows its last slash); or {pattern: points}. ``["ground"]`` is a pattern. The scene's
            ``contacts`` hold the result. A sphere and the ends of a capsule touch with their lowest point, a box with
            its corners. A mesh, a cylinder, a cone and an ellipsoid touch with ``points`` of their surface. Friction is
            the file's: MuJoCo's of the two geoms, Bullet's ``lateral_friction``, Gazebo's ``mu1``, a USD material's;
            0.8 where a file has none. Torsional and rolling friction are MuJoCo's with ``condim`` 4 and 6, and Bullet's
            ``spinning_friction`` and ``rolling_friction``.
        ground: The ground that they touch. None: the file's plane or height field; without one, the plane at height
            zero, but no contacts for contacts="ground" of an MJCF file, which a warning says.
        points: Of a shape that is the hull of points, at most.
        pairs: Which shapes of two bodies touch each other: "all" that the file lets touch, those with shapes that stand
            still, such as a table, included; or a list of pairs of names, patterns of shapes or bodies, such as
            ``[("cube", "*finger*")]``; [], none. None: all with contacts=True, and none otherwise, of which patterns of
            ``contacts`` warn. More than 32 need a scene that is solved in joint space, which one with torsional
            friction on the ground is not; there contacts=True leaves them out, with a warning. An MJCF file lets geoms
            touch by MuJoCo's rules: masks, ``<pair>``, ``<exclude>``, not those of a body and its parent; a URDF all
            but links next to each other, where links that fixed joints connect are one; a USD file by its filters and
            collision groups. Each is one contact with ``other``, see :class:`Contact`; boxes, spheres, capsules and
            convex meshes of up to 64 corners can touch.

    Raises:
        FileNotFoundError: There is no such file.
        TypeError: ``path`` is no path, or another argument is of another type.
        ValueError: The path is that of a folder. Or no importer reads files with this suffix, or the file's contents.
            Of a URDF, the message names the line and the element. Or a pattern of ``contacts`` matches no shape; the
            message lists the bodies with some.
        ImportError: A package for meshes or USD is missing. The message names the extra that installs it.
        UnsupportedError, DirectedLoopError: As :func:`from_newton` and :func:`from_mujoco`.
        UnsupportedError: A pattern of ``contacts`` names a shape that no contact represents, or the file has several
            grounds and ``ground`` does not choose. With contacts="ground", such shapes are left out, with a warning.

    Warns:
        UserWarning: A mass or an inertia was replaced, or taken from shapes. The message names the bodies. A mimic in a
            URDF names no joint of the file and was left out, or names a fixed one, so that its joint is held. Limits of
            a URDF, such as effort="0", stop joints or what drives them. An MJCF file holds contacts, sensors or other
            things that a scene leaves out, and a USD file attributes of physics.
    """
    for name, value, wanted in (("floating", floating, "None, True or False"), ("repair", repair, "True or False")):
        if not is_bool(value) and (name == "repair" or value is not None):
            raise TypeError(f"load: {name} is {quoted(value)}; expected {wanted}")
    file = robot_path(path)
    importer = robot_format(file)
    read: Callable[[Path, bool | None, bool, ShapeSelection], Scene]
    if importer == "mjcf":
        from ...mujoco.mjcf import read_mjcf  # imports the package mujoco, which other formats do not need

        read = read_mjcf
    else:
        read = {"urdf": read_urdf, "usd": read_usd}[importer]
    try:
        return read(file, floating, repair, ShapeSelection(contacts, ground, points, pairs))
    except ParseError as error:
        raise not_xml(file, error, importer) from None
    except ImportError as error:
        extra = "usd" if importer == "usd" else "meshes"
        need = "USD files" if importer == "usd" else "meshes"
        raise ImportError(
            f"load: {str(file)!r} needs a package that is missing ({error}) to read {need}; "
            f"pip install warp_spo[{extra}]"
        ) from error


def robot_path(path: str | os.PathLike[str]) -> Path:
    """Return the path that a caller gives.

    Raises:
        TypeError: It is no path.
        ValueError: It is empty, the text of a robot file, or the path of a folder.
    """
    text = os.fspath(path) if isinstance(path, str | os.PathLike) else None
    if not isinstance(text, str):
        raise TypeError(
            f"load: path is {quoted(path)}; expected the path of a robot file, a str or a pathlib.Path; "
            "from_newton and from_mujoco read models that are in memory"
        )
    if not text:
        raise ValueError("load: path is ''; expected the path of a robot file, such as 'robot.urdf'")
    if text.lstrip().startswith(("<", "#usda")):
        raise ValueError(
            f"load: path is {quoted(text)}, which is a robot description, not a path; write it into a file, and pass "
            "its path"
        )
    if os.path.isdir(text):
        found = sorted(file for file in Path(text).iterdir() if file.suffix.lower() in FORMATS)
        files = [file.name for file in found if file.is_file()]
        inside = f"it holds {', '.join(map(quoted, files[:6]))}" if files else "it holds none"
        more = f" and {len(files) - 6} more" if files[6:] else ""
        raise ValueError(
            f"load: {quoted(text, LONGEST_PATH)} is a folder; expected the path of a robot file in it; {inside}{more}"
        )
    return Path(text)


def robot_format(file: Path) -> str:
    """Return the format of an existing robot file by its suffix: "urdf", "mjcf" or "usd".

    Raises:
        ValueError: The suffix is none of a robot file.
        FileNotFoundError: There is no such file.
    """
    name = FORMATS.get(file.suffix.lower())
    if name is None:
        end, way_out = f"ends in {quoted(file.suffix)}", "export the robot in one of these formats"
        if not file.suffix:
            end, way_out = "has no suffix", "rename the file so that its suffix says its format"
        elif file.suffix.lower() == ".xacro":
            way_out = "expand it first: xacro robot.xacro > robot.urdf"
        raise ValueError(
            f"load: {quoted(str(file), LONGEST_PATH)} {end}; expected one of {', '.join(FORMATS)}; {way_out}"
        )
    if not os.path.isfile(file):  # of a path that is too long, too
        home = ", where ~ is not replaced: pass Path(...).expanduser()" if str(file).startswith("~") else ""
        raise FileNotFoundError(
            f"load: no file {quoted(str(file), LONGEST_PATH)} (from {os.getcwd()!r}{home}); expected the path of "
            f"{WORDS[name]}; call shipped(name) for a robot that comes with Newton"
        )
    return name


def not_xml(file: Path, error: Exception, name: str) -> ValueError:
    """Return the error for a file that should be XML of a format, and is not."""
    root = {"urdf": "<robot>", "mjcf": "<mujoco>"}[name]
    what = f"is not XML: {error}" if os.path.getsize(file) else "is empty"
    return ValueError(
        f"load: {str(file)!r} {what}; expected {WORDS[name]}, whose first element is {root}; correct the file"
    )
