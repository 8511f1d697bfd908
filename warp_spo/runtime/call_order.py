"""Calls that share scratch memory run one after the other: :class:`CallOrder`."""

from __future__ import annotations

import threading

import warp as wp

_locks: dict[str, threading.RLock] = {}  # of CUDA devices, whose current stream a call may change


class CallOrder:
    """Lets threads, and streams of a CUDA device, wait for each other.

    Attributes:
        lock: held during a call. On CUDA a call ends when its kernels are launched, and the stream of the next call
            waits for them.
        stream: of the latest call.
    """

    def __init__(self, device: wp.Device):
        self._device = device
        self.stream: wp.Stream | None = None
        self.lock = _locks.setdefault(device.alias, threading.RLock()) if device.is_cuda else threading.RLock()

    def order(self, stream: wp.Stream) -> None:
        """Let ``stream`` wait for the stream of the call before; in a graph capture nothing may wait."""
        before, self.stream = self.stream, stream
        if before is None or before is stream or before.cuda_stream == stream.cuda_stream:
            return
        if not (self._device.captures or before.is_capturing or stream.is_capturing):
            stream.wait_stream(before)
