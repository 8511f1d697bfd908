"""A finger learns to push a cube so that it stops at a target, by gradients through 120 steps of contact.

A finger of two hinges touches a cube that lies on the ground. Every world has a target of its own, farther away than
the finger follows: it has to let the cube go at the right speed, and friction has to stop it there. The unknowns are
torques of both hinges at a few knots in time, linear in between. The gradient goes through the finger's tip on the cube
and through the cube's corners on the ground, which stick, slide and stick again: all passes of every step are
differentiated, on the side of each switch on which the step was.
"""

import numpy as np
import torch
import warp as wp

import warp_spo as spo
from warp_spo.examples.options import command, drawing
from warp_spo.examples.parts import at, bar
from warp_spo.viewing.charts import OURS, log_axis

DT, STEPS, KNOTS = 5e-3, 120, 5  # time step [s], steps of a rollout, knots of the torques
PUSH = 0.3  # how long the finger acts [s]; then its brakes hold it back
LINK, TIP, HALF, MASS = 0.15, 0.015, 0.04, 0.4  # links, radius of the tip, half the side of the cube [m]; its mass [kg]
HEIGHT, TOUCH = 0.28, 0.1  # of the finger's base over the ground, of the tip as it touches the cube [m]
TARGETS = (0.06, 0.18)  # how far the cube is to go, of the first and the last world [m]


def scene():
    """Return a finger in the plane of x and z, and a cube on the ground; q is its two hinges, and the cube's pose."""
    hinge = dict(axis=(0, -1, 0), armature=2e-3, damping=0.02)
    hinges = [
        spo.Hinge("revolute", -1, 0, parent_pose=at(z=HEIGHT), **hinge),
        spo.Hinge("revolute", 0, 1, parent_pose=at(z=-LINK), **hinge),
        spo.Hinge("free", -1, 2),
    ]
    links = [spo.Body(0.1, (0, 0, -0.5 * LINK), 2e-4 * np.eye(3), gravcomp=1.0, label=label) for label in ("upper", "lower")]
    cube = spo.Body(MASS, inertia=MASS * (2.0 * HALF) ** 2 / 6.0 * np.eye(3), label="cube")
    box = dict(box=(HALF, HALF, HALF))
    tip = spo.Contact(1, sphere=((0, 0, -LINK), TIP), other=spo.Contact(2, **box), stiffness=5e3, damping=20.0, friction=0.3)
    ground = spo.Contact(2, **box, stiffness=5e3, dissipation=0.5, friction=0.4)
    return spo.Scene([*links, cube], hinges, contacts=[ground, tip], ground=spo.Plane())
