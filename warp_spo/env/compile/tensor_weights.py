"""Weights of a network as :mod:`warp_spo.kernels.tensor_networks` reads them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...kernels.tensor_networks import BOUNDED, MOST_INPUTS, MOST_UNITS, SCALE, NetworkShape

if TYPE_CHECKING:
    from ..actuator_nets import ActuatorNetwork

WEIGHTS = 9  # scaled weights are at most two to this power
LANES = np.arange(32)


def shape_of(network: ActuatorNetwork) -> NetworkShape | None:
    """Return the shape of a network that tensor cores can evaluate as accurately as float32, None of others."""
    layers = network.layers
    units = max((-(-len(biases) // 16) * 16 for _, biases in layers[:-1]), default=0)
    inputs = layers[0][0].shape[1]
    if not units or network.activation not in BOUNDED or units > MOST_UNITS or inputs > MOST_INPUTS:
        return None
    scales = [1.0, *(SCALE * 2.0 ** _power(w) for w, _ in layers[1:-1])]
    return NetworkShape(inputs, units, len(layers) - 1, network.activation, tuple(scales))


def pack(network: ActuatorNetwork, shape: NetworkShape) -> np.ndarray:
    """Return the array of weights, float32, some of whose words are two float16."""
    found, before, units = [], shape.rows, shape.units
    for layer, scale in enumerate(shape.scales):
        w, b = network.layers[layer]
        each = 1.0 if layer == 0 else scale / SCALE
        whole = np.zeros((before, units))
        whole[: w.shape[1], : w.shape[0]] = each * w.T
        found += [(_tf32 if layer == 0 else _halves)(whole), np.zeros(units, np.float32)]
        found[-1][: len(b)] = scale * b
        before = units
    w, b = network.layers[-1]
    last = np.zeros(before + 1, np.float32)
    last[: w.shape[1]], last[-1] = w[0] / SCALE, b[0]
    return np.concatenate([*found, last])


def _power(weights: np.ndarray) -> int:
    """Return the power of two that brings the largest weight to at most two to WEIGHTS."""
    most = np.abs(weights).max(initial=0.0)
    return 0 if most == 0.0 else WEIGHTS - int(np.ceil(np.log2(most)))


def _tf32(weights: np.ndarray) -> np.ndarray:
    """Return the words of weights [input, output] of products of TF32."""
    high = _rounded(weights.astype(np.float32))
    low = _rounded((weights - high).astype(np.float32))
    ins, outs = (np.arange(size // 8)[:, None] * 8 for size in weights.shape)
    rows = (ins + LANES % 4)[:, None, :]
    columns = (outs + LANES // 4)[None]
    return np.stack([part[rows + 4 * k, columns] for part in (high, low) for k in (0, 1)], axis=-1).ravel()


def _rounded(x: np.ndarray) -> np.ndarray:
    """Return float32 rounded to the 11 bits of TF32, halves away from zero."""
    return ((x.view(np.uint32) + np.uint32(1 << 12)) & np.uint32(0xFFFFE000)).view(np.float32)


def _halves(weights: np.ndarray) -> np.ndarray:
    """Return the words of weights [input, output] of products of float16."""
    high = weights.astype(np.float16)
    low = (weights - high).astype(np.float16)
    ins, outs = np.arange(weights.shape[0] // 16)[:, None] * 16, np.arange(weights.shape[1] // 8)[:, None] * 8
    rows, columns = (ins + LANES % 4 * 2)[:, None, :], (outs + LANES // 4)[None]
    pairs = [
        np.stack([part[rows + 8 * k, columns], part[rows + 8 * k + 1, columns]], axis=-1)
        for part in (high, low)
        for k in (0, 1)
    ]
    return np.ascontiguousarray(np.stack(pairs, axis=-2)).view(np.float32).ravel()
