"""The lazy algebra of operators: sums, products, multiples and transposes compute nothing until they are applied.

An operator maps ``x`` [world, columns] to [world, rows], separately in each world. ``op = H @ phi @ M @ phi.T @ H.T``
computes nothing; ``op @ x`` applies the factors from the right, each by its own kernels, without forming a matrix. If
all letters of an expression belong to one :class:`LetterOwner`, it may apply the expression in one kernel instead.
"""

import abc
import functools
import itertools
import numbers
from collections.abc import Sequence
from typing import Any, NoReturn, overload

import warp as wp

from ..errors import never_copied
from ..kernels import block_sparse, declare
from ..runtime import launches
from ..runtime.arrays import ArrayT, Call, kind_of, new, parse_device, parse_dtype
from ..runtime.memory import view


class Workspace:
    """The temporary arrays of one operator for one number of worlds and columns; the first use allocates them."""

    def __init__(self, call: Call, worlds: int, columns: int):
        self._sizes = worlds, columns
        self._memory = call.kind, call.dtype, call.device
        self._arrays: dict[tuple, tuple] = {}

    def take(self, owner: "Operator", rows: int, use: object = 0) -> wp.array:
        """Return the temporary [world, row, column] that ``owner`` may use while it is being applied."""
        # One operator may appear several times in an expression, but never inside itself: its temporaries are free
        # again when its _apply returns, and no input or output of it can be one of them.
        key = id(owner), rows, use
        if key not in self._arrays:
            worlds, columns = self._sizes
            kind, dtype, device = self._memory
            self._arrays[key] = new(kind, (worlds, rows, columns), dtype, device)
        return self._arrays[key][1]


class LetterOwner(abc.ABC):
    """The owner of operators that are letters of the paper; it may apply an expression of them in one kernel."""

    __reduce__ = never_copied("operators of a scene", "memory of a device", "store q, and call dyn.operators(q) anew")

    @abc.abstractmethod
    def fill(self) -> None:
        """Launch the kernels that compute the blocks of all letters, unless the blocks are up to date."""

    @abc.abstractmethod
    def run(self, expression: Any, x: wp.array, out: wp.array) -> bool:
        """Launch ``out = expression x`` [world, row] as one kernel, or return False; see Operator.expression."""


class Operator(abc.ABC):
    """A linear map of vectors, with one matrix a world or one for all worlds.

    A subclass defines ``_apply`` and ``_apply_transposed``; everything else is here. Subclasses override nothing; to
    change an operator, wrap it.

    Attributes:
        shape: (rows, columns).
        worlds: the number of worlds; 1 stands for the same matrix in any number of worlds.
        device: the device of the operator and of the arrays that it maps.
        dtype: the scalar type of the operator and of the arrays that it maps.
        kind: the kind of array that :meth:`dense` returns; None is NumPy.
        letter: the owner and the name of the letter, None if no kernel knows it; None if the operator is not a letter.
        form: the name of the composition with its numbers.
        operands: the composed operators.
    """

    letter: "tuple[LetterOwner, str | None] | None" = None
    form: tuple = ()
    operands: "tuple[Operator, ...]" = ()
    __array_ufunc__ = None  # NumPy hands array @ op and array + op to the operator

    __reduce__ = never_copied(
        "Operator", "memory of a device", "store op.dense(), or what the operator was made of: its weights, or q"
    )

    def __init__(self, shape: tuple[int, int], worlds: int, device: wp.Device, dtype: type, kind: str | None):
        self.shape = shape
        self.worlds = worlds
        self.device = device
        self.dtype = dtype
        self.kind = kind
        self._workspaces: dict[tuple, Workspace] = {}
        declare(block_sparse, dtype)

    @functools.cached_property
    def expression(self) -> Any:
        """The operator in letters, as nested tuples (form, operands); None if a part of it is not a letter."""
        if self.letter is not None:
            return self.letter[1]
        parts = [operand.expression for operand in self.operands]
        return None if not self.form or None in parts else (*self.form, *parts)

    @functools.cached_property
    def letters(self) -> "tuple[LetterOwner, ...]":
        """The owners of the letters of the operator."""
        own = () if self.letter is None else (self.letter[0],)
        return tuple(dict.fromkeys([*own, *(owner for operand in self.operands for owner in operand.letters)]))

    def _launch_fused(self, x: wp.array, out: wp.array) -> bool:
        """Launch ``out = op x`` [world, row] as one kernel, or return False if there is no such kernel."""
        return len(self.letters) == 1 and self.expression is not None and self.letters[0].run(self.expression, x, out)

    def _fill(self) -> None:
        """Launch the kernels that compute the blocks of the letters, unless the blocks are up to date."""
        for owner in self.letters:
            owner.fill()

    @abc.abstractmethod
    def _apply(self, x: wp.array, out: wp.array, alpha: float, accumulate: bool, space: Workspace) -> None:
        """Launch ``out = alpha op x``, or with ``accumulate`` ``out += alpha op x``.

        ``x`` and ``out`` are [world, row, column] and do not overlap.
        """

    @abc.abstractmethod
    def _apply_transposed(self, x: wp.array, out: wp.array, alpha: float, accumulate: bool, space: Workspace) -> None:
        """Launch the same as :meth:`_apply` for the transpose of the operator."""

    def apply(self, x: ArrayT, out: ArrayT | None = None) -> ArrayT:
        """Return ``op @ x``.

        Args:
            x: [world, columns of op] or [world, columns of op, any]; torch, Warp or NumPy.
            out: array for the result [world, rows of op (, any)], of the kind of x; it must not overlap x.

        With ``out`` and without NumPy, every call after the first one for a number of worlds and columns only launches
        kernels. An operator may be applied on one stream at a time only, because it has one set of temporary arrays.

        Raises:
            ValueError, TypeError: an array has another kind, shape, dtype or device than expected.
        """
        name = f"{type(self).__name__}.apply"
        kind_of(x, name, "x")
        many = len(x.shape) == 3
        with Call(name, self.device, self.dtype) as call:
            worlds = self.worlds if self.worlds > 1 else -1
            shape = (worlds, self.shape[1], -1) if many else (worlds, self.shape[1])
            read = call.read("x", x, shape, "[world, column of the operator, any]" if many else "[world, column]")
            worlds = read.shape[0]
            columns = read.shape[2] if many else 1
            shape = (worlds, self.shape[0], columns) if many else (worlds, self.shape[0])
            y = call.write(out, shape, "[world, row of the operator, any]" if many else "[world, row]")
            if y.size and (many or not self._launch_fused(read, y)):
                self._fill()
                key = call.kind, worlds, columns
                if key not in self._workspaces:
                    self._workspaces[key] = Workspace(call, worlds, columns)
                self._apply(_with_columns(read), _with_columns(y), 1.0, False, self._workspaces[key])
        return call.result

    def dense(self) -> Any:
        """Return the matrix [world, row, column], for inspection and tests; one world if all worlds share it."""
        return self._columns("dense", 0, self.shape[1], 0, self.shape[0])

    def _columns(self, name: str, first: int, count: int, first_row: int, rows: int) -> Any:
        """Return ``rows`` rows from ``first_row`` on of ``count`` columns from ``first`` on, in the operator's kind."""
        with Call(f"{type(self).__name__}.{name}", self.device, self.dtype, kind=self.kind) as call:
            y = call.write(None, (self.worlds, rows, count))
            if y.size:
                space = Workspace(call, self.worlds, count)
                x, whole = space.take(self, self.shape[1], "x"), y
                if rows != self.shape[0]:
                    whole = space.take(self, self.shape[0], "y")
                self._fill()
                launches.launch(block_sparse.unit(self.dtype), x.shape, [first], [x], device=self.device)
                self._apply(x, whole, 1.0, False, space)
                if whole is not y:
                    launches.copy(y, whole[:, first_row : first_row + rows])
        return call.result

    @functools.cached_property
    def T(self) -> "Operator":
        """The transpose."""
        return Transpose(self)

    @overload
    def __matmul__(self, other: "Operator") -> "Operator": ...
    @overload
    def __matmul__(self, other: ArrayT) -> ArrayT: ...
    def __matmul__(self, other: Any) -> Any:
        return Product(self, other) if isinstance(other, Operator) else self.apply(other)

    def __rmatmul__(self, array: ArrayT) -> ArrayT:
        kind_of(array, "array @ operator", "array")
        if len(array.shape) != 2:
            raise ValueError(
                f"array @ operator: array has shape {tuple(array.shape)}; expected [world, row of the operator]; for "
                f"several columns write operator.T @ array with [world, row, column]"
            )
        return self.T.apply(array)

    def __add__(self, other: "Operator") -> "Operator":
        return Sum(self, other) if isinstance(other, Operator) else self._refuse("+", other)

    def __sub__(self, other: "Operator") -> "Operator":
        return Sum(self, Scaled(-1.0, other)) if isinstance(other, Operator) else self._refuse("-", other)

    def __radd__(self, other: object) -> NoReturn:
        self._refuse("+", other)

    def __rsub__(self, other: object) -> NoReturn:
        self._refuse("-", other)

    def __neg__(self) -> "Operator":
        return Scaled(-1.0, self)

    def __mul__(self, number: float) -> "Operator":
        return Scaled(number, self) if isinstance(number, numbers.Real) else self._refuse("*", number)

    __rmul__ = __mul__

    def _refuse(self, sign: str, other: object) -> NoReturn:
        expected = "a number" if sign == "*" else "an operator"
        raise TypeError(
            f"{type(self).__name__} {sign} {type(other).__name__}: expected {expected}; use dense() for matrices of "
            f"numbers, or @ to apply the operator"
        )

    def __repr__(self) -> str:
        worlds = "any worlds" if self.worlds == 1 else f"{self.worlds} worlds"
        return (
            f"{type(self).__name__}({self.shape[0]} x {self.shape[1]}, {worlds}, {self.dtype.__name__}, {self.device})"
        )


class Identity(Operator):
    """``I x = x``.

    Args:
        size: number of rows and columns.
        device: the CPU unless given.
        dtype: "float32" or "float64".
        worlds: number of worlds of ``dense``; 1 goes with operators of any number.
    """

    def __init__(self, size: int, device="cpu", dtype="float64", kind: str | None = None, worlds: int = 1):
        super().__init__((size, size), worlds, parse_device(device), parse_dtype(dtype, "Identity"), kind)
        self.form = ("identity",)

    def _apply(self, x: wp.array, out: wp.array, alpha: float, accumulate: bool, space: Workspace) -> None:
        add_scaled(x, out, alpha, accumulate)

    _apply_transposed = _apply


class Scaled(Operator):
    """``(a B) x = a (B x)``; the kernels of B apply the factor at no cost."""

    def __init__(self, factor: float, operand: Operator):
        super().__init__(operand.shape, operand.worlds, operand.device, operand.dtype, operand.kind)
        self.factor = float(factor)
        self.operand = operand
        self.form, self.operands = ("scaled", self.factor), (operand,)

    def _apply(self, x: wp.array, out: wp.array, alpha: float, accumulate: bool, space: Workspace) -> None:
        self.operand._apply(x, out, alpha * self.factor, accumulate, space)

    def _apply_transposed(self, x: wp.array, out: wp.array, alpha: float, accumulate: bool, space: Workspace) -> None:
        self.operand._apply_transposed(x, out, alpha * self.factor, accumulate, space)


class Transpose(Operator):
    """``B.T``."""

    def __init__(self, operand: Operator):
        super().__init__(operand.shape[::-1], operand.worlds, operand.device, operand.dtype, operand.kind)
        self.operand = operand
        self.form, self.operands = ("transpose",), (operand,)
        self.__dict__["T"] = operand

    def _apply(self, x: wp.array, out: wp.array, alpha: float, accumulate: bool, space: Workspace) -> None:
        self.operand._apply_transposed(x, out, alpha, accumulate, space)

    def _apply_transposed(self, x: wp.array, out: wp.array, alpha: float, accumulate: bool, space: Workspace) -> None:
        self.operand._apply(x, out, alpha, accumulate, space)


class Sum(Operator):
    """``(B + C) x = B x + C x``, summed from left to right."""

    def __init__(self, *terms: Operator):
        self.terms = _flatten(Sum, terms, "terms")
        for term in self.terms:
            if term.shape != self.terms[0].shape:
                raise ValueError(
                    f"sum of operators: {self.terms[0]!r} and {term!r} differ in shape; expected equal shapes; check "
                    f"which of them is missing a .T"
                )
        super().__init__(self.terms[0].shape, *common("sum", self.terms))
        self.form, self.operands = ("sum",), self.terms

    def _apply(self, x: wp.array, out: wp.array, alpha: float, accumulate: bool, space: Workspace) -> None:
        for index, term in enumerate(self.terms):
            term._apply(x, out, alpha, accumulate or index > 0, space)

    def _apply_transposed(self, x: wp.array, out: wp.array, alpha: float, accumulate: bool, space: Workspace) -> None:
        for index, term in enumerate(self.terms):
            term._apply_transposed(x, out, alpha, accumulate or index > 0, space)


class Product(Operator):
    """``(B C) x = B (C x)``."""

    def __init__(self, *factors: Operator):
        self.factors = _flatten(Product, factors, "factors")
        for left, right in itertools.pairwise(self.factors):
            if left.shape[1] != right.shape[0]:
                raise ValueError(
                    f"product of operators: {left!r} @ {right!r}; expected as many columns on the left as rows on the "
                    f"right; check which of them is missing a .T"
                )
        super().__init__((self.factors[0].shape[0], self.factors[-1].shape[1]), *common("product", self.factors))
        self.form, self.operands = ("product",), self.factors

    def _apply(self, x: wp.array, out: wp.array, alpha: float, accumulate: bool, space: Workspace) -> None:
        for stage, factor in enumerate(self.factors[:0:-1]):
            between = space.take(self, factor.shape[0], stage % 2)
            factor._apply(x, between, 1.0, False, space)
            x = between
        self.factors[0]._apply(x, out, alpha, accumulate, space)

    def _apply_transposed(self, x: wp.array, out: wp.array, alpha: float, accumulate: bool, space: Workspace) -> None:
        for stage, factor in enumerate(self.factors[:-1]):
            between = space.take(self, factor.shape[1], stage % 2)
            factor._apply_transposed(x, between, 1.0, False, space)
            x = between
        self.factors[-1]._apply_transposed(x, out, alpha, accumulate, space)


def add_scaled(x: wp.array, out: wp.array, alpha: float, accumulate: bool) -> None:
    """Launch ``out = alpha x``, or with ``accumulate`` ``out += alpha x``; both are [world, row, column]."""
    launches.launch(block_sparse.scale(x.dtype), x.shape, [alpha, accumulate, x], [out], device=x.device)


def _with_columns(array: wp.array) -> wp.array:
    """Return an array [world, row] as [world, row, 1], without a copy."""
    if array.ndim == 3:
        return array
    return view(array.ptr or 0, (*array.shape, 1), array.dtype, str(array.device))


def _flatten(kind: type, operands: Sequence[Operator], name: str) -> tuple[Operator, ...]:
    """Return the operands, with those of type ``kind`` replaced by their parts in the attribute ``name``."""
    return tuple(part for one in operands for part in (getattr(one, name) if type(one) is kind else (one,)))


def common(what: str, operands: Sequence[Operator]) -> tuple[int, wp.Device, type, str | None]:
    """Return worlds, device, dtype and kind of a composition; ValueError that names two operands that do not fit."""
    first = operands[0]
    worlds = 1
    for operand in operands:
        if operand.device != first.device or operand.dtype is not first.dtype:
            raise ValueError(
                f"{what} of operators: {first!r} and {operand!r} differ in device or dtype; expected the same; build "
                f"them with the same device= and dtype="
            )
        if operand.worlds > 1 and worlds > 1 and operand.worlds != worlds:
            raise ValueError(
                f"{what} of operators: one has {worlds} worlds, {operand!r} another number; expected the same, or "
                f"weights that all worlds share"
            )
        worlds = max(worlds, operand.worlds)
    return worlds, first.device, first.dtype, next((o.kind for o in operands if o.kind is not None), None)
