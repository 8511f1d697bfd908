"""Bodies of a Newton model that touch each other under SolverSPO: steps are those of a scene."""

import dataclasses

import newton
import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support.pair_scenes import WEDGE
from support.solver_models import H
from support.solver_pair_models import GRAVITY, SIDE, WALL, arm, config, free_cube, many, mesh_of, tower, with_table
from warp_spo import Status
from warp_spo.examples import grasp, newton_grasp
from warp_spo.newton import SolverSPO

SLIP = 1e-3  # [m], of a held cube
EQUAL = 1e-4  # of float32 steps of one scene from float32 and from float64 values, over the largest velocity


@pytest.fixture(autouse=True)
def on_the_device(device):
    with wp.ScopedDevice(device):
        yield


def run(solver, state, steps, contacts=None, observables=None):
    for _ in range(steps):
        solver.step(state, state, None, contacts, H, observables=observables)


def state_of(model, seed, speed=0.3):
    state, rng = model.state(), np.random.default_rng(seed)
    qd = (speed * rng.normal(size=model.joint_qd.shape)).astype(np.float32)
    state.joint_qd.assign(qd)
    newton.eval_fk(model, state.joint_q, state.joint_qd, state)
    return state


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:SolverSPO")
def test_a_step_is_that_of_a_scene_by_hand():
    """Bit by bit; each kind of shape, margins, means of materials that differ between worlds."""
    model = many(arm())
    mu = model.shape_material_mu.numpy()
    mu[8] = 0.1  # of the elbow in the second world
    model.shape_material_mu.assign(mu)
    pairs = [("pad", "cube"), ("elbow", "ball"), ("stick", "ball"), ("ball", "pad")]
    solver, state = SolverSPO(model, contacts="none", pairs=pairs), state_of(model, 0)
    of = lambda *values: np.float32(values).astype(float).sum()  # noqa: E731  the model's values are float32
    pad, ball = dict(box=(of(0.1, 0.005), of(0.1, 0.005), of(0.02, 0.005))), dict(sphere=of(0.05, 0.003))
    middle, end = of(-0.15), of(0.15)
    stick = dict(capsule=((0, 0, middle + end), (0, 0, middle - end), of(0.03)))
    elbow, cube = dict(sphere=((0, 0, middle), of(0.03))), dict(box=[of(SIDE)] * 3)
    law = dict(stiffness=1e5, damping=1e3)
    contacts = [spo.Contact(2, **pad, other=spo.Contact(3, **cube), stiffness=1e5, damping=525.0),
                spo.Contact(1, **elbow, other=spo.Contact(4, **ball), stiffness=7.5e4, damping=1e3),
                spo.Contact(0, **stick, other=spo.Contact(4, **ball), **law),
                spo.Contact(4, **ball, other=spo.Contact(2, **pad), **law)]  # fmt: skip
    scene = spo.from_newton(model).with_contacts(contacts)
    dyn = spo.Dynamics(scene, 2, dtype="float32", variable=tuple(solver.dynamics.variable))
    mu = [np.float32([0.5]) * (a + b) for a, b in np.float32([(0.8, 0.4), (0.2, 0.8), (0.1, 0.8), (0.8, 0.8)])]
    dyn.set(contact_friction=np.concatenate([mu[0], mu[1], mu[3], mu[3], mu[0], mu[2], mu[3], mu[3]]).reshape(2, 4))
    q, qd = state.joint_q.numpy().reshape(2, -1), state.joint_qd.numpy().reshape(2, -1)
    reports = {"contact_f": (2, 4, 3), "contact_slip": (2, 4), "qdd": qd.shape}
    reports = {name: np.full(shape, np.nan, np.float32) for name, shape in reports.items()}
    seen, force, status = solver.observables(solver.supported_observables), reports["contact_f"], np.ones(2, np.int32)
    for name in ("contact_f", "contact_slip"):
        getattr(seen, name).fill_(np.nan)
    state.body_f, met = None, np.zeros(4, bool)
    for _ in range(60):  # with all that the solver asks for: one kernel, the same bits
        q, qd = dyn.step(q, qd, np.zeros_like(qd), H, status=status, report=spo.StepReport(**reports))
        run(solver, state, 1, observables=seen)
        for name in ("contact_f", "contact_slip"):
            np.testing.assert_array_equal(getattr(seen, name).numpy(), reports[name])
        met |= force.any(axis=(0, 2))
    np.testing.assert_array_equal(state.joint_q.numpy().reshape(2, -1), q)
    assert met.sum() >= 3 and not solver.status.numpy().any()
    assert np.abs(q[0] - q[1]).max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_impulses_are_equal_and_opposite(dtype):
    """A ball flies against a cube: both keep their momentum, of the solver's steps and of its scene in float64."""
    one, bound = newton.ModelBuilder(), {"float32": 1e-5, "float64": 1e-12}[dtype]  # 60 steps round each velocity once
    free_cube(one, "cube", (0.0, 0.0, 0.0), density=500.0)
    ball = one.add_body(xform=wp.transform(wp.vec3(0.2, 0.03, 0.0), wp.quat_identity()), label="ball")
    one.add_shape_sphere(ball, radius=0.05, cfg=config(), label="ball")
    model = many(one, 2, ground=False)
    model.set_gravity((0.0, 0.0, 0.0))
    solver, state = SolverSPO(model, pairs=[("ball", "cube")]), model.state()
    mass = model.body_mass.numpy().astype(np.float64).reshape(2, 2, 1)
    qd = np.zeros((2, 12), np.float32)
    qd[:, 6], qd[:, 9:12], qd[:, 0] = [-1.5, -0.7], 2.0, 0.2
    q, dyn, met = model.joint_q.numpy().reshape(2, 14), solver.dynamics, 0.0
    before = (mass * qd.reshape(2, 2, 6)[:, :, :3]).sum(axis=1)
    if dtype == "float32":
        state.joint_qd.assign(qd.ravel())
        seen = solver.observables({"contact_f"})
        for _ in range(60):
            run(solver, state, 1, observables=seen)
            met = max(met, np.abs(seen.contact_f.numpy()).max())
        qd = state.joint_qd.numpy().reshape(2, 12)
    else:
        scene, force = dyn.scene, np.zeros((2, 1, 3))
        dyn = spo.Dynamics(scene, 2, dtype="float64")
        for _ in range(60):
            q, qd = dyn.step(q, qd, None, H, report=spo.StepReport(contact_f=force))
            met = max(met, np.abs(force).max())
        mass = np.broadcast_to(scene.values["body_mass"], (2, 2))[..., None]
    after = (mass * qd.reshape(2, 2, 6)[:, :, :3]).sum(axis=1)
    assert met > 10.0
    np.testing.assert_allclose(after, before, atol=bound * np.abs(before).max())


@pytest.mark.slow
@pytest.mark.parametrize("table", [False, True])
def test_a_tower_stands(table):
    """On the ground, and on a box that stands still, by the contacts of a pipeline; a pair carries what is above it."""
    model = tower(table=table)
    solver, state = SolverSPO(model, pairs="all"), model.state()
    pipeline = newton.CollisionPipeline(model) if table else None
    contacts = pipeline.contacts() if table else None
    seen = solver.observables({"contact_f", "contact_slip", "status"})
    for _ in range(400):
        if table:
            pipeline.collide(state, contacts)
        run(solver, state, 1, contacts, seen)
    weight, force = WALL.density * (2 * SIDE) ** 3 * GRAVITY, seen.contact_f.numpy()[:, -3:, 2]
    np.testing.assert_allclose(force, np.tile([-2.0 * weight, 0.0, -weight], (2, 1)), rtol=2e-3, atol=1e-3)
    assert np.abs(state.joint_qd.numpy()).max() < 1e-3 and not solver.status.numpy().any()
    newton.CollisionPipeline(model).collide(state, listed := newton.CollisionPipeline(model).contacts())
    assert listed.rigid_contact_count.numpy()[0] > 12  # the bodies' contacts are in the list, and none is left out
    run(solver, state, 1, listed, seen)
    assert not solver.status.numpy().any()


@pytest.mark.slow
def test_a_cube_stands_on_a_table():
    """A shape that stands still is in a pair, and the ground carries the other cube; friction is the mean."""
    model = with_table()
    solver, state, control = SolverSPO(model, pairs=[("table", "cube")]), model.state(), model.control()
    (pair,) = solver.dynamics.scene.contact_pairs
    assert (pair.body, pair.other) == (0, -1)
    seen = solver.observables({"contact_f", "contact_slip", "status"})
    run(solver, state, 200, observables=seen)
    weight, force = WALL.density * (2 * SIDE) ** 3 * GRAVITY, seen.contact_f.numpy()[..., 2]
    np.testing.assert_allclose(force[:, -1], weight, rtol=1e-4)
    np.testing.assert_allclose(force[:, 4:8].sum(axis=1), weight, rtol=1e-4)
    assert not force[:, :4].any() and not seen.status.numpy().any()
    push = control.joint_f.numpy().reshape(2, 2, 6)
    push[:, 0, 0] = [0.4 * weight, 0.6 * weight]  # friction is 0.5
    control.joint_f.assign(push.ravel())
    speeds = []
    for _ in range(60):
        solver.step(state, state, control, None, H)
        speeds.append(state.joint_qd.numpy().reshape(2, 2, 6)[:, 0, 0].copy())
    tilt = 0.5 * weight * SIDE / (WALL.ke * SIDE**2)  # of the cube, whose face gives the normal: 2 mrad
    wanted = [0.0, 0.1 * GRAVITY]
    np.testing.assert_allclose((speeds[-1] - speeds[19]) / (40 * H), wanted, atol=2.0 * tilt * GRAVITY)
    assert speeds[-1][0] < 2e-3  # creeps by 1.3 mm/s: 0.8 of the friction is used
    pipeline = newton.CollisionPipeline(model)
    pipeline.collide(state, contacts := pipeline.contacts())
    solver.step(state, state, control, contacts, H)
    assert contacts.rigid_contact_count.numpy()[0] >= 16 and not solver.status.numpy().any()


@pytest.mark.slow
def test_a_ball_rests_between_two_meshes():
    """Wedges that stand still, of which each carries half of it.."""
    one = newton.ModelBuilder()
    for side, angle in ((1.0, 0.0), (-1.0, np.pi)):
        where = wp.transform(wp.vec3(0.15 * side, 0.0, 0.0), wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), angle))
        one.add_shape_mesh(-1, mesh=mesh_of(WEDGE), xform=where, label=f"wedge {side:g}", cfg=WALL)
    ball = one.add_body(label="ball", xform=wp.transform(wp.vec3(0.01, 0.0, 0.08), wp.quat_identity()))
    one.add_shape_sphere(ball, radius=0.05, cfg=config(ke=1e4, kd=100.0))
    model = many(one, ground=False)
    solver, state = SolverSPO(model, pairs=[("ball", "wedge*")]), model.state()
    seen = solver.observables({"contact_f", "status"})
    run(solver, state, 600, observables=seen)
    weight, force = WALL.density * 4.0 / 3.0 * np.pi * 0.05**3 * GRAVITY, seen.contact_f.numpy()
    np.testing.assert_allclose(force[..., 2], weight / 2.0, rtol=1e-3)
    np.testing.assert_allclose(np.abs(force[..., 0]), weight / 2.0 * 0.1 / 0.27, rtol=1e-2)
    assert not seen.status.numpy().any()


@pytest.mark.slow
def test_pairs_that_are_not_listed_are_a_status_word():
    """A list of contacts with two bodies that no pair has: UNSUPPORTED in their world alone, in a graph, too."""
    model = tower(3)
    solver, state = SolverSPO(model, contacts="none", pairs=[("cube_1", "cube_0")]), model.state()
    pipeline = newton.CollisionPipeline(model)
    contacts = pipeline.contacts()
    q = state.joint_q.numpy().reshape(2, 3, 7)
    q[:, :, 2] += 1.0  # above the ground, which no contact of this solver is with
    q[0, 1, 2] -= 1e-3
    q[0, 2, 2] += 0.5
    q[1, 1:, 2] -= [1e-3, 3e-3]
    state.joint_q.assign(q.ravel())
    newton.eval_fk(model, state.joint_q, state.joint_qd, state)
    pipeline.collide(model.state(), contacts)  # loads what the graph needs
    solver.step(model.state(), model.state(), None, contacts, H)
    solver.reset(model.state())
    with wp.ScopedCapture() as capture:
        pipeline.collide(state, contacts)
        solver.step(state, state, None, contacts, H)
    wp.capture_launch(capture.graph)
    assert solver.status.numpy().tolist() == [Status.OK, Status.UNSUPPORTED]
    q, qd = state.joint_q.numpy().reshape(2, 3, 7), state.joint_qd.numpy().reshape(2, 3, 6)
    assert (qd[:, 1, 2] > qd[:, 0, 2] + 1e-3).all()  # pushed apart


@pytest.mark.slow
def test_friction_follows_the_model_by_a_launch():
    """A cube on one that is pushed: it slides in the world whose friction is taken away."""
    model = tower(2)
    solver, state, control = SolverSPO(model, pairs="all"), model.state(), model.control()
    run(solver, state, 100)
    mu = model.shape_material_mu.numpy()
    mu[2:4] = 0.0
    model.shape_material_mu.assign(mu)
    with wp.ScopedCapture() as capture:
        solver.notify_model_changed(newton.ModelFlags.SHAPE_PROPERTIES)
    wp.capture_launch(capture.graph)
    solver.check_model()
    force = control.joint_f.numpy().reshape(2, 2, 6)
    force[:, 1, 0] = 5.0
    control.joint_f.assign(force.ravel())
    for _ in range(50):
        solver.step(state, state, control, None, H)
    qd = state.joint_qd.numpy().reshape(2, 2, 6)
    assert abs(qd[0, 1, 0]) < 1e-2  # sticks: 5 N of 31 N
    np.testing.assert_allclose(qd[1, 1, 0], 5.0 / 4.0 * 50 * H, rtol=0.02)  # 4 kg


@pytest.mark.slow
def test_substeps_and_gradients():
    """Substeps are the same steps; a tape says that they have no gradients."""
    model = tower(2)
    fine, coarse = SolverSPO(model, pairs="all"), SolverSPO(model, pairs="all", substeps=3)
    a, b = state_of(model, 1), state_of(model, 1)
    seen = coarse.observables({"contact_f", "contact_slip", "status"})
    for _ in range(3):
        fine.step(a, a, None, None, 1e-3)
    coarse.step(b, b, None, None, 3e-3, observables=seen)
    np.testing.assert_array_equal(a.joint_q.numpy(), b.joint_q.numpy())
    assert np.isfinite(seen.contact_f.numpy()).all() and seen.contact_f.numpy().any()
    first, second = model.state(requires_grad=True), model.state(requires_grad=True)
    with wp.Tape(), pytest.raises(ValueError, match="contact between bodies"):
        fine.step(first, second, None, None, H)


# -- a gripper ---------------------------------------------------------------------------------------------------------
def own_scene():
    """The scene of the example ``grasp`` with the materials of ``newton_grasp``, where pads touch the ground, too."""
    given, law = grasp.scene(), dict(stiffness=newton_grasp.STIFFNESS, damping=newton_grasp.DAMPING)
    bodies = [dataclasses.replace(body, gravcomp=0.0) for body in given.bodies]
    contacts = [spo.Contact(one.body, box=one.box, **law) for one in given.contacts[1:]]
    contacts += [dataclasses.replace(one, **law) for one in given.contacts]
    return spo.Scene(bodies, given.hinges, contacts=contacts)


@pytest.mark.slow
def test_a_step_of_the_gripper_is_that_of_the_librarys_own_scene():
    """From the moment in which the cube is held; the same forces, and both pads carry the cube's weight."""
    model = newton_grasp.model(2)
    solver, dyn = SolverSPO(model, pairs=newton_grasp.PAIRS), spo.Dynamics(own_scene(), 2, dtype="float32")
    assert len(solver.dynamics.scene.contact_points) == 12 and len(solver.dynamics.scene.contact_pairs) == 2
    _, _, q = grasp.path(dyn, 1.0)
    q[:, 7:9] = grasp.CUBE - 4e-4
    q, qd = q.astype(np.float32), np.zeros((2, 15), np.float32)
    qd[1, 9:15] = [0.02, -0.01, 0.1, 0.3, -0.2, 0.1]
    tau = np.float32(dyn.gravity_force(q))
    tau[:, 7:9], tau[:, 9:] = -grasp.FORCE, 0.0
    state, control = model.state(), model.control()
    state.joint_q.assign(q.ravel())
    state.joint_qd.assign(qd.ravel())
    control.joint_f.assign(tau.ravel())
    control.joint_target_q.assign(q.ravel())
    seen, force = solver.observables({"contact_f", "status"}), np.zeros((2, 14, 3), np.float32)
    seen.contact_f.fill_(np.nan)
    for _ in range(3):
        target = np.float32(control.joint_target_q.numpy().reshape(2, -1))
        q, qd = dyn.step(q, qd, tau, H, target_q=target, report=spo.StepReport(contact_f=force))
        solver.step(state, state, control, None, H, observables=seen)
        np.testing.assert_allclose(state.joint_qd.numpy().reshape(2, -1), qd, atol=EQUAL * max(1.0, np.abs(qd).max()))
        np.testing.assert_allclose(seen.contact_f.numpy(), force, atol=1e-3 * np.abs(force).max())
        assert np.abs(force[:, -2:]).max() > 20.0 and not seen.status.numpy().any()


@pytest.mark.slow
def test_a_gripper_holds_a_cube(capsys):
    """0.5 kg with 40 N: it slips less than a millimetre in 5 s, and the pads carry its weight."""
    rows, words = newton_grasp.main(worlds=2)
    times, height, apart, _ = (np.array(column) for column in zip(*rows, strict=True))
    late = times > 2.0
    assert height[-1, 0] > 0.17 and np.ptp(apart[late, 0]) < SLIP  # 0.37 mm here
    assert height[-1, 1] < grasp.CUBE + 1e-3  # a friction of 0.05 holds nothing
    assert not words.any() and "slips by 0.03" in capsys.readouterr().out
