"""Sensors of environments: accelerometers beside differences of velocities, rays beside points along them, delays."""

import numpy as np
import pytest
import torch

import warp_spo as spo
from support.env_scenes import cart_env, walker_env, walker_q, walker_scene
from warp_spo.env import Observation, observations, rays

FLOAT32 = 1e-5
SITE = (0, (0.1, 0.05, 0.02, 0.0, 0.0, np.sin(0.2), np.cos(0.2)))


def test_history_delay_and_bias():
    angle = lambda w: w.q[1]  # noqa: E731
    terms = [
        angle,
        Observation(angle, history=3),
        Observation(angle, delay=2),
        Observation(angle, delay=(0, 2), history=2),
    ]
    terms += [Observation(angle, bias=0.1), Observation(angle, bias=0.1)]
    env = cart_env(16, observations={"a": terms}, terminations={}, episode_length_s=0.12)
    seen = [env.get_observations()["a"][:, 0]] * 3
    bias = env.get_observations()["a"][:, 7:] - env.get_observations()["a"][:, :1]
    assert (bias.abs() <= 0.1).all() and bias[:, 0].unique().numel() == 16 and not bias[:, 0].equal(bias[:, 1])
    delays = None
    for step in range(14):
        if step == 3:
            first = torch.arange(16) == 0
            again = env.reset(first)[0]["a"][:, 0]  # the histories of the other worlds do not move
            seen = [torch.where(first, again, x) for x in seen]
        observed, _, done, _ = env.step(torch.zeros(16, 1))
        now, given = observed["a"][:, 0], observed["a"]
        fresh = done.bool()
        old = [torch.where(fresh, now, x) for x in seen]
        seen = [now, old[0], old[1]]
        if not fresh.any():
            assert torch.equal(given[:, 1:4], torch.stack(seen, dim=1)) and torch.equal(given[:, 4], seen[2])
            late = torch.stack([(given[:, 5] == x) for x in seen], dim=1)
            if step in (2, 9):
                assert late.any(dim=1).all()
                found = late.int().argmax(dim=1)
                delays = found if delays is None else delays
                assert found[1:].equal(delays[1:]) and delays.unique().numel() == 3  # world 0 has just started anew
        assert torch.allclose(given[:, 7:] - given[:, :1], bias, atol=FLOAT32)


def test_an_observation_of_several_groups_is_measured_once():
    """With a history and without one they see the same noise; another observation of the same term has its own."""
    plain, past, other = (Observation(lambda w: w.q[0], noise=0.5, history=n) for n in (1, 2, 1))
    env = cart_env(4, observations={"a": [plain, past], "b": [past, plain], "c": [other]})
    for _ in range(3):
        observed, *_ = env.step(torch.zeros(4, 1))
        assert observed["a"][:, :1].equal(observed["b"][:, 2:]) and observed["a"][:, 1:].equal(observed["b"][:, :2])
        assert (observed["a"][:, 0] != observed["a"][:, 1]).all() and (observed["a"][:, 0] != observed["c"][:, 0]).all()
        assert ((observed["a"][:, :2] - env.q[:, :1]).abs() <= 0.5 + FLOAT32).all()


def test_a_term_of_rows_is_its_list():
    """A thread for each row of each world finds what the list of all rows is; noise differs by row, world and step."""
    rows = np.random.default_rng(0).normal(size=(21, 2))
    each = observations.Each(lambda w, row: row[0] * w.q[1] + row[1], rows)
    noisy = Observation(each, scale=2.0, noise=0.1, clip=(-3.0, 3.0))
    terms = {"rows": [lambda w: w.q, each, noisy], "list": [lambda w: each(w)], "again": [noisy]}
    env, few = (cart_env(worlds, observations=terms, final_observations=True) for worlds in (8, 3))
    assert env.num_obs == {"rows": 44, "list": 21, "again": 21}
    seen = env.get_observations()  # rows that several kernels write begin at whole lines of 128 bytes
    assert [seen[name].stride() for name in terms] == [(64, 1), (21, 1), (32, 1)]
    before = None
    for _ in range(25):  # with new starts
        observed, _, _, extras = env.step(torch.zeros(8, 1))
        fewer, _, _, _ = few.step(torch.zeros(3, 1))
        for seen in (observed, extras["final_observations"]):
            plain, noise = seen["rows"][:, 2:23], seen["rows"][:, 23:] - 2.0 * seen["list"].clamp(-1.4, 1.4)
            expected = seen["rows"][:, 1:2].double().numpy() * rows[:, 0] + rows[:, 1]
            assert np.allclose(plain.numpy(), expected, atol=FLOAT32) and torch.allclose(plain, seen["list"])
            inside = seen["list"].abs() < 1.4
            assert (noise[inside].abs() <= 0.2 + FLOAT32).all() and noise[inside].abs().max() > 0.15
            assert noise[inside].unique().numel() > 0.9 * inside.sum()
            assert seen["again"].equal(seen["rows"][:, 23:])
        assert all(fewer[name].equal(observed[name][:3]) for name in terms)
        assert before is None or not before.equal(noise)
        before = noise
    keeps = observations.Each(lambda w, row: w.keep("a", [row[0]]) or row[0], rows)
    with pytest.raises(ValueError, match=r"observations\.Each: .* keeps a; expected nothing"):
        cart_env(2, observations={"a": [keeps]})
    with pytest.raises(ValueError, match=r"rows has shape \(3,\)"):
        observations.Each(lambda w, row: row, [1, 2, 3])


def test_rows_read_what_was_remembered():
    """A row is computed before other observations of the step keep something."""
    rows = np.linspace(0.5, 1.5, 21)[:, None]

    def count(w):
        w.keep("count", w.memory("count", 1, reset=None) + 1.0)
        return w.kept["count"]

    each = observations.Each(lambda w, row: row[0] * w.memory("count", 1, reset=None)[0], rows)
    env = cart_env(3, observations={"a": [count, each]})
    plain = cart_env(3, observations={"a": [lambda w: w.q, each]})
    assert env._in_turn == {"observe"} and not plain._in_turn  # only then kernels may run at the same time
    for _ in range(4):
        seen = env.step(torch.zeros(3, 1))[0]["a"]
        assert torch.allclose(seen[:, 1:], torch.tensor(rows.T, dtype=seen.dtype) * (seen[:, :1] - 1.0), atol=FLOAT32)
    assert seen[0, 0] == 5.0  # one look at the start


@pytest.mark.slow
def test_accelerometer_and_gyro():
    """In flight, where episodes start, a sensor feels nothing; else gravity and the change of its velocity."""
    env = walker_env(
        3,
        default_q=np.array([*walker_q()[:2], 3.0, *walker_q()[3:]]),
        observations={"a": [observations.accelerometer(SITE), observations.gyro(SITE)]},
        events=[],
        terminations={},
        decimation=1,
        dt=1e-3,
    )
    first = env.get_observations()["a"].numpy()
    assert np.allclose(first, 0.0, atol=1e-3)  # its servos at rest
    env.q[:, 2] = torch.tensor([0.36, 0.5, 3.0])
    env.qd[:, 3:6] = torch.tensor([[0.0, 0, 0], [0.3, -0.2, 0.4], [0.0, 0, 0]])
    observed, _, _, _ = env.step(torch.zeros(3, 8))
    assert np.allclose(observed["a"][2].numpy(), 0.0, atol=1e-3)  # in free fall, its servos at rest
    before = env.dyn.frame_velocities(env.q, env.qd, [SITE])[:, 0].double().numpy()
    observed, _, _, _ = env.step(0.3 * torch.ones(3, 8))
    after = env.dyn.frame_velocities(env.q, env.qd, [SITE])[:, 0].double().numpy()
    poses = env.dyn.frame_poses(env.q, [SITE])[:, 0].double().numpy()
    for world in range(3):
        x, y, z, w = poses[world, 3:]
        across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        matrix = np.eye(3) + 2 * w * across + 2 * across @ across
        felt = matrix.T @ ((after[world, :3] - before[world, :3]) / 1e-3 + [0, 0, 9.81])
        assert np.allclose(observed["a"][world, :3].numpy(), felt, atol=0.05 + 0.02 * abs(felt).max())  # of order dt
        assert np.allclose(observed["a"][world, 3:].numpy(), matrix.T @ after[world, 3:], atol=FLOAT32)


OBSTACLES = (
    rays.Sphere((2.0, 0.3, 0.5), 0.5),
    rays.Capsule((-1.5, -1.0, 0.2), (-1.5, 1.0, 0.8), 0.3),
    rays.Box((0.3, 0.6, 0.4), (0.5, 2.0, 0.3, 0.0, 0.0, np.sin(0.4), np.cos(0.4))),
)


def inside(points):
    """Return whether points are in one of the obstacles or below z = 0."""
    sphere = np.linalg.norm(points - OBSTACLES[0].center, axis=-1) < 0.5
    a, b = np.array(OBSTACLES[1].start), np.array(OBSTACLES[1].end)
    along = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)[..., None]
    capsule = np.linalg.norm(points - a - along * (b - a), axis=-1) < 0.3
    c, s = np.cos(0.8), np.sin(0.8)
    local = (points - OBSTACLES[2].pose[:3]) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    box = (abs(local) < OBSTACLES[2].half).all(axis=-1)
    return sphere | capsule | box | (points[..., 2] < 0)


@pytest.mark.slow
@pytest.mark.parametrize("field", [False, True])
def test_rays(field):
    """Distances beside the first of many points along each ray that is inside of something."""
    slopes = rays.ring(8) * [1.0, 1.0, 0.0] + [0.0, 0.0, -0.5]
    directions = np.concatenate([rays.ring(12), slopes / np.linalg.norm(slopes, axis=1)[:, None], [[0, 0, -1.0]]])
    scene, obstacles = walker_scene(), OBSTACLES
    if field:
        scene, obstacles = scene.with_contacts(scene.contacts, spo.terrain.slope((8.0, 8.0), 0.1, 0.3)), ()
    env = walker_env(
        4,
        scene=scene,
        observations={"a": [rays.lidar(directions, 3.0, (0.1, 0.0, 0.05), obstacles, steps=60)]},
        events=[],
        terminations={},
    )
    generator = torch.Generator().manual_seed(0)
    env.q[:, :2] = torch.tensor([[0.0, 0.0], [0.4, 0.9], [-0.8, 0.1], [0.9, 1.2]])
    env.q[:, 3:7] += 0.1 * torch.randn(4, 4, generator=generator)
    env.q[:, 2] += 0.3 + 0.6 * field
    observed, _, _, _ = env.step(torch.zeros(4, 8))
    t = np.linspace(0.0, 3.0, 3001)
    for world, q in enumerate(env.q.double().numpy()):
        x, y, z, w = q[3:7] / np.linalg.norm(q[3:7])
        across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        matrix = np.eye(3) + 2 * w * across + 2 * across @ across
        start = q[:3] + matrix @ [0.1, 0.0, 0.05]
        points = start + t[None, :, None] * (directions @ matrix.T)[:, None]
        if field:
            h, o, cell = scene.ground.heights, scene.ground.origin, scene.ground.cell
            u, v = (np.clip((points[..., i] - o[i]) / cell, 0, h.shape[i] - 1.001) for i in (0, 1))
            i, j = u.astype(int), v.astype(int)
            a, b = u - i, v - j
            ground = (
                h[i, j] * (1 - a) * (1 - b)
                + h[i + 1, j] * a * (1 - b)
                + h[i, j + 1] * (1 - a) * b
                + h[i + 1, j + 1] * a * b
            )
            hits = points[..., 2] < ground
        else:
            hits = inside(points)
        expected = np.where(hits.any(axis=1), t[hits.argmax(axis=1)], 3.0)
        assert np.allclose(observed["a"][world].numpy(), expected, atol=0.02 if field else 2e-3)
        assert (expected < 3.0).sum() > 5
