"""Blocks of the spatial operators of scenes whose links share dofs: weights, H, M and Delta, as a trace.

Node k is body k. Its vector is (eta'; omega; v): the rates of its modes, then the velocity of its node frame. With the
slopes Pi of the point of the parent that carries the body, and phi from the body's node frame to that point,

    w(p, k) = [Pi*; phi(p, point)] phi(point, k) [0, I],  H = [[0, H], [I, 0]],

where the rows of H are the hinge's dofs, then the modes. M(k) is the inertia of all pieces of the body at q.

A rotor of the hinge comes before all that, with its velocity about its centre of mass, axis along z, in model "full",
and with its turn rate about the axis alone in model "reduced", whose locked rotor is part of M(p):

    w(p, k) = [phi(p, rotor) [I or z], phi(p, k)],  H = [ratio z or ratio, H],  M(k) = diag(M_rotor or J, M).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..hinges.deflection import Deflection
from ..hinges.quaternions import matrix_quaternion
from ..hinges.rotor_axis import RotorAxis
from ..trace.emission import Store
from ..trace.scalars import Value
from ..trace.spatial import IDENTITY, ZERO, Pose, Rigid, Twist, Vector, cross, dot
from .articulated import columns
from .kinematics import place_all
from .model.link import BodyPlacement, Link
from .model.rotations import fold_rotation
from .model.rotors import locked_inertia, rotor_link

if TYPE_CHECKING:
    from .model.tracing import Trace

NOTHING = Vector((*ZERO, *ZERO))
Six = list[Value]


def node_blocks(trace: Trace) -> list[Store]:
    """out = blocks of M, row by row, node after node; E_phi, edge after edge; H; Delta; frames [node, 7]"""
    links, scene = trace.links, trace.links.scene
    origins, first = place_all(trace), ZERO
    if links.links:
        first = trace.places[id(links.links[0])].pose.l
    found: dict[str, list[Value]] = {name: [] for name in ("out", "E_phi", "H", "Delta", "frames")}
    for parent, child in scene.tree.edges:
        found["E_phi"] += _weight(trace, int(parent), int(child))
    for node in range(scene.body_count):
        modes, own, rotor = _modes(trace, node), _hinge_links(trace, node), rotor_link(links, node)
        size = scene.node_sizes[node] - 6 - modes  # of the rotor
        columns_of = {
            dof: _at_node(trace, node, link, column)
            for link in own
            for dof, column in zip(link.dofs, columns(link, trace.places[id(link)]), strict=True)
        }
        for dof in sorted(columns_of):
            turns = columns(rotor, trace.places[id(rotor)])[0] if rotor is not None and dof in rotor.dofs else NOTHING
            found["H"] += [*_entries(turns, size), *[0.0] * modes, *columns_of[dof]]
        found["H"] += [float(i == j - size) for i in range(modes) for j in range(size + modes + 6)]
        armature = {dof: a for link in own for dof, a in zip(link.dofs, link.armature, strict=True)}
        diagonal = [armature[dof] for dof in sorted(armature)] + [0.0] * modes
        found["Delta"] += [a if i == j else 0.0 for i, a in enumerate(diagonal) for j in range(len(diagonal))]
        found["out"] += _beside(_rotor_inertia(rotor, size), _inertia(trace, node))
        placement = links.placements[node]
        axes, origin = (
            (IDENTITY, ZERO)
            if placement.link is None
            else (trace.axes[id(placement.link)], origins[id(placement.link)])
        )
        at = origin + axes @ placement.offset + (ZERO if placement.link is None else first)
        found["frames"] += [*at, *matrix_quaternion(axes @ placement.matrix)]
    return [Store(array, (i,), value) for array, values in found.items() for i, value in enumerate(values)]


def _hinge_links(trace: Trace, node: int) -> list[Link]:
    """Return the links of a body's own hinge, inboard first."""
    return [x for x in trace.links.links if x.node == node and not isinstance(x.hinge, Deflection | RotorAxis)]


def _modes(trace: Trace, node: int) -> int:
    return len(trace.links.flexible[node].leader.dofs) if node in trace.links.flexible else 0


def _entries(six: Vector, size: int) -> Six:
    """Return the entries of a rotor's motion or force that its node has: all, omega or n about its axis, or none."""
    return [*six] if size == 6 else [six[2]] * size


def _rotor_inertia(rotor: Link | None, size: int) -> list[list[Value]]:
    """Return the rotor's block of M."""
    if rotor is None or rotor.inertia is None:
        return [[0.0] * size for _ in range(size)]
    P = rotor.inertia.articulated
    return [[P.entry(i, j) for j in range(6)] for i in range(6)] if size == 6 else [[P.entry(2, 2)]]


def _beside(first: list[list[Value]], second: list[list[Value]]) -> list[Value]:
    """Return the block diagonal of two matrices, row by row."""
    rows = [[*row, *[0.0] * len(second)] for row in first] + [[*[0.0] * len(first), *row] for row in second]
    return [x for row in rows for x in row]


def _at_node(trace: Trace, node: int, link: Link, column: Vector) -> Six:
    """Return a motion of a link of a body's hinge as a motion of the body's node frame."""
    placement, path = trace.links.placements[node], list[Link]()
    over = placement.link
    while over is not link:
        assert over is not None
        path.append(over)
        over = over.parent
    w, v = Vector(column[:3]), Vector(column[3:])
    for other in reversed(path):
        w, v = trace.places[id(other)].pose.motion_to_child(w, v)
    return [*(x for part in Pose(None, placement.matrix, placement.offset).motion_to_child(w, v) for x in part)]


def _weight(trace: Trace, parent: int, child: int) -> list[Value]:
    """Return w(parent, child), row by row: what a unit force on the child's node does to the parent's.

    Columns are forces on the child's rotor, on its modes, and (n; f) on its body; rows are the forces that these
    cause on the parent's rotor, on its modes, and (n; f) on its body. Forces on the child's modes cause none, and the
    parent's rotor feels none.
    """
    links, scene = trace.links, trace.links.scene
    placement, inner = links.placements[child], links.placements[parent]
    rotor = rotor_link(links, child)
    port = links.ports[child].link if child in links.ports else None  # of a flexible parent
    modes = _modes(trace, child)
    rotor_size = scene.node_sizes[child] - 6 - modes
    parent_rotor_size = scene.node_sizes[parent] - 6 - _modes(trace, parent)
    starts: list[tuple[Link | None, Vector, Vector] | None] = []
    for c in range(rotor_size):
        unit = _unit(c if rotor_size == 6 else 2)
        starts.append((rotor, Vector(unit[:3]), Vector(unit[3:])))
    starts += [None] * modes
    for c in range(6):
        unit = _unit(c)
        at_seat = Pose(None, placement.matrix, placement.offset).force_to_parent(Vector(unit[:3]), Vector(unit[3:]))
        starts.append((placement.link, *at_seat))
    rows: list[list[Value]] = [[] for _ in range(scene.node_sizes[parent])]
    for start in starts:
        if start is None:  # modes of the child
            entries: list[Value] = [0.0] * len(rows)
        else:
            (over, n, f), modal = start, list[Value]()
            while over is not inner.link:
                assert over is not None
                if over is port:
                    modal = [dot(h, (*n, *f)) for h in columns(over, trace.places[id(over)])]
                n, f = trace.places[id(over)].pose.force_to_parent(n, f)
                over = over.parent
            back = inner.matrix.T
            entries = [*[0.0] * parent_rotor_size, *modal, *(back @ (n - cross(inner.offset, f))), *(back @ f)]
        for row, entry in zip(rows, entries, strict=True):
            row.append(entry)
    return [x for row in rows for x in row]


def _unit(c: int) -> Vector:
    return Vector(float(i == c) for i in range(6))


def _inertia(trace: Trace, node: int) -> list[list[Value]]:
    """Return M of a node without its rotor: of its rigid body, or of all pieces of its flexible one, and of the locked
    rotors that ride on it."""
    links, scene = trace.links, trace.links.scene
    riders = [(int(k), scene.hinges[scene.hinge_of[k]]) for k in scene.tree.children[node]]
    riders = [(k, h) for k, h in riders if getattr(h.rotor, "model", "") == "reduced" and links.placements[node].link]
    if node not in links.flexible:
        whole = links.nodes[node].rigid
        for child, hinge in riders:
            whole = whole + locked_inertia(hinge.rotor, *links.nodes[child].tree)
        P = whole.articulated
        return [[P.entry(i, j) for j in range(6)] for i in range(6)]
    own, placement = links.flexible[node], links.placements[node]
    n, leader = len(own.leader.dofs), own.leader
    M: list[list[Value]] = [[0.0] * (n + 6) for _ in range(n + 6)]
    rigid = [_in_link(placement, Vector(float(i == c) for i in range(6))) for c in range(6)]
    ports = {id(port.link) for port in links.ports.values()}
    still = Pose(None, own.axes, own.origin)
    pieces: list[tuple[Rigid, list[Vector]]] = [
        (own.rest, [NOTHING] * n + [Vector(_flat(still.motion_to_child(*motion))) for motion in rigid])
    ]
    for piece in leader.shared_dofs.links:  # type: ignore[union-attr]
        if piece.inertia is not None and id(piece) not in ports:
            place = trace.places[id(piece)]
            moved = [Vector(_flat(place.pose.motion_to_child(*motion))) for motion in rigid]
            pieces.append((piece.inertia, [*columns(piece, place), *moved]))
    for child, hinge in riders:
        port = links.ports[child].link
        assert port is not None
        moved = [Vector(_flat(trace.places[id(port)].pose.motion_to_child(*motion))) for motion in rigid]
        anchor = links.poses["joint_X_p"][scene.hinge_of[child]][0]
        pieces.append(
            (locked_inertia(hinge.rotor, fold_rotation(anchor), ZERO), [*columns(port, trace.places[id(port)]), *moved])
        )
    for inertia, J in pieces:
        forces = [_flat(inertia.apply(Vector(column[:3]), Vector(column[3:]))) for column in J]
        for i in range(n + 6):
            for j in range(i + 1):
                M[i][j] = M[j][i] = M[i][j] + dot(J[i], forces[j])
    for i, a in enumerate(leader.armature):
        M[i][i] = M[i][i] + a
    for (i, j), x in leader.coupling_inertia.items():
        M[i][j] = M[j][i] = M[i][j] + x
    return M


def _in_link(placement: BodyPlacement, motion: Vector) -> Twist:
    """Return a motion of a node frame as one of the frame of the link that it sits on."""
    w, v = placement.matrix @ Vector(motion[:3]), placement.matrix @ Vector(motion[3:])
    return w, v + cross(placement.offset, w)


def _flat(twist: Twist) -> Six:
    return [*twist[0], *twist[1]]
