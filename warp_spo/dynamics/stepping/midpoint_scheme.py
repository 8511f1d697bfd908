"""The midpoint scheme of steps: velocity terms act as two half-step impulses.

Steps with contacts of MIDPOINT_PASSES passes and more use it, and all others that ask for rounds. Each round evaluates
the velocity terms at the midpoint of the previous round's step and repeats the step with them, with all its passes.
Then velocity terms are evaluated at the midpoint of the last one's step, see
:mod:`warp_spo.recursions.contact.velocity_kicks`.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

import warp as wp

from ...execution.routine import PassForm, Routine, SegmentForm
from ...kernels.status import mark_unsettled
from ...recursions.contact import step as contact_step
from ...recursions.contact.velocity_kicks import (
    KICK,
    PASS_ACCELERATION,
    PATH,
    PREVIOUS_KICK,
    PREVIOUS_RATES,
    START,
    final_kick,
    first_kick,
)
from ...recursions.derivatives import adjoints
from ...runtime import launches
from ...scene.scene import Scene

if TYPE_CHECKING:
    from ..dynamics import Dynamics

MIDPOINT_PASSES = 4  # passes from which on a step uses the midpoint scheme
ITERATIONS = 2
UNSETTLED = 0.1  # share of the largest rate by which the final kick may change a rate without a status


def _divides(scene: Scene, inputs: Iterable[str], **_: Any) -> bool:
    return contact_step.by_segments(scene)


CONTACT_STEP = Routine(
    "contact_step",
    contact_step.step,
    segments=SegmentForm(messages="PzafSE", divides=_divides, wide=True),
    passes=PassForm(counted=True),
)
FIRST_KICK = Routine("middle_kick", first_kick, segments=SegmentForm(messages="fPza"))
FINAL_KICK = Routine("last_kick", final_kick, segments=SegmentForm(messages="fPza"))
INTEGRATE_VJP = Routine("integrate_vjp", adjoints.integrate_vjp)


class MidpointIteration(NamedTuple):
    """Inputs and results of one iteration of a step.

    Attributes:
        previous_rates: rates after the step of the previous iteration; qd in the first one [world, dof].
        previous_kick: kick of the previous iteration; zero in the first one [world, dof].
        kick: what velocity terms add to the rates in half a step [world, dof].
        path: the rates along which q moves [world, dof].
        q: coordinates at the midpoint, at which kick and passes are evaluated [world, coordinate].
        found: rates after the step [world, dof].
        gained: what the passes add to the rates, over the length of the step [world, dof].
    """

    previous_rates: wp.array
    previous_kick: wp.array
    kick: wp.array
    path: wp.array
    q: wp.array
    found: wp.array
    gained: wp.array

    def step(self, q: wp.array, path: bool = True) -> dict[str, wp.array]:
        """Return the arrays that the step of the iteration reads for the coordinates ``q`` before the step, by name.

        ``path``: contacts read along which rates q moves.
        """
        return {"q": self.q, START: q, KICK: self.kick} | ({PATH: self.path} if path else {})


def count_rounds(scene: Scene, passes: float, rounds: int | None) -> int:
    """Return how many rounds of so many passes a step with contacts makes; 0 where it is not of the midpoint scheme.

    Args:
        rounds: as the caller gives it. None: ITERATIONS from MIDPOINT_PASSES passes on, unless pairs of bodies touch.
    """
    if rounds is not None:
        return rounds
    return ITERATIONS if passes >= MIDPOINT_PASSES and not scene.contact_pairs else 0


def step(
    dyn: Dynamics,
    dt: float,
    ends: tuple[wp.array, wp.array],
    more: dict[str, wp.array],
    q: wp.array,
    qd: wp.array,
    rounds: int,
    routine: Routine = CONTACT_STEP,
    **given: Any,
) -> None:
    """Launch a step of the midpoint scheme, with contacts or without.

    A kick is what velocity terms add to the rates in half a step. Each round is a kick and a step of ``routine``, which
    has no velocity terms; the final kick follows the last round.

    Args:
        rounds: how many, 1 or more. routine: CONTACT_STEP, or STEP in a scene without contacts.
        ends: arrays for q and qd after it. more: further arrays to fill, by name. given: arguments of the step, with
            its "passes", "reports" and options.
    """
    (q_out, qd_out), status = ends, more.get("status")
    q, qd = (  # the final kick reads both after q is stored
        _copy(dyn, name, array) if any(array.ptr == end.ptr for end in ends) else array
        for name, array in (("q", q), ("qd", qd))
    )
    options: dict[str, Any] = {name: given.pop(name) for name in ("qdd", "status") if name in given}
    further = {"qdd_out": more["qdd_out"]} if "qdd" in options else {}
    last = run(dyn, dt, q, qd, rounds, given, more | {"q_out": q_out}, options, routine=routine)[-1]
    state: dict[str, Any] = {"q": q, "qd": qd, "dt": dt, PREVIOUS_RATES: last.found, PREVIOUS_KICK: last.kick}
    state |= {PASS_ACCELERATION: last.gained, "qdd": True} if further else {}
    dyn._engine.launch_routine(FINAL_KICK, qd_out, further, **state)
    if status is not None:
        read = [last.found, last.kick, qd_out, UNSETTLED]
        dyn.recursions.launch(mark_unsettled, dyn.worlds, read, [status])


def _copy(dyn: Dynamics, name: str, array: wp.array) -> wp.array:
    launches.copy(copy := dyn.recursions.array(f"{name} before", *array.shape), array)
    return copy


def run(
    dyn: Dynamics,
    dt: float,
    q: wp.array,
    qd: wp.array,
    rounds: int,
    given: dict[str, Any],
    more: dict[str, wp.array],
    options: dict[str, Any],
    gains: bool = False,
    routine: Routine = CONTACT_STEP,
) -> list[MidpointIteration]:
    """Launch the iterations of a step of so many ``rounds`` without the final kick, and return them.

    Args:
        given: arguments of the step. more: arrays that the last iteration fills, by name, for these ``options``.
        gains: fill in :attr:`MidpointIteration.gained` in all iterations. routine: of :func:`step`.
    """
    iterations, launch, contacts = list[MidpointIteration](), dyn._engine.launch_routine, routine is CONTACT_STEP
    reports = {"reports": given["reports"]} if contacts else {}
    given = given | dict.fromkeys(reports, ())
    while len(iterations) < rounds:
        one = begin_iteration(dyn, dt, q, qd, iterations, rounds == 1)
        iterations.append(one)
        asked = {"q_out": dyn.recursions.array("q of a round", *q.shape)}
        chosen = {"qdd": True} if gains else {}
        if len(iterations) == rounds:
            asked, given, chosen = asked | more, given | reports, chosen | options
        asked |= {"qdd_out": one.gained} if "qdd" in chosen else {}
        launch(routine, one.found, asked, qd=qd, dt=dt, **one.step(q, contacts), **given, **chosen)
    return iterations


def begin_iteration(
    dyn: Dynamics, dt: float, q: wp.array, qd: wp.array, iterations: list[MidpointIteration], only: bool = False
) -> MidpointIteration:
    """Launch the kick of the iteration that follows ``iterations``, and return it.

    ``only``: of the one round of a step, whose kick has a shorter kernel: the rates of no iteration come before.
    """

    def array(name: str, like: wp.array) -> wp.array:
        return dyn.recursions.array((name, len(iterations)), *like.shape)

    previous_rates, previous_kick = (
        (iterations[-1].found, iterations[-1].kick) if iterations else (qd, array(PREVIOUS_KICK, qd))
    )
    if not iterations:
        launches.fill(previous_kick, 0)
    one = MidpointIteration(
        previous_rates,
        previous_kick,
        array(KICK, qd),
        array(PATH, qd),
        array("q half way", q),
        array(PREVIOUS_RATES, qd),
        array(PASS_ACCELERATION, qd),
    )
    more = {"q_out": one.q, f"{PATH}_out": one.path}
    previous = {} if only else {PREVIOUS_RATES: previous_rates, PREVIOUS_KICK: previous_kick}
    dyn._engine.launch_routine(FIRST_KICK, one.kick, more, q=q, qd=qd, dt=dt, **previous)
    return one
