"""Operations of Dynamics inside ``torch.compile``: two ops of torch, one for the way forward and one for the way back.

The ops take the operation by its name and the Dynamics by its number, so that nothing is registered for a Dynamics. All
that torch traces is :func:`call_in_graph`; kernels are compiled and launched when an op runs.
"""

import ast
import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch.autograd import forward_ad

from ..runtime.autograd import KNOWN
from ..runtime.torch_tensors import DTYPES, is_tensor, pointer
from .autograd import Record

if TYPE_CHECKING:
    from ..dynamics.dynamics import Dynamics
    from ..dynamics.operation import Operation

NUMBER = "a number"  # stands among the options for one that the op takes as a number
RESULTS = ("out", "actuator_state")  # arguments that a call writes besides those declared so
ONLY = {"integrator": "semi_implicit", "substeps": 1}  # options of which gradients know one value
PLAIN = (bool, int, str, list, tuple, type(None))  # classes of options that a graph takes, and of their entries
CALL = "str dyn, str operation, str names, str options, float number, {}, Tensor[] tensors"
Shape = tuple[tuple[int, ...], torch.dtype]


# -- ops ---------------------------------------------------------------------------------------------------------------
class Graphed(NamedTuple):
    """The call that an op stands for: the arguments of the op, but for its tensors.

    Attributes:
        dyn: number of the Dynamics. operation: name. names: of the arguments that are tensors, with spaces between.
        options: the other arguments, (name, value) one after the other, written as Python. number: the one that is
            NUMBER among them, which need not be a constant of the graph.
    """

    dyn: str
    operation: str
    names: str
    options: str
    number: float

    def find(self) -> tuple["Dynamics", "Operation", dict[str, Any]]:
        """Return the Dynamics, the operation and its options."""
        dyn: Dynamics = KNOWN[self.dyn]
        given = {name: self.number if value == NUMBER else value for name, value in _parse(self.options)}
        return dyn, dyn._operations[self.operation], given

    def record(self) -> Record:
        """Return the call as one that can be differentiated."""
        dyn, operation, options = self.find()
        return Record(dyn, operation, options, tuple(self.names.split()), ())

    def shapes(self, filled: str, tensors: Sequence[torch.Tensor]) -> tuple[list[Shape], dict[str, Shape]]:
        """Return shape and dtype of the results, and of the arrays named in ``filled``."""
        dyn, operation, options = self.find()
        by_name, engine = dict(zip(self.names.split(), tensors, strict=True)), dyn._engine
        entries = 0
        if any("entry" in result.axes for result in operation.results):
            entries = len(getattr(dyn, operation.name.replace("packed", "pattern"))[0])
        results = []
        for result in operation.results:
            shape, _ = engine.shape_of(result, by_name, len(options.get("frames", ())), entries)
            results.append((shape, DTYPES[result.dtype or dyn.dtype]))
        declared = {one.name: one for one in operation.arrays}
        more = {name: declared[name] for name in filled.split()}
        return results, {n: (engine.shape(one.axes)[0], DTYPES[one.dtype or dyn.dtype]) for n, one in more.items()}


@functools.lru_cache(maxsize=256)
def _parse(options: str) -> tuple[tuple[str, Any], ...]:
    return tuple(ast.literal_eval(options))


def _run(*arguments: Any) -> list[torch.Tensor]:
    """Return the results of a call, and the arrays named in ``filled``, which it writes besides.

    Raises:
        RuntimeError: A value of the scene was set to a tensor that requires grad.
    """
    *call, filled, tensors = arguments
    graphed = Graphed(*call)
    dyn, operation, options = graphed.find()
    if dyn.values.tensors:
        raise RuntimeError(
            f"Dynamics.{operation.name} in a graph of torch: {', '.join(dyn.values.tensors)} was set to a tensor that "
            f"requires grad, which is no input of the graph; expected detached values; call it outside of torch.compile"
        )
    more = {}
    for name, (shape, dtype) in graphed.shapes(filled, tensors)[1].items() if filled else ():
        more[name] = torch.empty(shape, dtype=dtype, device=tensors[0].device)
    with torch.no_grad():
        result = operation.run(dyn, **dict(zip(graphed.names.split(), tensors, strict=True)), **options, **more)
    return [*(result if isinstance(result, tuple) else (result,)), *more.values()]


def _run_backwards(*arguments: Any) -> list[torch.Tensor]:
    """Return the gradients by the arguments that are named in ``wanted``."""
    *call, wanted, tensors, kept, cotangents = arguments
    with torch.no_grad():
        given = tuple(c.contiguous() for c in cotangents)
        found = Graphed(*call).record().gradients(wanted.split(), tensors, tuple(kept), given)
    return [found[name] for name in wanted.split()]


_forward_op = torch.library.custom_op(
    "warp_spo::call", _run, mutates_args=(), schema=f"({CALL.format('str filled')}) -> Tensor[]"
)
_backward_op = torch.library.custom_op(
    "warp_spo::pull_back", _run_backwards, mutates_args=(),
    schema=f"({CALL.format('str wanted')}, Tensor[] kept, Tensor[] cotangents) -> Tensor[]",
)  # fmt: skip


@_forward_op.register_fake
def _(*arguments: Any) -> list[torch.Tensor]:
    *call, filled, tensors = arguments
    results, more = Graphed(*call).shapes(filled, tensors)
    return [tensors[0].new_empty(shape, dtype=dtype) for shape, dtype in (*results, *more.values())]


@_backward_op.register_fake
def _(*arguments: Any) -> list[torch.Tensor]:
    *call, wanted, tensors, _, _ = arguments
    by_name = dict(zip(Graphed(*call).names.split(), tensors, strict=True))
    return [torch.empty_like(by_name[name], memory_format=torch.contiguous_format) for name in wanted.split()]


def _save(ctx: Any, inputs: tuple, output: list[torch.Tensor]) -> None:
    *call, _, tensors = inputs
    ctx.graphed, ctx.count = Graphed(*call), len(tensors)
    dyn, operation, options = ctx.graphed.find()
    names, derivative = ctx.graphed.names.split(), operation.derivative
    ctx.wanted = [name if x.requires_grad else None for name, x in zip(names, tensors, strict=True)]
    for name in filter(None, ctx.wanted):
        if derivative is None or name not in derivative.by:
            raise ValueError(
                f"Dynamics.{operation.name}: {name} requires grad; derivatives are not available through this call; "
                f"pass {name}.detach(), or call inside torch.no_grad()"
            )
    for name, value in ONLY.items():
        if options.get(name, value) != value:
            raise ValueError(
                f"Dynamics.{operation.name} in a graph of torch: {name} is {options[name]!r} and an input requires "
                f"grad; expected {value!r}, which has gradients; call it outside of the graph"
            )
    dyn._gradients.check(operation)
    ctx.results = len(operation.results)
    ctx.save_for_backward(*tensors, *output)


def _differentiate(ctx: Any, cotangents: Sequence[torch.Tensor | None]) -> tuple:
    tensors, kept = ctx.saved_tensors[: ctx.count], ctx.saved_tensors[ctx.count :]
    given = [torch.zeros_like(y) if c is None else c for c, y in zip(cotangents[: ctx.results], kept, strict=False)]
    wanted = " ".join(filter(None, ctx.wanted))
    rest = iter(_backward_op(*ctx.graphed, wanted, list(tensors), list(kept), given))
    return *[None] * 6, [next(rest) if name else None for name in ctx.wanted]


_forward_op.register_autograd(_differentiate, setup_context=_save)


# -- calls -------------------------------------------------------------------------------------------------------------
def call_in_graph(
    dyn: str,
    operation: str,
    parameters: tuple[str, ...],
    results: int,
    keeps: tuple[str, ...],
    written: tuple[str, ...],
    args: tuple,
    more: dict[str, Any],
) -> Any:
    """Return the result of an operation while torch traces its call.

    Args:
        dyn: The number of the Dynamics.
        operation: Its name. results: how many it has. keeps: arrays that its way back needs besides.
        parameters: Names of its arguments. written: those that it fills.
        args, more: The caller's arguments.
    """
    given = dict(zip(parameters, args, strict=False))
    for name, value in more.items():
        if name in given or name not in parameters:
            raise TypeError(f"Dynamics.{operation}: argument {name} is unknown, or is given twice")
        given[name] = value
    if len(args) > len(parameters):
        raise TypeError(f"Dynamics.{operation}: {len(args)} arguments; expected {len(parameters)} at most")
    out = given.pop("out", None)
    filled = {name: given.pop(name, None) for name in written}
    filled = {name: array for name, array in filled.items() if array is not None}
    tensors, names, number, number_of = [], [], 0.0, ""
    options: list[tuple[str, Any]] = []
    for name, value in given.items():
        if isinstance(value, torch.Tensor):
            tensors.append(value)
            names.append(name)
        elif isinstance(value, float) and not number_of:
            number, number_of = value, name
            options.append((name, NUMBER))
        elif not isinstance(value, (*PLAIN, float)) or (name == "actuator_state" and value is not None):
            raise TypeError(
                f"Dynamics.{operation} inside torch.compile: {name} is of type {type(value).__name__}; expected torch "
                f"tensors, numbers and lists of them; call it outside of torch.compile"
            )
        else:
            options.append((name, value))
    if not tensors:
        raise TypeError(f"Dynamics.{operation} inside torch.compile: no argument is a tensor; expected torch tensors")
    recorded = torch.is_grad_enabled() and any([x.requires_grad for x in tensors])
    extra = [*(keeps if recorded else ()), *[name for name in filled if not recorded or name not in keeps]]
    found = _forward_op(dyn, operation, " ".join(names), repr(options), number, " ".join(extra), tensors)
    for name, array in filled.items():
        array.copy_(found[results + extra.index(name)])
    if results == 1:
        return found[0] if out is None else out.copy_(found[0])
    outs = (None,) * results if out is None else out
    return tuple([y if x is None else x.copy_(y) for x, y in zip(outs, found[:results], strict=True)])


def _check_options(declared: "Operation", by: tuple[str, ...], options: dict[str, Any]) -> None:
    """Raise TypeError unless ``options`` are the arguments that the operation needs besides the tensors ``by``."""
    operation, written = declared.name, tuple(one.name for one in declared.arrays if one.written)
    rest = [name for name in declared.parameters if name not in (*by, *RESULTS, *written, *ONLY)]
    expected = ", ".join(f"{name}=" for name in declared.as_given(rest)) or "none"
    for name in options:
        if name not in rest and (name not in ONLY or options[name] != ONLY[name]):
            raise TypeError(f"custom_op({operation!r}): {name}={options[name]!r} is no option; expected {expected}")
    for name in rest:
        if declared.needs(name) and name not in options:
            raise TypeError(f"custom_op({operation!r}): {name} is missing; expected {expected}")


def custom_op(dyn: "Dynamics", operation: str, **options: Any) -> Callable[..., Any]:
    """Return an operation of ``dyn`` as a custom op of torch. ``torch.compile`` keeps it in its graph, with gradients.

    ::

        step = custom_op(dyn, "step", dt=2e-3)

        @torch.compile(fullgraph=True)
        def loss(q, qd, tau): ...  step(q, qd, tau) ...

    Inside ``torch.compile`` the plain ``dyn.step(q, qd, tau, dt=2e-3)`` is the same op.

    Args:
        dyn: The Dynamics.
        operation: Name of an operation that has gradients.
        options: The operation's arguments that are not tensors, such as ``dt`` and a step's ``options``.

    Returns:
        A function of the operation's tensors [world, ...], by position or by name, and None where the method takes it.
        It raises RuntimeError if a value of ``dyn`` is set to a tensor that requires grad, because this tensor is no
        input of the op.

    Raises:
        TypeError: ``dyn`` is no Dynamics, or the options are not those of the operation.
        ValueError: The operation has no gradient.
    """
    if not hasattr(dyn, "_operations"):
        raise TypeError(f"custom_op: dyn is of type {type(dyn).__name__}; expected a Dynamics")
    known = {name: one.derivative for name, one in dyn._operations.items() if one.derivative is not None}
    if not isinstance(operation, str) or operation not in known:
        raise ValueError(f"custom_op: operation is {operation!r}; expected one of {', '.join(known)}")
    declared, derivative = dyn._operations[operation], known[operation]
    by, keeps, results = derivative.by, derivative.keeps, len(declared.results)
    options = declared.expand(f"custom_op({operation!r})", options)
    _check_options(declared, by, options)
    dyn._gradients.check(declared)
    parameters = (*by, *options)

    def call(*args: Any, **more: Any) -> Any:
        named = (*zip(by, args, strict=False), *more.items())
        inputs = dict(named)
        if len(args) > len(by) or len(named) > len(inputs) or not all(n in by for n in more):
            raise TypeError(
                f"custom_op({operation!r}): {len(args)} tensors by position and {', '.join(more) or 'none'} by name; "
                f"expected {', '.join(by)}, each once at most"
            )
        for n, x in inputs.items():
            if x is None:
                continue  # an option of the op
            if not is_tensor(x):
                raise TypeError(f"custom_op({operation!r}): {n} is of type {type(x).__name__}; expected a torch tensor")
            if forward_ad._current_level >= 0 or not torch.compiler.is_compiling():
                pointer(f"custom_op({operation!r})", n, x)
        return call_in_graph(dyn._handle, operation, parameters, results, keeps, (), (), {**inputs, **options})

    return call
