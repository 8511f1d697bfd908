"""Steps with contacts whose velocity terms are those in the middle of the step: their rounds, and the way back.

From MANY passes on a step begins with rounds of EARLY passes each. The first sees the velocity terms half way along the
rates before the step, each later one those along the mean of these rates and of what the round before found, see
:mod:`warp_spo.recursions.contact.middle`. The passes that the caller asks for come last.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import warp as wp

from .. import launches
from ..execution.routine import Routine
from ..kernels import combination
from ..recursions.contact import step as contact
from ..recursions.contact.middle import FOUND, MEAN, MIDDLE, middle_bias
from ..recursions.derivatives import middle
from ..scene.scene import Scene

if TYPE_CHECKING:
    from collections.abc import Callable

    from .dynamics import Dynamics

MANY = 4  # passes from which on a step begins with rounds
EARLY = (3, 3)  # passes of each round
CONTACT_STEP = Routine("contact_step", contact.step, letters="PzafSE", passes=True, counted=True, wide=True)
BIAS = Routine("middle_bias", middle_bias, letters="z", short=True)


def _divides(scene: Scene, inputs: Any, apart: bool, **_: Any) -> bool:
    return apart


BIAS_VJP = Routine("middle_bias_vjp", middle.middle_bias_vjp, letters="B", divides=_divides)


class Round(NamedTuple):
    """What a round of a step reads and finds, [world, dof].

    Attributes:
        before, found_before: the mean v and qd' of the round before; of the first round, qd.
        mean, bias: v of this round, and the velocity terms there. found: qd' of this round; None: it is the last one.
        middle: q half way along v, where asked for.
    """

    before: wp.array
    found_before: wp.array
    mean: wp.array
    bias: wp.array
    found: wp.array | None
    middle: wp.array | None = None


def taken(scene: Scene, passes: float) -> bool:
    """Return whether a step of so many passes begins with rounds; one with pairs of bodies does not."""
    return passes >= MANY and not scene.contact_pairs


def run(
    dyn: Dynamics,
    dt: float,
    q: wp.array,
    qd: wp.array,
    body_f: wp.array | None,
    poses: bool = False,
    **given: Any,
) -> list[Round]:
    """Launch the rounds of a step, and return them; the last one found only the velocity terms of the step itself.

    Args:
        poses: fill in :attr:`Round.middle`. given: forces and targets by name.
    """
    launch, found = dyn._engine.launch_routine, list[Round]()
    before = found_before = qd
    for number in range(len(EARLY) + 1):
        bias, mean, rates = (dyn.recursions.array((name, number), *qd.shape) for name in (MIDDLE, MEAN, FOUND))
        at = dyn.recursions.array(("way back", MIDDLE, number), *q.shape) if poses else None
        outs = {f"{MEAN}_out": mean} | ({} if at is None else {"q_out": at})
        more = {FOUND: found_before} | ({"poses": True} if poses else {})
        launch(BIAS, bias, outs, q=q, qd=before, dt=dt, body_f=body_f, **more)
        if number == len(EARLY):
            return [*found, Round(before, found_before, mean, bias, None, at)]
        ends = dyn.recursions.array((FOUND, "q"), *q.shape)
        options = {MIDDLE: bias, "passes": float(EARLY[number]), "reports": ()}  # in the order of the step's own call
        launch(CONTACT_STEP, rates, {"q_out": ends}, q=q, qd=qd, dt=dt, **given, **options)
        found.append(Round(before, found_before, mean, bias, rates, at))
        before, found_before = mean, rates
    raise AssertionError("a step has a last round")


def pull_back(
    dyn: Dynamics,
    back: Callable[..., None],
    results: dict[str, wp.array],
    passes: int,
    q_cotangent: wp.array,
    qd_cotangent: wp.array,
    qdd: wp.array,
    body_f: wp.array | None = None,
    **given: Any,
) -> None:
    """Launch the gradients of a step that begins with rounds.

    Args:
        back: ``back(results, passes, **given)`` launches those of a step whose velocity terms are given.
        results: arrays to fill, by name of what they are gradients by. passes: of the last round.
        qdd: that the step found. given: arguments of the step.
    """
    q, qd, dt = given["q"], given["qd"], given["dt"]
    forces = {name: value for name, value in given.items() if name not in ("q", "qd", "dt")}
    rounds = run(dyn, dt, q, qd, body_f, poses=True, **forces)
    entering = [name for name in results if name in ("q", "body_f", "value")]

    def array(*key: Any) -> wp.array:
        return dyn.recursions.array(("way back", *key), *qd.shape)

    def like(name: str, of: str) -> wp.array:
        return dyn.recursions.array(("way back", of, name), *results[name].shape)

    def add(name: str, more: wp.array) -> None:
        flat = [x.reshape((1, x.size)) for x in (results[name], more)]
        dyn.recursions.launch(combination.combine, flat[0].shape, [1.0, flat[0], 1.0, flat[1]], [flat[0]])

    by_bias, by_mean, by_found = array("bias"), array("mean"), array("found")
    launches.fill(by_mean, 0)
    ends = {"q_cotangent": q_cotangent, "qd_cotangent": qd_cotangent, "qdd": qdd}
    back({**results, MIDDLE: by_bias}, passes, **given, **ends, **{MIDDLE: rounds[-1].bias})
    still = dyn.recursions.array(("way back", "q"), *q.shape)
    launches.fill(still, 0)
    for number in reversed(range(len(rounds))):
        one = rounds[number]
        later, by_mean = by_mean, array("mean", number)
        more = {f"{name}_bar": like(name, "bias") for name in entering} | {f"{FOUND}_bar": by_found}
        read = {"q": one.middle, "qd": one.mean, "q_from": q, "qd_from": one.before, FOUND: one.found_before, "dt": dt}
        read |= {"cotangent": by_bias, f"{MEAN}_cotangent": later} | ({} if body_f is None else {"body_f": body_f})
        wrt = ("qd", *entering, FOUND)
        apart = middle.divides(dyn.scene, dyn.variable, read, wrt)
        dyn._engine.launch_routine(BIAS_VJP, by_mean, more, **read, wrt=wrt, apart=apart)
        for name in entering:
            add(name, more[f"{name}_bar"])
        if number == 0:
            if "qd" in results:
                add("qd", by_mean)
                add("qd", by_found)
            return
        before, rates = rounds[number - 1], array("qdd")
        dyn.recursions.launch(combination.combine, qd.shape, [1.0 / dt, before.found, -1.0 / dt, qd], [rates])
        parts = {name: like(name, "step") for name in results}
        ends = {"q_cotangent": still, "qd_cotangent": by_found, "qdd": rates, MIDDLE: before.bias}
        back({**parts, MIDDLE: by_bias}, EARLY[number - 1], **given, **ends)
        for name, part in parts.items():
            add(name, part)
