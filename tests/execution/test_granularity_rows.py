"""Tree and segment granularity: rows of arrays that shared memory cannot hold or that begin anywhere."""

import itertools
import math

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import laws, warp_machine, zoo
from support.granularity_scenes import DTYPES, GRANULARITIES, MANY, dynamics, equals_reference, states
from support.quick import slow_unless
from warp_spo.execution import plan
from warp_spo.kernels import straight_line


@pytest.mark.parametrize("granularity", GRANULARITIES)
def test_a_long_result_that_shared_memory_cannot_hold(granularity, device, monkeypatch):
    """Values that wait in the rows of the result, and parameters with them."""
    texts = warp_machine.recorded(monkeypatch)
    dyn = dynamics("two arms", granularity, MANY, "float64", device, varied=True)
    monkeypatch.setattr(straight_line, "SHARED_BYTES", 5_000)  # twice as many in float64
    dyn.programs.builder.relays = True
    for operation in ("mass_matrix", "mass_matrix_inverse"):
        equals_reference(dyn, operation, states(dyn), laws.TOLERANCE["float64"])
    assert {text.frame.result.way for text in texts} == {straight_line.RELAYED}


@pytest.mark.parametrize(
    ("granularity", "dtype", "way"),
    slow_unless(
        [("tree", "float32", straight_line.MAPPED), ("tree", "float64", straight_line.RELAYED),
         ("segment", "float32", straight_line.RELAYED), ("segment", "float64", straight_line.MAPPED)],
        itertools.product(GRANULARITIES, DTYPES, [straight_line.MAPPED, straight_line.RELAYED]),
    ),
)  # fmt: skip
def test_long_results_that_begin_anywhere(granularity, dtype, way, device, monkeypatch):
    """Of worlds that fill no warp, no tile and no 16 bytes; nothing is written in front of the result or behind it."""
    operation = "mass_matrix" if granularity == "tree" else "mass_matrix_inverse"
    texts = warp_machine.recorded(monkeypatch)
    if way == straight_line.RELAYED:  # room for a tile, and for what the limbs send, but not for all values
        room = 1_250 if granularity == "tree" else 4_000
        monkeypatch.setattr(straight_line, "SHARED_BYTES", room * 4)  # in float32
    for worlds in (1, 3, 33, 70):
        dyn = dynamics("two arms", granularity, worlds, dtype, device)
        dyn.programs.builder.relays = True
        arrays, size = states(dyn), dyn.scene.dof_count**2 * worlds
        wanted = equals_reference(dyn, operation, arrays, laws.TOLERANCE[dtype])
        q = laws.to_device(dyn, arrays)["q"]
        for at in range(5):
            memory = wp.full(at + size + 5, math.nan, dtype=dyn.dtype, device=device)
            getattr(dyn, operation)(q, out=memory[at : at + size].reshape(wanted.shape))
            np.testing.assert_array_equal(memory[at : at + size].numpy(), wanted.ravel())
            rest = np.concatenate([memory[:at].numpy() if at else [], memory[at + size :].numpy()])
            assert np.isnan(rest).all()
        if granularity == "segment" and worlds == 3:
            by_warps = warp_machine.run(texts[-1], {"q": arrays["q"]}).reshape(wanted.shape)
            assert laws.error(by_warps, wanted) <= laws.TOLERANCE[dtype]
    found = {(text.frame.result.way, text.frame.warps) for text in texts}
    assert found == {(way, 1 if granularity == "tree" else 2)}


@pytest.mark.parametrize(
    ("name", "dtype"),
    slow_unless(
        [("chain_helical", "float32"), ("chain_universal", "float64")],
        itertools.product(["chain_helical", "chain_universal"], DTYPES),
    ),
)
def test_rows_that_begin_anywhere(name, dtype, device, monkeypatch):
    """Rows come in and out 16 bytes at a time where memory allows it; slices begin between such places."""
    for limit in ("FEW_WORLDS", "SHORT_ROWS", "LONG_ROWS"):
        monkeypatch.setattr(plan, limit, 0)
    scene = zoo.SCENES[name]()
    dyn = spo.Dynamics(scene, 70, device=device, dtype=dtype)
    assert dyn.plan.staged or not device.is_cuda
    given = laws.states(scene, 70)

    def beginning(values, at):
        flat = wp.array(np.concatenate([np.full(at, np.nan), np.ravel(values)]), dtype=dyn.dtype, device=device)
        return flat[at:].reshape(values.shape)

    for operation, third in (("forward_dynamics", "tau"), ("inverse_dynamics", "qdd")):
        results = []
        for at in range(5):
            arrays = [beginning(given[key], at) for key in ("q", "qd", third)]
            out = beginning(np.full((70, scene.dof_count), np.nan), at)
            results.append(getattr(dyn, operation)(*arrays, out=out).numpy())
        assert np.isfinite(results[0]).all()
        for result in results[1:]:
            np.testing.assert_array_equal(result, results[0])
