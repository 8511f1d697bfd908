"""``python -m benchmarks --everything``: measure every number of the README, ours and the peers', in one command.

The work consists of parts, each a process that writes a file of rows. The kernels of several parts are compiled at the
same time, on all cores. A part whose kernels are compiled is measured, one part at a time on each GPU. Parts come in
order of importance. Parts that the time budget leaves out are named, and the same command continues with them.
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
PEERS_FOLDER = "WARP_SPO_PEERS"  # environment variable: folder of the peers' own programs, which may be built there
GRACE = 15.0  # [s] that an interrupted process has to end by itself
LEAST = 8.0  # [s] of the budget that must be left to begin a part


class Part(NamedTuple):
    """Cases that one process compiles and another one measures.

    Attributes:
        name: name of its files.
        measure: arguments of ``python -m`` that measure the cases; ``--json FILE`` is added.
        compile: arguments of ``python -m`` that compile their kernels; None: they are compiled while measuring.
        seconds: longest time that measuring may take.
        alone: whether nothing else may run meanwhile, because the part measures the host's cores.
    """

    name: str
    measure: Sequence[str]
    compile: Sequence[str] | None = None
    seconds: float = 60.0
    alone: bool = False


class Job(NamedTuple):
    """A part that is being measured; it is stopped at the time ``end``."""

    part: Part
    job: subprocess.Popen
    begin: float
    end: float


class Scheduler:
    """Runs the processes of parts: several that compile, and one on each GPU that measures.

    Args:
        folder: folder of rows and logs; a part with a ``.done`` file there is not run again.
        budget: time for everything, from now on [s].
        jobs: largest number of processes that compile at the same time.
        alone: measure nothing until everything is compiled, for compiling and measuring need the same cores.
        gpus: number of GPUs to measure on; the last one of three or more is used for compiling.
    """

    def __init__(self, folder: Path, budget: float, jobs: int, alone: bool, gpus: int = 1):
        self.folder, self.end, self.jobs, self.alone, self.gpus = folder, time.monotonic() + budget, jobs, alone, gpus
        self.begin = time.monotonic()
        self.compiling: dict[str, subprocess.Popen] = {}
        self.measuring: dict[int, Job] = {}
        folder.mkdir(parents=True, exist_ok=True)

    @property
    def left(self) -> float:
        """Time that is left of the budget [s]."""
        return self.end - time.monotonic()

    def say(self, text: str) -> None:
        """Print a line, with the time that has passed and that is left."""
        print(f"[{time.monotonic() - self.begin:4.0f} s, {max(0.0, self.left):4.0f} s left] {text}", flush=True)

    def start(self, arguments: Sequence[str], log: Path, gpu: int) -> subprocess.Popen:
        """Start ``python -m arguments`` in a process group of its own, which sees only one of several GPUs."""
        sees = {"CUDA_VISIBLE_DEVICES": str(gpu)} if self.gpus > 1 else {}
        with log.open("w") as out:
            return subprocess.Popen([sys.executable, "-m", *arguments], cwd=ROOT, stdout=out, stderr=subprocess.STDOUT,
                                    start_new_session=True, env=os.environ | sees)  # fmt: skip

    def run(self, parts: Sequence[Part]) -> list[Part]:
        """Compile and measure the parts; return those that were left out or stopped for lack of time."""
        waiting = [part for part in parts if not self._is_done(part)]
        if len(waiting) < len(parts):
            self.say(f"{len(parts) - len(waiting)} parts are there already, in {self.folder}")
        queue, unfinished = [part for part in waiting if part.compile], []
        gpus = range(self.gpus - 1 if self.gpus > 2 else self.gpus)
        try:
            while self.measuring or (waiting and self.left > LEAST):
                while queue and sum(job.poll() is None for job in self.compiling.values()) < self.jobs:
                    part = queue.pop(0)
                    log = self.folder / f"{part.name}.compile.log"
                    self.compiling[part.name] = self.start(part.compile or (), log, self.gpus - 1)
                unfinished += [part for gpu in list(self.measuring) if (part := self._finish(gpu))]
                for gpu in gpus:
                    part = self._next_part(waiting, bool(queue)) if self.left > LEAST else None
                    if gpu not in self.measuring and part:
                        waiting.remove(part)
                        self._measure(part, gpu)
                time.sleep(0.1)
        finally:
            for job in [*self.compiling.values(), *(each.job for each in self.measuring.values())]:
                stop(job, 1.0)
        return unfinished + waiting

    def _is_done(self, part: Part) -> bool:
        file = self.folder / f"{part.name}.json"
        return (self.folder / f"{part.name}.done").exists() and (is_run(file) or not file.exists())

    def _next_part(self, waiting: list[Part], queued: bool) -> Part | None:
        """Return the first part that can be measured now, or None.

        A part that compiles its own kernels must wait until the kernels of all other parts are compiled.
        """
        busy = {name for name, job in self.compiling.items() if job.poll() is None}
        if any(each.part.alone for each in self.measuring.values()):
            return None
        idle = not (busy or queued)
        if self.alone and not idle:
            return None
        compiled = self.compiling.keys() - busy
        return next((part for part in waiting if (part.name in compiled or (idle and not part.compile))
                     and (not part.alone or (idle and not self.measuring))), None)  # fmt: skip

    def _measure(self, part: Part, gpu: int) -> None:
        file, log, begin = self.folder / f"{part.name}.json", self.folder / f"{part.name}.log", time.monotonic()
        job = self.start([*part.measure, "--json", str(file)], log, gpu)
        self.measuring[gpu] = Job(part, job, begin, begin + max(1.0, min(part.seconds, self.left)))

    def _finish(self, gpu: int) -> Part | None:
        """Say what the GPU's job has measured, if the job is over; return the job's part if it was not completed."""
        part, job, begin, end = self.measuring[gpu]
        code = job.poll()
        if code is None and time.monotonic() < end:
            return None
        stop(job, GRACE)
        del self.measuring[gpu]
        file, log = self.folder / f"{part.name}.json", self.folder / f"{part.name}.log"
        rows = len(evidence.read(file)["rows"]) if is_run(file) else 0
        how = "stopped, out of time" if code is None else "" if code == 0 else f"returned {code}"
        reasons = [line for line in log.read_text().splitlines() if line.startswith(("skipped", "benchmarks:"))]
        self.say("; ".join([f"{part.name}: {rows} rows in {time.monotonic() - begin:.0f} s", *filter(None, [how])]))
        print("".join(f"    {line[:200]}\n" for line in dict.fromkeys(reasons)), end="", flush=True)
        if code not in (0, 1):  # 1: it was measured, and the log says which error exceeds its tolerance
            return part
        (self.folder / f"{part.name}.done").touch()
        return None


def stop(job: subprocess.Popen, grace: float) -> None:
    """Interrupt a process and its children, and kill them if they have not ended after ``grace`` seconds."""
    for number, wait in ((signal.SIGINT, grace), (signal.SIGKILL, None)):
        if job.poll() is not None:
            return
        os.killpg(job.pid, number)
        try:
            job.wait(wait)
        except subprocess.TimeoutExpired:
            continue


def is_run(file: Path) -> bool:
    """Return whether the file exists and holds a whole run."""
    try:
        evidence.read(file)
    except ValueError:
        return False
    return True


def merge(files: Sequence[Path]) -> dict:
    """Return the runs in ``files``, which have one commit and machine, as one run."""
    runs = sorted(map(evidence.read, files), key=lambda run: run["date"])
    whole: dict[str, Any] = dict(runs[-1], rows=[])
    for key in ("machine", "versions"):
        whole[key] = {name: value for run in runs for name, value in run[key].items()}
    for run in runs:
        whole["rows"] += [row for row in run["rows"] if "verdict" not in row]
    stress = [row for run in runs for row in [*run["rows"], *run.get("stress", [])] if "verdict" in row]
    return whole | (dict(stress=stress) if stress else {})


def short_name(machine: dict) -> str:
    """Return a machine's name for files, such as "h200" or "cpu"."""
    return machine["device"].split()[-1].lower() if "device_memory_GiB" in machine else "cpu"


def run(
    parts: Sequence[Part], device: Any, budget: float, jobs: int | None, out: Path, gpus: int = 1
) -> tuple[Path, list[Part]]:
    """Run the parts, write their rows as one run into the file or folder ``out``, and return the file.

    Returns:
        The file, and the parts that were left out.

    Raises:
        ValueError: not a single row was measured, or ``budget``, ``jobs`` or ``gpus`` is not positive.
    """
    for name, value in (("budget", budget), ("jobs", jobs), ("gpus", gpus)):
        if value is not None and not value > 0:
            raise ValueError(f"benchmarks: --{name} is {value:g}; expected more than 0")
    found = runner.machine(device)
    cuda = "device_memory_GiB" in found
    folder = FOLDER / f"{short_name(found)}-{runner.commit()[:12]}"
    os.environ.setdefault(PEERS_FOLDER, str(FOLDER / "peers"))
    Path(os.environ[PEERS_FOLDER]).mkdir(parents=True, exist_ok=True)
    cores = os.cpu_count() or 1
    scheduler = Scheduler(folder, budget, jobs or (max(1, cores - 2) if cuda else cores), alone=not cuda, gpus=gpus)
    most = sum(part.seconds for part in parts)
    scheduler.say(f"{found['device']}: {len(parts)} parts, at most {most:.0f} s of measuring")
    left_out = scheduler.run(parts)
    files = [file for part in parts if is_run(file := folder / f"{part.name}.json")]
    if not files:
        raise ValueError(f"benchmarks: no case was measured in {budget:g} s; the logs are in {folder}")
    whole = merge(files)
    if out.is_dir() or not out.suffix:
        out = out / f"{whole['date'][:10]}-{short_name(found)}.json"
    scheduler.say(f"wrote {runner.save(whole, out)}")
    if left_out:
        names = ", ".join(part.name for part in left_out)
        scheduler.say(f"left out: {names}; the same command continues with them")
    return out, left_out
