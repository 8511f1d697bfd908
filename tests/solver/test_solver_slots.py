"""Contacts that SolverSPO takes from a list, as newton.CollisionPipeline makes it: slots of shapes, excess, order."""

import newton
import numpy as np
import pytest
import warp as wp

from support.solver_grounds import CFG, SIDE, WEIGHT, block, boxes, plane, run, spheres
from support.solver_models import H
from warp_spo import Status
from warp_spo.errors import UnsupportedError
from warp_spo.kernels import newton_contact_slots
from warp_spo.newton import SolverSPO
from warp_spo.scene import ground

RADIUS, PLANE = 0.19, 4  # of the spheres; index of the plane's shape
ROUNDING = 2e-6  # of float32, in metres, after three steps
SPIN = 2e-4  # in radians a second: friction at a slip near eps turns rounding of a place into 6e-5, measured


@pytest.fixture(scope="module")
def made():
    model = spheres()
    return model, SolverSPO(model, contacts="pipeline"), SolverSPO(model, pairs=[])


def listed(rows, room=32, count=None):
    """A list of contacts: shape, other shape, and whether the first of them comes first; spheres on the plane z = 0."""
    contacts = newton.Contacts(room, 0, device="cpu")
    arrays = {name: getattr(contacts, f"rigid_contact_{name}").numpy() for name in (
        "shape0", "shape1", "point0", "point1", "margin0", "margin1", "normal")}  # fmt: skip
    for i, (own, other, first, at) in enumerate(rows[:room]):
        a, b = ("0", "1") if first else ("1", "0")
        arrays[f"shape{a}"][i], arrays[f"shape{b}"][i] = own, other
        arrays[f"point{b}"][i], arrays[f"margin{a}"][i] = at, RADIUS  # the sphere's own point is its centre
        arrays["normal"][i] = [0.0, 0.0, -1.0 if first else 1.0]
    contacts.rigid_contact_count.assign(np.array([len(rows) if count is None else count], np.int32))
    return contacts


def start(model):
    """Spheres that are 1 cm in the ground, just above, in and far above it, and move."""
    state, rng = model.state(), np.random.default_rng(0)
    q = model.joint_q.numpy().reshape(4, 7).copy()
    q[:, 2] = RADIUS + np.array([-0.01, 0.001, -0.002, 0.5])
    qd = rng.normal(size=(4, 6)).astype(np.float32)
    state.joint_q.assign(q.ravel())
    state.joint_qd.assign(qd.ravel())
    newton.eval_fk(model, state.joint_q, state.joint_qd, state)
    return state


def test_listed_contacts_are_those_of_the_ground(made):
    """Whichever shape comes first, and in any order of the list; forces are in the slots of their shapes."""
    model, solver, own = made
    wanted, seen = start(model), solver.observables({"contact_f", "status"})
    seen.contact_f.fill_(np.nan)
    own_seen = own.observables({"contact_f"})
    run(own, wanted, 3, observables=own_seen)
    for order in ([0, 1, 2, 3], [2, 0, 3, 1]):
        state = start(model)
        contacts = listed([(i, PLANE, i % 2 == 0, (0.3 * i, 0.1, 0.0)) for i in order])
        run(solver, state, 3, contacts, observables=seen)
        assert seen.status.numpy().tolist() == own.status.numpy().tolist() == [0, 0]
        for name, tolerance in (("joint_q", ROUNDING), ("joint_qd", SPIN)):
            np.testing.assert_allclose(getattr(state, name).numpy(), getattr(wanted, name).numpy(), atol=tolerance)
        force = seen.contact_f.numpy().reshape(2, 2, 4, 3)
        # A listed point is fixed in its body, a sphere's own lowest point is not: second order in the turn of a step.
        np.testing.assert_allclose(force[:, :, 0], own_seen.contact_f.numpy().reshape(2, 2, 3), atol=0.02, rtol=2e-3)
        assert not force[:, :, 1:].any() and force[:, :, 0, 2].max() > 30.0


def test_without_contacts_bodies_fall(made):
    model, solver, _ = made
    state = start(model)
    before = state.joint_qd.numpy().reshape(4, 6).copy()
    run(solver, state, 1)
    np.testing.assert_allclose(before[:, 2] - state.joint_qd.numpy().reshape(4, 6)[:, 2], 9.81 * H, atol=1e-6)


def test_more_contacts_than_slots_are_named_by_status(made):
    """SLOTS in the world of the shape; the first four of the list count. Beyond the list's room, in every world."""
    model, solver, _ = made
    five = [(2, PLANE, False, (0.1 * i, 0.0, -1.0 if i < 4 else 0.5)) for i in range(5)]
    four = solver.observables({"contact_f", "status"})
    state = start(model)
    run(solver, state, 1, listed([*five, (0, PLANE, True, (0, 0, 0.0))]), observables=four)
    assert four.status.numpy().tolist() == [Status.OK, Status.SLOTS]
    assert solver.status.numpy().tolist() == [Status.OK, Status.SLOTS]
    assert not four.contact_f.numpy().reshape(2, 2, 4, 3)[1].any()  # the fifth alone would push
    solver.reset(state)
    run(solver, start(model), 1, listed([(0, PLANE, True, (0, 0, 0.0))] * 2, room=2, count=3), observables=four)
    assert four.status.numpy().tolist() == [Status.SLOTS, Status.SLOTS]
    solver.reset(state)


def test_slots_hold_the_first_contacts_of_their_shape(made):
    """In the order of the list, whatever lies between them; an empty slot holds no number of a contact."""
    model, solver, _ = made
    owners = [3, 0, 2, 0, 3, 0, 0, 0]  # of each contact in the list
    solver.step(start(model), model.state(), None, listed([(i, PLANE, i % 2 == 0, (0, 0, -1.0)) for i in owners]), H)
    slots = solver._slots._slot.numpy().reshape(4, 4)
    wanted = [[i for i, owner in enumerate(owners) if owner == shape][:4] for shape in range(4)]
    assert [row[row != int(newton_contact_slots.EMPTY)].tolist() for row in slots] == wanted
    solver.reset(model.state())


def test_what_slots_do_not_take_is_named_by_status(made):
    """Two bodies that touch, but not those apart; a belt that moves."""
    model, solver, _ = made
    state = start(model)
    apart, touching = (0, 1, True, (9.0, 0.0, 0.0)), (2, 3, True, (0.0, 0.0, 0.0))
    for rows, words in (([apart], [0, 10]), ([touching], [0, 10])):
        contacts = listed(rows)
        normal = contacts.rigid_contact_normal.numpy()
        normal[0] = [1.0, 0.0, 0.0]
        margin = contacts.rigid_contact_margin1.numpy()
        margin[0] = RADIUS if rows == [apart] else 1.0
        run(solver, state, 1, contacts)
        assert solver.status.numpy().tolist() == ([0, 0] if rows == [apart] else words)
        solver.reset(state)
    contacts = listed([(0, PLANE, True, (0, 0, 0.5))])
    if contacts.rigid_contact_surface_velocity is None:
        contacts.rigid_contact_surface_velocity = wp.zeros(32, dtype=wp.vec3, device="cpu")
    contacts.rigid_contact_surface_velocity.numpy()[0] = [0.1, 0.0, 0.0]
    run(solver, state, 1, contacts)
    assert solver.status.numpy().tolist() == [10, 0]
    solver.reset(state)


def test_a_graph_reads_the_list_at_every_replay(made):
    model, solver, _ = made
    state, contacts = start(model), listed([])
    with wp.ScopedCapture(device="cpu") as capture:
        solver.step(state, state, None, contacts, H)
    for rows in ([(0, PLANE, False, (0.0, 0.0, 0.0))], []):
        copy_list(listed(rows), contacts)
        state.assign(start(model))
        state.joint_qd.zero_()
        wp.capture_launch(capture.graph)
        assert (state.joint_qd.numpy()[2] > -9.81 * H + 1e-3) == bool(rows)  # held up in part, or falling


def copy_list(source, target):
    for name in ("count", "shape0", "shape1", "point0", "point1", "margin0", "margin1", "normal"):
        wp.copy(getattr(target, f"rigid_contact_{name}"), getattr(source, f"rigid_contact_{name}"))


def test_a_slider_does_not_turn():
    """Places of points on it reach no result, and are read all the same: its weight rests on the listed contact."""
    builder = newton.ModelBuilder()
    slider = builder.add_link(mass=2.0)
    builder.add_shape_sphere(slider, radius=RADIUS, cfg=newton.ModelBuilder.ShapeConfig(ke=2e3, kd=40.0, density=0.0))
    turn = wp.transform((0.0, 0.0, 0.0), wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 0.5))
    upward = (0.0, np.sin(0.5), np.cos(0.5))  # in the turned anchors
    joint = builder.add_joint_prismatic(-1, slider, axis=upward, parent_xform=turn, child_xform=turn)
    builder.add_articulation([joint])
    builder.joint_q[:] = [RADIUS - 0.005]
    builder.add_ground_plane(cfg=CFG)
    model = builder.finalize(device="cpu")
    solver, state = SolverSPO(model, contacts="pipeline"), model.state()
    newton.eval_fk(model, state.joint_q, state.joint_qd, state)
    seen = solver.observables({"contact_f"})
    run(solver, state, 300, listed([(0, 1, True, (0.0, 0.0, 0.0))]), observables=seen)
    np.testing.assert_allclose(seen.contact_f.numpy()[0, :, 2], [2.0 * 9.81, 0, 0, 0], rtol=2e-3)


def test_models_that_have_no_slots():
    assert float(newton_contact_slots.AWAY) == ground.AWAY
    with pytest.raises(UnsupportedError, match="contacts of a model without shapes that stand still"):
        SolverSPO(boxes(None), contacts="pipeline")
    with pytest.raises(UnsupportedError, match="contacts='pipeline' with integrator='rk4'"):
        SolverSPO(boxes(plane()), contacts="pipeline", integrator="rk4")


@pytest.mark.slow
def test_cubes_rest_on_obstacles_that_newton_finds():
    """A plane and a block, which only the pipeline knows: heights and forces at rest; a plane of another normal."""

    def ledge(builder):
        block(builder)
        builder.shape_transform[-1] = wp.transform((0.0, 0.0, -1.0 + 0.05), wp.quat_identity())
        builder.shape_material_ke[-1], builder.shape_material_kd[-1] = CFG.ke, CFG.kd

    model = boxes(lambda b: (plane(0.0)(b), ledge(b)), lambda b: (plane(0.08)(b), ledge(b)))
    solver, state, pipeline = SolverSPO(model), model.state(), newton.CollisionPipeline(model)
    contacts, seen = pipeline.contacts(), solver.observables({"contact_f", "status"})
    for _ in range(400):
        pipeline.collide(state, contacts)
        solver.step(state, state, None, contacts, H, observables=seen)
    assert not seen.status.numpy().any()
    np.testing.assert_allclose(seen.contact_f.numpy()[..., 2].sum(axis=1), WEIGHT, rtol=1e-3)
    height = state.joint_q.numpy().reshape(2, 7)[:, 2]
    np.testing.assert_allclose(height, np.array([0.05, 0.08]) + SIDE / 2 - WEIGHT / (4 * CFG.ke), atol=2e-3)
