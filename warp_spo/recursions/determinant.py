"""The gradient of log det Mass, outward: d log det / d P(k) = Upsilon(k), which phi carries as it carries P inward.

Upsilon+ = phi* Upsilon(p) phi belongs to P+, Upsilon(k) = psi-bar* Upsilon+ psi-bar + H* D^-1 H to P(k). A hinge that
moves a link moves phi P+ phi* by its generator crf(H*), so that d log det / d theta = 2 tr(Upsilon+ crf(H*) P+).
A. Jain, "Compensating mass matrix potential for constrained molecular dynamics" (1997).
"""

from __future__ import annotations

from ..trace.scalars import Value
from ..trace.spatial import ZERO, Articulated, Matrix, Pose, Vector, dot
from .articulated import NO_INERTIA, Factor


def to_child(pose: Pose, S: Articulated) -> Articulated:
    """phi* S phi: phi* moves (v; omega) as phi moves (n; f), the way back."""
    still = Pose(None, None, -pose.l) if pose.matrix is None else Pose(None, pose.matrix.T, -(pose.matrix.T @ pose.l))
    S = still.articulated_to_parent(_exchanged(S))
    if pose.turn is not None:
        c, s = pose.turn
        S = Pose((c, -s), None, ZERO).articulated_to_parent(S)
    return _exchanged(S)


def _exchanged(S: Articulated) -> Articulated:
    return Articulated(S.m, S.C.T, S.J)


def upsilon(done: Factor, S: Articulated) -> Articulated:
    """Upsilon(k) for S = Upsilon+, pivot by pivot: P+ = P - U D^-1 U*."""
    if done.whole:  # nothing of P is left in P+
        S = NO_INERTIA
    for pivot in done.pivots[::-1]:
        g, h = pivot.U * pivot.inverse, pivot.column
        y = Vector(dot((S.entry(i, j) for j in range(6)), g) for i in range(6))
        s = dot(g, y) + pivot.inverse
        S = Articulated.build(
            lambda i, j, S=S, y=y, s=s, h=h: S.entry(i, j) - h[i] * y[j] - y[i] * h[j] + s * (h[i] * h[j])
        )
    return S


def generators(S: Articulated, P: Articulated) -> tuple[Vector, Vector]:
    """tr(S crf(omega; v) P) per unit of omega, and of v."""

    def entry(i: int, j: int) -> Value:
        return dot((P.entry(i, k) for k in range(6)), [S.entry(k, j) for k in range(6)])

    both = Matrix.of([[entry(i, j) + entry(i + 3, j + 3) for j in range(3)] for i in range(3)])
    return _axial(both), _axial(Matrix.of([[entry(i + 3, j) for j in range(3)] for i in range(3)]))


def _axial(A: Matrix) -> Vector:
    """The vector a with tr(w~ A) = w . a."""
    return Vector((A[1][2] - A[2][1], A[2][0] - A[0][2], A[0][1] - A[1][0]))
