"""torch tensors in and out: :class:`Module` and :func:`custom_op`.

Only this package, and the environments, import torch. The rest of ``warp_spo`` reaches it through
:mod:`warp_spo.runtime.arrays` and :mod:`warp_spo.runtime.autograd`, and only if the caller has imported torch.
"""

from ..runtime.torch_tensors import (
    CLASSES,
    device_name,
    has_dtype,
    is_dense,
    is_grad_enabled,
    is_on,
    is_tensor,
    like,
    maker,
    mark_changed,
    pointer,
    requires_grad,
    stream,
)
from .autograd import call_with_gradient
from .compiled import call_in_graph, custom_op
from .module import Module

__all__ = [
    "CLASSES",
    "Module",
    "call_in_graph",
    "call_with_gradient",
    "custom_op",
    "device_name",
    "has_dtype",
    "is_dense",
    "is_grad_enabled",
    "is_on",
    "is_tensor",
    "like",
    "maker",
    "mark_changed",
    "pointer",
    "requires_grad",
    "stream",
]
