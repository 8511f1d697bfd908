"""SolverSPO inside wp.Tape: gradients against central differences in float64, and SolverFeatherstone's."""

import itertools
import re
import warnings

import newton
import numpy as np
import pytest
import warp as wp
from newton import JointTargetMode
from newton.solvers import SolverFeatherstone

import warp_spo as spo
from support.newton_models import add_joint, add_link, arm
from support.solver_models import floating, fourbar, moving
from warp_spo.errors import UnsupportedError
from warp_spo.newton import SolverSPO
from warp_spo.reference.dense import Dense, quaternion_product, rotation

STEPS, H = 3, 0.01
NUDGE = 1e-6  # of central differences in float64
FLOAT32 = 2e-4  # of the largest of a few gradients, after three steps; 3e-5 here
STATE = ("joint_q", "joint_qd", "body_q", "body_qd")
VALUES = ("body_mass", "body_com", "body_inertia", "joint_armature", "joint_damping", "joint_target_ke",
          "joint_target_kd", "gravity")  # fmt: skip


def smooth(builder, worlds=2):
    """A model of that robot with damping and drives, but without limits and friction, whose arrays require grad."""
    both = newton.ModelBuilder()
    both.replicate(builder, worlds)
    model = both.finalize(device="cpu", requires_grad=True)
    model.joint_limit_lower.fill_(-1e10)
    model.joint_limit_upper.fill_(1e10)
    model.joint_velocity_limit.fill_(1e6)
    model.joint_effort_limit.fill_(1e6)
    model.joint_friction.zero_()
    free = np.repeat([k in (newton.JointType.FREE, newton.JointType.BALL) for k in model.joint_type.numpy()],
                     np.diff(model.joint_qd_start.numpy()))  # fmt: skip
    model.joint_target_mode.assign(np.where(free, JointTargetMode.NONE, JointTargetMode.POSITION_VELOCITY))
    return model


def inside_the_tree():
    """A free body on a body that turns, and a link on it."""
    builder, rng = newton.ModelBuilder(), np.random.default_rng(4)
    bodies = [add_link(builder, rng, f"body{k}") for k in range(3)]
    joints = [add_joint(builder, rng, kind, parent, body) for kind, parent, body in
              zip(("revolute", "free", "revolute"), (-1, *bodies), bodies, strict=False)]  # fmt: skip
    builder.add_articulation(joints)
    return builder


def random_control(model, rng):
    control = model.control()
    for name in ("joint_f", "joint_target_q", "joint_target_qd"):
        array = getattr(control, name)
        array.assign(rng.normal(size=array.size).astype(np.float32))
    return control


def rollout(solver, first, control):
    """States of a rollout inside a tape, and the tape."""
    states = [first, *(solver.model.state() for _ in range(STEPS))]
    tape = wp.Tape()
    with tape:
        for before, after in itertools.pairwise(states):
            solver.step(before, after, control, None, H)
    return states, tape


def tau_of(scene, q, joint_f):
    """joint_f [world, dof] as tau: wrenches on free joints in the axes of their parent anchors."""
    tau = joint_f.copy()
    for world, row in enumerate(q):
        poses = Dense(scene, row).body_poses
        for h, hinge in enumerate(scene.hinges):
            if hinge.unconstrained:
                turn = scene.values["joint_X_p"][0, h, 3:]
                if hinge.parent >= 0:
                    turn = quaternion_product(poses[hinge.parent, 3:], turn)
                dofs = slice(scene.qd_start[h], scene.qd_start[h + 1])
                tau[world, dofs] = (joint_f[world, dofs].reshape(2, 3) @ rotation(turn)).ravel()
    return tau


def by_world(scene, name, array):
    """Newton's array as [world, ...] of the scene, float64."""
    values = array.numpy().astype(np.float64)
    if name in ("joint_q", "joint_target_q"):
        return values[scene.q_index]
    if name.startswith("joint_"):
        return values[scene.dof_index]
    rows = 1 if name == "gravity" else scene.body_count
    return values[: scene.worlds * rows].reshape(scene.worlds, *((rows,) if rows > 1 else ()), *values.shape[1:])


def loss(dyn, seeds, given):
    """The product of the seeds with the last state of a rollout in float64."""
    scene = dyn.scene
    dyn.set(**{name: given[name] for name in dyn.variable})
    q, qd = given["joint_q"], given["joint_qd"]
    targets = {"target_q": given.get("joint_target_q"), "target_qd": given.get("joint_target_qd")}
    for step in range(STEPS):
        body_f = given["body_f"] if step == 0 else None
        q, qd = dyn.step(q, qd, tau_of(scene, q, given["joint_f"]), H, body_f=body_f, **targets)
    after = {"joint_q": q, "joint_qd": qd, "body_q": dyn.body_poses(q), "body_qd": dyn.body_velocities(q, qd)}
    return sum((seeds[name] * after[name]).sum() for name in STATE)


CASES = {"free": (lambda: floating(np.random.default_rng(3)), "raise"), "inside": (inside_the_tree, "raise"),
         "loop": (fourbar, "embed")}  # fmt: skip


@pytest.mark.filterwarnings("ignore:from_newton")
@pytest.mark.parametrize("case", ["free", *(pytest.param(case, marks=pytest.mark.slow) for case in ("inside", "loop"))])
def test_gradients_are_differences(case):
    """By every array that a step reads, through the state and the poses and velocities of bodies."""
    make, loops = CASES[case]
    rng, model = np.random.default_rng(0), smooth(make())
    if loops != "raise":  # a loop joint has no forces
        for name in ("joint_damping", "joint_stiffness", "joint_armature", "joint_target_ke", "joint_target_kd"):
            getattr(model, name).zero_()
        model.joint_target_mode.zero_()
    solver = SolverSPO(model, variable=VALUES if loops == "raise" else ("body_mass", "gravity"), loops=loops)
    scene, first, control = solver.dynamics.scene, moving(model), random_control(model, rng)
    if loops != "raise":
        solver.reset(first)
        first.joint_qd.assign(0.1 * rng.normal(size=model.joint_dof_count).astype(np.float32))
    first.body_f.assign(rng.normal(size=(model.body_count, 6)).astype(np.float32))
    states, tape = rollout(solver, first, control)
    seeds = {name: rng.normal(size=getattr(states[-1], name).numpy().shape).astype(np.float32) for name in STATE}
    last = {name: getattr(states[-1], name) for name in STATE}
    tape.backward(grads={last[n]: wp.array(seeds[n], dtype=last[n].dtype, device="cpu") for n in STATE})

    owners = {"joint_q": first, "joint_qd": first, "body_f": first, "joint_f": control}
    if solver._drives.any:
        owners |= {"joint_target_q": control, "joint_target_qd": control}
    owners |= dict.fromkeys(solver.dynamics.variable, model)
    given = {name: by_world(scene, name, getattr(one, name)) for name, one in owners.items()}
    grads = {name: by_world(scene, name, getattr(one, name).grad) for name, one in owners.items()}
    driven = {name: factor.numpy() for name, factor in solver._drives.factors.items()}
    given |= {name: given[name] * driven[name] for name in given if name in driven}
    fine = spo.Dynamics(scene, None, "cpu", "float64", solver.dynamics.variable, loops=loops, granularity="node")
    weights = {name: by_world(scene, name, wp.array(seeds[name], dtype=last[name].dtype)) for name in STATE}
    for name, gradient in grads.items():
        direction = rng.normal(size=gradient.shape) * driven.get(name, 1.0)
        if name == "body_inertia":
            direction = direction + np.swapaxes(direction, -1, -2)
        if name == "joint_damping":  # a free body on a link is carried while it has no law, and one nudge is a law
            direction = direction * (given[name] != 0.0)
            assert np.any(direction)
        high, low = (loss(fine, weights, given | {name: given[name] + side * direction}) for side in (NUDGE, -NUDGE))
        wanted, size = (high - low) / (2.0 * NUDGE), np.abs(gradient * direction).sum()
        assert size > 0.0, name
        assert abs((gradient * direction).sum() - wanted) <= FLOAT32 * size, name


@pytest.fixture(scope="module")
def made():
    model = smooth(arm(joints=2, axis=(0, 1, 0)))
    return model, SolverSPO(model)


def test_a_step_without_gradients_is_not_recorded(made):
    model, solver = made
    states = [model.state(requires_grad=False) for _ in range(2)]
    followed = [array for array in vars(model).values() if isinstance(array, wp.array) and array.requires_grad]
    for array in followed:
        array.requires_grad = False
    seen = pytest.warns(UserWarning, match="no array of state_in, .* requires grad, .*finalize")
    with wp.Tape() as tape, seen as caught:
        solver.step(*states, model.control(requires_grad=False), None, H)
    assert len(caught) == 1 and caught[0].filename == __file__
    for array in followed:
        array.requires_grad = True
    assert tape.launches == []


def test_gradients_add_up(made):
    """As those of Warp's own kernels do, until the tape's arrays are set to zero."""
    model, solver = made
    states, tape = rollout(solver, moving(model), model.control())
    seed = {states[-1].joint_q: wp.full(4, 1.0, dtype=float, device="cpu")}
    found = []
    for _ in range(2):
        tape.backward(grads=seed)
        found.append(states[0].joint_qd.grad.numpy().copy())
        for state in states[1:]:
            state.joint_q.grad.zero_()
            state.joint_qd.grad.zero_()
    np.testing.assert_allclose(found[1], 2.0 * found[0], rtol=1e-6)
    assert np.abs(found[0]).min() > 1e-3
    tape.zero()
    assert not states[0].joint_qd.grad.numpy().any()


@pytest.mark.parametrize(
    ("case", "error", "words"),
    [
        ("same", ValueError, "state_in and state_out share joint_q; expected two states"),
        ("swap", ValueError, "state_out.joint_q was read by an earlier step of this tape"),
        ("midpoint", UnsupportedError, "integrator='midpoint'"),
        ("observable", UnsupportedError, "the observable 'joint_qdd', which requires grad"),
        ("reset", UnsupportedError, "SolverSPO.reset: a state that requires grad inside wp.Tape"),
        ("solve", UnsupportedError, "SolverSPO.solve_inverse: a state that requires grad inside wp.Tape"),
    ],
)
def test_what_has_no_gradient_says_so(made, monkeypatch, case, error, words):
    model, solver = made
    first, second, control = moving(model), model.state(), model.control()
    if case == "midpoint":
        monkeypatch.setattr(solver, "integrator", "midpoint")
    with pytest.raises(error, match=words), wp.Tape():
        if case == "reset":
            solver.reset(first)
        if case == "solve":
            solver.solve_inverse(first)
        seen = solver.observables({"joint_qdd"}) if case == "observable" else None
        solver.step(first, first if case == "same" else second, control, None, H, observables=seen)
        solver.step(second, first, control, None, H)


def test_a_model_that_changed_before_the_way_back(made):
    model, solver = made
    states, tape = rollout(solver, moving(model), model.control())
    solver.notify_model_changed(newton.ModelFlags.BODY_INERTIAL_PROPERTIES)
    with pytest.raises(ValueError, match=r"call tape\.backward before changing the model"):
        tape.backward(grads={states[-1].joint_q: wp.full(4, 1.0, dtype=float, device="cpu")})


@pytest.mark.slow
def test_gradients_are_featherstones():
    """Without damping and springs both solvers take the same step. Featherstone needs a solver for each step."""
    model = smooth(arm(joints=3, axis=(0, 1, 0), parent_xform=wp.transform((0.3, 0.1, 0.2), wp.quat_identity())))
    for name in ("joint_damping", "joint_stiffness", "joint_target_ke", "joint_target_kd"):
        getattr(model, name).zero_()
    found = {}
    for kind in (SolverSPO, SolverFeatherstone):
        states = [moving(model), *(model.state() for _ in range(STEPS))]
        control = random_control(model, np.random.default_rng(0))
        solvers = [kind(model)] * STEPS if kind is SolverSPO else [kind(model) for _ in range(STEPS)]
        with wp.Tape() as tape:
            for solver, before, after in zip(solvers, states, states[1:], strict=False):
                solver.step(before, after, control, None, H)
        last, rng = states[-1], np.random.default_rng(1)
        seeds = {array: wp.array(rng.normal(size=array.numpy().shape), dtype=array.dtype, device="cpu")
                 for array in (last.joint_q, last.joint_qd, last.body_q)}  # fmt: skip
        tape.backward(grads=seeds)
        found[kind] = [x.grad.numpy().copy() for x in (states[0].joint_q, states[0].joint_qd, control.joint_f)]
        tape.zero()
    for ours, theirs in zip(*found.values(), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-3 * np.abs(theirs).max())


def test_gradients_that_stay_zero_are_named_once():
    """Arrays that require grad and are compiled into the kernels; named in variable=, they have gradients."""
    model, told = (
        smooth(arm()),
        r"gradients of the model's joint_friction, joint_stiffness, .*joint_rest_q.*variable=\(",
    )
    model.joint_stiffness.fill_(2.0)
    model.joint_rest_q.fill_(0.3)
    first = moving(model)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        rollout(SolverSPO(model, contacts="none"), first, model.control())
    assert len(caught) == 1 and re.search(told, str(caught[0].message)) and caught[0].filename == __file__
    names = ("joint_stiffness", "joint_rest_q")
    for name, array in vars(model).items():
        if isinstance(array, wp.array) and name.startswith("joint_"):
            array.requires_grad = name in (*names, "joint_q", "joint_qd")
    solver = SolverSPO(model, contacts="none", variable=(*VALUES, *names))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        states, tape = rollout(solver, first, model.control())
        states[-1].joint_qd.grad.fill_(1.0)
        tape.backward()
    for name in names:
        assert np.abs(getattr(model, name).grad.numpy()).max() > 0.0
