"""The steps that every operation shares: check and read the arguments, make the results, find the kernel, launch it."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..errors import UnsupportedError
from ..execution.routine import Routine
from ..runtime import launches
from ..runtime.arrays import Call
from ..runtime.autograd import records_gradient
from .operation import Argument, Closed, Derivative, Operation, Refused, Result

if TYPE_CHECKING:
    from ..execution.programs import Program
    from .dynamics import Dynamics

OPEN_TREE = "loops='cut' leaves the loops open"
COUNTS = {2: "a pair of arrays", 3: "three arrays"}


class Engine:
    """Runs the declared operations of one :class:`Dynamics`."""

    def __init__(self, dyn: Dynamics):
        self._dyn = dyn
        self._shapes: dict[tuple[str, int, int], tuple[tuple[int, ...], str]] = {}

    @functools.cached_property
    def branch(self) -> launches.Branch:
        """A second stream, for work of a call that runs beside the rest of it."""
        return launches.Branch(self._dyn.device)

    # -- calls -----------------------------------------------------------------------------------------------------
    def run(self, operation: Operation, out: Any = None, entries: int = 0, **given: Any) -> Any:
        """Run an operation whose kernel computes all of it; return what the caller gets.

        Args:
            out: the caller's ``out=``. entries: of a packed result.
            given: the caller's arguments by name.
        """
        with self.call(operation) as call:
            outs = self.outs(call, operation, out)
            arguments = self.read(call, operation, **given)
            results = self.write(call, operation, outs, arguments, entries)
            more = None
            if len(results) > 1:
                more = {f"{r.name}_out": array for r, array in zip(operation.results[1:], results[1:], strict=True)}
            self.launch(operation, results[0], more, **arguments)
        return call.result

    def call(self, operation: Operation) -> Call:
        """Begin a call of an operation.

        Raises:
            UnsupportedError: it has no form for the loops of this Dynamics.
            ValueError: a value of the scene requires grad.
        """
        self.refuse(operation.name, operation)
        return self.call_named(operation.name)

    def call_named(self, name: str) -> Call:
        """Begin a call that errors name so."""
        values = self._dyn.values
        if values.tensors and records_gradient((), values):
            names = ", ".join(values.tensors)
            raise ValueError(
                f"Dynamics.{name}: {names} was set to a tensor that requires grad; derivatives are not available "
                f"through this call; call inside torch.no_grad(), or set {names} to detached tensors"
            )
        return Call(f"Dynamics.{name}", self._dyn.device, self._dyn.dtype, call_order=self._dyn.recursions.call_order)

    def refuse(self, name: str, form: Operation | Derivative) -> None:
        """Raise UnsupportedError if an operation, or a derivative, has no form for the loops of this Dynamics."""
        if self._dyn.scene.shares_dofs and isinstance(form, Operation) and isinstance(form.sharing, Refused):
            way = form.sharing.way_out or "leave out modes and rotors"
            raise UnsupportedError(f"Dynamics.{name}", "a scene with flexible bodies or rotors", way)
        if not self._dyn.closed:
            return
        closures = self._dyn._closures
        closed: Closed = form.multipliers if closures.embedding is None else form.embed
        if isinstance(closed, Refused):
            what = closed.what or f"loops={closures.loops!r}"
            way = f"{closed.way_out}; {OPEN_TREE}" if closed.way_out else OPEN_TREE
            raise UnsupportedError(f"Dynamics.{name}", what, way)

    # -- arguments and results -------------------------------------------------------------------------------------
    def read(self, call: Call, operation: Operation, **given: Any) -> dict[str, Any]:
        """Return Warp arrays, then options, by name; arguments that are not ``given`` are left out.

        Raises:
            TypeError, ValueError: an argument is not what the declaration says.
        """
        options: dict[str, Any] = {}
        for option in operation.options:
            if option.name in given:
                value = given[option.name]
                options[option.name] = value if option.read is None else option.read(self._dyn.scene, call, value)
        frames = len(options["frames"]) if "frames" in options else 0
        found: dict[str, Any] = {}
        for argument in operation.arrays:
            name = argument.name
            if name in given:
                array = given[name]
                found[name] = None if array is None and argument.optional else self._read(call, argument, array, frames)
        found.update(options)
        return found

    def _read(self, call: Call, argument: Argument, array: Any, frames: int) -> wp.array | float:
        """Return one array argument, or the number that is given in its place."""
        if argument.number and isinstance(array, int | float | np.number) and not isinstance(array, bool):
            return float(array)
        shape, meaning = self.shape(argument.axes, frames)
        if argument.written:
            return call.update(argument.name, array, shape, meaning, dtype=argument.dtype)
        if argument.columns:
            of_array: tuple[int, ...] = tuple(getattr(array, "shape", ()))
            shape = (*shape, of_array[-1]) if len(of_array) == len(shape) + 1 else shape
            meaning = f"{meaning} or {meaning[:-1]}, columns]"
        try:
            return call.read(argument.name, array, shape, meaning)
        except ValueError:
            if argument.name == "tau" and self._dyn.embedding is not None:
                self._refuse_independent(call, array)
            raise

    def _refuse_independent(self, call: Call, tau: Any) -> None:
        """Raise ValueError if ``tau`` has entries for the independent dofs alone, as inverse dynamics returns it."""
        worlds, dofs, width = self._dyn.worlds, self._dyn.scene.dof_count, len(self._dyn.independent_dofs)
        if tuple(tau.shape) == (worlds, width) and width != dofs:
            raise ValueError(
                f"{call.name}: tau {tuple(tau.shape)} has entries for dyn.independent_dofs alone; expected "
                f"({worlds}, {dofs}) [world, dof]; pass full, zeros of that shape, after "
                f"full[:, dyn.independent_dofs] = tau"
            )

    def outs(self, call: Call, operation: Operation, out: Any) -> tuple[Any, ...]:
        """Return the caller's array for each result, or None.

        Raises:
            TypeError: as many arrays as there are results were expected, in a tuple.
        """
        count = len(operation.results)
        if count == 1:
            return (out,)
        if not isinstance(out, tuple | list) or len(out) != count:
            names = ", ".join(result.name for result in operation.results)
            raise TypeError(f"{call.name}: out is {out!r}; expected {COUNTS[count]} or None, ({names})")
        return tuple(out)

    def write(
        self, call: Call, operation: Operation, outs: tuple[Any, ...], arguments: dict[str, Any], entries: int = 0
    ) -> list[wp.array]:
        """Return the Warp array of each result."""
        frames = len(arguments["frames"]) if "frames" in arguments else 0
        if len(outs) == 1:
            (result,) = operation.results
            shape, meaning = self.shape_of(result, arguments, frames, entries)
            return [call.write(outs[0], shape, meaning, dtype=result.dtype, over=result.over)]
        found = []
        for index, (result, out) in enumerate(zip(operation.results, outs, strict=True)):
            shape, meaning = self.shape_of(result, arguments, frames, entries)
            found.append(call.write(out, shape, meaning, name=f"out[{index}]", dtype=result.dtype, over=result.over))
        return found

    def shape_of(
        self, result: Result, arguments: dict[str, Any], frames: int = 0, entries: int = 0
    ) -> tuple[tuple[int, ...], str]:
        """Return the shape of a result, and its axes for errors."""
        if result.like:
            return tuple(arguments[result.like].shape), f"like {result.like}"
        return self.shape(result.axes, frames, entries)

    def shape(self, axes: str, frames: int = 0, entries: int = 0) -> tuple[tuple[int, ...], str]:
        """Return the shape of an array with these axes, and the axes for errors."""
        key = axes, frames, entries
        known = self._shapes.get(key)
        if known is None:
            sizes = tuple(self._size(axis, frames, entries) for axis in axes.split(", "))
            words = axes if self._dyn.embedding is not None else axes.replace("independent dof", "dof")
            known = self._shapes[key] = sizes, f"[{words}]"
        return known

    def _size(self, axis: str, frames: int, entries: int) -> int:
        dyn = self._dyn
        if axis == "independent dof":
            return len(dyn.independent_dofs)
        if axis == "row":
            return dyn.closure_rows
        if axis.isdigit():
            return int(axis)
        if axis.endswith(" frames"):
            return int(axis.split()[0]) * frames
        if axis.endswith(" bodies"):
            return int(axis.split()[0]) * dyn.scene.body_count
        return {
            "world": dyn.worlds,
            "coordinate": dyn.scene.coord_count,
            "dof": dyn.scene.dof_count,
            "body": dyn.scene.body_count,
            "actuator": len(dyn.scene.actuators),
            "contact": dyn.scene.contact_count,
            "frame": frames,
            "entry": entries,
        }[axis]

    # -- launches --------------------------------------------------------------------------------------------------
    def launch(
        self, form: Operation | Derivative, out: wp.array, more: dict[str, wp.array] | None = None, **given: Any
    ) -> bool:
        """Launch an operation, or a derivative, in its form for the loops of this Dynamics; as :meth:`launch_routine`.

        Where an operation has a kernel of its own for embedded loops, that kernel runs.
        """
        embedding = self._dyn.embedding
        if embedding is not None and isinstance(form.embed, Routine):
            return self.launch_routine(form.embed, out, more, **given, embedding=embedding)
        assert form.routine is not None
        return self.launch_routine(form.routine, out, more, **given)

    def launch_routine(
        self, routine: Routine, out: wp.array, more: dict[str, wp.array] | None = None, **given: Any
    ) -> bool:
        """Launch a routine.

        Args:
            out: the result, [world, ...]. more: further results by name.
            given: arrays [world, ...] and numbers that the kernel reads, and options of its trace; None is left out.

        Returns:
            Whether it ran as sweeps, which leave their intermediate results in the workspace.
        """
        dyn, more = self._dyn, more or {}
        if not routine.has_node_form:
            if out.size == 0:
                return False
            if dyn.scene.dof_count == 0:
                launches.fill(out, 0)
                return False
        program, arrays, options = self._find(routine, out, more, given)
        if program is None:
            assert routine.sweeps is not None, f"{routine.name} has no form for this scene"
            routine.sweeps(dyn.recursions, out, **arrays, **more, **options)
            return True
        dyn.programs.launch(program, arrays, out, *more.values())
        return False

    def has_program(self, routine: Routine, out: wp.array, more: dict[str, wp.array], **given: Any) -> bool:
        """Return whether one kernel computes a routine for these arguments; as :meth:`launch_routine`."""
        return bool(out.size and self._dyn.scene.dof_count) and self._find(routine, out, more, given)[0] is not None

    def _find(
        self, routine: Routine, out: wp.array, more: dict[str, wp.array], given: dict[str, Any]
    ) -> tuple[Program | None, dict[str, Any], dict[str, Any]]:
        """Return the program of a routine, and the arrays and the options among the arguments ``given``."""
        arrays = {name: value for name, value in given.items() if isinstance(value, wp.array | float)}
        options = {name: value for name, value in given.items() if value is not None and name not in arrays}
        shapes = {name: getattr(array, "shape", ()) for name, array in arrays.items()}
        further = {name: array.shape for name, array in more.items()}
        return self._dyn.programs.find(routine, shapes, out.shape, further, **options), arrays, options
