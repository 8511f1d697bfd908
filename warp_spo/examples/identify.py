"""Masses and damping of an arm from its motion, by gradients of rollouts: Gauss and Newton's iteration.

The record is cut into windows, each a world that starts where it was measured. Masses and damping are tensors with a
row for each world, so one backward pass for a coordinate gives the rows of the regressor of all windows.
"""

import numpy as np
import torch

import warp_spo as spo
from warp_spo.examples.parts import at, bar, command, drawing
from warp_spo.trials.drawing import FAINT, OURS, OURS_DARK

MASSES, DAMPING = [2.0, 1.5, 0.7], [0.5, 0.3, 0.1]  # what is to be found [kg, N m s]
DT, WINDOW = 2e-3, 20  # [s, steps]
UNITS = np.repeat([1e-4, 2e-3], 3)  # how well q and qd are measured [rad, rad/s]


def scene(masses=(1.0, 1.0, 1.0), damping=(0.0, 0.0, 0.0)):
    """Bars of 0.4 m; what they weigh by default is a guess."""
    axes, places = [(0, 0, 1), (0, 1, 0), (0, 1, 0)], [at(), at(0.4), at(0.4)]
    hinges = [spo.Hinge("revolute", k - 1, k, axis=axes[k], parent_pose=places[k]) for k in range(3)]
    arm = spo.Scene([bar(0.4, 1.0) for _ in hinges], hinges)
    return arm.with_values(body_mass=np.array([masses]), joint_damping=np.array([damping]))


def record(steps, noise, rng):
    """States (q; qd) [step + 1, 6] as measured, and the torques between them [step, 3]."""
    dyn = spo.Dynamics(scene(MASSES, DAMPING), device="cpu", dtype="float64")
    q, qd, states, pushes = rng.uniform(-1.0, 1.0, (1, 3)), np.zeros((1, 3)), [], []
    for _ in range(steps):
        pushes.append(dyn.gravity_force(q) + rng.normal(0.0, 5.0, (1, 3)))
        states.append(np.hstack([q, qd]))
        q, qd = dyn.step(q, qd, pushes[-1], DT)
    states = np.concatenate([*states, np.hstack([q, qd])])
    return states + noise * UNITS * rng.normal(size=states.shape), np.concatenate(pushes)


def main(steps=1000, noise=1.0, iterations=6, seed=0, picture=None):
    states, pushes = (torch.as_tensor(x) for x in record(steps, noise, np.random.default_rng(seed)))
    starts, ends, windows = states[:-1:WINDOW], states[WINDOW::WINDOW], steps // WINDOW
    pushes, units = pushes.reshape(windows, WINDOW, 3), torch.as_tensor(UNITS)
    dyn = spo.Dynamics(scene(), windows, "cpu", "float64", variable=("body_mass", "joint_damping"), granularity="tree")
    guesses = [torch.tensor([*dyn.scene.values["body_mass"][0], *dyn.scene.values["joint_damping"][0]])]
    for _ in range(iterations):
        masses, damping = (x.repeat(windows, 1).requires_grad_() for x in guesses[-1].split(3))
        dyn.set(body_mass=masses, joint_damping=damping)
        q, qd = starts[:, :3].contiguous(), starts[:, 3:].contiguous()
        for k in range(WINDOW):
            q, qd = dyn.step(q, qd, pushes[:, k].contiguous(), DT)
        missed = (torch.cat([q, qd], 1) - ends) / units
        rows = [torch.cat(torch.autograd.grad(column.sum(), (masses, damping), retain_graph=True), 1)
                for column in missed.unbind(1)]  # fmt: skip
        change = torch.linalg.lstsq(torch.cat(rows), -missed.detach().T.reshape(-1, 1)).solution
        deviation = torch.linalg.inv(torch.cat(rows).T @ torch.cat(rows)).diagonal().sqrt()
        guesses.append(guesses[-1] + change[:, 0])
    found, right = guesses[-1].numpy(), np.array(MASSES + DAMPING)
    print(
        f"{steps} steps: masses {found[:3].round(3)} kg, damping {found[3:].round(3)} N m s, off by "
        f"{np.abs(found - right).max():.1e}"
    )
    if picture:
        with drawing(picture, "Masses of the bars", "Damping of the hinges") as axes:
            for k, (value, spread, wanted) in enumerate(zip(np.transpose(guesses), deviation, right, strict=True)):
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
