"""Joint springs and dampers: -damping qd - stiffness (q - rest)."""

import functools

import warp as wp

from .spatial import spatial
from .topology import Topology

SCREWS, FREE = wp.constant(0), wp.constant(2)


@functools.cache
def passive_force(T) -> wp.Kernel:
    """One thread for each (node, world).

    A rotation's distance from rest is the rotation vector of R(q) R(rest)^T in the parent anchor's axes: with equal
    stiffness about all axes the torque is the gradient of stiffness |vector|^2 / 2.
    """
    s = spatial(T)
    vec3 = s.vec3

    @wp.func
    def rotation_vector(x: T, y: T, z: T, w: T):
        u = vec3(x, y, z)
        if w < T(0.0):
            u = -u
        sine = wp.length(u)
        angle = T(2.0) * wp.atan2(sine, wp.abs(w))
        scale = T(2.0) / wp.abs(w)
        if sine > T(1.0e-6) * wp.abs(w):
            scale = angle / sine
        return scale * u

    @wp.kernel(module=f"warp_spo_passive_{T.__name__}", enable_backward=False)
    def kernel(
        topology: Topology,
        damping: wp.array2d[T],
        stiffness: wp.array2d[T],
        rest: wp.array2d[T],
        q: wp.array2d[T],
        qd: wp.array2d[T],
        out: wp.array2d[T],
    ):
        node, world = wp.tid()
        motion = topology.motion[node]
        dof = topology.qd_start[node]
        coord = topology.q_start[node]
        for i in range(topology.dof_count[node]):
            force = T(0.0)
            if qd:
                force = -damping[dof + i, world] * qd[world, dof + i]
            if motion == SCREWS or (motion == FREE and i < 3):
                force -= stiffness[dof + i, world] * (q[world, coord + i] - rest[coord + i, world])
            out[world, dof + i] = force
        if motion != SCREWS:
            if motion == FREE:
                dof += 3
                coord += 3
            x, y, z, w = q[world, coord], q[world, coord + 1], q[world, coord + 2], q[world, coord + 3]
            a, b = rest[coord, world], rest[coord + 1, world]
            c, d = rest[coord + 2, world], rest[coord + 3, world]
            turn = rotation_vector(
                d * x - w * a - (y * c - z * b),
                d * y - w * b - (z * a - x * c),
                d * z - w * c - (x * b - y * a),
                w * d + x * a + y * b + z * c,
            )
            for i in range(3):
                out[world, dof + i] -= stiffness[dof + i, world] * turn[i]

    return kernel

KERNELS = (passive_force,)
