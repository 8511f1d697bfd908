"""The gradient of log det Mass, outward: d log det / d P(k) = Upsilon(k), which phi carries as it carries P inward.

Upsilon+ = phi* Upsilon(p) phi belongs to P+, Upsilon(k) = psi-bar* Upsilon+ psi-bar + H* D^-1 H to P(k). A hinge that
moves a link moves phi P+ phi* by its generator crf(H*), so that d log det / d theta = 2 tr(Upsilon+ crf(H*) P+).
A. Jain, "Compensating mass matrix potential for constrained molecular dynamics" (1997).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..trace.differentiation import reverse
from ..trace.emission import Store
from ..trace.scalars import Value, ordered, sum_of_logarithms
from ..trace.spatial import ZERO, Articulated, Matrix, Pose, Vector, dot
from . import motion
from .articulated import NO_INERTIA, LinkFactor
from .articulated_sweeps import factor_tree
from .derivatives.tangents import tangent_gradient

if TYPE_CHECKING:
    from .model.tracing import Trace


def to_child(pose: Pose, S: Articulated) -> Articulated:
    """phi* S phi: phi* moves (v; omega) as phi moves (n; f), the way back."""
    still = Pose(None, None, -pose.l) if pose.matrix is None else Pose(None, pose.matrix.T, -(pose.matrix.T @ pose.l))
    S = still.articulated_to_parent(_exchange(S))
    if pose.turn is not None:
        c, s = pose.turn
        S = Pose((c, -s), None, ZERO).articulated_to_parent(S)
    return _exchange(S)


def _exchange(S: Articulated) -> Articulated:
    return Articulated(S.m, S.C.T, S.J)


def upsilon(done: LinkFactor, S: Articulated) -> Articulated:
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


def log_det_mass_matrix(trace: Trace) -> list[Store]:
    done = factor_tree(trace)
    return [Store("out", (), sum_of_logarithms(p.D for f in done.values() for p in f.pivots))]


def log_det_mass_matrix_gradient(trace: Trace, scale: float = 1.0) -> list[Store]:
    """out = d log det Mass / dq, dual to qd"""
    done = factor_tree(trace)
    if trace.links.shares_dofs or any(link.hinge.columns_vary for link in trace.links.links):
        return _by_reverse(trace, done, scale)
    carried: dict[int, Articulated] = {}
    stores = []
    for link in trace.links.links:
        trace.label(link, "u")
        key, factor = id(link), done[id(link)]
        place = trace.places[key]
        S = NO_INERTIA
        if link.parent is not None:
            S = to_child(place.pose, carried[id(link.parent)])
        carried[key] = upsilon(factor, S)
        w, v = generators(S, factor.P)
        if factor.whole:
            w, v = ZERO, ZERO
        elif len(link.dofs) > 1 and not factor.turned:  # turning the link turns H: move P under it instead
            P = NO_INERTIA if link.inertia is None else link.inertia.articulated
            for child in link.children:
                P = P + done[id(child)].in_parent
            w, _ = generators(carried[key], P)
        values = motion.hinge_entries(link, place, w, v)
        stores += [Store("out", (dof,), 2.0 * scale * x) for dof, x in zip(link.dofs, values, strict=True)]
    return stores


def _by_reverse(trace: Trace, done: dict[int, LinkFactor], scale: float) -> list[Store]:
    """The same as the reverse of the sweep that finds D: of hinges whose columns depend on q, too."""
    value = sum_of_logarithms(pivot.D for factor in done.values() for pivot in factor.pivots)
    inputs = [x for x in ordered([value]) if x.op == "input" and x.args[0] == "q"]
    gradient = dict(zip((x.args for x in inputs), reverse([value], inputs, [scale]), strict=True))
    return [Store("out", index, entry) for index, entry in tangent_gradient(trace, gradient)]


def fixman_torque(trace: Trace) -> list[Store]:
    """out = -1/2 d log det Mass / dq"""
    return log_det_mass_matrix_gradient(trace, -0.5)
