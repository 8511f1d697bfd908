"""Changes of variables x' = B x of vectors over nodes, block by block: E' = B E B^-1, H' = H B^-1, M' = B M B*.

Blocks lie row-major, in any order, in arrays [world or 1, scalar]. Their sizes are run-time values.
"""

import functools

import warp as wp


@functools.cache
def multiply(T) -> wp.Kernel:
    """Write one product a pair of blocks; one thread for each (pair, world).

    A row of ``pairs`` is (rows, inner size, columns; offset, row stride and column stride on the left; the same on the
    right; offset of the result). ``symmetric``: the results are; both triangles get the numbers of the lower one.
    """

    @wp.kernel(module=f"warp_spo_similarity_{T.__name__}", enable_backward=False)
    def block_multiply(
        pairs: wp.array2d[int], left: wp.array2d[T], right: wp.array2d[T], symmetric: bool, product_out: wp.array2d[T]
    ):
        pair, world = wp.tid()
        rows, inner, columns = pairs[pair, 0], pairs[pair, 1], pairs[pair, 2]
        left_world = wp.where(left.shape[0] == 1, 0, world)  # one world of blocks is shared by all
        right_world = wp.where(right.shape[0] == 1, 0, world)
        at = pairs[pair, 9]
        for a in range(rows):
            for b in range(wp.where(symmetric, a + 1, columns)):
                total = T(0.0)
                for c in range(inner):
                    x = left[left_world, pairs[pair, 3] + a * pairs[pair, 4] + c * pairs[pair, 5]]
                    total += x * right[right_world, pairs[pair, 6] + c * pairs[pair, 7] + b * pairs[pair, 8]]
                product_out[world, at + a * columns + b] = total
                if symmetric:
                    product_out[world, at + b * columns + a] = total

    return block_multiply


@functools.cache
def invert(T) -> wp.Kernel:
    """Write the inverse of square blocks, by elimination with row pivots; one thread for each (block, world).

    A row of ``blocks`` is (size, offset, offset of the inverse). The inverse of a singular block is NaN.
    """

    @wp.kernel(module=f"warp_spo_similarity_{T.__name__}", enable_backward=False)
    def block_invert(
        blocks: wp.array2d[int], block: wp.array2d[T], rest_out: wp.array2d[T], inverse_out: wp.array2d[T]
    ):
        index, world = wp.tid()
        m, first, at = blocks[index, 0], blocks[index, 1], blocks[index, 2]
        for a in range(m):
            for b in range(m):
                rest_out[world, at + a * m + b] = block[world, first + a * m + b]
                inverse_out[world, at + a * m + b] = T(wp.where(a == b, 1.0, 0.0))
        for c in range(m):
            pivot = int(c)
            for a in range(c + 1, m):
                if wp.abs(rest_out[world, at + a * m + c]) > wp.abs(rest_out[world, at + pivot * m + c]):
                    pivot = a
            divisor = rest_out[world, at + pivot * m + c]
            if divisor == T(0.0):
                divisor = T(wp.nan)
            for b in range(m):  # swap the two rows, and divide the new one
                x = rest_out[world, at + pivot * m + b] / divisor
                rest_out[world, at + pivot * m + b] = rest_out[world, at + c * m + b]
                rest_out[world, at + c * m + b] = x
                y = inverse_out[world, at + pivot * m + b] / divisor
                inverse_out[world, at + pivot * m + b] = inverse_out[world, at + c * m + b]
                inverse_out[world, at + c * m + b] = y
            for a in range(m):
                factor = rest_out[world, at + a * m + c]
                if a != c:
                    for b in range(m):
                        rest_out[world, at + a * m + b] -= factor * rest_out[world, at + c * m + b]
                        inverse_out[world, at + a * m + b] -= factor * inverse_out[world, at + c * m + b]

    return block_invert


KERNELS = (multiply, invert)
