"""Tasks, their training, films and exports, at small sizes."""

import types

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("rsl_rl")

import warp_spo as spo  # noqa: E402
from warp_spo import env as envs  # noqa: E402
from warp_spo import play, train  # noqa: E402
from warp_spo.env import evaluation, learning, observations, robots, training_log  # noqa: E402
from warp_spo.env.tasks import TASKS, go2_flat, go2_rough, task, velocity  # noqa: E402
from warp_spo.viewing import Camera, Primitive, films  # noqa: E402
from warp_spo.viewing.renderer import Renderer  # noqa: E402
from warp_spo.viewing.surfaces import primitive_surface  # noqa: E402


def roll(env, steps, seed=0):
    torch.manual_seed(seed)
    rows = []
    for _ in range(steps):
        observed, reward, done, _ = env.step(0.5 * torch.randn(env.num_envs, env.num_actions))
        rows.append((observed["actor"].clone(), reward.clone(), done.clone(), env.q.clone()))
    return [torch.stack([row[i] for row in rows]) for i in range(4)]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder with a cart-pole training of three iterations, by the command line."""
    folder = tmp_path_factory.mktemp("runs")
    given = ["cartpole", "--worlds", "16", "--device", "cpu", "--iterations", "3", "--out", str(folder), "--seed", "3"]
    assert train.main(given) == 0
    return folder


def test_cartpole_steps():
    """Rewards are those of the formula, worlds differ, and the rail's end ends an episode."""
    env = envs.make("cartpole", 8, "cpu", seed=1)
    observed, reward, done, q = roll(env, 60)
    assert observed.isfinite().all() and (q[-1].std(dim=0) > 1e-3).all()
    fine = done[-1] == 0
    x, theta = q[-1][fine].T
    v, w = env.qd[fine].T
    up = 0.5 * (1 + theta.cos()) * (0.3 + 0.7 * (-((x / 0.8) ** 2)).exp())
    still = (-0.5 * ((1 - theta.cos()) / 0.05 + w**2 / 4 + v**2 / 4)).exp()
    wanted = env.step_dt * (up + 2.0 * still - 0.02 * env.actions[fine, 0] ** 2)
    assert torch.allclose(reward[-1][fine], wanted, atol=1e-6)
    env.q[0, 0], env.qd[0, 0] = 1.78, 0.0  # just before the stop, which would throw it back
    assert env.step(torch.zeros(8, 1))[2][0] == 1


def test_a_seed_repeats_a_course():
    first, again, other = (roll(envs.make("cartpole", 4, "cpu", seed=seed), 20)[3] for seed in (5, 5, 6))
    assert torch.equal(first, again) and not torch.equal(first, other)


def test_the_critic_of_velocity_tasks_sees_the_truth():
    """The observations that actors see with noise, bias and delay have none of these for critics; scales are equal."""
    late = observations.Observation(observations.command, noise=0.1, bias=0.2, delay=(0, 2), scale=3.0, history=2)
    groups = velocity.observed(go2_flat.FEET, go2_rough.SCAN, late)
    of_critic = [each for each in groups["critic"] if isinstance(each, observations.Observation)]
    assert len(of_critic) == len(groups["actor"])
    for seen, true in zip(groups["actor"], of_critic, strict=True):
        assert (true.noise, true.bias, true.delay) == (0.0, 0.0, 0)
        assert (true.scale, true.clip, true.history) == (seen.scale, seen.clip, seen.history)
        assert true.term is seen.term or seen.term is velocity.ACTOR[3][1]  # encoders of critics have no bias
    assert go2_rough.SCAN.noise > 0.0 and groups["actor"][-2] is go2_rough.SCAN


def test_an_unknown_task_is_refused():
    with pytest.raises(ValueError, match=r"make: task 'walk' is unknown; expected one of cartpole, ant, panda-reach"):
        envs.make("walk")


def test_a_training_leaves_checkpoints_and_a_course(trained):
    rows = training_log.read_rows(trained / "progress.jsonl")
    assert [row["iteration"] for row in rows] == [0, 1, 2] and all(
        np.isfinite(list(row.values())).all() for row in rows
    )
    assert torch.load(trained / "model_2.pt", weights_only=True)["iter"] == 2
    assert (trained / "curve.png").stat().st_size > 1000


def test_a_course_prints_no_numbers_of_episodes_that_have_not_ended(tmp_path, capsys):
    """Neither rewards before the first end, nor lengths before the first that counts."""
    names = ("/reward/up", "/episode/seconds", "/episode/finished", "/episode/whole")
    for row, words in (
        ((0, 0, 0, 0), "reward        -  episode     - s"),
        ((2, 0, 3, 0), "reward    2.000  episode     - s"),
        ((2, 7, 3, 1), "reward    2.000  episode   7.0 s"),
    ):
        env = types.SimpleNamespace(
            device="cpu", log=lambda row=row: {n: torch.tensor(float(x)) for n, x in zip(names, row, strict=True)}
        )
        one = training_log.TrainingLog(env, tmp_path, 1, 0.0, True)
        one.init_logging_writer()
        one.log(0, 1, 0.1, 0.1, {}, action_std=torch.ones(1), learning_rate=1e-3)
        assert words in capsys.readouterr().out


def test_a_training_resumes(trained, tmp_path):
    """Where it stopped: the optimizer's steps go on; asking for no more iterations is an error."""
    env = envs.make("cartpole", 16, "cpu")
    learner = task("cartpole").LEARNER
    runner = learning.train(env, learner, tmp_path, 4, resume=trained / "model_2.pt")
    assert runner.current_learning_iteration == 3
    steps = {int(state["step"]) for state in runner.alg.optimizer.state_dict()["state"].values()}
    assert steps == {4 * learner.epochs * learner.batches}
    runner = learning.train(env, learner, tmp_path, 9, resume=trained / "model_2.pt", seconds=1e-9)
    assert runner.current_learning_iteration == 3 and (tmp_path / "model_3.pt").exists()  # time is over after one
    with pytest.raises(ValueError, match="has 3 iterations, and 3 are asked for in all; expected more"):
        learning.train(env, learner, tmp_path, 3, resume=trained / "model_2.pt")


def test_a_resumed_training_drops_the_rows_after_its_checkpoint(trained, tmp_path):
    """A log has each iteration once, and seconds that grow."""
    env, learner = envs.make("cartpole", 16, "cpu"), task("cartpole").LEARNER
    learning.train(env, learner, tmp_path, 3, seed=1)
    (tmp_path / "model_1.pt").write_bytes((trained / "model_2.pt").read_bytes())
    found = torch.load(tmp_path / "model_1.pt", weights_only=True) | {"iter": 1}
    torch.save(found, tmp_path / "model_1.pt")
    learning.train(env, learner, tmp_path, 5, resume=tmp_path / "model_1.pt")
    rows = training_log.read_rows(tmp_path / "progress.jsonl")
    assert [row["iteration"] for row in rows] == [0, 1, 2, 3, 4]
    assert (np.diff([row["seconds"] for row in rows]) > 0.0).all()
    with pytest.raises(ValueError, match=r"holds a training; expected a new folder \(out\), or a checkpoint"):
        learning.train(env, learner, tmp_path, 9)


@pytest.mark.parametrize(
    ("program", "given", "words"),
    [
        ("train", ["--worlds", "0"], "--worlds: '0' given; expected an integer, 1 or more"),
        ("train", ["--iterations", "-2"], "--iterations: '-2' given"),
        ("train", ["--save-interval", "0"], "--save-interval: '0' given"),
        ("train", ["--seconds", "-1"], "expected seconds, more than zero"),
        ("train", ["--device", "tpu"], "device is 'tpu'; expected one of this machine's devices"),
        ("train", ["--resume", "nowhere.pt"], "No such file or directory: 'nowhere.pt'"),
        ("train", ["--resume", "BAD"], "cannot be read"),
        ("train", ["--resume", "OTHER"], "has no actor_state_dict, critic_state_dict, iter, optimizer_state_dict"),
        ("train", ["--out", "TRAINED"], "holds a training"),
        ("train", ["--out", "TRAINED", "--gpus", "2", "--device", "cpu"], "holds a training"),
        ("train", ["--resume", "GOOD", "--iterations", "2"], "has 3 iterations, and 2 are asked for in all"),
        ("play", ["nowhere.pt"], "No such file or directory: 'nowhere.pt'"),
        ("play", ["GOOD", "--seconds", "0"], "expected seconds, more than zero"),
        ("play", ["GOOD", "--command", "1", "2"], "--command has 2 number(s); cartpole expects 0"),
        ("play", ["GOOD", "--trial", "stairs"], "--trial is 'stairs'; expected one of those of cartpole: none"),
        ("play", ["GOOD", "--mujoco"], "--mujoco with cartpole; expected a task that tracks velocities"),
    ],
)
def test_what_a_command_line_asks_wrongly_is_one_line(program, given, words, trained, tmp_path, capsys):
    places = {"BAD": tmp_path / "bad.pt", "OTHER": tmp_path / "other.pt", "TRAINED": trained}
    places["GOOD"] = trained / "model_2.pt"
    places["BAD"].write_text("hello")
    torch.save({"weights": torch.zeros(3)}, places["OTHER"])
    given = [str(places.get(text, text)) for text in given]
    given += ["--worlds", "16"] if "--worlds" not in given else []
    given += ["--out", str(tmp_path / "new" / "run")] if "--out" not in given else []
    with pytest.raises(SystemExit) as stopped:
        {"train": train, "play": play}[program].main(["cartpole", *given])
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and words in said and said.count("\n") == 1


def test_a_checkpoint_of_another_task_is_refused(trained):
    env = envs.make("ant", 2, "cpu")
    runner = learning.make_runner(env, task("ant").LEARNER)
    with pytest.raises(ValueError, match=r"does not fit the task's networks .*expected one of the same task"):
        learning.load_checkpoint(runner, trained / "model_2.pt")


@pytest.mark.parametrize("part", [{"iter": "2"}, {"infos": {"levels": 3}}])
def test_a_checkpoint_with_other_things_in_it_is_refused(trained, tmp_path, part):
    env = envs.make("cartpole", 4, "cpu")
    runner = learning.make_runner(env, task("cartpole").LEARNER)
    torch.save(torch.load(trained / "model_2.pt", weights_only=True) | part, tmp_path / "model_9.pt")
    with pytest.raises(ValueError, match=r"model_9.pt': iter is '?2'?, its levels are (dict|int); expected an integer"):
        learning.load_checkpoint(runner, tmp_path / "model_9.pt")


def test_play_draws_a_film(trained, tmp_path):
    from PIL import Image

    given = ["cartpole", str(trained / "model_2.pt"), "--seconds", "0.3"]
    given += ["--out", str(tmp_path / "film")]
    assert play.main(given) == 0
    with Image.open(tmp_path / "film.gif") as film_, Image.open(tmp_path / "film.png") as strip:
        assert film_.n_frames > 3 and strip.size == (5 * 480, 2 * 300)
        shown = np.asarray(strip).astype(int)
    orange = (shown[..., 0] > shown[..., 2] + 60).mean()
    assert 0.001 < orange < 0.1  # the pole


def test_play_draws_no_film_beside_an_export(trained, tmp_path):
    """Nor overwrites one that is there, unless it is asked for."""
    pytest.importorskip("onnx")
    given = ["cartpole", str(trained / "model_2.pt"), "--seconds", "0.1"]
    given += ["--out", str(tmp_path / "film"), "--export", str(tmp_path / "policy")]
    assert play.main(given) == 0
    assert sorted(file.name for file in tmp_path.iterdir()) == ["policy.onnx", "policy.pt"]
    assert play.main([*given, "--film", "webp"]) == 0 and (tmp_path / "film.webp").exists()


def test_a_sphere_is_drawn_where_it_is():
    """Its picture is a disc about the projected centre, of the radius that the opening angle gives."""
    camera = Camera(distance=4.0, width=200, height=200, view=0.5)
    ball = Primitive("sphere", -1, (0.3,), (0.4, 0.1, 1.0, 0, 0, 0, 1), (1.0, 0.0, 0.0))
    target = np.array([0.4, 0.1, 1.0])
    picture = Renderer([ball], 0, None, camera).draw(np.zeros((0, 7)), target).astype(int)
    red = np.argwhere(picture[..., 0] > picture[..., 1] + 60)
    radius = 100 * np.tan(np.arcsin(0.3 / 4.0)) / np.tan(0.25)
    assert np.allclose(red.mean(axis=0), 99.5, atol=0.5)
    assert len(red) == pytest.approx(np.pi * radius**2, rel=0.03)


@pytest.mark.parametrize(("kind", "size", "area"), [
    ("cylinder", (0.3, 0.2), 2 * 0.3 * 2 * 0.2),
    ("cone", (0.3, 0.2), 0.3 * 2 * 0.2),
    ("ellipsoid", (0.3, 0.2, 0.1), np.pi * 0.3 * 0.1),
])  # fmt: skip
@pytest.mark.parametrize("triangles", [False, True])
def test_a_round_shape_is_drawn_with_its_outline(kind, size, area, triangles):
    """From far away a picture of its side has the area of its outline: contacts' shapes, and those of a file."""
    camera = Camera(distance=20.0, azimuth=-0.5 * np.pi, elevation=0.0, width=240, height=160, view=0.05)
    shape = Primitive(kind, -1, size, (0, 0, 1, 0, 0, 0, 1), (1.0, 0.0, 0.0))
    renderer = Renderer([primitive_surface(shape) if triangles else shape], 0, None, camera)
    picture = renderer.draw(np.zeros((0, 7)), np.array([0.0, 0.0, 1.0])).astype(int)
    red = (picture[..., 0] > picture[..., 1] + 60).sum()
    pixel = 2 * 20.0 * np.tan(0.025) / 160
    assert red * pixel**2 == pytest.approx(area, rel=0.05)  # 20 edges about the axis, and whole pixels


def test_the_ground_is_drawn_where_it_is():
    """The depth of the middle of a picture is the camera's distance, if it looks at a point of the ground."""
    ramp = spo.HeightField(0.3 * np.arange(5.0)[:, None] + 0.1 * np.arange(3.0), (0.5, 0.25), (-1.0, -0.2, 0.4))
    tilted = np.array([0.3, -0.2, 0.8]) / np.linalg.norm([0.3, -0.2, 0.8])
    grounds = [
        (None, (0.3, 0.2, 0.0)),
        (spo.Plane(0.7), (3.0, -2.0, 0.7)),
        (spo.Plane(0.7, tilted), tuple(0.7 * tilted)),
        (ramp, (0.25, 0.1, 0.4 + 0.6 * 1.25 + 0.4 * 0.3)),
        (ramp, (0.25, 30.0, 0.4 + 0.6 * 1.25 + 0.2)),  # beyond an edge
    ]
    for ground, point in grounds:
        for azimuth in (0.7, 4.0):
            camera = Camera(distance=3.0, azimuth=azimuth, elevation=0.8, width=201, height=151)
            renderer = Renderer([], 0, ground, camera)
            renderer.draw(np.zeros((0, 7)), np.array(point))
            assert renderer.depth.numpy()[0, 75, 100] == pytest.approx(3.0, abs=0.03)  # nearest of a pixel


def test_a_large_field_is_coarse_far_away_alone():
    """Near what is looked at all lines are drawn, and a picture of it is the same; beyond, one of eight."""
    heights = np.random.default_rng(0).uniform(0.0, 0.1, (400, 200))
    field, camera = spo.HeightField(heights, 0.05), Camera(distance=1.0, elevation=1.2, width=80, height=50)
    looked = np.array([[5.0, 5.0, 0.0], [6.0, 5.0, 0.0]])
    coarse, whole = (Renderer([], 0, field, camera, around=around) for around in (looked, None))
    x, y, z = coarse.model.shape_source[0].vertices.T
    assert len(x) < 0.4 * heights.size
    inside = (x > 2.1) & (x < 8.9) & (y > 2.1) & (y < 7.9)
    assert inside.sum() == len(np.arange(43, 178)) * len(np.arange(43, 158))
    at = np.rint(np.stack([x, y]) / 0.05).astype(int)
    held = (at >= 0).all(axis=0) & (at[0] < 400) & (at[1] < 200)
    assert np.allclose(z[held], heights[at[0][held], at[1][held]], atol=1e-6)
    seen = [each.draw(np.zeros((0, 7)), looked[0]) for each in (coarse, whole)]
    assert np.array_equal(*seen) and seen[0].std() > 1.0


def test_a_film_says_how_far_it_is(capsys):
    """Its seconds are those measured from the second picture on; a short film says nothing."""
    times = iter(np.concatenate([[50.0], 50.0 + 0.5 * np.arange(1, 100)]))
    progress = films.FilmProgress(60, lambda: next(times))
    for done in range(1, 61):
        progress.show(done)
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "picture 2 of 60: 0.50 s each, 29 s left", "picture 23 of 60: 0.50 s each, 18 s left",
        "picture 44 of 60: 0.50 s each, 8 s left",
    ]  # fmt: skip
    short = films.FilmProgress(9, iter(np.arange(0.0, 5.0, 0.5)).__next__)
    for done in range(1, 10):
        short.show(done)
    assert not capsys.readouterr().err


def test_a_marker_is_in_its_own_picture_alone():
    robot, camera = robots.load("cartpole"), Camera(distance=4.0, width=120, height=75)
    balls = [Primitive("sphere", -1, (0.1,), (x, -0.5, 1.0, 0, 0, 0, 1), (0.0, 0.0, 1.0)) for x in (-0.3, 0.3)]
    q = np.repeat(robot.q[None], 3, axis=0)
    shown = films.pictures(robot.scene, (), q, camera, False, [balls[:1], balls[1:], []])
    blue = [np.asarray(each).astype(int)[..., 2] > np.asarray(each).astype(int)[..., 0] + 60 for each in shown]
    assert blue[0].sum() > 20 and blue[1].sum() > 20 and not (blue[0] & blue[1]).any() and not blue[2].any()


def test_a_film_is_written_as_its_name_says(tmp_path):
    from PIL import Image

    frames = [Image.new("RGB", (32, 20), (80 * i, 0, 0)) for i in range(3)]
    for suffix in ("gif", "webp"):
        with Image.open(films.save(frames, tmp_path / f"film.{suffix}", 0.04)) as found:
            assert found.n_frames == 3 and found.size == (32, 20)
    with pytest.raises(ValueError, match=r"films.save: 'film.avi'; expected a name that ends in .gif, .webp or .mp4"):
        films.save(frames, tmp_path / "film.avi", 0.04)
    pytest.importorskip("imageio_ffmpeg")
    assert b"ftyp" in films.save(frames, tmp_path / "film.mp4", 0.04).read_bytes()[:16]


def test_measures_of_a_known_course():
    """A pole that is held upright by hand counts; worlds that end early do not."""
    env = envs.make("cartpole", 4, "cpu")

    def policy(observed):
        env.q[:, 1] = torch.tensor([0.0, 0.05, 0.3, 0.0])
        env.q[:3, 0], env.q[3, 0], env.qd[:] = 0.0, 2.0, 0.0
        return torch.zeros(4, 1)

    found = evaluation.balance(env, policy)
    assert found["worlds"] == 4 and found["upright"] == 2 and found["least share"] == 0.0


def test_a_new_start_is_no_place_that_was_reached():
    """A world that ends early names another place as it starts anew; no command of its first episode changed before."""
    env = envs.make("panda-reach", 2, "cpu")

    def policy(observed):
        env.qd[0] = 1e9 if int(env.episode_length_buf[0]) == 5 else 0.0  # beyond its bounds: the world ends
        return torch.zeros(2, env.num_actions)

    found = evaluation.reach(env, policy, "hand")
    assert found["places"] == 3  # of the other world, whose episode has four


@pytest.mark.slow
@pytest.mark.parametrize("name", TASKS)
def test_every_task_steps(name):
    env = envs.make(name, 4, "cpu")
    observed, reward, _, _ = roll(env, 10)
    assert observed.isfinite().all() and reward.isfinite().all()
    assert (observed[-1].std(dim=0) > 0).float().mean() > 0.5  # worlds differ


@pytest.mark.slow
def test_g1_is_rewarded_for_steps_in_time():
    """The clock's stance is 0.6 of a stride, half a stride apart, and both feet's while the command stands."""
    from warp_spo.env.tasks import g1_flat

    env = envs.make("g1-flat", 3, "cpu", seed=2)
    env.reset()
    env.episode_length_buf = torch.zeros_like(env.episode_length_buf)
    sums, seen = [torch.zeros(3)], []
    for step in range(1, 45):
        env.command[:] = torch.tensor([[0.5, 0, 0], [0.0, 0, 0.3], [0, 0, 0]])
        observed, _, done, _ = env.step(0.3 * torch.randn(3, env.num_actions))
        assert not done.any()
        turn = env.step_dt * step / g1_flat.STRIDE
        wanted = [[np.sin(2 * np.pi * turn), np.cos(2 * np.pi * turn)]] * 2 + [[0.0, 0.0]]
        assert np.allclose(observed["actor"][:, -2:], wanted, atol=1e-4)
        touches = env.memory(f"feet {g1_flat.FEET!r} 1.0")[:, 2:4] > 0.0  # times of contact
        stance = torch.tensor([abs((turn - foot / 2 + 0.5) % 1 - 0.5) < 0.3 for foot in (0, 1)])
        right = torch.stack([touches[0] == stance, touches[1] == stance, touches[2]]).float().mean(dim=1)
        sums.append(env.memory("sum reward in step")[:, 0].clone())
        if step not in (8, 12, 28, 32):  # where a stance begins or ends, rounding decides
            assert torch.allclose(sums[-1] - sums[-2], 2.0 * env.step_dt * right, atol=1e-5), (step, right)
        seen.append(right)
    assert len(torch.stack(seen).unique()) == 3  # none, one and both feet in step


@pytest.mark.slow
def test_ants_are_paid_for_a_trot_of_all_legs():
    """A quarter for each rule of a trot, and for each foot that both touched and was lifted a short time ago."""
    from warp_spo.env.tasks import ant

    env = envs.make("ant", 32, "cpu", seed=4)
    env.reset()
    env.episode_length_buf = torch.zeros_like(env.episode_length_buf)
    names, feet = ("sum reward trot", "sum reward stepping"), [f"foot_{i}" for i in (1, 2, 3, 4)]
    before, times, seen = torch.zeros(2, 32), torch.zeros(32, 8), []
    for step in range(40):
        _, _, done, _ = env.step(2.0 * torch.randn(32, 8) * (torch.arange(32) % 2)[:, None])  # every other one stands
        going = done == 0
        touches = env.memory(f"feet {ant.FEET!r} 1.0")[:, 4:8] > 0.0  # times of contact
        gap = env.dyn.frame_poses(env.q, feet)[:, :, 2] - 0.08
        fl, hl, hr, fr = touches.T
        rules = (fl == hr).float() + (hl == fr).float() + (fl != fr).float() + (hl != hr).float()
        since = env.memory(f"stepping {ant.FEET!r} 0.05").clone()  # steps
        clear = torch.cat([torch.ones_like(touches), (gap - 0.05).abs() > 0.04], dim=1) & going[:, None]
        wanted = torch.where(torch.cat([touches, gap > 0.05], dim=1), torch.zeros(()), times + 1.0)
        assert torch.allclose(since[clear], wanted[clear], atol=1e-4), step
        steps = ((since[:, :4] < 20.0) & (since[:, 4:] < 20.0)).float().sum(dim=1)  # 0.4 s of 20 ms
        now = torch.stack([env.memory(name)[:, 0].clone() for name in names])
        wanted = 0.25 * env.step_dt * torch.stack([ant.TROT * rules, ant.STEPPING * steps])
        assert torch.allclose((now - before)[:, going], wanted[:, going], atol=1e-5), step
        seen.append(torch.stack([rules, steps])[:, going])
        before, times = now, since
    for row in torch.cat(seen, dim=1):
        assert set(row.tolist()) >= {0.0, 2.0, 4.0}
