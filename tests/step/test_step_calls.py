"""Steps as users call them: outputs, status, values that change, mistakes; accelerations and reactions of bodies."""

import dataclasses
import warnings

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import laws, symbolic, zoo
from support.allocations import no_warp_allocation
from support.step_calls import bundled
from support.step_scenes import FORCES, H, furnished, slider, states
from warp_spo.errors import UnsupportedError
from warp_spo.kernels import native, pass_loops
from warp_spo.reference.dense import Dense, rotation


def test_in_place_and_without_allocation(device):
    scene, worlds = furnished(zoo.fork()), 3
    dyn = spo.Dynamics(scene, worlds, device=device)
    on = laws.to_device(dyn, states(scene, worlds, "float32"))
    dyn.prepare("step", target_q=True, target_qd=True, body_f=True)
    out = [wp.empty_like(on[name]) for name in ("q", "qd")]
    with no_warp_allocation():
        dyn.step(on["q"], on["qd"], on["tau"], H, **{n: on[n] for n in FORCES[1:]}, out=out)
        dyn.step(on["q"], on["qd"], on["tau"], H, **{n: on[n] for n in FORCES[1:]}, out=(on["q"], on["qd"]))
    for array, name in zip(out, ("q", "qd"), strict=True):
        np.testing.assert_array_equal(array.numpy(), on[name].numpy())
    with pytest.raises(ValueError, match="overlaps"):
        dyn.step(on["q"], on["qd"], on["tau"], H, out=(out[0], on["tau"]))
    q, qd, tau = (states(scene, worlds, "float32")[name].astype(np.float32) for name in ("q", "qd", "tau"))
    after = dyn.step(q, qd, tau, H)
    assert dyn.step(q, qd, tau, H, out=(q, qd))[0] is q
    for got, wanted in zip((q, qd), after, strict=True):
        np.testing.assert_array_equal(got, wanted)
    with pytest.raises(ValueError, match="overlaps"):
        dyn.step(q, qd, tau, H, out=(q, tau))


@pytest.mark.slow
@pytest.mark.parametrize("granularity", ["segment", "tree", "node"])
def test_states_of_bodies(granularity, device):
    """Those of the state after the step, whatever else it is asked for; over arrays full of NaN."""
    scene, worlds = furnished(zoo.fork()), 3
    dyn = spo.Dynamics(scene, worlds, device=device, granularity=granularity)
    on = laws.to_device(dyn, states(scene, worlds, "float32"))
    given = {n: on[n] for n in ("q", "qd", *FORCES)} | {"dt": H}
    sizes = dict(poses=7, velocities=6)
    word = dict(status=wp.empty(worlds, dtype=wp.int32, device=device))
    for more in (word, dict(substeps=2), *([dict(integrator="midpoint")] if granularity == "tree" else [])):
        alone = dyn.step(**given, **bundled(**more))
        expected = dict(zip(sizes, dyn.body_states(*alone), strict=True))
        for names in (("poses", "velocities"), ("velocities",)):
            bodies = {n: wp.full((worlds, scene.body_count, sizes[n]), np.nan, dyn.dtype, device) for n in names}
            after = dyn.step(**given, **bundled(**more, **bodies))
            for got, wanted in zip(after, alone, strict=True):
                np.testing.assert_array_equal(got.numpy(), wanted.numpy())
            for name, got in bodies.items():
                np.testing.assert_allclose(got.numpy(), expected[name].numpy(), rtol=0.0, atol=1e-5)
    with pytest.raises(ValueError, match=r"velocities .* expected \(3, 5, 6\) \[world, body, 6\]"):
        dyn.step(**given, report=spo.StepReport(velocities=np.zeros((3, 5, 7), np.float32)))


def test_a_step_in_place_reads_its_state_once(device, monkeypatch):
    """No second try for far angles after the state has been written over: they are looked at first."""
    texts, kernel = [], native.kernel
    monkeypatch.setattr(
        native,
        "kernel",
        lambda name, text, *more, **options: texts.append(text) or kernel(name, text, *more, **options),
    )
    scene = zoo.chain(3)
    scene = scene.with_values(joint_stiffness=np.zeros(3))
    dyn = spo.Dynamics(scene, 2, device=device, dtype="float64")
    a = laws.states(scene, 2)
    q = a["q"] + 2.0 * np.pi * 2.0**40
    on = [wp.array(x, dtype=wp.float64, device=device) for x in (q, a["qd"])]
    dyn.step(*on, None, H, out=tuple(on))
    near = dyn.step(np.remainder(q, 2.0 * np.pi), a["qd"], None, H)
    np.testing.assert_allclose(on[1].numpy(), near[1], atol=1e-3)  # what 2^40 turns leave of an angle
    assert len(texts) == 1 and "reach()" in texts[0] and "again" not in texts[0]


def test_values_that_are_variable_or_differ_between_worlds(device):
    """As inputs they do what they do folded."""
    names = ("damping", "stiffness", "friction", "target_ke", "target_kd", "armature")
    names = tuple(f"joint_{name}" for name in names)
    scene, worlds = furnished(zoo.fork()), 2
    scene = scene.with_values(joint_velocity_limit=np.full(scene.dof_count, 1e6))  # as heavy as the scene's armature
    rng = np.random.default_rng(1)
    values = {name: rng.uniform(0.1, 2.0, (worlds, scene.dof_count)) for name in names}
    lower = rng.uniform(-1.0, -0.2, (worlds, scene.dof_count))
    lower[:, scene.values["joint_limit_lower"][0] < -1e9] = -1e10
    various = scene.with_values(joint_limit_lower=lower)
    dyn = spo.Dynamics(various, worlds, device=device, dtype="float64", variable=names)
    dyn.set(**values)
    a = states(scene, worlds)
    got = dyn.step(a["q"], a["qd"], a["tau"], H, **{n: a[n] for n in FORCES[1:]})
    for w in range(worlds):
        one = scene.with_values(joint_limit_lower=lower[w], **{name: array[w] for name, array in values.items()})
        folded = symbolic.advance(one, {name: array[w : w + 1] for name, array in a.items()}, H)
        for x, y in zip(got, folded, strict=False):
            np.testing.assert_allclose(x[w], y[0], atol=1e-12)


def test_status_words(device, monkeypatch):
    monkeypatch.setattr(pass_loops, "MOST_PASSES", 1)
    dyn = spo.Dynamics(slider(friction=1.0), 4, device=device)
    q, qd, tau = np.zeros((4, 1)), np.array([[1.0], [3e38], [np.nan], [1e-3]]), np.zeros((4, 1))
    tau[1], h = 3e38, 10.0
    status = np.full(4, -1, dtype=np.int32)
    after = dyn.step(q, qd, tau, h, status=status)[1]
    assert status.tolist() == [5, 1, 2, 5]
    assert np.isfinite(after[[0, 3]]).all()
    monkeypatch.undo()
    dyn = spo.Dynamics(slider(friction=1.0), 4, device=device)
    dyn.step(q, qd, tau, h, status=status)
    assert status.tolist() == [0, 1, 2, 0]


def test_further_results_are_asked_for_one_by_one(device):
    """qdd alone, status alone, both, neither: each its own kernel, and the same step."""
    scene = furnished(zoo.fork())
    dyn, a = spo.Dynamics(scene, 2, device=device, dtype="float64"), states(scene, 2)
    plain = dyn.step(a["q"], a["qd"], a["tau"], H)
    for asked in (("status",), ("qdd",), ("qdd", "status")):
        given = {"status": np.full(2, -1, np.int32), "qdd": np.full(a["qd"].shape, np.nan)}
        given = {name: given[name] for name in asked}
        for x, y in zip(dyn.step(a["q"], a["qd"], a["tau"], H, **bundled(**given)), plain, strict=True):
            np.testing.assert_allclose(x, y, atol=1e-14)
        if "status" in asked:
            assert not given["status"].any()
        if "qdd" in asked:
            np.testing.assert_allclose(a["qd"] + H * given["qdd"], plain[1], atol=1e-13)


def test_mistakes_are_explained(device):
    dyn = spo.Dynamics(zoo.fork(), 2, device=device)
    a = states(dyn.scene, 2)
    call = lambda **more: dyn.step(**{"q": a["q"], "qd": a["qd"], "tau": None, "dt": H, **bundled(**more)})  # noqa: E731
    with pytest.raises(TypeError, match=r"Dynamics.step: dt is 'soon'; expected a number of seconds"):
        call(dt="soon")
    with pytest.raises(TypeError, match=r"Dynamics.step: dt is array\(\[0.002\]\); expected a number of seconds"):
        call(dt=np.array([2e-3]))
    with pytest.raises(ValueError, match="integrator is 'euler'; expected one of semi_implicit"):
        call(integrator="euler")
    with pytest.raises(ValueError, match=r"Dynamics.step: qd is a NumPy array \(2, 3\)"):
        call(qd=np.zeros((2, 3)))
    with pytest.raises(ValueError, match=r"target_q is a NumPy array \(2, 11\)"):
        call(target_q=a["qd"])
    with pytest.raises(TypeError, match="expected a pair of arrays or None"):
        call(out=np.zeros((2, 12)))
    with pytest.raises(ValueError, match="status with integrator='rk4'"):
        call(integrator="rk4", status=np.zeros(2, dtype=np.int32))
    limited = zoo.single_body("ball").with_values(joint_limit_upper=np.ones(3))
    with pytest.raises(UnsupportedError, match="a limit on 'joint_0:0', a dof of a ball or free hinge"):
        spo.Dynamics(limited, 1, device=device).step(limited.neutral_q[None], np.zeros((1, 3)), None, H)


def test_values_and_times_that_no_step_has():
    scene = slider()
    for name in ("joint_friction", "joint_effort_limit", "joint_velocity_limit"):
        with pytest.raises(ValueError, match=f"{name} holds -1"):
            scene.with_values(**{name: [-1.0]})
    with pytest.raises(ValueError, match="joint_friction holds -2"):
        slider(friction=-2.0)
    dyn = spo.Dynamics(scene, 1, device="cpu")
    for dt in (0.0, -1e-3, float("nan")):
        with pytest.raises(ValueError, match=r"dt is .* expected (more than zero|a number that float32 holds, finite)"):
            dyn.step(np.zeros((1, 1)), np.zeros((1, 1)), None, dt)


def test_a_scene_that_cannot_move(device):
    scene = spo.Scene([spo.Body(1.0)], [spo.Hinge("fixed", -1, 0)])
    status = np.full(2, -1, dtype=np.int32)
    q, qd = spo.Dynamics(scene, 2, device=device).step(np.zeros((2, 0)), np.zeros((2, 0)), None, H, status=status)
    assert q.shape == qd.shape == (2, 0) and not status.any()


def test_a_kernel_reads_rows_through_shared_memory_too(device):
    """The staged form of the same text; on a CPU it is not compiled, but its rows are laid out."""
    scene = furnished(zoo.fork())
    dyn = spo.Dynamics(scene, 3, device=device)
    dyn.programs.builder.plan = dataclasses.replace(dyn.plan, staged=True)
    plain = spo.Dynamics(scene, 3, device=device)
    a = states(scene, 3, "float32")
    for x, y in zip(dyn.step(a["q"], a["qd"], a["tau"], H), plain.step(a["q"], a["qd"], a["tau"], H), strict=True):
        np.testing.assert_array_equal(x, y)


def fixed_and_floating():
    """A body fixed to the world, one on a hinge on it, one fixed to that, and a floating body beside them."""
    kinds = ["fixed", "revolute", "fixed", "free", "ball"]
    return zoo.from_parents([-1, 0, 1, -1, 3], kinds, 8)


@pytest.mark.parametrize("scene", [fixed_and_floating, zoo.forest, zoo.SCENES["tree10"]])
def test_accelerations_and_reactions_of_bodies(scene):
    """Accelerations are the rates of velocities; reactions, children's and body_f move every body as Newton says."""
    scene = scene()
    a = laws.states(scene, 2)
    given, shape = ("q", "qd", "qdd"), {"out": (scene.body_count, 6)}
    acceleration = np.nan_to_num(symbolic.run(scene, "body_accelerations", a, given, shape)["out"])
    reaction = symbolic.run(scene, "body_reactions", a, (*given, "body_f"), shape)["out"]
    for w in range(2):
        q, qd, qdd, h = a["q"][w], a["qd"][w], a["qdd"][w], 1e-6
        dense = Dense(scene, q, world=w)
        ahead, behind = (
            Dense(scene, dense.integrate(qd + 0.5 * s * h * qdd, s * h), world=w).body_velocities(qd + s * h * qdd)
            for s in (1.0, -1.0)
        )
        np.testing.assert_allclose(acceleration[w], (ahead - behind) / (2.0 * h), atol=1e-7)
        mass, com, inertia = (scene.values[f"body_{name}"][0] for name in ("mass", "com", "inertia"))
        turn = [rotation(pose[3:]) for pose in dense.body_poses]
        centre = [pose[:3] + R @ c for pose, R, c in zip(dense.body_poses, turn, com, strict=True)]
        for k in range(scene.body_count):
            I, spin = turn[k] @ inertia[k] @ turn[k].T, dense.body_velocities(qd)[k, 3:]
            linear, angular = acceleration[w, k, :3], acceleration[w, k, 3:]
            got = reaction[w, k] + a["body_f"][w, k]
            for child in scene.tree.children[k]:
                f = reaction[w, child]
                got = got - f - np.concatenate([np.zeros(3), np.cross(centre[child] - centre[k], f[:3])])
            wanted = [*(mass[k] * (linear - scene.values["gravity"][0])), *(I @ angular + np.cross(spin, I @ spin))]
            np.testing.assert_allclose(got, wanted, atol=1e-9)


def test_targets_that_no_drive_follows_are_said_once(device):
    """At the first step that is given some; not where a drive follows, or gains may be set."""
    body, place = spo.Body(1.0, inertia=np.eye(3)), dict(axis=(0, 1, 0))
    at = np.ones((1, 1))

    def step(dyn, **given):
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            dyn.step(at, at, None, 1e-3, **given)
        return [each for each in found if "target_q moves nothing" in str(each.message)]

    bare = spo.Scene([body], [spo.Hinge("revolute", -1, 0, **place)])
    dyn = spo.Dynamics(bare, 1, device)
    said = [step(dyn), step(dyn, target_q=at), step(dyn, target_q=at)]
    assert [len(each) for each in said] == [0, 1, 0] and said[1][0].filename == __file__
    driven = spo.Scene([body], [spo.Hinge("revolute", -1, 0, target_ke=1.0, **place)])
    for scene, variable in ((driven, ()), (bare, ("joint_target_ke",))):
        assert not step(spo.Dynamics(scene, 1, device, variable=variable), target_q=at)
