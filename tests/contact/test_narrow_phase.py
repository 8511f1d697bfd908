"""The narrow phase of every pair of convex shapes, by itself: shallow poses, edges that cross, what lies on what."""

import functools

import mujoco
import numpy as np
import pytest

from benchmarks.contact.narrow_phase import PAIRS, SHAPES, PairsAtPoses, matrices, solid
from warp_spo.dynamics.convex_contacts import ConvexContacts, PairShape
from warp_spo.errors import UnsupportedError
from warp_spo.kernels import convex_pairs
from warp_spo.reference.convex_overlap import GrownShape, PosedPair

POSES = 40
SHALLOW = [pair for pair in PAIRS if "hull64" not in pair]
IDENTITY = (0.0, 0.0, 0.0, 1.0)
ROUNDED = {"float32": 2e-6, "float64": 1e-12}  # places and depths of figures that are known [m]
SAME_DEPTH = 2e-6  # of both precisions [m]: some 30 units in the last place of the sizes
OTHER_FACE = 1e-4  # where two faces are as near but for rounding, the least depth decides; other points differ [m]
DTYPES = ["float32", "float64"]
HALF = np.sqrt(0.5)


@functools.cache
def shallow():
    return PairsAtPoses(SHALLOW, POSES)


@functools.cache
def contacts(dtype):
    return shallow().contacts(dtype)


@functools.cache
def found(dtype):
    return contacts(dtype)(shallow().poses)


@functools.cache
def errors(dtype):
    return {row.pair: row for row in shallow().errors(contacts(dtype), dtype)}


def about(axis, angle):
    """Return the quaternion xyzw of a rotation about an axis by an angle in degrees."""
    return (*(np.sin(np.radians(angle) / 2.0) * np.eye(3)["xyz".index(axis)]), np.cos(np.radians(angle) / 2.0))


def points_of(first, second, place, turn=IDENTITY, first_turn=IDENTITY, dtype="float64", reach=0.0):
    """Return the points of two shapes, the first in the origin; by all routines, so that tests share a kernel."""
    shapes = [first, second, *(SHAPES[kind][0] for kind in ("sphere", "box", "cylinder"))]
    pairs = [(0, 1), (2, 2), (2, 3), (3, 3), (4, 4)]
    away = np.tile([9.0, 9.0, 9.0, *IDENTITY], (3, 1))
    poses = [[(0.0, 0.0, 0.0, *first_turn), (*place, *turn), *away]]
    sets = ConvexContacts(shapes, pairs, reach=reach, dtype=dtype)(poses)
    return sets.points[0, 0, : sets.counts[0, 0]]


# -- shallow poses -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("pair", [" ".join(pair) for pair in SHALLOW])
def test_shallow_poses_are_those_of_the_truth(pair, dtype):
    """None missed, no ghost, normals within 5 degrees, depths within 0.05 mm: see benchmarks.contact.narrow_phase."""
    row = errors(dtype)[pair]
    assert row.holds and row.poses == POSES, row


def test_every_pair_of_kinds_has_a_routine():
    kinds = convex_pairs.KINDS
    for first in range(len(kinds)):
        for second in range(len(kinds) - (first == kinds.index("plane"))):
            assert convex_pairs.routine(first, second) == convex_pairs.routine(second, first)
    assert len(convex_pairs.TABLE) == 21 + 6


def those_there(sets):
    """Return a mask of the points that are there [world, pair, 8]."""
    return np.arange(8) < sets.counts[..., None]


def test_both_precisions_find_the_same_depths():
    deepest = [np.where(those_there(found(dtype)), found(dtype).points[..., 6], -1.0).max(axis=2) for dtype in DTYPES]
    apart = np.abs(deepest[0] - deepest[1])
    assert (apart < SAME_DEPTH).mean() > 0.99 and apart.max() < OTHER_FACE


def test_bits_depend_neither_on_worlds_nor_on_order():
    poses, all_of, there = shallow().poses, found("float32"), those_there(found("float32"))
    turned, alone = contacts("float32")(poses[::-1]), contacts("float32")(poses[7:8])
    assert np.array_equal(all_of.counts, turned.counts[::-1]) and np.array_equal(all_of.counts[7], alone.counts[0])
    assert np.array_equal(all_of.points[there], turned.points[::-1][there])
    assert np.array_equal(all_of.points[7][there[7]], alone.points[0][there[7]])


def test_the_order_of_two_shapes_turns_normals_alone():
    """Of shapes of two kinds; two of one kind are taken as they come."""
    made = shallow()
    swapped = ConvexContacts(made.shapes, contacts("float32").pairs[:, ::-1])(made.poses)
    mixed = [i for i, (first, second) in enumerate(made.pairs) if first != second]
    there = those_there(swapped)[:, mixed]
    own, other = found("float32").points[:, mixed], swapped.points[:, mixed]
    assert np.array_equal(found("float32").counts[:, mixed], swapped.counts[:, mixed])
    assert np.array_equal(own[there] * [1, 1, 1, -1, -1, -1, 1], other[there])


# -- MuJoCo ------------------------------------------------------------------------------------------------------------
GEOMS = {"sphere": "SPHERE", "capsule": "CAPSULE", "box": "BOX", "cylinder": "CYLINDER", "ellipsoid": "ELLIPSOID"}
LIKE = 0.9  # share of poses: MuJoCo's own are within 5 degrees of the truth for 91 % of hulls
AGREE = 5e-5  # depths [m]


@pytest.mark.parametrize("pair", [(a, b) for a, b in SHALLOW if a in GEOMS and b in GEOMS])
def test_depths_and_normals_are_those_of_mujoco(pair):
    made = shallow()
    at = made.pairs.index(pair)
    spec = mujoco.MjSpec()
    for shape in made.shapes[2 * at : 2 * at + 2]:
        body = spec.worldbody.add_body(mocap=True)
        sizes = [*shape.sizes, 0.0, 0.0][:3]
        body.add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{GEOMS[shape.kind]}"), size=sizes, margin=0.0)
    model = spec.compile()
    data = mujoco.MjData(model)
    sets = found("float64")
    alike = []
    for world, poses in enumerate(made.poses[:, 2 * at : 2 * at + 2]):
        data.mocap_pos[:], data.mocap_quat[:] = poses[:, :3], poses[:, [6, 3, 4, 5]]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        own = sets.points[world, at, : sets.counts[world, at]]
        deepest = own[own[:, 6].argmax()]
        line = np.zeros(6)
        distance = mujoco.mj_geomDistance(model, data, 0, 1, 0.01, line)
        assert distance < 0.0
        normal = (line[3:] - line[:3]) / np.linalg.norm(line[3:] - line[:3])
        alike.append(abs(-distance - deepest[6]) < AGREE and abs(normal @ deepest[3:6]) > np.cos(np.radians(5.0)))
    assert np.mean(alike) >= LIKE


# -- edges, faces, sides -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("degrees", [90.0, 60.0, 10.0])
def test_crossed_edges_rest_on_each_other(dtype, degrees):
    """Two beams with a sharp edge each, one along x and one turned by an angle, 1 mm deep where they cross."""
    beam = PairShape("box", (0.3, 0.05, 0.05))
    upper = np.array(about("x", 45.0))
    turn = np.array(about("z", degrees))
    both = product(turn, upper)
    points = points_of(beam, beam, (0.01, 0.0, -0.1 / HALF * 1.0 + 1e-3), both, tuple(upper), dtype)
    assert len(points) == 1
    assert np.allclose(points[0, 3:6], [0.0, 0.0, 1.0], atol=1e-5)
    assert np.allclose(points[0, [2, 6]], [-0.05 / HALF + 0.5e-3, 1e-3], atol=ROUNDED[dtype])
    across = np.sin(np.radians(degrees))
    assert np.allclose(points[0, :2], [0.01, 0.0], atol=10.0 * ROUNDED[dtype] / across)  # where lines cross


def product(p, q):
    """Return the product of two quaternions xyzw."""
    v = p[3] * q[:3] + q[3] * p[:3] + np.cross(p[:3], q[:3])
    return (*v, p[3] * q[3] - p[:3] @ q[:3])


@pytest.mark.parametrize("kind", ["box", "hull"])
@pytest.mark.parametrize("sharp", [False, True])
@pytest.mark.parametrize("dtype", DTYPES)
def test_a_bar_lies_on_two_sharp_edges(kind, sharp, dtype):
    """A face has a point at both of its sides on each edge; an edge of the bar has one. All push up, 0.2 mm deep."""
    half = np.array([0.3, 0.02, 0.02])
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    bar = PairShape("box", tuple(half)) if kind == "box" else PairShape("hull", corners)
    wedge = PairShape("box", (0.05, 0.2, 0.05))
    low = 0.02 / HALF if sharp else 0.02
    for x in (-0.15, 0.15):
        place = (x, 0.0, -low - 0.05 / HALF + 2e-4)
        points = points_of(bar, wedge, place, about("y", 45.0), about("x", 45.0 if sharp else 0.0), dtype)
        assert len(points) == (1 if sharp else 2)
        assert np.allclose(points[:, 3:6], [0.0, 0.0, 1.0], atol=1e-5)
        assert np.allclose(points[:, [0, 2, 6]], [x, -low + 1e-4, 2e-4], atol=ROUNDED[dtype])
        assert np.allclose(np.sort(points[:, 1]), 0.0 if sharp else [-0.02, 0.02], atol=2e-5)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("kind", ["box", "cylinder", "hull", "capsule"])
def test_what_lies_on_a_face_has_all_its_support(kind, dtype):
    """Flat, 0.1 mm deep, and half a centimetre over the side of a box: corners, a cap, the part of a segment."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.05
    shape = {
        "box": PairShape("box", (0.05, 0.05, 0.05)), "cylinder": PairShape("cylinder", (0.05, 0.05)),
        "hull": PairShape("hull", corners), "capsule": PairShape("capsule", (0.05, 0.05)),
    }[kind]  # fmt: skip
    turn = about("y", 90.0) if kind == "capsule" else IDENTITY
    points = points_of(PairShape("box", (0.1, 0.2, 0.1)), shape, (0.055, 0.01, 0.1499), turn, dtype=dtype)
    assert len(points) == {"box": 4, "hull": 4, "cylinder": 4, "capsule": 2}[kind]
    assert np.allclose(points[:, 3:6], [0.0, 0.0, -1.0], atol=1e-5)
    assert np.allclose(points[:, [2, 6]], [0.09995, 1e-4], atol=ROUNDED[dtype])
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    assert low[0] == pytest.approx(0.005, abs=4e-3 if kind == "cylinder" else 2e-6)
    assert high[0] == pytest.approx(0.1, abs=4e-3 if kind == "cylinder" else 2e-6)
    assert kind == "capsule" or np.ptp(points[:, 1]) == pytest.approx(0.1, abs=1e-2)


def test_two_boxes_turned_on_each_other_have_eight_points():
    box = PairShape("box", (0.05, 0.05, 0.05))
    points = points_of(box, box, (0.0, 0.0, 0.0999), about("z", 45.0))
    corner = 0.05 * np.tan(np.radians(22.5))
    assert len(points) == 8
    assert np.allclose(np.sort(np.abs(points[:, :2]), axis=1), [corner, 0.05], atol=1e-12)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("first, second", [("capsule", "capsule"), ("capsule", "cylinder"), ("cylinder", "cylinder")])
def test_sides_that_lie_along_each_other_have_both_ends(first, second, dtype):
    a, b = PairShape(first, (0.03, 0.1)), PairShape(second, (0.02, 0.1))
    points = points_of(a, b, (0.0499, 0.0, 0.06), dtype=dtype)
    assert np.allclose(points[:, 3:6], [-1.0, 0.0, 0.0], atol=1e-4)
    assert np.allclose(points[:, [0, 6]], [0.02995, 1e-4], atol=ROUNDED[dtype])
    assert np.allclose([points[:, 2].min(), points[:, 2].max()], [-0.04, 0.1], atol=1e-3)


@pytest.mark.parametrize("kind", [kind for kind in SHAPES if kind != "hull64"])
def test_shapes_on_a_plane_are_as_deep_as_they_reach(kind):
    shape, rng = SHAPES[kind][0], np.random.default_rng(3)
    worlds, plane = 16, PairShape("plane")
    turns = rng.normal(size=(worlds, 2, 4))
    turns /= np.linalg.norm(turns, axis=2, keepdims=True)
    own, ground = matrices(turns[:, 0]), matrices(turns[:, 1])
    up = ground[:, :, 2]
    reach = solid(shape).reach(-np.einsum("wrs,wr->ws", own, up))
    poses = np.zeros((worlds, 2, 7))
    poses[:, :, 3:], poses[:, 0, :3] = turns, up * (reach - 1e-3)[:, None]
    sets = ConvexContacts([shape, plane], [(0, 1)], dtype="float64")(poses)
    depth = np.where(those_there(sets), sets.points[..., 6], -1.0)
    assert np.allclose(depth.max(axis=2), 1e-3, atol=1e-9) and (sets.counts <= 4).all()
    assert np.allclose(sets.points[:, 0, 0, 3:6], up)


def test_points_apart_count_within_reach():
    box = PairShape("box", (0.05, 0.05, 0.05))
    assert len(points_of(box, box, (0.0, 0.0, 0.101))) == 0
    points = points_of(box, box, (0.0, 0.0, 0.101), reach=2e-3)
    assert len(points) == 4 and np.allclose(points[:, 6], -1e-3)


def test_rounding_is_a_larger_shape():
    """A box grown by 1 cm touches as deep as the reference says, at its faces and its corners."""
    grown, ball = PairShape("box", (0.05, 0.05, 0.05), 0.01), PairShape("sphere", (0.03,))
    place = 0.05 + (0.04 - 1e-3) / np.sqrt(3.0) * np.ones(3)
    points = points_of(grown, ball, place)
    assert np.allclose(points[0, 3:], [*-np.ones(3) / np.sqrt(3.0), 1e-3], atol=1e-9)
    cube = PairShape("box", (0.05, 0.05, 0.05))
    points = points_of(grown, cube, (0.0, 0.0, 0.1095))
    assert len(points) == 4 and np.allclose(points[:, 6], 5e-4)


def test_the_reference_knows_closed_forms():
    """Spheres, and a ball beside a cylinder's rim."""
    turn = np.eye(3)[None]
    ball, rod = GrownShape("sphere", np.zeros(3), 0.05), GrownShape("cylinder", np.array([0.03, 0.03, 0.1]))
    pair = PosedPair(ball, ball, turn, turn, np.array([[0.0, 0.06, 0.0]]))
    assert pair.least().depth == pytest.approx(0.04)
    place = np.array([[0.03 + 0.03, 0.0, 0.1 + 0.039]])
    least = PosedPair(rod, ball, turn, turn, place).least()
    assert least.depth == pytest.approx(0.05 - np.hypot(0.03, 0.039), abs=1e-7)
    assert np.allclose(least.normal[0], [-0.6097, 0.0, -0.7926], atol=1e-3)


# -- errors ------------------------------------------------------------------------------------------------------------
BOX = PairShape("box", (0.1, 0.1, 0.1))


@pytest.mark.parametrize(
    "shapes, pairs, message",
    [
        ([BOX, PairShape("torus", (0.1,))], [(0, 1)], "shape 1 is a 'torus'; expected one of sphere, capsule"),
        ([BOX, PairShape("capsule", (0.1,))], [(0, 1)], r"a capsule, has sizes \[0.1\]; expected 2 above zero"),
        ([BOX, PairShape("box", (0.1, 0.1, 0.0))], [(0, 1)], "expected 3 above zero"),
        ([BOX, PairShape("sphere", (0.1,), -1.0)], [(0, 1)], "rounding -1.0; expected 0 or more"),
        ([BOX, BOX], [(0, 2)], "pairs names shapes from 0 to 2; there are 2"),
        ([BOX, BOX], [0, 1], "pairs has shape"),
        ([BOX, PairShape("hull", np.eye(3))], [(0, 1)], "in one plane"),
    ],
)
def test_bad_shapes_and_pairs_are_refused(shapes, pairs, message):
    with pytest.raises(ValueError, match=message):
        ConvexContacts(shapes, pairs)


def test_two_planes_are_refused():
    with pytest.raises(UnsupportedError, match="two planes"):
        ConvexContacts([PairShape("plane"), PairShape("plane")], [(0, 1)])
