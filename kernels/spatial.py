"""Spatial quantities in memory and in registers, in the paper's order, V = (omega; v) and f = (n; f).

A quantity of a node is one vector: a pose (R by rows, then l), a motion or a force, a rigid inertia (mass, first
moment, inertia about the frame's origin: xx, yy, zz, xy, xz, yz), or an articulated inertia (the upper triangle of P by
rows). Arrays inside the library are ``[node or dof, component, world]`` with neighbouring worlds at neighbouring
addresses, so that the reads of a warp are contiguous. Functions of these vectors are in
:mod:`warp_spo.execution.node.functions`.
"""

import functools
import types

import warp as wp

from . import native
from .elementary import C_TYPE

POSE, MOTION, RIGID, ARTICULATED = 12, 6, 10, 21  # numbers of components
ENTRY = (
    "const long long part = a.strides[1]; {c}* at = ({c}*)((char*)a.data + i * (long long)a.strides[0]\n"
    "    + world * (long long)a.strides[2]);\n"
)
COMPONENT = "*({c}*)((char*)at + {k} * part)"


@functools.cache
def spatial(T: type) -> types.SimpleNamespace:
    """Return the types and functions below, by name, for scalars of type ``T`` (wp.float32 or wp.float64)."""
    vec3 = wp.types.vector(3, T)
    vec6 = wp.types.vector(MOTION, T)
    vec10 = wp.types.vector(RIGID, T)
    vec12 = wp.types.vector(POSE, T)
    vec21 = wp.types.vector(ARTICULATED, T)
    mat33 = wp.types.matrix((3, 3), T)

    load3, store3 = _load_and_store(3, T)
    load_pose, store_pose = _load_and_store(POSE, T)
    load_motion, store_motion = _load_and_store(MOTION, T)
    load_rigid, store_rigid = _load_and_store(RIGID, T)
    load_articulated, store_articulated = _load_and_store(ARTICULATED, T)

    @wp.func
    def pose(R: mat33, l: vec3):
        return vec12(
            R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2], R[2, 0], R[2, 1], R[2, 2], l[0], l[1], l[2]
        )  # fmt: skip

    @wp.func
    def rotation_of(x: vec12):
        return mat33(x[0], x[1], x[2], x[3], x[4], x[5], x[6], x[7], x[8])

    @wp.func
    def motion(w: vec3, v: vec3):
        return vec6(w[0], w[1], w[2], v[0], v[1], v[2])

    @wp.func
    def base_acceleration(gravity: wp.array2d[T], world: int):
        """Return the spatial acceleration of the inertial frame that stands for gravity: (0; -gravity)."""
        v = vec3()
        if gravity:
            v = -vec3(gravity[0, world], gravity[1, world], gravity[2, world])
        return motion(vec3(), v)

    @wp.func
    def pack(J: mat33, C: mat33, m: mat33):
        """Return the 21 numbers of P = [[J, C], [C*, m]]."""
        return vec21(
            J[0, 0], J[0, 1], J[0, 2], C[0, 0], C[0, 1], C[0, 2],
            J[1, 1], J[1, 2], C[1, 0], C[1, 1], C[1, 2],
            J[2, 2], C[2, 0], C[2, 1], C[2, 2],
            m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2], m[2, 2],
        )  # fmt: skip

    @wp.func
    def J_of(P: vec21):
        return mat33(P[0], P[1], P[2], P[1], P[6], P[7], P[2], P[7], P[11])

    @wp.func
    def C_of(P: vec21):
        return mat33(P[3], P[4], P[5], P[8], P[9], P[10], P[12], P[13], P[14])

    @wp.func
    def m_of(P: vec21):
        return mat33(P[15], P[16], P[17], P[16], P[18], P[19], P[17], P[19], P[20])

    @wp.func
    def skew(v: vec3):
        o = T(0.0)
        return mat33(o, -v[2], v[1], v[2], o, -v[0], -v[1], v[0], o)

    @wp.func
    def rotation(axis: vec3, angle: T):
        """Return exp(angle axis~), computed from the half angle because 1 - cos would cancel."""
        s = wp.sin(T(0.5) * angle)
        c = wp.cos(T(0.5) * angle)
        a = skew(axis)
        return wp.identity(n=3, dtype=T) + (T(2.0) * s * c) * a + (T(2.0) * s * s) * (a * a)

    return types.SimpleNamespace(**locals())


def _load_and_store(n: int, T: type) -> tuple[wp.Function, wp.Function]:
    """Return a function that loads the ``n`` components a[i, :, world] as one vector, and one that stores them."""
    c, vector, array = C_TYPE[T], wp.types.vector(n, T), wp.array3d[T]
    entry, places = ENTRY.format(c=c), [COMPONENT.format(c=c, k=k) for k in range(n)]
    loads = "".join(f"v[{k}] = {place};\n" for k, place in enumerate(places))
    stores = "".join(f"{place} = v[{k}];\n" for k, place in enumerate(places))
    where = {"a": array, "i": int, "world": int}
    load = native.function(f"load_{n}_{T.__name__}", f"{entry}wp::vec_t<{n}, {c}> v;\n{loads}return v;", where, vector)
    return load, native.function(f"store_{n}_{T.__name__}", entry + stores, where | {"v": vector})
