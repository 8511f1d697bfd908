"""Figures over time: entries of commits, their page and charts, and two commits that are compared in turns."""

import math
import re
import subprocess
from pathlib import Path

import pytest

from benchmarks import commits, evidence, history, robots
from benchmarks.__main__ import main
from support.rendering import assert_is_whole
from warp_spo.viewing import charts

MACHINE = dict(device="NVIDIA L4", device_memory_GiB=22.0)
VERSIONS = {"warp-lang": "1.19.0"}
CASES = [
    dict(scene="panda", op="forward_dynamics", worlds=4096, dtype="float32"),
    dict(scene="go2", op="step", worlds=65536, dtype="float32"),
]
IN_GIT = (evidence.ROOT / ".git").exists()
needs_git = pytest.mark.skipif(not IN_GIT, reason="this is no checkout of git")


@pytest.fixture(scope="module")
def pyplot():
    return charts.load_pyplot()


def rows(*times, skipped=None):
    found = [case | dict(us=us) for case, us in zip(CASES, times, strict=True)]
    return [found[0], CASES[1] | dict(skipped=skipped)] if skipped else found


def entry(day, name, *processes):
    return history.entry(processes, (name * 40, f"2026-11-{day}T10:00:00+00:00", f"Commit {name}"), MACHINE, VERSIONS)


@pytest.fixture
def folder(tmp_path):
    history.save(entry(22, "b", rows(2.0, 30.0), rows(2.2, 33.0), rows(2.1, 36.0)), tmp_path)
    history.save(entry(21, "a", rows(4.0, 0.0, skipped="an old mistake")), tmp_path)
    history.save(entry(23, "c", rows(3.0, 20.0)), tmp_path)
    return tmp_path


def test_entries_hold_medians_and_ranges_of_processes_oldest_first(folder):
    (mine,) = history.entries(folder).values()
    assert [data["commit"][0] for data in mine] == ["a", "b", "c"]
    first, second = mine[1]["rows"]
    assert first["name"] == "panda.forward_dynamics.w4096" and second["name"] == "go2.step.w65536"
    assert (first["us"], first["low_us"], first["high_us"]) == (2.1, 2.0, 2.2)
    assert mine[0]["rows"][1] == CASES[1] | dict(name="go2.step.w65536", skipped="an old mistake")
    before = sorted(folder.iterdir())
    history.save(entry(23, "c", rows(5.0, 25.0)), folder)  # measured again: one file a commit and machine
    assert sorted(folder.iterdir()) == before
    assert history.entries(folder)["NVIDIA L4"][-1]["rows"][0]["us"] == 5.0


def test_the_page_shows_a_panel_for_each_robot_and_operation(folder, pyplot):
    page = history.write_page(pyplot, folder)
    text, picture = page.read_text(), (folder / "history-l4.svg").read_text()
    assert_is_whole(picture)
    written = set(re.findall(r"<!-- (.*?) -->", picture))
    panels = {f"{robot}, {operation}" for robot in ("panda", "go2") for operation in ("forward_dynamics", "step")}
    assert panels <= written and {"4,096 worlds", "65,536 worlds", "run time of all worlds", "2 µs"} <= written
    assert "commit, oldest first" in written and any("NVIDIA L4" in one for one in written)
    assert "| panda | forward_dynamics | 4,096 | 3 | 4 | 2.1 | bbbbbbb |" in text  # newest, oldest, best
    assert "| go2 | step | 65,536 | 20 | 33 | 20 | ccccccc |" in text and "![" in text and "history-l4.svg" in text


def test_the_committed_page_is_that_of_the_committed_entries(pyplot, tmp_path):
    for file in history.FOLDER.glob("*.json"):
        (tmp_path / file.name).write_text(file.read_text())
    page = history.write_page(pyplot, tmp_path)
    assert page.read_text() == (history.FOLDER / history.PAGE).read_text(), "draw it: benchmarks --history --commits"


def test_a_folder_without_entries_is_refused(pyplot, tmp_path):
    with pytest.raises(ValueError, match=r"no figures in .*; python -m benchmarks --history measures some"):
        history.write_page(pyplot, tmp_path)


# -- two commits -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("before, after, word", [
    ((10.0, 11.0, 12.0), (7.0, 8.0, 9.0), "faster"), ((7.0, 8.0, 9.0), (10.0, 11.0, 12.0), "slower"),
    ((10.0, 11.0, 12.0), (9.0, 9.5, 10.5), "same"), ((1.0, 2.0), (3.0, math.nan), "skipped"), ((), (), "skipped"),
])  # fmt: skip
def test_a_verdict_needs_times_that_do_not_overlap(before, after, word):
    verdict = commits.judge("case", before, after)
    assert verdict.word == word
    if word == "same":
        assert verdict.noise == pytest.approx(2.0 / 11.0)
        assert str(verdict) == ("case: 11 to 9.5 us, -13.6%; processes differ by 18.2%: no difference beyond the noise")


def test_chance_is_that_of_drawing_one_side():
    """Of the 252 ways to draw five of ten times, two have all of one commit below all of the other."""
    assert commits.by_chance(5) == pytest.approx(2 / 252)


@needs_git
def test_processes_of_two_commits_take_turns(monkeypatch, capsys):
    names, order = {}, []

    def measure(root, chosen, device):
        kind = names.setdefault(root, len(names))
        assert (root / "warp_spo" / "__init__.py").is_file()
        order.append(kind)
        us = 1000.0 if len(order) <= 2 else (12.0 if kind == 0 else 10.0) + 0.1 * len(order)  # the first two compile
        return [case | dict(us=us) for case in chosen]

    monkeypatch.setattr(commits, "measure", measure)
    call = ["--compare", "HEAD", "HEAD", "--rounds", "3", "--device", "cpu", "--worlds", "64"]
    assert main(["panda.step", *call]) == 1
    assert sorted(order[:2]) == sorted(order[2:4]) == sorted(order[4:6]) == [0, 1] and len(order) == 8
    assert order[::2] == [0, 1, 0, 1]  # neither is always first; the first process of all is the second commit's
    text = capsys.readouterr().out
    assert "panda.step.w64: " in text and "1 slower, 0 faster, 0 same" in text and "processes of each commit" in text
    assert not any(str(root) in commits.git("worktree", "list") or root.exists() for root in names)


def test_folders_stand_for_commits(monkeypatch, capsys, tmp_path):
    """On a machine without git: git archive fills folders, and a file in each tells which commit it is."""
    names = [str(tmp_path / name) for name in ("old", "new")]
    for name in names:
        (Path(name) / "warp_spo").mkdir(parents=True)
        (Path(name) / "warp_spo" / "__init__.py").touch()
    times = {Path(name): us for name, us in zip(names, (10.0, 20.0), strict=True)}
    monkeypatch.setattr(commits, "git", None)
    monkeypatch.setattr(
        commits, "measure", lambda root, chosen, device: [case | dict(us=times[root]) for case in chosen]
    )
    options = ["panda.step", "--device", "cpu", "--worlds", "64"]
    assert main([*options, "--compare", *names, "--rounds", "2"]) == 1
    assert "panda.step.w64: 10 to 20 us, +100.0%" in capsys.readouterr().out
    keep = [*options, "--history", str(tmp_path / "kept"), "--commits", names[0]]
    assert main(keep) == 2 and "tells no commit; expected a folder that git archive" in capsys.readouterr().err
    (Path(names[0]) / commits.ARCHIVED).write_text(f"{'d' * 40}\n2026-11-23T10:00:00+00:00\nCommit d\n")
    assert main(keep) == 0 and (tmp_path / "kept" / "history-cpu.svg").is_file()
    (mine,) = history.entries(tmp_path / "kept").values()
    assert (mine[0]["commit"], mine[0]["subject"], mine[0]["rows"][0]["us"]) == ("d" * 40, "Commit d", 10.0)


@needs_git
def test_archives_tell_their_commit(tmp_path):
    done = subprocess.run(
        ["git", "archive", "HEAD", commits.ARCHIVED], cwd=evidence.ROOT, capture_output=True, check=True
    )
    subprocess.run(["tar", "x"], cwd=tmp_path, input=done.stdout, check=True)
    assert tuple((tmp_path / commits.ARCHIVED).read_text().strip().split("\n")) == commits.resolve("HEAD")


@needs_git
def test_mistakes_are_named(capsys, tmp_path):
    for call, words in [
        (["--compare", "HEAD", "nothing-like-this"], "nothing-like-this"),
        (["--compare", "HEAD", "HEAD", "--rounds", "1"], "--rounds is 1; expected 2 or more"),
        (["walk", "--compare", "HEAD", "HEAD"], "no case matches 'walk'; expected some of panda.forward_dynamics.w64"),
        (["--history", str(tmp_path), "--commits", "nothing-like-this"], "nothing-like-this"),
    ]:
        assert main([*call, "--device", "cpu"]) == 2 and words in capsys.readouterr().err


@needs_git
def test_only_committed_code_has_a_history(monkeypatch, tmp_path):
    monkeypatch.setattr(history.runner, "commit", lambda: "a" * 40 + "-dirty")
    with pytest.raises(ValueError, match="commit your changes, or name --commits"):
        history.measure(None, CASES, "cpu", tmp_path)


@pytest.mark.slow
@pytest.mark.skipif(not robots.is_available("panda"), reason="example-robot-data is missing")
def test_a_process_measures_the_package_of_its_folder(tmp_path):
    """And says why a case failed; a folder without the package is an error, not another package's times."""
    chosen = [dict(scene="panda", op=op, worlds=2, dtype="float32") for op in ("mass_matrix", "no_such_call")]
    first, second = commits.measure(evidence.ROOT, chosen, "cpu")
    assert first["us"] > 0.0 and first["p10_us"] <= first["us"] <= first["p90_us"]
    assert "AttributeError" in second["skipped"]
    with pytest.raises(ValueError, match=r"was not measured, but|failed: "):
        commits.measure(tmp_path, chosen[:1], "cpu")


@needs_git
def test_past_results_become_entries(tmp_path):
    """The history holds results of commits that later ones replaced, and its page shows them."""
    done = subprocess.run(["git", "rev-parse", "--is-shallow-repository"], capture_output=True, text=True)
    if done.stdout.strip() == "true":
        pytest.skip("a shallow clone has no past")
    history.harvest(tmp_path)
    for file in tmp_path.glob("*.json"):
        assert evidence.read(file)["rows"]
        assert (history.FOLDER / file.name).is_file(), "python -m benchmarks --history --past writes it"
