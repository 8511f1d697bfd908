"""Options and reports of a step: what they hold, what a step makes of them, and calls that are written otherwise."""

import copy
import pickle

import numpy as np
import pytest
import torch
import warp as wp

import warp_spo as spo
from support import contact_cases
from support.step_calls import bundled
from warp_spo.dynamics.stepping.options import NAMES
from warp_spo.dynamics.stepping.step import STEP

WORLDS, H = 3, 1e-3


@pytest.fixture(scope="module")
def case(device):
    dyn = spo.Dynamics(contact_cases.box(), WORLDS, device, "float64")
    q = np.tile([0.0, 0.0, 0.09, 0.0, 0.0, 0.0, 1.0], (WORLDS, 1))
    return dyn, q, np.full((WORLDS, 6), 0.1)


def test_names_are_those_of_the_arrays_that_a_step_writes():
    written = [one.name for one in STEP.arrays if one.written]
    assert sorted(written) == sorted((*NAMES, "status"))


@pytest.mark.parametrize("kind", ["numpy", "torch", "warp"])
def test_reports_have_shapes_and_kinds(case, kind):
    dyn, q, _ = case
    where = wp.device_to_torch(dyn.device)
    like = {"numpy": q, "torch": torch.as_tensor(q, device=where), "warp": None}[kind]
    report = dyn.step_report(*NAMES, like=like)
    points = dyn.scene.contact_count
    shapes = [(6,), (1, 7), (1, 6), (points, 3), (points,), (points,), (3,), (points, 3)]
    assert tuple(report) == NAMES and len(report) == len(shapes)
    for name, shape in zip(NAMES, shapes, strict=True):
        array = report[name]
        assert array is getattr(report, name) and tuple(array.shape) == (WORLDS, *shape)
        assert isinstance(array, {"numpy": np.ndarray, "torch": torch.Tensor, "warp": wp.array}[kind])
        assert not (array.numpy() if kind == "warp" else np.asarray(array.tolist())).any()
    assert len(dyn.step_report()) == 0
    assert repr(dyn.step_report("qdd", "poses")) == "StepReport(qdd, poses)"


def test_a_step_fills_what_it_is_given(case):
    """The arrays of a report, whoever made them; steps without one are the same."""
    dyn, q, qd = case
    made, own = dyn.step_report("contact_f", "qdd", like=q), spo.StepReport(qdd=np.zeros((WORLDS, 6)), poses=None)
    assert tuple(own) == ("qdd",)
    for report in (made, own):
        after = dyn.step(q, qd, dt=H, report=report)
        np.testing.assert_allclose(qd + H * report.qdd, after[1], atol=1e-12)
        for mine, theirs in zip(after, dyn.step(q, qd, None, H), strict=True):
            np.testing.assert_allclose(mine, theirs, atol=1e-12)
    assert made["contact_f"].any()


def test_options_that_are_defaults_are_not_passed(case):
    """They are equal to a call without, a recorded one, too."""
    dyn, q, qd = case
    q, qd = (torch.as_tensor(x, device=wp.device_to_torch(dyn.device)) for x in (q, qd))
    dyn._replays.forget()
    for options in ({}, {"options": spo.StepOptions()}, {"options": spo.StepOptions("semi_implicit", 1, None)}):
        dyn.step(q, qd, dt=H, report=None, **options)
    assert [len(kind.plans) for kind in dyn._replays._kinds.values()] == [1]


@pytest.mark.parametrize("kind", ["torch", "warp"])
def test_calls_with_bundles_are_repeated(case, kind, monkeypatch):
    """Other objects with equal options, and the same report, are a call of the same kind."""
    dyn, q, qd = case
    wanted = dyn.step(q, qd, dt=H, options=spo.StepOptions(substeps=2, passes=2), report=(exact := dyn.step_report(
        "contact_f", "poses", like=q)))  # fmt: skip
    if kind == "torch":
        q, qd = (torch.as_tensor(x, device=wp.device_to_torch(dyn.device)) for x in (q, qd))
    else:
        q, qd = (wp.array(x, dtype=dyn.dtype, device=dyn.device) for x in (q, qd))
    report = dyn.step_report("contact_f", "poses", like=q)
    for _ in range(2):
        dyn.step(q, qd, dt=H, options=spo.StepOptions(substeps=2, passes=2), report=report)
    for array in report.values():
        array.fill_(float("nan"))
    monkeypatch.setattr(type(dyn._replays), "run", lambda *_: pytest.fail("the step was not repeated"))
    again = spo.StepReport(**report)
    found = dyn.step(q, qd, dt=H, options=spo.StepOptions(substeps=2, passes=2), report=again)
    for mine, theirs in zip((*found, *report.values()), (*wanted, *exact.values()), strict=True):
        np.testing.assert_array_equal(mine.numpy() if kind == "warp" else mine.cpu().numpy(), theirs)


def test_options_compare_by_value():
    one, other = spo.StepOptions(substeps=4), spo.StepOptions(substeps=4)
    assert one == other and hash(one) == hash(other) and one != spo.StepOptions()
    assert pickle.loads(pickle.dumps(one)) == one
    report = copy.deepcopy(spo.StepReport(qdd=np.ones(3)))
    assert report.qdd.all() and report == report and report != copy.deepcopy(report)


MISTAKES = {
    "an option by itself": (
        dict(substeps=2),
        r"substeps= is no argument; expected options=StepOptions\(substeps=...\)",
    ),
    "a report by itself": (dict(contact_f=None), r"contact_f= .*; expected report=dyn.step_report\('contact_f'\)"),
    "a misspelled name": (dict(targetq=None), r"targetq= is no argument; expected dyn.step\(q, qd, tau, dt, body_f=,"),
    "no options": (dict(options={"substeps": 2}), r"options is \{'substeps': 2\}; expected a StepOptions"),
    "no report": (dict(report={}), "report is of type dict; expected a StepReport"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_calls_that_are_written_otherwise(case, mistake):
    (dyn, q, qd), (given, message) = case, MISTAKES[mistake]
    with pytest.raises(TypeError, match="Dynamics.step: " + message):
        dyn.step(q, qd, None, H, **given)


def test_mistakes_have_names(case):
    dyn, q, qd = case
    with pytest.raises(
        TypeError, match=r"Dynamics.step: 5 arguments by position; expected 4 at most, as in dyn.step\("
    ):
        dyn.step(q, qd, None, H, None)
    with pytest.raises(TypeError, match=r"Dynamics.step: dt is missing; expected a number of seconds"):
        dyn.step(q, qd)
    with pytest.raises(TypeError, match=r"step\(\) missing 1 required positional argument: 'qd'"):
        dyn.step(q, dt=H)
    with pytest.raises(ValueError, match="StepReport: there is no report 'force'; expected some of qdd, poses"):
        spo.StepReport(force=q)
    with pytest.raises(ValueError, match=r"Dynamics.step_report: there is no report 'status'"):
        dyn.step_report("status")
    with pytest.raises(AttributeError, match=r"StepReport has no 'poses'; it has qdd; ask for dyn.step_report"):
        _ = dyn.step_report("qdd").poses
    with pytest.raises(KeyError):
        dyn.step_report("qdd")["poses"]


def test_prepare_takes_options_and_names(case):
    """The kernels of a step that is prepared so are those that it launches."""
    dyn = spo.Dynamics(case[0].scene, WORLDS, "cpu", "float64")
    q, qd = case[1:]
    given = dict(options=spo.StepOptions(passes=2), status=True)
    dyn.prepare("step", report=("contact_f", "poses"), **given)
    dyn.prepare("step", "body_poses", ("step", {"report": "qdd"}))
    before = len(dyn.programs.describe())
    report = dyn.step_report("contact_f", "poses", like=q)
    dyn.step(q, qd, 0.0 * qd, H, options=given["options"], status=np.zeros(WORLDS, np.int32), report=report)
    dyn.step(q, qd, 0.0 * qd, H, report=dyn.step_report("qdd", like=q))
    assert len(dyn.programs.describe()) == before
    with pytest.raises(TypeError, match=r"Dynamics.prepare: passes= .*; expected options=StepOptions\(passes=...\)"):
        dyn.prepare("step", passes=2)
    with pytest.raises(TypeError, match=r'Dynamics.prepare: qdd= is no argument; expected report=\("qdd",\)'):
        dyn.prepare("step", qdd=True)
    with pytest.raises(ValueError, match=r"Dynamics.prepare: report names 'force'; expected some of qdd, poses"):
        dyn.prepare("step", report="force")
    with pytest.raises(ValueError, match="step_vjp has no option options"):
        dyn.prepare("step_vjp", options=spo.StepOptions())


def test_functions_of_other_libraries_take_options(case):
    from warp_spo import torch as spo_torch

    dyn, q, qd = spo.Dynamics(case[0].scene, WORLDS, "cpu", "float64"), *map(torch.as_tensor, case[1:])
    options = spo.StepOptions(passes=2)
    wanted = dyn.step(q, qd, dt=H, options=options)
    module = spo_torch.Module(
        spo.Dynamics(dyn.scene, WORLDS, "cpu", "float64", variable=("body_mass",)), ("body_mass",)
    )
    for found in (
        spo_torch.custom_op(dyn, "step", dt=H, options=options)(q, qd),
        module.step(q, qd, dt=H, options=options),
    ):
        for mine, theirs in zip(found, wanted, strict=True):
            torch.testing.assert_close(mine.detach(), theirs, rtol=0.0, atol=1e-12)
    with pytest.raises(TypeError, match=r"custom_op\('step'\): passes= is no argument; expected options=StepOptions"):
        spo_torch.custom_op(dyn, "step", dt=H, passes=2)
    with pytest.raises(TypeError, match=r"report=StepReport\(\) is no option; expected dt=, options="):
        spo_torch.custom_op(dyn, "step", dt=H, report=spo.StepReport())
    pytest.importorskip("jax")
    from warp_spo import jax as spo_jax

    with pytest.raises(
        TypeError, match=r"warp_spo.jax.function\('step'\): substeps= is no argument; expected options="
    ):
        spo_jax.function(dyn, "step", dt=H, substeps=2)
    with pytest.raises(TypeError, match="report= is no option; expected dt=, options="):
        spo_jax.function(dyn, "step", dt=H, report=spo.StepReport())


def test_a_graph_of_torch_takes_options_and_reports(case):
    """One node, as the call outside; objects that are made inside, too."""
    dyn, q, qd = spo.Dynamics(case[0].scene, WORLDS, "cpu", "float64"), *map(torch.as_tensor, case[1:])

    def step(q, qd, report):
        return dyn.step(q, qd, dt=H, options=spo.StepOptions(substeps=2), report=report)

    compiled = torch.compile(step, backend="eager", fullgraph=True)
    reports = [dyn.step_report("contact_f", "qdd", like=q) for _ in range(2)]
    for mine, theirs in zip(
        *(call(q, qd, one) for call, one in zip((compiled, step), reports, strict=True)), strict=True
    ):
        assert torch.equal(mine, theirs)
    for name, array in reports[0].items():
        assert torch.equal(array, reports[1][name]) and array.any()


def test_the_helper_of_tests():
    given = bundled(substeps=2, qdd=1, status=3)
    assert given["options"] == spo.StepOptions(substeps=2) and given["report"].qdd == 1 and given["status"] == 3
