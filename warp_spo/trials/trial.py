"""Trials: one operation in all worlds, compared with the dense reference, then timed on the same inputs."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from ..dynamics.dynamics import Dynamics
from ..dynamics.spatial_operators import SpatialOperators
from ..graph.algebra import Operator
from .operations import Inputs, Operation

SAMPLE = 8  # worlds that the reference computes; it takes 10 to 100 ms for one
WARM_UP = 0.2  # [s]: clocks rise and caches fill
GRAPH_ROUNDS = 64  # times that a graph goes through all sets of inputs: its launch, 8 us, is spread over them
GRAPH_SECONDS = 0.05  # fewer rounds where they would take longer
MOST_SUMMED = 2**30  # entries of a sum, which are counted in 32 bits


class Subject:
    """A Dynamics under trial, with random inputs on its device that all its trials share.

    Args:
        dyn: the Dynamics.
        inputs: sets of inputs for its scene and worlds; evaluations in a row take them in turn.
    """

    def __init__(self, dyn: Dynamics, inputs: list[Inputs]):
        self.dyn, self.inputs = dyn, inputs
        self._arrays: dict[tuple[str, int], wp.array] = {}

    def array(self, name: str, index: int) -> wp.array:
        """Input ``name`` of set ``index`` on the device [world, n]."""
        key = name, index
        if key not in self._arrays:
            host = self.inputs[index].array(name)
            self._arrays[key] = wp.array(host, dtype=self.dyn.dtype, device=self.dyn.device)
        return self._arrays[key]

    @functools.cached_property
    def operators(self) -> SpatialOperators:
        """phi, psi and their kin."""
        return self.dyn.operators(self.array("q", 0))

    @functools.cached_property
    def mass(self) -> Operator:
        """The mass matrix as an expression of them."""
        o = self.operators
        return o.H @ o.phi @ o.M @ o.phi.T @ o.H.T + o.Delta


class Timing(NamedTuple):
    """Run time of one evaluation of all worlds [s]: median, and the 10th and 90th percentiles."""

    median: float
    low: float
    high: float


class Trial:
    """One operation of a subject.

    Args:
        subject: on what.
        operation: which.
        sample: worlds that are compared with the reference, spread evenly.

    Attributes:
        forward_errors: relative errors of all worlds compared so far, NaN for a result that is not finite.
        backward_errors: their backward errors, if the operation solves an equation.
        first_call: wall time of the first evaluation [s]: kernels that no earlier trial brought are compiled, or loaded
            from Warp's cache, and the workspace is allocated.
        bytes: of the caller's arrays that one evaluation reads and writes; None where the result is inside.
    """

    def __init__(self, subject: Subject, operation: Operation, sample: int = SAMPLE):
        self.subject, self.operation, self.sample = subject, operation, sample
        self.forward_errors: list[float] = []
        self.backward_errors: list[float] = []
        dyn, self.sets = subject.dyn, len(subject.inputs)
        shape = (dyn.worlds, *operation.shape(dyn.scene))
        self.out = wp.empty(shape, dtype=dyn.dtype, device=dyn.device)
        self._inputs = [[subject.array(name, i) for name in operation.reads] for i in range(self.sets)]
        arrays = [self.out, *self._inputs[0]]
        size = sum(array.size for array in arrays) * wp.types.type_size_in_bytes(dyn.dtype)
        self.bytes = None if operation.reveal else size
        wp.synchronize_device(dyn.device)
        start = time.perf_counter()
        if operation.at_first_q:
            subject.operators.update(subject.array("q", 0))
        self.evaluate(0)
        wp.synchronize_device(dyn.device)
        self.first_call = time.perf_counter() - start

    def evaluate(self, index: int) -> None:
        """Launch one evaluation at set ``index`` of the inputs."""
        self.operation.call(self.subject, *self._inputs[index], out=self.out)

    def poison(self) -> None:
        """Fill what an evaluation writes with NaN."""
        self.out.fill_(float("nan"))
        if self.operation.reveal:
            nowhere: Any = wp.full(self._inputs[0][0].shape, float("nan"), self.out.dtype, self.out.device)
            self.subject.operators.update(nowhere)

    def error(self, index: int) -> float:
        """Largest relative error of a sample of worlds, after an evaluation at set ``index``; NaN if any world has one.

        See :meth:`warp_spo.trials.operations.Operation.error`.
        """
        operation, subject, worlds = self.operation, self.subject, self.subject.dyn.worlds
        if operation.reveal:
            operation.reveal(subject, *self._inputs[index], out=self.out)
        if not all_finite(self.out):
            self.forward_errors.append(float("nan"))
            return float("nan")
        inputs, errors = subject.inputs[index], []
        at = subject.inputs[0] if operation.at_first_q else inputs
        for world in np.unique(np.linspace(0, worlds - 1, self.sample).astype(int)).tolist():
            expected = inputs.expected(operation, at, world)
            given = [inputs.array(name)[world] for name in operation.reads]
            result = (self.out[world : world + 1] if self.out.size else self.out).numpy()[0]
            errors.append(operation.error(at.dense(world), given, result, expected))
            if operation.solves:
                self.backward_errors.append(operation.backward_error(at.dense(world), given, result))
        self.forward_errors += errors
        return float(np.max(errors))

    def check(self) -> float:
        """Evaluate every set of inputs, each into a poisoned result; return the largest error."""
        errors = []
        for index in range(self.sets):
            self.poison()
            self.evaluate(index)
            errors.append(self.error(index))
        return float(np.max(errors))

    def measure(self, repeats: int = 20, warm_up: float = WARM_UP, budget: float = 1.0) -> tuple[Timing, float]:
        """Time evaluations in a row, at the sets of inputs in turn, and check what the timed run left.

        CUDA: the evaluations are captured into one graph, replayed, and timed by events. CPU: wall time of calls.

        Args:
            repeats: how often the row is timed.
            warm_up: [s] of evaluations before.
            budget: on the CPU, fewer repeats, 3 at least, where they would take longer [s].

        Returns:
            run time of one evaluation; error, as :meth:`error`.
        """
        device = self.subject.dyn.device
        once = self._warm_up(self._row, warm_up) / self.sets
        rounds = int(np.clip(GRAPH_SECONDS / (once * self.sets), 1, GRAPH_ROUNDS))
        count = rounds * self.sets
        if device.is_cuda:
            with wp.ScopedCapture(device) as capture:
                for _ in range(rounds):
                    self._row()
            self._warm_up(lambda: wp.capture_launch(capture.graph), warm_up)
            self.poison()
            seconds = self._replay(capture.graph, repeats)
        else:
            self.poison()
            seconds = []
            while len(seconds) < 3 or (len(seconds) < repeats and sum(seconds) < budget):
                start = time.perf_counter()
                for _ in range(rounds):
                    self._row()
                seconds.append(time.perf_counter() - start)
        low, median, high = np.percentile(np.array(seconds) / count, [10, 50, 90])
        return Timing(float(median), float(low), float(high)), self.error(self.sets - 1)

    def eager(self, convert: Callable[[wp.array], Any] | None = None, repeats: int = 20, budget: float = 0.2) -> Timing:
        """Wall time of single calls, each waited for: what a user pays who captures nothing.

        Args:
            convert: makes of a Warp array what the calls are given, such as ``wp.to_torch``; it is not timed.
            repeats: how many calls are timed, after one round to warm up.
            budget: fewer, 3 at least, where they would take longer [s].
        """
        device, calls = self.subject.dyn.device, []
        out = self.out if convert is None else convert(self.out)
        for inputs in self._inputs:
            given = inputs if convert is None else [convert(array) for array in inputs]
            calls.append(functools.partial(self.operation.call, self.subject, *given, out=out))
        seconds: list[float] = []
        for count in range(len(calls) + repeats):
            start = time.perf_counter()
            calls[count % len(calls)]()
            wp.synchronize_device(device)
            if count >= len(calls):
                seconds.append(time.perf_counter() - start)
            if len(seconds) >= 3 and sum(seconds) >= budget:
                break
        low, median, high = np.percentile(seconds, [10, 50, 90])
        return Timing(float(median), float(low), float(high))

    def _row(self) -> None:
        for index in range(self.sets):
            self.evaluate(index)

    def _warm_up(self, run: Any, seconds: float) -> float:
        """Run for some time; return the wall time of the last run [s]."""
        device, begin = self.subject.dyn.device, time.perf_counter()
        while True:
            start = time.perf_counter()
            run()
            wp.synchronize_device(device)
            end = time.perf_counter()
            if end - begin >= seconds:
                return end - start

    def _replay(self, graph: Any, repeats: int) -> list[float]:
        """Seconds of each of ``repeats`` replays."""
        device = self.subject.dyn.device
        events = [[wp.Event(device, enable_timing=True) for _ in range(2)] for _ in range(repeats)]
        for start, end in events:
            device.stream.record_event(start)
            wp.capture_launch(graph)
            device.stream.record_event(end)
        wp.synchronize_device(device)
        return [1e-3 * wp.get_event_elapsed_time(start, end) for start, end in events]


def all_finite(array: wp.array) -> bool:
    """NaN and infinity outlast a sum, and no gigabytes travel."""
    flat, size = array.flatten(), array.size
    parts = (flat[at : min(at + MOST_SUMMED, size)] for at in range(0, size, MOST_SUMMED))
    return all(np.isfinite(wp.utils.array_sum(part)) for part in parts)
