"""Stress checks of status words: a world that cannot be computed is flagged, and no other world changes.

A check is a function of a :class:`Setting` that raises AssertionError. ``CHECKS`` names the checks.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import warp_spo as spo
from warp_spo.execution.parameters import VARIABLE

from . import scenes
from .exact import Sweep
from .scenes import GRAVITY, Problem, Setting, draw, problem

HINGE = 3  # of an 8-link chain: its armature is changed by a check
SPOILED = 5  # world whose values a check changes
READ = ("body_mass", "body_com", "body_inertia", "joint_armature", "joint_X_p", "joint_X_c", "gravity")
"""Values of a scene that forward dynamics reads."""


def run(p: Problem, where: Setting, **body_f: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return qdd [world, dof] and status [world] of forward dynamics; values that differ by world are variable."""
    status = np.full(p.worlds, -1, dtype=np.int32)
    # Values that happen to be equal must be variable too: folded values give other bits.
    variable = tuple(name for name in VARIABLE if p.scene.values[name].shape[0] > 1)
    dyn = where.dynamics(p.scene, p.worlds, variable=variable)
    return dyn.forward_dynamics(p.q, p.qd, p.tau, status=status, **body_f), status


def assert_one_world_flagged(p: Problem, clean: Problem, word: int, where: Setting) -> None:
    """Fail unless world SPOILED of ``p`` alone has the status ``word``, and all others the bits that ``clean`` gives.

    Words 1 and 2 must come with NaN.
    """
    (qdd, status), (wanted, zero) = run(p, where), run(clean, where)
    others = np.arange(p.worlds) != SPOILED
    assert not zero.any(), f"the clean problem is flagged: {zero}"
    assert status[SPOILED] == word, f"status {status[SPOILED]}, qdd {qdd[SPOILED]}"
    assert word > 2 or np.isnan(qdd[SPOILED]).any(), f"status is {word}, but the result is {qdd[SPOILED]}"
    assert not status[others].any(), f"other worlds are flagged: {status}"
    np.testing.assert_array_equal(qdd[others], wanted[others])


def spoil_one_world(p: Problem, name: str, value: Any) -> tuple[Problem, Problem]:
    """Return ``p`` with a value of its scene replaced in world SPOILED, and ``p`` with the old value in every world."""
    values = np.repeat(p.scene.values[name][:1], p.worlds, axis=0)
    clean = Problem(p.scene.with_values(**{name: values}), p.q, p.tau, p.qd)
    values = values.copy()
    values[SPOILED] = value
    return Problem(p.scene.with_values(**{name: values}), p.q, p.tau, p.qd), clean


def check_massless_leaf(where: Setting) -> None:
    """A last link without mass and inertia, in one world, is flagged there."""
    p = scenes.chain_rand(8)
    mass, inertia = p.scene.values["body_mass"][0].copy(), p.scene.values["body_inertia"][0].copy()
    mass[-1], inertia[-1] = 0.0, 0.0
    bad, clean = spoil_one_world(p, "body_mass", mass)
    both, _ = spoil_one_world(bad, "body_inertia", inertia)
    _, clean = spoil_one_world(clean, "body_inertia", inertia)
    assert_one_world_flagged(both, clean, 1, where)


def check_negative_mass(where: Setting) -> None:
    """Body and Scene refuse a negative mass; in a variable value, which is not inspected, its world is flagged."""
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


def check_zero_inertia_axis(where: Setting) -> None:
    """A rod without inertia about its own axis, on a hinge about it, is flagged; in its frame or oblique to it."""
    for axis in ((1.0, 0.0, 0.0), (0.36, 0.48, 0.8)):
        along = np.array(axis)
        thin = (np.eye(3) - np.outer(along, along)) / 12.0
        bodies = [scenes.rod(), spo.Body(1.0, 0.5 * along, np.eye(3) / 12.0)]
        hinges = [spo.Hinge("revolute", -1, 0, axis=(0, 0, 1)), spo.Hinge("revolute", 0, 1, axis=axis)]
        q, tau = draw(2, scenes.WORLDS, 2, 0.6), draw(3, scenes.WORLDS, 2)
        p = problem(spo.Scene(bodies, hinges, gravity=GRAVITY), q, tau)
        inertia = p.scene.values["body_inertia"][0].copy()
        inertia[1] = scenes.round_to_float32(thin)
        assert_one_world_flagged(*spoil_one_world(p, "body_inertia", inertia), 1, where)


def check_negative_armature(where: Setting) -> None:
    """Armature of -1.01 H P H* on a hinge is flagged; -0.99 H P H* on the root is not, and may err by 100 times S1."""
    base = scenes.chain_rand(8)
    D = np.asarray(Sweep(base.scene, base.q[:1], "extended").D, dtype=np.float64)[0]
    p = Problem(base.scene, np.repeat(base.q[:1], base.worlds, axis=0), base.tau)
    for hinge in (0, HINGE):
        armature = -1.01 * D * (np.arange(8) == hinge)
        assert_one_world_flagged(*spoil_one_world(p, "joint_armature", scenes.round_to_float32(armature)), 1, where)
    p, _ = spoil_one_world(p, "joint_armature", scenes.round_to_float32(-0.99 * D * (np.arange(8) == 0)))
    qdd, status = run(p, where)
    wanted = Sweep(p.scene, p.q, "extended").forward(p.tau)[SPOILED].astype(np.float64)
    error = np.linalg.norm(qdd[SPOILED] - wanted) / np.linalg.norm(wanted)
    assert not status.any(), "a positive D is flagged"
    assert error <= 10 * 100 * 5e-7 * where.eps / 2.0**-23, f"error {error:.1e}"


def check_lost_directions(where: Setting) -> None:
    """A world in which no digit of D is right is flagged: a weak ball, and a d6 hinge whose middle angle is 90 degrees.

    Granularity "node" gives word 1 and NaN. Other granularities, whose frames lie along the hinges' axes, may give a
    result that is right to half of its digits; the word, which describes the node's recursion, is 1 there too.
    """
    for p in [scenes.weak_ball(weak, False) for weak in (1e-8, 1e-9, 0.0)] + [scenes.three_angles(0.0)]:
        if where.dtype == "float64":  # the same with the smallest numbers of float64
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


def check_outboard_cancellation(where: Setting) -> None:
    """A gimbal with oblique axes, in whose D(0) the arm's inertia cancels down to rounding, is flagged.

    With armature on that hinge the result is right, and nothing is flagged.
    """
    p = scenes.gimbal(1e-20, 1e-10, oblique=True)
    qdd, status = run(p, where)
    assert np.isin(status, (1, 3)).all(), f"status {status}, qdd {qdd[0]}"
    geared = Problem(p.scene.with_values(joint_armature=(2.0**-7, 0.0, 0.0)), p.q, p.tau)
    qdd, status = run(geared, where)
    wanted = Sweep(geared.scene, geared.q, "extended").forward(geared.tau).astype(np.float64)
    error = (np.linalg.norm(qdd - wanted, axis=1) / np.linalg.norm(wanted, axis=1)).max()
    # the arm's .33 over the armature 2^-7 is 42; S1
    assert not status.any() and error <= 1e3 * where.eps, f"status {status}, error {error:.1e}"


def check_half_of_the_digits_lost(where: Setting) -> None:
    """A ball joint whose weak axis keeps a quarter of the digits, in one world, gets word 3 and a finite result."""
    base = scenes.weak_ball(0.5, False)
    weak = where.eps**0.75
    assert_one_world_flagged(
        *spoil_one_world(base, "body_inertia", [np.diag([1.0, 1.0, float(np.float32(weak))])]), 3, where
    )


def check_out_of_range(where: Setting) -> None:
    """Finite numbers that are too small or too large for the dtype, in one world, get word 4 there, not 1 or 3."""
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


def check_non_finite_input(where: Setting) -> None:
    """NaN or infinity in one entry of an input gets status 2 in its world and changes no bit of another world.

    Every entry of every input is tried: one in each world with an odd number. An entry that the recursion does not
    read, such as the position of a free root, changes the word alone.
    """
    scene = scenes.floating_chain(1).scene
    sizes = dict(q=scene.coord_count, qd=scene.dof_count, tau=scene.dof_count, body_f=6 * scene.body_count)
    for name, entries in sizes.items():
        p = scenes.floating_chain(2 * entries)
        body_f = scenes.round_to_float32(draw(9, p.worlds, 6 * scene.body_count)).reshape(p.worlds, -1, 6)
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


def check_non_finite_value(where: Setting) -> None:
    """NaN or infinity in one entry of a variable value gets status 2 in its world and changes no bit of another world.

    Every entry of every value in READ is tried. Infinite armature locks a hinge: the result is finite and right, and
    the word is 2 nevertheless.
    """
    scene = scenes.floating_chain(1).scene
    for name in READ:
        entries = scene.values[name][0].size
        p = scenes.floating_chain(2 * entries)
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


CHECKS = {
    "S14.massless_leaf": (check_massless_leaf, "S14"),
    "S21.negative_delta": (check_negative_armature, "S21"),
    "negative_mass": (check_negative_mass, "unusual inputs"),
    "zero_inertia_axis": (check_zero_inertia_axis, "unusual inputs"),
    "lost_directions": (check_lost_directions, "lost digits"),
    "lost_outboard": (check_outboard_cancellation, "lost digits"),
    "digits_lost": (check_half_of_the_digits_lost, "status words"),
    "out_of_range": (check_out_of_range, "status words"),
    "non_finite_input": (check_non_finite_input, "unusual inputs"),
    "non_finite_value": (check_non_finite_value, "unusual inputs"),
}
"""Name -> (check, section of the stress suite that it belongs to)."""
