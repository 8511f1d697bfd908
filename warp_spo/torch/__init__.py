"""Operations inside torch's autograd and compiler: :class:`Module` and :func:`custom_op`.

Tensors in and out are the work of :mod:`warp_spo.runtime.torch_tensors`. Only that file, this package and environments
import torch, and only if the caller has imported it.
"""

from .autograd import call_with_gradient
from .compiled import call_in_graph, custom_op
from .module import Module

__all__ = ["Module", "call_in_graph", "call_with_gradient", "custom_op"]
