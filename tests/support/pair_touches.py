"""A kernel that finds the points of pairs of shapes alone, by the native code that steps run."""

import contextlib
import functools

import numpy as np
import warp as wp

import warp_spo as spo
from warp_spo.kernels import hull_clipping, hull_distance, narrow_phase, native
from warp_spo.kernels.elementary import C_TYPE, NATIVE
from warp_spo.recursions.contact.pairs import Polyhedron
from warp_spo.reference import body_contact
from warp_spo.reference.rotations import homogeneous

from .pair_scenes import WEDGE
from .pair_steps import plant

HEADER = 3  # values before the touches of a pair: where the second body is from the first
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
    solid = spo.Contact(0, hull=points).shape.convex("test")
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
    text = hull_distance.lines(FIND, bool(of)).replace("REAL", C_TYPE[T]).replace("UNROLL\n", "#pragma unroll\n")
    for name, value in {
        "ENTRIES": ENTRIES,
        "HEADER": HEADER,
        "TOGETHER": hull_clipping.MOST if len(of) > 1 else narrow_phase.MOST,
    }.items():
        text = text.replace(name, str(value))
    arrays = {"poses": wp.array3d[T], "pairs": wp.array2d[int], "shapes": wp.array2d[T], "touches_out": wp.array2d[T]}
    find = native.function(
        "find_touch",
        NATIVE[C_TYPE[T]] + narrow_phase.native(T, of, long=True, faces=len(of) > 1) + text,
        {"pair": int, "world": int, **arrays},
    )

    @wp.kernel(module=f"warp_spo_touches_{len(of)}_{T.__name__}", enable_backward=False)
    def kernel(poses: wp.array3d[T], pairs: wp.array2d[int], shapes: wp.array2d[T], touches_out: wp.array2d[T]):
        pair, world = wp.tid()
        find(pair, world, poses, pairs, shapes, touches_out)

    return kernel


def touches_found(device, poses, kinds, shapes, hulls, most, dtype=wp.float64):
    """Return what native code finds for a pair of shapes, in float64 [world, most, POINT]; without a touch NaN or AWAY.

    ``poses`` [world, 2, 7] are those of the bodies, ``shapes`` [2, ENTRIES] the shapes in them, ``hulls`` the corners
    of the hulls that ``kinds`` number.
    """
    out = wp.full((HEADER + most * narrow_phase.POINT, len(poses)), np.nan, dtype=dtype, device=device)
    given = [wp.array(poses, dtype=dtype, device=device), wp.array([[0, 1, *kinds, 0]], dtype=int, device=device),
             wp.array(shapes, dtype=dtype, device=device)]  # fmt: skip
    find = find_touches(dtype, tuple(map(polyhedron, hulls)))
    wp.launch(find, (1, len(poses)), given, [out], device=device)
    return np.float64(out.numpy())[HEADER:].T.reshape(len(poses), most, narrow_phase.POINT)


def random_shape(rng, kind):
    """Return a random shape of a body, its row in the kernel's table."""
    turn = rng.normal(size=4)
    size = rng.uniform(0.05, 0.2, 3) if kind else np.array([0.0, 0.0, 0.1])
    return np.concatenate([0.05 * rng.normal(size=3), turn / np.linalg.norm(turn), size, [0.0 if kind else 0.08]])


def assert_points_are_those_of_the_reference(device, kinds, long):
    """Points of random shapes of two kinds, in any order; half of the pairs are nearly aligned. ``long``: capsules."""
    worlds, rng, (hull, _) = 30 if long else 100, np.random.default_rng(sum(kinds)), hull_of(WEDGE)
    shapes = np.array([random_shape(rng, kind) for kind in kinds])
    for row, kind in enumerate(kinds):
        shapes[row, 9] = shapes[row, 9] if kind or long or kinds == (0, 0) else 0.0
    poses = np.concatenate([0.15 * rng.normal(size=(worlds, 2, 3)), rng.normal(size=(worlds, 2, 4))], axis=2)
    poses[::2, :, 3:] = np.array([0.0, 0.0, 0.02, 1.0])
    poses[..., 3:] /= np.linalg.norm(poses[..., 3:], axis=2)[..., None]
    if kinds == (1, 1):
        shapes[:, 3:7] = np.array([0.0, 0.0, 0.0, 1.0])
    found, counts = touches_found(device, poses, kinds, shapes, [WEDGE], most=8), set()
    for w in range(worlds):
        both = [(kind, homogeneous(pose) @ homogeneous(row[:7]), hull.corners if kind == 2 else row[7:10], row[10])
                for kind, pose, row in zip(kinds, poses[w], shapes, strict=True)]  # fmt: skip
        wanted = body_contact.touches(*both)
        rows = found[w, : 8 if kinds == (1, 1) else max(1, len(wanted))]
        rows = rows[rows[:, 6] > narrow_phase.AWAY]
        assert len(rows) == len(wanted)
        counts.add(len(wanted))
        found_rows = np.c_[rows[:, :3] + poses[w, 0, :3], rows[:, 3:]]
        for row in np.array([[*point, *normal, depth] for point, normal, depth in wanted]):  # in any order
            nearest = np.abs(found_rows - row).max(axis=1).argmin()
            np.testing.assert_allclose(found_rows[nearest], row, atol=1e-12)
            found_rows = np.delete(found_rows, nearest, axis=0)
    assert counts >= ({4, 5, 6, 7} if kinds == (1, 1) else {4} if long else {1})


@contextlib.contextmanager
def planted(monkeypatch, place, old, new, text="NATIVE"):
    """Put a bug into native code that :func:`find_touches` is made of, for the time of a block."""
    plant(monkeypatch, place, old, new, text)
    find_touches.cache_clear()
    try:
        yield
    finally:
        find_touches.cache_clear()
