"""Collision shapes of a MuJoCo model, and the friction that MuJoCo gives them on the ground."""

from __future__ import annotations

import dataclasses
from typing import Any

import mujoco
import numpy as np

from ..scene.collision_shapes import CollisionShape
from ..scene.contact_shapes import SHAPES, kinds_in
from ..scene.contacts import FRICTIONS
from ..scene.ground import HeightField
from ..scene.shape_pairs import ShapePair
from .mechanism import xyzw
from .source import Source

GEOMS = {int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")): name.lower() for name in (
    "PLANE", "HFIELD", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX", "MESH", "SDF")}  # fmt: skip
"""MuJoCo's kinds by number."""
SOFTNESS = {"solref": (0.02, 1.0), "solreffriction": (0.0, 0.0), "solimp": (0.9, 0.95, 0.001, 0.5, 2.0)}
"""How soft a contact of MuJoCo is where a file does not say."""
Pairs = dict[frozenset[int], int]
"""Numbers of explicit pairs by their two geoms."""
KINDS = {"hfield": "height field", **{name.lower(): kind for name, kind in kinds_in("mujoco").items()}}


def collision_shapes(source: Source, moving: np.ndarray) -> list[CollisionShape]:
    """Return the collision shapes of a model, those that explicit pairs name included.

    ``moving`` says which bodies of the scene can move, bool [body]; body k of it is body k + 1 of the model.

    A shape that moves has the friction that it has on the model's ground, if there is one: by the rule of MuJoCo for
    priorities, and zero where the contact has one dimension. Torsional friction takes four dimensions (``condim``),
    rolling friction six. Its rounding is the margin of the contact, the sum of both
    geoms' or that of their pair, because MuJoCo pushes two surfaces apart until they are so far from each other.
    """
    m = source.model
    pairs, solid = explicit_pairs(source), solid_geoms(source)
    still = lambda geom: m.geom_bodyid[geom] == 0 or not moving[m.geom_bodyid[geom] - 1]  # noqa: E731
    grounds = [geom for geom in solid if still(geom) and _name(m, geom) in ("plane", "hfield")]
    found = []
    for geom in solid:
        touched = [ground for ground in grounds if is_explicit_or_masked(source, geom, ground, pairs)]
        if grounds and not still(geom) and not touched:
            continue  # it collides with other things than the ground
        if still(geom):
            found.append(geom_shape(source, geom, None, 0.0))
            continue
        ground = touched[0] if touched else None
        shape = geom_shape(source, geom, None, _margin(source, geom, ground, pairs))
        material = _frictions(source, geom, ground, pairs)
        found.append(dataclasses.replace(shape, **material, unread=_unread_material(source, geom, ground, pairs)))
    return found


def _name(m: Any, geom: int) -> str:
    return GEOMS.get(int(m.geom_type[geom]), f"geom of type {int(m.geom_type[geom])}")


def solid_geoms(source: Source) -> list[int]:
    """Return the geoms that may touch anything, by masks or by a pair."""
    m = source.model
    solid = {int(geom) for geom in np.flatnonzero(m.geom_contype | m.geom_conaffinity)}
    return sorted(solid | {geom for pair in explicit_pairs(source) for geom in pair})


def explicit_pairs(source: Source) -> Pairs:
    """Return the explicit pairs of geoms: number of the pair by its geoms."""
    m = source.model
    return {frozenset((int(m.pair_geom1[i]), int(m.pair_geom2[i]))): i for i in range(m.npair)}


def is_explicit_or_masked(source: Source, geom: int, ground: int, pairs: Pairs) -> bool:
    """Whether MuJoCo makes contacts of two geoms: by a pair, or by masks, unless the file excludes their bodies.

    Geoms of one rigid piece, and of one and its parent, count as any others.
    """
    m = source.model
    if frozenset((geom, ground)) in pairs:
        return True
    if not m.geom_contype[geom] & m.geom_conaffinity[ground] | m.geom_contype[ground] & m.geom_conaffinity[geom]:
        return False
    bodies = sorted((int(m.geom_bodyid[geom]), int(m.geom_bodyid[ground])))
    signatures = {(a << 16) + b for a, b in (bodies, bodies[::-1])}
    return signatures.isdisjoint(m.exclude_signature.tolist())


def pair_of_geoms(source: Source, one: CollisionShape, other: CollisionShape, pairs: Pairs) -> ShapePair:
    """Return two shapes that touch each other with what MuJoCo gives to their contact, in the first of them."""
    a, b = one.index, other.index
    explicit = frozenset((a, b)) in pairs or source.enabled("OVERRIDE")
    margin, lent = (
        (_margin(source, a, b, pairs), 0.0) if explicit else (_margin(source, g, None, pairs) for g in (a, b))
    )
    unread = _unread_material(source, a, b, pairs)
    first = dataclasses.replace(one, **_frictions(source, a, b, pairs), rounding=margin, unread=unread)
    return ShapePair(first, dataclasses.replace(other, rounding=lent))


def _frictions(source: Source, geom: int, ground: int | None, pairs: Pairs) -> dict[str, Any]:
    """Return sliding, torsional and rolling friction of a geom on a ground or another geom, its own without one."""
    m = source.model
    pair = None if ground is None else pairs.get(frozenset((geom, ground)))
    if pair is not None:
        (slide, across, torsional, roll, roll_across), dimensions = m.pair_friction[pair], m.pair_dim[pair]
        for least, word, value, other in ((3, "friction", slide, across), (6, "rolling friction", roll, roll_across)):
            if dimensions >= least and other != value:
                words = f"the {word} {other:g} across of a contact pair of {source.words('geom', geom)}"
                source.left_out.append(f"{words}, which has {value:g} in all directions")
        values = slide, torsional, roll
    else:
        both = _take_by_priority(m, geom, ground)
        values, dimensions = m.geom_friction[both].max(axis=0), m.geom_condim[both].max()
    if source.enabled("OVERRIDE"):
        values = m.opt.o_friction[[0, 2, 3]]
    leasts = zip(FRICTIONS, values, (3, 4, 6), strict=True)
    return {name: float(value) if dimensions >= least else 0.0 for name, value, least in leasts}


def _take_by_priority(m: Any, geom: int, ground: int | None) -> list[int]:
    """Return the geoms of a contact that give it its values: those of the highest priority."""
    both = [geom] if ground is None else [geom, ground]
    priority = max(m.geom_priority[g] for g in both)
    return [g for g in both if m.geom_priority[g] == priority]


def _unread_material(source: Source, geom: int, ground: int | None, pairs: Pairs) -> str:
    """Return which values that MuJoCo gives to a geom's contact with a ground are not its defaults, and not read.

    They are those of the softness, surfaces that move or stick, and a gap below zero, within which nothing pushes.
    """
    m = source.model
    pair = None if ground is None else pairs.get(frozenset((geom, ground)))
    if source.enabled("OVERRIDE"):
        rows = {name: [getattr(m.opt, f"o_{name}")] for name in ("solref", "solimp")}
    elif pair is not None:
        rows = {name: [getattr(m, f"pair_{name}")[pair]] for name in SOFTNESS}
    else:
        rows = {name: getattr(m, f"geom_{name}")[_take_by_priority(m, geom, ground)] for name in ("solref", "solimp")}
    found = [name for name, values in rows.items() if (np.array(values) != SOFTNESS[name]).any()]
    both = [geom] if ground is None else [geom, ground]
    part, elements = ("geom", both) if pair is None else ("pair", [pair])
    surfaces, sticky, gaps = (source.field(name) for name in ("geom_surfacevel", f"{part}_adhesion", f"{part}_gap"))
    found += ["surfacevel"] if surfaces is not None and surfaces[both].any() else []  # MuJoCo 3 has none of the two
    found += ["adhesion"] if sticky is not None and sticky[elements].any() else []
    return ", ".join([*found, "gap"] if gaps is not None and gaps[elements].sum() < 0.0 else found)


def _margin(source: Source, geom: int, ground: int | None, pairs: Pairs) -> float:
    """Return how far apart MuJoCo keeps the surfaces of a geom and a ground [m]; of the geom alone without one."""
    m = source.model
    if source.enabled("OVERRIDE"):
        return float(m.opt.o_margin)
    pair = None if ground is None else pairs.get(frozenset((geom, ground)))
    if pair is not None:
        return float(m.pair_margin[pair])
    return float(sum(m.geom_margin[g] for g in (geom, ground) if g is not None))


def geom_shape(source: Source, geom: int, friction: float | None, margin: float) -> CollisionShape:
    m, kind = source.model, source.missing.get(geom) or _name(source.model, geom)
    names: tuple[str, ...] = ()
    if kind in ("mesh", "hfield"):
        names = (source.name(kind, int(m.geom_dataid[geom])),)
    return CollisionShape(
        source.name("geom", geom) or (names[0] if names else ""),
        int(m.geom_bodyid[geom]) - 1,
        KINDS.get(kind, kind),
        np.concatenate([m.geom_pos[geom], xyzw(m.geom_quat[geom])]),
        () if geom in source.missing else _sizes(m, geom, kind),
        rounding=margin,
        friction=friction,
        names=names,
        index=geom,
    )


def _sizes(m: Any, geom: int, kind: str) -> Any:
    size, data = np.array(m.geom_size[geom]), int(m.geom_dataid[geom])
    if kind == "hfield":
        return _field(m, data)
    if KINDS.get(kind) not in SHAPES:
        return size
    sizes = SHAPES[KINDS[kind]].sizes
    if sizes is None:
        first = int(m.mesh_vertadr[data])
        return np.array(m.mesh_vert[first : first + int(m.mesh_vertnum[data])], dtype=np.float64)
    return size[: len(sizes)]


def _field(m: Any, number: int) -> HeightField:
    """Return a height field about its geom: rows of MuJoCo's data go along y."""
    rows, columns = int(m.hfield_nrow[number]), int(m.hfield_ncol[number])
    first = int(m.hfield_adr[number])
    half_x, half_y, top, _ = (float(x) for x in m.hfield_size[number])
    data = np.array(m.hfield_data[first : first + rows * columns], dtype=np.float64).reshape(rows, columns)
    cells = 2.0 * half_x / (columns - 1), 2.0 * half_y / (rows - 1)
    return HeightField(top * data.T, cells, (-half_x, -half_y))
