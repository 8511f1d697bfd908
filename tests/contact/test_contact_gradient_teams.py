"""Gradients of steps with contacts by limbs: every kernel against its trace of the whole tree, and races."""

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import contact_cases, contact_gradients, symbolic, warp_machine
from support.actuated import driven_hand
from support.contact_cases import quadruped, touching, waisted
from support.contact_steps import steps
from warp_spo.dynamics.operation import derivative_of
from warp_spo.dynamics.stepping import contact_gradients as kernels
from warp_spo.dynamics.stepping.step import STEP
from warp_spo.recursions.contact.velocity_kicks import KICK, PATH, START
from warp_spo.recursions.derivatives.contact import INERTIA, PassGradient, PassSolve, divides
from warp_spo.recursions.derivatives.contact_pass import weighed_segments
from warp_spo.reference.dense import Dense

H, WORLDS, PASSES = 5e-3, 4, 2
ROUTINES = {"contact_pass": kernels.PASS, "contact_solve": kernels.SOLVE, "contact_gradient": kernels.GRADIENT}
OPTIONS = ("laws", "wrt", "apart")
WRT = ("q", "qd", "tau", "contact_friction")


def launches(scene, wrt, kicked):
    """For the last launch of each kernel its name, what it reads, and what the whole tree leaves.

    ``kicked``: velocity terms are kicks, so that what joints feel depends on what they carry.
    """
    ran, rng = [], np.random.default_rng(0)
    a = dict(zip(("q", "qd", "tau"), touching(scene, 3, WORLDS), strict=True))
    if kicked:
        starts = np.array([Dense(scene, q).integrate(-qd, 0.5 * H) for q, qd in zip(a["q"], a["qd"], strict=True)])
        a |= {START: starts, KICK: 0.05 * rng.normal(size=a["qd"].shape), PATH: a["qd"]}
    a = contact_gradients.furnish(scene, a)
    cotangents = [rng.normal(size=a[name].shape) for name in ("q", "qd")]
    contact_gradients.gradient(scene, a, H, PASSES, cotangents, wrt, ran)
    return {kernel: (known, found) for kernel, known, found in ran}


def assert_right(monkeypatch, scene, wrt=WRT, only=tuple(ROUTINES), kicked=False):
    ran = launches(scene, wrt, kicked)
    texts = warp_machine.recorded(monkeypatch)
    dyn = spo.Dynamics(scene, WORLDS, "cpu", "float64", granularity="segment", variable=contact_gradients.VALUES)
    terms = (START, KICK, PATH) if kicked else ()
    laws, weighed = kernels._laws(dyn, ("q", "qd", "tau", "dt", "passes", *terms))
    for kernel in only:
        known, wanted = ran[kernel]
        read = ["q", "qd", "dt", "passes", "number", "row", "qdd_before", *terms]
        read += ["tau"] if kernel == "contact_pass" else ["qdd", "q_cotangent", "qd_cotangent", "cotangent"]
        options = {"laws": laws}
        if kernel == "contact_gradient":
            read += ["cotangent_came", "solved", *(f"{name}_later" for name in wrt), *[INERTIA] * bool(weighed)]
            options |= {"wrt": wrt, "apart": True}
        numbers = ("dt", "passes", "number")
        given = {name: float(known[name][0, 0]) if name in numbers else known[name] for name in read}
        shapes = {name: np.shape(array) for name, array in given.items()}
        more = {name: array.shape for name, array in wanted.items() if name != "out"}
        routine = kernels.WEIGHED.get(ROUTINES[kernel], ROUTINES[kernel]) if weighed else ROUTINES[kernel]
        program = dyn.programs.find(routine, shapes, wanted["out"].shape, more, **options)
        assert program.warps > 1
        fields = {name: known[name].reshape(WORLDS, -1).T for name in contact_gradients.VALUES if name in known}
        for backwards in (False, True):
            got = {"out": warp_machine.run(texts[-1], given | fields, backwards, further := {})} | further
            assert set(got) == set(wanted)
            for name, array in got.items():
                right = wanted[name].reshape(WORLDS, -1)
                tolerance = 1e-9 * max(1.0, np.nanmax(abs(right)))
                np.testing.assert_allclose(array, right, atol=tolerance, err_msg=f"{kernel} {name}")


@pytest.mark.slow
def test_limbs_share_gradients(monkeypatch):
    assert_right(monkeypatch, quadruped())


@pytest.mark.slow
@pytest.mark.parametrize("scene", [quadruped(contact_cases.EFFORT), waisted()], ids=["quadruped", "waisted"])
def test_limbs_share_gradients_where_velocity_terms_are_kicks(monkeypatch, scene):
    """The waist and the arm of the second scene carry limbs, and feel their inertia."""
    trace = contact_gradients.trace_of(scene, ("q", "qd", "tau", "dt", "passes", START, KICK, PATH))
    assert len(weighed_segments(trace)) == (0 if scene.body_count == 13 else 2)
    assert_right(monkeypatch, scene, (*WRT, START, KICK, PATH, "joint_target_ke"), kicked=True)


@pytest.mark.slow
def test_limbs_share_gradients_on_stairs(monkeypatch):
    assert_right(
        monkeypatch,
        quadruped(ground=steps()),
        (*WRT, "ground_heights", "contact_stiffness", "ground_origin", "joint_target_ke"),
    )


@pytest.mark.slow
@pytest.mark.parametrize("passes", [3, 4])
def test_limbs_of_a_gpu_and_a_thread_of_a_cpu_agree(passes, device):
    if device.is_cpu:
        pytest.skip("limbs have GPU threads of their own")
    scene, worlds, found = waisted(), 64, []
    a = dict(zip(("q", "qd", "tau"), touching(scene, 3, worlds), strict=True)) | {"dt": H, "passes": passes}
    rng = np.random.default_rng(0)
    a |= {f"{name}_cotangent": rng.normal(size=a[name].shape) for name in ("q", "qd")}
    for on, count in (("cpu", worlds), (device, worlds), (device, 33)):
        dyn = spo.Dynamics(scene, count, on, "float64", variable=("contact_friction",))
        given = {n: wp.array(x[:count], dtype=wp.float64, device=on) if np.ndim(x) else x for n, x in a.items()}
        given["qdd"] = wp.zeros_like(given["qd"])
        more = dict(report=spo.StepReport(qdd=given["qdd"]), options=spo.StepOptions(passes=passes))
        dyn.step(given["q"], given["qd"], given["tau"], H, **more)
        outs = [wp.full(dyn._gradients.shape_of(STEP, n), np.nan, dtype=wp.float64, device=on) for n in WRT]
        dyn._gradients.launch(derivative_of(STEP), WRT, outs, given)
        found.append([out.numpy() for out in outs])
    assert dyn.programs.warps(kernels.WEIGHED[kernels.GRADIENT] if passes == 4 else kernels.GRADIENT) > 1
    for name, wanted, mine, few in zip(WRT, *found, strict=True):
        np.testing.assert_allclose(mine, wanted, atol=1e-11 * abs(wanted).max(), err_msg=name)
        assert (few == mine[:33]).all(), name


def test_which_gradients_limbs_share():
    scene = quadruped()
    assert divides(scene, (), ("q", "dt"), ("q", "qd", "ctrl", "contact_friction", "ground_origin"))
    assert not divides(scene, (), ("q", "body_f"), ("q",))
    assert not divides(scene, (), ("q",), ("q", "value"))  # masses
    assert not divides(scene, ("body_gravcomp",), ("q",), ("q",))
    assert not divides(driven_hand(), (), ("q", "ctrl"), ("q",))  # tendons from limb to limb


BUGS = {
    "what a limb hands on": (
        PassGradient,
        "stores",
        'trace.exchange.receive("G", segment)[: len(self.passed_on)]',
        "[0.0] * len(self.passed_on)",
    ),
    "what points on the trunk hand on": (PassGradient, "_carry", "if link is not self._under:", "if True:"),
    "how inertias count": (
        PassSolve,
        "_tell",
        'exchange.send("Q", segment, gradients)',
        'exchange.send("Q", segment, [0.0] * len(gradients))',
    ),
    "how inertias count in memory": (
        PassGradient,
        "stores",
        "[trace.graph.input(INERTIA, first + i) for i in range(len(packed))]",
        "[0.0] * len(packed)",
    ),
    "a push of a limb": (PassSolve, "stores", "Vector(wrenches[6 * at : 6 * at + 6])", "Vector([0.0] * 6)"),
}


@pytest.mark.slow
@pytest.mark.parametrize("bug", BUGS)
def test_a_planted_bug_is_seen(bug, monkeypatch):
    only = "contact_solve" if bug in ("a push of a limb", "how inertias count") else "contact_gradient"
    kicked = "inertias" in bug
    scene = waisted() if kicked else quadruped()
    launches_of = launches(scene, WRT, kicked)
    monkeypatch.setitem(globals(), "launches", lambda *_: launches_of)
    symbolic.plant(monkeypatch, *BUGS[bug])
    with pytest.raises(AssertionError):
        assert_right(monkeypatch, scene, only=(only,), kicked=kicked)
