"""The specification of where edges and corners of shapes touch the bilinear cells of a height field, and their lines.

Along an edge the field is quadratic in each cell. Seen from the edge it has its tops where the edge crosses a line of
the grid, and inside of a cell that is bent downward along the edge. There the normal is that of the field's surface.
"""

import numpy as np

from .field_cells import over_cell, twist_of

NONE, POINT, INSIDE, VERTEX, LINE_Y, LINE_X = 0.0, 1.0, 2.0, 3.0, 4.0, 5.0
"""Kinds: a grid point; the inside of the cell from there; a corner of the shape in it; its lines along y, and x."""
SIDE, RIMS = 5.0, 11.0  # added to the kinds of what the side of a cylinder touches; kind of a place on a rim
DOWN = 0.5  # by how much a face or an edge looks down at least: the cosine of 60 degrees
ACROSS = 0.17  # sine of the angle between an edge and a grid line, seen from above, at least
LOW, PASSES = 0.1, 0.02  # as DOWN and ACROSS, where an edge crosses a crease
STEEPEST = 0.1  # cosine of the steepest slope that such an edge, or the side of a cylinder, touches
BENT = 4e-4  # of a cell, how far a corner is from the plane of the others [m], from which its inside is looked at
BESIDE = 0.35  # cosine of the angle between a face's normal and the ground's below which its edges may carry
SLACK = 0.5  # share of half the smallest size by which a depth may exceed the way out to the side
PARALLEL = 1e-6  # below which a direction does not lead along an axis


def between(low, high, cell, count):
    """Return the first and the last grid point between two places, and where the cells around them end."""
    most = count - 1.0
    low, high = (np.clip(x / cell, 0.0, most) if np.isfinite(x) else 0.0 for x in (low, high))
    return int(np.ceil(low)), int(np.floor(high)), int(np.floor(low)), int(np.ceil(high))


def polyhedron(field, cell, centre, axes, reach, slack, faces, edges, lower=None):
    """Return the candidates of a convex polyhedron.

    Args:
        reach: half its extent along x and y. faces: outward normal and distance from the middle. edges: middle,
            direction, half the length, and the normals of both faces. All in the axes of the shape. lower: of a box,
            the axis whose lower corners are points of their own; None: all corners are looked at.
    """
    u, v = ((int(np.abs(axes[:, 2]).argmax()) + more) % 3 for more in (1, 2))
    sides = lambda q: (q[u], q[v])  # noqa: E731
    found = points(field, cell, centre, axes, reach, slack, faces, sides)
    for edge in edges:
        found += crossings(field, cell, centre, axes, edge, slack, sides)
        found += _inside_cells(field, cell, centre, axes, edge, slack, sides)
        found += _corners(field, cell, centre, axes, edge, sides, lower)
    return found


def points(field, cell, centre, axes, reach, slack, faces, sides, round_by=np.inf):
    """Return the candidates under faces; ``round_by``: how far a shape reaches from its third axis if that bounds it.

    ``sides``: returns what tells the quadrant of a place.
    """
    ranges = [between(centre[f] - reach[f], centre[f] + reach[f], cell[f], field.shape[f]) for f in (0, 1)]
    found, looks = [], [normal @ axes[:, 2] <= -DOWN for normal, _ in faces]
    steep = [-DOWN < normal @ axes[:, 2] <= -LOW for normal, _ in faces]
    for i in range(ranges[0][0], ranges[0][1] + 1):
        for j in range(ranges[1][0], ranges[1][1] + 1):
            q = axes @ (np.array([i * cell[0], j * cell[1], field[i, j]]) - centre)
            inside = np.array([offset - normal @ q for normal, offset in faces])
            best, aside = (int(np.where(which, inside, np.inf).argmin()) for which in (looks, steep))
            depth = inside[best] if looks[best] else np.inf
            if steep[aside] and inside[aside] < depth and is_top(field, cell, i, j, -axes.T @ faces[aside][0]):
                best, depth = aside, inside[aside]
            out = faces[best][0]
            side = min(
                (
                    x
                    for n, (x, look, (normal, _)) in enumerate(zip(inside, looks, faces, strict=True))
                    if n != best and not look and normal @ out > -DOWN
                ),
                default=np.inf,
            )
            side = min(side, round_by - np.sqrt(q[0] * q[0] + q[1] * q[1]))
            if np.isfinite(depth) and side >= 0.0 and depth <= side + slack:
                found.append((depth, *sides(q), [POINT, i, j, *out, *(faces[best][1] * out)]))
    return found


def is_top(field, cell, i, j, n):
    """Return whether the field falls away along its lines from a plane with the normal ``n`` at a grid point."""
    for f, (along, across) in enumerate(((i, j), (j, i))):
        m = min(across, field.shape[1 - f] - 2)
        before, after = (_slope_beside(field, cell, along + beside, m, across - m, f) for beside in (-1, 0))
        if not before * n[2] >= -n[f] >= after * n[2]:
            return False
    return True


def looks_down(axes, both, least):
    """Return whether a face of an edge looks down by ``least``."""
    return min(normal @ axes[:, 2] for normal in both) <= -least


def carries(axes, both, n):
    """Return whether an edge may touch a surface with the normal ``n``: no face of it looks up along that."""
    return all(normal @ (axes @ n) <= BESIDE for normal in both)


def crossings(field, cell, centre, axes, edge, slack, sides, radius=np.inf):
    """Return the candidates where grid lines cross an edge; ``radius``: of the rim of which it is a part.

    On steep lines, along those that an edge nearly follows, and if no face of the edge looks down by DOWN, only those
    on creases count, where the field falls away from the edge on both sides.
    """
    seat, local, half, *both = edge
    at, along, found = centre + axes.T @ seat, axes.T @ local, []
    for f in (0, 1) if looks_down(axes, both, LOW) else ():
        o, across = 1 - f, along[f]
        if not abs(across) >= PASSES:
            continue
        wide = abs(across) * half
        begin, end, *_ = between(at[f] - wide, at[f] + wide, cell[f], field.shape[f])
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
            if not carries(axes, both, n) or depth > half - abs(t) + slack:
                continue
            if not (looks_down(axes, both, DOWN) and abs(rise) <= 1.0 and up >= DOWN and abs(across) >= ACROSS):
                way = along - t / radius * (axes.T @ both[0])
                falls = (way[2] - way[o] * rise) / way[f]
                before, after = (_slope_beside(field, cell, line + side, m, place - m, f) for side in (-1, 0))
                if not (up >= STEEPEST and before >= falls >= after):
                    continue
            q = seat + t * local
            found.append((depth, *sides(q), [LINE_Y if f == 0 else LINE_X, i, j, *local, *seat]))
    return found


def _slope_beside(field, cell, n, m, part, f):
    """Return the slope along axis ``f`` in its cell n, m across, at ``part`` of that; beyond the edges it is level."""
    if not 0 <= n <= field.shape[f] - 2:
        return 0.0
    h = field[n : n + 2, m : m + 2] if f == 0 else field[m : m + 2, n : n + 2].T
    return np.array([1.0 - part, part]) @ (h[1] - h[0]) / cell[f]


def cells_under(field, cell, at, along, half):
    """Yield i, j of the cells that a line passes, seen from above, and from where to where it is in each [m]."""
    within = lambda f, i, first, last: (  # noqa: E731
        (first, last)
        if not abs(along[f]) > PARALLEL
        else (
            max(first, min((i * cell[f] - at[f]) / along[f], ((i + 1) * cell[f] - at[f]) / along[f])),
            min(last, max((i * cell[f] - at[f]) / along[f], ((i + 1) * cell[f] - at[f]) / along[f])),
        )
    )
    wide = abs(along[0]) * half
    *_, begin, end = between(at[0] - wide, at[0] + wide, cell[0], field.shape[0])
    for i in range(begin, end):
        first, last = within(0, i, -half, half)
        a, b = at[1] + first * along[1], at[1] + last * along[1]
        *_, low, high = between(min(a, b), max(a, b), cell[1], field.shape[1])
        for j in range(low, high):
            yield i, j, *within(1, j, first, last)


def _inside_cells(field, cell, centre, axes, edge, slack, sides):
    """Return the candidates where an edge is farthest below the inside of a bent cell."""
    seat, local, half, *both = edge
    at, along, found = centre + axes.T @ seat, axes.T @ local, []
    if not looks_down(axes, both, LOW):
        return found
    for i, j, *_ in cells_under(field, cell, at, along, half):
        corners, (x, y) = field[i : i + 2, j : j + 2], along[:2] / cell
        s, t = at[:2] / cell - (i, j)
        bend = 2.0 * twist_of(corners) * x * y
        if not (abs(twist_of(corners)) > BENT and bend < 0.0):
            continue
        slope, _ = over_cell(corners, cell, s, t)
        way = (along[2] - slope @ along[:2]) / bend
        s, t = s + way * x, t + way * y
        if not (abs(way) <= half and 0.0 <= s <= 1.0 and 0.0 <= t <= 1.0):
            continue
        n, depth = in_cell(corners, cell, s, t, at[2] + way * along[2])
        if carries(axes, both, n) and n[2] >= STEEPEST and depth <= half - abs(way) + slack:
            found.append((depth, *sides(seat + way * local), [INSIDE, i, j, *local, *seat]))
    return found


def _corners(field, cell, centre, axes, edge, sides, lower):
    """Return the candidates where ends of an edge are in slopes of more than 45 degrees; ``lower``: see polyhedron."""
    seat, local, half, *both = edge
    found, last = [], np.array(field.shape) - 1.0
    for place in (seat - half * local, seat + half * local) if looks_down(axes, both, LOW) else ():
        if lower is not None and place[lower] * axes[lower, 2] < 0.0:
            continue
        at = centre + axes.T @ place
        part = at[:2] / cell
        if not ((part >= 0.0) & (part <= last)).all():
            continue
        i, j = (min(int(p), int(most) - 1) for p, most in zip(part, last, strict=True))
        n, depth = in_cell(field[i : i + 2, j : j + 2], cell, *(part - (i, j)), at[2])
        steep = n[0] * n[0] + n[1] * n[1] > n[2] * n[2]
        if steep and n[2] >= STEEPEST and carries(axes, both, n):
            found.append((depth, *sides(place), [VERTEX, i, j, 0.0, 0.0, 0.0, *place]))
    return found


def in_cell(corners, cell, s, t, z):
    """Return the normal of a cell's surface over a place in it, and the depth of a point at z there."""
    slope, height = over_cell(corners, cell, s, t)
    n = np.array([*-slope, 1.0]) / np.sqrt(1.0 + slope @ slope)
    return n, (height - z) * n[2]
