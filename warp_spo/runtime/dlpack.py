"""Arrays of other libraries at the border, through DLPack: JAX, CuPy, and all whose arrays have ``__dlpack__``.

Nothing is copied: kernels read and write the library's memory. On CUDA, a call with CuPy arrays runs on CuPy's current
stream. Other libraries do not tell their stream, so a call with their arrays waits until its kernels have run.
"""

from __future__ import annotations

import functools
import importlib
import sys
from collections.abc import Iterable
from typing import Any

import numpy as np
import warp as wp

HOST, CUDA, PINNED, MANAGED = 1, 2, 3, 13  # DLPack's numbers of kinds of memory
NAMES = {"jax": ("JAX", "jax.numpy"), "jaxlib": ("JAX", "jax.numpy"), "cupy": ("CuPy", "cupy")}

_streams: dict[tuple[str, int], tuple[wp.Stream, Any]] = {}


class Library(str):
    """The kind of an array of another library: the library's name, as users write it.

    Attributes:
        module: name of the module that has ``from_dlpack``.
    """

    module: str

    @property
    def is_immutable(self) -> bool:
        """Whether nobody may write the library's arrays."""
        return self == "JAX"

    @property
    def has_stream(self) -> bool:
        """Whether a call can run on the library's own stream."""
        return self == "CuPy"


def library_of(array: object) -> Library | None:
    """Return the library of an array that has ``__dlpack__``; None of any other object."""
    kind: Any = type(array)
    return _library(kind) if hasattr(array, "__dlpack__") and hasattr(array, "__dlpack_device__") else None


@functools.cache
def _library(kind: Any) -> Library:
    root = kind.__module__.partition(".")[0]
    name, module = NAMES.get(root, (root, root))
    found = Library(name)
    found.module = module
    return found


def is_traced(array: object) -> bool:
    """Whether ``array`` stands for numbers that JAX will know later, inside ``jit``, ``grad`` or ``vmap``."""
    return "jax" in sys.modules and isinstance(array, sys.modules["jax"].core.Tracer)


def settle(arguments: Iterable[Any]) -> None:
    """Wait until JAX has computed the arrays among some arguments.

    A caller does so before it waits for other calls (:mod:`.call_order`). JAX computes in threads of its own,
    and what it has not computed yet may be a call of ours that waits for the same lock.
    """
    if "jax" in sys.modules:
        kind = sys.modules["jax"].Array
        for array in arguments:
            if isinstance(array, kind) and not is_traced(array) and not array.is_deleted():
                array.block_until_ready()


def device_of(array: Any) -> str:
    """Return Warp's name of the device whose memory an array is in.

    Raises:
        Exception: what the library raises for an array that it cannot hand over.
    """
    place, number = map(int, array.__dlpack_device__())
    if place in (HOST, PINNED):
        return "cpu"
    return f"cuda:{number}" if place in (CUDA, MANAGED) else f"DLPack's device {place}:{number}"


def read(call: str, name: str, array: Any, library: Library, device: wp.Device, change: bool) -> wp.array | None:
    """Return a Warp array over the memory of an array, None if that is not memory of ``device``.

    The library's pending work on the array comes before Warp's current stream.

    Args:
        call, name: names of the call and of its argument, for errors.
        array: the caller's array, of ``library``.
        device: where the kernels run.
        change: whether the call writes the array.

    Raises:
        ValueError: the call may not write the array, or the library cannot hand it over.
    """
    if change and library.is_immutable:
        raise ValueError(
            f"{call}: {name} is a {library} array, which nobody can write; expected an array that the call can write; "
            f"leave out= away to get a new {library} array; for other arguments pass a NumPy, Warp or torch array"
        )
    try:
        if getattr(array, "is_deleted", bool)():
            raise ValueError("the array was deleted or donated")
        if device_of(array) != device.alias:
            return None
        if device.is_cuda:
            found: Any = wp.from_dlpack(array)
            return found
        host = np.from_dlpack(array)  # tells also whether somebody may write it
        strides = None if host.flags.c_contiguous else host.strides
        memory: dict[str, Any] = {"ptr": host.ctypes.data, "shape": host.shape, "strides": strides}
        found = wp.array(**memory, dtype=wp.dtype_from_numpy(host.dtype), device=device)
    except Exception as error:
        raise ValueError(
            f"{call}: {name} is a {library} array that DLPack cannot hand over ({type(error).__name__}: {error}); "
            f"expected one whole array of numbers in the memory of {device}; pass a copy of it"
        ) from error
    if change and not host.flags.writeable:
        raise ValueError(
            f"{call}: {name} is a read-only {library} array; expected one that can be written; pass a copy"
        )
    found._ref = host  # keeps the memory
    return found


def new(call: str, library: Library, shape: tuple, dtype: type, device: wp.Device) -> tuple[Any, wp.array]:
    """Return (the library's array, None if :func:`share` will make it; Warp array) of undefined content.

    Raises:
        TypeError: the library cannot take arrays. ValueError: it would round them.
    """
    module: Any = importlib.import_module(library.module)
    if library == "JAX" and dtype is wp.float64 and not sys.modules["jax"].config.jax_enable_x64:
        raise ValueError(
            f"{call}: the result is float64, which JAX would make float32, because its float64 is turned off; expected "
            f"it on; call jax.config.update('jax_enable_x64', True) at the start of the program"
        )
    if library.has_stream and device.is_cuda:  # the memory is freed in the order of the library's stream
        with module.cuda.Device(device.ordinal):
            owner = module.empty(shape, dtype=wp.dtype_to_numpy(dtype))
        return owner, wp.array(ptr=owner.data.ptr, shape=shape, dtype=dtype, device=device)
    if not hasattr(module, "from_dlpack"):
        raise TypeError(
            f"{call}: the first array is of {library}, and the module {library.module} has no from_dlpack; expected a "
            f"library that can take the result; pass a torch tensor, a Warp array or a NumPy array first, or out="
        )
    return None, wp.empty(shape, dtype=dtype, device=device)


def share(array: Any, library: Library) -> Any:
    """Return a Warp array as an array of another library, which has the same memory and keeps it."""
    module: Any = sys.modules[library.module]
    return module.from_dlpack(array.numpy() if array.device.is_cpu else array)


def stream(device: wp.Device) -> wp.Stream:
    """Return CuPy's current stream of a CUDA device as a Warp stream."""
    cupy: Any = sys.modules["cupy"]
    with cupy.cuda.Device(device.ordinal):
        current = cupy.cuda.get_current_stream()
    key = device.alias, current.ptr
    if key not in _streams:
        _streams[key] = wp.Stream(device, cuda_stream=current.ptr), current  # kept, so that its handle is not reused
    return _streams[key][0]
