"""torch at the border: what :mod:`warp_spo.arrays` asks of tensors. The only file besides env.py that imports torch."""

import functools
from typing import Any

import torch
import warp as wp

_DTYPES: dict[Any, torch.dtype] = {
    wp.float32: torch.float32,
    wp.float64: torch.float64,
    wp.int32: torch.int32,
    wp.int64: torch.int64,
    wp.uint8: torch.uint8,
    wp.bool: torch.bool,
}

is_grad_enabled = torch.is_grad_enabled
mark_changed = torch.autograd.graph.increment_version  # so that a backward pass that saved the tensor notices
_streams: dict[tuple[int, int], wp.Stream] = {}


def is_tensor(array) -> bool:
    return isinstance(array, torch.Tensor)


def has_dtype(tensor: torch.Tensor, dtype: type) -> bool:
    """Whether the tensor holds the Warp scalar type ``dtype``."""
    return tensor.dtype is _DTYPES.get(dtype)


def is_on(tensor: torch.Tensor, device: wp.Device) -> bool:
    """Whether the tensor lies in memory of ``device``."""
    return tensor.device == _device(device.alias) and tensor.layout is torch.strided


def empty(shape: tuple, dtype: type, device: wp.Device) -> torch.Tensor:
    """Return a tensor with undefined content."""
    return torch.empty(shape, dtype=_DTYPES[dtype], device=_device(device.alias))


def device_name(device: torch.device) -> str:
    """Return the name of a device; a CUDA device without a number is torch's current one."""
    return f"cuda:{torch.cuda.current_device()}" if device.type == "cuda" and device.index is None else str(device)


def stream(device: wp.Device) -> wp.Stream:
    """Return torch's current stream of a CUDA device as a Warp stream."""
    current = torch.cuda.current_stream(_device(device.alias))
    key = (device.ordinal, current.cuda_stream)
    if key not in _streams:
        _streams[key] = wp.stream_from_torch(current)  # keeps torch's stream alive, so a handle names one stream
    return _streams[key]


@functools.cache
def _device(device: str) -> torch.device:
    return torch.device(wp.device_to_torch(device))
