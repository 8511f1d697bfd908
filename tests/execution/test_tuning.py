"""Plans by measurement: which choice is taken, where it is kept, and what makes it measured anew."""

import json
import os
import pickle
import subprocess
import sys
import warnings

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import contact_cases, pair_scenes, zoo
from warp_spo.dynamics import tuning
from warp_spo.dynamics.stepping.integrators import CONTACT_STEP
from warp_spo.examples import fourbar
from warp_spo.execution import plan, tuned
from warp_spo.execution.device_facts import CPU, MEASURED
from warp_spo.scene.fingerprint import fingerprint

WORLDS = 3
NAME = "mass_matrix"


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Choices are kept in an empty folder, and the plan chooses."""
    monkeypatch.setattr(tuned, "FOLDER", str(tmp_path / "kept"))
    monkeypatch.setattr(plan, "DEFAULT", None)
    return tmp_path / "kept"


@pytest.fixture
def device():
    """The CPU, whose candidates are "tree" and "node"."""
    return wp.get_device("cpu")


@pytest.fixture
def times(monkeypatch):
    """Times [s] that measurements find, by granularity; they are counted, and nothing is timed."""
    found = {"node": 1e-6, "tree": 2e-6, "segment": 3e-6, "measured": 0}

    def seconds(call, device):
        call()
        found["measured"] += 1
        dyn = call.args[0]
        return found[dyn.plan.of(dyn._operations[NAME].routine)]

    monkeypatch.setattr(tuning, "_seconds", seconds)
    return found


def made(device, scene=None, **options):
    return spo.Dynamics(zoo.fork() if scene is None else scene, WORLDS, device, **options)


def test_the_fastest_is_used_and_kept(device, times, folder):
    dyn = made(device)
    q = zoo.random_state(dyn.scene, WORLDS).q
    expected = made(device, dtype="float64").mass_matrix(q)
    before = dyn.mass_matrix(q)
    kept = list(dyn.programs._programs.values())
    assert "mass_matrix  tree" in dyn.explain() and NAME in dyn.operation_counts
    choice = dyn.tune(NAME)[NAME]
    assert all(one in dyn.programs._programs.values() for one in kept)  # a graph may hold their tables
    assert "mass_matrix  tree" not in dyn.explain() and NAME not in dyn.operation_counts
    assert choice.granularity == "node" and choice.measured and choice.us["node"] == pytest.approx(1.0)
    assert dyn.plan.of(dyn._operations[NAME].routine) == "node" and dyn.granularity == "tree"
    assert "tuned        mass_matrix: node 1 us, tree 2 us" in dyn.explain() and dyn.explain().count("tuned") == 1
    assert choice.device in dyn.explain() and choice.date in dyn.explain()
    after = dyn.mass_matrix(q)
    assert np.allclose(after, expected, atol=1e-4) and np.allclose(before, expected, atol=1e-4)
    assert np.array_equal(after, made(device, granularity="node").mass_matrix(q))  # to the bit what it would be forced
    assert json.loads(choice.file.read_text())["us"] == choice.us and choice.file.parent == folder
    measured = times["measured"]
    assert dyn.tune(NAME)[NAME] is choice and times["measured"] == measured
    times["tree"] = 1e-9  # whatever a second measurement would find, the file decides
    again = made(device).tune(NAME)[NAME]
    assert again.granularity == "node" and not again.measured and times["measured"] == measured
    assert again.file == choice.file and again.us == choice.us and again.date == choice.date


def test_a_step_with_contacts_is_tuned_for_itself(monkeypatch, folder):
    """Its candidates on a GPU are a thread a world and limbs; a step without contacts keeps its own choice."""
    scene = contact_cases.quadruped()
    dyn, times = made(wp.get_device("cpu"), scene), {"tree": 1.0, "segment": 2.0}
    dyn.plan = plan.choose(scene, WORLDS, MEASURED, "float32")
    monkeypatch.setattr(tuning, "_measure", lambda dyn, operation, routine, names: {one: times[one] for one in names})
    assert dyn.plan.of(CONTACT_STEP) == "segment"
    choice = dyn.tune("step")["step"]
    assert choice.granularity == "tree" and choice.us == {"segment": 2.0, "tree": 1.0}
    assert dyn.plan.of(CONTACT_STEP) == "tree" and dyn.plan.of(dyn._operations["step"].routine) == "segment"


def test_the_first_guess_stays_where_it_is_nearly_as_fast(device, times):
    times["tree"] = 1.02e-6
    assert made(device).tune([NAME])[NAME].granularity == "tree"


def test_copies_keep_the_choice(device, times):
    dyn = made(device)
    dyn.tune(NAME)
    copy = pickle.loads(pickle.dumps(dyn))
    assert copy.plan.tuned == dyn.plan.tuned and copy.plan.of(copy._operations[NAME].routine) == "node"
    assert not made(device).plan.tuned  # others are not affected


def test_real_times_are_positive_and_of_all_candidates(request):
    dyn = made(request.config.getoption("--device"))
    routines = {name: dyn._operations[name].routine for name in ("forward_dynamics", NAME, "bias_force", "body_poses")}
    expected = {name: set(dyn.plan.candidates(routine)) for name, routine in routines.items()}
    found = dyn.tune((*routines, "inverse_dynamics"))
    assert {name: set(found[name].us) or {found[name].granularity} for name in routines} == expected
    assert all(us > 0.0 for one in found.values() for us in one.us.values()) and len(expected[NAME]) == 2
    assert found["bias_force"] is found["inverse_dynamics"]


def test_without_names_the_usual_operations_are_tuned(device, times, monkeypatch):
    monkeypatch.setattr(tuning, "_tune_one", lambda dyn, operation: operation.name)
    assert list(made(device).tune()) == list(tuning.USUAL)


@pytest.mark.parametrize("change", ["driver", "warp", "worlds", "dtype", "value", "variable", "device", "loops"])
def test_another_key_measures_anew(change, device, times, monkeypatch):
    scene, options = zoo.fork(), {}
    made(device).tune(NAME)
    measured = times["measured"]
    if change == "driver":
        key = tuning._key
        monkeypatch.setattr(tuning, "_key", lambda *given: key(*given) | {"driver": [99, 0]})
    if change == "warp":
        monkeypatch.setattr(wp, "__version__", "99.0")
    if change == "device":
        monkeypatch.setattr("warp_spo.dynamics.dynamics.read_facts", lambda device: type(CPU)("other", 0, 7))
    if change == "value":
        scene = scene.with_values(body_mass=2.0 * scene.values["body_mass"])
    options |= {"worlds": dict(worlds=WORLDS + 1), "dtype": dict(dtype="float64")}.get(change, {})
    options |= {"variable": dict(variable=["body_mass"])}.get(change, {})
    if change == "loops":
        scene = spo.Scene(scene.bodies, scene.hinges, scene.values["gravity"][0], loops=[spo.Loop("ball", 0, 4)])
        options["loops"] = "cut"
    spo.Dynamics(scene, **(dict(worlds=WORLDS, device=device) | options)).tune(NAME)
    assert times["measured"] > measured


@pytest.mark.parametrize("content", [b"", b"\xff\xfe", b"[1]", b"{}", "key", "candidate", "time", "folder"])
def test_a_damaged_file_is_a_warning_and_replaced(content, device, times):
    file = made(device).tune(NAME)[NAME].file
    found = json.loads(file.read_text())
    if content == "key":
        found["key"]["worlds"] = 99
    if content == "candidate":
        found["us"]["warp"] = 1.0
    if content == "time":
        found["us"]["tree"] = float("nan")
    if content == "folder":
        file.unlink()
        file.mkdir()
    else:
        file.write_bytes(json.dumps(found).encode() if isinstance(content, str) else content)
    with pytest.warns(UserWarning) as warned:
        choice = made(device).tune(NAME)[NAME]
    assert "cannot be used" in str(warned[0].message) and str(file) in str(warned[0].message)
    assert warned[0].filename == __file__  # the warning names the line of the caller
    assert choice.measured and choice.granularity == "node"
    if content == "folder":
        assert choice.file is None and "WARP_CACHE_PATH" in str(warned[-1].message)
    else:
        assert not made(device).tune(NAME)[NAME].measured


def test_a_folder_that_cannot_be_written_is_a_warning(device, times, folder):
    folder.write_text("a file where the folder should be")
    with pytest.warns(UserWarning, match=r"cannot be kept in .* WARP_CACHE_PATH .*granularity='node'"):
        choice = made(device).tune(NAME)[NAME]
    assert choice.file is None and choice.granularity == "node"


WRITER = """
import warp_spo
from warp_spo.execution import tuned
tuned.FOLDER = {folder!r}
for k in range(200):
    tuned.write({key!r}, tuned.Tuned("tree", dict(tree=1.0 + k, node=2.0), "cpu", "2026-11-22"))
"""


def test_two_processes_may_write_at_once(folder):
    key = {"routine": NAME, "scene": "one"}
    command = [sys.executable, "-W", "error::UserWarning", "-c", WRITER.format(folder=str(folder), key=key)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    writers = [subprocess.Popen(command, env=environment) for _ in range(2)]
    seen = 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        while any(each.poll() is None for each in writers) or not seen:
            seen += tuned.read(key, ("tree", "node")) is not None
    assert [each.returncode for each in writers] == [0, 0] and not list(folder.glob("*.tmp"))


def test_a_choice_that_another_process_wrote_meanwhile_counts(device, times, monkeypatch):
    read, calls = tuned.read, []

    def read_later(key, candidates, warn=True):
        calls.append(warn)
        if len(calls) == 2:
            tuned.write(key, tuned.Tuned("tree", {"tree": 1.0, "node": 2.0}, "cpu", "2026-11-22"))
        return read(key, candidates, warn)

    monkeypatch.setattr(tuned, "read", read_later)
    choice = made(device).tune(NAME)[NAME]
    assert choice.granularity == "tree" and not choice.measured


def test_the_solver_tunes_what_its_integrator_calls(device, monkeypatch):
    """A solver without ``tune`` measures nothing."""
    pytest.importorskip("newton")
    import newton

    from support.solver_models import replicated
    from warp_spo.newton import SolverSPO

    asked = []
    monkeypatch.setattr(SolverSPO, "_prepare", lambda self: None)
    monkeypatch.setattr(spo.Dynamics, "tune", lambda self, operations: asked.append(operations))
    builder = newton.ModelBuilder()
    link = builder.add_link(mass=1.0)
    builder.add_articulation([builder.add_joint_revolute(-1, link, axis=newton.Axis.Z)])
    model = replicated(builder, 2)
    for options in ({}, {"tune": True}, {"tune": True, "integrator": "rk4"}):
        SolverSPO(model, **options)
    assert asked == ["step", "forward_dynamics"]


# -- what may be chosen ------------------------------------------------------------------------------------------------
def test_only_what_the_plan_knows_is_a_candidate():
    routines = {name: spo.Dynamics._operations[name].routine for name in ("forward_dynamics", "step", "jacobian")}

    def candidates(name, scene, worlds, device, **options):
        return plan.choose(scene, worlds, device, "float32", **options).candidates(routines[name])

    fork, deep = zoo.fork(), zoo.chain(plan.MOST_DOFS + 1)
    assert candidates("forward_dynamics", fork, 4, CPU) == ("tree", "node")
    assert candidates("forward_dynamics", fork, 4096, CPU) == ("tree",)
    assert candidates("forward_dynamics", fork, 4, MEASURED) == ("segment", "tree")  # there a launch a level never wins
    assert candidates("forward_dynamics", fork, 1 << 20, MEASURED) == ("tree", "segment")
    assert candidates("step", fork, 4, MEASURED) == ("segment", "tree") and candidates("step", fork, 4, CPU) == (
        "tree",
    )
    assert candidates("forward_dynamics", zoo.chain(7), 4096, MEASURED) == ("tree",)  # one limb
    assert candidates("forward_dynamics", deep, 4, MEASURED) == ("node",)
    assert candidates("forward_dynamics", fork, 4, MEASURED, granularity="tree") == ("tree",)
    assert candidates("jacobian", fork, 4, MEASURED) == ("tree",)


def test_sweeps_and_scans_are_a_choice_for_all_operations(device, monkeypatch):
    """Where the plan is granularity node; copies keep it, and results are those of the recursion if it is forced."""
    monkeypatch.setattr(plan, "MOST_DOFS", 4)
    scene, lengths = zoo.chain(7), []
    us = {0: 5.0, 4: 2.0, 7: 3.0}

    def seconds(call, device):
        scan = call.args[0].recursions.scan
        lengths.append(scan._length if scan else 0)
        return 1e-6 * us[lengths[-1]]

    monkeypatch.setattr(tuning, "_seconds", seconds)
    dyn = made(device, scene)
    assert dyn.granularity == "node" and set(dyn.plan.block_lengths(dyn.scene).values()) == {0, 4, 7}
    state = zoo.random_state(scene, WORLDS)
    first = dyn.recursions.scan
    found = dyn.tune(["forward_dynamics", "mass_matrix"])
    assert found["recursion"].granularity == "scan of 4" and sorted(lengths) == [0, 4, 7]
    assert found["mass_matrix"].granularity == "node" and dyn.recursions.scan is not first
    assert "tuned        recursion: scan of 4 2 us, scan of 7 3 us, sweep 5 us" in dyn.explain()
    forced = made(device, scene, recursion="scan")
    results = [one.forward_dynamics(state.q, state.qd, state.qd) for one in (dyn, forced)]
    assert np.array_equal(*results)
    copy = pickle.loads(pickle.dumps(dyn))
    assert copy.recursions.scan._length == 4 and copy.plan.tuned == dyn.plan.tuned
    assert made(device, scene).tune("mass_matrix")["recursion"].granularity == "scan of 4" and len(lengths) == 3
    us[0] = 1.0
    assert made(device, scene, recursion="sweep").tune("mass_matrix").keys() == {"mass_matrix"}  # it was asked for


def test_where_there_is_nothing_to_choose_nothing_is_measured(device, times, folder):
    choice = made(device, granularity="tree").tune(NAME)[NAME]
    assert choice.granularity == "tree" and not choice.us and str(choice) == "tree, the only one"
    dyn = made(device, pair_scenes.palm())  # a thread for each world solves for these pairs of bodies, on a GPU, too
    dyn.plan = plan.choose(dyn.scene, WORLDS, MEASURED, "float32")
    assert dyn.tune("step")["step"].granularity == "tree"
    assert not times["measured"] and not folder.exists()


def test_mistakes(device):
    dyn = made(device)
    for wrong in ("forward", "operational_inertia", "forward_dynamics_vjp", ["mass_matrix", "set"]):
        with pytest.raises(ValueError, match=r"Dynamics.tune: operations names .* expected some of forward_dynamics"):
            dyn.tune(wrong)
    with pytest.raises(TypeError, match=r"Dynamics.tune: operations is 3"):
        dyn.tune(3)
    with pytest.raises(spo.UnsupportedError, match="refine=1"):
        made(device, refine=1).tune()
    closed = made(device, fourbar.scene(), loops="embed")
    with pytest.raises(spo.UnsupportedError, match=r"Dynamics.mass_matrix_packed"):
        closed.tune("mass_matrix_packed")


# -- fingerprints ------------------------------------------------------------------------------------------------------
FINGERPRINT = """
from support import zoo
from warp_spo.scene.fingerprint import fingerprint
print(fingerprint(zoo.SCENES["chain7"]()), fingerprint(zoo.every_d6()))
"""


def test_fingerprints_are_equal_in_all_processes():
    environment = os.environ | {"PYTHONHASHSEED": "77", "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", FINGERPRINT]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert done.stdout.split()[-2:] == [fingerprint(zoo.SCENES["chain7"]()), fingerprint(zoo.every_d6())]


def test_fingerprints_differ_where_kernels_do():
    scene = zoo.fork()
    mass = scene.values["body_mass"]
    heavier = scene.with_values(body_mass=1.5 * mass)
    varied = scene.with_values(body_mass=mass * np.ones((4, 1)))
    other = [heavier, varied, zoo.fork(seed=3), zoo.dancer(), zoo.star(4)]
    other += [spo.Scene(scene.bodies, scene.hinges, loops=[spo.Loop("ball", 0, 4)])]
    assert len({fingerprint(one) for one in [scene, *other]}) == len(other) + 1
    assert fingerprint(scene) == fingerprint(zoo.fork()) != fingerprint(scene, ["body_mass"])
    assert fingerprint(scene, ["body_mass"]) == fingerprint(heavier, ["body_mass"])
    named = spo.Scene([spo.Body(1.0, label="a")], [spo.Hinge("free", -1, 0)])
    assert fingerprint(named) == fingerprint(spo.Scene([spo.Body(1.0, label="b")], [spo.Hinge("free", -1, 0)]))


def test_heights_of_the_ground_are_no_code():
    def on(ground):
        free = spo.Hinge("free", -1, 0)
        return spo.Scene(
            [spo.Body(1.0, inertia=np.eye(3))], [free], contacts=[spo.Contact(0, point=(0, 0, 0))], ground=ground
        )

    low, high, large = (spo.HeightField(np.full((n, n), height), 0.1) for n, height in ((5, 0.0), (5, 0.3), (6, 0.0)))
    assert fingerprint(on(low)) == fingerprint(on(high))
    assert len({fingerprint(on(ground)) for ground in (low, large, spo.Plane(), spo.Plane(0.1))}) == 4


def test_functions_of_the_user_count_by_what_they_return():
    def slider(length):
        pose = lambda q: ([length * q[0], 0.0, 0.0], np.eye(3).tolist())  # noqa: E731
        return spo.Scene([spo.Body(1.0)], [spo.Hinge.custom(-1, 0, coordinates=1, pose=pose)])

    assert fingerprint(slider(0.3)) == fingerprint(slider(0.3)) != fingerprint(slider(0.4))


def test_fingerprints_see_every_part_of_a_scene():
    """A new attribute of scenes belongs into the fingerprint, or into this list."""
    seen = {"bodies", "hinges", "loops", "couplings", "actuators", "contacts", "ground", "values"}
    derived = {
        "contact_points",
        "contact_pairs",
        "hinge_of",
        "tree",
        "q_start",
        "qd_start",
        "dof_axis",
        "dof_angular",
        "dof_linear",
    }
    of_callers = {
        "q_index",
        "dof_index",
        "sites",
        "keyframes",
        "initial_q",
    }  # kernels of frames are made for the frames of a call
    assert set(vars(zoo.fork())) == seen | derived | of_callers
