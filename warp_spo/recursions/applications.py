"""The paper's applications as traces: operations that have no other form than a kernel of their scene."""

from __future__ import annotations

from ..trace.emit import Store
from ..trace.graph import Value
from ..trace.spatial import Articulated, Vector
from . import articulated, hybrid
from .hybrid import Given
from .traced import Trace


class Applications(Trace):
    """The operations of :class:`Trace`, and those beyond them."""

    # -- hybrid dynamics -------------------------------------------------------------------------------------------
    def hybrid_dynamics(self, held: tuple[bool, ...] | None = None) -> list[Store]:
        """out = qdd, tau_out = tau: dofs under the mask follow qdd, the others tau.

        Args:
            held: the mask, if it is constant; otherwise the array "prescribed" is it.
        """
        mask = self.vector("prescribed") if held is None else lambda dof: float(held[dof])
        tau, qdd, moves = self.vector("tau"), self.vector("qdd"), "qd" in self.given
        given: dict[int, Given] = {}
        done: dict[int, articulated.Factor] = {}
        rates: dict[int, list[Value]] = {}
        heads: dict[int, list[Value]] = {}
        inner: dict[int, Articulated] = {}
        forces: dict[int, Vector] = {}
        for link, outward in self.traversal():
            key = id(link)
            if outward:
                self.place(link, moves)
                continue
            self.at(link, "P")
            place, move = self.places[key], self.motions[key]
            carried = [inner[id(child)] for child in link.children]
            through = [(self.places[id(child)].pose, done[id(child)].P) for child in link.children]
            given[key] = known = Given(*([entry(dof) for dof in link.dofs] for entry in (mask, tau, qdd)))
            if known.free:
                done[key] = articulated.factor(link, place, carried, through, self.epsilon)
            else:
                done[key] = hybrid.factor(link, place, known.mask, carried, through, self.epsilon)
            inner[key] = done[key].in_parent
            self.at(link, "z")
            z = articulated.gyroscopic(link.inertia, move) - self.external(link)
            for child in link.children:
                z = z + forces[id(child)]
            if known.free:
                rates[key], forces[key] = articulated.reduced(link, place, done[key], move, z, known.tau)
            else:
                rates[key], heads[key], forces[key] = hybrid.reduced(link, place, done[key], move, z, known)
        alpha: dict[int, tuple[Vector, Vector]] = {}
        stores: list[Store] = []
        for link in self.links.links:
            self.at(link, "a")
            key = id(link)
            above = self.base if link.parent is None else alpha[id(link.parent)]
            known, place, move = given[key], self.places[key], self.motions[key]
            if known.free:
                forward, alpha[key] = articulated.expanded(link, place, done[key], rates[key], move, above)
                inverse = known.tau
            else:
                forward, inverse, alpha[key] = hybrid.expanded(
                    link, place, done[key], rates[key], heads[key], move, above, known
                )
            for dof, a, force in zip(link.dofs, forward, inverse, strict=True):
                stores += [Store("out", (dof,), a), Store("tau_out", (dof,), force)]
        return stores
