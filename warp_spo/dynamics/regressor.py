"""The regressor of inverse dynamics, dense and as products: tau as a linear function of the bodies' inertias."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..execution.routine import Routine, TuningHints
from ..recursions import regressor as recursion
from ..runtime.arrays import AnyArray, ArrayT
from .operation import AS_WRITTEN, QD, QDD, TAU, Argument, Operation, Q, Refused, Result, Trial, required

if TYPE_CHECKING:
    from .dynamics import Dynamics

OPEN = Refused("use loops='multipliers'")

INVERSE_DYNAMICS_REGRESSOR = Operation(
    "inverse_dynamics_regressor",
    arguments=(Q, QD, QDD),
    results=(Result("regressor", "world, dof, 10 bodies"),),
    routine=Routine(
        "inverse_dynamics_regressor", recursion.inverse_dynamics_regressor, hints=TuningHints(long_result=True)
    ),
    embed=OPEN,
    sharing=Refused("differentiate inverse_dynamics by the values"),
    multipliers=AS_WRITTEN,
    trial=Trial(lambda dense, q, qd, qdd: dense.inverse_dynamics_regressor(qd, qdd)),
)


@INVERSE_DYNAMICS_REGRESSOR.method
def inverse_dynamics_regressor(
    self: Dynamics, q: ArrayT, qd: AnyArray | None = None, qdd: AnyArray | None = None, out: ArrayT | None = None
) -> ArrayT:
    """Compute Y of tau = Y parameters + armature qdd, the forces of :meth:`inverse_dynamics`, gravity included.

    The parameters are ten numbers a body, body after body: m [kg]; m c [kg m], c being the centre of mass in the body
    frame; Ixx, Ixy, Iyy, Ixz, Iyz, Izz [kg m^2] about the origin of the body frame, in its axes. Y does not
    depend on them; ``scene.inertial_parameters`` holds those of a scene.

    The columns of Y are linearly dependent, in all motions together, for every robot but bodies that fly freely, each
    by itself: plain least squares finds what the motion shows of the parameters, and no more. To find masses where
    centres and inertias are known, use Y B and move Y pi to the other side, where pi holds the inertias about the
    centres. The column of B for a body holds, in its ten rows, 1, c, and the entries xx, xy, yy, xz, yz, zz of
    ``|c|^2 1 - c c*``. The page on theory has this as an example.

    Args:
        q, qd, qdd: state and accelerations, as :meth:`inverse_dynamics`; None means zero.
        out: array for the result.

    Returns:
        [world, dof, 10 bodies]; zero where a dof does not move a body.
    """
    return self._engine.run(INVERSE_DYNAMICS_REGRESSOR, out, q=q, qd=qd, qdd=qdd)


INVERSE_DYNAMICS_REGRESSOR_PRODUCT = Operation(
    "inverse_dynamics_regressor_product",
    arguments=(Q, QD, QDD, Argument("parameters", "world, 10 bodies")),
    results=(Result("tau", "world, dof"),),
    routine=Routine("inverse_dynamics_regressor_product", recursion.inverse_dynamics_regressor_product),
    embed=OPEN,
    sharing=Refused("differentiate inverse_dynamics by the values"),
    multipliers=AS_WRITTEN,
    trial=Trial(lambda dense, q, qd, qdd, p: dense.inverse_dynamics_regressor(qd, qdd) @ p),
)


@INVERSE_DYNAMICS_REGRESSOR_PRODUCT.method
def inverse_dynamics_regressor_product(
    self: Dynamics,
    q: ArrayT,
    qd: AnyArray | None,
    qdd: AnyArray | None,
    parameters: AnyArray,
    out: ArrayT | None = None,
) -> ArrayT:
    """Compute Y parameters for Y of :meth:`inverse_dynamics_regressor`, without Y: one recursion out and back.

    Args:
        q, qd, qdd: as of :meth:`inverse_dynamics_regressor`.
        parameters: [world, 10 bodies].
        out: array for the result.

    Returns:
        tau [world, dof], without armature qdd.
    """
    return self._engine.run(INVERSE_DYNAMICS_REGRESSOR_PRODUCT, out, q=q, qd=qd, qdd=qdd, parameters=parameters)


INVERSE_DYNAMICS_REGRESSOR_TRANSPOSED_PRODUCT = Operation(
    "inverse_dynamics_regressor_transposed_product",
    arguments=(Q, QD, QDD, required(TAU)),
    results=(Result("parameters", "world, 10 bodies"),),
    routine=Routine(
        "inverse_dynamics_regressor_transposed_product", recursion.inverse_dynamics_regressor_transposed_product
    ),
    embed=OPEN,
    sharing=Refused("differentiate inverse_dynamics by the values"),
    multipliers=AS_WRITTEN,
    trial=Trial(lambda dense, q, qd, qdd, tau: dense.inverse_dynamics_regressor(qd, qdd).T @ tau),
)


@INVERSE_DYNAMICS_REGRESSOR_TRANSPOSED_PRODUCT.method
def inverse_dynamics_regressor_transposed_product(
    self: Dynamics, q: ArrayT, qd: AnyArray | None, qdd: AnyArray | None, tau: AnyArray, out: ArrayT | None = None
) -> ArrayT:
    """Compute Y* tau for Y of :meth:`inverse_dynamics_regressor`, without Y: the gradient of ``tau* Y parameters``.

    With the product it serves least squares over many samples, which never form Y.

    Args:
        q, qd, qdd: as of :meth:`inverse_dynamics_regressor`.
        tau: forces [world, dof].
        out: array for the result.

    Returns:
        [world, 10 bodies]
    """
    return self._engine.run(INVERSE_DYNAMICS_REGRESSOR_TRANSPOSED_PRODUCT, out, q=q, qd=qd, qdd=qdd, tau=tau)
