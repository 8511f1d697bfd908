"""Values that terms read are those of their world: first observations, memories, periods, held commands, its values."""

import itertools

import numpy as np
import pytest
import torch

import warp_spo as spo
import warp_spo.env as envs
from support.env_scenes import FEET, cart_env, cart_scene, walker_env, walker_q, walker_scene
from warp_spo.env import TorchTerm, actions, commands, curricula, evaluation, events, observations, rewards
from warp_spo.env.tasks import velocity
from warp_spo.recursions.contact import coupled
from warp_spo.reference import Dense

FLOAT32 = 1e-6  # a few roundings of numbers of size one
STILL = dict(terminations={}, rewards={}, events=[])


def compare_gaps(env, observed):
    """Return what is observed of gaps, and those of the dense reference at the environment's state."""
    wanted = []
    for q in env.q.double().numpy():
        poses = spo.Dynamics(env.scene, 1, "cpu", "float64").body_poses(q[None])[0]
        for point in env.scene.contact_points[:4]:
            u, w = poses[point.body, 3:6], poses[point.body, 6]
            v = np.array(point.position)
            place = poses[point.body, :3] + v + 2.0 * np.cross(u, np.cross(u, v) + w * v)
            wanted.append(place[2] - point.radius)
    return observed["a"][:, :4].double().numpy(), np.reshape(wanted, (-1, 4))


def test_first_gaps_and_slips_are_those_of_the_new_state():
    """After construction, resets of all and of some worlds, and at ends of episodes, with velocities at the start."""
    env = walker_env(
        4, commands=None, terminations={"low": lambda w: w.q[2] < 0.3}, rewards={},
        observations={"a": [observations.feet_height(FEET), lambda w: [*w.contact_slip, *w.contact_force.ravel()]]},
        events=[events.base(z=(0.0, 0.2), roll=(-0.3, 0.3), velocity=(-1.0, 1.0)), events.joints((-0.2, 0.2))],
    )  # fmt: skip

    def check(observed, worlds):
        found, wanted = compare_gaps(env, observed)
        np.testing.assert_allclose(found[worlds], wanted[worlds], atol=FLOAT32)
        speeds = np.linalg.norm(env.qd[worlds, :2].numpy(), axis=1)  # of the belly where nothing turns
        np.testing.assert_allclose(observed["a"][worlds, 8].numpy(), speeds, rtol=1e-4, atol=1e-4)
        assert (observed["a"][worlds, 9:] == 0.0).all()

    check(env.get_observations(), [0, 1, 2, 3])
    for _ in range(3):
        env.step(torch.randn(4, 8, generator=torch.Generator().manual_seed(1)))
    check(env.reset()[0], [0, 1, 2, 3])
    env.step(torch.zeros(4, 8))
    check(env.reset(torch.tensor([False, True, False, True]))[0], [1, 3])
    env.q[1, 2] = 0.1
    observed, _, done, _ = env.step(torch.zeros(4, 8))
    assert done.tolist() == [0, 1, 0, 0]
    check(observed, [1])


@pytest.mark.parametrize("kind", ["effort", "drive", "servo"])
def test_first_forces_are_those_of_the_action_zero(kind):
    """A held push of the episode before is gone; drives and servos pull from the new state to the default."""
    gains = dict(joint_target_ke=[50.0, 0.0], joint_target_kd=[2.0, 0.0]) if kind == "drive" else {}
    scene = cart_scene()
    if kind == "servo":
        servo = spo.Actuator(0, gain=50.0, bias=(0.0, -50.0, -2.0))
        scene = spo.Scene(scene.bodies, scene.hinges, actuators=[servo])
    act = {"effort": actions.Effort("slide", scale=7.0, offset=0.5), "drive": actions.Position("slide", scale=0.3),
           "servo": actions.Control(scale=0.3, offset="default")}[kind]  # fmt: skip
    env = cart_env(4, scene=scene.with_values(**gains), actions=act, observations={"a": [lambda w: w.joint_force]})

    def check(observed, worlds):
        q, qd = (x[worlds, 0].numpy() for x in (env.q, env.qd))
        wanted = np.full(len(worlds), 0.5) if kind == "effort" else -50.0 * q - 2.0 * qd
        np.testing.assert_allclose(observed["a"][worlds, 0].numpy(), wanted, atol=1e-4)

    check(env.get_observations(), [0, 1, 2, 3])
    for _ in range(2):
        env.step(torch.ones(4, 1))
    check(env.reset(torch.tensor([True, False, True, False]))[0], [0, 2])
    env.step(torch.ones(4, 1))
    env.q[2, 0] = 0.6
    observed, _, done, _ = env.step(torch.ones(4, 1))
    assert done.tolist() == [0, 0, 1, 0]
    check(observed, [2])


def test_what_start_and_reset_keep_stays():
    """Numbers of Start for good, those of Reset until the next one; a curriculum in Reset counts episodes."""

    def change(w):
        w.keep("level", w.memory("level", 1) + 1.0)
        w.keep("place", [w.q[0]])

    seen = lambda w: [w.memory(name, 1)[0] for name in ("own", "level", "place")]  # noqa: E731
    env = cart_env(
        3, observations={"a": [seen]}, terminations={},
        events=[events.joints((-0.1, 0.1)), events.Start(lambda w: w.keep("own", [w.uniform(1.0, 2.0)])),
                events.Reset(change, levels=("level",))],
    )  # fmt: skip
    own, place = env.memory("own").clone(), env.q[:, :1].clone()
    assert (own >= 1.0).all() and own.unique().numel() == 3
    for step in range(1, 45):
        observed, *_ = env.step(torch.ones(3, 1))
        if step % 20 == 0:
            place = env.q[:, :1].clone()
        level = torch.full((3, 1), 1.0 + step // 20)
        assert observed["a"].equal(torch.cat([own, level, place], dim=1)), step
    assert env.levels()["level"].equal(torch.full((3, 1), 3.0))


def test_the_time_in_events_is_that_of_their_world():
    """Zero where an episode starts, the time after the step where one goes on."""

    def start(w):
        w.keep("start", [w.time, 1.0 if w.before is None else w.before.time])

    def change(w):
        w.keep("change", [w.time])

    seen = {"a": [lambda w: [*w.memory("start", 2), w.memory("change", 1)[0]]]}
    env = cart_env(
        2, observations=seen, terminations={}, events=[events.Reset(start), events.Interval(change, (0.06, 0.06))]
    )
    found = torch.stack([env.step(torch.zeros(2, 1))[0]["a"][0] for _ in range(20)])
    assert torch.allclose(found[[2, 5], 2], torch.tensor([0.06, 0.12])) and (found[:, 0] == 0.0).all()
    assert (found[:19, 1] == 1.0).all() and found[19, 1] == pytest.approx(0.4)


def test_frames_in_resets_and_commands_are_those_of_the_state_that_starts():
    """A reset that has placed the pole, and a command about it, read where it is now and not where it was."""

    def place(w):
        w.q[0], w.q[1] = w.uniform(-0.3, 0.3), w.uniform(-0.5, 0.5)
        w.keep("place", [*w.frame("pole").position, *w.jacobian("pole")[0]])

    class Above(commands.Uniform):
        def draw(self, w, done):
            return {"command": [w.frame("pole").position[0] + w.uniform(1.0, 1.0)]}

    env = cart_env(
        4, events=[events.Reset(place)], commands=Above(((0.0, 2.0),)), terminations={"out": lambda w: w.q[0] > 0.9},
        observations={"a": [lambda w: w.memory("place", 5, reset=None), lambda w: w.command]},
    )  # fmt: skip
    dyn = spo.Dynamics(env.scene, 4, "cpu", "float64")

    def check(observed, worlds):
        place = dyn.frame_poses(env.q.double(), ["pole"])[:, 0, :3]
        wanted = torch.cat([place, dyn.jacobian(env.q.double(), ["pole"])[:, 0, 0], place[:, :1] + 1.0], dim=1)
        torch.testing.assert_close(observed["a"].double()[worlds], wanted[worlds], rtol=0.0, atol=FLOAT32)

    check(env.get_observations(), [0, 1, 2, 3])
    env.step(torch.ones(4, 1))
    check(env.reset(torch.tensor([True, False, True, False]))[0], [0, 2])
    env.q[1, 0] = 1.0
    observed, _, done, _ = env.step(torch.ones(4, 1))
    assert done.tolist() == [0, 1, 0, 0]
    check(observed, [1])
    mounts = events.randomise("joint_X_p", [(0.0, 0.1)] * 3 + [(0.0, 0.0)] * 4, "add", when="reset")
    with pytest.raises(ValueError, match=r"World.frame: .* reads 'pole' where an episode starts; .* joint_X_p"):
        cart_env(1, events=[events.Reset(place), mounts])


def test_phases_are_counted_in_whole_steps():
    """Of a period of seven steps, far into an episode: exact to the rounding of a number below one."""
    clock = lambda w: w.phase(7 * w.dt)  # noqa: E731
    env = cart_env(
        2, observations={"clock": [clock]}, rewards={"clock": (1.0, clock)}, terminations={}, episode_length_s=1e5,
        final_observations=True,
    )  # fmt: skip
    assert (env.reset()[0]["clock"] == 0.0).all()
    env.episode_length_buf = torch.tensor([0, 1_000_003])
    for step in range(1, 9):
        found, rewards, _, extras = env.step(torch.zeros(2, 1))
        for each in (found["clock"][:, 0], rewards / env.step_dt, extras["final_observations"]["clock"][:, 0]):
            np.testing.assert_allclose(each, [step % 7 / 7, (1_000_003 + step) % 7 / 7], atol=1e-6, rtol=0)


def test_exports_are_of_the_robot_that_is_not_drawn():
    """Gears that a world draws are not those of an exported policy's robot, and are there again afterwards."""
    export = pytest.importorskip("warp_spo.env.export")
    env = walker_env(
        2, **(STILL | dict(events=[events.randomise("actuator_gear", (0.5, 0.8)), events.encoder_bias(0.1)]))
    )
    gears, bias = env.values["actuator_gear"].clone(), env.memory("encoder bias").clone()
    np.testing.assert_allclose(export.controls_of(env)[1], walker_q()[7:], rtol=1e-5)
    assert env.values["actuator_gear"].equal(gears) and env.memory("encoder bias").equal(bias)


def test_memories_of_other_sizes_and_of_values_are_refused():
    """Numbers beyond those of a name would be those of another one."""
    with pytest.raises(ValueError, match=r"World.keep\('x'\) was given a list of 2; expected one number"):
        cart_env(
            2, rewards={"a": (1.0, lambda w: w.memory("x", 1)[0]), "b": (1.0, lambda w: w.keep("x", [1.0, 2.0]) or 0.0)}
        )
    with pytest.raises(
        ValueError, match=r"World.memory: 'x' has 1 numbers, which a reset sets to 0.0; a term asks for 1, set to None"
    ):
        cart_env(
            2, rewards={"a": (1.0, lambda w: w.memory("x", 1, reset=0.0)[0])},
            events=[events.Reset(lambda w: w.keep("x", [1.0]))],
        )  # fmt: skip

    def change(w):
        w.keep("x", [1.0])

    with pytest.raises(ValueError, match=r"events.Values: .* keeps x; expected changes of values alone"):
        cart_env(2, events=[events.Values(("body_mass",), change)])


def read_feet(env):
    """Return which feet touch, and their gaps [world, foot]."""
    return env._tensors["contact_f"][:, :4].norm(dim=2).numpy() > 1.0, env._tensors["contact_gap"][:, :4].numpy().copy()


@pytest.mark.slow
def test_terms_of_one_memory_leave_it_to_each_other():
    """Twice with other arguments, and twice alike as reward and observation, beside NumPy."""
    longest, heights = (0.06, 0.16), (0.05, 0.07)
    terms = [rewards.stepping(FEET, 0.02, longest=each) for each in longest]
    terms += [velocity.swing_height(FEET, each, least_command=-1.0) for each in heights]
    seen = {"a": [*terms, terms[0]]}
    env = walker_env(4, **(STILL | dict(observations=seen, rewards={str(i): (1.0, t) for i, t in enumerate(terms)})))
    low, high, top, before, landed = np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((4, 4), bool), 0
    for step in range(30):
        observed, reward, *_ = env.step(1.5 * torch.sin(torch.arange(32.0).view(4, 8) + 0.35 * step))
        touches, gap = read_feet(env)
        low, high, top = np.where(touches, 0, low + 1), np.where(gap > 0.02, 0, high + 1), np.maximum(gap, top)
        wanted = [((low < each / 0.02 - 0.5) & (high < each / 0.02 - 0.5)).mean(1) for each in longest]
        wanted += [np.where(touches & ~before, (top / each - 1.0) ** 2, 0.0).sum(1) for each in heights]
        np.testing.assert_allclose(observed["a"].numpy(), np.stack([*wanted, wanted[0]], 1), rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(reward.numpy(), 0.02 * np.sum(wanted, axis=0), rtol=1e-4, atol=1e-5)
        landed += (touches & ~before & (top > 0.01)).sum()
        top, before = np.where(touches, 0.0, top), touches
    assert landed > 5


def test_names_of_the_environments_own_memories_are_refused():
    """Every name of an environment's memory that its own parts keep; names that only resemble them stay free."""
    plain = cart_env(1, metrics={"m": lambda w: 0.0}, commands=commands.Uniform(((0.0, 1.0),)),
                     observations={"a": [observations.Observation(lambda w: w.q, bias=0.1, delay=(0, 1))]},
                     rewards={"up": (curricula.Curriculum(1.0, 2.0, curricula.BySuccess("m", 0.5)), lambda w: 1.0)},
                     events=[events.Interval(lambda w: None)])  # fmt: skip
    for name in plain._layout.memory:
        with pytest.raises(ValueError, match="under which the environment itself remembers"):
            cart_env(1, rewards={"r": (1.0, lambda w, name=name: w.keep(name, [1.0]) or 0.0)})
    free = ["last height", "actions", "command mine", "history", "sum", "until dawn", "bias", "curriculum"]

    def own(w):
        for name in free:
            w.keep(name, [1.0])
        return 0.0

    assert {*free} < {*cart_env(1, rewards={"r": (1.0, own)})._layout.memory}


def test_names_of_memories_tell_a_text_from_a_tuple():
    """Expressions that print alike are not the same bodies."""
    env = walker_env(
        2,
        **(
            STILL
            | dict(
                observations={
                    "a": [lambda w: w.feet("shank0|shank1").air_time, lambda w: w.feet(("shank0|shank1",)).air_time]
                }
            )
        ),
    )
    assert {name for name in env._layout.memory if name.startswith("feet")} == {
        "feet 'shank0|shank1' 1.0",
        "feet ('shank0|shank1',) 1.0",
    }


@pytest.mark.parametrize(("seconds", "dt"), [
    (1.0, 0.02), *(pytest.param(seconds, dt, marks=pytest.mark.slow) for seconds, dt in itertools.product(
        (1.0, 2.0, 3.0, 5.0), (0.02, 0.005, 1.0 / 60.0, 0.1)) if (seconds, dt) != (1.0, 0.02)),
])  # fmt: skip
def test_periods_are_whole_steps(dt, seconds):
    """Pushes, redraws of commands and of values come every ``seconds`` / ``dt`` steps, exactly, again and again."""
    count = 0

    def change(w):
        w.keep("pushes", w.memory("pushes", 1, reset=None) + 1.0)

    steps, period = round(seconds / dt), (seconds, seconds)
    env = cart_env(
        1, dt=dt, decimation=1, terminations={}, episode_length_s=1e4 * dt,
        commands=commands.Uniform(((-1.0, 1.0),), period),
        observations={"a": [lambda w: [w.command[0], w.memory("pushes", 1, reset=None)[0], w.value("body_mass")[0]]]},
        events=[events.Interval(change, period), events.randomise("body_mass", (0.5, 2.0), when=period)],
    )  # fmt: skip
    before, changed = env.get_observations()["a"], []
    for step in range(1, 2 * steps + 2 if steps <= 100 else steps + 2):
        observed = env.step(torch.zeros(1, 1))[0]["a"]
        changed += [(step, *(observed != before)[0].tolist())] * bool((observed != before).any())
        before, count = observed, count + 1
    assert changed == [(steps * k, True, True, True) for k in range(1, count // steps + 1)]


@pytest.mark.parametrize(("seconds", "dt", "steps"), [
    (0.05, 0.02, 3), (0.29, 0.02, 15), (1.0, 0.02, 50), (0.3, 0.1, 3), (1.1, 0.1, 11), (0.001, 0.02, 1)
])  # fmt: skip
def test_an_episode_lasts_until_its_time_has_passed(seconds, dt, steps):
    """The time-out is that of the first step whose end is at ``episode_length_s`` or later, and of no other."""
    env = cart_env(1, dt=dt, decimation=1, terminations={}, episode_length_s=seconds)
    assert env.max_episode_length == steps
    outs = [bool(env.step(torch.zeros(1, 1))[3]["time_outs"][0]) for _ in range(steps)]
    assert outs == [False] * (steps - 1) + [True]


def test_waits_are_within_their_range_and_of_the_seed():
    """The first change of a value waits, too, and a reset with a seed repeats all of it."""
    env = cart_env(
        64, terminations={}, episode_length_s=10.0, observations={"a": [lambda w: w.value("body_mass")[0]]},
        events=[events.randomise("body_mass", (0.5, 2.0), when=(0.1, 0.2))],
    )  # fmt: skip
    runs = []
    for _ in range(2):
        observed = env.reset(seed=3)[0]["a"]
        runs.append([observed] + [env.step(torch.zeros(64, 1))[0]["a"] for _ in range(30)])
    assert all(a.equal(b) for a, b in zip(*runs, strict=True))
    changes = (torch.stack(runs[0])[1:] != torch.stack(runs[0])[:-1])[..., 0].numpy()
    for world in range(64):
        at = np.r_[0, 1 + np.flatnonzero(changes[:, world])]
        assert (np.diff(at) >= 5).all() and (np.diff(at) <= 10).all() and at[1] >= 5, world
    assert len({int(np.flatnonzero(row)[0]) for row in changes.T}) > 3


@pytest.mark.parametrize("asked", [
    commands.Velocity(heading=(-3.0, 3.0), seconds=(0.04, 0.08), standing=0.5),
    commands.Velocity(seconds=(0.04, 0.08), standing=0.5),
], ids=["heading", "redraws"])  # fmt: skip
def test_a_written_command_is_held(asked):
    """Through redraws, headings and new episodes; other worlds and other numbers go on as they would."""
    env, twin = (walker_env(4, commands=asked, terminations={}, episode_length_s=0.3) for _ in range(2))
    env.command[1] = torch.tensor([0.0, 0.0, 0.0])  # also where the world stands already
    env.command[2, 2] = 0.3
    changed = 0
    for _ in range(40):
        observed, *_ = env.step(torch.zeros(4, 8))
        twin.step(torch.zeros(4, 8))
        assert (env.command[1] == 0.0).all() and env.command[2, 2] == pytest.approx(0.3)
        assert env.command[[0, 3]].equal(twin.command[[0, 3]]) and env.command[2, :2].equal(twin.command[2, :2])
        assert observed["actor"][:, 6:9].equal(env.command.clone())
        changed += int(not twin.command[1].equal(torch.zeros(3)))
    assert changed > 5
    env.memory("command held")[:] = 0.0
    for _ in range(15):
        env.step(torch.zeros(4, 8))
    assert env.memory("command held").sum() == 0.0 and (env.command[2, 2] != 0.3 or env.command[1].any())
    env.command = torch.tensor([0.1, 0.2, 0.3])
    assert env.memory("command held").all()
    env.reset(seed=0)
    assert not env.memory("command held").any()


@pytest.mark.slow
class Told:
    """A command of one's own: the time, the action, how often it was updated in the episode, and where it was drawn."""

    size, seconds = 6, (9.0, 9.0)

    def draw(self, w, done):
        return {"command": [0.0, 0.0, 0.0, w.time, w.action[0], w.q[0]]}

    def update(self, w, command):
        w.keep("updates", w.memory("updates", 1) + 1.0)
        return [w.time, w.action[0], w.memory("updates", 1)[0], *command[3:]]


def test_commands_of_ones_own_see_the_episode_that_starts():
    """World 1 ends after 2 of 4 steps; time, action and memory are 0 where an episode starts, for draws, too."""
    env = cart_env(
        2, events=[events.joints((0.1, 0.2))], terminations={}, episode_length_s=0.08, commands=Told(),
    )  # fmt: skip
    env.episode_length_buf = torch.tensor([0, 2])
    ages = [0, 2]
    for _ in range(9):
        observed, _, done, _ = env.step(torch.full((2, 1), 0.5))
        for world in range(2):
            ages[world] = 0 if done[world] else ages[world] + 1
            time, action, updates, drawn_time, drawn_action, place = env.command[world].tolist()
            assert time == pytest.approx(ages[world] * env.step_dt) and action == (0.5 if ages[world] else 0.0)
            assert updates <= ages[world] + 1 and drawn_time == drawn_action == 0.0
            if done[world]:
                assert updates == 0.0 and place == observed["actor"][world, 0]


def test_evaluations_hold_their_command():
    """In every observation of a rollout, the first one included; the environment's own command comes back."""
    env, seen = walker_env(4, terminations={}), []

    def policy(observed):
        seen.append(observed["actor"][:, 6:9].clone())
        return torch.zeros(4, 8)

    evaluation.tracking(env, policy, seconds=0.5, command=(0.3, 0.0, 0.3))
    assert torch.allclose(torch.stack(seen), torch.tensor([0.3, 0.0, 0.3]))
    assert not env.memory("command held").any()


def test_a_tensor_marks_what_is_written():
    """Through views, in place, by out=; reading marks nothing, and results are plain tensors."""
    from warp_spo.env.held_tensor import HeldTensor

    marks = torch.zeros(3, 2)
    held = HeldTensor.of(torch.zeros(2, 3).t(), marks)
    for write, wanted in [
        (lambda: held.__setitem__(1, 5.0), [0, 1, 0]), (lambda: held[:, 0].add_(1.0), [0.5, 0.5, 0.5]),
        (lambda: held.unbind(0)[2].copy_(torch.ones(2)), [0, 0, 1]),
        (lambda: torch.add(held, 1.0, out=held), [1, 1, 1]),
        (lambda: held[torch.tensor([True, False, True])].add_(1.0), [0, 0, 0]),
        (lambda: held.clone().zero_(), [0, 0, 0]),
        (lambda: (held * 2.0, held.sum(), held.numpy(), held.equal(marks), held[0].tolist()), [0, 0, 0]),
    ]:  # fmt: skip
        marks.zero_()
        write()
        assert marks.mean(dim=1).tolist() == wanted
    assert all(type(x) is torch.Tensor for x in (held + 1.0, held.clone(), torch.stack([held]), held.double()))


def test_functions_of_an_index_mark_what_they_write_and_refused_writes_nothing():
    """Marks are where the same function changes a plain tensor of zeros; beside torch itself."""
    from warp_spo.env.held_tensor import HeldTensor

    mask, rows, two = torch.tensor([[True], [False], [False]]), torch.tensor([0, 2]), torch.full((2, 2), 5.0)
    index = torch.tensor([[1], [0]])
    for write in (
        lambda x: x.masked_fill_(mask, 5.0), lambda x: x.masked_fill_(mask=mask, value=5.0),
        lambda x: x.masked_scatter_(mask.expand(3, 2), two), lambda x: x.index_fill_(0, rows, 5.0),
        lambda x: x.index_copy_(0, rows, two), lambda x: x.index_add_(0, rows, two, alpha=2.0),
        lambda x: x.scatter_(1, index, 5.0), lambda x: x.scatter_(1, index, 5.0, reduce="add"),
        lambda x: x.scatter_add_(1, index=index, src=two), lambda x: x.index_put_((rows, rows // 2), two[0]),
        lambda x: x.index_put_((rows,), two, accumulate=True), lambda x: x[1:].index_fill_(0, torch.tensor([1]), 2.0),
        lambda x: x.__iadd__(1.0), lambda x: x.t().index_fill_(0, torch.tensor([1]), 2.0),
    ):  # fmt: skip
        marks, plain = torch.zeros(3, 2), torch.zeros(3, 2)
        held = HeldTensor.of(torch.zeros(3, 2), marks)
        write(held), write(plain)
        assert torch.equal(marks, (plain != 0).float()) and torch.equal(
            torch.Tensor.as_subclass(held, torch.Tensor), plain
        )
    for refused in (
        lambda x: x.copy_(torch.ones(7)), lambda x: x.__setitem__(0, torch.ones(7)), lambda x: x.add_("a"),
        lambda x: torch.add(x, torch.ones(7), out=x), lambda x: x.index_copy_(0, rows, torch.ones(3, 3)),
    ):  # fmt: skip
        marks = torch.zeros(3, 2)
        with pytest.raises((RuntimeError, TypeError, IndexError)):
            refused(HeldTensor.of(torch.zeros(3, 2), marks))
        assert not marks.any()


def test_joint_limits_are_the_worlds():
    scene = walker_scene(delay=0).with_values(
        joint_limit_lower=np.r_[[-1e10] * 6, [-1.4] * 7, -1e10], joint_limit_upper=np.r_[[1e10] * 6, [1.0] * 8]
    )
    drawn = events.randomise("joint_limit_upper", (0.2, 0.9), names="joint_.*")
    env = walker_env(6, scene=scene, **(STILL | dict(observations={"a": [rewards.joint_limits(0.5)]}, events=[drawn])))
    low, high = (
        env.scene.values["joint_limit_lower"][0, 6:13],
        env.values["joint_limit_upper"][:, 6:13].double().numpy(),
    )
    assert np.ptp(high, axis=0).min() > 0.1
    beyond = abs(env.q[:, 7:14].double().numpy() - 0.5 * (low + high)) - 0.25 * (high - low)
    np.testing.assert_allclose(env.get_observations()["a"][:, 0].numpy(), np.maximum(beyond, 0.0).sum(1), rtol=1e-5)


@pytest.mark.parametrize("drawn", [False, True], ids=["of the scene", "drawn"])
def test_gravity_is_the_worlds(drawn):
    """projected_gravity and tilt along gravity, wherever it points."""
    scene = walker_scene()
    scene = spo.Scene(
        scene.bodies, scene.hinges, gravity=(3.0, -4.0, -5.0), actuators=scene.actuators, contacts=scene.contacts
    )
    drawn_values = [events.randomise("gravity", [(-2.0, 2.0)] * 3, "add")] if drawn else []
    changes = [events.base(yaw=(-3.0, 3.0), roll=(-0.5, 0.5)), *drawn_values]
    seen = {"a": [observations.projected_gravity, rewards.tilt]}
    env = walker_env(5, scene=scene, **(STILL | dict(observations=seen, events=changes)))
    gravity = env.values["gravity"].double().numpy() if drawn else np.tile([3.0, -4.0, -5.0], (5, 1))
    along = gravity / np.linalg.norm(gravity, axis=1, keepdims=True)
    u, w = -env.q[:, 3:6].double().numpy(), env.q[:, 6:7].double().numpy()
    back = along + 2.0 * np.cross(u, np.cross(u, along) + w * along)
    found = env.get_observations()["a"].double().numpy()
    np.testing.assert_allclose(found[:, :3], back, atol=FLOAT32)
    np.testing.assert_allclose(found[:, 3], (back[:, :2] ** 2).sum(1), atol=FLOAT32)


def test_gears_and_grounds_are_the_worlds():
    """Offsets of servos in lengths of the drawn gear, and rays to a plane where the drawn ground is."""
    from warp_spo.env import rays

    gears = events.randomise("actuator_gear", (0.8, 1.2))
    moved = events.randomise("ground_origin", [(0.0, 0.0), (0.0, 0.0), (-0.2, 0.2)], "add")
    down = rays.lidar([(0.0, 0.0, -1.0)])
    env = walker_env(
        4,
        **(
            STILL
            | dict(
                observations={"a": [down, lambda w: w.base_height, lambda w: w.contact_gap[4]]}, events=[gears, moved]
            )
        ),
    )
    controls = env.controls(torch.zeros(4, 8))["ctrl"].numpy()
    np.testing.assert_allclose(controls, env.values["actuator_gear"].numpy() * walker_q()[7:], rtol=1e-5)
    height = walker_q()[2] - env.values["ground_origin"][:, 2:].numpy()
    assert np.ptp(height) > 0.05
    np.testing.assert_allclose(env.get_observations()["a"].numpy(), height - [0.0, 0.0, 0.05], atol=1e-5)


def test_worlds_of_a_scene_may_differ():
    """Values, and first gaps where legs are of other lengths, of a scene whose worlds have their own."""
    scene = walker_scene()
    poses = np.repeat(scene.values["joint_X_p"], 3, axis=0)
    poses[:, 2::2, 2] -= np.array([[0.0], [0.05], [0.1]])
    scene = scene.with_values(joint_X_p=poses)
    seen = {"a": [observations.feet_height(FEET), lambda w: w.value("joint_X_p")[2, 2]]}
    env = walker_env(3, scene=scene, **(STILL | dict(observations=seen)))
    observed = env.get_observations()["a"].double().numpy()
    np.testing.assert_allclose(observed[:, 4], poses[:, 2, 2], rtol=1e-6)
    for world, q in enumerate(env.q.double().numpy()):
        dense = Dense(scene, q, world=world)
        feet = [dense.body_matrix[2 * leg + 2] @ [0.0, 0.0, -0.2, 1.0] for leg in range(4)]
        np.testing.assert_allclose(observed[world, :4], [foot[2] - 0.02 for foot in feet], atol=FLOAT32)


def test_a_loaded_log_leaves_out_what_the_saved_one_does():
    env, other = (cart_env(8, terminations={}) for _ in range(2))
    env.episode_length_buf = torch.tensor([0, *[5] * 7])
    state = env.state_dict()
    other.load_state_dict(state)
    for each in (env, other):
        for _ in range(20):
            each.step(torch.zeros(8, 1))
    assert env.log()["/episode/whole"] == other.log()["/episode/whole"] == 1 and other.log()["/episode/finished"] == 8


@pytest.mark.parametrize(("event", "words"), [
    (events.randomise("body_mass", (0.0, 1.0)),
     r"body_mass of body trunk would be between 0 and 6.*span \(0.0, 1.0\); expected masses above zero"),
    (events.randomise("body_mass", (-7.0, 1.0), "add"), "body_mass of body trunk .* between -1 and 7 .*above zero"),
    (events.randomise("contact_friction", (-0.1, 1.0), "set"), "of contact 0 .* between -0.1 and 1 .*zero or more"),
    (events.randomise("body_inertia", (-0.5, 1.0)), "of body trunk .* expected positive principal moments"),
    (events.randomise("body_inertia", (0.1, 0.2), "set"), "of body trunk .* expected positive principal moments"),
    (events.randomise("joint_damping", (-1.0, 0.5), "add"), "joint_damping of dof base:0 .* between -1 and 0.5"),
    (events.randomise("actuator_delay", (3, 3), "set"), "changes actuator_delay .* expected events.delays"),
    (events.Values(("actuator_delay",), lambda w: None), "changes actuator_delay .* expected events.delays"),
    (events.randomise("joint_armature", (-0.02, 0.02), "add", names="joint_1"),
     "joint_armature of dof joint_1 .* between -0.01 and 0.03 .*zero or more"),
    (events.Values(("joint_armature",), lambda w: w.values["joint_armature"].__setitem__(7, -1.0)),
     r"draws joint_armature.7. as -1 .* expected zero or more"),
    (events.randomise("actuator_force_range", [(1.0, 2.0), (0.5, 1.5)], "set"), "expected lower ends below upper ends"),
    (events.randomise("joint_X_p", (-0.1, 0.1), "add"), "joint_X_p of joint base .* expected unit quaternions"),
    (events.Values(("body_mass",), lambda w: w.values["body_mass"].__setitem__(1, -1.0)),
     "an event draws body_mass.1. as -1 in world 0"),
    (events.randomise("joint_limit_lower", (-1.0, 3e10), "set", names="joint_1"),
     r"joint_limit_lower of dof joint_1 .* between -1 and 3e.10 .* expected lower limits below upper ones"),
    (events.Values(("joint_limit_lower",), lambda w: w.values["joint_limit_lower"].__setitem__(6, 2e10)),
     "an event draws joint_limit_lower of dof joint_1 as .*, above joint_limit_upper 1e.10, in world 0"),
])  # fmt: skip
def test_impossible_draws_are_refused_with_their_range(event, words):
    with pytest.raises(ValueError, match=words):
        walker_env(2, events=[event])


def test_terms_in_torch_see_the_new_state():
    """A TorchTerm among observations, in the first observation after an end."""
    env = cart_env(4, observations={"a": [TorchTerm(lambda env: env.q, size=2), lambda w: w.q]})
    env.q[1, 0] = 0.7
    observed, *_ = env.step(torch.zeros(4, 1))
    assert observed["a"][:, :2].equal(observed["a"][:, 2:]) and abs(float(observed["a"][1, 0])) < 0.2


def test_the_first_gap_of_two_bodies_is_that_of_the_new_state():
    env = make_pair_env()
    q = env.q.numpy()
    np.testing.assert_allclose(env.get_observations()["a"][:, 0].numpy(), find_gap_of_boxes(q), atol=FLOAT32)
    env.step(torch.zeros(3, 1))
    observed, _ = env.reset(torch.tensor([True, False, True]))
    np.testing.assert_allclose(observed["a"][[0, 2], 0].numpy(), find_gap_of_boxes(env.q.numpy())[[0, 2]], atol=FLOAT32)
    env.q[1, 1] = 5.0
    observed, _, ended, _ = env.step(torch.zeros(3, 1))
    assert (env._tensors["contact_gap"][1] > 1.0).all() and not ended.any()
    assert observed["a"][1, 0] == 1.0 and (observed["a"][[0, 2], 0] < 0.2).all()


@pytest.mark.slow
def test_a_gap_that_is_infinite_ends_no_world(monkeypatch):
    """In joint space, where pairs that are not near have no gap."""
    monkeypatch.setattr(coupled, "is_supported", lambda links: False)
    env = make_pair_env()
    env.q[1, 1] = 5.0
    observed, _, ended, _ = env.step(torch.zeros(3, 1))
    assert torch.isinf(env._tensors["contact_gap"][1]).all() and not ended.any()
    assert observed["a"][1, 0] == 1.0


def make_pair_env():
    """Two boxes of 0.1 m on one rail."""
    ball = lambda name: spo.Body(1.0, inertia=0.01 * np.eye(3), label=name)  # noqa: E731
    rail = lambda body: spo.Hinge("prismatic", -1, body, axis=(1, 0, 0), label=f"rail{body}")  # noqa: E731
    half = (0.1, 0.1, 0.1)
    touch = spo.Contact(0, box=half, other=spo.Contact(1, box=half), stiffness=1e4, damping=10.0)
    scene = spo.Scene([ball("a"), ball("b")], [rail(0), rail(1)], contacts=[touch])
    return cart_env(
        3, scene=scene, actions=actions.Effort("rail0"), default_q=[0.0, 0.3], rewards={}, terminations={},
        observations={"a": [lambda w: w.contact_gap]}, events=[events.joints((-0.05, 0.05))],
    )  # fmt: skip


def find_gap_of_boxes(q):
    return q[:, 1] - q[:, 0] - 0.2


def test_first_accelerations_are_those_of_the_new_state():
    """In free fall an accelerometer off the centre of mass feels the turn alone, omega x (omega x r), whatever came
    before. In a box that comes to the ground it feels most of 9.81 m/s^2. A motor's action 0 is the offset of its own.
    """
    body = spo.Body(2.0, inertia=0.1 * np.eye(3), label="body")
    free = spo.Hinge("free", -1, 0, label="root")
    sites = {"imu": (0, (0.1, 0.0, 0.2, 0.0, 0.0, 0.0, 1.0))}
    common = dict(worlds=2, device="cpu", rewards={}, observations={"a": [lambda w: w.imu("imu").acceleration]})
    rim = spo.Body(0.5, inertia=0.01 * np.eye(3), label="rim")
    spun = spo.Scene([body, rim], [free, spo.Hinge("revolute", -1, 1, axis=(0, 1, 0), label="spin")], sites=sites)
    turns = events.base(angular_velocity=(2.0, 2.0), z=(5.0, 5.0))
    env = envs.Env(spun, actions=actions.Effort("spin"), events=[turns], **common)
    omega = env.qd[0, 3:6].double().numpy()
    felt = np.cross(omega, np.cross(omega, sites["imu"][1][:3]))
    for observed in (env.get_observations(), env.reset(torch.tensor([True, False]))[0], env.reset()[0]):
        np.testing.assert_allclose(observed["a"][0].numpy(), felt, rtol=1e-5)
        env.step(torch.ones(2, 1))
    standing = spo.Scene([body, rim], spun.hinges, sites=sites, contacts=[spo.Contact(0, box=((0.2, 0.2, 0.1)))])
    env = envs.Env(standing, actions=actions.Effort("spin"), default_q=[0, 0, 0.1, 0, 0, 0, 1, 0], **common)
    np.testing.assert_allclose(env.get_observations()["a"][0].numpy(), [0, 0, 9.81], atol=1.5)  # a step of 5 ms
    thrust = spo.Actuator(0, gain=40.0, delay=1, label="thrust")
    lifted = spo.Scene(
        [body], [spo.Hinge("prismatic", -1, 0, axis=(0, 0, 1), label="lift")], sites=sites, actuators=[thrust]
    )
    env = envs.Env(lifted, actions=actions.Control(offset=1.0), **common)  # a delay begins with the first control
    np.testing.assert_allclose(env.get_observations()["a"][0].numpy(), [0, 0, 20.0], rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["go2-flat", "go2-rough", "g1-flat"])
def test_first_gaps_of_the_tasks_are_those_of_a_step_from_there(task):
    """The dynamics report the same gaps, to the bit, of a step that starts from the first state."""
    env = envs.make(task, 8, "cpu", seed=3)
    report = env.dyn.step_report("contact_gap", like=env.q)
    state = env.dyn.actuator_state(like=env.q, longest=3) if env._actuator_state is not None else None
    env.dyn.step(
        env.q, env.qd, None, 1e-5, report=report, ctrl=torch.zeros(8, len(env.scene.actuators)), actuator_state=state
    )
    held = env._tensors["contact_gap"]
    seen = held.abs().max(dim=0).values > 0
    assert seen.sum() >= 4 and torch.allclose(held[:, seen], report.contact_gap[:, seen], atol=FLOAT32)


def test_first_gaps_of_all_shapes_over_a_field_are_those_of_a_step():
    """Two boxes lie 1 cm above a ridge: the second gap was that of a shape that the step does not reach."""
    contacts = [spo.Contact(i, box=(0.1, 0.1, 0.05), label=f"box{i}") for i in range(2)]
    bodies = [spo.Body(1.0, inertia=np.eye(3) * 0.01, label=f"body{i}") for i in range(3)]
    hinges = [spo.Hinge("free", -1, i, label=f"base{i}") for i in range(2)]
    hinges.append(spo.Hinge("revolute", -1, 2, axis=(0, 1, 0), label="spin"))
    roof = np.array([[0.0, 0.2, 0.0]] * 2)
    scene = spo.Scene(bodies, hinges, contacts=contacts, ground=spo.HeightField(roof, (2.0, 1.0), origin=(-1.0, -1.0)))
    start = [-0.5, 0.0, 0.26, 0, 0, 0, 1, 0.5, 0.0, 0.26, 0, 0, 0, 1, 0.0]
    observed = {"a": [lambda w: w.contact_gap]}
    spin = actions.Effort("spin")
    env = envs.Env(
        scene, 2, "cpu", actions=spin, observations=observed, rewards={}, default_q=start, episode_length_s=1
    )
    report = env.dyn.step_report("contact_gap", like=env.q)
    env.dyn.step(env.q, env.qd, None, env._layout.dt, report=report)
    found = env.get_observations()["a"]
    assert (report.contact_gap.amin(dim=1) < 0.011).all()
    np.testing.assert_allclose(found, report.contact_gap, atol=FLOAT32)
