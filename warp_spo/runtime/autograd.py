"""Which calls torch's autograd records. torch is used only if the caller has imported it."""

import itertools
import sys
import weakref
from typing import Any

from .arrays import torch_border


class TensorValues:
    """The values of a scene that were set to torch tensors which require grad.

    Attributes:
        tensors: These tensors by the value's name.
        stamps: A number for each value that was ever set. It changes whenever the value is set to another tensor, or to
            the same tensor after an in-place change.
    """

    def __init__(self) -> None:
        self.tensors: dict[str, Any] = {}
        self.stamps: dict[str, int] = {}
        self._versions: dict[str, int] = {}
        self._count = 0

    def set(self, name: str, value: Any) -> None:
        """Record that the value ``name`` was set to ``value``, an array of any kind or None."""
        tracked = records_gradient((value,))
        if tracked and name in self.tensors and self.tensors[name] is value:
            if self._versions[name] == value._version:
                return
        self._count += 1
        self.stamps[name] = self._count
        self.tensors.pop(name, None)
        if tracked:
            self.tensors[name], self._versions[name] = value, value._version


def records_gradient(arguments: tuple, values: TensorValues | None = None) -> bool:
    """Whether torch's autograd records a call with these arguments of an object with these values."""
    if "torch" not in sys.modules:
        return False
    torch = torch_border()
    return torch.is_grad_enabled() and (bool(values and values.tensors) or any(map(torch.requires_grad, arguments)))


def check_plain(call: str, name: str, value: Any) -> None:
    """Raise ValueError if ``value`` is a torch tensor with a tangent or a transform, which a copy would lose."""
    if "torch" in sys.modules and torch_border().is_tensor(value):
        torch_border().pointer(call, name, value)


def call_with_gradient(*call: Any) -> Any:
    """Return the result of :func:`warp_spo.torch.call_with_gradient`."""
    from ..torch import call_with_gradient

    return call_with_gradient(*call)


def is_traced() -> bool:
    """Whether ``torch.compile`` traces the call. This is asked in every call, and takes the least that torch has."""
    torch = sys.modules.get("torch")
    return torch is not None and torch.compiler.is_dynamo_compiling()


def is_exported() -> bool:
    """Whether torch traces the call in any way, such as for an export, which runs it with tensors of no numbers."""
    return "torch" in sys.modules and sys.modules["torch"].compiler.is_compiling()


def call_in_graph(*call: Any) -> Any:
    """Return the result of :func:`warp_spo.torch.call_in_graph`; code that torch traces may call no cached function."""
    from ..torch import call_in_graph

    return call_in_graph(*call)


KNOWN: weakref.WeakValueDictionary[str, Any] = weakref.WeakValueDictionary()
_numbers = itertools.count()


def register(dyn: Any) -> str:
    """Return a new number for a Dynamics, by which :data:`KNOWN` has it."""
    found = str(next(_numbers))
    KNOWN[found] = dyn
    return found
