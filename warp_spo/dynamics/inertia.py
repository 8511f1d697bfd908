"""The mass matrix: the matrix itself, its inverse, solves with it and its determinant."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..execution.node import operations as node_operations
from ..execution.routine import Routine, SegmentForm, TuningHints
from ..recursions import composite, determinant, forward_dynamics
from ..recursions import mass_matrix_inverse as inverse
from ..recursions.derivatives import adjoints
from ..recursions.loops import minimal
from ..runtime import launches
from ..runtime.arrays import AnyArray, ArrayT
from .operation import AS_WRITTEN, Argument, Derivative, Operation, Q, Refused, Result, Trial

if TYPE_CHECKING:
    from .dynamics import Dynamics
    from .gradients import Gradients

COLUMNS = 6  # right-hand sides that one kernel of embedded loops solves for
OF_LOG_DET = Refused("take differences of log_det_mass_matrix")

MASS_MATRIX = Operation(
    "mass_matrix",
    arguments=(Q,),
    results=(Result("mass", "world, independent dof, independent dof"),),
    routine=Routine(
        "mass_matrix",
        composite.mass_matrix,
        node_operations.mass_matrix,
        segments=SegmentForm(messages="R"),
        hints=TuningHints(long_result=True),
    ),
    embed=Routine("embedded_mass_matrix", minimal.mass_matrix),
    multipliers=AS_WRITTEN,
    derivative=Derivative(Routine("mass_matrix_vjp", adjoints.mass_matrix_vjp), by=("q",)),
    trial=Trial(lambda dense, q: dense.mass_matrix, main=True),
)


@MASS_MATRIX.method
def mass_matrix(self: Dynamics, q: ArrayT, out: ArrayT | None = None) -> ArrayT:
    """Compute Mass = H phi M phi* H* + Delta, armature included, by composite bodies.

    With embedded loops it is X* Mass X, the matrix of the kinetic energy as a function of the independent dofs.

    Returns:
        [world, dof, dof], both triangles; with embedded loops [world, independent dof, independent dof].
    """
    return self._engine.run(MASS_MATRIX, out, q=q)


MASS_MATRIX_INVERSE = Operation(
    "mass_matrix_inverse",
    arguments=(Q,),
    results=(Result("inverse", "world, independent dof, independent dof"),),
    routine=Routine(
        "mass_matrix_inverse",
        inverse.mass_matrix_inverse,
        node_operations.mass_matrix_inverse,
        segments=SegmentForm(messages="PNDVY"),
        hints=TuningHints(long_result=True),
    ),
    embed=Routine("embedded_mass_matrix_inverse", minimal.mass_matrix_inverse),
    multipliers=AS_WRITTEN,
    trial=Trial(
        lambda dense, q: np.linalg.inv(dense.mass_matrix),
        solves=lambda dense, q: (dense.mass_matrix, np.eye(len(dense.mass_matrix))),
        main=True,
    ),
)


@MASS_MATRIX_INVERSE.method
def mass_matrix_inverse(self: Dynamics, q: ArrayT, out: ArrayT | None = None) -> ArrayT:
    """Compute Mass^-1 = [I - H psi K]* D^-1 [I - H psi K] (eq. 1), both triangles [world, dof, dof]."""
    return self._engine.run(MASS_MATRIX_INVERSE, out, q=q)


def _pull_columns(
    gradients: Gradients, operation: Operation, given: dict, options: dict, results: Any, cotangents: Any, wrt: Any
) -> dict[str, Any]:
    """Return gradients for several right-hand sides, torch tensors, one after the other."""
    (result,), (cotangent,) = results, cotangents
    if result.ndim == 2:
        return gradients.pull_back_kernel(operation, given, options, result, cotangent, wrt)
    found: dict[str, Any] = {}
    for c in range(result.shape[2]):
        column, along = result[..., c].contiguous(), cotangent[..., c].contiguous()
        for name, gradient in gradients.pull_back_kernel(operation, given, options, column, along, wrt).items():
            if name != "b":
                found[name] = found[name] + gradient if name in found else gradient
            else:
                found.setdefault("b", result.clone())[..., c] = gradient
    return found


SOLVE_MASS_MATRIX = Operation(
    "solve_mass_matrix",
    arguments=(Q, Argument("b", "world, independent dof", columns=True)),
    results=(Result("x", "world, independent dof", like="b"),),
    routine=Routine(
        "solve_mass_matrix",
        forward_dynamics.solve_mass_matrix,
        node_operations.solve_mass_matrix,
        segments=SegmentForm(messages="Pza"),
        hints=TuningHints(velocities=False, occupancy=((4, 128),)),
    ),
    embed=Routine("embedded_solve_mass_matrix", minimal.solve_mass_matrix),
    multipliers=AS_WRITTEN,
    derivative=Derivative(
        Routine("solve_mass_matrix_vjp", adjoints.solve_mass_matrix_vjp), by=("q", "b"), reads="qdd", pull=_pull_columns
    ),
    trial=Trial(
        lambda dense, q, b: np.linalg.solve(dense.mass_matrix, b),
        solves=lambda dense, q, b: (dense.mass_matrix, b),
        main=True,
    ),
)


@SOLVE_MASS_MATRIX.method
def solve_mass_matrix(self: Dynamics, q: ArrayT, b: AnyArray, out: ArrayT | None = None) -> ArrayT:
    """Compute Mass^-1 b in O(dof) for each column.

    Args:
        q: coordinates [world, coordinate].
        b: right-hand sides [world, dof] or [world, dof, columns]; with embedded loops Mass is that of the independent
            dofs, and b is [world, independent dof], or with columns, of which one kernel takes up to six.
        out: array for the result.

    Returns:
        Mass^-1 b, of the shape of b.
    """
    engine = self._engine
    with engine.call(SOLVE_MASS_MATRIX) as call:
        given = engine.read(call, SOLVE_MASS_MATRIX, q=q, b=b)
        (x,) = engine.write(call, SOLVE_MASS_MATRIX, (out,), given)
        if self._refinement is not None:
            self._refinement.solve_mass_matrix(**given, out=x)
        elif self.embedding is not None and x.ndim == 3:
            _solve_columns(self, **given, out=x)
        elif x.ndim == 3 and self.scene.shares_dofs:
            _solve_one_by_one(self, **given, out=x)
        elif x.ndim == 3:
            node_operations.solve_mass_matrix(self.recursions, x, **given)
        else:
            engine.launch(SOLVE_MASS_MATRIX, x, **given)
    return call.result


def _solve_columns(dyn: Dynamics, q: wp.array, b: wp.array, out: wp.array) -> None:
    """Solve for several right-hand sides with embedded loops: up to COLUMNS in one kernel, which factors once."""
    columns, launch = b.shape[2], dyn._engine.launch
    if columns <= COLUMNS:
        launch(SOLVE_MASS_MATRIX, out, q=q, b=b, columns=columns)
        return
    for first in range(0, columns, COLUMNS):
        chunk = slice(first, min(first + COLUMNS, columns))
        size = *b.shape[:2], chunk.stop - chunk.start
        right, x = (dyn.recursions.array((name, size), *size) for name in ("columns of b", "columns of Mass^-1 b"))
        launches.copy(right, b[:, :, chunk])
        launch(SOLVE_MASS_MATRIX, x, q=q, b=right, columns=size[2])
        launches.copy(out[:, :, chunk], x)


def _solve_one_by_one(dyn: Dynamics, q: wp.array, b: wp.array, out: wp.array) -> None:
    """Solve for several right-hand sides where links share dofs, of which node granularity knows nothing."""
    right, x = (dyn.recursions.array((name, 1), *b.shape[:2]) for name in ("columns of b", "columns of Mass^-1 b"))
    for c in range(b.shape[2]):
        launches.copy(right, b[:, :, c])
        dyn._engine.launch(SOLVE_MASS_MATRIX, x, q=q, b=right)
        launches.copy(out[:, :, c], x)


# -- packed ------------------------------------------------------------------------------------------------------------
MASS_MATRIX_PACKED = Operation(
    "mass_matrix_packed",
    arguments=(Q,),
    results=(Result("entries", "world, entry"),),
    routine=Routine("mass_matrix_packed", composite.mass_matrix_packed),
    embed=Refused("use mass_matrix"),
    multipliers=AS_WRITTEN,
)


@MASS_MATRIX_PACKED.method
def mass_matrix_packed(self: Dynamics, q: ArrayT, out: ArrayT | None = None) -> ArrayT:
    """Compute the entries of :meth:`mass_matrix` at :attr:`mass_matrix_pattern` [world, entry]."""
    return self._engine.run(MASS_MATRIX_PACKED, out, entries=len(self.mass_matrix_pattern[0]), q=q)


def mass_matrix_pattern(self: Dynamics) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the entries of Mass's lower triangle that the tree allows, row after row.

    Two dofs meet if the body of one carries the body of the other, or if they belong to one hinge.
    """
    self._engine.refuse(MASS_MATRIX_PACKED.name, MASS_MATRIX_PACKED)
    scene, met = self.scene, []
    node_of = np.repeat(np.argsort(scene.hinge_of), np.diff(scene.qd_start))
    for row, a in enumerate(node_of):
        for column, b in enumerate(node_of[: row + 1]):
            if a == b or scene.tree.is_ancestor(int(a), int(b)) or scene.tree.is_ancestor(int(b), int(a)):
                met.append((row, column))
    rows, columns = np.array(met, dtype=int).reshape(-1, 2).T
    return rows, columns


MASS_MATRIX_INVERSE_PACKED = Operation(
    "mass_matrix_inverse_packed",
    arguments=(Q,),
    results=(Result("entries", "world, entry"),),
    routine=Routine("mass_matrix_inverse_packed", inverse.mass_matrix_inverse_packed),
    embed=Refused("use mass_matrix_inverse"),
    multipliers=AS_WRITTEN,
)


@MASS_MATRIX_INVERSE_PACKED.method
def mass_matrix_inverse_packed(self: Dynamics, q: ArrayT, out: ArrayT | None = None) -> ArrayT:
    """Compute the entries of :meth:`mass_matrix_inverse` at :attr:`mass_matrix_inverse_pattern` [world, entry].

    Worlds in which Mass is not positive definite are NaN as there.
    """
    entries = len(self.mass_matrix_inverse_pattern[0])
    return self._engine.run(MASS_MATRIX_INVERSE_PACKED, out, entries=entries, q=q)


def mass_matrix_inverse_pattern(self: Dynamics) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the entries of Mass^-1's lower triangle that are not zero, row after row.

    Two dofs meet if one moving body carries both. Within one tree no entry is zero; trees of a forest do not meet.
    """
    self._engine.refuse(MASS_MATRIX_INVERSE_PACKED.name, MASS_MATRIX_INVERSE_PACKED)
    scene, carrier = self.scene, np.full(self.scene.body_count, -1)
    for node in (node for level in scene.tree.levels for node in level):
        above = carrier[scene.tree.parent[node]] if scene.tree.parent[node] >= 0 else -1
        carrier[node] = above if above >= 0 or scene.hinge_sizes[node] == 0 else node
    root = np.repeat(carrier[np.argsort(scene.hinge_of)], np.diff(scene.qd_start))
    rows, columns = np.nonzero(np.tril(root[:, None] == root[None]))
    return rows, columns


# -- determinant and factor --------------------------------------------------------------------------------------------
LOG_DET_MASS_MATRIX = Operation(
    "log_det_mass_matrix",
    arguments=(Q,),
    results=(Result("log_det", "world"),),
    routine=Routine("log_det_mass_matrix", determinant.log_det_mass_matrix, node_operations.log_det_mass_matrix),
    embed=Routine("embedded_log_det_mass_matrix", minimal.log_det_mass_matrix),
    multipliers=AS_WRITTEN,
    # its absolute error is the relative error of the determinant
    trial=Trial(lambda dense, q: dense.log_det, scale=lambda dense, expected: 1.0, main=True),
)


@LOG_DET_MASS_MATRIX.method
def log_det_mass_matrix(self: Dynamics, q: ArrayT, out: ArrayT | None = None) -> ArrayT:
    """Compute log det Mass = sum of log D(k), added in float64 [world]; with embedded loops log det X* Mass X."""
    return self._engine.run(LOG_DET_MASS_MATRIX, out, q=q)


LOG_DET_MASS_MATRIX_GRADIENT = Operation(
    "log_det_mass_matrix_gradient",
    arguments=(Q,),
    results=(Result("gradient", "world, dof"),),
    routine=Routine("log_det_mass_matrix_gradient", determinant.log_det_mass_matrix_gradient),
    embed=OF_LOG_DET,
    multipliers=AS_WRITTEN,
)


@LOG_DET_MASS_MATRIX_GRADIENT.method
def log_det_mass_matrix_gradient(self: Dynamics, q: ArrayT, out: ArrayT | None = None) -> ArrayT:
    """Compute the gradient of log det Mass, whose rate is gradient . qd, by one sweep in and one out, O(dof).

    It is dual to qd, like a force: the entry of a dof is the derivative along unit qd of that dof alone, 2 tr(Upsilon+
    crf(H*) P+), where Upsilon is the gradient by the articulated inertia. A. Jain 1997.

    Returns:
        [world, dof], [1 per unit of the dof]
    """
    return self._engine.run(LOG_DET_MASS_MATRIX_GRADIENT, out, q=q)


FIXMAN_TORQUE = Operation(
    "fixman_torque",
    arguments=(Q,),
    results=(Result("torque", "world, dof"),),
    routine=Routine("fixman_torque", determinant.fixman_torque),
    embed=OF_LOG_DET,
    multipliers=Refused(),
    trial=Trial(
        lambda dense, q: dense.fixman_torque, scale=lambda dense, expected: max(1.0, float(np.linalg.norm(expected)))
    ),
)


@FIXMAN_TORQUE.method
def fixman_torque(self: Dynamics, q: ArrayT, out: ArrayT | None = None) -> ArrayT:
    """Compute the force of the Fixman potential (kT/2) log det Mass, divided by kT: -1/2 the gradient of log det Mass.

    kT times this torque removes the bias that rigid bonds put on the distribution of q. Fixman 1974; A. Jain 1997.

    Returns:
        [world, dof], [1 per unit of the dof], dual to qd.
    """
    return self._engine.run(FIXMAN_TORQUE, out, q=q)
