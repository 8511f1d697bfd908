"""Gradients by the heights of a field, which all worlds share: sums over worlds and points in a fixed order."""

from __future__ import annotations

from typing import Any

import warp as wp

from ..kernels import height_field as kernels
from ..runtime import launches


class HeightSums:
    """Memory for the sums of one number of contributions to one number of heights.

    Args:
        count: contributions, each by the four corners of a cell. heights: of the field. T: scalar type.
    """

    def __init__(self, count: int, heights: int, T: type, device: wp.Device):
        self.count, self.heights, self.T, self.device = count, heights, T, device
        self.keys, self.order = (wp.empty(2 * count, dtype=wp.int32, device=device) for _ in range(2))
        self.parts, self.lanes = -(-count // kernels.RUN), kernels.LANES if device.is_cuda else 1
        self.range: Any = wp.empty((2, heights), dtype=wp.int32, device=device)
        self.carries: Any = wp.empty((4, self.parts), dtype=T, device=device)
        self.last, self.sums = (wp.empty((4, heights), dtype=T, device=device) for _ in range(2))

    def add_up(self, cells: wp.array, contributions: wp.array, steps: tuple[int, ...], out: wp.array) -> None:
        """Write the sum of all contributions to each height.

        Args:
            cells: the place of each contribution's cell, whole numbers [contribution]. contributions: by its corners
                [contribution, corner]. steps: places of the corners from that of the cell. out: [height].
        """
        on: Any = {"device": self.device}
        T, none = self.T, self.heights
        launches.launch(
            kernels.number_cells(T), self.count, [cells, contributions, none], [self.keys, self.order], **on
        )
        launches.sort(self.keys, self.order, self.count, none.bit_length())
        launches.fill(self.range, 0)
        inputs = [self.keys, self.order, contributions, self.count, none]
        launches.launch(kernels.add_runs(T), self.parts, inputs, [self.range, self.carries, self.last], **on)
        inputs = [self.range, self.carries, self.last, self.lanes]
        launches.launch(kernels.add_carries(T), (self.heights, self.lanes), inputs, [self.sums], **on)
        inputs = [self.range, self.sums, wp.vec4i(*steps)]
        launches.launch(kernels.add_corners(T), self.heights, inputs, [out], **on)
