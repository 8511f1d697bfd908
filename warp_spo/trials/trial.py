"""Trials: evaluate one operation in all worlds, compare it with the dense reference, and time it on the same inputs."""

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
from .inputs import Inputs, TrialCase

SAMPLE = 8  # worlds that are compared with the reference, which takes 10 to 100 ms a world
WARM_UP = 0.2  # [s] of evaluations before timing, in which clocks rise and caches fill
GRAPH_ROUNDS = 64  # times that a graph evaluates all sets of inputs, over which its launch of 8 us is spread
GRAPH_SECONDS = 0.05  # a graph has fewer rounds if they would take longer
MOST_SUMMED = 2**30  # entries in one call of array_sum, which counts them in 32 bits


class Subject:
    """A Dynamics to try, and random inputs on its device that all its trials share.

    Args:
        dyn: The Dynamics.
        inputs: Sets of inputs for its scene and worlds. Evaluations in a row use them in turn.
    """

    def __init__(self, dyn: Dynamics, inputs: list[Inputs]):
        self.dyn, self.inputs = dyn, inputs
        self._arrays: dict[tuple[str, int], wp.array] = {}

    def array(self, name: str, index: int) -> wp.array:
        """Return the input ``name`` of set ``index`` on the device [world, n]."""
        key = name, index
        if key not in self._arrays:
            host = self.inputs[index].array(name)
            self._arrays[key] = wp.array(host, dtype=self.dyn.dtype, device=self.dyn.device)
        return self._arrays[key]

    @functools.cached_property
    def operators(self) -> SpatialOperators:
        """The spatial operators at the first set of inputs: phi, psi and the others."""
        return self.dyn.operators(self.array("q", 0))

    @functools.cached_property
    def mass(self) -> Operator:
        """The mass matrix as an expression of these operators."""
        o = self.operators
        return o.H @ o.phi @ o.M @ o.phi.T @ o.H.T + o.Delta


class Timing(NamedTuple):
    """Run time of one evaluation of all worlds [s]: median, and the 10th and 90th percentiles."""

    median: float
    low: float
    high: float


class TrialRun:
    """One operation of a subject. The constructor runs the first evaluation.

    Args:
        subject: The Dynamics and its inputs.
        operation: The operation.
        sample: Number of worlds, evenly spread, that are compared with the reference.

    Attributes:
        forward_errors: Relative errors of all worlds compared so far; NaN for a result that is not finite.
        backward_errors: Backward errors of the same worlds if the operation solves an equation, else empty.
        first_call: Wall time of the first evaluation [s]. It includes compiling new kernels, or loading them from
            Warp's cache, and allocating the workspace.
        bytes: Bytes of the caller's arrays that one evaluation reads and writes. None if the result is not among them.
    """

    def __init__(self, subject: Subject, operation: TrialCase, sample: int = SAMPLE):
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
        """Fill the result with NaN, so that an evaluation must write all of it."""
        self.out.fill_(float("nan"))
        if self.operation.reveal:
            nan: Any = wp.full(self._inputs[0][0].shape, float("nan"), self.out.dtype, self.out.device)
            self.subject.operators.update(nan)

    def error(self, index: int) -> float:
        """Return the largest relative error of the sample after an evaluation at set ``index``.

        The error is NaN if the result of any world is not finite.

        See :meth:`warp_spo.trials.inputs.TrialCase.error`.
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
            arguments = [inputs.array(name)[world] for name in operation.reads]
            result = (self.out[world : world + 1] if self.out.size else self.out).numpy()[0]
            errors.append(operation.error(at.dense(world), arguments, result, expected))
            if operation.solves:
                self.backward_errors.append(operation.backward_error(at.dense(world), arguments, result))
        self.forward_errors += errors
        return float(np.max(errors))

    def check(self) -> float:
        """Evaluate every set of inputs into a poisoned result, and return the largest error."""
        errors = []
        for index in range(self.sets):
            self.poison()
            self.evaluate(index)
            errors.append(self.error(index))
        return float(np.max(errors))

    def measure(self, repeats: int = 20, warm_up: float = WARM_UP, budget: float = 1.0) -> tuple[Timing, float]:
        """Time evaluations in a row, at the sets of inputs in turn, and check the result of the last one.

        On CUDA the evaluations are captured into one graph, which is replayed and timed by events. On the CPU the wall
        time of calls is taken.

        Args:
            repeats: How often the row is timed.
            warm_up: Time of evaluations before the timing [s].
            budget: Time after which a CPU stops repeating, with 3 repeats at least [s].

        Returns:
            The run time of one evaluation, and the error as of :meth:`error`.
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
        """Return the wall time of single calls, each waited for: the run time without graph capture.

        Args:
            convert: Function from a Warp array to the array that the calls receive, such as ``wp.to_torch``. It is not
                timed. None passes Warp arrays.
            repeats: Number of timed calls, after one call for each set of inputs to warm up.
            budget: Time after which calls are no longer repeated, with 3 calls at least [s].
        """
        device, calls = self.subject.dyn.device, []
        out = self.out if convert is None else convert(self.out)
        for inputs in self._inputs:
            arrays = inputs if convert is None else [convert(array) for array in inputs]
            calls.append(functools.partial(self.operation.call, self.subject, *arrays, out=out))
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
        """Launch one evaluation at each set of inputs."""
        for index in range(self.sets):
            self.evaluate(index)

    def _warm_up(self, run: Callable[[], Any], seconds: float) -> float:
        """Call ``run`` for some ``seconds`` and return the wall time of the last call [s]."""
        device, begin = self.subject.dyn.device, time.perf_counter()
        while True:
            start = time.perf_counter()
            run()
            wp.synchronize_device(device)
            end = time.perf_counter()
            if end - begin >= seconds:
                return end - start

    def _replay(self, graph: wp.Graph, repeats: int) -> list[float]:
        """Return the run time of each of ``repeats`` replays [s]."""
        device = self.subject.dyn.device
        events = [[wp.Event(device, enable_timing=True) for _ in range(2)] for _ in range(repeats)]
        for start, end in events:
            device.stream.record_event(start)
            wp.capture_launch(graph)
            device.stream.record_event(end)
        wp.synchronize_device(device)
        return [1e-3 * wp.get_event_elapsed_time(start, end) for start, end in events]


def all_finite(array: wp.array) -> bool:
    """Whether all entries are finite. They are summed on the device, because NaN and infinity survive a sum."""
    flat, size = array.flatten(), array.size
    parts = (flat[at : min(at + MOST_SUMMED, size)] for at in range(0, size, MOST_SUMMED))
    return all(np.isfinite(wp.utils.array_sum(part)) for part in parts)
