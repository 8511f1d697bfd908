"""A kernel that finds the points of pairs of shapes alone, by the native code that steps run."""

import functools

import warp as wp

import warp_spo as spo
from warp_spo.kernels import hull_faces, hulls, native, touches
from warp_spo.kernels.elementary import C_TYPE, NATIVE
from warp_spo.recursions.contact.couples import Polyhedron
from warp_spo.scene.pairs import shape_of

ENTRIES = 11  # of a shape: its pose in the body, half its sizes, its radius

FIND = r"""
struct placing
{
    static CUDA_CALLABLE inline void matrix(const REAL* q, REAL* R)
    {
        const REAL s = 2 / (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
        const REAL x = q[0], y = q[1], z = q[2], w = q[3];
        const REAL turn[9] = {1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w),
            s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w),
            s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)};
        UNROLL
        for (int i = 0; i < 9; ++i) R[i] = turn[i];
    }

    static CUDA_CALLABLE inline solids::Solid place(const REAL* origin, const REAL* body, const REAL* shape, int kind)
    {
        solids::Solid found;
        REAL R[9], own[9];
        matrix(body, R);
        matrix(shape + 3, own);
        UNROLL
        for (int r = 0; r < 3; ++r) {
            found.at[r] = origin[r] + solids::dot(R + 3 * r, shape);
            found.size[r] = shape[7 + r];
            UNROLL
            for (int c = 0; c < 3; ++c)
                found.turn[3 * r + c] = R[3 * r] * own[c] + R[3 * r + 1] * own[3 + c] + R[3 * r + 2] * own[6 + c];
        }
        found.radius = shape[10];
        found.box = kind > 0;
        HULLS found.hull = kind - 2;
        return found;
    }
};
const int* row = pairs.data + 5 * pair;
const REAL* one = poses.data + ((long long)world * poses.shape[1] + row[0]) * 7;
const REAL* two = poses.data + ((long long)world * poses.shape[1] + row[1]) * 7;
const REAL* shape = shapes.data + 2 * ENTRIES * pair;
const long long worlds = touches_out.shape[1];
REAL *out = touches_out.data + row[4] * worlds + world, zero[3] = {0, 0, 0}, between[3];
for (int c = 0; c < 3; ++c) out[c * worlds] = between[c] = two[c] - one[c];
const solids::Solid a = placing::place(zero, one + 3, shape, row[2]);
const solids::Solid b = placing::place(between, two + 3, shape + ENTRIES, row[3]);
solids::touch(a, b, out + HEADER * worlds, worlds, row[2] && row[3] ? TOGETHER : row[2] || row[3] ? 4 : 1);
"""


def hull_of(points):
    """Return the hull of points about its middle, and that."""
    solid = shape_of("test", spo.Contact(0, hull=points))
    return solid.hull, solid.pose[:3]


def polyhedron(points):
    """Return the hull of points as native code reads it."""
    hull, _ = hull_of(points)
    return Polyhedron(hull.planes, hull.edges)


@functools.cache
def find_touches(T, of=()) -> wp.Kernel:
    """Write the touches of all pairs.

    Inputs are the poses of frames [world, frame, 7]; for each pair (frame, frame, kind, kind, first entry of its
    touches), with 0 for shapes with a radius, 1 for boxes and 2 + i for the hull i of ``of``; and the shapes
    [2 pair, ENTRIES].
    """
    text = hulls.lines(FIND, bool(of)).replace("REAL", C_TYPE[T]).replace("UNROLL\n", "#pragma unroll\n")
    for name, value in {
        "ENTRIES": ENTRIES,
        "HEADER": touches.HEADER,
        "TOGETHER": hull_faces.MOST if len(of) > 1 else touches.MOST,
    }.items():
        text = text.replace(name, str(value))
    arrays = {"poses": wp.array3d[T], "pairs": wp.array2d[int], "shapes": wp.array2d[T], "touches_out": wp.array2d[T]}
    find = native.function(
        "find_touch",
        NATIVE[C_TYPE[T]] + touches.native(T, of, long=True, faces=len(of) > 1) + text,
        {"pair": int, "world": int, **arrays},
    )

    @wp.kernel(module=f"warp_spo_touches_{len(of)}_{T.__name__}", enable_backward=False)
    def kernel(poses: wp.array3d[T], pairs: wp.array2d[int], shapes: wp.array2d[T], touches_out: wp.array2d[T]):
        pair, world = wp.tid()
        find(pair, world, poses, pairs, shapes, touches_out)

    return kernel
