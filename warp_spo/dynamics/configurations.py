"""Between two configurations: the velocity from one to the other, and what lies on the way."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..execution.routine import Routine
from ..recursions import coordinates as recursion
from ..recursions.derivatives import adjoints
from ..runtime.arrays import AnyArray, ArrayT
from .operation import AS_WRITTEN, KINEMATIC, Argument, Derivative, Operation, Result, Trial
from .trial_inputs import rotations

if TYPE_CHECKING:
    from .dynamics import Dynamics

ENDS = (Argument("q0", "world, coordinate", sample="q"), Argument("q1", "world, coordinate", sample="q_after"))

DIFFERENCE = Operation(
    "difference",
    arguments=ENDS,
    results=(Result("velocity", "world, dof"),),
    routine=Routine("difference", recursion.difference),
    embed=AS_WRITTEN,
    multipliers=AS_WRITTEN,
    derivative=Derivative(
        Routine("difference_vjp", adjoints.difference_vjp),
        by=("q0", "q1"),
        values=KINEMATIC,
        embed=AS_WRITTEN,
        multipliers=AS_WRITTEN,
        state=("q0", "q1"),
    ),
    trial=Trial(lambda dense, q0, q1: dense.difference(q1)),
)


@DIFFERENCE.method
def difference(self: Dynamics, q0: ArrayT, q1: AnyArray, out: ArrayT | None = None) -> ArrayT:
    """Compute the velocity that takes q0 to q1 in 1 s: ``integrate(q0, difference(q0, q1), 1.0)`` is q1.

    Scalar coordinates: q1 - q0, full turns included. Ball and free hinges: the rotation vector of the short way round,
    no longer than pi, in the parent anchor's axes; ``integrate`` then returns the quaternion of q1, or its negative,
    which is the same rotation. A free hinge's first three entries are the way of its body's centre of mass, which goes
    straight.

    Args:
        q0, q1: coordinates [world, coordinate].
        out: array for the result.

    Returns:
        [world, dof], laid out as qd, of 1 s.
    """
    return self._engine.run(DIFFERENCE, out, q0=q0, q1=q1)


INTERPOLATE = Operation(
    "interpolate",
    arguments=(*ENDS, Argument("s", "world", number=True, sample="share")),
    results=(Result("q", "world, coordinate", quaternions=rotations),),
    routine=Routine("interpolate", recursion.interpolate),
    embed=AS_WRITTEN,
    multipliers=AS_WRITTEN,
    derivative=Derivative(
        Routine("interpolate_vjp", adjoints.interpolate_vjp),
        by=("q0", "q1"),
        values=KINEMATIC,
        embed=AS_WRITTEN,
        multipliers=AS_WRITTEN,
        state=("q0", "q1", "s"),
    ),
    trial=Trial(lambda dense, q0, q1, s: dense.integrate(dense.difference(q1), s)),
)


@INTERPOLATE.method
def interpolate(self: Dynamics, q0: ArrayT, q1: AnyArray, s: float | AnyArray, out: ArrayT | None = None) -> ArrayT:
    """Compute ``integrate(q0, difference(q0, q1), s)``: q0 at s = 0, q1 at s = 1, and beyond them for other s.

    Bodies turn at a constant rate about a fixed axis. With closed loops, what lies between need not close them; see
    ``project``.

    Args:
        q0, q1: coordinates [world, coordinate].
        s: share of the way, a number or [world].
        out: array for the result.

    Returns:
        [world, coordinate], quaternions of unit length.
    """
    return self._engine.run(INTERPOLATE, out, q0=q0, q1=q1, s=s)
