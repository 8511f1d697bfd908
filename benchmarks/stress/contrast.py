"""Other forms of forward dynamics in NumPy float32, to show what their errors would be. The library has none of them.

Each form is a function ``(scene, q, tau) -> (qdd, D)``, [world, dof]. A result is NaN where the form breaks down.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from .exact import Link, Sweep, block, force_transform, skew, transpose

FLOAT32 = np.float32


def _sweep(scene: Any, q: np.ndarray, tau: np.ndarray, **options: Any) -> tuple[np.ndarray, np.ndarray]:
    sweep = Sweep(scene, q, "float32", **options)
    return sweep.forward(tau), sweep.D


def _world_poses(links: list[Link], outward: list[int]) -> tuple[list, list]:
    R: list[Any] = [None] * len(links)
    x: list[Any] = [None] * len(links)
    for k in outward:
        link = links[k]
        if link.parent < 0:
            R[k], x[k] = link.R, link.l
        else:
            R[k] = R[link.parent] @ link.R
            x[k] = x[link.parent] + (R[link.parent] @ link.l[..., None])[..., 0]
    return R, x


def _move_link(link: Link, R: np.ndarray, x: np.ndarray, l: np.ndarray) -> Link:
    """Return the link in world axes, about the point at ``-x`` from its origin and at ``l`` from the parent's point."""
    force = force_transform(R, x)
    motion = block(R, R * 0, skew(x) @ R, R)
    unit = np.broadcast_to(np.eye(3, dtype=R.dtype), R.shape)
    return dataclasses.replace(link, R=unit, l=l, H=motion @ link.H, M=force @ link.M @ transpose(force))


def world_axes(links: list[Link], outward: list[int]) -> list[Link]:
    """Return the links in world axes about their origins; offsets are rotated from the local ones."""
    R, x = _world_poses(links, outward)
    moved = []
    for k, link in enumerate(links):
        offset = link.l if link.parent < 0 else (R[link.parent] @ link.l[..., None])[..., 0]
        moved.append(_move_link(link, R[k], x[k] * 0, offset))
    return moved


def world_axes_by_subtraction(links: list[Link], outward: list[int]) -> list[Link]:
    """Return the links in world axes about their origins; offsets are differences of world positions."""
    R, x = _world_poses(links, outward)
    return [
        _move_link(link, R[k], x[k] * 0, x[k] - (x[link.parent] if link.parent >= 0 else 0 * x[k]))
        for k, link in enumerate(links)
    ]


def world_origin(links: list[Link], outward: list[int]) -> list[Link]:
    """Return the links in world axes about the world's origin, where phi is the identity."""
    R, x = _world_poses(links, outward)
    return [_move_link(link, R[k], x[k], x[k] * 0) for k, link in enumerate(links)]


def square_root(scene: Any, q: np.ndarray, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return qdd and D by the square-root form: P = L L* is only known by L, which QR of stacked factors updates."""
    sweep = Sweep(scene, q, "float32")
    factors: list[list] = [[] for _ in sweep.links]
    for k in reversed(sweep.outward):
        link = sweep.links[k]
        roots = [transpose(_body_root(link.M)), *factors[k]]
        L = np.linalg.qr(np.concatenate(roots, -2), mode="r")  # L* L = P
        for e in reversed(range(len(link.dofs))):
            dof, h = link.dofs[e], link.H[..., e : e + 1]
            root = np.sqrt(np.maximum(link.armature[:, e], 0))[:, None, None]
            top = np.concatenate([root, np.zeros((len(root), 1, 6), FLOAT32)], -1)
            array = np.linalg.qr(np.concatenate([top, np.concatenate([L @ h, L], -1)], -2), mode="r")
            pivot = array[:, :1, :1]
            sweep.D[:, dof] = pivot[:, 0, 0] ** 2
            sweep.U[dof] = transpose(pivot * array[:, :1, 1:])
            L = array[:, 1:, 1:]
        if link.parent >= 0:
            factors[link.parent].append(L @ transpose(link.phi))
    return sweep.forward(tau), sweep.D


def _body_root(M: np.ndarray) -> np.ndarray:
    """Return L = [[J_c^1/2, c~ m^1/2], [0, m^1/2]], for which L L* = M, of a body with positive mass."""
    root = np.sqrt(M[:, 3:, 3:])  # diagonal
    s = M[:, :3, 3:] / M[:, 3, 3][:, None, None]
    J = M[:, :3, :3] - M[:, :3, 3:] @ transpose(s)
    values, vectors = np.linalg.eigh((J + transpose(J)) / 2)
    return block(vectors * np.sqrt(np.maximum(values, 0))[:, None, :], s @ root, root * 0, root)


def cholesky(mass: np.ndarray, right: np.ndarray, dtype: Any = FLOAT32) -> np.ndarray:
    """Return mass^-1 right [world, dof] by a dense Cholesky factorisation in ``dtype``; NaN where it breaks down."""
    out = np.full(right.shape, np.nan, dtype)
    for world, (M, b) in enumerate(zip(mass.astype(dtype), right.astype(dtype), strict=True)):
        try:
            L = np.linalg.cholesky(M)
        except np.linalg.LinAlgError:
            continue
        out[world] = np.linalg.solve(L.T, np.linalg.solve(L, b))
    return out


FORMS: dict[str, Callable] = {
    "body axes, NumPy": _sweep,
    "full 6 x 6 P": functools.partial(_sweep, symmetric=False),
    "world axes": functools.partial(_sweep, change=world_axes),
    "subtracted offsets": functools.partial(_sweep, change=world_axes_by_subtraction),
    "world origin": functools.partial(_sweep, change=world_origin),
    "square root": square_root,
    "float32 sum": _sweep,
}
