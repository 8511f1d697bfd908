"""SolverSPO on height fields whose elevations change, and gradients by them through wp.Tape."""

import itertools

import newton
import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support.solver_grounds import H, boxes, field, plane
from warp_spo.newton import SolverSPO

ELEVATIONS = "heightfield_elevations"
FLOAT32 = 5e-6  # of the largest entry; 2e-7 measured


def tilted(model, worlds):
    """A state in which cubes fall onto the field with an edge or a corner first."""
    rng, state = np.random.default_rng(0), model.state(requires_grad=True)
    q, qd = state.joint_q.numpy().reshape(worlds, 7), rng.normal(size=(worlds, 6)).astype(np.float32)
    q[:, :2] += rng.uniform(-0.7, 0.7, (worlds, 2)).astype(np.float32)
    q[:, 3:] += 0.2 * rng.normal(size=(worlds, 4)).astype(np.float32)
    q[:, 3:] /= np.linalg.norm(q[:, 3:], axis=1, keepdims=True)
    q[:, 2] -= 0.1
    state.joint_q.assign(q.ravel())
    state.joint_qd.assign(qd.ravel())
    return state, q, qd


GROUNDS = {
    "one for all": ([None] * 3, field(1)),
    "two are alike": ([field(1), field(2, at=(0.3, 0.1, -0.02)), field(1)], None),
}


@pytest.mark.slow
@pytest.mark.parametrize("ground, passes", [("one for all", 4), ("two are alike", 3)])
def test_a_tape_differentiates_elevations(ground, passes):
    """By each elevation of each shape, against differences in float64; twice, the second time added to the first."""
    grounds, everywhere = GROUNDS[ground]
    model, steps = boxes(*grounds, everywhere=everywhere), 3
    model.heightfield_elevations.requires_grad = True
    solver = SolverSPO(model, variable=(ELEVATIONS,), passes=passes)
    first, q, qd = tilted(model, 3)
    states, tape = [first, *(model.state(requires_grad=True) for _ in range(steps))], wp.Tape()
    with tape:
        for before, after in itertools.pairwise(states):
            solver.step(before, after, None, None, H)
    seeds = np.random.default_rng(1).normal(size=(3, 6)).astype(np.float32)
    tape.backward(grads={states[-1].joint_qd: wp.array(seeds.ravel(), device="cpu")})
    found = model.heightfield_elevations.grad.numpy()

    scene = solver.dynamics.scene
    heights = scene.values["ground_heights"][0]
    dyn = spo.Dynamics(scene, 3, "cpu", "float64", variable=("ground_heights",))
    fields = heights.reshape(-1, *heights.shape[-2:])
    low, high = fields.min(axis=(1, 2)), fields.max(axis=(1, 2))
    elevations = ((fields - low[:, None, None]) / (high - low)[:, None, None]).transpose(0, 2, 1).ravel()
    np.testing.assert_allclose(model.heightfield_elevations.numpy(), elevations, atol=1e-6)

    def last(elevations):
        unit = elevations.reshape(len(fields), *fields.shape[:0:-1]).transpose(0, 2, 1)
        dyn.set(ground_heights=(low[:, None, None] + (high - low)[:, None, None] * unit).reshape(heights.shape))
        after, rate = q.astype(float), qd.astype(float)
        for _ in range(steps):
            after, rate = dyn.step(after, rate, None, H, options=spo.StepOptions(passes=passes))
        return (rate * seeds).sum()

    touched = np.flatnonzero(found)
    assert 8 <= len(touched) < found.size
    wanted, nudge = np.zeros(found.size), 1e-6
    for at in (*touched, *np.flatnonzero(found == 0.0)[::20]):
        unit = nudge * np.eye(found.size)[at]
        wanted[at] = (last(elevations + unit) - last(elevations - unit)) / (2.0 * nudge)
    np.testing.assert_allclose(found, wanted, atol=FLOAT32 * abs(wanted).max())


@pytest.mark.slow
def test_a_solver_reads_elevations():
    """After a change and its announcement, by launches alone if they are variable, else with a warning."""
    for variable in ((ELEVATIONS,), ()):
        model = boxes(None, None, everywhere=field(1))
        solver, scene = SolverSPO(model, variable=variable), spo.from_newton(model, contacts="ground")
        state, *_ = tilted(model, 2)
        end, mine = model.state(), spo.Dynamics(scene, 2, "cpu", variable=("ground_heights",) if variable else ())
        for more in (0.0, 0.2):
            model.heightfield_elevations.assign(model.heightfield_elevations.numpy() + more)
            if more and not variable:
                with pytest.warns(UserWarning, match=ELEVATIONS):
                    solver.notify_model_changed(newton.ModelFlags.SHAPE_PROPERTIES)
            else:
                solver.notify_model_changed(newton.ModelFlags.SHAPE_PROPERTIES)
            solver.step(state, end, None, None, H)
            heights = spo.from_newton(model, contacts="ground").values["ground_heights"][0]
            if variable:
                mine.set(ground_heights=heights)
            else:
                mine = spo.Dynamics(scene.with_values(ground_heights=heights), 2, "cpu")
            wanted = mine.step(*(x.numpy().reshape(2, -1) for x in (state.joint_q, state.joint_qd)), None, H)[1]
            np.testing.assert_allclose(end.joint_qd.numpy().reshape(2, 6), wanted, atol=1e-4)


def test_elevations_without_a_field():
    with pytest.raises(spo.UnsupportedError, match="variable='heightfield_elevations' of a model whose ground is no"):
        SolverSPO(boxes(plane(0.0)), variable=(ELEVATIONS,))
