"""Closed loops and couplings: what they add to :class:`warp_spo.Dynamics`, and what they change in it.

``loops="embed"``: links that loops and couplings tie are one node of the tree (:mod:`.recursions.clusters`), closures
hold exactly. ``loops="multipliers"``: the tree stays open, multipliers close it (:mod:`.recursions.multipliers`), which
serves loops of any extent and redundant ones, at the square of the closures' condition. Both run as kernels of their
scene, a thread a world, at every granularity. ``step`` keeps them closed; who integrates accelerations by other means
calls ``project`` once a step.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import warp as wp

from ..arrays import Call
from ..errors import UnsupportedError, as_integer
from ..kernels import declare
from ..kernels import loops as kernels
from ..recursions.loops.embedded import Embedding
from .applications import Applications
from .embedding import Closing, embedding, usual_rank

EMBEDDED = (
    "mass_matrix",
    "mass_matrix_inverse",
    "solve_mass_matrix",
    "inverse_dynamics",
    "log_det_mass_matrix",
    "operational_inertia_inverse",
    "operational_inertia_inverse_product",
    "hybrid_dynamics",
    "jacobian",
    "jacobian_bias",
    "com_jacobian",
    "centroidal_momentum_matrix",
    "centroidal_momentum_bias",
    "forward_dynamics_vjp",
    "forward_dynamics_jvp",
    "inverse_dynamics_vjp",
    "inverse_dynamics_jvp",
    "step_vjp",
)
"""Operations that have a form of their own where loops are embedded, most of them in the independent dofs."""
OF_TREES = {
    "embed": (
        "quasi_velocities",
        "log_det_mass_matrix_gradient",
        "fixman_torque",
        "mass_matrix_packed",
        "mass_matrix_inverse_packed",
        "operators",
        "body_reactions",
    ),
    "multipliers": (
        "hybrid_dynamics",
        "operational_inertia_inverse",
        "operational_inertia_inverse_product",
        "operational_inertia",
        "fixman_torque",
        "body_reactions",
    ),
}
"""Operations that know nothing of closed loops, and would be wrong."""
WAYS_OUT = {
    "quasi_velocities": "factor mass_matrix, which is that of the independent dofs",
    "log_det_mass_matrix_gradient": "take differences of log_det_mass_matrix",
    "fixman_torque": "take differences of log_det_mass_matrix",
    "mass_matrix_packed": "use mass_matrix",
    "mass_matrix_inverse_packed": "use mass_matrix_inverse",
}
COLUMNS = 6
"""Right-hand sides of solve_mass_matrix that one kernel solves for."""
EMBED, OPEN = "use loops='embed'", "loops='cut' is the open tree"


class Loops(Applications):
    """What Dynamics inherits. Arrays and coordinates are as there."""

    loops: str
    closed: bool
    dtype: Any
    embedding: Embedding | None

    def _close(self, loops: str, independent: Any) -> None:
        self.loops = loops
        self.closed = loops in ("embed", "multipliers") and bool(self.scene.loops or self.scene.couplings)
        if independent is not None and not (self.closed and loops == "embed"):
            raise ValueError("Dynamics: independent= belongs to loops='embed' of a scene with loops or couplings")
        self._usual_rank = usual_rank(self.scene) if self.closed and loops == "multipliers" else 0
        self.embedding = embedding(self.scene, independent) if self.closed and loops == "embed" else None
        self._minimal = len(self.independent_dofs)
        if self.closed:
            declare(kernels, self.dtype)

    @functools.cached_property
    def independent_dofs(self) -> np.ndarray:
        """Dofs that move all others where loops are embedded: the minimal coordinates, ascending [independent dof].

        Those that ``Dynamics(independent=...)`` names. Otherwise they are chosen when the object is made, by random
        configurations that close the loops: the first dofs that hold the others nearly as well as any do. What speaks
        of them (mass matrices, Jacobians, forces) is NaN where they lose their hold on the others (the dead point of a
        rocker); forward_dynamics and operational_inertia pass such points.
        """
        return np.arange(self.scene.dof_count) if self.embedding is None else np.array(self.embedding.dofs, dtype=int)

    @functools.cached_property
    def closure_rows(self) -> int:
        """Rows of :meth:`closure_error`: of the loop joints one by one, translations first, then of the couplings."""
        return Closing(self.scene).size

    def closure_error(self, q: Any, out: Any = None) -> Any:
        """How far the loops and couplings are from closed.

        Of each loop joint: distances along what it does not let slide [m]; twice the tangent of half the angle about
        what it does not let turn [rad], or the difference of a cosine where it has two axes. Of each coupling
        q - ratio q[reference] - offset.

        Returns:
            [world, row]
        """
        with self._call("closure_error") as call:
            self._check_closed(call)
            q, _ = self._read_state(call, q, None)
            out = call.write(out, (self.worlds, self.closure_rows), "[world, row]")
            self._launch("closure_error", out, q=q)
        return call.result

    def project(self, q: Any, qd: Any = None, hold: bool = False, iterations: int = 2, out: Any = None) -> Any:
        """The nearest state that closes the loops: Newton steps q - Y^+ g, then qd - Y^+ Y qd, Y the Jacobian of g.

        g is :meth:`closure_error`. Nearest in the sum of squares of the dofs, rad and m alike. :meth:`step` does as
        much by itself; to close a state by hand, ask for more ``iterations``.

        Args:
            q, qd: [world, coordinate], [world, dof]; qd None is left out.
            hold: the independent dofs stay as they are (loops="embed"); NaN where they do not hold the others.
            iterations: Newton steps of q; each squares the error. 0 leaves q as it is.
            out: an array for q, or with qd a pair of arrays or None, (q, qd).

        Returns:
            q [world, coordinate]; with ``qd`` the pair q, qd [world, dof]. A world whose closures lose rank there, at a
            change point, is NaN.
        """
        with self._call("project") as call:
            self._check_closed(call)
            if hold and self.embedding is None:
                raise UnsupportedError(call.name, "hold=True with loops='multipliers'", "use loops='embed'")
            steps = as_integer(iterations)
            if steps is None or steps < 0:
                raise ValueError(f"{call.name}: iterations is {iterations!r}; expected how many Newton steps")
            both = out if isinstance(out, tuple | list) else (out, None)
            if len(both) != 2 or (qd is None and both[1] is not None):
                pair = "a pair of arrays or None, (q, qd)" if qd is not None else "an array for q, there being no qd"
                raise TypeError(f"{call.name}: out is {out!r}; expected {pair}")
            q, qd = self._read_state(call, q, qd)
            q_out = call.write(both[0], q.shape, "[world, coordinate]", name="out[0]")
            qd_out = None if qd is None else call.write(both[1], qd.shape, "[world, dof]", name="out[1]")
            self._project(q, qd, hold, steps, q_out, qd_out)
        return call.result

    def _project(self, q: wp.array, qd: Any, hold: bool, iterations: int, q_out: wp.array, qd_out: Any) -> None:
        spare = [q_out, self.recursions.array("projected q", *q.shape)]
        for i in range(iterations):
            new = spare[(iterations - 1 - i) % 2]
            self._correct(new, hold, rates=False, q=q)
            q = new
        if iterations == 0:
            wp.copy(q_out, q)
        if qd is not None:
            self._correct(qd_out, hold, rates=True, q=q_out, qd=qd)

    def _correct(self, out: wp.array, hold: bool, rates: bool, **state: Any) -> None:
        if self.embedding is not None:
            held = self.embedding.dofs if hold else ()
            name = "project_velocity" if rates else "project_position"
            self._launch(name, out, how=self.embedding, held=held, **state)
            return
        system, more = self._system()
        self._launch("closure_system", system, more, rates=rates, **state)
        multipliers, _, _ = self._least_norm()
        self._launch("closure_step", out, rates=rates, multipliers=multipliers, **state)

    # -- multipliers -----------------------------------------------------------------------------------------------
    def loop_multipliers(
        self, q: Any, qd: Any = None, tau: Any = None, body_f: Any = None, out: Any = (None, None)
    ) -> tuple[Any, Any]:
        """Multipliers of the rows of :meth:`closure_error`, as forward_dynamics finds them (loops="multipliers").

        tau + Y* multipliers moves the open tree as the closed loops do: [N] for rows in m, [N m] for rows in rad. Where
        rows are redundant it is the answer with the least sum of squares, each weighed by the sum of squares of what
        the dofs do to its joint, velocities for [m] and angular velocities for [rad]: their units do not matter.

        Args:
            q, qd, tau, body_f: as forward_dynamics. out: (multipliers, rank), each an array or None.

        Returns:
            multipliers [world, row]; rank [world], int32: how many of the rows are independent, that is eigenvalues of
            Y Mass^-1 Y*, so weighed, above 32 rows eps of the largest. Where they are fewer than where the loops
            usually close, at a change point, the multipliers are NaN.
        """
        with self._call("loop_multipliers") as call:
            if not self.closed or self.loops != "multipliers":
                raise UnsupportedError(
                    call.name, f"loops={self.loops!r} without multipliers", "build Dynamics with loops='multipliers'"
                )
            if not isinstance(out, tuple | list) or len(out) != 2:
                raise TypeError(f"{call.name}: out is {out!r}; expected a pair of arrays or None, (multipliers, rank)")
            q, qd = self._read_state(call, q, qd)
            tau, body_f = self._read_rate(call, "tau", tau), self._read_body_f(call, body_f)
            found = call.write(out[0], (self.worlds, self.closure_rows), "[world, row]", name="out[0]")
            rank = call.write(out[1], (self.worlds,), "[world]", name="out[1]", dtype=wp.int32)
            self._find_multipliers(q, qd, tau, body_f)
            multipliers, known, _ = self._solution()
            wp.copy(found, multipliers)
            wp.copy(rank, known)
        return call.result

    def _system(self) -> tuple[wp.array, dict[str, wp.array]]:
        """The matrix [world, row, row]; the right-hand side and the sizes [world, row]."""
        n, run = self.closure_rows, self.recursions
        more = {name: run.array(f"loop {name}", self.worlds, n) for name in ("right", "size")}
        return run.array("loop system", self.worlds, n, n), more

    def _solution(self) -> tuple[wp.array, wp.array, wp.array]:
        """multipliers [world, row], rank [world], resolved [world, 1]."""
        run = self.recursions
        return (
            run.array("loop multipliers", self.worlds, self.closure_rows),
            self._rank,
            run.array("loop resolved", self.worlds, 1),
        )

    @functools.cached_property
    def _rank(self) -> wp.array:
        return wp.zeros(self.worlds, dtype=wp.int32, device=self.device)

    def _least_norm(self) -> tuple[wp.array, wp.array, wp.array]:
        run, n = self.recursions, self.closure_rows
        system, more = self._system()
        found, rank, resolved = self._solution()
        vectors, scale = run.array("loop vectors", self.worlds, n, n), run.array("loop scale", self.worlds, n)
        outputs = [vectors, scale, found, rank, resolved.reshape((self.worlds,))]
        run.launch(
            kernels.solve_least_norm, self.worlds, [system, more["right"], more["size"], self._usual_rank], outputs
        )
        return found, rank, resolved

    def _find_multipliers(self, q: Any, qd: Any, tau: Any, body_f: Any) -> None:
        system, more = self._system()
        self._launch("loop_system", system, more, q=q, qd=qd, tau=tau, body_f=body_f)
        self._least_norm()

    # -- what Dynamics asks for ------------------------------------------------------------------------------------
    def _closed_forward_dynamics(self, out: wp.array, status: Any, q: Any, qd: Any, tau: Any, body_f: Any) -> None:
        given = dict(q=q, qd=qd, tau=tau, body_f=body_f)
        if self.embedding is None:
            self._find_multipliers(**given)
            multipliers, _, margin = self._solution()
            self._launch("loop_forward_dynamics", out, multipliers=multipliers, **given)
            least = kernels.EPSILON[self.dtype] ** 0.5
        else:
            margin = self.recursions.array("loop margin", self.worlds, len(self.embedding.rows))
            more = {} if status is None or margin.size == 0 else {"margin": margin}
            self._launch("embedded_forward_dynamics", out, more, how=self.embedding, status=bool(more), **given)
            least = 4.0 * kernels.EPSILON[self.dtype]
        if status is not None:
            inputs = [q, qd, tau, body_f, out, margin, self.dtype(least)]
            self.recursions.launch(kernels.status_word, self.worlds, inputs, [status])

    def _launch(self, operation: str, out: wp.array, more: dict[str, wp.array] | None = None, **given: Any) -> None:
        if self.embedding is not None and operation in EMBEDDED:
            operation, given = f"embedded_{operation}", {**given, "how": self.embedding}
        super()._launch(operation, out, more, **given)

    def _solve_columns(self, q: wp.array, b: wp.array, out: wp.array) -> None:
        """With loops embedded: up to COLUMNS right-hand sides in one kernel, which factors once; more in turns."""
        columns = b.shape[2]
        if columns <= COLUMNS:
            self._launch("solve_mass_matrix", out, q=q, b=b, columns=columns)
            return
        for first in range(0, columns, COLUMNS):
            turn = slice(first, min(first + COLUMNS, columns))
            size = *b.shape[:2], turn.stop - turn.start
            right, x = (self.recursions.array((name, size), *size) for name in ("columns of b", "columns of Mass^-1 b"))
            wp.copy(right, b[:, :, turn])
            self._launch("solve_mass_matrix", x, q=q, b=right, columns=size[2])
            wp.copy(out[:, :, turn], x)

    def _check_prescribed(self, call: Call, held: tuple[bool, ...] | None) -> None:
        """Of closed loops, only independent dofs can be prescribed, and a kernel is made for each mask."""
        if self.embedding is None:
            return
        if held is None:
            raise UnsupportedError(
                call.name,
                "a mask on the device, or one for each world, with loops='embed'",
                "pass a list or a NumPy array [dof]",
            )
        labels = self.scene.dof_labels
        wrong = [labels[dof] for dof, on in enumerate(held) if on and dof not in self.embedding.dofs]
        if wrong:
            raise UnsupportedError(
                call.name,
                f"prescribing {', '.join(wrong)}, which the loops make follow other dofs",
                "name them in Dynamics(independent=...)",
            )

    def _check_closed(self, call: Call) -> None:
        if not self.closed:
            what = f"loops={self.loops!r}" if self.scene.loops or self.scene.couplings else "a scene without loops"
            raise UnsupportedError(
                call.name,
                what,
                "build Dynamics with loops='embed' or 'multipliers' of a scene that has loops or couplings",
            )

    def _check_operation(self, name: str) -> None:
        if self.closed and name in OF_TREES[self.loops]:
            ways = WAYS_OUT if self.loops == "embed" else dict.fromkeys((*EMBEDDED, "operational_inertia"), EMBED)
            way = f"{ways[name]}; {OPEN}" if name in ways else OPEN
            raise UnsupportedError(f"Dynamics.{name}", f"loops={self.loops!r}", way)
