"""Analytic derivatives of the dynamics against Pinocchio's, and against central differences of the dense reference."""

import functools
import itertools

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from benchmarks.table import cases
from support import laws, oracles, symbolic, warp_machine, zoo
from support.allocations import no_warp_allocation
from support.quick import slow_unless
from support.robots import ROBOTS
from support.routines import ROUTINES
from support.segments_of_trees import TREES
from warp_spo.execution.plan import MOST_DOFS
from warp_spo.kernels import straight_line
from warp_spo.recursions.derivatives import inverse_dynamics as dense
from warp_spo.recursions.derivatives import sensitivity
from warp_spo.reference.dense import Dense

STEP = 1e-5
DIFFERENCES = 1e-6  # relative: eps / h + h^2; the bound, measured 4e-9
SAME_NUMBERS = 1e-9  # float64 against Pinocchio; measured 6e-14
FLOAT32 = 2e-5  # grows with the condition of Mass, up to 1e4 here; measured 2e-6
SCENES = ["one_ball", "one_free", "chain_helical", "chain_free", "chain_planar", "fork", "forest", "tree10", "plain"]
LARGE = ["every_d6", "floating_tree", "trees25", "arm"]  # the dense reference takes long
LOADED = ("qd", "qdd", "body_f")
QUICK = ["chain_helical", "chain_free", "forest", "tree10"]


@functools.cache
def scene_of(name):
    return (zoo.SCENES | ROBOTS)[name]()


def without_outer_armature(scene):
    """No armature on ball and free hinges, where it is not of the oracle's basis."""
    turning = np.repeat([h.kind in oracles.TURNING for h in scene.hinges], [h.dof_count for h in scene.hinges])
    return scene.with_values(joint_armature=np.where(turning, 0.0, scene.values["joint_armature"]))


def traced(scene, operation, a, given, shape):
    got = symbolic.run(scene, operation, a, given, {"out": shape})["out"]
    return np.nan_to_num(got)  # what is not stored is zero


def inverse(scene, a, given=("q", "qd", "qdd", "body_f")):
    """(d/dq, d/dqd, Mass) [world, dof, dof], by the trace."""
    shape = 3, scene.dof_count, scene.dof_count
    return traced(scene, "inverse_dynamics_derivatives", a, given, shape).swapaxes(0, 1)


def difference(function, x, directions):
    """[..., direction] of ``function(moved)``; ``x(direction, step)`` moves."""
    return np.stack([(function(x(e, STEP)) - function(x(e, -STEP))) / (2 * STEP) for e in directions], axis=-1)


def by_differences(scene, a, world, inverse_dynamics=True):
    """d/dq, d/dqd of the reference's inverse or forward dynamics in one world."""
    s = {name: array[world] for name, array in a.items()}
    at = functools.partial(Dense, scene, world=world)
    units = np.eye(scene.dof_count)

    def value(dense, qd):
        if inverse_dynamics:
            return dense.inverse_dynamics(qd, s["qdd"], s["body_f"])
        return dense.forward_dynamics(qd, s["tau"], s["body_f"])

    here = at(s["q"])
    by_q = difference(lambda q: value(at(q), s["qd"]), here.integrate, units)
    return by_q, difference(lambda qd: value(here, qd), lambda e, h: s["qd"] + h * e, units)


@functools.cache
def inverse_by_differences(name):
    """As :func:`by_differences`, of a state of the scene ``name``."""
    return by_differences(scene_of(name), laws.states(scene_of(name), 1), 0)


# -- inverse dynamics --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", slow_unless(QUICK, SCENES))
def test_inverse_dynamics_by_central_differences(name):
    scene = scene_of(name)
    a = laws.states(scene, 1)
    wanted = (*inverse_by_differences(name), Dense(scene, a["q"][0]).mass_matrix)
    for ours, right in zip(inverse(scene, a)[:, 0], wanted, strict=True):
        assert laws.error(ours, right) <= DIFFERENCES


@pytest.mark.parametrize("name", slow_unless(QUICK, [*SCENES, *LARGE]))
def test_inverse_dynamics_is_pinocchios(name):
    scene = without_outer_armature(scene_of(name))
    a, oracle = laws.states(scene, 2), oracles.PinocchioModel(scene)
    got = inverse(scene, a, ("q", "qd", "qdd"))
    for w in range(2):
        wanted = oracle.inverse_dynamics_derivatives(a["q"][w], a["qd"][w], a["qdd"][w])
        for ours, theirs in zip(got[:2, w], wanted, strict=True):
            assert laws.error(ours, theirs) <= SAME_NUMBERS


@pytest.mark.parametrize("given", [(), ("qd",), ("qdd",), ("body_f",)])
def test_what_is_not_given_is_zero(given):
    scene = scene_of("forest")
    a = laws.states(scene, 1)
    less = {name: array if name in ("q", *given) else np.zeros_like(array) for name, array in a.items()}
    np.testing.assert_allclose(inverse(scene, a, ("q", *given)), inverse(scene, less), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", slow_unless(QUICK, SCENES))
def test_mass_matrix_derivative_by_central_differences(name):
    scene = scene_of(name)
    a, n = laws.states(scene, 1), scene.dof_count
    got = traced(scene, "mass_matrix_derivative", a, ("q",), (n, n, n))[0]
    here = Dense(scene, a["q"][0])
    wanted = difference(lambda q: Dense(scene, q).mass_matrix, here.integrate, np.eye(n))
    assert laws.error(got, wanted) <= DIFFERENCES


@pytest.mark.parametrize(
    ("name", "given"),
    slow_unless(
        [("fork", LOADED), ("comb", ("qdd",))], itertools.product(["fork", "comb", "forest"], [LOADED, ("qdd",)])
    ),
)
def test_limbs_side_by_side(name, given, monkeypatch):
    """The CUDA text, warp by warp in either order, gives what one thread gives for the whole tree."""
    monkeypatch.setattr(straight_line, "SHARED_BYTES", 1 << 20)
    scene, texts = TREES[name]() if name in TREES else scene_of(name), warp_machine.recorded(monkeypatch)
    n, a = scene.dof_count, laws.states(scene, 3)
    dyn = spo.Dynamics(scene, 3, device="cpu", dtype="float64", granularity="segment")
    shapes = {key: a[key].shape for key in ("q", *given)}
    program = dyn.programs.find(ROUTINES["inverse_dynamics_derivatives"], shapes, (3, 3, n, n))
    assert program.warps > 1
    wanted = inverse(scene, a, ("q", *given)).swapaxes(0, 1)
    for backwards in (False, True):
        got = warp_machine.run(texts[-1], a, backwards).reshape(wanted.shape)
        assert laws.error(got, wanted) <= laws.TOLERANCE["float64"]


def test_mass_matrix_derivative_is_that_of_inverse_dynamics():
    """d(Mass e_j)/dq is d tau/dq at qdd = e_j at rest without gravity."""
    scene = scene_of("tree10").with_values(gravity=np.zeros(3))
    n = scene.dof_count
    a = {name: np.repeat(array, n, axis=0) for name, array in laws.states(scene, 1).items()} | {"qdd": np.eye(n)}
    got = traced(scene, "mass_matrix_derivative", a, ("q",), (n, n, n))[0]
    columns = inverse(scene, a, ("q", "qdd"))[0]  # [j, i, coordinate]
    assert laws.error(got, columns.swapaxes(0, 1)) <= laws.TOLERANCE["float64"]


# -- laws --------------------------------------------------------------------------------------------------------------
def test_zeros_are_where_the_tree_has_no_path():
    """Two dofs meet only if one's body carries the other's; a floating base's position and velocity change nothing."""
    scene = scene_of("fork").with_values(gravity=np.zeros(3))
    n, a = scene.dof_count, laws.states(scene, 1)
    trace = symbolic.run(scene, "inverse_dynamics_derivatives", a, ("q", "qd", "qdd"), {"out": (3, n, n)})["out"][0]
    mass = Dense(scene, a["q"][0]).mass_matrix
    for block in trace:
        np.testing.assert_array_equal(np.isnan(block), mass == 0.0)
    root = [hinge.kind for hinge in scene.hinges].index("free")
    linear = slice(scene.qd_start[root], scene.qd_start[root] + 3)
    np.testing.assert_array_equal(np.nan_to_num(trace[:2, :, linear]), 0.0)


def test_velocity_derivative_at_the_bias_is_the_coriolis_matrix():
    """tau - Mass qdd is quadratic in qd without gravity: half of d tau/d qd times qd is the bias."""
    scene = scene_of("tree10").with_values(gravity=np.zeros(3))
    a = laws.states(scene, 1)
    by_qd = inverse(scene, a, ("q", "qd"))[1, 0]
    assert laws.error(0.5 * by_qd @ a["qd"][0], Dense(scene, a["q"][0]).bias_force(a["qd"][0])) <= 1e-12


def test_gravity_has_a_potential():
    """At rest without acceleration d tau/d q is the Hessian of the potential: symmetric for screws."""
    scene = scene_of("every_d6")
    hessian = inverse(scene, laws.states(scene, 1), ("q",))[0, 0]
    assert laws.error(hessian, hessian.T) <= 1e-12


# -- as users call them ------------------------------------------------------------------------------------------------
WORLDS = 11  # more than a tile


def call(dyn, name, on, **more):
    third = "qdd" if name.startswith("inverse") else "tau"
    return getattr(dyn, name)(on["q"], on["qd"], on[third], on["body_f"], **more)


def numbers(results):
    return np.array([np.asarray(r.numpy(), np.float64) for r in results])


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_kernels(dtype, device):
    """Every value differs in every world; against differences; written entirely, no allocation, NaN stays at home."""
    scene = zoo.varied(zoo.fork(), WORLDS)
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype=dtype)
    a = laws.states(scene, WORLDS, dtype=dtype)
    on, spoiled = laws.to_device(dyn, a), {name: array.copy() for name, array in a.items()}
    spoiled["q"][4] = np.nan
    spoiled = laws.to_device(dyn, spoiled)
    tolerance = FLOAT32 if dtype == "float32" else DIFFERENCES
    for name in ("inverse_dynamics_derivatives", "forward_dynamics_derivatives"):
        results = call(dyn, name, on)
        first = numbers(results)
        assert results._fields == ("q", "qd", "qdd" if name.startswith("inverse") else "tau")
        for world in (0, 10):
            mass = Dense(scene, a["q"][world], world=world).mass_matrix
            last = mass if name.startswith("inverse") else np.linalg.inv(mass)
            wanted = (*by_differences(scene, a, world, name.startswith("inverse")), last)
            for got, right in zip(first[:, world], wanted, strict=True):
                assert laws.error(got, right) <= tolerance, (name, world)
        out = [wp.full(results[0].shape, float("nan"), dtype=dyn.dtype, device=device) for _ in range(3)]
        with no_warp_allocation():
            again = call(dyn, name, on, out=out)
        assert all(x is y for x, y in zip(again, out, strict=True))
        np.testing.assert_array_equal(numbers(out), first)
        broken = numbers(call(dyn, name, spoiled))
        others = np.arange(WORLDS) != 4
        np.testing.assert_array_equal(broken[:, others], first[:, others])
        assert np.isnan(broken[:, 4]).any(axis=(1, 2)).all()
    result = dyn.mass_matrix_derivative(on["q"])
    out = wp.full(result.shape, float("nan"), dtype=dyn.dtype, device=device)
    dyn.mass_matrix_derivative(on["q"], out=out)
    np.testing.assert_array_equal(out.numpy(), result.numpy())
    here = Dense(scene, a["q"][9], world=9)
    wanted = difference(lambda q: Dense(scene, q, world=9).mass_matrix, here.integrate, np.eye(scene.dof_count))
    assert laws.error(result.numpy()[9], wanted) <= tolerance


def test_forward_dynamics_is_pinocchios(device):
    scene = without_outer_armature(scene_of("forest"))
    dyn, oracle = spo.Dynamics(scene, 2, device=device, dtype="float64"), oracles.PinocchioModel(scene)
    a = laws.states(scene, 2)
    got = dyn.forward_dynamics_derivatives(a["q"], a["qd"], a["tau"])
    for w in range(2):
        wanted = oracle.forward_dynamics_derivatives(a["q"][w], a["qd"][w], a["tau"][w])
        for ours, theirs in zip((got.q[w], got.qd[w]), wanted, strict=True):
            assert laws.error(ours, theirs) <= SAME_NUMBERS


@pytest.mark.parametrize("name", ["forest", "tree10"])
def test_forward_dynamics_by_minus_the_inverse(name):
    """The traces, evaluated without compiling a kernel, against Pinocchio's own recursion, on more scenes."""
    scene = without_outer_armature(scene_of(name))
    a, oracle = laws.states(scene, 2), oracles.PinocchioModel(scene)
    for w in range(2):
        a["qdd"][w] = oracle.forward_dynamics(a["q"][w], a["qd"][w], a["tau"][w])
    got = inverse(scene, a, ("q", "qd", "qdd"))
    for w in range(2):
        wanted = oracle.forward_dynamics_derivatives(a["q"][w], a["qd"][w], a["tau"][w])
        for ours, theirs in zip(got[:2, w], wanted, strict=True):
            assert laws.error(-np.linalg.solve(got[2, w], ours), theirs) <= SAME_NUMBERS


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_products(dtype, device):
    """J* y and J x against the dense J; written entirely, no allocation, NaN stays at home."""
    scene = zoo.varied(zoo.fork(), WORLDS)
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype=dtype)
    a = laws.states(scene, WORLDS, dtype=dtype)
    x = [a["b"][..., i].copy() for i in range(3)]
    y = a["qdd"] - a["tau"]
    tolerance = 1e-11 if dtype == "float64" else FLOAT32
    on = laws.to_device(dyn, a | {"y": y} | {f"x{i}": rate for i, rate in enumerate(x)})
    for name, third in (("inverse_dynamics", "qdd"), ("forward_dynamics", "tau")):
        J = numbers(call(dyn, f"{name}_derivatives", on))
        state = on["q"], on["qd"], on[third], on["body_f"]
        wrt = ("tangent", "qd", third)
        vjp = getattr(dyn, f"{name}_vjp")
        got = vjp(*state, cotangent=on["y"], wrt=wrt)
        for block, key in zip(J, wrt, strict=True):
            assert laws.error(got[key].numpy(), np.einsum("wij,wi->wj", block, y)) <= tolerance, (name, key)
        out = {key: wp.full(got[key].shape, float("nan"), dtype=dyn.dtype, device=device) for key in wrt}
        with no_warp_allocation():
            assert vjp(*state, cotangent=on["y"], wrt=wrt, out=out)["qd"] is out["qd"]
        for key in wrt:
            np.testing.assert_array_equal(out[key].numpy(), got[key].numpy())
        spoiled = a["q"].copy()
        spoiled[3] = np.nan
        bad = vjp(spoiled, *(v.numpy() for v in state[1:]), cotangent=y, wrt=wrt)
        for key in wrt:
            np.testing.assert_array_equal(np.delete(bad[key], 3, 0), np.delete(got[key].numpy(), 3, 0))
            assert np.isnan(bad[key][3]).any()
        rates = {"dq": on["x0"], "dqd": on["x1"], f"d{third}": on["x2"]}
        moved = getattr(dyn, f"{name}_jvp")(*state, **rates).numpy()
        assert laws.error(moved, sum(np.einsum("wij,wj->wi", J[i], x[i]) for i in range(3))) <= tolerance
    with pytest.raises(ValueError, match=r"dbody_f is given and body_f is None; expected both"):
        dyn.forward_dynamics_jvp(on["q"], dbody_f=on["body_f"])


def test_far_from_the_origin_and_fast():
    """10 km away and at 1 km/s, float32 keeps its digits: neither enters, to the bit."""
    scene = scene_of("fork")
    n, a = scene.dof_count, laws.states(scene, 1, dtype="float32")
    root = [hinge.kind for hinge in scene.hinges].index("free")
    first, rate = scene.q_start[root], scene.qd_start[root]
    far = {name: array.copy() for name, array in a.items()}
    far["q"][:, first : first + 3] = 8192.0
    far["qd"][:, rate : rate + 3] = 1024.0
    given, shapes = ("q", "qd", "qdd"), {"out": (3, n, n)}
    results = [
        symbolic.run(scene, "inverse_dynamics_derivatives", x, given, shapes, "float32")["out"] for x in (a, far)
    ]
    np.testing.assert_array_equal(*results)


def test_no_world_too_many_dofs_and_none(device):
    chain = spo.Dynamics(zoo.chain(MOST_DOFS + 1), 1, device=device)
    q = np.zeros((1, MOST_DOFS + 1))
    for name in ("inverse_dynamics_derivatives", "forward_dynamics_derivatives", "mass_matrix_derivative"):
        with pytest.raises(spo.UnsupportedError, match=f"{name}: a scene of {MOST_DOFS + 1} dof"):
            getattr(chain, name)(q)
    still = spo.Dynamics(spo.Scene([spo.Body(1.0)], [spo.Hinge("fixed", -1, 0)]), 2, device=device)
    nothing = np.zeros((2, 0))
    assert still.forward_dynamics_derivatives(nothing).tau.shape == (2, 0, 0)
    assert still.inverse_dynamics_derivatives(nothing).q.shape == (2, 0, 0)
    assert still.mass_matrix_derivative(nothing).shape == (2, 0, 0, 0)
    with pytest.raises(TypeError, match=r"expected three arrays or None, \(q, qd, tau\)"):
        still.forward_dynamics_derivatives(nothing, out=nothing)


# -- operations --------------------------------------------------------------------------------------------------------
PINNED = {"arm7": (2522, 1456, 2502), "quadruped": (10155, 7857, 8770), "humanoid": (22247, 26298, 15145)}
"""Scene of the benchmarks -> operations of a world: derivatives of inverse dynamics, of Mass; J* y of forward dynamics.

The last, with the accelerations that it takes, is 1.9 to 2.3 times forward dynamics.
"""


@pytest.mark.parametrize("name", PINNED)
def test_operations_are_no_more_than_they_were(name):
    scene = cases.SCENES[name]()
    find = spo.Dynamics(scene, 1, device="cpu", granularity="tree").programs.find
    q, rate, n = (1, scene.coord_count), (1, scene.dof_count), scene.dof_count
    state = {"q": q, "qd": rate, "qdd": rate}
    pulled = {"q": q, "qd": rate, "tau": rate, "cotangent": rate}
    bars = {"qd_bar": rate, "tau_bar": rate}
    found = (
        find(ROUTINES["inverse_dynamics_derivatives"], state, (1, 3, n, n)),
        find(ROUTINES["mass_matrix_derivative"], {"q": q}, (1, n, n, n)),
        find(ROUTINES["forward_dynamics_vjp"], pulled, q, bars, wrt=("q", "qd", "tau")),
    )
    counts = tuple(program.operations for program in found)
    assert all(a <= b for a, b in zip(counts, PINNED[name], strict=True)), counts
    assert sum(counts) >= 0.97 * sum(PINNED[name]), f"fewer than pinned: write down {counts}"


# -- planted bugs ------------------------------------------------------------------------------------------------------
BUGS = {
    "sign of the Coriolis force": (sensitivity.CarriedSums, "force", "+ cross(s.spin, self", "- cross(s.spin, self"),
    "S' of a ball": (sensitivity, "of_coordinates", "motion.spin, own", "spin_c, own"),
    "the whirl": (sensitivity, "of_coordinates", "skew(w) + (", "skew(w) - ("),
    "the joint's own slide": (sensitivity, "of_coordinates", " + cross(change, slide)", ""),
    "the parent's spin in a rate": (sensitivity, "of_rates", "spin_c + motion.spin", "motion.spin"),
    "drift of the origins": (sensitivity.SensitivityAdjoint, "to_parent", " + cross(drift, v) * 2.0", ""),
    "moments of a load": (sensitivity, "to_parent", " + _lever(l, pull)", ""),
    "a row's pull": (sensitivity.CarriedSums, "row", " + cross(self.pull, v)", ""),
    "the force elsewhere": (dense, "_entries", " + cross(s.shift, force[1])", ""),
    "the force turned": (dense, "_entries", "n + cross(s.turn, force[0])", "n"),
}


@pytest.mark.parametrize("bug", BUGS)
def test_a_planted_bug_is_seen(bug, monkeypatch):
    name = "chain_helical" if "slide" in bug else "forest" if "sign" in bug else "chain_free"
    scene, wanted = scene_of(name), inverse_by_differences(name)
    a = laws.states(scene, 1)
    symbolic.plant(monkeypatch, *BUGS[bug])
    got = inverse(scene, a)
    assert max(laws.error(got[i, 0], wanted[i]) for i in range(2)) > 1e-3


def test_a_repeated_or_captured_call_waits_for_its_second_stream(device):
    """The inverse mass matrix is computed beside the rest, and the product needs it: no call reads an older one."""
    scene, worlds = zoo.branched(0), 64
    dyn = spo.Dynamics(scene, worlds, device)
    states = [zoo.random_state(scene, worlds, seed) for seed in range(4)]
    given = [[wp.array(x, dtype=dyn.dtype, device=device) for x in (s.q, s.qd, 3.0 * s.qd)] for s in states]
    expected = [
        [x.numpy() for x in spo.Dynamics(scene, worlds, device).forward_dynamics_derivatives(*g)] for g in given
    ]
    shape = worlds, scene.dof_count, scene.dof_count
    out = tuple(wp.full(shape, np.nan, dtype=dyn.dtype, device=device) for _ in range(3))
    for arrays, wanted in zip(given, expected, strict=True):  # the second call is recorded, the third repeats it
        dyn.forward_dynamics_derivatives(*arrays, out=out)
        assert all(np.array_equal(x.numpy(), y) for x, y in zip(out, wanted, strict=True))
    if not device.is_cuda:
        return
    with wp.ScopedCapture(device) as capture:
        for _ in range(3):
            dyn.forward_dynamics_derivatives(*given[0], out=out)
    for _ in range(3):
        wp.copy(given[0][0], given[1][0])
        wp.copy(given[0][1], given[1][1])
        wp.copy(given[0][2], given[1][2])
        wp.capture_launch(capture.graph)
    assert all(np.array_equal(x.numpy(), y) for x, y in zip(out, expected[1], strict=True))
