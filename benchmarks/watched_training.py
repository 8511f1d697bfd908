"""By how much an iteration is longer with a page, while somebody looks at it, with ``keep_failures``, with TensorBoard.

    python -m benchmarks.watched_training --device cuda:0 --json watched.json       # ends after 2.5 minutes
    python -m benchmarks.watched_training --device cuda:0 --states TensorBoard

States take turns: a training as it is, one with ``--view`` at which nobody looks, one that a reader in another
process looks at (see ``page_client``), one whose environment keeps failures, and one that TensorBoard logs. A turn is
some iterations; its ratio is that of its time to that of the first state in the same round, and the median over the
rounds is compared with the limits: 0.5 %, 3 %, 2 % and 1 %.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

from warp_spo.env import learning, loggers
from warp_spo.env.state_copies import StateCopies
from warp_spo.env.task_files import robot_file
from warp_spo.env.tasks import task
from warp_spo.env.training_log import LiveRows
from warp_spo.viewing.appearance import file_appearance
from warp_spo.viewing.training_view import TrainingView

from .page_client import looking

PLAIN, PAGE, WATCHED, KEPT = "plain", "page, nobody looks", "page, somebody looks", "keep_failures"
LOGGED = "TensorBoard"
LIMITS = {PAGE: 0.005, WATCHED: 0.03, KEPT: 0.02, LOGGED: 0.01}  # by how much an iteration may be longer


class Training:
    """A training that goes on turn by turn.

    Args:
        chosen: the task. options: of the command. folder: of its rows. kept: further arguments of its environment.
    """

    def __init__(self, chosen: Any, options: argparse.Namespace, folder: Path, **kept: Any):
        self.env = chosen.build(options.worlds, options.device, seed=0, **kept)
        self.runner, _ = learning.prepare(
            self.env, chosen.LEARNER, folder, 10**6, save_interval=10**6, every=10**6, loggers=()
        )
        self.runner.save_all = lambda *_: None  # each turn would end with a checkpoint
        self.file, self.rows = robot_file(chosen), folder / "progress.jsonl"

    def learn(self, iterations: int) -> float:
        """Learn for so many iterations; return the time of one [s]."""
        self.wait()
        began = time.perf_counter()
        with contextlib.redirect_stdout(io.StringIO()):
            self.runner.learn(iterations)
        self.wait()
        return (time.perf_counter() - began) / iterations

    def wait(self) -> None:
        """Wait for the device."""
        self.env.q.sum().item()

    @contextlib.contextmanager
    def page(self, copies: StateCopies) -> Any:
        """Show the training as ``train --view`` does, inside; a context manager."""
        look = None if self.file is None else file_appearance(self.file, self.env.scene)
        view = TrainingView(self.env.scene, copies, LiveRows(self.rows), self.env.default_q, appearance=look)
        self.runner.watchers.append(copies.copy)
        view.start()
        try:
            yield view.page
        finally:
            self.runner.watchers.remove(copies.copy)
            view.close()

    @contextlib.contextmanager
    def logger(self) -> Any:
        """Log to TensorBoard, too, inside; a context manager."""
        log: Any = self.runner.logger
        log._open = {LOGGED: loggers.start("tensorboard", self.rows.parent, 0, {})}
        try:
            yield
        finally:
            log.close()


def _watch(training: Training, copies: StateCopies, times: dict[str, list[float]], iterations: int) -> None:
    """Time a training with a page, at which nobody looks and then somebody does, as far as ``times`` has these."""
    with training.page(copies) as page:
        before = copies.count
        if PAGE in times:
            times[PAGE].append(training.learn(iterations))
            assert copies.count == before, "states were copied while nobody looked"
        if WATCHED in times:
            with looking(page):
                times[WATCHED].append(training.learn(iterations))


def main(arguments: list[str] | None = None) -> int:
    """Measure, print a table, and return 1 where a limit is passed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="go2-flat")
    parser.add_argument("--worlds", type=int, default=4096)
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--iterations", type=int, default=20, help="of a turn")
    parser.add_argument("--rounds", type=int, default=15, help="at most")
    parser.add_argument("--seconds", type=float, default=150.0, help="after which no round begins")
    parser.add_argument("--states", nargs="+", choices=LIMITS, default=list(LIMITS), metavar="STATE")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    began, chosen = time.monotonic(), task(options.task)
    states = [state for state in LIMITS if state in options.states]
    times: dict[str, list[float]] = {state: [] for state in (PLAIN, *states)}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        plain = Training(chosen, options, folder / "plain")
        kept = None
        if KEPT in states:
            kept = Training(chosen, options, folder / "kept", keep_failures=folder / "failures")
            print(kept.env._failures.describe(), flush=True)
        copies = StateCopies(plain.env)
        for each in filter(None, (plain, kept)):
            each.learn(options.iterations)  # compiles and warms up
        print(f"begins after {time.monotonic() - began:.0f} s", flush=True)
        for number in range(options.rounds):
            if number and time.monotonic() - began > options.seconds:
                break
            times[PLAIN].append(plain.learn(options.iterations))
            if PAGE in states or WATCHED in states:
                _watch(plain, copies, times, options.iterations)
            if LOGGED in states:
                with plain.logger():
                    times[LOGGED].append(plain.learn(options.iterations))
            if kept is not None:
                times[KEPT].append(kept.learn(options.iterations))
        files, ring = (0, 0) if kept is None else (len(kept.env.failure_files()), kept.env._failures.bytes)
    ratios = {
        state: [row / base - 1.0 for row, base in zip(times[state], times[PLAIN], strict=True)] for state in states
    }
    longer = {state: statistics.median(rows) for state, rows in ratios.items()}
    for state, rows in times.items():
        words = ""
        if state in longer:
            low, high = (100 * edge(ratios[state]) for edge in (min, max))
            words = f"{100 * longer[state]:+6.2f} % ({low:+.2f} to {high:+.2f}; limit {100 * LIMITS[state]} %)"
        print(f"{state:22} {1e3 * statistics.median(rows):8.2f} ms an iteration {words}")
    print(f"{len(times[PLAIN])} rounds of {options.iterations} iterations, {copies.count} copies, {files} failures")
    if options.json:
        row = {"task": options.task, "worlds": options.worlds, "device": options.device, "seconds": times,
               "longer": longer, "copies": copies.count, "ring_bytes": ring}  # fmt: skip
        options.json.write_text(json.dumps(row, indent=1) + "\n")
    return int(any(longer[state] > LIMITS[state] for state in states))


if __name__ == "__main__":
    raise SystemExit(main())
