"""Plans on GPUs of other sizes: numbers of worlds in proportion to multiprocessors, blocks that shared memory holds."""

import dataclasses
import json

import numpy as np
import pytest

import warp_spo as spo
from support import zoo
from warp_spo.dynamics.inertia import SOLVE_MASS_MATRIX
from warp_spo.execution import device_facts, plan
from warp_spo.execution.device_facts import CPU, MEASURED, DeviceFacts
from warp_spo.kernels import native, straight_line

L4 = DeviceFacts("NVIDIA L4", multiprocessors=58, shared_bytes=100 * 1024)
RTX_4090 = DeviceFacts("NVIDIA GeForce RTX 4090", multiprocessors=128, shared_bytes=100 * 1024)


def test_a_small_gpu_is_full_with_fewer_worlds():
    scene = zoo.fork()
    for device, limit in ((MEASURED, 32768), (L4, 14398), (RTX_4090, 31775)):
        few, many = (plan.choose(scene, limit + more, device, "float32") for more in (0, 1))
        assert (
            (few.granularity, many.granularity) == ("segment", "tree") and few.latency_bound and not many.latency_bound
        )
        assert f"up to {limit} worlds" in few.reason and f"more than {limit} worlds" in many.reason
    assert CPU.scaled(100) == 100
    few, many = (plan.choose(zoo.star(4), 17997 + more, L4, "float32") for more in (0, 1))  # limbs of one code
    assert (few.granularity, many.granularity) == ("segment", "tree") and not few.latency_bound


def test_a_thread_of_a_scan_takes_more_nodes_on_a_small_gpu():
    scene = zoo.planar_chain(300)
    large, small = (plan.choose(scene, 256, device, "float32").block_length for device in (MEASURED, L4))
    assert small == 2 * large > 0


def test_facts_are_those_of_the_device(device):
    facts = device_facts.read_facts(device)
    assert facts.cuda == device.is_cuda
    if device.is_cuda:
        assert facts.multiprocessors == device.sm_count and facts.shared_bytes >= 48 * 1024
        assert spo.Dynamics(zoo.fork(), 2, device).plan.device == facts


@pytest.mark.parametrize("kilobytes, capped", [(228, True), (8, False)])
def test_registers_are_capped_only_where_shared_memory_holds_the_blocks(kilobytes, capped, monkeypatch):
    """A solve by limbs wants four blocks on a multiprocessor; without shared memory for them a cap would only spill."""
    facts, caps, worlds = dataclasses.replace(MEASURED, shared_bytes=kilobytes * 1024), {}, 1 << 16

    def note(name, text, arrays, T, registers=None, **more):
        caps[name] = registers

    monkeypatch.setattr("warp_spo.dynamics.dynamics.read_facts", lambda device: facts)
    monkeypatch.setattr(native, "kernel", note)
    dyn = spo.Dynamics(zoo.star(4), worlds, "cpu", granularity="segment")
    shape = (worlds, dyn.scene.dof_count)
    dyn.programs.find(SOLVE_MASS_MATRIX.routine, {"q": (worlds, dyn.scene.coord_count), "b": shape}, shape)
    assert (caps["solve_mass_matrix"] is not None) == capped


@pytest.mark.parametrize("kilobytes, room", [(228, 92), (80, 77), (48, 46)])
def test_float64_has_room_for_as_many_scalars_as_float32(kilobytes, room, monkeypatch):
    """Where the GPU has the memory; a block asks for what it may not declare."""
    facts = dataclasses.replace(MEASURED, shared_bytes=kilobytes * 1024)
    monkeypatch.setattr("warp_spo.dynamics.dynamics.read_facts", lambda device: facts)
    rooms = {x: spo.Dynamics(zoo.star(2), 2, "cpu", dtype=x).programs.builder.room() for x in ("float32", "float64")}
    assert rooms == {"float32": 46 * 1024, "float64": room * 1024}


@pytest.mark.parametrize("bodies, asked", [(8, False), (40, True)])
def test_rows_that_a_block_may_not_declare_are_asked_for(bodies, asked, monkeypatch):
    kernels, make = [], native.kernel
    monkeypatch.setattr("warp_spo.dynamics.dynamics.read_facts", lambda device: MEASURED)
    monkeypatch.setattr(native, "kernel", lambda *a, **more: kernels.append((more, a[1])) or make(*a, **more))
    dyn = spo.Dynamics(zoo.planar_chain(bodies), 2, "cpu", dtype="float64", granularity="tree")
    x = np.zeros((2, 6 * bodies))
    dyn.operators(np.zeros((2, bodies))).phi.apply(x)
    [(more, text)] = kernels
    assert bool(more["shared"]) == asked == ("extern __shared__" in text)
    assert not asked or straight_line.SHARED_BYTES < more["shared"] <= 2 * straight_line.SHARED_BYTES


@pytest.mark.slow
def test_the_benchmark_of_plans_times_candidates_and_checks_results(device, capsys, tmp_path):
    from benchmarks import plans

    call = ["--device", device.alias, "--scenes", "2", "--operations", "mass_matrix", "step", "--worlds", "2"]
    plans.main([*call, "--json", str(tmp_path / "plans.json")])  # the exit code depends on times
    text = capsys.readouterr().out
    assert "2 mass_matrix, 15 dofs, " in text and "2 step, " in text and "; 0 wrong results" in text
    first, second = json.loads((tmp_path / "plans.json").read_text())["rows"]
    assert {"tree", "node"} <= first["us"].keys() and first["chosen"] in first["us"]
    assert first["ratio"] >= 1.0 and 0.0 < first["error"] < 1e-4 and second["operation"] == "step"
