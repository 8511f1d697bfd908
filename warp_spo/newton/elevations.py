"""Heights of the ground's fields as the model has them: elevations from 0 to 1 of each field's range of heights."""

from __future__ import annotations

from typing import Any

import newton
import numpy as np
import warp as wp

from ..kernels import declare
from ..kernels import newton_height_fields as kernels
from .worlds import to_numpy


class Fields:
    """The elevations of a model's height fields, read once."""

    def __init__(self, model: newton.Model):
        names = "heightfield_data", "shape_heightfield_index", "heightfield_elevations"
        self._data, self._index, self._elevations = (to_numpy(model, name) for name in names)

    def of(self, shape: int) -> Any:
        """Return what Newton's collisions know of the field of a shape: data_offset, nrow, ncol, min_z, max_z."""
        return self._data[self._index[shape]]

    def elevations(self, shape: int) -> np.ndarray:
        """Return the elevations of the field of a shape [row, column]; rows go along y."""
        one = self.of(shape)
        first, rows, columns = (int(one[name]) for name in ("data_offset", "nrow", "ncol"))
        return self._elevations[first : first + rows * columns].reshape(rows, columns)


class Elevations:
    """Places of the heights of a scene's fields among the elevations of a model.

    Args:
        model: The Newton model. rows: Index of the shape that is each field [field], each once.
        shape: Of the heights in the scene, (x, y), or (field, x, y) of several fields.
    """

    def __init__(self, model: newton.Model, rows: np.ndarray, shape: tuple[int, ...]):
        self._device, self._shape = model.device, shape
        fields = Fields(model)
        found = [fields.of(row) for row in rows]
        places = np.arange(shape[-2] * shape[-1]).reshape(shape[-1], shape[-2]).T.ravel()  # Newton's rows go along y
        index = np.array([int(one["data_offset"]) for one in found])[:, None] + places
        lowest, highest = (np.array([one[name] for one in found], np.float32) for name in ("min_z", "max_z"))
        self._index: Any = wp.array(index.astype(np.int32), device=self._device)
        self._lowest: Any = wp.array(lowest, device=self._device)
        self._spread: Any = wp.array(highest - lowest, device=self._device)
        self._heights, self._gradient = (wp.empty(index.shape, dtype=wp.float32, device=self._device) for _ in range(2))
        declare(kernels, None)

    def read(self, flat: wp.array) -> wp.array:
        """Return the heights of the scene for the model's elevations, in a buffer that the next call overwrites."""
        inputs = [self._index, self._lowest, self._spread, flat]
        wp.launch(kernels.heights(), self._index.shape, inputs, [self._heights], device=self._device)
        return self._heights.reshape(self._shape)

    def gradient(self, name: str) -> wp.array:
        """Return a buffer for the gradient by the heights of the scene, see :meth:`add`."""
        return self._gradient.reshape(self._shape)

    def add(self, gradient: wp.array, flat: wp.array) -> None:
        """Add a gradient by heights to ``flat``, the gradient by the model's elevations."""
        inputs = [self._index, self._spread, gradient.reshape(self._index.shape)]
        wp.launch(kernels.add(), self._index.shape, inputs, [flat], device=self._device)
