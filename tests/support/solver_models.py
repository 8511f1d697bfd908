"""Newton models for SolverSPO, random states of them, and rollouts."""

import newton
import numpy as np
import warp as wp

from warp_spo.newton import SolverSPO, from_newton

from .newton_models import add_joint, add_link, finalize

H = 2e-3
FLOAT32 = 2e-5  # of velocities of the order of 1 after some steps


def replicated(builder, worlds):
    both = newton.ModelBuilder()
    both.replicate(builder, worlds)
    return finalize(both)


def floating(rng, permute=False, anchor=True):
    """A free body and two links on it; ``permute`` numbers the bodies the other way round."""
    builder = newton.ModelBuilder()
    seeds = rng.integers(1 << 30, size=6)
    order = [2, 1, 0] if permute else [0, 1, 2]
    bodies = {}
    for k in order:
        bodies[k] = add_link(builder, np.random.default_rng(seeds[k]), f"body{k}")
    joints = []
    for k, (kind, parent) in enumerate((("free", -1), ("revolute", 0), ("revolute", 1))):
        over = -1 if parent < 0 else bodies[parent]
        joints.append(add_joint(builder, np.random.default_rng(seeds[3 + k]), kind, over, bodies[k], f"joint{k}"))
    builder.add_articulation(joints, label="robot")
    return builder


def moving(model, seed=0):
    """A state with random coordinates and velocities, unit quaternions; each world another."""
    rng, state = np.random.default_rng(seed), model.state()
    scene = from_newton(model)
    q = rng.uniform(-0.5, 0.5, model.joint_coord_count)
    for row in scene.q_index:
        for hinge, start in zip(scene.hinges, scene.q_start, strict=False):
            if hinge.coord_count > hinge.dof_count:
                entries = row[start + hinge.coord_count - 4 : start + hinge.coord_count]
                q[entries] = rng.normal(size=4)
                q[entries] /= np.linalg.norm(q[entries])
    state.joint_q.assign(q.astype(np.float32))
    state.joint_qd.assign(rng.normal(size=model.joint_dof_count).astype(np.float32))
    newton.eval_fk(model, state.joint_q, state.joint_qd, state)
    return state


def advance(solver, state, steps=1, control=None, h=H, **more):
    other = solver.model.state()
    for _ in range(steps):
        solver.step(state, other, control, None, h, **more)
        state, other = other, state
    return state


def rotation(pose):
    from .oracles import rotation as of_quaternion  # needs Pinocchio, which tests of a GPU do without

    return of_quaternion(pose[3:].astype(float))


def same_poses(a, b, tolerance):
    np.testing.assert_allclose(a[:, :3], b[:, :3], atol=tolerance)
    np.testing.assert_allclose(np.abs((a[:, 3:] * b[:, 3:]).sum(axis=1)), 1.0, atol=tolerance)


def turned_model():
    """A model whose free joint has turned and offset anchors and a CoM beside the frame, and its solver."""
    model = replicated(floating(np.random.default_rng(3)), 2)
    model.joint_limit_upper.fill_(1e10)
    model.joint_limit_lower.fill_(-1e10)
    for name in (
        "joint_damping",
        "joint_stiffness",
        "joint_friction",
        "joint_armature",
        "joint_target_ke",
        "joint_target_kd",
    ):
        getattr(model, name).zero_()
    model.joint_target_mode.zero_()
    model.joint_velocity_limit.fill_(1e6)
    return model, SolverSPO(model)


def wheel(mode, **values):
    builder = newton.ModelBuilder()
    link = builder.add_link(mass=1.0, inertia=wp.mat33(*np.eye(3).ravel()))
    joint = builder.add_joint_revolute(-1, link, axis=(0, 0, 1), target_ke=40.0, target_kd=3.0, actuator_mode=mode,
                                       **values)  # fmt: skip
    builder.add_articulation([joint])
    return finalize(builder)


OPEN = (0.3, -1.3, 2.0)  # joint angles that do not meet
BARS = (0.4, 0.9, 0.7)


def fourbar(loop=None):
    """Bars of 0.4, 0.9 and 0.7 m between pins 1 m apart; the second pin belongs to no articulation."""
    builder = newton.ModelBuilder()
    over, joints, pose = -1, [], lambda x: wp.transform((x, 0, 0), wp.quat_identity())
    for k, length in enumerate(BARS):
        inertia = np.diag([0.05, 1.0, 1.0]) * length**2 / 12.0
        link = builder.add_link(mass=1.0, com=wp.vec3(0.5 * length, 0, 0), inertia=wp.mat33(inertia), label=f"bar{k}")
        at = pose(BARS[k - 1] if k else 0.0)
        joints.append(builder.add_joint_revolute(over, link, axis=(0, 1, 0), parent_xform=at, label=f"joint{k}"))
        over = link
    builder.add_joint_revolute(
        -1, over, axis=(0, 1, 0), parent_xform=pose(1.0), child_xform=pose(BARS[2]), label="pin", **loop or {}
    )
    builder.add_articulation(joints, label="fourbar")
    for joint, angle in zip(joints, OPEN, strict=True):
        builder.joint_q[joint] = angle
    builder.joint_q[3] = 0.25  # the pin's own entry
    return builder
