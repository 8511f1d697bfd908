"""Options and reports of a step of a scene with contacts: passes, forces, gaps, slips, excess."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

from ...errors import UnsupportedError, as_integer
from ...kernels import combination
from ...recursions.contact import step as contact_step
from ...recursions.contact.pairs import default_passes
from ...recursions.contact.turning import turning_names
from ...runtime.arrays import Call
from ...scene.contact_values import contact_figures
from ...scene.ground import HeightField
from ..closures import AMID_CONTACTS
from ..operation import Argument
from . import integrators
from .joint_space import reason_against

if TYPE_CHECKING:
    from ..dynamics import Dynamics

REPORTS = contact_step.REPORTS
AXES = ("world, contact, 3", "world, contact", "world, contact", "world, 3", "world, contact, 3")
ARGUMENTS = tuple(
    Argument(name, axes, optional=True, asked=True, written=True) for name, axes in zip(REPORTS, AXES, strict=True)
)
FEW_TIED = "generated code: few links are tied, and it eliminates them"
MOST_HEIGHTS = {"float32": 2**24, "float64": 2**31}  # points of a field whose numbers the dtype tells apart


def check_step(dyn: Dynamics, call: Call, integrator: str, passes: Any, asked: dict[str, Any]) -> int | None:
    """Return the number of passes, None without contacts; raise an error for what a step with contacts cannot do.

    Args:
        passes: as the caller gives it. asked: arrays of REPORTS by name; None where the caller gives none.
    """
    if not dyn.scene.contacts:
        for name, value in (("passes", passes), *asked.items()):
            if value is not None:
                raise ValueError(f"{call.name}: {name} is given, and the scene has no contacts; expected None")
        return None
    if asked["contact_moment"] is not None and not turns(dyn):
        raise ValueError(
            f"{call.name}: contact_moment is given, and no contact has torsional or rolling friction; expected None"
        )
    count = default_passes(dyn.scene) if passes is None else as_integer(passes)
    if count is None or count < 1:
        raise ValueError(f"{call.name}: passes is {passes!r}; expected an integer, 1 or more")
    refuse(dyn, call, integrator)
    reports = [name for name, value in asked.items() if value is not None]
    if reports and dyn.scene.dof_count == 0:
        what = f"{' and '.join(reports)} of a scene in which nothing can move"
        raise UnsupportedError(call.name, what, "leave it out")
    return count


def turns(dyn: Dynamics) -> bool:
    """Return whether some contact point has torsional or rolling friction."""
    scene, variable = dyn.scene, dyn.variable
    return any(turning_names(scene, variable, number) for number in range(len(scene.contact_points)))


def check_rounds(dyn: Dynamics, call: Call, integrator: str, rounds: Any) -> int | None:
    """Return the checked number of rounds of a step; None where the caller gives none."""
    if rounds is None:
        return None
    count = as_integer(rounds)
    if count is None or count < 0:
        raise ValueError(f"{call.name}: rounds is {rounds!r}; expected an integer, 0 or more")
    obstacles = {
        "where bodies touch each other": dyn.scene.contact_pairs,
        "where loops are closed": dyn.closed,
        f"with integrator={integrator!r}": integrator != "semi_implicit",
    }
    for where in filter(obstacles.get, obstacles) if count else ():
        raise UnsupportedError(call.name, f"rounds={count} {where}", "leave it out")
    return count


def refuse(dyn: Dynamics, call: Call, integrator: str) -> None:
    """Raise UnsupportedError for a step with contacts that has no kernel."""
    forced = dyn._options["granularity"]
    if integrator != "semi_implicit":
        raise UnsupportedError(call.name, f"integrator={integrator!r} with contacts", "use 'semi_implicit'")
    if dyn.closed:
        raise UnsupportedError(call.name, "closing loops in a scene with contacts", AMID_CONTACTS)
    if forced == "node":
        raise UnsupportedError(call.name, f"granularity={forced!r} with contacts", "use another one, or leave it out")
    obstacle, way = reason_against(dyn)
    if obstacle:
        raise UnsupportedError(call.name, f"contact between bodies in a scene with {obstacle}", way)
    if isinstance(dyn.scene.ground, HeightField) and dyn.scene.ground.heights.size >= MOST_HEIGHTS[dyn.dtype.__name__]:
        way = "use dtype='float64', or a coarser field"
        raise UnsupportedError(call.name, f"a HeightField of {dyn.scene.ground.heights.size} points in float32", way)


def add_share(dyn: Dynamics, substep: int, count: int, now: wp.array, mean: wp.array) -> None:
    """Launch ``mean`` += ``now`` / count, [world, contact, 3]; in the first substep ``mean`` holds nothing yet."""
    flat = [array.reshape((dyn.worlds, 3 * array.shape[1])) for array in (now, mean)]
    shares = [1.0 / count, flat[0], 1.0, flat[1]] if substep else [1.0 / count, flat[0], 0.0, flat[0]]
    dyn.recursions.launch(combination.combine, flat[0].shape, shares, [flat[1]])


def explain(dyn: Dynamics) -> str:
    """Return a line on the scene's contacts."""
    figures = contact_figures(dyn.scene)
    if not dyn.scene.contacts:
        return figures
    passes = f"{default_passes(dyn.scene)} passes of a step unless StepOptions(passes=) says otherwise, none at node"
    if dyn._joint_space is not None:
        return f"{figures}; {passes}; {dyn._joint_space.explain()}"
    routine = integrators.contact_routine(dyn)
    form = "a thread computes a whole world"
    if dyn.plan.of(routine) == "segment" and routine.divides(dyn.scene, ()):
        held = dyn.programs.warps(routine) != 1  # 1: a kernel was built, and limbs found no room in it
        form = "a warp for each limb" if held else f"{form}: what limbs tell each other does not fit in shared memory"
    if dyn.scene.contact_pairs:
        obstacle, _ = reason_against(dyn)
        form += f"; no step takes pairs of bodies beside {obstacle}" if obstacle else f"; pairs of bodies by {FEW_TIED}"
    return f"{figures}; {passes}; {form}"
