"""Time steps by limbs side by side: the dense nonlinear equation, the step by whole trees, and warps that vote."""

import functools
import itertools

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import actuated, implicit, laws, symbolic, warp_machine, zoo
from support.granularity_scenes import MANY, hand
from support.quick import slow_unless
from support.routines import ROUTINES
from support.step_calls import bundled
from support.step_scenes import FORCES, TOLERANCE, H, furnished, states
from warp_spo.execution import plan
from warp_spo.execution.segment import programs as segment_programs
from warp_spo.execution.segment import warp_specialized
from warp_spo.kernels import pass_loops, straight_line
from warp_spo.kernels.substeps import repeat_on_cuda
from warp_spo.recursions.step.step import MOST_JOINT_SPACE_DOFS, Step, by_segments

WORLDS = 4
SCENES = {
    "hand": hand,
    "fork": zoo.fork,
    "forest": zoo.forest,
    "roots": lambda: zoo.from_parents([-1, 0, -1, 2], ["ball", "universal", "ball", "d6"], 7, d6_axes=[(0, 3)]),
}
"""The last: two chains that have nothing to do with each other, and no barrier but the vote."""


AS_THEY_ARE = {"driven": actuated.driven_hand, "alike": actuated.alike_hand}
AS_THEY_ARE |= {"still": zoo.fork}  # nothing bends: one pass


@functools.cache
def scene_of(name):
    return AS_THEY_ARE[name]() if name in AS_THEY_ARE else furnished(SCENES[name]())


def step(dyn, a, **more):
    return dyn.step(a["q"], a["qd"], a["tau"], H, **{n: a[n] for n in FORCES[1:]}, **bundled(**more))


@pytest.mark.parametrize(
    ("name", "dtype"),
    [
        ("hand", "float64"),
        pytest.param("forest", "float64", marks=pytest.mark.slow),
        ("fork", "float32"),
        ("still", "float32"),
    ],
)
def test_equals_the_dense_nonlinear_equation(name, dtype, device):
    """With a status and accelerations, in arrays that were full of NaN, and over the state itself."""
    scene = scene_of(name)
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype=dtype, granularity="segment")
    a = states(scene, WORLDS, dtype)
    on = laws.to_device(dyn, a)
    status = wp.full(WORLDS, -1, dtype=wp.int32, device=device)
    out = tuple(wp.full(x.shape, float("nan"), dtype=dyn.dtype, device=device) for x in (on["q"], on["qd"]))
    qdd = wp.full(on["qd"].shape, float("nan"), dtype=dyn.dtype, device=device)
    step(dyn, on, status=status, qdd=qdd, out=out)
    assert not status.numpy().any()
    q, qd = (array.numpy().astype(np.float64) for array in out)
    for w in range(WORLDS):
        wanted = implicit.step(scene, w, H, *(a[n][w] for n in ("q", "qd", *FORCES)))
        np.testing.assert_allclose(qd[w], wanted[1], atol=TOLERANCE[dtype])
        np.testing.assert_allclose(q[w], wanted[0], atol=TOLERANCE[dtype])
    np.testing.assert_allclose(a["qd"] + H * qdd.numpy(), qd, atol=TOLERANCE[dtype])
    step(dyn, on, status=status, qdd=qdd, out=(on["q"], on["qd"]))
    for over, array in zip((on["q"], on["qd"]), out, strict=True):
        np.testing.assert_array_equal(over.numpy(), array.numpy())
    assert all("segment" in line for line in dyn.programs.describe())


@pytest.mark.parametrize("integrator", ["semi_implicit", "midpoint"])
def test_equals_the_step_by_trees(integrator, device):
    """Worlds with NaN, with infinity and without a solution say so, and stay alone."""
    scene, found = scene_of("fork"), []
    a = states(scene, MANY)
    bad = {name: array.copy() for name, array in a.items()}
    bad["q"][1, 0], bad["body_f"][2, 0, 0], bad["tau"][3, -1] = np.nan, np.inf, 1e308
    for granularity in ("tree", "segment"):
        dyn = spo.Dynamics(scene, MANY, device=device, dtype="float64", granularity=granularity)
        given = {"status": np.full(MANY, -1, np.int32)} if integrator == "semi_implicit" else {}
        good = step(dyn, a, integrator=integrator)
        found.append((*step(dyn, bad, integrator=integrator, **given), *good))
        for x, y in zip(found[-1][:2], good, strict=True):
            np.testing.assert_array_equal(np.delete(x, (1, 2, 3), 0), np.delete(y, (1, 2, 3), 0))
        if given:
            assert given["status"].tolist() == [0, 2, 2, 1, *[0] * (MANY - 4)]
    for x, y in zip(*found, strict=True):
        np.testing.assert_allclose(y, x, rtol=0.0, atol=TOLERANCE["float64"])
    if integrator == "midpoint":
        assert dyn.programs.describe()[0].startswith("step  segment")


@pytest.mark.slow
@pytest.mark.parametrize("most", [0, 1 << 10])
@pytest.mark.parametrize(("name", "dtype"), [("hand", "float64"), ("fork", "float64"), ("driven", "float32")])
def test_laws_in_turns_or_in_statements(name, dtype, most, device, monkeypatch):
    """Both are the dense step, of all worlds."""
    monkeypatch.setattr(segment_programs, "MOST_LAWS", most)
    scene = scene_of(name)
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype=dtype, granularity="segment")
    a = states(scene, WORLDS, dtype)
    status = np.full(WORLDS, -1, np.int32)
    q, qd = step(dyn, a, status=status)
    assert not status.any()
    for w in range(WORLDS):
        wanted = implicit.step(scene, w, H, *(a[n][w] for n in ("q", "qd", *FORCES)))
        np.testing.assert_allclose(qd[w], wanted[1], atol=TOLERANCE[dtype])
        np.testing.assert_allclose(q[w], wanted[0], atol=TOLERANCE[dtype])


def test_what_stays_a_thread_a_world(device):
    """Few dofs, and loops that are closed."""
    assert zoo.SCENES["chain7"]().dof_count <= MOST_JOINT_SPACE_DOFS < scene_of("fork").dof_count
    short = zoo.from_parents([-1, 0, 0], ["revolute", "revolute", "prismatic"], 5)
    dyn = spo.Dynamics(short, 1, device=device, granularity="segment")
    a = states(short, 2, "float32")
    step(dyn, {name: array[:1] for name, array in a.items()})
    assert "tree" in dyn.programs.describe()[0]
    assert by_segments(scene_of("fork")) and not by_segments(short)


# -- warps -------------------------------------------------------------------------------------------------------------
def texts_of(monkeypatch, name, staged=False, substeps=None, **options):
    """The CUDA text of a step by warps, a state, what the step should give, and how many passes each world needs."""
    for limit in ("FEW_WORLDS", "LONG_ROWS") if staged else ():
        monkeypatch.setattr(plan, limit, 0)
    monkeypatch.setattr(straight_line, "SHARED_BYTES", 1 << 20)
    texts, scene = warp_machine.recorded(monkeypatch), scene_of(name)
    dyn = spo.Dynamics(scene, WORLDS, device="cpu", dtype="float64", granularity="segment")
    a = states(scene, WORLDS)
    if scene.actuators:
        a["ctrl"] = np.random.default_rng(4).normal(size=(WORLDS, len(scene.actuators)))
    if not staged:
        del a["body_f"]  # long rows always come through shared memory
    rate, wide = (WORLDS, scene.dof_count), (WORLDS, scene.coord_count)
    shapes = {key: array.shape for key, array in a.items()} | {"dt": ()}
    shapes |= {} if substeps is None else {"substeps": ()}
    more = {"q_out": wide} | ({"qdd_out": rate} if "qdd" in options else {})
    more |= {"status": (WORLDS,)} if "status" in options else {}
    bodies = (WORLDS, scene.body_count)
    more |= {"poses_out": (*bodies, 7), "velocities_out": (*bodies, 6)} if "bodies" in options else {}
    program = dyn.programs.find(ROUTINES["step"], shapes, rate, more, **options)
    assert program.warps > 1 and texts[-1].frame.staged == staged
    numbers = {"dt": H} | ({} if substeps is None else {"substeps": substeps})
    return texts[-1], a | numbers, symbolic.advance(scene, a, H)


@pytest.mark.parametrize(
    ("name", "staged"),
    slow_unless(
        [("hand", False), ("fork", True), ("roots", False), ("still", True), ("driven", False)],
        itertools.product([*SCENES, "still", "driven"], [False, True]),
    ),
)
def test_warps_meet_at_barriers_alone(name, staged, monkeypatch):
    """Warp by warp in either order, written over the state; worlds need different numbers of passes."""
    text, a, (q, qd, passes) = texts_of(monkeypatch, name, staged, qdd=True, status=True)
    assert name == "still" or passes.max() > passes.min() or passes.max() > 2
    for backwards in (False, True):
        for over in (None, {"q_out": "q", "out": "qd"}):
            more = {}
            got = warp_machine.run(text, a, backwards, more, over)
            np.testing.assert_allclose(got, qd, rtol=0.0, atol=TOLERANCE["float64"])
            np.testing.assert_allclose(more["q_out"], q, rtol=0.0, atol=TOLERANCE["float64"])
            np.testing.assert_allclose(a["qd"] + H * more["qdd_out"], qd, rtol=0.0, atol=TOLERANCE["float64"])
            assert not more["status"].any()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hand", "forest"])
def test_the_step_writes_the_states_of_bodies(name, monkeypatch):
    """They are those of the state after the step, whichever warp goes first, written over the state or not."""
    text, a, (q, qd, _) = texts_of(monkeypatch, name, True, status=True, bodies=True)
    dense = spo.Dynamics(scene_of(name), WORLDS, device="cpu", dtype="float64", granularity="tree")
    expected = dense.body_states(q, qd)
    for backwards in (False, True):
        for over in (None, {"q_out": "q", "out": "qd"}):
            got = warp_machine.run(text, a, backwards, more := {}, over)
            np.testing.assert_allclose(got, qd, rtol=0.0, atol=TOLERANCE["float64"])
            for found, right in zip((more["poses_out"], more["velocities_out"]), expected, strict=True):
                np.testing.assert_allclose(found.reshape(right.shape), right, rtol=0.0, atol=TOLERANCE["float64"])
            assert not more["status"].any()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "most"), slow_unless([("hand", 0), ("roots", 1 << 10)], itertools.product(SCENES, [0, 1 << 10]))
)
def test_warps_take_turns(name, most, monkeypatch):
    """Laws and checks in loops, and in statements."""
    monkeypatch.setattr(segment_programs, "MOST_LAWS", most)
    text, a, (q, qd, _) = texts_of(monkeypatch, name, status=True)
    assert ("force_row" in text.cuda) == (most == 0)
    for backwards in (False, True):
        got = warp_machine.run(text, a, backwards, more := {})
        np.testing.assert_allclose(got, qd, rtol=0.0, atol=TOLERANCE["float64"])
        np.testing.assert_allclose(more["q_out"], q, rtol=0.0, atol=TOLERANCE["float64"])
        assert not more["status"].any()


def test_equal_limbs_share_one_text(monkeypatch):
    """The guesses of each lie at the same places."""
    text, a, (_, qd, _) = texts_of(monkeypatch, "alike")
    assert 2 * len(text.cuda) < len(text.cpu)
    np.testing.assert_allclose(warp_machine.run(text, a, further={}), qd, rtol=0.0, atol=TOLERANCE["float64"])


def test_neighbours_change_nothing(monkeypatch):
    """Bit by bit: alone, a world gives what it gives among 31 that need more passes; NaN stays alone."""
    text, a, (_, qd, passes) = texts_of(monkeypatch, "fork", status=True)
    a["q"][2, 1] = np.nan
    together = warp_machine.run(text, a, further=(more := {}))
    assert more["status"][:, 0].tolist() == [0, 0, 2, 0] and len(set(passes)) > 1
    for w in (0, 1, 3):
        one = {name: array if name == "dt" else array[w : w + 1] for name, array in a.items()}
        np.testing.assert_array_equal(warp_machine.run(text, one, further={})[0], together[w])
        np.testing.assert_allclose(together[w], qd[w], rtol=0.0, atol=TOLERANCE["float64"])


def test_a_world_that_does_not_settle_says_so(monkeypatch):
    monkeypatch.setattr(pass_loops, "MOST_PASSES", 1)
    text, a, (*_, passes) = texts_of(monkeypatch, "fork", status=True)
    more = {}
    warp_machine.run(text, a, further=more)
    assert (more["status"][:, 0] == 5 * (passes > 1)).all() and (passes > 1).any()


@pytest.mark.parametrize("name", ["hand", "forest"])
def test_bodies_of_each_limb(name, monkeypatch):
    """Poses and velocities of bodies by limbs, which send each other nothing, equal those by whole trees."""
    texts, scene = warp_machine.recorded(monkeypatch), scene_of(name)
    a = {key: array for key, array in states(scene, WORLDS).items() if key in ("q", "qd")}
    expected = spo.Dynamics(scene, WORLDS, device="cpu", dtype="float64", granularity="tree").body_states(*a.values())
    dyn = spo.Dynamics(scene, WORLDS, device="cpu", dtype="float64", granularity="segment")
    bodies = (WORLDS, scene.body_count)
    shapes = {key: array.shape for key, array in a.items()}
    dyn.programs.find(ROUTINES["body_states"], shapes, (*bodies, 7), {"velocities_out": (*bodies, 6)})
    for backwards in (False, True):
        poses = warp_machine.run(texts[-1], a, backwards, further=(more := {}))
        for got, right in zip((poses, more["velocities_out"]), expected, strict=True):
            np.testing.assert_allclose(got.reshape(right.shape), right, rtol=0.0, atol=TOLERANCE["float64"])


def test_passes_share_what_does_not_change(monkeypatch):
    """It is stored before the loop and read in it, and all passes give what the dense step gives."""
    text, a, (_, qd, passes) = texts_of(monkeypatch, "hand")
    before, loop = text.cuda.split("for (int turn")
    assert "held_row[0] =" in before and "held_row[0]" in loop and "held_row[0] =" not in loop
    np.testing.assert_allclose(warp_machine.run(text, a, further={}), qd, rtol=0.0, atol=TOLERANCE["float64"])
    assert passes.max() > 1


@pytest.mark.parametrize(
    ("name", "staged"),
    [
        ("hand", True),
        ("driven", False),
        pytest.param("roots", False, marks=pytest.mark.slow),
        pytest.param("still", False, marks=pytest.mark.slow),
    ],
)
def test_substeps_meet_at_barriers_alone(name, staged, monkeypatch):
    """The state stays where warps share it; the last of several substeps gives what as many runs give."""
    text, a, _ = texts_of(monkeypatch, name, staged, qdd=True, status=True, substeps=3)
    assert text.frame.repeats and [row.name for row in text.frame.state] == ["q", "qd"]
    looped = text._replace(cuda=repeat_on_cuda(text.cuda, True))
    once, over = dict(a), {"q_out": "q", "out": "qd"}
    for _ in range(3):
        once["qd"] = warp_machine.run(looped, once | {"substeps": 1}, further=(wanted := {}), over=over)
        once["q"] = wanted["q_out"]
    for backwards in (False, True):
        more = {}
        got = warp_machine.run(looped, a, backwards, more, over)
        np.testing.assert_array_equal(got, once["qd"])
        for key in ("q_out", "qdd_out", "status"):
            np.testing.assert_array_equal(more[key], wanted[key])


@pytest.mark.parametrize("name", ["hand", "roots"])
def test_a_substep_begins_behind_a_barrier(name, monkeypatch):
    """Without it a limb reads the state, or a vote, while another still writes or reads it."""
    text, a, _ = texts_of(monkeypatch, name, substeps=2)
    with pytest.raises(warp_machine.Race):
        looped = text._replace(cuda=repeat_on_cuda(text.cuda, False))
        warp_machine.run(looped, a, further={}, over={"q_out": "q", "out": "qd"})


# -- planted bugs ------------------------------------------------------------------------------------------------------
WAIT = """\'asm volatile("bar.sync 0;" ::: "memory");\', """
BUGS = {
    "a warp that stops early": (
        pass_loops, "repeat_team_passes", '"const int going = __syncthreads_or(missed_row[0] > 0);"',
        WAIT + '"const int going = missed_row[0] > 0;"'),
    "nobody asks for another pass": (
        pass_loops, "repeat_team_passes", "_or(missed_row[0] > 0)", "_or(missed_row[0] < 0)"),
    "flags in one place": (pass_loops, "repeat_team_passes", "(turn & 1)", "(turn & 0)"),
    "no barrier in the vote": (
        pass_loops, "repeat_team_passes", "going = __syncthreads_or(missed_row[0] > 0)", "going = missed_row[0] > -1"),
    "a guess that stays": (Step, "_stores_of_pass", "after = gain\n", "after = 0.0 * gain\n"),
    "a limb that is not asked": (pass_loops, "repeat_team_passes", "for warp in range(warps)", "for warp in range(1)"),
    "a word before it is said": (warp_specialized.WarpSpecializedKernel, "_in_passes",
        "if last and any(text_of_ranks)", "if False"),
    "a word unheard": (Step, "_send_status", "select(less(worst, word), word, worst)", "word"),
}  # fmt: skip
NEEDS = {"flags in one place": "roots", "a limb that is not asked": "hand"}


def seen(monkeypatch, name):
    """Whether the machine, or a result, shows that something is wrong."""
    text, a, (q, qd, _) = texts_of(monkeypatch, name, status=True)
    a["tau"][1, 0], a["tau"][3, -1] = np.inf, np.inf
    more, expected = {}, [0, 2, 0, 2]
    try:
        with np.errstate(invalid="ignore"):
            got = warp_machine.run(text, a, further=more)
    except warp_machine.Race:
        return True
    rest = [0, 2]
    wrong = np.abs(got[rest] - qd[rest]).max() > 1e-9 or np.abs(more["q_out"][rest] - q[rest]).max() > 1e-9
    return wrong or more["status"][:, 0].tolist() != expected


@pytest.mark.parametrize("bug", ["none", *BUGS])
def test_a_planted_bug_is_seen(bug, monkeypatch):
    if bug == "none":
        assert not seen(monkeypatch, "fork") and not seen(monkeypatch, "roots")
        return
    symbolic.plant(monkeypatch, *BUGS[bug])
    assert seen(monkeypatch, NEEDS.get(bug, "fork"))
