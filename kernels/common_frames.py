"""Shifts phi(o, k) of all nodes to one frame o, and their inverses, as dense row-major matrices."""

import functools

import warp as wp

from .factorization import BlockTables


@functools.cache
def common_frame(s) -> wp.Kernel:
    """Write phi(o, k), from node k to a common frame o, and its inverse, 36 scalars a node; one thread a (node, world).

    o is the node frame of the root above k or, with ``frames``, the inertial frame. The weights on the way from k to o
    are multiplied: no two positions far from o are subtracted.
    """
    T = s.T
    mat33, vec3, quat = s.mat33, s.vec3, wp.types.quaternion(dtype=T)

    @wp.func
    def read(blocks: wp.array2d[T], world: int, first: int):
        """Return three rows and columns of a block from its entry ``first`` on."""
        return mat33(
            blocks[world, first], blocks[world, first + 1], blocks[world, first + 2],
            blocks[world, first + 6], blocks[world, first + 7], blocks[world, first + 8],
            blocks[world, first + 12], blocks[world, first + 13], blocks[world, first + 14],
        )  # fmt: skip

    @wp.func
    def write(out: wp.array2d[T], world: int, first: int, R: mat33, S: mat33):
        """Write [[R, S], [0, R]]."""
        for a in range(3):
            for b in range(3):
                out[world, first + 6 * a + b] = R[a, b]
                out[world, first + 6 * a + b + 3] = S[a, b]
                out[world, first + 6 * (a + 3) + b] = T(0.0)
                out[world, first + 6 * (a + 3) + b + 3] = R[a, b]

    @wp.kernel(module=f"warp_spo_common_frames_{T.__name__}", enable_backward=False)
    def kernel(
        tables: BlockTables,
        weight: wp.array2d[T],
        frames: wp.array3d[T],
        B_out: wp.array2d[T],
        inverse_out: wp.array2d[T],
    ):
        node, world = wp.tid()
        R, S = wp.identity(n=3, dtype=T), mat33()
        at = int(node)
        while tables.parent[at] >= 0:
            outer = read(weight, world, tables.weight[at])
            S = outer * S + read(weight, world, tables.weight[at] + 3) * R
            R = outer * R
            at = tables.parent[at]
        if frames:
            outer = wp.quat_to_matrix(
                quat(frames[world, at, 3], frames[world, at, 4], frames[world, at, 5], frames[world, at, 6])
            )
            l = vec3(frames[world, at, 0], frames[world, at, 1], frames[world, at, 2])
            S = outer * S + s.skew(l) * outer * R
            R = outer * R
        write(B_out, world, 36 * node, R, S)
        write(inverse_out, world, 36 * node, wp.transpose(R), wp.transpose(S))

    return kernel


KERNELS = (common_frame,)
