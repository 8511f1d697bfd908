"""The benchmark runner on tiny cases, its JSON, and the README's table."""

import dataclasses
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest

from warp_spo.operations import INPUTS, OPERATIONS, TOLERANCE, Inputs, rotations

sys.path.append(str(Path(__file__).parent.parent))  # benchmarks/ is not installed; behind an installed warp_spo
from benchmarks import cases, runner, table
from benchmarks.__main__ import main


def test_every_operation_of_every_scene_is_within_its_tolerance(device):
    rows = list(runner.run(cases.cases("", worlds=[3]), device, check=True))
    assert len(rows) == len(cases.SCENES) * len(OPERATIONS) * 2
    assert {row["name"]: row["error"] for row in rows if not row["error"] <= TOLERANCE[row["dtype"]]} == {}


def test_run_prints_and_writes_what_it_measured(tmp_path, capsys, device):
    pattern = r"arm7\.(forward_dynamics|phi\.T|operators\.update)"
    call = [pattern, "--worlds", "5", "--dtype", "float64", "--json", str(tmp_path), "--device", str(device)]
    assert main(call) == 0
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
        assert row["evals_per_s"] == pytest.approx(5e6 / row["us"])
        assert 0.0 < row["error"] <= TOLERANCE["float64"]
    printed = dict(line.split() for line in capsys.readouterr().out.splitlines())
    prefix = "arm7.forward_dynamics.float64.w5"
    assert float(printed[f"{prefix}.us"]) == pytest.approx(data["rows"][-1]["us"], rel=1e-3)
    assert {f"{prefix}.{metric}" for metric in ("evals_per_s", "error", "spread", "compile_s")} <= set(printed)


def test_wrong_and_missing_results_are_found(device, monkeypatch):
    case = cases.cases("arm7.forward_dynamics", worlds=[3], dtypes=["float64"])
    operation = OPERATIONS["forward_dynamics"]

    def measured(call):
        monkeypatch.setattr(runner, "OPERATIONS", {operation.name: dataclasses.replace(operation, call=call)})
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


def _data():
    rows = []
    for worlds in (64, 4096):
        for dtype, error in (("float32", 2e-7), ("float64", 3e-15)):
            us = 0.25 * worlds
            row = dict(name="ant.phi", scene="ant", op="phi", worlds=worlds, dtype=dtype, dof=14, error=error * worlds)
            rows.append(row | dict(us=us, evals_per_s=1e6 * worlds / us))
    versions = {"python": "3.11.7", "warp-lang": "1.19.0"}
    return dict(commit="0123456789abcdef", date="2026-01-02T03:04:05+00:00", machine=dict(device="GPU X"),
                versions=versions, rows=rows)  # fmt: skip


def test_table_has_a_line_an_operation_and_a_column_a_robot():
    text = table.markdown(_data())
    assert text.startswith("GPU X, commit 0123456789ab, 2026-01-02, python 3.11.7, warp-lang 1.19.0.")
    assert "| µs, float32, 64 worlds | ant (14 dof) | error |" in text
    assert "| `phi` | 16.0 | 1.3e-05 |" in text and "| `phi` | 1024 | 8.2e-04 |" in text
    assert text.count("| `phi` |") == 4  # two precisions, two world counts
    missing = _data()
    missing["rows"][0]["error"] = float("nan")
    del missing["rows"][0]["us"]
    assert "| `phi` | – | nan |" in table.markdown(missing)


def test_readme_is_rewritten_between_the_markers(tmp_path, monkeypatch, capsys):
    readme = tmp_path / "README.md"
    readme.write_text(f"before\n{table.BEGIN}\nold\n{table.END}\nafter\n")
    monkeypatch.setattr(table, "ROOT", tmp_path)
    monkeypatch.setattr(table, "RESULTS", tmp_path)
    assert main(["--readme"]) == 2  # no run yet
    assert "no JSON in" in capsys.readouterr().err
    runner.save(_data() | dict(date="2025-01-01T00:00:00+00:00"), tmp_path)
    runner.save(_data(), tmp_path)
    for _ in range(2):  # twice: the markers stay
        assert main(["--readme"]) == 0
        expected = f"before\n{table.BEGIN}\n{table.markdown(_data())}{table.END}\nafter\n"
        assert readme.read_text() == expected
    readme.write_text("no markers")
    assert main(["--readme"]) == 2
    assert readme.read_text() == "no markers"


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
