"""What the stress suite asserts without an error bound: flags, NaN in one world alone, equal bits, limits.

A check is a function of a :class:`Setting` that raises AssertionError; ``CHECKS`` names them with where they stand.
"""

from __future__ import annotations

import dataclasses
from fractions import Fraction
from typing import Any

import numpy as np
import warp as wp

import warp_spo as spo
from warp_spo.execution.parameters import VARIABLE

from . import stress_scenes as scenes
from .exact import Sweep
from .stress_scenes import GRAVITY, NONE, Problem, Setting, draw, problem
from .stress_steps import stiff_arm

HINGE = 3  # of an 8-link chain, that a check spoils
SPOILED = 5  # world that a check spoils


def run(p: Problem, where: Setting, **body_f: Any) -> tuple[np.ndarray, np.ndarray]:
    """qdd [world, dof] and status [world] of forward dynamics; what the scene holds for each world is variable."""
    status = np.full(p.worlds, -1, dtype=np.int32)
    own = tuple(name for name in VARIABLE if p.scene.values[name].shape[0] > 1)  # else equal entries fold: other bits
    dyn = where.dynamics(p.scene, p.worlds, variable=own)
    return dyn.forward_dynamics(p.q, p.qd, p.tau, status=status, **body_f), status


def only_flagged(p: Problem, clean: Problem, word: int, where: Setting) -> None:
    """World SPOILED of ``p`` alone has the status word, and NaN if it says so; others have their bits of ``clean``."""
    (qdd, status), (wanted, zero) = run(p, where), run(clean, where)
    others = np.arange(p.worlds) != SPOILED
    assert not zero.any(), f"the clean problem is flagged: {zero}"
    assert status[SPOILED] == word, f"status {status[SPOILED]}, qdd {qdd[SPOILED]}"
    assert word > 2 or np.isnan(qdd[SPOILED]).any(), f"status {word}, and yet the result is {qdd[SPOILED]}"
    assert not status[others].any(), f"other worlds are flagged: {status}"
    np.testing.assert_array_equal(qdd[others], wanted[others])


def in_one_world(p: Problem, name: str, value: Any) -> tuple[Problem, Problem]:
    """``p`` with one of the scene's values replaced in world SPOILED alone; and with it the same in all worlds."""
    values = np.repeat(p.scene.values[name][:1], p.worlds, axis=0)
    clean = Problem(p.scene.with_values(**{name: values}), p.q, p.tau, p.qd)
    values = values.copy()
    values[SPOILED] = value
    return Problem(p.scene.with_values(**{name: values}), p.q, p.tau, p.qd), clean


def closed_form(where: Setting) -> None:
    """D of the straight chain of thin rods, tip to base; it tends to 1/3 + 12^-1/2."""
    p, n = scenes.straight(6), 6
    p = Problem(p.scene.with_values(body_inertia=[np.diag([0.0, 1.0, 1.0]) / 12.0] * n), p.q, p.tau)  # not rounded
    dyn = where.dynamics(p.scene, p.worlds)
    dyn.forward_dynamics(p.q, None, p.tau)
    D = dyn.recursions.array("pivot").numpy()[::-1, 0]
    wanted = [Fraction(*pair) for pair in ((1, 3), (7, 12), (13, 21), (97, 156), (181, 291), (1351, 2172))]
    error = max(abs(Fraction(float(D[i])) / wanted[i] - 1) for i in range(n))
    assert error <= 10 * 4 * where.eps, f"error {float(error):.1e}"


def condition_slope(where: Setting) -> None:
    """cond of the mass matrix of straight rods grows with the 4th power of their number."""
    low, high = 64, 128
    cond = []
    for n in (low, high):
        p = scenes.straight(n)
        mass = dataclasses.replace(where, dtype="float64").dynamics(p.scene, p.worlds).mass_matrix(p.q)
        cond.append(np.linalg.cond(mass[0]))
    slope = np.log2(cond[1] / cond[0])
    assert abs(slope - 4.0) <= 0.1, f"slope {slope:.3f}, cond {cond}"


def massless_leaf(where: Setting) -> None:
    p = scenes.chain_rand(8)
    mass, inertia = p.scene.values["body_mass"][0].copy(), p.scene.values["body_inertia"][0].copy()
    mass[-1], inertia[-1] = 0.0, 0.0
    bad, clean = in_one_world(p, "body_mass", mass)
    both, _ = in_one_world(bad, "body_inertia", inertia)
    _, clean = in_one_world(clean, "body_inertia", inertia)
    only_flagged(both, clean, 1, where)


def negative_mass(where: Setting) -> None:
    """Body and Scene refuse it; in a variable value, which nobody inspects, a pivot that turns negative is flagged."""
    p = scenes.chain_rand(8)
    try:
        spo.Body(-1.0)
    except ValueError:
        pass
    else:
        raise AssertionError("Body takes a negative mass")
    mass = np.repeat(p.scene.values["body_mass"], p.worlds, axis=0)
    mass[SPOILED, -1] = -1.0
    try:
        p.scene.with_values(body_mass=mass)
    except ValueError:
        pass
    else:
        raise AssertionError("Scene.with_values takes a negative mass")
    dyn = where.dynamics(p.scene, p.worlds, variable=("body_mass",))
    dyn.set(body_mass=mass)
    status = np.zeros(p.worlds, dtype=np.int32)
    qdd = dyn.forward_dynamics(p.q, None, p.tau, status=status)
    assert status[SPOILED] == 1 and np.isnan(qdd[SPOILED]).any(), f"status {status}"
    assert np.isfinite(np.delete(qdd, SPOILED, 0)).all() and status.sum() == 1


def zero_inertia_axis(where: Setting) -> None:
    """A rod without inertia about its own axis, on a hinge about it: along an axis of its frame, and across."""
    for axis in ((1.0, 0.0, 0.0), (0.36, 0.48, 0.8)):
        along = np.array(axis)
        thin = (np.eye(3) - np.outer(along, along)) / 12.0
        bodies = [scenes.rod(), spo.Body(1.0, 0.5 * along, np.eye(3) / 12.0)]
        hinges = [spo.Hinge("revolute", -1, 0, axis=(0, 0, 1)), spo.Hinge("revolute", 0, 1, axis=axis)]
        q, tau = draw(2, scenes.WORLDS, 2, 0.6), draw(3, scenes.WORLDS, 2)
        p = problem(spo.Scene(bodies, hinges, gravity=GRAVITY), q, tau)
        inertia = p.scene.values["body_inertia"][0].copy()
        inertia[1] = scenes.rounded(thin)
        only_flagged(*in_one_world(p, "body_inertia", inertia), 1, where)


def unit_powers_of_two(where: Setting) -> None:
    """Mass by 2^7 and length by 2^-5 change no bit of qdd.

    As values of each world, which one program reads: folded they make two, whose products a GPU's compiler fuses with
    other sums.
    """
    p = scenes.chain_gravity(16)
    p = Problem(p.scene, p.q, scenes.rounded(draw(3, p.worlds, 16)), scenes.rounded(draw(5, p.worlds, 16)))
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


def stiff_is_locked(where: Setting) -> None:
    """Armature to infinity is a fixed hinge: the difference falls as 1/s, to rounding."""
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


def negative_armature(where: Setting) -> None:
    """Delta = -1.01 H P H* on one hinge is flagged. -0.99 of it on the root hinge leaves M positive: 100 times S1."""
    base = scenes.chain_rand(8)
    D = np.asarray(Sweep(base.scene, base.q[:1], "extended").D, dtype=np.float64)[0]
    p = Problem(base.scene, np.repeat(base.q[:1], base.worlds, axis=0), base.tau)
    for hinge in (0, HINGE):
        armature = -1.01 * D * (np.arange(8) == hinge)
        only_flagged(*in_one_world(p, "joint_armature", scenes.rounded(armature)), 1, where)
    p, _ = in_one_world(p, "joint_armature", scenes.rounded(-0.99 * D * (np.arange(8) == 0)))
    qdd, status = run(p, where)
    wanted = Sweep(p.scene, p.q, "extended").forward(p.tau)[SPOILED].astype(np.float64)
    error = np.linalg.norm(qdd[SPOILED] - wanted) / np.linalg.norm(wanted)
    assert not status.any(), "a positive D is flagged"
    assert error <= 10 * 100 * 5e-7 * where.eps / 2.0**-23, f"error {error:.1e}"


def lost_directions(where: Setting) -> None:
    """Where no digit of D is left, in oblique axes, a world is flagged: a ball, a d6 at the middle angle 90 degrees.

    At node granularity word 1 and NaN. A form that turns its frames onto the axes may be right to half of its digits
    instead; the word, which judges by the node's form, is 1 all the same.
    """
    for p in [scenes.weak_ball(weak, False) for weak in (1e-8, 1e-9, 0.0)] + [scenes.three_angles(0.0)]:
        if where.dtype == "float64":  # its own smallest numbers
            p = (
                scenes.weak_ball(1e-18, False)
                if p.q.shape[1] == 4
                else Problem(p.scene, np.where(np.arange(3) == 1, np.pi / 2.0, p.q), p.tau)
            )
        qdd, status = run(p, where)
        lost = np.isnan(qdd).any(1)
        assert (status == 1).all(), f"status {status}, q {p.q[0]}, qdd {qdd[0]}"
        if where.granularity == "node":
            assert lost.all(), f"q {p.q[0]}, qdd {qdd[0]}"
        elif not lost.all():
            wanted = Sweep(p.scene, p.q, "mp50").forward(p.tau).astype(np.float64)
            error = (np.linalg.norm(qdd - wanted, axis=1) / np.linalg.norm(wanted, axis=1))[~lost]
            assert error.max() <= where.eps**0.5, f"error {error.max():.1e}, q {p.q[0]}"


def lost_outboard(where: Setting) -> None:
    """A gimbal in oblique axes: D(0) is what is left when the arm's inertia cancels outboard, and that is rounding.

    Armature on the hinge that lost its inertia gives the digits back.
    """
    p = scenes.gimbal(1e-20, 1e-10, oblique=True)
    qdd, status = run(p, where)
    assert np.isin(status, (1, 3)).all(), f"status {status}, qdd {qdd[0]}"
    geared = Problem(p.scene.with_values(joint_armature=(2.0**-7, 0.0, 0.0)), p.q, p.tau)
    qdd, status = run(geared, where)
    wanted = Sweep(geared.scene, geared.q, "extended").forward(geared.tau).astype(np.float64)
    error = (np.linalg.norm(qdd - wanted, axis=1) / np.linalg.norm(wanted, axis=1)).max()
    assert not status.any() and error <= 1e3 * where.eps, f"status {status}, error {error:.1e}"  # .33 / 2^-7, and more


def digits_lost(where: Setting) -> None:
    """A ball whose weak axis keeps a quarter of the digits, in one world: word 3 there, and a number all the same."""
    base = scenes.weak_ball(0.5, False)
    weak = where.eps**0.75
    only_flagged(*in_one_world(base, "body_inertia", [np.diag([1.0, 1.0, float(np.float32(weak))])]), 3, where)


def out_of_range(where: Setting) -> None:
    """Finite numbers too small or too large for the dtype, in one world: word 4, and neither 1 nor 3 is blamed."""
    p = scenes.chain_rand(4)
    low, high = (-126, 127) if where.dtype == "float32" else (-1022, 1023)  # exponents of normal numbers
    spoiled = {
        "inertia so small that products are subnormal": dict(body_mass=low + 6, body_inertia=low + 6, tau=low + 6),
        "velocity products overflow": dict(qd=high - 20),
        "accelerations overflow": dict(tau=high),
        "accelerations are subnormal": dict(tau=low - 10, qd=low),
        "mass that overflows on the way to the base": dict(body_mass=high - 2, body_inertia=high - 2),
    }
    own = dict(q=p.q, qd=np.ones_like(p.q), tau=p.tau)
    values = {name: np.repeat(p.scene.values[name], p.worlds, axis=0) for name in ("body_mass", "body_inertia")}
    dyn = where.dynamics(p.scene, p.worlds, variable=tuple(values))
    wanted, others = dyn.forward_dynamics(**own), np.arange(p.worlds) != SPOILED
    for label, exponents in spoiled.items():
        changed = {name: array.copy() for name, array in (own | values).items()}
        for name, exponent in exponents.items():
            own_size = np.abs(changed[name][SPOILED]).max()
            changed[name][SPOILED] = np.ldexp(changed[name][SPOILED] / own_size, exponent)
        dyn.set(**{name: changed[name] for name in values})
        status = np.zeros(p.worlds, dtype=np.int32)
        qdd = dyn.forward_dynamics(**{name: changed[name] for name in own}, status=status)
        assert status[SPOILED] == 4 and status.sum() == 4, f"{label}: status {status}, qdd {qdd[SPOILED]}"
        np.testing.assert_array_equal(qdd[others], wanted[others], err_msg=label)


def massless_robot(where: Setting) -> None:
    """Bodies without any mass on hinges with armature: Mass = Delta, qdd = tau / Delta to the last bit."""
    n = 8
    scene = scenes.chain(np.zeros(n), gravity=GRAVITY, armature=2.0 ** np.arange(n))
    p = scenes.base(scene)
    qdd, status = run(p, where)
    assert not status.any(), f"status {status}"
    wanted = p.tau / scene.values["joint_armature"]
    assert np.abs(qdd / wanted - 1.0).max() <= where.eps, "qdd is not tau / Delta"


def floating_chain(worlds: int) -> Problem:
    """Twelve links that float; velocities, forces and gravity."""
    p = scenes.far_origin(0.0, floating=True)
    q, tau = (np.resize(x, (worlds, x.shape[1])) for x in (p.q, p.tau))
    return Problem(p.scene, q, tau, scenes.rounded(draw(5, worlds, p.scene.dof_count)))


def non_finite_input(where: Setting) -> None:
    """NaN and infinity in every entry of every input, each in a world of its own: status 2, and the others' bits.

    Worlds with odd numbers are spoiled, by one entry each. An entry that a form of the recursion does not read, the
    place of a free root, changes nothing but the word.
    """
    scene = floating_chain(1).scene
    sizes = dict(q=scene.coord_count, qd=scene.dof_count, tau=scene.dof_count, body_f=6 * scene.body_count)
    for name, entries in sizes.items():
        p = floating_chain(2 * entries)
        body_f = scenes.rounded(draw(9, p.worlds, 6 * scene.body_count)).reshape(p.worlds, -1, 6)
        given, odd = dict(q=p.q, qd=p.qd, tau=p.tau, body_f=body_f), np.arange(p.worlds) % 2 == 1
        dyn = where.dynamics(scene, p.worlds)
        wanted = dyn.forward_dynamics(**given)
        for spoil in (np.nan, np.inf, -np.inf):
            array, status = given[name].copy(), np.zeros(p.worlds, dtype=np.int32)
            array.reshape(p.worlds, -1)[1::2][np.diag_indices(entries)] = spoil
            qdd = dyn.forward_dynamics(**given | {name: array}, status=status)
            label = f"{name} = {spoil}"
            np.testing.assert_array_equal(status, np.where(odd, 2, 0), err_msg=label)
            np.testing.assert_array_equal(qdd[~odd], wanted[~odd], err_msg=label)
            hidden = np.flatnonzero(np.isfinite(qdd[odd]).all(1) & (qdd[odd] != wanted[odd]).any(1))
            assert not len(hidden), f"{label}: entries {hidden} leave a finite result"


READ = ("body_mass", "body_com", "body_inertia", "joint_armature", "joint_X_p", "joint_X_c", "gravity")


def non_finite_value(where: Setting) -> None:
    """The same in every entry of every value of the scene that forward dynamics reads, set while it is variable.

    Infinite armature is a locked hinge: the result is finite and right, and yet the word is 2.
    """
    scene = floating_chain(1).scene
    for name in READ:
        entries = scene.values[name][0].size
        p = floating_chain(2 * entries)
        odd = np.arange(p.worlds) % 2 == 1
        dyn = where.dynamics(scene, p.worlds, variable=(name,))
        wanted = dyn.forward_dynamics(p.q, p.qd, p.tau)
        for spoil in (np.nan, np.inf, -np.inf):
            values = np.repeat(scene.values[name], p.worlds, axis=0)
            values.reshape(p.worlds, -1)[1::2][np.diag_indices(entries)] = spoil
            status = np.zeros(p.worlds, dtype=np.int32)
            dyn.set(**{name: values})
            qdd = dyn.forward_dynamics(p.q, p.qd, p.tau, status=status)
            label = f"{name} = {spoil}"
            np.testing.assert_array_equal(status, np.where(odd, 2, 0), err_msg=label)
            np.testing.assert_array_equal(qdd[~odd], wanted[~odd], err_msg=label)
            hidden = np.flatnonzero(np.isfinite(qdd[odd]).all(1) & (qdd[odd] != wanted[odd]).any(1))
            assert not len(hidden) or label == "joint_armature = inf", f"{label}: entries {hidden} give a finite result"
        dyn.set(**{name: scene.values[name][0]})
        np.testing.assert_array_equal(dyn.forward_dynamics(p.q, p.qd, p.tau), wanted, err_msg=f"{name} set back")


def same_bits(where: Setting, worlds: int = 64) -> None:
    """Three runs, worlds permuted, one world alone, bodies renumbered with the order of siblings kept."""
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


def worlds_against_closed_form(where: Setting, worlds: int = 1) -> None:
    """A double pendulum of uniform rods in any number of worlds against its 2 x 2 mass matrix."""
    rng = np.random.default_rng(0)
    q, tau = rng.uniform(-1.0, 1.0, (worlds, 2)), rng.normal(size=(worlds, 2))
    rods = [spo.Body(1.0, (0.5, 0.0, 0.0), np.diag([0.0, 1.0, 1.0]) / 12.0)] * 2
    p = problem(scenes.tree([-1, 0], rods, [0.0, 1.0], [0, 0]), q, tau)
    qdd, status = run(p, where)
    c = np.cos(p.q[:, 1])
    J = p.scene.values["body_inertia"][0, 0, 2, 2] + 0.25  # about the end, of 1/12 as float32 has it
    M = np.array([[1.0 + 2.0 * J + c, J + c / 2.0], [J + c / 2.0, np.full(worlds, J)]])
    det = M[0, 0] * M[1, 1] - M[0, 1] ** 2
    wanted = np.stack([M[1, 1] * p.tau[:, 0] - M[0, 1] * p.tau[:, 1], M[0, 0] * p.tau[:, 1] - M[0, 1] * p.tau[:, 0]])
    error = np.linalg.norm(qdd - (wanted / det).T, axis=1) / np.linalg.norm(wanted / det, axis=0)
    assert not status.any() and error.max() <= 10 * 5e-7 * where.eps / 2.0**-23, f"error {error.max():.1e}"


def many_worlds(where: Setting) -> None:
    worlds_against_closed_form(where, 2**20)


def many_steps(where: Setting) -> None:
    """On a GPU, where a graph of steps is replayed; elsewhere the check stiff_arm does 10 000."""
    device = wp.get_device(where.device)
    stiff_arm(where, 1_000_000 if device.is_cuda else 20_000)


def same_bits_of_many(where: Setting) -> None:
    same_bits(where, 4096)


CHECKS = {
    "S5.closed_form": (closed_form, "S5"),
    "S6.cond_law": (condition_slope, "S6"),
    "S14.massless_leaf": (massless_leaf, "S14"),
    "S19.unit_pow2": (unit_powers_of_two, "S19"),
    "S20.stiff_is_locked": (stiff_is_locked, "S20"),
    "S21.negative_delta": (negative_armature, "S21"),
    "S32.determinism": (same_bits, "S32"),
    "negative_mass": (negative_mass, "beyond what bodies are"),
    "massless_robot": (massless_robot, "beyond what bodies are"),
    "zero_inertia_axis": (zero_inertia_axis, "beyond what bodies are"),
    "lost_directions": (lost_directions, "lost digits"),
    "lost_outboard": (lost_outboard, "lost digits"),
    "digits_lost": (digits_lost, "status words"),
    "out_of_range": (out_of_range, "status words"),
    "non_finite_input": (non_finite_input, "beyond what bodies are"),
    "non_finite_value": (non_finite_value, "beyond what bodies are"),
    "stiff_arm": (stiff_arm, "beyond what bodies are"),
    "one_world": (worlds_against_closed_form, "closed form"),
}
"""Name -> (check, where it stands)."""

LONG = {
    "S32.determinism_4096_worlds": (same_bits_of_many, "S32"),
    "stiff_arm_million_steps": (many_steps, "beyond what bodies are"),
    "million_worlds": (many_worlds, "beyond what bodies are"),
}
"""Those that take long, as the slow cases do."""

READS_PIVOTS = ("S5.closed_form",)
"""Checks of D as the recursions leave it in memory, which only granularity "node" does."""
