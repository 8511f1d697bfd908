"""How the parts of a step run: on CUDA as one graph, or as several around terms that a graph cannot hold."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch


def run_all(works: Sequence[Callable[[], None]], device: torch.device | None = None) -> None:
    """Do works; a graph of a ``device`` that is being captured holds them side by side, for None in turn."""
    if len(works) > 1 and device and device.type == "cuda" and torch.cuda.is_current_stream_capturing():
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

    def __call__(self) -> None:
        """Run one step."""
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
