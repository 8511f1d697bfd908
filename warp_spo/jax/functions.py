"""Operations of a Dynamics as functions for ``jit``, ``grad`` and ``vmap``, with the declared derivatives."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
import warp as wp

from ..dynamics.operation import Argument
from ..errors import as_names
from ..execution.parameters import SHARED
from ..runtime.arrays import Call
from .operations import JaxOperation

if TYPE_CHECKING:
    from ..dynamics.dynamics import Dynamics
    from ..dynamics.operation import Operation


def function(
    dyn: Dynamics, operation: str, *, capture: bool = False, values: Sequence[str] = (), **options: Any
) -> Function:
    """Return an operation of ``dyn`` as a function of JAX arrays, which ``jit``, ``grad`` and ``vmap`` transform.

    ::

        step = warp_spo.jax.function(dyn, "step", dt=2e-3)

        @jax.jit
        def height(q, qd, tau):                     # [world, ...], for all worlds of dyn
            q, qd = step(q, qd, tau)
            return q[:, 2].sum()

        jax.grad(height, argnums=2)(q, qd, tau)
        jax.vmap(step)(q, qd, tau)                  # the same as step(q, qd, tau): vmap's axis is the world

    The function takes the operation's arrays by position or by name, and None where the method does. They are
    ``[world, ...]``, or ``[...]`` of one world where ``vmap`` makes the batch. A batch of several times as many rows as
    ``dyn`` has worlds is computed that many rows at a time. Kernels run on XLA's device and stream, at the values of
    the scene that ``dyn`` has then.
    Gradients are those that torch gets, of first order; ``jvp`` and ``jacfwd`` are refused by JAX. Values of the scene
    that ``values`` names are arguments, too, with gradients: each call computes with those that it is given, and leaves
    those of ``dyn`` as they are::

        step = warp_spo.jax.function(dyn, "step", dt=2e-3, values=("body_mass",))
        jax.grad(lambda mass: step(q, qd, tau, body_mass=mass)[0][:, 2].sum())(mass)        # [world, body]

    Args:
        dyn: The Dynamics. It lives as long as the process, because XLA never forgets a function.
        operation: Name of a method, such as "forward_dynamics", "inverse_dynamics" or "step".
        capture: Let XLA capture the launches of the operation (not of its gradient) in its CUDA graphs, which saves the
            way through Python. After :meth:`Dynamics.set` of a value that is not ``variable``, such graphs are out of
            date.
        values: Names of values of the scene among ``variable`` of ``dyn``, which the function takes by name:
            ``[world, ...]``, or ``[...]`` of one world under ``vmap``; ``ground_heights`` as :meth:`Dynamics.set` takes
            them, for all worlds. They cost four launches more in each direction.
        options: The operation's arguments that are not arrays, such as ``dt``, ``frames`` and a step's ``options``.
            With ``status=True``, for operations that take it, the status [world], int32, follows the results.

    Raises:
        TypeError: ``dyn`` is no Dynamics, or the options are not those of the operation.
        ValueError: No such operation; float64, while JAX's ``jax_enable_x64`` is off; a value that is not variable, or
            values with ``capture``.
    """
    if not hasattr(dyn, "_operations"):
        raise TypeError(f"warp_spo.jax.function: dyn is of type {type(dyn).__name__}; expected a Dynamics")
    known = {name: one for name, one in dyn._operations.items() if one.results and not one.product}
    if not isinstance(operation, str) or operation not in known:
        raise ValueError(f"warp_spo.jax.function: operation is {operation!r}; expected one of {', '.join(known)}")
    names = as_names("warp_spo.jax.function", "values", values, ("gravity",))
    options = known[operation].expand(f"warp_spo.jax.function({operation!r})", options)
    return Function(dyn, known[operation], options, capture, names)


class Function:
    """An operation that JAX traces; :func:`function` makes it."""

    def __init__(
        self, dyn: Dynamics, operation: Operation, options: dict[str, Any], capture: bool, values: tuple[str, ...]
    ):
        self.name = f"warp_spo.jax.function({operation.name!r})"
        self.dyn, self.operation, self.options = dyn, operation, dict(options)
        self.capture, self.values = capture, values
        self._check_values()
        self.arguments = {one.name: one for one in operation.arrays if not one.written}
        self.arguments |= {name: Argument(name, "world, ...") for name in values}
        self._programs: dict[tuple, JaxOperation] = {}
        self.status = self._takes_status()
        self._check_options()
        self._check_precision()

    def __repr__(self) -> str:
        return f"{self.name} of {self.dyn.scene!r}"

    def __call__(self, *arrays: Any, **more: Any) -> Any:
        self._check_precision()
        given = {name: self._as_array(name, array) for name, array in self._bind(arrays, more).items()}
        first = next(iter(given))
        alone = given[first].ndim == len(self._shape(self.arguments[first])) - 1
        given = {name: array[None] if self._is_shared(name, alone) else array for name, array in given.items()}
        for name, array in given.items():
            self._check_shape(name, array, alone)
        if alone:
            if not any(isinstance(array, jax.core.Tracer) for array in given.values()):
                self.check_rows(1, alone)
            given = {name: array[None] for name, array in given.items()}
        columns = {name: array.shape[-1] if self._has_columns(name, array) else None for name, array in given.items()}
        key = alone, tuple(columns.items())
        if key not in self._programs:
            self._programs[key] = JaxOperation(self, columns, alone)
        found = self._programs[key](*given.values())
        return jax.tree.map(lambda x: x[0], found) if alone else found

    @functools.cached_property
    def repeated(self) -> tuple[int, Function]:
        """Return how often the operation runs for one call, and the function of one run, which has the gradient."""
        options = dict(self.options)
        derivative = self.operation.derivative
        times = 1 if derivative is None else derivative.repeats(self.name, options)
        once = self if times == 1 else Function(self.dyn, self.operation, options, self.capture, self.values)
        return times, once

    def _has_columns(self, name: str, array: Any) -> bool:
        """Whether an argument [row, ...] has an axis of right-hand sides."""
        return array.ndim > len(self._shape(self.arguments[name]))

    # -- checks ----------------------------------------------------------------------------------------------------
    def _takes_status(self) -> bool:
        """Take ``status`` out of the options, and return whether it is asked for."""
        asked = self.options.get("status", False)
        if asked is False or "status" not in (one.name for one in self.operation.arrays):
            return False
        if asked is not True:
            raise TypeError(f"{self.name}: status is {asked!r}; expected True, by which it is one of the results")
        del self.options["status"]
        return True

    def _check_options(self) -> None:
        expected = [one.name for one in self.operation.options if one.name in self.operation.parameters]
        written = [one.name for one in self.operation.options if one.stand_in is not None]
        for name in self.options:
            if name in written:
                raise TypeError(f"{self.name}: {name}= holds memory that the call writes, which JAX would not know")
            if name not in expected:
                words = ", ".join(f"{one}=" for one in self.operation.as_given(expected)) or "none"
                raise TypeError(
                    f"{self.name}: {name}= is no option; expected {words}; arrays go to the function itself"
                )
        for name in expected:
            if self.operation.needs(name) and name not in self.options:
                raise TypeError(f"{self.name}: {name} is missing; expected {name}=")
        call = Call(self.name, self.dyn.device, self.dyn.dtype)
        for one in self.operation.options:
            if one.read is not None and one.name in self.options:
                one.read(self.dyn.scene, call, self.options[one.name])

    def _check_values(self) -> None:
        for name in self.values:
            if name not in self.dyn.variable:
                known = ", ".join(self.dyn.variable) or "none"
                raise ValueError(
                    f"{self.name}: values names {name!r}; expected values that are variable: {known}; build Dynamics "
                    f"with variable=({name!r},)"
                )
        if self.values and self.capture:
            raise ValueError(
                f"{self.name}: values with capture=True; expected one of the two, because a call sets them"
            )

    def _is_shared(self, name: str, alone: bool) -> bool:
        """Whether all worlds share an argument, which then has no world axis."""
        if name not in self.values or name not in SHARED:
            return False
        if alone:
            raise ValueError(
                f"{self.name}: {name} is given with arrays of one world; expected arrays [world, ...], because all "
                f"worlds share it"
            )
        return True

    def _check_precision(self) -> None:
        settings: Any = jax.config
        if self.dyn.dtype is wp.float64 and not settings.jax_enable_x64:
            raise ValueError(
                f"{self.name}: the Dynamics is float64 and JAX has float64 turned off; expected the same precision; "
                f"call jax.config.update('jax_enable_x64', True) at the start of the program, or build the Dynamics "
                f"with dtype='float32'"
            )

    def _bind(self, arrays: tuple, more: dict[str, Any]) -> dict[str, Any]:
        """Return the arrays that were given by name."""
        named = (*zip(self.arguments, arrays, strict=False), *more.items())
        found = {name: array for name, array in named if array is not None}
        given = {name for name, array in named if array is not None or name not in self.values}
        lacking = [name for name in self.arguments if self.is_needed(name) and name not in given]
        written = [name for name in ("out", *(a.name for a in self.operation.arrays if a.written)) if name in more]
        if written:
            raise TypeError(f"{self.name}: {written[0]}= is given; JAX arrays cannot be written; use what it returns")
        wrong = (
            len(arrays) > len(self.arguments) or len(named) > len(dict(named)) or not set(more) <= set(self.arguments)
        )
        if wrong or lacking or not found:
            raise TypeError(
                f"{self.name}: {len(arrays)} arrays by position and {', '.join(more) or 'none'} by name; expected "
                f"{', '.join(self.arguments)}, each once at most{f'; {lacking[0]} is missing' if lacking else ''}"
            )
        return {name: found[name] for name in self.arguments if name in found}

    def is_needed(self, name: str) -> bool:
        """Whether each call takes an argument."""
        return name in self.values or self.operation.needs(name)

    def _as_array(self, name: str, array: Any) -> Any:
        """Return an argument as a JAX array; NumPy arrays are cast."""
        dtype = wp.dtype_to_jax(self.arguments[name].dtype or self.dyn.dtype)
        if isinstance(array, np.ndarray):
            return jnp.asarray(array, dtype)
        if not isinstance(array, jax.Array):
            raise TypeError(f"{self.name}: {name} is of type {type(array).__name__}; expected a JAX or a NumPy array")
        if array.dtype != dtype:
            way = f"pass {name}.astype({np.dtype(dtype).name!r})"
            if array.dtype.name in ("float32", "float64"):
                way += f", or build the Dynamics with dtype={array.dtype.name!r}"
            raise ValueError(
                f"{self.name}: {name} is {array.dtype} {array.shape}; expected {np.dtype(dtype).name}; {way}"
            )
        return array

    def _shape(self, argument: Argument) -> tuple[int, ...]:
        """Return the shape of an argument, [world, ...]; the axis of a value that all worlds share has one entry."""
        if argument.name in self.values:
            shape = self.dyn.scene.values[argument.name].shape[1:]
            return (1 if argument.name in SHARED else self.dyn.worlds, *shape)
        return self.dyn._engine.shape(argument.axes, len(self.options.get("frames", ())))[0]

    def _check_shape(self, name: str, array: Any, alone: bool) -> None:
        """Raise ValueError unless an argument has its shape, without the world where the first one has none."""
        argument = self.arguments[name]
        whole = self._shape(argument)
        expected = whole[1:] if alone else whole
        if argument.columns and array.ndim == len(expected) + 1:
            expected = (*expected, array.shape[-1])
        if array.shape != expected:
            axes = argument.axes.removeprefix("world, ") if alone else argument.axes
            also = "because the first array is of one world" if alone else f"or {whole[1:]} of one world under vmap"
            raise ValueError(
                f"{self.name}: {name} has shape {array.shape}; expected {expected} [{axes}], {also}; reshape {name}, "
                f"or build the Dynamics for this many worlds"
            )

    def check_rows(self, rows: int, alone: bool) -> None:
        """Raise ValueError unless the Dynamics can compute so many rows.

        Args:
            rows: number of worlds times what ``vmap`` makes of them.
            alone: whether ``vmap`` made the worlds, too.
        """
        worlds = self.dyn.worlds
        if rows % worlds:
            raise ValueError(
                f"{self.name}: the arrays have {rows} rows; expected {worlds}, the worlds of the Dynamics, or a "
                f"multiple of it; build the Dynamics with worlds={rows}, or map over {worlds}"
            )
        differ = worlds > 1 and (self.dyn.variable or self.dyn.scene.worlds > 1)
        if alone and rows != worlds and differ:
            raise ValueError(
                f"{self.name}: vmap made {rows} rows for {worlds} worlds whose values may differ, so that a row's "
                f"world is not known; expected {worlds} rows; pass arrays [world, ...], or build the Dynamics with "
                f"worlds={rows}"
            )
