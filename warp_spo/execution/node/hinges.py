"""The nodes that the kernel of all scenes cannot place, at node granularity: one kernel more, generated for the scene.

That kernel knows screws, balls and free hinges. A hinge of another kind is traced, a thread a world for all of them,
and writes what the other kernel writes.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from ...kernels import native
from ...kernels.elementary import C_TYPE, NATIVE
from ...kernels.spatial import MOTION, POSE
from ...recursions.model.links import Link
from ...scene.scene import Scene
from ...trace.emission import Emitter, Store, render
from ...trace.scalars import Graph
from ...trace.spatial import ZERO, Matrix, Pose, Vector

READ = {"q": 2, "qd": 2, "tree": 3}  # arrays and their axes
WRITTEN = {"pose": POSE, "axis": MOTION, "velocity": MOTION, "bias": MOTION}  # arrays [.., component, world]
MACROS = """\
#define ROW(name, entry) (*wp::address(name, (int)world, (int)(entry)))
#define COLUMN(name, entry, width) (*wp::address(name, (int)(entry) / (width), (int)(entry) % (width), (int)world))
"""


def links(scene: Scene) -> list[Link]:
    """Return the links of all hinges of other kinds, each by itself."""
    found = []
    for node, index in enumerate(scene.hinge_of):
        elements = scene.hinges[index].elements
        if any(kind.node_code is None for kind, _ in elements):
            first, (kind, axis) = int(scene.qd_start[index]), elements[0]
            assert len(elements) == 1 and axis is None and not kind.at_com, "placed by itself, about its anchor"
            dofs = tuple(range(first, first + kind.dofs))
            found.append(Link(None, kind, None, ZERO, None, dofs, int(scene.q_start[index]), (), node))
    return found


def kernel(scene: Scene, T: type, moves: bool) -> wp.Kernel | None:
    """Return the kernel, or None if the scene has no such hinge.

    It takes the worlds, ``q``, with ``moves`` ``qd``, the poses ``tree`` of the parent anchors in the parents' node
    frames, and fills ``pose``, ``axis``, with ``moves`` ``velocity`` and ``bias``.
    """
    some = links(scene)
    if not some:
        return None
    graph, stores = Graph(), []
    for link in some:
        graph.step = f"{link.title}|x"
        stores += _stores(graph, link, moves)
    widths = WRITTEN | {"tree": POSE}

    def place(array: str, entry: str) -> str:
        return f"COLUMN({array}, {entry}, {widths[array]})" if array in widths else f"ROW({array}, {entry})"

    emitter = Emitter(
        T.__name__,
        place,
        lambda array, entry, value: f"{place(array, entry)} = {value};",
        lambda array, index: index[0],
    )
    statements = render(emitter.region(stores), T.__name__)
    text = f"{NATIVE[C_TYPE[T]]}const int world = thread;\n{MACROS}{statements}\n#undef ROW\n#undef COLUMN\n"
    return native.kernel("hinges", text, [(name, READ.get(name, 3)) for name in names(moves)], T)


def names(moves: bool) -> list[str]:
    """Return the arrays that the kernel takes after the worlds."""
    return [name for name in (*READ, *WRITTEN) if moves or name not in ("qd", "velocity", "bias")]


def _stores(graph: Graph, link: Link, moves: bool) -> list[Store]:
    hinge, node = link.hinge, link.node
    place = hinge.transform(link, lambda i: graph.input("q", i))
    rows = np.reshape([graph.input("tree", POSE * node + i) for i in range(POSE)], (4, 3)).tolist()
    tree = Pose(None, Matrix.of(rows[:3]), Vector(rows[3]))
    rotation = tree.rotation @ place.pose.rotation
    pose = [x for row in (*rotation, tree.point_to_parent(place.pose.l)) for x in row]
    stores = [Store("pose", (POSE * node + i,), value) for i, value in enumerate(pose)]
    for dof, (w, v) in zip(link.dofs, hinge.columns(place), strict=True):
        stores += [Store("axis", (MOTION * dof + i,), value) for i, value in enumerate((*w, *v))]
    if moves:
        rates = [graph.input("qd", dof) for dof in link.dofs]
        bias = hinge.own_bias(place, rates) or (ZERO, ZERO)
        for name, (w, v) in (("velocity", hinge.velocity(place, rates)), ("bias", bias)):
            stores += [Store(name, (MOTION * node + i,), value) for i, value in enumerate((*w, *v))]
    return stores
