"""Pairs of bodies that overlap in the neutral pose: they push from the first step on."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np

from ..errors import shown
from ..reference.convex_overlap import GrownShape, PosedPair
from .contact_defaults import NeutralPose
from .contact_shapes import BOX, CYLINDER, ELLIPSOID, SWEPT_SEGMENT, ConvexShape
from .frames import pose_matrix

DEEP = 1e-3  # an overlap that is said [m]; shapes of one surface, as drawn, overlap by less
SOME = 60  # directions that are tried first
NAMED = 4  # pairs in the message
NAMES = {SWEPT_SEGMENT: "capsule", BOX: "box", CYLINDER: "cylinder", ELLIPSOID: "ellipsoid"}


def warn_of_overlaps(call: str, scene: Any, first: int) -> None:
    """Warn of pairs that overlap in the neutral pose of a scene, at the line outside of this package that made it.

    ``first``: of the scene's contacts, the number of the first that is looked at.
    """
    found = sorted(_overlaps(scene, first), reverse=True) if scene.contact_pairs else []
    if not found:
        return
    words = [
        f"{shown(scene.contacts[i].label) or f'contact {i}'} by {1e3 * depth:.3g} mm" for depth, i in found[:NAMED]
    ]
    more = f" and {len(found) - NAMED} more" if len(found) > NAMED else ""
    depth, frame = 1, sys._getframe()
    while frame.f_back is not None and str(frame.f_globals.get("__name__", "")).startswith("warp_spo."):
        depth, frame = depth + 1, frame.f_back
    warnings.warn(
        f"{call}: {len(found)} pair(s) of shapes overlap in the neutral pose and push from the first step on: "
        f"{', '.join(words)}{more}; a filter of the source, such as <exclude>, or pairs=[...] by names leaves them out",
        UserWarning,
        stacklevel=depth,
    )


def _overlaps(scene: Any, first: int) -> Iterator[tuple[float, int]]:
    """Yield depth [m] and contact of each pair that is deeper than DEEP.

    The place of a tree that floats is none of the file's, so that pairs of two trees count only if neither does.
    """
    neutral = NeutralPose(scene)
    for pair in scene.contact_pairs:
        bodies = pair.body, pair.other
        alike = len({int(neutral.roots[body]) if body >= 0 else -1 for body in bodies}) == 1
        if pair.contact < first or not (alike or neutral.flying.isdisjoint(bodies)):
            continue
        places = [
            (neutral.places[body] if body >= 0 else np.eye(4)) @ pose_matrix(shape.pose)
            for body, shape in zip(bodies, pair.shapes, strict=True)
        ]
        between = places[1][:3, 3] - places[0][:3, 3]
        if np.linalg.norm(between) > sum(np.linalg.norm(shape.size) + shape.radius for shape in pair.shapes):
            continue
        a, b = (_solid(shape) for shape in pair.shapes)
        turn_a, turn_b = (place[None, :3, :3] for place in places)
        posed = PosedPair(a, b, turn_a, turn_b, between[None])
        if posed.least(SOME, improve=False).depth[0] <= DEEP:  # no direction gives less than the true depth
            continue
        depth = float(posed.least().depth[0])
        if depth > DEEP:
            yield depth, pair.contact


def _solid(shape: ConvexShape) -> GrownShape:
    """Return a shape of the narrow phase as the reference has it."""
    if shape.hull is None:
        return GrownShape(NAMES[shape.kind], shape.size, shape.radius)
    solid = GrownShape("hull", shape.size, shape.radius, shape.hull.corners)
    along = np.array([edge[3:6] for face in shape.hull.edges for edge in np.reshape(face, (-1, 7))])
    solid.normals_and_edges = shape.hull.normals, along / np.linalg.norm(along, axis=1)[:, None]
    return solid
