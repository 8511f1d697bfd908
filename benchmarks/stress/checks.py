"""Stress checks without an error law: closed forms, limits, units, equal bits; with those of status words, all checks.

A check is a function of a :class:`Setting` that raises AssertionError. ``CHECKS`` names the checks.
"""

from __future__ import annotations

import dataclasses
from fractions import Fraction

import numpy as np
import warp as wp

import warp_spo as spo

from . import scenes, status
from .contact import check_falling_cubes
from .scenes import GRAVITY, NONE, Problem, Setting, draw, problem
from .status import run
from .steps import check_stiff_arm


def check_straight_chain(where: Setting) -> None:
    """The pivots D of straight thin rods are known fractions, which tend from tip to base to 1/3 + 12^-1/2."""
    p, n = scenes.straight(6), 6
    p = Problem(p.scene.with_values(body_inertia=[np.diag([0.0, 1.0, 1.0]) / 12.0] * n), p.q, p.tau)  # not rounded
    dyn = where.dynamics(p.scene, p.worlds)
    dyn.forward_dynamics(p.q, None, p.tau)
    D = dyn.recursions.array("pivot").numpy()[::-1, 0]
    wanted = [Fraction(*pair) for pair in ((1, 3), (7, 12), (13, 21), (97, 156), (181, 291), (1351, 2172))]
    error = max(abs(Fraction(float(D[i])) / wanted[i] - 1) for i in range(n))
    assert error <= 10 * 4 * where.eps, f"error {float(error):.1e}"


def check_condition_slope(where: Setting) -> None:
    """The condition number of the mass matrix of a straight chain grows with the 4th power of the number of rods."""
    low, high = 64, 128
    cond = []
    for n in (low, high):
        p = scenes.straight(n)
        mass = dataclasses.replace(where, dtype="float64").dynamics(p.scene, p.worlds).mass_matrix(p.q)
        cond.append(np.linalg.cond(mass[0]))
    slope = np.log2(cond[1] / cond[0])
    assert abs(slope - 4.0) <= 0.1, f"slope {slope:.3f}, cond {cond}"


def check_units(where: Setting) -> None:
    """Units of mass larger by 2^7 and of length smaller by 2^-5 change no bit of qdd.

    The values are variable, so that both problems run the same program. Folded values would give two programs, in
    which a GPU's compiler may fuse different products and sums.
    """
    p = scenes.chain_gravity(16)
    p = Problem(
        p.scene, p.q, scenes.round_to_float32(draw(3, p.worlds, 16)), scenes.round_to_float32(draw(5, p.worlds, 16))
    )
    mass, length = 2.0**7, 2.0**-5
    v = p.scene.values
    X = v["joint_X_p"] * np.array([length] * 3 + [1.0] * 4)
    other = p.scene.with_values(
        body_mass=v["body_mass"] * mass,
        body_com=v["body_com"] * length,
        joint_X_p=X,
        body_inertia=v["body_inertia"] * mass * length**2,
        gravity=v["gravity"] * length,
    )
    names = ("body_mass", "body_com", "joint_X_p", "body_inertia", "gravity")
    here, there = (
        scene.with_values(**{name: np.repeat(scene.values[name][:1], p.worlds, axis=0) for name in names})
        for scene in (p.scene, other)
    )
    scaled = Problem(there, p.q, p.tau * mass * length**2, p.qd)
    np.testing.assert_array_equal(run(scaled, where)[0], run(Problem(here, p.q, p.tau, p.qd), where)[0])


def check_stiff_limit(where: Setting) -> None:
    """As armature s grows a hinge becomes fixed: the difference falls as 1/s, down to rounding."""
    n, level = 16, {}
    for s in (1e6, 1e8, 1e12):
        p = scenes.stiff_armature(s, n)
        free = np.arange(0, n, 2)
        hinges = list(p.scene.hinges)
        for k in range(1, n, 2):  # the angle goes into the anchor, so every world is a scene of its own
            hinges[k] = spo.Hinge("fixed", k - 1, k, parent_pose=hinges[k].parent_pose)
        locked = spo.Scene(p.scene.bodies, hinges, gravity=NONE)
        X = np.repeat(locked.values["joint_X_p"], p.worlds, axis=0)
        X[:, 1::2, 3:] = np.stack([np.zeros_like(p.q[:, 1::2])] * 3 + [np.ones_like(p.q[:, 1::2])], -1)
        X[:, 1::2, 4], X[:, 1::2, 6] = np.sin(p.q[:, 1::2] / 2), np.cos(p.q[:, 1::2] / 2)
        bodies = {name: p.scene.values[name] for name in ("body_mass", "body_com", "body_inertia")}
        locked = Problem(locked.with_values(joint_X_p=X, **bodies), p.q[:, free], p.tau[:, free])
        got, wanted = run(p, where)[0][:, free], run(locked, where)[0]
        level[s] = float(np.abs(got - wanted).max() / np.abs(wanted).max())
    rounding = 10 * 4.2 * where.eps
    assert level[1e8] <= 0.011 * level[1e6] + rounding and level[1e12] <= 1.1e-6 * level[1e6] + rounding, f"{level}"


def check_massless_robot(where: Setting) -> None:
    """A robot of massless bodies on hinges with armature Delta has qdd = tau / Delta, to the last bit."""
    n = 8
    scene = scenes.chain(np.zeros(n), gravity=GRAVITY, armature=2.0 ** np.arange(n))
    p = scenes.base(scene)
    qdd, status = run(p, where)
    assert not status.any(), f"status {status}"
    wanted = p.tau / scene.values["joint_armature"]
    assert np.abs(qdd / wanted - 1.0).max() <= where.eps, "qdd is not tau / Delta"


def check_same_bits(where: Setting, worlds: int = 64) -> None:
    """Results have equal bits: in three runs, in any order of worlds, in one world alone, for renumbered bodies."""
    n = 15
    p = scenes.binary_tree(n)
    q, tau = (np.resize(x, (worlds, n)) + 0.0 for x in (p.q, p.tau))
    first = run(Problem(p.scene, q, tau), where)[0]
    for _ in range(2):
        np.testing.assert_array_equal(run(Problem(p.scene, q, tau), where)[0], first)
    order = np.random.default_rng(0).permutation(worlds)
    np.testing.assert_array_equal(run(Problem(p.scene, q[order], tau[order]), where)[0], first[order])
    np.testing.assert_array_equal(run(Problem(p.scene, q[:1], tau[:1]), where)[0], first[:1])

    def depth_first(k: int) -> list[int]:
        return [k, *depth_first(2 * k + 1), *depth_first(2 * k + 2)] if k < n else []

    old = np.array(depth_first(0))
    new = np.argsort(old)
    hinges = []
    for k in old:
        h = p.scene.hinges[k]
        hinges.append(
            spo.Hinge(
                "revolute",
                -1 if h.parent < 0 else int(new[h.parent]),
                int(new[k]),
                axis=h.axis,
                parent_pose=h.parent_pose,
            )
        )
    renumbered = problem(spo.Scene([p.scene.bodies[k] for k in old], hinges, gravity=NONE), q[:, old], tau[:, old])
    np.testing.assert_array_equal(run(renumbered, where)[0], first[:, old])


def check_double_pendulum(where: Setting, worlds: int = 1) -> None:
    """A double pendulum of uniform rods, in any number of worlds, agrees with its 2 x 2 mass matrix."""
    rng = np.random.default_rng(0)
    q, tau = rng.uniform(-1.0, 1.0, (worlds, 2)), rng.normal(size=(worlds, 2))
    rods = [spo.Body(1.0, (0.5, 0.0, 0.0), np.diag([0.0, 1.0, 1.0]) / 12.0)] * 2
    p = problem(scenes.tree([-1, 0], rods, [0.0, 1.0], [0, 0]), q, tau)
    qdd, status = run(p, where)
    c = np.cos(p.q[:, 1])
    J = p.scene.values["body_inertia"][0, 0, 2, 2] + 0.25  # about the rod's end; 1/12 is rounded to float32
    M = np.array([[1.0 + 2.0 * J + c, J + c / 2.0], [J + c / 2.0, np.full(worlds, J)]])
    det = M[0, 0] * M[1, 1] - M[0, 1] ** 2
    wanted = np.stack([M[1, 1] * p.tau[:, 0] - M[0, 1] * p.tau[:, 1], M[0, 0] * p.tau[:, 1] - M[0, 1] * p.tau[:, 0]])
    error = np.linalg.norm(qdd - (wanted / det).T, axis=1) / np.linalg.norm(wanted / det, axis=0)
    assert not status.any() and error.max() <= 10 * 5e-7 * where.eps / 2.0**-23, f"error {error.max():.1e}"


def check_million_worlds(where: Setting) -> None:
    """A double pendulum in 2^20 worlds agrees with its mass matrix."""
    check_double_pendulum(where, 2**20)


def check_million_steps(where: Setting) -> None:
    """A stiff arm over 10^6 steps on a GPU, or 20 000 on a CPU, accumulates no rounding error."""
    device = wp.get_device(where.device)
    check_stiff_arm(where, 1_000_000 if device.is_cuda else 20_000)


def check_same_bits_of_4096_worlds(where: Setting) -> None:
    """Results in 4096 worlds have equal bits."""
    check_same_bits(where, 4096)


CHECKS = {
    "S5.closed_form": (check_straight_chain, "S5"),
    "S6.cond_law": (check_condition_slope, "S6"),
    "S19.unit_pow2": (check_units, "S19"),
    "S20.stiff_is_locked": (check_stiff_limit, "S20"),
    "S32.determinism": (check_same_bits, "S32"),
    "massless_robot": (check_massless_robot, "unusual inputs"),
    "stiff_arm": (check_stiff_arm, "unusual inputs"),
    "one_world": (check_double_pendulum, "closed form"),
} | status.CHECKS
"""Name -> (check, section of the stress suite that it belongs to)."""

LONG = {
    "S32.determinism_4096_worlds": (check_same_bits_of_4096_worlds, "S32"),
    "stiff_arm_million_steps": (check_million_steps, "unusual inputs"),
    "million_worlds": (check_million_worlds, "unusual inputs"),
    "falling_cubes": (check_falling_cubes, "contact"),
}
"""Checks that take minutes, as the slow cases do."""

READS_PIVOTS = ("S5.closed_form",)
"""Checks that read the pivots D where the recursions leave them in memory, which only granularity "node" does."""
