"""The steps of the recursions as Warp functions of one node, traced once for all scenes.

A kernel at node granularity walks the tree and calls these functions at each node. The hinge of a node has any number
of columns h of H*, each (omega; v) in the node frame. Every quantity is one vector, packed as in
:mod:`warp_spo.kernels.spatial`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import warp as wp

from ...hinges.quaternions import quaternion_rotation
from ...kernels import native
from ...kernels.elementary import C_TYPE, NATIVE
from ...kernels.spatial import spatial
from ...recursions import articulated, kinematics, motion, newton_euler
from ...recursions.articulated import Pivot
from ...recursions.model.links import LinkPlacement
from ...recursions.model.tracing import EPSILON
from ...recursions.motion import STILL, VelocityTerms
from ...trace.emission import Emitter, Store, render
from ...trace.scalars import Graph, Value, reciprocal
from ...trace.spatial import Articulated, Matrix, Pose, Rigid, Vector, magnitude

FUSED = """\
#if defined(__clang__)
#pragma clang fp contract(fast)
#endif
"""  # fuse multiplications with additions on the CPU, too, as CUDA's compiler does


class ArgumentKind(NamedTuple):
    """A kind of argument: its number of components, and a function that unpacks them for the recursions."""

    size: int
    unpack: Callable[[Vector], Any]


NUMBER, ARM, COLUMN = ArgumentKind(1, lambda x: x[0]), ArgumentKind(3, Vector), ArgumentKind(6, Vector)
PARTS = ArgumentKind(6, lambda x: (Vector(x[:3]), Vector(x[3:])))  # angular part, linear part
PLACE = ArgumentKind(12, lambda x: Pose(None, Matrix.of([x[:3], x[3:6], x[6:9]]), Vector(x[9:])))
RIGID, INERTIA = ArgumentKind(10, Rigid.unpacked), ArgumentKind(21, Articulated.unpacked)
MOVING = ArgumentKind(6, lambda x: STILL._replace(spin=Vector(x[:3]), whirl=motion.whirl(x)))


def _node_acceleration(pose: Pose, above: VelocityTerms, alpha: tuple, own: tuple, bias: Vector) -> Vector:
    move = motion.compose_motions(pose, above, *own)
    w, v = motion.carry_acceleration(LinkPlacement(pose, None), move, alpha)
    return Vector((*(w + move.bias_w), *(v + move.bias_v))) + bias


def _pivot(h: Vector, U: Vector, D: Value) -> Pivot:
    return Pivot(None, h, U, D, reciprocal(D))


def _eliminate(P: Articulated, h: Vector, armature: Value, least: Value) -> tuple:
    pivot, after = articulated.eliminate(P, h, armature, least)
    return after, pivot.U, pivot.D


NODE_FUNCTIONS: dict[str, tuple[Callable, dict[str, ArgumentKind]]] = {
    # quaternion xyzw -> R; pose * inner; pose * inner^-1; pose^-1 * other; a point's vector in the other frame
    "quaternion_rotation": (quaternion_rotation, {"x": NUMBER, "y": NUMBER, "z": NUMBER, "w": NUMBER}),
    "compose": (
        lambda pose, inner: Pose(None, pose.rotation @ inner.rotation, pose.point_to_parent(inner.l)),
        {"pose": PLACE, "inner": PLACE},
    ),
    "compose_inverse": (
        lambda pose, inner: Pose(
            None, pose.rotation @ inner.rotation.T, pose.l - pose.to_parent(inner.to_child(inner.l))
        ),
        {"pose": PLACE, "inner": PLACE},
    ),
    "relative_pose": (
        lambda pose, other: Pose(None, pose.rotation.T @ other.rotation, pose.to_child(other.l - pose.l)),
        {"pose": PLACE, "other": PLACE},
    ),
    "point_to_parent": (Pose.point_to_parent, {"pose": PLACE, "r": ARM}),
    "point_to_child": (lambda pose, r: pose.to_child(r - pose.l), {"pose": PLACE, "r": ARM}),
    # phi* v; V(k) and alpha(k), given the hinge's own velocity H* qd and its acceleration at qdd = 0;
    # velocity of a point and angular velocity, in inertial axes
    "motion_to_child": (lambda pose, v: pose.motion_to_child(*v), {"pose": PLACE, "v": PARTS}),
    "node_velocity": (
        lambda pose, above, own: kinematics.carried_velocity(LinkPlacement(pose, None), above, own),
        {"pose": PLACE, "above": PARTS, "own": PARTS},
    ),
    "node_acceleration": (
        _node_acceleration,
        {"pose": PLACE, "above": MOVING, "alpha": PARTS, "own": PARTS, "bias": COLUMN},
    ),
    "point_velocity": (
        lambda pose, v, arm: (kinematics.velocity(pose.rotation, v[0], v[1], arm), pose.to_parent(v[0])),
        {"pose": PLACE, "v": PARTS, "arm": ARM},
    ),
    # M alpha + crf(V) M V; (force; torque) in inertial axes at the CoM -> (n; f) in the node frame; phi f; M v
    "body_force": (
        lambda body, v, alpha: newton_euler.body_force(body, v, *alpha),
        {"body": RIGID, "v": MOVING, "alpha": PARTS},
    ),
    "wrench": (
        lambda pose, com, external: newton_euler.wrench(pose.rotation, com, *external),
        {"pose": PLACE, "com": ARM, "external": PARTS},
    ),
    "force_to_parent": (lambda pose, f: pose.force_to_parent(*f), {"pose": PLACE, "f": PARTS}),
    "momentum": (lambda body, v: body.apply(*v), {"body": RIGID, "v": PARTS}),
    # phi R phi*; phi P phi*; a rigid inertia as an articulated one; |h|* |P| |other|
    "rigid_to_parent": (Pose.rigid_to_parent, {"pose": PLACE, "body": RIGID}),
    "articulated_to_parent": (Pose.articulated_to_parent, {"pose": PLACE, "P": INERTIA}),
    "articulated": (lambda body: body.articulated, {"body": RIGID}),
    "magnitude": (lambda P, h, other: magnitude(h, P, other), {"P": INERTIA, "h": COLUMN, "other": COLUMN}),
    # P+, U, D; P - U D^-1 U*; bound of the cancellation that an eliminated pivot causes in a later one of its hinge;
    # D^-1 eps and z + G eps; qdd and alpha + H* qdd
    "eliminate": (_eliminate, {"P": INERTIA, "h": COLUMN, "armature": NUMBER, "least": NUMBER}),
    "downdate": (articulated.downdate, {"P": INERTIA, "U": COLUMN, "D": NUMBER}),
    "cancellation": (articulated.cancellation, {"coupling": NUMBER, "share": NUMBER, "size": NUMBER}),
    "eliminate_force": (
        lambda h, U, D, z, b: articulated.reduce_pivot(_pivot(h, U, D), z, b),
        {"h": COLUMN, "U": COLUMN, "D": NUMBER, "z": COLUMN, "b": NUMBER},
    ),
    "back_substitute": (
        lambda h, U, D, alpha, rate: articulated.expand_pivot(_pivot(h, U, D), alpha, rate),
        {"h": COLUMN, "U": COLUMN, "D": NUMBER, "alpha": COLUMN, "rate": NUMBER},
    ),
}
"""By name: the function that is traced, and the kinds of its arguments. Several results are packed into one vector."""


class NodeFunctions:
    """The functions of NODE_FUNCTIONS as attributes, with the types, loads and stores of :mod:`.kernels.spatial`.

    Attributes:
        T: the scalar type.
        wide: the same functions in float64.
        least: a pivot must exceed this multiple of the terms that cancel in it.
    """

    def __init__(self, T: type):
        self.T, self.least = T, articulated.LEAST * EPSILON[T.__name__]
        self.wide: NodeFunctions = self if T is wp.float64 else node_functions(wp.float64)
        vars(self).update(vars(spatial(T)))
        vars(self).update({name: _emit(name, step, kinds, T) for name, (step, kinds) in NODE_FUNCTIONS.items()})


@functools.cache
def node_functions(T: type) -> NodeFunctions:
    """Return the node functions for scalars of type ``T`` (wp.float32 or wp.float64)."""
    return NodeFunctions(T)


def _emit(name: str, step: Callable, kinds: dict[str, ArgumentKind], T: type) -> wp.Function:
    """Return the Warp function that traces ``step`` on scalars of type ``T``."""
    graph, dtype, c = Graph(), T.__name__, C_TYPE[T]
    arguments = {x: kind.unpack(Vector(graph.input(x, i) for i in range(kind.size))) for x, kind in kinds.items()}
    results = step(*arguments.values())
    values = _pack(results)
    if isinstance(results, Matrix):
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


def _pack(results: Any) -> list[Value]:
    """Return the numbers of one or several results, one after the other."""
    if isinstance(results, (Rigid, Articulated)):
        return results.packed
    if isinstance(results, Pose):
        return [x for row in (*results.rotation, results.l) for x in row]
    return [x for part in results for x in _pack(part)] if isinstance(results, (tuple, list)) else [results]
