"""Contacts that SolverSPO computes by itself: a model's shapes on its plane or height field."""

import warnings

import newton
import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support.solver_grounds import CFG, SIDE, WEIGHT, block, boxes, field, plane, run, spheres
from support.solver_models import H
from warp_spo import Status
from warp_spo.errors import UnsupportedError
from warp_spo.newton import SolverSPO


@pytest.mark.parametrize("own", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_cubes_rest_on_grounds_of_their_own(own):
    """Planes at other heights, one plane for all: materials are means, forces carry the weight, height is exact."""
    model = boxes(plane(0.1), plane(0.02)) if own else boxes(None, None, everywhere=plane(0.05))
    solver, state = SolverSPO(model), model.state()
    seen = solver.observables({"contact_f", "contact_slip", "status"})
    seen.contact_f.fill_(np.nan)
    run(solver, state, 500, observables=seen)
    np.testing.assert_allclose(seen.contact_f.numpy()[..., 2].sum(axis=1), WEIGHT, rtol=1e-4)
    resting = np.array([0.1, 0.02] if own else [0.05, 0.05]) + SIDE / 2 - WEIGHT / (4 * CFG.ke)
    np.testing.assert_allclose(state.joint_q.numpy().reshape(2, 7)[:, 2], resting, atol=2e-6)
    assert seen.contact_slip.numpy().shape == (2, 4) and abs(seen.contact_slip.numpy()).max() < 1e-5
    assert not seen.status.numpy().any() and not solver.status.numpy().any()


def test_a_step_is_that_of_the_scene(device):
    """Bit by bit; worlds on height fields of their own, of which one is moved."""
    model = boxes(field(1), field(2, at=(0.3, 0.1, -0.02)), field(1))
    solver, state = SolverSPO(model), model.state()
    scene = spo.from_newton(model, contacts="ground")
    assert scene.ground.count == 2 and scene.values["ground_field"].ravel().tolist() == [0, 1, 0]
    np.testing.assert_allclose(scene.values["ground_origin"], [[0, 0, 0], [0.3, 0.1, -0.02], [0, 0, 0]], atol=1e-7)
    variable = tuple(solver.dynamics.variable)
    dyn = spo.Dynamics(scene, 3, "cpu", "float32", variable)
    q, qd = model.joint_q.numpy().reshape(3, 7), model.joint_qd.numpy().reshape(3, 6)
    for _ in range(150):
        q, qd = dyn.step(q, qd, None, H)
    run(solver, state, 150)
    np.testing.assert_array_equal(state.joint_q.numpy().reshape(3, 7), q)
    assert not np.array_equal(q[0], q[1]) and np.array_equal(q[0], q[2])


def test_friction_may_change_between_steps():
    """shape_material_mu is variable and set by launches; ke is compiled in, and rebuilds with a warning."""
    model = boxes(plane(0.1), plane(0.1))
    solver, state = SolverSPO(model), model.state()
    qd = model.joint_qd.numpy().reshape(2, 6)
    qd[:, 0] = 2.5
    state.joint_qd.assign(qd.ravel())
    mu = model.shape_material_mu.numpy()
    mu[2] = 0.0  # of the cube in world 1: the mean with the ground's 0.4 is 0.2
    model.shape_material_mu.assign(mu)
    solver.notify_model_changed(newton.ModelFlags.SHAPE_PROPERTIES)
    run(solver, state, 300)
    before = state.joint_qd.numpy().reshape(2, 6)[:, 0].copy()
    run(solver, state, 10)
    lost = before - state.joint_qd.numpy().reshape(2, 6)[:, 0]
    np.testing.assert_allclose(lost[1], 0.2 * 9.81 * 10 * H, rtol=1e-2)
    with pytest.raises(ValueError, match=r"SHAPE_PROPERTIES|shape_material_ke is"):
        ke = model.shape_material_ke.numpy() * 2
        model.shape_material_ke.assign(ke)
        solver.check_model()
    with pytest.warns(UserWarning, match="shape_material_ke folded into the kernels"):
        solver.notify_model_changed(newton.ModelFlags.SHAPE_PROPERTIES)
    assert solver.dynamics.scene.values["contact_stiffness"][0, 0] == 4e3


def test_contacts_between_bodies_are_named_by_status():
    """Contacts with the ground are the solver's own; a pair of bodies is not: UNSUPPORTED in that world."""
    model = spheres()
    with pytest.warns(UserWarning, match="pass through each other"):
        solver = SolverSPO(model)
    state, contacts = model.state(), newton.Contacts(4, 0, device="cpu")
    for pairs, words in (([(0, 4), (4, 2)], [0, 0]), ([(0, 4), (2, 3)], [0, 10]), ([(1, 0), (3, 4)], [10, 0])):
        contacts.rigid_contact_shape0.assign(np.array([pair[0] for pair in (*pairs, (0, 1), (2, 3))], np.int32))
        contacts.rigid_contact_shape1.assign(np.array([pair[1] for pair in (*pairs, (0, 1), (2, 3))], np.int32))
        contacts.rigid_contact_count.assign(np.array([2], np.int32))
        solver.step(state, state, None, contacts, H)
        assert solver.status.numpy().tolist() == words
        solver.reset(state, wp.array([False, True, False], dtype=wp.bool, device="cpu"))
        assert solver.status.numpy().tolist() == [words[0], 0]
        solver.reset(state)


@pytest.mark.slow
def test_contacts_that_newton_finds():
    """Newton's pipeline finds contacts with the ground, which the solver takes itself, and one pair in world 1."""
    model = spheres()
    solver, state, pipeline = SolverSPO(model, pairs=[]), model.state(), newton.CollisionPipeline(model)
    contacts = pipeline.contacts()
    q = model.joint_q.numpy().reshape(2, 2, 7).copy()
    q[1, 0, 0] = -0.05
    state.joint_q.assign(q.ravel())
    newton.eval_fk(model, state.joint_q, state.joint_qd, state)
    pipeline.collide(state, contacts)
    assert contacts.rigid_contact_count.numpy()[0] >= 5
    solver.step(state, state, None, contacts, H)
    assert solver.status.numpy().tolist() == [Status.OK, Status.UNSUPPORTED]


@pytest.mark.parametrize("grounds, words", [
    ([None], "contacts='ground': a model whose ground is no level plane and no height field"),
    ([lambda b: (plane()(b), block(b))], "contacts='ground': left out: box 'block' of the world"),
    ([lambda b: (plane()(b), plane(1.0)(b))], "several grounds: plane"),
    ([plane(), plane(0.0, (0.0, 0.6, 0.8))], "world 1 has a plane with another normal"),
    ([field(1), field(1, turn=(0.0, 0.0, 0.6, 0.8))], "world 1 has a height field whose axes are turned"),
    ([plane(), field(1)], r"world 1 (has|differs)"),
])  # fmt: skip
def test_what_has_no_contacts_says_why(grounds, words):
    """An error if contacts with the ground are asked for; "auto" then leaves them out, or takes those of a pipeline."""
    model = boxes(*grounds)
    with pytest.raises(UnsupportedError, match=words):
        SolverSPO(model, contacts="ground")
    if len(grounds) > 1 or grounds[0] is None:
        with warnings.catch_warnings(record=True) as seen:
            warnings.simplefilter("always")
            solver = SolverSPO(model)
        assert bool(solver.dynamics.scene.contacts) == ("another normal" in words or "turned" in words)
        passes = [str(one.message) for one in seen if "pass through shapes that stand still" in str(one.message)]
        assert len(passes) == ("differs" in words) and all("different collision shapes" in one for one in passes)
        assert ("contact_f" in solver.supported_observables) == bool(solver.dynamics.scene.contacts)


def test_options_that_have_no_contacts():
    model = boxes(plane())
    with pytest.raises(ValueError, match="SolverSPO: contacts is 'all'; expected one of auto, ground, pipeline, none"):
        SolverSPO(model, contacts="all")
    with pytest.raises(UnsupportedError, match="contacts='ground' with integrator='rk4'"):
        SolverSPO(model, contacts="ground", integrator="rk4")
    with pytest.raises(UnsupportedError, match="contacts='ground' with granularity='node'"):
        SolverSPO(model, contacts="ground", granularity="node")
    with pytest.warns(UserWarning, match="bodies pass through shapes.*integrator='midpoint' have no contacts") as seen:
        assert not SolverSPO(model, integrator="midpoint").dynamics.scene.contacts
    assert seen[0].filename == __file__
    obstacle = boxes(lambda b: (plane()(b), block(b)))
    with pytest.warns(UserWarning, match="bodies pass through shapes.*substeps take no list of contacts") as seen:
        assert not SolverSPO(obstacle, substeps=2).dynamics.scene.contacts
    assert seen[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not SolverSPO(boxes(None), integrator="midpoint").dynamics.scene.contacts  # nothing stands still
