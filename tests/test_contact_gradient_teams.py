"""Gradients of steps with contacts by limbs: every kernel against its trace of the whole tree, and races."""

import contact_gradients
import numpy as np
import pytest
import symbolic
import warp_machine
from contact_cases import quadruped, touching
from test_contact_step import steps
from test_step_teams import driven

import warp_spo as spo
from warp_spo.dynamics import contact_gradients as kernels
from warp_spo.recursions.derivatives.contact import PassGradient, PassSolve, divides

H, WORLDS, PASSES = 5e-3, 4, 2
ROUTINES = {"contact_pass": kernels.PASS, "contact_solve": kernels.SOLVE, "contact_gradient": kernels.GRADIENT}
OPTIONS = ("laws", "wrt", "apart")
WRT = ("q", "qd", "tau", "contact_friction")


def launches(ground, wrt):
    """The scene, and for the last launch of each kernel its name, what it reads, and what the whole tree leaves."""
    scene, ran = quadruped(ground=ground), []
    a = dict(zip(("q", "qd", "tau"), touching(scene, 3, WORLDS), strict=True))
    a = contact_gradients.furnish(scene, a)
    rng = np.random.default_rng(0)
    cotangents = [rng.normal(size=a[name].shape) for name in ("q", "qd")]
    contact_gradients.gradient(scene, a, H, PASSES, cotangents, wrt, ran)
    return scene, {kernel: (known, found) for kernel, known, found in ran}


def assert_right(monkeypatch, ground=None, wrt=WRT, only=tuple(ROUTINES)):
    scene, ran = launches(ground, wrt)
    texts = warp_machine.recorded(monkeypatch)
    dyn = spo.Dynamics(scene, WORLDS, "cpu", "float64", granularity="segment", variable=contact_gradients.VALUES)
    arguments = ("q", "qd", "tau", "dt", "passes")
    laws = kernels._laws(dyn, arguments)
    for kernel in only:
        known, wanted = ran[kernel]
        read = ["q", "qd", "dt", "passes", "number", "row", "qdd_before"]
        read += ["tau"] if kernel == "contact_pass" else ["qdd", "q_cotangent", "qd_cotangent", "cotangent"]
        options = {"laws": laws}
        if kernel == "contact_gradient":
            read += ["cotangent_came", "solved", *(f"{name}_later" for name in wrt)]
            options |= {"wrt": wrt, "apart": True}
        numbers = ("dt", "passes", "number")
        given = {name: float(known[name][0, 0]) if name in numbers else known[name] for name in read}
        shapes = {name: np.shape(array) for name, array in given.items()}
        more = {name: array.shape for name, array in wanted.items() if name != "out"}
        program = dyn.programs.find(ROUTINES[kernel], shapes, wanted["out"].shape, more, **options)
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
    assert_right(monkeypatch)


@pytest.mark.slow
def test_limbs_share_gradients_on_stairs(monkeypatch):
    assert_right(
        monkeypatch, steps(), (*WRT, "ground_heights", "contact_stiffness", "ground_origin", "joint_target_ke")
    )


def test_which_gradients_limbs_share():
    scene = quadruped()
    assert divides(scene, (), ("q", "dt"), ("q", "qd", "ctrl", "contact_friction", "ground_origin"))
    assert not divides(scene, (), ("q", "body_f"), ("q",))
    assert not divides(scene, (), ("q",), ("q", "value"))  # masses
    assert not divides(scene, ("body_gravcomp",), ("q",), ("q",))
    assert not divides(driven(), (), ("q", "ctrl"), ("q",))  # tendons from limb to limb


BUGS = {
    "what a limb hands on": (
        PassGradient,
        "stores",
        'trace.receive("G", piece)[: len(self.passed_on)]',
        "[0.0] * len(self.passed_on)",
    ),
    "what points on the trunk hand on": (PassGradient, "_carry", "if link is not self._under:", "if True:"),
    "a push of a limb": (PassSolve, "stores", "Vector(wrenches[6 * at : 6 * at + 6])", "Vector([0.0] * 6)"),
}


@pytest.mark.slow
@pytest.mark.parametrize("bug", BUGS)
def test_a_planted_bug_is_seen(bug, monkeypatch):
    only = "contact_solve" if bug == "a push of a limb" else "contact_gradient"
    launches_of = launches(None, WRT)
    monkeypatch.setitem(globals(), "launches", lambda *_: launches_of)
    symbolic.plant(monkeypatch, *BUGS[bug])
    with pytest.raises(AssertionError):
        assert_right(monkeypatch, only=(only,))
