"""Operations of Dynamics as custom ops of torch, for ``torch.compile``."""

import inspect
import itertools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch.autograd import forward_ad

from .autograd import Record
from .tensors import is_tensor, pointer

if TYPE_CHECKING:
    from ..dynamics.dynamics import Dynamics
    from ..dynamics.operation import Operation

_numbers = itertools.count()  # of custom ops, which need names of their own
RESULTS = (
    "out",
    "qdd",
    "status",
    "actuator_state",
)  # arguments that a call writes, which a graph of torch would not know

ONLY = {"integrator": "semi_implicit", "substeps": 1}  # options of which gradients know one value


def _check_options(declared: "Operation", by: tuple[str, ...], options: dict[str, Any]) -> None:
    """Raise TypeError unless ``options`` are the arguments that the operation needs besides the tensors ``by``."""
    operation, parameters = declared.name, inspect.signature(declared.function).parameters
    rest = {n: p.default for n, p in parameters.items() if n not in (*by, *RESULTS, *ONLY, "self")}
    expected = ", ".join(f"{n}=" for n in rest) or "none"
    for name in options:
        if name not in rest and (name not in ONLY or options[name] != ONLY[name]):
            raise TypeError(f"custom_op({operation!r}): {name}={options[name]!r} is no option; expected {expected}")
    for name, default in rest.items():
        if default is inspect.Parameter.empty and name not in options:
            raise TypeError(f"custom_op({operation!r}): {name} is missing; expected {expected}")


def custom_op(dyn: "Dynamics", operation: str, **options: Any) -> Callable[..., Any]:
    """Return an operation of ``dyn`` as a custom op of torch. ``torch.compile`` keeps it in its graph, with gradients.

    ::

        step = custom_op(dyn, "step", dt=2e-3)

        @torch.compile(fullgraph=True)
        def loss(q, qd, tau): ...  step(q, qd, tau) ...

    Args:
        dyn: The Dynamics.
        operation: Name of an operation that has gradients.
        options: The operation's arguments that are not tensors.

    Returns:
        A function of the operation's tensors [world, ...], by position or by name. It raises RuntimeError if a value of
        ``dyn`` is set to a tensor that requires grad, because this tensor is no input of the op.

    Raises:
        TypeError: ``dyn`` is no Dynamics, or the options are not those of the operation.
        ValueError: The operation has no gradient.
    """
    if not hasattr(dyn, "_operations"):
        raise TypeError(f"custom_op: dyn is of type {type(dyn).__name__}; expected a Dynamics")
    known = {name: one.derivative for name, one in dyn._operations.items() if one.derivative is not None}
    if not isinstance(operation, str) or operation not in known:
        raise ValueError(f"custom_op: operation is {operation!r}; expected one of {', '.join(known)}")
    declared, by = dyn._operations[operation], known[operation].by
    _check_options(declared, by, options)
    dyn._gradients.check(declared)
    name = f"warp_spo::{operation}_{next(_numbers)}"

    def record(names: str) -> Record:
        if dyn.values.tensors:
            raise RuntimeError(
                f"custom_op({operation!r}): {', '.join(dyn.values.tensors)} was set to a tensor that requires grad; "
                f"expected detached values; call Dynamics.{operation} itself for gradients by them"
            )
        return Record(dyn, declared, options, tuple(names.split()), ())

    def forward(names: str, tensors: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        return list(record(names).run(tensors)[1])

    def backward(names: str, wanted: str, tensors: Any, kept: Any, cotangents: Any) -> list[torch.Tensor]:
        found = record(names).gradients(wanted.split(), tensors, tuple(kept), tuple(c.contiguous() for c in cotangents))
        return [found[name] for name in wanted.split()]

    forward_op = torch.library.custom_op(
        name, forward, mutates_args=(), schema="(str names, Tensor[] tensors) -> Tensor[]"
    )
    backward_op = torch.library.custom_op(
        f"{name}_backward", backward, mutates_args=(),
        schema="(str names, str wanted, Tensor[] tensors, Tensor[] kept, Tensor[] cotangents) -> Tensor[]",
    )  # fmt: skip
    shapes = dyn._gradients.result_shapes(declared, **options)
    like = by.index(declared.results[0].like) if declared.results[0].like else None
    results = len(declared.results)  # further outputs are there for the backward pass

    @forward_op.register_fake
    def _(names: str, tensors: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        if like is not None:
            return [torch.empty_like(tensors[like])]
        return [tensors[0].new_empty(shape) for shape in shapes]

    @backward_op.register_fake
    def _(names: str, wanted: str, tensors: Any, kept: Any, cotangents: Any) -> list[torch.Tensor]:
        by_name = dict(zip(names.split(), tensors, strict=True))
        return [torch.empty_like(by_name[name]) for name in wanted.split()]

    def save(ctx: Any, inputs: tuple, output: list[torch.Tensor]) -> None:
        ctx.names, tensors = inputs
        ctx.count = len(tensors)
        ctx.wanted = [x.requires_grad for x in tensors]
        ctx.save_for_backward(*tensors, *output)

    def differentiate(ctx: Any, cotangents: Sequence[torch.Tensor]) -> tuple:
        tensors, kept = ctx.saved_tensors[: ctx.count], ctx.saved_tensors[ctx.count :]
        names = [name for name, wanted in zip(ctx.names.split(), ctx.wanted, strict=True) if wanted]
        found = backward_op(ctx.names, " ".join(names), list(tensors), list(kept), list(cotangents[:results]))
        rest = iter(found)
        return None, [next(rest) if wanted else None for wanted in ctx.wanted]

    forward_op.register_autograd(differentiate, setup_context=save)

    def call(*args: Any, **more: Any) -> Any:
        named = (*zip(by, args, strict=False), *more.items())
        inputs = {n: x for n, x in named if x is not None}
        if len(args) > len(by) or len(named) > len(dict(named)) or not all(n in by for n in more):
            raise TypeError(
                f"custom_op({operation!r}): {len(args)} tensors by position and {', '.join(more) or 'none'} by name; "
                f"expected {', '.join(by)}, each once at most"
            )
        for n, x in inputs.items():
            if not is_tensor(x):
                raise TypeError(f"custom_op({operation!r}): {n} is of type {type(x).__name__}; expected a torch tensor")
            if forward_ad._current_level >= 0 or not torch.compiler.is_compiling():
                pointer(f"custom_op({operation!r})", n, x)
        found = forward_op(" ".join(inputs), list(inputs.values()))
        return tuple(found[:results]) if results > 1 else found[0]

    return call
