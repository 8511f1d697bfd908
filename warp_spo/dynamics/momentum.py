"""Momentum of a robot and the motion of its centre of mass. Orin, Goswami, Lee 2013.

The centre of mass is that of all bodies that a hinge lets move, of every tree of the scene together.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..execution.node import operations as node_operations
from ..execution.routine import Routine
from ..recursions import momentum as recursion
from ..recursions.derivatives import adjoints
from ..recursions.loops import minimal
from ..runtime.arrays import AnyArray, ArrayT
from .operation import AS_WRITTEN, KINEMATIC, QD, Derivative, Operation, Q, Result, Trial, required

if TYPE_CHECKING:
    from .dynamics import Dynamics

COM_VALUES = ("body_mass", *KINEMATIC)

COM = Operation(
    "com",
    arguments=(Q,),
    results=(Result("com", "world, 3"),),
    routine=Routine("com", recursion.com, node_operations.com),
    embed=AS_WRITTEN,
    multipliers=AS_WRITTEN,
    derivative=Derivative(
        Routine("com_vjp", adjoints.com_vjp), by=("q",), values=COM_VALUES, embed=AS_WRITTEN, multipliers=AS_WRITTEN
    ),
    trial=Trial(lambda dense, q: dense.center_of_mass),
)


@COM.method
def com(self: Dynamics, q: ArrayT, out: ArrayT | None = None) -> ArrayT:
    """Compute the centre of mass of all bodies that a hinge lets move, in the inertial frame [world, 3] [m].

    It is that of :meth:`com_jacobian`: bodies that are fixed to the inertial frame do not count. NaN where all moving
    bodies are massless, and zero where nothing moves.
    """
    return self._engine.run(COM, out, q=q)


COM_VELOCITY = Operation(
    "com_velocity",
    arguments=(Q, required(QD)),
    results=(Result("velocity", "world, 3"),),
    routine=Routine("com_velocity", recursion.com_velocity, node_operations.com_velocity),
    embed=AS_WRITTEN,
    multipliers=AS_WRITTEN,
    derivative=Derivative(
        Routine("com_velocity_vjp", adjoints.com_velocity_vjp),
        by=("q", "qd"),
        values=COM_VALUES,
        embed=AS_WRITTEN,
        multipliers=AS_WRITTEN,
    ),
    trial=Trial(lambda dense, q, qd: dense.com_jacobian @ qd),
)


@COM_VELOCITY.method
def com_velocity(self: Dynamics, q: ArrayT, qd: AnyArray, out: ArrayT | None = None) -> ArrayT:
    """Compute the velocity of :meth:`com`, inertial axes [world, 3] [m/s]: :meth:`com_jacobian` @ qd of all dofs."""
    return self._engine.run(COM_VELOCITY, out, q=q, qd=qd)


COM_JACOBIAN = Operation(
    "com_jacobian",
    arguments=(Q,),
    results=(Result("jacobian", "world, 3, independent dof"),),
    routine=Routine("com_jacobian", recursion.com_jacobian),
    embed=Routine("embedded_com_jacobian", minimal.com_jacobian),
    multipliers=AS_WRITTEN,
    trial=Trial(lambda dense, q: dense.com_jacobian),
)


@COM_JACOBIAN.method
def com_jacobian(self: Dynamics, q: ArrayT, out: ArrayT | None = None) -> ArrayT:
    """Compute the velocity of the centre of mass per unit qd, inertial axes: sum of m(k) J(k) / sum of m(k).

    The centre of mass is that of all bodies that a hinge lets move, of every tree of the scene together.

    Returns:
        [world, 3, dof], [m/s per unit qd]; with embedded loops [world, 3, independent dof].
    """
    return self._engine.run(COM_JACOBIAN, out, q=q)


CENTROIDAL_MOMENTUM_MATRIX = Operation(
    "centroidal_momentum_matrix",
    arguments=(Q,),
    results=(Result("matrix", "world, 6, independent dof"),),
    routine=Routine("centroidal_momentum_matrix", recursion.centroidal_momentum_matrix),
    embed=Routine("embedded_centroidal_momentum_matrix", minimal.centroidal_momentum_matrix),
    multipliers=AS_WRITTEN,
    trial=Trial(lambda dense, q: dense.centroidal_momentum_matrix),
)


@CENTROIDAL_MOMENTUM_MATRIX.method
def centroidal_momentum_matrix(self: Dynamics, q: ArrayT, out: ArrayT | None = None) -> ArrayT:
    """Compute A, the momentum per unit qd: linear [kg m/s], then angular about the centre of mass [kg m^2/s].

    In inertial axes; linear comes first, as in :meth:`jacobian`. The centre of mass is that of :meth:`com_jacobian`.
    Armature is not included. A column is R(k) H*, where R(k) is the composite inertia, moved to the centre of mass.
    Orin, Goswami, Lee 2013.

    Returns:
        [world, 6, dof]; with embedded loops A X [world, 6, independent dof].
    """
    return self._engine.run(CENTROIDAL_MOMENTUM_MATRIX, out, q=q)


CENTROIDAL_MOMENTUM_BIAS = Operation(
    "centroidal_momentum_bias",
    arguments=(Q, required(QD)),
    results=(Result("bias", "world, 6"),),
    routine=Routine("centroidal_momentum_bias", recursion.centroidal_momentum_bias),
    embed=Routine("embedded_centroidal_momentum_bias", minimal.centroidal_momentum_bias),
    multipliers=AS_WRITTEN,
    trial=Trial(lambda dense, q, qd: dense.centroidal_momentum_bias(qd)),
)


@CENTROIDAL_MOMENTUM_BIAS.method
def centroidal_momentum_bias(self: Dynamics, q: ArrayT, qd: AnyArray, out: ArrayT | None = None) -> ArrayT:
    """Compute A' qd for A of :meth:`centroidal_momentum_matrix`: A qdd + A' qd is the rate of the momentum.

    Returns:
        [world, 6]: force [N], then moment about the centre of mass [N m], inertial axes.
    """
    return self._engine.run(CENTROIDAL_MOMENTUM_BIAS, out, q=q, qd=qd)
