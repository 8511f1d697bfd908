"""A leg learns to hop, by gradients through 100 steps of contact with the ground.

The trunk slides up and down; hip and knee have springs that hold a crouch. Every world is such a leg with a height of
its own that the trunk is to reach at the end, half a second later. The unknowns are torques of hip and knee at a few
knots in time, linear in between. The gradient goes through landing feet and feet that lift off: all passes of every
step are differentiated, on the side of each switch on which the step was.
"""

import numpy as np
import torch
import warp as wp

import warp_spo as spo
from warp_spo.examples.options import command, drawing
from warp_spo.examples.parts import at, bar
from warp_spo.viewing.charts import OURS, log_axis

DT, STEPS, KNOTS = 5e-3, 100, 11  # time step [s], steps of a rollout, knots of the torques
LINK, FOOT = 0.25, 0.02  # length of thigh and shank, radius of the foot [m]
CROUCH = (0.8, -1.6)  # hip and knee at the start [rad]
HEIGHTS = (0.45, 0.75)  # of the trunk at the end, of the first and the last world [m]


def scene():
    """Return a leg of 3.6 kg above a plane; q is height of the trunk, hip, knee. At q = 0 the leg hangs along -z."""
    motor = dict(axis=(0, 1, 0), armature=0.01, target_ke=60.0, target_kd=1.5)
    trunk = spo.Body(3.0, inertia=0.02 * np.eye(3), label="trunk")
    hinges = [
        spo.Hinge("prismatic", -1, 0, axis=(0, 0, 1)),
        spo.Hinge("revolute", 0, 1, **motor),
        spo.Hinge("revolute", 1, 2, parent_pose=at(z=-LINK), **motor),
    ]
    foot = spo.Contact(2, sphere=((0, 0, -LINK), FOOT), stiffness=2e4, dissipation=0.5)
    legs = [bar(-LINK, 0.3, axis=2) for _ in range(2)]
    return spo.Scene([trunk, *legs], hinges, contacts=[foot], ground=spo.Plane())


def start(dyn):
    """Return q, qd [world, dof] of legs that crouch on the ground."""
    hip, knee = CROUCH
    height = LINK * (np.cos(hip) + np.cos(hip + knee)) + FOOT
    q = torch.tensor([[height, hip, knee]] * dyn.worlds, dtype=torch.float64, device=wp.device_to_torch(dyn.device))
    return q, torch.zeros_like(q)


def main(worlds=4, iterations=60, device=None, picture=None):
    dyn = spo.Dynamics(scene(), worlds, device, "float64")
    q0, qd0 = start(dyn)
    heights = torch.linspace(*HEIGHTS, worlds, dtype=q0.dtype, device=q0.device)
    knots = torch.zeros((KNOTS, worlds, 2), dtype=q0.dtype, device=q0.device, requires_grad=True)
    optimizer, losses = torch.optim.Adam([knots], lr=1.0), []
    report = dyn.step_report("contact_f", like=q0)
    for _ in range(iterations):
        q, qd, path, loads = q0, qd0, [], []
        for step in range(STEPS):
            knot, part = divmod(step * (KNOTS - 1) / STEPS, 1.0)
            torques = torch.lerp(knots[int(knot)], knots[int(knot) + 1], part)
            # The step is recorded by autograd; its gradient goes back through each of its passes.
            q, qd = dyn.step(q, qd, torch.nn.functional.pad(torques, (1, 0)), DT, target_q=q0, report=report)
            path.append(q.detach()[:, 0])
            loads.append(report.contact_f[:, 0, 2].clone())
        off = (q[:, 0] - heights).square()
        loss = off.sum() + 1e-4 * qd.square().sum() + 1e-7 * knots.square().sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    miss = 1e2 * off.detach().sqrt().max()
    print(
        f"{iterations} gradients through {STEPS} steps of {worlds} legs reduce the loss from {losses[0]:.3g} to "
        f"{losses[-1]:.3g}."
    )
    print(f"After {STEPS * DT:g} s the trunks are within {miss:.1f} cm of their heights.")
    if picture:
        path, loads, times = torch.stack(path).cpu(), torch.stack(loads).cpu(), DT * np.arange(1, STEPS + 1)
        titles = "Learning: lower is better", "The last rollout: height", "Force of the ground"
        with drawing(picture, *titles) as (left, middle, right):
            left.plot(losses, ".-", color=OURS, label=f"loss of {worlds} worlds")
            log_axis(left.yaxis, losses, "{:g}".format)
            left.set(xlabel="iteration", ylabel="loss")
            for world in range(worlds):
                shade = 0.3 + 0.7 * (world + 1) / worlds
                middle.plot(times, path[:, world], color=OURS, alpha=shade)
                middle.plot(times[-1], heights[world].item(), "o", color=OURS, alpha=shade)
                right.plot(times, loads[:, world], color=OURS, alpha=shade)
            middle.set(xlabel="time [s]", ylabel="height of the trunk [m]")
            right.set(xlabel="time [s]", ylabel="normal force [N]", ylim=(0.0, None))
    return losses


if __name__ == "__main__":
    command(main)
