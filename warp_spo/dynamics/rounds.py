"""Steps with contacts whose velocity terms are kicks from half way: their rounds, and the way back.

From MANY passes on a step is made in rounds. Each finds what velocity terms do to the rates half way through the step
that the round before has found, and makes the whole step with that, see :mod:`warp_spo.recursions.contact.middle`.
Those before the last one take EARLY passes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import warp as wp

from .. import launches
from ..execution.routine import Routine
from ..kernels import combination, unsettled
from ..recursions.contact import step as contact
from ..recursions.contact.middle import FOUND, HALF, KICK, KICKED, START, middle_kick
from ..recursions.derivatives import adjoints
from ..scene.scene import Scene
from .inertia import SOLVE_MASS_MATRIX
from .inverse_dynamics import WAY_BACK

if TYPE_CHECKING:
    from collections.abc import Callable

    from .dynamics import Dynamics

MANY = 4  # passes from which on a step is made in rounds
EARLY = (3, 3)  # passes of each round before the last one
UNSETTLED = 0.1  # share of the largest rate by which the last round may change a rate without a word
CONTACT_STEP = Routine("contact_step", contact.step, letters="PzafSE", passes=True, counted=True, wide=True)
MIDDLE_KICK = Routine("middle_kick", middle_kick, letters="fPza")
INTEGRATE_VJP = Routine("integrate_vjp", adjoints.integrate_vjp)


class Round(NamedTuple):
    """What a round of a step reads and finds.

    Attributes:
        found: rates after the step that the round before found; of the first round, those before the step [world, dof].
        kicked, kick: what velocity terms add to the rates in half a step, of the round before and of this one.
        q: coordinates half way, at which its passes are.
        half, a, b: where asked for, coordinates and rates at which the kick was found.
    """

    found: wp.array
    kicked: wp.array
    kick: wp.array
    q: wp.array
    half: wp.array | None = None
    a: wp.array | None = None
    b: wp.array | None = None

    def step(self, q: wp.array) -> dict[str, wp.array]:
        """Return what the step of the round reads for the coordinates ``q`` before it, by name."""
        return {"q": self.q, START: q, KICK: self.kick}


def taken(scene: Scene, passes: float) -> bool:
    """Return whether a step of so many passes is made in rounds; one with pairs of bodies is not."""
    return passes >= MANY and not scene.contact_pairs


def run(dyn: Dynamics, dt: float, q: wp.array, qd: wp.array, states: bool = False, **given: Any) -> list[Round]:
    """Launch the rounds of a step but for the passes of the last one, and return them.

    Args:
        states: fill in :attr:`Round.half`, ``a`` and ``b``. given: forces and targets by name.
    """
    launch, rounds = dyn._engine.launch_routine, list[Round]()

    def array(name: str, like: wp.array) -> wp.array:
        return dyn.recursions.array((name, len(rounds)), *like.shape)

    found, kicked, ends = qd, array(KICKED, qd), array(FOUND + " q", q)
    launches.fill(kicked, 0)
    while True:
        one = Round(found, kicked, array(KICK, qd), array("q half way", q))
        one = one._replace(half=array(HALF, q), a=array("a", qd), b=array("b", qd)) if states else one
        more = {f"{name}_out": array for name, array in one._asdict().items() if name in ("q", HALF, "a", "b")}
        more = {name: array for name, array in more.items() if array is not None}
        asked = {"states": True} if states else {}
        launch(MIDDLE_KICK, one.kick, more, q=q, qd=qd, dt=dt, **{FOUND: found, KICKED: kicked}, **asked)
        rounds.append(one)
        if len(rounds) > len(EARLY):
            return rounds
        found, kicked = array(FOUND, qd), one.kick
        count = {"passes": float(EARLY[len(rounds) - 1])}
        options = {**one.step(q), **given, **count, "reports": ()}  # in the order of the step's own call
        launch(CONTACT_STEP, found, {"q_out": ends}, qd=qd, dt=dt, **options)


def mark_unsettled(dyn: Dynamics, rounds: list[Round], status: wp.array) -> None:
    """Launch the word NOT_SETTLED where the last round changed a rate by UNSETTLED of the largest one."""
    last = rounds[-1]
    read = [last.kicked, last.kick, last.found, UNSETTLED]
    dyn.recursions.launch(unsettled.mark_unsettled, dyn.worlds, read, [status])


def pull_back(
    dyn: Dynamics,
    back: Callable[..., None],
    results: dict[str, wp.array],
    passes: int,
    q_cotangent: wp.array,
    qd_cotangent: wp.array,
    qdd: wp.array,
    **given: Any,
) -> None:
    """Launch the gradients of a step that is made in rounds.

    Args:
        back: ``back(results, passes, **given)`` launches those of passes between kicks.
        results: arrays to fill, by name of what they are gradients by. passes: of the last round.
        qdd: that the step found. given: arguments of the step.
    """
    q, qd, dt = given.pop("q"), given.pop("qd"), given.pop("dt")
    rounds, h, launch = run(dyn, dt, q, qd, states=True, **given), 0.5 * dt, dyn._engine.launch_routine

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

    for array in results.values():
        launches.fill(array, 0)
    extra = {"q": q, "qd": qd, START: q, KICK: qd}
    parts = {name: like(array, "step", name) for name, array in (results | extra).items()}
    kinds = [name for name in ("q", "qd", "value") if name == "q" or name in parts]
    by_kicked, rates, gains, still = like(qd, "kicked"), like(qd, "rates"), like(qd, "gains"), like(q, "still")
    launches.fill(by_kicked, 0)
    launches.fill(still, 0)
    after, cotangents = combine(dt, qdd, 1.0, qd, like(qd, "after")), (q_cotangent, qd_cotangent)
    for number, one in reversed([*enumerate(rounds)]):
        combine(1.0, qd, 1.0, one.kick, rates)  # before the passes
        combine(1.0, after, -1.0, one.kick, gains)
        combine(1.0 / dt, gains, -1.0 / dt, rates, gains)
        ends = {"q_cotangent": cotangents[0], "qd_cotangent": cotangents[1], "qdd": gains}
        count = passes if number == len(EARLY) else EARLY[number]
        back(parts, count, qd=qd, dt=dt, **one.step(q), **given, **ends)
        for name in results.keys() - {"q"}:
            add(name, parts[name])
        add("q", parts[START])
        by_rates = moved_back(rates, parts["q"])
        add("qd", by_rates)
        by_kick = combine(1.0, parts[KICK], 1.0, by_rates, parts[KICK])
        combine(1.0, by_kick, 1.0, by_kicked, by_kick)

        # k = h acc / 2 with Mass acc + c(a) - c(b) = 0; of c(a) and c(b) gravity counts twice, and cancels
        solved, acc = like(qd, "solved"), combine(1.0 / h, one.kick, 0.0, one.kick, like(qd, "acc"))
        dyn._engine.launch(SOLVE_MASS_MATRIX, solved, q=one.half, b=by_kick)
        found: list[dict[str, wp.array]] = []
        for sign, at, accelerates in ((-h, one.a, {"qdd": acc}), (h, one.b, {})):
            weighed = combine(sign, solved, 0.0, solved, like(qd, "weighed"))
            ways = {name: like(parts[name], "terms", name, sign) for name in kinds}
            more = {f"{name}_bar": way for name, way in ways.items() if name != "q"}
            state = {"q": one.half, "qd": at, **accelerates, "cotangent": weighed}
            launch(WAY_BACK, ways["q"], more, **state, wrt=tuple(ways))
            found.append(ways)
        (along, across), by_half, by_u, by_v = found, like(q, "half"), like(qd, "u"), like(qd, "v")
        if "value" in results:
            add("value", along["value"])
            add("value", across["value"])
        combine(1.0, along["q"], 1.0, across["q"], by_half)
        combine(1.0, one.a, -1.0, one.b, rates)  # v
        combine(0.5, along["qd"], -0.5, across["qd"], by_v)
        combine(1.0, by_v, 1.0, moved_back(rates, by_half), by_v)
        combine(0.5, along["qd"], 0.5, across["qd"], by_u)
        by_found = combine(1.0, by_u, 0.5, by_v, like(qd, "found"))
        combine(-1.0, by_u, 0.0, by_u, by_kicked)
        add("qd", by_v, 0.5)
        after, cotangents = one.found, (still, by_found)
    add("qd", by_found)  # the first round found the rates before the step
