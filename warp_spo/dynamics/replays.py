"""Repeats recorded calls of a Dynamics: the checks that can fail from call to call, and the launches. Nothing else.

The first call of a kind compiles and allocates. The second is recorded: :mod:`warp_spo.launches` keeps its device work.
From the third on, arrays are compared with what the recorded call took, their addresses are set in the packed arguments
of the kernels, and the kernels are launched. Two calls are of one kind if they pass the same arguments by the same
names, arrays of the same classes and numbers that are equal. Whatever differs from the recorded call in any other way
is a call as if nothing were recorded, which does it or says what is wrong.

One call runs at a time, see :class:`warp_spo.turns.Turn`.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import warp as wp

from ..arrays import CLASSES, TORCH, torch_border
from ..launches import Recording
from ..launches import recording as open_recording
from ..memory import ranges_overlap, size_in_bytes
from ..turns import Turn

Builder = Callable[[list, list], Any]
"""``build(arrays, results)`` returns what a caller gets, of the arrays of the call and those that it made."""
MOST_KINDS, MOST_TRIES = 256, 4  # kinds of calls that are kept; calls of a kind that are recorded
NUMBERS = frozenset((int, float, bool, str))
MISS = object()
"""What :meth:`Replays.replay` returns if nothing was recorded for the call."""


class Like(NamedTuple):
    """What a recorded call knows of an array: of the next one it takes the same."""

    shape: Any
    dtype: Any
    device: Any


class Plan:
    """A recorded call.

    Args:
        arrays: the arrays that it took, in the order of its arguments.
        ranges: address and size in bytes of each.
        recording: what it did.
        build: what the caller gets.
    """

    def __init__(self, device: wp.Device, arrays: list, ranges: list, recording: Recording, build: Builder):
        self._device, self._recording, self._build = device, recording, build
        self.kind = CLASSES[type(arrays[0])]
        self._addresses, maker = _addresses, _maker
        if self.kind == TORCH:
            self._addresses, maker = torch_border().addresses, torch_border().maker
        self._like = tuple(Like(x.shape, x.dtype, x.device) for x in arrays)
        self._makers = [maker(shape, dtype, device) for _, shape, dtype in recording.results]
        self._written = [i for i, x in enumerate(arrays) if any(x is other for other in recording.written)]
        pairs = [(i, j) for i in self._written for j in range(len(arrays)) if i != j]
        self._same = [(i, j, arrays[i] is arrays[j]) for i, j in pairs if ranges[i] == ranges[j]]
        self._apart = [(i, ranges[i][1], j, ranges[j][1]) for i, j in pairs if ranges[i] != ranges[j]]
        self._places = tuple(map(tuple, recording.places))
        self._last: list[int] = []  # addresses that the packed arguments hold

    def replay(self, turn: Turn, arrays: list) -> Any:
        """Do the call again with other arrays; return :data:`MISS` if they differ in more than their memory."""
        addresses = self._addresses(arrays, self._like)
        if addresses is None:
            return MISS
        for i, j, identical in self._same:
            if addresses[i] != addresses[j] or identical != (arrays[i] is arrays[j]):
                return MISS
        for i, size, j, other_size in self._apart:
            if ranges_overlap(addresses[i], size, addresses[j], other_size):
                return MISS
        stream = None
        if self._device.is_cuda:
            stream = torch_border().stream(self._device) if self.kind == TORCH else self._device.stream
            turn.order(stream)
        results = []
        for make in self._makers:
            owner, address = make()
            results.append(owner)
            addresses.append(address)
        if addresses != self._last:
            for address, places in zip(addresses, self._places, strict=True):
                for place in places:
                    place.data = address
            for number, place, shift in self._recording.shifted:
                place.data = addresses[number] + shift
            self._last = addresses
        if self.kind == TORCH and self._written:
            torch_border().mark_changed([arrays[i] for i in self._written])
        for step in self._recording.steps:
            step.launch(stream)
        return self._build(arrays, results)


@dataclasses.dataclass
class Kind:
    """Calls of one kind.

    Attributes:
        plans: those that are recorded, which differ in the arrays that are written in place. tries: to record one.
    """

    plans: list[Plan] = dataclasses.field(default_factory=list)
    tries: int = 0


class Replays:
    """The recorded calls of one Dynamics."""

    def __init__(self, device: wp.Device, turn: Turn):
        self._device, self.turn = device, turn
        if "torch" in sys.modules:
            torch_border()  # fills CLASSES
        self._kinds: dict[tuple, Kind] = {}

    def forget(self) -> None:
        """Forget all calls: arrays that they read were replaced."""
        self._kinds = {}

    def replay(self, name: str, args: tuple, more: dict[str, Any]) -> tuple[Any, tuple | None, list]:
        """Repeat a recorded call; return its result, its kind and its arrays. The result may be :data:`MISS`."""
        key, arrays = _kind_of_call(name, args, more)
        kind = self._kinds.get(key) if key is not None else None
        if kind is not None and kind.plans and open_recording() is None and _is_plain():
            with self.turn.lock:
                for plan in kind.plans:
                    found = plan.replay(self.turn, arrays)
                    if found is not MISS:
                        return found, key, arrays
        return MISS, key, arrays

    def run(self, key: tuple | None, arrays: list, call: Callable[[], Any]) -> Any:
        """Return the result of ``call()``; record the second call of a kind."""
        with self.turn.lock:
            plain = open_recording() is None and _is_plain() and not self._device.is_capturing
            if key is None or not arrays or not plain:
                return call()
            kind = self._kinds.get(key)
            if kind is None:
                result = call()
                if len(self._kinds) >= MOST_KINDS:
                    self._kinds.clear()
                self._kinds[key] = Kind()
                return result
            ranges = _ranges(arrays) if kind.tries < MOST_TRIES else None
            return call() if ranges is None else self._record(kind, arrays, ranges, call)

    def _record(self, kind: Kind, arrays: list, ranges: list, call: Callable[[], Any]) -> Any:
        """Record a call and return its result."""
        kind.tries += 1
        with Recording(ranges) as recording:
            result = call()
        build = _builder(result, arrays, [owner for owner, _, _ in recording.results])
        if recording.complete and build is not None and _lie_apart(arrays, ranges, recording.written):
            kind.plans.append(Plan(self._device, arrays, ranges, recording, build))
        return result


def _kind_of_call(name: str, args: tuple, more: dict[str, Any]) -> tuple[tuple | None, list]:
    """Return a key of the calls that pass the same arguments but for the arrays, and the arrays; None: no such key."""
    key: list[Any] = [name, len(args), *more]
    arrays: list[Any] = []
    for value in (*args, *more.values()) if more else args:
        kind = type(value)
        key.append(kind)
        if kind in CLASSES:
            arrays.append(value)
        elif value is not None and not _add(value, kind, key, arrays):
            return None, arrays
    return tuple(key), arrays


def _add(value: Any, kind: type, key: list, arrays: list) -> bool:
    """Add an argument that is no array to the key of a call; return False if it has none."""
    if kind in NUMBERS:
        key.append(value)
        return True
    if kind is dict:
        key.append(tuple(value))
        value = value.values()
    elif not issubclass(kind, tuple | list):
        return False
    key.append(len(value))
    for item in value:
        kind = type(item)
        key.append(kind)
        if kind in CLASSES:
            arrays.append(item)
        elif item is not None and not _add(item, kind, key, arrays):
            return False
    return True


def _is_plain() -> bool:
    """Whether no tape and no capture of launches by Warp wants to know what is launched."""
    runtime: Any = wp._src.context.runtime
    return runtime.tape is None and runtime._apic_capture is None


def _addresses(arrays: list, like: tuple[Like, ...]) -> list[int] | None:
    """Return the addresses of Warp arrays; None if one is not like the recorded one."""
    found = []
    for x, (shape, dtype, device) in zip(arrays, like, strict=True):
        if x.shape != shape or x.dtype is not dtype or x.device is not device or not x.is_contiguous:
            return None
        found.append(x.ptr)
    return found


def _maker(shape: tuple[int, ...], dtype: type, device: wp.Device) -> Callable[[], tuple[wp.array, int]]:
    """Return a function that returns a new Warp array and its address."""

    def make() -> tuple[wp.array, int]:
        array: wp.array = wp.empty(shape, dtype=dtype, device=device)
        return array, array.ptr or 0

    return make


def _ranges(arrays: list) -> list[tuple[int, int]] | None:
    """Return address and size of arrays of one kind; None if they are of several, or one is empty."""
    kind = CLASSES[type(arrays[0])]
    if any(CLASSES[type(x)] != kind for x in arrays):
        return None
    try:
        if kind == TORCH:
            found = [(x.data_ptr(), x.numel() * x.element_size()) for x in arrays]
        else:
            found = [(x.ptr, size_in_bytes(x)) for x in arrays]
    except RuntimeError:  # a tensor without memory
        return None
    return found if all(address and size for address, size in found) else None


def _lie_apart(arrays: list, ranges: list[tuple[int, int]], written: list) -> bool:
    """Whether it is clear by the address which array a kernel was given.

    An array that is read and written in its place has one address in all arguments.
    """
    for i, a in enumerate(ranges):
        for j, b in enumerate(ranges[:i]):
            same = a == b and any(arrays[i] is x or arrays[j] is x for x in written)
            if not same and ranges_overlap(*a, *b):
                return False
    return True


def _builder(result: Any, arrays: list, results: list) -> Builder | None:
    """Return a function that makes the like of ``result`` of other arrays; None if it holds anything else."""
    for i, x in enumerate(results):
        if result is x:
            return lambda arrays, results: results[i]
    for i, x in enumerate(arrays):
        if result is x:
            return lambda arrays, results: arrays[i]
    if result is None:
        return lambda arrays, results: None
    if isinstance(result, dict):
        names = tuple(result)
        return _built_of(result.values(), lambda items: dict(zip(names, items, strict=True)), arrays, results)
    if isinstance(result, tuple):
        make: Any = tuple if type(result) is tuple else type(result)._make  # type: ignore[attr-defined]
        return _built_of(result, make, arrays, results)
    return None


def _built_of(items: Iterable[Any], make: Callable[[list], Any], arrays: list, results: list) -> Builder | None:
    """Return a builder of a container."""
    builders = []
    for item in items:
        build = _builder(item, arrays, results)
        if build is None:
            return None
        builders.append(build)
    return lambda arrays, results: make([build(arrays, results) for build in builders])
