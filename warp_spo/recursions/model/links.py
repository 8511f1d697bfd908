"""Links: a scene as the recursions see it, one degree of freedom at a time, constants folded.

A hinge that is a sequence of elementary ones becomes a chain of links without inertia, the last one with the body's;
each has one elementary hinge, an object of :mod:`warp_spo.hinges`, and its axis along its own z axis. A body
on a fixed hinge belongs to the link under it, so that a body that does not move costs nothing.

Variable values are symbols here. An operation works on a copy whose quantities are read from tables: what depends on
the scene's values alone is computed once when they are set, not in every call.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from ...hinges.hinge_type import LinkPlacement as LinkPlacement
from ...scene.actuators import ACTUATOR_VALUES, RANGES
from ...scene.flexible.modes import Amplitudes
from ...scene.parts import DOF_VALUES
from ...scene.scene import Scene
from ...trace.scalars import Graph, Scalar, Value, is_constant, less, lost, select
from ...trace.spatial import IDENTITY, ZERO, Matrix, Pose, Rigid, Vector, symmetric, total
from . import flexible, rotors
from .flexible import Flexible
from .link import BodyPlacement as BodyPlacement
from .link import Link as Link
from .link import NodeBody as NodeBody
from .link import SharedDofs as SharedDofs
from .rotations import fold_rotation, numbers, pose_of, rotation_to_axis, still

if TYPE_CHECKING:
    from .shared_constants import SharedConstants

MOTION_VALUES = ("body_mass", "body_com", "body_inertia", "joint_X_p", "joint_X_c", "joint_armature", "gravity")
LINK_VALUES = (*MOTION_VALUES, "body_gravcomp")
TABLES = ("value", "node_value", "lost_value")
"""Tables: values of links; values of bodies by themselves, for the operators; see :meth:`Links.lost_values`."""
BOUNDS = (*RANGES, "joint_limit_lower", "joint_limit_upper", "joint_effort_limit", "joint_velocity_limit")
NOTHING = Rigid(0.0, ZERO, symmetric(0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
PRICES = (6, 10, 10, 10, 4, 4, 4, 8, 8, 8)  # of mass, first moment, moments and products of inertia
POINT = 1e-15  # share of a body's largest moment about its CoM below which another one is zero


class Links:
    """The links of a scene, parents before children, depth first.

    Args:
        scene: entries of its values that are the same in all worlds fold; the others are inputs in Newton's names and
            order, ``graph.input("body_mass", body)``.
        variable: names whose entries are inputs, all of them.
        graph: of the trace; None: a new one.

    Attributes:
        scene, variable: as given. graph: the trace's graph.
        links: the links. placements, nodes: by body.
        gravity: Vector.
        turns_vary: some joint's anchor is turned by what is no constant.
        tables: the scalars that an :meth:`with_tables` copy reads, by name, in order.
        reverses: what takes gradients by the tables back to the values, see :mod:`warp_spo.execution.link_values`.
        values: one world's values; symbols where they vary. poses: of hinges' anchors, (rotation, position).
        shared_constants: of the segment that a trace works on, see :mod:`.shared_constants`; None: constants fold.
        flexible: bodies with modes. ports: where children, by body, and frames, by (body, position), of them sit.
    """

    def __init__(self, scene: Scene, variable: tuple[str, ...] = (), graph: Graph | None = None):
        self.scene, self.variable, self.graph = scene, variable, Graph() if graph is None else graph
        self.links: list[Link] = []
        self.placements: dict[int, BodyPlacement] = {}
        self.nodes: dict[int, NodeBody] = {}
        self.tables: dict[str, dict[Scalar, int]] = {table: {} for table in TABLES}
        self.reverses: dict[Any, Any] = {}
        self.shared_constants: SharedConstants | None = None
        self.flexible: dict[int, Flexible] = {}
        self.ports: dict[Any, BodyPlacement] = {}
        self.values = {name: self._symbols(name, name in variable) for name in LINK_VALUES}
        self.gravity = Vector(self.values["gravity"].tolist())
        self.poses = {name: [pose_of(p) for p in self.values[name]] for name in ("joint_X_p", "joint_X_c")}
        self.turns_vary = any(R.dtype == object for poses in self.poses.values() for R, _ in poses)
        for root in scene.tree.roots:
            self._visit(root)
        flexible.attach(self, ((end, pose[:3]) for loop in scene.loops for end, pose in loop.ends))
        self._group()

    @property
    def shares_dofs(self) -> bool:
        """Whether some links share dofs."""
        return any(link.shared_dofs is not None for link in self.links)

    @property
    def leaders(self) -> list[Link]:
        """The links at which dofs are accounted for, each dof at one."""
        return [link for link in self.links if link.is_leader]

    def with_tables(self, copies: bool = False) -> Links:
        """Return a copy with a graph of its own, in which quantities that are not constant are entries of a table.

        ``copies``: its links are copies even if all quantities are constant.
        """
        other = copy.copy(self)
        other.graph = Graph()
        if self.graph.empty and not self.flexible and not copies:
            return other

        def table(name: str) -> Callable[[Any], Any]:
            slots = self.tables[name]
            read = lambda x: other.graph.input(name, slots.setdefault(x, len(slots)))  # noqa: E731
            return lambda values: _map_scalars(values, lambda x: x if is_constant(x) else read(x))

        value, apart = table("value"), table("node_value")
        twin: dict[Link | None, Any] = {None: None}
        for link in self.links:
            twin[link] = dataclasses.replace(
                link,
                parent=twin[link.parent],
                inertia=value(link.inertia),
                grouped=value(link.grouped),
                gravity_compensation=value(link.gravity_compensation),
                matrix=value(link.matrix),
                offset=value(link.offset),
                com=value(link.com),
                armature=value(link.armature),
                children=[],
            )
            if link.parent is not None:
                twin[link.parent].children.append(twin[link])
        other.links = [twin[link] for link in self.links]
        groups = {id(link.shared_dofs): link.shared_dofs for link in self.links if link.shared_dofs is not None}
        for group in groups.values():
            copied = SharedDofs([twin[link] for link in group.links], group.coupling_inertia)
            for link in copied.links:
                link.shared_dofs = copied
        other.flexible = {
            node: Flexible(twin[own.link], value(own.axes), value(own.origin), twin[own.leader], apart(own.rest))
            for node, own in self.flexible.items()
        }
        other.ports = {key: BodyPlacement(twin[s.link], *value(s[1:])) for key, s in self.ports.items()}
        other.placements = {node: BodyPlacement(twin[s.link], *value(s[1:])) for node, s in self.placements.items()}
        other.gravity = value(self.gravity)
        other.nodes = {
            node: NodeBody(apart(own.tree), value(own.anchor), value(own.com), apart(own.rigid))
            for node, own in self.nodes.items()
        }
        return other

    def traversal(self) -> Iterator[tuple[Link, bool]]:
        """(link, True) going out to it, (link, False) coming back with all that it carries: few values live at once."""
        stack = [(link, True) for link in reversed(self.links) if link.parent is None]
        while stack:
            link, outward = stack.pop()
            yield link, outward
            if outward:
                stack.append((link, False))
                stack.extend((child, True) for child in reversed(link.children))

    def carried_mass(self, link: Link) -> float | None:
        """Return the mass that a free root link carries, itself included; None for other links, or if it varies."""
        if not link.hinge.unconstrained or link.parent is not None:
            return None
        mass, carried = 0.0, [link]
        while carried:
            other = carried.pop()
            mass = mass + (0.0 if other.inertia is None else other.inertia.mass)
            carried.extend(other.children)
        return mass if is_constant(mass) else None

    # -- values ----------------------------------------------------------------------------------------------------
    def lost_values(self) -> list[Value]:
        """Return an input that is 0, or NaN in worlds where a value of the scene is not finite; [] if all values fold.

        Of ranges and bounds NaN alone counts, because infinity is no bound. Values of contacts are not among them.
        """
        slots = self.tables["lost_value"]
        if not slots:
            graph, found = Graph(), []
            for name in dict.fromkeys((*LINK_VALUES, *DOF_VALUES, "joint_rest_q", *ACTUATOR_VALUES)):
                symbols = self._symbols(name, name in self.variable, graph).flat
                vary = [x for x in symbols if not is_constant(x)]
                found += [_lost_bound(x) if name in BOUNDS else lost(x) for x in vary]
            slots |= {total(found): 0} if found else {}
        return [self.graph.input("lost_value", 0)] if slots else []

    def _symbols(self, name: str, all_vary: bool, graph: Graph | None = None) -> np.ndarray:
        """One world's value: numbers, or objects where some are inputs of a graph, left out: of this one."""
        graph = graph or self.graph
        values = self.scene.values[name]
        vary = np.flatnonzero((values != values[:1]).any(axis=0) | all_vary)
        if not vary.size:
            return values[0]
        symbols = values[0].astype(object)
        symbols.flat[vary] = [graph.input(name, int(entry)) for entry in vary]
        return symbols

    def _node(self, node: int) -> NodeBody:
        scene, poses = self.scene, self.poses
        R, p = poses["joint_X_p"][scene.hinge_of[node]]
        parent = scene.tree.parent[node]
        if parent >= 0:
            R_a, p_a = poses["joint_X_c"][scene.hinge_of[parent]]
            R, p = R_a.T @ R, R_a.T @ (p - p_a)
        R_c, p_c = poses["joint_X_c"][scene.hinge_of[node]]
        com = numbers(R_c.T @ (self.values["body_com"][node] - p_c))
        return NodeBody(
            (fold_rotation(R), Vector(p.tolist())),
            (fold_rotation(R_c), Vector(p_c.tolist())),
            Vector(com.tolist()),
            self.rigid(node, R_c, com),
        )

    def rigid(self, node: int, R: np.ndarray, c: np.ndarray) -> Rigid:
        """Inertia of the body about the origin of its node frame, for its CoM ``c`` in it."""
        mass = self.values["body_mass"][node : node + 1]
        inertia = R.T @ self.values["body_inertia"][node] @ R + (np.eye(3) * (c @ c) - np.outer(c, c)) * mass
        J = (0.5 * (inertia + inertia.T)).tolist()
        return Rigid(
            mass.tolist()[0],
            Vector((c * mass).tolist()),
            symmetric(J[0][0], J[1][1], J[2][2], J[0][1], J[0][2], J[1][2]),
        )

    def _without_rounding(self, node: int, own: Rigid) -> Rigid:
        """Return ``own``, the inertia of a body about its CoM, with zeros for moments that are only rounding.

        ``own`` was computed as a difference of moments about another point, which leaves rounding. With it, the pivot
        of a dof without inertia would be a small positive number instead of zero, and nothing would report it. Which
        moments are zero is read from the scene's inertia; if that is variable, ``own`` is returned as it is.
        """
        inertia, R = self.values["body_inertia"][node], self.poses["joint_X_c"][self.scene.hinge_of[node]][0]
        if inertia.dtype == object or R.dtype == object:
            return own
        moments = (R.T @ inertia @ R).diagonal()
        gone = moments <= POINT * moments.max()
        entry = lambda i, j: 0.0 if gone[i] or gone[j] else own.inertia[i][j]  # noqa: E731
        return own._replace(inertia=Matrix.of([[entry(i, j) for j in range(3)] for i in range(3)]))

    def placement(self, body: int, pose: np.ndarray) -> BodyPlacement:
        """Where a frame of a body, or with -1 of the inertial frame, sits."""
        R, p = pose_of(pose)
        if body < 0:
            return BodyPlacement(None, fold_rotation(R), Vector(p.tolist()))
        if (body, tuple(p.tolist())) in self.ports:
            port = self.ports[body, tuple(p.tolist())]
            return BodyPlacement(port.link, port.matrix @ fold_rotation(R), port.offset)
        placement, (R_body, p_body) = self.placements[body], self.nodes[body].anchor
        axes = placement.matrix @ R_body.T
        return BodyPlacement(
            placement.link, axes @ fold_rotation(R), placement.offset + axes @ (Vector(p.tolist()) - p_body)
        )

    def carrier(self, body: int) -> Link | None:
        """The link that the centre of mass of a body sits on."""
        return self.flexible[body].leader if body in self.flexible else self.placements[body].link

    def center(self, body: int) -> tuple[Link | None, Vector]:
        """The link that the centre of mass of a body sits on, and its place there; the mean one of a flexible body."""
        if body in self.flexible:
            return self.flexible[body].leader, ZERO
        placement = self.placements[body]
        return placement.link, placement.offset + placement.matrix @ self.nodes[body].com

    def on_parent_node(self, link: Link) -> Link:
        """The first link of a hinge as it sits in the parent's node frame, instead of in the parent's link."""
        matrix, offset = self.nodes[link.node].tree
        if link.align is not None:
            matrix = matrix @ link.align
        return dataclasses.replace(link, matrix=still(matrix), offset=offset)

    # -- building --------------------------------------------------------------------------------------------------
    def _visit(self, root: int) -> None:
        stack = [root]
        while stack:
            node = stack.pop()
            self._place(node)
            stack.extend(reversed(self.scene.tree.children[node]))

    def _place(self, node: int) -> None:
        scene = self.scene
        parent = scene.tree.parent[node]
        placement = self.placements[parent] if parent >= 0 else BodyPlacement(None, IDENTITY, ZERO)
        self.nodes[node] = body = self._node(node)
        index = scene.hinge_of[node]
        R, l = body.tree
        if node in self.ports:  # the parent's point that carries it, in the axes of the parent's body frame
            placement, R, l = self.ports[node], fold_rotation(self.poses["joint_X_p"][index][0]), ZERO
        matrix, offset, link = placement.matrix @ R, placement.offset + placement.matrix @ l, placement.link
        dof, coordinate = int(scene.qd_start[index]), int(scene.q_start[index])
        armatures = self.values["joint_armature"].tolist()
        rotor, anchor = scene.hinges[index].rotor, (matrix, offset)
        for kind, axis in scene.hinges[index].elements:
            if isinstance(kind, Amplitudes):
                break
            align = None if axis is None else rotation_to_axis(axis)
            own = range(dof, dof + kind.dofs)
            link = Link(
                link,
                kind,
                still(matrix if align is None else matrix @ align),
                offset,
                align,
                tuple(own),
                coordinate,
                tuple(armatures[i] for i in own),
                node,
                body.com if kind.at_com else ZERO,
            )
            self.append(link)
            if rotor is not None and rotor.shares_dof and dof == scene.qd_start[index]:
                rotors.add(self, link, rotor, *anchor)
            matrix, offset = IDENTITY if align is None else align.T, -link.com if kind.at_com else ZERO
            dof, coordinate = dof + kind.dofs, coordinate + kind.coordinates
        rest = BodyPlacement(link, matrix, offset)
        self.placements[node] = rest
        if scene.bodies[node].modes is not None:
            flexible.deform(self, node, dof, coordinate, tuple(armatures[dof : dof + scene.bodies[node].modes.count]))
            return
        if rest.link is not None:
            inertia = Pose(None, rest.matrix, rest.offset).rigid_to_parent(body.rigid)
            at_com = rest.link.node == node and rest.link.hinge.at_com
            rest.link.add(self._without_rounding(node, inertia) if at_com else inertia)
            share = self.values["body_gravcomp"].tolist()[node]
            rest.link.compensate(share * body.rigid.mass, rest.offset + rest.matrix @ body.com)

    def append(self, link: Link) -> None:
        """Add a link, after its parent."""
        self.links.append(link)
        if link.parent is not None:
            link.parent.children.append(link)

    def _group(self) -> None:
        """Hand inward what a hinge does not move: a rod on the axis of a turn, the moments of inertia of a slide.

        Khalil, Kleinfinger 1987: the base parameters of an arm; mass, first moment along the axis and one moment of
        inertia of every turning link become zero. Only constants, which fold.
        """
        for link in self.links:
            link.grouped = link.inertia
        for link in reversed(self.links):
            own = link.grouped
            if own is None:
                continue
            if not all(map(is_constant, (*own.packed, *link.offset, *(x for row in link.matrix or () for x in row)))):
                continue
            parts = link.hinge.split_inertia(own)
            if parts is None:
                continue
            handed, kept = parts
            parent = link.parent
            if parent is None:
                link.grouped = kept
                continue
            before = NOTHING if parent.grouped is None else parent.grouped
            after = before + Pose(None, link.matrix, link.offset).rigid_to_parent(handed)
            if _price(kept) + _price(after) < _price(own) + _price(before):
                link.grouped, parent.grouped = kept, after


def place_link(link: Link, q: Any) -> LinkPlacement:
    """Return ``link`` where the coordinates put it; ``q(i)`` is entry i."""
    return link.hinge.transform(link, q)


def _price(inertia: Rigid) -> int:
    """Operations, roughly, in which the numbers of an inertia that are not zero take part."""
    return sum(price for x, price in zip(inertia.packed, PRICES, strict=True) if not is_constant(x) or x != 0.0)


def _lost_bound(x: Value) -> Value:
    """Return 0, or NaN where ``x`` is NaN."""
    return select(less(x, 0.0) + less(0.0, x), 0.0, lost(x))


def _map_scalars(values: Any, change: Callable[[Value], Value]) -> Any:
    """A nest of tuples and dicts with ``change`` made to each scalar; None stays."""
    if isinstance(values, dict):
        return {key: _map_scalars(value, change) for key, value in values.items()}
    if isinstance(values, tuple):
        items = [_map_scalars(value, change) for value in values]
        return type(values)(*items) if hasattr(values, "_fields") else type(values)(items)
    return values if values is None else change(values)
