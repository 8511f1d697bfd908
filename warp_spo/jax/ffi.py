"""Python functions of Warp arrays as JAX functions, through Warp's foreign function interface."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import jax
import warp as wp


class Form(NamedTuple):
    """Shape [world, ...] and Warp scalar type of an array."""

    shape: tuple[int, ...]
    dtype: Any


def forms_of(arrays: Iterable[wp.array]) -> list[Form]:
    """Return the forms of Warp arrays."""
    return [Form(tuple(array.shape), array.dtype) for array in arrays]


def traceable(
    name: str, run: Callable[..., None], inputs: Sequence[Form], outputs: Sequence[Form], capture: bool
) -> Callable[..., tuple[jax.Array, ...]]:
    """Return ``run(inputs, outputs)``, which fills its outputs by launches, as a function of JAX arrays [row, ...].

    Rows are worlds, or several times as many: ``vmap`` puts its axis before the others, and Warp's arrays have all
    leading axes in one. A value that all worlds share has one row for as many rows of the others as there are worlds.
    XLA never forgets a function, so that ``run`` lives as long as the process.

    Args:
        name: for errors of XLA.
        run: takes Warp arrays, on the stream of XLA.
        inputs, outputs: forms of the arrays; the number of rows may differ from theirs.
        capture: whether XLA may capture the launches in its CUDA graphs.
    """

    def call(*arrays: wp.array) -> None:
        run(arrays[: len(inputs)], arrays[len(inputs) :])

    named = {f"in_{i}": form for i, form in enumerate(inputs)} | {f"out_{i}": form for i, form in enumerate(outputs)}
    kinds: dict[str, Any] = {key: wp.array(dtype=form.dtype, ndim=len(form.shape)) for key, form in named.items()}
    order = [inspect.Parameter(key, inspect.Parameter.POSITIONAL_ONLY, annotation=kind) for key, kind in kinds.items()]
    vars(call)["__signature__"] = inspect.Signature(order)
    call.__annotations__, call.__qualname__ = kinds, f"warp_spo.{name}"
    mode = wp.JaxCallableGraphMode.JAX if capture else wp.JaxCallableGraphMode.NONE
    options: dict[str, Any] = {"vmap_method": "broadcast_all", "module_preload_mode": wp.JaxModulePreloadMode.NONE}
    foreign = wp.jax_callable(call, num_outputs=len(outputs), graph_mode=mode, **options)

    def traced(*arrays: jax.Array) -> tuple[jax.Array, ...]:
        rows, worlds = arrays[0].shape[0], inputs[0].shape[0]
        sizes = {f"out_{i}": (rows * one.shape[0] // worlds, *one.shape[1:]) for i, one in enumerate(outputs)}
        return tuple(foreign(*arrays, output_dims=sizes))

    return jax.jit(traced)  # without it, every call would compile
