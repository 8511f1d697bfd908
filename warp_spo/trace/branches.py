"""Branches of a trace: which statements only the values of one branch need, so that code may skip them."""

from __future__ import annotations

import operator
from collections.abc import Container

from .scalars import BRANCHES, Scalar

Sides = tuple[list[Scalar], list[Scalar]]  # what only the values of a branch need, and only the others
in_order = operator.attrgetter("number")  # sorts scalars as their graph grew


def branch_of(scalar: Scalar) -> tuple:
    """Return what tells the branch of a value from others: its mask and its name."""
    mask, _, _, name = scalar.args
    return mask.key, name


def find_blocks(needed: list[Scalar], used: Container[tuple]) -> dict[tuple, Sides]:
    """Return, by branch, the scalars that only the values of this branch need, and only the others, in their order.

    Inputs of a kernel stay outside, because statements before the branch may write over them.

    Args:
        needed: the scalars of a region. used: the keys of those that are stored, used later, or known.
    """
    blocks: dict[tuple, Sides] = {branch_of(x): ([], []) for x in needed if x.op in BRANCHES}
    if not blocks:
        return blocks
    owners: dict[tuple, set] = {}  # the sides of branches on which each scalar is used; None: outside of all
    for scalar in sorted(needed, key=in_order, reverse=True):
        at = owners.get(scalar.key, {None})
        own = next(iter(at)) if len(at) == 1 else None
        turns = scalar.op in ("sin", "cos") and scalar.args[0].op == "input"  # angles that are reduced first
        if scalar.key in used or turns or scalar.op in ("input", *BRANCHES):
            own = None
        if own is not None:
            blocks[own[0]][own[1]].append(scalar)
        for place, value in enumerate(scalar.args):
            if value.__class__ is Scalar:
                sides = 2 if scalar.op == "either" else 1 if scalar.op in BRANCHES else 0
                takes = (branch_of(scalar), place - 1) if 1 <= place <= sides else own
                owners.setdefault(value.key, set()).add(takes)
    return {key: (one[::-1], other[::-1]) for key, (one, other) in blocks.items()}
