"""Expressions of the spatial operators: what a user composed, as data, before any of it is computed.

An expression is a letter, or a tuple: ``("resolvent", E)``, ``("transpose", A)``, ``("scaled", a, A)``, ``("sum", A,
B, ...)``, ``("product", A, B, ...)``, ``("identity",)``.
"""

from __future__ import annotations

import itertools
from typing import Any

Expression = Any
NODES, HINGES = "nodes", "hinges"
SPACES = {
    "E_phi": (NODES, NODES),
    "E_psi": (NODES, NODES),
    "H": (HINGES, NODES),
    "M": (NODES, NODES),
    "Delta": (HINGES, HINGES),
    "P": (NODES, NODES),
    "D": (HINGES, HINGES),
    "D_inverse": (HINGES, HINGES),
    "G": (NODES, HINGES),
}
"""Letter -> the spaces of its rows and of its columns."""
RESOLVENTS = {"E_phi": "phi", "E_psi": "psi"}
NONE: tuple[None, None] = (None, None)


def spaces(expression: Expression) -> tuple[str | None, str | None]:
    """Return the spaces of the rows and of the columns of an expression; None for any space.

    Raises:
        ValueError: spaces of factors or terms that differ, even if their sizes agree.
    """
    if isinstance(expression, str):
        return SPACES[expression]
    form, *operands = expression
    if form == "identity":
        return NONE
    if form == "scaled":
        return spaces(operands[1])
    if form == "transpose":
        rows, columns = spaces(operands[0])
        return columns, rows
    found = [pair for pair in map(spaces, operands) if pair != NONE]
    if form == "product":
        if any(left[1] != right[0] for left, right in itertools.pairwise(found)):
            raise ValueError(f"{format_expression(expression)}: nodes meet hinges")
        return (found[0][0], found[-1][1]) if found else NONE
    if len(set(found)) > 1 or (len(found) < len(operands) and found and found[0][0] != found[0][1]):
        raise ValueError(f"{format_expression(expression)}: nodes meet hinges")
    return found[0] if found else NONE


def spaces_agree(expression: Expression) -> bool:
    """Return whether the spaces of an expression's factors and terms agree."""
    try:
        spaces(expression)
    except ValueError:
        return False
    return True


def format_expression(expression: Expression) -> str:
    """Return the expression as a user writes it."""
    if isinstance(expression, str):
        return expression
    form, *operands = expression
    if form == "identity":
        return "1"
    if form == "resolvent":
        return RESOLVENTS.get(operands[0], f"resolvent({format_expression(operands[0])})")
    if form == "scaled":
        return f"{operands[0]:g} {_in_brackets(operands[1])}"
    if form == "transpose":
        return f"{_in_brackets(operands[0])}.T"
    if form == "product":
        return " @ ".join(map(_in_brackets, operands))
    return " + ".join(map(format_expression, operands))


def _in_brackets(expression: Expression) -> str:
    text = format_expression(expression)
    return f"({text})" if " " in text else text
