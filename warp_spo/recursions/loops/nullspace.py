"""The null space of constraint rows: Y = [L 0] Q* by Householder reflections, branch-free, with zeros kept as zeros.

The columns of Q beyond L are an orthonormal basis of the rates that Y allows, wherever the rows are independent. No dof
is declared dependent, so the dead point of a crank, where a fixed choice of dependent dofs is singular, is an ordinary
configuration. The remainder of a row after projection on the rows before it, over the size of its terms, is a sine;
where the remainder is rounding alone the rows are dependent, and results become NaN.
"""

from __future__ import annotations

from typing import NamedTuple

from ...trace.scalars import Entry, Value, absolute, is_constant, nan_unless_above, reciprocal, select, sqrt
from ...trace.spatial import total
from ..articulated import zero_or_nan

LEAST = 64.0  # roundings of a row's size; a smaller remainder may be rounding alone


class Reflection(NamedTuple):
    """I - scale v v*, v by column."""

    v: dict[int, Value]
    scale: Value

    def apply(self, x: dict[int, Value]) -> dict[int, Value]:
        along = self.scale * total(value * x.get(column, 0.0) for column, value in self.v.items())
        if _vanishes(along):
            return x
        return {**x, **{column: x.get(column, 0.0) - along * value for column, value in self.v.items()}}


class Basis(NamedTuple):
    """Chosen columns that the rows allow, by dof; ``lost_pivot`` is NaN where the rows lose rank, otherwise zero."""

    basis: list[dict[int, Value]]
    lost_pivot: Value


class NullSpace:
    """Factors of rows.

    Args:
        rows: entries by column, no more than there are columns.
        sizes: of each row, the sum of squares of the terms that may cancel in it.
        columns: all of them.
        epsilon: rounding of the dtype.

    Attributes:
        basis: orthonormal vectors that Y makes zero, by column.
        margins: of each row, the square of its remainder after the rows before it, over its size.
        lost_pivot: zero, or NaN where a row is zero_or_nan; the basis alone need not show that.
    """

    def __init__(self, rows: list[dict[int, Value]], sizes: list[Value], columns: list[int], epsilon: float):
        self._columns = columns
        self._steps: list[tuple[int, int, Value, Reflection | None]] = []  # row, column, 1 / L, reflection
        self._rows = [{c: x for c, x in row.items() if not _vanishes(x)} for row in rows]
        self.margins: list[Value] = []
        self.lost_pivot: Value = 0.0
        waiting, live = list(range(len(rows))), list(columns)
        while waiting:
            row = min(waiting, key=lambda r: sum(c in self._rows[r] for c in live))
            waiting.remove(row)
            left = {c: x for c, x in self._rows[row].items() if c in live}
            self._steps.append(self._reflect(row, left, sizes[row], waiting, live, epsilon))
        self.basis = [self._reflect_back({column: 1.0}) for column in live]

    def _reflect(self, row: int, left: dict, size: Value, waiting: list, live: list, epsilon: float) -> tuple:
        square = nan_unless_above(total(x * x for x in left.values()), (LEAST * epsilon) ** 2 * size)
        self.margins.append(square * reciprocal(size))
        self.lost_pivot = self.lost_pivot + zero_or_nan(square)
        if not left:
            pivot = live.pop(0)
            return row, pivot, square, None  # NaN: nothing is left of the row
        shared = {c: sum(c in self._rows[other] for other in waiting) for c in left}
        pivot = min(left, key=lambda c: (shared[c], c))
        live.remove(pivot)
        if len(left) == 1:
            return row, pivot, left[pivot] * reciprocal(square), None
        norm, head = sqrt(square), left[pivot]
        sign = select(head + absolute(head), 1.0, -1.0)
        v = {**left, pivot: head + sign * norm}
        reflection = Reflection(v, reciprocal(square + absolute(head) * norm))
        for other in waiting:
            self._rows[other] = {c: x for c, x in reflection.apply(self._rows[other]).items() if not _vanishes(x)}
        self._rows[row] = {**self._rows[row], pivot: -sign * norm}
        return row, pivot, -sign * reciprocal(norm), reflection

    def _reflect_back(self, x: dict[int, Value]) -> dict[int, Value]:
        for _, _, _, reflection in reversed(self._steps):
            x = x if reflection is None else reflection.apply(x)
        return x

    def particular(self, right: list[Value]) -> dict[int, Value]:
        """Return the shortest x with Y x = ``right``, by column."""
        found: dict[int, Value] = {}
        for row, pivot, inverse, _ in self._steps:
            known = total(self._rows[row].get(column, 0.0) * x for column, x in found.items())
            found[pivot] = (right[row] - known) * inverse
        return self._reflect_back(found)

    def multipliers(self, force: Entry) -> list[Value]:
        """Return mu, by row, with Y* mu = the part of a ``force``, by column, that X* maps to zero."""
        x = {column: force(column) for column in self._columns}
        for _, _, _, reflection in self._steps:
            x = x if reflection is None else reflection.apply(x)
        found: dict[int, Value] = {}
        for row, pivot, inverse, _ in reversed(self._steps):
            known = total(self._rows[other].get(pivot, 0.0) * y for other, y in found.items())
            found[row] = (x[pivot] - known) * inverse
        return [found[row] for row in range(len(found))]


def _vanishes(x: Value) -> bool:
    return is_constant(x) and x == 0.0
