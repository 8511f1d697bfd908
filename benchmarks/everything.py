"""``python -m benchmarks --everything``: every number and picture of the README, ours and the peers', in one go.

The work is cut into parts, each a process with a file of rows. Kernels of all parts are compiled side by side, on all
cores; what is compiled is measured, one part at a time on a GPU. Parts come in order of importance: what the time
budget leaves out is named, and the same command goes on from there.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from . import evidence, runner
from .evidence import ROOT

FOLDER = ROOT / "build" / "evidence"
PEERS_FOLDER = "WARP_SPO_PEERS"  # where peers' own programs are, or are built
GRACE = 15.0  # [s] between an interrupt and the end of a process
LAST = 8.0  # [s]: with less left, no part is begun


class Part(NamedTuple):
    """Some cases that are compiled and measured by one process each.

    Attributes:
        name: of its files.
        measure: arguments of ``python -m``, to which ``--json FILE`` is added.
        compile: the same for what compiles its kernels and measures nothing; None: nothing is worth it.
        seconds: most that measuring may take.
        alone: it measures the host's cores: nothing is compiled or measured beside it.
    """

    name: str
    measure: Sequence[str]
    compile: Sequence[str] | None = None
    seconds: float = 60.0
    alone: bool = False


class Measuring(NamedTuple):
    """A part that is being measured, until ``end``."""

    part: Part
    job: subprocess.Popen
    begin: float
    end: float


class Lanes:
    """Processes of parts: many that compile, and one that measures on each GPU.

    Args:
        folder: for rows and logs; a part that has its ``.done`` there is not run again.
        budget: [s] from now.
        jobs: how many compile at a time.
        alone: measure nothing until everything is compiled, as where both need the same cores.
        gpus: to measure on. Of three or more the last one is left to what compiles.
    """

    def __init__(self, folder: Path, budget: float, jobs: int, alone: bool, gpus: int = 1):
        self.folder, self.end, self.jobs, self.alone, self.gpus = folder, time.monotonic() + budget, jobs, alone, gpus
        self.begin = time.monotonic()
        self.compiling: dict[str, subprocess.Popen] = {}
        self.measuring: dict[int, Measuring] = {}
        folder.mkdir(parents=True, exist_ok=True)

    @property
    def left(self) -> float:
        return self.end - time.monotonic()

    def say(self, text: str) -> None:
        print(f"[{time.monotonic() - self.begin:4.0f} s, {max(0.0, self.left):4.0f} s left] {text}", flush=True)

    def start(self, arguments: Sequence[str], log: Path, gpu: int) -> subprocess.Popen:
        """``python -m arguments``, in a process group of its own, which sees one of several GPUs."""
        sees = {"CUDA_VISIBLE_DEVICES": str(gpu)} if self.gpus > 1 else {}
        with log.open("w") as out:
            return subprocess.Popen([sys.executable, "-m", *arguments], cwd=ROOT, stdout=out, stderr=subprocess.STDOUT,
                                    start_new_session=True, env=os.environ | sees)  # fmt: skip

    def run(self, parts: Sequence[Part]) -> list[Part]:
        """Compile and measure; returns the parts that the budget left out or cut short."""
        waiting = [part for part in parts if not self._is_done(part)]
        if len(waiting) < len(parts):
            self.say(f"{len(parts) - len(waiting)} parts are there already, in {self.folder}")
        queue, unfinished = [part for part in waiting if part.compile], []
        lanes = range(self.gpus - 1 if self.gpus > 2 else self.gpus)
        try:
            while self.measuring or (waiting and self.left > LAST):
                while queue and sum(job.poll() is None for job in self.compiling.values()) < self.jobs:
                    part = queue.pop(0)
                    log = self.folder / f"{part.name}.compile.log"
                    self.compiling[part.name] = self.start(part.compile or (), log, self.gpus - 1)
                unfinished += [part for lane in list(self.measuring) if (part := self._ended(lane))]
                for lane in lanes:
                    part = self._ready(waiting, bool(queue)) if self.left > LAST else None
                    if lane not in self.measuring and part:
                        waiting.remove(part)
                        self._measure(part, lane)
                time.sleep(0.1)
        finally:
            for job in [*self.compiling.values(), *(each.job for each in self.measuring.values())]:
                stop(job, 1.0)
        return unfinished + waiting

    def _is_done(self, part: Part) -> bool:
        file = self.folder / f"{part.name}.json"
        return (self.folder / f"{part.name}.done").exists() and (is_run(file) or not file.exists())

    def _ready(self, waiting: list[Part], queued: bool) -> Part | None:
        """The first part whose kernels are compiled; what compiles its own comes when all others' are."""
        busy = {name for name, job in self.compiling.items() if job.poll() is None}
        if any(each.part.alone for each in self.measuring.values()):
            return None
        idle = not (busy or queued)
        if self.alone and not idle:
            return None
        compiled = self.compiling.keys() - busy
        return next((part for part in waiting if (part.name in compiled or (idle and not part.compile))
                     and (not part.alone or (idle and not self.measuring))), None)  # fmt: skip

    def _measure(self, part: Part, lane: int) -> None:
        file, log, begin = self.folder / f"{part.name}.json", self.folder / f"{part.name}.log", time.monotonic()
        job = self.start([*part.measure, "--json", str(file)], log, lane)
        self.measuring[lane] = Measuring(part, job, begin, begin + max(1.0, min(part.seconds, self.left)))

    def _ended(self, lane: int) -> Part | None:
        """Report what the lane has measured, once that is over; returns a part that did not come to its end."""
        part, job, begin, end = self.measuring[lane]
        code = job.poll()
        if code is None and time.monotonic() < end:
            return None
        stop(job, GRACE)
        del self.measuring[lane]
        file, log = self.folder / f"{part.name}.json", self.folder / f"{part.name}.log"
        rows = len(evidence.read(file)["rows"]) if is_run(file) else 0
        how = "stopped, out of time" if code is None else "" if code == 0 else f"returned {code}"
        reasons = [line for line in log.read_text().splitlines() if line.startswith(("skipped", "benchmarks:"))]
        self.say("; ".join([f"{part.name}: {rows} rows in {time.monotonic() - begin:.0f} s", *filter(None, [how])]))
        print("".join(f"    {line[:200]}\n" for line in dict.fromkeys(reasons)), end="", flush=True)
        if code not in (0, 1):  # 1: measured, and something is beyond its tolerance, as the log says
            return part
        (self.folder / f"{part.name}.done").touch()
        return None


def stop(job: subprocess.Popen, grace: float) -> None:
    """Interrupt a process and its children; end them where they do not listen."""
    for number, wait in ((signal.SIGINT, grace), (signal.SIGKILL, None)):
        if job.poll() is not None:
            return
        os.killpg(job.pid, number)
        try:
            job.wait(wait)
        except subprocess.TimeoutExpired:
            continue


def is_run(file: Path) -> bool:
    """Whether the file is there and holds a run; one that was cut off in writing does not."""
    try:
        evidence.read(file)
    except ValueError:
        return False
    return True


def merged(files: Sequence[Path]) -> dict:
    """The runs in files of one commit and machine as one run."""
    runs = sorted(map(evidence.read, files), key=lambda run: run["date"])
    whole: dict[str, Any] = dict(runs[-1], rows=[])
    for key in ("machine", "versions"):
        whole[key] = {name: value for run in runs for name, value in run[key].items()}
    for run in runs:
        whole["rows"] += [row for row in run["rows"] if "verdict" not in row]
    stress = [row for run in runs for row in [*run["rows"], *run.get("stress", [])] if "verdict" in row]
    return whole | (dict(stress=stress) if stress else {})


def short(machine: dict) -> str:
    """Such as h200 or cpu."""
    return machine["device"].split()[-1].lower() if "device_memory_GiB" in machine else "cpu"


def run(
    parts: Sequence[Part], device: Any, budget: float, jobs: int | None, out: Path, gpus: int = 1
) -> tuple[Path, list[Part]]:
    """Run parts, write their rows as one run into the file or folder ``out``; returns the file, and parts left out.

    Raises:
        ValueError: there was no time for a single row; budget, jobs or gpus are not positive.
    """
    for name, value in (("budget", budget), ("jobs", jobs), ("gpus", gpus)):
        if value is not None and not value > 0:
            raise ValueError(f"benchmarks: --{name} is {value:g}; expected more than 0")
    found = runner.machine(device)
    cuda = "device_memory_GiB" in found
    folder = FOLDER / f"{short(found)}-{runner.commit()[:12]}"
    os.environ.setdefault(PEERS_FOLDER, str(FOLDER / "peers"))
    Path(os.environ[PEERS_FOLDER]).mkdir(parents=True, exist_ok=True)
    cores = os.cpu_count() or 1
    lanes = Lanes(folder, budget, jobs or (max(1, cores - 2) if cuda else cores), alone=not cuda, gpus=gpus)
    most = sum(part.seconds for part in parts)
    lanes.say(f"{found['device']}: {len(parts)} parts, at most {most:.0f} s of measuring")
    left_out = lanes.run(parts)
    files = [file for part in parts if is_run(file := folder / f"{part.name}.json")]
    if not files:
        raise ValueError(f"benchmarks: nothing was measured in {budget:g} s; logs are in {folder}")
    whole = merged(files)
    if out.is_dir() or not out.suffix:
        out = out / f"{whole['date'][:10]}-{short(found)}.json"
    lanes.say(f"wrote {runner.save(whole, out)}")
    if left_out:
        names = ", ".join(part.name for part in left_out)
        lanes.say(f"left out: {names}; the same command goes on with them")
    return out, left_out
