"""Products of a symmetric matrix and matrices in tiles, against NumPy: see warp_spo.kernels.products."""

import numpy as np
import pytest
import warp as wp

from warp_spo.execution import mass_inverse_products
from warp_spo.kernels import products as kernels
from warp_spo.kernels.straight_line import SHARED_BYTES, TILE

ROUNDING = {"float32": 3e-6, "float64": 1e-14}  # of sums of 100 products, relative; measured 7e-7 and 2e-15


def tree_mask(rng, size, limbs):
    """Which entries a tree of ``limbs`` on one root of up to six dofs has; some more are zero, a column altogether."""
    root = min(6, size)
    mask = np.zeros((2, size, size), dtype=bool)
    mask[:, :root], mask[:, :, :root] = True, True
    for limb in np.array_split(np.arange(root, size), limbs):
        mask[:, limb[:, None], limb] = True
    mask &= rng.uniform(size=mask.shape) < 0.9
    mask[:, :, 0] = False
    mask[0, :, size // 2] = False
    return mask


@pytest.mark.parametrize(("size", "limbs", "worlds", "chunks"), [(7, 1, 9, 1), (35, 4, 11, 1), (100, 1, 3, 2)])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_products(size, limbs, worlds, chunks, dtype, device):
    """Every entry is written, zeros too; worlds that fill no tile and no block; columns that come in several parts."""
    rng, T = np.random.default_rng(size), getattr(wp, dtype)
    mask = tree_mask(rng, size, limbs)
    slots = np.full(mask.shape, -1)
    count = int(mask.sum())
    slots[mask] = rng.permutation(count)
    places = slots.ravel().tolist()
    layout = kernels.choose_layout(size, places, T)
    assert len(layout.chunks) >= chunks and layout.scalars * np.dtype(dtype).itemsize <= SHARED_BYTES
    A = rng.normal(size=(worlds, size, size))
    A = (A + A.swapaxes(1, 2)).astype(dtype)
    B = rng.normal(size=(worlds, *mask.shape)).astype(dtype) * mask
    tiles = np.full((-(-worlds // TILE), count, TILE), np.nan, dtype)  # NaN where there is no world
    for world in range(worlds):
        tiles[world // TILE, slots[mask], world % TILE] = B[world][mask]
    product = mass_inverse_products.build(size, places, count, T, wp.get_device(device))
    out = [wp.full(A.shape, float("nan"), dtype=T, device=device) for _ in range(2)]
    product.launch(wp.array(A, dtype=T, device=device), wp.array(tiles, dtype=T, device=device), *out)
    for block, got in enumerate(out):
        wanted = -A.astype(float) @ B[:, block].astype(float)
        assert np.abs(got.numpy() - wanted).max() <= ROUNDING[dtype] * np.abs(wanted).max()


def test_columns_with_equal_rows_share_a_loop():
    """Four limbs on a root: the root's columns and each limb's are one group each."""
    mask = np.zeros((2, 18, 18), dtype=bool)
    mask[:, :6], mask[:, :, :6] = True, True
    for first in range(6, 18, 3):
        mask[:, first : first + 3, first : first + 3] = True
    slots = np.where(mask, np.arange(mask.size).reshape(mask.shape), -1)
    layout = kernels.choose_layout(18, slots.ravel().tolist(), wp.float32)
    (chunk,) = layout.chunks
    assert [(len(group.columns), len(group.rows)) for group in chunk] == [(6, 18), *[(3, 9)] * 4]
    assert sorted(layout.order_columns()) == list(range(18)) and layout.worlds == TILE
