"""Points and spheres on convex hulls: their faces and points, steps against the dense one, and motions."""

from itertools import pairwise

import mujoco
import numpy as np
import pytest
import warp as wp
from scipy.optimize import minimize_scalar, nnls
from scipy.spatial import ConvexHull

import warp_spo as spo
from support.hull_scenes import CAN, CUBE, LAW, TETRAHEDRON
from support.pair_scenes import WEDGE, cube, free, stepped
from support.pair_steps import assert_is_dense
from support.pair_touches import hull_of, planted, touches_found
from warp_spo.kernels import hull_distance
from warp_spo.reference import body_contact
from warp_spo.reference.rotations import homogeneous
from warp_spo.scene.extreme_points import farthest_points
from warp_spo.scene.hulls import MOST


def test_faces_are_those_of_qhull():
    """Faces, corners and volumes, of clouds in float64 and float32, of cubes cut into cells, and of a can."""
    rng = np.random.default_rng(0)
    clouds = [rng.normal(size=(n, 3)) * rng.uniform(0.01, 1.0, 3) + 3.0 for n in (4, 5, 8, 13, 25)]
    clouds += [np.float64(np.float32(cloud)) for cloud in clouds]
    for cloud in clouds:
        hull, middle = hull_of(cloud)
        known = ConvexHull(cloud)
        assert len(hull.faces) == len(known.simplices)
        np.testing.assert_array_equal(np.sort(hull.corners + middle, axis=0), np.sort(cloud[known.vertices], axis=0))
        normals = np.column_stack([hull.normals, hull.offsets + hull.normals @ middle])
        wanted = known.equations * [1.0, 1.0, 1.0, -1.0]
        apart = np.abs(normals[:, None] - wanted).max(axis=2)
        assert apart.min(axis=0).max() < 1e-9 and apart.min(axis=1).max() < 1e-9
    side = np.linspace(-1.0, 1.0, 5)
    cells = np.stack(np.meshgrid(side, side, side), axis=-1).reshape(-1, 3)
    rounded = cells * [1.0, 0.1, 0.3] + 1e-7 * rng.uniform(-1.0, 1.0, cells.shape)  # no two of an edge in line
    known = [(cells, 6, 8), (rounded, 6, 8), (np.float32(CAN), 14, 24), (WEDGE, 5, 6), (TETRAHEDRON, 4, 4)]
    for points, faces, corners in known:
        hull, _ = hull_of(points)
        assert (len(hull.faces), len(hull.corners)) == (faces, corners)
        fans = [hull.corners[[face[0], *two]] for face in hull.faces for two in pairwise(face[1:])]
        volume = sum(np.linalg.det(fan) for fan in fans) / 6.0  # counterclockwise, seen from outside
        np.testing.assert_allclose(volume, ConvexHull(points).volume, rtol=1e-6)


def test_flat_and_long_hulls_keep_all_corners_on_the_ground(monkeypatch):
    """Also those that reach farthest in few directions, none of which is looked in; in parts, where points are many."""
    for seed, scale in enumerate(([1, 1, 0.2], [1, 1, 0.2], [1, 0.4, 0.05], [1, 0.05, 0.05], [1, 0.02, 0.01])):
        cloud = np.random.default_rng(seed + 1).normal(size=(40, 3)) * scale
        wanted = cloud[np.sort(ConvexHull(cloud).vertices)]
        np.testing.assert_array_equal(spo.Contact(0, hull=cloud).positions, wanted)
        few = cloud[:10]
        np.testing.assert_array_equal(farthest_points(few, 16), np.sort(ConvexHull(few).vertices))  # of a file's mesh
    monkeypatch.setattr("warp_spo.scene.extreme_points.AT_ONCE", 1000)
    np.testing.assert_array_equal(spo.Contact(0, hull=cloud).positions, wanted)


def test_a_hull_that_is_none_has_a_name():
    """Flat ones, and those of too many faces or corners."""
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(100, 3)) / 10.0
    ball /= np.linalg.norm(ball, axis=1)[:, None]
    solid = dict(hull=TETRAHEDRON)
    cases = [
        (dict(hull=TETRAHEDRON[:3]), dict(point=(0, 0, 0)), ValueError, "in one plane; expected points that span"),
        (dict(hull=CUBE * [1, 1, 0]), dict(point=(0, 0, 0)), ValueError, "points in one plane"),
        (dict(hull=ball), dict(sphere=0.1), spo.UnsupportedError, f"more than {MOST} corners .* coarser mesh"),
        (dict(hull=ball[:36]), dict(sphere=0.1), spo.UnsupportedError, f"68 faces, more than {MOST}"),
        (solid, dict(box=(1, 1, 0)), ValueError, "points in one plane"),
        (dict(hull=CAN), dict(hull=CAN), spo.UnsupportedError, "largest faces have 24 corners together, more than 16"),
    ]
    for one, other, kind, message in cases:
        for a, b in ((one, other), (other, one)):
            with pytest.raises(kind, match=message):
                free([cube(1.0, 0.1)] * 2, [spo.Contact(0, **a, other=spo.Contact(1, **b))])


# -- points ------------------------------------------------------------------------------------------------------------
def truth(local, corners):
    """Distance of a point from the hull of some corners and its nearest point, by other people's algorithms.

    Outside, the smallest norm in the hull of the corners less the point: Lawson and Hanson, ch. 23, with their
    algorithm for least squares that are not negative. Inside, Qhull's planes.
    """
    planes = ConvexHull(corners).equations
    heights = planes[:, :3] @ local + planes[:, 3]
    if heights.max() <= 0.0:
        return heights.max(), local - heights.max() * planes[heights.argmax(), :3]
    weights, _ = nnls(np.vstack([(corners - local).T, np.ones(len(corners))]), np.array([0.0, 0.0, 0.0, 1.0]))
    nearest = weights @ corners / weights.sum()
    return np.linalg.norm(local - nearest), nearest


BODIES = (TETRAHEDRON, WEDGE, CUBE, CAN)


def touched(device, corners, order, places, radius, dtype=wp.float64, half=0.0, turns=(0, 0, 0, 1)):
    """Points of a ball or a capsule at ``places`` in the frame of a hull, as native code finds them.

    Return place, normal, depth; of the four points of a capsule [world, point, ...]. Its ``turns`` are in that frame.
    """
    hull, middle = hull_of(corners)
    turn = np.array([0.1, -0.3, 0.2, 0.9])
    turn /= np.linalg.norm(turn)
    frame = homogeneous([0.3, -0.2, 0.5, *turn])
    poses = np.zeros((len(places), 2, 7))
    poses[:, 1], poses[:, 0, 3:] = [0.3, -0.2, 0.5, *turn], product(turn, np.broadcast_to(turns, (len(places), 4)))
    poses[:, 0, :3] = places @ frame[:3, :3].T + frame[:3, 3]
    sizes = np.ptp(hull.corners, axis=0) / 2.0
    rows = np.array([[0, 0, 0, 0, 0, 0, 1, 0, 0, half, radius], [*middle, 0, 0, 0, 1, *sizes, 0.0]])
    kinds = [0, 2]
    if order:
        poses, rows, kinds = poses[:, ::-1].copy(), rows[::-1].copy(), [2, 0]
    found, sign = touches_found(device, poses, kinds, rows, [corners], most=4, dtype=dtype), -1.0 if order else 1.0
    found = found if half else found[:, 0]
    at = found[..., :3] + (poses[:, None] if half else poses)[..., 0, :3] - frame[:3, 3]
    return at @ frame[:3, :3], sign * found[..., 3:6] @ frame[:3, :3], found[..., 6]


def product(a, b):
    """The product of a quaternion with others."""
    v = a[3] * b[:, :3] + b[:, 3:] * a[:3] + np.cross(a[:3], b[:, :3])
    return np.column_stack([v, a[3] * b[:, 3] - b[:, :3] @ a[:3]])


def around(corners, rng, count=60):
    """Points inside a hull, over its faces, edges and corners, and anywhere around it."""
    hull, middle = hull_of(corners)
    far = rng.normal(size=(count, 3)) * 0.3
    near = np.concatenate([hull.corners, 0.9 * hull.corners])  # and no two faces as near
    near += 1e-3 * rng.normal(size=near.shape)
    faces = [hull.corners[list(face)].mean(axis=0) for face in hull.faces] + 0.02 * hull.normals
    return np.concatenate([far, near, faces, 0.3 * far]) + middle


def test_points_of_a_hull_are_the_nearest_ones(device):
    check_points(device, WEDGE, around(WEDGE, np.random.default_rng(0), 20))


@pytest.mark.slow
@pytest.mark.parametrize("number", range(len(BODIES)))
def test_points_of_other_hulls_are_the_nearest_ones(device, number):
    check_points(device, BODIES[number], around(BODIES[number], np.random.default_rng(number)))


def check_points(device, corners, places):
    radius = 0.04
    for order in (0, 1):
        at, normal, depth = touched(device, corners, order, places, radius)
        inside = 0
        for i, local in enumerate(places):
            distance, nearest = truth(local, corners)
            inside += distance < 0.0
            np.testing.assert_allclose(radius - depth[i], distance, atol=1e-12)
            np.testing.assert_allclose(local - (radius - depth[i]) * normal[i], nearest, atol=1e-9)
            np.testing.assert_allclose(at[i], nearest - 0.5 * depth[i] * normal[i], atol=1e-9)
            np.testing.assert_allclose(np.linalg.norm(normal[i]), 1.0, atol=1e-12)
            if i % 4 == order and len(corners) <= 8:
                ours, out = body_contact.out_of_hull(local, np.asarray(corners))
                np.testing.assert_allclose([ours, *(ours * out)], [distance, *(local - nearest)], atol=1e-9)
        assert 4 <= inside < len(places) - 15


BUGS = {
    "edges without ends": ("share = share < 0 ? 0 : share > 1 ? 1 : share;", ""),
    "the first face is the nearest": ("face == begin || height > most", "face == begin"),
    "faces without borders": ("over = over && dot(from, outward) <= 0;", ""),
    "faces that are not seen": ("if (!(height > 0)) continue;", "if (height != height) continue;"),
    "the last edge counts": ("least < 0 || square < least", "true"),
}


@pytest.mark.slow
@pytest.mark.parametrize("bug", BUGS)
def test_a_planted_bug_of_hulls_is_seen(monkeypatch, device, bug):
    with planted(monkeypatch, hull_distance, *BUGS[bug]), pytest.raises(AssertionError):
        test_points_of_a_hull_are_the_nearest_ones(device)


@pytest.mark.slow
def test_capsules_on_a_hull_are_nearest_where_they_touch(device):
    """The deepest point is as deep as the axis is near, which a search along it finds; two are about as near."""
    rng, half, radius = np.random.default_rng(0), 0.12, 0.03
    for corners in (WEDGE, TETRAHEDRON):
        places = around(corners, rng, 40)
        turns = rng.normal(size=(len(places), 4))
        turns /= np.linalg.norm(turns, axis=1)[:, None]
        for order in (0, 1):
            at, normal, depth = touched(device, corners, order, places, radius, half=half, turns=turns)
            outside = 0
            for i, (place, turn) in enumerate(zip(places, turns, strict=True)):
                axis = homogeneous([0, 0, 0, *turn])[:3, 2]
                found = minimize_scalar(lambda s: truth(place + s * axis, corners)[0], bounds=(-half, half),  # noqa: B023
                                        method="bounded", options=dict(xatol=1e-9))  # fmt: skip
                near = min(found.fun, *(truth(place + s * axis, corners)[0] for s in (-half, half)))
                np.testing.assert_allclose(radius - depth[i].max(), near, atol=1e-7)
                if near < 1e-3:  # inside, depths are along the normal of the nearest face
                    continue
                outside += 1
                for end in range(4):
                    on_axis = at[i, end] + (radius - 0.5 * depth[i, end]) * normal[i, end]
                    along = (on_axis - place) @ axis
                    np.testing.assert_allclose(on_axis, place + along * axis, atol=1e-9)
                    distance, _ = truth(on_axis, corners)
                    assert abs(along) <= half + 1e-9
                    if end in (1, 2):
                        assert near - 1e-9 < distance < near + 1.001e-3 * half
                    else:
                        np.testing.assert_allclose(radius - depth[i, end], distance, atol=1e-9)
            assert outside > 20


@pytest.mark.slow
def test_points_of_a_hull_in_float32(device):
    """As exact near edges and corners as elsewhere: the normal of a ball comes from far enough."""
    places = around(WEDGE, np.random.default_rng(0))
    _, normal, depth = touched(device, WEDGE, 0, places, 0.04, wp.float32)
    _, wanted, deep = touched(device, WEDGE, 0, places, 0.04)
    np.testing.assert_allclose(depth, deep, atol=2e-7)
    far = np.abs(0.04 - deep) > 1e-3
    np.testing.assert_allclose(normal[far], wanted[far], atol=3e-4)


@pytest.mark.slow
def test_distances_are_those_of_mujoco(device):
    """Of a ball and a mesh, outside; MuJoCo's algorithm stops within 1e-6."""
    for corners in BODIES[:3]:
        listed = " ".join(map(str, np.asarray(corners).ravel()))
        model = mujoco.MjModel.from_xml_string(
            f"""<mujoco><asset><mesh name="m" vertex="{listed}"/></asset><worldbody><geom type="mesh" mesh="m"/>
            <body><freejoint/><geom type="sphere" size="0.04"/></body></worldbody></mujoco>"""
        )
        data, places = mujoco.MjData(model), around(corners, np.random.default_rng(1), 100)
        _, _, depth = touched(device, corners, 0, places, 0.04)
        for place, deep in zip(places, depth, strict=True):
            data.qpos[:3] = place
            mujoco.mj_kinematics(model, data)
            if deep < 0.0:
                apart = mujoco.mj_geomDistance(model, data, 0, 1, 10.0, None)
                np.testing.assert_allclose(apart, -deep, atol=2e-6)


def test_a_ball_over_an_edge_turns_smoothly(device):
    """From one face to the next over an edge: the normal turns as far as the ball goes round, and does not jump."""
    edge, angle = np.array([0.12, 0.0, 0.1]), np.linspace(-0.3, 2.4, 4001)
    way = np.column_stack([np.sin(angle - 0.2), np.zeros_like(angle), np.cos(angle - 0.2)])
    _, normal, depth = touched(device, WEDGE, 0, edge + 0.03 * way, 0.04)
    step = np.linalg.norm(np.diff(normal, axis=0), axis=1)
    assert step.max() < 1.1 * (angle[1] - angle[0]) and np.abs(np.diff(depth)).max() < 0.03 * (angle[1] - angle[0])
    on_edge = (way[:, 0] > 0.01) & (way[:, 2] > 0.01) & (np.arctan2(way[:, 0], way[:, 2]) > -np.arctan2(0.1, 0.27))
    np.testing.assert_allclose(normal[on_edge], way[on_edge], atol=1e-12)


# -- steps -------------------------------------------------------------------------------------------------------------
def rocks():
    """A ball and a tetrahedron that fly, an arm, and a wedge that stands still: each order, two hulls of a scene."""
    bodies = [cube(0.5, 0.04), cube(1.0, 0.06), cube(0.7, 0.05)]
    hinges = [spo.Hinge("free", -1, 0), spo.Hinge("free", -1, 1),
              spo.Hinge("revolute", -1, 2, axis=(0, 1, 0), parent_pose=(-0.04, 0, 0.52, 0, 0, 0, 1), armature=0.01,
                        target_ke=30.0, target_kd=1.0, effort_limit=4.0)]  # fmt: skip
    ball, rock, tip = dict(sphere=0.04), dict(hull=TETRAHEDRON), dict(point=(0.0, 0.0, -0.205))
    wedge = spo.Contact(-1, hull=WEDGE)
    contacts = [
        spo.Contact(1, **rock, **LAW),
        spo.Contact(0, **ball, other=wedge, friction=0.4, **LAW),
        spo.Contact(1, **rock, other=spo.Contact(0, **ball), **LAW),
        spo.Contact(2, **tip, other=spo.Contact(1, **rock), friction=0.6, **LAW),
        spo.Contact(1, **rock, other=spo.Contact(-1, sphere=((0.09, 0.12, 0.33), 0.05)), **LAW),
        spo.Contact(2, capsule=((0.04, 0.0, 0.1), (0.04, 0.0, -0.18), 0.03), other=spo.Contact(1, **rock), **LAW),
        spo.Contact(
            0, box=(0.03, 0.03, 0.03), other=spo.Contact(2, capsule=((0, 0, 0), (-0.045, 0.0, -0.41), 0.02)), **LAW
        ),
    ]
    return spo.Scene(bodies, hinges, contacts=contacts)


def rocks_states(seed, worlds):
    """Return q, qd of ``rocks``: ball, tetrahedron and tip near each other over the wedge; in the last world apart."""
    rng, scene = np.random.default_rng(seed), rocks()
    q, qd = np.tile(scene.neutral_q, (worlds, 1)), 0.4 * rng.normal(size=(worlds, scene.dof_count))
    q[:, :3], q[:, 7:10] = [-0.04, 0.0, 0.08], [-0.04, 0.0, 0.217]
    q[:, :3] += 0.003 * rng.normal(size=(worlds, 3))
    q[:, 7:10] += 0.003 * rng.normal(size=(worlds, 3))
    q[:, 10:14] = np.array([0.0, 0.0, 0.0, 1.0]) + 0.02 * rng.normal(size=(worlds, 4))
    q[:, 10:14] /= np.linalg.norm(q[:, 10:14], axis=1)[:, None]
    q[:, 14] = 0.03 * rng.normal(size=worlds)
    q[-1, 2], q[-1, 9] = 3.0, 5.0
    return np.float64(np.float32(q)), np.float64(np.float32(qd))


@pytest.mark.slow
def test_a_step_with_hulls_is_the_dense_one(device):
    """Hulls on either side, one that stands still; a world does alone what it does among others."""
    (q, qd), scene = rocks_states(0, 6), rocks()
    dyn = spo.Dynamics(scene, 6, device=device, dtype="float64")
    found = assert_is_dense(dyn, q, qd, least=12)
    assert (found["contact_f"][:, len(scene.contact_points) :] != 0.0).any(axis=(0, 2)).all()
    for alone in (0, 5):
        dyn = spo.Dynamics(scene, 1, device=device, dtype="float64")
        one = stepped(dyn, q[alone : alone + 1], qd[alone : alone + 1])
        for key in ("q", "qd", "contact_f"):
            np.testing.assert_array_equal(one[key][0], found[key][alone])
