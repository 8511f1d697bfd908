"""torch at the border: what :mod:`warp_spo.arrays` asks of tensors. The only file besides env.py that imports torch."""

import functools
import inspect
import itertools
from collections.abc import Sequence
from typing import Any

import torch
import warp as wp
from torch._C import _functorch
from torch.autograd import forward_ad

from .errors import as_names

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
    return tensor.device == _device(device.alias) and is_dense(tensor)


def is_dense(tensor: torch.Tensor) -> bool:
    return tensor.layout is torch.strided


def pointer(call: str, name: str, tensor: torch.Tensor) -> int:
    """Return where the tensor's numbers lie; 0 if nowhere.

    Raises:
        ValueError: a transform of torch, or a forward-mode tangent, would be lost with the memory alone.
    """
    try:
        found = tensor.data_ptr()
    except RuntimeError:  # sparse ones have no pointer either
        if _functorch.is_functorch_wrapped_tensor(tensor) or _functorch.is_legacy_batchedtensor(tensor):
            raise ValueError(
                f"{call}: {name} is wrapped by a transform of torch (torch.func, jacobian(vectorize=True), "
                f"is_grads_batched=True), which cannot look into this call; expected a plain tensor; worlds are the "
                f"batch: use backward, or the _vjp and _jvp methods, or vectorize=False"
            ) from None
        return 0
    if forward_ad._current_level >= 0 and forward_ad.unpack_dual(tensor).tangent is not None:
        raise ValueError(
            f"{call}: {name} has a forward-mode tangent; derivatives are not available through this call; use "
            f"backward, or the _jvp methods, or pass torch.autograd.forward_ad.unpack_dual({name}).primal"
        )
    return found


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


# -- derivatives -------------------------------------------------------------------------------------------------------
def requires_grad(array: Any) -> bool:
    return isinstance(array, torch.Tensor) and array.requires_grad


def differentiated(dyn: Any, operation: str, method: Any, arguments: dict[str, Any], by: tuple, values: tuple) -> Any:
    """``method(dyn, **arguments)`` as an operation that torch can go back through.

    Args:
        operation: the public name. by: arguments with a derivative. values: of the scene, that enter.
    """
    sources = {name: tensor for name, tensor in dyn.values.tensors.items() if name in values}
    given = {name: arguments.pop(name) for name in by if arguments.get(name) is not None}
    tensors = {**given, **sources}
    if not any(map(requires_grad, tensors.values())):
        with torch.set_grad_enabled(any(map(requires_grad, arguments.values()))):  # which the call then refuses
            return method(dyn, **given, **arguments)
    call = f"Dynamics.{operation}"
    for name, x in tensors.items():
        if not is_tensor(x):
            other = next(n for n, y in tensors.items() if requires_grad(y))
            raise TypeError(
                f"{call}: {other} requires grad and {name} is of type {type(x).__name__}; expected torch tensors only; "
                f"pass torch.as_tensor({name}), or call inside torch.no_grad()"
            )
        pointer(call, name, x)
    if arguments.get("integrator", "semi_implicit") != "semi_implicit" or arguments.get("qdd") is not None:
        raise ValueError(
            f"{call}: an input requires grad; expected integrator='semi_implicit' and no qdd=, of which gradients are "
            f"known; call inside torch.no_grad()"
        )
    out = arguments.pop("out", None)
    if any(x is not None for x in (out if isinstance(out, tuple | list) else (out,))):
        raise ValueError(
            f"{call}: out is given and an input requires grad; a result that gradients flow through is a new tensor; "
            f"leave out=, or call inside torch.no_grad()"
        )
    plain = _Plain(dyn, operation, method, arguments, tuple(given), tuple(sources))
    with torch.no_grad():
        dyn.check_gradient(operation)
    return _Operation.apply(plain, *tensors.values())


class _Plain:
    """What an operation takes besides tensors: names of its arguments, and of values of the scene that enter."""

    def __init__(self, dyn: Any, operation: str, method: Any, options: dict, arguments: tuple, values: tuple):
        self.dyn, self.operation, self.method, self.options = dyn, operation, method, options
        self.arguments, self.values = arguments, values
        self.stamps = dict(dyn.values.stamps)

    def run(self, tensors: Sequence[torch.Tensor]) -> tuple[Any, tuple]:
        """The result; all that the way back needs of it."""
        more = {}
        if self.operation == "step":
            more["qdd"] = torch.empty_like(tensors[self.arguments.index("qd")])
        result = self.method(self.dyn, **dict(zip(self.arguments, tensors, strict=False)), **self.options, **more)
        return result, (*(result if isinstance(result, tuple) else (result,)), *more.values())

    def gradients(self, wanted: list[str], tensors: Sequence[torch.Tensor], results: tuple, cotangents: tuple) -> dict:
        """By name; where a value has been set anew since the call, at the value of the call."""
        given = dict(zip((*self.arguments, *self.values), tensors, strict=True))
        stamps = self.dyn.values.stamps
        anew = [name for name, stamp in stamps.items() if self.stamps.get(name) != stamp]
        lost = [name for name in anew if name not in self.values and name in self.dyn.entering(self.operation)]
        if lost:
            raise RuntimeError(
                f"Dynamics.{self.operation}: {', '.join(lost)} was set between this call and its backward pass; "
                f"expected the values of the call; go back before Dynamics.set, or set tensors that require grad"
            )
        arrays = {name: given[name] for name in self.arguments}
        with self.dyn.held({name: given[name] for name in anew if name in self.values}):
            return self.dyn.pulled_back(self.operation, arrays, self.options, results, cotangents, wanted)


class _Operation(torch.autograd.Function):
    """An operation of Dynamics."""

    @staticmethod
    def forward(ctx: Any, plain: _Plain, *tensors: torch.Tensor) -> Any:
        ctx.plain = plain
        result, kept = plain.run([x.detach() for x in tensors])
        ctx.save_for_backward(*tensors, *kept)
        return result

    @staticmethod
    def backward(ctx: Any, *cotangents: torch.Tensor) -> tuple:
        plain, names = ctx.plain, (*ctx.plain.arguments, *ctx.plain.values)
        tensors, results = ctx.saved_tensors[: len(names)], ctx.saved_tensors[len(names) :]
        wanted = [name for name, needed in zip(names, ctx.needs_input_grad[1:], strict=True) if needed]
        with torch.no_grad():
            plainly = [x.detach() for x in tensors], tuple(y.detach() for y in results)
            found = plain.gradients(wanted, *plainly, tuple(c.contiguous() for c in cotangents))
            for name, tensor in zip(names, tensors, strict=True):
                if name in found and found[name].dim() > tensor.dim():  # a value that all worlds share
                    found[name] = found[name].sum(0)
        if torch.is_grad_enabled():
            sources = [x for x in (*tensors, *cotangents) if x.requires_grad]
            found = {name: _Once.apply(plain.operation, value, *sources) for name, value in found.items()}
        return None, *(found.get(name) for name in names)


class _Once(torch.autograd.Function):
    """A gradient that was asked for with ``create_graph=True``: itself, with an error behind it."""

    @staticmethod
    def forward(ctx: Any, operation: str, gradient: torch.Tensor, *sources: torch.Tensor) -> torch.Tensor:
        ctx.operation = operation
        return gradient.view_as(gradient)

    @staticmethod
    def backward(ctx: Any, *cotangents: torch.Tensor) -> tuple:
        raise RuntimeError(
            f"Dynamics.{ctx.operation}: its gradient is differentiated once more; expected first derivatives only, "
            f"which are analytic and not recorded; take finite differences of gradients for second ones"
        )


class Module(torch.nn.Module):
    """A :class:`warp_spo.Dynamics` whose values are parameters, shared by all worlds and put in place before each call.

    ::

        robot = Module(spo.Dynamics(scene, worlds, variable=("body_mass", "joint_armature")))
        optimizer = torch.optim.Adam(robot.parameters())
        loss = (robot.forward_dynamics(q, qd, tau) - measured).square().mean()

    Its methods are the operations of Dynamics that have gradients; calling it is ``forward_dynamics``.

    Args:
        dyn: what it wraps.
        names: values, ``variable`` there; default: all of those that gradients reach. They start as the scene has them.

    Raises:
        ValueError: a name that is not variable, or has no gradient.
    """

    def __init__(self, dyn: Any, names: Sequence[str] | None = None):
        super().__init__()
        if not hasattr(dyn, "differentiable_values"):
            raise TypeError(f"Module: dyn is of type {type(dyn).__name__}; expected a Dynamics")
        self.dyn = dyn
        names = as_names("Module", "names", dyn.differentiable_values if names is None else names, ("body_mass",))
        for name in names:
            if name not in dyn.differentiable_values:
                raise ValueError(
                    f"Module: {name!r} has no gradient here; expected some of {', '.join(dyn.differentiable_values)}; "
                    f"build Dynamics with variable=({name!r},)"
                )
            value = torch.as_tensor(dyn.scene.values[name].mean(0))
            value = value.to(device=_device(dyn.device.alias), dtype=_DTYPES[dyn.dtype])
            self.register_parameter(name, torch.nn.Parameter(value))

    def _called(self, operation: str, *args: Any, **more: Any) -> Any:
        self.dyn.set(**dict(self.named_parameters()))
        return getattr(self.dyn, operation)(*args, **more)

    def forward(self, *args: Any, **more: Any) -> Any:
        return self._called("forward_dynamics", *args, **more)

    forward_dynamics = functools.partialmethod(_called, "forward_dynamics")
    inverse_dynamics = functools.partialmethod(_called, "inverse_dynamics")
    bias_force = functools.partialmethod(_called, "bias_force")
    gravity_force = functools.partialmethod(_called, "gravity_force")
    step = functools.partialmethod(_called, "step")
    mass_matrix = functools.partialmethod(_called, "mass_matrix")
    jacobian = functools.partialmethod(_called, "jacobian")
    solve_mass_matrix = functools.partialmethod(_called, "solve_mass_matrix")
    body_poses = functools.partialmethod(_called, "body_poses")
    body_velocities = functools.partialmethod(_called, "body_velocities")
    integrate = functools.partialmethod(_called, "integrate")


_made = itertools.count()
WRITTEN = ("out", "qdd", "status")  # arguments that a call fills: a graph of torch would not know of it


def _check_options(operation: str, method: Any, by: tuple[str, ...], options: dict[str, Any]) -> None:
    """Raise TypeError unless ``options`` are all that an operation needs besides the tensors ``by`` name."""
    takes = inspect.signature(method).parameters
    rest = {n: p.default for n, p in takes.items() if n not in (*by, *WRITTEN, "self", "integrator")}
    expected = ", ".join(f"{n}=" for n in rest) or "none"
    for name in options:
        if name not in rest and (name, options[name]) != ("integrator", "semi_implicit"):
            raise TypeError(f"custom_op({operation!r}): {name}={options[name]!r} is no option; expected {expected}")
    for name, default in rest.items():
        if default is inspect.Parameter.empty and name not in options:
            raise TypeError(f"custom_op({operation!r}): {name} is missing; expected {expected}")


def custom_op(dyn: Any, operation: str, **options: Any) -> Any:
    """An operation of ``dyn`` as a custom op of torch: ``torch.compile`` keeps it in its graph, gradients included.

    ::

        step = custom_op(dyn, "step", dt=2e-3)

        @torch.compile(fullgraph=True)
        def loss(q, qd, tau): ...  step(q, qd, tau) ...

    Args:
        operation: one that has gradients. options: its arguments that are no tensors.

    Returns:
        A function of the operation's tensors, by position or by name, [world, ...].

    Raises:
        ValueError: another operation.
        RuntimeError: when called, if a value of ``dyn`` is set to a tensor that requires grad: it is no input here.
    """
    known = getattr(dyn, "differentiable_by", None)
    if known is None:
        raise TypeError(f"custom_op: dyn is of type {type(dyn).__name__}; expected a Dynamics")
    if not isinstance(operation, str) or operation not in known:
        raise ValueError(f"custom_op: operation is {operation!r}; expected one of {', '.join(known)}")
    by, method = known[operation], inspect.unwrap(getattr(type(dyn), operation))
    _check_options(operation, method, by, options)
    dyn.check_gradient(operation)
    name = f"warp_spo::{operation}_{next(_made)}"

    def plain(names: str) -> _Plain:
        if dyn.values.tensors:
            raise RuntimeError(
                f"custom_op({operation!r}): {', '.join(dyn.values.tensors)} was set to a tensor that requires grad; "
                f"expected detached values; call Dynamics.{operation} itself to go back to them"
            )
        return _Plain(dyn, operation, method, options, tuple(names.split()), ())

    def forward(names: str, tensors: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        return list(plain(names).run(tensors)[1])

    def backward(names: str, wanted: str, tensors: Any, kept: Any, cotangents: Any) -> list[torch.Tensor]:
        found = plain(names).gradients(wanted.split(), tensors, tuple(kept), tuple(c.contiguous() for c in cotangents))
        return [found[name] for name in wanted.split()]

    ahead = torch.library.custom_op(name, forward, mutates_args=(), schema="(str names, Tensor[] tensors) -> Tensor[]")
    back = torch.library.custom_op(
        f"{name}_backward", backward, mutates_args=(),
        schema="(str names, str wanted, Tensor[] tensors, Tensor[] kept, Tensor[] cotangents) -> Tensor[]",
    )  # fmt: skip
    shapes = dyn.result_shapes(operation, **options)
    results = 2 if operation == "step" else 1  # what comes after them serves the way back

    @ahead.register_fake
    def _(names: str, tensors: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        if operation == "solve_mass_matrix":
            return [torch.empty_like(tensors[1])]
        return [tensors[0].new_empty(shape) for shape in shapes]

    @back.register_fake
    def _(names: str, wanted: str, tensors: Any, kept: Any, cotangents: Any) -> list[torch.Tensor]:
        given = dict(zip(names.split(), tensors, strict=True))
        return [torch.empty_like(given[name]) for name in wanted.split()]

    def setup(ctx: Any, inputs: tuple, output: list[torch.Tensor]) -> None:
        ctx.names, tensors = inputs
        ctx.count = len(tensors)
        ctx.wanted = [x.requires_grad for x in tensors]
        ctx.save_for_backward(*tensors, *output)

    def pulled(ctx: Any, cotangents: Sequence[torch.Tensor]) -> tuple:
        tensors, kept = ctx.saved_tensors[: ctx.count], ctx.saved_tensors[ctx.count :]
        names = [name for name, wanted in zip(ctx.names.split(), ctx.wanted, strict=True) if wanted]
        found = back(ctx.names, " ".join(names), list(tensors), list(kept), list(cotangents[:results]))
        rest = iter(found)
        return None, [next(rest) if wanted else None for wanted in ctx.wanted]

    ahead.register_autograd(pulled, setup_context=setup)

    def call(*args: Any, **more: Any) -> Any:
        named = (*zip(by, args, strict=False), *more.items())
        given = {n: x for n, x in named if x is not None}
        if len(args) > len(by) or len(named) > len(dict(named)) or not all(n in by for n in more):
            raise TypeError(
                f"custom_op({operation!r}): {len(args)} tensors by position and {', '.join(more) or 'none'} by name; "
                f"expected {', '.join(by)}, each once at most"
            )
        for n, x in given.items():
            if not is_tensor(x):
                raise TypeError(f"custom_op({operation!r}): {n} is of type {type(x).__name__}; expected a torch tensor")
            if forward_ad._current_level >= 0 or not torch.compiler.is_compiling():
                pointer(f"custom_op({operation!r})", n, x)
        found = ahead(" ".join(given), list(given.values()))
        return tuple(found[:results]) if results > 1 else found[0]

    return call
