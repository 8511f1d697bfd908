"""A tensor that marks which of its numbers have been written: ``HeldTensor``."""

from __future__ import annotations

from typing import Any

import torch


class HeldTensor(torch.Tensor):
    """A tensor whose entries, when torch writes them in place, become 1 in another tensor of its shape.

    Views of it mark what they write, too; all else that torch makes of it is a plain tensor.
    """

    _marks: torch.Tensor

    @classmethod
    def of(cls, values: torch.Tensor, marks: torch.Tensor) -> HeldTensor:
        """Return the same memory as ``values``, which marks what is written in ``marks``."""
        found = values.as_subclass(cls)
        found._marks = marks
        return found

    def __deepcopy__(self, memo: dict) -> torch.Tensor:
        return _plain(self).clone()

    def __reduce_ex__(self, protocol: Any) -> Any:
        return _plain(self).__reduce_ex__(protocol)

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Call a function of torch; mark what it writes."""
        kwargs = {} if kwargs is None else kwargs
        name, first = getattr(func, "__name__", ""), args[0] if args else None
        with torch._C.DisableTorchFunctionSubclass():
            if name == "__setitem__" and isinstance(first, cls):
                first._marks[args[1]] = 1.0
            elif name.endswith("_") and not name.endswith("__") and isinstance(first, cls):
                first._marks.fill_(1.0)
            if isinstance(kwargs.get("out"), cls):
                kwargs["out"]._marks.fill_(1.0)
            found = func(*args, **kwargs)
            if found is first or not isinstance(first, cls):
                return found
            views = found if isinstance(found, tuple | list) else [found]
            if not any(_shares(first, view) for view in views):
                return _plain(found)
            marks = func(first._marks, *args[1:], **kwargs)
            if isinstance(found, tuple | list):
                return type(found)(cls.of(a, b) for a, b in zip(found, marks, strict=True))
            return cls.of(found, marks)


def _shares(tensor: torch.Tensor, other: Any) -> bool:
    """Return whether ``other`` is a tensor of numbers in the memory of ``tensor``."""
    if not isinstance(other, torch.Tensor) or other.dtype != tensor.dtype or other.device != tensor.device:
        return False
    return other.untyped_storage().data_ptr() == tensor.untyped_storage().data_ptr()


def _plain(found: Any) -> Any:
    """Return a tensor that marks nothing in place of one that does."""
    return found.as_subclass(torch.Tensor) if isinstance(found, HeldTensor) else found
