"""Scenes and states of the stress suite.

Base: rods of 1 m and 1 kg, inertia diag(.01, 1/12, 1/12) about the CoM, hinges about z and y in turn, angles uniform in
(-.6, .6) [rad] of seed 2, forces normal of seed 3 [N m]; further worlds have further seeds. Every number is rounded to
float32 first, so that each precision solves the same problem.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

import warp_spo as spo

WORLDS = 16
ANGLE_SEED, TAU_SEED, NEXT_WORLD = 2, 3, 1000
GRAVITY = (0.0, 0.0, -9.81)
ROUNDED = ("body_mass", "body_com", "body_inertia", "joint_X_p", "joint_X_c", "joint_armature", "gravity")
NONE = (0.0, 0.0, 0.0)
ARM = (0.3, 0.4, 0.5)  # [kg m^2]


@dataclasses.dataclass(frozen=True)
class Problem:
    """A scene, q [world, coordinate], tau and qd [world, dof] or None; every number is one that float32 has."""

    scene: spo.Scene
    q: np.ndarray
    tau: np.ndarray | None = None
    qd: np.ndarray | None = None

    @property
    def worlds(self) -> int:
        return len(self.q)


@dataclasses.dataclass(frozen=True)
class Setting:
    """Where a check runs: Warp device, "float32" or "float64", and granularity, None for the plan's choice."""

    device: Any = None
    dtype: str = "float32"
    granularity: str | None = None

    @property
    def eps(self) -> float:
        """Distance of 1 from the next number of the dtype."""
        return {"float32": 2.0**-23, "float64": 2.0**-52}[self.dtype]

    def dynamics(self, scene: spo.Scene, worlds: int, **options: Any) -> spo.Dynamics:
        """Return the Dynamics of a scene on this device, in this precision, at this granularity."""
        return spo.Dynamics(scene, worlds, self.device, self.dtype, granularity=self.granularity, **options)


def round_to_float32(array: Any) -> np.ndarray:
    """Return an array of float64 whose entries are rounded to float32."""
    return np.asarray(array, dtype=np.float32).astype(np.float64)


def problem(scene: spo.Scene, q: np.ndarray, tau: Any = None, qd: Any = None) -> Problem:
    """Return a scene and states as a Problem, rounded to float32."""
    values = {name: round_to_float32(scene.values[name]) for name in ROUNDED}
    tau, qd = (None if x is None else round_to_float32(x) for x in (tau, qd))
    return Problem(scene.with_values(**values), round_to_float32(q), tau, qd)


def draw(seed: int, worlds: int, size: int, spread: float | None = None) -> np.ndarray:
    """Return normal numbers [world, size], or uniform ones in (-spread, spread); world 0 is drawn from ``seed``."""
    rngs = [np.random.default_rng(seed + NEXT_WORLD * world) for world in range(worlds)]
    return np.array([rng.normal(size=size) if spread is None else rng.uniform(-spread, spread, size) for rng in rngs])


def rod(mass: float = 1.0, length: float = 1.0) -> spo.Body:
    """Return a uniform rod along x that starts at the body's origin; mass [kg], length [m]."""
    scale = mass * length**2
    return spo.Body(mass, (0.5 * length, 0.0, 0.0), np.diag([0.01 * scale, scale / 12.0, scale / 12.0]))


def at(x: float) -> tuple:
    """Return a pose at x [m] on the x axis, not turned."""
    return (x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def tree(
    parents: Sequence[int],
    bodies: Sequence[spo.Body],
    offset: Sequence[float],
    depth: Sequence[int],
    gravity: Any = NONE,
    **hinge: Any,
) -> spo.Scene:
    """Return a scene of revolute hinges, about z at even ``depth`` and y at odd, ``offset`` [m] along the parent's x.

    Args:
        parents: of each body; -1: the world.
        hinge: further arguments of the hinges, a sequence of one value for each hinge.
    """
    hinges = [
        spo.Hinge(
            "revolute",
            int(p),
            k,
            axis=(0, d % 2, 1 - d % 2),
            parent_pose=at(x),
            **{key: value[k] for key, value in hinge.items()},
        )
        for k, (p, x, d) in enumerate(zip(parents, offset, depth, strict=True))
    ]
    return spo.Scene(list(bodies), hinges, gravity=gravity)


def chain(masses: Any, lengths: Any = 1.0, gravity: Any = NONE, **hinge: Any) -> spo.Scene:
    """Return a chain of rods of these masses [kg] and lengths [m] on hinges about z and y in turn."""
    masses, lengths = np.broadcast_arrays(np.atleast_1d(masses), np.atleast_1d(lengths))
    n = len(masses)
    bodies = [rod(m, l) for m, l in zip(masses, lengths, strict=True)]
    return tree(np.arange(n) - 1, bodies, [0.0, *lengths[:-1]], range(n), gravity, **hinge)


def base(scene: spo.Scene, worlds: int = WORLDS, spread: float = 0.6, tau: Any = "random", qd: Any = None) -> Problem:
    """Return a scene at random angles in (-spread, spread) [rad] under random forces, or under ``tau``."""
    n = scene.dof_count
    tau = draw(TAU_SEED, worlds, n) if isinstance(tau, str) else tau
    return problem(scene, draw(ANGLE_SEED, worlds, n, spread), tau, qd)


def chain_rand(n: int, spread: float = 0.6, worlds: int = WORLDS) -> Problem:
    """Return a chain of n rods under random forces, without gravity."""
    return base(chain(np.ones(n)), worlds, spread)


def chain_gravity(n: int) -> Problem:
    """Return a chain of n rods under gravity alone."""
    return base(chain(np.ones(n), gravity=GRAVITY), tau=None)


def chain_coriolis(n: int) -> Problem:
    """Return a chain of n rods with random velocities and no force."""
    return base(chain(np.ones(n)), tau=None, qd=draw(5, WORLDS, n))


def chain_gravity_torque(n: int) -> Problem:
    """Return a chain of n rods without gravity, under the hinge forces that have the same effect as gravity."""
    one = chain_gravity(n)
    force = spo.Dynamics(one.scene, one.worlds, "cpu", "float64", granularity="node").gravity_force(one.q)
    return problem(one.scene.with_values(gravity=NONE), one.q, -force)


def straight(n: int, thin: bool = True) -> Problem:
    """Return a chain of n rods on a straight line in the xy plane, all hinges about z.

    Worlds differ by the angle of hinge 0, on which no pivot depends. ``thin``: no inertia about the rods' own axes.
    """
    inertia = np.diag([0.0 if thin else 0.01, 1.0 / 12.0, 1.0 / 12.0])
    bodies = [spo.Body(1.0, (0.5, 0.0, 0.0), inertia) for _ in range(n)]
    scene = tree(np.arange(n) - 1, bodies, [0.0] + [1.0] * (n - 1), [0] * n)
    q = np.zeros((WORLDS, n))
    q[:, 0] = draw(ANGLE_SEED, WORLDS, 1, 3.0)[:, 0]
    return problem(scene, q, draw(TAU_SEED, WORLDS, n))


def binary_tree(n: int) -> Problem:
    """Return a binary tree of n rods, numbered level by level."""
    parents = (np.arange(n) - 1) // 2
    parents[0] = -1
    depth = np.floor(np.log2(np.arange(n) + 1)).astype(int)
    return base(tree(parents, [rod()] * n, [0.0] + [1.0] * (n - 1), depth))


def star(n: int) -> Problem:
    """Return one rod that carries n rods at its end."""
    return base(tree([-1] + [0] * n, [rod()] * (n + 1), [0.0] + [1.0] * n, [0, *np.arange(n) % 2]))


def caterpillar(n: int) -> Problem:
    """Return a chain of n rods, each of which carries three rods more."""
    parents = [*range(-1, n - 1), *np.repeat(np.arange(n), 3)]
    depth = [*range(n), *np.tile(np.arange(3), n)]
    return base(tree(parents, [rod()] * (4 * n), [0.0] + [1.0] * (4 * n - 1), depth))


def heavy_tip(r: float) -> Problem:
    """Return a chain of 8 links whose masses grow in geometric progression; the tip's is r times the base's."""
    return base(chain(r ** (np.arange(8) / 7.0)))


def light_link(link: int, mu: float) -> Problem:
    """Return a chain of 8 links in which one link has mass ``mu`` [kg], the others 1 kg."""
    masses = np.ones(8)
    masses[link] = mu
    return base(chain(masses))


def gimbal(e: float, delta: float, oblique: bool = False, round_arm: bool = False) -> Problem:
    """Return a gimbal: hinges about z, y, z, two rings and an arm, ``delta`` [rad] away from where it locks.

    Args:
        e: mass [kg] and inertia [kg m^2] of each ring; the arm has 1 kg.
        oblique: the hinges' axes are oblique in the bodies' frames.
        round_arm: the arm has the principal inertias ARM, and not a rod's.
    """
    ring = spo.Body(e, inertia=e * np.eye(3))
    arm = spo.Body(1.0, inertia=np.diag(ARM)) if round_arm else rod()
    R = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0] if oblique else np.eye(3)
    arm = spo.Body(arm.mass, R @ arm.com, R @ arm.inertia @ R.T)
    axes = (R * np.sign(np.linalg.det(R))).T[[2, 1, 2]]
    hinges = [spo.Hinge("revolute", k - 1, k, axis=axis) for k, axis in enumerate(axes)]
    scene = spo.Scene([ring, ring, arm], hinges, gravity=NONE)
    q = draw(ANGLE_SEED, WORLDS, 3, 0.6)
    q[:, 1] = delta
    return problem(scene, q, draw(TAU_SEED, WORLDS, 3))


def far_origin(x: float, floating: bool = False) -> Problem:
    """Return a chain of 12 links of 0.1 m whose root is at (x, x, x) [m], fixed or floating."""
    scene = chain(np.ones(12), 0.1, gravity=GRAVITY)
    hinges, far = list(scene.hinges), (x, x, x, 0.0, 0.0, 0.0, 1.0)
    hinges[0] = spo.Hinge("free", -1, 0) if floating else dataclasses.replace(hinges[0], parent_pose=far)
    scene = spo.Scene(scene.bodies, hinges, gravity=GRAVITY)
    q = draw(ANGLE_SEED, WORLDS, 12, 0.6)
    if floating:
        turn = draw(7, WORLDS, 4)
        place = np.full((WORLDS, 3), x)
        q = np.concatenate([place, turn / np.linalg.norm(turn, axis=1)[:, None], q[:, 1:]], 1)
    return problem(scene, q, draw(TAU_SEED, WORLDS, scene.dof_count))


def scale_separation(r: float, n: int = 20) -> Problem:
    """Return a chain of n rods of 1 kg; rod k is 10 r^k [m] long."""
    return base(chain(np.ones(n), 10.0 * r ** np.arange(n)))


def stiff_armature(s: float, n: int = 16) -> Problem:
    """Return a chain of n rods with an armature of .33 s [kg m^2] on every second hinge."""
    return base(chain(np.ones(n), armature=np.where(np.arange(n) % 2 == 1, 0.33 * s, 0.0)))


def implicit_stiffness(dt: float, ke: float = 1e8, kd: float = 1e4, n: int = 8) -> Problem:
    """Return a chain with the armature and forces of an implicit step: Delta = dt kd + dt^2 ke.

    dt [s], springs ke [N m/rad], dampers kd [N m s/rad].
    """
    scene = chain(np.ones(n), gravity=GRAVITY, armature=np.full(n, dt * kd + dt**2 * ke))
    q, qd = draw(ANGLE_SEED, WORLDS, n, 0.6), draw(5, WORLDS, n)
    return problem(scene, q, -ke * (1e-3 * q + dt * qd) - kd * qd, qd)


def weak_ball(weak: float, floating: bool) -> Problem:
    """Return a body of inertia (1, 1, weak) [kg m^2] on a ball hinge at its CoM, in random orientations.

    ``floating``: the ball hinge sits on a floating rod, and not on the world.
    """
    body = spo.Body(1.0, inertia=np.diag([1.0, 1.0, weak]))
    bodies, hinges = [body], [spo.Hinge("ball", -1, 0)]
    if floating:
        bodies, hinges = [rod(), body], [spo.Hinge("free", -1, 0), spo.Hinge("ball", 0, 1, parent_pose=at(1.0))]
    scene = spo.Scene(bodies, hinges, gravity=NONE)
    turns = [draw(seed, WORLDS, 4) for seed in (7, 8)][: len(bodies)]
    turns = [turn / np.linalg.norm(turn, axis=1)[:, None] for turn in turns]
    q = np.concatenate([draw(6, WORLDS, 3, 1.0), *turns] if floating else turns, 1)
    return problem(scene, q, draw(TAU_SEED, WORLDS, scene.dof_count))


def three_angles(delta: float) -> Problem:
    """Return a rod on a d6 of three angles about z, y, x; the middle angle is ``delta`` [rad] short of 90 degrees."""
    scene = spo.Scene([rod()], [spo.Hinge("d6", -1, 0, angular=np.eye(3)[[2, 1, 0]])], gravity=GRAVITY)
    q = draw(ANGLE_SEED, WORLDS, 3, 0.6)
    q[:, 1] = np.pi / 2.0 - delta
    return problem(scene, q, draw(TAU_SEED, WORLDS, 3))


def floating_chain(worlds: int) -> Problem:
    """Return a floating chain of twelve links in gravity, with velocities and forces, in any number of worlds."""
    p = far_origin(0.0, floating=True)
    q, tau = (np.resize(x, (worlds, x.shape[1])) for x in (p.q, p.tau))
    return Problem(p.scene, q, tau, round_to_float32(draw(5, worlds, p.scene.dof_count)))
