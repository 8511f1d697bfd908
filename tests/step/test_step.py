"""A step of whole scenes against the dense nonlinear equation, and integrators by their order."""

import numpy as np
import pytest
import torch
import warp as wp

import warp_spo as spo
from benchmarks.contact import throws
from benchmarks.table import robots
from support import implicit, laws, symbolic, zoo
from support.step_scenes import FORCES, SETTLED, TOLERANCE, H, furnished, slider, states
from warp_spo.errors import UnsupportedError
from warp_spo.hinges import ball, free
from warp_spo.kernels import pass_loops
from warp_spo.recursions.step import joint_laws, joint_space, step


@pytest.mark.parametrize(
    ("name", "dtype"),
    [
        ("chain7", "float64"),
        ("fork", "float64"),
        ("fork", "float32"),
        pytest.param("forest", "float64", marks=pytest.mark.slow),
    ],
)
def test_equals_the_dense_nonlinear_equation(name, dtype, device):
    scene, worlds = furnished(zoo.SCENES[name]()), 4
    dyn = spo.Dynamics(scene, worlds, device=device, dtype=dtype)
    a = states(scene, worlds, dtype)
    on = laws.to_device(dyn, a)
    status = wp.full(worlds, -1, dtype=wp.int32, device=device)
    out = tuple(wp.full(x.shape, float("nan"), dtype=dyn.dtype, device=device) for x in (on["q"], on["qd"]))
    assert dyn.step(on["q"], on["qd"], on["tau"], H, **{n: on[n] for n in FORCES[1:]}, status=status, out=out) == out
    assert not status.numpy().any()
    q, qd = (array.numpy().astype(np.float64) for array in out)
    for w in range(worlds):
        wanted = implicit.step(scene, w, H, *(a[n][w] for n in ("q", "qd", *FORCES)))
        np.testing.assert_allclose(qd[w], wanted[1], atol=TOLERANCE[dtype])
        np.testing.assert_allclose(q[w], wanted[0], atol=TOLERANCE[dtype])


BUGS = [
    (joint_laws.JointLaws, "_spring", "+ self.drift(link.dofs[i])", ""),
    (joint_laws.JointLaws, "_limits", "(0.0, None) if inward > 0.0 else (None, 0.0)", "None, None"),
    (joint_laws.Law, "piece", "select(over, 0.0, resistance)", "resistance"),
    (joint_laws.Law, "is_mispredicted", "one.at(u) - piece.line(u)", "0.0 * u"),
    (step.Step, "_with_resistance", "self.h * piece.resistance", "piece.resistance"),
    (joint_space.JointSpace, "solve", "U.get((i, j), 0.0) - column[i]", "U.get((i, j), 0.0) + column[i]"),
    (free.Free, "integrate", "+ shift[i]", ""),
    (ball, "rotate_by", "half = turn * 0.5", "half = turn"),
]


@pytest.mark.parametrize(("owner", "name", "old", "new"), BUGS)
def test_a_planted_bug_is_seen(monkeypatch, owner, name, old, new):
    scene = furnished(zoo.fork())
    monkeypatch.setattr(step, "MOST_JOINT_SPACE_DOFS", 99 if owner is joint_space.JointSpace else 0)
    a = states(scene, 3)
    wanted = [implicit.step(scene, w, H, *(a[n][w] for n in ("q", "qd", *FORCES))) for w in range(3)]

    def error():
        q, qd, _ = symbolic.advance(scene, a, H)
        return max(max(np.abs(q[w] - wanted[w][0]).max(), np.abs(qd[w] - wanted[w][1]).max()) for w in range(3))

    assert error() < TOLERANCE["float64"]
    symbolic.plant(monkeypatch, owner, name, old, new)
    assert error() > 1e-6


@pytest.mark.parametrize(("name", "dtype"), [("forest", "float64"), ("dancer", "float64"), ("chain7", "float32")])
def test_passes_in_joint_space_equal_sweeps(monkeypatch, name, dtype):
    """Several roots, a floating base, balls; chain7 takes joint space by itself."""
    scene, results = furnished(zoo.SCENES[name]()), []
    a = states(scene, 8)
    for short in (0, 99):
        monkeypatch.setattr(step, "MOST_JOINT_SPACE_DOFS", short)
        results.append(symbolic.advance(scene, a, H, dtype)[:2])
    for swept, short in zip(*results, strict=True):
        np.testing.assert_allclose(short, swept, rtol=0.0, atol=TOLERANCE[dtype])


def test_passes_in_joint_space_with_hinges_listed_child_first(monkeypatch):
    """The root's dofs are the last ones: eliminating them first fills in what two branches have in common."""
    scene, results = furnished(zoo.from_parents([2, 2, -1], ["prismatic", "revolute", "free"], 4)), []
    assert scene.hinges[-1].parent == -1 and scene.dof_count == 8
    a = states(scene, 8)
    for short in (0, 99):
        monkeypatch.setattr(step, "MOST_JOINT_SPACE_DOFS", short)
        results.append(symbolic.advance(scene, a, H)[:2])
    for swept, short in zip(*results, strict=True):
        np.testing.assert_allclose(short, swept, rtol=0.0, atol=TOLERANCE["float64"])


def test_passes_that_states_need():
    """Thrown at random into everything: the number of passes that the kernel allows is enough for every world."""
    for h in (2e-3, 2e-2):
        scene = furnished(zoo.SCENES["chain7"]())
        *_, passes = symbolic.advance(scene, states(scene, 1000), h, most=pass_loops.MOST_PASSES)
        assert passes.max() <= pass_loops.MOST_PASSES and passes.mean() < 7.0


@pytest.mark.slow
def test_guesses_that_would_repeat_for_ever_end(monkeypatch):
    """Eight states of G1, drives to random targets: changed all at once, guesses come back after five passes."""
    bare, worlds = robots.scene("g1"), [28, 135, 190, 453, 789, 1431, 1518, 1563]
    drive = np.r_[np.zeros(6), np.ones(29)]
    scene = bare.with_values(joint_target_ke=200.0 * drive, joint_target_kd=20.0 * drive)
    (q, qd), (target, _) = (throws.states(bare, 2048, seed) for seed in (0, 1))
    a = {name: array[worlds].astype(float) for name, array in (("q", q), ("qd", qd), ("target_q", target))}
    assert symbolic.advance(scene, a, 5e-3, most=pass_loops.MOST_PASSES)[2].max() <= pass_loops.MOST_PASSES
    monkeypatch.setattr(step, "FREE_PASSES", 2 * pass_loops.MOST_PASSES)
    assert (symbolic.advance(scene, a, 5e-3, most=pass_loops.MOST_PASSES)[2] > pass_loops.MOST_PASSES).all()


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
            dyn.step(q, qd, tau, 0.1 / count, options=spo.StepOptions(integrator=integrator), out=(q, qd))
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
        q, qd = dyn.step(q, qd, None, H, options=spo.StepOptions(integrator="midpoint"))
    assert abs(q[0, 0]) < 1.0
    with pytest.raises(UnsupportedError, match="friction or velocity limits"):
        spo.Dynamics(slider(friction=1.0), 1, device=device).step(
            q, qd, None, H, options=spo.StepOptions(integrator="rk4")
        )
