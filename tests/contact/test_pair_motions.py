"""Bodies that touch each other, over many steps: what their motion conserves, and what stands, holds or comes apart."""

import numpy as np
import pytest

import warp_spo as spo
from support.pair_motions import largest_rise, momentum, stand
from support.pair_scenes import H, cube, cubes_in_a_row, free, stack, stacked, stepped
from warp_spo.examples import grasp
from warp_spo.kernels import straight_line
from warp_spo.recursions.contact import coupled
from warp_spo.reference.body_contact import PairStep


def head_on(dtype, device, count=60, granularity=None):
    """Two balls that meet off centre, spinning; return the scene and momenta before and after."""
    scene = free([cube(1.0, 0.05), cube(3.0, 0.05)],
                 [spo.Contact(0, sphere=0.05, other=spo.Contact(1, sphere=0.05), stiffness=1e5)])  # fmt: skip
    q = np.zeros((2, 14), dtype)
    q[:, [6, 13]], q[:, 7], q[:, 8] = 1.0, 0.15, [0.0, 0.03]
    qd = np.zeros((2, 12), dtype)
    qd[:, 0], qd[:, 6], qd[:, 3:6] = 1.0, -0.5, 2.0
    before, met = momentum(scene, q, qd), 0.0
    dyn = spo.Dynamics(scene, 2, device=device, dtype=dtype, granularity=granularity)
    force = np.zeros((2, 1, 3), dtype)
    for _ in range(count):
        q, qd = dyn.step(q, qd, None, H, report=spo.StepReport(contact_f=force))
        met = max(met, np.abs(force).max())
    assert met > 10.0
    return before, momentum(scene, q, qd), np.linalg.norm(q[:, 7:10] - q[:, :3], axis=1)


def test_a_collision_keeps_momentum(device):
    """The impulses are equal and opposite at one point."""
    before, after, apart = head_on("float64", device)
    np.testing.assert_allclose(after[:, :3], before[:, :3], atol=1e-12 * np.abs(before).max())
    np.testing.assert_allclose(after[0, 3:], before[0, 3:], atol=1e-12)
    assert (apart > 0.09).all()  # they have not passed through each other


def test_every_array_of_a_thread_has_entries(device, monkeypatch):
    """Also where no hinge has a law with bounds; compilers for CUDA refuse an array without entries."""
    texts, assemble = [], straight_line.assemble
    monkeypatch.setattr(straight_line, "assemble", lambda *given: texts.append(assemble(*given)) or texts[-1])
    head_on("float64", device, granularity="tree")
    assert any("couples::judge" in text for text in texts) and not any("[0] = {}" in text for text in texts)


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
    contacts = [spo.Contact(1, sphere=0.05, other=spo.Contact(0, **wall), stiffness=1e5, damping=10) for wall in walls]
    scene = free([cube(2.0, 0.2), cube(1.0, 0.05)], contacts)
    q, qd = np.zeros((1, 14), dtype), np.zeros((1, 12), dtype)
    q[:, [6, 13]], qd[0, 6:9] = 1.0, [2.0, 1.3, 0.7]
    before, dyn, met = momentum(scene, q, qd), spo.Dynamics(scene, 1, device=device, dtype=dtype), 0
    force = np.zeros((1, 6, 3), dtype)
    for _ in range(count):
        q, qd = dyn.step(q, qd, None, H, report=spo.StepReport(contact_f=force))
        met += np.abs(force).max() > 0.0
    return before, momentum(scene, q, qd), met


@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "bound"), [("float64", 1e-12), ("float32", 1e-6)])
def test_a_ball_in_a_free_cage(device, dtype, bound):
    before, after, met = cage(dtype, device, 400)
    assert met > 5
    np.testing.assert_allclose(after[:, :3], before[:, :3], atol=bound * np.abs(before).max())


@pytest.mark.slow
def test_a_stack_stands(device):
    """Five cubes, offset and turned: 10 s."""
    scene = stack()
    fastest, drift, _, force = stand(scene, stacked(5), 5.0, 10.0, device)
    assert fastest < 1e-5 and drift < 1e-4
    carried = 9.81 * 5.0 * np.arange(5, 0, -1)
    np.testing.assert_allclose(np.append(force[:4, 2].sum(), force[4:, 2]), carried, rtol=1e-4)


@pytest.mark.slow
def test_a_heavy_cube_on_light_ones(device):
    """100 kg on four of 1 kg, as deep as springs say."""
    masses = (1.0, 1.0, 1.0, 1.0, 100.0)
    scene = stack(masses, ground=1e6, stiffness=1e6, damping=4e3)
    fastest, _, q, force = stand(scene, stacked(5, offset=0.0), 3.0, 0.5, device)
    carried = 9.81 * np.cumsum(masses[::-1])[::-1]
    np.testing.assert_allclose(force[4:, 2], carried[1:], rtol=1e-4)
    sunk = carried[0] / 4e6 + (carried[1:] / 1e6).sum()  # four corners carry the lowest
    assert fastest < 1e-4
    np.testing.assert_allclose(0.9 - q[30], sunk, rtol=0.02)


@pytest.mark.slow
def test_a_row_of_cubes(monkeypatch, device):
    """Ten pairs in a row are solved together. Momentum is kept."""
    monkeypatch.setattr(coupled, "is_supported", lambda links: True)
    scene, q, qd = cubes_in_a_row(11)
    found = stepped(spo.Dynamics(scene, 2, device=device, dtype="float64"), q, qd)
    for w in range(2):
        _, wanted = PairStep(scene, q[w], qd[w], H).run(passes=4)
        assert np.abs(found["qd"][w] - wanted.v).max() < 1e-10
    before, after = momentum(scene, q, qd), momentum(scene, found["q"], found["qd"])
    np.testing.assert_allclose(after[:, :3], before[:, :3], atol=1e-12)


def legs(contacts=True):
    """A free trunk and two legs of two links, without gravity; their links touch each other."""
    bodies, hinges = [cube(7.0, 0.15)], [spo.Hinge("free", -1, 0)]
    for y in (0.1, -0.1):
        thigh = len(bodies)
        bodies += [spo.Body(1.0, (0, 0, -0.1), 4.3e-3 * np.eye(3)), spo.Body(0.5, (0, 0, -0.1), 1.6e-3 * np.eye(3))]
        hinges += [spo.Hinge("ball", 0, thigh, parent_pose=(0, y, -0.1, 0, 0, 0, 1)),
                   spo.Hinge("revolute", thigh, thigh + 1, axis=(0, 1, 0),
                             parent_pose=(0, 0, -0.2, 0, 0, 0, 1))]  # fmt: skip
    link = dict(capsule=((0, 0, 0), (0, 0, -0.2), 0.04))
    pairs = [spo.Contact(i, **link, other=spo.Contact(j, **link), stiffness=1e5, friction=0.5)
             for i in (1, 2) for j in (3, 4)]  # fmt: skip
    away = [spo.Contact(0, point=(0, 0, 100.0))]
    return spo.Scene(bodies, hinges, contacts=pairs if contacts else away, gravity=(0, 0, 0))


@pytest.mark.slow
def test_legs_that_cross_gain_no_more_than_free_ones(device):
    rng, worlds, scene = np.random.default_rng(0), 40, legs()
    q, qd = np.tile(scene.neutral_q, (worlds, 1)), 0.3 * rng.normal(size=(worlds, scene.dof_count))
    qd[:, 6], qd[:, 10] = -rng.uniform(1, 4, worlds), rng.uniform(1, 4, worlds)
    qd[:, [7, 9, 11, 13]] = rng.normal(size=(worlds, 4))
    (rise, met), (without, _) = (largest_rise(each, q, qd, device) for each in (scene, legs(contacts=False)))
    assert met > 30 and rise < without < 5e-4  # 3e-5 and 1.3e-4


def held(device, drives, force=grasp.FORCE):
    """Let a Panda lift a cube; return its slip in the last 5 s [m], how high it is, and all status words."""
    dyn = spo.Dynamics(grasp.scene(drives), 1, device=device, dtype="float64")
    heights, points, q = grasp.path(dyn, 7.0)
    qd, tau, target = np.zeros((1, dyn.scene.dof_count)), np.zeros((1, dyn.scene.dof_count)), q.copy()
    tau[:, 7:9], target[:, 7:9] = 0.0 if drives else -force, 0.0
    apart, status, words, cube_ = [], np.zeros(1, np.int32), set(), dyn.scene.body_count - 1
    for i in range(round(7.0 / H)):
        target[0, :7] = [np.interp(np.clip(i * H - 0.5, 0.0, 1.0), heights, points[:, j]) for j in range(7)]
        q, qd = dyn.step(q, qd, tau, H, target_q=target, status=status)
        words.add(int(status[0]))
        if i * H >= 2.0:
            apart.append(np.subtract(*dyn.frame_poses(q, [cube_, grasp.TIP])[0, :, :3]))
    return np.linalg.norm(np.ptp(apart, axis=0)), q[0, -5], words


@pytest.mark.slow
@pytest.mark.parametrize("drives", [False, True])
def test_a_gripper_holds_a_cube(device, drives):
    """0.5 kg, 40 N, friction 0.8, for 5 s: creep of 0.08 mm/s; fingers pressed by a force, and by saturated drives."""
    slip, height, words = held(device, drives)
    assert slip < 1e-3 and height > 0.15 and words == {spo.Status.OK}


@pytest.mark.parametrize("mass", [0.5, 2.0])
def test_drives_at_their_limit_pinch(mass):
    """Two stiff drives press 20 N each on a cube that hangs: in steps of 10 ms they hold it, with all their force."""
    half, cube = 0.025, mass * (2 * 0.025) ** 2 / 6.0 * np.eye(3)
    drive = dict(target_ke=1e4, target_kd=200.0, effort_limit=20.0)
    box, k = spo.Contact(2, box=(half, half, half)), 9.81 * mass / 1e-4
    scene = spo.Scene(
        [*(spo.Body(0.1, inertia=1e-4 * np.eye(3)) for _ in range(2)), spo.Body(mass, inertia=cube)],
        [*(spo.Hinge("prismatic", -1, i, axis=(0, way, 0), **drive) for i, way in ((0, 1), (1, -1))),
         spo.Hinge("free", -1, 2)],
        contacts=[spo.Contact(i, box=((0.01, 0.004, 0.01), (0, way * 0.004, 0, 0, 0, 0, 1)), other=box,
                              stiffness=k, damping=0.01 * k, eps=1e-4) for i, way in ((0, 1), (1, -1))],
    )  # fmt: skip
    q, qd, target = np.array([half, half, 0, 0, 0, 0, 0, 0, 1.0]), np.zeros(8), np.zeros(9)
    target[:2], target[8] = half - 0.008, 1.0
    for _ in range(12):
        step = PairStep(scene, q, qd, 1e-2, target)
        q, found = step.run(passes=4)
        qd = found.v
    np.testing.assert_allclose(np.abs(step.reports(found)[0][:, 1]), 20.0, rtol=1e-3)
    assert found.excess[2] < 1e-2 and abs(q[4]) < 2e-4  # of 9.81 mm that a free fall takes in this time
