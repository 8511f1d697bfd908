"""Two commits that are compared in turns."""

import math
from pathlib import Path

import pytest

from benchmarks.__main__ import main
from benchmarks.table import commits, evidence, robots

IN_GIT = (evidence.ROOT / ".git").exists()
needs_git = pytest.mark.skipif(not IN_GIT, reason="this is no checkout of git")


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
    """On a machine without git, git archive has filled folders."""
    names = [str(tmp_path / name) for name in ("old", "new")]
    for name in names:
        (Path(name) / "warp_spo").mkdir(parents=True)
        (Path(name) / "warp_spo" / "__init__.py").touch()
    times = {Path(name): us for name, us in zip(names, (10.0, 20.0), strict=True)}
    monkeypatch.setattr(commits, "git", None)
    monkeypatch.setattr(commits, "measure", lambda root, chosen, device: [one | dict(us=times[root]) for one in chosen])
    options = ["panda.step", "--device", "cpu", "--worlds", "64"]
    assert main([*options, "--compare", *names, "--rounds", "2"]) == 1
    assert "panda.step.w64: 10 to 20 us, +100.0%" in capsys.readouterr().out


@needs_git
def test_mistakes_are_named(capsys):
    for call, words in [
        (["--compare", "HEAD", "nothing-like-this"], "nothing-like-this"),
        (["--compare", "HEAD", "HEAD", "--rounds", "1"], "--rounds is 1; expected 2 or more"),
        (["walk", "--compare", "HEAD", "HEAD"], "no case matches 'walk'; expected some of panda.forward_dynamics.w64"),
    ]:
        assert main([*call, "--device", "cpu"]) == 2 and words in capsys.readouterr().err


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
