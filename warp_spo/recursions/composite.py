"""Composite bodies: Mass(i, k) = H(i) phi(i, k) R(k) H*(k) + Delta, R the rigid inertia of all that a link carries."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..trace.emission import Store
from ..trace.scalars import Value
from ..trace.spatial import IDENTITY, ZERO, Pose, Rigid, Vector, Wrench
from .articulated import columns
from .articulated_sweeps import mirror, pack
from .model.links import NOTHING as NOTHING
from .model.links import Link, LinkPlacement
from .motion import hinge_entries

if TYPE_CHECKING:
    from .model.tracing import Trace


def entries(
    link: Link, places: dict[int, LinkPlacement], body: Rigid, shared: dict[int, Wrench]
) -> dict[tuple[int, int], Value]:
    """(row, column) of Mass for the columns of a link that carries ``body`` = R, rows on the way to the root.

    Links of a group have dofs in common, see :mod:`.model.shared_dofs`: their forces on the parent are added up in
    ``shared``, by column, and go on to the root from the group's last link.
    """
    found = own_entries(link, places[id(link)], body)
    for (i, j), x in link.coupling_inertia.items():
        found[link.dofs[i], link.dofs[j]] = found[link.dofs[i], link.dofs[j]] + x
    for column, H in zip(link.dofs, columns(link, places[id(link)]), strict=True):
        n, f = body.apply(Vector(H[:3]), Vector(H[3:]))
        over = link
        if link.shared_dofs is not None and link.parent is not None:
            n, f = places[id(link)].pose.force_to_parent(n, f)
            if column in shared:
                n, f = shared[column][0] + n, shared[column][1] + f
            shared[column] = n, f
            if not link.is_last:
                continue
            over = link.parent
            found |= _rows(over, places, column, n, f)
        while over.parent is not None:
            n, f = places[id(over)].pose.force_to_parent(n, f)
            over = over.parent
            found |= _rows(over, places, column, n, f)
    return found


def _rows(
    link: Link, places: dict[int, LinkPlacement], column: int, n: Vector, f: Vector
) -> dict[tuple[int, int], Value]:
    """Return the entries of a link's dofs in a column that puts (n; f) on the link."""
    forces = hinge_entries(link, places[id(link)], n, f)
    return {(row, column): force for row, force in zip(link.dofs, forces, strict=True)}


def own_entries(link: Link, place: LinkPlacement, body: Rigid) -> dict[tuple[int, int], Value]:
    """H R H* + Delta of the link's own dofs, upper triangle.

    A link that turns by a quaternion has R in the axes of its rates, where its mass is exact. R in the link's axes is
    the same but for rounding: a float32 rotation is off by 1e-7 from its inverse.
    """
    if place.turned is not None:
        body = Pose(None, place.turned, ZERO).rigid_to_parent(body)
        place = place._replace(turned=IDENTITY)
    found: dict[tuple[int, int], Value] = {}
    for column, armature, H in zip(link.dofs, link.armature, columns(link, place), strict=True):
        forces = hinge_entries(link, place, *body.apply(Vector(H[:3]), Vector(H[3:])))
        for row, force in zip(link.dofs, forces, strict=True):
            if row <= column:
                found[row, column] = force + armature if row == column else force
    return found


def mass_matrix(trace: Trace) -> list[Store]:
    """out = Mass, both triangles"""
    carried: dict[int, Rigid] = {}
    found: dict[tuple[int, int], Value] = {}
    shared: dict[int, Wrench] = {}
    stores: list[Store] = []
    for link, outward in trace.traversal():
        if outward:
            trace.place(link)
            continue
        key = id(link)
        trace.label(link, "R")
        body = link.grouped or NOTHING
        for other in trace.exchange.from_children(link, "R", carried, Rigid.unpacked):
            body = body + other
        if link.parent is not None:
            carried[key] = trace.places[key].pose.rigid_to_parent(body)
            stores += trace.exchange.send_to_parent("R", link, carried[key].packed)
        trace.label(link, "F")
        for at, value in entries(link, trace.places, body, shared).items():
            found[at] = found[at] + value if at in found else value  # links of a group add to the same entries
    return stores + mirror(found)


def mass_matrix_packed(trace: Trace) -> list[Store]:
    """out = the entries of Mass that the tree allows, lower triangle, row after row"""
    return pack(mass_matrix(trace))
