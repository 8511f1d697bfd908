"""Operational space: J Mass^-1 J* of frames, as a matrix and as a product."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from ..trace.emission import Store
from ..trace.scalars import Value
from ..trace.spatial import ZERO, Twist, Vector, cross
from . import articulated
from .articulated_sweeps import NO_FORCE, factor_tree, mirror, pivots, propagate_inward, weighted_products
from .kinematics import accelerations_of_frames, frame_on_link, place_all, place_axes
from .model import shared_dofs
from .model.links import Link
from .motion import STILL
from .newton_euler import link_acceleration

if TYPE_CHECKING:
    from .model.tracing import Trace


def operational_inertia_inverse(trace: Trace, frames: tuple) -> list[Store]:
    """out [6 frames, 6 frames] = J Mass^-1 J*: a unit wrench on a frame, sent inward, is a column of Y."""
    for each in trace.links.links:
        place_axes(trace, each)
    done = factor_tree(trace)
    columns: dict[int, dict] = {}
    for row, (link, wrench) in enumerate(unit_wrenches(trace, frames)):
        columns[row] = {} if link is None else propagate_inward(trace, done, link, wrench, [0.0] * len(link.dofs))
    return mirror(weighted_products(trace, *pivots(done), columns))


def unit_wrenches(trace: Trace, frames: tuple) -> Iterator[tuple[Link | None, Vector]]:
    """Yield, for each frame, its link and (n; f) in the link's frame of three unit forces, then of three torques."""
    for index, (body, origin) in enumerate(frames):
        link, arm = frame_on_link(trace, body, origin)
        for c in range(6):
            if link is None:
                yield None, ZERO
                continue
            trace.label(link, f"y{index}{c}_")
            axis = trace.axes[id(link)][c % 3]
            yield link, Vector((*cross(arm, axis), *axis) if c < 3 else (*axis, *ZERO))


def operational_inertia_inverse_product(trace: Trace, frames: tuple) -> list[Store]:
    """out [frame, 6] = J Mass^-1 J* x: wrenches x on the frames inward, the accelerations that they make outward"""
    place_all(trace)
    done = factor_tree(trace)
    forces: dict[int, Vector] = {id(link): NO_FORCE for link in trace.links.links}
    for key, wrench in wrenches_on_links(trace, frames).items():
        forces[key] = forces[key] - wrench
    return accelerations_of_frames(trace, frames, respond(trace, done, forces)[1])


def respond(trace: Trace, done: dict, forces: dict[int, Vector]) -> tuple[dict[int, Value], dict[int, Twist]]:
    """Return what forces against the links, by id, make of the tree at rest: qdd by dof, accelerations of links by id.

    The sweep inward adds forces of children to ``forces``.
    """
    rates: dict[int, list[Value]] = {}
    for link in reversed(trace.links.links):
        trace.label(link, "z")
        key, still = id(link), [0.0] * len(link.dofs)
        if link.shared_dofs is None:
            rates[key], force = articulated.reduce_link(link, trace.places[key], done[key], STILL, forces[key], still)
        elif link.is_leader:
            rates[key], _, force = shared_dofs.reduce(done[key], trace.places, {}, forces, still)
        else:
            continue
        if link.parent is not None:
            forces[id(link.parent)] = forces[id(link.parent)] + force
    qdd: dict[int, Value] = {}
    alpha: dict[int, Twist] = {}
    for link in trace.links.links:
        trace.label(link, "a")
        above = (ZERO, ZERO) if link.parent is None else alpha[id(link.parent)]
        place = trace.places[id(link)]
        if link.shared_dofs is None:
            own, alpha[id(link)] = articulated.expand_link(link, place, done[id(link)], rates[id(link)], STILL, above)
            qdd |= zip(link.dofs, own, strict=True)
            continue
        if link.is_leader:
            qdd |= zip(link.dofs, shared_dofs.expand(done[id(link)], rates[id(link)], above)[0], strict=True)
        alpha[id(link)] = link_acceleration(link, place, STILL, above, qdd.__getitem__)
    return qdd, alpha


def wrenches_on_links(trace: Trace, frames: tuple) -> dict[int, Vector]:
    """Return (n; f) by link, in its frame, of the wrenches x on the frames; after the links are placed."""
    x, found = trace.vector("x"), dict[int, Vector]()
    for index, (body, origin) in enumerate(frames):
        link, arm = frame_on_link(trace, body, origin)
        if link is not None:
            trace.label(link, f"x{index}_")
            back = trace.axes[id(link)].T
            f, n = (back @ Vector(x(6 * index + 3 * part + c) for c in range(3)) for part in range(2))
            wrench = Vector((*(n + cross(arm, f)), *f))
            found[id(link)] = found[id(link)] + wrench if id(link) in found else wrench
    return found
