"""Contacts that SolverSPO's steps leave out: an error, or in a graph capture a status word in the worlds with some."""

import newton
import numpy as np
import pytest
import warp as wp

from support.solver_models import H
from warp_spo import Status
from warp_spo.errors import UnsupportedError
from warp_spo.newton import SolverSPO

RADIUS = 0.2
HEIGHTS = (1.0, 0.15, 2.0)  # [m], of the spheres in three worlds; the second is in the ground


@pytest.fixture(scope="module")
def made():
    builder = newton.ModelBuilder()
    ball = builder.add_link(label="ball")
    builder.add_shape_sphere(ball, radius=RADIUS)
    builder.add_articulation([builder.add_joint_free(ball)])
    all_worlds = newton.ModelBuilder()
    all_worlds.replicate(builder, 3)
    all_worlds.add_ground_plane()
    model = all_worlds.finalize(device="cpu")
    return model, SolverSPO(model, contacts="none")


def start(model, heights=HEIGHTS):
    state, q = model.state(), model.joint_q.numpy().reshape(3, -1)
    q[:, 2] = heights
    state.joint_q.assign(q.ravel())
    newton.eval_fk(model, state.joint_q, state.joint_qd, state)
    return state


def listed(*shapes, count=None):
    """Newton's list of contacts of these pairs of shapes; shapes 0, 1, 2 are the spheres, 3 is the ground."""
    contacts = newton.Contacts(2, 0, device="cpu")
    put(contacts, *shapes, count=count)
    return contacts


def put(contacts, *shapes, count=None):
    pairs = np.full((2, 2), -1, np.int32)
    pairs[: len(shapes)] = shapes if shapes else pairs[:0]
    contacts.rigid_contact_shape0.assign(pairs[:, 0])
    contacts.rigid_contact_shape1.assign(pairs[:, 1])
    contacts.rigid_contact_count.assign(np.array([len(shapes) if count is None else count], np.int32))


def test_contacts_are_refused(made):
    """Outside of a capture their count is read; a capacity is no contact."""
    model, solver = made
    state = start(model)
    solver.step(state, state, None, listed(), H)
    with pytest.raises(UnsupportedError, match=r"SolverSPO.step: 1 contacts"):
        solver.step(state, state, None, listed((1, 3)), H)
    assert not solver.status.numpy().any()


@pytest.mark.parametrize("observed", [False, True])
def test_a_graph_marks_worlds_with_contacts(made, observed):
    """The device counts at every replay; a world keeps its word until it is reset."""
    model, solver = made
    state, contacts, seen = start(model), listed(), solver.observables({"status"}) if observed else None
    with wp.ScopedCapture(device=model.device) as capture:
        solver.step(state, state, None, contacts, H, observables=seen)
    put(contacts, (1, 3))
    wp.capture_launch(capture.graph)
    assert solver.status.numpy().tolist() == [Status.OK, Status.UNSUPPORTED, Status.OK]
    moved = state.joint_q.numpy().reshape(3, -1)[:, 2] - HEIGHTS
    np.testing.assert_allclose(moved, -9.81 * H**2, atol=1e-6)  # contacts are left out, the step is not
    for pairs, now, kept in (((), [0, 0, 0], [0, 10, 0]), (((3, 0),), [10, 0, 0], [10, 10, 0])):
        put(contacts, *pairs)
        wp.capture_launch(capture.graph)
        assert solver.status.numpy().tolist() == kept
        if observed:
            assert seen.status.numpy().tolist() == now
    solver.reset(state, flags=0)
    assert solver.status.numpy().tolist() == [10, 10, 0]
    solver.reset(state, wp.array([True, False, False, False], dtype=wp.bool, device="cpu"))
    assert solver.status.numpy().tolist() == [0, 10, 0]
    solver.reset(state)
    assert not solver.status.numpy().any()


@pytest.mark.slow
def test_contacts_that_newton_finds(made):
    model, solver = made
    pipeline = newton.CollisionPipeline(model)
    state, contacts = start(model), pipeline.contacts()
    with wp.ScopedCapture(device=model.device) as capture:
        pipeline.collide(state, contacts)
        solver.step(state, state, None, contacts, H)
    wp.capture_launch(capture.graph)
    assert contacts.rigid_contact_count.numpy()[0] == 1
    assert solver.status.numpy().tolist() == [Status.OK, Status.UNSUPPORTED, Status.OK]
    solver.reset(state)


def test_a_more_severe_word_stays(made):
    """World 1 has a NaN; where there are more contacts than the list holds, any world may have one."""
    model, solver = made
    state, contacts, seen = start(model), listed(), solver.observables({"status"})
    f = state.body_f.numpy().copy()
    f[1] = np.nan
    with wp.ScopedCapture(device=model.device) as capture:
        solver.step(state, state, None, contacts, H, observables=seen)
    for pairs, count, expected in ((((1, 3),), 1, [0, 2, 0]), (((1, 3), (2, 0)), 2, [0, 2, 10]),
                                   (((1, 3), (1, 3)), 3, [10, 2, 10]), (((3, -1),), 1, [0, 2, 0])):  # fmt: skip
        put(contacts, *pairs, count=count)
        state.assign(start(model))
        state.body_f.assign(f)
        wp.capture_launch(capture.graph)
        assert seen.status.numpy().tolist() == expected
    solver.reset(state)
