"""The way back through operations: gradients by arguments and by values of the scene, from declared derivatives.

Nothing is recorded. Forward dynamics is differentiated by its own solve and one Newton-Euler recursion in reverse, in
one kernel, or in two where a warp works on a limb. With embedded loops see
:mod:`warp_spo.recursions.loops.embedded_adjoints`.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import warp as wp

from ..errors import UnsupportedError, as_names
from ..execution import link_values
from ..execution.height_gradients import HeightSums
from ..execution.parameters import SHARED
from ..execution.plan import MOST_DOFS
from ..recursions.model.links import LINK_VALUES
from ..runtime import launches
from ..runtime.arrays import Call
from .call_replay import MISS, as_written, kind_of_call
from .operation import DIFFERENTIABLE, Derivative, Operation, derivative_of

if TYPE_CHECKING:
    from .dynamics import Dynamics

Pull = Callable[..., dict[str, Any]]
"""``pull(gradients, operation, given, options, results, cotangents, wrt)`` returns the gradients by name."""


class Gradients:
    """Gradients of the operations of one :class:`Dynamics`, which is ``dyn``."""

    def __init__(self, dyn: Dynamics):
        self.dyn = dyn
        self._checked: set[str] = set()  # names of operations that have gradients on this scene
        self.pass_laws: dict[tuple[str, ...], tuple[tuple[int, ...], tuple[int, ...]]] = {}  # of steps with contacts
        self.height_sums: HeightSums | None = None
        self.latest: dict[str, Callable[[tuple, dict[str, Any]], Any]] = {}  # repeats a call that torch records

    # -- for torch -------------------------------------------------------------------------------------------------
    @property
    def values(self) -> tuple[str, ...]:
        """Names of the variable values by which results can be differentiated."""
        return tuple(name for name in DIFFERENTIABLE if name in self.dyn.variable)

    def check(self, operation: Operation) -> None:
        """Raise UnsupportedError where an operation has no gradient on this scene."""
        if operation.name in self._checked:
            return
        derivative, name = derivative_of(operation), f"{operation.name}, backwards"
        self.dyn._engine.refuse(name, derivative)
        call = Call(f"Dynamics.{name}", self.dyn.device, self.dyn.dtype)
        self.check_size(call)
        lacking = derivative.lacking(self.dyn.programs.links) if self.dyn.scene.dof_count else ""
        if lacking:
            what, _, way_out = lacking.partition("; ")
            raise UnsupportedError(call.name, what, way_out)
        self._checked.add(operation.name)

    def forget(self) -> None:
        """Forget what was checked: values that kernels fold have changed."""
        self._checked.clear()
        self.pass_laws.clear()
        self.latest.clear()

    def remember(self, record: Any, tensors: list, written: tuple, guards: Any, apply: Callable[..., Any]) -> None:
        """Let the next call of an operation that torch records go without checks, if it is written as this one.

        Args:
            record: the call. tensors: its tensors. written: its arguments by position, and by name.
            guards: ``guards(tensors)`` is None if tensors are not like these; None: torch cannot tell.
            apply: ``apply(record, *tensors)`` returns the result.
        """
        find, values = as_written(*written), self.dyn.values
        found = None if find is None else find(*written)
        if find is None or found is None or guards is None or len(found) != len(tensors):
            return
        if any(x is not y for x, y in zip(found, tensors, strict=True)):
            return  # torch wants its tensors in another order

        def again(args: tuple, more: dict[str, Any]) -> Any:
            tensors = find(args, more)
            if tensors is None or values.tensors or values.stamps != record.stamps or guards(tensors) is None:
                return MISS
            return apply(record, *tensors)

        self.latest[record.operation.name] = again

    def check_size(self, call: Call) -> None:
        """Raise UnsupportedError where the scene has too many dofs for derivatives."""
        dofs = self.dyn.scene.dof_count
        if dofs > MOST_DOFS:
            way = f"derivatives are straight-line code, of up to {MOST_DOFS} dof"
            raise UnsupportedError(call.name, f"a scene of {dofs} dof", way)

    def result_shapes(self, operation: Operation, frames: Sequence[Any] = (), **_: Any) -> list[tuple[int, ...]]:
        """Return the shapes of the results, and of what the way back needs besides; a result like b has b's."""
        derivative, shape = derivative_of(operation), self.dyn._engine.shape
        kept = [argument.axes for argument in operation.arrays if argument.name in derivative.keeps]
        return [shape(axes, len(frames))[0] for axes in (*(result.axes for result in operation.results), *kept)]

    def pull_back(
        self,
        operation: Operation,
        given: dict[str, Any],
        options: dict[str, Any],
        results: Sequence[Any],
        cotangents: Sequence[Any],
        wrt: Sequence[str],
    ) -> dict[str, Any]:
        """Return gradients by name of a call with the arguments ``given``, for the cotangents of its results.

        Args:
            options: arguments that are no arrays. results: of the call, and what else its derivative keeps.
            wrt: names of arguments and of values.
        """
        replays, arguments = self.dyn._replays, (given, options, results, cotangents, wrt)
        flat = {**given, **options, "wrt": tuple(wrt)}
        found, key, arrays = replays.replay(f"{operation.name}, backwards", (*results, *cotangents), flat)
        if found is not MISS:
            return found
        numbers = tuple(options[option.name] for option in operation.options if option.name in options)
        if kind_of_call(operation.name, numbers, {})[1]:  # a tensor for dt, for example
            key = None
        return replays.run(key, arrays, lambda: self._pull_back(operation, *arguments), all_taken=False)

    def _pull_back(
        self, operation: Operation, given: dict, options: dict, results: Any, cotangents: Any, wrt: Any
    ) -> dict[str, Any]:
        derivative = derivative_of(operation)
        self.dyn._engine.refuse(f"{operation.name}, backwards", derivative)
        if derivative.pull is not None:
            return derivative.pull(self, operation, given, options, results, cotangents, wrt)
        (result,), (cotangent,) = results, cotangents
        return self.pull_back_kernel(operation, given, options, result, cotangent, wrt)

    def pull_back_kernel(
        self,
        operation: Operation,
        given: dict[str, Any],
        options: dict[str, Any],
        result: Any,
        cotangent: Any,
        wrt: Sequence[str],
    ) -> dict[str, Any]:
        """Return gradients of an operation with one result by launching its declared kernel, as :meth:`pull_back`."""
        derivative, shape, engine = derivative_of(operation), tuple(result.shape), self.dyn._engine
        with engine.call_named(f"{operation.name}, backwards") as call:
            state = {name: array for name, array in given.items() if name in derivative.state}
            arrays = engine.read(call, operation, **state)
            arrays["cotangent"] = call.read("cotangent", cotangent, shape)
            arrays |= engine.read(call, operation, **options)
            if derivative.reads:
                arrays[derivative.reads] = call.read("result", result, shape)
            names, outs = self.prepare_outputs(call, operation, {}, wrt, None)
            self.launch(derivative, names, outs, arrays)
        return by_name(names, call.result)

    @contextlib.contextmanager
    def at_values(self, values: dict[str, Any]) -> Iterator[None]:
        """Set variable values of the scene inside the block, and what they were before after it."""
        if not values:
            yield
            return
        dyn = self.dyn
        parameters = dyn.recursions.parameters
        with Call("Dynamics.set", dyn.device, dyn.dtype, call_order=dyn.recursions.call_order) as call:
            arrays, before = {}, {}
            for name, value in values.items():
                shape = dyn.scene.values[name].shape[1:]
                arrays[name] = call.read(name, value, (dyn.worlds, *shape) if value.ndim > len(shape) else shape)
            call.order()
            for name in arrays:  # on the stream that read has entered
                before[name] = wp.clone(parameters.value(name))
            parameters.set(arrays)
            try:
                yield
            finally:
                for name, value in before.items():
                    launches.copy(parameters.value(name), value)
                parameters.refresh(values)

    # -- steps of the methods --------------------------------------------------------------------------------------
    def prepare_outputs(
        self, call: Call, operation: Operation, given: dict[str, Any], wrt: Sequence[str], out: dict[str, Any] | None
    ) -> tuple[tuple[str, ...], list[wp.array]]:
        """Check the names ``wrt`` by which a gradient is asked for; return them, and an array for the gradient by each.

        Names are those of arguments, "tangent" for the first argument along its tangent coordinates, and values of the
        scene that kernels read from memory. tau may be left out: its gradient does not read it.

        Args:
            given: arguments by name, None where one was left out. out: the caller's arrays by name; others are made.
        """
        self.check_size(call)
        derivative = derivative_of(operation)
        arguments, scene_values = derivative.by, derivative.values
        names = as_names(call.name, "wrt", wrt, arguments[:2])
        if not isinstance(out, Mapping | None):
            raise TypeError(f"{call.name}: out is of type {type(out).__name__}; expected a dict, arrays by name of wrt")
        out = out or {}
        accepted = (*arguments[:1], "tangent", *arguments[1:], *(name for name in scene_values if self._varies(name)))
        for name in names:
            if name in scene_values and name not in accepted:
                way = f"build Dynamics with variable=({name!r},)"
                raise ValueError(f"{call.name}: wrt names {name!r}, which is folded into the kernels; {way}")
            if name not in accepted:
                raise ValueError(f"{call.name}: wrt names {name!r}; expected some of {', '.join(accepted)}")
            if name in given and given[name] is None and name != "tau":
                raise ValueError(f"{call.name}: wrt names {name!r}, which is None; pass zeros to differentiate by it")
        if not names or len(set(names)) < len(names):
            raise ValueError(f"{call.name}: wrt is {names!r}; expected one name or more, each once")
        for name in out:
            if name not in names:
                raise ValueError(f"{call.name}: out has {name!r}; expected names out of wrt: {', '.join(names)}")
        shapes = {name: self.shape_of(operation, name) for name in names}
        return names, [call.write(out.get(n), shapes[n], f"[world, ...] like {n}", name=f"out[{n!r}]") for n in names]

    def _varies(self, name: str) -> bool:
        return name in self.dyn.variable or self.dyn.scene.values[name].shape[0] > 1

    def shape_of(self, operation: Operation, name: str) -> tuple[int, ...]:
        """Return the shape of the gradient by an argument, by a value of the scene, or along "tangent" coordinates."""
        if name in DIFFERENTIABLE:
            shape = self.dyn.scene.values[name].shape[1:]
            return shape if name in SHARED else (self.dyn.worlds, *shape)
        axes = {argument.name: argument.axes for argument in operation.arrays}
        return self.dyn._engine.shape(axes.get(name, "world, dof"))[0]

    def launch(
        self, derivative: Derivative, names: tuple[str, ...], outs: Sequence[wp.array], given: dict[str, Any]
    ) -> None:
        """Launch a derivative; gradients by values of the scene follow from those by the values of its links."""
        dyn, results = self.dyn, {name: out for name, out in zip(names, outs, strict=True) if out.size}
        values = {name: results.pop(name) for name in names if name in LINK_VALUES and name in results}
        if dyn.scene.dof_count == 0:
            for array in outs:
                launches.fill(array, 0)
        if dyn.scene.dof_count == 0 or not (results or values):
            return
        if values:
            dyn.programs.links.with_tables()  # fills the table
            size = len(dyn.programs.links.tables["value"])
            results["value"] = dyn.recursions.array("value of derivatives", dyn.worlds, size)
        first, *more = results
        further = {f"{name}_bar": results[name] for name in more}
        if derivative.launch is None:
            dyn._engine.launch(derivative, results[first], further, wrt=tuple(results), **given)
        else:
            derivative.launch(dyn, derivative, results[first], further, wrt=tuple(results), **given)
        if values:
            flat = {name: array.reshape((dyn.worlds, math.prod(array.shape[1:]))) for name, array in values.items()}
            link_values.pull_back(dyn.recursions.parameters, dyn.programs.links, results["value"], flat)

    def push(self, call: Call, operation: Operation, given: dict[str, Any], along: dict[str, Any], out: Any) -> None:
        """Launch a derivative along a direction.

        Args:
            operation: the product. given: its arrays by name. along: directions, "dq" and so on. out: the caller's.
        """
        arrays = given | {f"{name[1:]}_dot": rate for name, rate in along.items()}
        for array in ("qd", "qdd", "body_f"):
            if arrays.get(array) is None and arrays.get(f"{array}_dot") is not None:
                raise ValueError(f"{call.name}: d{array} is given and {array} is None; expected both; pass zeros")
        self.check_size(call)
        (result,) = self.dyn._engine.write(call, operation, (out,), {})
        self.dyn._engine.launch(operation, result, **arrays)


def by_name(names: tuple[str, ...], results: Any) -> dict[str, Any]:
    """Return the results of a call by name."""
    return dict(zip(names, results if len(names) > 1 else (results,), strict=True))
