"""The start of a training: imports without torch's compiler, which nothing of it uses, and the seconds of each part."""

from __future__ import annotations

import contextlib
import functools
import inspect
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

PRECISIONS = ("float32", "tf32", "bfloat16")  # of the networks' products on a GPU
HIDDEN = ("add_param_group", "load_state_dict", "state_dict", "zero_grad")  # methods of torch's optimizers


class StartTimes:
    """The seconds that the parts of a start take.

    Args:
        began: time of the start, as of ``time.time``.

    Attributes:
        parts: name and seconds of each part, in order.
    """

    def __init__(self, began: float):
        self._last, self.parts = began, list[tuple[str, float]]()

    def mark(self, name: str) -> None:
        """Add a part by its name, with the seconds since the part before ended."""
        now = time.time()
        self.parts.append((name, now - self._last))
        self._last = now

    def describe(self) -> str:
        """Return a line for each part, and one of their sum."""
        rows = [*self.parts, ("from the start", sum(seconds for _, seconds in self.parts))]
        return "\n".join(f"{seconds:8.2f} s  {name}" for name, seconds in rows)


def import_learning(mark: Callable[[str], None] = lambda name: None) -> Any:
    """Import torch, rsl_rl and the module that trains, and return it; ``mark`` is told of the parts.

    Raises:
        ImportError: torch or rsl_rl is missing.
    """
    import torch

    mark("import torch")
    with without_compiler():
        import rsl_rl.runners  # noqa: F401
    leave_out_compiler(torch.optim.Optimizer)
    mark("import rsl_rl")
    from . import learning

    mark("import warp_spo.env.learning")
    return learning


@contextlib.contextmanager
def without_compiler() -> Iterator[None]:
    """Return a context in which imports of TensorDict leave ``torch._dynamo`` out, which takes seconds to import.

    TensorDict marks functions for ``torch.compile`` when it is imported. Here it marks none: where a process compiles
    code of TensorDicts afterwards, graphs break at more places.
    """
    import torch.compiler

    held = torch.compiler.allow_in_graph, torch.compiler.assume_constant_result
    if "torch._dynamo" not in sys.modules:
        torch.compiler.allow_in_graph = torch.compiler.assume_constant_result = lambda function: function
    try:
        yield
    finally:
        torch.compiler.allow_in_graph, torch.compiler.assume_constant_result = held


def leave_out_compiler(kind: Any) -> None:
    """Let methods of optimizers that torch hides from its compiler run as they are, unless the compiler is imported."""
    for name in HIDDEN if "torch._dynamo" not in sys.modules else ():
        inner = getattr(getattr(kind, name), "__wrapped__", None)
        if inner is not None:
            inner.__dynamo_disable = inner  # where torch keeps what it makes at the first call


def plain_step(optimizer: Any) -> Callable[[], Any]:
    """Return the step of an optimizer without what torch puts around it: hooks, and the import of its compiler."""
    return functools.partial(inspect.unwrap(type(optimizer).step), optimizer)
