"""Bodies that touch each other: their points, the coupled step against the dense one, and what it conserves."""

import functools

import numpy as np
import pytest
import warp as wp
from pair_scenes import cube, free, mixed, mixed_states, stack, stacked

import warp_spo as spo
from warp_spo import reference_pairs
from warp_spo.kernels import touches
from warp_spo.reference_pairs import PairStep
from warp_spo.reference_rotations import homogeneous

H, WORLDS = 5e-3, 9
TOLERANCE = {"float64": (1e-10, 1e-9), "float32": (1e-4, 1e-3)}
"""Of velocities, over the largest one, and of forces, over the largest one; 4e-13 and 3e-12, 2e-5 and 2e-4 measured."""


def placed(rng, kind):
    """A random shape of a body, its row in the kernel's table."""
    turn = rng.normal(size=4)
    size = rng.uniform(0.05, 0.2, 3) if kind else np.array([0.0, 0.0, 0.1])
    return np.concatenate([0.05 * rng.normal(size=3), turn / np.linalg.norm(turn), size, [0.0 if kind else 0.08]])


@pytest.mark.parametrize("kinds", [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_points_are_those_of_the_reference(device, kinds):
    """Segments, spheres, boxes; half of the boxes nearly aligned."""
    worlds, rng = 100, np.random.default_rng(sum(kinds))
    shapes = np.array([placed(rng, kind) for kind in kinds])
    for row, kind in enumerate(kinds):
        shapes[row, 9] = shapes[row, 9] if kind or kinds == (0, 0) else 0.0
    poses = np.concatenate([0.15 * rng.normal(size=(worlds, 2, 3)), rng.normal(size=(worlds, 2, 4))], axis=2)
    poses[::2, :, 3:] = np.array([0.0, 0.0, 0.02, 1.0])
    poses[..., 3:] /= np.linalg.norm(poses[..., 3:], axis=2)[..., None]
    if kinds == (1, 1):
        shapes[:, 3:7] = np.array([0.0, 0.0, 0.0, 1.0])
    size = touches.HEADER + 8 * touches.POINT
    out = wp.full((size, worlds), np.nan, dtype=wp.float64, device=device)
    given = [wp.array(poses, dtype=wp.float64, device=device), wp.array([[0, 1, *kinds, 0]], dtype=int, device=device)]
    given.append(wp.array(shapes, dtype=wp.float64, device=device))
    wp.launch(touches.find_touches(wp.float64), (1, worlds), given, [out], device=device)
    found, counts = out.numpy(), set()
    for w in range(worlds):
        both = [(kind, homogeneous(pose) @ homogeneous(row[:7]), row[7:10], row[10])
                for kind, pose, row in zip(kinds, poses[w], shapes, strict=True)]  # fmt: skip
        wanted = reference_pairs.touches(*both)
        rows = found[touches.HEADER :, w].reshape(-1, touches.POINT)[: 8 if sum(kinds) == 2 else 1]
        rows = rows[rows[:, 6] > touches.AWAY]
        assert len(rows) == len(wanted)
        counts.add(len(wanted))
        for row, (point, normal, depth) in zip(rows, wanted, strict=True):
            np.testing.assert_allclose(row[:3] + poses[w, 0, :3], point, atol=1e-12)
            np.testing.assert_allclose(row[3:], [*normal, depth], atol=1e-12)
    assert counts >= ({4, 5, 6, 7} if sum(kinds) == 2 else {1})


def stepped(dyn, q, qd, **more):
    """One step with all reports, which begin as NaN."""
    count, dtype, worlds = dyn.scene.contact_count, dyn.dtype.__name__, len(q)
    found = {"contact_f": np.full((worlds, count, 3), np.nan, dtype)}
    found |= {name: np.full((worlds, count), np.nan, dtype) for name in ("contact_gap", "contact_slip")}
    found |= {"contact_excess": np.full((worlds, 3), np.nan, dtype), "status": np.full(worlds, -1, np.int32)}
    found["q"], found["qd"] = dyn.step(q.astype(dtype), qd.astype(dtype), None, H, **found, **more)
    return found


def assert_is_dense(dyn, q, qd, passes=None, least=1, **values):
    """A step is the dense one in every world, with ``values`` of the scene; return what it finds."""
    scene = dyn.scene.with_values(**values)
    found, (velocity, force) = stepped(dyn, q, qd, passes=passes), TOLERANCE[dyn.dtype.__name__]
    touching, points = 0, len(dyn.scene.contact_points)
    for w in range(len(q)):
        at = PairStep(scene, q[w], qd[w], H, world=w)
        after, wanted = at.run(passes=passes or 4)
        f, gap, slip = at.reports(wanted)
        most = max(1.0, np.abs(wanted.f).max())
        touching += (np.abs(f).max(axis=1) > 0.0).sum()
        np.testing.assert_allclose(found["qd"][w], wanted.v, atol=velocity * np.abs(wanted.v).max())
        np.testing.assert_allclose(found["q"][w], after, atol=velocity)
        np.testing.assert_allclose(found["contact_f"][w, points:], f, atol=force * most)
        np.testing.assert_allclose(found["contact_gap"][w, points:], gap, atol=1e-6)
        np.testing.assert_allclose(found["contact_slip"][w, points:], slip, atol=velocity * np.abs(wanted.v).max())
        np.testing.assert_allclose(found["contact_excess"][w], wanted.excess, atol=force * most)
    assert touching >= least
    return found


@functools.cache
def mixed_dynamics(device, dtype):
    return spo.Dynamics(mixed(), WORLDS, device=device, dtype=dtype, variable=("contact_friction",))


def test_a_step_is_the_dense_one(device):
    """Every kind of pair, drives with limits, the ground; another friction in each world."""
    dyn, (q, qd) = mixed_dynamics(str(device), "float64"), mixed_states(0, WORLDS)
    friction = np.linspace(0.2, 1.0, WORLDS)[:, None] * np.ones((1, dyn.scene.contact_count))
    dyn.set(contact_friction=friction)
    for passes in (None, 1, 3):
        assert_is_dense(dyn, q, qd, passes, least=WORLDS, contact_friction=friction)


@pytest.mark.slow
def test_a_step_in_float32_is_the_dense_one(device):
    dyn, (q, qd) = mixed_dynamics(str(device), "float32"), mixed_states(0, WORLDS)
    friction = np.full((WORLDS, dyn.scene.contact_count), 0.8)
    dyn.set(contact_friction=friction.astype(np.float32))
    assert_is_dense(dyn, q, qd, least=WORLDS, contact_friction=friction)


def test_nan_stays_in_its_world(device):
    dyn, (q, qd) = mixed_dynamics(str(device), "float64"), mixed_states(0, WORLDS)
    friction = np.full((WORLDS, dyn.scene.contact_count), 0.5)
    dyn.set(contact_friction=friction)
    clean = stepped(dyn, q, qd)
    friction[1, -3], q[2, 4] = np.nan, np.nan
    dyn.set(contact_friction=friction)
    found = stepped(dyn, q, qd)
    assert found["status"].tolist()[1:3] == [spo.Status.NOT_FINITE] * 2 and np.isnan(found["qd"][1:3]).any(axis=1).all()
    for name in ("q", "qd", "contact_f", "status"):
        np.testing.assert_array_equal(np.delete(found[name], [1, 2], axis=0), np.delete(clean[name], [1, 2], axis=0))


def momentum(scene, q, qd):
    """Linear and angular momentum about the origin of free bodies, [world, 6]."""
    total = np.zeros((len(q), 6))
    for b in range(len(scene.bodies)):
        m, inertia = scene.values["body_mass"][0, b], scene.values["body_inertia"][0, b, 0, 0]  # of cubes and balls
        p = m * qd[:, 6 * b : 6 * b + 3]
        total[:, :3] += p
        total[:, 3:] += np.cross(q[:, 7 * b : 7 * b + 3], p) + inertia * qd[:, 6 * b + 3 : 6 * b + 6]
    return total


def head_on(dtype, device, count=60):
    """Two balls that meet off centre, spinning; return the scene and momenta before and after."""
    scene = free([cube(1.0, 0.05), cube(3.0, 0.05)],
                 [spo.Contact(0, sphere=0.05, other=spo.Contact(1, sphere=0.05), stiffness=1e5)])  # fmt: skip
    q = np.zeros((2, 14), dtype)
    q[:, [6, 13]], q[:, 7], q[:, 8] = 1.0, 0.15, [0.0, 0.03]
    qd = np.zeros((2, 12), dtype)
    qd[:, 0], qd[:, 6], qd[:, 3:6] = 1.0, -0.5, 2.0
    before, met = momentum(scene, q, qd), 0.0
    dyn, force = spo.Dynamics(scene, 2, device=device, dtype=dtype), np.zeros((2, 1, 3), dtype)
    for _ in range(count):
        q, qd = dyn.step(q, qd, None, H, contact_f=force)
        met = max(met, np.abs(force).max())
    assert met > 10.0
    return before, momentum(scene, q, qd), np.linalg.norm(q[:, 7:10] - q[:, :3], axis=1)


def test_a_collision_keeps_momentum(device):
    """The impulses are equal and opposite at one point."""
    before, after, apart = head_on("float64", device)
    np.testing.assert_allclose(after[:, :3], before[:, :3], atol=1e-12 * np.abs(before).max())
    np.testing.assert_allclose(after[0, 3:], before[0, 3:], atol=1e-12)
    assert (apart > 0.09).all()  # they have not passed through each other


@pytest.mark.slow
def test_a_collision_keeps_momentum_in_float32(device):
    before, after, _ = head_on("float32", device)
    np.testing.assert_allclose(after[:, :3], before[:, :3], atol=1e-6 * np.abs(before).max())


WALLS = (
    [((x, 0, 0), 0) for x in (-0.2, 0.2)]
    + [((0, y, 0), 1) for y in (-0.2, 0.2)]
    + [((0, 0, z), 2) for z in (-0.2, 0.2)]
)


def cage(dtype, device, count):
    """A ball in a free cage of six boxes; return momenta before and after, and how often it met a wall."""
    walls = []
    for place, axis in WALLS:
        half = [0.2, 0.2, 0.2]
        half[axis] = 0.02
        walls.append(dict(box=(half, (*place, 0, 0, 0, 1))))
    contacts = [
        spo.Contact(1, sphere=0.05, other=spo.Contact(0, **wall), stiffness=1e5, damping=10.0) for wall in walls
    ]
    scene = free([cube(2.0, 0.2), cube(1.0, 0.05)], contacts)
    q, qd = np.zeros((1, 14), dtype), np.zeros((1, 12), dtype)
    q[:, [6, 13]], qd[0, 6:9] = 1.0, [2.0, 1.3, 0.7]
    before, dyn, met = momentum(scene, q, qd), spo.Dynamics(scene, 1, device=device, dtype=dtype), 0
    force = np.zeros((1, 6, 3), dtype)
    for _ in range(count):
        q, qd = dyn.step(q, qd, None, H, contact_f=force)
        met += np.abs(force).max() > 0.0
    return before, momentum(scene, q, qd), met


@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "bound"), [("float64", 1e-12), ("float32", 1e-6)])
def test_a_ball_in_a_free_cage(device, dtype, bound):
    before, after, met = cage(dtype, device, 400)
    assert met > 5
    np.testing.assert_allclose(after[:, :3], before[:, :3], atol=bound * np.abs(before).max())


def stand(scene, q, settle, seconds, device, dtype="float64"):
    """Let bodies come to rest; return largest speed and drift [m] after ``settle`` seconds, q and the last forces."""
    dyn, q = spo.Dynamics(scene, 1, device=device, dtype=dtype), np.array(q, dtype)[None]
    qd, force, fastest, drift = (
        np.zeros((1, scene.dof_count), dtype),
        np.zeros((1, scene.contact_count, 3), dtype),
        0,
        0,
    )
    for i in range(round((settle + seconds) / H)):
        q, qd = dyn.step(q, qd, None, H, contact_f=force)
        if i == round(settle / H):
            first = q
        if i > settle / H:
            place = (q - first).reshape(-1, 7)[:, :3]
            fastest, drift = max(fastest, np.abs(qd).max()), max(drift, np.abs(place).max())
    return fastest, drift, q[0], force[0]


@pytest.mark.slow
def test_a_stack_stands(device):
    """Five cubes, offset and turned: 10 s."""
    scene = stack()
    fastest, drift, _, force = stand(scene, stacked(5), 5.0, 10.0, device)
    assert fastest < 1e-5 and drift < 1e-4
    carried = 9.81 * 5.0 * np.arange(5, 0, -1)
    np.testing.assert_allclose(np.append(force[:8, 2].sum(), force[8:, 2]), carried, rtol=1e-4)


@pytest.mark.slow
def test_a_heavy_cube_on_light_ones(device):
    """100 kg on four of 1 kg, as deep as springs say."""
    masses = (1.0, 1.0, 1.0, 1.0, 100.0)
    scene = stack(masses, ground=1e6, stiffness=1e6, damping=4e3)
    fastest, _, q, force = stand(scene, stacked(5, offset=0.0), 3.0, 0.5, device)
    carried = 9.81 * np.cumsum(masses[::-1])[::-1]
    np.testing.assert_allclose(force[8:, 2], carried[1:], rtol=1e-4)
    sunk = carried[0] / 8e6 * 2.0 + (carried[1:] / 1e6).sum()  # four corners carry the lowest
    assert fastest < 1e-4
    np.testing.assert_allclose(0.9 - q[30], sunk, rtol=0.02)
