"""Hulls that touch hulls and boxes: their points, steps against the dense one, and what stands or is held."""

import numpy as np
import pytest

import warp_spo as spo
from support.hull_scenes import CAN, CUBE, LAW, TETRAHEDRON, gripper, lifted
from support.pair_motions import momentum, stand
from support.pair_scenes import WEDGE, box, cube, free, stack, stacked, stepped
from support.pair_steps import assert_is_dense
from support.pair_touches import hull_of, planted, touches_found
from warp_spo.kernels import hull_clipping, narrow_phase
from warp_spo.reference import body_contact
from warp_spo.reference.rotations import homogeneous

PRISM = np.array([[0.07 * np.cos(a), 0.05 * np.sin(a), z] for a in np.arange(6) * np.pi / 3.0 for z in (-0.04, 0.05)])


def touched(device, shapes, poses):
    """Points of two hulls at poses [world, 2, 7], as native code finds them, and as the reference does."""
    both = [hull_of(points) for points in shapes]
    rows = np.array([[*middle, 0, 0, 0, 1, *np.ptp(hull.corners, axis=0) / 2.0, 0] for hull, middle in both])
    for pose, points in zip(poses, touches_found(device, poses, (2, 3), rows, shapes, most=16), strict=True):
        points = points[points[:, 6] > narrow_phase.AWAY]
        points[:, :3] += pose[0, :3]
        solids = [(2, homogeneous(at) @ homogeneous(row[:7]), hull.corners, 0.0)
                  for at, row, (hull, _) in zip(pose, rows, both, strict=True)]  # fmt: skip
        yield points, np.array([[*point, *n, depth] for point, n, depth in body_contact.touches(*solids)])


def assert_same(found, wanted):
    """The same points, in any order."""
    assert len(found) == len(wanted)
    for row in wanted:
        nearest = np.abs(found - row).max(axis=1).argmin()
        np.testing.assert_allclose(found[nearest], row, atol=1e-11)
        found = np.delete(found, nearest, axis=0)


def near(rng, worlds, apart):
    """Random poses, every other pair of bodies nearly aligned."""
    poses = np.concatenate([apart * rng.normal(size=(worlds, 2, 3)), rng.normal(size=(worlds, 2, 4))], axis=2)
    poses[::2, :, 3:] = np.array([0.0, 0.0, 0.02, 1.0]) + 0.01 * rng.normal(size=(len(poses[::2]), 2, 4))
    poses[..., 3:] /= np.linalg.norm(poses[..., 3:], axis=2)[..., None]
    return poses


@pytest.mark.slow
@pytest.mark.parametrize("shapes", [(WEDGE, TETRAHEDRON), (CUBE, PRISM), (CAN, WEDGE), (PRISM, PRISM)])
def test_points_of_two_hulls_are_those_of_the_reference(device, shapes):
    counts = set()
    for found, wanted in touched(device, shapes, near(np.random.default_rng(0), 60, 0.06)):
        assert_same(found, wanted)
        counts.add(len(wanted))
    assert len(counts) > 3


@pytest.mark.slow
def test_cubes_as_hulls_share_what_boxes_share(device):
    for pose, (found, _) in zip(
        poses := near(np.random.default_rng(1), 100, 0.05), touched(device, (CUBE, CUBE), poses), strict=True
    ):
        boxes = [(1, homogeneous(at), np.full(3, 0.05), 0.0) for at in pose]
        wanted = np.array([[*point, *n, depth] for point, n, depth in body_contact.faces(*boxes)]).reshape(-1, 7)
        assert_same(found, wanted)


BUGS = {
    "the first face is the nearest": ("const bool more = face == hulls::first_face_of(a.hull) || apart + least > most;",
                                      "const bool more = face == hulls::first_face_of(a.hull);"),
    "the other face looks away": ("cosine < toward", "cosine > -toward"),
    "edges are not left": ("if (to < 1) common.put(end, here, out);", ""),
    "corners of the common face are forgotten": ("if (!within_it) continue;", "continue;"),
    "both normals lead out of the first": ("swap ? common.outward[r] : -common.outward[r]", "-common.outward[r]"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("bug", BUGS)
def test_a_planted_bug_of_faces_is_seen(monkeypatch, device, bug):
    with planted(monkeypatch, hull_clipping, *BUGS[bug]), pytest.raises(AssertionError):
        test_points_of_two_hulls_are_those_of_the_reference(device, (WEDGE, TETRAHEDRON))


# -- steps -------------------------------------------------------------------------------------------------------------
def stones():
    """A prism on a wedge that stands still, a box on the prism, and a tetrahedron at its side and on a post."""
    wedge, post = spo.Contact(-1, hull=2.0 * WEDGE), spo.Contact(-1, hull=CUBE + np.array([0.19, -0.08, 0.16]))
    contacts = [spo.Contact(0, hull=PRISM, other=wedge, **LAW),
                box(1, 0.05, other=spo.Contact(0, hull=PRISM), **LAW),
                spo.Contact(2, hull=TETRAHEDRON, other=box(1, 0.05), friction=0.4, **LAW),
                spo.Contact(2, hull=TETRAHEDRON, other=post, **LAW)]  # fmt: skip
    return free([cube(1.0, 0.05), cube(0.5, 0.05), cube(0.7, 0.08)], contacts, (0.0, 0.0, -9.81))


def stones_states(seed, worlds):
    rng, scene = np.random.default_rng(seed), stones()
    q, qd = np.tile(scene.neutral_q, (worlds, 1)), 0.3 * rng.normal(size=(worlds, scene.dof_count))
    turn = 0.5 * np.arctan2(0.1, 0.27)
    q[:, :3], q[:, 3:7] = [0.0, 0.0, 0.15], [0.0, -np.sin(turn), 0.0, np.cos(turn)]
    q[:, 7:10], q[:, 10:14] = [-0.03, 0.0, 0.243], [0.0, -np.sin(turn), 0.0, np.cos(turn)]
    q[:, 14:17] = [0.09, 0.02, 0.3]
    for first in (0, 7, 14):
        q[:, first : first + 3] += 0.003 * rng.normal(size=(worlds, 3))
        q[:, first + 3 : first + 7] += 0.02 * rng.normal(size=(worlds, 4))
        q[:, first + 3 : first + 7] /= np.linalg.norm(q[:, first + 3 : first + 7], axis=1)[:, None]
    return np.float64(np.float32(q)), np.float64(np.float32(qd))


@pytest.mark.slow
def test_a_step_of_stones_is_the_dense_one(device):
    dyn = spo.Dynamics(stones(), 6, device=device, dtype="float64")
    found = assert_is_dense(dyn, *stones_states(0, 6), least=12)
    assert (found["contact_f"] != 0.0).any(axis=(0, 2)).all()


@pytest.mark.slow
def test_float32_of_stones_loses_two_digits_at_most(device):
    """Stiff contacts in a row multiply rounding, on CPUs and GPUs alike; off by a share of the largest rate.

    Measured in 256 worlds: median 4e-6, worst 1.9e-4 on a CPU and 1.1e-4 on an H200.
    """
    q, qd = stones_states(0, 256)
    exact, found = (
        stepped(spo.Dynamics(stones(), 256, device=device, dtype=dtype), q, qd)["qd"]
        for dtype in ("float64", "float32")
    )
    off = np.abs(found - exact).max(axis=1) / np.abs(exact).max(axis=1)
    assert np.median(off) < 1e-5 and off.max() < 5e-4


@pytest.mark.slow
def test_a_stack_of_hulls_stands(device):
    """Three cubes as hulls, offset and turned, as boxes do; momentum is kept where they fly."""
    as_hulls = stack((5.0,) * 3)
    corners = dict(hull=2.0 * CUBE)
    contacts = [as_hulls.contacts[0], *(spo.Contact(i, **corners, other=spo.Contact(i - 1, **corners)) for i in (1, 2))]
    as_hulls = as_hulls.with_contacts(contacts)
    fastest, drift, q, force = stand(as_hulls, stacked(3), 4.0, 2.0, device)
    assert fastest < 1e-5 and drift < 1e-4
    np.testing.assert_allclose(force[4:, 2], 9.81 * np.array([10.0, 5.0]), rtol=1e-4)
    _, _, as_boxes, _ = stand(stack((5.0,) * 3), stacked(3), 4.0, 2.0, device)
    np.testing.assert_allclose(q, as_boxes, atol=1e-7)


@pytest.mark.slow
def test_stones_that_meet_keep_their_momentum(device):
    scene = free(
        [cube(1.0, 0.05), cube(0.7, 0.08)], [spo.Contact(0, hull=PRISM, other=spo.Contact(1, hull=TETRAHEDRON), **LAW)]
    )
    rng, worlds = np.random.default_rng(0), 20
    q, qd = np.zeros((worlds, 14)), 0.5 * rng.normal(size=(worlds, 12))
    q[:, 3:7], q[:, 10:14] = rng.normal(size=(worlds, 4)), rng.normal(size=(worlds, 4))
    for turn in (q[:, 3:7], q[:, 10:14]):
        turn /= np.linalg.norm(turn, axis=1)[:, None]
    q[:, 7], qd[:, 0], qd[:, 6] = 0.3, 1.0, -1.0
    before, dyn, force, met = (
        momentum(scene, q, qd),
        spo.Dynamics(scene, worlds, device=device, dtype="float64"),
        np.zeros((worlds, 1, 3)),
        0,
    )
    for _ in range(60):
        q, qd = dyn.step(q, qd, None, 5e-3, report=spo.StepReport(contact_f=force))
        met = np.maximum(met, np.abs(force).max(axis=(1, 2)))
    assert (met > 1.0).sum() > 15
    np.testing.assert_allclose(momentum(scene, q, qd), before, atol=1e-11)


@pytest.mark.slow
def test_a_gripper_with_pads_holds_a_prism(device):
    """Pads are boxes that press two of its six faces with 40 N, and lift it by 0.1 m."""
    pad = [dict(box=((0.02, 0.01, 0.02), (0.0, 0.01 * side, 0.01, 0.0, 0.0, 0.0, 1.0))) for side in (1.0, -1.0)]
    hexagon = np.arange(6) * np.pi / 3.0
    prism = dict(hull=np.array([[0.06 * np.cos(a), 0.06 * np.sin(a), z] for a in hexagon for z in (-0.05, 0.05)]))
    base = gripper(prism)
    contacts = [
        spo.Contact(1 + i, **pad[i], other=spo.Contact(3, **prism), stiffness=4e4, damping=200.0) for i in (0, 1)
    ]
    q = lifted(prism, device, side=0.06 * np.sqrt(0.75), scene=base.with_contacts(contacts))
    assert q[-1, 5] > 0.095 and np.ptp(q[100:, 5] - q[100:, 0]) < 1e-3
