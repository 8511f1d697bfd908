"""Mechanisms whose closures are redundant in every configuration, and configurations that close them."""

import numpy as np

import warp_spo as spo
from warp_spo.examples.parts import about, at, bar
from warp_spo.reference.rotations import homogeneous, pose7


def placed(axis, angle, *position):
    """Return the 4 x 4 matrix of a place, turned by ``angle`` [rad] about a unit vector."""
    return homogeneous((*position, *about(axis, angle)))


FRAME, LEAF = placed((0.6, 0.0, 0.8), 0.7, 0.1, 0.2, 0.3), placed((0.0, 0.8, -0.6), 0.4, 0.3, 0.1, 0.2)


def cranks(feet, length=0.4, span=1.0):
    """Parallel cranks: one at x = 0 carries the coupler, from which the others hang; they stand at ``feet`` [m]."""
    turn = dict(axis=(0, 1, 0))
    hinges = [spo.Hinge("revolute", -1, 0, **turn), spo.Hinge("revolute", 0, 1, parent_pose=at(length), **turn)]
    hinges += [spo.Hinge("revolute", 1, 2 + i, parent_pose=at(x), **turn) for i, x in enumerate(feet)]
    loops = [
        spo.Loop("revolute", -1, 2 + i, parent_pose=at(x), child_pose=at(length), **turn) for i, x in enumerate(feet)
    ]
    return spo.Scene([bar(length), bar(span), *[bar(length)] * len(feet)], hinges, loops=loops)


def level(count, angles=(0.7, 1.2, -2.0)):
    """Configurations [angle, dof] of ``count`` parallel cranks, the coupler level."""
    angles = np.array(angles)
    return np.stack([angles, -angles, *[np.pi + angles] * (count - 1)], axis=1)


def bennett(a=0.5, twist=0.6, b=0.8):
    """Four bars a, b, a, b with twists of sines in the ratio of a to b: one dof, where counting gives -2."""
    other, turn = np.arcsin(np.sin(twist) * b / a), dict(axis=(0, 0, 1))
    far = [placed((1, 0, 0), angle, x, 0.0, 0.0) for x, angle in ((a, twist), (b, other))]
    bodies = [spo.Body(1.0, com=(x / 2, 0.02, 0.03), inertia=x * np.diag([0.01, 0.1, 0.1])) for x in (a, b, a)]
    poses = [at(0.0), pose7(far[0]), pose7(far[1])]
    hinges = [spo.Hinge("revolute", i - 1, i, parent_pose=pose, **turn) for i, pose in enumerate(poses)]
    pin = spo.Loop("revolute", -1, 2, parent_pose=pose7(np.linalg.inv(far[1])), child_pose=pose7(far[0]), **turn)
    return spo.Scene(bodies, hinges, loops=[pin])


def sarrus(length=0.5):
    """A plate on two folds of two bars whose planes are perpendicular: it moves straight up."""
    about_y, about_x = dict(axis=(0, 1, 0)), dict(axis=(1, 0, 0))
    body = spo.Body(1.0, com=(0.01, 0.02, length / 2), inertia=np.diag([0.05, 0.06, 0.02]))
    pose = lambda x=0.0, y=0.0, z=length: (x, y, z, 0.0, 0.0, 0.0, 1.0)  # noqa: E731
    hinges = [
        spo.Hinge("revolute", -1, 0, parent_pose=pose(0.3, 0.0, 0.0), **about_y),
        spo.Hinge("revolute", 0, 1, parent_pose=pose(), **about_y),
        spo.Hinge("revolute", 1, 2, parent_pose=pose(), **about_y),
        spo.Hinge("revolute", 2, 3, parent_pose=pose(-0.3, 0.3, 0.0), **about_x),
        spo.Hinge("revolute", 3, 4, parent_pose=pose(z=-length), **about_x),
    ]
    foot = spo.Loop("revolute", -1, 4, parent_pose=pose(0.0, 0.3, 0.0), child_pose=pose(z=-length), **about_x)
    return spo.Scene([body] * 5, hinges, loops=[foot])


def folded(angles=(0.4, 0.8, -0.5)):
    """Configurations [angle, dof] of the Sarrus linkage."""
    return np.array(angles)[:, None] * np.array([1.0, -2.0, 1.0, -1.0, 2.0])


def door(kind="revolute", apart=(0.0, 0.0, 1.7)):
    """A leaf on a hinge, and the same hinge again ``apart`` from it, all askew: every row of the loop is rounding.

    A prismatic kind is a drawer on two rails, a ball closes the leaf in three rows.
    """
    hinge = "prismatic" if kind == "prismatic" else "revolute"
    axis = {} if kind == "ball" else dict(axis=(0, 0, 1))
    shift = homogeneous((*apart, 0.0, 0.0, 0.0, 1.0))
    leaf = spo.Body(10.0, com=(0.5, 0.1, 1.0), inertia=np.diag([3.0, 3.0, 1.0]))
    first = spo.Hinge(hinge, -1, 0, axis=(0, 0, 1), parent_pose=pose7(FRAME), child_pose=pose7(LEAF))
    second = spo.Loop(kind, -1, 0, parent_pose=pose7(FRAME @ shift), child_pose=pose7(LEAF @ shift), **axis)
    return spo.Scene([leaf], [first], loops=[second])


def cranks_beside_a_door():
    """Three parallel cranks and a door: rows that count, rows that are redundant, and rows that are rounding."""
    one, other = cranks([1.0, 0.5]), door()
    hinge, loop = other.hinges[0], other.loops[0]
    leaf = spo.Hinge("revolute", -1, 4, axis=(0, 0, 1), parent_pose=hinge.parent_pose, child_pose=hinge.child_pose)
    again = spo.Loop("revolute", -1, 4, axis=(0, 0, 1), parent_pose=loop.parent_pose, child_pose=loop.child_pose)
    return spo.Scene([*one.bodies, *other.bodies], [*one.hinges, leaf], loops=[*one.loops, again])
