"""Steps with contacts by limbs side by side: the step by whole trees, races, and neighbours."""

import dataclasses
import functools
import re

import numpy as np
import pytest

import warp_spo as spo
from support import symbolic, warp_machine, zoo
from support.actuated import driven_hand
from support.contact_cases import box, everywhere, quadruped, touching
from support.contact_steps import FIELDS, above, assert_is_dense, steps, with_turning
from support.step_scenes import furnished, states
from warp_spo.dynamics.stepping.integrators import CONTACT_STEP
from warp_spo.execution import plan
from warp_spo.execution.segment import warp_specialized
from warp_spo.kernels import pass_loops, straight_line
from warp_spo.kernels.substeps import repeat_on_cuda
from warp_spo.recursions.contact import points, step
from warp_spo.recursions.contact.step import REPORTS
from warp_spo.recursions.model.exchange import SegmentExchange
from warp_spo.reference.contact import ContactStep
from warp_spo.scene.contact_shapes import CORNERS

H, WORLDS = 5e-3, 4
SIZES = {"contact_f": (3,), "contact_gap": (), "contact_slip": (), "contact_moment": (3,)}


def case(name):
    """A scene and states. The quadruped's legs share the points of its trunk; others have points anywhere, and in the
    last one tendons from limb to limb."""
    if name in ("quadruped", "stairs"):
        scene = quadruped(ground=steps() if name == "stairs" else None)
        return scene, dict(zip(("q", "qd", "tau"), touching(scene, 3, WORLDS), strict=True))
    if name in ("hulls", "hulls on stairs"):
        scene = quadruped(ground=steps() if name == "hulls on stairs" else None)
        barrel = np.array([[x, *y] for x in (-0.1, 0.1) for y in hexagon() * 0.08])
        scene = scene.with_contacts([*scene.contacts, spo.Contact(0, hull=barrel)], scene.ground)
        return scene, dict(zip(("q", "qd", "tau"), touching(scene, 3, WORLDS), strict=True))
    if name in ("crowded", "turning"):
        scene = mirrored() if name == "crowded" else with_turning(mirrored())
        return scene, dict(zip(("q", "qd", "tau"), touching(scene, 3, WORLDS), strict=True))
    if name == "driven":
        scene = everywhere(driven_hand(), 0)
        ctrl = np.random.default_rng(4).normal(size=(WORLDS, len(scene.actuators)))
        return scene, states(scene, WORLDS) | {"ctrl": ctrl}
    scene = everywhere(furnished(zoo.random_tree(8, 1)), 1) if name == "tree" else everywhere(furnished(zoo.fork()), 0)
    return scene, states(scene, WORLDS)


def hexagon():
    """Corners [6, 2] of a hexagon about the origin."""
    turn = np.pi / 3.0 * np.arange(6)
    return np.stack([np.cos(turn), np.sin(turn)], axis=1)


def mirrored():
    """The quadruped with blocks for shins, its right legs put on turned about: constants 1 there are -1."""
    scene = quadruped()
    hinges = list(scene.hinges)
    for at, hinge in enumerate(hinges):
        if hinge.parent == 0 and hinge.parent_pose[1] < 0.0:
            about = np.append(hinge.parent_pose[:3], [0.0, 0.0, 1.0, 0.0])
            hinges[at] = dataclasses.replace(hinge, parent_pose=about)
    shins = [spo.Contact(b, hull=CORNERS * (0.02, 0.03, 0.1) - (0, 0, 0.11)) for b in (3, 6, 9, 12)]
    return spo.Scene(scene.bodies, hinges, contacts=[*shins, scene.contacts[-1]])


@functools.cache
def known(name, staged=False):
    """What :func:`text_of` returns of the code as it is; whoever changes a state copies it."""
    with pytest.MonkeyPatch.context() as patch:
        return text_of(patch, name, staged)


def text_of(monkeypatch, name, staged=False, reports=REPORTS, status=True, **numbers):
    """The CUDA text of a step with all reports, a state, and what the step by a whole tree gives."""
    for limit in ("FEW_WORLDS", "LONG_ROWS") if staged else ():
        monkeypatch.setattr(plan, limit, 0)
    monkeypatch.setattr(straight_line, "SHARED_BYTES", 1 << 20)
    texts, (scene, a) = warp_machine.recorded(monkeypatch), case(name)
    if not staged:
        a.pop("body_f", None)  # long rows always come through shared memory
    dyn = spo.Dynamics(scene, WORLDS, device="cpu", dtype="float64", granularity="segment")
    rate, count = (WORLDS, scene.dof_count), len(scene.contact_points)
    shapes = {key: array.shape for key, array in a.items()} | {"dt": (), "passes": (), **dict.fromkeys(numbers, ())}
    more = {"q_out": (WORLDS, scene.coord_count), "qdd_out": rate} | ({"status": (WORLDS,)} if status else {})
    sizes = {key: (WORLDS, count, *size) for key, size in SIZES.items()} | {"contact_excess": (WORLDS, 3)}
    more |= {key: sizes[key] for key in reports}
    options = dict(reports=reports, qdd=True) | ({"status": True} if status else {})
    program = dyn.programs.find(CONTACT_STEP, shapes, rate, more, **options)
    assert program.warps > 1 and texts[-1].frame.staged == staged
    return texts[-1], a | {"dt": H, "passes": 3.0, **numbers}, symbolic.contact_step(scene, a, H)


def assert_alike(got, more, wanted):
    for key, array in {"out": got, **more}.items():
        right = wanted[key].reshape(len(array), -1)
        np.testing.assert_allclose(array, right, atol=1e-9 * max(1.0, np.abs(right).max()), err_msg=key)


@pytest.mark.parametrize(
    ("name", "staged"),
    [
        ("quadruped", True),
        ("fork", False),
        ("crowded", True),
        pytest.param("turning", True, marks=pytest.mark.slow),
        pytest.param("tree", True, marks=pytest.mark.slow),
        pytest.param("driven", True, marks=pytest.mark.slow),
        pytest.param("stairs", False, marks=pytest.mark.slow),
        pytest.param("hulls", False, marks=pytest.mark.slow),
        pytest.param("hulls on stairs", False, marks=pytest.mark.slow),
    ],
)
def test_warps_meet_at_barriers_alone(name, staged):
    """Warp by warp in either order, written over the state."""
    assert_right(known(name, staged))


def assert_right(case):
    text, a, wanted = case
    assert wanted["contact_f"].any()
    for backwards in (False, True):
        for over in (None, {"q_out": "q", "out": "qd"}):
            assert_alike(warp_machine.run(text, a, backwards, more := {}, over), more, wanted)


@pytest.mark.parametrize(("reports", "status"), [((), True), (("contact_excess",), False), ((), False)])
def test_what_is_not_asked_for(reports, status, monkeypatch):
    text, a, wanted = text_of(monkeypatch, "quadruped", True, reports, status)
    assert_alike(warp_machine.run(text, a, further=(more := {})), more, wanted)
    assert set(more) == {"q_out", "qdd_out", *reports, *(["status"] if status else [])}


def test_substeps_meet_at_barriers_alone(monkeypatch):
    """State, reports and the mean force of two substeps are those of two runs, to the bit."""
    text, a, _ = text_of(monkeypatch, "quadruped", substeps=2)
    text, over = text._replace(cuda=repeat_on_cuda(text.cuda, True)), {"q_out": "q", "out": "qd"}
    once, forces = a | {"substeps": 1}, []
    for _ in range(2):
        once["qd"] = warp_machine.run(text, once, further=(wanted := {}), over=over)
        once["q"] = wanted["q_out"]
        forces.append(wanted["contact_f"])
    wanted["contact_f"] = 0.5 * forces[1] + 0.5 * forces[0]
    assert np.abs(forces[1] - forces[0]).max() > 1.0
    for backwards in (False, True):
        np.testing.assert_array_equal(warp_machine.run(text, a, backwards, more := {}, over), once["qd"])
        for name, array in wanted.items():
            np.testing.assert_array_equal(more[name], array, err_msg=name)


def test_neighbours_change_nothing():
    """Bit by bit: alone, a world gives what it gives among others; NaN stays alone."""
    text, a, wanted = known("quadruped", True)
    a = a | {"q": a["q"].copy()}
    a["q"][2, 9] = np.nan
    together = warp_machine.run(text, a, further=(more := {}))
    assert more["status"][2] == spo.Status.NOT_FINITE
    for w in (0, 1, 3):
        one = {name: array if name in ("dt", "passes") else array[w : w + 1] for name, array in a.items()}
        np.testing.assert_array_equal(warp_machine.run(text, one, further=(alone := {}))[0], together[w])
        for name, array in alone.items():
            np.testing.assert_array_equal(array[0], more[name][w])
            np.testing.assert_allclose(array[0], wanted[name][w].ravel(), atol=1e-6)


def test_rows_that_come_in_together_change_no_bit():
    """The plan takes another text for more worlds."""
    found = []
    for staged in (False, True):
        text, a, _ = known("quadruped", staged)
        found.append((warp_machine.run(text, a, further=(more := {})), more))
    (first, more), (second, others) = found
    np.testing.assert_array_equal(first, second)
    for name in more:
        np.testing.assert_array_equal(more[name], others[name])


def test_legs_share_one_text_and_the_points_of_the_trunk():
    text, _, _ = known("quadruped", True)
    assert 2 * len(text.cuda) < len(text.cpu)
    numbers = "contact 4, contact 5, contact 6, contact 7"
    assert numbers in text.cuda


def test_passes_compute_no_velocity_terms():
    """Passes leave out all that comes before them, differences a - b that they take as b - a, too."""
    for name in ("quadruped", "crowded"):
        cuda = known(name, True)[0].cuda
        passes = cuda[cuda.index("turn < (int)passes_row[0]") :]
        assert re.findall(r" w\d+ = (?!qd_row)", cuda) and not re.findall(r" w\d+ = (?!qd_row)", passes)


@pytest.mark.slow
def test_arms_found_anew_in_each_pass(monkeypatch):
    """As of limbs with many spheres: a thread keeps three values less for each of them, and takes the same step."""
    kept = known("quadruped", True)[0]
    monkeypatch.setattr(points, "ARMS", 0)
    case = text_of(monkeypatch, "quadruped", True)
    held = [int(re.search(r"held_row\[(\d+)\] = {}", text.cuda)[1]) for text in (case[0], kept)]
    assert held[1] - held[0] >= 3
    assert_right(case)


@pytest.mark.slow
def test_mirrored_legs_write_states_of_bodies(monkeypatch):
    """By one text, with the signs of quaternions that a whole tree gives."""
    texts, (scene, a) = warp_machine.recorded(monkeypatch), case("crowded")
    tree, limbs = (
        spo.Dynamics(scene, WORLDS, device="cpu", dtype="float64", granularity=g) for g in ("tree", "segment")
    )
    wanted = tree.body_states(a["q"], a["qd"])
    for found, right in zip(limbs.body_states(a["q"], a["qd"]), wanted, strict=True):
        np.testing.assert_allclose(found, right, atol=1e-12)
    poses = warp_machine.run(texts[-1], a, further=(more := {}))
    assert 2 * len(texts[-1].cuda) < len(texts[-1].cpu)
    for found, right in zip((poses, more["velocities_out"]), wanted, strict=True):
        np.testing.assert_allclose(found, right.reshape(WORLDS, -1), atol=1e-12)


def test_mirrored_legs_share_one_text():
    """Numbers in which they differ come from a table, and shins away from the ground cost a look."""
    text, _, _ = known("crowded", True)
    assert 2 * len(text.cuda) < len(text.cpu) and text.tables["table"].any()
    assert text.cuda.count(" != 0) {") == 2  # of one shin, a branch inward and one outward


BUGS = {
    "a point that nobody takes": (points, "points_of", "first * each", "(first + 1) * each"),
    "a point that two take": (points, "points_of", "mine[each * len(segment.children) :]", "mine"),
    "what a message leaves out": (SegmentExchange, "add_contacts", "z - pushes[key]", "z"),
    "excess of one limb": (step.ContactStepTrace, "_send_to_the_first", "largest(list(values))", "values[0]"),
    "no barrier after the passes": (pass_loops, "count_team_passes", '"}", barrier]', '"}"]'),
    "no barrier ahead": (warp_specialized.WarpSpecializedKernel, "_before_passes", "[BARRIER] if stage else []", "[]"),
}


QUICK = ("a point that nobody takes", "what a message leaves out", "no barrier after the passes")


@pytest.mark.parametrize("bug", [pytest.param(bug, marks=[pytest.mark.slow] * (bug not in QUICK)) for bug in BUGS])
def test_a_planted_bug_is_seen(bug, monkeypatch):
    symbolic.plant(monkeypatch, *BUGS[bug])
    with pytest.raises(AssertionError):
        assert_right(text_of(monkeypatch, "quadruped", True))


def test_points_that_see_no_walls():
    """A box on stairs that has corners alone, which see slopes, with a sphere that sees a second place."""
    bare = box(ground=FIELDS["stairs"])
    corners = dataclasses.replace(bare.contacts[0], walls=False)
    scene = bare.with_contacts([corners, spo.Contact(0, sphere=0.25)], bare.ground)
    a = above(bare, 1, 12)
    assert_is_dense(scene, a, 3)
    seen = [ContactStep(scene, a["q"][w], a["qd"][w], H).numbers for w in range(12)]
    assert all(numbers[:4] == [*range(4)] for numbers in seen) and {len(numbers) for numbers in seen} == {6}
