"""Tables that a solver in joint space reads of a scene: the order of its dofs, their axes and laws, and its pairs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..kernels import joint_space
from ..recursions.contact import coupled
from ..recursions.contact.pairs import inverse_weights
from ..recursions.contact.points import inverse_weights as point_weights
from ..recursions.model.links import Links
from ..recursions.step.joint_laws import DEFAULT_BOUND, HOLD, neutral_inertias
from ..scene.contact_values import TURNING_VALUES
from ..scene.parts import UNLIMITED
from ..scene.scene import Scene

MOST_PLACES = 256  # of dofs, each limb's even; tables hold a place in 8 bits
NONE = 1e30  # a bound that no force or rate reaches
SIGNS = {-1: 0, 0: 1, 1: 2}  # two bits of a column


class JointTables(NamedTuple):
    """Tables of a scene.

    Attributes:
        sizes: of the system. place: integers, see :class:`~warp_spo.kernels.joint_space.Sizes`.
        dof_values, pair_values: constants, flat. pairs: the order of the scene's pairs here.
    """

    sizes: joint_space.Sizes
    place: np.ndarray
    dof_values: np.ndarray
    pair_values: np.ndarray
    pairs: list[int]


def joint_tables(
    scene: Scene,
    pattern: tuple[np.ndarray, np.ndarray],
    near: int,
    slots: int,
    surfaces: list[range],
    motors: tuple[int, ...],
    routines: list[int],
) -> JointTables:
    """Return the tables of a scene whose packed mass matrix has rows and columns ``pattern``.

    ``near``: pairs at most that are near in a world. ``slots``: points of pairs at most. ``surfaces``: of each point
    with the ground, the numbers of the surfaces that it may touch. ``motors``: see :func:`motor_laws`. ``routines``: of
    each pair the number of the routine that finds its points; pairs of one follow each other, so that threads of a warp
    find the points of like pairs; those of routines with high numbers, which take longest, come first.
    """
    dofs_of = _dofs_by_body(scene)
    ways = _ways(scene)
    order = _order(scene, dofs_of, ways)
    position = {dof: i for i, dof in enumerate(order) if dof >= 0}
    tiles = len(order) // 2
    couples, columns = _couples(scene, dofs_of, ways, position)
    pairs = sorted(range(len(scene.contact_pairs)), key=lambda i: (-routines[i], i))
    rows, cols = pattern
    sizes = joint_space.Sizes(
        scene.dof_count, tiles, len(rows), len(pairs), len(couples), max(map(len, columns), default=0), near,
        slots + sum(map(len, surfaces)), sum(map(len, surfaces)), len(surfaces), sum(motors),
    )  # fmt: skip
    held, masks = _held_tiles(rows, cols, position, tiles)
    sizes = sizes._replace(held=1 + max(held))
    entries = [4 * held[_tile(i, j)] + 2 * (i % 2) + j % 2 for i, j in _places(rows, cols, position)]
    coordinate, dof_values = _dofs(scene)
    own = [joint_space.DOF_VALUES.index(name) for name in ("stiffness", "ke", "kd")]
    dof_values[np.ix_(np.flatnonzero(motors), np.array(own))] = 0.0
    table: list[int] = [*order, *entries]
    table += _words(masks, sizes.words) + held
    table += _words([sum(1 << (column & 255) for column in each) for each in columns], sizes.words)
    for each in columns:
        table += [len(each), *each, *[0] * (sizes.columns - len(each))]
    for pair in pairs:
        table += [couples[_bodies(scene, pair)], len(scene.contact_points) + pair]
    numbers = [number for number, own in enumerate(surfaces) for _ in own]
    table += [x for number in numbers for x in (couples[scene.contact_points[number].body, -1], number)]
    table += coordinate
    met: list[list[int]] = [[] for _ in order]  # entry and the other dof, of each dof
    for entry, (i, j) in zip(entries, _places(rows, cols, position), strict=True):
        for one, other in {(i, j), (j, i)}:
            met[one].append(entry << 8 | other)
    table += [*np.cumsum([0, *map(len, met)]).tolist(), *(x for row in met for x in sorted(row))]
    table += np.cumsum([0, *motors]).tolist()
    assert len(table) == sizes.table_starts["END"]
    place = np.array(table, dtype=np.int64).astype(np.uint32).view(np.int32)
    return JointTables(sizes, place, np.ravel(dof_values), _pair_values(scene, pairs, numbers), pairs)


def find_obstacle(scene: Scene, variable: tuple[str, ...]) -> str:
    """Return in words what a scene has that the solver in joint space does not take; "" if nothing."""
    some: bool | np.bool
    found = ["bodies with modes"] * any(body.modes is not None for body in scene.bodies)
    found += ["dofs without inertia"] * (not (neutral_inertias(scene) > 0.0).all())
    count = len(scene.contact_points)
    for name in TURNING_VALUES:
        some = name in variable or scene.values[name][:, :count].any()
        found += [name.removeprefix("contact_").replace("_", " ")] * bool(count and some)
    found += ["boxes without thickness"] * any(
        shape.has_faces and not (shape.size > 0.0).all() for pair in scene.contact_pairs for shape in pair.shapes
    )
    if not found and len(_order(scene, _dofs_by_body(scene), _ways(scene))) > MOST_PLACES:
        found.append(f"{scene.dof_count} dofs")
    return found[0] if found else ""


def why_unsolved(scene: Scene) -> str:
    """Return why no step takes the pairs of a scene; "" if one does, by generated code for few or in joint space."""
    obstacle = find_obstacle(scene, ())
    if not obstacle or coupled.is_supported(Links(scene)):
        return ""
    return f"steps of a scene with {obstacle} do not solve such pairs in joint space"


def way_out(obstacle: str) -> str:
    """Return what a user may do about pairs in a scene with an ``obstacle``, see :func:`find_obstacle`."""
    ways = {
        "bodies with modes": "leave out modes= of its bodies",
        "dofs without inertia": "give their bodies mass, or their hinges armature=",
        "boxes without thickness": "give boxes half sizes above zero",
        **{name.removeprefix("contact_").replace("_", " "): f"set {name} to zero, and leave it out of variable="
           for name in TURNING_VALUES},
    }  # fmt: skip
    way = ways.get(obstacle, "use another solver, such as Newton's SolverMuJoCo")
    return f"{way}; or list few pairs of capsules, boxes and hulls, which need no joint space"


def motor_laws(scene: Scene, variable: tuple[str, ...]) -> tuple[int, ...]:
    """Return how many laws of its spring, drive and actuators each dof has that are computed with the bias force.

    They are those of dofs with actuators, and of hinges that turn freely with springs or position drives.
    """
    counts = np.zeros(scene.dof_count, dtype=int)
    for actuator in scene.actuators:
        for hinge in actuator.hinges:
            counts[scene.qd_start[hinge]] += 1
    counts[counts > 0] += 2
    for hinge, dofs in zip(scene.hinges, _dofs_of(scene), strict=True):
        if hinge.coord_count > hinge.dof_count:
            for name in ("joint_stiffness", "joint_target_ke"):
                some = name in variable or scene.values[name][:, dofs].any()
                counts[dofs] = np.maximum(counts[dofs], 2 * bool(some))
    return tuple(counts.tolist())


def _dofs_of(scene: Scene) -> list[np.ndarray]:
    """Return the dofs of each hinge."""
    return [np.arange(a, b) for a, b in zip(scene.qd_start[:-1], scene.qd_start[1:], strict=True)]


def _dofs_by_body(scene: Scene) -> list[np.ndarray]:
    hinges = _dofs_of(scene)
    return [hinges[hinge] for hinge in scene.hinge_of]


def _ways(scene: Scene) -> list[list[int]]:
    """Return the bodies from each body to the root of its tree, itself first."""
    found = []
    for body in range(len(scene.bodies)):
        way = [body]
        while scene.tree.parent[way[-1]] >= 0:
            way.append(int(scene.tree.parent[way[-1]]))
        found.append(way)
    return found


def _bodies(scene: Scene, pair: int) -> tuple[int, int]:
    return scene.contact_pairs[pair].body, scene.contact_pairs[pair].other


def _order(scene: Scene, dofs_of: list[np.ndarray], ways: list[list[int]]) -> list[int]:
    """Return dofs in the order of elimination, each limb from an even place on; -1 fills.

    Trees that may touch others in many ways come last, and children before what carries them, so that limbs fill
    nothing.
    """
    trees: dict[int, list[int]] = {}
    for body, way in enumerate(ways):
        trees.setdefault(way[-1], []).append(body)
    met = dict.fromkeys(trees, 0)
    for pair in scene.contact_pairs:
        roots = {ways[body][-1] for body in (pair.body, pair.other) if body >= 0}
        for root in roots if len(roots) > 1 else ():
            met[root] += 1
    order: list[int] = []
    sizes = {root: sum(len(dofs_of[body]) for body in bodies) for root, bodies in trees.items()}
    for root in sorted(trees, key=lambda root: (met[root], -sizes[root], root)):
        children: dict[int, list[int]] = {body: [] for body in trees[root]}
        for body in trees[root]:
            if body != root:
                children[ways[body][1]].append(body)
        _add_limbs(root, children, dofs_of, order)
    return order


def _add_limbs(root: int, children: dict[int, list[int]], dofs_of: list[np.ndarray], order: list[int]) -> None:
    """Add a tree's dofs, leaves first; a limb is a chain of bodies without branches."""
    chain = [root]
    while len(children[chain[-1]]) == 1:
        chain += children[chain[-1]]
    for child in children[chain[-1]]:
        _add_limbs(child, children, dofs_of, order)
    for body in reversed(chain):
        order += dofs_of[body].tolist()
    order += [-1] * (len(order) % 2)


def _couples(
    scene: Scene, dofs_of: list[np.ndarray], ways: list[list[int]], position: dict[int, int]
) -> tuple[dict[tuple[int, int], int], list[list[int]]]:
    """Return the number of each couple of bodies, and its columns: block, and which way each dof moves the first."""
    couples: dict[tuple[int, int], int] = {}
    columns = []
    touching = [_bodies(scene, pair) for pair in range(len(scene.contact_pairs))]
    for bodies in (*touching, *((point.body, -1) for point in scene.contact_points)):
        if bodies in couples:
            continue
        couples[bodies] = len(couples)
        first, second = (set(ways[body]) if body >= 0 else set() for body in bodies)
        signs = {position[dof]: sign for sign, own in ((1, first - second), (-1, second - first))
                 for body in own for dof in dofs_of[body].tolist()}  # fmt: skip
        blocks = sorted({at // 2 for at in signs})
        columns.append([b | SIGNS[signs.get(2 * b, 0)] << 8 | SIGNS[signs.get(2 * b + 1, 0)] << 10 for b in blocks])
    return couples, columns


def _places(rows: np.ndarray, cols: np.ndarray, position: dict[int, int]) -> list[tuple[int, int]]:
    """Return row and column of each entry of the mass matrix, by places, in its lower triangle."""
    both = [sorted((position[i], position[j])) for i, j in zip(rows.tolist(), cols.tolist(), strict=True)]
    return [(high, low) for low, high in both]


def _tile(i: int, j: int) -> int:
    """Return which tile of the triangle two places have."""
    return (i // 2) * (i // 2 + 1) // 2 + j // 2


def _held_tiles(
    rows: np.ndarray, cols: np.ndarray, position: dict[int, int], tiles: int
) -> tuple[list[int], list[int]]:
    """Return the number of each tile of the triangle among those of the mass matrix, or -1, and masks of columns."""
    held, masks = [-1] * (tiles * (tiles + 1) // 2), [0] * tiles
    for i, j in _places(rows, cols, position):
        if held[_tile(i, j)] < 0:
            held[_tile(i, j)] = 1 + max(held)
        if i // 2 != j // 2:
            masks[j // 2] |= 1 << (i // 2)
    return held, masks


def _words(masks: list[int], words: int) -> list[int]:
    """Return masks in so many words of 32 bits each."""
    return [(mask >> shift) & 0xFFFFFFFF for mask in masks for shift in range(0, 32 * words, 32)]


def _dofs(scene: Scene) -> tuple[list[int], np.ndarray]:
    """Return of each dof its coordinate, -1 where it has none of its own, and its constants."""
    count, value = scene.dof_count, lambda name: np.asarray(scene.values[name][0], dtype=np.float64)
    of = {name: np.zeros(count) for name in joint_space.DOF_VALUES}
    names = {"stiffness": "joint_stiffness", "damping": "joint_damping", "ke": "joint_target_ke",
             "kd": "joint_target_kd", "dry": "joint_friction", "limit_ke": "joint_limit_ke",
             "limit_kd": "joint_limit_kd"}  # fmt: skip
    for name, source in names.items():
        of[name][:] = value(source)
    effort, fastest = value("joint_effort_limit"), value("joint_velocity_limit")
    of["effort"] = np.where(effort < DEFAULT_BOUND, effort, NONE)
    of["fastest"] = np.where(np.abs(fastest) < DEFAULT_BOUND, fastest, NONE)
    inertia = np.array([neutral_inertias(scene)[dof] for dof in range(count)])
    of["weight"] = 1.0 / inertia
    of["brake"] = HOLD * inertia  # over h
    for name in ("lower", "upper"):
        bound = value(f"joint_limit_{name}")
        of[name] = np.where(np.abs(bound) < UNLIMITED, bound, NONE)
    coordinate = [-1] * count
    for hinge, dofs, first in zip(scene.hinges, _dofs_of(scene), scene.q_start, strict=False):
        for i, dof in enumerate(dofs.tolist()):
            if hinge.coord_count == hinge.dof_count:
                coordinate[dof] = int(first) + i
                of["rest"][dof] = value("joint_rest_q")[first + i]
    return coordinate, np.stack([of[name] for name in joint_space.DOF_VALUES], axis=1)


def _pair_values(scene: Scene, pairs: list[int], numbers: list[int]) -> np.ndarray:
    """Return the constants of pairs, then of the points with these numbers, and half of gravity."""
    first, points = len(scene.contact_points), scene.contact_points
    values = [scene.values[f"contact_{name}"][0] for name in ("stiffness", "damping", "friction")]
    weights = inverse_weights(scene) if pairs else []
    rows = [[*(x[first + i] for x in values), scene.contact_pairs[i].eps, weights[i]] for i in pairs]
    of_points = point_weights(scene) if numbers else []
    rows += [[*(x[i] for x in values), points[i].eps, of_points[i]] for i in numbers]
    return np.append(np.ravel(rows), 0.5 * np.linalg.norm(scene.values["gravity"][0]))
