"""The table of results in parts: every part names cases, an error fails by name, a run goes on where it stopped."""

import dataclasses

import pytest

from benchmarks import rows
from benchmarks.__main__ import choose, main, parser
from benchmarks.table import parts, runner
from benchmarks.table.precisions import PRECISIONS
from support.benchmark_results import RUN
from warp_spo.trials.inputs import OPERATIONS, TOLERANCE


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
        assert "NaN or exceeds its tolerance in arm7.gravity_force.float64.w2.node" in err
    assert runner.tolerance(dict(dtype="float32", sweep="chain")) == 1e-2
    assert runner.tolerance(dict(dtype="float32")) == TOLERANCE["float32"]


def test_a_place_that_cannot_be_written_is_refused_before_measuring(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    place = str(tmp_path / "file" / "below")
    assert main(["cartpole.passive", "--check", "--worlds", "1", "--json", place]) == 2
    assert f"benchmarks: --json is '{place}" in capsys.readouterr().err


def test_parts_are_cases_that_there_are():
    found = parts.gpu_parts()
    assert len({part.name for part in found}) == len(found)
    for part in found:
        assert choose(parser().parse_args(part.measure), True), part.name


def test_all_rows_of_a_commit_can_be_measured_in_slices(tmp_path, monkeypatch, capsys):
    """Every case of the parts is in one group; a file continues with what it lacks, and only for its own commit."""
    cases = rows.cases()
    groups = rows.grouped(cases)
    assert sum(map(len, groups.values())) == len(cases) > 400 and len(groups["g1.w4096.float32"]) == 33
    assert any(case.get("sweep") for case in cases) and {case["dtype"] for case in cases} == set(PRECISIONS)
    file = tmp_path / "run.json"
    monkeypatch.setattr(rows.roofline, "measure", lambda device: None)
    monkeypatch.setattr(runner, "machine", lambda device: RUN["machine"])
    monkeypatch.setattr(runner, "commit", lambda: RUN["commit"])
    runner.save(RUN | dict(rows=[case | dict(us=1.0) for case in groups["g1.w4096.float32"]]), file)
    assert rows.main([str(file), "g1.w4096.float32", "--device", "cpu"]) == 0
    assert "0 groups; 1 are there" in capsys.readouterr().out
    monkeypatch.setattr(runner, "commit", lambda: "b" * 40)
    with pytest.raises(ValueError, match=r"is of commit .* this is bbbb.*; expected another file"):
        rows.main([str(file), "--device", "cpu"])
