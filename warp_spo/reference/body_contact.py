"""The specification of contact between bodies: dense float64 NumPy for one world, deliberately simple.

Two bodies share points, each with a normal n towards the first body and a depth. A point is a contact as one with the
ground is, whose velocity is that of the first body at the point less that of the second: J = J_first - J_second. So a
step solves the system of :mod:`.contact` with more rows, exactly, and forces come in pairs.
"""

from itertools import combinations

import numpy as np

from .contact import SLIP, ContactStep, Points
from .rotations import homogeneous

FLAT = 1e-3  # share of a capsule's half length by which it may come away from a face that it lies on
LEAD = 0.05  # share of the smallest half size by which the second box must be farther away to give the common face


class PairStep(ContactStep):
    """One step of a scene in which bodies touch the ground and each other; arguments as those of ContactStep.

    Attributes:
        pair_of: by point after those with the ground, the number of its pair.
    """

    def _points(self, path):
        dense, scene, rows, self.numbers, self.pair_of = self.dense, self.scene, [], [], []
        ground = super()._points(path) if scene.contact_points else None
        for number, pair in enumerate(scene.contact_pairs):
            at = len(scene.contact_points) + number
            k, d, mu = (dense.value(f"contact_{name}")[at] for name in ("stiffness", "damping", "friction"))
            places = [dense.body_matrix[body] if body >= 0 else np.eye(4) for body in (pair.body, pair.other)]
            touched = self.points_of(number, *map(place, pair.shapes, places))
            for point, normal, depth in touched:
                J = dense._jacobian_at(pair.body, point)[:3]
                J = J - dense._jacobian_at(pair.other, point)[:3] if pair.other >= 0 else J
                share = len(touched)
                rows.append((J, normal, depth, k / share, d / share, mu, pair.eps, pair_weight(self.neutral, pair)))
                self.pair_of.append(number)
        n = dense.dof_count
        shapes = ((-1, 3, n), (-1, 3), *[(-1,)] * 6)
        found = Points(*(np.reshape([row[i] for row in rows], s) for i, s in enumerate(shapes)), np.zeros(len(rows)))
        found = found.that_turn_freely()
        return found if ground is None else Points(*(np.concatenate(both) for both in zip(ground, found, strict=True)))

    def points_of(self, number, first, second):
        """Return the points that the two placed shapes of a pair share."""
        return touches(first, second)

    def reports(self, found):
        """Return the force on the first body of each pair [pair, 3], and gap and slip of its deepest point [pair]."""
        count, first = len(self.scene.contact_pairs), len(self.numbers)
        f, gap, slip = np.zeros((count, 3)), np.full(count, np.inf), np.zeros(count)
        for i, number in enumerate(self.pair_of, start=first):
            f[number] += found.f[i]
            if -self.points.depth[i] < gap[number]:
                v, n = self.points.J[i] @ found.v, self.points.n[i]
                gap[number], slip[number] = -self.points.depth[i], np.linalg.norm(v - n * (n @ v))
        return f, gap, slip


def pair_weight(dense, pair):
    """Return the inverse weight of a pair, the sum of its bodies', each the mean over its shape, times SLIP [1/kg]."""
    inverse, total = np.linalg.pinv(dense.mass_matrix), 0.0
    for body, shape in zip((pair.body, pair.other), pair.shapes, strict=True):
        if body < 0:
            continue
        frames = [(body, (*point, 0, 0, 0, 1)) for point in shape.samples]
        J = dense.jacobian(frames)[:, :3]
        total += np.einsum("pai,ij,paj->", J, inverse, J) / (3.0 * len(frames))
    return SLIP * total


def place(shape, body):
    """Return the kind of a shape, its 4 x 4 matrix in the inertial frame, its half sizes and its radius.

    In place of half its sizes, a hull has its corners [corner, 3].
    """
    size = shape.size if shape.hull is None else shape.hull.corners
    return shape.kind, body @ homogeneous(shape.pose), size, shape.radius


def touches(first, second):
    """Return the points that two placed shapes share: (point, normal towards the first, depth) each."""
    if first[0] == second[0] == 0:
        return [rounds(first, second)]
    if first[0] == second[0] == 1:
        return faces(first, second)
    if first[0] == second[0] == 2:
        return hull_faces(first, second)
    if first[0] == 0:
        return round_in(first, second)
    return [(point, -normal, depth) for point, normal, depth in round_in(second, first)]


def rounds(first, second):
    """Return the point of two segments with radii, in the middle between their surfaces."""
    ends = [(place[:3, 3] - size[2] * place[:3, 2], place[:3, 3] + size[2] * place[:3, 2])
            for _, place, size, _ in (first, second)]  # fmt: skip
    x, y = nearest(*ends[0], *ends[1])
    apart = x - y
    distance = np.linalg.norm(apart)
    normal = apart / distance if distance > 0.0 else np.array([0.0, 0.0, 1.0])
    r, s = first[3], second[3]
    return 0.5 * (x - r * normal + y + s * normal), normal, r + s - distance


def nearest(a, b, c, d):
    """Return the nearest points of two segments, from a to b and from c to d. Ericson 2005, section 5.1.9."""
    u, v, w = b - a, d - c, a - c
    uu, vv, uv, uw, vw = u @ u, v @ v, u @ v, u @ w, v @ w
    clip = lambda x: min(max(x, 0.0), 1.0)  # noqa: E731
    if uu == 0.0:
        s, t = 0.0, clip(vw / vv) if vv > 0.0 else 0.0
    elif vv == 0.0:
        s, t = clip(-uw / uu), 0.0
    else:
        across = uu * vv - uv * uv
        s = clip((uv * vw - uw * vv) / across) if across > 1e-6 * uu * vv else 0.5
        t = (uv * s + vw) / vv
        if not 0.0 <= t <= 1.0:
            t = clip(t)
            s = clip((uv * t - uw) / uu)
    return a + s * u, c + t * v


def round_in(stick, solid):
    """Return the points of a sphere or a capsule and a box or a hull; the normal leads out of that.

    Those of a capsule are the ends of the part of its axis over the face where it is nearest, and, between each of them
    and the nearest place, where a line from there to there has risen by FLAT of its half length. All have the normal of
    the nearest place, and the depths of the last two fall with the slope there.
    """
    (_, axis, (_, _, half), radius), (kind, place, size, _) = stick, solid
    middle, along = place[:3, :3].T @ (axis[:3, 3] - place[:3, 3]), half * place[:3, :3].T @ axis[:3, 2]
    out_of = lambda share: (out_of_box if kind == 1 else out_of_hull)(middle + share * along, size)  # noqa: E731
    nearest = first_where(lambda share: out_of(share)[1] @ along > 0.0, -1.0, 1.0) if half > 0.0 else 0.0
    least, normal = out_of(nearest)
    ends = [(nearest, least)]
    if half > 0.0:
        corners = size if kind == 2 else np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size
        low, high = over_face(corners, middle, along, normal)
        low, high = (min(low, nearest), max(high, nearest)) if low < high else (nearest, nearest)
        slope, ends, inner = 0.0 if -1.0 + 1e-12 < nearest < 1.0 else along @ normal, [], []
        for end in (low, high):
            distance = out_of(end)[0]
            share = nearest + (end - nearest) * min(1.0, FLAT * half / max(distance - least, 1e-300))
            ends.append((end, distance))
            inner.append((share, max(least, least + (share - nearest) * slope)))
        ends = [ends[0], *inner, ends[1]]
    found = []
    for share, distance in ends:
        depth = radius - distance
        surface = middle + share * along - distance * normal  # of the solid
        point = place[:3, :3] @ (surface - 0.5 * depth * normal) + place[:3, 3]
        found.append((point, place[:3, :3] @ normal, depth))
    return found


def over_face(corners, middle, along, normal):
    """Return between which shares of a segment it lies over the face of a hull that ``normal`` points out of most."""
    size, begin, end = np.ptp(corners, axis=0).max(), -1.0, 1.0
    up, offset = max(planes(corners), key=lambda plane: round(plane[0] @ normal, 9))
    on = corners[np.abs(corners @ up - offset) < 1e-9 * size]
    for a in on:
        for b in on:
            outward = np.cross(b - a, up)
            if ((on - a) @ outward).max() > 1e-9 * size**2 or not outward.any():
                continue
            apart, rate = (middle - a) @ outward, along @ outward
            if rate > 0.0:
                end = min(end, -apart / rate)
            elif rate < 0.0:
                begin = max(begin, -apart / rate)
    return begin, end


def first_where(true, low, high):
    """Return the least number between two from which on something is true, by halving; ``high`` if it never is."""
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if true(middle) else (middle, high)
    return high


def out_of_box(local, half):
    """Return how far a point is from a box, less than zero inside, and the unit vector along which that grows."""
    inside = np.clip(local, -half, half)
    apart = local - inside
    distance = np.linalg.norm(apart)
    if distance > 0.0:
        normal = apart / distance
    else:
        axis = np.argmin(half - np.abs(local))
        normal, distance = np.zeros(3), -(half - np.abs(local))[axis]
        normal[axis] = 1.0 if local[axis] >= 0.0 else -1.0
    return distance, normal


def planes(corners):
    """Return normals and offsets of the planes through three corners that have none beyond them; some several times."""
    size, found = np.ptp(corners, axis=0).max(), []
    for a, b, c in combinations(corners, 3):
        across = np.cross(b - a, c - a)
        if np.linalg.norm(across) > 1e-9 * size**2:
            normal = across / np.linalg.norm(across)
            sides = [way * normal for way in (1.0, -1.0) if (way * (corners - a) @ normal).max() <= 1e-9 * size]
            found += [(side, side @ a) for side in sides]
    return found


def out_of_hull(local, corners):
    """Return the same of a hull: from its corners alone.

    Inside, the nearest plane through three corners with none beyond it. Outside, the nearest of all points in the hulls
    of three corners, two, or one; that of three counts where the point over it lies between them.
    """
    up, offset = max(planes(corners), key=lambda plane: plane[0] @ local - plane[1])
    if up @ local - offset <= 0.0:
        return up @ local - offset, up
    points = list(corners)
    for some in [*combinations(corners, 2), *combinations(corners, 3)]:
        sides = np.array(some[1:]) - some[0]
        weights = np.linalg.lstsq(sides.T, local - some[0], rcond=None)[0]
        if min(*weights, 1.0 - weights.sum()) >= 0.0:
            points.append(some[0] + weights @ sides)
    apart = local - min(points, key=lambda point: np.linalg.norm(local - point))
    return np.linalg.norm(apart), apart / np.linalg.norm(apart)


def faces(first, second):
    """Return the points of two boxes: a face of one, clipped by the sides of the nearest face of the other.

    The face with the largest distance between the boxes along its normal is the common one, the first box's unless the
    second one's is farther by LEAD of the smallest half size.
    """
    best = [farthest(first, second), farthest(second, first)]
    lead = LEAD * min(first[2].min(), second[2].min())
    swap = best[1][0] > best[0][0] + lead
    (_, here, half, _), (_, there, other, _) = (second, first) if swap else (first, second)
    _, axis, sign = best[1] if swap else best[0]
    normal = sign * here[:3, axis]  # out of the box of the common face
    toward = there[:3, :3].T @ normal
    side = np.argmax(np.abs(toward))
    facing = -np.sign(toward[side]) * there[:3, side]
    u, v = there[:3, (side + 1) % 3] * other[(side + 1) % 3], there[:3, (side + 2) % 3] * other[(side + 2) % 3]
    middle = there[:3, 3] + facing * other[side]
    polygon = [middle + u + v, middle - u + v, middle - u - v, middle + u - v]
    for step in (1, 2):
        across, width = here[:3, (axis + step) % 3], half[(axis + step) % 3]
        for way in (1.0, -1.0):
            polygon = clipped(polygon, way * across, width + way * across @ here[:3, 3])
    found = []
    for corner in polygon:
        depth = half[axis] - normal @ (corner - here[:3, 3])
        found.append((corner + 0.5 * depth * normal, normal if swap else -normal, depth))
    return found


def hull_faces(first, second):
    """Return the points of two hulls: as :func:`faces`, with the face that looks at the common one most."""
    placed = [(place[:3, :3], place[:3, 3], corners @ place[:3, :3].T + place[:3, 3]) for _, place, corners, _ in
              (first, second)]  # fmt: skip
    best = []
    for (turn, at, _), (_, _, others), (_, _, corners, _) in zip(placed, placed[::-1], (first, second), strict=True):
        sides = [(turn @ up, offset + turn @ up @ at) for up, offset in planes(corners)]
        best.append(max((((others @ up - offset).min(), up, offset) for up, offset in sides), key=lambda side: side[0]))
    lead = LEAD * min(np.ptp(solid[2], axis=0).min() / 2.0 for solid in (first, second))
    swap = best[1][0] > best[0][0] + lead
    _, normal, offset = best[1] if swap else best[0]
    here, there = placed[::-1] if swap else placed
    facing = min((there[0] @ up for up, _ in planes((first if swap else second)[2])), key=lambda up: up @ normal)
    polygon = around(there[2], facing)
    common = around(here[2], normal)
    for a, b in zip(common, common[1:] + common[:1], strict=True):
        outward = np.cross(b - a, normal)
        polygon = clipped(polygon, outward, outward @ a)
    found = []
    for corner in polygon:
        depth = offset - normal @ corner
        found.append((corner + 0.5 * depth * normal, normal if swap else -normal, depth))
    return found


def around(corners, up):
    """Return the corners of the face of a hull that is highest along ``up``, as they go round it counterclockwise."""
    heights = corners @ up
    on = corners[heights > heights.max() - 1e-9 * np.ptp(corners, axis=0).max()]
    apart = on - on.mean(axis=0)
    return list(on[np.argsort(np.arctan2(apart @ np.cross(up, apart[0]), apart @ apart[0]))])


def farthest(one, other):
    """Return distance, axis and sign of the face of a box from which another box is farthest."""
    (_, here, half, _), (_, there, size, _) = one, other
    offset = here[:3, :3].T @ (there[:3, 3] - here[:3, 3])
    apart = np.abs(offset) - half - np.abs(here[:3, :3].T @ there[:3, :3]) @ size
    axis = np.argmax(apart)
    return apart[axis], axis, 1.0 if offset[axis] >= 0.0 else -1.0


def clipped(polygon, across, limit):
    """Return the part of a polygon with across . x <= limit."""
    found = []
    for a, b in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        x, y = across @ a - limit, across @ b - limit
        if x <= 0.0:
            found.append(a)
        if (x < 0.0 < y) or (y < 0.0 < x):
            found.append(a + (b - a) * (x / (x - y)))
    return found
