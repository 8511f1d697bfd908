"""Operational-space control of a floating robot: an arm on a free base draws a circle that is fixed in space.

Nothing holds the base, so the arm's motion moves it. The acceleration of the hand is
a = J Mass^-1 (S* tau - bias_force) + dJ/dt qd, where S selects the arm's hinges. The torques tau that give the hand the
acceleration it needs are the solution of a system of three equations in each world.
"""

import numpy as np

import warp_spo as spo
from warp_spo.examples.options import band, command, drawing
from warp_spo.examples.parts import at, bar
from warp_spo.viewing.charts import FAINT, OURS, log_axis

RADIUS, PERIOD = 0.1, 2.0  # of the circle [m], [s]
STIFF, DAMP = 400.0, 40.0  # gains on the hand's errors in position [1/s^2] and velocity [1/s]


def scene(gravity=(0.0, 0.0, 0.0)):
    """Return a base of 40 kg with an arm of six hinges. The hand is the end of the last bar."""
    bodies, hinges = [spo.Body(40.0, (0, 0, 0), np.diag([2.0, 2.0, 2.0]))], [spo.Hinge("free", -1, 0)]
    for k, axis in enumerate([(0, 0, 1), (0, 1, 0), (0, 1, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]):
        bodies.append(bar(0.3, 2.0))
        hinges.append(spo.Hinge("revolute", k, k + 1, axis=axis, parent_pose=at(0.3 * (k > 0)), armature=0.01))
    return spo.Scene(bodies, hinges, gravity=gravity)


def main(seconds=2.0, dt=2e-3, worlds=4, seed=0, device=None, picture=None):
    dyn = spo.Dynamics(scene(), worlds, device, "float64")
    hand, rng = [(6, (0.3, 0, 0, 0, 0, 0, 1))], np.random.default_rng(seed)
    q, qd = np.tile(dyn.scene.neutral_q, (worlds, 1)), 0.02 * rng.standard_normal((worlds, 12))
    q[:, 7:] = [0.2, 0.7, -1.3, 0.3, 0.5, 0.2] + 0.1 * rng.standard_normal((worlds, 6))
    arm = np.repeat(np.eye(12)[None, :, 6:], worlds, axis=0)  # S*: the base has dofs 0 to 5
    center, errors, path = place(dyn, q), [], []
    for step in range(round(seconds / dt)):
        angle, rate = 2.0 * np.pi * step * dt / PERIOD, 2.0 * np.pi / PERIOD
        # Position, velocity and acceleration on the circle, relative to where the hand started.
        circle = RADIUS * np.array([[0.0, np.cos(angle) - 1.0, np.sin(angle)],
                                    [0.0, -rate * np.sin(angle), rate * np.cos(angle)],
                                    [0.0, -(rate**2) * np.cos(angle), -(rate**2) * np.sin(angle)]])  # fmt: skip
        J = dyn.jacobian(q, hand)[:, 0, :3]
        error, slip = center + circle[0] - place(dyn, q), circle[1] - np.einsum("wij,wj->wi", J, qd)
        wanted = circle[2] + STIFF * error + DAMP * slip
        # Mass^-1 of a unit torque at each hinge, and of the bias force, in one solve with seven columns.
        solved = dyn.solve_mass_matrix(q, np.concatenate([arm, dyn.bias_force(q, qd)[:, :, None]], axis=2))
        reach = J @ solved  # the hand's acceleration by each torque, and by the bias force
        wanted += reach[:, :, 6] - dyn.jacobian_bias(q, qd, hand)[:, 0, :3]
        calm = -0.2 * qd[:, 6:]  # damps motions of the arm that leave the hand where it is
        need = wanted - np.einsum("wij,wj->wi", reach[:, :, :6], calm)
        tau = np.zeros((worlds, 12))
        tau[:, 6:] = calm + np.einsum("wij,wj->wi", np.linalg.pinv(reach[:, :, :6]), need)
        q, qd = dyn.step(q, qd, tau, dt)
        errors.append(np.linalg.norm(error, axis=1))
        path.append(np.stack([center + circle[0] - error, q[:, :3]]))
    late, drift = np.max(errors[len(errors) // 2 :]), np.linalg.norm(q[:, :3], axis=1).max()
    print(
        f"In the second half of {seconds} s the hand is within {1e3 * late:.1f} mm of its circle, in {worlds} worlds."
    )
    print(f"The base, which nothing holds, has moved by up to {1e3 * drift:.0f} mm.")
    if picture:
        with drawing(picture, "Paths, seen along x", "Error of the hand: lower is better") as axes:
            for k, (name, color) in enumerate((("hand", OURS), ("base", FAINT))):
                lines = axes[0].plot(*np.moveaxis(np.array(path)[:, k, :, 1:], -1, 0), color=color, linewidth=1.2)
                lines[0].set_label(f"{name} in {worlds} worlds")
            axes[0].set(aspect="equal", xlabel="y [m]", ylabel="z [m]")
            band(axes[1], dt * np.arange(len(errors)), 1e3 * np.array(errors), OURS, "hand")
            log_axis(axes[1].yaxis, 1e3 * np.ravel(errors[5:]), "{:g}".format)
            axes[1].set(xlabel="time [s]", ylabel="distance from the circle [mm]")
    return late


def place(dyn, q):
    """Return the hand's position [world, 3]."""
    return dyn.frame_poses(q, [(6, at(0.3))])[:, 0, :3]


if __name__ == "__main__":
    command(main)
