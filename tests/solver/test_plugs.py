"""Where Newton's own parts take their inertia from SolverSPO; Isaac Lab by a stand-in of the interface it documents."""

import contextlib
import dataclasses
import re
from pathlib import Path

import newton
import numpy as np
import pytest
import warp as wp
from newton.actuators import JointSpaceResponse
from newton.controllers import ControllerOperationalSpaceModelFree

import warp_spo.newton
from benchmarks.blocks import ROOT
from support.newton_models import arm
from support.solver_models import floating, moving, replicated
from warp_spo.newton import SolverSPO
from warp_spo.newton.isaaclab import adapter
from warp_spo.reference.dense import Dense


@pytest.fixture(scope="module")
def made():
    builder = floating(np.random.default_rng(3))
    model = replicated(builder, 2)
    return model, SolverSPO(model)


def test_joint_space_response_from_our_solve(made):
    """Newton's inverse blocks, filled column by column, are the inverse mass matrix; and Newton's own for an arm."""
    model, solver = made
    state = moving(model)
    response = JointSpaceResponse(model)
    response.refresh_from_solve(solver.solve_inverse(state), dof_map=solver.dof_map)
    q = state.joint_q.numpy().reshape(2, -1)
    for w in range(2):
        wanted = np.linalg.inv(Dense(solver.dynamics.scene, q[w]).mass_matrix)
        got = response.inverse_blocks.numpy()[w]
        np.testing.assert_allclose(got, wanted, atol=2e-5 * np.abs(wanted).max())

    builder = arm(joints=3, axis=(0, 1, 0), parent_xform=wp.transform((0.3, 0.1, 0.2), wp.quat_identity()))
    model = replicated(builder, 2)
    solver, state, both = SolverSPO(model), moving(model), JointSpaceResponse(model)
    both.refresh(state)
    theirs = both.inverse_blocks.numpy().copy()
    both.refresh_from_solve(solver.solve_inverse(state))
    np.testing.assert_allclose(both.inverse_blocks.numpy(), theirs, atol=2e-5 * np.abs(theirs).max())


def test_inputs_of_operational_space_control():
    rng = np.random.default_rng(1)
    builder = newton.ModelBuilder()
    joints, parent = [], -1
    for k in range(7):
        com, inertia = wp.vec3(*rng.uniform(-0.2, 0.2, 3)), wp.mat33(*np.eye(3).ravel())
        link = builder.add_link(mass=1.0, com=com, inertia=inertia)
        pose, axis = wp.transform((0.3, 0, 0), wp.quat_identity()), wp.vec3(*np.eye(3)[k % 3])
        joints.append(builder.add_joint_revolute(parent, link, axis=axis, parent_xform=pose))
        parent = link
    builder.add_articulation(joints)
    model = replicated(builder, 2)
    solver, state = SolverSPO(model), moving(model)
    controller = ControllerOperationalSpaceModelFree(
        controlled_dofs_per_robot=wp.array([7, 7], dtype=wp.int32, device="cpu"),
        motion_stiffness=1.0,
        motion_damping=1.0,
        use_inertia_decoupling=True,
        use_gravity_compensation=True,
        device="cpu",
    )
    inputs = controller.input()
    tool = (6, (0.1, 0.0, 0.2, 0.0, 0.0, 0.0, 1.0))
    solver.operational_space(state, tool, inputs)
    q = state.joint_q.numpy().reshape(2, -1)
    for w in range(2):
        dense = Dense(solver.dynamics.scene, q[w])
        np.testing.assert_allclose(inputs.jacobian_tool_world.numpy()[w], dense.jacobian([tool])[0], atol=1e-5)
        np.testing.assert_allclose(inputs.mass_matrix.numpy()[w], dense.mass_matrix, atol=1e-4)
        np.testing.assert_allclose(inputs.gravity_force.numpy()[7 * w : 7 * w + 7], dense.gravity_force, atol=1e-4)


def test_effective_mass_of_coupled_points(made):
    """By how a point answers a force on it: the inverse of 1/3 of the summed accelerations."""
    model, solver = made
    bodies, places = np.array([1, 5, 3]), np.random.default_rng(0).normal(size=(3, 3)).astype(np.float32)
    mass, inertia = wp.zeros(3, dtype=float, device="cpu"), wp.zeros(3, dtype=wp.mat33, device="cpu")
    arrays = [wp.array(a, dtype=t, device="cpu") for a, t in ((0 * bodies, int), (bodies, int), (places, wp.vec3))]
    solver.coupling_eval_effective_mass_block(*arrays, mass, inertia)
    q = model.joint_q.numpy().reshape(2, -1)
    for i, body in enumerate(bodies):
        world, k = divmod(int(body), 3)
        dense = Dense(solver.dynamics.scene, q[world])
        offset = model.body_com.numpy()[body] + places[i]
        mobility = dense.operational_inertia_inverse([(k, (*offset, 0.0, 0.0, 0.0, 1.0))])
        assert mass.numpy()[i] == pytest.approx(3.0 / np.trace(mobility[:3, :3]), rel=1e-4)
        body_axes = np.array(wp.quat_to_matrix(wp.quat(*dense.body_poses[k, 3:].tolist()))).reshape(3, 3)
        turning = np.linalg.inv(body_axes.T @ mobility[3:, 3:] @ body_axes)
        np.testing.assert_allclose(inertia.numpy()[i], turning, rtol=1e-3, atol=1e-4)
        least = np.linalg.eigvalsh(inertia.numpy()[i] - model.body_inertia.numpy()[body])[0]
        assert least > -1e-4
    arrays[0].fill_(1)
    with pytest.raises(ValueError, match="no body"):
        solver.coupling_eval_effective_mass(*arrays, mass)
    for hook in ("prepare_proxy_contacts", "rewind_proxy_body", "harvest_proxy_wrenches"):
        with pytest.raises(NotImplementedError, match="it takes no contacts"):
            getattr(solver, f"coupling_{hook}")(None, None)


class StandInManager:
    """A stand-in for Isaac Lab's NewtonManager, as it is documented: ``_build_solver`` fills four slots."""

    _solver = _use_single_state = _needs_collision_pipeline = _supports_rigid_body_force_input = None

    @classmethod
    def start(cls, model, cfg):
        cfg.class_type._build_solver(model, cfg)


@dataclasses.dataclass
class StandInCfg:
    """A stand-in of NewtonSolverCfg."""

    solver_type: str = "none"


def test_isaac_labs_four_slots(made):
    model, _ = made
    manager, configuration = adapter(StandInManager, StandInCfg)
    assert issubclass(manager, StandInManager) and issubclass(configuration, StandInCfg)
    cfg = configuration(integrator="midpoint", variable=("body_mass",))
    StandInManager.start(model, cfg)
    solver = StandInManager._solver
    assert isinstance(solver, SolverSPO) and solver.integrator == "midpoint"
    assert solver.dynamics.variable == ("body_mass",)
    assert StandInManager._use_single_state is True and StandInManager._needs_collision_pipeline is False
    assert StandInManager._supports_rigid_body_force_input is True
    assert manager._requires_initial_reset_before_graph_capture() is False
    state = moving(model)
    solver.step(state, state, None, None, 1e-3)
    assert np.isfinite(state.joint_q.numpy()).all()


def test_an_older_newton_is_refused_by_its_version(monkeypatch):
    """The lowest version is that of the dependencies."""
    (wanted,) = re.findall(r'"newton>=([\d.]+)"', (ROOT / "pyproject.toml").read_text())
    assert wanted == warp_spo.newton.LOWEST
    for version, refused in (("1.6.1", True), ("1.7.9", True), ("1.8.0", False), ("1.10.0", False), ("unknown", False)):
        monkeypatch.setattr(newton, "__version__", version)
        name = {"__name__": "warp_spo.newton", "__package__": "warp_spo.newton"}
        words = rf"Newton {version} is installed; expected {wanted} or newer: pip install 'newton>={wanted}'"
        with pytest.raises(ImportError, match=words) if refused else contextlib.nullcontext():
            exec(Path(warp_spo.newton.__file__).read_text(), name)
