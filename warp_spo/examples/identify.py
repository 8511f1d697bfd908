"""System identification: find masses and damping of an arm from its measured motion, by gradients of simulations.

The record is cut into windows of 20 steps. Each window is a world that starts at the measured state and is simulated
with the measured torques. Gauss-Newton iterations change masses and damping until all windows end where the
measurement says. These values are tensors with a row for each world, so that one backward pass for each coordinate
gives the derivatives of all windows at once.
"""

import numpy as np
import torch
import warp as wp

import warp_spo as spo
from warp_spo.examples.options import command, drawing
from warp_spo.examples.parts import at, bar
from warp_spo.viewing.charts import FAINT, OURS, OURS_DARK

MASSES, DAMPING = [2.0, 1.5, 0.7], [0.5, 0.3, 0.1]  # the true values [kg], [N m s/rad]
DT, WINDOW = 2e-3, 20  # time step [s], steps of a window
UNITS = np.repeat([1e-4, 2e-3], 3)  # standard errors of the measured q [rad] and qd [rad/s]


def scene(masses=(1.0, 1.0, 1.0), damping=(0.0, 0.0, 0.0)):
    """Return an arm of three bars of 0.4 m. The defaults are the guess from which the search starts."""
    axes, places = [(0, 0, 1), (0, 1, 0), (0, 1, 0)], [at(), at(0.4), at(0.4)]
    hinges = [spo.Hinge("revolute", k - 1, k, axis=axes[k], parent_pose=places[k]) for k in range(3)]
    arm = spo.Scene([bar(0.4, 1.0) for _ in hinges], hinges)
    return arm.with_values(body_mass=np.array([masses]), joint_damping=np.array([damping]))


def record(steps, noise, rng):
    """Return measured states (q, qd) [step + 1, 6] of the true arm, and the torques between them [step, 3]."""
    dyn = spo.Dynamics(scene(MASSES, DAMPING), device="cpu", dtype="float64")
    q, qd, states, torques = rng.uniform(-1.0, 1.0, (1, 3)), np.zeros((1, 3)), [], []
    for _ in range(steps):
        torques.append(dyn.gravity_force(q) + rng.normal(0.0, 5.0, (1, 3)))  # holds the weight and shakes the arm
        states.append(np.hstack([q, qd]))
        q, qd = dyn.step(q, qd, torques[-1], DT)
    states = np.concatenate([*states, np.hstack([q, qd])])
    return states + noise * UNITS * rng.normal(size=states.shape), np.concatenate(torques)


def main(worlds=50, noise=1.0, iterations=6, seed=0, device=None, picture=None):
    values = ("body_mass", "joint_damping")
    dyn = spo.Dynamics(scene(), worlds, device, "float64", variable=values, granularity="tree")
    place, measured = wp.device_to_torch(dyn.device), record(worlds * WINDOW, noise, np.random.default_rng(seed))
    states, torques, units = (torch.as_tensor(x, device=place) for x in (*measured, UNITS))
    starts, ends, torques = states[:-1:WINDOW], states[WINDOW::WINDOW], torques.reshape(worlds, WINDOW, 3)
    guesses = [torch.tensor(np.concatenate([dyn.scene.values[name][0] for name in values]), device=place)]
    for _ in range(iterations):
        masses, damping = (x.repeat(worlds, 1).requires_grad_() for x in guesses[-1].split(3))
        dyn.set(body_mass=masses, joint_damping=damping)
        q, qd = starts[:, :3].contiguous(), starts[:, 3:].contiguous()
        for k in range(WINDOW):
            q, qd = dyn.step(q, qd, torques[:, k].contiguous(), DT)
        # Residuals in standard errors, and their derivatives by the six values: a row for each coordinate and window.
        residuals = (torch.cat([q, qd], 1) - ends) / units
        rows = [torch.cat(torch.autograd.grad(column.sum(), (masses, damping), retain_graph=True), 1)
                for column in residuals.unbind(1)]  # fmt: skip
        change = torch.linalg.lstsq(torch.cat(rows), -residuals.detach().T.reshape(-1, 1)).solution
        deviation = torch.linalg.inv(torch.cat(rows).T @ torch.cat(rows)).diagonal().sqrt()
        guesses.append(guesses[-1] + change[:, 0])
    found, right = guesses[-1].cpu().numpy(), np.array(MASSES + DAMPING)
    for value, name, wanted in zip(
        found, ["bar 1", "bar 2", "bar 3", "hinge 1", "hinge 2", "hinge 3"], right, strict=True
    ):
        unit, what = ("kg", "mass") if name.startswith("bar") else ("N m s/rad", "damping")
        print(f"The {what} of {name} is found as {value:.3f} {unit}; the true value is {wanted} {unit}.")
    print("The mass of bar 1 has the largest error: it turns about the vertical, where gravity has no effect.")
    if picture:
        with drawing(picture, "Masses of the bars", "Damping of the hinges") as axes:
            for k, (value, spread, wanted) in enumerate(
                zip(torch.stack(guesses, 1).cpu().numpy(), deviation.cpu().numpy(), right, strict=True)
            ):
                each, color = axes[k // 3], (OURS, OURS_DARK, FAINT)[k % 3]
                each.plot(value, ".-", color=color)
                name = f"{('bar', 'hinge')[k // 3]} {k % 3 + 1} ± 2 standard errors"
                each.errorbar(iterations, value[-1], 2.0 * spread, fmt=".", color=color, capsize=4.0, label=name)
                each.axhline(
                    wanted, color=color, linestyle="--", linewidth=0.8, label="true value" if k % 3 == 2 else None
                )
            for each, name in zip(axes, ("mass [kg]", "damping [N m s/rad]"), strict=True):
                each.set(xlabel="iteration", ylabel=name)
    return np.abs(found - right).max()


if __name__ == "__main__":
    command(main)
