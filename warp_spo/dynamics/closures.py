"""Closed loops and couplings of one :class:`Dynamics`: how they are closed, and the launches that close them.

``loops="embed"``: the links that loops and couplings tie are one node of the tree, see
:mod:`warp_spo.recursions.loops.clusters`, so that the closures hold exactly. ``loops="multipliers"``: the tree stays
open and multipliers close it, see :mod:`warp_spo.recursions.loops.multipliers`. That serves loops of any extent and
redundant ones; the error grows with the square of the closures' condition.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..errors import UnsupportedError
from ..execution import status_words
from ..execution.routine import Routine
from ..kernels import declare
from ..kernels import loops as kernels
from ..recursions.loops import embedded, multipliers, projection
from ..runtime import launches
from ..runtime.arrays import Call
from ..scene.scene import Scene
from .loop_analysis import ClosureEvaluator, embedding, find_usual_rank

if TYPE_CHECKING:
    from .dynamics import Dynamics

LOOPS = ("raise", "cut", "embed", "multipliers")
AMID_CONTACTS = (
    "use loops='cut', which leaves them open, and hold what follows by drives: target_q = ratio q + offset, see the "
    "page on closed loops; or leave the contacts out, scene.with_contacts([]), and loops='embed' closes them"
)
"""Ways to treat the loops of a scene that has contacts, for errors."""
FORWARD_DYNAMICS = Routine("embedded_forward_dynamics", embedded.forward_dynamics)
PROJECT_POSITION = Routine("project_position", projection.project_position)
PROJECT_VELOCITY = Routine("project_velocity", projection.project_velocity)
SYSTEM = Routine("closure_system", multipliers.closure_system)
STEP = Routine("closure_step", multipliers.closure_step)
MULTIPLIERS = Routine("loop_system", multipliers.loop_system)
UNDER_MULTIPLIERS = Routine("loop_forward_dynamics", multipliers.loop_forward_dynamics)


class Closures:
    """The loops and couplings of one :class:`Dynamics`.

    Args:
        dyn: the Dynamics, whose scene has the loops.
        loops, independent: arguments of :class:`Dynamics`.

    Attributes:
        loops: "raise", "cut", "embed" or "multipliers". closed: loops are there, and this Dynamics closes them.
        embedding: rows that count and independent dofs, where loops are embedded; otherwise None.
    """

    def __init__(self, dyn: Dynamics, loops: str, independent: Sequence[int | str] | None):
        scene = dyn.scene
        self._dyn, self.loops = dyn, loops
        self.closed = loops in ("embed", "multipliers") and bool(scene.loops or scene.couplings)
        if independent is not None and not (self.closed and loops == "embed"):
            raise ValueError("Dynamics: independent= belongs to loops='embed' of a scene with loops or couplings")
        if self.closed and loops == "multipliers" and scene.shares_dofs:
            what = "loops='multipliers' of a scene with flexible bodies or rotors"
            raise UnsupportedError("Dynamics", what, "use loops='embed'")
        self._usual_rank = find_usual_rank(scene) if self.closed and loops == "multipliers" else 0
        self.embedding = embedding(scene, independent) if self.closed and loops == "embed" else None
        if self.closed:
            declare(kernels, dyn.dtype)

    @functools.cached_property
    def independent_dofs(self) -> np.ndarray:
        """See :attr:`Dynamics.independent_dofs`."""
        if self.embedding is None:
            return np.arange(self._dyn.scene.dof_count)
        return np.array(self.embedding.dofs, dtype=int)

    @functools.cached_property
    def rows(self) -> int:
        """Number of rows of all closures."""
        return ClosureEvaluator(self._dyn.scene).size

    def explain(self) -> str:
        """Return one line for :meth:`Dynamics.explain`."""
        scene = self._dyn.scene
        if not scene.loops and not scene.couplings:
            return "none"
        tied = f"{len(scene.loops)} loop joint(s), {len(scene.couplings)} coupling(s)"
        if self.embedding is not None:
            rows, dofs = len(self.embedding.rows), len(self.embedding.dofs)
            return f"{tied} embedded: {rows} of {self.rows} rows count, {dofs} dofs are independent"
        return f"{tied} by {self.rows} multipliers" if self.closed else f"{tied} left open"

    def check(self, call: Call) -> None:
        """Raise UnsupportedError unless loops are there and closed."""
        if not self.closed:
            scene = self._dyn.scene
            what = f"loops={self.loops!r}" if scene.loops or scene.couplings else "a scene without loops"
            way = "build Dynamics with loops='embed' or 'multipliers' of a scene that has loops or couplings"
            raise UnsupportedError(call.name, what, way)

    # -- forward dynamics ------------------------------------------------------------------------------------------
    def forward_dynamics(
        self, out: wp.array, status: wp.array | None, q: wp.array, qd: Any, tau: Any, body_f: Any
    ) -> None:
        """Launch forward dynamics with closed loops."""
        dyn, given = self._dyn, {"q": q, "qd": qd, "tau": tau, "body_f": body_f}
        if self.embedding is None:
            self.find_multipliers(**given)
            found, _, margin = self.solution()
            dyn._engine.launch_routine(UNDER_MULTIPLIERS, out, multipliers=found, **given)
            least = kernels.EPSILON[dyn.dtype] ** 0.5
        else:
            margin = dyn.recursions.array("loop margin", dyn.worlds, len(self.embedding.rows))
            more = {} if status is None or margin.size == 0 else {"margin": margin}
            options = {"embedding": self.embedding, "status": bool(more)}
            dyn._engine.launch_routine(FORWARD_DYNAMICS, out, more, **options, **given)
            least = 4.0 * kernels.EPSILON[dyn.dtype]
        if status is not None:
            status_words.write_of_rank(dyn.recursions, q, qd, tau, body_f, out, margin, least, status)

    # -- projection ------------------------------------------------------------------------------------------------
    def project(
        self, q: wp.array, qd: Any, hold: bool, iterations: int, q_out: wp.array, qd_out: wp.array | None
    ) -> None:
        """Launch :meth:`Dynamics.project`: Newton steps of q, then the nearest qd."""
        spare = [q_out, self._dyn.recursions.array("projected q", *q.shape)]
        for i in range(iterations):
            new = spare[(iterations - 1 - i) % 2]
            self._correct(new, hold, rates=False, q=q)
            q = new
        if iterations == 0:
            launches.copy(q_out, q)
        if qd_out is not None:
            self._correct(qd_out, hold, rates=True, q=q_out, qd=qd)

    def _correct(self, out: wp.array, hold: bool, rates: bool, **state: Any) -> None:
        launch = self._dyn._engine.launch_routine
        if self.embedding is not None:
            routine = PROJECT_VELOCITY if rates else PROJECT_POSITION
            launch(routine, out, embedding=self.embedding, fixed=self.embedding.dofs if hold else (), **state)
            return
        system, more = self.system()
        launch(SYSTEM, system, more, rates=rates, **state)
        found, _, _ = self.least_norm()
        launch(STEP, out, rates=rates, multipliers=found, **state)

    # -- multipliers -----------------------------------------------------------------------------------------------
    def find_multipliers(self, **given: Any) -> None:
        """Launch the solve for the multipliers that close the loops at q, qd, tau, body_f; see :meth:`solution`."""
        system, more = self.system()
        self._dyn._engine.launch_routine(MULTIPLIERS, system, more, **given)
        self.least_norm()

    def system(self) -> tuple[wp.array, dict[str, wp.array]]:
        """Return the arrays of the equation: matrix [world, row, row]; right-hand side and sizes [world, row]."""
        run, rows, worlds = self._dyn.recursions, self.rows, self._dyn.worlds
        more = {name: run.array(f"loop {name}", worlds, rows) for name in ("right", "size")}
        return run.array("loop system", worlds, rows, rows), more

    def solution(self) -> tuple[wp.array, wp.array, wp.array]:
        """Return the arrays of the solution: multipliers [world, row], rank [world], margin of the rank [world, 1]."""
        run, worlds = self._dyn.recursions, self._dyn.worlds
        multipliers = run.array("loop multipliers", worlds, self.rows)
        return multipliers, self._rank, run.array("loop resolved", worlds, 1)

    @functools.cached_property
    def _rank(self) -> wp.array:
        return wp.zeros(self._dyn.worlds, dtype=wp.int32, device=self._dyn.device)

    def least_norm(self) -> tuple[wp.array, wp.array, wp.array]:
        """Launch the solve of the equation for its solution of least norm; return :meth:`solution`."""
        run, rows, worlds = self._dyn.recursions, self.rows, self._dyn.worlds
        system, more = self.system()
        found, rank, resolved = self.solution()
        vectors, scale = run.array("loop vectors", worlds, rows, rows), run.array("loop scale", worlds, rows)
        outputs = [vectors, scale, found, rank, resolved.reshape((worlds,))]
        run.launch(kernels.solve_least_norm, worlds, [system, more["right"], more["size"], self._usual_rank], outputs)
        return found, rank, resolved


def check_loops(scene: Scene, loops: str) -> None:
    """Raise ValueError unless ``loops`` says what to do with the loops of the scene."""
    if loops not in LOOPS:
        raise ValueError(f"Dynamics: loops is {loops!r}; expected one of {', '.join(LOOPS)}")
    if not scene.constraint_summary or loops != "raise":
        return
    if scene.contacts:
        raise ValueError(
            f"Dynamics: the scene has {scene.constraint_summary}, and contacts, with which no step closes "
            f"them; expected a tree; "
            f"{AMID_CONTACTS}"
        )
    raise ValueError(
        f"Dynamics: the scene has {scene.constraint_summary}; expected a tree; loops='cut' leaves them open, "
        f"loops='embed' and "
        f"loops='multipliers' close them"
    )
