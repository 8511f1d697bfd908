"""The steps of the recursions as Warp functions of one node: traced once, emitted for the kernels of every scene.

A kernel at node granularity walks a tree, and calls these for what it does at a node. A node's hinge has any number of
columns H*, (omega; v) in the node frame each. Quantities are vectors, packed as :mod:`.kernels.spatial` says.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import warp as wp

from .kernels import straight
from .kernels.elementary import NATIVE
from .kernels.spatial import ARTICULATED, MOTION, POSE, RIGID, spatial
from .recursions import articulated as bodies
from .recursions import kinematics, links, newton_euler
from .recursions import motion as motions
from .recursions.articulated import Pivot
from .recursions.links import Placed
from .recursions.motion import STILL, Motion
from .recursions.traced import EPSILON
from .trace import spatial as algebra
from .trace.emit import Emitter, Store, literals
from .trace.graph import Graph, Value, reciprocal
from .trace.spatial import Articulated, Matrix, Pose, Rigid, Vector

SCALAR = 1
FUSED = """\
#if defined(__clang__)
#pragma clang fp contract(fast)
#endif
"""  # as CUDA's compiler does: a product that is added is not rounded first
STEPS: dict[str, tuple[dict[str, int], Callable]] = {}


class Steps:
    """Warp functions by name, and the types that they take.

    Attributes:
        T: the scalar type. wide: the same in float64.
        least: share of what cancels in a pivot that it must exceed.
    """

    def __init__(self, T: type):
        self.T, self.least = T, bodies.LEAST * EPSILON[T.__name__]
        self.wide: Steps = self if T is wp.float64 else steps(wp.float64)
        vars(self).update(vars(spatial(T)))
        vars(self).update({name: _emitted(name, sizes, step, T) for name, (sizes, step) in STEPS.items()})


@functools.cache
def steps(T: type) -> Steps:
    """Types, loads, stores and steps for scalars of type ``T`` (wp.float32 or wp.float64)."""
    return Steps(T)


def _emitted(name: str, sizes: dict[str, int], step: Callable, T: type) -> wp.Function:
    graph, dtype, c = Graph(), T.__name__, straight.C_TYPE[T]
    given = {array: Vector(graph.input(array, i) for i in range(size)) for array, size in sizes.items()}
    found = step(**{array: x[0] if sizes[array] == SCALAR else x for array, x in given.items()})
    if isinstance(found, Matrix):
        kind, place, values = wp.types.matrix((3, 3), T), "(&result.data[0][0])", [x for row in found for x in row]
    elif isinstance(found, (tuple, list)):
        kind, place, values = wp.types.vector(len(found), T), "result.c", list(found)
    else:
        kind, place, values = T, "(&result)", [found]
    emitter = Emitter(
        dtype,
        lambda array, entry: array if sizes[array] == SCALAR else f"{array}[{entry}]",
        lambda array, entry, value: f"{place}[{entry}] = {value};",
        lambda array, index: index[0],
    )
    statements = literals(emitter.region([Store("result", (i,), value) for i, value in enumerate(values)]), dtype)
    shape = {SCALAR: c}.get(len(values), f"wp::vec_t<{len(values)}, {c}>")
    shape = f"wp::mat_t<3, 3, {c}>" if isinstance(found, Matrix) else shape
    types_of = {array: T if size == SCALAR else wp.types.vector(size, T) for array, size in sizes.items()}
    native = f"{FUSED}{NATIVE[c]}{shape} result;\n{statements}\nreturn result;"
    return straight.function(f"{name}_{dtype}", native, types_of, kind)


def step(**sizes: int) -> Callable:
    """Make a step of a function of vectors of these ``sizes``, or of scalars, that returns some, one, or a Matrix."""

    def add(traced: Callable) -> Callable:
        STEPS[traced.__name__] = sizes, traced
        return traced

    return add


def _parts(v: Any) -> tuple[Vector, Vector]:
    return Vector(v[:3]), Vector(v[3:])


def _pose(x: Any) -> Pose:
    return Pose(None, Matrix.of([x[0:3], x[3:6], x[6:9]]), Vector(x[9:]))


def _packed(R: Matrix, l: Vector) -> list[Value]:
    return [*R[0], *R[1], *R[2], *l]


def _moving(v: Any) -> Motion:
    w = Vector(v[:3])
    return STILL._replace(spin=w, whirl=motions.whirl(w))


# -- places ------------------------------------------------------------------------------------------------------------
@step(x=SCALAR, y=SCALAR, z=SCALAR, w=SCALAR)
def quaternion_rotation(x: Value, y: Value, z: Value, w: Value) -> Matrix:
    """Rotation of the quaternion after normalising it; NaN for a zero quaternion."""
    return links.quaternion_rotation(x, y, z, w)


@step(pose=POSE, inner=POSE)
def placed_on(pose: Vector, inner: Vector) -> list[Value]:
    """The pose of a frame that sits at ``inner`` in a frame at ``pose``."""
    outer, own = _pose(pose), _pose(inner)
    return _packed(outer.rotation @ own.rotation, outer.point_to_parent(own.l))


@step(pose=POSE, inner=POSE)
def placed_under(pose: Vector, inner: Vector) -> list[Value]:
    """The pose of a frame in which ``pose`` sits at ``inner``."""
    outer, own = _pose(pose), _pose(inner)
    return _packed(outer.rotation @ own.rotation.T, outer.l - outer.to_parent(own.to_child(own.l)))


@step(pose=POSE, other=POSE)
def placed_in(pose: Vector, other: Vector) -> list[Value]:
    """The pose, in a frame at ``pose``, of one at ``other`` beside it."""
    own, beside = _pose(pose), _pose(other)
    return _packed(own.rotation.T @ beside.rotation, own.to_child(beside.l - own.l))


@step(pose=POSE, r=3)
def point_to_parent(pose: Vector, r: Vector) -> Vector:
    return _pose(pose).point_to_parent(r)


@step(pose=POSE, r=3)
def point_to_child(pose: Vector, r: Vector) -> Vector:
    """Where a point at ``r`` in the parent lies in the frame at ``pose``."""
    own = _pose(pose)
    return own.to_child(r - own.l)


@step(pose=POSE, v=MOTION, arm=3)
def velocity(pose: Vector, v: Vector, arm: Vector) -> list[Value]:
    """In inertial axes, of a point at ``arm`` in a node that moves with v; then the angular velocity."""
    R, (w, v) = _pose(pose).rotation, _parts(v)
    return [*kinematics.velocity(R, w, v, arm), *(R @ w)]


# -- motion ------------------------------------------------------------------------------------------------------------
@step(pose=POSE, v=MOTION)
def motion_to_child(pose: Vector, v: Vector) -> list[Value]:
    """phi*(p, k) v"""
    return [x for part in _pose(pose).motion_to_child(*_parts(v)) for x in part]


@step(pose=POSE, above=MOTION, own=MOTION)
def moved(pose: Vector, above: Vector, own: Vector) -> list[Value]:
    """V(k) for V(p) ``above`` and the hinge's ``own`` H* qd."""
    place = Placed(_pose(pose), None)
    w, v = kinematics.carried_velocity(place, _parts(above), _parts(own))
    return [*w, *v]


@step(pose=POSE, above=MOTION, acceleration=MOTION, own=MOTION, bias=MOTION)
def accelerated(pose: Vector, above: Vector, acceleration: Vector, own: Vector, bias: Vector) -> Vector:
    """alpha(k) for V(p) ``above``, alpha(p) and what the hinge adds: H* qd, and its acceleration at qdd = 0."""
    place = Placed(_pose(pose), None)
    move = motions.joined(place.pose, _moving(above), *_parts(own))
    w, v = motions.carried(place, move, _parts(acceleration))
    return Vector((*(w + move.bias_w), *(v + move.bias_v))) + bias


# -- forces ------------------------------------------------------------------------------------------------------------
@step(body=RIGID, v=MOTION, acceleration=MOTION)
def body_force(body: Vector, v: Vector, acceleration: Vector) -> Vector:
    """M alpha + crf(V) M V"""
    return newton_euler.body_force(Rigid.unpacked(body), _moving(v), *_parts(acceleration))


@step(pose=POSE, com=3, wrench=MOTION)
def wrench(pose: Vector, com: Vector, wrench: Vector) -> list[Value]:
    """A body's external (force; torque) as (n; f) of its node."""
    n, f = newton_euler.wrench(_pose(pose).rotation, com, *_parts(wrench))
    return [*n, *f]


@step(pose=POSE, f=MOTION)
def force_to_parent(pose: Vector, f: Vector) -> list[Value]:
    """phi(p, k) f"""
    n, f = _pose(pose).force_to_parent(*_parts(f))
    return [*n, *f]


@step(body=RIGID, v=MOTION)
def momentum(body: Vector, v: Vector) -> list[Value]:
    """M v"""
    n, f = Rigid.unpacked(body).apply(*_parts(v))
    return [*n, *f]


# -- inertias ----------------------------------------------------------------------------------------------------------
@step(pose=POSE, body=RIGID)
def rigid_to_parent(pose: Vector, body: Vector) -> list[Value]:
    """phi R phi*"""
    return _pose(pose).rigid_to_parent(Rigid.unpacked(body)).packed


@step(pose=POSE, P=ARTICULATED)
def articulated_to_parent(pose: Vector, P: Vector) -> list[Value]:
    """phi P phi*"""
    return _pose(pose).articulated_to_parent(Articulated.unpacked(P)).packed


@step(body=RIGID)
def articulated(body: Vector) -> list[Value]:
    """M as P"""
    return Rigid.unpacked(body).articulated.packed


@step(P=ARTICULATED, h=MOTION, other=MOTION)
def magnitude(P: Vector, h: Vector, other: Vector) -> Value:
    """|h|* |P| |other|"""
    return algebra.magnitude(h, Articulated.unpacked(P), other)


@step(P=ARTICULATED, h=MOTION, armature=SCALAR, least=SCALAR)
def eliminated(P: Vector, h: Vector, armature: Value, least: Value) -> list[Value]:
    """P+, then U = P h, then D, NaN if it is not above ``least`` and zero."""
    pivot, after = bodies.eliminate(Articulated.unpacked(P), h, armature, least)
    return [*after.packed, *pivot.U, pivot.D]


@step(P=ARTICULATED, U=MOTION, D=SCALAR)
def less(P: Vector, U: Vector, D: Value) -> list[Value]:
    """P - U D^-1 U*"""
    return bodies.without(Articulated.unpacked(P), U, D).packed


@step(coupling=SCALAR, share=SCALAR, size=SCALAR)
def brought(coupling: Value, share: Value, size: Value) -> Value:
    """What an eliminated pivot brings to what may cancel in a later one."""
    return bodies.brought(coupling, share, size)


@step(h=MOTION, U=MOTION, D=SCALAR, z=MOTION, b=SCALAR)
def taken(h: Vector, U: Vector, D: Value, z: Vector, b: Value) -> list[Value]:
    """z + G eps, then D^-1 eps, eps = b - H z."""
    rate, z = bodies.taken(Pivot(None, h, U, D, reciprocal(D)), z, b)
    return [*z, rate]


@step(h=MOTION, U=MOTION, D=SCALAR, alpha=MOTION, rate=SCALAR)
def released(h: Vector, U: Vector, D: Value, alpha: Vector, rate: Value) -> list[Value]:
    """alpha + H* qdd, then qdd = rate - G* alpha."""
    qdd, after = bodies.released(Pivot(None, h, U, D, reciprocal(D)), alpha, rate)
    return [*after, qdd]
