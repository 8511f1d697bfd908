"""The stiffness of a boom, found from the motion of its tip by gradients of simulations.

The boom is softer than drawn. Torques at its hinge shake it, of another frequency in each world, and its tip's sideways
motion is measured. Gauss-Newton iterations change the stiffness of the modes until simulated tips move as measured.
"""

import numpy as np
import torch
import warp as wp

import warp_spo as spo
from warp_spo.examples.options import command, drawing
from warp_spo.viewing.charts import FAINT, OURS

LENGTH, TRUE, DT, STEPS = 24.0, np.array([0.7, 0.8, 0.9]), 4e-3, 100  # [m], in units of what is drawn, [s]


def scene():
    """Return the boom on a vertical hinge; its modes bend it sideways."""
    tube, more = (spo.Section.tube(0.2, 0.01), spo.Material(7850.0, 2.1e11)), dict(damping_ratio=0.01, rotary=False)
    modes = spo.beam_modes(LENGTH, *tube, "clamped", {"y": 3}, points=6, **more)
    base = spo.Hinge("revolute", -1, 0, axis=(0, 0, 1), armature=2e5)
    return spo.Scene([spo.Body(*modes.rigid, modes=modes)], [base], gravity=(0, 0, 0))


def tips(dyn, stiffness, torques):
    """Return measurements [m] [time, world] of the tip, for the stiffness of the modes [world, 3]."""
    dyn.set(joint_stiffness=torch.nn.functional.pad(stiffness, (1, 0)))  # the hinge itself has none
    state, found = tuple(torch.zeros_like(torques[:2])), []
    for tau in torques:
        state = dyn.step(*state, tau, DT)
        found.append(state[0] @ torch.tensor([LENGTH, 1.0, 1.0, 1.0]).to(tau))  # sideways: shapes are 1 at the tip
    return torch.stack(found[4::5])


def main(worlds=4, noise=1.0, iterations=6, seed=0, device=None, picture=None):
    dyn = spo.Dynamics(scene(), worlds, device, "float64", variable=("joint_stiffness",))
    put = lambda x: torch.tensor(x, device=wp.device_to_torch(dyn.device))  # noqa: E731
    drawn, torques = put(dyn.scene.values["joint_stiffness"][0, 1:]), np.zeros((STEPS, worlds, 4))
    torques[..., 0] = 4e5 * np.sin(2.0 * np.pi * DT * np.arange(STEPS)[:, None] * np.geomspace(0.5, 12.0, worlds))
    measured, shares = tips(dyn, (put(TRUE) * drawn).repeat(worlds, 1), put(torques)), torch.ones_like(drawn)[None]
    measured += 1e-4 * noise * put(np.random.default_rng(seed).normal(size=measured.shape))
    for _ in range(iterations):
        guess = shares[-1].repeat(worlds, 1).requires_grad_()
        left = measured - tips(dyn, guess * drawn, put(torques))
        rows = torch.cat([torch.autograd.grad(-x.sum(), guess, retain_graph=True)[0] for x in left])
        shares = torch.cat([shares, shares[-1:] + torch.linalg.lstsq(rows, left.detach().reshape(-1, 1)).solution.T])
    found = shares.cpu().numpy()
    print(f"The stiffness of the modes is found as {found[-1].round(4)} of what is drawn, the true values are {TRUE}.")
    if picture:
        with drawing(picture, "Stiffness of the modes") as (axes,):
            axes.plot(found, ".-", color=OURS, label=["found", None, None])
            axes.hlines(TRUE, 0, iterations, FAINT, "--", label="true")
            axes.set(xlabel="iteration", ylabel="in units of what is drawn")
    return np.abs(found[-1] - TRUE).max()


if __name__ == "__main__":
    command(main)
