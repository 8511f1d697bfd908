"""Actions in task space beside NumPy: Jacobians by differences, and damped least squares by numpy.linalg."""

import numpy as np
import pytest
import torch

import warp_spo as spo
from warp_spo.env import Env, actions, events, observations, robots
from warp_spo.env.task_space import DifferentialIK

FAR = 0.3  # [m or rad] of random targets from the pose


def panda(worlds=4, **changes):
    robot = robots.load("panda")
    options = {
        "actions": DifferentialIK("hand"),
        "observations": {"actor": [observations.joint_position()]},
        "rewards": {},
        "events": [events.joints(position=(-0.3, 0.3))],
        "default_q": robot.q,
        "dt": 0.01,
        "decimation": 2,
    }
    return Env(changes.pop("scene", robot.scene), worlds, "cpu", **(options | changes))


def pose_of(dyn, q):
    """Return position and rotation matrix of the hand, one world, float64."""
    x = dyn.frame_poses(q[None], ["hand"])[0, 0]
    u, w = x[3:6], x[6]
    across = np.array([[0, -u[2], u[1]], [u[2], 0, -u[0]], [-u[1], u[0], 0]])
    return x[:3], np.eye(3) + 2 * w * across + 2 * across @ across


def rotation_vector(R):
    """Return the rotation vector of a matrix, below half a turn."""
    angle = np.arccos(np.clip(0.5 * (np.trace(R) - 1.0), -1.0, 1.0))
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return axis * (0.5 if angle < 1e-9 else 0.5 * angle / np.sin(angle))


def jacobian_of(dyn, q, step=1e-6):
    """Return the Jacobian [6, 7] by central differences of poses."""
    columns = []
    for i in range(len(q)):
        (a, A), (b, B) = (pose_of(dyn, q + side * step * np.eye(len(q))[i]) for side in (-1.0, 1.0))
        columns.append(np.concatenate([b - a, rotation_vector(B @ A.T)]) / (2.0 * step))
    return np.array(columns).T


@pytest.mark.parametrize(
    ("kind", "relative", "rest"), [("position", True, 0.2), ("pose", True, 0.0), ("pose", False, 0.1)]
)
def test_targets_are_damped_least_squares(kind, relative, rest):
    env = panda(actions=DifferentialIK("hand", kind=kind, relative=relative, scale=0.5, damping=0.1, rest=rest))
    dyn = spo.Dynamics(env.scene, 1, "cpu", "float64")
    torch.manual_seed(1)
    given = FAR * torch.randn(4, env.num_actions)
    if not relative:
        given[:, :3] += 2.0 * torch.tensor([0.5, 0.0, 0.4])
        given[:, 3:] = env.dyn.frame_poses(env.q, ["hand"])[:, 0, 3:] * 3.0 + 0.5 * torch.randn(4, 4)
        given[2, 3:] *= -1.0  # the same rotation
    ctrl = env.controls(given)["ctrl"].double().numpy()
    for world in range(4):
        q, a = env.q[world].double().numpy(), 0.5 * given[world].double().numpy()
        J, (p, R) = jacobian_of(dyn, q), pose_of(dyn, q)
        e = a
        if not relative:
            x, y, z, w = a[3:] / np.linalg.norm(a[3:])
            u = np.array([x, y, z])
            across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            wanted = (w * w - u @ u) * np.eye(3) + 2 * w * across + 2 * np.outer(u, u)
            e = np.concatenate([a[:3] - p, rotation_vector(wanted @ R.T)])
        J = J[: len(e)]
        free = rest * (env.default_q - q)
        expected = q + free + J.T @ np.linalg.solve(J @ J.T + 0.01 * np.eye(len(e)), e - J @ free)
        assert np.allclose(ctrl[world], expected, atol=2e-5), ctrl[world] - expected


def test_the_hand_goes_where_it_is_asked_to():
    """A pose is held to a millimetre and 3 mrad after two seconds; servos follow, gravity is compensated."""
    env = panda(actions=DifferentialIK("hand", kind="pose", relative=False, scale=1.0), episode_length_s=9.0)
    start = env.dyn.frame_poses(env.q, ["hand"])[:, 0]
    target = start + torch.tensor([0.05, 0.08, -0.06, 0.0, 0.0, 0.0, 0.0])
    for _ in range(100):
        env.step(target)
    end = env.dyn.frame_poses(env.q, ["hand"])[:, 0]
    assert (end[:, :3] - target[:, :3]).abs().max() < 1e-3
    assert ((end[:, 3:] * target[:, 3:]).sum(dim=1).abs() > 1.0 - 1e-6).all()


def test_drives_take_targets_too():
    robot = robots.load("panda")
    driven = robot.scene.with_values(joint_target_ke=np.full(7, 400.0), joint_target_kd=np.full(7, 40.0))
    drives, servos = (
        panda(2, scene=scene, actions=DifferentialIK("hand", through=through), events=[])
        for scene, through in ((driven, actions.Position()), (robot.scene, actions.Control()))
    )
    given = torch.tensor([[0.5, 0.1, 0.2], [0.0, 0.3, -0.2]])
    assert torch.allclose(drives.controls(given)["target_q"], servos.controls(given)["ctrl"], atol=1e-6)


def test_what_is_refused():
    for make, words in (
        (lambda: DifferentialIK("hand", kind="twist"), "expected 'position' or 'pose'"),
        (lambda: DifferentialIK("hand", damping=0.0), "damping is 0"),
        (lambda: DifferentialIK("hand", through=actions.Effort()), "expected actions.Control or actions.Position"),
        (lambda: panda(actions=DifferentialIK("nobody")), "nobody"),
    ):
        with pytest.raises((ValueError, TypeError), match=words):
            make()


@pytest.mark.parametrize(("kind", "relative"), [("position", True), ("pose", False)])
def test_first_forces_are_those_of_the_action_zero(kind, relative):
    """Where an episode starts they are of its own Jacobian and pose: those of a call of the stage of actions there."""
    offset = 0.0 if relative else (0.5, 0.1, 0.4, 0.0, 1.0, 0.0, 0.0)
    env = panda(
        3, actions=DifferentialIK("hand", kind=kind, relative=relative, offset=offset, rest=0.2),
        observations={"actor": [lambda w: w.joint_force]}, terminations={"far": lambda w: w.q[0] > 1.5},
    )  # fmt: skip
    none = torch.zeros(3, env.num_actions)

    def check(observed, worlds):
        state = env.state_dict()
        wanted = env.dyn.actuator_force(env.q, env.qd, env.controls(none)["ctrl"])
        env.load_state_dict(state)
        assert wanted.abs().amax(dim=1).min() > 1.0
        torch.testing.assert_close(observed["actor"][worlds], wanted[worlds], rtol=1e-5, atol=1e-4)

    check(env.get_observations(), [0, 1, 2])
    env.step(none + 0.3)
    check(env.reset(torch.tensor([True, False, True]))[0], [0, 2])
    env.q[1, 0] = 2.0
    observed, _, done, _ = env.step(none + 0.3)
    assert done.tolist() == [0, 1, 0]
    check(observed, [1])
