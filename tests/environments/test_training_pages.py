"""The page of a training: nothing is copied while nobody looks, and what is shown is where the worlds are."""

import json

import numpy as np
import pytest
import torch

from support.env_scenes import cart_env
from warp_spo.env.state_copies import StateCopies
from warp_spo.env.training_log import LiveRows
from warp_spo.viewing.training_view import TrainingView

pytest.importorskip("viser", reason="needs the extra view")
SENT = 1e-6  # of places that the server sends as float32, within 1 m [m]


def test_nothing_is_copied_while_nobody_looks_and_states_arrive_while_somebody_does(tmp_path):
    env, file = cart_env(8, events=[], terminations={}, episode_length_s=50.0), tmp_path / "progress.jsonl"
    copies = StateCopies(env, worlds=5, interval=0.0)
    view = TrainingView(env.scene, copies, LiveRows(file), env.default_q, port=18080)
    try:
        push = torch.linspace(-1.0, 1.0, 8)[:, None]
        view.tick()
        env.step(push)
        copies.copy()
        assert not copies.wanted and copies.count == 0
        view.page.record()  # as a browser that looks
        view.tick()
        env.step(push)
        copies.copy()
        q = env.q.clone()
        rows = [{"iteration": i, "seconds": 2.0 * i, "reward": 0.5 * i, "/reward/up": float(i)} for i in range(3)]
        file.write_text("".join(json.dumps(row) + "\n" for row in rows) + '{"iteration": 3, "sec')  # torn
        view.tick()
        assert copies.count == 1
        poses = env.dyn.body_poses(q).numpy()[:5]
        for body, handle in view._layer.handles:
            assert np.allclose(handle.batched_positions, poses[:, body, :3] + view.offsets, atol=SENT, rtol=0)
        curve = view.curves["reward"].rows
        assert [row[:2] for row in curve] == [(0, 0.0), (1, 0.5), (2, 1.0)] and view.bars.values == {"up": 2.0}
        view.page._recorded = None
        view.tick()
        env.step(push)
        copies.copy()
        assert copies.count == 1
    finally:
        view.close()


def test_steps_are_those_of_an_environment_that_nobody_looks_at():
    env, alone = (cart_env(4, seed=3) for _ in range(2))
    copies = StateCopies(env, interval=0.0)
    copies.wanted = True
    for _ in range(5):
        for each in (env, alone):
            each.step(torch.full((4, 1), 0.3))
        copies.copy()
        assert (env.q == alone.q).all() and (copies.take() == alone.q.numpy()).all()
    assert copies.take() is None
