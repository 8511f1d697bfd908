"""Loops by Lagrange multipliers, as traces: Mass qdd + bias_force = tau + Y* lambda, Y qdd + Y' qd = 0.

With qdd(0) the accelerations of the open tree, (Y Mass^-1 Y*) lambda = -(Y qdd(0) + Y' qd); the tree then moves under
tau + Y* lambda. Y touches only what lies between a loop's ends; loops may span the robot and reach the inertial frame.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ...trace.emission import Store
from ...trace.scalars import Value
from ...trace.spatial import ZERO, Vector, total
from .. import articulated
from ..motion import STILL
from ..traced import pivots
from .closures import opened
from .clusters import Columns
from .embedded import Embedded


class Multipliers(Embedded):
    """The operations of :class:`Embedded`, and those of a scene whose loops are open but for multipliers."""

    def rows(self) -> list[Columns]:
        """Y, each row by dof; after the links are placed."""
        self.graph.step = "loops|y"
        found = [row for constraint in self.constraints for row in constraint.jacobian(self.places)]
        return [{dof: x for dof, x in row.items() if not (x.__class__ is float and x == 0.0)} for row in found]

    def loop_system(self, tau: Callable[[int], Value] | None = None) -> list[Store]:
        """out [row, row] = Y Mass^-1 Y*; right [row] = Y qdd(0) + Y' qd; size [row]; for ``tau`` or the array."""
        moves = "qd" in self.given
        done, rates, _ = self.reduce(tau or self.vector("tau"), moves, loads=True)
        open_ = {item.index[0]: item.value for item in self.expand(done, rates, self.base)}
        qd = self.vector("qd") if moves else None
        self.graph.step = "loops|g"
        right = [a for c in self.constraints for a in c.acceleration(self.places, qd, open_.__getitem__)]
        halves = {}
        for i, row in enumerate(self.rows()):
            self.graph.step = f"loop row {i}|m"
            halves[i] = self._loaded(done, row)
        stores = self._both(self._sandwich(*pivots(done), halves))
        return stores + [Store("right", (i,), value) for i, value in enumerate(right)] + self._sizes()

    def _sizes(self) -> list[Store]:
        """size [row]: the square of what each row is a projection of"""
        sizes = [size for c in self.constraints for size in c.sizes(self.places)]
        return [Store("size", (i,), value) for i, value in enumerate(sizes)]

    def _loaded(self, done: dict[int, articulated.Factor], tau: Columns) -> dict[int, list[Value]]:
        """D^-1 [I - H psi K] tau, by link."""
        rates: dict[int, list[Value]] = {}
        forces: dict[int, Vector] = {}
        for link in reversed(self.links.links):
            below = [forces[id(child)] for child in link.children if id(child) in forces]
            right: list[Any] = [tau.get(dof, 0.0) for dof in link.dofs]
            if not below and not any(dof in tau for dof in link.dofs):
                continue
            force = Vector(total(other[c] for other in below) for c in range(6)) if below else Vector((*ZERO, *ZERO))
            key = id(link)
            rates[key], forces[key] = articulated.reduced(link, self.places[key], done[key], STILL, force, right)
        return rates

    def loop_forward_dynamics(self) -> list[Store]:
        """out [dof] = Mass^-1 (tau + Y* lambda - bias_force), lambda the array "multipliers"."""
        self.place_links("qd" in self.given)
        tau, given = self.vector("tau"), self.vector("multipliers")
        loads = self._combined(given)
        done, rates, _ = self.reduce(lambda dof: tau(dof) + loads.get(dof, 0.0), "qd" in self.given, loads=True)
        return self.expand(done, rates, self.base)

    def _combined(self, weights: Any) -> Columns:
        """Y* weights"""
        found: Columns = {}
        for i, row in enumerate(self.rows()):
            for dof, x in row.items():
                found[dof] = found.get(dof, 0.0) + x * weights(i)
        return found

    # -- projection ------------------------------------------------------------------------------------------------
    def closure_system(self, rates: bool = False) -> list[Store]:
        """out [row, row] = Y Y*; right [row] = g, or Y qd; size [row]"""
        self.place_links()
        rows = self.rows()
        if rates:
            qd = self.vector("qd")
            right = [total(x * qd(dof) for dof, x in row.items()) for row in rows]
        else:
            right = [g for c in self.constraints for g in c.error(self.places, self.vector("q"))]
        stores = [Store("right", (i,), value) for i, value in enumerate(right)] + self._sizes()
        for i, row in enumerate(rows):
            for j, other in enumerate(rows[: i + 1]):
                value = total(x * other[dof] for dof, x in row.items() if dof in other)
                stores += [Store("out", place, value) for place in {(i, j), (j, i)}]
        return stores

    def closure_step(self, rates: bool = False) -> list[Store]:
        """out = q moved, or qd changed, by Y* times the array "multipliers"."""
        self.place_links()
        step = self._combined(self.vector("multipliers"))
        if rates:
            qd = self.vector("qd")
            return [Store("out", (dof,), qd(dof) + step.get(dof, 0.0)) for dof in range(self.links.scene.dof_count)]
        return self.moved_all(step)

    def closures_open(self) -> list[Store]:
        """out [1] = how many rows are open"""
        self.place_links()
        return [Store("out", (0,), opened(self.constraints, self.places, self.vector("q"), self.vector("qd")))]
