"""Gradients of a step with contacts: its passes once more, of which all is kept, and then back through each of them.

A pass is a launch of its own here, so that any number of them needs the same three kernels. The results of a pass that
the next one reads stay in the workspace, [world, dof] and [world, variable] of each pass; steps share it.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import TYPE_CHECKING, Any

import warp as wp

from ...execution.height_gradients import HeightSums
from ...execution.routine import Routine, SegmentForm, TuningHints
from ...recursions.contact.ground import CORNERS, corner_steps
from ...recursions.contact.points import surface_numbers
from ...recursions.contact.step import PASSES, by_segments
from ...recursions.derivatives import contact
from ...recursions.derivatives.adjoints import result_name
from ...recursions.derivatives.contact import CAME, COTANGENT, HEIGHTS_AT, INERTIA, SOLVED
from ...recursions.derivatives.contact_pass import (
    BEFORE,
    NUMBER,
    ROW,
    contact_pass,
    count_law_variables,
    count_variables,
    weighed_segments,
)
from ...recursions.model.messages import SIZES
from ...recursions.model.tracing import Trace
from ...scene.ground import HEIGHTS, HeightField
from . import midpoint_scheme, midpoint_scheme_gradients

if TYPE_CHECKING:
    from ..dynamics import Dynamics


def _divides(scene: Any, inputs: Any, apart: bool = True, **_: Any) -> bool:
    return apart and by_segments(scene)


PASS = Routine(
    "contact_pass",
    contact_pass,
    segments=SegmentForm(messages="Pzaf", divides=_divides, wide=True),
    hints=TuningHints(crowded=True),
)
SOLVE = Routine(
    "contact_solve",
    contact.contact_solve,
    segments=SegmentForm(messages="Pza", divides=_divides, wide=True),
    hints=TuningHints(crowded=True),
)
GRADIENT = Routine(
    "contact_gradient",
    contact.contact_gradient,
    segments=SegmentForm(messages="BGO", divides=_divides, wide=True),
    hints=TuningHints(crowded=True),
)
WEIGHED = {
    SOLVE: dataclasses.replace(SOLVE, segments=SegmentForm(messages="PzaQ", divides=_divides, wide=True)),
    GRADIENT: dataclasses.replace(GRADIENT, segments=SegmentForm(messages="PBGO", divides=_divides, wide=True)),
}
"""The same where limbs tell each other how inertias count that joints further in feel."""
NOT_READ = ("qdd", "q_cotangent", "qd_cotangent")  # of the arrays that are given, what the passes do not read


def launch(
    dyn: Dynamics,
    out: wp.array,
    more: dict[str, wp.array],
    wrt: tuple[str, ...],
    passes: int | None = None,
    rounds: int | None = None,
    **given: Any,
) -> None:
    """Launch the gradients of a step, into ``out`` by the first name of ``wrt``, into ``more`` by the others in order.

    Args:
        passes, rounds: how many passes, and iterations of the midpoint scheme, the step took; None: its defaults.
        given: arrays and numbers by name: arguments of the step, "qdd" that it found, and the cotangents of its
            results; None for one that was left out.
    """
    pass_count = PASSES if passes is None else passes
    given = {name: value for name, value in given.items() if value is not None}
    results = dict(zip(wrt, (out, *more.values()), strict=True))
    if rounds_made := midpoint_scheme.count_rounds(dyn.scene, pass_count, rounds):
        midpoint_scheme_gradients.backpropagate(
            dyn, functools.partial(_launch, dyn), results, pass_count, rounds_made, **given
        )
    else:
        _launch(dyn, results, pass_count, **given)


def _launch(dyn: Dynamics, asked: dict[str, wp.array], count: int, **given: Any) -> None:
    """Launch the gradients of ``count`` passes into the arrays ``asked`` for by name."""
    launch, wrt = dyn._engine.launch_routine, tuple(asked)
    read = {name: value for name, value in given.items() if name not in NOT_READ}
    read["passes"] = float(count)
    (laws, weighed), dofs = _laws(dyn, tuple(read)), dyn.scene.dof_count
    variables = count_variables(dyn.programs.links, laws)

    def array(name: str, number: int, size: int) -> wp.array:
        return dyn.recursions.array((name, number, size), dyn.worlds, size)

    rates = [array("qdd of a pass", number, dofs) for number in range(count)] + [given["qdd"]]  # first: before the step
    rows = [array("variables of a pass", number, variables) for number in range(count)]
    left = [array(COTANGENT, number, dofs + variables) for number in range(count + 1)]  # by what passes leave
    solved = [array(SOLVED, number, dofs) for number in range(count)]
    solve, gradient = (WEIGHED[one] if weighed else one for one in (SOLVE, GRADIENT))
    inertias = [array(INERTIA, number, SIZES["P"] * len(weighed)) for number in range(count)] if weighed else []
    known = [{NUMBER: float(n), ROW: rows[n], BEFORE: rates[n], "laws": laws} for n in range(count)]
    for number in range(count - 1):
        launch(PASS, rates[number + 1], {f"{ROW}_out": rows[number + 1]}, **known[number], **read)
    read |= {name: given[name] for name in NOT_READ[1:]}
    read.pop("tau", None)  # no gradient depends on it
    for number in reversed(range(count)):
        known[number] |= {"qdd": rates[number + 1], COTANGENT: left[number + 1]}
        more = {f"{COTANGENT}_out": left[number]} | ({f"{INERTIA}_out": inertias[number]} if weighed else {})
        launch(solve, solved[number], more, **known[number], **read)
    results = dict(asked)
    ground, surfaces = dyn.scene.ground, 0
    if HEIGHTS in results:
        surfaces = sum(map(len, surface_numbers(dyn.scene, varies=True)))
        results[HEIGHTS] = dyn.recursions.array("heights by surface", dyn.worlds, surfaces, CORNERS)
        results[HEIGHTS_AT] = dyn.recursions.array("cells by surface", dyn.worlds, surfaces)
    bars = {result_name(name, wrt): array for name, array in results.items() if name != wrt[0]}
    read |= {f"{name}_later": results[name] for name in wrt}
    apart = contact.divides(dyn.scene, dyn.variable, read, wrt)
    for number in reversed(range(count)):
        known[number] |= {SOLVED: solved[number], CAME: left[number]} | ({INERTIA: inertias[number]} if weighed else {})
        launch(gradient, results[wrt[0]], bars, wrt=wrt, apart=apart, **known[number], **read)
    if HEIGHTS in wrt:
        assert isinstance(ground, HeightField)
        summed = asked[HEIGHTS]
        if dyn._gradients.height_sums is None:
            dyn._gradients.height_sums = HeightSums(dyn.worlds * surfaces, summed.size, dyn.dtype, dyn.device)
        contributions = results[HEIGHTS].reshape((dyn.worlds * surfaces, CORNERS))
        sums = dyn._gradients.height_sums
        sums.add_up(results[HEIGHTS_AT].flatten(), contributions, corner_steps(ground), summed.flatten())


def _laws(dyn: Dynamics, inputs: tuple[str, ...]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return how many variables the laws of each link have, and which segments carry what these laws feel.

    Both depend on what is given besides the state.
    """
    known = dyn._gradients.pass_laws
    if inputs not in known:
        traces = (Trace(dyn.programs.links.with_tables(), dyn.dtype.__name__, inputs) for _ in range(2))
        known[inputs] = count_law_variables(next(traces)), weighed_segments(next(traces))
    return known[inputs]
