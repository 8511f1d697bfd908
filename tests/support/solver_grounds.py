"""Newton models of cubes and spheres on planes and height fields, and steps of them."""

import newton
import numpy as np
import warp as wp

from .solver_models import H

SIDE, DENSITY = 0.2, 500.0
WEIGHT = DENSITY * SIDE**3 * 9.81
CFG = newton.ModelBuilder.ShapeConfig(ke=2e3, kd=40.0, mu=0.4, density=DENSITY)


def plane(height=0.0, normal=(0.0, 0.0, 1.0)):
    return lambda builder: builder.add_shape_plane((*normal, -height), width=0.0, length=0.0, cfg=CFG)


def field(seed, at=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0, 1.0)):
    heights = 0.05 * np.random.default_rng(seed).normal(size=(5, 9))
    hills = newton.Heightfield(heights, 5, 9, hx=2.0, hy=1.0)
    return lambda builder: builder.add_shape_heightfield(heightfield=hills, xform=wp.transform(at, turn), cfg=CFG)


def boxes(*grounds, everywhere=None):
    """A world with a cube for each ground, 5 mm above z = 0.1; and a ground outside of all worlds."""
    builder = newton.ModelBuilder()
    for ground in grounds:
        one = newton.ModelBuilder()
        cube = one.add_link(label="cube", xform=wp.transform((0.0, 0.0, SIDE / 2 + 0.105), wp.quat_identity()))
        one.add_shape_box(cube, hx=SIDE / 2, hy=SIDE / 2, hz=SIDE / 2, cfg=CFG, label="side")
        one.add_articulation([one.add_joint_free(cube)])
        one.joint_q[:] = [0.0, 0.0, SIDE / 2 + 0.105, 0.0, 0.0, 0.0, 1.0]
        if ground is not None:
            ground(one)
        builder.add_world(one)
    if everywhere is not None:
        everywhere(builder)
    return builder.finalize(device="cpu")


def run(solver, state, steps, contacts=None, dt=H, observables=None):
    for _ in range(steps):
        solver.step(state, state, None, contacts, dt, observables=observables)


def spheres():
    """Two spheres beside each other in each of two worlds: shapes 0, 1 and 2, 3; a plane, 4."""
    one = newton.ModelBuilder()
    for x in (-0.3, 0.3):
        ball = one.add_link()
        one.add_shape_sphere(ball, radius=0.19, cfg=CFG)
        one.add_articulation([one.add_joint_free(ball)])
        one.joint_q[-7:] = [x, 0.0, 0.19, 0.0, 0.0, 0.0, 1.0]
    builder = newton.ModelBuilder()
    builder.replicate(one, 2)
    builder.add_ground_plane(cfg=CFG)
    return builder.finalize(device="cpu")


def block(builder):
    builder.add_shape_box(-1, hx=1.0, hy=1.0, hz=1.0, label="block")
