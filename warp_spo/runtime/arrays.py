"""Checks and converts the arrays of every public call: :class:`Call`.

The caller's arrays are torch tensors, Warp arrays, NumPy arrays or arrays of a library that speaks DLPack, such as JAX
and CuPy, ``[world, ...]`` and C-contiguous. Kernels read and write them in place, so they must have the object's dtype
and device; nothing is copied silently. NumPy arrays alone are cast and copied. The kind of the first array is the kind
of the result.

:data:`ArrayT` says so to editors and type checkers: ``def f(self, q: ArrayT, out: ArrayT | None = None) -> ArrayT``
returns a ``torch.Tensor`` for a ``torch.Tensor`` (or a ``torch.nn.Parameter``), a ``wp.array`` for a ``wp.array``, a
``np.ndarray`` for a ``np.ndarray``, and a ``jax.Array`` for a ``jax.Array``. An argument that may be of another kind
than the result is an :data:`AnyArray`. Neither imports torch or JAX at run time.
"""

import functools
import sys
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar, Union

import numpy as np
import warp as wp

from ..errors import refuse_masked
from . import dlpack, launches
from .call_order import CallOrder
from .memory import is_same, overlap, view

if TYPE_CHECKING:
    import jax
    import torch

ArrayT = TypeVar("ArrayT", "torch.Tensor", "wp.array[Any, Any]", "np.ndarray[Any, Any]", "jax.Array")
AnyArray = Union["torch.Tensor", "wp.array[Any, Any]", "np.ndarray[Any, Any]", "jax.Array"]
NUMPY, WARP, TORCH = "NumPy", "Warp", "torch"
CLASSES: dict[type, str] = {wp.array: WARP}
"""Kinds by class of array, of arrays that lie in a device's memory; torch's join when the first tensor comes."""
_DTYPES = {"float32": wp.float32, "float64": wp.float64}


def parse_dtype(dtype: Any, call: str = "dtype") -> type:
    """Return ``wp.float32`` or ``wp.float64`` for the name or the NumPy, Warp or torch type of that name.

    Raises:
        ValueError: The type is another one. Python's ``float`` is refused too, because it is float32 for Warp and
            float64 for NumPy.
    """
    name = getattr(dtype, "__name__", None) or str(dtype).removeprefix("torch.")
    if name not in _DTYPES:
        raise ValueError(
            f'{call}: dtype is {dtype!r}; expected "float32" or "float64", or the type of that name of Warp, NumPy or '
            f"torch"
        )
    return _DTYPES[name]


def parse_device(device: Any = None, call: str = "device") -> wp.Device:
    """Return the Warp device for a name, a Warp device or a torch device. None is Warp's current device.

    Raises:
        ValueError: This machine has no such device.
    """
    try:
        if device is not None and type(device).__module__ == "torch":
            return wp.get_device(torch_border().device_name(device))
        return wp.get_device(device)
    except (TypeError, ValueError, RuntimeError, AssertionError):  # AssertionError comes from a torch without CUDA
        known = ", ".join(repr(known.alias) for known in wp.get_devices())
        raise ValueError(f"{call}: device is {device!r}; expected one of this machine's devices: {known}") from None


def kind_of(array: object, call: str, name: str) -> str:
    """Return ``NUMPY``, ``WARP`` or ``TORCH``, or the :class:`warp_spo.runtime.dlpack.Library` of another array.

    Raises:
        TypeError: ``array`` is no array, it is a NumPy masked array, or JAX traces it.
    """
    if isinstance(array, wp.array):
        return WARP
    if isinstance(array, np.ndarray):
        refuse_masked(call, name, array)
        return NUMPY
    if "torch" in sys.modules and torch_border().is_tensor(array):
        return TORCH
    if dlpack.is_traced(array):
        owner, _, method = call.rpartition(".")
        way = f"call warp_spo.jax.function(dyn, {method!r}) there"
        if owner != "Dynamics":
            way = f"call {call} outside of JAX's functions"
        if call == "Dynamics.set":
            way = f"set values outside of JAX's functions, or build Dynamics with variable=({name!r},) and give them "
            way += f"to a warp_spo.jax.function(dyn, ..., values=({name!r},)), which has gradients by them"
        raise TypeError(
            f"{call}: {name} is traced by JAX (jit, grad or vmap), so it holds no numbers yet; expected an array with "
            f"numbers; {way}"
        )
    library = dlpack.library_of(array)
    if library is None:
        raise TypeError(
            f"{call}: {name} is of type {type(array).__name__}; expected a torch tensor, a Warp array, a NumPy array, "
            f"or an array with __dlpack__; wrap numbers in numpy.array(...)"
        )
    return library


def device_of(array: Any, kind: str) -> Any:
    """Return the device of an array of this kind, not NumPy's, as :func:`parse_device` takes it."""
    return dlpack.device_of(array) if isinstance(kind, dlpack.Library) else array.device


def shape_of(array: Any) -> tuple[int, ...]:
    """Return the shape counted in scalars: the entries of Warp's vectors, matrices and transforms are trailing axes."""
    return tuple(array.shape) + tuple(getattr(array.dtype, "_shape_", ()) if isinstance(array, wp.array) else ())


class Call:
    """Checks the arrays of one public call, and returns its result in the kind of the caller's arrays.

    ::

        with Call("Dynamics.forward_dynamics", device, dtype) as call:
            q = call.read("q", q, (worlds, nq), "[world, coordinate]")
            qdd = call.write(out, (worlds, nv), "[world, dof]")
            wp.launch(...)
        return call.result

    If any array is a torch tensor on CUDA, Warp's current stream of the device is torch's inside the block. With torch
    and Warp arrays and with ``out``, the call allocates, copies and waits for nothing. NumPy results, and NumPy arrays
    passed to :meth:`update`, are filled when the block ends.

    Args:
        name: Name of the call, for errors.
        device: The device on which the kernels run.
        dtype: ``wp.float32`` or ``wp.float64``.
        kind: Kind of the result if the call reads no array.
        call_order: The order of calls in which this call has to wait.

    Attributes:
        result: The array of :meth:`write` in the caller's kind, or a tuple of them if :meth:`write` was called more
            than once. It is set when the block ends without an exception.
    """

    __slots__ = (
        "_call_order",
        "_inputs",
        "_outputs",
        "_results",
        "_saved_stream",
        "_staged",
        "_waits",
        "device",
        "dtype",
        "kind",
        "name",
        "result",
    )

    def __init__(
        self, name: str, device: wp.Device, dtype: type, kind: str | None = None, call_order: CallOrder | None = None
    ):
        self.name = name
        self._call_order = call_order
        self.device = device
        self.dtype = dtype
        self.kind = kind
        self.result: Any = None
        self._inputs: list[tuple] = []  # (name, caller's array, Warp array)
        self._outputs: list[tuple] = []
        self._results: list[tuple] = []  # (caller's array or None, Warp array)
        self._staged: list[tuple] = []  # (NumPy array to fill, Warp array)
        self._saved_stream: wp.Stream | None = None
        self._waits = False  # for kernels that a library does not know of

    def __enter__(self) -> "Call":
        if self._call_order is not None:
            self._call_order.lock.acquire()
        return self

    def order(self) -> None:
        """Let the current stream wait for the call before. Kernels are launched after it; :meth:`write` does it too."""
        if self._call_order is not None and self.device.is_cuda:
            self._call_order.order(self.device.stream)

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
        try:
            if error is None:
                self._finish()
        finally:
            if self._saved_stream is not None:
                wp.set_stream(self._saved_stream, self.device, sync=False)
            if self._call_order is not None:
                self._call_order.lock.release()

    def read(
        self, name: str, array: Any, shape: tuple, meaning: str = "", *, dtype: Any = None, optional: bool = False
    ) -> Any:
        """Return an input as a Warp array of scalars on the device. None stays None if ``optional``.

        Args:
            name: Name of the argument, for errors.
            array: The caller's array.
            shape: Expected shape; -1 matches any size.
            meaning: The axes in words, such as ``"[world, dof]"``.
            dtype: Expected scalar type; None is the call's dtype.
            optional: Whether ``array`` may be None.

        Raises:
            TypeError: ``array`` is not an array.
            ValueError: The array has another shape, dtype or device, is not contiguous, requires grad, or overlaps an
                output.
        """
        if array is None and optional:
            return None
        warp_array = self._as_warp(name, array, shape, meaning, dtype or self.dtype)
        self._check_apart(name, array, warp_array, self._outputs)
        self._inputs.append((name, array, warp_array))
        return warp_array

    def update(
        self, name: str, array: Any, shape: tuple, meaning: str = "", *, dtype: Any = None, optional: bool = True
    ) -> Any:
        """Return an array that the call changes in place. Arguments and errors are those of :meth:`read`."""
        if array is None and optional:
            return None
        warp_array = self._as_warp(name, array, shape, meaning, dtype or self.dtype, change=True)
        self._add_output(name, array, warp_array)
        if isinstance(array, np.ndarray):
            self._staged.append((array, warp_array))
        return warp_array

    def write(
        self, out: Any, shape: tuple, meaning: str = "", *, name: str = "out", dtype: Any = None, over: str = ""
    ) -> wp.array:
        """Return the Warp array for a result, of undefined content: that of ``out``, or a new one if ``out`` is None.

        A new one has the kind of the first array of the call. ``out`` must not overlap an input, but it may be the very
        array that was read under the name ``over``.

        Raises:
            TypeError: ``out`` is of another kind than the first array.
            ValueError: As :meth:`read`.
        """
        dtype = dtype or self.dtype
        if out is None:
            out, warp_array = self._new(tuple(shape), dtype)
        else:
            kind = kind_of(out, self.name, name)
            if self.kind is not None and kind != self.kind:
                raise TypeError(
                    f"{self.name}: {name} is {_describe(out, kind)}; expected a {self.kind} array, the kind of "
                    f"the first array of the call; pass {name} in that kind"
                )
            if kind == NUMPY:
                self._check(name, out, kind, out.shape, shape, meaning, dtype, out.dtype.name == dtype.__name__)
                warp_array = wp.empty(tuple(shape), dtype=dtype, device=self.device)
                self._check_writeable(name, out)
                self._staged.append((out, warp_array))
            else:
                warp_array = self._as_warp(name, out, shape, meaning, dtype, change=True)
            self._add_output(name, out, warp_array, over)
        self._results.append((out, warp_array))
        self.order()
        return warp_array

    def _new(self, shape: tuple, dtype: type) -> tuple[Any, wp.array]:
        """Return (the caller's new array, None for NumPy; its Warp array)."""
        if isinstance(self.kind, dlpack.Library):
            return dlpack.new(self.name, self.kind, shape, dtype, self.device)
        if self.kind == TORCH and self.device.is_cuda:
            self._enter_stream()
        owner, array = new(self.kind, shape, dtype, self.device)
        if (recording := launches.recording()) is not None:
            recording.add_result(owner, array, shape, dtype)
        return (None if self.kind in (None, NUMPY) else owner), array

    def _as_warp(self, name: str, array: Any, shape: tuple, meaning: str, dtype: Any, change: bool = False) -> wp.array:
        """Return a Warp array of scalars over the caller's memory, or over a copy of a NumPy array."""
        kind = kind_of(array, self.name, name)
        if (recording := launches.recording()) is not None:
            recording.taken.append(array)
        if self.kind is None:
            self.kind = kind
        if kind == NUMPY:
            return self._copy_numpy(name, array, shape, meaning, dtype, change)
        if kind == WARP:
            came = array.shape
            same = array.dtype is dtype
            if not same and getattr(array.dtype, "_wp_scalar_type_", None) is dtype:
                # the entries of vectors and transforms become trailing axes
                came = came + array.dtype._shape_
                same = True
            self._check(name, array, kind, came, shape, meaning, dtype, same)
            if array.device != self.device or not array.is_contiguous:
                self._refuse_place(name, array, kind, array.is_contiguous, change)
            if array.requires_grad and getattr(wp._src.context.runtime, "tape", None) is not None:
                self._refuse_grad(name, "is recorded by wp.Tape", "leave the tape's block")
            return array if array.dtype is dtype else view(array.ptr, came, dtype, self.device.alias)
        if isinstance(kind, dlpack.Library):
            if self.device.is_cuda:
                self._order(name, kind)
            came = dlpack.read(self.name, name, array, kind, self.device, change)
            if came is None or not came.is_contiguous:
                self._refuse_place(name, array, kind, came is None, change)
            self._check(name, array, kind, came.shape, shape, meaning, dtype, came.dtype is dtype)
            return came
        torch = torch_border()
        pointer = torch.pointer(self.name, name, array)
        self._check(name, array, kind, array.shape, shape, meaning, dtype, torch.has_dtype(array, dtype))
        if not torch.is_on(array, self.device) or not array.is_contiguous():
            self._refuse_place(name, array, kind, array.is_contiguous(), change)
        if not pointer and array.numel():
            raise ValueError(
                f"{self.name}: {name} holds no memory; expected numbers in memory; if it is a lazy zero tensor, pass "
                f"{name}.clone()"
            )
        if array.is_neg():  # the memory holds the numbers with the opposite sign
            raise ValueError(
                f"{self.name}: {name} is a lazy negative view; expected a plain tensor; pass {name}.resolve_neg()"
            )
        if array.requires_grad and torch.is_grad_enabled():
            self._refuse_grad(name, "requires grad", f"pass {name}.detach(), or call inside torch.no_grad()")
        if self.device.is_cuda:
            self._enter_stream()
        if change:
            torch.mark_changed([array])
        return view(pointer, tuple(array.shape), dtype, self.device.alias)

    def _order(self, name: str, kind: dlpack.Library) -> None:
        """Make the library's stream Warp's until the block ends; or else wait for the kernels when the block ends."""
        if kind.has_stream and self._saved_stream is None:
            self._enter_stream(dlpack.stream(self.device))
        elif not kind.has_stream or self.device.stream.cuda_stream != dlpack.stream(self.device).cuda_stream:
            self._waits = True
            if self.device.is_capturing:
                raise ValueError(
                    f"{self.name}: {name} is a {kind} array inside a graph capture; expected Warp arrays, or tensors "
                    f"of one library; pass warp.from_dlpack({name}), made before the capture"
                )

    def _copy_numpy(
        self, name: str, array: np.ndarray, shape: tuple, meaning: str, dtype: Any, change: bool
    ) -> wp.array:
        kinds = {wp.float32: "biuf", wp.float64: "biuf", wp.bool: "b"}.get(dtype, "iu")
        fits = array.dtype.name == dtype.__name__ if change else array.dtype.kind in kinds
        self._check(name, array, NUMPY, array.shape, shape, meaning, dtype, fits)
        if change:
            self._check_writeable(name, array)
        if self.device.is_capturing:
            raise ValueError(
                f"{self.name}: {name} is {_describe(array, NUMPY)} inside a graph capture; expected an array on "
                f"{self.device}; copy it there before the capture"
            )
        host = np.array(array, dtype=wp.dtype_to_numpy(dtype), order="C", ndmin=1)
        staged: wp.array | None = wp.array(host, dtype=dtype, device="cpu", copy=False) if host.size else None
        if staged is None or self.device.is_cpu:
            return staged if staged is not None else wp.empty(array.shape, dtype=dtype, device=self.device)
        warp_array = wp.empty(array.shape, dtype=dtype, device=self.device)
        wp.copy(warp_array, staged)  # on the current stream; wp.array(host, device=...) would use the null stream
        return warp_array

    def _check(
        self, name: str, array: Any, kind: str, came: Any, shape: tuple, meaning: str, dtype: Any, dtype_fits: bool
    ) -> None:
        """Raise ValueError unless the shape that ``came`` is ``shape``, and the dtype fits."""
        if came == shape or (len(came) == len(shape) and all(e in (-1, c) for c, e in zip(came, shape, strict=True))):
            if dtype_fits:
                return
            way = f"convert it to {dtype.__name__}"
            if dtype is self.dtype and _dtype_name(array) in _DTYPES:
                way += f", or build the object with dtype={_dtype_name(array)!r}"
            if kind == "JAX" and dtype is wp.float64:
                way += "; in JAX that takes jax.config.update('jax_enable_x64', True)"
        else:
            way = _way_to_shape(name, kind, came, shape, meaning)
        sizes = ", ".join("any" if size == -1 else str(size) for size in shape) + ("," if len(shape) == 1 else "")
        expected, found = f"{dtype.__name__} ({sizes}) {meaning}".rstrip(), _describe(array, kind)
        if kind == NUMPY and dtype_fits:  # it is cast, so that its dtype does not matter
            expected, found = f"({sizes}) {meaning}".rstrip(), f"a {kind} array {tuple(array.shape)}"
        raise ValueError(f"{self.name}: {name} is {found}; expected {expected}; {way}")

    def _refuse_place(self, name: str, array: Any, kind: str, contiguous: bool, change: bool) -> NoReturn:
        if kind == TORCH and not torch_border().is_dense(array):
            raise ValueError(
                f"{self.name}: {name} is {_describe(array, kind)}, {array.layout}; expected a dense one; "
                f"pass {name}.to_dense()"
            )
        if contiguous:
            place = str(device_of(array, kind))
            way = f"move it there, or build the object with device={place!r}"
            if place == "meta":
                way = f"pass a tensor that holds numbers, as torch.zeros_like({name}, device={self.device.alias!r})"
            raise ValueError(f"{self.name}: {name} is {_describe(array, kind)}; expected it on {self.device}; {way}")
        way = f"pass {name}.contiguous()" if kind in (TORCH, WARP) else "pass a contiguous copy"
        if change:
            way = f"pass a contiguous array, then copy it into {name}: {name}.contiguous() is not {name}"
        raise ValueError(
            f"{self.name}: {name} is {_describe(array, kind)} with strides; expected a C-contiguous array; {way}"
        )

    def _refuse_grad(self, name: str, what: str, way_out: str) -> NoReturn:
        raise ValueError(f"{self.name}: {name} {what}; derivatives are not available through this call; {way_out}")

    def _check_writeable(self, name: str, array: np.ndarray) -> None:
        if not array.flags.writeable:
            raise ValueError(
                f"{self.name}: {name} is a read-only NumPy array; expected one that can be written; pass a copy"
            )
        extents = zip(array.strides, array.shape, strict=True)
        if array.size and any(stride == 0 and size > 1 for stride, size in extents):
            raise ValueError(
                f"{self.name}: {name} is a NumPy array with strides {array.strides}, whose entries share memory; "
                f"expected one entry for each number of the result; pass a fresh array"
            )

    def _add_output(self, name: str, array: Any, warp_array: wp.array, over: str = "") -> None:
        same = [one for one in self._inputs if one[0] == over and is_same(array, warp_array, *one[1:])]
        self._check_apart(name, array, warp_array, [other for other in self._inputs if other not in same])
        self._check_apart(name, array, warp_array, self._outputs)
        self._outputs.append((name, array, warp_array))
        if (recording := launches.recording()) is not None:
            recording.written.append(array)

    def _check_apart(self, name: str, array: Any, warp_array: wp.array, others: list[tuple]) -> None:
        """Raise ValueError if the memory of an array overlaps that of ``others``."""
        for other_name, *other in others:
            if overlap(array, warp_array, *other):
                raise ValueError(
                    f"{self.name}: {name} overlaps {other_name} in memory; expected memory that is apart from that of "
                    f"every other array, because the call writes it; pass a fresh array for one of them"
                )

    def _enter_stream(self, wanted: wp.Stream | None = None) -> None:
        """Make ``wanted``, by default torch's current stream, Warp's, until the block ends."""
        if self._saved_stream is None:
            current = self.device.stream
            wanted = wanted or torch_border().stream(self.device)
            self._saved_stream = current
            if wanted.cuda_stream != current.cuda_stream:
                # Copies of this call's NumPy arrays may still run on the other stream. Without NumPy arrays nothing may
                # wait, because waiting for a stream outside of a graph capture would end the capture.
                numpy_came = any(isinstance(array, np.ndarray) for _, array, _ in self._inputs + self._outputs)
                wp.set_stream(wanted, self.device, sync=numpy_came)

    def _finish(self) -> None:
        """Fill NumPy arrays and set the result."""
        numpy_came = any(isinstance(array, np.ndarray) for _, array, _ in self._inputs)
        if self.device.is_cuda and (numpy_came or self._waits or self._staged or self.kind in (None, NUMPY)):
            wp.synchronize_stream(self.device.stream)  # copies made here are freed without regard to streams
        for array, warp_array in self._staged:
            array[...] = warp_array.numpy()
        results = tuple(self._to_kind_of_result(made) if out is None else out for out, made in self._results)
        self.result = results[0] if len(results) == 1 else results or None

    def _to_kind_of_result(self, array: wp.array) -> Any:
        """Return a result that the call made, in its kind."""
        return dlpack.share(array, self.kind) if isinstance(self.kind, dlpack.Library) else array.numpy()


def new(kind: str | None, shape: tuple, dtype: type, device: wp.Device) -> tuple:
    """Return (owner, Warp array) of undefined content. The memory is freed with the owner.

    For torch the owner is a tensor, so that torch reuses the memory in the order of the stream that used it.
    """
    if kind == TORCH:
        tensor, address = torch_border().maker(shape, dtype, device)()
        return tensor, view(address, shape, dtype, device.alias)
    array = wp.empty(shape, dtype=dtype, device=device)
    return array, array


def _way_to_shape(name: str, kind: str, came: Any, shape: tuple, meaning: str) -> str:
    """Return what the caller can do about an array of the shape that ``came`` in place of ``shape``, in words."""
    inner = shape[1:]
    if meaning == "[world, actuator]" and shape[-1] == 0:
        return f"the scene has no actuators: leave {name} out; drives follow target_q and target_qd"
    repeats = len(came) <= len(shape) and all(
        c in (1, e) for c, e in zip(reversed(came), reversed(shape), strict=False)
    )
    if meaning.startswith("[world, ...]") and shape and repeats and came[-1:] != shape[-1:]:
        of = "contact points and pairs" if name.startswith("contact_") else "entries along the last axis"
        return f"give one number for each of the {shape[-1]} {of}: repeat it"
    of_one_world = len(came) == len(inner) and all(e in (-1, c) for c, e in zip(came, inner, strict=True))
    if not of_one_world or not inner or not meaning.startswith("[world"):
        return f"reshape {name}, or build the object for this size"
    if shape[0] == 1:
        return f"pass {name}.reshape({(1, *came)})" if kind == WARP else f"pass {name}[None]"
    count = "one for each world" if shape[0] < 0 else f"{shape[0]} of them"
    return f"it has the shape of one world; stack {count} along a first axis"


def _dtype_name(array: Any) -> str:
    return getattr(array.dtype, "__name__", None) or str(array.dtype).removeprefix("torch.")


def _describe(array: Any, kind: str) -> str:
    place = "" if kind == NUMPY else f" on {device_of(array, kind)}"
    return f"a {kind} array {_dtype_name(array)} {tuple(array.shape)}{place}"


@functools.cache
def torch_border() -> Any:
    """Return the module :mod:`.torch_tensors`."""
    from . import torch_tensors  # imports torch, which the caller has imported

    CLASSES.update(dict.fromkeys(torch_tensors.CLASSES, TORCH))
    return torch_tensors
