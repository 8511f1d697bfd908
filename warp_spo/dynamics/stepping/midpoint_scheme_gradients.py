"""Gradients of a step of the midpoint scheme, in reverse mode: from the final kick to the first one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

from ...kernels import combination
from ...recursions.contact.velocity_kicks import KICK, PATH, START
from ...runtime import launches
from ..inertia import SOLVE_MASS_MATRIX
from ..inverse_dynamics import PULLBACK
from . import midpoint_scheme

if TYPE_CHECKING:
    from collections.abc import Callable

    from ..dynamics import Dynamics


def backpropagate(
    dyn: Dynamics,
    back: Callable[..., None],
    results: dict[str, wp.array],
    passes: int,
    rounds: int,
    q_cotangent: wp.array,
    qd_cotangent: wp.array,
    **given: Any,
) -> None:
    """Launch the gradients of a step of the midpoint scheme.

    Args:
        back: ``back(results, passes, **given)`` launches those of passes between kicks.
        results: arrays to fill, by name of what they are gradients by. passes: of an iteration. rounds: how many
            iterations. given: arguments of the step, and "qdd" that it found, which is found anew.
    """
    q, qd, dt, _ = (given.pop(name) for name in ("q", "qd", "dt", "qdd"))
    iterations = midpoint_scheme.run(
        dyn, dt, q, qd, rounds, given | {"passes": float(passes), "reports": ()}, {}, {}, gains=True
    )
    end = midpoint_scheme.begin_iteration(dyn, dt, q, qd, iterations)
    for array in results.values():
        launches.fill(array, 0)
    adjoint, still = MidpointAdjoint(dyn, dt, q, qd, results), dyn.recursions.array(("way back", "still"), *q.shape)
    launches.fill(still, 0)
    last = adjoint.combine(2.0, qd_cotangent, 0.0, qd_cotangent, adjoint.like(qd, "last"))  # of qd'
    adjoint.backpropagate_kick(end, last)
    adjoint.combine(1.0, adjoint.by_previous_rates, 1.0, qd_cotangent, adjoint.by_previous_rates)
    adjoint.combine(1.0, adjoint.by_previous_kick, -2.0, qd_cotangent, adjoint.by_previous_kick)
    by_q = q_cotangent
    for one in reversed(iterations):
        ends = {"q_cotangent": by_q, "qd_cotangent": adjoint.by_previous_rates, "qdd": one.gained}
        back(adjoint.parts, passes, qd=qd, dt=dt, **one.step(q), **given, **ends)
        adjoint.backpropagate_passes(one)
        by_q = still
    adjoint.add("qd", adjoint.by_previous_rates)  # previous_rates of the first iteration are qd


class MidpointAdjoint:
    """Reverse mode of one step: the gradients that have been added up, and those that are still passed on.

    Args:
        dyn: the dynamics. dt: length of the step. q, qd: state before it. results: gradients to fill, by name.

    Attributes:
        parts: gradients by the inputs of the passes. by_previous_rates, by_previous_kick: gradients by the rates and
            the kick of the previous iteration.
    """

    def __init__(self, dyn: Dynamics, dt: float, q: wp.array, qd: wp.array, results: dict[str, wp.array]):
        self.dyn, self.h, self.q, self.qd, self.results = dyn, 0.5 * dt, q, qd, results
        extra = {"q": q, "qd": qd, START: q, KICK: qd, PATH: qd}
        self.parts = {name: self.like(array, "step", name) for name, array in (results | extra).items()}
        self.kinds = [name for name in ("q", "qd", "value") if name == "q" or name in self.parts]
        self.by_previous_rates, self.by_previous_kick = self.like(qd, "found"), self.like(qd, "kicked")

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

    def backpropagate_passes(self, one: midpoint_scheme.MidpointIteration) -> None:
        """Add ``parts`` of an iteration's passes, and backpropagate its kick."""
        for name in self.results.keys() - {"q"}:
            self.add(name, self.parts[name])
        self.add("q", self.parts[START])
        by_kick = self.combine(1.0, self.parts[KICK], 1.0, self.by_previous_kick, self.like(self.qd, "by kick"))
        self.backpropagate_kick(one, by_kick, self.parts["q"], self.parts[PATH])

    def backpropagate_kick(
        self,
        one: midpoint_scheme.MidpointIteration,
        by_kick: wp.array,
        by_half: wp.array | None = None,
        by_path: wp.array | None = None,
    ) -> None:
        """Add the gradient by q and qd of a kick, from those by its results; set those by its inputs."""
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
        self.combine(1.0, by_u, 1.0, self._backpropagate_half_step(one.path, half), by_u)
        self.combine(1.0, by_u, 0.5, by_v, self.by_previous_rates)
        self.combine(-1.0, by_u, 0.0, by_u, self.by_previous_kick)
        self.add("qd", by_v, 0.5)

    def _terms(self, one: midpoint_scheme.MidpointIteration, by_kick: wp.array) -> list[dict[str, wp.array]]:
        """Return the gradients by what a kick is made of: along u + v, and along u - v.

        k = h acc / 2 with Mass acc + c(a) - c(b) = 0; of c(a) and c(b) gravity counts twice, and cancels.
        """
        combine, like, qd = self.combine, self.like, self.qd
        v = combine(0.5, qd, 0.5, one.previous_rates, like(qd, "v"))
        a, b = (combine(0.5, one.path, sign, v, like(qd, "rates", sign)) for sign in (0.5, -0.5))
        solved = like(qd, "solved")
        acc = combine(1.0 / self.h, one.kick, 0.0, one.kick, like(qd, "acc"))
        self.dyn._engine.launch(SOLVE_MASS_MATRIX, solved, q=one.q, b=by_kick)
        found: list[dict[str, wp.array]] = []
        for sign, at, accelerates in ((-self.h, a, {"qdd": acc}), (self.h, b, {})):
            weighed = combine(sign, solved, 0.0, solved, like(qd, "weighed"))
            gradients: dict[str, wp.array] = {name: like(self.parts[name], "terms", name, sign) for name in self.kinds}
            more = {f"{name}_bar": adjoint for name, adjoint in gradients.items() if name != "q"}
            state = {"q": one.q, "qd": at, **accelerates, "cotangent": weighed}
            self.dyn._engine.launch_routine(PULLBACK, gradients["q"], more, **state, wrt=tuple(gradients))
            found.append(gradients)
        return found

    def _backpropagate_half_step(self, rates: wp.array, cotangent: wp.array) -> wp.array:
        """Add the gradient by q of q moved along the rates for half a step; return that by the rates."""
        gradients = {"q": self.like(self.q, "moved q"), "qd": self.like(self.qd, "moved")}
        if "value" in self.results:  # rates of a free base are those of its centre of mass
            gradients["value"] = self.like(self.results["value"], "moved value")
        more = {f"{name}_bar": adjoint for name, adjoint in gradients.items() if name != "q"}
        state = {"q": self.q, "qd": rates, "dt": self.h, "cotangent": cotangent}
        self.dyn._engine.launch_routine(
            midpoint_scheme.INTEGRATE_VJP, gradients["q"], more, **state, wrt=tuple(gradients)
        )
        for name in gradients.keys() - {"qd"}:
            self.add(name, gradients[name])
        return gradients["qd"]
