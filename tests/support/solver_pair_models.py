"""Newton models whose bodies touch each other."""

from itertools import pairwise

import newton
import numpy as np
import warp as wp

from .pair_touches import hull_of

SIDE = 0.1
GRAVITY = 9.81
WALL = newton.ModelBuilder.ShapeConfig(density=500.0, ke=1e5, kd=1e3, mu=0.8)


def config(**values):
    found = WALL.copy()
    for name, value in values.items():
        setattr(found, name, value)
    return found


def mesh_of(points):
    """The hull of points as a mesh of triangles."""
    hull, middle = hull_of(points)
    fans = [(face[0], *two) for face in hull.faces for two in pairwise(face[1:])]
    return newton.Mesh(hull.corners + middle, np.ravel(fans))


def many(one, worlds=2, ground=True):
    builder = newton.ModelBuilder()
    builder.replicate(one, worlds)
    if ground:
        builder.add_ground_plane(cfg=WALL)
    return builder.finalize()


def free_cube(builder, label, at, half=SIDE, **cfg):
    body = builder.add_body(xform=wp.transform(wp.vec3(*at), wp.quat_identity()), label=label)
    builder.add_shape_box(body, hx=half, hy=half, hz=half, cfg=config(**cfg), label=f"box of {label}")
    return body


def tower(count=3, worlds=2, table=False):
    """Cubes on each other, each shifted by 5 mm, on the ground or on a box that stands still."""
    one = newton.ModelBuilder()
    if table:
        one.add_shape_box(-1, xform=wp.transform(wp.vec3(0.0, 0.0, -0.1), wp.quat_identity()), hx=1.0, hy=1.0, hz=0.1,
                          cfg=WALL)  # fmt: skip
    for i in range(count):
        free_cube(one, f"cube_{i}", (0.005 * i, 0.003 * i, SIDE * (2 * i + 1)))
    return many(one, worlds, ground=not table)


def arm():
    """A two-link arm, a plate fixed to its hand, a cube, a ball, a stick, a tin, and a post that stands still."""
    one = newton.ModelBuilder()
    links = [one.add_link(mass=1.0, inertia=wp.mat33(*(0.01 * np.eye(3)).ravel()), label=name)
             for name in ("upper", "lower", "plate")]  # fmt: skip
    down = wp.transform(wp.vec3(0.0, 0.0, -0.3), wp.quat_identity())
    up = wp.transform(wp.vec3(0.0, 0.0, 0.9), wp.quat_identity())
    joints = [one.add_joint_revolute(-1, links[0], parent_xform=up, axis=(1.0, 0.0, 0.0)),
              one.add_joint_revolute(links[0], links[1], parent_xform=down, axis=(0.0, 1.0, 0.0)),
              one.add_joint_fixed(links[1], links[2], parent_xform=down)]  # fmt: skip
    one.add_articulation(joints)
    half = wp.transform(wp.vec3(0.0, 0.0, -0.15), wp.quat_identity())
    one.add_shape_capsule(links[0], xform=half, radius=0.03, half_height=0.15, cfg=config(), label="stick")
    one.add_shape_sphere(links[1], xform=half, radius=0.03, cfg=config(mu=0.2, ke=5e4), label="elbow")
    one.add_shape_box(links[2], hx=0.1, hy=0.1, hz=0.02, cfg=config(margin=0.005), label="pad")
    free_cube(one, "cube", (0.0, 0.0, 0.176), mu=0.4, kd=50.0)
    ball = one.add_body(label="ball", xform=wp.transform(wp.vec3(0.031, 0.0, 0.525), wp.quat_identity()))
    one.add_shape_sphere(ball, radius=0.05, cfg=config(margin=0.003), label="ball")
    tin = one.add_body(label="tin", xform=wp.transform(wp.vec3(1.0, 0.0, 0.5), wp.quat_identity()))
    one.add_shape_cone(tin, radius=0.05, half_height=0.1, cfg=config(), label="tin")
    one.add_shape_box(-1, xform=wp.transform(wp.vec3(2.0, 0.0, 0.5), wp.quat_identity()), hx=0.1, hy=0.1, hz=0.1,
                      cfg=config(), label="post")  # fmt: skip
    return one


def with_table(post=False):
    """A cube on a table over the ground, and one on the ground; and a post that nothing meets."""
    builder = newton.ModelBuilder()
    for _ in range(2):
        one = newton.ModelBuilder()
        free_cube(one, "cube", (0.0, 0.0, 0.6 + 0.1))
        free_cube(one, "other", (2.0, 0.0, 0.1))
        at = wp.transform(wp.vec3(0.0, 0.0, 0.55), wp.quat_identity())
        one.add_shape_box(-1, xform=at, hx=0.5, hy=0.5, hz=0.05, cfg=config(mu=0.2), label="table")
        if post:
            one.add_shape_sphere(-1, xform=wp.transform(wp.vec3(4.0, 0.0, 0.0), wp.quat_identity()), radius=0.1,
                                 cfg=WALL, label="post")  # fmt: skip
        builder.add_world(one)
    builder.add_ground_plane(cfg=WALL)
    return builder.finalize()
