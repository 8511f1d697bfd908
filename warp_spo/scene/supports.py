"""Points of a shape that move over it with its pose: those that reach farthest against the ground's normal.

The velocity of such a point is that of the material that is there. This is the host's own word for where they are; the
step's is in :mod:`warp_spo.recursions.contact.supports`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..reference.hull_corners import choose

CORNER, RIM, SURFACE, HULL_CORNER = "corner", "rim", "surface", "hull corner"
"""Corners of the face of a box that looks down; points on the rims of a cylinder or a cone; the lowest of an
ellipsoid; lowest corners of a hull, see :mod:`warp_spo.reference.hull_corners`."""
BOX_GRID, CAPSULE_GRID, HULL_GRID, CYLINDER_GRID = "box grid", "capsule grid", "hull grid", "cylinder grid"
"""Where a shape touches points and lines of a height field's grid, see :mod:`warp_spo.reference.field_grid`."""
GRIDS = {BOX_GRID: ("box", 4), CAPSULE_GRID: ("capsule", 2), HULL_GRID: ("hull", 4), CYLINDER_GRID: ("cylinder", 4)}
"""The shape in the search for such places, and how many of them it has."""
UPRIGHT = 1e-8  # square of the sine below which an axis is along the normal, and points on a rim keep their places
SIDES = (-0.5, np.sqrt(0.75))  # cosine and sine of 120 degrees, from the lowest point of a rim to those beside it


class Support(NamedTuple):
    """A point that moves over a shape, about the shape's middle.

    Attributes:
        kind: CORNER, RIM, SURFACE, or one of GRIDS.
        axes: of the shape, in the body frame [3, 3], one a row.
        sizes: [m]. CORNER: half of the sizes. RIM: radius at the end of the third axis and at the other end, and half
            their distance. SURFACE: half of the axes.
        number: CORNER: 0 to 3. RIM: 0: lowest at the end of the third axis, 1: at the other end, 2 and 3: 120 degrees
            beside the lowest, on the end that is lower, or of a cone on the wider one. SURFACE: 0.
    """

    kind: str
    axes: tuple[tuple[float, float, float], ...]
    sizes: tuple[float, float, float]
    number: int
    table: tuple[float, ...] = ()

    @property
    def signs(self) -> tuple[float, float]:
        """CORNER: on which side of the face's middle the point is, along the two axes of the face."""
        return (1.0 if self.number & 1 else -1.0), (1.0 if self.number & 2 else -1.0)

    @property
    def meets_grid(self) -> bool:
        """Whether it is where the shape touches the grid of a height field."""
        return self.kind in GRIDS

    @property
    def reach(self) -> float:
        """The largest distance from the middle [m]."""
        a, b, c = self.sizes
        if self.kind == CAPSULE_GRID:
            return a + c
        box = float(np.hypot(np.hypot(a, b), c))
        return {RIM: float(np.hypot(max(a, b), c)), SURFACE: max(a, b, c)}.get(self.kind, box)

    def offset(self, normal: Any) -> np.ndarray:
        """Return where the point is from the shape's middle [m]; ``normal`` of the ground and result in the body."""
        axes = np.array(self.axes)
        if self.kind == HULL_CORNER:
            corners = np.reshape(self.table, (-1, 3))
            return corners[choose(corners, normal)[0][self.number]]
        return axes.T @ OFFSETS[self.kind](axes @ np.asarray(normal), np.array(self.sizes), self.number)

    def is_there(self, normal: Any) -> bool:
        """Return whether the point counts: of corners of a hull, whether no earlier one is the same."""
        return self.kind != HULL_CORNER or bool(choose(np.reshape(self.table, (-1, 3)), normal)[1][self.number])


def _corner(n: np.ndarray, half: np.ndarray, number: int) -> np.ndarray:
    face, signs = int(np.abs(n).argmax()), [1.0 if number & 1 else -1.0, 1.0 if number & 2 else -1.0]
    signs.insert(face, -1.0 if n[face] > 0.0 else 1.0)
    return np.array(signs) * half


def _in_quadrant(n: np.ndarray, half: np.ndarray, number: int) -> np.ndarray:
    """Return the middle of a quadrant of the face that looks down, which stands for places on a grid."""
    face = int(np.abs(n).argmax())
    return np.where(np.arange(3) == face, 1.0, 0.5) * _corner(n, half, number)


def _on_axis(n: np.ndarray, sizes: np.ndarray, number: int) -> np.ndarray:
    return np.array([0.0, 0.0, (number - 0.5) * sizes[2]])


def _rim(n: np.ndarray, sizes: np.ndarray, number: int) -> np.ndarray:
    top, bottom, half = sizes
    square = n[0] ** 2 + n[1] ** 2
    x, y = -n[:2] / np.sqrt(square) if square > UPRIGHT else (1.0, 0.0)
    lower_is_top = n[2] < 0.0 if top == bottom else top > bottom
    on_top = lower_is_top if number > 1 else number == 0
    if number > 1:
        cos, sin = SIDES[0], SIDES[1] if number == 2 else -SIDES[1]
        x, y = cos * x - sin * y, sin * x + cos * y
    radius = top if on_top else bottom
    return np.array([radius * x, radius * y, half if on_top else -half])


def _lowest(n: np.ndarray, half: np.ndarray, number: int) -> np.ndarray:
    return -(half**2) * n / np.linalg.norm(half * n)


OFFSETS = {
    CORNER: _corner,
    RIM: _rim,
    SURFACE: _lowest,
    BOX_GRID: _in_quadrant,
    HULL_GRID: _in_quadrant,
    CYLINDER_GRID: _in_quadrant,
    CAPSULE_GRID: _on_axis,
}
