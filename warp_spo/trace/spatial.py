"""Spatial algebra over traced scalars, in the paper's order: V = (omega; v), f = (n; f).

Vectors and matrices are tuples of values, so that a structural zero is the constant 0.0. A pose maps a link's axes to
its parent's in up to two rotations: first about the link's own z axis, by the hinge's angle, then by a matrix of the
scene. Two separate rotations cost less than their product.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

from .scalars import Value, absolute, inverse_root, is_constant, less, select


def total(values: Iterable[Value]) -> Value:
    """Return the sum of the values, added from left to right."""
    result: Value = 0.0
    for value in values:
        result = result + value
    return result


class Vector(tuple):
    """Three or more values."""

    __slots__ = ()

    def __add__(self, other: Iterable[Value]) -> Vector:
        return Vector(a + b for a, b in zip(self, other, strict=True))

    def __sub__(self, other: Iterable[Value]) -> Vector:
        return Vector(a - b for a, b in zip(self, other, strict=True))

    def __neg__(self) -> Vector:
        return Vector(-a for a in self)

    def __mul__(self, scale: Value) -> Vector:
        return Vector(a * scale for a in self)

    __rmul__ = __mul__

    @property
    def vanishes(self) -> bool:
        """Whether all entries are the constant zero."""
        return all(is_constant(a) and a == 0.0 for a in self)


Twist = tuple[Vector, Vector]  # (omega; v), or its rate of change
Wrench = tuple[Vector, Vector]  # (n; f)


ZERO = Vector((0.0, 0.0, 0.0))


def dot(a: Iterable[Value], b: Iterable[Value]) -> Value:
    return total(x * y for x, y in zip(a, b, strict=True))


def norm(a: Sequence[Value]) -> Value:
    """Return the length of a vector."""
    square = dot(a, a)
    return square * inverse_root(select(less(0.0, square), square, 1.0))


def cross(a: Sequence[Value], b: Sequence[Value]) -> Vector:
    return Vector((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))


class Matrix(tuple):
    """Rows of values; ``@`` multiplies by a matrix or a vector."""

    __slots__ = ()

    @classmethod
    def of(cls, rows: Iterable[Iterable[Value]]) -> Matrix:
        """Return the matrix with these rows."""
        return cls(Vector(row) for row in rows)

    @property
    def T(self) -> Matrix:
        return Matrix.of(zip(*self, strict=True))

    def __matmul__(self, other: Any) -> Any:
        if isinstance(other, Matrix):
            columns = other.T
            return Matrix.of([dot(row, column) for column in columns] for row in self)
        return Vector(dot(row, other) for row in self)

    def __add__(self, other: Any) -> Matrix:
        return Matrix(a + b for a, b in zip(self, other, strict=True))

    def __sub__(self, other: Matrix) -> Matrix:
        return Matrix(a - b for a, b in zip(self, other, strict=True))

    def __neg__(self) -> Matrix:
        return Matrix(-row for row in self)


IDENTITY = Matrix.of([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


def skew(v: Sequence[Value]) -> Matrix:
    """Return v~, the matrix with v~ a = v x a."""
    return Matrix.of([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def symmetric(xx: Value, yy: Value, zz: Value, xy: Value, xz: Value, yz: Value) -> Matrix:
    """Return the symmetric matrix with these entries."""
    return Matrix.of([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def upper(entry: Callable[[int, int], Value]) -> Matrix:
    """Return the symmetric matrix of ``entry(row, column)``, which is called for row <= column only."""
    entries = {(i, j): entry(i, j) for i in range(3) for j in range(i, 3)}
    return Matrix.of([[entries[min(i, j), max(i, j)] for j in range(3)] for i in range(3)])


class Rigid(NamedTuple):
    """A rigid inertia about a frame's origin: mass, first moment, inertia."""

    mass: Value
    moment: Vector
    inertia: Matrix

    def __add__(self, other: Any) -> Rigid:
        return Rigid(self.mass + other.mass, self.moment + other.moment, self.inertia + other.inertia)

    def apply(self, w: Vector, v: Vector) -> Wrench:
        """Return M (omega; v)."""
        return self.inertia @ w + cross(self.moment, v), self.mass * v - cross(self.moment, w)

    @property
    def packed(self) -> list[Value]:
        """The 10 numbers: mass, first moment, and the moments xx, yy, zz and products xy, xz, yz of inertia."""
        J = self.inertia
        return [self.mass, *self.moment, J[0][0], J[1][1], J[2][2], J[0][1], J[0][2], J[1][2]]

    @classmethod
    def unpacked(cls, values: Sequence[Value]) -> Rigid:
        """Return the inertia with these 10 numbers, in the order of :attr:`packed`."""
        return cls(values[0], Vector(values[1:4]), symmetric(*values[4:]))

    @property
    def articulated(self) -> Articulated:
        """The same inertia as a 6 x 6 matrix."""
        mass = self.mass
        return Articulated(self.inertia, skew(self.moment), symmetric(mass, mass, mass, 0.0, 0.0, 0.0))


class Articulated(NamedTuple):
    """P = [[J, C], [C*, m]], J and m symmetric."""

    J: Matrix
    C: Matrix
    m: Matrix

    def __add__(self, other: Any) -> Articulated:
        return Articulated(self.J + other.J, self.C + other.C, self.m + other.m)

    def apply(self, w: Vector, v: Vector) -> Wrench:
        """Return P (omega; v)."""
        return self.J @ w + self.C @ v, self.C.T @ w + self.m @ v

    def entry(self, i: int, j: int) -> Value:
        """Return the entry (i, j) of the 6 x 6 matrix."""
        if i < 3:
            return self.J[i][j] if j < 3 else self.C[i][j - 3]
        return self.C[j][i - 3] if j < 3 else self.m[i - 3][j - 3]

    @classmethod
    def build(cls, entry: Callable[..., Value]) -> Articulated:
        """Return the inertia whose entries are ``entry(i, j)``, which is called for i <= j only."""
        C = Matrix.of([[entry(i, j + 3) for j in range(3)] for i in range(3)])
        return cls(upper(entry), C, upper(lambda i, j: entry(i + 3, j + 3)))

    @property
    def packed(self) -> list[Value]:
        """The 21 numbers of the upper triangle, by rows."""
        return [self.entry(i, j) for i in range(6) for j in range(i, 6)]

    @classmethod
    def unpacked(cls, values: Sequence[Value]) -> Articulated:
        """Return the inertia with these 21 numbers, in the order of :attr:`packed`."""
        places = {(i, j): k for k, (i, j) in enumerate((i, j) for i in range(6) for j in range(i, 6))}
        return cls.build(lambda i, j: values[places[i, j]])

    def less(self, U: Sequence[Value], scaled: Sequence[Value]) -> Articulated:
        """Return P - U scaled*. ``scaled`` is a multiple of U, so that the result is symmetric."""
        return Articulated.build(lambda i, j: self.entry(i, j) - U[i] * scaled[j])


class Pose(NamedTuple):
    """The pose of a link's frame in its parent's.

    Attributes:
        turn: cosine and sine of the angle of the first rotation, about z; None if there is none.
        matrix: the second rotation; None if there is none.
        l: the origin of the link's frame in the parent's frame.
    """

    turn: tuple[Value, Value] | None
    matrix: Matrix | None
    l: Vector

    def to_parent(self, v: Sequence[Value]) -> Vector:
        """Return a free vector in the parent's axes, given its components in the link's axes."""
        if self.turn is not None:
            c, s = self.turn
            v = Vector((c * v[0] - s * v[1], s * v[0] + c * v[1], v[2]))
        return Vector(v) if self.matrix is None else self.matrix @ v

    def to_child(self, v: Sequence[Value]) -> Vector:
        """Return a free vector in the link's axes, given its components in the parent's axes."""
        if self.matrix is not None:
            v = self.matrix.T @ v
        if self.turn is not None:
            c, s = self.turn
            v = Vector((c * v[0] + s * v[1], c * v[1] - s * v[0], v[2]))
        return Vector(v)

    def point_to_parent(self, r: Sequence[Value]) -> Vector:
        """Return the position of a point in the parent's frame, given its position ``r`` in the link's frame."""
        return self.l + self.to_parent(r)

    @property
    def rotation(self) -> Matrix:
        """The product of both rotations: its columns are the link's axes in the parent's frame."""
        columns = [self.to_parent(axis) for axis in IDENTITY]
        return Matrix(columns).T

    def force_to_parent(self, n: Vector, f: Vector) -> Wrench:
        """Return phi(p, k) (n; f)."""
        f = self.to_parent(f)
        return self.to_parent(n) + cross(self.l, f), f

    def motion_to_child(self, w: Vector, v: Vector) -> Twist:
        """Return phi*(p, k) (omega; v)."""
        return self.to_child(w), self.to_child(v + cross(w, self.l))

    def _rotate_symmetric(self, S: Matrix) -> Matrix:
        """Return R S R* for a symmetric matrix S."""
        if self.turn is not None:
            c, s = self.turn
            cc, ss, cs = c * c, s * s, c * s
            k = (cs + cs) * S[0][1]
            e, f = c * S[0][2] - s * S[1][2], s * S[0][2] + c * S[1][2]
            xy = cs * (S[0][0] - S[1][1]) + (cc - ss) * S[0][1]
            S = symmetric(cc * S[0][0] + (ss * S[1][1] - k), ss * S[0][0] + (cc * S[1][1] + k), S[2][2], xy, e, f)
        if self.matrix is not None:
            half = self.matrix @ S
            S = upper(lambda i, j: dot(half[i], self.matrix[j]))  # type: ignore[index]
        return S

    def turned(self, C: Matrix) -> Matrix:
        """Return R C R*."""
        rows = Matrix(self.to_parent(row) for row in C)  # C R*
        return Matrix(self.to_parent(column) for column in rows.T).T

    def rigid_to_parent(self, body: Rigid) -> Rigid:
        """Return phi M phi* for a rigid inertia M."""
        h = self.to_parent(body.moment)
        moment = h + self.l * body.mass
        inertia = self._rotate_symmetric(body.inertia)
        l = self.l
        cross_terms = upper(lambda i, j: _double(l, h, i, j) + _double(moment, l, i, j))
        return Rigid(body.mass, moment, inertia - cross_terms)

    def articulated_to_parent(self, P: Articulated) -> Articulated:
        """Return phi P phi*, computed block by block."""
        m, C_r, J = self._rotate_symmetric(P.m), self.turned(P.C), self._rotate_symmetric(P.J)
        L = skew(self.l)
        C = C_r + L @ m
        first, second = L @ C_r.T, C @ L
        return Articulated(upper(lambda i, j: J[i][j] + first[i][j] - second[i][j]), C, m)


def _double(a: Sequence[Value], b: Sequence[Value], i: int, j: int) -> Value:
    """Return the entry (i, j) of a~ b~ = b a* - (a . b) I."""
    if i != j:
        return b[i] * a[j]
    return -total(a[k] * b[k] for k in range(3) if k != i)


def magnitude(a: Sequence[Value], P: Articulated, b: Sequence[Value]) -> Value:
    """Return |a|* |P| |b|, with absolute values entry by entry: the size of the terms that cancel in a* P b."""
    terms = ((absolute(a[i]) * absolute(P.entry(i, j))) * absolute(b[j]) for i in range(6) for j in range(6))
    return total(terms)
