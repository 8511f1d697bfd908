"""Operational space: the inertia of a mechanism seen from frames on its bodies. Khatib 1987; Jain 2011, ch. 10."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from ..execution.node import operations as node_operations
from ..execution.routine import Routine
from ..kernels import cholesky
from ..recursions import operational as recursion
from ..recursions.loops import minimal
from ..runtime.arrays import AnyArray, ArrayT
from ..scene.frames import Frame
from .operation import AS_WRITTEN, FRAMES, USE_EMBED, Argument, Operation, Q, Result, Trial

if TYPE_CHECKING:
    from .dynamics import Dynamics

OPERATIONAL_INERTIA_INVERSE = Operation(
    "operational_inertia_inverse",
    arguments=(Q, FRAMES),
    results=(Result("inverse", "world, 6 frames, 6 frames"),),
    routine=Routine(
        "operational_inertia_inverse",
        recursion.operational_inertia_inverse,
        node_operations.operational_inertia_inverse,
    ),
    embed=Routine("embedded_operational_inertia_inverse", minimal.operational_inertia_inverse),
    multipliers=USE_EMBED,
    trial=Trial(lambda dense, q, frames: dense.operational_inertia_inverse(frames), main=True),
)


@OPERATIONAL_INERTIA_INVERSE.method
def operational_inertia_inverse(
    self: Dynamics, q: ArrayT, frames: Sequence[Frame], out: ArrayT | None = None
) -> ArrayT:
    """Compute J Mass^-1 J* for the frames of :meth:`jacobian`; with embedded loops, of the closed mechanism.

    Returns:
        [world, 6 frames, 6 frames], both triangles.
    """
    return self._engine.run(OPERATIONAL_INERTIA_INVERSE, out, q=q, frames=frames)


OPERATIONAL_INERTIA = Operation(
    "operational_inertia",
    arguments=(Q, FRAMES),
    results=(Result("inertia", "world, 6 frames, 6 frames"),),
    embed=AS_WRITTEN,
    multipliers=USE_EMBED,
)


@OPERATIONAL_INERTIA.method
def operational_inertia(self: Dynamics, q: ArrayT, frames: Sequence[Frame], out: ArrayT | None = None) -> ArrayT:
    """Compute the inertia of the mechanism seen from the frames: (J Mass^-1 J*)^-1, J of :meth:`jacobian`, by Cholesky.

    Rows and columns: linear [kg], then angular [kg m^2], frame after frame, inertial axes. Khatib 1987; Jain 2011,
    ch. 10. With embedded loops, it is the inertia of the closed mechanism, rods included.

    Returns:
        [world, 6 frames, 6 frames], both triangles. NaN in worlds where J Mass^-1 J* is singular to working precision;
        these are all worlds if the dofs above the frames cannot move all of their 6 rows independently.
    """
    engine = self._engine
    with engine.call(OPERATIONAL_INERTIA) as call:
        given = engine.read(call, OPERATIONAL_INERTIA, q=q, frames=frames)
        (inertia,) = engine.write(call, OPERATIONAL_INERTIA, (out,), given)
        rows = inertia.shape[1]
        inverse = self.recursions.array(("operational_inertia_inverse", rows), self.worlds, rows, rows)
        size = self.recursions.array(("operational_inertia size", rows), self.worlds, rows)
        engine.launch(OPERATIONAL_INERTIA_INVERSE, inverse, **given)
        self.recursions.launch(cholesky.inverse, self.worlds, [inverse], [size, inertia])
    return call.result


OPERATIONAL_INERTIA_INVERSE_PRODUCT = Operation(
    "operational_inertia_inverse_product",
    arguments=(Q, Argument("x", "world, 6 frames", sample="wrenches"), FRAMES),
    results=(Result("product", "world, frame, 6"),),
    routine=Routine("operational_inertia_inverse_product", recursion.operational_inertia_inverse_product),
    embed=Routine("embedded_operational_inertia_inverse_product", minimal.operational_inertia_inverse_product),
    multipliers=USE_EMBED,
    trial=Trial(lambda dense, q, x, frames: dense.operational_inertia_inverse(frames) @ x),
)


@OPERATIONAL_INERTIA_INVERSE_PRODUCT.method
def operational_inertia_inverse_product(
    self: Dynamics, q: ArrayT, x: AnyArray, frames: Sequence[Frame], out: ArrayT | None = None
) -> ArrayT:
    """Compute J Mass^-1 J* x in O(dof) without forming a matrix: the accelerations that wrenches x on the frames cause.

    With embedded loops the wrenches act on the closed mechanism, as in :meth:`operational_inertia`.

    Args:
        q: coordinates [world, coordinate].
        x: force, then torque on each frame, at its origin, inertial axes [world, 6 frames].
        frames: as :meth:`jacobian`.
        out: array for the result.

    Returns:
        [world, frame, 6], laid out as :meth:`frame_accelerations`. NaN where Mass has no inverse.
    """
    return self._engine.run(OPERATIONAL_INERTIA_INVERSE_PRODUCT, out, q=q, x=x, frames=frames)
