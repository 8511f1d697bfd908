"""Analytic derivatives of the dynamics as matrices.

Along q they are taken in tangent coordinates: column i is the rate at which a result changes as ``integrate(q, e_i,
t)`` moves q. For hinges made of screws that is q itself; a ball turns, a free hinge's body moves with its CoM and turns
about it, in the axes of the parent anchor.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import warp as wp

from ..execution.programs import Program
from ..execution.routine import Routine, SegmentForm, TuningHints
from ..kernels import tiles
from ..kernels.straight_line import TILE
from ..recursions.derivatives import inverse_dynamics as recursion
from ..runtime import launches
from ..runtime.arrays import AnyArray, ArrayT
from .derivative_references import forward_dynamics_by_q, inverse_dynamics_rates
from .forward_dynamics import FORWARD_DYNAMICS, known_accelerations
from .inertia import MASS_MATRIX_INVERSE
from .operation import (
    AS_WRITTEN,
    BODY_F,
    EMBEDDED_DERIVATIVE,
    NO_DERIVATIVE,
    QD,
    QDD,
    TAU,
    Operation,
    Q,
    Result,
    Trial,
    derivative_of,
)

if TYPE_CHECKING:
    from .dynamics import Dynamics

SQUARE = "world, dof, dof"


class InverseDynamicsDerivatives(NamedTuple):
    """d tau / d q along tangent coordinates, d tau / d qd, d tau / d qdd = Mass: each [world, dof, dof]."""

    q: Any
    qd: Any
    qdd: Any


class ForwardDynamicsDerivatives(NamedTuple):
    """d qdd / d q along tangent coordinates, d qdd / d qd, d qdd / d tau = Mass^-1: each [world, dof, dof]."""

    q: Any
    qd: Any
    tau: Any


INVERSE_DYNAMICS_DERIVATIVES = Operation(
    "inverse_dynamics_derivatives",
    arguments=(Q, QD, QDD, BODY_F),
    results=tuple(Result(name, SQUARE) for name in ("q", "qd", "qdd")),
    routine=Routine(
        "inverse_dynamics_derivatives",
        recursion.inverse_dynamics_derivatives,
        segments=SegmentForm(messages=recursion.LETTERS),
        hints=TuningHints(long_result=True, tiled=True),
    ),
    embed=NO_DERIVATIVE,
    multipliers=NO_DERIVATIVE,
    trial=Trial(lambda dense, q, qd, qdd: inverse_dynamics_rates(dense, qd, qdd)[0]),
)


@INVERSE_DYNAMICS_DERIVATIVES.method
def inverse_dynamics_derivatives(
    self: Dynamics,
    q: ArrayT,
    qd: AnyArray | None = None,
    qdd: AnyArray | None = None,
    body_f: AnyArray | None = None,
    out: tuple[ArrayT | None, ArrayT | None, ArrayT | None] = (None, None, None),
) -> InverseDynamicsDerivatives:
    """Compute the derivatives of :meth:`inverse_dynamics` by q, qd and qdd, analytically, in O(dof depth).

    Singh, Russo, Wensing 2022, "Efficient analytical derivatives of rigid-body dynamics using spatial vector algebra",
    in link frames and with classical accelerations, so that no velocity or position of the inertial frame enters.

    Args:
        q, qd, qdd, body_f: as of :meth:`inverse_dynamics`. body_f stays fixed in inertial axes as the bodies move.
        out: (q, qd, qdd), each an array or None.

    Returns:
        q, qd, qdd [world, dof, dof]: column j is the derivative by entry j. qdd is the mass matrix. Along q, column j
        is the rate of change as ``integrate(q, e_j, t)`` moves q, in tangent coordinates: for hinges made of screws q
        itself; a ball turns, and a free hinge's body moves with its CoM and turns about it, in the axes of the parent
        anchor.

    Raises:
        UnsupportedError: more than 128 dof; closed loops.
    """
    engine = self._engine
    with engine.call(INVERSE_DYNAMICS_DERIVATIVES) as call:
        self._gradients.check_size(call)
        outs = engine.outs(call, INVERSE_DYNAMICS_DERIVATIVES, out)
        given = engine.read(call, INVERSE_DYNAMICS_DERIVATIVES, q=q, qd=qd, qdd=qdd, body_f=body_f)
        results: list[wp.array] = engine.write(call, INVERSE_DYNAMICS_DERIVATIVES, outs, given)
        program, found = _run_into_tiles(self, INVERSE_DYNAMICS_DERIVATIVES, (3, *results[0].shape[1:]), {}, **given)
        for block, result in enumerate(results):
            _spread(self, program, found, block, result)
    return InverseDynamicsDerivatives(*call.result)


FORWARD_DYNAMICS_DERIVATIVES = Operation(
    "forward_dynamics_derivatives",
    arguments=(Q, QD, TAU, BODY_F),
    results=tuple(Result(name, SQUARE) for name in ("q", "qd", "tau")),
    embed=AS_WRITTEN,
    multipliers=EMBEDDED_DERIVATIVE,
    trial=Trial(forward_dynamics_by_q),
)


@FORWARD_DYNAMICS_DERIVATIVES.method
def forward_dynamics_derivatives(
    self: Dynamics,
    q: ArrayT,
    qd: AnyArray | None = None,
    tau: AnyArray | None = None,
    body_f: AnyArray | None = None,
    out: tuple[ArrayT | None, ArrayT | None, ArrayT | None] = (None, None, None),
) -> ForwardDynamicsDerivatives:
    """Compute the derivatives of :meth:`forward_dynamics`: -Mass^-1 times those of inverse dynamics at qdd.

    Args:
        q, qd, tau, body_f: as of :meth:`forward_dynamics`. body_f stays fixed in inertial axes as the bodies move.
        out: (q, qd, tau), each an array or None.

    Returns:
        q, qd, tau [world, dof, dof]: column j is the derivative by entry j; q along tangent coordinates, see
        :meth:`inverse_dynamics_derivatives`. tau is the inverse mass matrix, with embedded loops X (X* Mass X)^-1 X*.
        NaN in worlds where that does not exist.

    With embedded loops the matrices are computed row by row, by a launch for each dof; see
    :meth:`forward_dynamics_vjp`.

    Raises:
        UnsupportedError: more than 128 dof; loops by multipliers.
    """
    engine = self._engine
    with engine.call(FORWARD_DYNAMICS_DERIVATIVES) as call:
        self._gradients.check_size(call)
        outs = engine.outs(call, FORWARD_DYNAMICS_DERIVATIVES, out)
        given = engine.read(call, FORWARD_DYNAMICS_DERIVATIVES, q=q, qd=qd, tau=tau, body_f=body_f)
        results = engine.write(call, FORWARD_DYNAMICS_DERIVATIVES, outs, given)
        n, (by_q, by_qd, inverse) = self.scene.dof_count, results
        if self.embedding is not None:
            qdd = known_accelerations(self, None, **given)
            _differentiate_by_rows(self, {**given, "qdd": qdd}, results)
        elif n:
            assert MASS_MATRIX_INVERSE.routine is not None
            beside = self.plan.runs_beside(MASS_MATRIX_INVERSE.routine)
            with engine.branch.beside() if beside else contextlib.nullcontext():
                engine.launch(MASS_MATRIX_INVERSE, inverse, q=given["q"])
            qdd = known_accelerations(self, None, **given)
            given = {"q": given["q"], "qd": given["qd"], "qdd": qdd, "body_f": given["body_f"]}
            program, rates = _run_into_tiles(self, INVERSE_DYNAMICS_DERIVATIVES, (2, n, n), {"mass": False}, **given)
            assert program is not None and rates is not None
            if beside:
                engine.branch.join()
            self.programs.product(program, n).launch(inverse, rates, by_q, by_qd)
    return ForwardDynamicsDerivatives(*call.result)


MASS_MATRIX_DERIVATIVE = Operation(
    "mass_matrix_derivative",
    arguments=(Q,),
    results=(Result("derivative", "world, dof, dof, dof"),),
    routine=Routine("mass_matrix_derivative", recursion.mass_matrix_derivative, hints=TuningHints(tiled=True)),
    embed=NO_DERIVATIVE,
    multipliers=NO_DERIVATIVE,
)


@MASS_MATRIX_DERIVATIVE.method
def mass_matrix_derivative(self: Dynamics, q: ArrayT, out: ArrayT | None = None) -> ArrayT:
    """Compute d Mass / d q along tangent coordinates, see :meth:`inverse_dynamics_derivatives`.

    Returns:
        [world, dof, dof, dof], symmetric in the first two of dof; the last index is the tangent coordinate.

    Raises:
        UnsupportedError: more than 128 dof; closed loops.
    """
    engine = self._engine
    with engine.call(MASS_MATRIX_DERIVATIVE) as call:
        self._gradients.check_size(call)
        given = engine.read(call, MASS_MATRIX_DERIVATIVE, q=q)
        (result,) = engine.write(call, MASS_MATRIX_DERIVATIVE, (out,), given)
        program, found = _run_into_tiles(self, MASS_MATRIX_DERIVATIVE, result.shape[1:], {}, **given)
        _spread(self, program, found, 0, result)
    return call.result


# -- steps -------------------------------------------------------------------------------------------------------------
def _differentiate_by_rows(dyn: Dynamics, given: dict[str, Any], outs: Sequence[wp.array]) -> None:
    """Compute derivatives of forward dynamics by the way back from each of its results."""
    derivative, shape = derivative_of(FORWARD_DYNAMICS), (dyn.worlds, dyn.scene.dof_count)
    names = "tangent", "qd", "tau"
    rows = [dyn.recursions.array(f"row by {name}", *shape) for name in names]
    unit = dyn.recursions.array("unit cotangent", *shape)
    for dof in range(dyn.scene.dof_count):
        launches.fill(unit, 0)
        launches.fill(unit[:, dof], 1.0)
        dyn._gradients.launch(derivative, names, rows, {**given, "cotangent": unit})
        for row, out in zip(rows, outs, strict=True):
            launches.copy(out[:, dof], row)


def _run_into_tiles(
    dyn: Dynamics, operation: Operation, shape: tuple[int, ...], options: dict[str, Any], **given: Any
) -> tuple[Program | None, wp.array | None]:
    """Run a kernel whose result, of ``shape`` in a world, is left in tiles; return its program and the tiles."""
    if dyn.scene.dof_count == 0:
        return None, None
    assert operation.routine is not None
    arrays = {name: array for name, array in given.items() if array is not None}
    shapes = {name: array.shape for name, array in arrays.items()}
    program = dyn.programs.find(operation.routine, shapes, (dyn.worlds, *shape), **options)
    assert program is not None
    count = -(-dyn.worlds // TILE)
    found = dyn.recursions.array(("tiles", operation.name, *shapes, *options), count, max(program.slots, 1), TILE)
    dyn.programs.launch(program, arrays, found)
    return program, found


def _spread(dyn: Dynamics, program: Program | None, found: wp.array | None, block: int, out: wp.array) -> None:
    """Write one block of the tiles to [world, ...]."""
    if program is None or found is None or out.size == 0:
        return
    rows = out.reshape((dyn.worlds, out.size // dyn.worlds))
    inputs = [found, program.entry, block * rows.shape[1]]
    dyn.recursions.launch(tiles.unpack, (len(found), rows.shape[1]), inputs, [rows])
