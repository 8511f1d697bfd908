"""The benchmark runner on tiny cases: results against the reference, errors, counts, the roof."""

import dataclasses
import json
import math

import numpy as np
import pytest

import warp_spo as spo
from benchmarks import breakdown, capabilities, env_digests, guard, kernel_texts
from benchmarks.__main__ import main
from benchmarks.table import cases, operation_counts, robots, roofline, runner, shapes
from benchmarks.table.precisions import PRECISIONS
from support import zoo
from support.benchmark_results import NODE, REFINED, ROOF
from warp_spo.reference.dense import Dense
from warp_spo.trials.inputs import INPUTS, OPERATIONS, TOLERANCE, Inputs, rotations


def test_every_operation_of_every_scene_is_within_its_tolerance(device):
    every = cases.cases("", worlds=[3], granularities=NODE)
    rows = list(runner.run(every, device, check=True))
    scenes = set(cases.SCENES) - {name for name in robots.ROBOTS if not robots.is_available(name)}
    assert {case["scene"] for case in every} == scenes and len(rows) == len(scenes) * len(OPERATIONS) * 2
    assert {row["name"]: row["error"] for row in rows if not row["error"] <= TOLERANCE[row["dtype"]]} == {}


def test_run_prints_and_writes_what_it_measured(tmp_path, capsys, device):
    pattern = r"arm7\.(forward_dynamics|phi\.T|operators\.update)"
    call = [pattern, "--worlds", "5", "--dtype", "float64", "--json", str(tmp_path), "--device", str(device)]
    assert main([*call, "--granularity", "node"]) == 0
    (file,) = tmp_path.glob("*.json")
    data = json.loads(file.read_text())
    assert set(data) == {"commit", "date", "machine", "versions", "rows"}
    assert file.name.startswith(data["date"][:10])
    assert {"python", "warp-lang", "numpy", "newton", "warp_spo"} <= set(data["versions"])
    assert {"device", "cpu", "memory_GiB"} <= set(data["machine"])
    assert [row["op"] for row in data["rows"]] == ["phi.T", "operators.update", "forward_dynamics"]
    for row in data["rows"]:
        assert row["worlds"] == 5 and row["dof"] == 7 and row["granularity"]
        assert 0.0 < row["p10_us"] <= row["us"] <= row["p90_us"]
        assert row["evals_per_s"] == pytest.approx(5e6 / row["us"], rel=1e-4)  # five digits are kept
        assert 0.0 < row["error_median"] <= row["error_p99"] <= row["error"]
        assert 0.0 < row["roof"] <= ROOF and row["launches"] > 0
        assert 0.0 < row["error"] <= TOLERANCE["float64"]
    printed = dict(line.split() for line in capsys.readouterr().out.splitlines())
    prefix = "arm7.forward_dynamics.float64.w5.node"
    assert float(printed[f"{prefix}.us"]) == pytest.approx(data["rows"][-1]["us"], rel=1e-3)
    assert {f"{prefix}.{metric}" for metric in ("evals_per_s", "error", "spread", "compile_s")} <= set(printed)


def test_wrong_and_missing_results_are_found(device, monkeypatch):
    case = cases.cases("arm7.forward_dynamics", worlds=[3], dtypes=["float64"], granularities=NODE)
    operation = OPERATIONS["forward_dynamics"]

    def call_of(call):
        return dataclasses.replace(operation, call=call)

    def measured(call):
        changed = dataclasses.replace(PRECISIONS["float64"], operations={operation.name: call_of(call)})
        monkeypatch.setitem(PRECISIONS, "float64", changed)
        (row,) = runner.run(case, device, check=True)
        return row["error"]

    def without_velocity(subject, q, qd, tau, out):
        subject.dyn.forward_dynamics(q, None, tau, out=out)

    assert measured(operation.call) < TOLERANCE["float64"]
    assert measured(without_velocity) > 1e-3
    assert math.isnan(measured(lambda *inputs, out: None))  # the poison is still there


def test_either_sign_of_a_quaternion_is_right():
    scene = cases.arm()
    inputs, operation = Inputs(scene, 1), OPERATIONS["body_poses"]
    poses = inputs.dense(0).body_poses.copy()
    poses[2, 3:] *= -1.0
    assert operation.error(inputs.dense(0), [inputs.array("q")[0]], poses) < 1e-15
    poses[2, 0] += 1.0
    assert operation.error(inputs.dense(0), [inputs.array("q")[0]], poses) > 0.1


def test_mistakes_are_explained(capsys):
    assert main(["no_such_robot"]) == 2
    message = capsys.readouterr().err
    assert "no case matches 'no_such_robot'" in message
    assert "humanoid" in message and "log_det_mass_matrix" in message and "float64" in message
    assert main(["("]) == 2
    assert main(["arm7", "--worlds", "0"]) == 2
    assert main(["--table", "no_such_file.json"]) == 2


def test_scalar_types_are_compared_and_timed_from_torch_too(device):
    pytest.importorskip("torch")
    roof = roofline.Roof(dict(float32=1e15, float64=1e15), 1e15)
    (row,) = runner.run(cases.cases("arm7.solve", [4], ["float32"], NODE), device, roof=roof)
    assert row["eager_us"] > 0.0 and row["torch_us"] > 0.0
    assert row["bytes"] == 4 * 3 * 7 * 4 and row["flops"] == operation_counts.count(cases.arm(), "solve_mass_matrix")
    assert 0.0 < row["backward_error"] < row["error"]
    assert row["reference"] == "dense" and not row["chosen"]


def test_refinement_takes_the_error_of_float32_once_more(device):
    found = cases.cases("arm7.(forward|solve)", worlds=[4], dtypes=REFINED, granularities=NODE)
    rows = {(row["op"], row["dtype"]): row for row in runner.run(found, device, check=True)}
    assert len(rows) == 6
    for op in ("forward_dynamics", "solve_mass_matrix"):
        single, refined = rows[op, "float32"]["error"], rows[op, "refined"]["error"]
        assert 1e-9 < single and 0.0 < refined < 1e-4 * single
        assert rows[op, "refined"]["backward_error"] < 1e-4 * rows[op, "float32"]["backward_error"]


def test_a_granularity_that_is_not_offered_is_skipped_with_its_reason(device, capsys, monkeypatch):
    build = spo.Dynamics

    def without_trees(*arguments, granularity=None, **options):
        if granularity == "tree":
            raise spo.UnsupportedError("Dynamics", "granularity='tree'", "leave it out")
        return build(*arguments, granularity=granularity, **options)

    monkeypatch.setattr(spo, "Dynamics", without_trees)
    found = cases.cases("arm7.(phi$|phi.float|mass_matrix.float)", [2], ["float32"], ["node", "tree", None])
    assert len(found) == 6
    rows = list(runner.run(found, device, check=True))
    assert {row["granularity"] for row in rows if not row["chosen"]} == {"node"}
    keys = [(row["op"], row["granularity"]) for row in rows]
    assert len(set(keys)) == len(keys)  # what the plan chooses is not measured twice
    said = capsys.readouterr().err
    assert said.count("skipped") == 1 and "granularity='tree' is not supported" in said


def test_shapes_have_the_size_that_they_are_named_for(device):
    assert all(shapes.SHAPES[f"chain_{n}"]().tree.depth == n - 1 for n in (2, 64))
    assert shapes.SHAPES["tree_64"]().body_count == 64
    for depth in (4, 64):
        scene = shapes.SHAPES[f"deep_{depth}"]()
        assert scene.body_count == shapes.FIXED and scene.tree.depth == depth - 1
    scene = shapes.SHAPES["branching_4"]()
    assert scene.body_count == shapes.FIXED and max(map(len, scene.tree.children)) == 4
    found = cases.cases("^(chain|tree)_4[.]", worlds=[3], sweeps=True, cuda=False)
    assert {case["sweep"] for case in found} == {"chain", "tree"} and len(found) == 4
    for row in runner.run(found, device, check=True):
        assert row["reference"] == "float64" and 0.0 < row["error"] <= TOLERANCE["float32"]


def test_recursive_reference_is_the_dense_one():
    scene, rng = shapes.random_tree(6), np.random.default_rng(0)
    q, qd, tau = rng.normal(size=(3, 6))
    ours, dense = shapes.Recursive(scene)(scene, q), Dense(scene, q)
    np.testing.assert_allclose(ours.forward_dynamics(qd, tau), dense.forward_dynamics(qd, tau), rtol=1e-11)
    np.testing.assert_allclose(ours.inverse_dynamics(qd, tau), dense.inverse_dynamics(qd, tau), rtol=1e-11)


def test_operations_are_counted_for_every_operation():
    small, large = shapes.chain(8), shapes.chain(16)
    for op in OPERATIONS:
        less, more = operation_counts.count(small, op), operation_counts.count(large, op)
        assert less > 0 and more > less
        if op in ("forward_dynamics", "inverse_dynamics", "solve_mass_matrix", "phi"):  # O(n)
            assert more - less == pytest.approx(less, rel=0.2)
    # pose: 87 and M, R l; V: 48 + 6; alpha: 42 + 36 + 12 + 6; forces: 42 + 42 + 30 + 6, 48 + 13 (per further body)
    counts = [operation_counts.count(shapes.chain(n), "inverse_dynamics") for n in (8, 9)]
    assert counts[1] - counts[0] == 87 + 54 + 96 + 120 + 61
    assert operation_counts.count(small, "no_such_operation") is None


def test_roof_is_measured(device):
    roof = roofline.measure(device)
    assert min(roof.peak.values()) > 1e8 and roof.bandwidth > 1e8
    assert roof.share(1e6, 0.0, "float32", 1e6 / roof.peak["float32"]) == pytest.approx(1.0)
    assert roof.share(1.0, 1e6, "float64", 2e6 / roof.bandwidth) == pytest.approx(0.5)


def test_capabilities_are_compared_with_references(tmp_path, capsys, device, monkeypatch):
    monkeypatch.setattr(capabilities.robots, "ROBOTS", {"arm": None})
    monkeypatch.setattr(capabilities.robots, "scene", lambda name: zoo.from_parents([-1, 0], ["revolute", "ball"], 3))
    file, where = tmp_path / "capabilities.json", ["--worlds", "3", "--device", str(device)]
    assert capabilities.main(["^(derivatives|inverse) ", *where, "--json", str(file)]) == 0
    rows = json.loads(file.read_text())["rows"]
    assert [row["name"] for row in rows] == [
        f"arm {op}"
        for op in ("forward_dynamics", "forward_dynamics_derivatives", "forward_dynamics_vjp", "mass_matrix_inverse")
    ]
    assert all(0.0 < row["error"] <= TOLERANCE["float32"] and row["us"] > 0.0 for row in rows)
    breakdown.inputs_of.cache_clear()
    breakdown.expected.cache_clear()
    assert breakdown.main(["--robots", "arm", *where, "--json", str(file)]) == 0
    (row,) = json.loads(file.read_text())["rows"]
    assert row["error"] <= TOLERANCE["float32"]
    assert all(any(name.startswith(part) for name in row["us"]) for part in ("call", "forward", "mass", "negative"))
    right = OPERATIONS["mass_matrix_inverse"]
    wrong = dataclasses.replace(right, reference=lambda dense, q: 1.1 * right.reference(dense, q))
    monkeypatch.setattr(capabilities, "OPERATIONS", {right.name: wrong})
    assert capabilities.main(["^inverse ", *where]) == 1
    assert "mass_matrix_inverse, 3 worlds: skipped: AssertionError: error 9.1e-02" in capsys.readouterr().out


def test_inputs_are_reproducible_and_exact_in_both_precisions():
    scene = cases.SCENES["quadruped"]()
    a, b, other = Inputs(scene, 6, 1), Inputs(scene, 6, 1), Inputs(scene, 6, 2)
    for name in reversed(INPUTS):  # the order of asking does not matter
        b.array(name)
    for name in INPUTS:
        assert a.array(name).dtype == np.float32
        assert np.array_equal(a.array(name), b.array(name))
        assert a.array(name).size == 0 or not np.array_equal(a.array(name), other.array(name))
    (first,) = rotations(scene)
    np.testing.assert_allclose(np.linalg.norm(a.array("q")[:, first : first + 4], axis=1), 1.0, atol=1e-6)


@pytest.mark.slow
def test_texts_of_kernels_are_recorded_and_compared(tmp_path, capsys):
    folders = [str(tmp_path / name) for name in ("before", "after")]
    for folder in folders:
        assert kernel_texts.main([folder, "--limit", r"^arm\.float32\.w4096\.(forward_dynamics|step midpoint)$"]) == 0
    assert capsys.readouterr().out.startswith("2 cases, ")
    assert kernel_texts.main(["--compare", *folders]) == 0 and capsys.readouterr().out == "all texts are equal\n"
    next((tmp_path / "after").glob("index.json")).write_text("{}")
    assert kernel_texts.main(["--compare", *folders]) == 1


@pytest.mark.slow
def test_bits_of_environments_are_recorded_and_compared(tmp_path, capsys):
    file = tmp_path / "before.json"
    assert env_digests.main(["cartpole", "--json", str(file)]) == 0
    assert env_digests.main(["--compare", str(file)]) == 0
    assert capsys.readouterr().out.endswith("the same bits: cartpole\n")
    bits = json.loads(file.read_text())["cartpole"]
    file.write_text(json.dumps({"cartpole": [*bits[:2], *["0"] * (len(bits) - 2)]}))
    assert env_digests.main(["--compare", str(file)]) == 1
    assert capsys.readouterr().out.endswith("cartpole differs within its first 20 steps\n")


def test_numbers_that_are_spoilt_in_trainings_are_counted_by_name(tmp_path):
    """Each ends its world under its name, and no weight is lost; a count that is wrong is said."""
    file = tmp_path / "guard.json"
    given = ["cartpole", "--trainings", "1", "--clean", "2", "--iterations", "2", "--worlds", "16", "--json", str(file)]
    guard.main(given)
    (row,) = json.loads(file.read_text())["rows"]
    assert row["spoilt numbers"] > 5 and row["counted wrongly"] == {} and row["tensors not finite"] == 0
    near = row | {"farthest curve [spreads]": 1.0}  # of two short trainings the spread says nothing
    assert guard.failures(near) == []
    wrong = guard.failures(near | {"counted wrongly": {"action": 1}, "tensors not finite": 2})
    assert len(wrong) == 2 and "{'action': 1}" in wrong[1]
