"""Newton's flat arrays of all worlds as arrays [world, ...], without a copy where the memory is laid out that way."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import newton
import numpy as np
import warp as wp

from ..kernels import newton_arrays
from ..runtime.memory import view
from ..scene.scene import Scene
from .worlds import WorldRows


class FlatLayout:
    """The entries of a flat array that belong to the scene.

    Args:
        rows: Rows of the model's array that belong to each world [world, n].
        shape: Shape of the scene's array for one world: n rows and their components.
        device: Where the arrays are.
        like: The model's array. Arrays that are read or written later must have its size.
    """

    def __init__(self, rows: np.ndarray, shape: tuple[int, ...], device: wp.Device, like: Any):
        components = int(np.prod(shape)) // max(1, rows.shape[1])
        flat = (rows[..., None] * components + np.arange(components)).reshape(len(rows), -1)
        self.device, self.shape, self._flat_shape = device, (len(rows), *shape), flat.shape
        self._count = like.size * _components(like.dtype)
        self.plain = bool(np.array_equal(flat.ravel(), np.arange(flat.size)))
        self._index: Any = wp.array(flat, dtype=wp.int32, device=device)
        self._buffers: dict[str, wp.array] = {}
        self._own: Any = None
        others = np.ones(self._count, bool)  # a mask: setdiff1d takes seconds for a million entries
        others[flat] = False
        self._others: Any = wp.array(np.flatnonzero(others)[None, :], dtype=wp.int32, device=device)

    def buffer(self, name: str) -> wp.array:
        """Return the solver's own array [world, ...] of that name, allocated at the first call."""
        if name not in self._buffers:
            self._buffers[name] = wp.zeros(self.shape, dtype=wp.float32, device=self.device)
        return self._buffers[name]

    def read(self, flat: Any, name: str) -> wp.array:
        """Return the entries of ``flat`` as [world, ...]: a view of it, or the buffer ``name`` with a copy of them."""
        self._check(flat, name)
        if self.plain:
            return view(flat.ptr, self.shape, wp.float32, self.device.alias)
        out = self.buffer(name)
        self._launch(newton_arrays.gather, [self._index, _scalars(flat)], out.reshape(self._flat_shape))
        return out

    def target(self, flat: Any, name: str) -> wp.array:
        """Return the array to fill before :meth:`write`: a view of ``flat``, or the buffer ``name``."""
        self._check(flat, name)
        return view(flat.ptr, self.shape, wp.float32, self.device.alias) if self.plain else self.buffer(name)

    def write(self, array: wp.array, flat: Any, mask: Any = None) -> None:
        """Copy ``array`` [world, ...] into ``flat``, in the worlds of ``mask``; do nothing if it is a view of it."""
        if array.ptr != flat.ptr:
            self._launch(newton_arrays.scatter, [self._index, mask, array.reshape(self._flat_shape)], _scalars(flat))

    def add(self, array: wp.array, flat: Any) -> None:
        """Add ``array`` [world, ...] to the entries of ``flat``."""
        self._launch(newton_arrays.add, [self._index, array.reshape(self._flat_shape)], _scalars(flat))

    def add_rows(self, array: wp.array, total: wp.array) -> None:
        """Add ``array`` to ``total``, both [world, ...] of the scene."""
        if self._own is None:
            count = int(np.prod(self._flat_shape))
            entries = np.arange(count).reshape(self._flat_shape)
            self._own = self._index if self.plain else wp.array(entries, dtype=wp.int32, device=self.device)
        self._launch(newton_arrays.add, [self._own, array.reshape(self._flat_shape)], total.flatten())

    def add_others(self, source: Any, flat: Any) -> None:
        """Add to ``flat`` those entries of ``source`` that no world of the scene has, such as those of loop joints."""
        if not self._others.size:
            return
        index, dim = self._others, self._others.shape
        found = wp.empty(dim, dtype=wp.float32, device=self.device)
        wp.launch(newton_arrays.gather(wp.float32), dim, [index, _scalars(source)], [found], device=self.device)
        wp.launch(newton_arrays.add(wp.float32), dim, [index, found], [_scalars(flat)], device=self.device)

    def scale(self, array: wp.array, factor: wp.array, name: str) -> wp.array:
        """Return ``array`` [world, n] times ``factor`` [n], in the buffer ``name``."""
        out = self.buffer(name)
        self._launch(newton_arrays.scale, [factor, array], out)
        return out

    def _check(self, flat: Any, name: str) -> None:
        """Raise TypeError or ValueError unless the array's memory is as the model's; kernels read it by its address."""
        if isinstance(flat, wp.array):
            kind = flat.dtype  # Warp's vectors count by their numbers
            count = flat.size if kind is wp.float32 else flat.size * _components(kind)
            scalar = getattr(kind, "_wp_scalar_type_", kind)
            if count == self._count and scalar is wp.float32 and flat.device is self.device and flat.is_contiguous:
                return
        expected = f"a Warp array float32 of {self._count} numbers on {self.device}, as the model has it"
        if not isinstance(flat, wp.array):
            raise TypeError(f"SolverSPO: {name} is of type {type(flat).__name__}; expected {expected}")
        strides = "" if flat.is_contiguous else " with strides"
        came = f"a Warp array {scalar.__name__} of {count} numbers on {flat.device}{strides}"
        raise ValueError(f"SolverSPO: {name} is {came}; expected {expected}; use an array of this solver's model")

    def _launch(self, factory: Any, inputs: list, out: wp.array) -> None:
        if self._index.size:
            wp.launch(factory(wp.float32), self._flat_shape, inputs, [out], device=self.device)


@dataclasses.dataclass(frozen=True)
class StateLayouts:
    """Layouts of Newton's state: joint_q, joint_qd, body_q, body_qd (as body_f), and the joints' anchors."""

    q: FlatLayout
    qd: FlatLayout
    poses: FlatLayout
    wrenches: FlatLayout
    anchors: FlatLayout

    @classmethod
    def of(cls, model: newton.Model, worlds: WorldRows, scene: Scene) -> StateLayouts:
        """Return the layouts of a model's state."""
        rows = {
            "joint_q": (scene.q_index, ()),
            "joint_qd": (scene.dof_index, ()),
            "body_q": (worlds.bodies, (7,)),
            "body_qd": (worlds.bodies, (6,)),
            "joint_X_p": (worlds.hinges, (7,)),
        }
        return cls(*(lay_out(model, name, *found) for name, found in rows.items()))


def lay_out(model: newton.Model, name: str, rows: np.ndarray, shape: tuple[int, ...] = ()) -> FlatLayout:
    """Return how the model's array ``name`` is laid out: ``rows`` [world, n], each an entry of ``shape``."""
    return FlatLayout(rows, (*rows.shape[1:], *shape), model.device, getattr(model, name))


def _scalars(flat: Any) -> wp.array:
    """Return an array of vectors, matrices or transforms as a flat array of its numbers."""
    return view(flat.ptr, (flat.size * _components(flat.dtype),), wp.float32, flat.device.alias)


@functools.cache
def _components(dtype: Any) -> int:
    """Return the count of numbers in one entry."""
    return math.prod(getattr(dtype, "_shape_", ()))
