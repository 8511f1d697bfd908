"""Tensors at the border: what :mod:`warp_spo.arrays` needs to know of a torch tensor."""

import functools
from collections.abc import Callable
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
mark_changed = torch.autograd.graph.increment_version  # a backward pass that saved the tensor then raises an error
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


def addresses(tensors: list[torch.Tensor], like: tuple[tuple[Any, Any, Any], ...]) -> list[int] | None:
    """Return the addresses of tensors; None if one is not (shape, dtype, device), or no plain contiguous memory."""
    if forward_ad._current_level >= 0:
        return None
    found = []
    try:
        for x, (shape, dtype, device) in zip(tensors, like, strict=True):
            address = x.data_ptr()
            if x.shape != shape or x.dtype is not dtype or x.device != device or not x.is_contiguous() or x.is_neg():
                return None
            if not address or (x.requires_grad and torch.is_grad_enabled()):
                return None
            found.append(address)
    except RuntimeError:  # sparse, or wrapped by a transform
        return None
    return found


def maker(shape: tuple[int, ...], dtype: type, device: wp.Device) -> Callable[[], tuple[torch.Tensor, int]]:
    """Return a function that returns a new tensor and its address."""
    found, place = DTYPES[dtype], torch_device(device.alias)

    def make() -> tuple[torch.Tensor, int]:
        tensor = torch.empty(shape, dtype=found, device=place)
        return tensor, tensor.data_ptr()

    return make


def empty(shape: tuple, dtype: type, device: wp.Device) -> torch.Tensor:
    """Return a tensor with undefined content."""
    return torch.empty(shape, dtype=DTYPES[dtype], device=torch_device(device.alias))


def device_name(device: torch.device) -> str:
    """Return Warp's name of a device. A CUDA device without a number is torch's current one."""
    return f"cuda:{torch.cuda.current_device()}" if device.type == "cuda" and device.index is None else str(device)


def stream(device: wp.Device) -> wp.Stream:
    """Return torch's current stream of a CUDA device as a Warp stream."""
    index = device.ordinal
    found = _streams.get((index, torch._C._cuda_getCurrentRawStream(index)))
    if found is None:
        current = torch.cuda.current_stream(torch_device(device.alias))
        found = wp.stream_from_torch(current)  # keeps torch's stream alive, so its handle is not reused
        _streams[index, current.cuda_stream] = found
    return found


@functools.cache
def torch_device(device: str) -> torch.device:
    return torch.device(wp.device_to_torch(device))


def requires_grad(array: object) -> bool:
    """Whether ``array`` is a torch tensor that requires grad."""
    return isinstance(array, torch.Tensor) and array.requires_grad
