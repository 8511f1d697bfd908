"""Base classes of peers: name, version, operations with the work that is timed, and rows of numbers.

A peer that is called from Python implements ``prepare``, ``run`` and ``result``, and is timed here. A peer with its own
program implements ``rows``. Both compute the same robot at the same states.
"""

from __future__ import annotations

import abc
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import numpy as np

from warp_spo.trials.inputs import Inputs

from .coordinates import Coordinates, States, sample
from .lumped import Robot

WARM_UP = 0.05  # [s] of evaluations before anything is timed
GRAPH_SECONDS = 0.02  # longest time of a graph [s], by which the rounds are reduced
ROUNDS = 64  # largest number of times that a graph cycles through all sets of inputs
REPEATS = 20
BUDGET = 0.4  # longest time of all repeats [s], by which they are reduced, to 3 at least
SLOW = 0.5  # [s]: an operation that takes longer than this is not measured at larger world counts


class Absent(Exception):
    """A peer cannot run on this machine; the message gives the reason."""


class Peer(abc.ABC):
    """A peer with a robot.

    Attributes:
        name: the library's name; rows have it with the version.
        scene: name of the robot on the command line.
        timed: whether evaluations are timed; if not, they are only compiled.
        dtypes: precisions that the peer has.
        works: (operation, variant) -> a line that says which work is timed.
        twist, scalar_first: conventions of the peer's states, see :class:`Coordinates`.
    """

    name = ""
    scene = ""
    timed = True
    dtypes: tuple[str, ...] = ("float32",)
    works: ClassVar[dict[tuple[str, str], str]] = {}
    twist = "local"
    scalar_first = False

    @classmethod
    @abc.abstractmethod
    def version(cls) -> str:
        """Return the version of the installed package.

        Raises:
            Absent: the package, or something that it needs, is not installed.
        """

    def __init__(self, robot: Robot, device: Any, dtype: str):
        """Build the peer's model.

        Raises:
            Absent, Unsupported: the peer cannot run on this device, or does not support this robot.
        """
        self.robot, self.device, self.dtype = robot, device, dtype
        self.coordinates = Coordinates(robot, self.twist, self.scalar_first)

    @abc.abstractmethod
    def rows(self, inputs: list[Inputs], worlds: list[int], wanted: Callable[[str, str], bool]) -> Iterator[dict]:
        """Yield a row for each world count and operation; ``skipped`` gives the reason why one has no numbers.

        Args:
            inputs: sets of inputs of the largest number of worlds.
            worlds: world counts in rising order; after one that is skipped, larger ones are skipped too.
            wanted: function of operation and variant that says whether they are measured.
        """


class PythonPeer(Peer):
    """A peer whose evaluations are called from Python and timed here."""

    def states(self, inputs: list[Inputs]) -> Any:
        """Return the states for ``prepare``: an object with ``sets`` and with ``error`` for results."""
        return States(self.coordinates, inputs, self.dtype)

    @abc.abstractmethod
    def prepare(self, op: str, variant: str, states: States, worlds: int) -> None:
        """Copy the first ``worlds`` worlds of all sets of states to the device, and compile."""

    @abc.abstractmethod
    def run(self, index: int) -> None:
        """Launch one evaluation at set ``index``."""

    @abc.abstractmethod
    def poison(self) -> None:
        """Fill the arrays that an evaluation writes with NaN."""

    @abc.abstractmethod
    def result(self, worlds: list[int]) -> np.ndarray:
        """Return qdd or tau [len(worlds), dof], or the mass matrix [len(worlds), dof, dof], of the last evaluation."""

    def synchronize(self) -> None:
        """Wait for the device; on a CPU there is nothing to wait for."""
        return

    def graph(self, run: Callable[[], None]) -> Callable[[], None] | None:
        """Return a function that replays ``run`` as a graph, or None where there are no graphs and calls are timed."""
        return None

    def events(self, replay: Callable[[], None], repeats: int) -> list[float]:
        """Return the time of each of ``repeats`` calls of ``replay`` [s]."""
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
        """Return time and error of an operation; results of all sets of states and of the timed run are checked."""
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
        """Call ``run`` for WARM_UP seconds and return the wall time of the last call [s]."""
        begin = time.perf_counter()
        while True:
            start = time.perf_counter()
            run()
            self.synchronize()
            end = time.perf_counter()
            if end - begin >= WARM_UP:
                return end - start


class WarpPeer(PythonPeer):
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
        except Exception as error:  # work that allocates or copies to the host cannot be captured
            print(f"{self.name}: calls are timed, because no graph can be captured: {error}", file=sys.stderr)
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
