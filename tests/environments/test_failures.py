"""Files of worlds that failed: what leaves one, what it holds, its replay by one world alone, folders that fail."""

import errno
import math
import pickle

import numpy as np
import pytest

torch = pytest.importorskip("torch")

import warp_spo as spo  # noqa: E402
from support.env_scenes import cart_env, walker_env  # noqa: E402
from warp_spo import env as environments  # noqa: E402
from warp_spo import train as command  # noqa: E402
from warp_spo.env import Env, Observation, TorchTerm, actions, commands, events, failures, training_files  # noqa: E402
from warp_spo.env.failure_replay import read  # noqa: E402
from warp_spo.env.learning import Learner, train  # noqa: E402
from warp_spo.execution.status_words import words_of_states  # noqa: E402

WORLDS = 12
PLANTED, THROWN, POLICY = (7, 53), (9, 56), (3, 60)  # world and step


def hopper_scene():
    """Return a carriage that lifts a foot above the ground, and an arm with a delayed motor on it."""
    carriage = spo.Body(1.0, inertia=0.01 * np.eye(3), label="carriage")
    arm = spo.Body(0.2, com=(0, 0, 0.1), inertia=0.01 * np.eye(3), label="arm")
    hinges = [spo.Hinge("prismatic", -1, 0, axis=(0, 0, 1), label="lift"), spo.Hinge("revolute", 0, 1, axis=(0, 1, 0))]
    motor = spo.Actuator(1, gain=5.0, bias=(0, -5.0, -0.1), delay=2)
    foot = spo.Contact(0, sphere=((0, 0, 0), 0.05), label="foot")
    return spo.Scene([carriage, arm], hinges, actuators=[motor], contacts=[foot])


def course(w):
    """Start higher after each episode: a curriculum that resets keep."""
    (stage,) = w.memory("stage", 1, reset=None)
    stage = stage + (0.0 if w.before is None else 1.0)
    w.keep("stage", [stage])
    w.q[0] = 0.1 + 0.01 * stage


def hopper_env(worlds=WORLDS, device="cpu", keep=None, **changes):
    """Return hoppers with everything that a world may remember: delays, histories, pushes, commands, levels, values."""
    numbers = torch.linspace(0.0, 1.0, worlds)  # of one shape alone
    in_torch = lambda env: env.q[:, 0] + 0.1 * numbers.to(env.device) * env.episode_length_buf  # noqa: E731

    def kick(w):
        w.qd[0] = w.qd[0] + w.uniform(0.0, 0.5)

    options = dict(
        actions=actions.Control(scale=0.5), default_q=[0.15, 0.0], episode_length_s=0.5, keep_failures=keep,
        observations={"actor": [
            Observation(lambda w: w.q, noise=0.1, bias=0.1, history=3), Observation(lambda w: w.qd, delay=(0, 2)),
            TorchTerm(in_torch, name="in torch"), lambda w: w.command,
        ]},
        rewards={"foot": (1.0, lambda w: np.sqrt(1.0 + w.contact_force[0, 2])), "up": (1.0, lambda w: w.q[0])},
        terminations={"arm": lambda w: abs(w.q[1]) > 2.5},
        commands=commands.Velocity(seconds=(0.1, 0.3), level=commands.Level("up", share=0.0)),
        events=[
            events.Reset(course, levels=("stage",)), events.Interval(kick, (0.05, 0.2)),
            events.randomise("body_mass", (0.5, 2.0), when="reset"), events.delays((0, 3), when="reset"),
        ],
    )  # fmt: skip
    return Env(hopper_scene(), worlds, device, **(options | changes))


def noise(env, seed=0):
    """Return a function that draws actions."""
    generator = torch.Generator().manual_seed(seed)
    return lambda: torch.randn(env.num_envs, env.num_actions, generator=generator)


@pytest.fixture(scope="module")
def run(tmp_path_factory, device):
    """A run in which three worlds fail; its files by world, and the state of all worlds before each step."""
    folder = tmp_path_factory.mktemp("run") / "new" / "failures"
    env = hopper_env(device=str(device), keep=folder)
    draw, states = noise(env), []
    for i in range(64):
        given = draw()
        if i == PLANTED[1]:
            env.qd[PLANTED[0], 1] = math.nan
        if i == THROWN[1]:
            env.q[THROWN[0], 0], env.qd[THROWN[0], 0] = 0.06, -40.0
        if i == POLICY[1]:
            given[POLICY[0], 0] = math.nan
        states.append((env.q.clone(), env.qd.clone()))
        env.step(given)
    found = {read(file).world: file for file in env.failure_files()}
    assert len(found) == 3 and sorted(found.values()) == sorted(folder.iterdir())
    return env, found, states


@pytest.mark.parametrize("world, step, cause, first, written", [
    (*PLANTED, "not finite/state/coordinates", ("qd['joint_1']", math.nan), ("qd",)),
    (*THROWN, "status CONTACT", None, ("q", "qd")),
    (*POLICY, "not finite/action", ("actions['joint_1']", math.nan), ()),
])  # fmt: skip
def test_a_world_alone_takes_the_same_steps(run, world, step, cause, first, written):
    """The file has the states of the run; each leads to the next one to the bit, but where the test wrote."""
    env, files, states = run
    failure = read(files[world])
    assert (failure.step, failure.first_step, failure.cause) == (step, step - 49, cause)
    for i, (q, qd) in enumerate(states[failure.first_step : step + 1]):
        np.testing.assert_array_equal(failure.q[i], q[world].cpu().numpy())
        np.testing.assert_array_equal(failure.qd[i], qd[world].cpu().numpy())
    found = failure.find_first()
    assert (found is None and first is None) or (found[:2] == (step, first[0]) and math.isnan(found[2]))
    replayed = hopper_env(2, device=env.warp_device).replay_failure(files[world])
    assert replayed.cause == cause and replayed.differences == ([(step, written)] if written else [])
    assert replayed.equal is not bool(written) and (replayed.status == failure.status).all()
    assert replayed.done[-1] == (cause != "status CONTACT") and replayed.done[:-1].any()
    assert np.isfinite(replayed.contact_f[:-1]).all() and replayed.contact_f[:-1, 0, 2].max() > 1.0
    assert len(replayed.q) == 51 and math.isfinite(replayed.q[-1, 1]) == (world != PLANTED[0])


def test_a_state_that_steps_do_not_lead_to_is_told(run, tmp_path):
    """A bit that is changed in any array that decides how the world goes on."""
    env, files, _ = run
    alone = hopper_env(1, device=env.warp_device)
    contents = torch.load(files[POLICY[0]], weights_only=True)
    for name in ("q", "memory", "value_body_mass", "actuator state 0", "tick"):
        changed = {key: x.clone() for key, x in contents["arrays"].items()}
        changed[name][20].view(torch.int32).view(-1)[0] ^= 1
        torch.save(contents | {"arrays": changed}, tmp_path / "changed.pt")
        replayed = alone.replay_failure(tmp_path / "changed.pt")
        first = contents["step"] - 49
        assert not replayed.equal and (first + 20, (name,)) in replayed.differences, name


def test_a_plan_that_many_worlds_have_and_one_has_not(run, tmp_path):
    """The world is stepped among as many as in the run: its last bits may depend on the granularity."""
    env, files, _ = run
    alone = hopper_env(1, device=env.warp_device)
    torch.save(torch.load(files[POLICY[0]], weights_only=True) | {"plan": ["other", 0, False]}, tmp_path / "other.pt")
    for file, worlds in ((files[POLICY[0]], 1), (tmp_path / "other.pt", WORLDS)):
        assert alone.replay_failure(file).equal
        assert [each.num_envs for each in alone._alone.values()] == [worlds]


def test_words_on_a_failure(run):
    env, files, _ = run
    lines = read(files[POLICY[0]]).describe().splitlines()
    assert lines[0] == "world 3 failed in step 60: not finite/action"
    assert lines[1] == "status     OK"
    assert lines[3] == "first      actions['joint_1'] is nan, given to step 60"
    assert lines[-1] == f"file       50 steps of 0.02 s, 11 to 60, of one of 12 worlds on {env.warp_device}, seed 0"
    text = read(files[THROWN[0]]).describe()
    assert "CONTACT: Use a shorter dt" in text and "all numbers are finite up to that step" in text
    (line,) = (line for line in env.explain().splitlines() if line.startswith("failures"))
    assert "the last 50 steps, " in line and " bytes a step and world, " in line and "at most 20 files, 4 of a" in line


def test_the_scene_of_a_failure_has_the_values_of_its_world(run):
    env, files, _ = run
    failure = read(files[POLICY[0]])
    scene = failure.scene()
    mass = failure.arrays["value_body_mass"][-1]
    np.testing.assert_array_equal(scene.values["body_mass"][0], mass.double().numpy())
    assert scene.joint_labels == env.scene.joint_labels and not np.allclose(mass, env.scene.values["body_mass"][0])


def test_keeping_failures_changes_nothing_else(tmp_path):
    """States, results, logs and what is saved are to the bit those of an environment that keeps none."""
    envs = hopper_env(4), hopper_env(4, keep=tmp_path)
    draws = noise(envs[0]), noise(envs[0])
    for _ in range(30):
        (a, *rest), (b, *others) = (env.step(draw()) for env, draw in zip(envs, draws, strict=True))
        assert torch.equal(a["actor"], b["actor"]) and all(map(torch.equal, rest[:2], others[:2]))
    first, second = (env.state_dict() for env in envs)
    assert first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)
    envs[0].load_state_dict(second), envs[1].load_state_dict(first)
    assert envs[0].failure_files() == [] and "fault" not in envs[0]._tensors


def test_files_have_a_limit_and_episodes_before_a_seed_do_not_count(tmp_path):
    """A cause has at most four, one a step and 50 steps of a world; a reset with a seed begins the ring anew."""
    env = cart_env(6, keep_failures=tmp_path)
    bad = torch.full((6, 1), math.nan)
    for _ in range(7):
        env.step(bad)
    files = [read(file) for file in env.failure_files()]
    assert [(each.world, each.step, each.steps) for each in files] == [(0, 0, 1), (1, 1, 2), (2, 2, 3), (3, 3, 4)]
    env.reset(seed=5)
    env.qd[4, 0] = math.inf
    env.step(torch.zeros(6, 1))
    *_, last = env.failure_files()
    found = read(last)
    assert (found.world, found.step, found.seed, found.steps) == (4, 0, 5, 1)
    assert last.name == "world_00004_step_000000.pt"
    replayed = env.replay_failure(last)
    assert replayed.equal and replayed.cause == found.cause == "not finite/state/coordinates"


def test_a_world_may_have_files_of_two_causes(tmp_path):
    """Within fewer steps than the ring has: a contact out of its law does not hide what ends the world."""
    env = hopper_env(3, keep=tmp_path)
    for i in range(6):
        if i in (1, 3):
            env.q[1, 0], env.qd[1, 0] = 0.06, -40.0
        env.step(torch.full((3, 1), math.nan if i == 4 else 0.0))
    causes = [(each.world, each.step, each.cause) for each in map(read, env.failure_files())]
    assert causes[0] == (1, 1, "status CONTACT") and (0, 4, "not finite/action") in causes
    env.reset()
    given = torch.zeros(3, 1)
    given[1] = math.nan
    env.step(given)
    assert [(each.world, each.cause) for each in map(read, env.failure_files())][-1] == (1, "not finite/action")


def test_a_scene_with_values_for_each_world_and_a_run_on_several_devices(tmp_path):
    """World 2 of the second device, with its own mass."""
    scene = cart_env(1).scene.with_values(body_mass=[[1.0, 0.1 + 0.1 * i] for i in range(4)])
    make = lambda **more: cart_env(4, scene=scene, first_world=10, **more)  # noqa: E731
    env = make(keep_failures=tmp_path, rewards={"own": (1.0, lambda w: w.value("body_mass")[1] * w.q[0])})
    draw = noise(env)
    for i in range(30):
        given = draw()
        if i == 29:
            given[2] = math.nan
        env.step(given)
    (file,) = env.failure_files()
    assert (read(file).world, read(file).step) == (12, 29)
    assert read(file).scene().values["body_mass"].tolist() == [[1.0, pytest.approx(0.3)]]
    assert env.replay_failure(file).equal


def test_a_folder_that_cannot_be_written_is_an_error_at_start(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match=r"Env: keep_failures is '.*file/in', where no file can be written \(Not a dir"):
        cart_env(2, keep_failures=tmp_path / "file" / "in")
    with pytest.raises(TypeError, match="Env: keep_failures is 3; expected a folder, such as 'failures', or None"):
        cart_env(2, keep_failures=3)


def test_a_full_disk_is_one_warning(tmp_path, monkeypatch, recwarn):
    env = cart_env(4, keep_failures=tmp_path)

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(training_files, "write", full)
    for _ in range(5):
        env.step(torch.full((4, 1), math.nan))
    assert env.failure_files() == [] and not list(tmp_path.iterdir())
    env.step(torch.zeros(4, 1))
    (told,) = (str(each.message) for each in recwarn if "failure" in str(each.message))
    assert told.startswith(f"Env: a failure could not be written into '{tmp_path}' (No space left on device); all goes")


def test_files_that_are_none_or_do_not_fit(run, tmp_path):
    env, files, _ = run
    (tmp_path / "torn.pt").write_bytes(files[POLICY[0]].read_bytes()[:999])
    torch.save({"q": torch.zeros(1)}, tmp_path / "other.pt")
    torch.save(torch.load(files[POLICY[0]], weights_only=True) | {"format": 9}, tmp_path / "later.pt")
    for name, words in (("torn", "cannot be read"), ("other", "holds something else"), ("later", "is of format 9")):
        with pytest.raises(ValueError, match=rf"failure '.*{name}.pt': {words}"):
            env.replay_failure(tmp_path / f"{name}.pt")
    with pytest.raises(FileNotFoundError):
        env.replay_failure(tmp_path / "none.pt")
    words = (
        r"Env.replay_failure: '.*' holds .*value_body_mass \(2,\).*, this environment has .*; expected the arguments"
    )
    with pytest.raises(ValueError, match=words):
        cart_env(2).replay_failure(files[POLICY[0]])


def test_words_of_files_are_those_of_a_step_that_checks_its_state():
    """Steps of environments leave checks of q to the guard; files say of q what the check of a step says."""
    scene = spo.Scene(
        [spo.Body(1.0, inertia=np.eye(3)), spo.Body(1.0, inertia=np.eye(3))],
        [spo.Hinge("free", -1, 0), spo.Hinge("revolute", 0, 1, axis=(0, 1, 0))],
    )
    q = np.tile(scene.neutral_q.astype(np.float32), (6, 1))
    q[0, 3:7], q[1, 3:7], q[2, 7], q[3, 0], q[4, 3:7] = 0.0, 1e-17, 3e10, math.nan, 1e25
    words = {}
    for checks in (True, False):
        dyn, status = spo.Dynamics(scene, 6, "cpu", "float32"), np.zeros(6, np.int32)
        dyn._checks_results = checks
        dyn.step(q, np.zeros((6, scene.dof_count), np.float32), dt=1e-3, status=status)
        words[checks] = status
    assert [spo.Status(word).name for word in words[True][:4]] == ["QUATERNION", "RANGE", "RANGE", "NOT_FINITE"]
    assert (words[False] != words[True]).any()
    np.testing.assert_array_equal(words_of_states(scene, q, words[False]), words[True])


def test_a_scene_that_cannot_be_pickled_leaves_states(tmp_path, monkeypatch):
    def refuse(*_):
        raise pickle.PicklingError("a lambda")

    env = cart_env(2, keep_failures=tmp_path)
    monkeypatch.setattr(failures.pickle, "dumps", refuse)
    env.step(torch.full((2, 1), math.nan))
    failure = read(env.failure_files()[0])
    with pytest.raises(ValueError, match=r"Failure.scene: the file holds no scene \(a lambda\)"):
        failure.scene()
    assert failure.q.shape == (1, 2) and env.replay_failure(env.failure_files()[0]).equal


def test_a_training_with_a_failure_goes_on(tmp_path):
    """The observation of a world is infinite in its steps 2 and 3 of each episode; rsl_rl sees nothing of it."""
    wrong = lambda w: spo.where(abs(w.time - 0.04) < 0.01, np.log(w.qd[0] * 0.0), 0.0)  # noqa: E731
    env = cart_env(4, keep_failures=tmp_path / "failures", observations={"actor": [lambda w: w.q, wrong]})
    train(env, Learner(iterations=4, steps=8, hidden=(8,), epochs=1, batches=1), tmp_path / "run")
    files = env.failure_files()
    assert files and read(files[0]).cause == "not finite/observation/actor/term 1"
    assert env.replay_failure(files[-1]).equal


def test_the_command_keeps_failures(tmp_path, capsys):
    given = ["cartpole", "--worlds", "4", "--device", "cpu", "--iterations", "1", "--set", "learner.hidden=(8,)",
             "--set", "learner.steps=4", "--logger", "none"]  # fmt: skip
    assert command.main([*given, "--out", str(tmp_path / "run"), "--keep-failures"]) == 0
    said = capsys.readouterr().out
    assert "failures: the last 50 steps, " in said and f"in '{tmp_path}/run/failures'" in said
    assert list((tmp_path / "run" / "failures").iterdir()) == []
    (tmp_path / "file").write_text("")
    with pytest.raises(SystemExit):
        command.main([*given, "--out", str(tmp_path / "other"), "--keep-failures", str(tmp_path / "file")])
    assert "where no file can be written (File exists)" in capsys.readouterr().err


@pytest.mark.slow
def test_a_walker_with_everything_replays(tmp_path, device):
    """Many failures by hard actions, with pushes, headings, feet, other masses and last observations of episodes."""
    drawn = [events.base(yaw=(-3.0, 3.0)), events.joints((-0.1, 0.1)), events.push(0.5, seconds=(0.1, 0.3)),
             events.randomise("body_mass", (0.5, 2.0), when="reset")]  # fmt: skip
    make = lambda worlds, **more: walker_env(  # noqa: E731
        worlds, events=drawn, episode_length_s=0.4, final_observations=True, **more
    )
    env = make(64, keep_failures=tmp_path)
    draw = noise(env)
    for i in range(120):
        env.step(draw() * (1.0 + i / 20.0))
    files = env.failure_files()
    assert len(files) >= 4
    alone = make(1)
    assert all(alone.replay_failure(file).equal for file in files)


@pytest.mark.slow
def test_a_number_planted_in_one_of_4096_go2(tmp_path):
    """World 3,017 at step 137, of a ready task; it is stepped again alone."""
    env = environments.make("go2-flat", 4096, "cpu", keep_failures=tmp_path)
    draw = noise(env)
    for i in range(138):
        given = 0.5 * draw()
        if i == 137:
            given[3017, 5] = math.nan
            before = env.q[3017].clone()
        env.step(given)
    (file,) = (file for file in env.failure_files() if read(file).cause == "not finite/action")
    failure = read(file)
    assert (failure.world, failure.step, failure.steps) == (3017, 137, 50)
    assert (failure.q[-1] == before.numpy()).all()
    replayed = environments.make("go2-flat", 1, "cpu").replay_failure(file)
    assert replayed.equal and replayed.done[-1]
