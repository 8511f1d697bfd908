"""Trajectory optimisation: arms of seven hinges learn to swing their hands to targets, by gradients through 500 steps.

Every world is an arm with a target of its own. The unknowns are torques at a few knots in time, linear in between, that
are added to the torques which hold the arm at its start. The loss is the squared distance of the hand from its target
after the last step, plus small terms for the speed there and for the torques.
"""

import numpy as np
import torch
import warp as wp

import warp_spo as spo
from warp_spo.examples.options import band, command, drawing
from warp_spo.examples.parts import at, bar
from warp_spo.viewing.charts import OURS, log_axis

DT, STEPS, KNOTS = 2e-3, 500, 11  # time step [s], steps of a rollout, knots of the torques
START = [0.0, 0.5, 0.0, 1.2, 0.0, 0.6, 0.0]  # joint angles at the start [rad]
LINK = 0.25  # length of a bar [m]


def scene():
    """Return an arm of seven bars of 2 kg that turn about z and y in turn. At q = 0 all bars point along z."""
    axes = [(0, 0, 1), (0, 1, 0)]
    motor = dict(armature=0.05, damping=1.0, parent_pose=at(z=LINK))
    hinges = [spo.Hinge("revolute", k - 1, k, axis=axes[k % 2], **motor) for k in range(7)]
    return spo.Scene([bar(LINK, 2.0, axis=2) for _ in hinges], hinges)


def hand(poses):
    """Return the hand's position [world, 3]: the end of the last bar."""
    x, y, z, w = poses[:, 6, 3:].unbind(-1)
    along = torch.stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)], dim=-1)
    return poses[:, 6, :3] + LINK * along


def main(worlds=8, iterations=20, seed=0, device=None, picture=None):
    dyn = spo.Dynamics(scene(), worlds, device, "float64", granularity="tree")
    start = torch.tensor([START] * worlds, dtype=torch.float64, device=wp.device_to_torch(dyn.device))
    rng, hold = np.random.default_rng(seed), dyn.gravity_force(start)
    targets = hand(dyn.body_poses(start)) + torch.as_tensor(rng.uniform(-0.35, 0.35, (worlds, 3)), device=start.device)
    knots = torch.zeros((KNOTS, worlds, 7), dtype=start.dtype, device=start.device, requires_grad=True)
    optimizer, losses = torch.optim.Adam([knots], lr=0.4), []
    for _ in range(iterations):
        q, qd, path = start, torch.zeros_like(start), []
        for step in range(STEPS):
            knot, part = divmod(step * (KNOTS - 1) / STEPS, 1.0)
            # The step is recorded by autograd: its gradient is an analytic kernel, called in the backward pass.
            q, qd = dyn.step(q, qd, hold + torch.lerp(knots[int(knot)], knots[int(knot) + 1], part), DT)
            path.append(q.detach())
        off = (hand(dyn.body_poses(q)) - targets).square().sum(1)
        loss = off.mean() + 1e-3 * qd.square().sum(1).mean() + 1e-5 * knots.square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    miss = 1e2 * off.detach().sqrt().mean()
    print(
        f"{iterations} gradients through {STEPS} steps of {worlds} arms reduce the loss from {losses[0]:.3g} to "
        f"{losses[-1]:.3g}."
    )
    print(f"After {STEPS * DT:g} s the hands are {miss:.1f} cm from their targets on average.")
    if picture:
        paths = torch.stack([hand(dyn.body_poses(q)) for q in path]) - targets
        with drawing(picture, "Learning: lower is better", "The last rollout: lower is better") as (left, right):
            left.plot(losses, ".-", color=OURS, label=f"mean loss of {worlds} worlds")
            log_axis(left.yaxis, losses, "{:g}".format)
            left.set(xlabel="iteration", ylabel="loss")
            band(right, DT * np.arange(1, STEPS + 1), paths.norm(dim=-1).cpu().numpy(), OURS, "hand")
            right.set(xlabel="time [s]", ylabel="distance from the target [m]", ylim=(0.0, None))
    return losses


if __name__ == "__main__":
    command(main)
