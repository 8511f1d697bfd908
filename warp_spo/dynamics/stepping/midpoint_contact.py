"""Steps with contacts whose velocity terms are kicks from half way: their rounds.

From MANY passes on a step is made in ROUNDS of as many passes each. A round finds what velocity terms do to the rates
half way through the step that the round before has found, and makes the whole step with that. At the end the rates
receive what velocity terms do half way through that step itself, see :mod:`warp_spo.recursions.contact.velocity_kicks`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import warp as wp

from ...execution.routine import PassForm, Routine, SegmentForm
from ...kernels.status import mark_unsettled
from ...recursions.contact import step as contact
from ...recursions.contact.velocity_kicks import FOUND, GAINED, KICK, KICKED, PATH, START, last_kick, middle_kick
from ...recursions.derivatives import adjoints
from ...runtime import launches
from ...scene.scene import Scene

if TYPE_CHECKING:
    from ..dynamics import Dynamics

MANY = 4  # passes from which on a step is made in rounds
ROUNDS = 2
UNSETTLED = 0.1  # share of the largest rate by which the end may change a rate without a word
CONTACT_STEP = Routine(
    "contact_step", contact.step, segments=SegmentForm(messages="PzafSE", wide=True), passes=PassForm(counted=True)
)
MIDDLE_KICK = Routine("middle_kick", middle_kick, segments=SegmentForm(messages="fPza"))
LAST_KICK = Routine("last_kick", last_kick, segments=SegmentForm(messages="fPza"))
INTEGRATE_VJP = Routine("integrate_vjp", adjoints.integrate_vjp)


class Round(NamedTuple):
    """Inputs and results of a round of a step.

    Attributes:
        before, kicked: rates after the step and kick that the round before found; of the first round, those before the
            step and zero [world, dof].
        kick: what velocity terms add to the rates in half a step. path: the rates along which q moves.
        q: coordinates half way along the path, at which the kick was found and the passes are.
        found, gained: rates after the step, and what its passes add to them over its length.
    """

    before: wp.array
    kicked: wp.array
    kick: wp.array
    path: wp.array
    q: wp.array
    found: wp.array
    gained: wp.array

    def step(self, q: wp.array) -> dict[str, wp.array]:
        """Return what the passes of the round read for the coordinates ``q`` before the step, by name."""
        return {"q": self.q, START: q, KICK: self.kick, PATH: self.path}


def in_rounds(scene: Scene, passes: float) -> bool:
    """Return whether a step of so many passes is made in rounds; one with pairs of bodies is not."""
    return passes >= MANY and not scene.contact_pairs


def step(
    dyn: Dynamics,
    dt: float,
    ends: tuple[wp.array, wp.array],
    more: dict[str, wp.array],
    q: wp.array,
    qd: wp.array,
    **given: Any,
) -> None:
    """Launch a step in rounds.

    Args:
        ends: arrays for q and qd after it. more: further arrays to fill, by name. given: arguments of the step, with
            its "passes", "reports" and options.
    """
    (q_out, qd_out), status = ends, more.get("status")
    q, qd = (  # the last kick reads both after q is stored
        _copy(dyn, name, array) if any(array.ptr == end.ptr for end in ends) else array
        for name, array in (("q", q), ("qd", qd))
    )
    options: dict[str, Any] = {name: given.pop(name) for name in ("qdd", "status") if name in given}
    further = {"qdd_out": more["qdd_out"]} if "qdd" in options else {}
    last = run(dyn, dt, q, qd, given, more | {"q_out": q_out}, options)[-1]
    state: dict[str, Any] = {"q": q, "qd": qd, "dt": dt, FOUND: last.found, KICKED: last.kick}
    state |= {GAINED: last.gained, "qdd": True} if further else {}
    dyn._engine.launch_routine(LAST_KICK, qd_out, further, **state)
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
    given: dict[str, Any],
    more: dict[str, wp.array],
    options: dict[str, Any],
    gains: bool = False,
) -> list[Round]:
    """Launch the rounds of a step but for the last kick, and return them.

    Args:
        given: arguments of the step. more: arrays that the last round fills, by name, for these ``options``.
        gains: fill in :attr:`Round.gained` of all rounds.
    """
    made, launch = list[Round](), dyn._engine.launch_routine
    given, reports = given | {"reports": ()}, given["reports"]
    while len(made) < ROUNDS:
        one = begin(dyn, dt, q, qd, made)
        made.append(one)
        asked = {"q_out": dyn.recursions.array("q of a round", *q.shape)}
        chosen = {"qdd": True} if gains else {}
        if len(made) == ROUNDS:
            asked, given, chosen = asked | more, given | {"reports": reports}, chosen | options
        asked |= {"qdd_out": one.gained} if "qdd" in chosen else {}
        launch(CONTACT_STEP, one.found, asked, qd=qd, dt=dt, **one.step(q), **given, **chosen)
    return made


def begin(dyn: Dynamics, dt: float, q: wp.array, qd: wp.array, made: list[Round]) -> Round:
    """Launch the kick of the round after those that were ``made``, and return the round."""

    def array(name: str, like: wp.array) -> wp.array:
        return dyn.recursions.array((name, len(made)), *like.shape)

    before, kicked = (made[-1].found, made[-1].kick) if made else (qd, array(KICKED, qd))
    if not made:
        launches.fill(kicked, 0)
    one = Round(
        before, kicked, array(KICK, qd), array(PATH, qd), array("q half way", q), array(FOUND, qd), array(GAINED, qd)
    )
    more = {"q_out": one.q, f"{PATH}_out": one.path}
    dyn._engine.launch_routine(MIDDLE_KICK, one.kick, more, q=q, qd=qd, dt=dt, **{FOUND: before, KICKED: kicked})
    return one
