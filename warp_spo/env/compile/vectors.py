"""Vectors of abstract scalars, rotations of them, and names that regular expressions choose."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ...errors import shown
from ...trace.functions import AbstractScalar, where
from ...trace.scalars import Value

Vector = np.ndarray  # of abstract scalars


def vector(values: Iterable[Any]) -> Vector:
    """Return an array of abstract scalars."""
    values = list(values)
    out = np.empty(len(values), dtype=object)
    for i, value in enumerate(values):
        out[i] = value
    return out


def cross(a: Any, b: Any) -> Vector:
    """Return the vector product of two vectors of three entries."""
    return vector([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def multiply(a: Any, b: Any) -> Vector:
    """Return the product of two quaternions, xyzw: the rotation ``b``, then ``a``."""
    u = a[3] * vector(b[:3]) + b[3] * vector(a[:3]) + cross(a, b)
    return vector([*u, a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2]])


def rotate(quaternion: Any, v: Any) -> Vector:
    """Return ``v`` turned by a unit quaternion, xyzw."""
    u, w = quaternion[:3], quaternion[3]
    twice = 2.0 * cross(u, v)
    return vector(v) + w * twice + cross(u, twice)


def rotate_back(quaternion: Any, v: Any) -> Vector:
    """Return ``v`` turned by the inverse of a unit quaternion, xyzw."""
    return rotate(vector([-quaternion[0], -quaternion[1], -quaternion[2], quaternion[3]]), v)


def between(x: Any, most: float) -> Any:
    """Return a number between zero and ``most``, so that no table is read beyond its end; NaN becomes zero."""
    return where(x > 0.0, where(x < most, x, most), 0.0)


def find(call: str, what: str, labels: Sequence[str], names: Any) -> list[int]:
    """Return the indices of the labels that a regular expression, or one of several, matches; in their own order.

    An expression matches the whole label, or all of it that follows the last "/".

    Raises:
        ValueError: an expression is none, or it matches nothing.
    """
    try:
        patterns = [re.compile(name) for name in ([names] if isinstance(names, str) else names)]
    except (TypeError, re.error) as error:
        raise ValueError(f"{call}: {names!r} is no regular expression ({error}); expected one, or several") from None
    found: set[int] = set()
    for pattern in patterns:
        ends = [label.rsplit("/", 1)[-1] for label in labels]
        hits = {
            i
            for i, (label, end) in enumerate(zip(labels, ends, strict=True))
            if pattern.fullmatch(label) or pattern.fullmatch(end)
        }
        if not hits:
            raise ValueError(
                f"{call}: {pattern.pattern!r} matches no {what}; expected one of {', '.join(map(shown, labels))}"
            )
        found |= hits
    return sorted(found)


def as_scalar(x: Any) -> Any:
    """Return an abstract scalar, or a number as a Python float."""
    return x if isinstance(x, AbstractScalar) else float(x)


def as_value(x: Any) -> Value:
    """Return the traced value of an abstract scalar, or a number."""
    return x.value if isinstance(x, AbstractScalar) else float(x)
