"""The state of one symbolic evaluation of a scene: its inputs and where links are placed.

The recursions are functions of a :class:`Trace` that return what they store. ``label`` names in the emitted code which
link and which letter of the paper a value belongs to.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping

from ...trace.scalars import Entry
from ...trace.spatial import IDENTITY, ZERO, Matrix, Twist, Vector, cross
from .. import motion, newton_euler
from ..motion import STILL, VelocityTerms
from .exchange import Exchange, WholeTree
from .links import Link, LinkPlacement, Links, place_link

EPSILON = {"float32": 2.0**-23, "float64": 2.0**-52}


class Trace:
    """One evaluation of a scene, or of one segment of it: what is shared between the recursions on it.

    Args:
        links: the scene's links.
        dtype: "float32" or "float64"; pivots are compared with its rounding.
        inputs: names of the arrays that are read: "qd", "tau", "qdd", "body_f", "b"; an array that is not among them is
            zero and costs nothing.
        exchange: what the evaluation works on, and its messages to others; None: it takes the whole tree.

    Attributes:
        places: by id of the link: its placement. motions: its velocity terms. axes: its axes in the inertial frame.
        compensates_gravity: external wrenches hold up the bodies' ``gravcomp``, as forces of the hinges do.
        substitutes: entries that take the place of those of an array, by its name.
    """

    def __init__(self, links: Links, dtype: str, inputs: tuple[str, ...], exchange: Exchange | None = None):
        self.links, self.graph, self.epsilon, self.inputs = links, links.graph, EPSILON[dtype], inputs
        self.exchange = WholeTree(links) if exchange is None else exchange
        self.substitutes: dict[str, Entry] = {}
        self.places: dict[int, LinkPlacement] = {}
        self.motions: dict[int, VelocityTerms] = {}
        self.axes: dict[int, Matrix] = {}
        self.compensates_gravity = False
        self.bodies: dict[int, list[int]] = {}  # by link: the bodies whose centre of mass is on it
        for body in links.placements:
            link = links.carrier(body)
            if link is not None:
                self.bodies.setdefault(id(link), []).append(body)

    # -- inputs ----------------------------------------------------------------------------------------------------
    def vector(self, name: str) -> Entry:
        """Return ``entry(i)`` of an array; zero if the array is not among the inputs."""
        if name in self.substitutes:
            return self.substitutes[name]
        if name not in self.inputs:
            return lambda i: 0.0
        return lambda i: self.graph.input(name, i)

    def at(self, state: Mapping[str, Entry]) -> Trace:
        """Return a trace of the same links at another ``state``: functions of entries of "q" and "qd", no forces."""
        other = copy.copy(self)
        other.inputs, other.substitutes, other.compensates_gravity = tuple(state), dict(state), False
        other.places, other.motions, other.axes = {}, {}, {}
        return other

    def label(self, link: Link, letter: str) -> None:
        """Name the scalars that follow after a link and a letter."""
        self.graph.step = f"{link.title}|{letter}"

    def place(self, link: Link, moves: bool = False) -> None:
        """Place a link by its coordinates; with ``moves`` compute its velocity terms too."""
        self.label(link, "x")
        self.places[id(link)] = place = place_link(link, self.vector("q"))
        self.label(link, "w")
        parent = None if link.parent is None else self.motions[id(link.parent)]
        qd = self.vector("qd") if moves else None
        self.motions[id(link)] = motion.link_motion(link, place, parent, qd) if moves else STILL
        if "body_f" in self.inputs or self.compensates_gravity:
            R = IDENTITY if link.parent is None else self.axes[id(link.parent)]
            self.axes[id(link)] = R @ place.pose.rotation

    def compensate_gravity(self) -> bool:
        """Let external wrenches hold up the bodies' ``gravcomp`` from now on; return whether a body has any."""
        self.compensates_gravity = any(link.gravity_compensation is not None for link in self.links.links)
        return self.compensates_gravity

    def external_wrench(self, link: Link) -> Vector:
        """Return (n; f) of the external wrenches on the bodies of a link, in its frame."""
        n, f = ZERO, ZERO
        if self.compensates_gravity and link.gravity_compensation is not None:
            up = -(self.axes[id(link)].T @ self.links.gravity)
            n, f = cross(link.gravity_compensation.moment, up), up * link.gravity_compensation.mass
        if "body_f" not in self.inputs:
            return Vector((*n, *f))
        acting = []
        for body in self.bodies.get(id(link), ()):
            entries = [self.graph.input("body_f", body, c) for c in range(6)]
            acting.append((self._center(body), Vector(entries[:3]), Vector(entries[3:])))
        n_bodies, f_bodies = newton_euler.add_wrenches(self.axes[id(link)], acting)
        n, f = n + n_bodies, f + f_bodies
        return Vector((*n, *f))

    def _center(self, body: int) -> Vector:
        """Return the centre of mass of a body of this segment in its link, with numbers that may be kept from
        folding."""
        constants, placement = self.links.shared_constants, self.links.placements[body]
        if constants is None or body in self.links.flexible:
            return self.links.center(body)[1]
        at, com = self.own_bodies.index(body), self.links.nodes[body].com
        rows = constants.of_body(at, "seat", [x for row in placement.matrix for x in row])
        turned = Matrix.of([rows[3 * i : 3 * i + 3] for i in range(3)]) @ Vector(constants.of_body(at, "centre", com))
        return Vector(constants.of_body(at, "offset", placement.offset)) + turned

    @property
    def base_acceleration(self) -> Twist:
        """Angular and linear acceleration of the inertial frame that stand for gravity."""
        return ZERO, -self.links.gravity

    # -- segments ----------------------------------------------------------------------------------------------------
    def traversal(self) -> Iterator[tuple[Link, bool]]:
        """Yield (link, True) outward for this segment and its ancestors, (link, False) back for this segment's
        links."""
        for link, outward in self.links.traversal():
            if self.exchange.needs_motion_of(link) and (outward or self.exchange.own(link)):
                yield link, outward

    @property
    def own_links(self) -> list[Link]:
        """The links of this segment, parents first; all links where the whole tree is traced."""
        return [link for link in self.links.links if self.exchange.own(link)]

    @property
    def active_links(self) -> list[Link]:
        """The links of this segment and those that it moves on, parents first."""
        return [link for link in self.links.links if self.exchange.needs_motion_of(link)]

    @property
    def own_bodies(self) -> list[int]:
        """The bodies on the links of this segment; bodies that do not move count as the first segment's."""
        carriers, exchange = {body: placement.link for body, placement in self.links.placements.items()}, self.exchange
        return [body for body, link in carriers.items() if (exchange.is_first if link is None else exchange.own(link))]
