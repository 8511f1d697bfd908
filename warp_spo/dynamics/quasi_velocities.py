"""Quasi-velocities, in which the kinetic energy is a sum of squares, and their equations of motion nu' + C = eps."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..execution.routine import Routine
from ..recursions import quasi_velocities as recursion
from ..runtime.arrays import AnyArray, ArrayT
from .operation import AS_WRITTEN, BODY_F, QD, TAU, Argument, Operation, Q, Refused, Result, Trial, required

if TYPE_CHECKING:
    from ..reference.dense import Dense
    from .dynamics import Dynamics

NU = Argument("nu", "world, dof", sample="qdd")
OF_ALL_DOFS = Refused("factor mass_matrix, which is that of the independent dofs")

QUASI_VELOCITIES = Operation(
    "quasi_velocities",
    arguments=(Q, required(QD)),
    results=(Result("nu", "world, dof"),),
    routine=Routine("quasi_velocities", recursion.quasi_velocities),
    embed=OF_ALL_DOFS,
    multipliers=AS_WRITTEN,
    trial=Trial(lambda dense, q, qd: dense.quasi_velocities(qd)),
)


@QUASI_VELOCITIES.method
def quasi_velocities(self: Dynamics, q: ArrayT, qd: AnyArray, out: ArrayT | None = None) -> ArrayT:
    """Compute nu = sqrt(D) [I + H phi K]* qd, in which the kinetic energy is nu . nu / 2 (armature included).

    U = [I + H phi K] is the unit upper triangular factor of Mass = U D U*, in the order in which dofs nearer to the
    root come first; D is diagonal, and * is the transpose. The factorization goes dof by dof and eliminates later dofs
    of a hinge first. Jain, Rodriguez 1995, "Diagonalized Lagrangian robot dynamics".

    Args:
        q: [world, coordinate].
        qd: [world, dof].

    Returns:
        [world, dof], [sqrt(kg) m/s]; NaN where D is not positive.
    """
    return self._engine.run(QUASI_VELOCITIES, out, q=q, qd=qd)


def dense_velocities(dense: Dense, nu: np.ndarray) -> np.ndarray:
    """Return qd of quasi-velocities [dof]: the solution of u* qd = nu, for Mass = u u*."""
    return np.linalg.solve(dense.mass_root.T, nu)


GENERALIZED_VELOCITIES = Operation(
    "generalized_velocities",
    arguments=(Q, NU),
    results=(Result("qd", "world, dof"),),
    routine=Routine("generalized_velocities", recursion.generalized_velocities),
    embed=OF_ALL_DOFS,
    multipliers=AS_WRITTEN,
    trial=Trial(lambda dense, q, nu: dense_velocities(dense, nu)),
)


@GENERALIZED_VELOCITIES.method
def generalized_velocities(self: Dynamics, q: ArrayT, nu: AnyArray, out: ArrayT | None = None) -> ArrayT:
    """Compute qd = [I - H psi K]* nu / sqrt(D), the velocities of the dofs for quasi-velocities nu.

    Args:
        q: [world, coordinate].
        nu: quasi-velocities [world, dof], as :meth:`quasi_velocities` returns them.

    Returns:
        [world, dof], in the units of qd; NaN where D is not positive.
    """
    return self._engine.run(GENERALIZED_VELOCITIES, out, q=q, nu=nu)


def dense_force(dense: Dense, tau: np.ndarray) -> np.ndarray:
    """Return u^-1 (tau - gravity_force) [dof], for Mass = u u*."""
    return np.linalg.solve(dense.mass_root, tau - dense.gravity_force)


QUASI_VELOCITY_FORCE = Operation(
    "quasi_velocity_force",
    arguments=(Q, TAU, BODY_F),
    results=(Result("eps", "world, dof"),),
    routine=Routine("quasi_velocity_force", recursion.quasi_velocity_force),
    embed=OF_ALL_DOFS,
    multipliers=AS_WRITTEN,
    trial=Trial(lambda dense, q, tau: dense_force(dense, tau)),
)


@QUASI_VELOCITY_FORCE.method
def quasi_velocity_force(
    self: Dynamics, q: ArrayT, tau: AnyArray | None = None, body_f: AnyArray | None = None, out: ArrayT | None = None
) -> ArrayT:
    """Compute eps of nu' + C(q, nu) = eps: all forces of forward dynamics, in the quasi-velocities.

    eps = [I - H psi K] (tau - gravity_force(q) + J* body_f) / sqrt(D), with J* body_f the forces of the dofs that do
    the work of body_f. It is dual to nu: eps . nu is the power of the forces. Gravity and body_f enter by bodies, as in
    forward dynamics. Jain, Rodriguez 1995, "Diagonalized Lagrangian robot dynamics".

    Args:
        q: [world, coordinate].
        tau: force of the dofs [world, dof] [N m, N]; None is zero.
        body_f: force [N], then torque [N m] at each body's CoM, world axes [world, body, 6]; None is zero.

    Returns:
        [world, dof], [sqrt(kg) m/s^2]; NaN where D is not positive.
    """
    return self._engine.run(QUASI_VELOCITY_FORCE, out, q=q, tau=tau, body_f=body_f)


def dense_coriolis(dense: Dense, nu: np.ndarray) -> np.ndarray:
    """Return u^-1 (bias_force - gravity_force) - (u*)' qd [dof], for Mass = u u*; (u*)' by differences."""
    qd = dense_velocities(dense, nu)
    force = np.linalg.solve(dense.mass_root, dense.bias_force(qd) - dense.gravity_force)
    return force - dense.rate(lambda moved: moved.mass_root.T @ qd, qd)


QUASI_VELOCITY_CORIOLIS = Operation(
    "quasi_velocity_coriolis",
    arguments=(Q, NU),
    results=(Result("C", "world, dof"),),
    routine=Routine("quasi_velocity_coriolis", recursion.quasi_velocity_coriolis),
    embed=OF_ALL_DOFS,
    multipliers=AS_WRITTEN,
    trial=Trial(lambda dense, q, nu: dense_coriolis(dense, nu)),
)


@QUASI_VELOCITY_CORIOLIS.method
def quasi_velocity_coriolis(self: Dynamics, q: ArrayT, nu: AnyArray, out: ArrayT | None = None) -> ArrayT:
    """Compute C(q, nu) of nu' + C = eps, what is left of Coriolis and centrifugal forces in the quasi-velocities.

    It is quadratic in nu and does no work: nu . C = 0. It is computed as -nu' of a motion without forces, in which nu
    changes because qd does (the articulated-body recursion) and because sqrt(D) [I + H phi K]* does (its derivative
    along the motion, in forward mode). :meth:`quasi_velocity_force` is eps. Jain, Rodriguez 1995, "Diagonalized
    Lagrangian robot dynamics".

    Args:
        q: [world, coordinate].
        nu: quasi-velocities [world, dof], as :meth:`quasi_velocities` returns them.

    Returns:
        [world, dof], [sqrt(kg) m/s^2]; NaN where D is not positive.
    """
    return self._engine.run(QUASI_VELOCITY_CORIOLIS, out, q=q, nu=nu)
