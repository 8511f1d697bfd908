"""States of bodies after a step, by traversals of the tree: few texts for all links and bodies, geometry from a table.

A traversal goes from a root to the bodies of a segment. It holds the frame of one link, in inertial axes, moves it to
the next link, and writes the states of its bodies. :func:`.kinematics.body_states` computes the same in statements of
its own for each body; those of a humanoid, once a step, are fetched more slowly than they are executed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

from ...hinges.quaternions import Quaternion, constant_quaternion, multiply, turned
from ...hinges.revolute import Revolute
from ...recursions.kinematics import NEUTRAL, quaternions_in_links, relative_quaternion
from ...recursions.model.links import Link, Links, place_link
from ...recursions.model.scene_cache import cached_by_scene
from ...recursions.model.segments import Segments
from ...scene.scene import Scene
from ...trace.emission import Store
from ...trace.scalars import Graph, Value, is_constant
from ...trace.spatial import IDENTITY, ZERO, Matrix, Vector, cross

GEOMETRY = "geometry"
"""The table of RECORD numbers for each body: origin and quaternion in the frame that its link has in a traversal, and
its com; then of PLACE numbers for each link: origin and quaternion at rest in the frame that its parent has in a
traversal."""
RECORD = 10
PLACE = 7
FRAME = "frame"
"""The variables of a traversal: origin, quaternion, omega, velocity."""
SIZE = 13
BY_STATEMENTS = 4  # dofs of unlike segments up to which bodies have statements of their own: these are fetched fast


class TraversalFrame(NamedTuple):
    """A frame in inertial axes: origin, quaternion, omega, velocity of the origin."""

    p: Vector
    Q: Quaternion
    w: Vector
    v: Vector


def is_supported(links: Links) -> bool:
    """Return whether traversals serve a scene: all bodies move, are rigid, and sit at places that do not vary.

    Where statements of their own are few, they wait less, for nothing that is read from a table.
    """
    if Segments(links).distinct_dof_count <= BY_STATEMENTS:
        return False
    fixed = all(
        name not in links.variable and (links.scene.values[name] == links.scene.values[name][:1]).all()
        for name in ("joint_X_p", "joint_X_c")
    )
    if not fixed or links.shares_dofs or links.flexible or any(one.link is None for one in links.placements.values()):
        return False
    anchored = all(node.anchor == (IDENTITY, ZERO) for node in links.nodes.values())
    return anchored or all(is_constant(x) for node in links.nodes.values() for x in node.com)


def traversals(links: Links) -> list[list[tuple[bool, int]]]:
    """Return the steps of a traversal for each segment: (True, link) moves the frame, (False, body) stores a state."""
    number = {id(link): at for at, link in enumerate(links.links)}
    bodies: dict[int, list[int]] = {}
    for body in sorted(links.placements):
        bodies.setdefault(id(links.placements[body].link), []).append(body)
    found = []
    for segment in Segments(links).all:
        steps = [(True, number[id(link)]) for above in reversed(segment.ancestors) for link in above.links]
        for link in segment.links:
            steps += [(True, number[id(link)]), *((False, body) for body in bodies.get(id(link), ()))]
        found.append(steps)
    return found


@cached_by_scene
def _numeric(scene: Scene) -> Links:
    """Return the links of the first world; what is read of them holds in every world of a scene that
    :func:`is_supported`."""
    return Links(scene.with_values(**{name: array[:1] for name, array in scene.values.items()}))


class RestPose(NamedTuple):
    """Where a link is at rest in the frame that its parent has in a traversal."""

    matrix: Matrix | None
    offset: Vector
    rest: Quaternion


@cached_by_scene
def _rest_poses(scene: Scene) -> list[RestPose]:
    """Return the places of all links, which are constants even if centres of mass vary."""
    links, found = _numeric(scene), []
    for link in links.links:
        matrix, offset, rest = link.matrix, link.offset, link.hinge.quaternion_at_rest(link)
        if link.parent is not None and _at_node(link.parent):
            offset, rest = _in_frame(links, link.parent, offset, rest)
            node = links.placements[link.parent.node].matrix.T
            matrix = node if matrix is None else node @ matrix
        found.append(RestPose(matrix, offset, rest))
    return found


@cached_by_scene
def geometry(scene: Scene) -> list[float]:
    """Return the numbers of all bodies and of all links of a scene that :func:`is_supported`."""
    links = _numeric(scene)
    within = quaternions_in_links(links)
    found: list[Value] = []
    for body in sorted(links.placements):
        placement, (R, p) = links.placements[body], links.nodes[body].anchor
        assert placement.link is not None
        offset, turn = _in_frame(links, placement.link, placement.offset - placement.matrix @ (R.T @ p), within[body])
        found += [*offset, *turn, *scene.values["body_com"][0, body].tolist()]
    for place in _rest_poses(scene):
        found += [*place.offset, *place.rest]
    return [float(x) for x in found]  # type: ignore[arg-type]


def _at_node(link: Link) -> bool:
    """Whether a traversal has the frame of a link's node, because its own is at a centre of mass, which may vary."""
    return link.hinge.at_com


def _in_frame(links: Links, link: Link, offset: Vector, turn: Quaternion) -> tuple[Vector, Quaternion]:
    """Return a place in the frame that a link has in a traversal, for that in the frame of the link."""
    if not _at_node(link):
        return offset, turn
    node = links.placements[link.node]
    x, y, z, w = constant_quaternion(node.matrix)
    return node.matrix.T @ (offset - node.offset), multiply(Vector((-x, -y, -z, w)), turn)


def move_to_link(links: Links, number: int) -> list[Store]:
    """Return the stores of a step of a traversal to a link; equal for all links that turn about an axis on another
    one."""
    link, over = links.links[number], TraversalFrame(ZERO, NEUTRAL, ZERO, ZERO)
    if link.parent is not None and link.hinge.shape == Revolute.name:
        graph, first = Graph(), RECORD * len(links.placements) + PLACE * number
        table = [graph.input(GEOMETRY, first + i) for i in range(PLACE)]
        still = dataclasses.replace(link, matrix=None, offset=Vector(table[:3]), rest=Vector(table[3:]))
    else:
        graph, place = links.graph, _rest_poses(links.scene)[number]
        still = dataclasses.replace(link, matrix=place.matrix, offset=place.offset, rest=place.rest)
    graph.step = "links|F"
    if link.parent is not None:
        over = _read(graph)
    frame = _frame_of_child(over, still, lambda c: graph.input("q", c), lambda dof: graph.input("qd", dof))
    if _at_node(link):
        placement = links.placements[link.node]
        arm, Q = turned(frame.Q, placement.offset), multiply(frame.Q, constant_quaternion(placement.matrix))
        frame = TraversalFrame(frame.p + arm, Q, frame.w, frame.v + cross(frame.w, arm))
    return [Store(FRAME, (i,), x) for i, x in enumerate(x for part in frame for x in part)]


def _read(graph: Graph) -> TraversalFrame:
    """Return the frame of a traversal."""
    values = [graph.input(FRAME, i) for i in range(SIZE)]
    return TraversalFrame(Vector(values[:3]), Vector(values[3:7]), Vector(values[7:10]), Vector(values[10:]))


def _frame_of_child(
    parent: TraversalFrame, link: Link, q: Callable[[int], Value], qd: Callable[[int], Value]
) -> TraversalFrame:
    """Return the frame of a link for that of its parent, at q and qd."""
    place = place_link(link, q)
    arm, Q = turned(parent.Q, place.pose.l), multiply(parent.Q, relative_quaternion(link, q))
    w, v = parent.w, parent.v + cross(parent.w, arm)
    columns = link.hinge.inertial_columns(link, place, _axes(parent.Q), _axes(Q), ZERO)
    for dof, (turn, shift) in zip(link.dofs, columns, strict=True):
        w, v = w + turn * qd(dof), v + shift * qd(dof)
    return TraversalFrame(parent.p + arm, Q, w, v)


def _axes(Q: Quaternion) -> Matrix:
    """Return the rotation matrix of a unit quaternion."""
    x, y, z, w = Q
    x2, y2, z2 = x + x, y + y, z + z
    return Matrix.of([
        [1.0 - (y2 * y + z2 * z), x2 * y - z2 * w, x2 * z + y2 * w],
        [x2 * y + z2 * w, 1.0 - (x2 * x + z2 * z), y2 * z - x2 * w],
        [x2 * z - y2 * w, y2 * z + x2 * w, 1.0 - (x2 * x + y2 * y)],
    ])  # fmt: skip


def store_body(links: Links, body: int) -> list[Store]:
    """Return the stores of a body's state, out [body, 7] and velocities_out [body, 6]; equal for all bodies."""
    graph = Graph()
    graph.step = "bodies|b"
    p, Q, w, v = _read(graph)
    number = [graph.input(GEOMETRY, RECORD * body + i) for i in range(RECORD)]
    com = [graph.input(*x.args) if not is_constant(x) else number[7 + i] for i, x in enumerate(links.nodes[body].com)]
    offset, turn = turned(Q, Vector(number[:3])), multiply(Q, Vector(number[3:7]))
    arm = offset + turned(turn, Vector(com))
    pose, twist = (*(p + offset), *turn), (*(v + cross(w, arm)), *w)
    return [
        *(Store("out", (body, i), x) for i, x in enumerate(pose)),
        *(Store("velocities_out", (body, i), x) for i, x in enumerate(twist)),
    ]
