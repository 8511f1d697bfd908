"""Launches kernels, copies, fills and sorts arrays; and records what a call does, so that a later call repeats it.

All device work between a public call and its result goes through :func:`launch`, :func:`copy`, :func:`fill` and
:func:`sort`. While a :class:`Recording` is open in the thread, they also keep what they do. A repetition sets the
addresses of the callers' arrays in the packed arguments of the kernels and packs nothing else, which takes a fraction
of the time.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import warp as wp

from .memory import size_in_bytes, view

MOST_IN_A_ROW = 1 << 24  # threads
LARGEST = 2**31 - 1  # of an axis of a launch


class _Thread(threading.local):
    recording: Recording | None = None
    branch: Branch | None = None
    waiting: list[Callable[[], None]] | None = None
    kernels: set[tuple[wp.Kernel, str, int]] | None = None


_thread = _Thread()


def launch(
    kernel: wp.Kernel, dim: Any, inputs: Sequence[Any], outputs: Sequence[Any], *, device: Any, block_dim: int = 256
) -> None:
    """Launch a kernel, as ``wp.launch``.

    Beyond MOST_IN_A_ROW threads Warp spreads blocks over several axes. Kernels of :mod:`.kernels.native` count blocks
    along the first one, and get a grid of this axis alone.
    """
    if _thread.waiting is not None and _thread.kernels is not None:
        _thread.kernels.add((kernel, wp.get_device(device).alias, block_dim))
        return _wait(functools.partial(launch, kernel, dim, inputs, outputs, device=device, block_dim=block_dim))
    in_a_row = counts_blocks(kernel, device) and dim > MOST_IN_A_ROW
    if in_a_row and dim > LARGEST:  # an index of Warp's has 32 bits; that of these kernels has 64
        dim = -(-dim // block_dim), block_dim
    recording = _thread.recording
    record = in_a_row or recording is not None
    command = wp.launch(kernel, dim, inputs, outputs, device=device, block_dim=block_dim, record_cmd=record)
    if not record or command is None:  # None: no thread has work
        return
    if in_a_row:
        command.grid_stride = True  # the shape of the grid; it has as many blocks as there are
    command.launch()
    if recording is not None:
        recording.keep_launch(command, [*inputs, *outputs])


def counts_blocks(kernel: wp.Kernel, device: Any) -> bool:
    """Return whether a kernel on a GPU tells its threads apart by the number of their block."""
    return getattr(kernel, "counts_blocks", False) and wp.get_device(device).is_cuda


def copy(out: wp.array, array: wp.array) -> None:
    """Copy one array to another, as ``wp.copy``."""
    if _thread.waiting is not None:
        return _wait(functools.partial(copy, out, array))
    wp.copy(out, array)
    if _thread.recording is not None:
        _thread.recording.keep(_Copy, out, array)


def fill(array: wp.array, value: float) -> None:
    """Set all entries of an array."""
    if _thread.waiting is not None:
        return _wait(functools.partial(fill, array, value))
    _set_all(array, value)
    if _thread.recording is not None:
        _thread.recording.keep(_Fill, array, value)


def sort(keys: wp.array, values: wp.array, count: int, bits: int) -> None:
    """Sort the first ``count`` keys, int32 from 0 to 2^bits - 1, and with them the values; equal keys keep their order.

    Both arrays have room for twice as many entries.
    """
    if _thread.waiting is not None:
        return _wait(functools.partial(sort, keys, values, count, bits))
    wp.utils.radix_sort_pairs(keys, values, count, 0, bits)
    if _thread.recording is not None:
        _thread.recording.keep(_Sort, keys, values, count, bits)


class Branch:
    """A second stream of a device, for work of a call that runs beside the rest of it; on a CPU nothing.

    A branch serves one call at a time, as the Dynamics does that has it.
    """

    def __init__(self, device: wp.Device):
        self.device = device
        if device.is_cuda:
            self.stream, self._begin, self._end = wp.Stream(device), wp.Event(device), wp.Event(device)

    @contextlib.contextmanager
    def beside(self) -> Iterator[None]:
        """Launch the work of the ``with`` block after all that came before, and beside what follows until the join."""
        if not self.device.is_cuda or _thread.waiting is not None:
            yield
            return
        self._order(self._fork)
        _thread.branch = self
        try:
            with wp.ScopedStream(self.stream, sync_enter=False):
                yield
        finally:
            _thread.branch = None

    def join(self) -> None:
        """Let what follows wait for the work of the branch."""
        if self.device.is_cuda and _thread.waiting is None:
            self._order(self._join)

    def _order(self, order: Callable[[wp.Stream], None]) -> None:
        order(self.device.stream)
        if _thread.recording is not None:
            _thread.recording.steps.append(_Order(order))

    def _fork(self, main: wp.Stream) -> None:
        self.stream.wait_event(main.record_event(self._begin))

    def _join(self, main: wp.Stream) -> None:
        main.wait_event(self.stream.record_event(self._end))


@contextlib.contextmanager
def compile_side_by_side() -> Iterator[None]:
    """Let the launches, copies, fills and sorts in the ``with`` block wait, and do them in order at its end.

    On CUDA, the kernels of the launches are compiled before, on all cores of the host. Inside the block nothing is
    computed, so that results must not be read there, and arrays that callers pass must outlive it. No graph may be
    captured.
    """
    if _thread.waiting is not None:  # an outer block does all of it
        yield
        return
    waiting: list[Callable[[], None]] = []
    kernels: set[tuple[wp.Kernel, str, int]] = set()
    _thread.waiting, _thread.kernels = waiting, kernels
    try:
        yield
    finally:
        _thread.waiting = _thread.kernels = None
    modules = dict.fromkeys((kernel.module, alias, block_dim) for kernel, alias, block_dim in kernels)
    on_gpus = [one for one in modules if wp.get_device(one[1]).is_cuda]
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        for load in [pool.submit(module.load, wp.get_device(on), block_dim=block) for module, on, block in on_gpus]:
            load.result()
    for each in waiting:
        each()


def _wait(work: Callable[[], None]) -> None:
    """Keep work for the end of :func:`compile_side_by_side`; a call that is recorded cannot be repeated then."""
    assert _thread.waiting is not None
    _thread.waiting.append(work)
    if _thread.recording is not None:
        _thread.recording.complete = False


def _set_all(array: wp.array, value: float) -> None:
    if value == 0:
        array.zero_()
    else:
        array.fill_(value)


def recording() -> Recording | None:
    """Return the recording that is open in this thread."""
    return _thread.recording


class _Place:
    """An array that a copy or fill touches, at the address ``data``. It may be the caller's: then it moves."""

    def __init__(self, array: wp.array, moves: bool):
        self.data = array.ptr
        self._like: tuple[Any, ...] = (tuple(array.shape), array.dtype, str(array.device))
        self._array = None if moves else array

    def array(self) -> wp.array:
        return view(self.data, *self._like) if self._array is None else self._array


class _Copy:
    def __init__(self, out: _Place, array: _Place):
        self._out, self._array = out, array

    def launch(self, stream: wp.Stream | None) -> None:
        wp.copy(self._out.array(), self._array.array(), stream=stream)


class _Fill:
    def __init__(self, place: _Place, value: float):
        self._place, self._value = place, value

    def launch(self, stream: wp.Stream | None) -> None:
        with wp.ScopedStream(stream, sync_enter=False):
            _set_all(self._place.array(), self._value)


class _Sort:
    def __init__(self, keys: _Place, values: _Place, count: int, bits: int):
        self._keys, self._values, self._count, self._bits = keys, values, count, bits

    def launch(self, stream: wp.Stream | None) -> None:
        with wp.ScopedStream(stream, sync_enter=False):
            wp.utils.radix_sort_pairs(self._keys.array(), self._values.array(), self._count, 0, self._bits)


class _Launch:
    """A recorded launch. On CUDA it calls Warp's native function itself, with arguments that were looked up before."""

    def __init__(self, command: Any):
        runtime: Any = wp._src.context.runtime
        self._command, self._runtime = command, runtime
        self._call: Any = None
        native: Any = getattr(runtime.core, "wp_cuda_launch_kernel", None)
        if command.device.is_cuda and len(getattr(native, "argtypes", None) or ()) == 11:
            blocks = command.bounds.size, command.max_blocks, command.block_dim, int(command.grid_stride)
            rest = command.cluster_dim, command.hooks.forward_smem_bytes, command.params_addr
            self._call = functools.partial(native, command.device.context, command.hooks.forward, *blocks, *rest)

    def launch(self, stream: wp.Stream | None) -> None:
        if self._call is None or stream is None or self._runtime.captures:  # Warp notes what its captures use
            self._command.launch(stream)
        elif self._call(stream.cuda_stream, None):
            raise RuntimeError(
                f"Kernel {self._command.kernel.key} failed to launch: {self._runtime.get_error_string()}"
            )


class _Order:
    """Lets a branch wait for the stream of a call, or the stream for the branch."""

    def __init__(self, order: Callable[[Any], None]):
        self.launch = order


class _OnBranch:
    """A step on the stream of a branch, whatever the stream of the call."""

    def __init__(self, step: Any, branch: Branch):
        self._step, self._stream = step, branch.stream

    def launch(self, stream: wp.Stream | None) -> None:
        self._step.launch(self._stream)


class Recording:
    """The device work of one call, done inside ``with Recording(arrays) as recording:``.

    Args:
        arrays: address and size in bytes of each of the caller's arrays; sizes are positive, arrays lie apart or are
            the very same.

    Attributes:
        steps: what was done, in order; ``step.launch(stream)`` does it again.
        places: for each array, the packed arguments that hold its address in ``data``.
        shifted: (array, packed argument, bytes from the array's start) of views that start inside an array.
        taken: the caller's arrays whose memory the call reads or writes. Of others, such as a tensor in place of a
            number, it took the numbers themselves.
        written: those that the call writes.
        results: (array, shape, dtype) of each array that the call makes for its caller, after those of the caller.
        complete: the steps are all of the work; otherwise the call cannot be repeated.
    """

    def __init__(self, arrays: Sequence[tuple[int, int]]):
        self._arrays = list(arrays)
        self.steps: list[Any] = []
        self.places: list[list[Any]] = [[] for _ in arrays]
        self.shifted: list[tuple[int, Any, int]] = []
        self.taken: list[Any] = []
        self.written: list[Any] = []
        self.results: list[tuple[Any, tuple[int, ...], type]] = []
        self.complete = True
        self._kept: list[Any] = []  # arrays that packed arguments point to
        self._outer: Recording | None = None

    def __enter__(self) -> Recording:
        self._outer, _thread.recording = _thread.recording, self
        return self

    def __exit__(self, *_: object) -> None:
        _thread.recording, self._outer = self._outer, None

    def add_result(self, owner: Any, array: wp.array, shape: tuple[int, ...], dtype: type) -> None:
        """Add an array that the call makes for its caller."""
        self.results.append((owner, shape, dtype))
        self._arrays.append((array.ptr or 0, size_in_bytes(array)))
        self.places.append([])

    def keep_launch(self, command: Any, arguments: list[Any]) -> None:
        """Keep a launch that was done."""
        self.complete &= isinstance(command, wp.Launch)  # Warp's deterministic mode has another class
        if not self.complete:
            return
        for at, argument in enumerate(arguments, 1):
            if not isinstance(argument, wp.array) or self._find(argument) is None:
                self._kept.append(argument)
                continue
            packed = type(command.params[at]).from_buffer_copy(command.params[at])  # the array shares its own
            command.params[at] = packed
            if command.params_addr:
                command.params_addr[at] = ctypes.c_void_p(ctypes.addressof(packed))
            self._follow(argument, packed)
        command.fwd_args = None  # would keep the caller's memory
        self._add(_Launch(command))

    def keep(self, step: type, *arguments: Any) -> None:
        """Keep a copy, a fill or a sort that was done."""
        places: list[Any] = []
        for argument in arguments:
            if not isinstance(argument, wp.array):
                places.append(argument)
                continue
            moves = self._find(argument) is not None
            places.append(_Place(argument, moves))
            if moves:
                self.complete &= bool(argument.is_contiguous)
                self._follow(argument, places[-1])
        self._add(step(*places))

    def _add(self, step: Any) -> None:
        self.steps.append(step if _thread.branch is None else _OnBranch(step, _thread.branch))

    def _find(self, array: wp.array) -> int | None:
        """Return the number of the caller's array in whose memory an array starts."""
        pointer = array.ptr or 0
        for number, (start, size) in enumerate(self._arrays):
            if start <= pointer < start + size:
                return number
        return None

    def _follow(self, array: wp.array, place: Any) -> None:
        number = self._find(array)
        assert number is not None
        shift = array.ptr - self._arrays[number][0]
        if shift:
            self.shifted.append((number, place, shift))
        else:
            self.places[number].append(place)
