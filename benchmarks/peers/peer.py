"""What every peer gives: name, version, operations with the work that is timed, and rows of numbers.

A peer that launches evaluations one by one gives ``prepare``, ``run`` and ``result``, timed here; one with its own
program gives ``rows``. Both get the same robot and the same states.
"""

from __future__ import annotations

import abc
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import numpy as np

from warp_spo.trials.operations import Inputs

from .coordinates import Coordinates, States, sample
from .lumped import Robot

WARM_UP = 0.05  # [s] of evaluations before anything is timed
GRAPH_SECONDS = 0.02  # a graph goes through all sets of inputs up to ROUNDS times, fewer where that would take longer
ROUNDS = 64
REPEATS = 20
BUDGET = 0.4  # [s]: fewer repeats, 3 at least, where they would take longer
SLOW = 0.5  # [s]: an operation that takes longer is not measured at more worlds


class Absent(Exception):
    """The peer cannot run here; the reason."""


class Peer(abc.ABC):
    """One peer with one robot.

    Attributes:
        name: as rows have it, with the version behind it.
        scene: name of the robot.
        timed: False: evaluate once, for what that compiles.
        dtypes: precisions that it has.
        works: (operation, variant) -> one line of what is timed.
        twist, scalar_first: its convention, see :class:`Coordinates`.
    """

    name = ""
    scene = ""  # of the robot, as the command line has it
    timed = True
    dtypes: tuple[str, ...] = ("float32",)
    works: ClassVar[dict[tuple[str, str], str]] = {}
    twist = "local"
    scalar_first = False

    @classmethod
    @abc.abstractmethod
    def version(cls) -> str:
        """Version of the installed package.

        Raises:
            Absent: it is not installed, or lacks what it needs.
        """

    def __init__(self, robot: Robot, device: Any, dtype: str):
        """Build the peer's model.

        Raises:
            Absent, Unsupported: it cannot run on this device, or has no such robot.
        """
        self.robot, self.device, self.dtype = robot, device, dtype
        self.coordinates = Coordinates(robot, self.twist, self.scalar_first)

    @abc.abstractmethod
    def rows(self, inputs: list[Inputs], worlds: list[int], wanted: Callable[[str, str], bool]) -> Iterator[dict]:
        """Yield a row for each number of worlds and operation; ``skipped`` says why it, and what has more, was not run.

        Args:
            inputs: sets of inputs, of the largest number of worlds.
            worlds: rising numbers of worlds.
            wanted: of an operation and a variant.
        """


class Stepped(Peer):
    """A peer that launches evaluations one by one, which are timed here."""

    def states(self, inputs: list[Inputs]) -> Any:
        """Sets of states as ``prepare`` gets them, with ``error`` of results."""
        return States(self.coordinates, inputs, self.dtype)

    @abc.abstractmethod
    def prepare(self, op: str, variant: str, states: States, worlds: int) -> None:
        """Take the first ``worlds`` of all sets of states to the device, and compile."""

    @abc.abstractmethod
    def run(self, index: int) -> None:
        """Launch one evaluation at set ``index``."""

    @abc.abstractmethod
    def poison(self) -> None:
        """Fill what an evaluation writes with NaN."""

    @abc.abstractmethod
    def result(self, worlds: list[int]) -> np.ndarray:
        """Of the last evaluation: qdd or tau [len(worlds), dof], or the mass matrix [len(worlds), dof, dof]."""

    def synchronize(self) -> None:
        """Wait for the device; on a CPU there is nothing to wait for."""
        return

    def graph(self, run: Callable[[], None]) -> Callable[[], None] | None:
        """``run`` captured into a graph; None: there are none here, and calls are timed."""
        return None

    def events(self, replay: Callable[[], None], repeats: int) -> list[float]:
        """Seconds of each of ``repeats`` calls of ``replay``."""
        seconds = []
        for _ in range(repeats):
            start = time.perf_counter()
            replay()
            self.synchronize()
            seconds.append(time.perf_counter() - start)
        return seconds

    def rows(self, inputs: list[Inputs], worlds: list[int], wanted: Callable[[str, str], bool]) -> Iterator[dict]:
        states = self.states(inputs)
        works = [work for work in self.works if wanted(*work)]
        for count in worlds:
            for op, variant in list(works):
                row = dict(op=op, variant=variant, worlds=count)
                try:
                    row |= self.measure(op, variant, states, count)
                except Exception as error:
                    yield row | dict(skipped=f"{type(error).__name__}: {error}")
                    works.remove((op, variant))
                    continue
                yield row
                if row.get("us", 0.0) > 1e6 * SLOW and count < worlds[-1]:
                    reason = f"{count} worlds take {row['us']:.3g} us"
                    yield dict(op=op, variant=variant, worlds=worlds[-1], skipped=reason)
                    works.remove((op, variant))

    def measure(self, op: str, variant: str, states: States, worlds: int) -> dict[str, Any]:
        """Check every set of states, each into poisoned memory; then time, and check what the timed run left."""
        self.synchronize()
        start = time.perf_counter()
        self.prepare(op, variant, states, worlds)
        self.run(0)
        self.synchronize()
        first = time.perf_counter() - start
        if not self.timed:
            return dict(compile_s=first)
        worst, chosen = [], sample(worlds)
        for index in range(len(states.sets)):
            self.poison()
            self.run(index)
            self.synchronize()
            worst.append(states.error(op, index, chosen, self.result(chosen)))

        def row() -> None:
            for index in range(len(states.sets)):
                self.run(index)

        once = self._warm_up(row) / len(states.sets)
        rounds = int(np.clip(GRAPH_SECONDS / (once * len(states.sets)), 1, ROUNDS))

        def rounds_of_rows() -> None:
            for _ in range(rounds):
                row()

        replay = self.graph(rounds_of_rows)
        timed = "graph" if replay else "calls"
        replay = replay or rounds_of_rows
        self._warm_up(replay)
        repeats = int(np.clip(BUDGET / (once * rounds * len(states.sets)), 3, REPEATS))
        self.poison()
        low, median, high = np.percentile(self.events(replay, repeats), [10, 50, 90]) / (rounds * len(states.sets))
        self.synchronize()
        worst.append(states.error(op, len(states.sets) - 1, chosen, self.result(chosen)))
        return dict(us=1e6 * median, p10_us=1e6 * low, p90_us=1e6 * high, error=float(np.max(worst)), compile_s=first,
                    timed=timed)  # fmt: skip

    def _warm_up(self, run: Callable[[], None]) -> float:
        """Run for some time; return the wall time of the last run [s]."""
        begin = time.perf_counter()
        while True:
            start = time.perf_counter()
            run()
            self.synchronize()
            end = time.perf_counter()
            if end - begin >= WARM_UP:
                return end - start


class WarpPeer(Stepped):
    """A peer made of Warp kernels: evaluations are captured into CUDA graphs and timed by events."""

    def synchronize(self) -> None:
        import warp as wp

        wp.synchronize_device(self.device)

    def graph(self, run: Callable[[], None]) -> Callable[[], None] | None:
        import warp as wp

        if not wp.get_device(self.device).is_cuda:
            return None
        try:
            with wp.ScopedCapture(self.device) as capture:
                run()
        except Exception as error:  # what reads back or allocates cannot be captured
            print(f"{self.name}: not captured, calls are timed: {error}", file=sys.stderr)
            return None
        return lambda: wp.capture_launch(capture.graph)

    def events(self, replay: Callable[[], None], repeats: int) -> list[float]:
        import warp as wp

        device = wp.get_device(self.device)
        if not device.is_cuda:
            return super().events(replay, repeats)
        pairs = [[wp.Event(device, enable_timing=True) for _ in range(2)] for _ in range(repeats)]
        for start, end in pairs:
            device.stream.record_event(start)
            replay()
            device.stream.record_event(end)
        self.synchronize()
        return [1e-3 * wp.get_event_elapsed_time(start, end) for start, end in pairs]
