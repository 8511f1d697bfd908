"""States of bodies by chains: one text for every hinge and body, in a loop with the geometry as numbers in a table.

A limb goes from its root out. In a turn it places a link that turns or slides on the one before, and a body on it, in
inertial axes. :func:`.kinematics.body_states` computes the same in statements of its own for each body; those of a
humanoid, once a step, are fetched more slowly than they are executed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ..hinges.quaternions import Quaternion, constant_quaternion, multiplied, turned
from ..hinges.slide import Slide
from ..hinges.turn import Turn, turned_about_z
from ..scene.scene import Scene
from ..trace.emission import Store
from ..trace.scalars import Graph, Value, is_constant
from ..trace.spatial import IDENTITY, ZERO, Vector, cross
from . import messages
from .kinematics import NEUTRAL, link_poses, link_velocities, quaternions_in_links
from .links import Link, Links
from .messages import INWARD
from .pieces import Piece, Pieces
from .remembered import remembered
from .tracing import Trace

FRAME, NUMBERS = "frame", "chain"
"""What a chain has come to, in inertial axes: position, quaternion, omega, velocity; the table of numbers."""
RECORD = 17  # numbers of a turn: offset and quaternion of a link, then of a body, and the body's centre of mass
MOST_TURNS = 31  # of a chain, whose kinds are bits of an integer


class Station(NamedTuple):
    """One turn of a chain: the dof of the link that it goes on to, and the body that it places; either may be None."""

    dof: int | None
    body: int | None


class Chains(NamedTuple):
    """The chains of a scene.

    Attributes:
        stations: the turns of each chain, by the index of the limb's piece. A chain begins with a turn at its root.
        first: the place of a chain's first turn among all turns.
        numbers: RECORD numbers for each turn.
    """

    stations: dict[int, list[Station]]
    first: dict[int, int]
    numbers: list[float]


def suits(links: Links) -> bool:
    """Return whether chains serve a scene: all hinges but those at roots turn or slide, and geometry is constant."""
    fixed = all(
        name not in links.variable and (links.scene.values[name] == links.scene.values[name][:1]).all()
        for name in ("joint_X_p", "joint_X_c")
    )
    if not fixed or links.shared or links.flexible or not all(_goes_on(link) or _leads(link) for link in links.links):
        return False
    if any(seat.link is None for seat in links.seats.values()):
        return False
    anchored = all(node.anchor == (IDENTITY, ZERO) for node in links.nodes.values())
    if not anchored and any(not is_constant(x) for node in links.nodes.values() for x in node.com):
        return False
    return all(len(chain) <= MOST_TURNS for chain in chains(links.scene).stations.values())


@remembered
def chains(scene: Scene) -> Chains:
    """Return the chains of a scene."""
    links = Links(scene.with_values(**{name: array[:1] for name, array in scene.values.items()}))
    stations, geometry = _stations(links), _Geometry(links)
    starts = np.cumsum([0, *map(len, stations.values())]).tolist()
    numbers = [x for chain in stations.values() for station in chain for x in geometry.record(station)]
    return Chains(stations, dict(zip(stations, starts, strict=False)), numbers)


def turn_counts(scene: Scene) -> dict[int, int]:
    """Return how many turns the chain of each limb has, by the index of its piece."""
    return {index: len(chain) for index, chain in chains(scene).stations.items()}


def add_chains(trace: Trace, after: Mapping[tuple[str, int], Value]) -> None:
    """Let a piece send what chains need of it, and a limb go along its chain after that.

    Args:
        trace: of the piece.
        after: its entries of the state after a step, by the names of their stores.
    """
    own, found = trace.piece, chains(trace.links.scene)
    assert own is not None and trace.slot is not None
    of_dof = {dof: link for link in trace.links.links for dof in link.dofs}
    sent: list[Store] = []
    pieces = Pieces(trace.links).pieces
    for index, chain in found.stations.items():
        first = trace.slot("C", pieces[index])
        for at, (dof, _) in enumerate(chain):
            if dof in own.dofs and dof is not None:
                q, qd = after["q_out", of_dof[dof].coordinate], after["out", dof]
                sent += [Store(INWARD, (first + 2 * at,), q), Store(INWARD, (first + 2 * at + 1,), qd)]
    if own.parent is None and _leads(own.links[0]):
        sent += trace.send("F", own, _frame_of_root(trace, own.links[0], after))
    trace.news = trace.news + sent
    if not own.children:
        trace.march = [
            _turn(trace, found, pieces[own.index], at, station) for at, station in enumerate(found.stations[own.index])
        ]


def _goes_on(link: Link) -> bool:
    return isinstance(link.hinge, Turn | Slide)


def _leads(link: Link) -> bool:
    """Whether a chain begins on the link, whose frame comes in a message."""
    return link.parent is None and not _goes_on(link)


def _frame_of_root(trace: Trace, root: Link, after: Mapping[tuple[str, int], Value]) -> list[Value]:
    """Return the frame of the node of a root link after a step."""
    moved = trace.at({"q": lambda c: after["q_out", c], "qd": lambda dof: after["out", dof]})
    moved.active = {id(root)}
    at, turns = link_poses(moved)
    w, v = link_velocities(moved)[id(root)]
    seat, axes = trace.links.seats[root.node], moved.axes[id(root)]
    trace.label(root, "b")
    w, v = axes @ w, axes @ v
    arm = axes @ seat.offset
    turn = multiplied(turns[id(root)], constant_quaternion(seat.matrix))
    return [*(at[id(root)] + arm), *turn, *w, *(v + cross(w, arm))]


def _turn(trace: Trace, found: Chains, leaf: Piece, at: int, station: Station) -> list[Store]:
    """Return what a chain stores in a turn; equal turns have equal statements, so each has a graph of its own."""
    assert trace.slot is not None
    graph, links = Graph(), trace.links
    graph.step = "chain|b"
    first = RECORD * (found.first[leaf.index] + at)
    number = lambda start, count: Vector(graph.input(NUMBERS, first + start + i) for i in range(count))  # noqa: E731
    root = leaf.root
    if at == 0:
        start: list[Value] = [*ZERO, *NEUTRAL, *ZERO, *ZERO]
        if _leads(root.links[0]):
            begin = trace.slot("F", root)
            start = [graph.input(INWARD, begin + i) for i in range(messages.SIZES["F"])]
        return [Store(FRAME, (i,), x) for i, x in enumerate(start)]
    frame = [graph.input(FRAME, i) for i in range(messages.SIZES["F"])]
    p, Q, w, v = Vector(frame[:3]), Vector(frame[3:7]), Vector(frame[7:10]), Vector(frame[10:])
    stores: list[Store] = []
    if station.dof is not None:
        place = trace.slot("C", leaf) + 2 * at
        q, rate = graph.input(INWARD, place), graph.input(INWARD, place + 1)
        arm, rest = turned(Q, number(0, 3)), number(3, 4)
        link = next(link for link in links.links if station.dof in link.dofs)
        if isinstance(link.hinge, Turn):
            Q = multiplied(Q, turned_about_z(rest, q))
            p, v, w = p + arm, v + cross(w, arm), w + _z(Q) * rate
        else:
            Q = multiplied(Q, rest)
            arm = arm + _z(Q) * q
            p, v = p + arm, v + cross(w, arm) + _z(Q) * rate
        stores += [Store(FRAME, (i,), x) for i, x in enumerate((*p, *Q, *w, *v)) if x is not frame[i]]
    if station.body is not None:
        offset, turn = turned(Q, number(7, 3)), multiplied(Q, number(10, 4))
        center = links.nodes[station.body].com
        if all(map(is_constant, center)):
            arm = turned(Q, number(14, 3))
        else:  # in the axes of the body
            read = [graph.input(*x.args) if not is_constant(x) else number(14 + i, 1)[0] for i, x in enumerate(center)]
            arm = offset + turned(turn, Vector(read))
        pose, twist = (*(p + offset), *turn), (*(v + cross(w, arm)), *w)
        stores += [Store("poses_out", (station.body, i), x) for i, x in enumerate(pose)]
        stores += [Store("velocities_out", (station.body, i), x) for i, x in enumerate(twist)]
    return stores


def _z(Q: Quaternion) -> Vector:
    """Return the z axis of a frame with the unit quaternion Q."""
    x, y, z, w = Q
    x2, y2 = x + x, y + y
    return Vector((x2 * z + y2 * w, y2 * z - x2 * w, 1.0 - (x2 * x + y2 * y)))


def _stations(links: Links) -> dict[int, list[Station]]:
    """Return the turns of each chain; a body inside of the robot goes to the shortest chain that passes it."""
    pieces, on = Pieces(links).pieces, {id(link): list[int]() for link in links.links}
    for body, seat in links.seats.items():
        if seat.link is not None:
            on[id(seat.link)].append(body)
    leaves = [piece for piece in pieces if not piece.children]
    paths = {
        leaf.index: [link for piece in reversed((leaf, *leaf.ancestors)) for link in piece.links] for leaf in leaves
    }
    taken = {leaf.index: {id(link): on[id(link)] for link in leaf.links} for leaf in leaves}  # by chain and link
    for piece in reversed(pieces):
        through = [leaf.index for leaf in leaves if piece in leaf.ancestors]
        for link in piece.links if through else ():
            for body in on[id(link)]:
                shortest = min(through, key=lambda index: sum(len(x) for x in taken[index].values()))
                taken[shortest].setdefault(id(link), []).append(body)
    found = {}
    for index, path in paths.items():
        chain = [Station(None, None)]
        for link in path:
            bodies: list[int | None] = [*taken[index].get(id(link), ())]
            if _goes_on(link):
                chain.append(Station(link.dofs[0], bodies.pop(0) if bodies else None))
            chain += [Station(None, body) for body in bodies]
        found[index] = chain
    return found


class _Geometry:
    """Where links and bodies sit, of the scene's constants: in the node's frame at a root, else in the link's."""

    def __init__(self, links: Links):
        self.links, self.within = links, quaternions_in_links(links)

    def record(self, station: Station) -> list[float]:
        """Return the numbers of a turn."""
        found: list[Value] = [0.0] * RECORD
        if station.dof is not None:
            link = next(one for one in self.links.links if station.dof in one.dofs)
            found[:3], found[3:7] = self._from(link.parent, link.offset, link.hinge.quaternion_at_rest(link))
        if station.body is not None:
            seat, (R, p) = self.links.seats[station.body], self.links.nodes[station.body].anchor
            at, turn = seat.offset - seat.matrix @ (R.T @ p), self.within[station.body]
            found[7:10], found[10:14] = self._from(seat.link, at, turn)
            found[14:], _ = self._from(seat.link, self.links.center(station.body)[1], turn)
        return [float(x) for x in found]  # type: ignore[arg-type]

    def _from(self, link: Link | None, offset: Vector, turn: Quaternion) -> tuple[Vector, Quaternion]:
        """Return a place in a link's frame, in the frame that a chain has for the link."""
        if link is None or _goes_on(link):
            return offset, turn
        seat = self.links.seats[link.node]
        x, y, z, w = constant_quaternion(seat.matrix)
        return seat.matrix.T @ (offset - seat.offset), multiplied(Vector((-x, -y, -z, w)), turn)
