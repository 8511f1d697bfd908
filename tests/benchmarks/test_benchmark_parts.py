"""A long benchmark in parts: it goes on where it stopped, fails by name, and shares several GPUs."""

import dataclasses
import importlib
import json
import re
import time

import pytest

from benchmarks import (
    everything,
    evidence,
    parts,
    peers,
    rows,
    runner,
)
from benchmarks import report as reports
from benchmarks.__main__ import choose, main, parser
from benchmarks.precisions import PRECISIONS
from support.benchmark_results import ROOF, RUN
from warp_spo.trials.operations import OPERATIONS, TOLERANCE


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
    """Results of other parts are kept; a file that is no run is left out or measured anew."""
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
    assert everything.Scheduler(tmp_path, 60.0, 1, alone=True).run([part]) == [part]
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
    assert everything.Scheduler(tmp_path, 60.0, 2, alone=False, gpus=3).run(found) == []
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
