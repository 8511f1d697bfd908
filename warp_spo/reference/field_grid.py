"""The specification of where shapes touch the grid of a height field: its points, and its lines between them.

A box or a hull touches grid points under its faces that look down, along the face's normal, and grid lines where they
cross its edges, along the normal of both. A capsule touches a point or a line where that is nearest to its axis. A
cylinder that stands is a disc, with RIM edges, and one that lies is a capsule without its ends. Each candidate has a
depth, negative outside. The deepest of each quadrant of the shape are rows of their own: of two the first found
counts, unless the other is deeper by more than TIE, where being farther out counts as deeper by OUTWARD of that.

What is found is discrete: which point or line, and which face or edge. Where it lies follows from the pose and heights.
"""

import numpy as np

from . import hull_corners
from .field_spheres import find_cells

ROW = 9  # numbers of a row: its kind, i, j of a grid point, a direction and a place on the shape, in its axes
NONE, POINT, LINE_Y, LINE_X = 0.0, 1.0, 2.0, 3.0  # kinds: a grid point; from there a line along y, or along x
SIDE, RIMS = 3.0, 7.0  # added to the kinds of what the side of a cylinder touches; kind of a place on a rim
UPRIGHT = 1e-8  # square of the sine below which a face is parallel to a cell, and no place on its rim is the lowest
QUADRANTS, RIM = 4, 32
STANDS = 0.7  # cosine of the lean up to which a cylinder stands
OUTWARD, TIE = 1e-3, 1e-6  # share of the distance from the middle that counts as depth; what is as deep [m]
DOWN = 0.5  # by how much a face or an edge looks down at least: the cosine of 60 degrees
ACROSS = 0.17  # sine of the angle between an edge and a grid line, seen from above, at least
BESIDE = 0.35  # cosine of the angle between a face's normal and the ground's below which its edges may carry
SLACK = 0.5  # share of half the smallest size by which a depth may exceed the way out to the side
PARALLEL = 1e-6  # square of the sine below which an axis and a grid line are parallel


def find(shape, heights, numbers):
    """Return the rows [QUADRANTS, ROW] of a shape: "box", "capsule", "hull", "cylinder"; "sphere": see :func:`_sphere`.

    Of "corners", those of a hull that touch, rows are :func:`.hull_corners.on_field`.

    Args:
        heights: of all fields, row after row. numbers: of the first height of the field; the shape's middle from there
            (3) [m]; its axes, one a row (9); its sizes (3) [m]; the cell along x and y [m]; points along x and y; by
            how much the field may be below the shape [m], beyond which it is not looked at; of a hull the number of
            faces, their normals and distances from the middle, and the edges, see _polyhedron;
            of corners these, along the axes.
    """
    numbers = np.asarray(numbers, dtype=np.float64)
    if shape == "sphere":
        return _sphere(heights, numbers)
    first, centre, axes, sizes, cell, counts, below, table = np.split(numbers, [1, 4, 13, 16, 18, 20, 21])
    counts = counts.astype(int)
    field = heights[int(first[0]) :][: counts[0] * counts[1]].reshape(counts)
    axes = axes.reshape(3, 3)
    if shape == "corners":
        return hull_corners.on_field(field, cell, centre, axes, table.reshape(-1, 3))
    half = np.array([sizes[0], sizes[0], sizes[2] + sizes[0]]) if sizes[1] == 0.0 else sizes
    bottom = centre[2] - np.abs(axes.T[2]) @ half - below[0]
    found = SHAPES[shape](field, cell, centre, axes, sizes, table)
    return _choose([each for each in found if not _is_low(field, each[3], bottom)])


def _is_low(field, row, bottom):
    """Return whether a grid point and its lines, or the cell of a rim, are all below ``bottom``."""
    kind, i, j = row[0], int(row[1]), int(row[2])
    cell = field[i : i + 2, j : j + 2]
    return bool(
        (cell < bottom).all() if kind == RIMS else (cell.ravel()[: cell.size - (cell.size == 4)] < bottom).all()
    )


def _choose(candidates):
    """Return the rows of the best of (depth, u, v, row)."""
    rows, best = np.zeros((QUADRANTS, ROW)), np.full(QUADRANTS, -np.inf)
    rows[:, 3] = 1.0
    for depth, u, v, row in candidates:
        quadrant, score = (u > 0.0) + 2 * (v > 0.0), depth + OUTWARD * (abs(u) + abs(v))
        if score > best[quadrant] + TIE:
            rows[quadrant], best[quadrant] = row, score
    return rows


def _between(low, high, cell, count):
    """Return the first and the last grid point between two places, and where the cells around them end."""
    most = count - 1.0
    low, high = (np.clip(x / cell, 0.0, most) if np.isfinite(x) else 0.0 for x in (low, high))
    return int(np.ceil(low)), int(np.floor(high)), int(np.floor(low)), int(np.ceil(high))


def _box(field, cell, centre, axes, half, table):
    faces = [(sign * unit, size) for unit, size in zip(np.eye(3), half, strict=True) for sign in (-1.0, 1.0)]
    edges = []
    for k in range(3):
        first, second = np.eye(3)[(k + 1) % 3], np.eye(3)[(k + 2) % 3]
        for b, a in ((b, a) for b in (-1.0, 1.0) for a in (-1.0, 1.0)):
            seat = half * (a * first + b * second)
            edges.append((seat, np.eye(3)[k], half[k], a * first, b * second))
    return _polyhedron(field, cell, centre, axes, np.abs(axes.T) @ half, SLACK * half.min(), faces, edges)


def _hull(field, cell, centre, axes, half, table):
    count, rest = int(table[0]), table[1:]
    faces = [(row[:3], row[3]) for row in rest[: 4 * count].reshape(-1, 4)]
    edges = [(row[:3], row[3:6], row[6], row[7:10], row[10:13]) for row in rest[4 * count :].reshape(-1, 13)]
    return _polyhedron(field, cell, centre, axes, np.abs(axes.T) @ half, SLACK * half.min(), faces, edges)


def _polyhedron(field, cell, centre, axes, reach, slack, faces, edges, round_by=np.inf):
    """Return the candidates of a convex polyhedron.

    Args:
        reach: half its extent along x and y. faces: outward normal and distance from the middle. edges: middle,
            direction, half the length, and the normals of both faces. All in the axes of the shape. round_by: how far
            from its third axis it reaches, where that bounds its faces.
    """
    ranges = [_between(centre[f] - reach[f], centre[f] + reach[f], cell[f], field.shape[f]) for f in (0, 1)]
    u, v = ((int(np.abs(axes[:, 2]).argmax()) + more) % 3 for more in (1, 2))
    found, looks = [], [normal @ axes[:, 2] <= -DOWN for normal, _ in faces]
    for i in range(ranges[0][0], ranges[0][1] + 1):
        for j in range(ranges[1][0], ranges[1][1] + 1):
            q = axes @ (np.array([i * cell[0], j * cell[1], field[i, j]]) - centre)
            inside = [offset - normal @ q for normal, offset in faces]
            down = [depth if look else np.inf for depth, look in zip(inside, looks, strict=True)]
            best = int(np.argmin(down))
            out, depth = faces[best][0], down[best]
            side = min(
                (x for x, look, (n, _) in zip(inside, looks, faces, strict=True) if not look and n @ out > -DOWN),
                default=np.inf,
            )
            side = min(side, round_by - np.sqrt(q[0] * q[0] + q[1] * q[1]))
            if np.isfinite(depth) and side >= 0.0 and depth <= side + slack:
                found.append((depth, q[u], q[v], [POINT, i, j, *out, *(faces[best][1] * out)]))
    return found + _edges(field, cell, centre, axes, slack, edges, lambda q: (q[u], q[v]))


def _edges(field, cell, centre, axes, slack, edges, sides):
    """Return the candidates where grid lines cross edges; ``sides``: returns what tells the quadrant of a place."""
    found = []
    for seat, along, half, *both in edges:
        if min(normal @ axes[:, 2] for normal in both) <= -DOWN:
            for f in (0, 1):
                found += _crossings(field, cell, centre, axes, seat, along, half, both, f, slack, sides)
    return found


def _crossings(field, cell, centre, axes, seat, local, half, both, f, slack, sides):
    """Return the candidates where lines at constant x (``f`` 0) or y cross an edge."""
    at, along = centre + axes.T @ seat, axes.T @ local
    o, across, found = 1 - f, along[f], []
    if not abs(across) >= ACROSS:
        return found
    wide = abs(across) * half
    begin, end, *_ = _between(at[f] - wide, at[f] + wide, cell[f], field.shape[f])
    for line in range(begin, end + 1):
        t = (line * cell[f] - at[f]) / across
        place = (at[o] + t * along[o]) / cell[o]
        if abs(t) > half or not 0.0 <= place <= field.shape[o] - 1.0:
            continue
        m = min(int(place), field.shape[o] - 2)
        i, j = (line, m) if f == 0 else (m, line)
        rises = field[i, j + 1] - field[i, j] if f == 0 else field[i + 1, j] - field[i, j]
        rise = rises / cell[o]
        slope = (along[2] - along[o] * rise) / across
        up = 1.0 / np.sqrt(1.0 + rise * rise + slope * slope)
        n = np.array([0.0, 0.0, up])
        n[f], n[o] = -slope * up, -rise * up
        depth = (field[i, j] + (place - m) * rises - at[2] - t * along[2]) * up
        carries = all(normal @ (axes @ n) <= BESIDE for normal in both)
        if abs(rise) <= 1.0 and up >= DOWN and carries and depth <= half - abs(t) + slack:
            q = seat + t * local
            found.append((depth, *sides(q), [LINE_Y if f == 0 else LINE_X, i, j, *local, *seat]))
    return found


def _cylinder(field, cell, centre, axes, sizes, table):
    radius, _, half = sizes
    slack = SLACK * sizes.min()
    rims = _rims(field, cell, centre, axes, sizes)
    if abs(axes[2, 2]) < STANDS:
        across = _across(axes[2])
        beside = _beside_axis(field, cell, centre, axes[2], radius, half, slack, across)
        edges = [edge for end in (-1.0, 1.0) for edge in _rim_edges(radius, half, end)]
        sides = lambda q: (q[2], across @ (axes.T @ q))  # noqa: E731
        return [*beside, *_edges(field, cell, centre, axes, slack, edges, sides), *rims]
    end = -1.0 if axes[2, 2] > 0.0 else 1.0
    face, edges = (np.array([0.0, 0.0, end]), half), _rim_edges(radius, half, end)
    found = _polyhedron(field, cell, centre, axes, np.abs(axes.T) @ sizes, slack, [face], edges, radius)
    return [*found, *rims]


def _rim_edges(radius, half, end):
    """Return the edges of a rim, see _polyhedron."""
    edges, share, face = [], np.pi / RIM, np.array([0.0, 0.0, end])
    for n in range(RIM):
        cos, sin = np.cos(2.0 * share * n), np.sin(2.0 * share * n)
        out = np.array([cos, sin, 0.0])
        seat = radius * np.cos(share) * out + half * face
        edges.append((seat, np.array([-sin, cos, 0.0]), radius * np.sin(share), out, face))
    return edges


def _across(axis):
    """Return the horizontal direction across an axis that lies [3]."""
    across = np.array([-axis[1], axis[0], 0.0])
    return across / np.sqrt(across @ across)


def _rims(field, cell, centre, axes, sizes):
    """Return the candidates where a rim of a cylinder is farthest below the plane of a cell, if that is in the cell."""
    found, lies = [], abs(axes[2, 2]) < STANDS
    reach = np.abs(axes.T) @ sizes
    ranges = [_between(centre[f] - reach[f], centre[f] + reach[f], cell[f], field.shape[f]) for f in (0, 1)]
    for i in range(ranges[0][2], ranges[0][3]):
        for j in range(ranges[1][2], ranges[1][3]):
            for end in (-1.0, 1.0) if lies else (-1.0 if axes[2, 2] > 0.0 else 1.0,):
                corners = field[i : i + 2, j : j + 2]
                place, steep = _on_rim(corners, cell, axes[2], sizes, end)
                s, t = (centre + place)[:2] / cell - (i, j)
                if steep or not (0.0 <= s <= 1.0 and 0.0 <= t <= 1.0):
                    continue
                depth = _in_cell(corners, cell, s, t, (centre + place)[2])[1]
                u, v = (end * sizes[2], _across(axes[2]) @ place) if lies else (axes @ place)[:2]
                found.append((depth, u, v, [RIMS, i, j, end, 0.0, 0.0, 0.0, 0.0, 0.0]))
    return found


def _on_rim(corners, cell, axis, sizes, end):
    """Return the place on a rim, from the middle, farthest against the plane of a cell, and whether that is steep."""
    slope = np.array([corners[1] - corners[0], corners[:, 1] - corners[:, 0]]).mean(axis=1) / cell
    n = np.array([*-slope, 1.0]) / np.sqrt(1.0 + slope @ slope)
    out = n - (n @ axis) * axis
    square = out @ out
    out = out / np.sqrt(square) if square > UPRIGHT else np.zeros(3)
    return end * sizes[2] * axis - sizes[0] * out, bool(slope @ slope > 1.0)


def _in_cell(corners, cell, s, t, z):
    """Return the normal of a cell's surface over a place in it, and the depth of a point at z there."""
    height = np.array([1.0 - s, s]) @ corners @ np.array([1.0 - t, t])
    slope_x = np.array([1.0 - t, t]) @ (corners[1] - corners[0]) / cell[0]
    slope_y = np.array([1.0 - s, s]) @ (corners[:, 1] - corners[:, 0]) / cell[1]
    n = np.array([-slope_x, -slope_y, 1.0]) / np.sqrt(1.0 + slope_x**2 + slope_y**2)
    return n, (height - z) * n[2]


def _capsule(field, cell, centre, axes, sizes, table):
    radius, _, half = sizes
    return _beside_axis(field, cell, centre, axes[2], radius, half)


def _beside_axis(field, cell, centre, axis, radius, half, slack=None, across=None):
    """Return the candidates beside an axis.

    ``slack``, ``across``: of a cylinder, which has faces at the ends of its axis, and its horizontal direction across.
    """
    found = []
    reach = np.abs(axis[:2]) * half + radius
    ranges = [_between(centre[f] - reach[f], centre[f] + reach[f], cell[f], field.shape[f]) for f in (0, 1)]
    for i in range(ranges[0][2], ranges[0][3] + 1):
        for j in range(ranges[1][2], ranges[1][3] + 1):
            corner = np.array([i * cell[0], j * cell[1], field[i, j]])
            w = centre - corner
            along = axis @ w
            found.append((-along, w - along * axis, POINT, i, j))
            for f in (0, 1):
                o = 1 - f
                if (j, i)[f] + 1 >= field.shape[o]:
                    continue
                rises = field[i, j + 1] - field[i, j] if f == 0 else field[i + 1, j] - field[i, j]
                g = np.array([0.0, 0.0, rises])
                g[o] = cell[o]
                square, both, of_line = g @ g, axis @ g, g @ w
                spread = square - both * both
                if not spread > PARALLEL * square:
                    continue
                t = (both * of_line - square * along) / spread
                s = (of_line + both * t) / square
                if 0.0 <= s <= 1.0:
                    found.append((t, w + t * axis - s * g, LINE_Y if f == 0 else LINE_X, i, j))
    rows = []
    for t, away, kind, i, j in found:
        distance = np.sqrt(away @ away)
        if abs(t) < half:
            outside = _height(field, cell, centre + t * axis) <= (centre + t * axis)[2]
            if slack is not None:
                side = away[2] >= DOWN * distance and radius - distance <= half - abs(t) + slack
                kind += SIDE
            if not outside or (away[2] > 0.0 if slack is None else side):
                rows.append(
                    (
                        -distance if slack is None else radius - distance,
                        t,
                        0.0 if slack is None else -(across @ away),
                        [kind, i, j, 1.0 if outside else -1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
                    )
                )
    return rows


def _height(field, cell, at):
    """Return the height of the field at a place [m]."""
    x, y = (np.clip(at[f] / cell[f], 0.0, field.shape[f] - 1.0) for f in (0, 1))
    i, j = (min(int(p), field.shape[f] - 2) for f, p in enumerate((x, y)))
    s, t = x - i, y - j
    return np.array([1.0 - s, s]) @ field[i : i + 2, j : j + 2] @ np.array([1.0 - t, t])


def _sphere(heights, numbers):
    """Return the two cells that a sphere may touch, as :func:`.field_spheres.find_cells`.

    ``numbers``: of the first height; the centre (3) [m]; the cell (2) [m]; points along x and y; how many cells to
    each side are tried; whether for a second cell.
    """
    counts = numbers[6:8].astype(int)
    field = heights[int(numbers[0]) :][: counts[0] * counts[1]].reshape(counts)
    return np.array(find_cells(field, numbers[1:4], numbers[4:6], int(numbers[8]), bool(numbers[9])))


SHAPES = {"box": _box, "capsule": _capsule, "hull": _hull, "cylinder": _cylinder}


def touched(shape, field, cell, centre, axes, sizes, radius, row):
    """Return normal, depth and place on the shape of a row of :func:`find`; None: it touches nothing.

    Args:
        field: heights [i, j]. centre: of the shape, from the field's first point. axes: of the shape, one a row, as
            ``field`` in inertial axes. radius: by which the shape is larger [m].
    """
    kind, i, j = row[0], int(row[1]), int(row[2])
    if kind == NONE:
        return None
    corner = np.array([i * cell[0], j * cell[1], field[i, j]])
    if kind == RIMS:
        corners = field[i : i + 2, j : j + 2]
        at = centre + _on_rim(corners, cell, axes[2], sizes, row[3])[0]
        n, depth = _in_cell(corners, cell, *(at[:2] / cell - (i, j)), at[2])
        return n, depth + radius, at - radius * n
    g = np.array([0.0, 0.0, 0.0])
    beside = shape == "capsule" or kind > SIDE
    size = sizes[0] if shape == "capsule" else sizes[0] + radius
    kind -= SIDE * (kind > SIDE)
    if kind != POINT:
        f = 0 if kind == LINE_Y else 1
        g[1 - f], g[2] = cell[1 - f], (field[i, j + 1] if f == 0 else field[i + 1, j]) - field[i, j]
    if beside:
        w, axis = centre - corner, axes[2]
        t, s = -(axis @ w), 0.0
        if kind != POINT:
            both, square = axis @ g, g @ g
            t = (both * (g @ w) - square * (axis @ w)) / (square - both * both)
            s = (g @ w + both * t) / square
        away = w + t * axis - s * g
        distance = row[3] * np.linalg.norm(away)
        n = away / distance
        return n, size - distance, centre + t * axis - size * n
    out, at = axes.T @ row[3:6], centre + axes.T @ row[6:9]
    if kind == POINT:
        depth = out @ (at - corner)
        return -out, depth + radius, corner + depth * out + radius * out
    t = (corner[f] - at[f]) / out[f]
    at = at + t * out
    n = np.cross(out, g)
    n *= np.sign(n[2]) / np.linalg.norm(n)
    height = corner[2] + (at[1 - f] - corner[1 - f]) / cell[1 - f] * g[2]
    return n, (height - at[2]) * n[2] + radius, at - radius * n
