"""The Riccati recursion of any spatial kernel operator: P, D, G and the weights of E_psi, for all block sizes.

P(k) = M(k) + sum over children w P+ w*, D = H P H* + Delta, G = P H* D^-1, P+ = P - G H P, w_psi = w (I - G H).
The blocks lie one after the other, each row-major, in arrays [world, scalar]. Their sizes are run-time values, so that
one kernel serves every system, rigid or not.
"""

import functools

import warp as wp


@wp.struct
class BlockTables:
    """Sizes and places of the blocks of every node."""

    order: wp.array[int]  # nodes, level by level, roots first
    parent: wp.array[int]
    child_start: wp.array[int]
    children: wp.array[int]
    size: wp.array[int]  # m_k
    dofs: wp.array[int]  # r_k
    weight: wp.array[int]  # offset of w(p, k), m_p x m_k
    square: wp.array[int]  # offset of M(k) and P(k), m_k x m_k
    hinge: wp.array[int]  # offset of H(k), r_k x m_k, and of G(k), m_k x r_k
    pivot: wp.array[int]  # offset of D(k), r_k x r_k


@functools.cache
def factorize(T) -> wp.Kernel:
    """Factorise one level, inward; one thread for each (node, world). NaN where D is not positive definite."""

    @wp.kernel(module=f"warp_spo_factorization_{T.__name__}", enable_backward=False)
    def kernel(
        tables: BlockTables,
        level: int,
        weight: wp.array2d[T],
        H: wp.array2d[T],
        M: wp.array2d[T],
        Delta: wp.array2d[T],
        P_out: wp.array2d[T],
        D_out: wp.array2d[T],
        D_inverse_out: wp.array2d[T],
        G_out: wp.array2d[T],
        psi_out: wp.array2d[T],
        U_out: wp.array2d[T],  # P H*, scratch
        L_out: wp.array2d[T],  # Cholesky factor of D, scratch
        carry_out: wp.array2d[T],  # w P+, scratch
    ):
        i, world = wp.tid()
        node = tables.order[level + i]
        m, r = tables.size[node], tables.dofs[node]
        square, hinge, pivot = tables.square[node], tables.hinge[node], tables.pivot[node]

        for a in range(m):
            for b in range(a + 1):
                total = M[world, square + a * m + b]
                for e in range(tables.child_start[node], tables.child_start[node + 1]):
                    child = tables.children[e]
                    n, w = tables.size[child], tables.weight[child]
                    for c in range(n):
                        total += carry_out[world, w + a * n + c] * weight[world, w + b * n + c]
                P_out[world, square + a * m + b] = total
                P_out[world, square + b * m + a] = total

        for a in range(m):
            for j in range(r):
                total = T(0.0)
                for b in range(m):
                    total += P_out[world, square + a * m + b] * H[world, hinge + j * m + b]
                U_out[world, hinge + a * r + j] = total
        for j in range(r):
            for k in range(j + 1):
                total = Delta[world, pivot + j * r + k]
                for a in range(m):
                    total += H[world, hinge + j * m + a] * U_out[world, hinge + a * r + k]
                D_out[world, pivot + j * r + k] = total
                D_out[world, pivot + k * r + j] = total

        for j in range(r):
            for k in range(j + 1):
                total = D_out[world, pivot + j * r + k]
                for c in range(k):
                    total -= L_out[world, pivot + j * r + c] * L_out[world, pivot + k * r + c]
                if j == k:
                    if not total > T(0.0):
                        total = T(wp.nan)
                    L_out[world, pivot + j * r + j] = wp.sqrt(total)
                else:
                    L_out[world, pivot + j * r + k] = total / L_out[world, pivot + k * r + k]
        for column in range(r):  # D^-1, column by column: L y = e, L* x = y
            for j in range(r):
                total = T(wp.where(j == column, 1.0, 0.0))
                for c in range(j):
                    total -= L_out[world, pivot + j * r + c] * D_inverse_out[world, pivot + c * r + column]
                D_inverse_out[world, pivot + j * r + column] = total / L_out[world, pivot + j * r + j]
            for back in range(r):
                j = r - 1 - back
                total = D_inverse_out[world, pivot + j * r + column]
                for c in range(j + 1, r):
                    total -= L_out[world, pivot + c * r + j] * D_inverse_out[world, pivot + c * r + column]
                D_inverse_out[world, pivot + j * r + column] = total / L_out[world, pivot + j * r + j]
        for a in range(m):  # G D = U, row by row
            for j in range(r):
                total = U_out[world, hinge + a * r + j]
                for c in range(j):
                    total -= L_out[world, pivot + j * r + c] * G_out[world, hinge + a * r + c]
                G_out[world, hinge + a * r + j] = total / L_out[world, pivot + j * r + j]
            for back in range(r):
                j = r - 1 - back
                total = G_out[world, hinge + a * r + j]
                for c in range(j + 1, r):
                    total -= L_out[world, pivot + c * r + j] * G_out[world, hinge + a * r + c]
                G_out[world, hinge + a * r + j] = total / L_out[world, pivot + j * r + j]

        if tables.parent[node] >= 0:
            own = tables.weight[node]
            for a in range(tables.size[tables.parent[node]]):
                for b in range(m):
                    through = T(0.0)  # (w P)(a, b), then less (w G)(a, :) U*(:, b)
                    psi = weight[world, own + a * m + b]
                    for c in range(m):
                        through += weight[world, own + a * m + c] * P_out[world, square + c * m + b]
                    for j in range(r):
                        gain = T(0.0)
                        for c in range(m):
                            gain += weight[world, own + a * m + c] * G_out[world, hinge + c * r + j]
                        through -= gain * U_out[world, hinge + b * r + j]
                        psi -= gain * H[world, hinge + j * m + b]
                    carry_out[world, own + a * m + b] = through
                    psi_out[world, own + a * m + b] = psi

    return kernel


KERNELS = (factorize,)
