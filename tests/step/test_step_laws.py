"""A step of one hinge: each law (springs, limits, drives, friction, velocity limits) against its closed form."""

import numpy as np
import pytest

import warp_spo as spo
from support import implicit, symbolic, zoo
from support.step_scenes import H, slide, slider
from warp_spo.recursions.step import joint_laws, step
from warp_spo.reference.dense import Dense


def test_dampers_and_springs():
    q, qd = slide(slider(damping=3.0, stiffness=50.0, rest=0.2), 0.7, 1.5, 4.0)
    expected = (2.0 * 1.5 + H * (4.0 - 50.0 * (0.7 - 0.2))) / (2.0 + H * 3.0 + H * H * 50.0)
    np.testing.assert_allclose([q[0], qd[0]], [0.7 + H * expected, expected], rtol=1e-14)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_stiffness_of_1e8(dtype):
    """1e5 times what an explicit step could bear: the load hangs at tau / k and stays there."""
    q, qd = 1.0, 0.0
    for _ in range(50):
        q, qd = slide(slider(stiffness=1e8, damping=1e3), q, qd, 9.0, dtype=dtype)
    assert abs(q[0] - 9e-8) <= 1e-13 and abs(qd[0]) <= 1e-10


def test_limits_push_and_never_pull():
    """Inside nothing; outside a spring; a damper that resists going out, and lets go on the way back."""
    scene = slider(limit_lower=-1.0, limit_upper=1.0, limit_ke=100.0, limit_kd=1e4)
    q = np.array([0.0, 0.9, -1.1, 1.1, -1.1, 1.1])
    qd = np.array([5.0, 2.0, -3.0, 3.0, 3.0, -3.0])
    _, after = slide(scene, q, qd)
    damped = (2.0 * 3.0 - H * 100.0 * 0.1) / (2.0 + H * 1e4 + H * H * 100.0)
    np.testing.assert_allclose(after, [5.0, 2.0, -damped, damped, 3.0, -3.0], rtol=1e-13)
    _, after = slide(scene, [0.999, -0.999], [2.0, -2.0])  # the step leads out: its spring is there already
    outside = (2.0 * 2.0 + H * 100.0 * 0.001) / (2.0 + H * H * 100.0)
    np.testing.assert_allclose(after, [outside, -outside], rtol=1e-13)


def test_a_damper_that_pulls_or_comes_early_is_seen(monkeypatch):
    bugs = ("d = select(less(0.0, depth), d, 0.0)", "pass"), ("(0.0, None) if inward > 0.0", "(None, None) if 1")
    for old, new in bugs:
        with monkeypatch.context() as patch:
            symbolic.plant(patch, joint_laws.JointLaws, "_limits", old, new)
            with pytest.raises(AssertionError):
                test_limits_push_and_never_pull()


def test_a_drive_saturates():
    scene = slider(target_ke=1e3, target_kd=10.0, effort_limit=30.0)
    target = np.array([0.001, 10.0, -10.0])
    _, qd = slide(scene, 0.0, [0.0, 1.0, 1.0], target_q=target, target_qd=0.5)
    free = H * (1e3 * 0.001 + 10.0 * 0.5) / (2.0 + H * 10.0 + H * H * 1e3)
    np.testing.assert_allclose(qd, [free, 1.0 + H * 15.0, 1.0 - H * 15.0], rtol=1e-13)


def test_friction_sticks_and_slides():
    scene = slider(friction=4.0)
    _, qd = slide(scene, 0.0, [0.0, 0.0, 1.0, -1.0, 1e-3, 0.0], [3.9, -3.9, 0.0, 0.0, 0.0, 5.0])
    assert (np.abs(qd[[0, 1, 4]]) <= joint_laws.CREEP).all()  # held, held, stopped without turning round
    np.testing.assert_allclose(qd[[2, 3, 5]], [1.0 - H * 2.0, -1.0 + H * 2.0, H * 0.5], rtol=1e-12)


@pytest.mark.parametrize(("dtype", "share"), [("float32", 0.1), ("float64", 1e-9)])
def test_friction_stays_below_its_bound(dtype, share):
    """Two links stopped from 10 rad/s in a step, by about as much friction as that needs: what held each, from the
    change of the rates, is no more than its bound, and in float32 by rounding no more than the docstring says."""
    worlds, rng = 200, np.random.default_rng(3)
    scene = zoo.chain(2).with_values(joint_damping=np.zeros(2), joint_stiffness=np.zeros(2))
    q = rng.uniform(-1.0, 1.0, (worlds, 2)).astype(np.float32).astype(float)
    qd = (rng.choice([-10.0, 10.0], q.shape) * rng.uniform(0.8, 1.0, q.shape)).astype(np.float32).astype(float)

    def held(after):
        dense = [Dense(scene, x) for x in q]
        moved = zip(dense, qd, after, strict=True)
        return np.array([d.mass_matrix @ (b - a) / H + d.bias_force(a) for d, a, b in moved])

    bound = np.abs(held(np.zeros_like(qd))) * rng.choice([0.9, 0.98, 1.02, 2.0], q.shape)
    bound = bound.astype(np.float32).astype(float)
    scene = scene.with_values(joint_friction=bound)
    arrays = {"q": q, "qd": qd, "tau": np.zeros_like(qd), "joint_friction": bound}
    _, after, passes = symbolic.advance(scene, arrays, H, dtype)
    assert (passes <= 8).all() and (np.abs(after) < 2.0 * joint_laws.CREEP).any()
    assert (np.abs(held(after)) <= (1.0 + share) * bound).all()


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_velocity_limits(dtype):
    _, qd = slide(slider(velocity_limit=2.0), 0.0, [1.0, 1.99, 5.0, -5.0, 2.0], [0.0, 1e3, 0.0, 0.0, -1e3], dtype=dtype)
    np.testing.assert_allclose(qd, [1.0, 2.0, 2.0, -2.0, 1.0], atol=3.1 / joint_laws.HOLD)
    assert abs(qd[4] - 1.0) < 1e-5  # braking is nothing that it resists


def weightless(count, **values):
    """Sliders of 1 kg in a row, without gravity; the last one carries nothing, and has what is given."""
    bodies = [spo.Body(float(k < count - 1), inertia=np.eye(3) * (k < count - 1)) for k in range(count)]
    hinges = [spo.Hinge("prismatic", k - 1, k, axis=(1, 0, 0)) for k in range(count - 1)]
    return spo.Scene(bodies, [*hinges, spo.Hinge("prismatic", count - 2, count - 1, axis=(1, 0, 0), **values)],
                     gravity=(0, 0, 0))  # fmt: skip


def balance(q, qd, tau, drive=(0.0, 0.0, np.inf), friction=0.0, limit=np.inf, limit_ke=0.0, fastest=np.inf):
    """The rate after a step at which the forces on nothing cancel, by bisection; NaN where none is bounded."""
    ke, kd, effort = drive
    hold = joint_laws.HOLD * (H * ke + kd + friction / joint_laws.CREEP + (H * limit_ke if limit < np.inf else 0.0))

    def excess(v):
        f = np.clip(-ke * (q + H * v) - kd * v, -effort, effort) - friction * np.clip(v / joint_laws.CREEP, -1.0, 1.0)
        f -= limit_ke * max(0.0, q + H * v - limit) if limit < np.inf else 0.0
        f -= hold * (max(v - fastest, 0.0) - max(-fastest - v, 0.0)) if fastest < np.inf else 0.0
        return -tau - f

    return implicit._root(excess, qd) if excess(1e9) > 0.0 > excess(-1e9) else np.nan


DRIVE, FRICTION, LIMIT = (100.0, 1.0, 1.5), 0.7, dict(limit=0.2, limit_ke=1e4)
WEIGHTLESS = [
    dict(drive=DRIVE),
    dict(friction=FRICTION),
    dict(drive=DRIVE, friction=FRICTION),
    dict(friction=FRICTION, fastest=2.0),
    dict(drive=DRIVE, friction=FRICTION, fastest=2.0, **LIMIT),
]


@pytest.mark.parametrize("laws_of_it", WEIGHTLESS, ids=lambda given: "-".join(given))
@pytest.mark.parametrize("count", [2, pytest.param(12, marks=pytest.mark.slow)])
def test_what_moves_nothing_is_where_its_forces_balance(laws_of_it, count):
    """No mass, no armature: a step is solved wherever a law holds the hinge, though at its start all are at their
    bounds; NaN where it pulls beyond them. In joint space, and by sweeps."""
    drive = dict(zip(("target_ke", "target_kd", "effort_limit"), laws_of_it.get("drive", ()), strict=False))
    names = dict(friction="friction", limit="limit_upper", limit_ke="limit_ke", fastest="velocity_limit")
    bounds = {names[name]: x for name, x in laws_of_it.items() if name in names}
    scene = weightless(count, limit_kd=0.0, **drive, **bounds)
    rng = np.random.default_rng(count)
    q, qd, tau = (rng.uniform(-size, size, (60, count)) for size in (0.4, 3.0, 3.0))
    qd[::3], tau[::4] = 0.0, 0.0
    for dtype in ("float64", "float32"):
        arrays = {name: x.astype(dtype).astype(float) for name, x in (("q", q), ("qd", qd), ("tau", tau))}
        _, after, passes = symbolic.advance(scene, arrays, H, dtype)
        wanted = np.array([balance(*(arrays[name][w, -1] for name in arrays), **laws_of_it) for w in range(60)])
        assert "fastest" in laws_of_it or (np.isnan(wanted).any() and not np.isnan(wanted).all())
        size = np.maximum(1.0, np.abs(qd[:, -1]))
        error = np.abs(after[:, -1] - wanted) / size
        np.testing.assert_array_equal(np.isnan(after[:, -1]), np.isnan(wanted))
        assert np.nanmax(error) <= 1e3 * np.finfo(dtype).eps and (passes <= 8).all(), (np.nanmax(error), passes)


def test_what_a_scene_does_not_have_costs_nothing():
    """Unlimited values, zeros and Newton's defaults leave the trace as it is; a law costs its own dof alone."""
    counts = lambda scene: len(symbolic.step.step(symbolic.Trace(symbolic.Links(scene), "float64", ("q", "qd"))).stores)  # noqa: E731

    def operations(scene):
        trace = symbolic.Trace(symbolic.Links(scene), "float64", ("q", "qd", "tau"))
        stores = symbolic.step.step(trace).stores
        return len(symbolic.ordered(item.value for item in stores)), {item.array for item in stores}

    bare = zoo.plain()
    dofs = bare.dof_count
    assert counts(bare) == 2 * dofs
    none, arrays = operations(bare)
    assert arrays == {"out", "q_out"}
    unlimited = bare.with_values(
        joint_limit_lower=np.full(dofs, -1e10),
        joint_effort_limit=np.full(dofs, 1e6),
        joint_velocity_limit=np.full(dofs, 1e6),
        joint_limit_ke=np.full(dofs, 7.0),
    )
    assert operations(unlimited) == (none, arrays)
    damped = bare.with_values(joint_damping=np.eye(dofs)[2])
    assert none < operations(damped)[0] < none + 100 and operations(damped)[1] == arrays
    rough = bare.with_values(joint_friction=np.eye(dofs)[2])
    assert operations(rough)[1] == {"out", "q_out", *step.LOOPED}


def test_a_free_hinge_without_laws_keeps_its_short_way():
    scene = zoo.single_body("free").with_values(
        joint_armature=np.zeros(6), joint_damping=np.zeros(6), joint_stiffness=np.zeros(6),
        body_inertia=np.eye(3)[None],  # a round body has no gyroscopic torque, whose end of a step is as long
    )  # fmt: skip

    def count(scene):
        stores = symbolic.step.step(symbolic.Trace(symbolic.Links(scene), "float64", ("q", "qd"))).stores
        return len(symbolic.ordered(item.value for item in stores))

    assert count(scene) * 3 < 2 * count(scene.with_values(joint_damping=np.arange(6.0)))
