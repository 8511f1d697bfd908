"""Substeps: to the bit what as many calls compute, with the worst status of all."""

import numpy as np
import pytest
import torch
import warp as wp

import warp_spo as spo
from benchmarks.table.resources import record_launches
from support import zoo
from support.actuated import CURVES, KINDS, arm, states
from support.allocations import no_warp_allocation
from support.mechanisms import MECHANISMS
from support.step_calls import bundled
from support.step_scenes import furnished
from support.step_scenes import states as step_states
from warp_spo.execution import plan
from warp_spo.execution.device_facts import CPU, MEASURED

H, COUNT = 2e-3, 3


def in_calls(dyn, q, qd, tau, **given):
    """COUNT calls, each on the result of the one before; the words of all."""
    words = []
    for _ in range(COUNT):
        if "status" in given:
            given["status"] = np.full(dyn.worlds, -1, np.int32)
        q, qd = dyn.step(q, qd, tau, H, **bundled(**given))
        words.append(given.get("status"))
    return (q, qd), words


@pytest.mark.parametrize("integrator", ["semi_implicit", "midpoint", "rk4"])
def test_bits_are_those_of_calls(integrator, device):
    scene = arm([KINDS["position"][0], *CURVES])
    q, qd, ctrl = states(scene, 2)
    dyn = spo.Dynamics(scene, 2, device=device, dtype="float64")
    given = dict(ctrl=ctrl, integrator=integrator)
    tau, qdd = np.ones_like(qd), np.full_like(qd, np.nan)
    wanted, _ = in_calls(dyn, q, qd, tau, **given)
    more = {} if integrator != "semi_implicit" else {"qdd": qdd}
    before = q.copy(), qd.copy()
    out = dyn.step(q, qd, tau, H, **bundled(substeps=COUNT, **given, **more))
    np.testing.assert_array_equal((q, qd), before)
    np.testing.assert_array_equal(out, wanted)
    assert dyn.step(q, qd, tau, H, out=(q, qd), **bundled(substeps=COUNT, **given))[0] is q
    np.testing.assert_array_equal((q, qd), wanted)
    if more:
        earlier = dyn.step(*before, tau, H, **bundled(substeps=COUNT - 1, **given))
        last = dyn.step(*earlier, tau, H, **bundled(qdd=np.empty_like(qdd), **given))
        np.testing.assert_allclose(qdd, (last[1] - earlier[1]) / H, atol=1e-9)


@pytest.mark.parametrize(
    ("granularity", "dtype"),
    [("tree", "float32"), ("segment", "float32"), pytest.param("segment", "float64", marks=pytest.mark.slow)],
)
def test_one_launch_takes_them_all(granularity, dtype, device):
    """Of a tree with all laws and forces, in as many launches as one step takes; another number compiles nothing."""
    scene, worlds = furnished(zoo.fork()), 35  # more than a warp has threads
    dyn = spo.Dynamics(scene, worlds, device=device, dtype=dtype, granularity=granularity)
    a = {name: array.astype(dtype) for name, array in step_states(scene, worlds, dtype).items()}
    a["q"][1, 0], a["tau"][2, -1] = np.nan, np.inf
    given = {name: a[name] for name in ("body_f", "target_q", "target_qd")}
    word, qdd = np.full(worlds, -1, np.int32), np.full(a["qd"].shape, np.nan, dtype)
    given |= {"status": word, "qdd": qdd}
    for count in (2, COUNT, COUNT):
        with record_launches() as launched:
            found = dyn.step(a["q"], a["qd"], a["tau"], H, **bundled(substeps=count, **given))
    assert len(dyn.programs.describe()) == 1 and len(launched) == 2  # the other one checks what the status is of
    wanted, words = in_calls(dyn, a["q"], a["qd"], a["tau"], **(given | {"qdd": (last := np.full_like(qdd, np.nan))}))
    for x, y in zip((*found, qdd), (*wanted, last), strict=True):
        np.testing.assert_array_equal(x, y)
    severity = np.array([spo.Status(one).severity for one in range(len(spo.Status))])
    np.testing.assert_array_equal(severity[word], np.max(severity[np.array(words)], axis=0))
    assert word[1] == word[2] == spo.Status.NOT_FINITE and np.isfinite(np.delete(wanted[1], (1, 2), 0)).all()
    dyn.step(a["q"], a["qd"], a["tau"], H, **bundled(substeps=COUNT, **given), out=(a["q"], a["qd"]))
    np.testing.assert_array_equal(a["q"], wanted[0])
    np.testing.assert_array_equal(a["qd"], wanted[1])


def test_explain_says_how_many_launches():
    scene = arm([KINDS["position"][0]])

    def line(scene, **more):
        return spo.Dynamics(scene, 1, "cpu", **more).explain().split("substeps     ")[1].split("\n")[0]

    assert line(scene) == "one launch takes all of a semi-implicit step"
    delayed = arm([spo.Actuator(0, delay=2)])
    assert line(delayed).startswith("a launch each: delays of actuators count substeps, where ctrl is given; otherwise")
    assert line(MECHANISMS["fourbar"](), loops="multipliers").startswith("a launch each: loops='multipliers'")


@pytest.mark.parametrize(("dofs", "worlds", "fuses"), [(18, 1 << 16, True), (35, 4096, True), (35, 16384, False)])
def test_long_code_takes_launches_where_blocks_share_a_multiprocessor(dofs, worlds, fuses):
    scene = zoo.from_parents([-1, *[0] * 4, *range(1, dofs - 4)], ["revolute"] * dofs, 1)
    assert plan.choose(scene, worlds, MEASURED, "float32", "segment").fuses_substeps("segment") == fuses
    assert plan.choose(scene, worlds, CPU, "float32", "tree").fuses_substeps("tree")


@pytest.mark.parametrize("loops", ["embed", "multipliers"])
def test_bits_are_those_of_calls_with_closed_loops(loops, device):
    scene = MECHANISMS["fourbar"]()
    dyn = spo.Dynamics(scene, 2, device=device, dtype="float64", loops=loops)
    rng = np.random.default_rng(0)
    q, qd = dyn.project(np.tile(scene.neutral_q, (2, 1)), rng.normal(size=(2, scene.dof_count)))
    status = np.full(2, -1, np.int32)
    wanted, words = in_calls(dyn, q, qd, None, status=status)
    out = dyn.step(q, qd, None, H, options=spo.StepOptions(substeps=COUNT), status=status)
    for x, y in zip(out, wanted, strict=True):
        np.testing.assert_array_equal(x, y)
    np.testing.assert_array_equal(status, np.max(words, axis=0))


def test_status_is_the_worst(device):
    """Of several words the most severe; where an earlier substep lost the state, the word of that one."""
    hinge = spo.Hinge("prismatic", -1, 0, axis=(1, 0, 0))
    scene = spo.Scene([spo.Body(2.0, inertia=np.eye(3))], [hinge], gravity=(0, 0, 0))
    dyn = spo.Dynamics(scene, 3, device=device, dtype="float64")
    words = [(5, 0, 0), (0, 1, 2), (2, 2, 2), (7, 5, 6), (6, 2, 2), (0, 0, 0)]
    from warp_spo.dynamics.stepping.step import SEVERITY
    from warp_spo.kernels import combination

    status = wp.array([word[0] for word in words], dtype=int, device=device)
    for k in (1, 2):
        later = wp.array([word[k] for word in words], dtype=int, device=device)
        dyn.recursions.launch(combination.worst, len(words), [SEVERITY, later], [status])
    np.testing.assert_array_equal(status.numpy(), [5, 1, 2, 6, 6, 0])
    rest = np.zeros((3, 1))
    word = np.full(3, -1, np.int32)
    tau = np.array([[0.0], [1e308], [np.nan]])
    dyn.step(rest, rest, tau, 10.0, options=spo.StepOptions(substeps=5), status=word)
    np.testing.assert_array_equal(word, [0, 1, 2])  # infinite after some substeps: not for an infinite input


def test_gradients_are_those_of_calls():
    scene = arm([KINDS["position"][0], KINDS["tendon motor"][0]])
    dyn = spo.Dynamics(scene, 2, device="cpu", dtype="float64")
    found = []
    for often in (True, False):
        q, qd, ctrl = (torch.tensor(array, requires_grad=True) for array in states(scene, 2))
        if often:
            after = q, qd
            for _ in range(COUNT):
                after = dyn.step(*after, None, H, ctrl=ctrl)
        else:
            after = dyn.step(q, qd, None, H, ctrl=ctrl, options=spo.StepOptions(substeps=COUNT))
        (after[0].square().sum() + after[1].sum()).backward()
        found.append([*(x.detach() for x in after), q.grad, qd.grad, ctrl.grad])
    for x, y in zip(*found, strict=True):
        assert torch.equal(x, y) and x.abs().max() > 0.0


def test_refusals():
    scene = arm([KINDS["position"][0]])
    dyn = spo.Dynamics(scene, 1, device="cpu")
    zeros = np.zeros((1, 3), np.float32)
    for count in (0, 1.5, True, "2"):
        with pytest.raises(ValueError, match=r"Dynamics.step: substeps is .*; expected an integer, 1 or more"):
            dyn.step(zeros, zeros, None, H, options=spo.StepOptions(substeps=count))
    grad = torch.zeros((1, 3), requires_grad=True)
    with pytest.raises(ValueError, match="substeps is 0; expected an integer"):
        dyn.step(grad, grad, None, H, options=spo.StepOptions(substeps=0))
    with pytest.raises(ValueError, match="status is given with substeps and an input requires grad"):
        dyn.step(grad, grad, None, H, options=spo.StepOptions(substeps=2), status=torch.zeros(1, dtype=torch.int32))
    with pytest.raises(TypeError, match="substeps=2 is no option"):
        from warp_spo import torch as spo_torch

        spo_torch.custom_op(dyn, "step", dt=H, options=spo.StepOptions(substeps=2))


def test_nothing_is_allocated_and_a_graph_repeats_it(device):
    scene = zoo.fork()
    dyn = spo.Dynamics(scene, 2, device=device)
    dyn.prepare("step", status=True, options=spo.StepOptions(substeps=COUNT))
    q, qd, tau = (wp.array(array, dtype=wp.float32, device=device) for array in zoo.random_state(scene, 2))
    status = wp.empty(2, dtype=int, device=device)
    out = wp.empty_like(q), wp.empty_like(qd)
    with no_warp_allocation():
        dyn.step(q, qd, tau, H, options=spo.StepOptions(substeps=COUNT), status=status, out=out)
    again = wp.empty_like(q), wp.empty_like(qd)
    with wp.ScopedCapture(device) as capture:
        dyn.step(q, qd, tau, H, options=spo.StepOptions(substeps=COUNT), status=status, out=again)
    for array in again:
        array.fill_(np.nan)
    wp.capture_launch(capture.graph)
    for x, y in zip(out, again, strict=True):
        np.testing.assert_array_equal(x.numpy(), y.numpy())


@pytest.mark.slow
def test_substeps_and_controls_in_a_graph_of_torch():
    """Under torch.compile the step is one node; buffers of delays are refused by name."""
    dyn = spo.Dynamics(arm([KINDS["position"][0]]), 2, device="cpu", dtype="float64")
    q, qd, ctrl = (torch.as_tensor(array) for array in states(dyn.scene, 2))
    step = lambda q, qd, ctrl, **more: dyn.step(q, qd, None, H, ctrl=ctrl, **more)  # noqa: E731
    compiled, often = torch.compile(step, backend="eager", fullgraph=True), spo.StepOptions(substeps=COUNT)
    for x, y in zip(compiled(q, qd, ctrl, options=often), step(q, qd, ctrl, options=often), strict=True):
        assert torch.equal(x, y)
    gradients = []
    for call in (compiled, step):
        given = ctrl.clone().requires_grad_(True)
        call(q, qd, given)[1].sum().backward()
        gradients.append(given.grad)
    assert torch.equal(*gradients) and gradients[0].any()
    with pytest.raises(Exception, match="actuator_state is of type ActuatorState"):
        compiled(q, qd, ctrl, actuator_state=dyn.actuator_state(like=q))
