"""Tasks of users by file, module and registered name; settings of a training; what is wrong with either."""

import dataclasses
import functools
import importlib
import json

import pytest

torch = pytest.importorskip("torch")
learning = pytest.importorskip("warp_spo.env.learning")

from warp_spo import env as envs  # noqa: E402
from warp_spo import play, tasks, train  # noqa: E402
from warp_spo.env import settings, task_files, training_files  # noqa: E402
from warp_spo.env.tasks import TASKS, task  # noqa: E402

OWN = '''"""A pole of one's own."""

from warp_spo.env.learning import Learner
from warp_spo.env.settings import make_env
from warp_spo.env.tasks import cartpole

LEARNER = Learner(iterations=2, worlds=4, steps=4, hidden=(8,), epochs=1, batches=1)


def build(worlds, device=None, seed=0, weight: float = 1.0, **options):
    env = cartpole.build(worlds, device, seed, **options)
    env.weight = weight
    return env
'''


@pytest.fixture
def own_file(tmp_path):
    file = tmp_path / "own_pole.py"
    file.write_text(OWN)
    return file


def run_all(name, folder, tmp_path, capsys, film=True):
    """Train, play, measure, draw a film, export and resume by the name of a task."""
    more = ["--device", "cpu", "--out", str(folder)]
    assert train.main([name, *more, "--iterations", "1"]) == 0
    assert train.main([name, *more, "--iterations", "3", "--resume", "latest"]) == 0
    assert training_files.read(folder / "last.pt")["iter"] == 2
    capsys.readouterr()
    given = [name, str(folder / "last.pt"), "--export", str(tmp_path / "policy"), "--set", "episode_length_s=0.4"]
    given += ["--out", str(tmp_path / "film"), "--seconds", "0.3", "--film", "gif"] if film else []
    assert play.main([*given, "--measure", "--worlds", "2"]) == 0
    said = capsys.readouterr().out
    found = json.loads(said[said.index("{") : said.index("}") + 1])
    assert found["worlds"] == 2 and found["episode/seconds"] == pytest.approx(0.4) and "reward/upright" in found
    wanted = {"policy.onnx", "policy.pt"} | ({"film.gif", "film.png"} if film else set())
    assert wanted <= {file.name for file in tmp_path.iterdir()}


def test_a_file_is_a_task(own_file, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_all(str(own_file), tmp_path / "runs" / "own_pole", tmp_path, capsys, film=False)
    assert envs.make(str(own_file), device="cpu").num_envs == 4
    assert train.main([str(own_file), "--device", "cpu", "--out", str(tmp_path / "x"), "--set", "weight=3"]) == 0


@pytest.mark.slow
def test_modules_and_registered_names_are_tasks(tmp_path, capsys, monkeypatch):
    """An installed package has its modules and a folder of metadata, which is what importlib.metadata reads."""
    package, about = tmp_path / "poles_of_mine", tmp_path / "poles_of_mine-1.0.dist-info"
    package.mkdir(), about.mkdir()
    (package / "__init__.py").write_text("")
    for name in ("one", "two"):
        (package / f"{name}.py").write_text(OWN)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: poles-of-mine\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(
        "[warp_spo.tasks]\npole-one = poles_of_mine.one\npole-two = poles_of_mine.two\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    assert tasks.main([]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(TASKS) + 2 and lines[-1] == "pole-two     A pole of one's own."
    run_all("pole-one", tmp_path / "a", tmp_path, capsys)
    run_all("poles_of_mine.two", tmp_path / "b", tmp_path, capsys)
    assert task_files.short_name("pole-one") == "pole-one" and task_files.short_name("poles_of_mine.two") == "two"


@pytest.mark.parametrize("name", TASKS)
def test_a_new_file_begins_as_a_ready_task(name, tmp_path, capsys):
    """Its code is that of the ready task, its comments say what may change; it is not written over another file."""
    file = tmp_path / "mine.py"
    assert tasks.main(["--new", str(file), "--like", name]) == 0
    chosen = task(str(file))
    assert chosen.LEARNER == task(name).LEARNER and "# Makes the environment." in file.read_text()
    assert "from ." not in file.read_text()
    with pytest.raises(SystemExit):
        tasks.main(["--new", str(file)])
    assert "there is such a file" in capsys.readouterr().err


def test_a_file_to_start_from_makes_the_environment(tmp_path):
    file = tmp_path / "mine.py"
    assert tasks.main(["--new", str(file), "--like", "cartpole"]) == 0
    one, other = task(str(file)).build(4, "cpu", seed=3), envs.make("cartpole", 4, "cpu", seed=3)
    assert torch.equal(one.q, other.q) and torch.equal(one.step(torch.ones(4, 1))[1], other.step(torch.ones(4, 1))[1])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x = 1\n", "mine.py: has no build; expected build(worlds, device, seed, **options) -> Env"),
        ("def build(worlds, device=None, seed=0, **o): ...\n", "has no LEARNER; expected LEARNER = learning.Learner("),
        ("LEARNER = 3\ndef build(): ...\n", "mine.py, line 1: LEARNER is int; expected learning.Learner(...)"),
        (OWN.replace("(worlds, device=None, seed=0, weight: float = 1.0, **options)", "(worlds)"),
         "mine.py, line 10: build takes (worlds) (too many positional arguments); expected build(worlds, device=None"),
        (OWN.replace("return env", "return 3"), "mine.py, line 10: build returns int; expected an Env"),
        (OWN.replace("env = cartpole", "env = cartpool"), "mine.py, line 11: NameError: name 'cartpool' is not def"),
        (OWN.replace("seed, **options)", "seed, dt=-1.0)"), "mine.py, line 11: Env: dt is -1"),
        (OWN.replace("import make_env", "import make_envy"), "ImportError: cannot import name 'make_envy'"),
        (OWN.replace("LEARNER =", "LEARNER ="[:-1]), "mine.py, line 7: invalid syntax"),
    ],
)  # fmt: skip
def test_what_a_file_lacks_is_said_with_its_line(text, words, tmp_path, capsys):
    (tmp_path / "mine.py").write_text(text)
    with pytest.raises(SystemExit) as stopped:
        train.main([str(tmp_path / "mine.py"), "--device", "cpu", "--out", str(tmp_path / "run")])
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and words in said.replace(str(tmp_path) + "/", "") and said.count("\n") == 1, said


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("carpole", "task 'carpole' is unknown; expected one of cartpole, .*did you mean cartpole.*FILE.py or package"),
        ("nowhere.py", "task 'nowhere.py': there is no such file"),
        ("no.such.module", "module 'no.such.module': ModuleNotFoundError"),
        ("json", "json.*has no build"),
    ],
)
def test_a_task_that_is_not_there_is_named(name, words):
    with pytest.raises(ValueError, match=words):
        task(name)


READ = {"false": False, "7": 7, "0.5": 0.5, "bfloat16": "bfloat16"}


def test_settings_reach_every_field_of_the_learner():
    """Each takes a value of its own kind, in the words of a command line."""
    learner = learning.Learner()
    for field in dataclasses.fields(learner):
        held = getattr(learner, field.name)
        text = {bool: "false", int: "7", float: "0.5", tuple: "[32, 16]", str: "bfloat16"}[type(held)]
        own, _ = settings.split(settings.parse([f"learner.{field.name}={text}"]))
        found = getattr(settings.apply(learner, own, "learner"), field.name)
        assert type(found) is type(held) and found == READ.get(text, (32, 16))


def arguments_of(held, path=""):
    """Return the numbers, texts and ranges that a task passes to Env, by the name that sets them."""
    if isinstance(held, tuple) and len(held) == 2 and callable(held[1]):
        held = held[0]
    if isinstance(held, bool | int | float | str) or (
        isinstance(held, tuple) and held and all(isinstance(x, float | int) for x in held)
    ):
        return {path: held}
    parts = settings._parts(held)
    found = [arguments_of(part, f"{path}.{name}" if path else name) for name, part in parts.items()]
    return {name: value for each in found for name, value in each.items()}


@pytest.mark.parametrize("name", TASKS)
def test_settings_reach_every_argument_of_a_ready_task(name, monkeypatch):
    """All numbers and ranges that its build() passes to Env, each with another value, arrive as they were set."""

    class Caught(Exception):
        pass

    @functools.wraps(settings.Env.__init__)
    def catch(self, scene, worlds, device, **given):
        raise Caught(given)

    monkeypatch.setattr(settings.Env, "__init__", catch)

    def passed(**options):
        with pytest.raises(Caught) as stopped:
            task(name).build(2, "cpu", **options)
        return arguments_of(stopped.value.args[0])

    before = passed()
    assert len(before) > 8 and "episode_length_s" in before and any(x.startswith("rewards.") for x in before)
    del before["seed"]  # an option of the commands
    changes = {}
    for place, held in before.items():
        if isinstance(held, bool):
            changes[place] = not held
        elif isinstance(held, tuple):
            changes[place] = tuple(x + 1 for x in held)
        elif not isinstance(held, str):  # names, which are checked against the scene
            changes[place] = held + 1
    after = passed(**settings.parse([f"{place}={value}" for place, value in changes.items()]))
    assert {place: after[place] for place in changes} == changes


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("learner.entrop=0.01", "unknown name 'learner.entrop' (did you mean entropy?); expected one of iterations, "),
        ("learner.entropy=high", "learner.entropy is 'high'; expected a number, as 0.01 is"),
        ("learner.epochs=1.5", "learner.epochs is 1.5; expected an integer, as 5 is"),
        ("learner.normalize=1", "learner.normalize is 1; expected true or false, as True is"),
        ("learner.hidden=64", "learner.hidden is 64; expected a list, such as [64, 64]"),
        ("learner=3", "learner is 3; expected names, such as learner.entropy=0.01"),
        ("rewards.ballance=3", "unknown name 'rewards.ballance' (did you mean balance?); expected one of upright"),
        ("episode_length=3", "unknown name 'episode_length' (did you mean episode_length_s?)"),
        ("episode_length_s=long", "episode_length_s is 'long'; expected a number, as 10.0 is"),
        ("rewards=3", "rewards is 3; it is made by the task's file and has to be changed there; its parts"),
        ("rewards.balance.x=3", "rewards.balance is"),
        ("dt", "--set dt: expected NAME=VALUE, such as learner.entropy=0.01"),
        ("seed=3", "seed is 3; expected it as an option"),
        ("keep_failures=3", "Env: keep_failures is 3; expected a folder"),
        ("metrics=x", "Env: metrics is 'x'; expected terms by name"),
        ("bounds=3", "Env: bounds is 3; expected warp_spo.env.Bounds"),
    ],
)
def test_a_setting_that_is_wrong_is_one_line(given, words, tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        train.main(["cartpole", "--device", "cpu", "--worlds", "4", "--out", str(tmp_path / "run"), "--set", given])
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and words in said and said.count("\n") == 1, said


def test_a_training_leaves_what_it_ran_with(tmp_path, capsys):
    """Files and --set change it; resume and play take it from beside the checkpoints."""
    file, folder = tmp_path / "mine.toml", tmp_path / "run"
    file.write_text("episode_length_s = 4\n[learner]\nhidden = [8]\nsteps = 4\nentropy = 0.5\n[rewards]\nbalance = 3\n")
    given = ["cartpole", "--device", "cpu", "--worlds", "4", "--iterations", "2", "--seed", "5", "--out", str(folder)]
    assert train.main([*given, "--settings", str(file), "--set", "learner.entropy=0.25"]) == 0
    found = settings.read(folder / "settings.toml")
    assert found["learner"] == dataclasses.asdict(task("cartpole").LEARNER) | {
        "hidden": [8], "steps": 4, "entropy": 0.25
    }  # fmt: skip
    assert found["episode_length_s"] == 4 and found["rewards"] == {"balance": 3}
    assert found["run"]["worlds"] == 4 and found["run"]["seed"] == 5 and found["versions"]["torch"] == torch.__version__
    assert found["run"]["command"].startswith("python -m warp_spo.train cartpole --device cpu")
    again = ["cartpole", "--device", "cpu", "--iterations", "3", "--out", str(folder), "--resume", "latest"]
    assert train.main(again) == 0  # with the same worlds, networks and seed
    assert settings.read(folder / "settings.toml")["learner"] == found["learner"]
    assert training_files.read(folder / "last.pt")["iter"] == 2
    capsys.readouterr()
    assert play.main(["cartpole", str(folder / "last.pt"), "--export", str(tmp_path / "policy")]) == 0
    assert "after 3 iteration(s)" in capsys.readouterr().out
    for text, words in (
        ("a = = 3", "settings.toml': "),
        ('[run]\ntask = "cartpole"\nseed = "x"', "has run.seed = 'x'; exp"),
    ):
        (folder / "settings.toml").write_text(text)
        with pytest.raises(SystemExit):
            train.main(again)
        assert words in capsys.readouterr().err


def test_trees_are_written_as_toml_and_read_again(tmp_path):
    tree = {
        "dt": 0.01,
        "on": True,
        "rewards": {"foot slip": -0.1, "x": {"y": [1, 2.5, 'a\n"b']}},
        "commands": {"a": [[1, 2]]},
    }
    (tmp_path / "tree.toml").write_text(settings.text_of(tree))
    assert settings.read(tmp_path / "tree.toml") == tree
    assert settings.parse(["rewards.foot slip=-0.1", "a.b=1e-3", "a.c=(1, 2)", "d=text"]) == {
        "rewards": {"foot slip": -0.1}, "a": {"b": 1e-3, "c": (1, 2)}, "d": "text"
    }  # fmt: skip


def test_measure_of_rough_ground_has_the_settings_of_the_environment(monkeypatch):
    """Its trials were built without what --set had changed."""
    from types import SimpleNamespace

    from warp_spo.env import evaluation
    from warp_spo.env.tasks import go2_rough

    built = []
    monkeypatch.setattr(go2_rough, "build", lambda worlds, device, **given: built.append(given))
    monkeypatch.setattr(evaluation, "tracking", lambda env, policy: {})
    monkeypatch.setattr(evaluation, "climb", lambda env, policy: {"climbed": 1.0})
    go2_rough.measure(SimpleNamespace(num_envs=2, device="cpu", options={"dt": 4e-3}), None)
    assert [given["trial"] for given in built] == [*go2_rough.TRIALS] and all(given["dt"] == 4e-3 for given in built)


def test_an_environment_of_a_task_knows_its_settings():
    from warp_spo.env.tasks import cartpole

    assert cartpole.build(1, "cpu", rewards={"effort": -1.0}).options == {"rewards": {"effort": -1.0}}


def test_ctrl_c_ends_play_with_a_line(monkeypatch, capsys):
    from warp_spo import play

    def stopped(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(play, "play", stopped)
    assert play.main(["cartpole", "none.pt"]) == 130
    assert capsys.readouterr().err.count("\n") == 1
