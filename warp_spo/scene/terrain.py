"""Ground of uneven height: fields of slopes, waves, bars, stairs, roughness and boxes, and grids of them by difficulty.

    ground = spo.terrain.stairs((8.0, 8.0), cell=0.05, riser=0.1, tread=0.3)
    field, origins = spo.terrain.tiles(rows=10, columns=20)

Every field is centred at x = y = 0 and has height zero along its edges, so that fields side by side meet without a
cliff. A seed gives the same field in every process.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..errors import as_integer
from .checks import checked_array
from .ground import HeightField

SIZE, CELL = (8.0, 8.0), 0.05  # [m]
EDGE = 0.5  # width of the flat strip along the edges [m]
PLATFORM = 2.0  # width of the flat square in the middle [m]


class Tiles(NamedTuple):
    """A field made of tiles, and where on it to start.

    Attributes:
        field: all tiles side by side, rows along x, columns along y.
        origins: highest point within half a metre of the middle of each tile, shape (rows, columns, 3), [m].
    """

    field: HeightField
    origins: np.ndarray

    def starts(
        self, worlds: int, hardest: int | None = None, seed: int = 0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return rows [world], columns [world] and places [world, 3] [m] at which worlds start.

        Columns go round, so that each kind of tile has as many worlds as another; rows are random, up to ``hardest``.
        A curriculum changes the rows and reads the places again, ``tiles.origins[rows, columns]``.

        Args:
            worlds: number of worlds. hardest: largest row; None: the last one. seed: of the random rows.
        """
        count, row = as_integer(worlds), len(self.origins) - 1 if hardest is None else as_integer(hardest)
        if count is None or count < 1:
            raise ValueError(f"Tiles.starts: worlds is {worlds!r}; expected an integer, 1 or more")
        if row is None or not 0 <= row < len(self.origins):
            raise ValueError(f"Tiles.starts: hardest is {hardest!r}; expected a row, 0 to {len(self.origins) - 1}")
        rows = np.random.default_rng(seed).integers(0, row + 1, count)
        columns = np.arange(count) % self.origins.shape[1]
        return rows, columns, self.origins[rows, columns]


def slope(size: Any = SIZE, cell: float = CELL, angle: float = 0.3, platform: float = PLATFORM) -> HeightField:
    """Return a hill with four sides of constant slope around a flat square; a pit if the angle is below zero.

    Args:
        size: lengths along x and y [m], multiples of the cell.
        cell: distance between the points of the field [m].
        angle: of the sides [rad], between -1.5 and 1.5.
        platform: width of the flat square [m].

    Raises:
        ValueError: a value is invalid; the message names it.
    """
    grid = _Grid("terrain.slope", size, cell)
    tilt = grid.number("angle [rad]", angle, -1.5, 1.5)
    return grid.field(np.tan(tilt) * grid.distance(platform))


def waves(size: Any = SIZE, cell: float = CELL, amplitude: float = 0.1, length: float = 2.0) -> HeightField:
    """Return waves along x and y: amplitude (sin 2 pi x / length + sin 2 pi y / length) / 2, which fade at the edges.

    Args:
        size, cell: as :func:`slope`.
        amplitude: largest height [m]. length: of a wave [m], at least four cells.
    """
    grid = _Grid("terrain.waves", size, cell)
    top = grid.number("amplitude [m]", amplitude, 0.0, np.inf)
    rate = 2.0 * np.pi / grid.number("length [m]", length, 4.0 * cell, np.inf)
    fade = np.clip(grid.distance(0.0) / EDGE, 0.0, 1.0)
    return grid.field(0.5 * top * fade * (np.sin(rate * grid.x)[:, None] + np.sin(rate * grid.y)[None, :]))


def bars(
    size: Any = SIZE, cell: float = CELL, height: float = 0.1, width: float = 0.2, spacing: float = 1.0
) -> HeightField:
    """Return bars across x to step over, a flat square free of them in the middle.

    Args:
        size, cell: as :func:`slope`.
        height, width: of a bar [m], width at least a cell. spacing: between the middles of two bars [m].
    """
    grid = _Grid("terrain.bars", size, cell)
    top = grid.number("height [m]", height, 0.0, np.inf)
    wide = grid.number("width [m]", width, cell, np.inf)
    pitch = grid.number("spacing [m]", spacing, wide + cell, np.inf)
    middle = pitch * np.round(grid.x / pitch)  # of the nearest bar
    near = np.abs(grid.x - middle) <= 0.5 * wide + 1e-9
    free = (np.abs(middle) <= 0.5 * PLATFORM)[:, None] & (np.abs(grid.y) <= 0.5 * PLATFORM)
    return grid.field(np.where(near[:, None] & ~free & (grid.distance(0.0) > 0.0), top, 0.0))


def stairs(
    size: Any = SIZE, cell: float = CELL, riser: float = 0.1, tread: float = 0.3, platform: float = PLATFORM
) -> HeightField:
    """Return stairs on four sides that lead up to a flat square; down to it if the riser is below zero.

    A riser is as steep as a field allows: it takes one cell.

    Args:
        size, cell: as :func:`slope`.
        riser: height of a step [m]. tread: its depth [m], a cell or more.
        platform: width of the flat square [m].
    """
    grid = _Grid("terrain.stairs", size, cell)
    rise = grid.number("riser [m]", riser, -np.inf, np.inf)
    deep = grid.number("tread [m]", tread, cell, np.inf)
    return grid.field(rise * np.floor(grid.distance(platform) / deep + 1e-9))


def rough(
    size: Any = SIZE, cell: float = CELL, amplitude: float = 0.05, grain: float = 0.2, seed: int = 0
) -> HeightField:
    """Return random heights between -amplitude and amplitude at distances of ``grain``, bilinear between them.

    Args:
        size, cell: as :func:`slope`.
        amplitude: [m]. grain: distance of independent heights [m], a cell or more.
        seed: of the random numbers, an integer, zero or more.
    """
    grid = _Grid("terrain.rough", size, cell)
    top = grid.number("amplitude [m]", amplitude, 0.0, np.inf)
    apart = grid.number("grain [m]", grain, cell, np.inf)
    rng = grid.random(seed)
    places = [(axis - axis[0]) / apart for axis in (grid.x, grid.y)]
    coarse = rng.uniform(-top, top, tuple(int(place[-1]) + 2 for place in places))
    first = [np.floor(place).astype(int) for place in places]
    part = [place - at for place, at in zip(places, first, strict=True)]
    along = (1.0 - part[0])[:, None] * coarse[first[0]] + part[0][:, None] * coarse[first[0] + 1]
    heights = (1.0 - part[1]) * along[:, first[1]] + part[1] * along[:, first[1] + 1]
    return grid.field(heights * np.clip(grid.distance(0.0) / EDGE, 0.0, 1.0))


def boxes(size: Any = SIZE, cell: float = CELL, height: float = 0.1, edge: float = 0.4, seed: int = 0) -> HeightField:
    """Return squares side by side, each at a random height between zero and ``height``, around a flat square.

    Args:
        size, cell: as :func:`slope`.
        height: of the highest [m]. edge: of a square [m], two cells or more.
        seed: of the random numbers, an integer, zero or more.
    """
    grid = _Grid("terrain.boxes", size, cell)
    top = grid.number("height [m]", height, 0.0, np.inf)
    wide = grid.number("edge [m]", edge, 2.0 * cell, np.inf)
    rng = grid.random(seed)
    which = [np.floor((axis - axis[0]) / wide + 1e-9).astype(int) for axis in (grid.x, grid.y)]
    heights = rng.uniform(0.0, top, (which[0][-1] + 1, which[1][-1] + 1))[which[0][:, None], which[1]]
    heights = np.where(grid.distance(0.0) > 0.0, heights, 0.0)
    free = (np.abs(grid.x) <= 0.5 * PLATFORM)[:, None] & (np.abs(grid.y) <= 0.5 * PLATFORM)
    return grid.field(np.where(free, 0.0, heights))


Kind = Callable[[Any, float, float, int], HeightField]
KINDS: Mapping[str, Kind] = {
    "slope up": lambda size, cell, hard, seed: slope(size, cell, 0.45 * hard),
    "slope down": lambda size, cell, hard, seed: slope(size, cell, -0.45 * hard),
    "waves": lambda size, cell, hard, seed: waves(size, cell, 0.25 * hard),
    "bars": lambda size, cell, hard, seed: bars(size, cell, 0.15 * hard),
    "stairs up": lambda size, cell, hard, seed: stairs(size, cell, 0.02 + 0.18 * hard),
    "stairs down": lambda size, cell, hard, seed: stairs(size, cell, -0.02 - 0.18 * hard),
    "rough": lambda size, cell, hard, seed: rough(size, cell, 0.1 * hard, seed=seed),
    "boxes": lambda size, cell, hard, seed: boxes(size, cell, 0.02 + 0.18 * hard, seed=seed),
}
"""Name -> function of size, cell, difficulty (0 to 1) and seed that makes a tile: what a legged robot is trained on."""


def tiles(
    rows: int = 10,
    columns: int = 16,
    size: Any = SIZE,
    cell: float = CELL,
    kinds: Mapping[str, Kind] | None = None,
    seed: int = 0,
) -> Tiles:
    """Return one field of tiles side by side: difficulty grows with the row, from 0 to 1; the kind changes by column.

    Args:
        rows, columns: number of tiles along x and y.
        size: of a tile, lengths along x and y [m], multiples of the cell. cell: as :func:`slope`.
        kinds: name -> function of size, cell, difficulty and seed that returns a field of this size, height zero along
            its edges; None: those of ``KINDS``.
        seed: of the random numbers; each tile gets one of its own.

    Returns:
        The field, and where on it to start, see :class:`Tiles`.

    Raises:
        ValueError: a value is invalid; the message names it.
    """
    call = "terrain.tiles"
    counts = []
    for name, given in (("rows", rows), ("columns", columns)):
        count = as_integer(given)
        if count is None or count < 1:
            raise ValueError(f"{call}: {name} is {given!r}; expected an integer, 1 or more")
        counts.append(count)
    kinds = KINDS if kinds is None else kinds
    if not kinds:
        raise ValueError(f"{call}: kinds is empty; expected one function or more")
    tile, names = _Grid(call, size, cell), list(kinds)
    seeds = tile.random(seed).integers(0, 2**31, tuple(counts))
    steps = [len(tile.x) - 1, len(tile.y) - 1]
    whole = _Grid(call, [count * length for count, length in zip(counts, tile.size, strict=True)], cell)
    heights, origins = np.zeros((len(whole.x), len(whole.y))), np.zeros((*counts, 3))
    near = (np.abs(tile.x) <= 0.5)[:, None] & (np.abs(tile.y) <= 0.5)
    for row in range(counts[0]):
        for column in range(counts[1]):
            name = names[column * len(names) // counts[1]]
            hard = row / max(1, counts[0] - 1)
            made = np.asarray(kinds[name](tile.size, cell, hard, int(seeds[row, column])).heights)
            if made.shape != near.shape:
                raise ValueError(
                    f"{call}: kinds[{name!r}] returned {made.shape} heights; expected {near.shape}, those of a tile"
                )
            edges = max(np.abs(made[[0, -1]]).max(), np.abs(made[:, [0, -1]]).max())
            if edges > 1e-9:
                raise ValueError(
                    f"{call}: kinds[{name!r}] has height {edges:.3g} m at its edges; expected zero, so that tiles meet"
                )
            first = row * steps[0], column * steps[1]
            heights[first[0] : first[0] + steps[0] + 1, first[1] : first[1] + steps[1] + 1] = made
            middle = whole.x[first[0]] - tile.x[0], whole.y[first[1]] - tile.y[0]
            origins[row, column] = *middle, made[near].max()
    origins.flags.writeable = False
    return Tiles(whole.field(heights), origins)


def stack(fields: Sequence[HeightField]) -> HeightField:
    """Return a set of fields, of which each world has one: ``ground_field`` of the scene's values says which.

    Raises:
        ValueError: the fields differ in the number of points, in their cells or in where they lie.
    """
    kinds = {(field.heights.shape, field.cells, field.origin) for field in fields}
    if len(kinds) != 1 or fields[0].heights.ndim != 2:
        raise ValueError(
            f"terrain.stack: {len(fields)} fields of {len(kinds)} kinds (points, cells, origin): {sorted(kinds)[:3]}; "
            "expected single fields that differ in their heights alone"
        )
    return HeightField(np.stack([field.heights for field in fields]), fields[0].cell, fields[0].origin)


class _Grid:
    """Points of a field: their x and y [m], and checks of the arguments of the function ``call``."""

    def __init__(self, call: str, size: Any, cell: float):
        self.call = call
        self.size = checked_array(call, "size [m]", size, (2,))
        self.cell = self.number("cell [m]", cell, 1e-3, EDGE)
        counts = np.round(self.size / self.cell)
        if np.any(self.size < 3.0 * EDGE) or np.any(np.abs(counts * self.cell - self.size) > 1e-6 * self.size):
            raise ValueError(
                f"{call}: size is {self.size.tolist()} m and cell is {self.cell:g} m; expected multiples of the cell, "
                f"{3.0 * EDGE} m or more"
            )
        self.x, self.y = (self.cell * (np.arange(count + 1) - 0.5 * count) for count in counts)

    def number(self, name: str, value: Any, least: float, most: float) -> float:
        """Return a checked number between two bounds."""
        number = float(checked_array(self.call, name, value, ()))
        if not least <= number <= most:
            raise ValueError(f"{self.call}: {name} is {number:g}; expected {least:g} to {most:g}")
        return number

    def random(self, seed: Any) -> np.random.Generator:
        number = as_integer(seed)
        if number is None or number < 0:
            raise ValueError(f"{self.call}: seed is {seed!r}; expected an integer, zero or more")
        return np.random.default_rng(number)

    def distance(self, platform: float) -> np.ndarray:
        """Return how far each point is from the flat strip along the edges [m], no more than at the platform's edge."""
        half = 0.5 * self.number("platform [m]", platform, 0.0, float(self.size.min()) - 2.0 * EDGE)
        outer = 0.5 * self.size - EDGE
        inside = np.minimum(outer[0] - np.abs(self.x)[:, None], outer[1] - np.abs(self.y)[None, :])
        return np.clip(inside, 0.0, float(outer.min()) - half)

    def field(self, heights: np.ndarray) -> HeightField:
        """Return the field of these heights, centred."""
        return HeightField(heights, self.cell, (self.x[0], self.y[0]))
