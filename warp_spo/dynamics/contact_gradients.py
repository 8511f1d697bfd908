"""Gradients of a step with contacts: its passes once more, of which all is kept, and then back through each of them.

A pass is a launch of its own here, so that any number of them needs the same two kernels. What a pass leaves for the
next one stays in the workspace, [world, dof] and [world, variable] of each pass; steps share it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

from ..execution.heights import HeightSums
from ..execution.routine import Routine
from ..recursions.contact.ground import CORNERS, corner_steps, surface_count
from ..recursions.contact.step import PASSES
from ..recursions.derivatives.adjoints import result_name
from ..recursions.derivatives.contact import COTANGENT, HEIGHTS_AT, contact_pass, contact_pass_vjp, count_variables
from ..recursions.tracing import Trace
from ..scene.contacts import HEIGHTS, HeightField

if TYPE_CHECKING:
    from .dynamics import Dynamics

PASS = Routine("contact_pass", contact_pass, passes=True)
PASS_VJP = Routine("contact_pass_vjp", contact_pass_vjp, passes=True)
READ_AFTERWARDS = ("qdd", "q_cotangent", "qd_cotangent")  # of the arrays that are given, what the passes do not read


def launch(
    dyn: Dynamics,
    out: wp.array,
    more: dict[str, wp.array],
    wrt: tuple[str, ...],
    passes: int | None = None,
    **given: Any,
) -> None:
    """Launch the gradients of a step, into ``out`` by the first name of ``wrt`` and into ``more`` by the others.

    Args:
        passes: as of the step. given: arrays and numbers by name: arguments of the step, "qdd" that it found, and the
            cotangents of its results.
    """
    engine, count = dyn._engine, PASSES if passes is None else passes
    given = {name: value for name, value in given.items() if value is not None}
    read = {name: value for name, value in given.items() if name not in READ_AFTERWARDS}
    read["passes"] = float(count)
    variables, dofs = _variables(dyn, tuple(read)), dyn.scene.dof_count

    def array(name: str, number: int, size: int) -> wp.array:
        return dyn.recursions.array((name, number, size), dyn.worlds, size)

    rates = [array("qdd of a pass", number, dofs) for number in range(count)] + [given["qdd"]]  # first: before the step
    rows = [array("variables of a pass", number, variables) for number in range(count)]
    for number in range(count - 1):
        before = {"row": rows[number], "qdd_before": rates[number]}
        engine.launch_routine(
            PASS, rates[number + 1], {"row_out": rows[number + 1]}, number=float(number), **before, **read
        )
    results = dict(zip(wrt, (out, *more.values()), strict=True))
    summed, ground = results.get(HEIGHTS), dyn.scene.ground
    if summed is not None:
        surfaces = len(dyn.scene.contact_points) * surface_count(ground, varies=True)
        results[HEIGHTS] = dyn.recursions.array("heights by surface", dyn.worlds, surfaces, CORNERS)
        results[HEIGHTS_AT] = dyn.recursions.array("cells by surface", dyn.worlds, surfaces)
    cotangents = [array(COTANGENT, number, dofs + variables) for number in range(2)]
    later = {f"{name}_later": results[name] for name in wrt}
    read |= {name: given[name] for name in READ_AFTERWARDS[1:]} | later
    read.pop("tau", None)  # no gradient depends on it
    for number in reversed(range(count)):
        passed = {"row": rows[number], "qdd_before": rates[number], "qdd": rates[number + 1]}
        passed[COTANGENT] = cotangents[number % 2]
        more = {result_name(name, wrt): array for name, array in results.items() if name != wrt[0]}
        more[f"{COTANGENT}_out"] = cotangents[1 - number % 2]
        engine.launch_routine(PASS_VJP, results[wrt[0]], more, number=float(number), wrt=wrt, **passed, **read)
    if summed is not None:
        assert isinstance(ground, HeightField)
        contributions, cells = results[HEIGHTS], results[HEIGHTS_AT]
        if dyn._gradients.height_sums is None:
            dyn._gradients.height_sums = HeightSums(cells.size, summed.size, dyn.dtype, dyn.device)
        flat = cells.flatten(), contributions.reshape((cells.size, CORNERS))
        dyn._gradients.height_sums.add_up(*flat, corner_steps(ground), summed.flatten())


def _variables(dyn: Dynamics, inputs: tuple[str, ...]) -> int:
    """Return how many variables the passes have, which depends on what is given besides the state."""
    known = dyn._gradients.pass_variables
    if inputs not in known:
        trace = Trace(dyn.programs.links.with_tables(), dyn.dtype.__name__, inputs)
        known[inputs] = count_variables(trace)
    return known[inputs]
