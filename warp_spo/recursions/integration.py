"""Motion along a constant velocity on the manifold of the coordinates."""

from __future__ import annotations

from collections.abc import Callable

from ..trace.scalars import Value
from .model.links import Link


def integrate_link(link: Link, q: Callable[[int], Value], rate: Callable[[int], Value], h: Value) -> list[Value]:
    """Return the link's coordinates after ``rate(dof)`` has been constant for ``h`` [s]; quaternions come out
    normalised."""
    return link.hinge.moved(link, q, [rate(dof) for dof in link.dofs], h)


def coordinate_rates(link: Link, q: Callable[[int], Value], rate: Callable[[int], Value]) -> list[Value]:
    """Return the time derivatives of the link's coordinates; of a quaternion, of the unit one."""
    return link.hinge.coordinate_rates(link, q, [rate(dof) for dof in link.dofs])
