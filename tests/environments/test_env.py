"""Environments against what they are made of: the dynamics, NumPy, and themselves with other worlds."""

import gc

import numpy as np
import pytest
import torch
import warp as wp

import warp_spo as spo
from support.env_scenes import FEET, cart_env, walker_env, walker_q, walker_scene
from warp_spo.env import TorchTerm, actions, commands, events, observations, rewards
from warp_spo.kernels import native, philox

FLOAT32 = 2e-6  # a few roundings of numbers of size one


def random_words(key, counter):
    """Return one block of the generator."""
    text = f"""{philox.NATIVE}
    const unsigned int key[2] = {{{key[0]}u, {key[1]}u}};
    const unsigned int counter[4] = {{{", ".join(f"{c}u" for c in counter)}}};
    philox::random(key, counter, (unsigned int*)place.data);
    """
    kernel, out = native.kernel("philox_test", text, [("place", 1)], wp.float32), wp.zeros(4, dtype=int, device="cpu")
    wp.launch(kernel, 1, [1, out], device="cpu")
    return out.numpy().astype(np.uint32)


def test_random_words_are_those_of_the_paper():
    """Known answers of Random123, file kat_vectors."""
    ones = 0xFFFFFFFF
    assert random_words([0, 0], [0] * 4).tolist() == [0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8]
    assert random_words([ones] * 2, [ones] * 4).tolist() == [0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD]


def test_a_step_is_the_dynamics_and_the_terms():
    env = cart_env()
    dyn = spo.Dynamics(env.scene, env.num_envs, "cpu")
    generator, sums, ended = torch.Generator().manual_seed(1), torch.zeros(8), 0
    for _ in range(60):
        q, qd, length = env.q.clone(), env.qd.clone(), env.episode_length_buf + 1
        given = 3.0 * torch.randn(8, 1, generator=generator)
        tau = torch.cat([10.0 * given, torch.zeros(8, 1)], dim=1)
        q, qd = dyn.step(q, qd, tau, 5e-3, options=spo.StepOptions(substeps=4))
        observed, reward, done, extras = env.step(given)
        expected = 0.02 * (torch.cos(q[:, 1]) - 0.1 * qd[:, 0] ** 2)
        assert torch.allclose(reward, expected, rtol=FLOAT32, atol=FLOAT32)
        out = q[:, 0].abs() > 0.5
        assert done.bool().equal(out | (length >= 20)) and extras["time_outs"].bool().equal((length >= 20) & ~out)
        assert env.episode_length_buf.equal(torch.where(done.bool(), 0, length))
        kept = ~done.bool()
        state = observed["actor"]
        assert state[kept].equal(torch.cat([q, qd], dim=1)[kept])  # to the bit
        assert (state[~kept, :2].abs() <= 0.1).all() and (state[~kept, 2:].abs() <= 0.2).all()
        ended += int(done.sum())
        sums += reward
        last = env.memory("last reward up")[:, 0] + env.memory("last reward slow")[:, 0]
        assert torch.allclose(last[~kept], sums[~kept], atol=20 * FLOAT32)
        sums[~kept] = 0.0
    assert ended > 20 and 0 < float(env.log()["/termination/out"]) < 1


def rollout(env, worlds, steps=15):
    """Return observations, rewards and ends of some worlds; actions depend on the world and the step alone."""
    numbers, found = torch.arange(env.num_envs) + env.first_world, []
    for step in range(steps):
        wave = torch.sin(numbers[:, None] + 1.7 * step + torch.arange(env.num_actions))
        observed, reward, done, _ = env.step(wave)
        found.append(
            torch.cat([*(observed[group] for group in env.num_obs), reward[:, None], done[:, None]], 1)[worlds]
        )
    return torch.stack(found)


def test_the_course_of_a_world_does_not_depend_on_where_it_runs():
    whole = rollout(walker_env(6, seed=7), slice(3, 6))
    part = rollout(walker_env(3, seed=7, first_world=3), slice(0, 3))
    assert torch.isfinite(whole).all() and whole.equal(part)
    assert not whole[:, 0].equal(whole[:, 1])


def matrix(quaternion):
    """Return the rotation matrix of a quaternion, xyzw."""
    x, y, z, w = quaternion / np.linalg.norm(quaternion)
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2.0 * w * across + 2.0 * across @ across


def test_terms_of_a_walker():
    """Base velocity, gravity and joint terms beside dyn.frame_velocities, air time beside its definition."""
    env = walker_env(4, seed=3)
    dyn, air = env.dyn, torch.zeros(4, 4)
    seen = False
    for step in range(40):
        observed, _, done, _ = env.step(0.5 * torch.sin(torch.arange(32.0).view(4, 8) + 0.9 * step))
        q, qd = env.q, env.qd
        rates = dyn.frame_velocities(q, qd, [0])[:, 0]
        turn = np.array([matrix(x) for x in q[:, 3:7].double().numpy()])
        back = lambda v: torch.as_tensor(np.einsum("wji,wj->wi", turn, v.double().numpy())).float()  # noqa: B023, E731
        critic, actor = observed["critic"], observed["actor"]
        assert torch.allclose(critic[:, :3], back(rates[:, :3]), atol=1e-5)
        assert ((actor[:, :3] - back(rates[:, 3:])).abs() <= 0.1 + 1e-5).all()
        assert torch.allclose(actor[:, 3:6], back(torch.tensor([[0.0, 0, -1]] * 4)), atol=1e-6)
        force = critic[:, 7:].view(4, 4, 3)
        touches = force.norm(dim=-1) > 1.0
        air = torch.where(touches | done.bool()[:, None], 0.0, air + 0.02)
        assert torch.allclose(critic[:, 3:7], air, atol=1e-5)
        seen |= bool((air > 0.05).any()) and bool(touches.any())
    assert seen


def test_what_is_not_finite_stays_in_its_world():
    env, twin = cart_env(4), cart_env(4)
    for step in range(6):
        given = torch.zeros(4, 1)
        if step == 2:
            given[1] = float("nan")
        if step == 4:
            env.qd[3, 1] = float("inf")
        observed, reward, done, _ = env.step(given)
        expected, _, _, _ = twin.step(torch.zeros(4, 1))
        assert torch.isfinite(observed["actor"]).all() and torch.isfinite(reward).all()
        assert observed["actor"][0].equal(expected["actor"][0]) and observed["actor"][2].equal(expected["actor"][2])
        assert done.tolist() == [0, step == 2, 0, step == 4]
    log = env.log()
    assert float(log["/not finite/action"]) == 1 and float(log["/not finite/state"]) == 1
    assert float(log["/termination/not finite"]) == 1  # of the worlds with a finished episode


def test_a_reward_that_is_not_finite_is_counted_and_not_summed():
    env = cart_env(4, rewards={"root": (1.0, lambda w: np.sqrt(0.4 - w.q[0]))}, terminations={})
    env.q[2, 0] = 0.45
    _, reward, done, _ = env.step(torch.zeros(4, 1))
    log = env.log()
    assert done.tolist() == [0, 0, 1, 0] and torch.isfinite(reward).all() and reward[2] == 0
    assert float(log["/not finite/reward"]) == 1 and float(log["/not finite/state"]) == 0
    assert all(torch.isfinite(value) for value in log.values())


def test_events_may_remember():
    """An event in between counts itself, in a memory that resets clear."""

    def change(w):
        w.keep("count", w.memory("count", 1) + 1.0)
        w.qd[0] = w.qd[0] + 0.5

    def start(w):
        w.keep("starts", w.memory("starts", 1, reset=None) + 1.0)

    env = cart_env(3, events=[events.Interval(change, (0.06, 0.06)), events.Reset(start)], terminations={})
    counts = []
    for _ in range(24):
        env.step(torch.zeros(3, 1))
        counts.append(env.memory("count")[0].item())
    assert counts == [0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4, 5, 5, 5, 6, 6, 0, 0, 0, 1, 1]
    assert (env.memory("starts") == 2).all()


def test_reset_of_chosen_worlds():
    env, twin = walker_env(4), walker_env(4)
    for _ in range(3):
        env.step(torch.ones(4, 8))
        twin.step(torch.ones(4, 8))
    before, mask = env.q.clone(), torch.tensor([True, False, True, False])
    env.reset(mask)
    assert env.q[~mask].equal(before[~mask]) and not (env.q[mask] == before[mask]).all()
    assert env.episode_length_buf.tolist() == [0, 3, 0, 3]
    assert env.memory("action")[:, 0].tolist() == [0, 1, 0, 1]
    again = env.q.clone()
    env.reset(mask)
    assert not (env.q[mask] == again[mask]).all()  # new random numbers
    for _ in range(60):  # pushes and commands of the other worlds come as they would have come
        env.step(torch.zeros(4, 8))
        twin.step(torch.zeros(4, 8))
    assert env.q[~mask].equal(twin.q[~mask]) and env.command[~mask].equal(twin.command[~mask])


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: cart_env().step(torch.zeros(8, 2)), r"actions has shape \(8, 2\); expected \(8, 1\).*slide"),
        (lambda: cart_env().reset(torch.ones(3, dtype=torch.bool)), r"mask is torch.bool \(3,\); expected bool \(8,\)"),
        (lambda: cart_env().reset("all"), r"mask is 'all'; expected bool \(8,\)"),
        (
            lambda: cart_env(rewards={"x": (1.0, lambda w: w.q)}),
            "reward 'x' returned an array of shape .2,.; expected one",
        ),
        (lambda: cart_env(rewards={"x": (1.0, lambda w: w.command[0])}), "reads commands"),
        (lambda: cart_env(rewards={"x": (1.0, lambda w: w.contact_force[0, 0])}), "reads contacts"),
        (lambda: cart_env(rewards={"x": (1.0, lambda w: w.joint_q("knee")[0])}), "'knee' matches no joint"),
        (lambda: cart_env(rewards={"x": lambda w: 1.0}), r"rewards\['x'\] is <function.*expected \(weight, term\)"),
        (lambda: cart_env(observations={"a": []}), "expected a list of terms for each group"),
        (lambda: cart_env(decimation=0), "decimation is 0; expected an integer, 1 or more"),
        (lambda: cart_env(dt=-1e-3), "dt is -0.001 s"),
        (lambda: cart_env(default_q=np.zeros(3)), r"default_q has shape \(3,\); expected \(2,\)"),
        (lambda: cart_env(rewards={"x": (1.0, lambda w: 1.0 if w.q[0] > 0 else 0.0)}), "does not take an abstract"),
    ],
)
def test_refusals(call, words):
    with pytest.raises((ValueError, TypeError), match=words):
        call()


def test_terms_in_torch():
    """A reward, a termination and an observation of the user's in torch are those of the same terms, traced."""
    slow = TorchTerm(lambda env: env.qd[:, 0] ** 2, name="slow")
    out = TorchTerm(lambda env: env.q[:, 0].abs() > 0.5, name="out")
    state = TorchTerm(lambda env: torch.cat([env.q, env.qd], dim=1), size=4)
    traced = cart_env()
    mixed_rewards = {"up": (1.0, lambda w: np.cos(w.q[1])), "slow": (-0.1, slow)}
    mixed = cart_env(rewards=mixed_rewards, terminations={"out": out}, observations={"actor": [state]})
    for step in range(30):
        given = 6.0 * torch.cos(torch.arange(8.0)[:, None] + 0.01 * step)
        (a, ra, da, _), (b, rb, db, _) = traced.step(given), mixed.step(given)
        assert a["actor"].equal(b["actor"]) and torch.allclose(ra, rb, atol=FLOAT32) and da.equal(db)
    assert float(mixed.log()["/termination/out"]) > 0
    wrong = cart_env(rewards={"x": (1.0, TorchTerm(lambda env: env.q, name="wide"))})
    with pytest.raises(ValueError, match=r"the term wide returned \(8, 2\); expected a tensor \(8,\)"):
        wrong.step(torch.zeros(8, 1))


def pseudo_inertias(mass, com, inertia):
    """Return the smallest eigenvalue of each body's 4 x 4 pseudo-inertia."""
    spread = 0.5 * np.trace(inertia, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - inertia
    spread = spread + mass[..., None, None] * com[..., :, None] * com[..., None, :]
    whole = np.zeros((*mass.shape, 4, 4))
    whole[..., :3, :3], whole[..., 3, 3] = spread, mass
    whole[..., :3, 3] = whole[..., 3, :3] = mass[..., None] * com
    return np.linalg.eigvalsh(whole)[..., 0]


@pytest.mark.slow
def test_randomised_values_are_those_of_the_dynamics():
    changes = [
        events.randomise("contact_friction", (0.3, 1.2), "set", FEET, alike=True),
        events.pseudo_inertia("trunk", 0.2, 0.3, 0.1, 0.02),
        events.randomise("joint_armature", (0.5, 2.0)),
        events.servo_gains((0.8, 1.2), (0.5, 2.0), when="reset"),
        events.delays((0, 3)),
        events.encoder_bias(0.02),
    ]
    env = walker_env(
        6, events=[events.joints((-0.1, 0.1)), *changes], observations={"a": [observations.joint_position()]}
    )
    friction = env.values["contact_friction"]
    assert (friction[:, :4] == friction[:, :1]).all() and friction[:, 0].unique().numel() == 6
    assert (friction >= 0.3).all() and (friction[:, :4] <= 1.2).all() and (friction[:, 4] == 0.8).all()
    mass, com, inertia = (env.values[f"body_{name}"].double().numpy() for name in ("mass", "com", "inertia"))
    assert (pseudo_inertias(mass, com, inertia) > 0).all() and np.ptp(mass[:, 0]) > 0.5 and np.ptp(mass[:, 1]) == 0
    delay = env.values["actuator_delay"]
    assert set(delay.unique().tolist()) <= {0.0, 1.0, 2.0, 3.0} and delay.unique().numel() > 1
    gains, bias = env.values["actuator_gain"].clone(), env.memory("encoder bias").clone()
    assert 0.01 < bias.abs().max() <= 0.02
    kp, kv = -env.values["actuator_bias"][..., 1], -env.values["actuator_bias"][..., 2]
    assert torch.allclose(kp, gains) and 10 < np.ptp(gains.numpy()) < 16 and 0.8 < np.ptp(kv.numpy()) < 1.5
    names = tuple(env.values)
    dyn = spo.Dynamics(env.scene, 6, "cpu", variable=names)
    dyn.set(**env.values)
    state, force = dyn.actuator_state(like=env.q, longest=3), torch.zeros(6, 5, 3)
    q, qd = env.q.clone(), env.qd.clone()
    for step in range(3):
        given = torch.sin(torch.arange(48.0).view(6, 8) + step)
        stand = torch.as_tensor(env.default_q[7:], dtype=torch.float32)
        ctrl = (stand - bias + 0.25 * given).contiguous()
        dyn.step(
            q,
            qd,
            None,
            5e-3,
            ctrl=ctrl,
            options=spo.StepOptions(substeps=4),
            actuator_state=state,
            report=spo.StepReport(contact_f=force),
            out=(q, qd),
        )
        observed, _, done, _ = env.step(given)
        assert not done.any() and torch.allclose(env.q, q, atol=1e-5) and torch.allclose(env.qd, qd, atol=1e-3)
        assert torch.allclose(observed["a"], env.q[:, 7:] + bias - stand, atol=FLOAT32)
    env.reset(torch.tensor([True] * 2 + [False] * 4))
    changed = (env.values["actuator_gain"] != gains).any(dim=1)
    assert changed.tolist() == [True] * 2 + [False] * 4 and env.memory("encoder bias").equal(bias)
    with pytest.raises(ValueError, match="two events change entry 0 of body_mass"):
        walker_env(events=[events.randomise("body_mass", (0.9, 1.1)), events.pseudo_inertia("trunk")])


def bilinear(field, x, y):
    """Return the heights of a field at points."""
    found = []
    for a, b in zip(x.ravel(), y.ravel(), strict=True):
        u, v = (a - field.origin[0]) / field.cell, (b - field.origin[1]) / field.cell
        i, j = (int(np.clip(np.floor(w), 0, n - 2)) for w, n in zip((u, v), field.heights.shape, strict=True))
        s, t, h = np.clip(u - i, 0, 1), np.clip(v - j, 0, 1), field.heights[i : i + 2, j : j + 2]
        found.append(h[0, 0] * (1 - s) * (1 - t) + h[1, 0] * s * (1 - t) + h[0, 1] * (1 - s) * t + h[1, 1] * s * t)
    return np.array(found).reshape(x.shape)


def allocated():
    """Return the bytes of all arrays and tensors that own memory."""
    gc.collect()
    sizes = {}
    for thing in gc.get_objects():
        if type(thing) is wp.array and thing.deleter is not None:
            sizes[thing.ptr] = thing.capacity
        elif type(thing) is torch.Tensor:
            sizes[thing.untyped_storage().data_ptr()] = thing.untyped_storage().nbytes()
    return sum(size for place, size in sizes.items() if place)


@pytest.mark.slow
def test_bytes_of_a_world_are_those_of_all_arrays():
    """More worlds take as much more memory; values that events change, and what is derived from them, included."""
    found = []
    for worlds in (1024, 2048):
        env = walker_env(worlds, events=[events.randomise("body_mass", (0.8, 1.2)), events.push(0.5)])
        env.step(torch.zeros(worlds, 8))
        found.append(allocated())
        expected = env.bytes_per_world
        del env
    assert (found[1] - found[0]) / 1024 == pytest.approx(expected, abs=8)


@pytest.mark.slow
def test_terrain_levels_and_height_scan():
    tiles = spo.terrain.tiles(4, 3, (6.0, 6.0), 0.1, seed=2)
    scene = walker_scene()
    scene = scene.with_contacts(scene.contacts, tiles.field)
    env = walker_env(
        8,
        scene=scene,
        observations={"a": [observations.height_scan((0.5, 0.2), 0.1, 0.5), lambda w: w.base_height]},
        events=[events.terrain(tiles, rows=2), events.base(yaw=(-3.0, 3.0)), events.joints((-0.1, 0.1))],
        commands=commands.Velocity(forward=(1.0, 1.0), left=(0.0, 0.0)),
        terminations={},
        rewards={"height": (1.0, rewards.base_height(0.3))},
    )
    row, column = env.memory("terrain").clone().unbind(1)
    starts = tiles.origins[row.int().numpy(), column.int().numpy()]
    assert set(row.tolist()) == {0.0, 1.0} and len(set(column.tolist())) > 1
    assert np.allclose(env.q[:, :3].numpy() - walker_q()[:3], starts, atol=1e-5)
    env.q[:, :2] += torch.linspace(-1.0, 1.0, 8)[:, None]
    for _ in range(3):
        observed, _, _, _ = env.step(torch.zeros(8, 8))
    q = env.q.double().numpy()
    x, y, z, w = q[:, 3:7].T
    heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    grid = np.array([(a, b) for a in np.linspace(-0.25, 0.25, 6) for b in np.linspace(-0.1, 0.1, 3)]).T
    c, s = np.cos(heading)[:, None], np.sin(heading)[:, None]
    ground = bilinear(tiles.field, q[:, :1] + c * grid[0] - s * grid[1], q[:, 1:2] + s * grid[0] + c * grid[1])
    assert np.allclose(observed["a"][:, :18].numpy(), q[:, 2:3] - 0.5 - ground, atol=1e-4)  # steep cells, float32
    assert np.allclose(observed["a"][:, 18].numpy(), q[:, 2] - bilinear(tiles.field, q[:, 0], q[:, 1]), atol=1e-4)
    env.episode_length_buf = torch.full((8,), 99)
    far = torch.arange(8) % 2 == 0  # half of the worlds stand more than half a tile away, the others nowhere
    some = torch.arange(8) % 4 == 1  # have gone 0.3 m in the four steps that they took, more than half of 1 m/s
    away = torch.where(far, 3.5, torch.where(some, 0.3, 0.0))[:, None] * torch.tensor([[1.0, 0.0]])
    env.q[:, :2] = torch.as_tensor(starts[:, :2], dtype=torch.float32) + away
    _, _, done, extras = env.step(torch.zeros(8, 8))
    assert done.all() and extras["time_outs"].all()
    expected = torch.where(far, row + 1, torch.where(some, row, (row - 1).clamp(min=0)))
    assert env.memory("terrain")[:, 0].equal(expected) and env.memory("terrain")[:, 1].equal(column)


@pytest.mark.slow
def test_forces_of_drives():
    """Forces that terms see of drives and efforts: ke (target - q) - kd qd within the limit, and what actions say."""
    scene = walker_scene().with_values(
        joint_target_ke=np.r_[np.zeros(6), np.full(8, 30.0)],
        joint_target_kd=np.r_[np.zeros(6), np.full(8, 1.0)],
        joint_effort_limit=np.r_[np.full(6, 1e6), np.full(8, 4.0)],
    )
    both = [actions.Position(scale=0.3), actions.Effort("joint.*|.*", scale=2.0)]
    env = walker_env(
        3,
        scene=scene,
        actions=both,
        events=[],
        terminations={},
        observations={"a": [lambda w: w.joint_force]},
        rewards={},
    )
    given = torch.sin(torch.arange(48.0)).view(3, 16)
    observed, _, _, _ = env.step(given)
    stand = torch.as_tensor(walker_q()[7:], dtype=torch.float32)
    drive = (30.0 * (stand + 0.3 * given[:, :8] - env.q[:, 7:]) - env.qd[:, 6:]).clamp(-4.0, 4.0)
    assert (drive.abs() == 4.0).any() and (drive.abs() < 4.0).any()
    assert torch.allclose(observed["a"][:, 6:], drive + 2.0 * given[:, 8:], atol=1e-4)
    assert (observed["a"][:, :6] == 0).all()


@pytest.mark.slow
def test_commands_grow_with_a_reward():
    level = commands.Level("standing", share=0.5, first=0.2, step=0.1)
    env = walker_env(
        3,
        commands=commands.Velocity(forward=(1.0, 1.0), left=(-1.0, -1.0), turn=(0.5, 0.5), level=level),
        rewards={"standing": (2.0, TorchTerm(lambda env: torch.tensor([1.0, 0.2, 1.0])))},
        terminations={},
        episode_length_s=0.06,
    )
    for step in range(7):
        shares = torch.tensor([1.0, 0.0, 1.0]) * (step // 3) * 0.1 + 0.2
        assert torch.allclose(env.command, shares[:, None] * torch.tensor([1.0, -1.0, 0.5]), atol=1e-6)
        env.step(torch.zeros(3, 8))
