"""Products of the inverse mass matrix and matrices that a program left in tiles: one kernel for each program."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import warp as wp

from ..kernels import native, products
from ..runtime import launches


class MassInverseProduct(NamedTuple):
    """A kernel that computes q_out, qd_out = -A B for the first two matrices B of a program's result."""

    kernel: wp.Kernel
    tables: tuple[wp.array, ...]
    worlds: int
    block: int
    device: wp.Device

    def launch(self, inverse: wp.array, tiles: wp.array, q_out: wp.array, qd_out: wp.array) -> None:
        """Launch the kernel: ``inverse`` [world, dof, dof], ``tiles`` [tile, slot, world of the tile]."""
        worlds = len(inverse)
        threads = products.BLOCKS * -(-worlds // self.worlds) * self.block if self.device.is_cuda else worlds
        inputs = [worlds, inverse, tiles, *self.tables]
        launches.launch(self.kernel, threads, inputs, [q_out, qd_out], device=self.device, block_dim=self.block)


def build(size: int, places: Sequence[int], slots: int, T: type, device: wp.Device) -> MassInverseProduct:
    """Return the product for B [matrix, ``size``, ``size``] whose entries have the slots ``places``, -1 being zero."""
    layout = products.choose_layout(size, places, T)
    text = products.assemble(layout, slots, T)
    arrays = [("a", 3), ("b", 3), ("place", 1), ("shifts", 1), ("q_out", 3), ("qd_out", 3)]
    kernel = native.kernel("negative_product", text, arrays, T)
    lists = layout.place_entries(places), layout.order_columns()
    tables: tuple[wp.array, ...] = tuple(wp.array(values, dtype=int, device=device) for values in lists)
    return MassInverseProduct(kernel, tables, layout.worlds, layout.block, device)
