"""The operations at node granularity: each is a sequence of sweeps with one launch a level, and serves every scene.

``run`` launches the sweeps of the scene. ``out`` and the arguments are Warp arrays [world, ...] as those of the method
of :class:`Dynamics` with the same name; an absent argument is None.
"""

from __future__ import annotations

import warp as wp

from ...kernels import articulated, body_sums, declare, kinematics
from .sweeps import Sweeps


def forward_dynamics(
    run: Sweeps,
    out: wp.array,
    q: wp.array,
    qd: wp.array | None = None,
    tau: wp.array | None = None,
    body_f: wp.array | None = None,
) -> None:
    run.hinges(q, qd)
    force = None
    if qd is not None or body_f is not None:
        # the outward sweep adds gravity as the acceleration of the base, so that it cancels with no velocity term
        alpha, velocity = run.accelerations(None, True, gravity=False) if qd is not None else (None, None)
        force = run.body_forces(alpha, velocity, body_f)
    run.factor()
    run.solve(tau, out, force, gravity=True)


def inverse_dynamics(
    run: Sweeps,
    out: wp.array,
    q: wp.array,
    qd: wp.array | None = None,
    qdd: wp.array | None = None,
    body_f: wp.array | None = None,
    gravity: bool = True,
) -> None:
    run.hinges(q, qd)
    force = run.body_forces(*run.accelerations(qdd, qd is not None, gravity), body_f)
    run.hinge_forces(qdd, force, out)


def mass_matrix(run: Sweeps, out: wp.array, q: wp.array) -> None:
    run.hinges(q)
    run.mass_matrix(out)


def mass_matrix_inverse(run: Sweeps, out: wp.array, q: wp.array) -> None:
    run.hinges(q)
    run.factor()
    run.inverse_product(None, run.scene.dof_count, out)


def solve_mass_matrix(run: Sweeps, out: wp.array, q: wp.array, b: wp.array) -> None:
    run.hinges(q)
    run.factor()
    run.solve(b, out)


def log_det_mass_matrix(run: Sweeps, out: wp.array, q: wp.array) -> None:
    run.hinges(q)
    run.launch_nodes(articulated.log_determinant, run.worlds, [run.factor()], [out])


def body_poses(run: Sweeps, out: wp.array, q: wp.array) -> None:
    run.hinges(q)
    run.launch_nodes(kinematics.body_poses, run.nodes, [run.world_poses(), run.parameters.anchor], [out])
    run.quaternion_signs(q, out)


def body_velocities(run: Sweeps, out: wp.array, q: wp.array, qd: wp.array) -> None:
    run.hinges(q, qd)
    inputs = [run.world_poses(), run.parameters.com, run.velocities()]
    run.launch_nodes(kinematics.body_velocities, run.nodes, inputs, [out])


def body_states(run: Sweeps, out: wp.array, q: wp.array, qd: wp.array, velocities_out: wp.array) -> None:
    body_poses(run, out, q)
    body_velocities(run, velocities_out, q, qd)


def frame_poses(run: Sweeps, out: wp.array, q: wp.array, frames: tuple) -> None:
    of_bodies = run.array("body poses", run.worlds, run.scene.body_count, 7)
    body_poses(run, of_bodies, q)
    run.launch_nodes(kinematics.frame_poses, out.shape[1::-1], [*run.frames(frames), of_bodies], [out])


def frame_velocities(run: Sweeps, out: wp.array, q: wp.array, qd: wp.array, frames: tuple) -> None:
    run.hinges(q, qd)
    inputs = [*run.frames(frames), run.parameters.anchor, run.world_poses(), run.velocities()]
    run.launch_nodes(kinematics.frame_velocities, out.shape[1::-1], inputs, [out])


def com(run: Sweeps, out: wp.array, q: wp.array) -> None:
    declare(body_sums, run.functions)
    run.hinges(q)
    inputs = [run.topology, run.parameters.rigid, run.world_poses()]
    run.launch_nodes(body_sums.center_of_mass, run.worlds, inputs, [out])


def com_velocity(run: Sweeps, out: wp.array, q: wp.array, qd: wp.array) -> None:
    declare(body_sums, run.functions)
    run.hinges(q, qd)
    inputs = [run.topology, run.parameters.rigid, run.world_poses(), run.velocities()]
    run.launch_nodes(body_sums.center_of_mass_velocity, run.worlds, inputs, [out])


def kinetic_energy(run: Sweeps, out: wp.array, q: wp.array, qd: wp.array) -> None:
    declare(body_sums, run.functions)
    run.hinges(q, qd)
    inputs = [run.parameters.rigid, run.velocities(), run.parameters.field("joint_armature"), qd]
    run.launch_nodes(body_sums.kinetic_energy, run.worlds, inputs, [out])


def jacobian(run: Sweeps, out: wp.array, q: wp.array, frames: tuple) -> None:
    run.hinges(q)
    run.jacobian(*run.frames(frames), out)


def operational_inertia_inverse(run: Sweeps, out: wp.array, q: wp.array, frames: tuple) -> None:
    rows, dofs = 6 * len(frames), run.scene.dof_count
    run.hinges(q)
    J = run.array(("jacobian", len(frames)), run.worlds, len(frames), 6, dofs)
    run.jacobian(*run.frames(frames), J)
    run.factor()
    run.inverse_product(J.reshape((run.worlds, rows, dofs)).transpose((0, 2, 1)), rows, out)
