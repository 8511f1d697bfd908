"""The specification of where capsules and cylinders touch the grid of a height field, and the inside of its cells."""

import numpy as np

from .field_cells import over_cell, twist_of
from .field_edges import (
    BENT,
    BESIDE,
    INSIDE,
    LINE_X,
    LINE_Y,
    LOW,
    POINT,
    RIMS,
    SIDE,
    SLACK,
    STEEPEST,
    between,
    cells_under,
    crossings,
    in_cell,
    looks_down,
    points,
)

RIM = 32  # edges that stand for a rim
STANDS, LEANS = 0.7, 0.95  # cosine of the lean up to which a cylinder stands, and from which its side touches
FLAT = 1e-4  # sine below which a rim is parallel to a cell, and no place on it is the lowest
TURNS, NEARINGS = 3, 6  # steps to a place on a rim, and to the nearest line of a cell
NEAR = 1e-3  # share of a cell by which the last of these may move
PARALLEL = 1e-6  # square of the sine below which an axis and a grid line are parallel


def cylinder(field, cell, centre, axes, sizes, table):
    """Return the candidates of a cylinder."""
    radius, _, half = sizes
    lean, slack = axes[2, 2], SLACK * sizes.min()
    lies, leans, end, found = abs(lean) < STANDS, abs(lean) <= LEANS, -1.0 if lean > 0.0 else 1.0, []
    sides = lambda q: (q[0], q[1])  # noqa: E731
    if lies:
        across = np.array([-axes[2, 1], axes[2, 0], 0.0]) / np.hypot(*axes[2, :2])
        sides = lambda q: (q[2], across @ (axes.T @ q))  # noqa: E731
    if leans:
        beside = _beside_axis(field, cell, centre, axes[2], radius, half, True)
        for t, away, distance, row in beside:
            q = axes @ -away
            found.append((radius - distance, *sides(np.array([*q[:2], t])), row))
    if abs(lean) >= LOW:
        face = (np.array([0.0, 0.0, end]), half)
        reach = np.abs(axes.T) @ sizes
        found += points(field, cell, centre, axes, reach, 0.0 if leans else slack, [face], sides, radius)
    for each in (end, -end) if leans else (end,):
        for edge in _rim_edges(radius, half, each):
            found += crossings(field, cell, centre, axes, edge, slack, sides, radius)
            found += _on_rim(field, cell, centre, axes, sizes, edge, each, sides)
    return found


def _rim_edges(radius, half, end):
    """Return the edges of a rim, see :func:`.field_edges.polyhedron`."""
    edges, share, face = [], np.pi / RIM, np.array([0.0, 0.0, end])
    for n in range(RIM):
        cos, sin = np.cos(2.0 * share * n), np.sin(2.0 * share * n)
        out = np.array([cos, sin, 0.0])
        seat = radius * np.cos(share) * out + half * face
        edges.append((seat, np.array([-sin, cos, 0.0]), radius * np.sin(share), out, face))
    return edges


def _on_rim(field, cell, centre, axes, sizes, edge, end, sides):
    """Return the candidates on the part of a rim at an edge where it is farthest below the inside of a cell."""
    seat, local, width, out, face = edge
    found, per = [], np.pi / RIM / width
    if not looks_down(axes, (out, face), LOW):
        return found
    for i, j, first, last in cells_under(field, cell, centre + axes.T @ seat, axes.T @ local, width):
        if not first < last:
            continue
        corners = field[i : i + 2, j : j + 2]

        def at(angle, corners=corners, i=i, j=j):
            q = np.cos(angle) * out + np.sin(angle) * local
            return RimPlace(corners, cell, (i, j), centre, axes, sizes, end, q[0], q[1])

        begin, stop = (at(per * x).grade for x in (first, last))
        if not (begin > 0.0 and stop <= 0.0):
            continue
        angle = (first + (last - first) * begin / (begin - stop)) * per
        for _ in range(TURNS):
            place = at(angle)
            angle -= place.grade / place.curve if place.curve < -FLAT else 0.0
            angle = np.clip(angle, first * per, last * per)
        place = at(angle)
        if not place.curve < -FLAT:
            continue
        n, depth = in_cell(corners, cell, *place.part, (centre + place.offset)[2])
        if n[2] >= STEEPEST and place.out @ n <= BESIDE and end * (axes[2] @ n) <= BESIDE:
            q = np.cos(angle) * out + np.sin(angle) * local
            row = [RIMS, i, j, end, q[0], q[1], 1.0 / place.curve, 0.0, 0.0]
            found.append((depth, *sides(sizes[0] * q + sizes[2] * face), row))
    return found


class RimPlace:
    """A place on a rim over a cell.

    Attributes:
        offset: from the cylinder's middle. out, way: away from the axis, and along the rim. part: where in the cell.
        grade: how steeply the rim falls into the ground. curve: how that changes along the rim, times the radius.
    """

    def __init__(self, corners, cell, first, centre, axes, sizes, end, cos, sin):
        self.out, self.way = axes.T @ [cos, sin, 0.0], axes.T @ [-sin, cos, 0.0]
        self.offset = end * sizes[2] * axes[2] + sizes[0] * self.out
        self.part = (centre + self.offset)[:2] / cell - first
        slope, _ = over_cell(corners, cell, *self.part)
        twist = 2.0 * twist_of(corners) / (cell[0] * cell[1])
        self.grade = slope @ self.way[:2] - self.way[2]
        self.curve = sizes[0] * twist * self.way[0] * self.way[1] - slope @ self.out[:2] + self.out[2]


def capsule(field, cell, centre, axes, sizes, table):
    """Return the candidates of a capsule."""
    radius, _, half = sizes
    beside = _beside_axis(field, cell, centre, axes[2], radius, half, False)
    return [(-distance, t, 0.0, row) for t, away, distance, row in beside]


def _beside_axis(field, cell, centre, axis, radius, half, ends):
    """Return (t, away, distance, row) of what an axis is beside; ``ends``: of a cylinder, which has faces there."""
    found = []
    reach = np.abs(axis[:2]) * half + radius
    ranges = [between(centre[f] - reach[f], centre[f] + reach[f], cell[f], field.shape[f]) for f in (0, 1)]
    for i in range(ranges[0][2], ranges[0][3] + 1):
        for j in range(ranges[1][2], ranges[1][3] + 1):
            w = centre - np.array([i * cell[0], j * cell[1], field[i, j]])
            along = axis @ w
            found.append((-along, w - along * axis, [POINT, i, j]))
            for f in (0, 1):
                o = 1 - f
                if (j, i)[f] + 1 >= field.shape[o]:
                    continue
                g = np.zeros(3)
                g[o], g[2] = cell[o], (field[i, j + 1] if f == 0 else field[i + 1, j]) - field[i, j]
                if (g @ g) - (axis @ g) ** 2 > PARALLEL * (g @ g):
                    t, s, away = nearest_on_line(axis, w, g)
                    if 0.0 <= s <= 1.0:
                        found.append((t, away, [LINE_Y if f == 0 else LINE_X, i, j]))
            if i + 1 < field.shape[0] and j + 1 < field.shape[1]:
                found += _beside_cell(field[i : i + 2, j : j + 2], cell, axis, w, (i, j))
    rows = []
    for t, away, (kind, *place) in found:
        distance = np.sqrt(away @ away)
        if abs(t) < half:
            outside = _height(field, cell, centre + t * axis) <= (centre + t * axis)[2]
            side = away[2] >= STEEPEST * distance and radius - distance <= half - abs(t)
            if not outside or (side if ends else away[2] > 0.0):
                row = [kind + SIDE * ends, *place[:2], 1.0 if outside else -1.0, *place[2:]]
                rows.append((t, away, distance, row + [0.0] * (9 - len(row))))
    return rows


def nearest_on_line(axis, w, g):
    """Return places on an axis and on a line nearest to each other, and the way from there to the axis.

    ``w``: from the beginning of the line to that of the axis. ``g``: along the line; the place on it is a share of g.
    """
    both, square = axis @ g, g @ g
    t = (both * (g @ w) - square * (axis @ w)) / (square - both * both)
    s = (g @ w + both * t) / square
    return t, s, w + t * axis - s * g


def _beside_cell(corners, cell, axis, w, first):
    """Return (t, away, row) where the inside of a bent cell is nearest to an axis; ``w``: from its first corner."""
    twist = twist_of(corners)
    if not (abs(twist) > BENT and twist * axis[0] * axis[1] < 0.0):
        return []
    share = 0.5
    for step in range(NEARINGS):
        t, s, away, gain, farther = line_of_cell(corners, cell, axis, w, share)
        if step == NEARINGS - 1:
            break
        share -= gain / farther if farther < 0.0 else -0.25 if gain > 0.0 else 0.25
        share = np.clip(share, 0.0, 1.0)
    if not (farther < 0.0 and abs(gain / farther) < NEAR and 0.0 <= share <= 1.0 and 0.0 <= s <= 1.0):
        return []
    return [(t, away, [INSIDE, *first, share, 1.0 / farther])]


def line_of_cell(corners, cell, axis, w, share):
    """Return how an axis is beside a line along y in a cell, ``share`` of the cell from its first one.

    Returns:
        place on the axis, share of the line, the way from there to the axis; by how much the square of the distance, of
        which a half counts, falls along x, and how that changes.
    """
    run, rise, twist = corners[1, 0] - corners[0, 0], corners[0, 1] - corners[0, 0], twist_of(corners)
    g = np.array([0.0, cell[1], rise + twist * share])
    t, s, away = nearest_on_line(axis, w - share * np.array([cell[0], 0.0, run]), g)
    p = np.array([cell[0], 0.0, run + twist * s])  # along the other lines of the cell
    both, square = axis @ g, g @ g
    more = (both * (axis @ p) - p @ g + twist * away[2]) / (square - both * both)
    change = -p + (axis @ p + more * both) * axis - more * g
    return t, s, away, away @ p, change @ p + away[2] * twist * more


def _height(field, cell, at):
    """Return the height of the field at a place [m]."""
    x, y = (np.clip(at[f] / cell[f], 0.0, field.shape[f] - 1.0) for f in (0, 1))
    i, j = (min(int(p), field.shape[f] - 2) for f, p in enumerate((x, y)))
    s, t = x - i, y - j
    return np.array([1.0 - s, s]) @ field[i : i + 2, j : j + 2] @ np.array([1.0 - t, t])
