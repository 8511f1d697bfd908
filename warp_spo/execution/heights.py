"""Gradients by the heights of a field, which all worlds share: sums over worlds and points in a fixed order."""

from __future__ import annotations

from typing import Any

import warp as wp

from .. import launches
from ..kernels import heights as kernels

MOST_SUMS = 1 << 22  # partial sums kept at most; large fields take fewer for each height


class HeightSums:
    """Memory for the sums of one number of contributions to one number of heights.

    Args:
        count: contributions, each by the four corners of a cell. heights: of the field. T: scalar type.
    """

    def __init__(self, count: int, heights: int, T: type, device: wp.Device):
        self.count, self.heights, self.T, self.device = count, heights, T, device
        self.keys, self.order = (wp.empty(2 * count, dtype=wp.int32, device=device) for _ in range(2))
        self.begin, self.end = (wp.empty(heights, dtype=wp.int32, device=device) for _ in range(2))
        lanes = max(1, min(kernels.LANES, MOST_SUMS // heights)) if device.is_cuda else 1
        self.sums: Any = wp.empty((heights, lanes), dtype=T, device=device)

    def add_up(self, cells: wp.array, contributions: wp.array, steps: tuple[int, ...], out: wp.array) -> None:
        """Write the sum of all contributions to each height.

        Args:
            cells: the place of each contribution's cell, whole numbers [contribution]. contributions: by its corners
                [contribution, corner]. steps: places of the corners from that of the cell. out: [height].
        """
        on: Any = {"device": self.device}
        launches.launch(kernels.number_cells(self.T), self.count, [cells], [self.keys, self.order], **on)
        launches.sort(self.keys, self.order, self.count)
        for array in (self.begin, self.end):
            launches.fill(array, 0)
        found = [self.begin, self.end]
        launches.launch(kernels.find_ranges(self.T), self.count, [self.keys, self.count], found, **on)
        inputs = [*found, self.order, wp.vec4i(*steps), contributions]
        launches.launch(kernels.add_lanes(self.T), self.sums.shape, inputs, [self.sums], **on)
        launches.launch(kernels.add_sums(self.T), self.heights, [self.sums], [out], **on)
