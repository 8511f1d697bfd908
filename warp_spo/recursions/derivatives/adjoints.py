"""Products with the Jacobians of the dynamics, J* y and J x, as traces.

Backwards through forward dynamics is forward dynamics' own solve and one Newton-Euler recursion in reverse: with
lambda = Mass^-1 y, J* y is lambda for tau and -(d tau / d x)* lambda at the accelerations for every other argument x.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

from ...trace.differentiation import forward, reverse
from ...trace.emission import Store
from ...trace.scalars import Scalar, Value, ordered
from ...trace.spatial import ZERO, Vector, cross, total
from ..impedance import Impedance
from ..integration import moved
from ..links import BALL, FREE, SCREW_MOTIONS, Link
from .inverse_dynamics import Derivatives
from .power import Entry, Power, Ways

COORDINATES = {BALL: 4, FREE: 7}  # of a hinge; of the others one each


class Adjoints(Derivatives):
    """The operations of :class:`Derivatives`, and products with Jacobians.

    A result is "out" if it is the first of those asked for, and ``name_bar`` otherwise.
    """

    weightless = False

    @property
    def base(self) -> tuple[Vector, Vector]:
        return (ZERO, ZERO) if self.weightless else super().base

    # -- backwards -------------------------------------------------------------------------------------------------
    def inverse_dynamics_vjp(self, wrt: tuple[str, ...]) -> list[Store]:
        """J* cotangent of inverse dynamics for the arguments ``wrt``"""
        power = Power(self, self.vector("cotangent"), self.vector("qdd"))
        return power.stores + self._named_stores(power.ways, wrt, wrt)

    def forward_dynamics_vjp(self, wrt: tuple[str, ...]) -> list[Store]:
        """J* cotangent of forward dynamics for the arguments ``wrt``

        "qdd" is what it makes, and "solved" Mass^-1 cotangent, where they are given.
        """
        if "qdd" in self.given:
            qdd = self.vector("qdd")
        else:
            qdd = {item.index[0]: item.value for item in self.forward_dynamics()}.__getitem__
        solved = self.vector("solved") if "solved" in self.given else self.solved("cotangent").__getitem__
        power = Power(self, lambda dof: -solved(dof), qdd)
        others = tuple(name for name in wrt if name != "tau")
        stores = power.stores + self._named_stores(power.ways, others, wrt)
        dofs = [dof for link in self.outward for dof in link.dofs] if "tau" in wrt else []
        return stores + [Store(_named("tau", wrt), (dof,), solved(dof)) for dof in dofs]

    def solve_mass_matrix_vjp(self, wrt: tuple[str, ...]) -> list[Store]:
        """J* cotangent of Mass^-1 b, which is "qdd": lambda for b, -(d (Mass qdd) / d x)* lambda for the others"""
        solved, self.weightless = self.solved("cotangent"), True
        power = Power(self, lambda dof: -solved[dof], self.vector("qdd"))
        stores = self._named_stores(power.ways, tuple(name for name in wrt if name != "b"), wrt)
        return stores + [Store(_named("b", wrt), (dof,), solved[dof]) for dof in solved if "b" in wrt]

    def body_poses_vjp(self, wrt: tuple[str, ...]) -> list[Store]:
        """J* cotangent of body_poses"""
        return self._of_stores(self.body_poses(), wrt)

    def body_velocities_vjp(self, wrt: tuple[str, ...]) -> list[Store]:
        """J* cotangent of body_velocities"""
        return self._of_stores(self.body_velocities(), wrt)

    def mass_matrix_vjp(self, wrt: tuple[str, ...]) -> list[Store]:
        """J* cotangent of mass_matrix, both triangles"""
        return self._of_stores(self.mass_matrix(), wrt)

    def jacobian_vjp(self, frames: tuple, wrt: tuple[str, ...]) -> list[Store]:
        """J* cotangent of jacobian"""
        return self._of_stores(self.jacobian(frames), wrt)

    def _of_stores(self, results: list[Store], wrt: tuple[str, ...]) -> list[Store]:
        seeds = [self.graph.input("cotangent", *item.index) for item in results]
        return self._reversed([item.value for item in results], seeds, wrt, wrt)

    def integrate_vjp(self, wrt: tuple[str, ...]) -> list[Store]:
        """J* cotangent of integrate"""
        return self._of_stores(self.integrate(), wrt)

    def step_vjp(self, wrt: tuple[str, ...]) -> list[Store]:
        """J* (q_cotangent; qd_cotangent) of a step whose accelerations are "qdd".

        qd' = qd + dt qdd, and q' moves along qd'. qdd solves Mass qdd + bias_force = tau + f(dt qdd), f the forces of
        the hinges; so its cotangent goes through (Mass + dt R)^-1, R the slope of f in the pieces that held, and then
        through the equation, in which qdd stays.
        """
        qdd, qd, h = self.vector("qdd"), self.vector("qd"), self.graph.input("dt", 0)
        pushed = self.vector("q_cotangent"), self.vector("qd_cotangent")
        links = self.links.links
        dofs = [dof for link in links for dof in link.dofs]
        after = {dof: qd(dof) + h * qdd(dof) for dof in dofs}
        state = [Store("out", (dof,), rate) for dof, rate in after.items()]
        for link in links:
            self.at(link, "q")
            values = moved(link, self.vector("q"), after.__getitem__, h)
            state += [Store("q_out", (link.coordinate + c,), value) for c, value in enumerate(values)]
        state = self.put_back(state)
        seeds = [pushed[item.array == "out"](item.index[0]) for item in state]
        results = [item.value for item in state]
        ends = [x for x in ordered(results, after.values()) if x.op == "input" and x.args[0] != "dt"]
        back = reverse(results, [*after.values(), *ends], seeds)
        found = dict(zip((x.args for x in ends), back[len(dofs) :], strict=True))
        rates = dict(zip(dofs, back, strict=False))
        impedance = Impedance(
            self.links,
            h,
            self.vector("q"),
            qd,
            None,
            self.vector("target_q") if "target_q" in self.given else None,
            self.vector("target_qd"),
        )
        forces: dict[int, Value] = {}
        stiff: dict[int, Value] = {}

        def stiffened(link: Link) -> Link:
            for dof, laws in zip(link.dofs, impedance.laws(link), strict=True):
                u = h * qdd(dof)
                forces[dof] = total(law.at(u) for law in laws)
                stiff[dof] = h * total(law.piece(u).resistance for law in laws)
            armature = (a + stiff[dof] for a, dof in zip(link.armature, link.dofs, strict=True))
            return dataclasses.replace(link, armature=tuple(armature))

        self.stiffened = stiffened
        solved, tau = self.solved(lambda dof: h * rates[dof]), self.vector("tau")
        right = {dof: h * rates[dof] - stiff[dof] * solved[dof] for dof in dofs}
        ways = self.ways(solved, qdd, lambda dof: tau(dof) + forces[dof], right.__getitem__)
        inputs = [x for x in ordered(forces.values()) if x.op == "input"]
        back = reverse(forces.values(), inputs, [solved[dof] for dof in forces])
        for entry, way in [*ways.items(), *zip((x.args for x in inputs), back, strict=True)]:
            found[entry] = found.get(entry, 0.0) + way
        for dof in dofs:
            found["qd", dof] = found.get(("qd", dof), 0.0) + rates[dof]
            found["tau", dof] = solved[dof]
        return [Store(_named(name, wrt), index, value) for name in wrt for index, value in self.entries(name, found)]

    def put_back(self, stores: list[Store]) -> list[Store]:
        """A state after a step, "q_out" and "out", with what constrains it seen to."""
        return stores

    def ways(self, solved: dict[int, Value], qdd: Entry, tau: Entry, right: Entry) -> Ways:
        """How solved . (tau - Mass qdd - bias_force) changes with what tau does not hold; Mass solved = ``right``."""
        return Power(self, lambda dof: -solved[dof], qdd).ways

    def solved(self, right: str | Entry) -> dict[int, Value]:
        """Mass^-1 times an array, by dof."""
        entry = self.vector(right) if isinstance(right, str) else right
        done, rates, _ = self.reduce(entry, moves=False, loads=False)
        return {item.index[0]: item.value for item in self.expand(done, rates, (ZERO, ZERO))}

    def _named_stores(self, found: dict[tuple, Value], wrt: tuple[str, ...], names: tuple[str, ...]) -> list[Store]:
        stores = []
        for name in wrt:
            entries = self.tangent(found) if name == "tangent" else self.entries(name, found)
            stores += [Store(_named(name, names), index, value) for index, value in entries]
        return stores

    def _reversed(
        self, outputs: list[Value], seeds: list[Value], wrt: tuple[str, ...], names: tuple[str, ...]
    ) -> list[Store]:
        inputs = [x for x in ordered(outputs) if x.op == "input"]
        found = dict(zip((x.args for x in inputs), reverse(outputs, inputs, seeds), strict=True))
        return self._named_stores(found, wrt, names)

    def entries(self, name: str, found: dict[tuple, Value]) -> Iterable[tuple[tuple[int, ...], Value]]:
        """(index, gradient) of every entry of an argument, or of "value"; zero where it does not enter."""
        if name == "body_f":
            places: list[tuple] = [(body, c) for body in range(self.links.scene.body_count) for c in range(6)]
        elif name == "value":
            places = [(i,) for i in range(len(self.links.tables["value"]))]
        elif name in ("q", "target_q"):
            places = [(link.coordinate + c,) for link in self.outward for c in range(COORDINATES.get(link.motion, 1))]
        else:
            places = [(dof,) for link in self.outward for dof in link.dofs]
        return [(place, found.get((name, *place), 0.0)) for place in places]

    def tangent(self, found: dict[tuple, Value]) -> list[tuple[tuple[int, ...], Value]]:
        """The gradient by q along the tangent coordinates."""
        entries: list[tuple[tuple[int, ...], Value]] = []
        for link in self.outward:
            self.at(link, "g")
            first = link.coordinate
            g = [found.get(("q", first + i), 0.0) for i in range(7)]
            if link.motion in SCREW_MOTIONS:
                entries.append(((link.dofs[0],), g[0]))
                continue
            at = first + (3 if link.motion == FREE else 0)
            (*u, w), (*g_u, g_w) = self.quaternion(at), g[at - first : at - first + 4]
            turn = (Vector(g_u) * w + cross(u, g_u) - Vector(u) * g_w) * 0.5
            if link.motion == FREE:
                turn = turn - cross(self.arm(link), g[:3])
                entries += [((dof,), value) for dof, value in zip(link.dofs[:3], g[:3], strict=True)]
            entries += [((dof,), value) for dof, value in zip(link.dofs[-3:], turn, strict=True)]
        return entries

    # -- forwards --------------------------------------------------------------------------------------------------
    def inverse_dynamics_jvp(self) -> list[Store]:
        """out = J x of inverse dynamics, x in the arrays "q_dot" (tangent), "qd_dot", "qdd_dot", "body_f_dot\""""
        return [Store("out", (dof,), value) for dof, value in self._pushed_forward().items()]

    def forward_dynamics_jvp(self) -> list[Store]:
        """out = J x of forward dynamics at the accelerations "qdd", x with "tau_dot" for "qdd_dot\""""
        rates, tau = self._pushed_forward(), self.vector("tau_dot")
        solved = self.solved(lambda dof: tau(dof) - rates[dof])
        return [Store("out", (dof,), value) for dof, value in solved.items()]

    def _pushed_forward(self) -> dict[int, Value]:
        tau = self.inverse_dynamics()
        outputs = [item.value for item in tau]
        return {item.index[0]: rate for item, rate in zip(tau, self.along(outputs), strict=True)}

    def along(self, outputs: list[Value], still: Iterable[Scalar] = ()) -> list[Value]:
        """How values change along the direction; what is ``still`` does not."""
        still = list(still)
        inputs = [x for x in ordered(outputs, still) if x.op == "input"]
        raw = self.raw(self.vector("q_dot"))
        seeds = [raw.get(x.args[1], 0.0) if x.args[0] == "q" else self._seed(x) for x in inputs]
        return forward(outputs, [*inputs, *still], [*seeds, *[0.0] * len(still)])

    def _seed(self, x: Scalar) -> Value:
        name, *index = x.args
        return self.graph.input(f"{name}_dot", *index) if f"{name}_dot" in self.given else 0.0

    def raw(self, rate: Entry) -> dict[int, Value]:
        """How the entries of q change along tangent coordinates."""
        found = {}
        for link in self.links.links:
            self.at(link, "g")
            x = Vector(rate(dof) for dof in link.dofs)
            if link.motion in SCREW_MOTIONS:
                found[link.coordinate] = x[0]
                continue
            at, turn = link.coordinate, Vector(x[-3:]) * 0.5
            if link.motion == FREE:
                moved = Vector(x[:3]) - cross(x[3:], self.arm(link))
                found |= {at + i: value for i, value in enumerate(moved)}
                at += 3
            *u, w = self.quaternion(at)
            turned = (*(turn * w + cross(turn, u)), -sum((a * b for a, b in zip(turn, u, strict=True)), 0.0))
            found |= {at + i: value for i, value in enumerate(turned)}
        return found

    # -- hinges ----------------------------------------------------------------------------------------------------
    def quaternion(self, first: int) -> list[Value]:
        q = self.vector("q")
        return [q(first + i) for i in range(4)]

    def arm(self, link: Link) -> Vector:
        """From the anchor of a free hinge to the centre of mass, in the parent anchor's axes."""
        return self.places[id(link)].turned @ link.com  # type: ignore[operator]


def _named(name: str, wrt: tuple[str, ...]) -> str:
    return "out" if name == wrt[0] else f"{name}_bar"
