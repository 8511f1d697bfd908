"""Closed loops and couplings: how far they are open, the nearest state that closes them, and their multipliers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, overload

import warp as wp

from ..errors import UnsupportedError, as_integer
from ..execution.routine import Routine
from ..recursions.loops import projection
from ..runtime import launches
from ..runtime.arrays import AnyArray, ArrayT
from .operation import AS_WRITTEN, BODY_F, QD, TAU, Operation, Option, Q, Result

if TYPE_CHECKING:
    from .dynamics import Dynamics

CLOSURE_ERROR = Operation(
    "closure_error",
    arguments=(Q,),
    results=(Result("error", "world, row"),),
    routine=Routine("closure_error", projection.closure_error),
    embed=AS_WRITTEN,
    multipliers=AS_WRITTEN,
)


@CLOSURE_ERROR.method
def closure_error(self: Dynamics, q: ArrayT, out: ArrayT | None = None) -> ArrayT:
    """Compute how far the loops and couplings are from closed.

    The rows of a loop joint are distances along the directions in which it does not slide [m], and twice the tangent of
    half the angle about the axes about which it does not turn [rad], or the difference of a cosine where it has two
    axes. The row of a coupling is q - ratio q[reference] - offset.

    Returns:
        [world, row]

    Raises:
        UnsupportedError: no loops, or loops that are not closed.
    """
    engine = self._engine
    with engine.call(CLOSURE_ERROR) as call:
        self._closures.check(call)
        given = engine.read(call, CLOSURE_ERROR, q=q)
        (error,) = engine.write(call, CLOSURE_ERROR, (out,), given)
        engine.launch(CLOSURE_ERROR, error, **given)
    return call.result


PROJECT = Operation(
    "project",
    arguments=(Q, QD, Option("hold", default=lambda scene: False), Option("iterations", in_prepare=False)),
    results=(Result("q", "world, coordinate"), Result("qd", "world, dof")),
    embed=AS_WRITTEN,
    multipliers=AS_WRITTEN,
)


@overload
def project(
    self: Dynamics, q: ArrayT, qd: None = None, hold: bool = False, iterations: int = 2, out: ArrayT | None = None
) -> ArrayT: ...
@overload
def project(
    self: Dynamics,
    q: ArrayT,
    qd: AnyArray,
    hold: bool = False,
    iterations: int = 2,
    out: tuple[ArrayT | None, ArrayT | None] | None = None,
) -> tuple[ArrayT, ArrayT]: ...
@PROJECT.method
def project(self: Dynamics, q: Any, qd: Any = None, hold: bool = False, iterations: int = 2, out: Any = None) -> Any:
    """Compute the nearest state that closes the loops, by Newton steps: q - Y^+ g, then qd - Y^+ Y qd.

    g is :meth:`closure_error` and Y its Jacobian. Nearest is meant in the sum of squares of the dofs, rad and m alike.
    :meth:`step` does the same by itself; to close a state by hand, pass more ``iterations``.

    Args:
        q: coordinates [world, coordinate].
        qd: velocities [world, dof]; None leaves them out.
        hold: keep the independent dofs as they are (loops="embed"); NaN where they do not determine the other dofs.
        iterations: Newton steps of q; each squares the error. 0 leaves q as it is.
        out: an array for q, or with qd a pair of arrays or None, (q, qd).

    Returns:
        q [world, coordinate]; with ``qd`` the pair q, qd [world, dof]. A world whose closures lose rank there, at a
        change point, is NaN.
    """
    engine = self._engine
    with engine.call(PROJECT) as call:
        self._closures.check(call)
        if hold and self.embedding is None:
            raise UnsupportedError(call.name, "hold=True with loops='multipliers'", "use loops='embed'")
        steps = as_integer(iterations)
        if steps is None or steps < 0:
            raise ValueError(f"{call.name}: iterations is {iterations!r}; expected how many Newton steps")
        both = out if isinstance(out, tuple | list) else (out, None)
        if len(both) != 2 or (qd is None and both[1] is not None):
            pair = "a pair of arrays or None, (q, qd)" if qd is not None else "an array for q, there being no qd"
            raise TypeError(f"{call.name}: out is {out!r}; expected {pair}")
        given = engine.read(call, PROJECT, q=q, qd=qd)
        q_in, qd_in = given["q"], given["qd"]
        q_out = call.write(both[0], q_in.shape, "[world, coordinate]", name="out[0]")
        qd_out = None if qd_in is None else call.write(both[1], qd_in.shape, "[world, dof]", name="out[1]")
        self._closures.project(q_in, qd_in, hold, steps, q_out, qd_out)
    return call.result


LOOP_MULTIPLIERS = Operation(
    "loop_multipliers",
    arguments=(Q, QD, TAU, BODY_F),
    results=(Result("multipliers", "world, row"), Result("rank", "world", dtype=wp.int32)),
    embed=AS_WRITTEN,
    multipliers=AS_WRITTEN,
)


@LOOP_MULTIPLIERS.method
def loop_multipliers(
    self: Dynamics,
    q: ArrayT,
    qd: AnyArray | None = None,
    tau: AnyArray | None = None,
    body_f: AnyArray | None = None,
    out: tuple[ArrayT | None, ArrayT | None] = (None, None),
) -> tuple[ArrayT, ArrayT]:
    """Compute multipliers of the rows of :meth:`closure_error`, as forward_dynamics finds them (loops="multipliers").

    The force tau + Y* multipliers moves the open tree as the closed loops move it: [N] for rows in m, [N m] for rows in
    rad. Where rows are redundant, the solution is that with the least sum of squares. Each row is weighed by the sum of
    squares of the motion that the dofs give its joint, velocities for [m] and angular velocities for [rad], so that
    units do not matter.

    Args:
        q, qd, tau, body_f: as of :meth:`forward_dynamics`.
        out: (multipliers, rank), each an array or None.

    Returns:
        multipliers [world, row]; rank [world], int32: the number of independent rows, which is the number of
        eigenvalues of Y Mass^-1 Y*, so weighed, above 32 rows eps of the largest. Where they are fewer than where the
        loops usually close, at a change point, the multipliers are NaN.
    """
    engine, closures = self._engine, self._closures
    with engine.call(LOOP_MULTIPLIERS) as call:
        if not self.closed or self.loops != "multipliers":
            what, way = f"loops={self.loops!r} without multipliers", "build Dynamics with loops='multipliers'"
            raise UnsupportedError(call.name, what, way)
        outs = engine.outs(call, LOOP_MULTIPLIERS, out)
        given = engine.read(call, LOOP_MULTIPLIERS, q=q, qd=qd, tau=tau, body_f=body_f)
        multipliers_out, rank_out = engine.write(call, LOOP_MULTIPLIERS, outs, given)
        closures.find_multipliers(**given)
        multipliers, rank, _ = closures.solution()
        launches.copy(multipliers_out, multipliers)
        launches.copy(rank_out, rank)
    return call.result
