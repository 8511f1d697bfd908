"""A tensor that marks which of its numbers have been written: ``HeldTensor``."""

from __future__ import annotations

from typing import Any

import torch

from .arguments import refuse_gradient

PLACES = {
    "masked_fill_": ("masked_fill_", ("mask",)), "masked_scatter_": ("masked_fill_", ("mask",)),
    "index_fill_": ("index_fill_", ("dim", "index")), "index_copy_": ("index_fill_", ("dim", "index")),
    "index_add_": ("index_fill_", ("dim", "index")), "index_reduce_": ("index_fill_", ("dim", "index")),
    "scatter_": ("scatter_", ("dim", "index")), "scatter_add_": ("scatter_", ("dim", "index")),
    "scatter_reduce_": ("scatter_", ("dim", "index")), "index_put_": ("index_put_", ("indices",)),
}  # fmt: skip
"""Function that writes in place -> the one that marks the same entries, and its arguments that say which these are."""


class HeldTensor(torch.Tensor):
    """A tensor whose entries, when torch writes them in place, become 1 in another tensor of its shape.

    Views of it mark what they write, too; all else that torch makes of it is a plain tensor. Functions in place mark
    the entries that their mask or index names; those of ``PLACES`` have one, and all others mark the whole tensor.
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
        if isinstance(first, cls) and _writes(name):
            for x in (each for each in (*args[1:], *kwargs.values()) if isinstance(each, torch.Tensor)):
                refuse_gradient("env.command", "x", x)
        with torch._C.DisableTorchFunctionSubclass():
            found = func(*args, **kwargs)  # before marks: what torch refuses writes nothing
            if isinstance(first, cls):
                _mark(first._marks, name, args[1:], kwargs)
            if isinstance(kwargs.get("out"), cls):
                kwargs["out"]._marks.fill_(1.0)
            if found is first or not isinstance(first, cls):
                return found
            views = found if isinstance(found, tuple | list) else [found]
            if not any(_shares(first, view) for view in views):
                return _plain(found)
            marks = func(first._marks, *args[1:], **kwargs)
            if isinstance(found, tuple | list):
                return type(found)(cls.of(a, b) for a, b in zip(found, marks, strict=True))
            return cls.of(found, marks)


def _mark(marks: torch.Tensor, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
    """Mark what a tensor's function of this name has written, if any; ``args`` are those after the tensor."""
    if name == "__setitem__":
        marks[args[0]] = 1.0
    elif name in PLACES:
        function, places = PLACES[name]
        where = [args[i] if i < len(args) else kwargs[place] for i, place in enumerate(places)]
        one = torch.ones((), dtype=marks.dtype, device=marks.device) if name == "index_put_" else 1.0
        getattr(marks, function)(*where, one)
    elif _writes(name):
        marks.fill_(1.0)


def _writes(name: str) -> bool:
    """Return whether a tensor's function of this name writes in place."""
    return name == "__setitem__" or (name.endswith("_") and not name.endswith("__"))


def _shares(tensor: torch.Tensor, other: Any) -> bool:
    """Return whether ``other`` is a tensor of numbers in the memory of ``tensor``."""
    if not isinstance(other, torch.Tensor) or other.dtype != tensor.dtype or other.device != tensor.device:
        return False
    return other.untyped_storage().data_ptr() == tensor.untyped_storage().data_ptr()


def _plain(found: Any) -> Any:
    """Return a tensor that marks nothing in place of one that does."""
    return found.as_subclass(torch.Tensor) if isinstance(found, HeldTensor) else found
