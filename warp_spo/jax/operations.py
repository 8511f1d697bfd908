"""One operation with a given set of arguments, as a JAX function with a gradient of its own."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import warp as wp
from jax.custom_derivatives import SymbolicZero

from ..dynamics.operation import derivative_of
from ..dynamics.preparation import stand_in
from ..execution.parameters import SHARED
from .ffi import forms_of, traceable

if TYPE_CHECKING:
    from .functions import Function

Arrays = tuple[Any, ...]
Traced = Callable[..., tuple[jax.Array, ...]]


class JaxOperation:
    """A :class:`Function` for some of its arguments, all of which are [row, ...].

    To make one compiles the kernels and runs them once, ahead of XLA's graphs.

    Args:
        function: the function.
        columns: names of the arguments, and how many right-hand sides each has; None where it has no axis for them.
        alone: whether ``vmap`` makes the worlds.
    """

    def __init__(self, function: Function, columns: dict[str, int | None], alone: bool):
        self.function, self.dyn, self.operation = function, function.dyn, function.operation
        self.options, self.columns, self.alone = function.options, columns, alone
        needed = filter(function.is_needed, function.arguments)
        self._absent: dict[str, Any] = {name: None for name in needed if name not in columns}
        self._once: JaxOperation | None = None  # one of several repetitions
        self._status = ("status",) if function.status else ()
        self._traced: dict[bool | tuple[str, ...], Traced] = {}
        results = self._compute(self._samples())
        self.kind = type(results)
        self.count = 1 if isinstance(results, wp.array) else len(results)
        self._traced[False] = self._forward(False)
        self.call = jax.custom_vjp(self._result)
        if function.repeated[0] == 1:
            self.call.defvjp(self._result_and_residuals, self._pull_back, symbolic_zeros=True)
        else:
            self.call.defvjp(self._repeat, lambda pull, cotangents: pull(cotangents))

    def __call__(self, *arrays: Any) -> Any:
        return self.call(*arrays)

    # -- forward ---------------------------------------------------------------------------------------------------
    def _samples(self) -> dict[str, wp.array]:
        """Return arguments to compile with, [world, ...]."""
        arguments, frames = self.function.arguments, self.options.get("frames", ())
        values, T = self.function.values, self.dyn.dtype
        given = {name: count for name, count in self.columns.items() if name not in values}
        found = {name: stand_in(self.dyn, arguments[name], frames, count) for name, count in given.items()}
        own = {name: self.dyn.recursions.parameters.value(name).numpy() for name in values}
        return found | {name: wp.array(own[name], dtype=T, device=self.dyn.device) for name in values}

    def _compute(self, given: dict[str, wp.array], **more: Any) -> Any:
        with self._at_values(given) as arrays:
            return self.operation.entry(self.dyn, **self._absent, **arrays, **self.options, **more)

    @contextlib.contextmanager
    def _at_values(self, given: dict[str, wp.array]) -> Iterator[dict[str, wp.array]]:
        """Return the arguments of the operation, and set the values of the scene among those given in the block."""
        names = self.function.values
        if not names:
            yield given
            return
        values = {name: given[name][0] if name in SHARED else given[name] for name in names}
        with self.dyn.recursions.call_order.lock, self.dyn._gradients.at_values(values):
            yield {name: array for name, array in given.items() if name not in names}

    def _arrays_to_write(self, names: tuple[str, ...]) -> dict[str, wp.array]:
        """Return arrays for arguments that the operation writes."""
        dyn, arguments = self.dyn, {one.name: one for one in self.operation.arrays}
        shapes = {name: dyn._engine.shape(arguments[name].axes)[0] for name in names}
        types = {name: arguments[name].dtype or dyn.dtype for name in names}
        return {name: wp.empty(shapes[name], dtype=types[name], device=dyn.device) for name in names}

    def _run_once(self, keep: bool) -> tuple[dict[str, wp.array], tuple[wp.array, ...], dict[str, wp.array]]:
        """Return arguments of one call, its results, and what it writes: the status, and what the derivative keeps."""
        keeps = self.operation.derivative.keeps if keep and self.operation.derivative else ()
        given, written = self._samples(), self._arrays_to_write((*self._status, *keeps))
        results = self._compute(given, **written, **self._further_options(keep))
        return given, (results,) if self.count == 1 else tuple(results), written

    def _further_options(self, keep: bool) -> dict[str, Any]:
        """Return the options that a call with a way back has besides those of the caller."""
        derivative = self.operation.derivative
        return derivative.adds(self.dyn) if keep and derivative is not None else {}

    def _forward(self, keep: bool) -> Traced:
        """Return the operation as a JAX function; its results are followed by what else it writes."""
        given, results, written = self._run_once(keep)
        added = self._further_options(keep)

        def run(inputs: Arrays, outputs: Arrays) -> None:
            for part in self._parts(inputs[0].shape[0]):
                found = [part(array) for array in outputs]
                out = found[0] if self.count == 1 else tuple(found[: self.count])
                more = dict(zip(written, found[self.count :], strict=True))
                self._compute(dict(zip(given, map(part, inputs), strict=True)), out=out, **more, **added)

        forms = forms_of((*results, *written.values()))
        name, read = self.operation.name, forms_of(given.values())
        return self._first_order(traceable(name, run, read, forms, self.function.capture))

    def _parts(self, rows: int) -> Iterator[Callable[[wp.array], wp.array]]:
        """Return functions that take as many rows of an array as there are worlds, part after part.

        Of a value that all worlds share they take one.
        """
        self.function.check_rows(rows, self.alone)
        worlds = self.dyn.worlds
        if rows == worlds:
            yield lambda array: array
            return
        for number in range(rows // worlds):
            yield functools.partial(_part, number, rows // worlds)

    def _as_results(self, found: Arrays) -> Any:
        """Return arrays as the operation returns them: one array, a tuple, or a named tuple; with status, a tuple."""
        found = found[: self.count + len(self._status)]
        if self._status:
            return tuple(found)
        if self.count == 1:
            return found[0]
        return self.kind(*found) if hasattr(self.kind, "_fields") else tuple(found)

    def _result(self, *arrays: Any) -> Any:
        return self._as_results(self._traced[False](*arrays))

    # -- backward --------------------------------------------------------------------------------------------------
    @property
    def _refusal(self) -> str:
        """Return in words which argument has no gradient, and what is expected; "" if there is a gradient."""
        derivative = self.operation.derivative
        if derivative is None:
            known = ", ".join(name for name, one in self.dyn._operations.items() if one.derivative is not None)
            return f"it has no gradient; expected one of {known}"
        return derivative.refuses(self.dyn, dict(self.options))

    def _repeat(self, *arrays: Any) -> tuple[Any, Any]:
        """Return the result of repetitions, and the way back through each of them."""
        times, single = self.function.repeated
        if self._once is None:
            self._once = JaxOperation(single, self.columns, self.alone)
        once = self._once
        names = [result.name for result in self.operation.results]

        def repeat(*arrays: Any) -> Any:
            given, found = dict(zip(self.columns, arrays, strict=True)), None
            for _ in range(times):
                found = once(*given.values())
                given |= dict(zip(names, found, strict=True))
            return found

        return jax.vjp(repeat, *arrays)

    def _result_and_residuals(self, *primals: Any) -> tuple[Any, Any]:
        """Return the result, and what the way back reads. JAX keeps the keys of a dictionary while it traces."""
        arrays = tuple(one.value for one in primals)
        wanted: dict = {name: () for name, one in zip(self.columns, primals, strict=True) if one.perturbed}
        keep = not self._refusal
        if keep not in self._traced:
            self._traced[keep] = self._forward(keep)
        found = self._traced[keep](*arrays)
        return self._as_results(found), (wanted, arrays, found)

    def _check_gradient(self, wanted: tuple[str, ...]) -> None:
        """Raise an error if a gradient is asked for that the operation does not have."""
        refused = self._refusal
        if refused:
            raise ValueError(
                f"{self.function.name}, backwards: {refused}; if no gradient should pass, put jax.lax.stop_gradient "
                f"around the result"
            )
        derivative = derivative_of(self.operation)
        by = *derivative.by, *(name for name in self.function.values if name in derivative.values)
        lacking = [name for name in wanted if name not in by]
        if lacking:
            raise ValueError(
                f"{self.function.name}: it has no gradient by {lacking[0]}; expected gradients by "
                f"{', '.join(by)}; pass jax.lax.stop_gradient({lacking[0]})"
            )
        several = [name for name, count in self.columns.items() if count is not None]
        if several:
            raise ValueError(
                f"{self.function.name}: {several[0]} has an axis of columns, for which JAX gets no gradient; expected "
                f"one column; map over them: jax.vmap(function, in_axes=..., out_axes=-1)"
            )
        self.dyn._gradients.check(self.operation)

    def _pull_back(self, residuals: Any, cotangents: Any) -> tuple:
        wanted, arrays, found = residuals
        self._check_gradient(tuple(wanted))
        given = tuple(cotangents)[: self.count] if self._status or self.count > 1 else (cotangents,)
        whole = [jnp.zeros(one.shape, one.dtype) if isinstance(one, SymbolicZero) else one for one in given]
        names = tuple(wanted)
        if names not in self._traced:
            self._traced[names] = self._backward(names)
        gradients = self._traced[names](*arrays, *found, *whole)
        by_name = dict(zip(wanted, gradients, strict=True))
        return tuple(by_name.get(name) for name in self.columns)

    def _first_order(self, launch: Traced) -> Traced:
        """Return a function with a way back that raises: JAX asks for it only where it differentiates a gradient."""

        def refuse(residuals: Any, cotangents: Any) -> Any:
            raise ValueError(
                f"{self.function.name}: its gradient is differentiated once more; expected first derivatives only, "
                f"because they are analytic and not traced; take finite differences of gradients for second derivatives"
            )

        guarded = jax.custom_vjp(launch)
        guarded.defvjp(lambda *arrays: (launch(*arrays), None), refuse)
        return guarded

    def _backward(self, wanted: tuple[str, ...]) -> Traced:
        """Return the gradients by some arguments as a JAX function of what the call read and wrote, and cotangents."""
        given, results, written = self._run_once(True)
        sizes = len(given), len(results) + len(written)

        def pull(arrays: Arrays) -> list[wp.array]:
            known = dict(zip(given, arrays, strict=False))
            computed, cotangents = list(arrays[sizes[0] : sum(sizes)]), arrays[sum(sizes) :]
            del computed[self.count : self.count + len(self._status)]
            gradients = self.dyn._gradients
            with self._at_values(known) as mine:
                found = gradients.pull_back(self.operation, mine, self.options, computed, cotangents, wanted)
            return [found[name].reshape((1, *found[name].shape)) if name in SHARED else found[name] for name in wanted]

        def run(inputs: Arrays, outputs: Arrays) -> None:
            for part in self._parts(inputs[0].shape[0]):
                for out, found in zip(outputs, pull(tuple(map(part, inputs))), strict=True):
                    wp.copy(part(out), found)

        read = (*given.values(), *results, *written.values(), *results)
        name = f"{self.operation.name}_vjp"
        return self._first_order(traceable(name, run, forms_of(read), forms_of(pull(read)), False))


def _part(number: int, count: int, array: wp.array) -> wp.array:
    """Return one of ``count`` parts of the rows of an array, which shares its memory."""
    rows = array.shape[0] // count
    return array[number * rows : (number + 1) * rows]
