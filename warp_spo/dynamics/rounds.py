"""Steps with contacts whose velocity terms are kicks from half way: their rounds, and the way back.

From MANY passes on a step is made in ROUNDS of as many passes each. A round finds what velocity terms do to the rates
half way through the step that the round before has found, and makes the whole step with that. At the end the rates
receive what velocity terms do half way through that step itself, see :mod:`warp_spo.recursions.contact.middle`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import warp as wp

from .. import launches
from ..execution.routine import Routine
from ..kernels import combination, unsettled
from ..recursions.contact import step as contact
from ..recursions.contact.middle import FOUND, GAINED, KICK, KICKED, PATH, START, last_kick, middle_kick
from ..recursions.derivatives import adjoints
from ..scene.scene import Scene
from .inertia import SOLVE_MASS_MATRIX
from .inverse_dynamics import WAY_BACK

if TYPE_CHECKING:
    from collections.abc import Callable

    from .dynamics import Dynamics

MANY = 4  # passes from which on a step is made in rounds
ROUNDS = 2
UNSETTLED = 0.1  # share of the largest rate by which the end may change a rate without a word
CONTACT_STEP = Routine("contact_step", contact.step, letters="PzafSE", passes=True, counted=True, wide=True)
MIDDLE_KICK = Routine("middle_kick", middle_kick, letters="fPza")
LAST_KICK = Routine("last_kick", last_kick, letters="fPza")
INTEGRATE_VJP = Routine("integrate_vjp", adjoints.integrate_vjp)


class Round(NamedTuple):
    """What a round of a step reads and finds.

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


def taken(scene: Scene, passes: float) -> bool:
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
        _copied(dyn, name, array) if any(array.ptr == end.ptr for end in ends) else array
        for name, array in (("q", q), ("qd", qd))
    )
    options: dict[str, Any] = {name: given.pop(name) for name in ("qdd", "status") if name in given}
    further = {"qdd_out": more["qdd_out"]} if "qdd" in options else {}
    last = _run(dyn, dt, q, qd, given, more | {"q_out": q_out}, options)[-1]
    state: dict[str, Any] = {"q": q, "qd": qd, "dt": dt, FOUND: last.found, KICKED: last.kick}
    state |= {GAINED: last.gained, "qdd": True} if further else {}
    dyn._engine.launch_routine(LAST_KICK, qd_out, further, **state)
    if status is not None:
        read = [last.found, last.kick, qd_out, UNSETTLED]
        dyn.recursions.launch(unsettled.mark_unsettled, dyn.worlds, read, [status])


def _copied(dyn: Dynamics, name: str, array: wp.array) -> wp.array:
    launches.copy(copy := dyn.recursions.array(f"{name} before", *array.shape), array)
    return copy


def _run(
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
        one = _begin(dyn, dt, q, qd, made)
        made.append(one)
        asked = {"q_out": dyn.recursions.array("q of a round", *q.shape)}
        chosen = {"qdd": True} if gains else {}
        if len(made) == ROUNDS:
            asked, given, chosen = asked | more, given | {"reports": reports}, chosen | options
        asked |= {"qdd_out": one.gained} if "qdd" in chosen else {}
        launch(CONTACT_STEP, one.found, asked, qd=qd, dt=dt, **one.step(q), **given, **chosen)
    return made


def _begin(dyn: Dynamics, dt: float, q: wp.array, qd: wp.array, made: list[Round]) -> Round:
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


def pull_back(
    dyn: Dynamics,
    back: Callable[..., None],
    results: dict[str, wp.array],
    passes: int,
    q_cotangent: wp.array,
    qd_cotangent: wp.array,
    **given: Any,
) -> None:
    """Launch the gradients of a step that is made in rounds.

    Args:
        back: ``back(results, passes, **given)`` launches those of passes between kicks.
        results: arrays to fill, by name of what they are gradients by. passes: of a round. given: arguments of the
            step, and "qdd" that it found, which is found anew.
    """
    q, qd, dt, _ = (given.pop(name) for name in ("q", "qd", "dt", "qdd"))
    rounds = _run(dyn, dt, q, qd, given | {"passes": float(passes), "reports": ()}, {}, {}, gains=True)
    end, h, launch = _begin(dyn, dt, q, qd, rounds), 0.5 * dt, dyn._engine.launch_routine

    def like(array: wp.array, *key: Any) -> wp.array:
        return dyn.recursions.array(("way back", *key), *array.shape)

    def combine(a: float, x: wp.array, b: float, y: wp.array, out: wp.array) -> wp.array:
        flat = [one.reshape((1, one.size)) for one in (x, y, out)]
        dyn.recursions.launch(combination.combine, flat[2].shape, [a, flat[0], b, flat[1]], [flat[2]])
        return out

    def add(name: str, more: wp.array, share: float = 1.0) -> None:
        if name in results:
            combine(1.0, results[name], share, more, results[name])

    def moved_back(rates: wp.array, cotangent: wp.array) -> wp.array:
        """Add the gradient by q of q moved along the rates for half a step; return that by the rates."""
        ways = {"q": like(q, "moved q"), "qd": like(qd, "moved")}
        if "value" in results:  # rates of a free base are those of its centre of mass
            ways["value"] = like(results["value"], "moved value")
        more = {f"{name}_bar": way for name, way in ways.items() if name != "q"}
        launch(INTEGRATE_VJP, ways["q"], more, q=q, qd=rates, dt=h, cotangent=cotangent, wrt=tuple(ways))
        for name in ways.keys() - {"qd"}:
            add(name, ways[name])
        return ways["qd"]

    def kicked_back(
        one: Round, by_kick: wp.array, by_half: wp.array | None = None, by_path: wp.array | None = None
    ) -> None:
        """Add the gradient by q and qd of a kick, from those by what it leaves; leave those by what it reads.

        They are in ``by_found`` and ``by_kicked``.
        """
        # k = h acc / 2 with Mass acc + c(a) - c(b) = 0; of c(a) and c(b) gravity counts twice, and cancels
        v = combine(0.5, qd, 0.5, one.before, like(qd, "v"))
        a, b = (combine(0.5, one.path, sign, v, like(qd, "rates", sign)) for sign in (0.5, -0.5))
        solved, acc = like(qd, "solved"), combine(1.0 / h, one.kick, 0.0, one.kick, like(qd, "acc"))
        dyn._engine.launch(SOLVE_MASS_MATRIX, solved, q=one.q, b=by_kick)
        found: list[dict[str, wp.array]] = []
        for sign, at, accelerates in ((-h, a, {"qdd": acc}), (h, b, {})):
            weighed = combine(sign, solved, 0.0, solved, like(qd, "weighed"))
            ways = {name: like(parts[name], "terms", name, sign) for name in kinds}
            more = {f"{name}_bar": way for name, way in ways.items() if name != "q"}
            state = {"q": one.q, "qd": at, **accelerates, "cotangent": weighed}
            launch(WAY_BACK, ways["q"], more, **state, wrt=tuple(ways))
            found.append(ways)
        along, across = found
        if "value" in results:
            add("value", along["value"])
            add("value", across["value"])
        half = combine(1.0, along["q"], 1.0, across["q"], like(q, "half"))
        by_u = combine(0.5, along["qd"], 0.5, across["qd"], like(qd, "u"))
        by_v = combine(0.5, along["qd"], -0.5, across["qd"], like(qd, "by v"))
        if by_half is not None and by_path is not None:
            combine(1.0, half, 1.0, by_half, half)
            combine(1.0, by_u, 1.0, by_path, by_u)
        combine(1.0, by_u, 1.0, moved_back(one.path, half), by_u)
        combine(1.0, by_u, 0.5, by_v, by_found)
        combine(-1.0, by_u, 0.0, by_u, by_kicked)
        add("qd", by_v, 0.5)

    for array in results.values():
        launches.fill(array, 0)
    extra = {"q": q, "qd": qd, START: q, KICK: qd, PATH: qd}
    parts = {name: like(array, "step", name) for name, array in (results | extra).items()}
    kinds = [name for name in ("q", "qd", "value") if name == "q" or name in parts]
    by_found, by_kicked, still = like(qd, "found"), like(qd, "kicked"), like(q, "still")
    launches.fill(still, 0)
    kicked_back(end, combine(2.0, qd_cotangent, 0.0, qd_cotangent, like(qd, "last")))  # qd' = found + 2 (end - kick)
    combine(1.0, by_found, 1.0, qd_cotangent, by_found)
    combine(1.0, by_kicked, -2.0, qd_cotangent, by_kicked)
    by_q = q_cotangent
    for one in reversed(rounds):
        ends = {"q_cotangent": by_q, "qd_cotangent": by_found, "qdd": one.gained}
        back(parts, passes, qd=qd, dt=dt, **one.step(q), **given, **ends)
        for name in results.keys() - {"q"}:
            add(name, parts[name])
        add("q", parts[START])
        by_kick = combine(1.0, parts[KICK], 1.0, by_kicked, like(qd, "by kick"))
        kicked_back(one, by_kick, parts["q"], parts[PATH])
        by_q = still
    add("qd", by_found)  # the first round found the rates before the step
