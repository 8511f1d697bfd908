"""Commits of this repository, measured by one text: in worktrees, by processes that take turns.

A commit may also be a folder that ``git archive`` has filled, for a machine that has no git.

Two commits that are measured one after the other differ by the temperature of the machine, by what else it does, and by
the process, whose kernels lie elsewhere in memory. So processes of both take turns, each measures all cases, and the
verdict looks at the medians of processes: a commit is faster in a case if the slowest of its processes is faster than
the fastest of the other's.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import itertools
import json
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from . import probe, robots
from .evidence import ROOT

OPERATIONS = ("forward_dynamics", "inverse_dynamics", "mass_matrix", "step")
SCENES = ("panda", "go2", "g1")
CLAIMED = (("panda", "solver_step"), ("g1", "operational_inertia_inverse"))
"""Further rows of the README's headline: SolverSPO.step of a Newton model, and the inertia at two feet."""
WORLDS, CPU_WORLDS = (4096, 65536), (64, 1024)
ROUNDS = 5  # processes of each commit that count
LIMIT = 1800.0  # [s] for one process, which may have to compile all kernels


def cases(pattern: str, worlds: Sequence[int]) -> list[dict]:
    """Return the cases whose names match a regular expression; a case names its robot, but no file yet.

    Raises:
        ValueError: no case matches.
    """
    everything = [
        dict(scene=scene, op=operation, worlds=count, dtype="float32")
        for scene, operation in (*itertools.product(SCENES, OPERATIONS), *CLAIMED)
        for count in worlds
    ]
    found = [case for case in everything if re.search(pattern, name_of(case))]
    if not found:
        names = ", ".join(map(name_of, everything))
        raise ValueError(f"benchmarks: no case matches {pattern!r}; expected some of {names}")
    return found


def name_of(row: dict) -> str:
    """Return the name of a case, such as "go2.step.w4096"."""
    return f"{row['scene']}.{row['op']}.w{row['worlds']}"


@contextlib.contextmanager
def checkout(commit: str) -> Iterator[Path]:
    """Check a commit out into a temporary folder, which is removed at the end; a folder is taken as it is.

    Raises:
        ValueError: git knows no such commit.
    """
    if is_folder(commit):
        yield Path(commit).resolve()
        return
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "tree"
        git("worktree", "add", "--detach", "--force", str(place), commit)
        try:
            yield place
        finally:
            git("worktree", "remove", "--force", str(place))


def is_folder(commit: str) -> bool:
    """Return whether the name of a commit is that of a folder with this package in it."""
    return Path(commit, "warp_spo", "__init__.py").is_file()


def git(*arguments: str) -> str:
    """Return what a git command prints.

    Raises:
        ValueError: it failed, or there is no git.
    """
    try:
        done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
    except OSError as error:
        raise ValueError(f"benchmarks: git is needed to look at commits: {error}") from None
    except subprocess.CalledProcessError as error:
        raise ValueError(f"benchmarks: git {' '.join(arguments[:2])}: {error.stderr.strip()}") from None
    return done.stdout.strip()


def measure(root: Path, chosen: Sequence[dict], device: str | None) -> list[dict]:
    """Return the rows of one process that measures the package in the folder ``root``.

    Raises:
        ValueError: the process failed, or imported the package from elsewhere.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        files = {}
        for scene in {case["scene"] for case in chosen}:
            files[scene] = folder / f"{scene}.urdf"
            files[scene].write_text(robots.urdf_text(scene))
        given = [x | dict(urdf=str(files[x["scene"]]), floating=robots.ROBOTS[x["scene"]].floating) for x in chosen]
        (folder / "cases.json").write_text(json.dumps(given))
        shutil.copy(probe.__file__, folder / "probe.py")  # beside nothing that could hide a module of the same name
        path = os.pathsep.join([str(root), *filter(None, [os.environ.get("PYTHONPATH")])])
        command = [sys.executable, "probe.py", "cases.json", "rows.json", *filter(None, [device])]
        done = subprocess.run(
            command, cwd=folder, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, timeout=LIMIT
        )
        if done.returncode:
            raise ValueError(f"benchmarks: measuring {root} failed: {done.stderr.strip()[-2000:]}")
        found = json.loads((folder / "rows.json").read_text())
    if not Path(found["package"]).resolve().is_relative_to(root.resolve()):
        raise ValueError(f"benchmarks: the package of {root} was not measured, but {found['package']}")
    return found["rows"]


class Verdict(NamedTuple):
    """Times of two commits in one case.

    Attributes:
        name: the case. before, after: medians of processes [us].
        change: time after over time before, medians of processes.
        noise: largest spread of the processes of one commit, over their median.
        word: "faster", "slower", "same" or "skipped".
    """

    name: str
    before: tuple[float, ...]
    after: tuple[float, ...]
    change: float
    noise: float
    word: str

    def __str__(self) -> str:
        if self.word == "skipped":
            return f"{self.name}: skipped"
        a, b = float(np.median(self.before)), float(np.median(self.after))
        verdict = "no difference beyond the noise" if self.word == "same" else self.word
        change = f"{a:.4g} to {b:.4g} us, {self.change - 1:+.1%}"
        return f"{self.name}: {change}; processes differ by {self.noise:.1%}: {verdict}"


def judge(name: str, before: Sequence[float], after: Sequence[float]) -> Verdict:
    """Return the verdict on one case; times that are NaN were not measured."""
    if not before or not after or not all(map(math.isfinite, [*before, *after])):
        return Verdict(name, tuple(before), tuple(after), math.nan, math.nan, "skipped")
    change = float(np.median(after) / np.median(before))
    noise = max((max(times) - min(times)) / float(np.median(times)) for times in (before, after))
    word = "faster" if max(after) < min(before) else "slower" if min(after) > max(before) else "same"
    return Verdict(name, tuple(before), tuple(after), change, noise, word)


def by_chance(rounds: int) -> float:
    """Return how often all times of one of two equal commits lie on one side of the other's."""
    return 2.0 / math.comb(2 * rounds, rounds)


def compile_kernels(names: Sequence[str], chosen: Sequence[dict], device: str | None) -> None:
    """Compile the kernels of commits into Warp's cache, a process for each case, several at a time.

    Raises:
        ValueError: git knows no such commit, or a process failed.
    """
    with contextlib.ExitStack() as stack, concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        roots = [stack.enter_context(checkout(name)) for name in names]
        tasks = [pool.submit(measure, root, [case], device) for case in chosen for root in roots]
        for task in tasks:
            task.result()


def compare(
    first: str, second: str, chosen: Sequence[dict], device: str | None, rounds: int = ROUNDS
) -> tuple[list[Verdict], str]:
    """Measure two commits in turns; return the verdicts, and one line about the noise.

    Raises:
        ValueError: git knows no such commit, or a process failed.
    """
    for commit in (first, second):
        if not is_folder(commit):
            git("cat-file", "-e", f"{commit}^{{commit}}")  # fails, by name, where git knows no such commit
    times: list[dict[str, list[float]]] = [{}, {}]
    with checkout(first) as a, checkout(second) as b:
        for turn in range(rounds + 1):
            order = (0, 1) if turn % 2 else (1, 0)
            for which in order:
                rows = measure((a, b)[which], chosen, device)
                shown = ", ".join(f"{name_of(row)} {row.get('us', math.nan):.4g}" for row in rows)
                print(f"round {turn}, {(first, second)[which]} [us]: {shown}", file=sys.stderr, flush=True)
                if turn:  # the first round compiles
                    for row in rows:
                        times[which].setdefault(name_of(row), []).append(row.get("us", math.nan))
    before, after = times
    verdicts = [judge(name_of(case), before[name_of(case)], after[name_of(case)]) for case in chosen]
    known = [verdict.noise for verdict in verdicts if verdict.word != "skipped"]
    noise = f"{np.median(known):.1%} in the median case, {max(known):.1%} at most" if known else "not known"
    return verdicts, (
        f"{rounds} processes of each commit in turns; processes of one commit differ by {noise}; equal commits are "
        f"called different in {by_chance(rounds):.1%} of cases"
    )
