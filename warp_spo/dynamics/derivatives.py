"""Analytic derivatives of the dynamics: methods of :class:`warp_spo.Dynamics`.

Along q they are taken in tangent coordinates: column i is the rate at which a result changes as ``integrate(q, e_i,
t)`` moves q. For hinges made of screws that is q itself; a ball turns, a free hinge's body moves with its CoM and turns
about it, in the axes of the parent anchor.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import warp as wp

from ..arrays import Call
from ..execution.programs import Program, Programs
from ..execution.sweeps import Sweeps
from ..kernels import tiles
from ..kernels.straight import TILE
from ..scene.scene import Scene


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


class Derivatives:
    """What Dynamics inherits. Arrays and coordinates are as there."""

    scene: Scene
    worlds: int
    device: wp.Device
    dtype: type
    recursions: Sweeps
    programs: Programs

    def inverse_dynamics_derivatives(
        self, q: Any, qd: Any = None, qdd: Any = None, body_f: Any = None, out: Any = (None, None, None)
    ) -> InverseDynamicsDerivatives:
        """Derivatives of :meth:`inverse_dynamics` by q, qd and qdd, analytic, O(dof depth).

        Singh, Russo, Wensing 2022, "Efficient analytical derivatives of rigid-body dynamics using spatial vector
        algebra", in link frames and with classical accelerations: no velocity or position of the inertial frame enters.

        Args:
            q, qd, qdd, body_f: as there. body_f stays fixed in inertial axes as the bodies move.
            out: (q, qd, qdd), each an array or None.

        Returns:
            q, qd, qdd [world, dof, dof]: column j is the derivative by entry j; q along tangent coordinates, see
            :mod:`.derivatives`. qdd is the mass matrix.

        Raises:
            UnsupportedError: more than 128 dof.
        """
        with self._call("inverse_dynamics_derivatives") as call:
            arrays, outs = self._read_derivative(call, q, qd, "qdd", qdd, body_f, out)
            program, found = self._tiled("inverse_dynamics_derivatives", (3, *self._square), **arrays)
            for block, result in enumerate(outs):
                self._spread(program, found, block, result)
        return InverseDynamicsDerivatives(*call.result)

    def forward_dynamics_derivatives(
        self, q: Any, qd: Any = None, tau: Any = None, body_f: Any = None, out: Any = (None, None, None)
    ) -> ForwardDynamicsDerivatives:
        """Derivatives of :meth:`forward_dynamics` by q, qd and tau: -Mass^-1 times those of inverse dynamics at qdd.

        Args:
            q, qd, tau, body_f: as there. body_f stays fixed in inertial axes as the bodies move.
            out: (q, qd, tau), each an array or None.

        Returns:
            q, qd, tau [world, dof, dof]: column j is the derivative by entry j; q along tangent coordinates, see
            :mod:`.derivatives`. tau is the inverse mass matrix, with loops embedded X (X* Mass X)^-1 X*. NaN in
            worlds where that does not exist.

        Loops that are embedded: row by row, a launch for each dof; see :meth:`forward_dynamics_vjp`.

        Raises:
            UnsupportedError: more than 128 dof; loops by multipliers.
        """
        with self._call("forward_dynamics_derivatives") as call:
            arrays, outs = self._read_derivative(call, q, qd, "tau", tau, body_f, out)
            qdd = self._accelerations(None, arrays)
            n, (by_q, by_qd, inverse) = self.scene.dof_count, outs
            if self.embedding is not None:
                self._row_by_row({**arrays, "qdd": qdd}, outs)
            elif n:
                arrays = {"q": arrays["q"], "qd": arrays["qd"], "qdd": qdd, "body_f": arrays["body_f"]}
                program, rates = self._tiled("inverse_dynamics_derivatives", (3, *self._square), **arrays)
                self._run("mass_matrix_inverse", inverse, q=arrays["q"])
                inputs = [inverse, rates, program.entry.reshape((3, n, n))]
                self.recursions.launch(tiles.negative_product, (len(rates), n, n), inputs, [by_q, by_qd])
        return ForwardDynamicsDerivatives(*call.result)

    def mass_matrix_derivative(self, q: Any, out: Any = None) -> Any:
        """d Mass / d q along tangent coordinates, see :mod:`.derivatives`; the last index is the coordinate.

        Returns:
            [world, dof, dof, dof], symmetric in the first two of dof.

        Raises:
            UnsupportedError: more than 128 dof.
        """
        with self._call("mass_matrix_derivative") as call:
            self._check_size(call)
            q, _ = self._read_state(call, q, None)
            shape = (*self._square, self.scene.dof_count)
            out = call.write(out, (self.worlds, *shape), "[world, dof, dof, dof]")
            program, found = self._tiled("mass_matrix_derivative", shape, q=q)
            self._spread(program, found, 0, out)
        return call.result

    # -- steps -----------------------------------------------------------------------------------------------------
    @property
    def _square(self) -> tuple[int, int]:
        return self.scene.dof_count, self.scene.dof_count

    def _read_derivative(
        self, call: Call, q: Any, qd: Any, name: str, third: Any, body_f: Any, out: Any
    ) -> tuple[dict[str, Any], tuple[wp.array, ...]]:
        """The arguments by name, and the three results."""
        self._check_size(call, "forward_dynamics" if name == "tau" else "")
        if not isinstance(out, tuple | list) or len(out) != 3:
            raise TypeError(f"{call.name}: out is {out!r}; expected three arrays or None, (q, qd, {name})")
        q, qd = self._read_state(call, q, qd)
        third, body_f = self._read_rate(call, name, third), self._read_body_f(call, body_f)
        shape = (self.worlds, *self._square)
        outs = tuple(call.write(array, shape, "[world, dof, dof]", name=f"out[{i}]") for i, array in enumerate(out))
        return {"q": q, "qd": qd, name: third, "body_f": body_f}, outs

    def _row_by_row(self, given: dict[str, Any], outs: Sequence[wp.array]) -> None:
        """Derivatives of forward dynamics by the way back from each of its results."""
        shape = self.worlds, self.scene.dof_count
        names = "tangent", "qd", "tau"
        rows = [self.recursions.array(f"row by {name}", *shape) for name in names]
        unit = self.recursions.array("unit cotangent", *shape)
        for dof in range(self.scene.dof_count):
            unit.zero_()
            unit[:, dof].fill_(1.0)
            self._pull("forward_dynamics", names, rows, {**given, "cotangent": unit})
            for row, out in zip(rows, outs, strict=True):
                wp.copy(out[:, dof], row)

    def _tiled(self, operation: str, shape: tuple[int, ...], **given: Any) -> tuple[Any, Any]:
        """Run a program whose result, of ``shape`` in a world, is left in tiles."""
        if self.scene.dof_count == 0:
            return None, None
        arrays = {name: array for name, array in given.items() if array is not None}
        shapes = {name: array.shape for name, array in arrays.items()}
        program: Program = self.programs.find(operation, shapes, (self.worlds, *shape))
        count = -(-self.worlds // TILE)
        found = self.recursions.array(("tiles", operation, *shapes), count, max(program.slots, 1), TILE)
        self.programs.launch(program, arrays, found)
        return program, found

    def _spread(self, program: Program | None, found: wp.array, block: int, out: wp.array) -> None:
        """Write one block of what is in tiles to [world, ...]."""
        if program is None or out.size == 0:
            return
        rows = out.reshape((self.worlds, out.size // self.worlds))
        inputs = [found, program.entry, block * rows.shape[1]]
        self.recursions.launch(tiles.unpack, (len(found), rows.shape[1]), inputs, [rows])

    _call: Any
    _read_state: Any
    _read_rate: Any
    _read_body_f: Any
    _run: Any
    _accelerations: Any
    _check_size: Any
    _pull: Any
    embedding: Any
