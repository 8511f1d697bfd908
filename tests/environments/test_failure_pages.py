"""The page of a world that failed: its slider shows the states of the file, and it says what went wrong."""

import numpy as np
import pytest
import torch

from support.env_scenes import cart_env
from warp_spo.env.failure_replay import read
from warp_spo.view import main
from warp_spo.viewing.failure_view import FailureView

pytest.importorskip("viser", reason="needs the extra view")
SENT = 1e-6  # of places that the server sends as float32, within 1 m [m]


def test_the_slider_shows_the_states_of_the_file(tmp_path, capsys):
    env = cart_env(4, events=[], terminations={}, episode_length_s=50.0, keep_failures=tmp_path)
    for step in range(8):
        actions = torch.full((4, 1), 0.5)
        if step == 7:
            env.qd[2] = float("nan")
        env.step(actions)
    (file,) = env.failure_files()
    failure = read(file)
    page = FailureView(failure, port=18120)
    try:
        assert page.step.value == page.step.max == failure.step and "Step 7, status" in page.said.content
        for step in (failure.first_step, failure.first_step + 3):
            page.step.value = step
            page.tick()
            q = np.tile(failure.q[step - failure.first_step], (4, 1)).astype(np.float32)
            wanted = env.dyn.body_poses(q)[0]
            np.testing.assert_allclose(page.poses, wanted, atol=SENT)
            for body, handle in page._layer.handles:
                np.testing.assert_allclose(handle.batched_positions[0], wanted[body, :3], atol=SENT)
        page.plays.value, page.speed.value = True, 1.0
        page.tick(failure.dt * failure.decimation)
        assert page.step.value == failure.first_step + 4
    finally:
        page.page.close()
    with pytest.raises(SystemExit):
        main([str(file), "--html", str(tmp_path / "page.html")])
    assert "--html with a failure" in capsys.readouterr().err
    (tmp_path / "other.pt").write_bytes(b"no failure")
    with pytest.raises(SystemExit):
        main([str(tmp_path / "other.pt")])
    assert "cannot be read" in capsys.readouterr().err
