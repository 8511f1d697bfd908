"""Segments of a scene as warps: barriers between them, results through shared memory, limbs that share code."""

import itertools
import re

import numpy as np
import pytest

import warp_spo as spo
from support import laws, warp_machine, zoo
from support.granularity_scenes import mirrored
from support.quick import slow_unless
from support.robots import ROBOTS
from support.routines import ROUTINES
from support.segments_of_trees import TREES, hand
from warp_spo.execution import plan
from warp_spo.execution.segment import shared_code
from warp_spo.execution.segment.schedule import Schedule
from warp_spo.kernels import straight_line
from warp_spo.recursions.model import shared_constants
from warp_spo.recursions.model.links import Links
from warp_spo.recursions.model.segments import Segments

LARGE = ("tree20", "three roots", "humanoid")  # seconds: a quick run takes smaller trees of the same shapes
EVERY = ("fork", "comb")  # trees of which a quick run takes every operation


@pytest.mark.parametrize("name", TREES)
def test_segments_are_chains(name):
    """Every link is in one segment; a segment is a chain that ends where the tree branches; a leaf has its own warp."""
    links = Links(TREES[name]())
    segments = Segments(links)
    assert sorted(id(link) for segment in segments.all for link in segment.links) == sorted(map(id, links.links))
    for segment in segments.all:
        for over, link in zip(segment.links, segment.links[1:], strict=False):
            assert link.parent is over and len(over.children) == 1
        assert len(segment.children) != 1 and len(segment.children) == len(segment.links[-1].children)
        assert all(one.index > segment.index and one.links[0].parent is segment.links[-1] for one in segment.children)
    schedule = Schedule(segments)
    leaves = [schedule.assignments[segment.index].warp for segment in segments.leaves]
    assert sorted(leaves) == [*range(schedule.warps)]


@pytest.mark.parametrize("name", TREES)
def test_segments_wait_for_each_other(name):
    """A warp reads results of other warps only from earlier stages; within a warp, inward comes before outward."""
    schedule = Schedule(Segments(Links(TREES[name]())))
    for segment in schedule.segments.all:
        own = schedule.assignments[segment.index]
        assert 0 <= own.inward <= own.outward < schedule.stages
        for child in (schedule.assignments[one.index] for one in segment.children):
            assert child.inward + (child.warp != own.warp) <= own.inward
            assert own.outward + (child.warp != own.warp) <= child.outward


SEGMENTED = {"forward_dynamics": ("qd", "tau", "body_f"), "inverse_dynamics": ("qd", "qdd", "body_f"),
             "solve_mass_matrix": ("b",), "mass_matrix": (), "mass_matrix_inverse": ()}  # fmt: skip

BRANCHED = [name for name in TREES if name != "chain"]


def built(texts, scene, operation, worlds=3, dtype="float64", given=None, **options):
    """The text of one operation at segment granularity, not compiled, and its result where the machine runs it."""
    dyn = spo.Dynamics(scene, worlds, device="cpu", dtype=dtype, granularity="segment", **options)
    arrays = laws.states(scene, worlds)
    arrays["b"] = arrays["b"][:, :, 0].copy()
    names = SEGMENTED[operation] if given is None else given
    shapes = {name: arrays[name].shape for name in ("q", *names)}
    dofs = scene.dof_count
    out = (worlds, dofs, dofs) if operation.startswith("mass_matrix") else (worlds, dofs)
    program = dyn.programs.find(ROUTINES[operation], shapes, out)
    fields = {name: laws.entries(dyn.programs.field(name))[:, :worlds] for name in program.fields}
    state = {name: array if name in ("q", *names) else np.zeros_like(array) for name, array in arrays.items()}
    return texts[-1], state | fields, np.array([laws.expected(dyn, operation, state, w) for w in range(worlds)])


@pytest.mark.parametrize(
    ("name", "operation"),
    slow_unless(
        [
            (name, operation)
            for name in BRANCHED
            for operation in SEGMENTED
            if name not in LARGE and (name in EVERY or operation in ("forward_dynamics", "mass_matrix_inverse"))
        ],
        itertools.product(BRANCHED, SEGMENTED),
    ),
)
def test_warps_meet_at_barriers_alone(name, operation, monkeypatch):
    """The CUDA text, warp by warp in either order: nothing is read before it is sent, and the result is right."""
    texts = warp_machine.recorded(monkeypatch)
    text, arrays, wanted = built(texts, TREES[name](), operation)
    for backwards in (False, True):
        got = warp_machine.run(text, arrays, backwards)
        assert laws.error(got, wanted.reshape(got.shape)) <= laws.TOLERANCE["float64"]


@pytest.mark.parametrize("operation", SEGMENTED)
@pytest.mark.parametrize("name", slow_unless(["fork", "hand"], ["fork", "hand", "humanoid"]))
def test_results_over_rows_that_warps_share(name, operation, monkeypatch):
    """Many worlds: rows come in through shared memory, and the result takes the place of one of them."""
    monkeypatch.setattr(plan, "FEW_WORLDS", 0)
    texts = warp_machine.recorded(monkeypatch)
    text, arrays, wanted = built(texts, TREES[name](), operation)
    assert text.frame.staged or not text.frame.result.way == straight_line.IN_PLACE
    for backwards in (False, True):
        got = warp_machine.run(text, arrays, backwards)
        assert laws.error(got, wanted.reshape(got.shape)) <= laws.TOLERANCE["float64"]


def test_results_that_leave_through_shared_memory(monkeypatch):
    """Three of a thread, or one that takes little work in many worlds; rows are read by their threads all the same."""
    texts, scene = warp_machine.recorded(monkeypatch), zoo.SCENES["chain7"]()
    q, qd, tau = (laws.states(scene, 3)[name] for name in ("q", "qd", "tau"))

    def frame(call, few=plan.FEW_WORLDS):
        monkeypatch.setattr(plan, "FEW_WORLDS", few)
        call(spo.Dynamics(scene, 3, device="cpu", granularity="tree"))
        return texts[-1].frame

    for wrt, ways in ((("q", "qd", "tau"), (straight_line.STAGED, 2)), (("q", "qd"), (straight_line.DIRECT, 0))):
        found = frame(lambda dyn, wrt=wrt: dyn.forward_dynamics_vjp(q, qd, tau, cotangent=tau, wrt=wrt))
        assert (found.result.way, len(found.staged_further)) == ways and not found.staged
    assert frame(lambda dyn: dyn.inverse_dynamics(q, qd, tau)).result.way == straight_line.DIRECT
    assert frame(lambda dyn: dyn.inverse_dynamics(q, qd, tau), few=0).result.way == straight_line.STAGED


@pytest.mark.parametrize("name", ["fork", "hand"])
def test_turns_are_loops_where_code_is_long(name, monkeypatch):
    """Columns that meet one another's, in a row and in loops."""
    texts, got = warp_machine.recorded(monkeypatch), []
    for most in (shared_code.CACHED, 0):
        monkeypatch.setattr(shared_code, "CACHED", most)
        text, arrays, wanted = built(texts, TREES[name](), "mass_matrix_inverse")
        assert ("++each" in text.cuda) == (most == 0)
        got.append(warp_machine.run(text, arrays))
        assert laws.error(got[-1], wanted.reshape(got[-1].shape)) <= laws.TOLERANCE["float64"]
    assert np.array_equal(*got)


def test_values_of_each_world_reach_the_warps(monkeypatch):
    texts = warp_machine.recorded(monkeypatch)
    scene = zoo.varied(hand(), 3)
    for operation in SEGMENTED:
        text, arrays, wanted = built(texts, scene, operation)
        assert text.frame.fields == ["value"]
        got = warp_machine.run(text, arrays)
        assert laws.error(got, wanted.reshape(got.shape)) <= laws.TOLERANCE["float64"]


def test_a_missing_barrier_is_seen(monkeypatch):
    texts = warp_machine.recorded(monkeypatch)
    text, arrays, _ = built(texts, zoo.fork(), "forward_dynamics")
    barriers = text.cuda.count(warp_machine.BARRIER)
    assert barriers >= 4
    for gone in range(barriers):
        parts = text.cuda.split(warp_machine.BARRIER)
        parts[gone : gone + 2] = [parts[gone] + parts[gone + 1]]
        with pytest.raises(warp_machine.Race):
            warp_machine.run(text._replace(cuda=warp_machine.BARRIER.join(parts)), arrays)


def branches(text):
    """Which warps enter each outer branch of a kernel's CUDA text."""
    found, depth = [], 0
    for line in text.cuda.split("\n"):
        if depth == 0 and (branch := re.match(r"(?:else )?if \((.*)\) \{$", line)):
            found.append(sorted(map(int, re.findall(r"warp == (\d+)", branch[1]))))
        depth += line.count("{") - line.count("}")
    return found


def test_equal_limbs_share_one_text(monkeypatch):
    texts = warp_machine.recorded(monkeypatch)
    for operation in SEGMENTED:
        text, _, _ = built(texts, hand(), operation)
        assert branches(text) == [[0, 1, 2, 3, 4]]
        assert " + who * " in text.cuda or "shifts" in text.tables  # they read and write entries of their own


def test_four_legs_are_one_program(monkeypatch):
    texts = warp_machine.recorded(monkeypatch)
    """Left and right, front and hind: offsets of either sign."""
    text, arrays, wanted = built(texts, hand(4, 3, floating=True), "forward_dynamics")
    assert branches(text) == [[0, 1, 2, 3]]
    assert laws.error(warp_machine.run(text, arrays), wanted) <= laws.TOLERANCE["float64"]


@pytest.mark.parametrize("operation", SEGMENTED)
def test_mirrored_limbs_share_one_text(operation, monkeypatch):
    """Numbers in which they differ come from a table, where each leg alone would drop zeros, ones and signs."""
    texts = warp_machine.recorded(monkeypatch)
    together, *_ = built(texts, mirrored(), operation)
    monkeypatch.setattr(shared_constants, "find_differing", lambda segments, *_: [frozenset()] * len(segments))
    apart, *_ = built(texts, mirrored(), operation)
    assert len(branches(together)) <= 2 < len(branches(apart))
    assert together.cuda.count(" = ") < 0.8 * apart.cuda.count(" = ")


def test_mirrored_limbs_share_one_text_where_wrenches_act_on_what_they_carry(monkeypatch):
    """The places of bodies on links do not fold either, and forces are those of the dense expression."""
    texts = warp_machine.recorded(monkeypatch)
    legs = mirrored()
    feet = [spo.Body(0.2, (0.01, 0.0, 0.0), np.eye(3) * 1e-3) for _ in range(4)]
    places = [(0.03 * side, 0.0, -0.2, 0.0, 0.0, 0.0, 1.0) for side in (1, -1, 0, 1)]
    fixed = [spo.Hinge("fixed", 2 + 2 * k, 9 + k, parent_pose=place) for k, place in enumerate(places)]
    text, arrays, wanted = built(texts, spo.Scene([*legs.bodies, *feet], [*legs.hinges, *fixed]), "forward_dynamics")
    assert branches(text) == [[0, 1, 2, 3]]
    assert laws.error(warp_machine.run(text, arrays), wanted) <= laws.TOLERANCE["float64"]


def test_what_differs_between_limbs_is_in_the_table(monkeypatch):
    """One constant of one finger: one column of the table, a row for each finger, the others' all the same."""
    texts = warp_machine.recorded(monkeypatch)
    scene = hand()
    masses = scene.values["body_mass"][0].copy()
    masses[-1] *= 1.25  # a tip; its inertia about its frame and its first moment change with it
    same, _, _ = built(texts, scene, "inverse_dynamics")
    other, arrays, wanted = built(texts, scene.with_values(body_mass=masses), "inverse_dynamics")
    assert branches(other) == branches(same) == [[0, 1, 2, 3, 4]]
    before, after = (np.reshape(text.tables.get("table", np.zeros((5, 0))), (5, -1)) for text in (same, other))
    columns = [tuple(column) for column in after.T]
    new = [column for column in columns if column not in [tuple(c) for c in before.T]]
    assert new and all(len(set(column[:-1])) == 1 and column[-1] != column[0] for column in new)
    assert any(column[-1] == pytest.approx(1.25 * column[0]) for column in new)
    assert laws.error(warp_machine.run(other, arrays), wanted) <= laws.TOLERANCE["float64"]


def test_another_structure_does_not_share(monkeypatch):
    texts = warp_machine.recorded(monkeypatch)
    """The odd finger has a part of the multiprocessor for itself; of the others, two share one."""
    text, arrays, wanted = built(texts, hand(odd=2), "forward_dynamics")
    assert sorted(branches(text)) == [[0, 1, 2, 4], [3]]
    assert laws.error(warp_machine.run(text, arrays), wanted) <= laws.TOLERANCE["float64"]


def test_numbers_of_equal_limbs_do_not_grow_the_code(monkeypatch):
    texts = warp_machine.recorded(monkeypatch)
    two, five = (built(texts, hand(fingers, spread=0.3), "forward_dynamics")[0] for fingers in (2, 5))
    count = lambda text: text.cuda.count(" = ")  # noqa: E731
    leaf = lambda text: text.cuda.split(warp_machine.BARRIER)[0].count("const double")  # noqa: E731
    assert abs(leaf(five) - leaf(two)) <= 0.02 * leaf(two)  # a few numbers of two fingers are equal, of five none
    assert count(five) < 1.5 * count(two)
    assert five.operations > 1.8 * two.operations


def test_steps_are_named_in_the_code(monkeypatch):
    """A comment for each link, names from the step that made a value."""
    texts = warp_machine.recorded(monkeypatch)
    scene = ROBOTS["arm"]()
    dyn = spo.Dynamics(scene, 1, device="cpu", dtype="float64", granularity="tree")
    rate = (1, scene.dof_count)
    dyn.programs.find(ROUTINES["forward_dynamics"], {"q": (1, scene.coord_count), "qd": rate, "tau": rate}, rate)
    for body in range(1, scene.body_count):  # the pedestal does not move
        assert f"// body {body}\n" in texts[-1].cpu
    names = re.findall(r"double (\w+) =", texts[-1].cpu)
    assert {"x", "w", "P", "z", "a"} <= {name.rstrip("0123456789") for name in names}
