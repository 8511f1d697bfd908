"""body_poses against newton.eval_fk, quaternions with their signs."""

import newton
import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support.newton_models import finalize, permuted_builder, random_state
from support.solver_models import floating, moving, replicated
from warp_spo.newton import SolverSPO, from_newton

FLOAT32_FK = 2e-5  # float32 forward kinematics of Newton over six turned joints


def eval_fk(model, q):
    """Newton's body_q [body, 7]."""
    state = model.state()
    newton.eval_fk(model, wp.array(q, dtype=wp.float32, device=model.device), model.joint_qd, state)
    return state.body_q.numpy()


def flip(rng, array):
    """Change the signs of some quaternions of an array of poses."""
    poses = array.numpy()
    poses[:, 3:] *= rng.choice([-1.0, 1.0], (len(poses), 1))
    array.assign(poses)


@pytest.mark.filterwarnings("ignore:from_newton")
@pytest.mark.parametrize("granularity", ["node", pytest.param("segment", marks=pytest.mark.slow), "tree"])
def test_signs_of_quaternions(granularity, rng):
    """At angles beyond a half turn, with anchors whose quaternions have either sign, bodies in any order."""
    model = finalize(permuted_builder(rng, robots=1))
    for name in ("joint_X_p", "joint_X_c"):
        flip(rng, getattr(model, name))
    scene = from_newton(model)
    dyn = spo.Dynamics(scene, 4, "cpu", granularity=granularity)
    q, _ = zip(*(random_state(model, rng) for _ in range(4)), strict=True)
    q = np.where(np.abs(q) > 1.0, 4.0 * np.array(q), q)  # no entry of a quaternion
    for got, row in zip(dyn.body_poses(q[:, scene.q_index[0]]), q, strict=True):
        np.testing.assert_allclose(got, eval_fk(model, row), atol=FLOAT32_FK * 10.0)


def test_signs_that_differ_between_worlds(rng):
    """Then the anchors are no constants, and no code that is generated for the scene computes the poses."""
    model = replicated(floating(np.random.default_rng(3)), 3)
    for name in ("joint_X_p", "joint_X_c"):
        flip(rng, getattr(model, name))
    state, solver = moving(model), SolverSPO(model)
    wanted = eval_fk(model, state.joint_q)
    solver.step(state, state, None, None, 1e-9)
    np.testing.assert_allclose(state.body_q.numpy(), wanted, atol=FLOAT32_FK)
