"""Work that is repeated as CUDA graphs: functions, and the steps of environments whose terms may not fit a graph."""

from __future__ import annotations

import gc
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch


def is_capturing() -> bool:
    """Return whether torch captures a graph on its current stream."""
    return torch.backends.cuda.is_built() and torch.cuda.is_current_stream_capturing()


def run_all(works: Sequence[Callable[[], None]], device: torch.device | None = None) -> None:
    """Do works; a graph of a ``device`` that is being captured holds them side by side, for None in turn."""
    if len(works) > 1 and device and device.type == "cuda" and is_capturing():
        main, sides = torch.cuda.current_stream(device), [torch.cuda.Stream(device) for _ in works[1:]]
        for side in sides:
            side.wait_stream(main)
        works[0]()
        for work, side in zip(works[1:], sides, strict=True):
            with torch.cuda.stream(side):
                work()
            main.wait_stream(side)
    else:
        for work in works:
            work()


class Captured:
    """A function without arguments that is a CUDA graph after its first calls; on a CPU it is the function.

    Its tensors have to stay at their places. First calls run on the stream of the capture, since autograd keeps the
    stream on which it met a parameter first. A function that cannot be captured is called each time, and a warning
    says why.

    Args:
        function: what is repeated. device: where it runs. what: words for the warning. plain: calls before the capture.
        captures: False: never.
    """

    def __init__(self, function: Callable[[], None], device: Any, what: str, plain: int = 1, captures: bool = True):
        self._function, self._what, self._plain = function, what, plain
        device = torch.device(device)
        self._stream = torch.cuda.Stream(device) if captures and device.type == "cuda" else None
        self._graph: torch.cuda.CUDAGraph | None = None

    @property
    def is_graph(self) -> bool:
        """Whether calls replay a graph."""
        return self._graph is not None

    def __call__(self) -> None:
        """Run, or replay, on torch's current stream; inside of another capture: become part of it."""
        if self._graph is not None:
            self._graph.replay()
        elif self._stream is None or is_capturing():
            self._function()
        elif self._plain == 0 and self._capture(self._stream):
            self()
        else:
            self._plain -= 1
            self._stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(self._stream):
                self._function()
            torch.cuda.current_stream().wait_stream(self._stream)

    def _capture(self, stream: torch.cuda.Stream) -> bool:
        """Capture the function, and return whether that went well."""
        gc.collect()  # a graph that is destroyed meanwhile would break the capture
        graph = torch.cuda.CUDAGraph()
        try:  # NCCL and others have threads of their own, which may do as they like
            with torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
                self._function()
        except Exception as error:
            why = f"{error or type(error).__name__}".splitlines()[0]
            warnings.warn(f"{self._what} runs without a CUDA graph: {why}", stacklevel=3)
            torch.cuda.synchronize()
            with torch.cuda.graph(torch.cuda.CUDAGraph(), stream=stream):  # else torch takes later draws for captured
                torch.zeros(1, device=stream.device)
            return False
        self._graph = graph
        return True


class Part(NamedTuple):
    """A part of a step.

    Attributes:
        run: does it, on torch's current stream.
        term: the name of the user's term that it is; "" for a part of the environment's own, which a graph can hold.
    """

    run: Callable[[], None]
    term: str = ""


class Replay:
    """Runs the parts of a step, in order; from the second time on CUDA as a graph.

    A user's term that waits for the device, or that cannot be captured, runs between graphs instead, with a warning
    that names it.

    Args:
        parts: of a step. graphs: whether to capture.
    """

    def __init__(self, parts: list[Part], graphs: bool):
        self._parts, self._graphs = parts, graphs
        self._eager: set[str] = set()
        self._steps = 0
        self._pieces: list[Callable[[], None]] | None = None

    @property
    def captured(self) -> int:
        """How many graphs make a step; 0 before the second step and where nothing is captured."""
        return 0 if self._pieces is None else sum(1 for piece in self._pieces if hasattr(piece, "__self__"))

    @property
    def is_capturable(self) -> bool:
        """Whether a graph can hold a whole step; known after the first step."""
        return self._graphs and not self._eager and self._steps > 0

    def __call__(self) -> None:
        """Run one step; inside of another capture: become part of it."""
        if self._graphs and is_capturing():
            for part in self._parts:
                part.run()
            return
        if self._pieces is None and self._graphs and self._steps > 0:
            self._capture()
        for piece in self._pieces if self._pieces is not None else [part.run for part in self._parts]:
            if self._graphs and self._steps == 0:
                self._try(piece)
            else:
                piece()
        self._steps += 1

    def _try(self, piece: Callable[[], None]) -> None:
        """Run a part of the first step; note a user's term that waits for the device."""
        term = next(part.term for part in self._parts if part.run is piece)
        if not term:
            return piece()
        mode = torch.cuda.get_sync_debug_mode()
        torch.cuda.set_sync_debug_mode("error")
        try:
            return piece()
        except RuntimeError as error:
            if "synchroniz" not in str(error):
                raise
            self._refuse(term, str(error))
        finally:
            torch.cuda.set_sync_debug_mode(mode)
        piece()

    def _refuse(self, term: str, why: str) -> None:
        self._eager.add(term)
        warnings.warn(
            f"Env: the term {term} cannot be part of a CUDA graph ({why.splitlines()[0]}); it runs between graphs, "
            f"which is slower; write it without .item(), nonzero, masks as indices, branches on tensors and copies to "
            f"the host",
            stacklevel=5,
        )

    def _capture(self) -> None:
        """Capture runs of parts that a graph can hold; a term that fails leaves them and all is captured again."""
        while True:
            pieces: list[Any] = []
            held: list[Part] = []
            failed = ""
            for part in [*self._parts, None]:
                if part is not None and part.term not in self._eager:
                    held.append(part)
                    continue
                if held:
                    graph, failed = self._graph(held)
                    if failed:
                        break
                    pieces.append(graph.replay)
                    held = []
                if part is not None:
                    pieces.append(part.run)
            if not failed:
                self._pieces = pieces
                return

    def _graph(self, parts: list[Part]) -> tuple[Any, str]:
        """Return the graph of some parts, and the name of the user's term that cannot be in it."""
        graph, now = torch.cuda.CUDAGraph(), ""
        try:
            with torch.cuda.graph(graph, capture_error_mode="thread_local"):  # other threads may do as they like
                for part in parts:
                    now = part.term
                    part.run()
                now = ""
        except Exception as error:
            if not now:
                raise
            torch.cuda.synchronize()
            self._refuse(now, str(error))
        return graph, now
