"""Tensors at the border: what :mod:`warp_spo.runtime.arrays` needs to know of a torch tensor."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import torch
import warp as wp
from torch._C import _functorch
from torch.autograd import forward_ad

DTYPES: dict[Any, torch.dtype] = {
    wp.float32: torch.float32,
    wp.float64: torch.float64,
    wp.int32: torch.int32,
    wp.int64: torch.int64,
    wp.uint8: torch.uint8,
    wp.bool: torch.bool,
}

is_grad_enabled = torch.is_grad_enabled
mark_changed = getattr(torch._C, "_increment_version", torch.autograd.graph.increment_version)
"""Says that tensors, a list, are changed. A backward pass that saved one then raises an error."""
_streams: dict[tuple[int, int], wp.Stream] = {}


CLASSES = (torch.Tensor, torch.nn.Parameter)
"""Classes of tensors that are nothing but memory; others may be anything."""


def is_tensor(array: object) -> bool:
    """Whether ``array`` is a torch tensor."""
    return isinstance(array, torch.Tensor)


def has_dtype(tensor: torch.Tensor, dtype: type) -> bool:
    """Whether the tensor holds the Warp scalar type ``dtype``."""
    return tensor.dtype is DTYPES.get(dtype)


def is_on(tensor: torch.Tensor, device: wp.Device) -> bool:
    """Whether the tensor is dense and in the memory of ``device``."""
    return tensor.device == torch_device(device.alias) and is_dense(tensor)


def is_dense(tensor: torch.Tensor) -> bool:
    """Whether the tensor has strides; sparse tensors have none."""
    return tensor.layout is torch.strided


def pointer(call: str, name: str, tensor: torch.Tensor) -> int:
    """Return the address of the tensor's memory, 0 if it has none.

    Raises:
        ValueError: The tensor is wrapped by a transform of torch or has a forward-mode tangent, which the memory does
            not hold.
    """
    try:
        found = tensor.data_ptr()
    except RuntimeError:  # raised for sparse tensors, too
        if _functorch.is_functorch_wrapped_tensor(tensor) or _functorch.is_legacy_batchedtensor(tensor):
            raise ValueError(
                f"{call}: {name} is wrapped by a transform of torch (torch.func, jacobian(vectorize=True), "
                f"is_grads_batched=True), which cannot trace this call; expected a plain tensor; call backward, or the "
                f"_vjp and _jvp methods, on one batch of worlds, or pass vectorize=False"
            ) from None
        return 0
    if forward_ad._current_level >= 0 and forward_ad.unpack_dual(tensor).tangent is not None:
        raise ValueError(
            f"{call}: {name} has a forward-mode tangent; derivatives are not available through this call; use "
            f"backward, or the _jvp methods, or pass torch.autograd.forward_ad.unpack_dual({name}).primal"
        )
    return found


def like(tensors: Sequence[torch.Tensor], exactly: bool = False) -> Any:
    """Return a function of other tensors that returns their addresses.

    It returns None if one differs in class, shape, dtype or device, has strides, no memory of its own, a tangent, or
    needs a gradient. The guards with which torch protects its compiled code look at all of it in one call, and only if
    they object does Python look once more: it does not mind strides of axes with one entry, for example. With
    ``exactly`` the guards alone decide, also that each tensor needs a gradient if its example does; without guards the
    result is None.
    """
    wanted = tuple((x.shape, x.dtype, x.device) for x in tensors)
    first = [next(j for j, other in enumerate(tensors) if other is x) for x in tensors]
    pairs = [(i, j) for i, j in enumerate(first) if i != j]
    places = [i for i, j in enumerate(first) if i == j]  # guards want each tensor once
    guards = _guards([tensors[i] for i in places])

    def same(tensors: Sequence[Any]) -> bool:
        if not pairs:
            return guards.check(*tensors)
        return all(tensors[i] is tensors[j] for i, j in pairs) and guards.check(*[tensors[i] for i in places])

    def find(tensors: Sequence[Any]) -> list[int] | None:
        if forward_ad._current_level >= 0:
            return None
        if guards is not None and same(tensors):
            found = [x.data_ptr() for x in tensors]
            return None if 0 in found else found
        return None if exactly else _addresses(tensors, wanted)

    return None if exactly and guards is None else find


def _guards(tensors: list[torch.Tensor]) -> Any:
    """Return torch's guards of tensors, or None if this torch has none."""
    kind: Any = getattr(getattr(torch._C._dynamo, "guards", None), "TensorGuards", None)
    try:
        shapes, strides = [list(x.shape) for x in tensors], [list(x.stride()) for x in tensors]
        found = kind(*tensors, dynamic_dims_sizes=shapes, dynamic_dims_strides=strides)
        return found if all(map(is_dense, tensors)) and found.check(*tensors) else None
    except (TypeError, RuntimeError):
        return None


def _addresses(tensors: Sequence[Any], wanted: tuple[tuple[Any, Any, Any], ...]) -> list[int] | None:
    found = []
    try:
        for x, (shape, dtype, device) in zip(tensors, wanted, strict=True):
            if type(x) not in CLASSES or x.shape != shape or x.dtype is not dtype or x.device != device:
                return None
            if not x.is_contiguous() or x.is_neg() or (x.requires_grad and torch.is_grad_enabled()):
                return None
            found.append(x.data_ptr())
    except RuntimeError:  # sparse, or wrapped by a transform
        return None
    return found if all(found) else None


def maker(shape: tuple[int, ...], dtype: type, device: wp.Device) -> Callable[[], tuple[torch.Tensor, int]]:
    """Return a function that returns a new tensor and its address.

    Where it can, it asks the allocator of compiled code, which gives memory inside transforms and modes of torch, too.
    The function raises ValueError where torch gives a tensor without memory.
    """
    kind, place = DTYPES[dtype], torch_device(device.alias)
    fast = getattr(getattr(torch._C._dynamo, "guards", None), f"_empty_strided_{place.type}", None)  # as compiled code
    if fast is None or (place.type == "cuda" and torch.cuda.device_count() > 1):
        make: Callable[[], torch.Tensor] = functools.partial(torch.empty, shape, dtype=kind, device=place)
    else:
        make = functools.partial(fast, tuple(shape), torch.empty(shape, device="meta").stride(), kind)

    def make_both() -> tuple[torch.Tensor, int]:
        tensor = make()
        try:
            address = tensor.data_ptr()
        except RuntimeError:
            address = 0
        if not address and tensor.numel():
            raise ValueError(
                f"Dynamics: the result's memory is a {type(tensor).__name__} that a transform or mode of torch wraps; "
                f"expected numbers in memory; call outside of it, or pass out="
            )
        return tensor, address

    return make_both


def device_name(device: torch.device) -> str:
    """Return Warp's name of a device. A CUDA device without a number is torch's current one."""
    return f"cuda:{torch.cuda.current_device()}" if device.type == "cuda" and device.index is None else str(device)


def stream(device: wp.Device) -> wp.Stream:
    """Return torch's current stream of a CUDA device as a Warp stream."""
    index = device.ordinal
    found = _streams.get((index, torch._C._cuda_getCurrentRawStream(index)))
    return _wrapped_stream(device) if found is None else found


def _wrapped_stream(device: wp.Device) -> wp.Stream:
    current = torch.cuda.current_stream(torch_device(device.alias))
    found = wp.stream_from_torch(current)  # keeps torch's stream alive, so its handle is not reused
    _streams[device.ordinal, current.cuda_stream] = found
    return found


@functools.cache
def torch_device(device: str) -> torch.device:
    return torch.device(wp.device_to_torch(device))


def requires_grad(array: object) -> bool:
    """Whether ``array`` is a torch tensor that requires grad."""
    return isinstance(array, torch.Tensor) and array.requires_grad
