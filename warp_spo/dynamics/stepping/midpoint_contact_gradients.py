"""The way back through a step that is made in rounds: its gradients, from the last kick to the first one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

from ...kernels import combination
from ...recursions.contact.velocity_kicks import KICK, PATH, START
from ...runtime import launches
from ..inertia import SOLVE_MASS_MATRIX
from ..inverse_dynamics import WAY_BACK
from . import midpoint_contact as rounds

if TYPE_CHECKING:
    from collections.abc import Callable

    from ..dynamics import Dynamics


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
    made = rounds.run(dyn, dt, q, qd, given | {"passes": float(passes), "reports": ()}, {}, {}, gains=True)
    end = rounds.begin(dyn, dt, q, qd, made)
    for array in results.values():
        launches.fill(array, 0)
    way, still = Way(dyn, dt, q, qd, results), dyn.recursions.array(("way back", "still"), *q.shape)
    launches.fill(still, 0)
    last = way.combine(2.0, qd_cotangent, 0.0, qd_cotangent, way.like(qd, "last"))  # qd' = found + 2 (end - kick)
    way.through_kick(end, last)
    way.combine(1.0, way.by_found, 1.0, qd_cotangent, way.by_found)
    way.combine(1.0, way.by_kicked, -2.0, qd_cotangent, way.by_kicked)
    by_q = q_cotangent
    for one in reversed(made):
        ends = {"q_cotangent": by_q, "qd_cotangent": way.by_found, "qdd": one.gained}
        back(way.parts, passes, qd=qd, dt=dt, **one.step(q), **given, **ends)
        way.through_passes(one)
        by_q = still
    way.add("qd", way.by_found)  # the first round found the rates before the step


class Way:
    """The way back through one step: the gradients that have been added up, and those on their way.

    Args:
        dyn: the dynamics. dt: length of the step. q, qd: state before it. results: gradients to fill, by name.

    Attributes:
        parts: gradients by what passes read, which they leave. by_found, by_kicked: by the rates and the kick that the
            round before has found.
    """

    def __init__(self, dyn: Dynamics, dt: float, q: wp.array, qd: wp.array, results: dict[str, wp.array]):
        self.dyn, self.h, self.q, self.qd, self.results = dyn, 0.5 * dt, q, qd, results
        extra = {"q": q, "qd": qd, START: q, KICK: qd, PATH: qd}
        self.parts = {name: self.like(array, "step", name) for name, array in (results | extra).items()}
        self.kinds = [name for name in ("q", "qd", "value") if name == "q" or name in self.parts]
        self.by_found, self.by_kicked = self.like(qd, "found"), self.like(qd, "kicked")

    def like(self, array: wp.array, *key: Any) -> wp.array:
        """Return an array of the same shape, the same one for a key."""
        return self.dyn.recursions.array(("way back", *key), *array.shape)

    def combine(self, a: float, x: wp.array, b: float, y: wp.array, out: wp.array) -> wp.array:
        """Launch out = a x + b y."""
        flat = [one.reshape((self.dyn.worlds, one.size // self.dyn.worlds)) for one in (x, y, out)]
        self.dyn.recursions.launch(combination.combine, flat[2].shape, [a, flat[0], b, flat[1]], [flat[2]])
        return out

    def add(self, name: str, more: wp.array, share: float = 1.0) -> None:
        """Add to a result, if it is asked for."""
        if name in self.results:
            self.combine(1.0, self.results[name], share, more, self.results[name])

    def through_passes(self, one: rounds.Round) -> None:
        """Add what the passes of a round left in ``parts``, and go through its kick."""
        for name in self.results.keys() - {"q"}:
            self.add(name, self.parts[name])
        self.add("q", self.parts[START])
        by_kick = self.combine(1.0, self.parts[KICK], 1.0, self.by_kicked, self.like(self.qd, "by kick"))
        self.through_kick(one, by_kick, self.parts["q"], self.parts[PATH])

    def through_kick(
        self, one: rounds.Round, by_kick: wp.array, by_half: wp.array | None = None, by_path: wp.array | None = None
    ) -> None:
        """Add the gradient by q and qd of a kick, from those by what it leaves; leave those by what it reads."""
        along, across = self._terms(one, by_kick)
        if "value" in self.results:
            self.add("value", along["value"])
            self.add("value", across["value"])
        half = self.combine(1.0, along["q"], 1.0, across["q"], self.like(self.q, "half"))
        by_u = self.combine(0.5, along["qd"], 0.5, across["qd"], self.like(self.qd, "u"))
        by_v = self.combine(0.5, along["qd"], -0.5, across["qd"], self.like(self.qd, "by v"))
        if by_half is not None and by_path is not None:
            self.combine(1.0, half, 1.0, by_half, half)
            self.combine(1.0, by_u, 1.0, by_path, by_u)
        self.combine(1.0, by_u, 1.0, self._pull_half_step(one.path, half), by_u)
        self.combine(1.0, by_u, 0.5, by_v, self.by_found)
        self.combine(-1.0, by_u, 0.0, by_u, self.by_kicked)
        self.add("qd", by_v, 0.5)

    def _terms(self, one: rounds.Round, by_kick: wp.array) -> list[dict[str, wp.array]]:
        """Return the gradients by what a kick is made of: along u + v, and along u - v.

        k = h acc / 2 with Mass acc + c(a) - c(b) = 0; of c(a) and c(b) gravity counts twice, and cancels.
        """
        combine, like, qd = self.combine, self.like, self.qd
        v = combine(0.5, qd, 0.5, one.before, like(qd, "v"))
        a, b = (combine(0.5, one.path, sign, v, like(qd, "rates", sign)) for sign in (0.5, -0.5))
        solved = like(qd, "solved")
        acc = combine(1.0 / self.h, one.kick, 0.0, one.kick, like(qd, "acc"))
        self.dyn._engine.launch(SOLVE_MASS_MATRIX, solved, q=one.q, b=by_kick)
        found: list[dict[str, wp.array]] = []
        for sign, at, accelerates in ((-self.h, a, {"qdd": acc}), (self.h, b, {})):
            weighed = combine(sign, solved, 0.0, solved, like(qd, "weighed"))
            ways: dict[str, wp.array] = {name: like(self.parts[name], "terms", name, sign) for name in self.kinds}
            more = {f"{name}_bar": way for name, way in ways.items() if name != "q"}
            state = {"q": one.q, "qd": at, **accelerates, "cotangent": weighed}
            self.dyn._engine.launch_routine(WAY_BACK, ways["q"], more, **state, wrt=tuple(ways))
            found.append(ways)
        return found

    def _pull_half_step(self, rates: wp.array, cotangent: wp.array) -> wp.array:
        """Add the gradient by q of q moved along the rates for half a step; return that by the rates."""
        ways = {"q": self.like(self.q, "moved q"), "qd": self.like(self.qd, "moved")}
        if "value" in self.results:  # rates of a free base are those of its centre of mass
            ways["value"] = self.like(self.results["value"], "moved value")
        more = {f"{name}_bar": way for name, way in ways.items() if name != "q"}
        state = {"q": self.q, "qd": rates, "dt": self.h, "cotangent": cotangent}
        self.dyn._engine.launch_routine(rounds.INTEGRATE_VJP, ways["q"], more, **state, wrt=tuple(ways))
        for name in ways.keys() - {"qd"}:
            self.add(name, ways[name])
        return ways["qd"]
