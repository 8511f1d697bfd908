"""Pages driven in headless Chromium, as a user drives them; no error in their consoles."""

import contextlib
import shutil
import threading
import time

import mujoco
import numpy as np
import pytest
import torch

import warp_spo as spo
from support.env_scenes import cart_env
from warp_spo.env import commands, observations, recording
from warp_spo.viewing.policy_view import Checkpoints

pytest.importorskip("viser", reason="needs the extra view")
playwright = pytest.importorskip("playwright.sync_api", reason="needs the package playwright")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium on the PATH: apt-get install chromium"),
]
SOFTWARE = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
PATIENCE = 60.0  # software WebGL draws a picture a second, on a busy machine fewer [s]
SENT = 1e-6  # of places that the server sends as float32, within 1 m [m]
ARM = """
<mujoco><worldbody><body name="upper" pos="0 0 0.5"><joint name="shoulder" axis="0 1 0" range="-90 50"/>
  <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03"/>
  <body name="lower" pos="0.3 0 0"><joint name="elbow" axis="0 1 0" range="-120 120"/>
    <geom type="box" pos="0.1 0 0" size="0.1 0.02 0.02"/></body></body></worldbody></mujoco>
"""


@contextlib.contextmanager
def opened(view):
    """A page of a view whose frames go on beside it; the console's errors are empty at the end."""
    errors, ended = [], threading.Event()

    def frames():
        while not ended.wait(0.05):
            view.tick(0.05)

    beside = threading.Thread(target=frames)
    beside.start()
    try:
        with playwright.sync_playwright() as player:
            browser = player.chromium.launch(executable_path=CHROMIUM, args=list(SOFTWARE))
            page = browser.new_page(viewport={"width": 900, "height": 900})
            page.set_default_timeout(1e3 * PATIENCE)
            page.on("console", lambda said: errors.append(said.text) if said.type == "error" else None)
            page.on("pageerror", lambda error: errors.append(str(error)))
            page.goto(view.page.url)
            page.get_by_role("tab").first.wait_for()
            yield page
            browser.close()
    finally:
        ended.set()
        beside.join()
        view.close()
    assert not errors, errors


def wait_until(condition):
    """Wait until a condition holds, at most PATIENCE."""
    end = time.time() + PATIENCE
    while not condition():
        assert time.time() < end, "nothing came of it"
        time.sleep(0.1)


def test_a_slider_in_the_browser_turns_the_link(tmp_path):
    file = tmp_path / "arm.xml"
    file.write_text(ARM)
    view = spo.view(file, port=18080)
    with opened(view) as page:
        page.get_by_role("slider").nth(0).press("End")
        page.get_by_role("slider").nth(1).press("Home")
        wait_until(lambda: np.allclose(view.q, np.radians([50, -120])))
        model = mujoco.MjModel.from_xml_path(str(file))
        data = mujoco.MjData(model)
        data.qpos[:] = view.q
        mujoco.mj_kinematics(model, data)
        wait_until(
            lambda: np.allclose(
                view.layers["what the file draws"].handles[1][1].batched_positions, data.xpos[2], atol=SENT
            )
        )
        page.get_by_role("tab", name="Drop it").click()
        page.get_by_role("button", name="Drop it").click()
        wait_until(lambda: view.motion is not None and view.motion.time > 0.1)


def test_a_policy_is_steered_pushed_held_and_exchanged_in_the_browser():
    env = cart_env(
        4, commands=commands.Uniform(((-1.0, 1.0),), seconds=(1e4, 1e4)), events=[], episode_length_s=1e4,
        observations={"actor": [lambda w: w.q, lambda w: w.qd, observations.command]}, terminations={},
    )  # fmt: skip
    env.command[:] = 0.0
    policies = {
        "model_0.pt": lambda observed: observed["actor"][:, -1:],
        "model_100.pt": lambda observed: torch.full((4, 1), -1.0),
    }
    checkpoints = Checkpoints(lambda: list(policies), policies.__getitem__)
    view = recording.view(env, policies["model_0.pt"], checkpoints=checkpoints, playing="model_0.pt", port=18080)
    with opened(view) as page:
        assert not env.qd[0, 0]
        page.get_by_role("slider").nth(2).press("End")  # after speed and worlds shown: the command
        wait_until(lambda: env.command[0, 0] == 1.0 and env.qd[0, 0] > 0.1)
        page.get_by_role("button", name="Pause").click()
        wait_until(lambda: view.paused)
        time.sleep(0.3)
        q, qd = env.q.clone(), env.qd.clone()
        time.sleep(0.5)
        assert (env.q == q).all()
        view.numbers["direction"].value = 0  # along the rail
        page.get_by_role("button", name="Push", exact=True).click()
        wait_until(lambda: (env.qd != qd).any())
        assert (env.q == q).all() and (env.qd[1:] == qd[1:]).all()
        page.get_by_role("button", name="Step").click()
        wait_until(lambda: (env.q != q).any())
        page.locator("input[value='model_0.pt']").first.click()
        page.get_by_role("option", name="model_100.pt").click()
        wait_until(lambda: view.playing == "model_100.pt")
        page.get_by_role("button", name="Pause").click()
        wait_until(lambda: (env.actions == -1.0).all())
