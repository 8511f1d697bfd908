"""Spatial algebra in the paper's order, V = (omega; v) and f = (n; f), for one scalar type.

A spatial vector is a pair of 3-vectors, a rigid inertia is (mass, first moment, inertia about the frame's origin), and
an articulated inertia P = [[J, C], [C^T, m]] keeps its 21 numbers: J and m symmetric, C full. Arrays inside the library
are ``[node or dof, component, world]``, worlds neighbouring, so that the threads of a warp read neighbouring addresses.
"""

import functools
import types

import warp as wp

POSE, MOTION, RIGID, ARTICULATED = 12, 6, 10, 21  # components of one of each


@functools.cache
def spatial(T) -> types.SimpleNamespace:
    """The types and functions below for scalars of type ``T`` (wp.float32 or wp.float64)."""
    vec3 = wp.types.vector(3, T)
    mat33 = wp.types.matrix((3, 3), T)

    @wp.func
    def load(a: wp.array3d[T], i: int, c: int, world: int):
        return vec3(a[i, c, world], a[i, c + 1, world], a[i, c + 2, world])

    @wp.func
    def store(a: wp.array3d[T], i: int, c: int, world: int, v: vec3):
        a[i, c, world] = v[0]
        a[i, c + 1, world] = v[1]
        a[i, c + 2, world] = v[2]

    @wp.func
    def load_matrix(a: wp.array3d[T], i: int, c: int, world: int):
        return wp.matrix_from_rows(load(a, i, c, world), load(a, i, c + 3, world), load(a, i, c + 6, world))

    @wp.func
    def store_matrix(a: wp.array3d[T], i: int, c: int, world: int, m: mat33):
        for row in range(3):
            for column in range(3):
                a[i, c + 3 * row + column, world] = m[row, column]

    @wp.func
    def load_symmetric(a: wp.array3d[T], i: int, c: int, world: int):
        xx, yy, zz = a[i, c, world], a[i, c + 1, world], a[i, c + 2, world]
        xy, xz, yz = a[i, c + 3, world], a[i, c + 4, world], a[i, c + 5, world]
        return mat33(xx, xy, xz, xy, yy, yz, xz, yz, zz)

    @wp.func
    def store_symmetric(a: wp.array3d[T], i: int, c: int, world: int, m: mat33):
        a[i, c, world] = m[0, 0]
        a[i, c + 1, world] = m[1, 1]
        a[i, c + 2, world] = m[2, 2]
        a[i, c + 3, world] = m[0, 1]
        a[i, c + 4, world] = m[0, 2]
        a[i, c + 5, world] = m[1, 2]

    @wp.func
    def skew(v: vec3):
        o = T(0.0)
        return mat33(o, -v[2], v[1], v[2], o, -v[0], -v[1], v[0], o)

    @wp.func
    def rotation(axis: vec3, angle: T):
        """exp(angle axis~), from the half angle: 1 - cos would cancel."""
        s = wp.sin(T(0.5) * angle)
        c = wp.cos(T(0.5) * angle)
        a = skew(axis)
        return wp.identity(n=3, dtype=T) + (T(2.0) * s * c) * a + (T(2.0) * s * s) * (a * a)

    @wp.func
    def quaternion_rotation(x: T, y: T, z: T, w: T):
        """Rotation of the quaternion after normalising it; NaN for a zero quaternion."""
        s = T(2.0) / (x * x + y * y + z * z + w * w)
        return mat33(
            T(1.0) - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y),
            s * (x * y + w * z), T(1.0) - s * (x * x + z * z), s * (y * z - w * x),
            s * (x * z - w * y), s * (y * z + w * x), T(1.0) - s * (x * x + y * y),
        )  # fmt: skip

    @wp.func
    def force_to_parent(R: mat33, l: vec3, n: vec3, f: vec3):
        """phi(p, k) (n; f)"""
        f_p = R * f
        return R * n + wp.cross(l, f_p), f_p

    @wp.func
    def motion_to_child(R: mat33, l: vec3, w: vec3, v: vec3):
        """phi*(p, k) (omega; v)"""
        Rt = wp.transpose(R)
        return Rt * w, Rt * (v + wp.cross(w, l))

    @wp.func
    def acceleration_to_child(R: mat33, l: vec3, w: vec3, dw: vec3, dv: vec3):
        """(d omega/dt; dv/dt) of a frame at (R, l) fixed to a body with angular velocity w, as an observer sees it."""
        Rt = wp.transpose(R)
        return Rt * dw, Rt * (dv + wp.cross(dw, l) + wp.cross(w, wp.cross(w, l)))

    @wp.func
    def rigid_apply(mass: T, moment: vec3, inertia: mat33, w: vec3, v: vec3):
        """(n; f) = M (omega; v)"""
        return inertia * w + wp.cross(moment, v), mass * v - wp.cross(moment, w)

    @wp.func
    def articulated_to_parent(R: mat33, l: vec3, J: mat33, C: mat33, m: mat33):
        """phi(p, k) P phi*(p, k), block by block."""
        Rt = wp.transpose(R)
        m_p = R * m * Rt
        C_r = R * C * Rt
        L = skew(l)
        C_p = C_r + L * m_p
        J_p = R * J * Rt + L * wp.transpose(C_r) - C_p * L
        return J_p, C_p, m_p

    return types.SimpleNamespace(**{name: f for name, f in locals().items() if name != "T"})
