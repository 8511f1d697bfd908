"""Numbers of worlds beyond which an index of 32 bits, or a row of a GPU's grid of blocks, ends.

On a GPU each case goes past its limit, and every world is compared with its equal in a small batch, to the bit. With
``pytest --device cuda:0 -m "slow or not slow"``; the largest case takes 40 GB.
"""

import gc
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
import torch
import warp as wp

import warp_spo as spo
from benchmarks.table import shapes
from support.env_scenes import walker_q, walker_scene
from warp_spo.env import make, robots
from warp_spo.kernels import row_copies
from warp_spo.runtime import launches, memory

FEW = 1021  # worlds of the small batch: a prime, so that a world and its equals lie differently in their blocks
PART = 1 << 20  # worlds that are compared at once


@pytest.fixture
def gpu(device):
    if not device.is_cuda:
        pytest.skip("needs the memory of a GPU")
    yield str(device)
    gc.collect()
    torch.cuda.empty_cache()


def states(scene, worlds, device, dtype=torch.float32):
    """Return q and three rows of rates and forces, the same every FEW worlds."""
    rng = np.random.default_rng(5)
    q = np.tile(scene.neutral_q, (FEW, 1)) + rng.uniform(-0.05, 0.05, (FEW, scene.coord_count))
    rates = [rng.normal(size=(FEW, scene.dof_count)) for _ in range(3)]
    few = [torch.as_tensor(x, dtype=dtype, device=device) for x in (q, *rates)]
    at = torch.arange(worlds, device=device) % FEW
    return [x[at].contiguous() for x in few]


def assert_equal_to_few(call, scene, worlds, device, **options):
    """Compare ``call(dyn, *states)`` with the same for FEW worlds, in all worlds, twice: as recorded, too."""
    expected = call(spo.Dynamics(scene, FEW, device, **options), *states(scene, FEW, device))
    dyn = spo.Dynamics(scene, worlds, device, **options)
    given = states(scene, worlds, device)
    for _ in range(2):
        found = call(dyn, *given)
        for one, few in zip(found, expected, strict=True):
            assert not few.isnan().any()
            for first in range(0, worlds, PART):
                part = one[first : first + PART]
                at = torch.arange(first, first + len(part), device=device) % FEW
                wrong = (part != few[at]).flatten(1).any(1)
                assert not wrong.any(), f"world {first + int(wrong.nonzero()[0])} of {worlds}"
                del part, at, wrong
        del found, one


CALLS = {
    "forward": lambda dyn, q, qd, tau, _: [dyn.forward_dynamics(q, qd, tau)],
    "inverse": lambda dyn, q, qd, _, qdd: [dyn.inverse_dynamics(q, qd, qdd)],
    "poses": lambda dyn, q, *_: [dyn.body_poses(q)],
    "mass": lambda dyn, q, *_: [dyn.mass_matrix(q)],
    "derivatives": lambda dyn, q, qd, tau, _: [*dyn.forward_dynamics_derivatives(q, qd, tau)],
    "step": lambda dyn, q, qd, tau, _: [*dyn.step(q, qd, tau, 2e-3)],
    "substeps": lambda dyn, q, qd, tau, _: [*dyn.step(q, qd, tau, 2e-3, options=spo.StepOptions(substeps=4))],
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "robot, granularity, call, worlds",
    [
        ("arm", "tree", "forward", (1 << 24) + 777),
        ("arm", "tree", "step", (1 << 25) + 777),
        ("go2", "segment", "forward", (1 << 22) + 777),
        ("go2", "segment", "step", (1 << 22) + 777),
        ("go2", "tree", "inverse", 5 << 20),
        ("go2", None, "poses", 5 << 20),
        ("go2", "node", "forward", (1 << 21) + 777),
        ("go2", "tree", "derivatives", 699_048 + 777),
        ("g1", None, "derivatives", 349_524 + 777),
        ("g1", None, "derivatives", 700_001),  # beyond 2^32 threads
        ("g1", None, "mass", 2_000_003),  # beyond 2^31 entries
        ("walker", None, "substeps", (1 << 22) + 777),
        ("g1", None, "substeps", 5 << 20),
        ("g1", None, "step", 5 << 20),
    ],
)
def test_worlds_beyond_the_limits_of_launches(gpu, robot, granularity, call, worlds):
    scenes = {"arm": lambda: shapes.chain(7), "walker": walker_scene}
    scene = scenes[robot]() if robot in scenes else robots.load(robot).scene
    assert_equal_to_few(CALLS[call], scene, worlds, gpu, granularity=granularity)


@pytest.mark.slow
@pytest.mark.parametrize("transposed", [False, True])
def test_copies_of_more_than_two_billion_entries(gpu, transposed):
    count, worlds = 16, (1 << 27) + 5
    source = torch.rand((worlds, count), device=gpu)
    target = torch.empty((count, worlds) if transposed else (worlds, count), device=gpu)
    kernel, given = row_copies.copy(wp.float32, wp.float32, 1, transposed), [wp.from_torch(x) for x in (source, target)]
    launches.launch(kernel, worlds * count, [worlds, None, *given], [], device=gpu)
    found = target.T if transposed else target
    assert all(found[i : i + PART].equal(source[i : i + PART]) for i in range(0, worlds, PART))


@pytest.mark.slow
@pytest.mark.parametrize("task, worlds", [("go2-flat", (1 << 22) + 777), ("go2-rough", (1 << 21) + 777)])
def test_environments_of_many_worlds(gpu, task, worlds):
    """The last worlds are those of an environment that begins with them."""
    few = 512
    expected = make(task, few, gpu, first_world=worlds - few)
    env = make(task, worlds, gpu)
    generator = torch.Generator(device=gpu).manual_seed(1)
    for _ in range(3):
        actions = torch.randn((few, env.num_actions), generator=generator, device=gpu)
        whole = torch.zeros((worlds, env.num_actions), device=gpu)
        whole[-few:] = actions
        observed, reward, done, _ = env.step(whole)
        small, small_reward, small_done, _ = expected.step(actions)
        for name in small.keys():
            assert observed[name][-few:].equal(small[name])
        assert reward[-few:].equal(small_reward) and done[-few:].equal(small_done)


@pytest.mark.parametrize("threads, dim, in_a_row", [(4, 4, False), (5, 5, True), (9, (3, 4), True)])
def test_grids_of_one_axis(monkeypatch, threads, dim, in_a_row):
    """Kernels that count blocks get a grid of one axis, and from 2^31 threads on Warp is told of blocks; lowered."""
    monkeypatch.setattr(launches, "MOST_IN_A_ROW", 4)
    monkeypatch.setattr(launches, "LARGEST", 8)
    monkeypatch.setattr(launches, "counts_blocks", lambda *_: True)
    command = SimpleNamespace(grid_stride=False, launch=mock.Mock())
    with mock.patch.object(wp, "launch", return_value=command) as launch:
        launches.launch("kernel", threads, [], [], device="cpu", block_dim=4)
    assert launch.call_args.args[1] == dim and launch.call_args.kwargs["record_cmd"] == in_a_row
    assert command.grid_stride == in_a_row and command.launch.call_count == in_a_row


def test_rows_longer_than_warp_counts_are_refused(monkeypatch):
    """At node granularity a row is an entry of all worlds; lowered."""
    monkeypatch.setattr(memory, "LONGEST_STRIDE", 1000)
    scene = walker_scene()
    dyn = spo.Dynamics(scene, 100, "cpu", granularity="node")
    q, zero = np.tile(walker_q(), (100, 1)), np.zeros((100, scene.dof_count))
    with pytest.raises(ValueError, match="expected fewer worlds in one Dynamics"):
        dyn.forward_dynamics(q, zero, zero)
