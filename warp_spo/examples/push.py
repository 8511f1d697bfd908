"""A finger learns to push a cube so that it stops at a target, by gradients through 120 steps of contact.

A finger of two hinges touches a cube that lies on the ground. Every world has a target of its own. The finger has to
give the cube the right speed, and friction has to stop it there. The unknowns are torques of both hinges at a few knots
in the first 0.3 s, linear in between. The gradient goes through the tip on the cube and through the cube's corners on
the ground, which stick, slide and stick again: all passes of every step are differentiated, on the side of each switch
on which the step was. A cube that the tip does not move has no gradient by the torques, so they begin with a push.
"""

import numpy as np
import torch
import warp as wp

import warp_spo as spo
from warp_spo.examples.options import command, drawing
from warp_spo.examples.parts import at
from warp_spo.viewing.charts import OURS, log_axis

DT, STEPS, ACTS, KNOTS = 5e-3, 120, 60, 5  # time step [s], steps of a rollout and with torques, knots of these
LINK, TIP, HEIGHT = 0.15, 0.015, 0.28  # length of a link, radius of the tip, height of the finger's base [m]
HALF, MASS, TOUCH = 0.04, 0.4, 0.05  # half the side [m] and mass [kg] of the cube, height at which the tip touches [m]
FIRST = (0.4, 0.3)  # torques of the first rollout, for half of the time [N m]
TARGETS = (0.06, 0.18)  # how far the cube is to go, in the first and the last world [m]


def scene():
    """Return a finger in the plane of x and z, and a cube on the ground; q is its two hinges, and the cube's pose."""
    hinge = dict(axis=(0, -1, 0), armature=2e-3, damping=0.02)
    hinges = [
        spo.Hinge("revolute", -1, 0, parent_pose=at(z=HEIGHT), **hinge),
        spo.Hinge("revolute", 0, 1, parent_pose=at(z=-LINK), **hinge),
        spo.Hinge("free", -1, 2),
    ]
    links = [spo.Body(0.1, (0, 0, -0.5 * LINK), 2e-4 * np.eye(3), gravcomp=1.0) for _ in range(2)]
    cube = spo.Body(MASS, inertia=MASS * (2.0 * HALF) ** 2 / 6.0 * np.eye(3), label="cube")
    box = dict(box=(HALF, HALF, HALF))
    ground = spo.Contact(2, **box, stiffness=5e3, dissipation=0.5, friction=0.4)
    tip = dict(sphere=((0, 0, -LINK), TIP), stiffness=5e3, damping=20.0, friction=0.3)
    return spo.Scene(
        [*links, cube], hinges, contacts=[ground, spo.Contact(1, **tip, other=spo.Contact(2, **box))],
        ground=spo.Plane(),
    )  # fmt: skip


def start(dyn):
    """Return q [world, coordinate] and qd [world, dof] of fingers that touch their cubes."""
    bent = np.arccos((HEIGHT - TOUCH) / (2.0 * LINK))
    q = np.tile(dyn.scene.neutral_q, (dyn.worlds, 1))
    q[:, :2], q[:, 2:5] = (-bent, 2.0 * bent), (TIP + HALF - 1e-4, 0.0, HALF - 1e-4)
    options = dict(dtype=torch.float64, device=wp.device_to_torch(dyn.device))
    return torch.tensor(q, **options), torch.zeros((dyn.worlds, dyn.scene.dof_count), **options)


def roll_out(dyn, q, qd, knots, report):
    """Return the state after a rollout, the places of the cubes [step, world], and the tips' forces."""
    path, forces = [q.detach()[:, 2]], []
    for step in range(STEPS):
        knot, part = divmod(step * (KNOTS - 1) / ACTS, 1.0)
        torques = torch.zeros_like(knots[0])
        if step < ACTS:
            torques = torch.lerp(knots[int(knot)], knots[int(knot) + 1], part)
        # The step is recorded by autograd; its gradient goes back through each of its passes.
        q, qd = dyn.step(q, qd, torch.nn.functional.pad(torques, (0, 6)), DT, report=report)
        path.append(q.detach()[:, 2])
        forces.append(report.contact_f[:, -1].norm(dim=1))
    path = torch.stack(path)
    return q, qd, path - path[0], torch.stack(forces)


def main(worlds=4, iterations=60, device=None, picture=None):
    dyn = spo.Dynamics(scene(), worlds, device, "float64")
    q0, qd0 = start(dyn)
    targets = torch.linspace(*TARGETS, worlds, dtype=q0.dtype, device=q0.device)
    knots = torch.zeros((KNOTS, worlds, 2), dtype=q0.dtype, device=q0.device)
    knots[: KNOTS // 2 + 1] = torch.tensor(FIRST, dtype=q0.dtype, device=q0.device)
    knots.requires_grad_()
    optimizer, losses = torch.optim.Adam([knots], lr=0.02, betas=(0.7, 0.9)), []
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.1 ** (1.0 / iterations))
    report = dyn.step_report("contact_f", like=q0)
    for _ in range(iterations):
        q, qd, path, forces = roll_out(dyn, q0, qd0, knots, report)
        off = q[:, 2] - q0[:, 2] - targets
        loss = off.square().sum() + 1e-3 * qd[:, 2:].square().sum() + 1e-7 * knots.square().sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        losses.append(loss.item())
    miss, speed = 1e3 * off.detach().abs().max(), 1e3 * qd.detach()[:, 2].abs().max()
    print(
        f"{iterations} gradients through {STEPS} steps of {worlds} cubes reduce the loss from {losses[0]:.3g} to "
        f"{losses[-1]:.3g}."
    )
    print(
        f"After {STEPS * DT:g} s the cubes are within {miss:.1f} mm of their targets, and none is faster than "
        f"{speed:.1f} mm/s."
    )
    if picture:
        path, forces, times = 1e3 * path.cpu(), forces.cpu(), DT * np.arange(STEPS + 1)
        titles = "Learning: lower is better", "The last rollout: places of the cubes", "Force of the tip"
        with drawing(picture, *titles) as (left, middle, right):
            left.plot(losses, ".-", color=OURS, label=f"loss of {worlds} worlds")
            log_axis(left.yaxis, losses, "{:g}".format)
            left.set(xlabel="iteration", ylabel="loss")
            for world in range(worlds):
                shade = 0.3 + 0.7 * (world + 1) / worlds
                middle.plot(times, path[:, world], color=OURS, alpha=shade)
                middle.plot(times[-1], 1e3 * targets[world].item(), "o", color=OURS, alpha=shade)
                right.plot(times[1:], forces[:, world], color=OURS, alpha=shade)
            middle.set(xlabel="time [s]", ylabel="distance [mm]")
            right.set(xlabel="time [s]", ylabel="force [N]", ylim=(0.0, None))
    return losses, float(miss)


if __name__ == "__main__":
    command(main)
