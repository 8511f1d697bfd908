"""Preparation: every kernel and array that an operation needs, ahead of its first call, by calling it with zeros."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..errors import as_integer, as_names
from ..runtime import launches
from .operation import Argument, Operation, Option, derivative_of

if TYPE_CHECKING:
    from .dynamics import Dynamics


def prepare(self: Dynamics, operation: str, *more: str | tuple[str, Mapping[str, Any]], **options: Any) -> None:
    """Compile and allocate all that ``operation`` needs, so that its next call only launches.

    On CUDA all kernels, of several operations too, are compiled side by side, on all cores of the host.

    The name of the way back through an operation, torch's too, is "<operation>_vjp", such as "step_vjp", with ``wrt=``
    the names of arguments and then of values in their order; default: all arguments that are given. For
    "forward_dynamics_jvp" and "inverse_dynamics_jvp", ``along=`` names directions; default: all but "dbody_f".

    Args:
        operation: name of a method, such as "forward_dynamics".
        more: further operations, each a name, or a pair of a name and a dict of its options.
        options: of the first operation. ``frames=`` for operations that take frames, ``columns=`` for
            solve_mass_matrix, ``prescribed=`` for hybrid_dynamics, ``hold=`` for project, ``seeds=`` for
            inverse_kinematics, ``options=StepOptions(...)`` and names ``report=("qdd", "contact_f")`` for step, and
            ``body_f=True``, ``status=True``, ``target_q=True``, ``target_qd=True``, ``ctrl=True``, and ``q=True`` for
            inverse_kinematics, if they will be passed.

    Raises:
        ValueError: no such operation, option or report. TypeError: an option of a step, or a report, by itself.
    """
    pairs = [one if isinstance(one, tuple) and len(one) == 2 else (one, {}) for one in more]
    for name, own in pairs:
        if not isinstance(own, Mapping):
            raise ValueError(f"Dynamics.prepare: options of {name!r} are {own!r}; expected a dict of options by name")
    with launches.compile_side_by_side():
        for name, own in ((operation, options), *pairs):
            _prepare(self, name, dict(own))


def _prepare(dyn: Dynamics, operation: Any, options: dict[str, Any]) -> None:
    operations = dyn._operations
    backwards = {f"{name}_vjp": one for name, one in operations.items() if one.derivative is not None}
    found = operations.get(operation) if isinstance(operation, str) else None
    if isinstance(operation, str) and operation in backwards:
        _prepare_backwards(dyn, backwards[operation], options)
    elif found is not None and found.results and found.product:
        _prepare_product(dyn, found, options)
    elif found is not None and found.results:
        _prepare_operation(dyn, found, options)
    else:
        names = ", ".join(name for name, one in operations.items() if one.results and not one.product)
        raise ValueError(f"Dynamics.prepare: no operation {operation!r}; expected one of {names}")


def _prepare_operation(dyn: Dynamics, operation: Operation, options: dict[str, Any]) -> None:
    operation.entry(dyn, **stand_ins(dyn, operation, operation.expand_asked("Dynamics.prepare", options)))


def stand_ins(dyn: Dynamics, operation: Operation, options: dict[str, Any] | None = None) -> dict[str, Any]:
    """Return arguments with which an operation compiles and allocates; ``options`` are those of :func:`prepare`."""
    options = {} if options is None else options
    given = _options(dyn, operation.options, options)
    arguments = [one for one in operation.arrays if not one.asked or options.pop(one.name, False)]
    columns = options.pop("columns", None) if any(one.columns for one in arguments) else None
    _refuse_rest(operation.name, options)
    given |= {one.name: stand_in(dyn, one, given.get("frames", ()), columns) for one in arguments}
    return given | {one.name: one.stand_in(dyn, given) for one in operation.options if one.stand_in is not None}


def _prepare_backwards(dyn: Dynamics, operation: Operation, options: dict[str, Any]) -> None:
    derivative = derivative_of(operation)
    wrt = as_names("Dynamics.prepare", "wrt", options.pop("wrt", ()), ("q", "qd"))
    arrays = {one.name: one for one in operation.arrays}
    chosen = [one for one in map(arrays.__getitem__, derivative.by) if _is_given(one, options, wrt)]
    given = {one.name: stand_in(dyn, one) for one in chosen}
    more = _options(dyn, tuple(option for option in operation.options if option.read is not None), options)
    others = [arrays[name] for name in derivative.state if name in arrays and name not in derivative.by]
    more |= {one.name: stand_in(dyn, one) for one in others}
    _refuse_rest(f"{operation.name}_vjp", options)
    shapes = dyn._gradients.result_shapes(operation, **more)
    results: list[Any] = [wp.zeros(shape, dtype=dyn.dtype, device=dyn.device) for shape in shapes]
    cotangents = results[: len(operation.results)]
    for known in ([None], results) if derivative.recomputes else (results,):
        dyn._gradients.pull_back(operation, given, more, known, cotangents, wrt or tuple(given))


def _prepare_product(dyn: Dynamics, product: Operation, options: dict[str, Any]) -> None:
    """Prepare a product along directions."""
    directions = {one.name: one for one in product.arrays if one.direction}
    default = tuple(one.name for one in directions.values() if not one.asked)
    along = as_names("Dynamics.prepare", "along", options.pop("along", default), ("dq", "dqd"))
    for name in along:
        if name not in directions:
            expected = ", ".join(directions)
            raise ValueError(f"Dynamics.prepare: along names {name!r} for {product.name}; expected some of {expected}")
    named = tuple(name[1:] for name in along)
    arguments = [one for one in product.arrays if not one.direction and _is_given(one, options, named)]
    _refuse_rest(product.name, options)
    chosen = [*arguments, *map(directions.__getitem__, along)]
    product.entry(dyn, **{one.name: stand_in(dyn, one) for one in chosen})


def _is_given(argument: Argument, options: dict[str, Any], named: tuple[str, ...]) -> bool:
    return not argument.asked or options.pop(argument.name, argument.name in named)


def _options(dyn: Dynamics, declared: tuple[Option, ...], options: dict[str, Any]) -> dict[str, Any]:
    """Return the options that a method is called with, taken out of those that the caller passed to ``prepare``."""
    found: dict[str, Any] = {}
    for option in declared:
        value = options.pop(option.name, None) if option.in_prepare else None
        value = option.default(dyn.scene) if value is None else value
        if value is not None:
            found[option.name] = value
    return found


def stand_in(dyn: Dynamics, argument: Argument, frames: Sequence[Any] = (), columns: Any = None) -> wp.array:
    """Return zeros, or the neutral coordinates, for an argument."""
    if argument.axes == "world, coordinate":
        return wp.array(np.tile(dyn.scene.neutral_q, (dyn.worlds, 1)), dtype=dyn.dtype, device=dyn.device)
    shape, _ = dyn._engine.shape(argument.axes, len(frames))
    if columns is not None and argument.columns:
        count = as_integer(columns)
        if count is None or count < 0:
            raise ValueError(f"Dynamics.prepare: columns is {columns!r}; expected how many right-hand sides")
        shape = (*shape, count)
    return wp.zeros(shape, dtype=argument.dtype or dyn.dtype, device=dyn.device)


def _refuse_rest(operation: str, options: dict[str, Any]) -> None:
    if options:
        raise ValueError(f"Dynamics.prepare: {operation} has no option {', '.join(options)}")
