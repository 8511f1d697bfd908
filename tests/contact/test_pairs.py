"""Bodies that touch each other: their points, and the coupled step against the dense one."""

import functools
import re
from itertools import product

import numpy as np
import pytest

import warp_spo as spo
from support import warp_machine
from support.pair_scenes import (
    H,
    box,
    cube,
    cube_thrown_at_cube,
    free,
    hand,
    hand_states,
    mixed,
    mixed_states,
    palm,
    ring,
    ring_states,
    shelf,
    shelf_states,
    stack,
    stepped,
)
from support.pair_steps import assert_is_dense, plant
from support.pair_touches import assert_points_are_those_of_the_reference
from warp_spo.dynamics.stepping.integrators import CONTACT_STEP, PAIRED_STEP
from warp_spo.examples import grasp
from warp_spo.execution import plan
from warp_spo.execution.device_facts import MEASURED
from warp_spo.kernels import couple_laws, couples
from warp_spo.recursions.contact import aggregates, coupled

WORLDS = 9
KINDS = [(0, 0), (0, 1), (1, 0), (1, 1), (0, 2), (2, 0)]


@pytest.mark.parametrize(("kinds", "long"), [*product(KINDS, [False]), ((0, 1), True), ((1, 0), True)])
def test_points_are_those_of_the_reference(device, kinds, long):
    """Segments, spheres, boxes, a hull, the first of these with the others; half of the boxes nearly aligned."""
    assert_points_are_those_of_the_reference(device, kinds, long)


@functools.cache
def mixed_dynamics(device, dtype):
    return spo.Dynamics(mixed(), WORLDS, device=device, dtype=dtype, variable=("contact_friction",))


def test_a_step_is_the_dense_one(device):
    """Every kind of pair, drives with limits, the ground; another friction in each world."""
    dyn, (q, qd) = mixed_dynamics(str(device), "float64"), mixed_states(0, WORLDS)
    friction = np.linspace(0.2, 1.0, WORLDS)[:, None] * np.ones((1, dyn.scene.contact_count))
    dyn.set(contact_friction=friction)
    for passes in (None, 1, 3):
        assert_is_dense(dyn, q, qd, passes, least=WORLDS, contact_friction=friction)


def test_a_hand_is_the_dense_one(device):
    """Limbs on a base, four pairs of which are of the same two bodies, and a world in which nothing touches."""
    q, qd = hand_states(0, 6)
    dyn = spo.Dynamics(hand(), 6, device=device, dtype="float64")
    assert_is_dense(dyn, q, qd, least=12)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hand", "mixed"])
def test_a_world_does_the_same_alone(device, name):
    """As among others, whose bodies may touch where its own do not; and whatever granularity is asked for."""
    scene, states = {"hand": (hand, hand_states), "mixed": (mixed, mixed_states)}[name]
    q, qd = states(1, 6)
    found = assert_is_dense(spo.Dynamics(scene(), 6, device=device, dtype="float64"), q, qd)
    alone = spo.Dynamics(scene(), 1, device=device, dtype="float64", granularity="segment")
    one = stepped(alone, q[-1:], qd[-1:])
    for key in ("q", "qd", "contact_f"):
        np.testing.assert_array_equal(one[key][0], found[key][-1])


@pytest.mark.slow
def test_a_ring_of_bodies_between_arms(device):
    """Bodies that fly are carried by others, couples close a ring, and two trees meet."""
    assert_is_dense(spo.Dynamics(ring(), 6, device=device, dtype="float64"), *ring_states(0, 6), least=12)


@pytest.mark.slow
def test_shapes_that_stand_still(device):
    """Of the inertial frame, as of a body that is fixed there."""
    (q, qd), found = shelf_states(0, 5), {}
    for body in (-1, 2):
        dyn = spo.Dynamics(shelf(body), 5, device=device, dtype="float64")
        found[body] = assert_is_dense(dyn, q, qd, least=5)
    assert found[-1]["contact_f"][:, 4:].any(axis=(0, 2)).tolist() == [True, True, False, True]
    for name in ("q", "qd", "contact_f", "contact_slip"):
        np.testing.assert_allclose(found[-1][name], found[2][name], atol=1e-9)
    np.testing.assert_array_equal(shelf(-1).values["contact_stiffness"], shelf(2).values["contact_stiffness"])


@pytest.mark.slow
def test_a_pair_of_the_base_itself(device):
    q, qd = hand_states(2, 4)
    dyn = spo.Dynamics(palm(), 4, device=device, dtype="float64")
    assert_is_dense(dyn, q, qd, least=8)
    assert "a thread computes a whole world" in dyn.explain()


@pytest.mark.slow
def test_a_step_in_float32_is_the_dense_one(device):
    dyn, (q, qd) = mixed_dynamics(str(device), "float32"), mixed_states(0, WORLDS)
    friction = np.full((WORLDS, dyn.scene.contact_count), 0.8)
    dyn.set(contact_friction=friction.astype(np.float32))
    assert_is_dense(dyn, q, qd, least=WORLDS, contact_friction=friction)


def test_nan_stays_in_its_world(device):
    dyn, (q, qd) = mixed_dynamics(str(device), "float64"), mixed_states(0, WORLDS)
    friction = np.full((WORLDS, dyn.scene.contact_count), 0.5)
    dyn.set(contact_friction=friction)
    clean = stepped(dyn, q, qd)
    friction[1, -3], q[2, 4] = np.nan, np.nan
    dyn.set(contact_friction=friction)
    found = stepped(dyn, q, qd)
    assert found["status"].tolist()[1:3] == [spo.Status.NOT_FINITE] * 2 and np.isnan(found["qd"][1:3]).any(axis=1).all()
    for name in ("q", "qd", "contact_f", "status"):
        np.testing.assert_array_equal(np.delete(found[name], [1, 2], axis=0), np.delete(clean[name], [1, 2], axis=0))


FIND = "counts[pair] = find(pair, places, touches);"
BUGS = {
    "adhesion": (couple_laws, "touch.depth - h * normal > 0;", "true;"),
    "opens at last": (couple_laws, "(closing && closed) || ", ""),
    "no friction": (couples, "sides.add(a, touch.at);", ""),
    "no lever of friction": (couples, "skew[3 * i + j - 3]", "0"),
    "no lever of springs": (couples, "add_cross(load, push + 1, normal);", ""),
    "a pair of two is forgotten": (couples, FIND, FIND.replace("= find", "= e > first_pair_of(p) ? 0 : find")),
    "dampers before the step are forgotten": (couples, "FUSED(-K[e], start[(j + 3) % 6], load[i])", "load[i]"),
    "unequal forces": (coupled.CoupledStep._columns, "(1.0, -1.0)", "(1.0, -0.9)"),
    "no other dof": (aggregates.AggregateSolve._system, "if other <= at:", "if other == at:"),
    "the base has no part": (aggregates.AggregateSolve.close, "P.less(U[at], G[-1])", "P"),
    "the base stands still": (aggregates.AggregateSolve.open, "x - dot(self.G[-1 - at], alpha) if self.G else x", "x"),
}


TELLING = [0, 1, 20, 71, 112, 194]
"""Throws in which points open and close between passes: found as those whose step a planted bug changes."""


def test_a_cube_that_is_thrown_at_another(device):
    scene, q, qd = cube_thrown_at_cube(TELLING)
    dyn = spo.Dynamics(scene, len(q), device=device, dtype="float64")
    assert_is_dense(dyn, q, qd, 3)


@pytest.mark.slow
@pytest.mark.parametrize("bug", BUGS)
def test_a_planted_bug_is_seen(monkeypatch, device, bug):
    plant(monkeypatch, *BUGS[bug])
    with pytest.raises(AssertionError):
        test_a_cube_that_is_thrown_at_another(device)
        test_a_hand_is_the_dense_one(device)


STICK = dict(capsule=((0, 0, 0), (0, 0, 1), 0.1))
MISTAKES = {
    "itself": (lambda: [box(0, 0.1, other=box(0, 0.1))], ValueError, "of body 0 with itself"),
    "nobody": (lambda: [box(0, 0.1, other=box(3, 0.1))], ValueError, "with body 3; expected one of 2"),
    "a name": (lambda: [box(0, 0.1, other=box("cube", 0.1))], TypeError, "with body 'cube'; expected an integer"),
    "a fraction": (lambda: [box(0, 0.1, other=box(1.0, 0.1))], TypeError, "with body 1.0; expected an integer"),
    "no shape": (lambda: [box(0, 0.1, other=1)], ValueError, "has 0 contacts with the ground"),
    "nested": (lambda: [box(0, 0.1, other=box(1, 0.1, other=0))], ValueError, "an other= itself"),
    "kind": (lambda: [box(0, 0.1, other="cube")], TypeError, "other is 'cube'; expected a Contact"),
    "flat hull": (lambda: [spo.Contact(0, hull=np.eye(3), other=box(1, 0.1))], ValueError, "3 points in one plane"),
    "dissipation": (lambda: [box(0, 0.1, other=box(1, 0.1), dissipation=1.0)], spo.UnsupportedError, "dissipation="),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_have_names(mistake):
    make, kind, message = MISTAKES[mistake]
    with pytest.raises(kind, match=message):
        free([cube(1.0, 0.1)] * 2, make())


def test_a_body_with_modes_is_refused_on_either_side():
    modes = spo.Modes(np.eye(1), 100.0 * np.eye(1), 0.1 * np.eye(1), np.zeros((6, 1)))
    bodies = [cube(1.0, 0.1), spo.Body(1.0, inertia=0.01 * np.eye(3), modes=modes)]
    for body in (0, 1):
        with pytest.raises(spo.UnsupportedError, match=r"contact 0: a contact (of|with) a body with modes"):
            free(bodies, [box(body, 0.1, other=box(1 - body, 0.1))])


def test_the_plan_takes_the_form_that_was_faster():
    """A thread a world for pairs, and for arms; limbs for cubes on the ground; see the measured facts."""
    forms = {}
    for name, scene in (("arm", grasp.scene()), ("stack", stack())):
        for worlds in (4096, 65536):
            chosen = plan.choose(scene, worlds, MEASURED, "float32")
            forms[name, worlds] = [chosen.of(routine) for routine in (PAIRED_STEP, CONTACT_STEP)]
    assert forms["arm", 4096] == forms["arm", 65536] == ["tree", "tree"]
    arm = grasp.scene()
    held = plan.choose(arm, 256, MEASURED, "float32")
    assert held.granularity == "tree" and "most of its links are on one path" in held.reason
    assert plan.choose(stack(), 256, MEASURED, "float32").granularity == "segment"
    assert forms["stack", 4096] == forms["stack", 65536] == ["tree", "segment"]


def test_couples_have_warps_of_their_own_where_worlds_are_few(monkeypatch):
    """All warps of a block come to the same barriers, and only the first one stores."""
    monkeypatch.setattr("warp_spo.dynamics.dynamics.read_facts", lambda device: MEASURED)
    texts, scene = warp_machine.recorded(monkeypatch), hand()
    for worlds in (40, 1 << 17):
        sizes = dict(q=scene.coord_count, qd=scene.dof_count, tau=scene.dof_count)
        shapes = {name: (worlds, size) for name, size in sizes.items()} | dict(dt=(), passes=())
        dyn = spo.Dynamics(scene, worlds, "cpu", "float32", granularity="tree")
        dyn.programs.find(PAIRED_STEP, shapes, shapes["qd"], {"q_out": shapes["q"]})
    few, many = texts
    assert (few.frame.warps, few.frame.block, many.frame.warps) == (4, 128, 1) and many.cpu == many.cuda
    own, _, others = few.cuda.split("if (warp == 0) {")[1].rpartition("} else {")
    seen = r"bar.sync|couples::judge\(couples::FIRST|couples::judge\(turn|for \(int turn"
    first, later = (["bar.sync", f"couples::judge({stage}", "bar.sync"] for stage in ("couples::FIRST", "turn"))
    assert re.findall(seen, own)[-7:] == re.findall(seen, others) == [*first, "for (int turn", *later]
    assert "result_row" in own and "result_row" not in others


def test_pairs_of_bodies_that_stand_still_are_solved_in_joint_space(device):
    scene = stack((1.0, 1.0))
    still = spo.Contact(2, sphere=0.1, other=spo.Contact(-1, sphere=0.1))  # neither of the two can move
    fixed = shelf(2).with_contacts([*shelf(2).contacts, still])
    at = shelf_states(0, 2)[0]  # such a pair is solved in joint space, whatever the granularity
    found = [spo.Dynamics(one, 2, device=device, dtype="float64", granularity=forced)
             .step(at, np.zeros_like(at[:, 2:]), None, H)[1]
             for one, forced in ((fixed, "segment"), (fixed, "tree"))]  # fmt: skip
    np.testing.assert_array_equal(*found)
    assert "1 pairs of bodies" in spo.Dynamics(scene, device=device).explain()
