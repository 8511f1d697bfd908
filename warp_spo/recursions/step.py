"""One time step of a scene, linearly implicit: (Mass + h R) qdd = tau - bias_force + F, and q moved along the new qd.

R and F are what the hinges' laws leave of themselves, see :mod:`.impedance`; where laws bend, a pass solves for the
pieces at its guess of u = qd' - qd and says whether they were the right ones. Passes share one text, run in a loop
until they were: sweeps over the tree, or with few dofs the solution of a system that is formed before the loop.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from ..trace.emit import Store
from ..trace.graph import Value, less, reciprocal, select
from ..trace.spatial import total
from .impedance import Impedance, Law, added
from .integration import coordinate_rates, moved
from .joint_space import JointSpace
from .links import Link
from .traced import Trace

GUESS, GAIN, MISSED = "guess", "gain", "missed"
"""Variables of a loop over passes, zero at first: by dof, the guess of u, and u; whether a guess missed a piece."""
LOOPED = (GUESS, GAIN, MISSED)
SHORT = 10  # dofs up to which passes solve a system that is formed once
NOT_POSITIVE, NOT_FINITE, NOT_SETTLED, CHANGE_POINT = 1, 2, 5, 6  # status words; the first two as warp_spo.status


class Step:
    """The step as a trace.

    The sweep sees the state ``q``, ``qd``. The step starts there too, unless ``q_from`` and ``qd_from`` are given: the
    sweep's state is then a point on the way, at which its laws are taken.
    """

    def __init__(self, trace: Trace):
        self.trace, self.links = trace, trace.links.links
        vector, given = trace.vector, trace.given
        self.h = trace.graph.input("dt", 0)
        apart = "q_from" in given
        self.q, self.qd = (vector("q_from"), vector("qd_from")) if apart else (vector("q"), vector("qd"))
        at = vector("qd")
        self.impedance = Impedance(
            trace.links,
            self.h,
            vector("q"),
            self.qd,
            (lambda dof: self.h * (self.qd(dof) - at(dof))) if apart else None,
            vector("target_q") if "target_q" in given else None,
            vector("target_qd"),
        )
        self.laws: dict[int, list[Law]] = {}  # by dof
        self.forces: dict[int, Value] = {}

    def stores(self, qdd: bool, status: bool) -> list[Store]:
        """out = qd', q_out = q'; with ``qdd`` qdd_out = (qd' - qd) / h, with ``status`` the word of each world."""
        trace = self.trace
        trace.stiffened = self._stiffened
        tau = trace.vector("tau")
        found = self._accelerations(lambda dof: tau(dof) + self.forces[dof])
        gains = {dof: self.h * value for dof, value in found.items()}
        looped = self._looped(gains)
        if looped:
            gains = {dof: trace.graph.input(GAIN, dof) for dof in gains}
        rates_after = {dof: self.qd(dof) + gain for dof, gain in gains.items()}
        stores: list[Store] = []
        for link in self.links:
            trace.at(link, "q")
            stores += [Store("out", (dof,), rates_after[dof]) for dof in link.dofs]
            coordinates = moved(link, self.q, rates_after.__getitem__, self.h)
            stores += [Store("q_out", (link.coordinate + c,), value) for c, value in enumerate(coordinates)]
            if qdd:
                stores += [Store("qdd_out", (dof,), gains[dof] * reciprocal(self.h)) for dof in link.dofs]
        stores = self.put_back(stores)
        if status:
            trace.graph.step = "status|s"
            stores.append(Store("status", (), self._word([item.value for item in stores], bool(looped))))
        return looped + stores

    def _accelerations(self, tau: Callable[[int], Value]) -> dict[int, Value]:
        """qdd by dof for ``tau``, the pieces that hold at the guess in Mass."""
        if self._short:
            return self._in_joint_space(tau)
        done, rates, _ = self.trace.reduce(tau, moves=True, loads=True)
        return {item.index[0]: item.value for item in self.trace.expand(done, rates, self.trace.base)}

    @property
    def _short(self) -> bool:
        """Several passes over few dofs."""
        if self.trace.links.scene.dof_count > SHORT:
            return False
        return any(law.bends for link in self.links for laws in self.impedance.laws(link) for law in laws)

    def _in_joint_space(self, tau: Callable[[int], Value]) -> dict[int, Value]:
        """The same, of a system that is formed once for all passes."""
        system = JointSpace(self.trace)
        pieces: dict[int, Law] = {}
        self.trace.ahead = [*system.mass.values(), *system.bias.values()]
        for link in self.links:
            self.trace.at(link, "r")
            pieces.update(zip(link.dofs, self._pieces(link), strict=True))
        return dict(enumerate(system.solve(lambda dof: self.h * pieces[dof].resistance, tau)))

    def put_back(self, stores: list[Store]) -> list[Store]:
        """The stores with what constrains the state after the step seen to."""
        return stores

    def _unresolved(self) -> Value:
        """Not 0 where constraints lose rank."""
        return 0.0

    def _stiffened(self, link: Link) -> Link:
        pieces = zip(link.armature, self._pieces(link), strict=True)
        return dataclasses.replace(link, armature=tuple(a + self.h * piece.resistance for a, piece in pieces))

    def _pieces(self, link: Link) -> list[Law]:
        """What holds at the guess, of each dof."""
        self.laws |= dict(zip(link.dofs, self.impedance.laws(link), strict=True))
        pieces = [added([law.piece(self._guess(dof)) for law in self.laws[dof]]) for dof in link.dofs]
        self.forces |= {dof: piece.force for dof, piece in zip(link.dofs, pieces, strict=True)}
        return pieces

    def _guess(self, dof: int) -> Value:
        """Of u; what the pass before has found, unless a law asked for another."""
        apart = any(law.least is not None and law.most is not None for law in self.laws[dof])
        return self.trace.graph.input(GUESS if apart else GAIN, dof)

    def _looped(self, gains: dict[int, Value]) -> list[Store]:
        """What a pass leaves behind; nothing if no law bends."""
        if not any(law.bends for laws in self.laws.values() for law in laws):
            return []
        stores, missed = [], []
        for link in self.links:
            self.trace.at(link, "u")
            for dof in link.dofs:
                gain, laws = gains[dof], self.laws[dof]
                stores.append(Store(GAIN, (dof,), gain))
                if not any(law.bends for law in laws):
                    continue
                guess = self._guess(dof)
                missed += [law.missed(guess, gain, self.trace.epsilon) for law in laws]
                if guess.args[0] == GUESS:
                    after = gain
                    for law in laws:
                        after = select(law.skipped(guess, gain), law.middle, after)
                    stores.append(Store(GUESS, (dof,), after))
        return [*stores, Store(MISSED, (0,), total(missed))]

    def _word(self, results: list[Value], looped: bool) -> Value:
        """The worst that is true of the world."""
        trace, scene = self.trace, self.trace.links.scene
        sizes = {"q": scene.coord_count, "target_q": scene.coord_count, "q_from": scene.coord_count}
        inputs = [self.h]
        for name in trace.given:
            if name in ("qd", "tau", "target_qd", "qd_from", *sizes):
                entry = trace.vector(name)
                inputs += [entry(i) for i in range(sizes.get(name, scene.dof_count))]
            if name == "body_f":
                inputs += [trace.graph.input(name, body, c) for body in range(scene.body_count) for c in range(6)]
        settled = less(trace.graph.input(MISSED, 0), 0.5) if looped else 1.0
        word = select(_finite(results), select(settled, 0.0, NOT_SETTLED), NOT_POSITIVE)
        return select(_finite(inputs), select(self._unresolved(), CHANGE_POINT, word), NOT_FINITE)


def _finite(values: list[Value]) -> Value:
    """1 if all are finite, else 0."""
    return less(-1.0, total(v.graph.make("lost", v) for v in values if not isinstance(v, float)))


def hinge_force(trace: Trace) -> list[Store]:
    """out = the forces of all laws as they are at q, qd."""
    impedance = Impedance(trace.links, 0.0, trace.vector("q"), trace.vector("qd"), None,
                          trace.vector("target_q") if "target_q" in trace.given else None, trace.vector("target_qd"))
    stores = []
    for link in trace.links.links:
        trace.at(link, "f")
        for dof, laws in zip(link.dofs, impedance.laws(link), strict=True):
            stores.append(Store("out", (dof,), total(law.at(0.0) for law in laws)))
    return stores


def passive_force(trace: Trace) -> list[Store]:
    """out = -damping qd - stiffness (q - rest)"""
    impedance = Impedance(trace.links, 0.0, trace.vector("q"), trace.vector("qd"))
    stores = []
    for link in trace.links.links:
        trace.at(link, "f")
        stores += [Store("out", (dof,), law.force) for dof, law in zip(link.dofs, impedance.passive(link), strict=True)]
    return stores


def integrate(trace: Trace) -> list[Store]:
    """out = q moved along qd for dt"""
    q, qd, h = trace.vector("q"), trace.vector("qd"), trace.graph.input("dt", 0)
    return _coordinates(trace, lambda link: moved(link, q, qd, h))


def rates(trace: Trace) -> list[Store]:
    """out = dq/dt"""
    return _coordinates(trace, lambda link: coordinate_rates(link, trace.vector("q"), trace.vector("qd")))


def _coordinates(trace: Trace, of: Callable[[Link], list[Value]]) -> list[Store]:
    stores = []
    for link in trace.links.links:
        trace.at(link, "q")
        stores += [Store("out", (link.coordinate + c,), value) for c, value in enumerate(of(link))]
    return stores
