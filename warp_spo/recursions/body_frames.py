"""States of bodies from the frames of links: one text for all, in a loop, with the geometry as numbers in a table.

Pieces first place their links, in inertial axes, and send each other the frames. Then each limb takes as many bodies
as the others. :func:`.kinematics.body_states` computes the same in statements of its own for each body; those of a
humanoid, once a step, are fetched more slowly than they are executed.
"""

from __future__ import annotations

from typing import NamedTuple

from ..hinges.quaternions import Quaternion, constant_quaternion, multiplied, turned
from ..scene.scene import Scene
from ..trace.emission import Store
from ..trace.scalars import Graph, Value, is_constant
from ..trace.spatial import IDENTITY, ZERO, Matrix, Vector, cross
from .kinematics import NEUTRAL, quaternions_in_links, relative_quaternion
from .links import Link, Links, place_link
from .messages import FRAME, INWARD
from .pieces import Piece, Pieces
from .remembered import remembered
from .tracing import Trace

GEOMETRY = "geometry"
"""The table of RECORD numbers for each body: origin and quaternion in the frame that its link sends, and its com."""
RECORD = 10
BY_STATEMENTS = (
    4  # dofs of unlike pieces up to which bodies have statements of their own, which are fetched fast enough
)


class Frame(NamedTuple):
    """A frame in inertial axes: origin, quaternion, omega, velocity of the origin."""

    p: Vector
    Q: Quaternion
    w: Vector
    v: Vector


def suits(links: Links) -> bool:
    """Return whether bodies share a text: all of them move, are rigid, and sit at places that do not vary.

    Where statements of their own are few, they wait less, for nothing that is read from a table.
    """
    if Pieces(links).unlike <= BY_STATEMENTS:
        return False
    fixed = all(
        name not in links.variable and (links.scene.values[name] == links.scene.values[name][:1]).all()
        for name in ("joint_X_p", "joint_X_c")
    )
    if not fixed or links.shared or links.flexible or any(seat.link is None for seat in links.seats.values()):
        return False
    anchored = all(node.anchor == (IDENTITY, ZERO) for node in links.nodes.values())
    return anchored or all(is_constant(x) for node in links.nodes.values() for x in node.com)


@remembered
def geometry(scene: Scene) -> list[float]:
    """Return the numbers of all bodies of a scene that :func:`suits`."""
    links = Links(scene.with_values(**{name: array[:1] for name, array in scene.values.items()}))
    within = quaternions_in_links(links)
    found: list[Value] = []
    for body in sorted(links.seats):
        seat, (R, p) = links.seats[body], links.nodes[body].anchor
        offset, turn = seat.offset - seat.matrix @ (R.T @ p), within[body]
        if seat.link is not None and _at_node(seat.link):
            node = links.seats[seat.link.node]
            x, y, z, w = constant_quaternion(node.matrix)
            offset, turn = node.matrix.T @ (offset - node.offset), multiplied(Vector((-x, -y, -z, w)), turn)
        found += [*offset, *turn, *scene.values["body_com"][0, body].tolist()]
    return [float(x) for x in found]  # type: ignore[arg-type]


def add_bodies(trace: Trace, state: Trace) -> None:
    """Let a piece send the frames of its links at a ``state``, in a round of the ``trace``.

    Afterwards limbs share the states of bodies, ``states`` of the first piece's trace.
    """
    own = trace.piece
    assert own is not None
    frames = _frames(state)
    sent = [x for link in own.links for part in _sent(state, link, frames[id(link)]) for x in part]
    trace.rounds = [*trace.rounds, trace.send("F", own, sent)]
    if own.index == 0:
        trace.states = [_body(trace, body) for body in sorted(trace.links.seats)]


def _at_node(link: Link) -> bool:
    """Whether a link sends the frame of its node, because its own is at a centre of mass, which may vary."""
    return link.hinge.at_com


def _frames(state: Trace) -> dict[int | None, Frame]:
    """Return the frames of the links that the state is traced for, by id; None is the inertial frame."""
    q, qd = state.vector("q"), state.vector("qd")
    frames: dict[int | None, Frame] = {None: Frame(ZERO, NEUTRAL, ZERO, ZERO)}
    for link in state.active_links:
        state.label(link, "F")
        over = frames[None if link.parent is None else id(link.parent)]
        place = place_link(link, q)
        arm, Q = turned(over.Q, place.pose.l), multiplied(over.Q, relative_quaternion(link, q))
        w, v = over.w, over.v + cross(over.w, arm)
        columns = link.hinge.inertial_columns(link, place, _axes(over.Q), _axes(Q), ZERO)
        for dof, (turn, shift) in zip(link.dofs, columns, strict=True):
            w, v = w + turn * qd(dof), v + shift * qd(dof)
        frames[id(link)] = Frame(over.p + arm, Q, w, v)
    return frames


def _axes(Q: Quaternion) -> Matrix:
    """Return the rotation matrix of a unit quaternion."""
    x, y, z, w = Q
    x2, y2, z2 = x + x, y + y, z + z
    return Matrix.of([
        [1.0 - (y2 * y + z2 * z), x2 * y - z2 * w, x2 * z + y2 * w],
        [x2 * y + z2 * w, 1.0 - (x2 * x + z2 * z), y2 * z - x2 * w],
        [x2 * z - y2 * w, y2 * z + x2 * w, 1.0 - (x2 * x + y2 * y)],
    ])  # fmt: skip


def _sent(state: Trace, link: Link, frame: Frame) -> Frame:
    """Return the frame that a link sends."""
    if not _at_node(link):
        return frame
    seat = state.links.seats[link.node]
    arm = turned(frame.Q, seat.offset)
    Q = multiplied(frame.Q, constant_quaternion(seat.matrix))
    return Frame(frame.p + arm, Q, frame.w, frame.v + cross(frame.w, arm))


def _body(trace: Trace, body: int) -> list[Store]:
    """Return the stores of a body's state; statements are equal for all bodies, so each has a graph of its own."""
    graph, links = Graph(), trace.links
    graph.step = "bodies|b"
    link = links.seats[body].link
    assert link is not None and trace.slot is not None
    piece: Piece = Pieces(links).of[id(link)]
    at = trace.slot("F", piece) + FRAME * [id(other) for other in piece.links].index(id(link))
    read = [graph.input(INWARD, at + i) for i in range(FRAME)]
    p, Q, w, v = Vector(read[:3]), Vector(read[3:7]), Vector(read[7:10]), Vector(read[10:])
    number = [graph.input(GEOMETRY, RECORD * body + i) for i in range(RECORD)]
    com = [graph.input(*x.args) if not is_constant(x) else number[7 + i] for i, x in enumerate(links.nodes[body].com)]
    offset, turn = turned(Q, Vector(number[:3])), multiplied(Q, Vector(number[3:7]))
    arm = offset + turned(turn, Vector(com))
    pose, twist = (*(p + offset), *turn), (*(v + cross(w, arm)), *w)
    return [
        *(Store("poses_out", (body, i), x) for i, x in enumerate(pose)),
        *(Store("velocities_out", (body, i), x) for i, x in enumerate(twist)),
    ]
