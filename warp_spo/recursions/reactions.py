"""Accelerations of bodies, and the wrenches that they receive through their hinges, in inertial axes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..trace.emission import Store
from ..trace.spatial import IDENTITY, Pose, Twist, Vector, Wrench, cross
from . import newton_euler
from .kinematics import place_all
from .motion import STILL

if TYPE_CHECKING:
    from .model.tracing import Trace


def body_accelerations(trace: Trace) -> list[Store]:
    """out [body, 6] = acceleration of the CoM, angular acceleration"""
    _, alpha = _link_motions(trace)
    stores = []
    for body in trace.links.placements:
        link, com = trace.links.center(body)
        if link is None:
            continue
        key = id(link)
        trace.label(link, "a")
        (w, v), move, R = alpha[key], trace.motions[key], trace.axes[key]
        linear = R @ (v + cross(w, com) + move.whirl @ com) + trace.links.gravity
        stores += [Store("out", (body, c), value) for c, value in enumerate((*linear, *(R @ w)))]
    return stores


def body_reactions(trace: Trace) -> list[Store]:
    """out [body, 6] = force, moment about the CoM, that a body's hinge puts on it

    The wrench on a body accelerates it and is passed on to its children; moments are about CoMs.
    """
    origins, alpha = _link_motions(trace)
    tree, placements, stores = trace.links.scene.tree, trace.links.placements, []
    still = -trace.places[id(trace.links.links[0])].pose.l  # the inertial frame's origin, seen from the first link's
    forces: dict[int, Wrench] = {}
    places: dict[int, Vector] = {}
    for body in reversed(list(placements)):  # parents come first there
        placement = placements[body]
        move, R, origin = STILL, IDENTITY, still
        w, v = trace.base_acceleration
        if placement.link is not None:
            key = id(placement.link)
            trace.label(placement.link, "f")
            (w, v), move, R, origin = alpha[key], trace.motions[key], trace.axes[key], origins[key]
        com = placement.offset + placement.matrix @ trace.links.nodes[body].com
        place = Pose(None, placement.matrix, placement.offset)
        moment = newton_euler.body_force(place.rigid_to_parent(trace.links.nodes[body].rigid), move, w, v)
        n, f = Vector(moment[:3]), Vector(moment[3:])
        n, f = R @ (n - cross(com, f)), R @ f
        places[body] = at = origin + R @ com
        if "body_f" in trace.inputs:
            f = f - Vector(trace.graph.input("body_f", body, c) for c in range(3))
            n = n - Vector(trace.graph.input("body_f", body, c) for c in range(3, 6))
        for child in tree.children[body]:
            n_c, f_c = forces[child]
            n, f = n + n_c + cross(places[child] - at, f_c), f + f_c
        forces[body] = n, f
        stores += [Store("out", (body, c), value) for c, value in enumerate((*f, *n))]
    return stores


def _link_motions(trace: Trace) -> tuple[dict[int, Vector], dict[int, Twist]]:
    """Return origins and accelerations of all links, with gravity as an acceleration of the base."""
    origins = place_all(trace, moves=True)
    qdd = trace.vector("qdd")
    alpha: dict[int, Twist] = {}
    for link in trace.links.links:
        trace.label(link, "a")
        above = trace.base_acceleration if link.parent is None else alpha[id(link.parent)]
        place, move = trace.places[id(link)], trace.motions[id(link)]
        alpha[id(link)] = newton_euler.link_acceleration(link, place, move, above, qdd)
    return origins, alpha
