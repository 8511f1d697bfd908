"""Grounds of a scene: a plane, a field of heights, or a list of contacts from outside."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from .checks import checked_array, checked_unit, refuse_gradient
from .pickling import StoredPart

HEIGHTS = "ground_heights"
GROUND_VALUES = ("ground_origin", "ground_field", "contact_place", HEIGHTS)
"""Names of a scene's values that come from its ground."""
CREASE = 1.19  # tangent of the angle, 50 degrees, by which a field's slope rises at a crease
STEEP = 1.0  # slope beyond which a cell of a height field is a wall and a floor
AWAY = -1e3  # depth of a surface that is not there [m]; no step reaches so far
PLACE = 7  # numbers of a point in the value contact_place


@dataclasses.dataclass(frozen=True, eq=False)
class Plane(StoredPart):
    """Flat ground: the points x with normal . x = height; bodies are on the side that the normal points to.

    Args:
        height: [m].
        normal: unit vector, inertial axes.

    Raises:
        ValueError: a value is invalid; the message names it.
    """

    height: float = 0.0
    normal: Any = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "height", float(checked_array("Plane", "height [m]", self.height, ())))
        normal = checked_unit("Plane", "normal", checked_array("Plane", "normal", self.normal, (3,)))
        object.__setattr__(self, "normal", tuple(normal.tolist()))


@dataclasses.dataclass(frozen=True, eq=False)
class HeightField(StoredPart):
    """Ground whose height over x and y is given on a grid, bilinear between its points.

    Point (i, j) of the grid lies at x = origin[0] + i cell, y = origin[1] + j cell, inertial axes. Beyond its edges the
    field goes on as it is at the edge. A set of fields of one size has a first axis more: world w stands on the field
    ``ground_field[w]`` of the scene's values.

    Args:
        heights: [m], shape (points along x, points along y), two or more each; or (fields, points along x, along y).
        cell: distance between neighbours [m], or one along x and one along y.
        origin: x and y of the point (0, 0) [m], and a height that is added to all [m] if there are three numbers.

    Raises:
        ValueError: a value is invalid, NaN among the heights included; the message names it.
    """

    heights: Any
    cell: Any
    origin: Any = (0.0, 0.0)

    def __post_init__(self) -> None:
        try:
            shape = np.shape(self.heights)
        except ValueError:
            raise ValueError("HeightField: heights has rows of different lengths; expected one length") from None
        if len(shape) not in (2, 3) or min(shape[-2:]) < 2 or shape[0] == 0:
            raise ValueError(
                f"HeightField: heights has shape {shape}; expected (points along x, points along y), two or more each, "
                "or (fields, points along x, points along y)"
            )
        refuse_gradient("HeightField", "heights", self.heights, HEIGHTS)
        heights = np.asarray(self.heights)
        if heights.dtype.kind == "f" and not np.isfinite(heights).all():
            place = np.argwhere(~np.isfinite(heights))[0].tolist()
            raise ValueError(f"HeightField: heights{place} is {heights[tuple(place)]}; expected finite numbers")
        object.__setattr__(self, "heights", checked_array("HeightField", "heights [m]", self.heights, shape))
        sizes = (2,) if np.shape(self.cell) == (2,) else ()
        cell = checked_array("HeightField", "cell [m]", self.cell, sizes).tolist()
        object.__setattr__(self, "cell", tuple(cell) if sizes else cell)
        if not min(self.cells) > 0.0:
            raise ValueError(f"HeightField: cell is {self.cell} m; expected more than zero")
        count = 3 if np.shape(self.origin) == (3,) else 2
        origin = checked_array("HeightField", "origin [m]", self.origin, (count,))
        object.__setattr__(self, "origin", (*origin.tolist(), 0.0)[:3])

    @property
    def count(self) -> int:
        """Number of fields."""
        return len(self.heights) if self.heights.ndim == 3 else 1

    @property
    def cells(self) -> tuple[float, float]:
        """Distances between neighbours along x and along y [m]."""
        return self.cell if isinstance(self.cell, tuple) else (self.cell, self.cell)

    @property
    def has_walls(self) -> bool:
        """Whether some cell is so steep that it has a wall."""
        h, (cell_x, cell_y) = self.heights, self.cells
        low, right, far, corner = h[..., :-1, :-1], h[..., 1:, :-1], h[..., :-1, 1:], h[..., 1:, 1:]
        twist = low - right - far + corner
        x, y = right - low + 0.5 * twist, far - low + 0.5 * twist
        return bool((np.hypot(x, y * (cell_x / cell_y)) > STEEP * cell_x).any())

    @property
    def has_creases(self) -> bool:
        """Whether the field folds upward so much, from one cell to the next, that a sphere may touch both sides."""
        for axis, cell in zip((-2, -1), self.cells, strict=True):
            slopes = np.moveaxis(np.diff(self.heights, axis=axis), axis, -1) * (1.0 / cell)
            before, after = slopes[..., :-1], slopes[..., 1:]
            if (after - before > CREASE * np.maximum(1.0 + before * after, 0.0)).any():
                return True
        return False


@dataclasses.dataclass(frozen=True, eq=False)
class Listed(StoredPart):
    """Ground that the value ``contact_place`` describes, by point: from outside, such as by a list of contacts.

    Seven numbers a point: its place in the body frame (3) [m], the ground's normal there (3), inertial axes, and how
    far the point is below it [m]. A depth far below zero is no contact. The positions of the scene's contacts only say
    about where the points are.
    """


def check_field(call: str, name: str, array: np.ndarray, ground: Any) -> None:
    """Raise ValueError unless ``ground_field`` holds numbers of fields, and all worlds share ``ground_heights``."""
    if name == HEIGHTS and len(array) > 1:
        raise ValueError(
            f"{call}: {name} has shape {array.shape}; expected {array.shape[1:]}, because all worlds share the heights;"
            " make a HeightField of several fields, and say by ground_field which of them a world stands on"
        )
    if name == "ground_field" and array.size and not np.isin(array, np.arange(ground.count)).all():
        raise ValueError(
            f"{call}: {name} holds {array.min():g} to {array.max():g}; expected integers below {ground.count}"
        )
