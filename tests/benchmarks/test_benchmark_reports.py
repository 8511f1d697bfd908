"""Results of benchmarks: the README's table, comparison of two runs."""

import json
import math
import re

import pytest

from benchmarks import limits
from benchmarks.__main__ import main
from benchmarks.table import evidence, pictures, runner, table
from support.benchmark_results import RUN, _data, _gathered, _row


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


def test_tables_and_headline_are_rewritten_between_the_markers(tmp_path, monkeypatch, capsys):
    first, results = tmp_path / "README.md", tmp_path / "benchmarks" / "results"
    results.mkdir(parents=True)
    every = results / "README.md"
    first.write_text("above\n<!-- headline:begin -->\nold\n<!-- headline:end -->\nbelow\n")
    every.write_text("before\n<!-- benchmarks:begin -->\nold\n<!-- benchmarks:end -->\nafter\n")
    monkeypatch.setattr(evidence, "ROOT", tmp_path)
    monkeypatch.setattr(evidence, "RESULTS", results)
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
        text = every.read_text()
        assert text.startswith("before\n<!-- benchmarks:begin -->\n") and text.endswith(
            "<!-- benchmarks:end -->\nafter\n"
        )
        assert table.page(_gathered(newest)) in text and "old" not in text
    assert "chain" not in text and "| `forward_dynamics` | 30.0 / – |" in text
    assert "\nold\n" in first.read_text()  # nothing of the headline was measured
    for name in table.PICTURES:
        assert f"({name})" in text
        assert re.search(r"<!-- run time of all ([\d,]+ robots|worlds) -->", (results / name).read_text())
    newest["rows"].append(_row("go2", "forward_dynamics", "float32", 2.4395, 1e-7))
    for name, us in (("torch: forward_dynamics, out=", 14.06), ("torch: add, out=", 8.4)):
        newest["rows"].append(dict(group="called from Python, go2", name=name, worlds=4096, us=us))
    newest["rows"].append(_row("g1", "forward_dynamics", "float32", 8.0, 1e-7))
    newest["rows"].append(_row("g1", "forward_dynamics", "float32", 2000.0, 1e-7, peer="GRiD 1", variant="aba"))
    runner.save(newest, results)
    assert main(["--readme", str(results)]) == 0
    assert "| **8.00 µs** | GRiD 2000 µs (250×) |" in first.read_text()
    assert (
        "**2.44 µs replayed, 14.1 µs called with torch tensors**, where torch's own\n`add` takes 8.40 µs"
        in first.read_text()
    )
    for file in (first, every):
        kept = file.read_text()
        file.write_text("no markers")
        others = [other.read_text() for other in (first, every)]
        assert main(["--readme", str(results)]) == 2
        assert others == [other.read_text() for other in (first, every)]
        file.write_text(kept)


def test_a_run_of_lines_is_shown_beside_tables_that_are_older_than_it():
    line = dict(robot="ant", operation="phi", dtype="float32", worlds=4096, variable=[], us=512.0, error=1e-7)
    run = dict(commit="fedcba9876543210", date="2026-01-02T03:04:06+00:00", rows=[line])
    assert "| ant, `phi` | float32 | 4,096 | 1024 | 512 | 1.0e-07 |" in table.page(_gathered(_data()), [run])
    earlier = run | dict(date="2026-01-02T03:04:04+00:00")
    assert "Measured after" not in table.page(_gathered(_data()), [earlier])


def test_committed_tables_are_those_of_the_committed_runs():
    found = evidence.gather(evidence.read(file) for file in evidence.files([evidence.RESULTS]))
    for file, text in table.filled(evidence.ROOT, evidence.RESULTS, found).items():
        assert file.read_text() == text, f"{file.name}: python -m benchmarks --readme writes it anew"


def test_committed_page_of_limits_is_that_of_its_newest_run():
    folder = evidence.RESULTS / "speed"
    file = max((file for file in folder.glob("*.json") if "reference_us" in file.read_text()), key=lambda f: f.name)
    page = limits.page(file)
    assert (folder / "README.md").read_text() == page, f"python -m benchmarks.speed --table {file.name} prints it anew"
    run, lines = json.loads(file.read_text()), {str(line.call): line for line in limits.LINES}
    assert page.count("\n| ") == 1 + len(limits.LINES) == 1 + len(lines) and str(run["commit"])[:12] in page
    row = next(row for row in run["rows"] if row["operation"] == "inverse_dynamics")
    assert f"| go2 inverse_dynamics | 65,536 | {row['us']:.4g} |" in page


def test_pareto_front_is_what_nothing_beats():
    points = [(1.0, 1e-3), (2.0, 1e-3), (3.0, 1e-9), (2.5, 1e-6), (1.0, 1e-4), (9.0, 1e-8)]
    assert [points[i] for i in pictures.pareto(points)] == [(1.0, 1e-4), (2.5, 1e-6), (3.0, 1e-9)]


def test_numbers_of_a_file_have_five_digits_and_nan_stays(tmp_path):
    run = _data(rows=[_row("ant", "phi", "float32", 12.3456789, float("nan"), parts=[0.123456789])])
    (row,) = evidence.read(runner.save(run, tmp_path))["rows"]
    assert row["us"] == 12.346 and row["parts"] == [0.12346] and math.isnan(row["error"])


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


@pytest.mark.parametrize("run", [
    [], RUN | dict(rows=None), RUN | dict(rows=[dict(us=30.0)]), RUN | dict(rows=[3]), RUN | dict(versions=[]),
    RUN | dict(date=3), RUN | dict(machine={}), RUN | dict(stress=[dict(verdict="ok")]),
    RUN | dict(stress=3),
], ids=str)  # fmt: skip
def test_what_is_no_run_is_refused_by_name(tmp_path, capsys, run):
    """A JSON file that no run wrote is named, whatever was to be made of it."""
    file = tmp_path / "odd.json"
    file.write_text(json.dumps(run))
    for call in (["--compare", str(file), str(file)], ["--table", str(file)]):
        assert main(call) == 2 and f"{str(file)!r} is not the JSON of a run" in capsys.readouterr().err
