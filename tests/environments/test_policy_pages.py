"""The page of a policy, driven through viser's handles without a browser, on a pole on a cart."""

import numpy as np
import pytest
import torch

from support.env_scenes import cart_env
from warp_spo.env import commands, observations, recording
from warp_spo.viewing.policy_view import Checkpoints

pytest.importorskip("viser", reason="needs the extra view")
SENT = 1e-6  # of places that the server sends as float32, within 1 m [m]
SPEEDS = 1e-5  # of velocities in float32, below 10 m/s


def command_follows(observed):
    """A policy that pulls the cart as the command says."""
    return observed["actor"][:, -1:]


@pytest.fixture(scope="module")
def env():
    return cart_env(
        6, commands=commands.Uniform(((-1.0, 1.0),), seconds=(100.0, 100.0)), events=[], episode_length_s=50.0,
        observations={"actor": [lambda w: w.q, lambda w: w.qd, observations.command]}, terminations={},
    )  # fmt: skip


@pytest.fixture
def page(env):
    env.reset(seed=0)
    found = recording.view(env, command_follows, port=18080)
    found.page.record()  # as if a browser looked
    yield found
    found.close()


def test_bodies_are_sent_where_the_environment_has_them(env, page):
    page.tick(0.1)
    poses = env.dyn.body_poses(env.q).numpy()
    for body, handle in page._layer.handles:
        assert np.allclose(handle.batched_positions, poses[:, body, :3] + page.offsets, atol=SENT, rtol=0)
        assert np.allclose(handle.batched_wxyzs[:, [1, 2, 3, 0]], poses[:, body, 3:], atol=SENT, rtol=0)
    page.numbers["followed"].value = 4
    page.numbers["worlds shown"].value = 5
    page.tick(0.0)
    assert len(page._layer.handles[0][1].batched_positions) == 5
    assert np.allclose(page.page.root.position[:2], -(poses[4, 0] + [*page.offsets[4], 0, 0, 0, 0])[:2], atol=SENT)


def test_pause_holds_and_a_step_is_one(env, page):
    page.tick(0.1)
    page.pause()
    q = env.q.clone()
    page.tick(1.0)
    assert (env.q == q).all()
    steps = page.steps
    page.step_once()
    page.tick(1.0)
    assert page.steps == steps + 1 and (env.q != q).any()
    page.pause()
    page.numbers["speed"].value = 2.0
    page.tick(4 * env.step_dt)
    assert page.steps == steps + 9


def test_a_slider_steers_the_followed_world_or_all(env, page):
    slider = page.sliders["command 0"]
    assert (slider.min, slider.max) == (-1.0, 1.0)
    before = env.command.clone()
    page.numbers["followed"].value, slider.value = 2, 0.75
    page.tick(0.0)
    assert env.command[2, 0] == 0.75 and (env.command[[0, 1, 3, 4, 5]] == before[[0, 1, 3, 4, 5]]).all()
    page.boxes["steer"].value, slider.value = True, -1.0
    page.tick(0.2)
    assert (env.command == -1.0).all() and (env.qd[:, 0] < 0.0).all()
    slider.value = 1.0
    left = env.qd[:, 0].clone()
    page.tick(0.4)
    assert (env.qd[:, 0] > left).all()  # its course has changed
    assert env.memory("command held").all()


def test_sliders_show_the_command_until_they_are_moved(env, page):
    env.command[1:3, 0] = torch.tensor([0.5, -0.25])
    env.memory("command held").zero_()
    slider = page.sliders["command 0"]
    for world, wanted in ((1, 0.5), (2, -0.25)):
        page.numbers["followed"].value = world
        page.tick(0.0)
        assert slider.value == pytest.approx(wanted, abs=slider.step) and env.command[world, 0] == wanted
    slider.value = 0.75
    page.tick(0.0)
    assert env.command[2, 0] == 0.75 and env.memory("command held")[2, 0] == 1.0
    page.free()
    assert not env.memory("command held").any()


def test_a_push_gives_the_impulse(env, page):
    """Mass times the jump of the velocities is the impulse on the cart, and none on the pole's joint."""
    page.pause()
    env.qd.zero_()
    page.numbers["followed"].value, page.numbers["impulse"].value, page.numbers["direction"].value = 3, 2.0, 180
    page.push()
    angle = float(env.q[3, 1])
    mass = np.array([[1.1, 0.05 * np.cos(angle)], [0.05 * np.cos(angle), 0.01 + 0.1 * 0.25]])
    assert np.allclose(mass @ env.qd[3].numpy(), [-2.0, 0.0], atol=SPEEDS)
    assert not env.qd[[0, 1, 2, 4, 5]].any()
    q = env.q[3, 0].clone()
    page.step_once()
    page.tick(0.0)
    assert env.q[3, 0] < q


def test_terms_are_those_of_the_followed_world(env, page):
    page.pause()
    page.step_once()
    page.tick()
    q, qd = env.q[0].numpy(), env.qd[0].numpy()
    assert page.bars.values == pytest.approx({"up": np.cos(q[1]), "slow": -0.1 * qd[0] ** 2}, abs=1e-4)
    assert "up" in page.bars.content() and page.terms.rows[-1][1:] == pytest.approx(tuple(page.bars.values.values()))


def test_a_checkpoint_from_the_list_acts_and_latest_is_the_newest(env):
    env.reset(seed=0)
    names = ["model_0.pt", "model_100.pt"]
    pulls = {"model_0.pt": 0.0, "model_100.pt": 1.0, "model_200.pt": -1.0}

    def load(name):
        if name not in pulls:
            raise ValueError(f"{name}: torn")
        return lambda observed: torch.full((6, 1), pulls[name])

    page = recording.view(
        env, load("model_0.pt"), checkpoints=Checkpoints(lambda: names, load), playing="model_0.pt", port=18080
    )
    try:
        box = page.choices["checkpoint"]
        assert list(box.options) == ["latest", "model_100.pt", "model_0.pt"] and box.value == "model_0.pt"
        env.qd.zero_()
        box.value = "model_100.pt"
        page.tick(env.step_dt)
        assert page.playing == "model_100.pt" and (env.actions == 1.0).all()
        box.value = "latest"
        names.append("model_200.pt")
        page._looked = -1e9
        page.tick(env.step_dt)
        assert page.playing == "model_200.pt" and (env.actions == -1.0).all()
        names.append("model_300.pt")
        page._looked = -1e9
        page.tick(env.step_dt)
        assert page.playing == "model_200.pt" and "torn" in page.said.content
    finally:
        page.close()


def test_ends_are_counted():
    env = cart_env(3, events=[], terminations={"out": lambda w: abs(w.q[0]) > 0.05}, episode_length_s=50.0)
    page = recording.view(env, lambda _: torch.tensor([[1.0], [-1.0], [0.0]]), port=18080)
    try:
        while not page.ended["out"]:
            page.tick(env.step_dt)
            assert page.steps < 100
        assert page.ended["out"] == 2 and page.ended["time out"] == 0
    finally:
        page.close()


def test_a_motion_is_one_page(env, page, tmp_path):
    text = page.as_html(0.4)
    assert text.lstrip().startswith("<!") and len(text) < 1.5e6
