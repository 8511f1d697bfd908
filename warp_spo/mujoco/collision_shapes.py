"""Collision shapes of a MuJoCo model, and the friction that MuJoCo gives them on the ground."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import mujoco
import numpy as np

from ..scene.collision_shapes import CollisionShape
from ..scene.contact_shapes import SHAPES, kinds_in
from ..scene.contacts import FRICTIONS
from ..scene.ground import HeightField
from .mechanism import xyzw
from .source import Source

GEOMS = {int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")): name.lower() for name in (
    "PLANE", "HFIELD", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX", "MESH", "SDF")}  # fmt: skip
"""MuJoCo's kinds by number."""
SOFTNESS = {"solref": (0.02, 1.0), "solreffriction": (0.0, 0.0), "solimp": (0.9, 0.95, 0.001, 0.5, 2.0)}
"""How soft a contact of MuJoCo is where a file does not say."""
Pairs = dict[frozenset[int], int]  # number of an explicit pair by its two geoms
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
    pairs = _pairs(source)
    solid = {int(geom) for geom in np.flatnonzero(m.geom_contype | m.geom_conaffinity)}
    solid |= {geom for pair in pairs for geom in pair}
    still = lambda geom: m.geom_bodyid[geom] == 0 or not moving[m.geom_bodyid[geom] - 1]  # noqa: E731
    grounds = [geom for geom in sorted(solid) if still(geom) and _name(m, geom) in ("plane", "hfield")]
    found = []
    for geom in sorted(solid):
        touched = [ground for ground in grounds if _touches(source, geom, ground, pairs)]
        if grounds and not still(geom) and not touched:
            continue  # it collides with other things than the ground
        if still(geom):
            found.append(_shape(source, geom, None, 0.0))
            continue
        ground = touched[0] if touched else None
        shape = _shape(source, geom, None, _margin(source, geom, ground, pairs))
        material = _frictions(source, geom, ground, pairs)
        found.append(dataclasses.replace(shape, **material, unread=_unread_softness(source, geom, ground, pairs)))
    return found


def _name(m: Any, geom: int) -> str:
    return GEOMS.get(int(m.geom_type[geom]), f"geom of type {int(m.geom_type[geom])}")


def _pairs(source: Source) -> Pairs:
    """Return the explicit pairs of geoms: number of the pair by its geoms."""
    m = source.model
    return {frozenset((int(m.pair_geom1[i]), int(m.pair_geom2[i]))): i for i in range(m.npair)}


def _touches(source: Source, geom: int, ground: int, pairs: Pairs) -> bool:
    """Whether MuJoCo makes contacts of a geom with a geom of the world: by masks or by a pair, unless excluded."""
    m = source.model
    if frozenset((geom, ground)) in pairs:
        return True
    body, other = sorted((int(m.geom_bodyid[geom]), int(m.geom_bodyid[ground])))
    if (body << 16) + other in m.exclude_signature.tolist() or (other << 16) + body in m.exclude_signature.tolist():
        return False
    return bool(m.geom_contype[geom] & m.geom_conaffinity[ground] | m.geom_contype[ground] & m.geom_conaffinity[geom])


def touching_bodies(source: Source, moving: np.ndarray) -> tuple[int, int] | None:
    """Return two geoms, of two bodies that move, that MuJoCo lets touch each other; None where there are none.

    Explicit pairs count, then masks, by MuJoCo's rules: not of one rigid piece, nor of a piece and its parent, unless
    the file disables ``filterparent``, nor of bodies that ``<exclude>`` names.
    """
    m, piece = source.model, np.array(source.model.body_weldid)
    above = piece[m.body_parentid[piece]]
    moves = np.concatenate([[False], moving[: m.nbody - 1]])[m.geom_bodyid]
    for one, other in ((int(a), int(b)) for a, b in zip(m.pair_geom1, m.pair_geom2, strict=True)):
        if moves[one] and moves[other] and piece[m.geom_bodyid[one]] != piece[m.geom_bodyid[other]]:
            return one, other
    excluded = {frozenset(divmod(int(pair), 1 << 16)) for pair in m.exclude_signature}
    kinds: dict[tuple[int, int], dict[int, int]] = {}  # by masks: a geom of each body
    for geom in np.flatnonzero((m.geom_contype | m.geom_conaffinity).astype(bool) & moves):
        masks = int(m.geom_contype[geom]), int(m.geom_conaffinity[geom])
        kinds.setdefault(masks, {}).setdefault(int(m.geom_bodyid[geom]), int(geom))
    for (a, b), (c, d) in itertools.combinations_with_replacement(kinds, 2):
        if not (a & d or b & c):
            continue
        for one, other in itertools.product(kinds[a, b], kinds[c, d]):  # all but a few of them may touch: soon found
            first, second = int(piece[one]), int(piece[other])
            related = not source.disabled("FILTERPARENT") and (above[one] == second or above[other] == first)
            if first != second and not related and frozenset((one, other)) not in excluded:
                return kinds[a, b][one], kinds[c, d][other]
    return None


def _frictions(source: Source, geom: int, ground: int | None, pairs: Pairs) -> dict[str, Any]:
    """Return sliding, torsional and rolling friction of a geom on a ground, its own without one."""
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
        both = _counting(m, geom, ground)
        values, dimensions = m.geom_friction[both].max(axis=0), m.geom_condim[both].max()
    if source.enabled("OVERRIDE"):
        values = m.opt.o_friction[[0, 2, 3]]
    leasts = zip(FRICTIONS, values, (3, 4, 6), strict=True)
    return {name: float(value) if dimensions >= least else 0.0 for name, value, least in leasts}


def _counting(m: Any, geom: int, ground: int | None) -> list[int]:
    """Return the geoms of a contact that give it its values: those of the highest priority."""
    both = [geom] if ground is None else [geom, ground]
    priority = max(m.geom_priority[g] for g in both)
    return [g for g in both if m.geom_priority[g] == priority]


def _unread_softness(source: Source, geom: int, ground: int | None, pairs: Pairs) -> str:
    """Return which of MuJoCo's values for the softness of a geom's contact with a ground are not its defaults."""
    m = source.model
    pair = None if ground is None else pairs.get(frozenset((geom, ground)))
    if source.enabled("OVERRIDE"):
        rows = {name: [getattr(m.opt, f"o_{name}")] for name in ("solref", "solimp")}
    elif pair is not None:
        rows = {name: [getattr(m, f"pair_{name}")[pair]] for name in SOFTNESS}
    else:
        rows = {name: getattr(m, f"geom_{name}")[_counting(m, geom, ground)] for name in ("solref", "solimp")}
    return ", ".join(name for name, values in rows.items() if (np.array(values) != SOFTNESS[name]).any())


def _margin(source: Source, geom: int, ground: int | None, pairs: Pairs) -> float:
    """Return how far apart MuJoCo keeps the surfaces of a geom and a ground [m]; of the geom alone without one."""
    m = source.model
    if source.enabled("OVERRIDE"):
        return float(m.opt.o_margin)
    pair = None if ground is None else pairs.get(frozenset((geom, ground)))
    if pair is not None:
        return float(m.pair_margin[pair])
    return float(sum(m.geom_margin[g] for g in (geom, ground) if g is not None))


def _shape(source: Source, geom: int, friction: float | None, margin: float) -> CollisionShape:
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
