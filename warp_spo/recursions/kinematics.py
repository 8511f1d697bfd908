"""Positions and velocities of bodies and frames in the inertial frame: poses, V = phi* H* qd, Jacobians."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..hinges.quaternions import Quaternion, constant_quaternion, multiply, turned
from ..trace.emission import Store
from ..trace.scalars import Entry, Value, constant_of
from ..trace.spatial import IDENTITY, ZERO, Matrix, Twist, Vector, cross, dot
from .model.links import Link, LinkPlacement, Links, place_link
from .motion import hinge_motion
from .newton_euler import link_acceleration

if TYPE_CHECKING:
    from .model.tracing import Trace

NEUTRAL = Vector((0.0, 0.0, 0.0, 1.0))  # quaternion xyzw of no rotation


def relative_quaternion(link: Link, q: Any) -> Quaternion:
    """Return the quaternion of the link's axes in its parent's."""
    return link.hinge.relative_quaternion(link, q)


def carried_velocity(place: LinkPlacement, parent: Twist, hinge: tuple) -> Twist:
    """(omega; v) of the link's frame, in its axes, for its parent's and the hinge's own."""
    w, v = place.pose.motion_to_child(*parent)
    return w + hinge[0], v + hinge[1]


def velocity(axes: Matrix, w: Any, v: Any, arm: Any) -> Vector:
    """In inertial axes, of a point at ``arm`` from the origin of a frame that moves with (w; v), in its ``axes``."""
    return axes @ (v + cross(w, arm))


def columns(link: Link, place: LinkPlacement, parent_axes: Matrix, axes: Matrix, arm: Vector) -> list[Twist]:
    """Return (omega; v), in inertial axes, of a point at ``arm`` from the link's origin, per unit rate of each dof.

    ``axes`` are the link's, ``parent_axes`` the parent link's axes in the inertial frame, ``arm`` is in the link's.
    """
    return link.hinge.inertial_columns(link, place, parent_axes, axes, arm)


def zero(dof: int) -> Value:
    """Return 0: no dof accelerates."""
    return 0.0


def place_axes(trace: Trace, link: Link) -> None:
    """Place a link and compute its axes in the inertial frame."""
    trace.place(link)
    trace.label(link, "R")
    parent = IDENTITY if link.parent is None else trace.axes[id(link.parent)]
    trace.axes[id(link)] = parent @ trace.places[id(link)].pose.rotation


def frame_on_link(trace: Trace, body: int, origin: tuple) -> tuple[Link | None, Vector]:
    """Return the link that carries a frame of a body, and the frame's origin in the link's frame."""
    if (body, tuple(origin)) in trace.links.ports:
        return trace.links.ports[body, tuple(origin)].link, ZERO
    placement = trace.links.placements[body]
    return placement.link, placement.offset + arm_on_link(trace, body, origin)


def arm_on_link(trace: Trace, body: int, origin: tuple) -> Vector:
    """Return the way from a body's node frame to the origin of a frame of the body, in the axes of its link."""
    R, p = trace.links.nodes[body].anchor
    return trace.links.placements[body].matrix @ (R.T @ (Vector(origin) - p))


def jacobian(trace: Trace, frames: tuple) -> list[Store]:
    """out [frame, 6, dof]: velocity of each frame's origin, then angular velocity, inertial axes, per unit qd."""
    for each in trace.links.links:
        place_axes(trace, each)
    stores = []
    for index, (body, origin) in enumerate(frames):
        link, arm = frame_on_link(trace, body, origin)
        while link is not None:
            trace.label(link, f"j{index}_")
            parent = IDENTITY if link.parent is None else trace.axes[id(link.parent)]
            place, axes = trace.places[id(link)], trace.axes[id(link)]
            for dof, (w, v) in zip(link.dofs, columns(link, place, parent, axes, arm), strict=True):
                stores += [Store("out", (index, c, dof), value) for c, value in enumerate((*v, *w))]
            arm, link = place.pose.point_to_parent(arm), link.parent
    return stores


def link_poses(trace: Trace) -> tuple[dict[int | None, Vector], dict[int | None, Quaternion]]:
    """Return the origin and the quaternion of every link in the inertial frame, by id; None is that frame itself."""
    q = trace.vector("q")
    origins: dict[int | None, Vector] = {None: ZERO}
    quaternions: dict[int | None, Quaternion] = {None: NEUTRAL}
    for link in trace.active_links:
        trace.label(link, "p")
        parent = None if link.parent is None else id(link.parent)
        trace.places[id(link)] = place = place_link(link, q)
        origins[id(link)] = origins[parent] + turned(quaternions[parent], place.pose.l)
        quaternions[id(link)] = multiply(quaternions[parent], relative_quaternion(link, q))
    return origins, quaternions


def quaternions_in_links(links: Links) -> dict[int, Quaternion]:
    """Return the quaternion of each body's axes in its link.

    Its sign makes the quaternion of the body the product of those of the anchors and hinges from the root on, as
    Newton's eval_fk computes it. Signs of constants decide this, so that it costs no operation.
    """
    scene = links.scene
    by_anchors = {-1: NEUTRAL}
    by_links: dict[int | None, Quaternion] = {None: by_anchors[-1]}
    for link in links.links:
        over = None if link.parent is None else id(link.parent)
        rest = Vector(map(constant_of, link.hinge.quaternion_at_rest(link)))
        by_links[id(link)] = multiply(by_links[over], rest)
    found = {}
    for body, placement in links.placements.items():  # parents first; all at neutral coordinates
        hinge = scene.hinge_of[body]
        outer, inner = (Vector(scene.values[name][0, hinge, 3:].tolist()) for name in ("joint_X_p", "joint_X_c"))
        back = Vector((-inner[0], -inner[1], -inner[2], inner[3]))
        by_anchors[body] = multiply(by_anchors[scene.tree.parent[body]], multiply(outer, back))
        own = constant_quaternion(placement.matrix @ links.nodes[body].anchor[0].T)
        carried = multiply(by_links[None if placement.link is None else id(placement.link)], own)
        found[body] = own * (-1.0 if dot(carried, by_anchors[body]) < 0.0 else 1.0)
    return found


def body_poses(trace: Trace) -> list[Store]:
    """out [body, 7] = position, quaternion xyzw"""
    (at, turns), within = link_poses(trace), quaternions_in_links(trace.links)
    stores, constants = [], trace.links.shared_constants
    for number, body in enumerate(trace.own_bodies):
        placement, (R, p) = trace.links.placements[body], trace.links.nodes[body].anchor
        key = None if placement.link is None else id(placement.link)
        axes = placement.matrix @ R.T
        origin, turn = placement.offset - axes @ p, within[body]
        if constants is not None:
            origin, turn = (Vector(constants.of_body(number, *each)) for each in (("origin", origin), ("turn", turn)))
        position = at[key] + turned(turns[key], origin)
        pose = (*position, *multiply(turns[key], turn))
        stores += [Store("out", (body, c), value) for c, value in enumerate(pose)]
    return stores


def frame_poses(trace: Trace, frames: tuple) -> list[Store]:
    """out [frame, 7] = position, quaternion xyzw: that of the body, then that of the frame in it"""
    (at, turns), of_bodies, stores = link_poses(trace), quaternions_in_links(trace.links), []
    for index, (body, pose) in enumerate(frames):
        trace.graph.step = f"frame {index}|f"
        link, arm = frame_on_link(trace, body, pose[:3])
        key = None if link is None else id(link)
        position = at[key] + turned(turns[key], arm)
        own = NEUTRAL if (body, tuple(pose[:3])) in trace.links.ports else of_bodies[body]
        within = multiply(own, Vector(pose[3:]))
        values = (*position, *multiply(turns[key], within))
        stores += [Store("out", (index, c), value) for c, value in enumerate(values)]
    return stores


def link_velocities(trace: Trace) -> dict[int | None, Twist]:
    """Place every link, and return its (omega; v) in its axes, by id; None is the inertial frame."""
    velocities: dict[int | None, Twist] = {None: (ZERO, ZERO)}
    for link in trace.active_links:
        place_axes(trace, link)
        trace.label(link, "v")
        place, parent = trace.places[id(link)], None if link.parent is None else id(link.parent)
        hinge = hinge_motion(link, place, trace.vector("qd"))
        velocities[id(link)] = carried_velocity(place, velocities[parent], hinge)
    return velocities


def frame_velocities(trace: Trace, frames: tuple) -> list[Store]:
    """out [frame, 6] = velocity of each frame's origin, angular velocity, in inertial axes"""
    velocities, stores = link_velocities(trace), []
    for index, (body, origin) in enumerate(frames):
        link, arm = frame_on_link(trace, body, origin)
        values = (*ZERO, *ZERO)
        if link is not None:
            trace.label(link, f"j{index}_")
            (w, v), R = velocities[id(link)], trace.axes[id(link)]
            values = (*velocity(R, w, v, arm), *(R @ w))
        stores += [Store("out", (index, c), value) for c, value in enumerate(values)]
    return stores


def body_velocities(trace: Trace) -> list[Store]:
    """out [body, 6] = velocity of the CoM, angular velocity, in inertial axes"""
    velocities, stores = link_velocities(trace), []
    for body in trace.own_bodies:
        link, com = trace.links.center(body)
        key = None if link is None else id(link)
        w, v = velocities[key]
        R = IDENTITY if key is None else trace.axes[key]
        values = (*velocity(R, w, v, com), *(R @ w))
        stores += [Store("out", (body, c), value) for c, value in enumerate(values)]
    return stores


def body_states(trace: Trace) -> list[Store]:
    """out = body_poses, velocities_out = body_velocities"""
    return body_poses(trace) + [item._replace(array="velocities_out") for item in body_velocities(trace)]


def place_all(trace: Trace, moves: bool = False) -> dict[int, Vector]:
    """Place every link, compute its axes, and return its origin in inertial axes from the first root's link."""
    origins: dict[int, Vector] = {}
    for link in trace.links.links:
        trace.place(link, moves)
        trace.label(link, "R")
        key, pose = id(link), trace.places[id(link)].pose
        if link.parent is None:
            trace.axes[key] = pose.rotation
            first = trace.places[id(trace.links.links[0])].pose.l
            origins[key] = pose.l - first if origins else ZERO  # what is far away cancels once
        else:
            over = id(link.parent)
            trace.axes[key] = trace.axes[over] @ pose.rotation
            origins[key] = origins[over] + trace.axes[over] @ pose.l
    return origins


def link_accelerations(trace: Trace, qdd: Entry) -> dict[int, Twist]:
    """Return the accelerations of the links without gravity: phi* (H* qdd + a)."""
    alpha: dict[int, Twist] = {}
    for link in trace.links.links:
        trace.label(link, "a")
        above = (ZERO, ZERO) if link.parent is None else alpha[id(link.parent)]
        place, move = trace.places[id(link)], trace.motions[id(link)]
        alpha[id(link)] = link_acceleration(link, place, move, above, qdd)
    return alpha


def jacobian_bias(trace: Trace, frames: tuple) -> list[Store]:
    """out [frame, 6] = J' qd: acceleration of each frame's origin, angular acceleration, inertial axes, qdd = 0."""
    place_all(trace, moves=True)
    return accelerations_of_frames(trace, frames, link_accelerations(trace, zero))


def frame_accelerations(trace: Trace, frames: tuple) -> list[Store]:
    """out [frame, 6] = J qdd + J' qd"""
    place_all(trace, moves="qd" in trace.inputs)
    return accelerations_of_frames(trace, frames, link_accelerations(trace, trace.vector("qdd")))


def accelerations_of_frames(trace: Trace, frames: tuple, alpha: dict[int, Twist]) -> list[Store]:
    """out [frame, 6]: accelerations of frames for those of their links ``alpha``, inertial axes"""
    stores = []
    for index, (body, origin) in enumerate(frames):
        link, arm = frame_on_link(trace, body, origin)
        values = (*ZERO, *ZERO)
        if link is not None:
            trace.label(link, f"j{index}_")
            (w, v), R = alpha[id(link)], trace.axes[id(link)]
            values = (*(R @ (v + cross(w, arm) + trace.motions[id(link)].whirl @ arm)), *(R @ w))
        stores += [Store("out", (index, c), value) for c, value in enumerate(values)]
    return stores
