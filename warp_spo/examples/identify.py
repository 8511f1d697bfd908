"""Masses and damping of an arm from its motion: the gradient of the joint forces by each mass is a regressor.

The forces are linear in the masses: tau = tau(m0) + (d tau / d m)(m - m0) + damping qd'. Every state of the trajectory
is a world; one vector-Jacobian product a hinge gives the rows of all of them, and least squares the masses.
"""

import numpy as np

import warp_spo as spo
from warp_spo.examples.parts import at, bar

MASSES, DAMPING = [2.0, 1.5, 0.7], [0.5, 0.3, 0.1]  # what is to be found [kg, N m s]
GUESS = [1.0, 1.0, 1.0]
DT = 2e-3  # [s]


def scene(masses, damping):
    axes, places = [(0, 0, 1), (0, 1, 0), (0, 1, 0)], [at(), at(0.4), at(0.4)]
    hinges = [
        spo.Hinge("revolute", k - 1, k, axis=axes[k], parent_pose=places[k], damping=damping[k]) for k in range(3)
    ]
    arm = spo.Scene([bar(0.4, 1.0) for _ in range(3)], hinges)
    return arm.with_values(body_mass=np.array([masses]))


def trajectory(steps, seed):
    """States and the forces that made them, [step, dof] each: q, qd, qdd, qd after the step, tau."""
    dyn, rng, found = spo.Dynamics(scene(MASSES, DAMPING), dtype="float64"), np.random.default_rng(seed), []
    q, qd = rng.uniform(-1.0, 1.0, (1, 3)), np.zeros((1, 3))
    for _ in range(steps):
        tau, qdd = dyn.gravity_force(q) + rng.normal(0.0, 2.0, (1, 3)), np.zeros((1, 3))
        q_after, qd_after = dyn.step(q, qd, tau, DT, qdd=qdd)
        found.append((q, qd, qdd, qd_after, tau))
        q, qd = q_after, qd_after
    return [np.concatenate(column) for column in zip(*found, strict=True)]


def main(steps=400, seed=0, noise=0.0):
    q, qd, qdd, qd_after, tau = trajectory(steps, seed)
    tau = tau + noise * np.random.default_rng(seed).standard_normal(tau.shape)
    dyn = spo.Dynamics(scene(GUESS, [0.0] * 3), worlds=steps, dtype="float64", variable=("body_mass",))
    rows, left = [], tau - dyn.inverse_dynamics(q, qd, qdd)
    for dof in range(3):
        unit = np.tile(np.eye(3)[dof], (steps, 1))
        by_mass = dyn.inverse_dynamics_vjp(q, qd, qdd, cotangent=unit, wrt=("body_mass",))["body_mass"]
        rows.append(np.concatenate([by_mass, unit * qd_after], axis=1))
    change, *_ = np.linalg.lstsq(np.concatenate(rows), left.T.ravel(), rcond=None)
    masses, damping = GUESS + change[:3], change[3:]
    error = max(np.abs(masses - MASSES).max(), np.abs(damping - DAMPING).max())
    print(f"{steps} states: masses {np.round(masses, 3)} kg, damping {np.round(damping, 3)} N m s, off by {error:.1e}")
    return error


if __name__ == "__main__":
    main()
    main(noise=0.05)
