"""The benchmark runner on tiny cases, its JSON, and the README's table."""

import base64
import dataclasses
import importlib
import json
import math
import re
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import zoo

import warp_spo as spo
from warp_spo.reference import Dense
from warp_spo.trials.operations import INPUTS, OPERATIONS, TOLERANCE, Inputs, rotations

sys.path.append(str(Path(__file__).parent.parent))  # benchmarks/ is not installed; behind an installed warp_spo
from benchmarks import (
    capabilities,
    cases,
    everything,
    evidence,
    operation_counts,
    parts,
    peers,
    pictures,
    robots,
    roofline,
    runner,
    shapes,
    table,
)
from benchmarks import report as reports
from benchmarks.__main__ import choose, main, parser
from benchmarks.precisions import PRECISIONS

NODE = ("node",)  # compiles nothing for a scene; other granularities have tests of their own
REFINED = ("float32", "refined", "float64")
ROOF = 1.2  # share that no measurement passes: the roof itself is measured to some per cent


def test_every_operation_of_every_scene_is_within_its_tolerance(device):
    every = cases.cases("", worlds=[3], granularities=NODE)
    rows = list(runner.run(every, device, check=True))
    scenes = set(cases.SCENES) - {name for name in robots.ROBOTS if not robots.at_hand(name)}
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


def _row(scene, op, dtype, us, error, worlds=4096, **more):
    row = dict(name=f"{scene}.{op}", scene=scene, op=op, worlds=worlds, dtype=dtype, granularity="node", chosen=True)
    return row | dict(dof=14, depth=3, us=us, evals_per_s=1e6 * worlds / us, error=error) | more


def _data(**more):
    rows = []
    for worlds in (64, 4096):
        for dtype, error in (("float32", 2e-7), ("float64", 3e-15)):
            rows.append(_row("ant", "phi", dtype, 0.25 * worlds, error * worlds, worlds, roof=0.0123))
    versions = {"python": "3.11.7", "warp-lang": "1.19.0"}
    machine = dict(device="GPU X", device_memory_GiB=1.0)
    return dict(commit="0123456789abcdef", date="2026-01-02T03:04:05+00:00", machine=machine, versions=versions,
                rows=rows) | more  # fmt: skip


def _gathered(*runs):
    return evidence.gather(runs)


def test_table_has_a_line_an_operation_and_a_column_a_robot():
    (found,) = _gathered(_data())
    assert found.sources == ["GPU X, commit 0123456789ab, 2026-01-02, python 3.11.7, warp-lang 1.19.0."]
    text = table.markdown(found)
    assert "| µs, 64 worlds, float32 / float64 | ant (14 dof) | largest error | of the roof |" in text
    assert "| `phi` | 16.0 / 16.0 | 1.3e-05 / 1.9e-13 | 1.2 % |" in text and "| `phi` | 1024 / 1024 |" in text
    missing = _data()
    missing["rows"][0]["error"] = float("nan")
    del missing["rows"][0]["us"]
    assert "| `phi` | – / 16.0 | nan / 1.9e-13 |" in table.markdown(*_gathered(missing))


def test_newest_rows_of_every_kind_are_gathered():
    old = _data(date="2025-01-01T00:00:00+00:00", commit="old")
    old["rows"] += [_row("ant", "phi", "float32", 9.0, 1e-6, peer="P 1"), dict(case="S1", parameters={}, verdict="ok")]
    cpu = _data(machine=dict(device="CPU Y"))
    found = _gathered(cpu, old, _data(stress=[dict(case="S2", parameters={}, verdict="FAILS")]))
    assert [one.machine["device"] for one in found] == ["GPU X", "CPU Y"]
    assert len(found[0].rows) == 4 and [row["peer"] for row in found[0].peers] == ["P 1"]
    assert [row["case"] for row in found[0].stress] == ["S2"]
    more = _data(date="2026-01-03T00:00:00+00:00", rows=[_row("arm7", "phi", "float32", 9.0, 1e-6)])
    assert len(_gathered(more, _data())[0].rows) == 5  # one commit's files complete each other
    assert len(found[0].sources) == 2 and "GPU X (P 1), commit old, 2025-01-01" in found[0].sources[1]


def test_readme_is_rewritten_between_the_markers(tmp_path, monkeypatch, capsys):
    readme, results = tmp_path / "README.md", tmp_path / "benchmarks" / "results"
    results.mkdir(parents=True)
    readme.write_text(f"before\n{table.BEGIN}\nold\n{table.END}\nafter\n")
    monkeypatch.setattr(table, "ROOT", tmp_path)
    monkeypatch.setattr(table, "RESULTS", results)
    assert main(["--readme", str(results)]) == 2  # no run yet
    assert "no JSON in" in capsys.readouterr().err
    runner.save(_data() | dict(date="2025-01-01T00:00:00+00:00"), results)
    newest = _data()
    newest["rows"] += [_row("ant", "forward_dynamics", d, 30.0, e) for d, e in (("float32", 1e-7), ("refined", 1e-13))]
    newest["rows"] += [_row(f"chain_{n}", "forward_dynamics", "float32", 3.0 * n, 1e-7, sweep="chain") | dict(dof=n)
                       for n in (2, 4)]  # fmt: skip
    runner.save(newest, results)
    for _ in range(2):  # twice: the markers stay
        assert main(["--readme", str(results)]) == 0
        assert readme.read_text() == f"before\n{table.BEGIN}\n{table.readme(_gathered(newest))}{table.END}\nafter\n"
    assert "chain" not in readme.read_text() and "| `forward_dynamics` | 30.0 / – |" in readme.read_text()
    for name in table.PICTURES:
        assert f"(benchmarks/results/{name})" in readme.read_text()
        assert "run time of all worlds [µs]" in (results / name).read_text()
    readme.write_text("no markers")
    assert main(["--readme", str(results)]) == 2
    assert readme.read_text() == "no markers"


def test_report_is_one_page_with_tables_pictures_and_the_stress_suite(tmp_path, capsys):
    run = _data()
    run["rows"].append(_row("ant", "phi", "float32", 9.0, float("nan"), peer="P 1"))
    law = dict(precision="float32", max_error=1e-3, median_error=1e-4, law=5e-7, ratio=2e3, formula="5e-7 & more")
    run["stress"] = [dict(case="S1.chain", parameters=dict(n=4), verdict="FAILS", **law),
                     dict(case="S14", parameters={}, precision="float64", verdict="ok")]  # fmt: skip
    file = runner.save(run, tmp_path / "run.json")
    assert json.loads(file.read_text())["stress"][0]["law"] == 5e-7
    assert main(["--from", str(file), "--report", str(tmp_path / "page")]) == 0
    (page,) = (tmp_path / "page").iterdir()
    text = page.read_text()
    assert '<td class="bad">nan</td>' in text and '<td class="bad">FAILS</td>' in text
    assert "<td>S1.chain n=4</td>" in text and "5e-7 &amp; more" in text and "1 of 2 within" in text
    images = [base64.b64decode(image).decode() for image in re.findall(r"base64,([^\"]+)", text)]
    assert len(images) == 2  # one for each world count
    assert any("1 without a result" in image and "P 1" in image for image in images)
    assert main(["--from", str(file)]) == 2
    assert "--report DIR" in capsys.readouterr().err


def test_pareto_front_is_what_nothing_beats():
    points = [(1.0, 1e-3), (2.0, 1e-3), (3.0, 1e-9), (2.5, 1e-6), (1.0, 1e-4), (9.0, 1e-8)]
    assert [points[i] for i in pictures.pareto(points)] == [(1.0, 1e-4), (2.5, 1e-6), (3.0, 1e-9)]


def test_numbers_of_a_file_have_five_digits_and_nan_stays(tmp_path):
    run = _data(rows=[_row("ant", "phi", "float32", 12.3456789, float("nan"), parts=[0.123456789])])
    (row,) = evidence.read(runner.save(run, tmp_path))["rows"]
    assert row["us"] == 12.346 and row["parts"] == [0.12346] and math.isnan(row["error"])


def test_an_error_beyond_its_tolerance_fails_and_is_named(device, capsys, monkeypatch):
    operation = OPERATIONS["gravity_force"]
    wrong = dataclasses.replace(operation, reference=lambda dense, q: 1.001 * dense.gravity_force)
    nothing = dataclasses.replace(operation, call=lambda *inputs, out: None)
    call = ["arm7.gravity", "--worlds", "2", "--dtype", "float64", "--granularity", "node", "--device", str(device)]
    for changed, error in ((wrong, "9.99e-04"), (nothing, "nan")):
        plain = dataclasses.replace(PRECISIONS["float64"], operations={"gravity_force": changed})
        monkeypatch.setitem(PRECISIONS, "float64", plain)
        assert main([*call, "--check"]) == 1
        out, err = capsys.readouterr()
        assert f"w2.node.error {float(error):.4g}"[:24] in out
        assert "NaN or beyond its tolerance in arm7.gravity_force.float64.w2.node" in err
    assert runner.tolerance(dict(dtype="float32", sweep="chain")) == 1e-2
    assert runner.tolerance(dict(dtype="float32")) == TOLERANCE["float32"]


def test_two_runs_are_compared(tmp_path, capsys):
    first, second = _data(), _data()
    for row in second["rows"]:
        row["us"] *= 1.04 if row["us"] > 20.0 else 3.0  # below 20 us nothing is said
    files = [str(runner.save(run, tmp_path / f"{name}.json")) for name, run in (("a", first), ("b", second))]
    assert main(["--compare", *files]) == 1  # 16 and 48 us
    assert "ant.phi.float32.w64" in capsys.readouterr().out
    for run, steps in ((first, (30.0, 60.0)), (second, (30.1, 90.0))):  # rows of capabilities have a name alone
        of = [dict(group="steps", name=f"robot {k}", worlds=64, us=us) for k, us in enumerate(steps)]
        runner.save(run | dict(rows=run["rows"] + of), tmp_path / ("a.json" if run is first else "b.json"))
    assert main(["--compare", *files]) == 1
    assert "50.0%          60 us          90 us  steps: robot 1.w64" in capsys.readouterr().out
    runner.save(first, tmp_path / "a.json")
    second["rows"] = [row for row in second["rows"] if row["worlds"] > 64]
    runner.save(second, tmp_path / "b.json")
    assert main(["--compare", *files]) == 0
    assert "2 cases of 20 us or more; 0 differ" in capsys.readouterr().out


RUN = dict(rows=[], machine=dict(device="x"), date="2026", commit="c", versions={})


@pytest.mark.parametrize("run", [
    [], RUN | dict(rows=None), RUN | dict(rows=[dict(us=30.0)]), RUN | dict(rows=[3]), RUN | dict(versions=[]),
    RUN | dict(date=3), RUN | dict(machine={}), RUN | dict(stress=[dict(verdict="ok")]),
    RUN | dict(stress=3),
], ids=str)  # fmt: skip
def test_what_is_no_run_is_refused_by_name(tmp_path, capsys, run):
    """A JSON file that no run wrote is named, whatever was to be made of it."""
    file = tmp_path / "odd.json"
    file.write_text(json.dumps(run))
    for call in (["--compare", str(file), str(file)], ["--table", str(file)],
                 ["--from", str(tmp_path), "--report", str(tmp_path)]):  # fmt: skip
        assert main(call) == 2 and f"{str(file)!r} is not the JSON of a run" in capsys.readouterr().err


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
    right = OPERATIONS["mass_matrix_inverse"]
    wrong = dataclasses.replace(right, reference=lambda dense, q: 1.1 * right.reference(dense, q))
    monkeypatch.setattr(capabilities, "OPERATIONS", {right.name: wrong})
    assert capabilities.main(["^inverse ", *where]) == 1
    assert "mass_matrix_inverse, 3 worlds: skipped: AssertionError: error 9.1e-02" in capsys.readouterr().out


def test_everything_goes_on_where_it_stopped(tmp_path, capsys, device, monkeypatch):
    """``--everything`` in small: ours, a sweep, a peer and the stress suite, part by part, and one page of it."""

    def few(pattern, cuda, where):
        own = ["--device", where]
        dtypes = ["--dtype", *PRECISIONS]
        ours = parts.ours("ours", r"^arm7\.forward", 100.0, *dtypes, *own, "--granularity", "node", worlds=("3",))
        sweep = parts.ours("sweep", r"^chain_2\.forward", 100.0, "--sweeps", *own)
        stress = everything.Part("stress", ["benchmarks.stress", "S1.chain_rand.*n4$", "--granularity", "node", *own])
        return [ours, sweep, stress, everything.Part("late", ["benchmarks", "nothing", *own])]

    monkeypatch.setattr(parts, "choose", few)
    monkeypatch.setattr(everything, "FOLDER", tmp_path / "parts")
    monkeypatch.delenv(everything.PEERS_FOLDER, raising=False)
    call = ["--everything", "--device", str(device), "--json", str(tmp_path / "run.json"), "--budget", "300"]
    assert main(call) == 1
    printed = capsys.readouterr().out
    assert "late: 0 rows" in printed and "left out: late" in printed
    run = evidence.read(tmp_path / "run.json")
    keys = {(row["scene"], row["dtype"], row.get("sweep")) for row in run["rows"]}
    assert keys == {("arm7", dtype, None) for dtype in PRECISIONS} | {("chain_2", "float32", "chain")}
    assert {row["verdict"] for row in run["stress"] if row["case"] == "S1.chain_rand"} == {"ok", ""}
    assert all(row["roof"] <= ROOF for row in run["rows"] if "roof" in row)
    assert run["machine"]["copy_GBps"] > 0.0
    assert main(call) == 1 and "3 parts are there already" in capsys.readouterr().out
    assert evidence.read(tmp_path / "run.json")["rows"] == run["rows"]
    assert main(["--from", str(tmp_path / "run.json"), "--report", str(tmp_path)]) == 0
    assert "S1.chain_rand n=4" in (tmp_path / reports.FILE).read_text()


def test_a_part_whose_file_was_cut_off_is_measured_again(tmp_path, device, monkeypatch):
    """What another part measured is kept, what is no run is left out or made anew."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    text = json.dumps(RUN | dict(rows=[dict(zip(evidence.MEASURED, "abcde", strict=True))]))
    (tmp_path / "one_part.py").write_text(f"import sys\nopen(sys.argv[-1], 'w').write({text!r})\n")
    part = everything.Part("one", ["one_part"])
    monkeypatch.setattr(everything, "FOLDER", tmp_path / "parts")
    monkeypatch.setenv(everything.PEERS_FOLDER, str(tmp_path))
    out = tmp_path / "out.json"
    everything.run([part], device, 60.0, 1, out)
    (file,) = (tmp_path / "parts").glob("*/one.json")
    file.write_text(text[:40])
    assert everything.run([part], device, 60.0, 1, out)[1] == [] and file.read_text() == text
    broken = file.with_name("broken.json")
    broken.write_text(text[:40])
    kept, left_out = everything.run([part, part._replace(name="broken")], device, 1.0, 1, out)
    assert len(left_out) == 1 and len(evidence.read(kept)["rows"]) == 1


@pytest.mark.parametrize("option, value", [("--jobs", "0"), ("--gpus", "-1"), ("--budget", "nan")])
def test_everything_refuses_what_it_would_wait_for_in_vain(tmp_path, capsys, option, value):
    assert main(["--everything", "headline.panda", option, value, "--json", str(tmp_path)]) == 2
    assert f"benchmarks: {option} is {value}; expected more than 0" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--json", "--report"])
def test_a_place_that_cannot_be_written_is_refused_before_measuring(tmp_path, capsys, option):
    (tmp_path / "file").write_text("")
    place = str(tmp_path / "file" / "below")
    assert main(["cartpole.passive", "--check", "--worlds", "1", option, place]) == 2
    assert f"benchmarks: {option} is '{place}" in capsys.readouterr().err


def test_everything_explains_a_filter_that_is_none(capsys):
    assert main(["--everything", "("]) == 2 and "'(' is no regular expression" in capsys.readouterr().err


def test_a_part_that_takes_too_long_is_stopped(tmp_path, capsys, monkeypatch):
    text = "import signal, time; signal.signal(signal.SIGINT, signal.SIG_IGN); time.sleep(60)"
    (tmp_path / "endless_part.py").write_text(text)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(everything, "GRACE", 1.0)
    part = everything.Part("endless", ["endless_part"], seconds=2.0)
    begin = time.monotonic()
    assert everything.Lanes(tmp_path, 60.0, 1, alone=True).run([part]) == [part]
    assert "endless: 0 rows" in capsys.readouterr().out and 2.0 < time.monotonic() - begin < 20.0


def test_parts_share_several_gpus(tmp_path, capsys, monkeypatch):
    """Two of three GPUs measure at the same time, the third compiles; what measures the host runs by itself."""
    (tmp_path / "one_part.py").write_text(
        "import json, os, sys, time\n"
        "begin = time.time()\n"
        "time.sleep(0.5)\n"
        "row = dict(gpu=os.environ['CUDA_VISIBLE_DEVICES'], begin=begin, end=time.time())\n"
        "open(sys.argv[-1], 'w').write(json.dumps(dict(rows=[row])))\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    compiling = ["one_part", str(tmp_path / "compiled.json")]
    found = [everything.Part("host", ["one_part"], alone=True), everything.Part("first", ["one_part"], compiling)]
    found += [everything.Part(name, ["one_part"]) for name in ("second", "third")]
    assert everything.Lanes(tmp_path, 60.0, 2, alone=False, gpus=3).run(found) == []
    rows = {part.name: json.loads((tmp_path / f"{part.name}.json").read_text())["rows"][0] for part in found}
    side_by_side = [rows["first"], rows["second"]]
    assert {row["gpu"] for row in side_by_side} == {"0", "1"}
    assert max(row["begin"] for row in side_by_side) < min(row["end"] for row in side_by_side)
    assert json.loads((tmp_path / "compiled.json").read_text())["rows"][0]["gpu"] == "2"
    host = rows.pop("host")
    assert all(row["end"] < host["begin"] or host["end"] < row["begin"] for row in rows.values())


def test_parts_are_cases_that_there_are():
    """Every command of every part names cases, peers and options that exist."""
    for found in (parts.choose("", True, "cuda:0"), parts.choose("", False, "cpu")):
        assert len({part.name for part in found}) == len(found)
        for part in found:
            module, *arguments = part.measure
            if module == "benchmarks":
                options = parser().parse_args(arguments)
                assert choose(options, True), part.name
            elif module == "benchmarks.peers":
                options = importlib.import_module("benchmarks.peers.__main__").parser().parse_args(arguments)
                names = [f"{options.peers[0]}.{scene}" for scene in options.scenes]
                kind = importlib.import_module(f"benchmarks.peers.{peers.PEERS[options.peers[0]]}").PEER
                works = [f"{name}.{op}.{variant}.{dtype}" for name in names for op, variant in kind.works
                         for dtype in kind.dtypes]  # fmt: skip
                assert any(re.search(options.filter, work) for work in works), part.name
    with pytest.raises(ValueError, match="no part matches"):
        parts.choose("nothing", True, "cuda:0")


def test_inputs_are_reproducible_and_exact_in_both_precisions():
    scene = cases.SCENES["quadruped"]()
    a, b, other = Inputs(scene, 6, 1), Inputs(scene, 6, 1), Inputs(scene, 6, 2)
    for name in reversed(INPUTS):  # the order of asking does not matter
        b.array(name)
    for name in INPUTS:
        assert a.array(name).dtype == np.float32
        assert np.array_equal(a.array(name), b.array(name))
        assert not np.array_equal(a.array(name), other.array(name))
    (first,) = rotations(scene)
    np.testing.assert_allclose(np.linalg.norm(a.array("q")[:, first : first + 4], axis=1), 1.0, atol=1e-6)
