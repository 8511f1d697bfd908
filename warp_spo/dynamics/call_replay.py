"""Repeats recorded calls of a Dynamics: the checks that can fail from call to call, and the launches. Nothing else.

The first call of a kind compiles and allocates. The second is recorded: :mod:`.runtime.launches` keeps its device work.
From the third on, arrays are compared with what the recorded call took, their addresses are set in the packed arguments
of the kernels, and the kernels are launched. Two calls are of one kind if they pass the same arguments by the same
names, arrays of the same classes and numbers that are equal. Whatever differs from the recorded call in any other way
is a call as if nothing were recorded, which does it or says what is wrong.

One call runs at a time, see :class:`warp_spo.runtime.call_order.CallOrder`.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import warp as wp

from ..runtime.arrays import CLASSES, TORCH, torch_border
from ..runtime.autograd import call_in_graph, call_with_gradient, is_exported, is_traced, records_gradient
from ..runtime.call_order import CallOrder
from ..runtime.dlpack import settle
from ..runtime.launches import Recording
from ..runtime.launches import recording as open_recording
from ..runtime.memory import ranges_overlap, size_in_bytes

if TYPE_CHECKING:
    from .operation import Operation

Builder = Callable[[Sequence[Any], list], Any]
"""``build(arrays, results)`` returns what a caller gets, of the arrays of the call and those that it made."""
MOST_KINDS, MOST_TRIES = 256, 4  # kinds of calls that are kept; calls of a kind that are recorded
NUMBERS = frozenset((int, float, bool, str))
MISS = object()
"""Returned by :meth:`Replays.replay` if nothing was recorded for the call."""


def dispatch(operation: Operation, dyn: Any, args: tuple, more: dict[str, Any]) -> Any:
    """Return the result of a call of an operation by users.

    In this order: torch traces the call as a node of its graph; a recorded call is repeated, with torch's gradients or
    without; torch's autograd records the call; the method runs.
    """
    graphed = operation.graphed
    if graphed is not None and is_traced():
        return call_in_graph(dyn._handle, *graphed, args, more)
    again = dyn._gradients.latest.get(operation.name)
    if again is not None:
        result = again(args, more)
        if result is not MISS:
            return result
    key, arrays = None, []
    if not dyn.values.tensors or not records_gradient((), dyn.values):
        result, key, arrays = dyn._replays.replay(operation.name, args, more)
        if result is not MISS:
            return result
    if graphed is not None and is_exported():
        return call_in_graph(dyn._handle, *graphed, args, more)
    if operation.derivative is not None and records_gradient((*args, *more.values()), dyn.values):
        names = operation.parameters
        arguments = dict(zip(names, args, strict=False)) | more
        if len(arguments) < len(args) + len(more) or not arguments.keys() <= names.keys():
            operation.signature.bind(dyn, *args, **more)  # raises TypeError
        return call_with_gradient(dyn, operation, arguments, (args, more))
    settle((*args, *more.values()))
    return dyn._replays.run(key, arrays, lambda: operation.function(dyn, *args, **more))


Repeat = Callable[[Sequence[Any]], Any]
"""``repeat(arrays)`` does a recorded call with other arrays; :data:`MISS` if they differ in more than their memory."""


def _repeater(
    device: wp.Device, call_order: CallOrder, arrays: list, ranges: list, recording: Recording, build: Builder
) -> Repeat:
    """Return a function that repeats a recorded call.

    Args:
        arrays: the arrays that it took, in the order of its arguments. ranges: address and size in bytes of each.
        recording: what it did. build: what the caller gets.
    """
    is_torch, is_cuda = CLASSES[type(arrays[0])] == TORCH, device.is_cuda
    find, maker, stream_of = _like(arrays), _maker, _stream
    mark_changed: Any = None
    if is_torch:
        border = torch_border()
        find, maker, stream_of, mark_changed = border.like(arrays), border.maker, border.stream, border.mark_changed
    makers = [maker(shape, dtype, device) for _, shape, dtype in recording.results]
    written = [i for i, x in enumerate(arrays) if any(x is other for other in recording.written)]
    pairs = [(i, j) for i in written for j in range(len(arrays)) if i != j]
    same = [(i, j, arrays[i] is arrays[j]) for i, j in pairs if ranges[i] == ranges[j]]
    apart = [(i, ranges[i][1], j, ranges[j][1]) for i, j in pairs if ranges[i] != ranges[j]]
    count, places = len(arrays), [*map(tuple, recording.places)]
    given_places, made_places = places[:count], places[count:]
    given_shifted = [one for one in recording.shifted if one[0] < count]
    made_shifted = [(i - count, place, shift) for i, place, shift in recording.shifted if i >= count]
    launches = [step.launch for step in recording.steps]
    marks = is_torch and bool(written)
    last: list[int] = []  # addresses of the arrays that the packed arguments hold

    def repeat(arrays: Sequence[Any]) -> Any:
        nonlocal last
        addresses = find(arrays)
        if addresses is None:
            return MISS
        for i, j, identical in same:
            if addresses[i] != addresses[j] or identical != (arrays[i] is arrays[j]):
                return MISS
        if addresses != last:
            for i, size, j, other_size in apart:
                if ranges_overlap(addresses[i], size, addresses[j], other_size):
                    return MISS
            last = addresses
            _set_addresses(addresses, given_places, given_shifted)
        stream = None
        if is_cuda:
            stream = stream_of(device)
            if stream is not call_order.stream:
                call_order.order(stream)
        results = []
        if makers:
            made = []
            for make in makers:
                owner, address = make()
                results.append(owner)
                made.append(address)
            _set_addresses(made, made_places, made_shifted)
        if marks:
            mark_changed([arrays[i] for i in written])
        for launch in launches:
            launch(stream)
        return build(arrays, results)

    return repeat


def _set_addresses(addresses: list[int], places: list[tuple], shifted: list[tuple[int, Any, int]]) -> None:
    """Set the addresses of arrays in packed arguments."""
    for address, holders in zip(addresses, places, strict=True):
        for place in holders:
            place.data = address
    for number, place, shift in shifted:
        place.data = addresses[number] + shift


def _stream(device: wp.Device) -> wp.Stream:
    return device.stream


def as_written(args: tuple, more: dict[str, Any]) -> Callable[[tuple, dict[str, Any]], Any] | None:
    """Return a function that finds the arrays of the next call, if it is written as this one; None if this has lists.

    Most calls are written as the one before. The function returns None for others, and does not look at the arrays.
    """
    values, entries = (*args, *more.values()), 0
    first = next((i for i, value in enumerate(values) if type(value) is tuple), 0)
    if type(values[first]) is tuple:  # such as out=(q, qd)
        entries = len(values[first])
        values = values[:first] + values[first] + values[first + 1 :]
    places = [i for i, value in enumerate(values) if type(value) in CLASSES]
    constants = [(i, value, type(value)) for i, value in enumerate(values) if i not in places]
    if any(value is not None and kind not in NUMBERS for _, value, kind in constants):
        return None
    count, names, whole = len(args), tuple(more), len(places) == len(values)

    def find(args: tuple, more: dict[str, Any]) -> Any:
        if len(args) != count or tuple(more) != names:
            return None
        values = (*args, *more.values())
        if entries:
            inner = values[first]
            if type(inner) is not tuple or len(inner) != entries:
                return None
            values = values[:first] + inner + values[first + 1 :]
        for at, constant, kind in constants:
            value = values[at]
            if value is not constant and (type(value) is not kind or value != constant):
                return None
        return values if whole else [values[i] for i in places]

    return find


@dataclasses.dataclass
class RecordedCalls:
    """Calls of one kind.

    Attributes:
        plans: functions that repeat recorded calls, which differ in the arrays that are written in place.
        tries: calls that were recorded.
    """

    plans: list[Repeat] = dataclasses.field(default_factory=list)
    tries: int = 0


class Replays:
    """The recorded calls of one Dynamics."""

    def __init__(self, device: wp.Device, call_order: CallOrder):
        self._device, self.call_order = device, call_order
        if "torch" in sys.modules:
            torch_border()  # fills CLASSES
        self._kinds: dict[tuple, RecordedCalls] = {}
        self._latest: dict[str, tuple[Any, Repeat]] = {}

    def forget(self) -> None:
        """Forget all calls: arrays that they read were replaced."""
        self._kinds, self._latest = {}, {}

    def replay(self, name: str, args: tuple, more: dict[str, Any]) -> tuple[Any, tuple | None, list]:
        """Repeat a recorded call; return its result, its kind and its arrays. The result may be :data:`MISS`."""
        runtime: Any = wp._src.context.runtime
        if runtime.tape is not None or runtime._apic_capture is not None or open_recording() is not None:
            return MISS, None, []  # who records launches wants to see them
        latest = self._latest.get(name)
        if latest is not None:
            find, repeat = latest
            arrays = find(args, more)
            if arrays is not None:
                with self.call_order.lock:
                    found = repeat(arrays)
                if found is not MISS:
                    return found, None, []
        key, arrays = kind_of_call(name, args, more)
        kind = self._kinds.get(key) if key is not None else None
        for repeat in () if kind is None else kind.plans:
            with self.call_order.lock:
                found = repeat(arrays)
            if found is not MISS:
                find = as_written(args, more)
                if find is not None:
                    self._latest[name] = find, repeat
                return found, key, arrays
        return MISS, key, arrays

    def run(self, key: tuple | None, arrays: list, call: Callable[[], Any], all_taken: bool = True) -> Any:
        """Return the result of ``call()``; record the second call of a kind.

        Args:
            all_taken: an array that the call does not take gives it numbers, such as a tensor for dt. These are not
                seen when the call is repeated, so it is not recorded.
        """
        with self.call_order.lock:
            plain = not self._device.is_capturing
            if key is None or not arrays or not plain:
                return call()
            kind = self._kinds.get(key)
            if kind is None:
                result = call()
                if len(self._kinds) >= MOST_KINDS:
                    self._kinds.clear()
                self._kinds[key] = RecordedCalls()
                return result
            ranges = _ranges(arrays) if kind.tries < MOST_TRIES else None
            return call() if ranges is None else self._record(kind, arrays, ranges, call, all_taken)

    def _record(self, kind: RecordedCalls, arrays: list, ranges: list, call: Callable[[], Any], all_taken: bool) -> Any:
        """Record a call and return its result."""
        kind.tries += 1
        with Recording(ranges) as recording:
            result = call()
        build = _builder(result, arrays, [owner for owner, _, _ in recording.results])
        if all_taken and not all(any(x is other for other in recording.taken) for x in arrays):
            return result
        if recording.complete and build is not None and _lie_apart(arrays, ranges, recording.written):
            kind.plans.append(_repeater(self._device, self.call_order, arrays, ranges, recording, build))
        return result


def kind_of_call(name: str, args: tuple, more: dict[str, Any]) -> tuple[tuple | None, list]:
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


def _like(arrays: Sequence[wp.array]) -> Callable[[Sequence[Any]], list[int] | None]:
    """Return a function of other Warp arrays that returns their addresses, or None if one is not like these."""
    wanted = tuple((x.shape, x.dtype, x.device) for x in arrays)

    def find(arrays: Sequence[Any]) -> list[int] | None:
        found = []
        for x, (shape, dtype, device) in zip(arrays, wanted, strict=True):
            if type(x) is not wp.array or x.shape != shape or x.dtype is not dtype:
                return None
            if x.device is not device or not x.is_contiguous:
                return None
            found.append(x.ptr)
        return found

    return find


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
        return _container_builder(result.values(), lambda items: dict(zip(names, items, strict=True)), arrays, results)
    if isinstance(result, tuple):
        make: Any = tuple if type(result) is tuple else type(result)._make  # type: ignore[attr-defined]
        return _container_builder(result, make, arrays, results)
    return None


def _container_builder(
    items: Iterable[Any], make: Callable[[list], Any], arrays: list, results: list
) -> Builder | None:
    """Return a function that builds a container of ``items`` again; None where one of them cannot be."""
    builders = []
    for item in items:
        build = _builder(item, arrays, results)
        if build is None:
            return None
        builders.append(build)
    return lambda arrays, results: make([build(arrays, results) for build in builders])
