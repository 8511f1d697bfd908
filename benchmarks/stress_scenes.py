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
    """A scene; q [world, coordinate]; tau and qd [world, dof] or None; the scene's values and states are float32's."""

    scene: spo.Scene
    q: np.ndarray
    tau: np.ndarray | None = None
    qd: np.ndarray | None = None

    @property
    def worlds(self) -> int:
        return len(self.q)


@dataclasses.dataclass(frozen=True)
class Setting:
    """Where a check runs: Warp device, "float32" or "float64", and granularity, None being what the plan chooses."""

    device: Any = None
    dtype: str = "float32"
    granularity: str | None = None

    @property
    def eps(self) -> float:
        return {"float32": 2.0**-23, "float64": 2.0**-52}[self.dtype]

    def dynamics(self, scene: spo.Scene, worlds: int, **options: Any) -> spo.Dynamics:
        return spo.Dynamics(scene, worlds, self.device, self.dtype, granularity=self.granularity, **options)


def rounded(array: Any) -> np.ndarray:
    return np.asarray(array, dtype=np.float32).astype(np.float64)


def problem(scene: spo.Scene, q: np.ndarray, tau: Any = None, qd: Any = None) -> Problem:
    values = {name: rounded(scene.values[name]) for name in ROUNDED}
    tau, qd = (None if x is None else rounded(x) for x in (tau, qd))
    return Problem(scene.with_values(**values), rounded(q), tau, qd)


def draw(seed: int, worlds: int, size: int, spread: float | None = None) -> np.ndarray:
    """[world, size] normal, or uniform in (-spread, spread); world 0 has ``seed``."""
    rngs = [np.random.default_rng(seed + NEXT_WORLD * world) for world in range(worlds)]
    return np.array([rng.normal(size=size) if spread is None else rng.uniform(-spread, spread, size) for rng in rngs])


def rod(mass: float = 1.0, length: float = 1.0) -> spo.Body:
    """A uniform rod along x from the body's origin."""
    scale = mass * length**2
    return spo.Body(mass, (0.5 * length, 0.0, 0.0), np.diag([0.01 * scale, scale / 12.0, scale / 12.0]))


def at(x: float) -> tuple:
    return (x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def tree(
    parents: Sequence[int],
    bodies: Sequence[spo.Body],
    offset: Sequence[float],
    depth: Sequence[int],
    gravity: Any = NONE,
    **hinge: Any,
) -> spo.Scene:
    """Revolute hinges about z on even ``depth`` and y on odd, ``offset`` along the parent's x."""
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
    masses, lengths = np.broadcast_arrays(np.atleast_1d(masses), np.atleast_1d(lengths))
    n = len(masses)
    bodies = [rod(m, l) for m, l in zip(masses, lengths, strict=True)]
    return tree(np.arange(n) - 1, bodies, [0.0, *lengths[:-1]], range(n), gravity, **hinge)


def base(scene: spo.Scene, worlds: int = WORLDS, spread: float = 0.6, tau: Any = "random", qd: Any = None) -> Problem:
    n = scene.dof_count
    tau = draw(TAU_SEED, worlds, n) if isinstance(tau, str) else tau
    return problem(scene, draw(ANGLE_SEED, worlds, n, spread), tau, qd)


def chain_rand(n: int, spread: float = 0.6, worlds: int = WORLDS) -> Problem:
    return base(chain(np.ones(n)), worlds, spread)


def chain_gravity(n: int) -> Problem:
    return base(chain(np.ones(n), gravity=GRAVITY), tau=None)


def chain_coriolis(n: int) -> Problem:
    return base(chain(np.ones(n)), tau=None, qd=draw(5, WORLDS, n))


def chain_gravity_torque(n: int) -> Problem:
    """Gravity as the forces tau = -C that do the same, in float64 before rounding."""
    one = chain_gravity(n)
    force = spo.Dynamics(one.scene, one.worlds, "cpu", "float64", granularity="node").gravity_force(one.q)
    return problem(one.scene.with_values(gravity=NONE), one.q, -force)


def straight(n: int, thin: bool = True) -> Problem:
    """All in the xy plane along a line; worlds differ by the angle of hinge 0, which no pivot depends on."""
    inertia = np.diag([0.0 if thin else 0.01, 1.0 / 12.0, 1.0 / 12.0])
    bodies = [spo.Body(1.0, (0.5, 0.0, 0.0), inertia) for _ in range(n)]
    scene = tree(np.arange(n) - 1, bodies, [0.0] + [1.0] * (n - 1), [0] * n)
    q = np.zeros((WORLDS, n))
    q[:, 0] = draw(ANGLE_SEED, WORLDS, 1, 3.0)[:, 0]
    return problem(scene, q, draw(TAU_SEED, WORLDS, n))


def binary_tree(n: int) -> Problem:
    parents = (np.arange(n) - 1) // 2
    parents[0] = -1
    depth = np.floor(np.log2(np.arange(n) + 1)).astype(int)
    return base(tree(parents, [rod()] * n, [0.0] + [1.0] * (n - 1), depth))


def star(n: int) -> Problem:
    return base(tree([-1] + [0] * n, [rod()] * (n + 1), [0.0] + [1.0] * n, [0, *np.arange(n) % 2]))


def caterpillar(n: int) -> Problem:
    parents = [*range(-1, n - 1), *np.repeat(np.arange(n), 3)]
    depth = [*range(n), *np.tile(np.arange(3), n)]
    return base(tree(parents, [rod()] * (4 * n), [0.0] + [1.0] * (4 * n - 1), depth))


def heavy_tip(r: float) -> Problem:
    """8 links, masses in geometric progression, tip over base = r."""
    return base(chain(r ** (np.arange(8) / 7.0)))


def light_link(link: int, mu: float) -> Problem:
    masses = np.ones(8)
    masses[link] = mu
    return base(chain(masses))


def gimbal(e: float, delta: float, oblique: bool = False, round_arm: bool = False) -> Problem:
    """Hinges z, y, z; two rings of inertia e [kg m^2] and mass e [kg]; an arm of 1 kg; delta [rad] off alignment.

    ``oblique``: body frames whose axes the hinges' are not; ``round_arm``: one of inertia ARM, thin nowhere.
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
    """12 links of 0.1 m whose root stands, or floats, at x [m] along every axis."""
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
    """Lengths 10 r^k [m] of rods of 1 kg."""
    return base(chain(np.ones(n), 10.0 * r ** np.arange(n)))


def stiff_armature(s: float, n: int = 16) -> Problem:
    """Delta = .33 s [kg m^2] on every second hinge."""
    return base(chain(np.ones(n), armature=np.where(np.arange(n) % 2 == 1, 0.33 * s, 0.0)))


def implicit_stiffness(dt: float, ke: float = 1e8, kd: float = 1e4, n: int = 8) -> Problem:
    """An implicit step dt [s] of springs ke [N m/rad] and dampers kd [N m s/rad]: Delta = dt kd + dt^2 ke."""
    scene = chain(np.ones(n), gravity=GRAVITY, armature=np.full(n, dt * kd + dt**2 * ke))
    q, qd = draw(ANGLE_SEED, WORLDS, n, 0.6), draw(5, WORLDS, n)
    return problem(scene, q, -ke * (1e-3 * q + dt * qd) - kd * qd, qd)


def weak_ball(weak: float, floating: bool) -> Problem:
    """A body of inertia (1, 1, weak) [kg m^2] on a ball hinge at its CoM, any orientation; on a free rod or not."""
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
    """A rod on a d6 of three angles about z, y, x, the middle one delta [rad] from where it loses a direction."""
    scene = spo.Scene([rod()], [spo.Hinge("d6", -1, 0, angular=np.eye(3)[[2, 1, 0]])], gravity=GRAVITY)
    q = draw(ANGLE_SEED, WORLDS, 3, 0.6)
    q[:, 1] = np.pi / 2.0 - delta
    return problem(scene, q, draw(TAU_SEED, WORLDS, 3))
