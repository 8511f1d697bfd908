"""Time steps: each law by its closed form, all together by the dense nonlinear equation, integrators by their order."""

import dataclasses

import implicit
import laws
import numpy as np
import pytest
import symbolic
import torch
import warp as wp
import zoo
from allocations import no_warp_allocation

import warp_spo as spo
from warp_spo.errors import UnsupportedError
from warp_spo.kernels import straight
from warp_spo.recursions import impedance, integration, joint_space, step
from warp_spo.reference import Dense, rotation
from warp_spo.scene.parts import SCREWS

H = 2e-3
TOLERANCE = {
    "float64": 1e-12,  # of velocities of the order of 1, up to 30
    "float32": 2e-5,
}
SETTLED = 3e-5  # relative, of velocities in float32: NOISE * HOLD roundings of a velocity limit, and some to spare
FORCES = ("tau", "body_f", "target_q", "target_qd")


def furnished(scene, seed=0):
    """Every law somewhere, at random."""
    rng, n = np.random.default_rng(seed), scene.dof_count
    screw = np.repeat([hinge.motion == SCREWS for hinge in scene.hinges], [hinge.dof_count for hinge in scene.hinges])
    some = lambda low, high, none: np.where(rng.random(n) < 0.5, rng.uniform(low, high, n), none)  # noqa: E731
    return scene.with_values(
        joint_friction=some(0.0, 1.0, 0.0),
        joint_target_ke=some(1.0, 100.0, 0.0),
        joint_target_kd=some(0.0, 5.0, 0.0),
        joint_effort_limit=some(1.0, 20.0, 1e6),
        joint_velocity_limit=some(0.5, 1.5, 1e6),
        joint_limit_lower=np.where(screw, rng.uniform(-1.0, -0.2, n), -1e10),
        joint_limit_upper=np.where(screw, rng.uniform(0.2, 1.0, n), 1e10),
    )


def states(scene, worlds, dtype="float64"):
    a = laws.states(scene, worlds, dtype=dtype)
    a |= {"target_q": a["q"][::-1].copy(), "target_qd": a["qdd"]}
    a["qd"][1] = 0.0
    return {name: a[name] for name in ("q", "qd", *FORCES)}


def slider(**values):
    """A mass of 2 kg on rails, without gravity."""
    hinge = spo.Hinge("prismatic", -1, 0, axis=(1, 0, 0), **values)
    return spo.Scene([spo.Body(2.0, inertia=np.eye(3))], [hinge], gravity=(0, 0, 0))


def slide(scene, q, qd, tau=0.0, h=H, dtype="float64", **more):
    """q', qd' of sliders, one a world."""
    given = {"q": q, "qd": qd, "tau": tau, **more}
    arrays = {name: np.atleast_1d(x).astype(float)[:, None] for name, x in given.items()}
    worlds = max(map(len, arrays.values()))
    arrays = {name: np.broadcast_to(x, (worlds, 1)) for name, x in arrays.items()}
    q_after, qd_after, passes = symbolic.advance(scene, arrays, h, dtype)
    assert (passes <= 3).all()  # of one dof
    return q_after[:, 0], qd_after[:, 0]


# -- law by law --------------------------------------------------------------------------------------------------------
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
            symbolic.plant(patch, impedance.Impedance, "_limits", old, new)
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
    assert (np.abs(qd[[0, 1, 4]]) <= impedance.CREEP).all()  # held, held, stopped without turning round
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
    assert (passes <= 8).all() and (np.abs(after) < 2.0 * impedance.CREEP).any()
    assert (np.abs(held(after)) <= (1.0 + share) * bound).all()


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_velocity_limits(dtype):
    _, qd = slide(slider(velocity_limit=2.0), 0.0, [1.0, 1.99, 5.0, -5.0, 2.0], [0.0, 1e3, 0.0, 0.0, -1e3], dtype=dtype)
    np.testing.assert_allclose(qd, [1.0, 2.0, 2.0, -2.0, 1.0], atol=3.1 / impedance.HOLD)
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
    hold = impedance.HOLD * (H * ke + kd + friction / impedance.CREEP + (H * limit_ke if limit < np.inf else 0.0))

    def excess(v):
        f = np.clip(-ke * (q + H * v) - kd * v, -effort, effort) - friction * np.clip(v / impedance.CREEP, -1.0, 1.0)
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
@pytest.mark.parametrize("count", [2, 12])
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
    counts = lambda scene: len(symbolic.Applications(symbolic.Links(scene), "float64", ("q", "qd")).step())  # noqa: E731

    def operations(scene):
        trace = symbolic.Applications(symbolic.Links(scene), "float64", ("q", "qd", "tau"))
        stores = trace.step()
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
        joint_armature=np.zeros(6), joint_damping=np.zeros(6), joint_stiffness=np.zeros(6)
    )

    def count(scene):
        stores = symbolic.Applications(symbolic.Links(scene), "float64", ("q", "qd")).step()
        return len(symbolic.ordered(item.value for item in stores))

    assert count(scene) * 2 < count(scene.with_values(joint_damping=np.arange(6.0)))


# -- all together ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("name", "dtype"), [("chain7", "float64"), ("fork", "float64"), ("fork", "float32"), ("forest", "float64")]
)
def test_equals_the_dense_nonlinear_equation(name, dtype, device):
    scene, worlds = furnished(zoo.SCENES[name]()), 4
    dyn = spo.Dynamics(scene, worlds, device=device, dtype=dtype)
    a = states(scene, worlds, dtype)
    on = laws.to_device(dyn, a)
    status = wp.full(worlds, -1, dtype=wp.int32, device=device)
    out = tuple(wp.full(x.shape, float("nan"), dtype=dyn.dtype, device=device) for x in (on["q"], on["qd"]))
    assert dyn.step(on["q"], on["qd"], on["tau"], H, *(on[n] for n in FORCES[1:]), status=status, out=out) == out
    assert not status.numpy().any()
    q, qd = (array.numpy().astype(np.float64) for array in out)
    for w in range(worlds):
        wanted = implicit.step(scene, w, H, *(a[n][w] for n in ("q", "qd", *FORCES)))
        np.testing.assert_allclose(qd[w], wanted[1], atol=TOLERANCE[dtype])
        np.testing.assert_allclose(q[w], wanted[0], atol=TOLERANCE[dtype])


BUGS = [
    (impedance.Impedance, "_spring", "+ self.ahead(link.dofs[i])", ""),
    (impedance.Impedance, "_limits", "(0.0, None) if inward > 0.0 else (None, 0.0)", "None, None"),
    (impedance.Law, "piece", "select(over, 0.0, resistance)", "resistance"),
    (impedance.Law, "missed", "one.at(u) - piece.line(u)", "0.0 * u"),
    (step.Step, "_stiffened", "self.h * piece.resistance", "piece.resistance"),
    (joint_space.JointSpace, "solve", "U.get((i, j), 0.0) - column[i]", "U.get((i, j), 0.0) + column[i]"),
    (integration, "moved", "+ shift[i]", ""),
    (integration, "turned", "half = turn * 0.5", "half = turn"),
]


@pytest.mark.parametrize(("owner", "name", "old", "new"), BUGS)
def test_a_planted_bug_is_seen(monkeypatch, owner, name, old, new):
    scene = furnished(zoo.fork())
    monkeypatch.setattr(step, "SHORT", 99 if owner is joint_space.JointSpace else 0)
    a = states(scene, 3)
    wanted = [implicit.step(scene, w, H, *(a[n][w] for n in ("q", "qd", *FORCES))) for w in range(3)]

    def error():
        q, qd, _ = symbolic.advance(scene, a, H)
        return max(max(np.abs(q[w] - wanted[w][0]).max(), np.abs(qd[w] - wanted[w][1]).max()) for w in range(3))

    assert error() < TOLERANCE["float64"]
    symbolic.plant(monkeypatch, owner, name, old, new)
    if owner is integration:
        monkeypatch.setattr(step, "moved", integration.moved)
    assert error() > 1e-6


@pytest.mark.parametrize(("name", "dtype"), [("forest", "float64"), ("dancer", "float64"), ("chain7", "float32")])
def test_passes_in_joint_space_equal_sweeps(monkeypatch, name, dtype):
    """Several roots, a floating base, balls; chain7 takes joint space by itself."""
    scene, results = furnished(zoo.SCENES[name]()), []
    a = states(scene, 8)
    for short in (0, 99):
        monkeypatch.setattr(step, "SHORT", short)
        results.append(symbolic.advance(scene, a, H, dtype)[:2])
    for swept, short in zip(*results, strict=True):
        np.testing.assert_allclose(short, swept, rtol=0.0, atol=TOLERANCE[dtype])


def test_passes_in_joint_space_with_hinges_listed_child_first(monkeypatch):
    """The root's dofs are the last ones: eliminating them first fills in what two branches have in common."""
    scene, results = furnished(zoo.from_parents([2, 2, -1], ["prismatic", "revolute", "free"], 4)), []
    assert scene.hinges[-1].parent == -1 and scene.dof_count == 8
    a = states(scene, 8)
    for short in (0, 99):
        monkeypatch.setattr(step, "SHORT", short)
        results.append(symbolic.advance(scene, a, H)[:2])
    for swept, short in zip(*results, strict=True):
        np.testing.assert_allclose(short, swept, rtol=0.0, atol=TOLERANCE["float64"])


def test_passes_that_states_need():
    """Thrown at random into everything: the number of passes that the kernel allows is enough for every world."""
    for h in (2e-3, 2e-2):
        scene = furnished(zoo.SCENES["chain7"]())
        *_, passes = symbolic.advance(scene, states(scene, 1000), h)
        assert passes.max() <= straight.MOST_PASSES and passes.mean() < 7.0


# -- integrators -------------------------------------------------------------------------------------------------------
def test_a_slope_by_friction_where_there_is_none(device):
    """Of one dof that moves: a force of -friction, whatever friction is; where an identification starts it is zero."""
    hinge = spo.Hinge("prismatic", -1, 0, axis=(1, 0, 0))
    scene = spo.Scene([spo.Body(2.0, inertia=np.eye(3))], [hinge], gravity=(0, 0, 0))
    for friction in (0.0, 1e-12, 0.5):
        dyn = spo.Dynamics(scene, 2, device=device, dtype="float64", variable=("joint_friction",))
        value = torch.full((2, 1), friction, dtype=torch.float64, device=wp.device_to_torch(device), requires_grad=True)
        dyn.set(joint_friction=value)
        q, qd = (torch.tensor(x, dtype=torch.float64, device=value.device) for x in ([[0.0], [0.0]], [[1.0], [-10.0]]))
        rates = dyn.step(q, qd, None, H)[1]
        rates.sum().backward()
        np.testing.assert_allclose(value.grad.cpu().numpy(), [[-H / 2.0], [H / 2.0]], rtol=1e-12)


def test_float32_settles_on_the_same_pieces(device):
    """Of a stiff law a rounding of u is a force: a velocity limit that may pull a little moves a light link a lot.

    All hinges of an arm near their limits of velocity, effort and position, thrown at random.
    """
    scene = zoo.SCENES["chain7"]()
    n, count = scene.dof_count, 2048
    scene = scene.with_values(
        joint_velocity_limit=np.full(n, 4.0),
        joint_effort_limit=np.full(n, 30.0),
        joint_target_ke=np.full(n, 200.0),
        joint_target_kd=np.full(n, 20.0),
        joint_limit_lower=np.full(n, -2.0),
        joint_limit_upper=np.full(n, 2.0),
    )
    a, found = laws.states(scene, count, dtype="float32"), {}
    for dtype in ("float64", "float32"):
        dyn = spo.Dynamics(scene, count, device=device, dtype=dtype)
        status = wp.full(count, -1, dtype=wp.int32, device=device)
        given = [
            wp.array(factor * a[name], dtype=dyn.dtype, device=device)
            for name, factor in (("q", 1.0), ("qd", 3.0), ("tau", 20.0))
        ]
        found[dtype] = dyn.step(*given, H, status=status)[1].numpy(), status.numpy()
    settled = (found["float64"][1] == 0) & (found["float32"][1] == 0)
    assert settled.mean() > 0.99
    exact = found["float64"][0][settled]
    error = np.abs(found["float32"][0][settled] - exact).max(axis=1) / np.abs(exact).max(axis=1)
    assert error.max() < SETTLED


def swinging():
    """A floating body, two arms and a ball, springs and dampers everywhere."""
    scene = zoo.fork()
    return scene.with_values(joint_damping=0.3 * scene.values["joint_damping"])


@pytest.mark.parametrize(("integrator", "order"), [("semi_implicit", 1), ("midpoint", 2), ("rk4", 4)])
def test_integrators_converge_at_their_order_to_one_solution(integrator, order, device):
    scene = swinging()
    dyn = spo.Dynamics(scene, 1, device=device, dtype="float64")
    a = laws.states(scene, 1)

    def after(count, integrator):
        q, qd = (wp.array(a[name], dtype=wp.float64, device=device) for name in ("q", "qd"))
        tau = wp.array(0.1 * a["tau"], dtype=wp.float64, device=device)
        for _ in range(count):
            dyn.step(q, qd, tau, 0.1 / count, integrator=integrator, out=(q, qd))
        q = laws.same_quaternion_sign("integrate", scene, q.numpy()[0], exact[0] if exact else q.numpy()[0])
        return q, qd.numpy()[0]

    exact = None
    exact = after(160, "rk4")
    errors = [max(np.abs(x - y).max() for x, y in zip(after(n, integrator), exact, strict=True)) for n in (10, 20)]
    assert errors[1] < 0.2 / 10**order
    assert abs(np.log2(errors[0] / errors[1]) - order) < 0.25


def test_midpoint_bears_stiff_springs(device):
    scene = slider(stiffness=1e8, damping=1e4)
    dyn = spo.Dynamics(scene, 1, device=device, dtype="float64")
    q, qd = np.array([[1.0]]), np.array([[0.0]])
    for _ in range(2000):
        q, qd = dyn.step(q, qd, None, H, integrator="midpoint")
    assert abs(q[0, 0]) < 1.0
    with pytest.raises(UnsupportedError, match="friction or velocity limits"):
        spo.Dynamics(slider(friction=1.0), 1, device=device).step(q, qd, None, H, integrator="rk4")


# -- as users call it --------------------------------------------------------------------------------------------------
def test_in_place_and_without_allocation(device):
    scene, worlds = furnished(zoo.fork()), 3
    dyn = spo.Dynamics(scene, worlds, device=device)
    on = laws.to_device(dyn, states(scene, worlds, "float32"))
    dyn.prepare("step", target_q=True, target_qd=True, body_f=True)
    out = [wp.empty_like(on[name]) for name in ("q", "qd")]
    with no_warp_allocation():
        dyn.step(on["q"], on["qd"], on["tau"], H, *(on[n] for n in FORCES[1:]), out=out)
        dyn.step(on["q"], on["qd"], on["tau"], H, *(on[n] for n in FORCES[1:]), out=(on["q"], on["qd"]))
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


def test_a_step_in_place_reads_its_state_once(device, monkeypatch):
    """No second try for far angles after the state has been written over: they are looked at first."""
    texts, kernel = [], straight.kernel
    monkeypatch.setattr(straight, "kernel", lambda name, text, *more: texts.append(text) or kernel(name, text, *more))
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
    got = dyn.step(a["q"], a["qd"], a["tau"], H, *(a[n] for n in FORCES[1:]))
    for w in range(worlds):
        one = scene.with_values(joint_limit_lower=lower[w], **{name: array[w] for name, array in values.items()})
        folded = symbolic.advance(one, {name: array[w : w + 1] for name, array in a.items()}, H)
        for x, y in zip(got, folded, strict=False):
            np.testing.assert_allclose(x[w], y[0], atol=1e-12)


def test_status_words(device, monkeypatch):
    monkeypatch.setattr(straight, "MOST_PASSES", 1)
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
        for x, y in zip(dyn.step(a["q"], a["qd"], a["tau"], H, **given), plain, strict=True):
            np.testing.assert_allclose(x, y, atol=1e-14)
        if "status" in asked:
            assert not given["status"].any()
        if "qdd" in asked:
            np.testing.assert_allclose(a["qd"] + H * given["qdd"], plain[1], atol=1e-13)


def test_mistakes_are_explained(device):
    dyn = spo.Dynamics(zoo.fork(), 2, device=device)
    a = states(dyn.scene, 2)
    call = lambda **more: dyn.step(**{"q": a["q"], "qd": a["qd"], "tau": None, "dt": H, **more})  # noqa: E731
    with pytest.raises(TypeError, match=r"Dynamics.step: dt is 'soon'; expected a number of seconds"):
        call(dt="soon")
    with pytest.raises(TypeError, match=r"Dynamics.step: dt is array\(\[0.002\]\); expected a number of seconds"):
        call(dt=np.array([2e-3]))
    with pytest.raises(ValueError, match="integrator is 'euler'; expected one of semi_implicit"):
        call(integrator="euler")
    with pytest.raises(ValueError, match=r"Dynamics.step: qd is a NumPy array float64 \(2, 3\)"):
        call(qd=np.zeros((2, 3)))
    with pytest.raises(ValueError, match=r"target_q is a NumPy array float64 \(2, 11\)"):
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
    dyn.programs.plan = dataclasses.replace(dyn.plan, staged=True)
    plain = spo.Dynamics(scene, 3, device=device)
    a = states(scene, 3, "float32")
    for x, y in zip(dyn.step(a["q"], a["qd"], a["tau"], H), plain.step(a["q"], a["qd"], a["tau"], H), strict=True):
        np.testing.assert_array_equal(x, y)


# -- what bodies feel --------------------------------------------------------------------------------------------------
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
