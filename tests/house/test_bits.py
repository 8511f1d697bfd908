"""A world's result has the same bits alone and among any number of others, in any place, at one granularity.

The plan takes other kernels for few worlds than for many. They compute the same formulas and differ in how rows come in
and leave; where the compiler chose which products to fuse with sums, their bits would differ.
"""

import functools

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from benchmarks.table import robots, shapes
from support import contact_cases, laws, warp_machine
from support.granularity_scenes import GRANULARITIES, dynamics, states
from warp_spo.errors import UnsupportedError
from warp_spo.execution import plan
from warp_spo.execution.device_facts import MEASURED
from warp_spo.trials.inputs import APPLICATIONS, DT, OPERATIONS, Inputs, TrialCase
from warp_spo.trials.trial import Subject, TrialRun

STATES = 31  # different worlds; one less than a warp has threads, so that each comes to stand in every place of a warp
COUNTS = (1, 2, 33, 1000, 4096, 65536)
SCENES = {
    "tree": lambda: shapes.random_tree(12),
    "go2": lambda: robots.scene("go2"),
    "g1": lambda: robots.scene("g1"),
    "quadruped on the ground": contact_cases.quadruped,
    "box on the ground": contact_cases.box,
}


def stepping(name, substeps):
    """A step, of which the rates count."""
    return TrialCase(
        name,
        ("q", "qd", "tau"),
        lambda scene: (scene.dof_count,),
        lambda subject, q, qd, tau, out: subject.dyn.step(
            q, qd, tau, DT, options=spo.StepOptions(substeps=substeps), out=(None, out)
        ),
        lambda *_: None,
    )


EVERY = {**OPERATIONS, **APPLICATIONS, "step": stepping("step", 1), "substeps": stepping("substeps", 3)}
ROWS = "FEW_WORLDS", "SHORT_ROWS", "LONG_ROWS"  # limits of the plan that decide how rows come in and leave


@wp.kernel(enable_backward=False, module="unique")
def count_differences(
    words: wp.array2d(dtype=wp.int32), wanted: wp.array2d(dtype=wp.int32), start: int, count: wp.array(dtype=int)
):
    """Count the words of each world that differ from those of its state, the row (7 world + start) % states."""
    world, word = wp.tid()
    if words[world, word] != wanted[(7 * world + start) % wanted.shape[0], word]:
        wp.atomic_add(count, 0, 1)


class Mixed(Inputs):
    """Inputs of many worlds that have one of a few states each: world w that of number (7 w + worlds) % STATES."""

    def __init__(self, scene, worlds):
        super().__init__(scene, worlds)
        self.states = Inputs(scene, STATES)

    def array(self, name):
        return self.states.array(name)[(7 * np.arange(self.worlds) + self.worlds) % STATES]


def evaluated(scene, worlds, granularity, dtype, operation, device):
    """The words of a result [world, word], and the granularity that the operation has."""
    dyn = spo.Dynamics(scene, worlds, device=device, dtype=dtype, granularity=granularity)
    subject = Subject(dyn, [Mixed(scene, worlds)])
    trial = TrialRun(subject, operation)
    if operation.reveal:
        operation.reveal(subject, *trial._inputs[0], out=trial.out)
    assert not np.isnan(trial.out[:1].numpy()).any()
    shape = worlds, trial.out.size // worlds * wp.types.type_size_in_bytes(dyn.dtype) // 4
    words = wp.array(ptr=trial.out.ptr, dtype=wp.int32, shape=shape, device=dyn.device, copy=False)
    return trial, words, operation.granularity(dyn)


@functools.cache
def scene_of(name):
    if name in robots.ROBOTS and not robots.is_available(name):
        pytest.skip(f"the file of {name} is not there")
    return SCENES[name]()


def holds(name, granularity, operation, device, dtype="float32"):
    """One operation's bits at every count of worlds, against those at STATES worlds."""
    if not device.is_cuda:
        pytest.skip("a CPU has one kernel for every number of worlds")
    scene, operation = scene_of(name), EVERY[operation]
    try:
        _few, wanted, form = evaluated(scene, STATES, granularity, dtype, operation, device)
    except UnsupportedError as refused:
        pytest.skip(str(refused))
    # of world w are the words of state (7 w + STATES) % STATES; put them in the order of states
    order = np.argsort(7 * np.arange(STATES) % STATES)
    wanted = wp.array(wanted.numpy()[order], dtype=wp.int32, device=device)
    for worlds in COUNTS:
        _trial, words, now = evaluated(scene, worlds, granularity, dtype, operation, device)
        assert now == form
        count = wp.zeros(1, dtype=int, device=device)
        wp.launch(count_differences, words.shape, [words, wanted, worlds, count], device=device)
        assert count.numpy()[0] == 0, f"{worlds} worlds"


@pytest.mark.parametrize("operation", EVERY)
@pytest.mark.parametrize("granularity", ["node", *GRANULARITIES])
def test_bits_of_a_branched_tree(granularity, operation, device):
    holds("tree", granularity, operation, device)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("granularity", GRANULARITIES)
@pytest.mark.parametrize("name", ["quadruped on the ground", "box on the ground"])
def test_bits_of_steps_with_contacts(name, granularity, dtype, device):
    holds(name, granularity, "step", device, dtype)


@pytest.mark.slow
@pytest.mark.parametrize("operation", EVERY)
@pytest.mark.parametrize("granularity", ["node", *GRANULARITIES])
@pytest.mark.parametrize("name", ["go2", "g1"])
def test_bits_of_robots(name, granularity, operation, device):
    holds(name, granularity, operation, device)


@pytest.mark.slow
@pytest.mark.parametrize("operation", ["forward_dynamics", "inverse_dynamics", "mass_matrix_inverse", "step"])
@pytest.mark.parametrize("granularity", GRANULARITIES)
@pytest.mark.parametrize("name", ["go2", "g1"])
def test_bits_of_robots_in_float64(name, granularity, operation, device):
    holds(name, granularity, operation, device, "float64")


def rounded_once(a, b, c):
    """a b + c of float64 numbers, in long doubles: not always the last bit, but another than in two roundings."""
    return np.asarray(np.longdouble(a) * b + c, np.float64)


@pytest.mark.parametrize("granularity", GRANULARITIES)
def test_every_text_of_a_routine_has_the_same_bits(granularity, monkeypatch):
    """Rows that are read by their threads or come in together, results that leave each way; run by the machine."""
    texts = warp_machine.recorded(monkeypatch)
    for name in ("FUSED_float", "FUSED_double"):
        monkeypatch.setitem(warp_machine.FUNCTIONS, name, rounded_once)
    for limit in (None, 0):
        for name in ROWS if limit is not None else ():
            monkeypatch.setattr(plan, name, limit)
        for worlds in (1, 70):
            dyn = dynamics("two arms", granularity, worlds, "float32", wp.get_device("cpu"))
            dyn.programs.builder.relays = True
            for operation in ("forward_dynamics", "inverse_dynamics", "mass_matrix_inverse"):
                laws.numpy_call(dyn, operation, states(dyn))
    arrays = states(dynamics("two arms", granularity, 3, "float32", wp.get_device("cpu")))
    found = {}
    for text in texts:
        results = found.setdefault(text.operation.name, {})
        results[text.cuda] = warp_machine.run(text, arrays)
    assert all(len(results) > 1 for results in found.values())
    for results in found.values():
        first, *others = results.values()
        for other in others:
            np.testing.assert_array_equal(other, first)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("granularity", GRANULARITIES)
def test_formulas_do_not_depend_on_the_number_of_worlds(granularity, dtype):
    """Forward dynamics with velocity terms first is another algorithm, whose bits differ."""
    found = set()
    for links in (7, 40):
        scene = shapes.random_tree(links)
        plans = [plan.choose(scene, worlds, MEASURED, dtype, granularity) for worlds in (1, 1000, 65536, 1 << 20)]
        assert len({one.bias_first for one in plans}) == 1
        found.add(plans[0].bias_first)
    assert True in found
