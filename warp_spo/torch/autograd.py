"""Operations of Dynamics in torch's autograd, with analytic gradients."""

import weakref
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch

from ..runtime.torch_tensors import is_tensor, like, pointer, requires_grad

if TYPE_CHECKING:
    from ..dynamics.dynamics import Dynamics
    from ..dynamics.operation import Operation


def call_with_gradient(
    dyn: "Dynamics", operation: "Operation", arguments: dict[str, Any], written: tuple[tuple, dict[str, Any]]
) -> Any:
    """Return the result of an operation, through which torch's backward pass can go.

    Args:
        dyn: The Dynamics.
        operation: The operation, which has a derivative.
        arguments: Its arguments by name. written: by position, and by name, as the caller wrote them.
    """
    assert operation.derivative is not None
    derivative = operation.derivative
    value_tensors = {name: tensor for name, tensor in dyn.values.tensors.items() if name in derivative.values}
    inputs = {name: arguments.pop(name) for name in derivative.by if arguments.get(name) is not None}
    tensors = {**inputs, **value_tensors}
    if not any(map(requires_grad, tensors.values())):
        # If another argument requires grad, the call refuses it.
        with torch.set_grad_enabled(any(map(requires_grad, arguments.values()))):
            return operation.run(dyn, **inputs, **arguments)
    call = f"Dynamics.{operation.name}"
    for name, x in tensors.items():
        if not is_tensor(x):
            other = next(n for n, y in tensors.items() if requires_grad(y))
            raise TypeError(
                f"{call}: {other} requires grad and {name} is of type {type(x).__name__}; expected torch tensors only; "
                f"pass torch.as_tensor({name}), or call inside torch.no_grad()"
            )
        pointer(call, name, x)
    refused = derivative.refuses(dyn, arguments)
    if refused:
        came, expected = refused.split("; ", 1)
        raise ValueError(f"{call}: {came} and an input requires grad; {expected}; call inside torch.no_grad()")
    arguments |= derivative.adds(dyn)
    times = derivative.repeats(call, arguments)
    out = arguments.pop("out", None)
    if any(x is not None for x in (out if isinstance(out, tuple | list) else (out,))):
        raise ValueError(
            f"{call}: out is given and an input requires grad; expected no out=, because a result with gradients is a "
            f"new tensor; leave out=, or call inside torch.no_grad()"
        )
    dyn._gradients.check(operation)
    record = Record(dyn, operation, arguments, tuple(inputs), tuple(value_tensors))
    if times == 1 and not value_tensors:
        given = list(tensors.values())
        dyn._gradients.remember(record, given, written, like(given, exactly=True), _Differentiable.apply)
    for _ in range(times - 1):
        results = _Differentiable.apply(record, *tensors.values())
        tensors |= {one.name: result for one, result in zip(operation.results, results, strict=True)}
    return _Differentiable.apply(record, *tensors.values())


class Record:
    """A call of an operation without its tensors, so that it can be run and differentiated.

    Args:
        dyn: The Dynamics.
        operation: The operation, which has a derivative.
        options: Arguments that are not differentiated.
        inputs: Names of the arguments that are tensors.
        values: Names of the values of the scene that are tensors.
    """

    def __init__(self, dyn: "Dynamics", operation: "Operation", options: dict, inputs: tuple, values: tuple):
        assert operation.derivative is not None
        self.dyn, self.operation, self.derivative = dyn, operation, operation.derivative
        names = {option.name for option in operation.options}
        self.options = {name: _copy(value) if name in names else value for name, value in options.items()}
        self.inputs, self.values = inputs, values
        self.stamps = dict(dyn.values.stamps)

    def run(self, tensors: Sequence[torch.Tensor]) -> tuple[Any, tuple]:
        """Return the result, and all tensors that the backward pass needs of it; torch must not record it."""
        more = {}
        for one in self.operation.arrays if self.derivative.keeps else ():
            if one.name in self.derivative.keeps:
                more[one.name] = tensors[0].new_empty(self.dyn._engine.shape(one.axes)[0])
        inputs = dict(zip(self.inputs, tensors, strict=False))
        result = self.operation.run(self.dyn, **inputs, **self.options, **more)
        return result, (*(result if isinstance(result, tuple) else (result,)), *more.values())

    def gradients(self, wanted: list[str], tensors: Sequence[torch.Tensor], results: tuple, cotangents: tuple) -> dict:
        """Return the gradients by name, at the values of the scene that the call saw.

        Raises:
            RuntimeError: A value was set since the call, and the tensors do not hold its old numbers.
        """
        by_name = dict(zip((*self.inputs, *self.values), tensors, strict=True))
        arrays = {name: by_name[name] for name in self.inputs}
        gradients, values = self.dyn._gradients, self.dyn.values
        if self.stamps == values.stamps:
            return gradients.pull_back(self.operation, arrays, self.options, results, cotangents, wanted)
        changed = [name for name, stamp in values.stamps.items() if self.stamps.get(name) != stamp]
        lost = [name for name in changed if name not in self.values and name in self.derivative.values]
        if lost:
            raise RuntimeError(
                f"Dynamics.{self.operation.name}: {', '.join(lost)} was set between this call and its backward pass; "
                f"expected the values of the call; call backward before Dynamics.set, or set tensors that require grad"
            )
        before = {name: by_name[name] for name in changed if name in self.values}
        with self.dyn.recursions.call_order.lock, gradients.at_values(before):
            return gradients.pull_back(self.operation, arrays, self.options, results, cotangents, wanted)


def _copy(option: Any) -> Any:
    """Return an option that stays as it is if the caller changes his: a list of frames, or a tensor for dt."""
    if type(option) in (list, tuple):
        return type(option)(map(_copy, option))
    return option.clone() if is_tensor(option) else option


class _Differentiable(torch.autograd.Function):
    """An operation of Dynamics with its analytic gradient."""

    @staticmethod
    def forward(ctx: Any, record: Record, *tensors: torch.Tensor) -> Any:
        ctx.record = record
        result, kept = record.run(tensors)
        ctx.save_for_backward(*tensors, *kept)
        ctx.places, ctx.owners = [x.data_ptr() for x in tensors], [weakref.ref(x) for x in tensors]
        return result

    @staticmethod
    def backward(ctx: Any, *cotangents: torch.Tensor) -> tuple:
        record, saved = ctx.record, ctx.saved_tensors
        names = (*record.inputs, *record.values)
        tensors, results = saved[: len(names)], saved[len(names) :]
        if ctx.places != [x.data_ptr() for x in tensors]:
            _refuse_replaced(record, names, tensors, ctx)
        wanted = [name for name, needed in zip(names, ctx.needs_input_grad[1:], strict=True) if needed]
        given = tuple([c.contiguous() for c in cotangents])
        if not torch.is_grad_enabled():
            found = record.gradients(wanted, tensors, results, given)
        else:
            with torch.no_grad():
                found = record.gradients(wanted, tensors, results, given)
        for name, tensor in zip(record.values, tensors[len(record.inputs) :], strict=True):
            if name in found and found[name].dim() > tensor.dim():  # all worlds share the value
                found[name] = found[name].sum(0)
        if torch.is_grad_enabled():
            sources = [x for x in (*tensors, *cotangents) if x.requires_grad]
            found = {name: _FirstOrder.apply(record.operation.name, value, *sources) for name, value in found.items()}
        return None, *[found.get(name) for name in names]


def _refuse_replaced(record: Record, names: tuple[str, ...], tensors: Sequence[torch.Tensor], ctx: Any) -> None:
    """Raise RuntimeError if a tensor has other memory than in the call; hooks of torch may save copies."""
    for name, tensor, place, owner in zip(names, tensors, ctx.places, ctx.owners, strict=True):
        if tensor.data_ptr() != place and tensor is owner():
            raise RuntimeError(
                f"Dynamics.{record.operation.name}: {name}.data was replaced between this call and its backward pass; "
                f"expected the numbers of the call; pass {name}.clone(), or call backward before"
            )


class _FirstOrder(torch.autograd.Function):
    """The gradient itself, with a backward pass that raises: ``create_graph=True`` asks for second derivatives."""

    @staticmethod
    def forward(ctx: Any, operation: str, gradient: torch.Tensor, *sources: torch.Tensor) -> torch.Tensor:
        ctx.operation = operation
        return gradient.view_as(gradient)

    @staticmethod
    def backward(ctx: Any, *cotangents: torch.Tensor) -> tuple:
        raise RuntimeError(
            f"Dynamics.{ctx.operation}: its gradient is differentiated once more; expected first derivatives only, "
            f"because they are analytic and not recorded; take finite differences of gradients for second derivatives"
        )
