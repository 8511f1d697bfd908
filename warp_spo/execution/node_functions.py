"""The steps of the recursions as Warp functions of one node: traced once, emitted for the kernels of every scene.

A kernel at node granularity walks a tree, and calls these for what it does at a node. A node's hinge has any number of
columns h of H*, (omega; v) in the node frame each. A quantity is a vector, packed as :mod:`.kernels.spatial` says.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import warp as wp

from ..kernels import native
from ..kernels.elementary import C_TYPE, NATIVE
from ..kernels.spatial import spatial
from ..recursions import articulated, kinematics, links, motion, newton_euler
from ..recursions.articulated import Pivot
from ..recursions.links import Placed
from ..recursions.motion import STILL, Motion
from ..recursions.tracing import EPSILON
from ..trace.emission import Emitter, Store, render
from ..trace.scalars import Graph, Value, reciprocal
from ..trace.spatial import Articulated, Matrix, Pose, Rigid, Vector, magnitude

FUSED = """\
#if defined(__clang__)
#pragma clang fp contract(fast)
#endif
"""  # as CUDA's compiler does: a product that is added is not rounded first


class Kind(NamedTuple):
    """A kind of argument: its components, and what the recursions make of them."""

    size: int
    read: Callable[[Vector], Any]


NUMBER, ARM, COLUMN = Kind(1, lambda x: x[0]), Kind(3, Vector), Kind(6, Vector)
PARTS = Kind(6, lambda x: (Vector(x[:3]), Vector(x[3:])))
PLACE = Kind(12, lambda x: Pose(None, Matrix.of([x[:3], x[3:6], x[6:9]]), Vector(x[9:])))
RIGID, INERTIA = Kind(10, Rigid.unpacked), Kind(21, Articulated.unpacked)
MOVING = Kind(6, lambda x: STILL._replace(spin=Vector(x[:3]), whirl=motion.whirl(x)))


def _accelerated(pose: Pose, above: Motion, alpha: tuple, own: tuple, bias: Vector) -> Vector:
    move = motion.joined(pose, above, *own)
    w, v = motion.carried(Placed(pose, None), move, alpha)
    return Vector((*(w + move.bias_w), *(v + move.bias_v))) + bias


def _pivot(h: Vector, U: Vector, D: Value) -> Pivot:
    return Pivot(None, h, U, D, reciprocal(D))


def _eliminated(P: Articulated, h: Vector, armature: Value, least: Value) -> tuple:
    pivot, after = articulated.eliminate(P, h, armature, least)
    return after, pivot.U, pivot.D


STEPS: dict[str, tuple[Callable, dict[str, Kind]]] = {
    # poses of a frame at ``inner`` in one at ``pose``, of one that has ``pose`` at ``inner``, of ``other`` seen from it
    "quaternion_rotation": (links.quaternion_rotation, {"x": NUMBER, "y": NUMBER, "z": NUMBER, "w": NUMBER}),
    "placed_on": (
        lambda pose, inner: Pose(None, pose.rotation @ inner.rotation, pose.point_to_parent(inner.l)),
        {"pose": PLACE, "inner": PLACE},
    ),
    "placed_under": (
        lambda pose, inner: Pose(
            None, pose.rotation @ inner.rotation.T, pose.l - pose.to_parent(inner.to_child(inner.l))
        ),
        {"pose": PLACE, "inner": PLACE},
    ),
    "placed_in": (
        lambda pose, other: Pose(None, pose.rotation.T @ other.rotation, pose.to_child(other.l - pose.l)),
        {"pose": PLACE, "other": PLACE},
    ),
    "point_to_parent": (Pose.point_to_parent, {"pose": PLACE, "r": ARM}),
    "point_to_child": (lambda pose, r: pose.to_child(r - pose.l), {"pose": PLACE, "r": ARM}),
    # V(k); alpha(k) for what the hinge adds, H* qd and its acceleration at qdd = 0; v and omega in inertial axes
    "motion_to_child": (lambda pose, v: pose.motion_to_child(*v), {"pose": PLACE, "v": PARTS}),
    "moved": (
        lambda pose, above, own: kinematics.carried_velocity(Placed(pose, None), above, own),
        {"pose": PLACE, "above": PARTS, "own": PARTS},
    ),
    "accelerated": (
        _accelerated,
        {"pose": PLACE, "above": MOVING, "alpha": PARTS, "own": PARTS, "bias": COLUMN},
    ),
    "velocity": (
        lambda pose, v, arm: (kinematics.velocity(pose.rotation, v[0], v[1], arm), pose.to_parent(v[0])),
        {"pose": PLACE, "v": PARTS, "arm": ARM},
    ),
    # M alpha + crf(V) M V; (force; torque) in inertial axes at the CoM as (n; f); M v
    "body_force": (
        lambda body, v, alpha: newton_euler.body_force(body, v, *alpha),
        {"body": RIGID, "v": MOVING, "alpha": PARTS},
    ),
    "wrench": (
        lambda pose, com, given: newton_euler.wrench(pose.rotation, com, *given),
        {"pose": PLACE, "com": ARM, "given": PARTS},
    ),
    "force_to_parent": (lambda pose, f: pose.force_to_parent(*f), {"pose": PLACE, "f": PARTS}),
    "momentum": (lambda body, v: body.apply(*v), {"body": RIGID, "v": PARTS}),
    # phi R phi*; phi P phi*; M as P; |h|* |P| |other|
    "rigid_to_parent": (Pose.rigid_to_parent, {"pose": PLACE, "body": RIGID}),
    "articulated_to_parent": (Pose.articulated_to_parent, {"pose": PLACE, "P": INERTIA}),
    "articulated": (lambda body: body.articulated, {"body": RIGID}),
    "magnitude": (lambda P, h, other: magnitude(h, P, other), {"P": INERTIA, "h": COLUMN, "other": COLUMN}),
    # P+, U, D; P - U D^-1 U*; D^-1 eps and z + G eps; qdd and alpha + H* qdd
    "eliminated": (_eliminated, {"P": INERTIA, "h": COLUMN, "armature": NUMBER, "least": NUMBER}),
    "without": (articulated.without, {"P": INERTIA, "U": COLUMN, "D": NUMBER}),
    "brought": (articulated.brought, {"coupling": NUMBER, "share": NUMBER, "size": NUMBER}),
    "taken": (
        lambda h, U, D, z, b: articulated.taken(_pivot(h, U, D), z, b),
        {"h": COLUMN, "U": COLUMN, "D": NUMBER, "z": COLUMN, "b": NUMBER},
    ),
    "released": (
        lambda h, U, D, alpha, rate: articulated.released(_pivot(h, U, D), alpha, rate),
        {"h": COLUMN, "U": COLUMN, "D": NUMBER, "alpha": COLUMN, "rate": NUMBER},
    ),
}
"""What is traced, and its arguments, by name. What it returns is packed one after the other; a Matrix is one."""


class NodeFunctions:
    """Warp functions by name, and the types that they take.

    Attributes:
        T: the scalar type. wide: the same in float64.
        least: share of what cancels in a pivot that it must exceed.
    """

    def __init__(self, T: type):
        self.T, self.least = T, articulated.LEAST * EPSILON[T.__name__]
        self.wide: NodeFunctions = self if T is wp.float64 else node_functions(wp.float64)
        vars(self).update(vars(spatial(T)))
        vars(self).update({name: _emitted(name, traced, kinds, T) for name, (traced, kinds) in STEPS.items()})


@functools.cache
def node_functions(T: type) -> NodeFunctions:
    """Types, loads, stores and node functions for scalars of type ``T`` (wp.float32 or wp.float64)."""
    return NodeFunctions(T)


def _emitted(name: str, traced: Callable, kinds: dict[str, Kind], T: type) -> wp.Function:
    graph, dtype, c = Graph(), T.__name__, C_TYPE[T]
    read = {x: kind.read(Vector(graph.input(x, i) for i in range(kind.size))) for x, kind in kinds.items()}
    found = traced(*read.values())
    values = _packed(found)
    if isinstance(found, Matrix):
        result, entries, shape = wp.types.matrix((3, 3), T), "(&result.data[0][0])", f"wp::mat_t<3, 3, {c}>"
    elif len(values) > 1:
        result, entries, shape = wp.types.vector(len(values), T), "result.c", f"wp::vec_t<{len(values)}, {c}>"
    else:
        result, entries, shape = T, "(&result)", c
    emitter = Emitter(
        dtype,
        lambda array, entry: array if kinds[array] is NUMBER else f"{array}[{entry}]",
        lambda array, entry, value: f"{entries}[{entry}] = {value};",
        lambda array, index: index[0],
    )
    statements = render(emitter.region([Store("result", (i,), value) for i, value in enumerate(values)]), dtype)
    text = f"{FUSED}{NATIVE[c]}{shape} result;\n{statements}\nreturn result;"
    types = {x: T if kind is NUMBER else wp.types.vector(kind.size, T) for x, kind in kinds.items()}
    return native.function(f"{name}_{dtype}", text, types, result)


def _packed(found: Any) -> list[Value]:
    if isinstance(found, (Rigid, Articulated)):
        return found.packed
    if isinstance(found, Pose):
        return [x for row in (*found.rotation, found.l) for x in row]
    return [x for part in found for x in _packed(part)] if isinstance(found, (tuple, list)) else [found]
