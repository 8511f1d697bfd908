"""A task of one's own from a robot's file: ``tasks --new FILE.py --robot ROBOT.xml``, trained, filmed and exported."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")
mujoco = pytest.importorskip("mujoco")
pytest.importorskip("warp_spo.env.learning")

import warp_spo as spo  # noqa: E402
from warp_spo import play, tasks, train  # noqa: E402
from warp_spo.env import robots  # noqa: E402
from warp_spo.env.tasks import task  # noqa: E402
from warp_spo.scene.collision_shapes import floating_bases  # noqa: E402

WHEEL = '<geom type="cylinder" size=".06 .012" euler="90 0 0"/></body>'
BALANCER = f"""<mujoco><worldbody><geom type="plane" size="0 0 .1"/>
<body name="chassis" pos=".3 0 .06" euler="0 0 40"><freejoint/><geom type="box" size=".03 .06 .1" pos="0 0 .12"/>
  <body pos="0 .08 0"><joint name="left wheel" axis="0 1 0"/>{WHEEL}
  <body pos="0 -.08 0"><joint name="right wheel" axis="0 1 0"/>{WHEEL}
</body></worldbody><actuator>
  <motor joint="left wheel" gear=".6" ctrlrange="-1 3"/><motor joint="right wheel" gear=".6" ctrlrange="-1 3"/>
</actuator></mujoco>"""
ARM = """<mujoco><worldbody><body><joint name="turn" axis="0 0 1"/>
  <geom type="capsule" size=".05" fromto="0 0 0 0 0 .3"/>
  <body pos="0 0 .3"><joint name="lift.1" axis="0 1 0" range="-90 90"/>
    <geom type="capsule" size=".03" fromto="0 0 0 .3 0 0"/></body></body></worldbody>
<actuator><position joint="turn" kp="20"/><position joint="lift.1" kp="20"/></actuator>
<keyframe><key name="home" qpos=".2 .4"/></keyframe></mujoco>"""


def new_file(text, folder, name="robot"):
    """Return the task's file that the command writes for a robot, which lies in a folder beside it."""
    (folder / "files").mkdir(exist_ok=True)
    (folder / "files" / f"{name}.xml").write_text(text)
    file = folder / f"{name}_task.py"
    assert tasks.main(["--new", str(file), "--robot", str(folder / "files" / f"{name}.xml")]) == 0
    return file


@pytest.mark.filterwarnings("ignore:load")
def test_a_robot_stands_where_its_file_has_it(tmp_path):
    """The start is MuJoCo's qpos0; a file without a floor has the plane z = 0 as one, an arm none."""
    chosen = task(str(new_file(BALANCER, tmp_path)))
    qpos = mujoco.MjModel.from_xml_string(BALANCER).qpos0
    np.testing.assert_allclose(chosen.START, [*qpos[:3], *np.roll(qpos[3:7], -1), *qpos[7:]], atol=1e-6)
    assert (tmp_path / chosen.ROBOT).is_file()
    assert f"below({round(0.5 * qpos[2], 3)})" in (tmp_path / "robot_task.py").read_text()  # it does not lie
    floorless = BALANCER.replace('<geom type="plane" size="0 0 .1"/>', "")
    for text, reads in ((BALANCER, 'ROBOT, contacts="ground")'), (floorless, 'ROBOT, contacts="*")'), (ARM, "ROBOT)")):
        file = new_file(text, tmp_path, f"robot_{len(reads)}")
        assert f"spo.load(Path(__file__).parent / {reads}" in file.read_text()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:load")
def test_wheels_have_their_motors_and_no_angle(tmp_path):
    """A wheel's angle is not observed, and the actions from -1 to 1 are the range of its motor."""
    env = task(str(new_file(BALANCER, tmp_path))).build(4, "cpu")
    assert env.num_obs == {"actor": 3 * 3 + 2 + 2 + 3} and env.num_actions == 2  # rates, base; command
    np.testing.assert_allclose(env.controls(torch.ones(4, 2))["ctrl"].cpu(), 3.0)  # the highest control
    np.testing.assert_allclose(env.controls(-torch.ones(4, 2))["ctrl"].cpu(), -1.0)


def test_an_arm_starts_from_its_keyframe(tmp_path):
    chosen = task(str(new_file(ARM, tmp_path)))
    env = chosen.build(4, "cpu")
    np.testing.assert_allclose(env.default_q, [0.2, 0.4])
    observed = env.get_observations()["actor"]  # lift, sine and cosine of turn, rates, actions
    assert observed.shape == (4, 1 + 2 + 2 + 2)
    torch.testing.assert_close(observed[:, 1:3], torch.stack([env.q[:, 0].sin(), env.q[:, 0].cos()], dim=1))
    np.testing.assert_allclose(env.controls(torch.ones(4, 2))["ctrl"].cpu(), [[0.5, 0.7]] * 4, atol=1e-6)


@pytest.mark.parametrize(("robot", "words"), [
    ("robot.urdf", "expected an MJCF file, .xml; a URDF says neither gains nor motors"),
    ("none.xml", "none.xml"),
    ("fixed.xml", "has no joint of one coordinate; expected one or more to act on"),
])  # fmt: skip
def test_a_robot_that_cannot_be_a_task_is_named(robot, words, tmp_path, capsys):
    (tmp_path / "fixed.xml").write_text("<mujoco><worldbody><body><geom size='.1'/></body></worldbody></mujoco>")
    with pytest.raises(SystemExit) as stopped:
        tasks.main(["--new", str(tmp_path / "task.py"), "--robot", str(tmp_path / robot)])
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and words in said and said.count("\n") == 1 and not (tmp_path / "task.py").exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", robots.NAMES)
def test_ready_robots_are_robots_of_ones_own(name, tmp_path):
    """Their files, which have keyframes, servos, motors, and bases of both kinds, become tasks whose worlds step."""
    env = task(str(new_file((robots.FILES / f"{name}.xml").read_text(), tmp_path, name))).build(2, "cpu")
    np.testing.assert_allclose(env.default_q, robots.load(name).q, atol=1e-12)
    for _ in range(3):
        env.step(torch.zeros(2, env.num_actions))
    assert torch.isfinite(env.q).all() and sum(env.log()[f"/not finite/{x}"] for x in ("state", "observation")) == 0


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:load")
def test_three_commands_lead_from_a_file_to_a_film_and_an_export(tmp_path, monkeypatch):
    """The film shows the robot's chassis, which touches nothing in this file and is orange in it alone."""
    from PIL import Image

    pytest.importorskip("onnx")
    monkeypatch.chdir(tmp_path)
    painted = BALANCER.replace('pos="0 0 .12"/>', 'pos="0 0 .12" rgba="1 .3 0 1" contype="0" conaffinity="0"/>')
    file = str(new_file(painted, tmp_path))
    more = ["--device", "cpu", "--worlds", "4", "--iterations", "2", "--set", "learner.steps=4"]
    assert train.main([file, *more]) == 0
    given = [file, "runs/robot_task/last.pt", "--export", "policy", "--film", "gif", "--seconds", "0.2"]
    assert play.main([*given, "--out", "film"]) == 0
    assert {"policy.onnx", "policy.pt", "film.gif", "film.png"} <= {each.name for each in tmp_path.iterdir()}
    with Image.open("film.png") as strip:
        shown = np.asarray(strip).astype(int)
    assert (shown[..., 0] > shown[..., 2] + 60).mean() > 1e-3


CAN = '<body name="can" pos=".5 0 .2"><freejoint/><geom type="cylinder" size=".03 .05"/></body>'
FINGER = """<mujoco><worldbody><geom type="plane" size="1 1 .1"/>{}<body name="palm" pos="0 0 .3">
  <joint name="lift" type="slide" axis="0 0 1" range="-.2 .2"/><geom type="box" size=".1 .02 .02"/>
  <body pos="0 0 -.1"><joint name="grip" type="slide" axis="1 0 0" range="0 .03"/><geom type="box" size=".01 .02 .05"/>
  </body></body></worldbody>
  <actuator><position joint="lift" kp="500"/><position joint="grip" kp="200"/></actuator></mujoco>"""


@pytest.mark.filterwarnings("ignore:load")
def test_an_object_is_no_robot(tmp_path):
    """A fixed hand holds its pose beside a can; of a can and a robot that floats the robot is the base. Short slides
    have short strokes."""
    text = new_file(FINGER.format(CAN), tmp_path).read_text()
    assert "contacts=True)" in text and "rewards.posture" in text and "track_velocity" not in text
    assert "scale=[0.2, 0.015]" in text
    assert 'position=(-0.0333, 0.0333), names="lift"' in text and 'position=(-0.0025, 0.0025), names="grip"' in text
    file = new_file(BALANCER.replace("<body", CAN + "<body", 1), tmp_path, "second")
    assert "track_velocity" in file.read_text()
    scene = spo.load(tmp_path / task(str(file)).ROBOT)
    assert [scene.body_labels[scene.hinges[i].child] for i in floating_bases(scene)][-1] == "can"
