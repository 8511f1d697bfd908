"""The specification of how deep two convex shapes overlap: dense float64 NumPy over many poses, deliberately simple.

Shapes a and b overlap along a unit vector n, towards a, by s(n) = h_b(n) + h_a(-n) - n . (place of a - place of b),
where h is how far a shape reaches along a vector. The depth is the least s, and its n is the normal; where s < 0 for
some n, the shapes are apart. For two polyhedra the least is at the normal of a face or across an edge of each, so all
of these are tried; else the sphere is sampled, and the best samples are improved by trying directions in cones that
shrink.
"""

import functools
from itertools import combinations
from typing import NamedTuple

import numpy as np

SAMPLES = 600  # directions over the sphere
STARTS = 4  # of them that are improved
ROUNDS = 80  # of improvement
AROUND = 32  # directions in each
FIRST, SHRINK = 0.15, 0.8  # the first cone's angle [rad], and by how much one shrinks in which nothing is better
CROSSINGS = 2000  # pairs of edges at most that are all tried; of more the sphere is sampled
TURN = 0.5  # radians by which the directions in a cone turn from round to round


class GrownShape:
    """A shape about its own origin.

    Args:
        kind: "sphere", "capsule", "box", "cylinder", "ellipsoid" or "hull". size: half its lengths along the axes; of a
            capsule (0, 0, half the length of its segment), of a cylinder its radius twice and half its length; zeros of
            a sphere and a hull. radius: by which it is grown. corners: of a hull [corner, 3].
    """

    def __init__(self, kind, size, radius=0.0, corners=None):
        self.kind, self.size, self.radius, self.corners = kind, size, radius, corners

    def reach(self, d):
        """Return how far it reaches along vectors [..., 3] of length one."""
        if self.corners is not None:
            return (d @ self.corners.T).max(axis=-1) + self.radius
        if self.kind == "ellipsoid":
            return np.linalg.norm(d * self.size, axis=-1) + self.radius
        if self.kind == "cylinder":
            return self.size[0] * np.hypot(d[..., 0], d[..., 1]) + self.size[2] * np.abs(d[..., 2]) + self.radius
        return np.abs(d) @ self.size + self.radius

    def is_polyhedron(self):
        """Return whether its surface is flat faces and edges alone."""
        return self.kind in ("box", "hull") and self.radius == 0.0

    @functools.cached_property
    def normals_and_edges(self):
        """Outward normals of faces [face, 3] and directions of edges [edge, 3], some several times."""
        if self.kind == "box":
            return np.vstack([np.eye(3), -np.eye(3)]), np.eye(3)
        if self.kind == "cylinder":
            return np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]), np.zeros((0, 3))
        if self.kind != "hull":
            return np.zeros((0, 3)), np.zeros((0, 3))
        return faces_and_edges(self.corners)


def faces_and_edges(corners):
    """Return the normals of a hull's triangles and the directions of their sides, from the corners alone."""
    size, normals, edges = np.ptp(corners, axis=0).max(), [], set()
    for triple in combinations(range(len(corners)), 3):
        a, b, c = corners[list(triple)]
        across = np.cross(b - a, c - a)
        length = np.linalg.norm(across)
        if length < 1e-12 * size**2:
            continue
        heights = (corners - a) @ (across / length)
        for sign in (1.0, -1.0):
            if (sign * heights).max() <= 1e-9 * size:
                normals.append(sign * across / length)
                edges |= set(combinations(triple, 2))
    i, j = np.array(sorted(edges)).T
    along = corners[j] - corners[i]
    return np.array(normals), along / np.linalg.norm(along, axis=1)[:, None]


class Overlaps(NamedTuple):
    """Least overlaps of a pair of shapes at poses: depth [pose] [m], unit normal towards the first shape [pose, 3]."""

    depth: np.ndarray
    normal: np.ndarray


class PosedPair:
    """Two shapes at poses, each with a rotation matrix; the first shape stands in the origin.

    Args:
        a, b: the shapes. turn_a, turn_b: [pose, 3, 3]. place: of b from a [pose, 3] [m].
    """

    def __init__(self, a, b, turn_a, turn_b, place):
        self.a, self.b, self.turn_a, self.turn_b, self.place = a, b, turn_a, turn_b, place

    def moved(self, by):
        """Return the pair with b farther along vectors [pose, 3]."""
        return PosedPair(self.a, self.b, self.turn_a, self.turn_b, self.place + by)

    def of(self, which):
        """Return the poses of a mask or of indices."""
        return PosedPair(self.a, self.b, self.turn_a[which], self.turn_b[which], self.place[which])

    def overlap(self, n):
        """Return s of unit vectors [pose, direction, 3]."""
        along_a, along_b = n @ self.turn_a, n @ self.turn_b
        return self.b.reach(along_b) + self.a.reach(-along_a) + np.einsum("pdr,pr->pd", n, self.place)

    def least(self, samples=SAMPLES, improve=True):
        """Return the least overlaps; without ``improve``, those of round shapes are of samples alone."""
        exact = self._is_exact()
        n = self._axes() if exact else np.concatenate([self._axes(), self.sample_directions(samples)], axis=1)
        s = self.overlap(n)
        if exact or not improve:
            best = s.argmin(axis=1)
            pose = np.arange(len(s))
            return Overlaps(s[pose, best], n[pose, best])
        return self._improve_directions(n, s)

    def _is_exact(self):
        """Return whether normals of faces and what is across edges are all directions that count."""
        crossings = len(self.a.normals_and_edges[1]) * len(self.b.normals_and_edges[1])
        return self.a.is_polyhedron() and self.b.is_polyhedron() and crossings <= CROSSINGS

    def _axes(self):
        """Return the normals of all faces and, where all are tried, what is across edges [pose, direction, 3]."""
        (up_a, along_a), (up_b, along_b) = self.a.normals_and_edges, self.b.normals_and_edges
        turn_a, turn_b = np.swapaxes(self.turn_a, 1, 2), np.swapaxes(self.turn_b, 1, 2)
        if not self._is_exact():
            along_a = along_b = np.zeros((0, 3))
        across = np.cross((along_a @ turn_a)[:, :, None], (along_b @ turn_b)[:, None])
        across = across.reshape(len(self.place), -1, 3)
        length = np.linalg.norm(across, axis=2, keepdims=True)
        across = np.where(length > 1e-6, across / np.maximum(length, 1e-6), [1.0, 0.0, 0.0])
        return np.concatenate([-up_a @ turn_a, up_b @ turn_b, across, -across], axis=1)

    def sample_directions(self, count):
        """Return directions over the sphere, the same for all poses."""
        height = 1.0 - (2.0 * np.arange(count) + 1.0) / count
        angle = np.pi * (1.0 + 5.0**0.5) * np.arange(count)
        across = np.sqrt(1.0 - height**2)
        n = np.stack([across * np.cos(angle), across * np.sin(angle), height], axis=1)
        return np.broadcast_to(n, (len(self.place), count, 3))

    def _improve_directions(self, n, s):
        """Return the best of the STARTS best directions after ROUNDS of tries around each."""
        pose = np.arange(len(s))[:, None]
        first = np.argpartition(s, STARTS, axis=1)[:, :STARTS]
        n, s = n[pose, first], s[pose, first]
        cone = np.full(s.shape, FIRST)
        for number in range(ROUNDS):
            one = np.cross(n, np.eye(3)[np.abs(n).argmin(axis=2)])
            one /= np.linalg.norm(one, axis=2, keepdims=True)
            other = np.cross(n, one)
            angle = 2.0 * np.pi * np.arange(AROUND) / AROUND + TURN * number
            across = np.multiply.outer(one, np.cos(angle)) + np.multiply.outer(other, np.sin(angle))
            tried = n[..., None, :] + cone[..., None, None] * np.moveaxis(across, 2, 3)
            tried /= np.linalg.norm(tried, axis=3, keepdims=True)
            found = self.overlap(tried.reshape(len(s), -1, 3)).reshape(*s.shape, AROUND)
            best = found.argmin(axis=2)[..., None]
            least = np.take_along_axis(found, best, axis=2)[..., 0]
            better = least < s
            n = np.where(better[..., None], np.take_along_axis(tried, best[..., None], axis=2)[..., 0, :], n)
            s, cone = np.minimum(s, least), np.where(better, cone, SHRINK * cone)
        best = s.argmin(axis=1)
        return Overlaps(s[pose[:, 0], best], n[pose[:, 0], best])
