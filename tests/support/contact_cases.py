"""Scenes with contacts, random systems with contacts at a held pose, and the energy that a step may not raise."""

import functools

import numpy as np

import warp_spo as spo
from warp_spo.reference.contact import ContactStep, Laws, Limits, Points

EFFORT = 5.0  # of the quadruped's drives, so small that many are saturated [N m]
STAND = np.array([0.0, 0.7, -1.4] * 4)  # joints of the quadruped [rad]


def solid(mass, x, y, z):
    """Inertia of a box of these sizes [m]."""
    return np.diag([y * y + z * z, x * x + z * z, x * x + y * y]) * mass / 12.0


def box(mass=5.0, ground=None, **contact):
    """A cube of 0.2 m with its eight corners."""
    contacts = [spo.Contact(0, box=(0.1, 0.1, 0.1), **contact)]
    return spo.Scene([spo.Body(mass, inertia=solid(mass, 0.2, 0.2, 0.2))], [spo.Hinge("free", -1, 0)],
                     contacts=contacts, ground=ground)  # fmt: skip


def quadruped(effort=33.0, ground=None, **contact):
    """14.4 kg, 18 dofs, spheres for feet and the corners of the trunk; drives with limits of effort and position."""
    bodies, hinges = [spo.Body(7.0, inertia=solid(7.0, 0.4, 0.2, 0.1), label="trunk")], [spo.Hinge("free", -1, 0)]
    drive = dict(armature=0.01, target_ke=60.0, target_kd=2.0, effort_limit=effort, limit_ke=1e3)
    contacts, place = [], lambda x, y, z: (x, y, z, 0.0, 0.0, 0.0, 1.0)
    for x in (0.19, -0.19):
        for y in (0.1, -0.1):
            b, side = len(bodies), 0.8 * y
            bodies += [spo.Body(0.7, inertia=solid(0.7, 0.08, 0.08, 0.08)),
                       spo.Body(1.0, (0.0, 0.0, -0.08), solid(1.0, 0.04, 0.04, 0.2)),
                       spo.Body(0.15, (0.0, 0.0, -0.1), solid(0.15, 0.02, 0.02, 0.2))]  # fmt: skip
            hinges += [
                spo.Hinge("revolute", 0, b, axis=(1, 0, 0), parent_pose=place(x, y, 0), limit_lower=-0.8,
                          limit_upper=0.8, **drive),
                spo.Hinge("revolute", b, b + 1, axis=(0, 1, 0), parent_pose=place(0, side, 0), limit_lower=-1.5,
                          limit_upper=3.0, friction=0.2, **drive),
                spo.Hinge("revolute", b + 1, b + 2, axis=(0, 1, 0), parent_pose=place(0, 0, -0.21), limit_lower=-2.7,
                          limit_upper=-0.8, **drive),
            ]  # fmt: skip
            contacts.append(spo.Contact(b + 2, sphere=((0, 0, -0.21), 0.02), **contact))
    contacts.append(spo.Contact(0, box=(0.19, 0.1, 0.05), **contact))
    return spo.Scene(bodies, hinges, contacts=contacts, ground=ground)


@functools.cache
def poses(count=4):
    """Mass, laws, limits and points of the quadruped in random poses near the ground, a damper for each drive."""
    scene, rng, found = quadruped(), np.random.default_rng(5), []
    for _ in range(count):
        turn = np.append(0.5 * rng.normal(size=3), 1.0)
        q = np.concatenate([[0.0, 0.0, 0.3], turn / np.linalg.norm(turn), STAND + 0.3 * rng.normal(size=12)])
        at = ContactStep(scene, q, np.zeros(18), 1e-3)
        damper = dict(a=np.zeros(18), s=20.0 * (at.laws.s > 0.0), load=np.zeros(18), effort=np.full(18, EFFORT))
        laws = at.laws._replace(**damper)
        found.append((at.dense.mass_matrix, laws, at.limits, at.points))
    return found


def quadruped_case(rng):
    """Return M, laws, limits, points, v and h of the quadruped with the lowest points just above or in the ground."""
    M, laws, limits, points = poses()[rng.integers(len(poses()))]
    v = rng.normal(size=18) * np.repeat([1.0, 2.0, 4.0], [3, 3, 12]) * 10.0 ** rng.uniform(-1.0, 0.7)
    depth = points.depth - points.depth.max() + rng.uniform(-3e-3, 6e-3)
    k = np.full(len(depth), 10.0 ** rng.uniform(3.5, 7.0))
    points = points._replace(depth=depth, k=k, d=0.1 * np.sqrt(k), mu=np.full(len(depth), rng.uniform(0.0, 1.5)))
    return M, laws, limits, points, v, 10.0 ** rng.uniform(-3.0, -1.7)


def random_case(rng, saturated=True):
    """Return M, laws, limits, points and v of a system with up to 8 dofs and 6 points; any h from 0.3 to 20 ms."""
    n, count, ends = rng.integers(2, 9), rng.integers(1, 7), rng.integers(0, 4)
    root = rng.normal(size=(n, n)) * 10.0 ** rng.uniform(-1.5, 0.5, n)
    M = root @ root.T + np.diag(10.0 ** rng.uniform(-3.0, 0.0, n))
    J = rng.normal(size=(count, 3, n)) * rng.uniform(0.2, 1.0, (count, 1, 1))
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    v = rng.normal(size=n) * 10.0 ** rng.uniform(-1.0, 0.7)
    k = 10.0 ** rng.uniform(3.0, 6.5, count)
    inverse = np.linalg.inv(M)
    weight = 0.6 * np.einsum("pai,ij,paj->p", J, inverse, J) / 3.0
    points = Points(J, normal, rng.uniform(-3e-3, 5e-3, count), k, 10.0 ** rng.uniform(0.0, 3.0, count),
                    rng.uniform(0.0, 1.5, count), np.full(count, 1e-3), weight)  # fmt: skip
    way, depth = rng.choice([-1.0, 1.0], ends), rng.uniform(-0.05, 0.05, ends)
    limits = Limits(rng.integers(0, n, ends), way, depth, 10.0 ** rng.uniform(1.0, 4.0, ends),
                    np.where(depth > 0.0, rng.uniform(0.0, 20.0, ends), 0.0))  # fmt: skip
    h, zero = 10.0 ** rng.uniform(-3.5, -1.7), np.zeros(n)
    s = rng.choice([0.0, 1.0], n) * 10.0 ** rng.uniform(-1.0, 1.0, n)  # a damping drive: its target does no work
    effort = 10.0 ** rng.uniform(-1.0, 1.5, n) if saturated else np.full(n, np.inf)
    laws = Laws(zero, rng.uniform(0.0, 0.5, n), s, zero, effort, rng.choice([0.0, 1.0], n) * rng.uniform(0.1, 5.0, n),
                np.full(n, np.inf), zero, np.diag(inverse))  # fmt: skip
    return M, laws, limits, points, v, h


def energy(M, limits, points, v, moved=0.0):
    """Return kinetic energy, and that of contacts and limits after ``moved`` seconds at ``v``."""
    depth = points.depth - moved * np.einsum("pa,pai,i->p", points.n, points.J, v)
    over = limits.depth - moved * limits.way * v[limits.dof]
    springs = points.k @ np.maximum(depth, 0.0) ** 2 + limits.k @ np.maximum(over, 0.0) ** 2
    return 0.5 * (v @ M @ v + springs)


def rise(solve, case, passes):
    """Return by how much the passes of ``solve`` raise the energy of a case, over the energy before."""
    M, laws, limits, points, v, h = case
    before = energy(M, limits, points, v)
    after = solve(M, laws, limits, points, v, np.zeros(len(v)), h, passes).v
    return (energy(M, limits, points, after, h) - before) / before


def pressed(case):
    """Return the case with all points in the ground and all limits passed."""
    M, laws, limits, points, v, h = case
    limits, points = (part._replace(depth=np.abs(part.depth)) for part in (limits, points))
    return M, laws, limits, points, v, h


def touching(scene, seed, worlds, h=5e-3):
    """Return q, qd, tau [world, ...] with the lowest points just above or in the ground."""
    rng, n = np.random.default_rng(seed), scene.dof_count
    q = np.tile(scene.neutral_q, (worlds, 1))
    turns = np.concatenate([0.3 * rng.normal(size=(worlds, 3)), np.ones((worlds, 1))], axis=1)
    q[:, 3:7] = turns / np.linalg.norm(turns, axis=1)[:, None]
    q[:, 7:] = (STAND if n == 18 else 0.0) + 0.4 * rng.normal(size=(worlds, n - 6))
    for world in range(worlds):
        q[world, 2] += ContactStep(scene, q[world], np.zeros(n), h).points.depth.max() - rng.uniform(-2e-3, 8e-3)
    return tuple(np.float64(np.float32(x)) for x in (q, rng.normal(size=(worlds, n)), rng.normal(size=(worlds, n))))


def everywhere(scene, seed):
    """The scene with points, a sphere and a capsule on random bodies, above a plane of any normal."""
    rng = np.random.default_rng(seed)
    shapes = [dict(point=0.2 * rng.normal(size=3)) for _ in range(3)]
    shapes += [dict(sphere=(0.2 * rng.normal(size=3), 0.1), friction=0.3)]
    shapes += [dict(capsule=(0.2 * rng.normal(size=3), 0.2 * rng.normal(size=3), 0.1), stiffness=1e5)]
    contacts = [spo.Contact(int(rng.integers(scene.body_count)), **shape) for shape in shapes]
    normal = rng.normal(size=3)
    return scene.with_contacts(contacts, spo.Plane(0.1, normal / np.linalg.norm(normal)))


def waisted(effort=2.0, ground=None):
    """A trunk with a leg and a waist, which carries a head and an arm with two fingers; drives that saturate."""
    parents = [-1, 0, 0, 2, 2, 4, 5, 5]  # trunk, leg, waist, head, arm, forearm, two fingers
    rng, hinges = np.random.default_rng(7), [spo.Hinge("free", -1, 0)]
    drive = dict(armature=0.01, target_ke=60.0, target_kd=2.0, effort_limit=effort, limit_ke=1e3, friction=0.2)
    for body, parent in enumerate(parents[1:], 1):
        at = (*(0.15 * rng.normal(size=3)), 0.0, 0.0, 0.0, 1.0)
        axis, limits = rng.normal(size=3), dict(limit_lower=-1.0, limit_upper=1.0)
        axis /= np.linalg.norm(axis)
        hinges.append(spo.Hinge("revolute", parent, body, axis=axis, parent_pose=at, **limits, **drive))
    bodies = [spo.Body(3.0 if body in (0, 2) else 0.5, 0.05 * rng.normal(size=3), solid(1.0, 0.2, 0.1, 0.1))
              for body in range(len(parents))]  # fmt: skip
    contacts = [spo.Contact(body, sphere=(0.1 * rng.normal(size=3), 0.05), friction=0.4) for body in range(1, 8)]
    contacts += [spo.Contact(body, point=0.1 * rng.normal(size=3)) for body in (0, 0, 2, 2, 5, 5)]
    return spo.Scene(bodies, hinges, contacts=contacts, ground=ground)
