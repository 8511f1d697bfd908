"""SolverSPO's torsional and rolling friction: where shapes ask for it as SolverMuJoCo has it; on a tape."""

import itertools

import newton
import numpy as np
import pytest
import warp as wp
from newton.solvers import SolverMuJoCo

from warp_spo.newton import SolverSPO

RADIUS, G, H = 0.1, 9.81, 2e-3
SPIN, ROLL = (0.01, 0.03), (0.002, 0.004)  # coefficients of the sphere and of the ground [m]; contacts have the means
NAMES = ("contact_torsional_friction", "contact_rolling_friction")
ShapeConfig = newton.ModelBuilder.ShapeConfig


def model(condim, ground=3, worlds=1, more=0, device="cpu"):
    """A sphere of 4.19 kg that rests on a plane, or several of them apart."""
    builders = newton.ModelBuilder(), newton.ModelBuilder()
    for builder in builders:
        SolverMuJoCo.register_custom_attributes(builder)
    material = [
        ShapeConfig(mu=0.8, mu_torsional=s, mu_rolling=r, ke=1e5, kd=1e3) for s, r in zip(SPIN, ROLL, strict=True)
    ]
    one, all_worlds = builders
    for number in range(1 + more):
        body = one.add_body(xform=((0.5 * number, 0.0, RADIUS), (0.0, 0.0, 0.0, 1.0)))
        one.add_shape_sphere(body, radius=RADIUS, cfg=material[0], custom_attributes={"mujoco:condim": condim})
    all_worlds.replicate(one, worlds)
    all_worlds.add_ground_plane(cfg=material[1])
    made = all_worlds.finalize(device=device)
    condims = made.mujoco.condim.numpy()
    condims[-1] = ground
    made.mujoco.condim.assign(condims)
    return made


@pytest.mark.parametrize(("condim", "ground"), [(1, 3), (4, 1), (3, 6)])
def test_shapes_turn_as_their_condim_says(condim, ground):
    """By the larger of both; without torsional friction a sphere keeps its spin, with it loses mu m g / I."""
    found, most = model(condim, ground), max(condim, ground)
    solver = SolverSPO(found, pairs=[])
    values = solver.dynamics.scene.values
    wanted = [np.mean(both) if most >= least else 0.0 for both, least in ((SPIN, 4), (ROLL, 6))]
    np.testing.assert_allclose([values[name][0, 0] for name in NAMES], wanted, rtol=1e-6)
    state, rates = found.state(), np.zeros(6, np.float32)
    rates[5] = 10.0
    state.joint_qd.assign(rates)
    for _ in range(20):
        solver.step(state, state, None, None, H)
    inertia = found.body_inertia.numpy()[0, 2, 2] / found.body_mass.numpy()[0]
    np.testing.assert_allclose(state.joint_qd.numpy()[5], 10.0 - 20 * H * wanted[0] * G / inertia, rtol=1e-3)


def test_changes_are_taken_and_what_has_no_such_friction_is_named():
    found = model(6)
    solver = SolverSPO(found, pairs=[])
    found.shape_material_mu_rolling.fill_(0.05)
    with pytest.raises(ValueError, match=r"shape_material_mu_rolling is 0\.05"):
        solver.check_model()
    with pytest.warns(UserWarning, match="shape_material_mu_rolling folded into the kernels"):
        solver.notify_model_changed(newton.ModelFlags.SHAPE_PROPERTIES)
    assert solver.dynamics.scene.values[NAMES[1]] == pytest.approx(0.05)
    with pytest.warns(UserWarning, match="contacts of a list have no torsional and no rolling friction"):
        SolverSPO(found, contacts="pipeline", pairs=[])
    with pytest.warns(UserWarning, match="pairs of bodies have no torsional and no rolling friction"):
        solver = SolverSPO(model(4, more=1), pairs="all")
    assert solver.dynamics.scene.values[NAMES[0]] == pytest.approx(np.mean(SPIN))  # of both points with the ground


def test_a_tape_differentiates_steps(device):
    """Of the spin after three steps by the state, against differences."""
    found = model(6, device=device)
    solver = SolverSPO(found, pairs=[], variable=("shape_material_mu",))

    def spin(rates, tape=None):
        states = [found.state(requires_grad=tape is not None) for _ in range(4)]
        states[0].joint_qd.assign(np.asarray(rates, np.float32))
        with tape or wp.ScopedTimer("", active=False):
            for before, after in itertools.pairwise(states):
                solver.step(before, after, None, None, H)
        return states

    start, tape = np.array([0.2, 0.0, 0.0, 0.5, 2.0, 0.01]), wp.Tape()
    states = spin(start, tape)
    seed = wp.array(np.array([0.0, 0.0, 0.0, 1.0, 2.0, 3.0], np.float32), device=device)
    tape.backward(grads={states[-1].joint_qd: seed})
    gradient = states[0].joint_qd.grad.numpy()
    for dof in (0, 4, 5):
        by = np.zeros(6)
        by[dof] = 2e-3
        ends = [spin(start + sign * by)[-1].joint_qd.numpy() @ seed.numpy() for sign in (1.0, -1.0)]
        assert abs((ends[0] - ends[1]) / 4e-3 - gradient[dof]) <= 2e-3 * abs(gradient).max()
