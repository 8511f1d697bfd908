"""Products J* y by limbs side by side and by whole trees, against the dense derivatives of another recursion."""

import functools
import itertools

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import laws, symbolic, warp_machine, zoo
from support.granularity_scenes import hand
from support.quick import slow_unless
from support.routines import ROUTINES
from warp_spo.execution import plan
from warp_spo.kernels import straight_line
from warp_spo.recursions.derivatives import power
from warp_spo.recursions.derivatives.power import FromParent, Power
from warp_spo.reference.dense import Dense

WORLDS = 3
TOLERANCE = {"float64": 1e-11, "float32": 2e-5}  # grows with the condition of Mass; measured 3e-14, 3e-6
SCENES = {
    "limbs": lambda: zoo.from_parents([-1, 0, 0, 2, 2], ["free", "ball", "helical", "prismatic", "revolute"], 61),
    "two roots": lambda: zoo.from_parents([-1, -1, 1], ["ball", "planar", "revolute"], 62),
}
WARPS = {"limbs": lambda: SCENES["limbs"](), "fork": zoo.fork, "hand": hand}
CASES = [("limbs", "float64", "tree"), ("limbs", "float64", "segment"), ("limbs", "float32", "segment"),
         ("two roots", "float64", "segment")]  # fmt: skip


@functools.cache
def scene_of(name):
    return SCENES[name]()


def built(name, granularity, dtype="float64", device=None, varied=False):
    """Dynamics and the arrays of a state; ``y`` is the cotangent."""
    scene = zoo.varied(scene_of(name), WORLDS) if varied else scene_of(name)
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype=dtype, granularity=granularity)
    arrays = laws.states(scene, WORLDS, dtype=dtype)
    arrays["y"] = np.ascontiguousarray(arrays["b"][:, :, 0])
    return dyn, arrays


def poisoned(dyn, name):
    width = dyn.scene.coord_count if name == "q" else dyn.scene.dof_count
    return wp.full((WORLDS, width), float("nan"), dtype=dyn.dtype, device=dyn.device)


def mul(J, y):
    """J* y of every world."""
    return np.einsum("wij,wi->wj", J, y)


def dense(scene, a, given=("q", "qd", "qdd")):
    """d tau / d q along tangent coordinates, d tau / d qd, Mass: [3, world, dof, dof]."""
    shape = {"out": (3, scene.dof_count, scene.dof_count)}
    J = symbolic.run(scene, "inverse_dynamics_derivatives", a, given, shape)["out"]
    return np.nan_to_num(J).swapaxes(0, 1)  # what is not stored is zero


@pytest.mark.parametrize("name, dtype, granularity", CASES)
def test_forward_dynamics(name, dtype, granularity, device):
    """Accelerations made on the way, or given; external forces, or none."""
    dyn, a = built(name, granularity, dtype, device)
    on, scene = laws.to_device(dyn, a), scene_of(name)
    for body_f in (None, "body_f") if dtype == "float64" else (None,):
        state = on["q"], on["qd"], on["tau"], on.get(body_f)
        known = dyn.forward_dynamics(*state)
        a["qdd"] = known.numpy().astype(np.float64)
        by_q, by_qd, mass = dense(scene, a, ("q", "qd", "qdd", *([body_f] if body_f else ())))
        weights = np.linalg.solve(mass, a["y"][..., None])[..., 0]
        wanted = {"tangent": -mul(by_q, weights), "qd": -mul(by_qd, weights), "tau": weights}
        for qdd in (None, known):
            out = {key: poisoned(dyn, key) for key in wanted}
            dyn.forward_dynamics_vjp(*state, cotangent=on["y"], qdd=qdd, wrt=tuple(wanted), out=out)
            for key, value in wanted.items():
                assert laws.error(out[key].numpy(), value) <= TOLERANCE[dtype], (key, body_f, qdd is None)
    lines = [line for line in dyn.programs.describe() if "forward_dynamics_vjp" in line]
    assert any("segment" in line for line in lines) == (granularity == "segment")


WRT = (("qd", "q"), ("tau",), ("tau", "tangent"), ("body_f", "q"))


@pytest.mark.parametrize(
    ("wrt", "few"),
    slow_unless(
        [(WRT[0], 0), (WRT[2], 0), (WRT[3], plan.FEW_WORLDS)],
        itertools.product(WRT, [0, plan.FEW_WORLDS]),
    ),
)
def test_what_is_asked_for_by_limbs(wrt, few, device, monkeypatch):
    """Any part of it, in any order, is what a thread for the whole tree gives; values differ between worlds."""
    monkeypatch.setattr(plan, "FEW_WORLDS", few)  # both solutions in two kernels, or in one
    found = []
    for granularity in ("segment", "tree"):
        dyn, a = built("limbs", granularity, device=device, varied=True)
        body_f = a["body_f"] if "body_f" in wrt else None
        given = {"cotangent": a["y"], "wrt": wrt}
        found.append(dyn.forward_dynamics_vjp(a["q"], a["qd"], a["tau"], body_f, **given))
        assert tuple(found[-1]) == wrt
    for key in wrt:
        assert laws.error(found[0][key], found[1][key]) <= TOLERANCE["float64"], key


@pytest.mark.parametrize("granularity", ["tree", "segment"])
def test_inverse_dynamics(granularity, device):
    dyn, a = built("two roots", granularity, device=device)
    on = laws.to_device(dyn, a)
    out = {key: poisoned(dyn, key) for key in ("tangent", "qd", "qdd")}
    dyn.inverse_dynamics_vjp(on["q"], on["qd"], on["qdd"], cotangent=on["y"], wrt=tuple(out), out=out)
    for got, J in zip(out.values(), dense(dyn.scene, a), strict=True):
        assert laws.error(got.numpy(), mul(J, a["y"])) <= TOLERANCE["float64"]


def test_a_world_without_a_solution_stays_alone(device):
    """NaN in one world's state, and a body without inertia at the tip of another's limb."""
    dyn, a = built("limbs", "segment", device=device)
    given = {"cotangent": a["y"], "wrt": ("q", "qd", "tau")}
    good = dyn.forward_dynamics_vjp(a["q"], a["qd"], a["tau"], **given)
    a["q"][1, 0:9] = np.nan
    bad = dyn.forward_dynamics_vjp(a["q"], a["qd"], a["tau"], **given)
    for key, array in good.items():
        np.testing.assert_array_equal(np.delete(bad[key], 1, 0), np.delete(array, 1, 0))
        assert np.isnan(bad[key][1]).any()


# -- warps -------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("name", "staged"),
    slow_unless([("limbs", False), ("fork", True), ("hand", False)], itertools.product(WARPS, [False, True])),
)
def test_warps_meet_at_barriers_alone(name, staged, monkeypatch):
    """The CUDA text of both kernels, warp by warp in either order, with rows and results in shared memory or not."""
    for limit in ("FEW_WORLDS", "LONG_ROWS") if staged else ():
        monkeypatch.setattr(plan, limit, 0)
    monkeypatch.setattr(straight_line, "SHARED_BYTES", 1 << 20)
    texts, scene = warp_machine.recorded(monkeypatch), WARPS[name]()
    dyn = spo.Dynamics(scene, WORLDS, device="cpu", dtype="float64", granularity="segment")
    a, rate, wide = laws.states(scene, WORLDS), (WORLDS, scene.dof_count), (WORLDS, scene.coord_count)
    a["cotangent"] = a["b"][:, :, 0].copy()
    reference = [Dense(scene, q) for q in a["q"]]
    qdd = np.array([reference[w].forward_dynamics(a["qd"][w], a["tau"][w]) for w in range(WORLDS)])
    solved = np.array([np.linalg.solve(reference[w].mass_matrix, a["cotangent"][w]) for w in range(WORLDS)])
    state, find, further = {"q": wide, "qd": rate}, dyn.programs.find, {}
    both = ROUTINES["forward_dynamics_and_solve"]
    program = find(both, state | {"tau": rate, "cotangent": rate}, rate, {"solved": rate})
    assert program.warps > 1 and texts[-1].frame.staged == texts[-1].frame.further_staged == staged
    for backwards in (False, True):
        assert laws.error(warp_machine.run(texts[-1], a, backwards, further), qdd) <= TOLERANCE["float64"]
        assert laws.error(further.pop("solved"), solved) <= TOLERANCE["float64"]
    a |= {"qdd": qdd, "solved": solved}
    by_q, by_qd = (-mul(J, solved) for J in dense(scene, a)[:2])
    state |= {"qdd": rate, "solved": rate}
    program = find(ROUTINES["forward_dynamics_vjp"], state, rate, {"qd_bar": rate}, wrt=("tangent", "qd"))
    assert program.warps > 1
    for backwards in (False, True):
        assert laws.error(warp_machine.run(texts[-1], a, backwards, further), by_q) <= TOLERANCE["float64"]
        assert laws.error(further.pop("qd_bar"), by_qd) <= TOLERANCE["float64"]


# -- planted bugs ------------------------------------------------------------------------------------------------------
BUGS = {
    "what the children say": (
        Power,
        "_pull_to_parent",
        "a + b for a, b in zip(bars, other",
        "a for a, b in zip(bars, other",
    ),
    "how fast points turn": (
        Power,
        "_pull_to_parent",
        "a + b for a, b in zip(bars[:own]",
        "a for a, b in zip(bars[:own]",
    ),
    "the sense of a turn": (Power, "_pull_to_parent", "x[1] * bars[3 * at] - x[0]", "x[1] * bars[3 * at] + x[0]"),
    "lambda and the armature": (Power, "_pull_to_parent", "armature_forces(link, self.qdd)", "[0.0] * len(dofs)"),
    "the Coriolis acceleration": (Power, "_motion_of_link", "2.0 * cross(spin, v_d)", "cross(spin, v_d)"),
    "what is met by the arm": (FromParent, "of", "parent.turning @ pose.l", "parent.turning @ pose.l * 0.0"),
    "omega'": (power, "turning_of", "skew(moving.w) + ", ""),
}


@pytest.mark.parametrize("bug", ["none", *BUGS])
def test_a_planted_bug_is_seen(bug, monkeypatch):
    if bug != "none":
        symbolic.plant(monkeypatch, *BUGS[bug])
    scene = SCENES["limbs"]()
    n, a = scene.dof_count, laws.states(scene, 1)
    a["cotangent"] = np.ascontiguousarray(a["b"][:, :, 0])
    state, wrt = ("q", "qd", "qdd"), ("tangent", "qd", "qdd")
    shapes = {"out": (n,), "qd_bar": (n,), "qdd_bar": (n,)}
    got = symbolic.run(scene, "inverse_dynamics_vjp", a, (*state, "cotangent"), shapes, wrt=wrt)
    pairs = zip(got.values(), dense(scene, a), strict=True)
    worst = max(laws.error(value, mul(J, a["cotangent"])) for value, J in pairs)
    assert worst <= TOLERANCE["float64"] if bug == "none" else worst > 1e-3
