"""The Riccati recursion of any spatial kernel operator: P, D, G and the weights of E_psi, for all block sizes.

P(k) = M(k) + sum over children w P+ w*, D = H P H* + Delta, G = P H* D^-1, P+ = P - G H P, w_psi = w (I - G H).
The blocks lie one after the other, each row-major, in arrays [world, scalar]. Their sizes are run-time values, so that
one kernel serves every system, rigid or not.
"""

import functools
from typing import Any

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


@wp.func
def gather(
    tables: BlockTables,
    node: int,
    world: int,
    M: wp.array2d[Any],
    carry: wp.array2d[Any],
    weight: wp.array2d[Any],
    P_out: wp.array2d[Any],
):
    """P = M + sum over children (w P+) w*, both triangles."""
    m, square = tables.size[node], tables.square[node]
    for a in range(m):
        for b in range(a + 1):
            total = M[world, square + a * m + b]
            for e in range(tables.child_start[node], tables.child_start[node + 1]):
                child = tables.children[e]
                n, w = tables.size[child], tables.weight[child]
                for c in range(n):
                    total += carry[world, w + a * n + c] * weight[world, w + b * n + c]
            P_out[world, square + a * m + b] = total
            P_out[world, square + b * m + a] = total


@wp.func
def project(
    tables: BlockTables,
    node: int,
    world: int,
    P: wp.array2d[Any],
    H: wp.array2d[Any],
    Delta: wp.array2d[Any],
    U_out: wp.array2d[Any],
    D_out: wp.array2d[Any],
):
    """U = P H* and D = H U + Delta, both triangles."""
    m, r = tables.size[node], tables.dofs[node]
    square, hinge, pivot = tables.square[node], tables.hinge[node], tables.pivot[node]
    for a in range(m):
        for j in range(r):
            total = P.dtype(0.0)
            for b in range(m):
                total += P[world, square + a * m + b] * H[world, hinge + j * m + b]
            U_out[world, hinge + a * r + j] = total
    for j in range(r):
        for k in range(j + 1):
            total = Delta[world, pivot + j * r + k]
            for a in range(m):
                total += H[world, hinge + j * m + a] * U_out[world, hinge + a * r + k]
            D_out[world, pivot + j * r + k] = total
            D_out[world, pivot + k * r + j] = total


@wp.func
def decompose(D: wp.array2d[Any], pivot: int, r: int, world: int, L_out: wp.array2d[Any]):
    """L L* = D, the block of r rows at ``pivot``; NaN where D is not positive definite."""
    for j in range(r):
        for k in range(j + 1):
            total = D[world, pivot + j * r + k]
            for c in range(k):
                total -= L_out[world, pivot + j * r + c] * L_out[world, pivot + k * r + c]
            if j == k:
                if not total > D.dtype(0.0):
                    total = D.dtype(wp.nan)
                L_out[world, pivot + j * r + j] = wp.sqrt(total)
            else:
                L_out[world, pivot + j * r + k] = total / L_out[world, pivot + k * r + k]


@wp.func
def solve(L: wp.array2d[Any], pivot: int, r: int, world: int, first: int, step: int, x_out: wp.array2d[Any]):
    """x <- D^-1 x for the r entries at ``first``, ``first + step``, ...: L y = x, then L* x = y."""
    for j in range(r):
        total = x_out[world, first + j * step]
        for c in range(j):
            total -= L[world, pivot + j * r + c] * x_out[world, first + c * step]
        x_out[world, first + j * step] = total / L[world, pivot + j * r + j]
    for back in range(r):
        j = r - 1 - back
        total = x_out[world, first + j * step]
        for c in range(j + 1, r):
            total -= L[world, pivot + c * r + j] * x_out[world, first + c * step]
        x_out[world, first + j * step] = total / L[world, pivot + j * r + j]


@wp.func
def carry_on(
    tables: BlockTables,
    node: int,
    world: int,
    weight: wp.array2d[Any],
    H: wp.array2d[Any],
    P: wp.array2d[Any],
    G: wp.array2d[Any],
    U: wp.array2d[Any],
    psi_out: wp.array2d[Any],
    carry_out: wp.array2d[Any],
):
    """w_psi = w - (w G) H and w P+ = w P - (w G) U*, for a node that has a parent."""
    m, r, own = tables.size[node], tables.dofs[node], tables.weight[node]
    square, hinge = tables.square[node], tables.hinge[node]
    for a in range(tables.size[tables.parent[node]]):
        for b in range(m):
            through = P.dtype(0.0)
            psi = weight[world, own + a * m + b]
            for c in range(m):
                through += weight[world, own + a * m + c] * P[world, square + c * m + b]
            for j in range(r):
                gain = P.dtype(0.0)
                for c in range(m):
                    gain += weight[world, own + a * m + c] * G[world, hinge + c * r + j]
                through -= gain * U[world, hinge + b * r + j]
                psi -= gain * H[world, hinge + j * m + b]
            carry_out[world, own + a * m + b] = through
            psi_out[world, own + a * m + b] = psi


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
        hinge, pivot = tables.hinge[node], tables.pivot[node]
        gather(tables, node, world, M, carry_out, weight, P_out)
        project(tables, node, world, P_out, H, Delta, U_out, D_out)
        decompose(D_out, pivot, r, world, L_out)
        for column in range(r):
            for row in range(r):
                D_inverse_out[world, pivot + row * r + column] = T(wp.where(row == column, 1.0, 0.0))
            solve(L_out, pivot, r, world, pivot + column, r, D_inverse_out)
        for row in range(m):  # G D = U
            for column in range(r):
                G_out[world, hinge + row * r + column] = U_out[world, hinge + row * r + column]
            solve(L_out, pivot, r, world, hinge + row * r, 1, G_out)
        if tables.parent[node] >= 0:
            carry_on(tables, node, world, weight, H, P_out, G_out, U_out, psi_out, carry_out)

    return kernel


KERNELS = (factorize,)
