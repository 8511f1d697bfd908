"""Normal modes: modal arrays in other amplitudes, in which mass and stiffness are diagonal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..checks import SYMMETRY, checked_array
from .modes import MassPoints, Modes


def normal_modes(
    mass: Any,
    stiffness: Any,
    damping: Any = None,
    coupling: Any = None,
    slopes: Mapping[Any, Any] | None = None,
    stiffening: Mapping[Any, Any] | None = None,
    points: MassPoints | None = None,
    damping_ratio: float | None = None,
    rigid: Any = None,
) -> tuple[Modes, np.ndarray]:
    """Return the modes of a body whose stiffness matrix is full, as a reduction after Craig and Bampton gives it.

    :class:`Modes` takes a diagonal stiffness. With the eigenvectors Phi of stiffness Phi = mass Phi diag(omega^2),
    Phi* mass Phi = 1, the amplitudes xi of the arrays are Phi eta, eta those of the result.

    Args:
        mass: modal mass (n, n), positive definite; None: that of the points.
        stiffness: modal stiffness (n, n), symmetric, no negative eigenvalue.
        damping: modal damping (n, n) that the same vectors make diagonal, such as a sum of multiples of mass and
            stiffness; None: zero, or of ``damping_ratio``.
        coupling, slopes, stiffening, points: as of :class:`Modes`, for the amplitudes xi.
        damping_ratio: share of critical damping of every mode, 2 damping_ratio omega, in place of ``damping``.
        rigid: as of :class:`Modes`.

    Returns:
        the modes; Phi (n, n).

    Raises:
        ValueError: a shape is wrong, mass is not positive definite, stiffness has a negative eigenvalue, or damping is
            not diagonal in the new amplitudes.
    """
    call = "normal_modes"
    if mass is None and points is None:
        raise ValueError(f"{call}: mass is missing; expected (n, n), or points=MassPoints(...)")
    M = points.inertia[6:, 6:] if mass is None and points is not None else mass
    n = np.shape(M)[-1] if np.ndim(M) else 0
    M, K = (_check_matrix(call, name, value, n) for name, value in (("mass", M), ("stiffness", stiffness)))
    lowest = np.linalg.eigvalsh(M)[0]
    if not lowest > 0.0:
        raise ValueError(f"{call}: mass has the eigenvalue {lowest:.3g}; expected positive ones; leave out such modes")
    root = np.linalg.inv(np.linalg.cholesky(M))
    squares, vectors = np.linalg.eigh(root @ K @ root.T)
    if squares[0] < -SYMMETRY * np.abs(squares).max():
        raise ValueError(f"{call}: stiffness gives omega^2 = {squares[0]:.3g}; expected none below zero")
    basis, omega = root.T @ vectors, np.sqrt(np.maximum(squares, 0.0))
    if damping is not None and damping_ratio is not None:
        raise ValueError(f"{call}: damping and damping_ratio are given; expected one of them")
    D = np.diag(2.0 * (damping_ratio or 0.0) * omega)
    if damping is not None:
        D = basis.T @ _check_matrix(call, "damping", damping, n) @ basis
        off = np.abs(D - np.diag(np.diag(D))).max()
        if off > SYMMETRY * np.abs(D).max():
            raise ValueError(
                f"{call}: damping couples the normal modes, by {off:.3g}; expected a sum of multiples of mass and "
                "stiffness; pass damping_ratio= instead"
            )
    change = lambda rows: None if rows is None else checked_array(call, "coupling", rows, (6, n)) @ basis  # noqa: E731
    moved = None
    if points is not None:
        bends = None if points.stiffening is None else _in_basis(points.stiffening, basis)
        moved = MassPoints(points.mass, points.position, points.shapes @ basis, bends)
    at = {name: checked_array(call, f"slopes[{name!r}]", rows, (6, n)) @ basis for name, rows in (slopes or {}).items()}
    bent = {name: _in_basis(np.asarray(G, dtype=np.float64), basis) for name, G in (stiffening or {}).items()}
    return Modes(np.eye(n), omega**2, np.diag(D), change(coupling), at, bent, moved, rigid), basis


def _check_matrix(call: str, name: str, value: Any, n: int) -> np.ndarray:
    """Return a symmetric matrix, made exactly so."""
    array = checked_array(call, name, value, (n, n))
    skew = np.abs(array - array.T).max(initial=0.0)
    if skew > SYMMETRY * np.abs(array).max(initial=0.0):
        raise ValueError(f"{call}: {name} is not symmetric, by {skew:.3g}; expected a symmetric matrix")
    return 0.5 * (array + array.T)


def _in_basis(G: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Return Phi* G Phi of each of several matrices."""
    return np.swapaxes(basis, 0, 1) @ G @ basis
