"""Scenes from MJCF files, compiled by MuJoCo."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import mujoco

from ..errors import shown
from ..scene.collision_shapes import NONE, ShapeSelection
from ..scene.scene import Scene
from .expansion import check_expansion
from .model import scene_of
from .source import Source


def read_mjcf(file: Path, floating: bool | None, repair: bool = True, selection: ShapeSelection = NONE) -> Scene:
    """Return the scene of an MJCF file; see :func:`warp_spo.load`. ``repair`` changes nothing: MuJoCo repairs nothing.

    Raises:
        xml.etree.ElementTree.ParseError: the file is not XML.
        ValueError: the file is not MJCF, expands without bounds, or MuJoCo refuses it; the message holds MuJoCo's.
        UnsupportedError: as :func:`from_mujoco`; the message names the file, too.
    """
    tag = check_expansion(file)
    if tag != "mujoco":
        raise ValueError(
            f"load: {str(file)!r} holds <{shown(tag)}>; expected <mujoco>; if it is URDF, let its name end in .urdf"
        )
    model, dropped, missing = compiled(file, bool(floating))
    source = Source(model, "load", str(file), missing)
    source.left_out += dropped
    return scene_of(source, floating, selection)


def compiled(file: Path, floating: bool = False) -> tuple[mujoco.MjModel, list[str], dict[int, str]]:
    """Return MuJoCo's model of a file, in words what had to be dropped from it, and by geom what cannot be read of it.

    A file that MuJoCo refuses is compiled again without sensors, skins and textures, and without the meshes and height
    fields that give no body its mass, at last without contact pairs: a scene needs none of them, and files are often
    without them. With ``floating`` bodies without joints move, too, so that their masses count.
    """
    try:
        return mujoco.MjModel.from_xml_path(os.fspath(file)), [], {}
    except REFUSALS as error:
        refusal = one_line(error)
    for unneeded in (UNNEEDED, (*UNNEEDED, *OF_CONTACT)):
        try:
            spec = mujoco.MjSpec.from_file(os.fspath(file))
            dropped, shapeless = _drop(spec, unneeded, floating)
            model = spec.compile()
        except REFUSALS as error:
            last = error
            continue
        missing = {int(geom.id): kind for geom, kind in shapeless}
        return model, [f"{', '.join(dropped)}, with which MuJoCo refuses the file ({refusal})"], missing
    words = one_line(last)
    lost = ", or put that file there" if LOST in words else ""
    if lost and INCLUDE not in words:
        lost += ", or give the body that takes its mass from it an <inertial>"
    raise ValueError(f"load: {str(file)!r}: MuJoCo refuses it: {words}; correct the file{lost}") from None


LOST, INCLUDE = "Error opening file", "Element 'include'"  # MuJoCo's words for a file that is not there, of an element
MOST_LETTERS = 1000  # of MuJoCo's messages, which hold names of the file
REFUSALS = (ValueError, RuntimeError, MemoryError, mujoco.FatalError, mujoco.UnexpectedError)
"""What MuJoCo's compiler raises, of memory that it does not get, too."""


UNNEEDED, OF_CONTACT = ("sensors", "skins", "tuples"), ("pairs", "excludes")


def _drop(spec: Any, unneeded: tuple[str, ...], floating: bool) -> tuple[list[str], list[tuple[Any, str]]]:
    """Take from a specification what changes no mass and no joint.

    Returns:
        In words what it was; and the geoms that lost their shape, with what it was.
    """
    dropped = []
    for name in unneeded:
        elements = list(getattr(spec, name))
        for element in elements:
            spec.delete(element)
        dropped += [f"{len(elements)} {name}"] if elements else []
    textures = list(spec.textures)
    dropped += [f"the pictures of {len(textures)} textures"] if textures else []
    for texture in textures:
        texture.file, texture.cubefiles = "", [""] * 6
        texture.builtin, texture.width, texture.height = mujoco.mjtBuiltin.mjBUILTIN_FLAT, 1, 1
        texture.nchannel = 3
    shapeless = []
    for geom in spec.geoms:
        if (geom.meshname or geom.hfieldname) and _gives_no_mass(spec, geom, floating):
            shapeless.append((geom, f"{'mesh' if geom.meshname else 'height field'} that MuJoCo cannot read"))
            geom.type, geom.size = mujoco.mjtGeom.mjGEOM_SPHERE, [1e-3, 0.0, 0.0]
            geom.meshname = geom.hfieldname = ""
            geom.mass = 0.0
    dropped += [f"the meshes and height fields of {len(shapeless)} geoms"] if shapeless else []
    used = {name for geom in spec.geoms for name in (geom.meshname, geom.hfieldname)}
    for asset in [*spec.meshes, *spec.hfields]:
        if (asset.name or Path(asset.file).stem) not in used:  # MuJoCo's rule for the name of an asset without one
            spec.delete(asset)
    return dropped, shapeless


def _gives_no_mass(spec: Any, geom: Any, floating: bool) -> bool:
    """Whether a geom changes no body that can move: its body stands still, has an <inertial>, or takes none from it."""
    always, never = (
        spec.compiler.inertiafromgeom == getattr(mujoco.mjtInertiaFromGeom, f"mjINERTIAFROMGEOM_{name}")
        for name in ("TRUE", "FALSE")
    )
    first, last = spec.compiler.inertiagrouprange
    if never or 0.0 in (geom.mass, geom.density) or not first <= geom.group <= last:
        return True
    body = geom.parent
    if body.explicitinertial and not always:
        return True
    while body.name != "world":  # whose parent is None in MuJoCo 4 and no body at all in 3.11
        if floating or body.joints:
            return False
        body = body.parent
    return True


def one_line(error: Exception) -> str:
    """Return an error's message in one line that prints, cut where it is long."""
    return shown(" ".join(str(error).split()), MOST_LETTERS)
