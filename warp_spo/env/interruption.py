"""Ctrl-C and SIGTERM as a request to end, which a training reads where it can stop without a loss."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from types import FrameType, TracebackType
from typing import Any

NAMES = {int(signal.SIGINT): "Ctrl-C", int(signal.SIGTERM): "SIGTERM"}


class StopRequest:
    """A context in which Ctrl-C and SIGTERM are remembered; a Ctrl-C after one of them is a KeyboardInterrupt at once.

    Outside of the main thread, and outside of the context, signals do what they did before.

    Attributes:
        signal: number of the signal that came, 0 without one.
    """

    def __init__(self) -> None:
        self.signal = 0
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._remember) for number in NAMES}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, before in self._before.items():
            signal.signal(number, before)
        self._before = {}

    def _remember(self, number: int, _: FrameType | None) -> None:
        if self.signal and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.signal = number
        if os.environ.get("RANK", "0") == "0":
            text = f"\n{NAMES[number]}: ends after this iteration, with a checkpoint; Ctrl-C again: at once\n"
            with contextlib.suppress(OSError):  # a terminal that is gone
                os.write(2, text.encode())  # print may be at work where the signal came
