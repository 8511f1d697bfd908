"""Layers of ELU on tensor cores: a product of matrices with what follows it as one Triton kernel.

Importing this needs Triton, which torch brings along where it has CUDA. A product reads TF32 or bfloat16 and sums in
float32; ELU, its slope and sums of biases are taken of these sums before they are written.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import triton
import triton.language as tl

from .fused_update import FusedNetwork


@triton.jit
def forward_layer(
    x, weight, bias, result, rows, units, inputs,
    ROWS: tl.constexpr, UNITS: tl.constexpr, INPUTS: tl.constexpr, EVEN: tl.constexpr,
):  # fmt: skip
    """Set result [row, unit] to ``elu(x weight' + bias)``; x [row, input], weight [unit, input]."""
    tiles = tl.cdiv(units, UNITS)
    at, part = tl.program_id(0) // tiles, tl.program_id(0) % tiles
    row = at * ROWS + tl.arange(0, ROWS)
    unit = part * UNITS + tl.arange(0, UNITS)
    k = tl.arange(0, INPUTS)
    a = x + (row % rows).to(tl.int64)[:, None] * inputs + k[None, :]
    b = weight + (unit % units)[None, :] * inputs + k[:, None]
    total = tl.zeros((ROWS, UNITS), dtype=tl.float32)
    for start in range(0, inputs, INPUTS):
        if EVEN:
            total = tl.dot(tl.load(a), tl.load(b), total)
        else:
            there = start + k < inputs
            left, right = tl.load(a, mask=there[None, :], other=0.0), tl.load(b, mask=there[:, None], other=0.0)
            total = tl.dot(left, right, total)
        a += INPUTS
        b += INPUTS
    y = total + tl.load(bias + unit % units)[None, :]
    y = tl.where(y > 0.0, y, tl.exp(y) - 1.0)
    place = result + row.to(tl.int64)[:, None] * units + unit[None, :]
    tl.store(place, y.to(result.dtype.element_ty), mask=(row < rows)[:, None] & (unit < units)[None, :])


@triton.jit
def backward_layer(
    slope, weight, result, below, sums, rows, units, inputs, along, across,
    ROWS: tl.constexpr, UNITS: tl.constexpr, INPUTS: tl.constexpr, EVEN: tl.constexpr,
):  # fmt: skip
    """Set below [row, unit] to ``(slope weight) elu'``, and sums [part, unit] to its sums over ROWS rows.

    slope [row, input] is the gradient of the sums of the layer above, weight [input, unit] its weights, with strides
    ``along`` and ``across``; result
    [row, unit] is what it read, of which the slope of ELU is taken.
    """
    tiles = tl.cdiv(units, UNITS)
    at, part = tl.program_id(0) // tiles, tl.program_id(0) % tiles
    row = at * ROWS + tl.arange(0, ROWS)
    unit = part * UNITS + tl.arange(0, UNITS)
    k = tl.arange(0, INPUTS)
    a = slope + (row % rows).to(tl.int64)[:, None] * inputs + k[None, :]
    b = weight + k[:, None] * along + (unit % units)[None, :] * across
    place = row.to(tl.int64)[:, None] * units + unit[None, :]
    there = (row < rows)[:, None] & (unit < units)[None, :]
    y = tl.load(result + place, mask=there, other=0.0).to(tl.float32)
    total = tl.zeros((ROWS, UNITS), dtype=tl.float32)
    for start in range(0, inputs, INPUTS):
        if EVEN:
            total = tl.dot(tl.load(a), tl.load(b), total)
        else:
            inside = start + k < inputs
            left, right = tl.load(a, mask=inside[None, :], other=0.0), tl.load(b, mask=inside[:, None], other=0.0)
            total = tl.dot(left, right, total)
        a += INPUTS
        b += INPUTS * along
    total = tl.where(there, tl.where(y > 0.0, total, total * (y + 1.0)), 0.0)
    tl.store(below + place, total.to(below.dtype.element_ty), mask=there)
    tl.store(sums + at * units + unit, tl.sum(total, axis=0), mask=unit < units)


class Tile(NamedTuple):
    """What a block of threads computes: rows, units, inputs at a time; its warps, and loads that are under way."""

    rows: int
    units: int
    inputs: int
    warps: int = 8
    stages: int = 3


def fit(tile: Tile, units: int, inputs: int, size: int) -> Tile:
    """Return a tile that is not wider than a layer, whose numbers have so many bytes."""
    least = lambda count: max(16, triton.next_power_of_2(count))  # noqa: E731
    found = min(tile.inputs * 4 // size, least(inputs))
    while inputs % 16 == 0 and inputs % found:
        found //= 2
    return tile._replace(units=min(tile.units, least(units)), inputs=found)


FORWARD, BACKWARD = Tile(128, 128, 32), Tile(128, 128, 32)
CHUNK = 128


class TritonNetwork(FusedNetwork):
    """The same with ELU inside of the products' kernels."""

    chunk = CHUNK

    def _run_layer(self, i: int, x: torch.Tensor) -> None:
        run_forward(x, self.weights[i], self.layers[i].bias.detach(), self.results[i], FORWARD)

    def _differentiate_layer(self, i: int) -> None:
        run_backward(self.slopes[i + 1], self.weights[i + 1], self.results[i], self.slopes[i], self.sums[i], BACKWARD)


def run_forward(x, weight, bias, result, tile: Tile) -> None:
    """Launch ``forward_layer`` on torch's current stream."""
    rows, inputs = x.shape
    units = weight.shape[0]
    tile = fit(tile, units, inputs, weight.element_size())
    grid = (triton.cdiv(rows, tile.rows) * triton.cdiv(units, tile.units),)
    forward_layer[grid](
        x, weight, bias, result, rows, units, inputs, ROWS=tile.rows, UNITS=tile.units, INPUTS=tile.inputs,
        EVEN=inputs % tile.inputs == 0, num_warps=tile.warps, num_stages=tile.stages,
    )  # fmt: skip


def run_backward(slope, weight, result, below, sums, tile: Tile) -> None:
    """Launch ``backward_layer`` on torch's current stream."""
    rows, inputs = slope.shape
    units = weight.shape[1]
    tile = fit(tile, units, inputs, weight.element_size())
    grid = (triton.cdiv(rows, tile.rows) * triton.cdiv(units, tile.units),)
    backward_layer[grid](
        slope, weight, result, below, sums, rows, units, inputs, *weight.stride(), ROWS=tile.rows, UNITS=tile.units,
        INPUTS=tile.inputs, EVEN=inputs % tile.inputs == 0, num_warps=tile.warps, num_stages=tile.stages,
    )  # fmt: skip
