"""Scenes whose bodies touch each other, and one step of them."""

import numpy as np

import warp_spo as spo
from warp_spo.reference.body_contact import faces
from warp_spo.reference.rotations import homogeneous

from .contact_cases import solid
from .step_calls import bundled

H = 5e-3
WEDGE = np.array([[x, y, z] for y in (-0.1, 0.1) for x, z in ((-0.15, 0.0), (0.12, 0.0), (0.12, 0.1))])  # 20 degrees
STRAIGHT = np.array([0.0, 0.0, 0.0, 1.0])
SHAPE_ARGUMENTS = {
    "point": (0.1, 0.2, 0.3),
    "sphere": ((0.1, 0.2, 0.3), 0.1),
    "capsule": ((0.1, 0.0, 0.0), (0.0, 0.2, 0.0), 0.1),
    "box": ((0.1, 0.2, 0.3), (0.3, -0.2, 0.1, np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))),
    "cylinder": ((0.1, 0.0, 0.0), (0.0, 0.2, 0.0), 0.1),
    "cone": ((0.1, 0.0, 0.0), (0.0, 0.2, 0.0), 0.1),
    "ellipsoid": ((0.1, 0.2, 0.3), (0.3, -0.2, 0.1, np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))),
    "hull": WEDGE,
}
"""Of a Contact, by kind of shape."""


def cube(mass, half):
    return spo.Body(mass, inertia=solid(mass, 2 * half, 2 * half, 2 * half))


def box(body, half, **contact):
    return spo.Contact(body, box=(half, half, half), **contact)


def free(bodies, contacts, gravity=(0.0, 0.0, 0.0)):
    """Bodies that fly freely."""
    return spo.Scene(bodies, [spo.Hinge("free", -1, i) for i in range(len(bodies))], gravity=gravity, contacts=contacts)


def stack(masses=(5.0,) * 5, half=0.1, ground=1e5, **contact):
    """Cubes on each other and on the ground."""
    contacts = [box(0, half, stiffness=ground, damping=1e3)]
    contacts += [box(i, half, other=box(i - 1, half), **contact) for i in range(1, len(masses))]
    return free([cube(mass, half) for mass in masses], contacts, (0.0, 0.0, -9.81))


def stacked(count, half=0.1, offset=0.005, turn=0.05):
    """Return q of a stack, each cube shifted and turned against the one below."""
    place = [(offset * i, 0.6 * offset * i * (-1) ** i, half + 2 * half * i) for i in range(count)]
    turns = [(0.0, 0.0, np.sin(0.5 * turn * i), np.cos(0.5 * turn * i)) for i in range(count)]
    return np.concatenate([np.concatenate(both) for both in zip(place, turns, strict=True)])


def mixed():
    """A two-link arm with a pad and a capsule, and a cube, a ball and a stick around it: every kind of pair."""
    bodies = [cube(2.0, 0.05), cube(1.0, 0.04), cube(1.5, 0.06), cube(0.5, 0.05), cube(0.4, 0.03), spo.Body(0.0)]
    pose = lambda z: (0.0, 0.0, z, 0.0, 0.0, 0.0, 1.0)  # noqa: E731
    drive = dict(armature=0.02, target_ke=30.0, target_kd=1.0, effort_limit=4.0)
    hinges = [spo.Hinge("revolute", -1, 0, axis=(1, 0, 0), parent_pose=pose(0.6), **drive),
              spo.Hinge("revolute", 0, 1, axis=(0, 1, 0), parent_pose=pose(-0.2), friction=0.1, **drive)]  # fmt: skip
    hinges += [spo.Hinge("free", -1, i) for i in range(2, 5)]
    hinges += [spo.Hinge("fixed", -1, 5)]
    stick = dict(capsule=((0.0, 0.0, 0.0), (0.0, 0.0, -0.2), 0.03))
    pad = dict(box=((0.04, 0.04, 0.02), (0.0, 0.0, -0.2, 0.1, 0.0, 0.0, 1.0) / np.sqrt(np.r_[[1.0] * 3, [1.01] * 4])))
    half = dict(stiffness=1e4, damping=20.0)
    contacts = [
        box(2, 0.06, friction=0.4),
        spo.Contact(1, **pad, other=2, **half),
        spo.Contact(0, **stick, other=spo.Contact(4, capsule=((-0.1, 0, 0), (0.1, 0, 0), 0.02)), **half),
        spo.Contact(3, sphere=0.05, other=spo.Contact(1, **pad), friction=0.3, **half),
        spo.Contact(0, **stick, other=spo.Contact(3, sphere=0.05), **half),
        spo.Contact(5, box=(0.3, 0.3, 0.05), other=spo.Contact(3, sphere=0.05), stiffness=2e4),
        box(2, 0.06, other=spo.Contact(5, box=(0.3, 0.3, 0.05)), eps=2e-3),
        spo.Contact(4, point=(0.1, 0.0, 0.0), other=box(2, 0.06), **half),
        spo.Contact(1, hull=0.5 * WEDGE - [0.0, 0.0, 0.27], other=spo.Contact(3, sphere=0.05), friction=0.5, **half),
    ]
    return spo.Scene(bodies, hinges, contacts=contacts, ground=spo.Plane(height=-0.04))


def mixed_states(seed, worlds):
    """Return q, qd of ``mixed`` with several pairs in contact in each world."""
    rng, scene = np.random.default_rng(seed), mixed()
    q, qd = np.tile(scene.neutral_q, (worlds, 1)), 0.5 * rng.normal(size=(worlds, scene.dof_count))
    q[:, :2] = 0.2 * rng.normal(size=(worlds, 2))
    ball = np.resize([(0.075, 0.0, 0.2), (0.0, 0.07, 0.5), (0.2, 0.1, 0.09)], (worlds, 3))
    stick = np.resize([(0.03, 0.05, 0.45), (0.03, 0.05, 0.45), (-0.09, 0.0, 0.16)], (worlds, 3))
    for first, place in ((2, (0.0, 0.0, 0.11)), (9, ball), (16, stick)):
        q[:, first : first + 3] = place + 0.01 * rng.normal(size=(worlds, 3))
        turns = np.concatenate([0.05 * rng.normal(size=(worlds, 3)), np.ones((worlds, 1))], axis=1)
        q[:, first + 3 : first + 7] = turns / np.linalg.norm(turns, axis=1)[:, None]
    return np.float64(np.float32(q)), np.float64(np.float32(qd))


def hand():
    """A palm on a short arm, three fingers with drives, and a cube and a ball between them: limbs on one base."""
    bodies = [cube(2.0, 0.05), cube(1.0, 0.05)]
    pose = lambda x, z: (x, 0.0, z, 0.0, 0.0, 0.0, 1.0)  # noqa: E731
    drive = dict(armature=0.02, target_ke=30.0, target_kd=1.0, effort_limit=4.0)
    hinges = [spo.Hinge("revolute", -1, 0, axis=(1, 0, 0), parent_pose=pose(0.0, 0.6), **drive),
              spo.Hinge("revolute", 0, 1, axis=(0, 1, 0), parent_pose=pose(0.0, -0.1), **drive)]  # fmt: skip
    for x in (-0.08, 0.08, 0.3):
        hinges.append(spo.Hinge("revolute", 1, len(bodies), axis=(0, 1, 0), parent_pose=pose(x, -0.05), **drive))
        bodies.append(spo.Body(0.2, (0, 0, -0.05), 4e-4 * np.eye(3)))
    hinges += [spo.Hinge("free", -1, len(bodies) + i) for i in range(2)]
    bodies += [cube(0.5, 0.05), cube(0.3, 0.03)]
    law = dict(stiffness=1e4, damping=20.0)
    pad = dict(box=((0.02, 0.03, 0.03), (0.0, 0.0, -0.1, 0.0, 0.0, 0.0, 1.0)))
    contacts = [box(5, 0.05)]
    contacts += [spo.Contact(finger, **pad, other=5, **law) for finger in (2, 3)]
    contacts += [spo.Contact(2, sphere=((0.0, y, -0.1), 0.025), other=5, **law) for y in (-0.02, 0.02)]
    contacts += [spo.Contact(4, sphere=((0.0, 0.0, -0.1), 0.02), other=spo.Contact(6, sphere=0.03), **law)]
    contacts += [spo.Contact(4, sphere=((0.0, 0.0, -0.1), 0.02), other=spo.Contact(3, **pad), **law)]
    return spo.Scene(bodies, hinges, contacts=contacts, ground=spo.Plane(height=0.28))


def palm():
    """The hand, whose palm touches the cube, too: limbs cannot share that."""
    scene = hand()
    touch = spo.Contact(1, sphere=((0.0, 0.0, -0.05), 0.06), other=5, stiffness=1e4, damping=20.0)
    return scene.with_contacts([*scene.contacts, touch])


def hand_states(seed, worlds):
    """Return q, qd of ``hand`` with the cube between two fingers and the ball at the third; in the last world apart."""
    rng, scene = np.random.default_rng(seed), hand()
    q, qd = np.tile(scene.neutral_q, (worlds, 1)), 0.3 * rng.normal(size=(worlds, scene.dof_count))
    q[:, :5] = 0.02 * rng.normal(size=(worlds, 5)) + [0.0, 0.0, -0.1, 0.1, 1.2]
    q[:, 5:8], q[:, 12:15] = [0.0, 0.0, 0.34], [0.24, 0.0, 0.42]
    q[:, 5:8] += 0.002 * rng.normal(size=(worlds, 3))
    q[-1, 7], q[-1, 14] = 5.0, 6.0
    return np.float64(np.float32(q)), np.float64(np.float32(qd))


def shelf(body):
    """Two cubes on each other and on a shelf that stands still: of the inertial frame, -1, or of a fixed body, 2."""
    pose, law = (0.0, 0.1, 0.5, 0.0, np.sin(0.05), 0.0, np.cos(0.05)), dict(stiffness=1e4, damping=30.0)
    bodies, hinges = [cube(1.0, 0.05), cube(2.0, 0.06)], [spo.Hinge("free", -1, i) for i in range(2)]
    if body >= 0:
        bodies, hinges = [*bodies, spo.Body(0.0)], [*hinges, spo.Hinge("fixed", -1, 2)]
    board, knob = dict(box=((0.3, 0.2, 0.02), pose)), dict(sphere=((0.12, 0.1, 0.6), 0.07))
    contacts = [box(0, 0.05), box(0, 0.05, other=spo.Contact(body, **board), **law), box(1, 0.06, other=0, **law),
                box(1, 0.06, other=spo.Contact(body, **board)),
                spo.Contact(0, sphere=0.06, other=spo.Contact(body, **knob), **law)]  # fmt: skip
    return spo.Scene(bodies, hinges, contacts=contacts)


def shelf_states(seed, worlds):
    """Return q, qd of ``shelf`` with one cube on the shelf, at the knob, and the other one on it."""
    rng = np.random.default_rng(seed)
    q = np.tile([0.0, 0.1, 0.57, 0, 0, 0, 1, 0.02, 0.1, 0.676, 0, 0, 0, 1], (worlds, 1))
    q[:, [0, 1, 2, 7, 8, 9]] += 0.003 * rng.normal(size=(worlds, 6))
    return np.float64(np.float32(q)), np.float64(np.float32(0.3 * rng.normal(size=(worlds, 12))))


def cube_thrown_at_cube(chosen):
    """A cube that meets another one in the air: the scene, and ``chosen`` ones of 1500 random states."""
    rng, worlds, half = np.random.default_rng(0), 1500, 0.1
    law = dict(stiffness=1e6, damping=300.0, friction=0.3)
    scene = free([cube(5.0, half), cube(3.0, half)], [box(1, half, other=box(0, half), **law)])
    q, qd = np.zeros((worlds, 14)), np.zeros((worlds, 12))
    turns = np.concatenate([0.1 * rng.normal(size=(worlds, 3)), np.ones((worlds, 1))], axis=1)
    q[:, 6], q[:, 10:] = 1.0, turns / np.linalg.norm(turns, axis=1)[:, None]
    q[:, 7:9], q[:, 9] = 0.03 * rng.normal(size=(worlds, 2)), 0.2
    for row in q:
        solids = [(1, homogeneous(row[7 * i : 7 * i + 7]), np.full(3, half), 0.0) for i in (1, 0)]
        q_above = max((depth for _, _, depth in faces(*solids)), default=0.0)
        row[9] += q_above - rng.uniform(-1e-3, 4e-3)
    qd[:, 6:] = rng.normal(size=(worlds, 6)) * np.repeat([1.0, 6.0], 3)
    return scene, q[chosen], qd[chosen]


def ring():
    """Four balls in a ring, an arm that touches two of them, and another arm that touches the first one's tip."""
    ball = dict(sphere=0.1)
    bodies = [cube(1.0 + i, 0.1) for i in range(4)]
    hinges = [spo.Hinge("free", -1, i) for i in range(4)]
    for x, axis in ((-0.45, (0, 0, 1)), (0.65, (0, 1, 0))):
        first = len(bodies)
        hinges.append(
            spo.Hinge("revolute", -1, first, axis=(0, 1, 0), parent_pose=(x, 0.0, 0, 0, 0, 0, 1), armature=0.01)
        )
        hinges.append(spo.Hinge("revolute", first, first + 1, axis=axis, parent_pose=(0.1, 0, 0, 0, 0, 0, 1)))
        bodies += [spo.Body(0.5, inertia=1e-3 * np.eye(3)), spo.Body(0.4, (0.05, 0, 0), 1e-3 * np.eye(3))]
    law = dict(stiffness=2e4, damping=30.0)
    pairs = [(0, 1), (1, 2), (3, 2), (0, 3)]
    contacts = [spo.Contact(i, **ball, other=spo.Contact(j, **ball), **law) for i, j in pairs]
    tip = dict(sphere=((0.25, 0.0, 0.0), 0.06))
    contacts += [spo.Contact(5, **tip, other=spo.Contact(0, **ball), **law)]
    contacts += [spo.Contact(5, **tip, other=spo.Contact(3, **ball), **law)]
    contacts += [spo.Contact(7, sphere=((-0.55, 0, 0), 0.15), other=spo.Contact(5, **tip), **law)]
    return spo.Scene(bodies, hinges, contacts=contacts)


def ring_states(seed, worlds):
    """Return q, qd of ``ring`` in which bodies touch."""
    rng, scene = np.random.default_rng(seed), ring()
    q, qd = np.tile(scene.neutral_q, (worlds, 1)), 0.5 * rng.normal(size=(worlds, scene.dof_count))
    for i, (x, y) in enumerate(((0.0, -0.098), (0.196, -0.098), (0.196, 0.098), (0.0, 0.098))):
        q[:, 7 * i : 7 * i + 2] = (x, y) + 0.001 * rng.normal(size=(worlds, 2))
        turns = np.concatenate([0.2 * rng.normal(size=(worlds, 3)), np.ones((worlds, 1))], axis=1)
        q[:, 7 * i + 3 : 7 * i + 7] = turns / np.linalg.norm(turns, axis=1)[:, None]
    q[:, 28:] = 0.05 * rng.normal(size=(worlds, 4))
    return np.float64(np.float32(q)), np.float64(np.float32(qd))


def cubes_in_a_row(count):
    """Cubes side by side in a row between two that fly towards each other: ``count`` - 1 pairs touch."""
    half = 0.05
    contacts = [box(i, half, other=box(i - 1, half), stiffness=1e5, damping=50.0) for i in range(1, count)]
    scene = free([cube(1.0, half) for _ in range(count)], contacts)
    q, qd = np.zeros((2, 7 * count)), np.zeros((2, 6 * count))
    q[:, ::7] = 2.0 * half * np.arange(count) - 1e-5 * np.arange(count)
    q[:, 6::7] = 1.0
    qd[:, 0], qd[:, -6], qd[1, 1::6] = 0.5, -0.5, 0.02 * np.arange(count)
    return scene, q, qd


def stepped(dyn, q, qd, **more):
    """One step with all reports, which begin as NaN."""
    count, dtype, worlds = dyn.scene.contact_count, dyn.dtype.__name__, len(q)
    found = {"contact_f": np.full((worlds, count, 3), np.nan, dtype)}
    found |= {name: np.full((worlds, count), np.nan, dtype) for name in ("contact_gap", "contact_slip")}
    found |= {"contact_excess": np.full((worlds, 3), np.nan, dtype), "status": np.full(worlds, -1, np.int32)}
    found["q"], found["qd"] = dyn.step(q.astype(dtype), qd.astype(dtype), None, H, **bundled(**found, **more))
    return found
