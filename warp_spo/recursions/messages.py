"""What the pieces of a robot send each other, and where each message lies among those of an operation.

Letters: inward P = phi P+ phi*, z and y = phi z+ or a force, f = a force, R = the composite inertia, B = how a sum
changes with the parent's motion; outward a and b = alpha, and for Mass^-1 N = the rates of all pivots further in for
each unit force on the last link, D = the piece's own pivots, V = its columns of Y, Y = the part of them that lies
further in. From all to the first piece, when all is done: S = a status word.
"""

from __future__ import annotations

from collections.abc import Iterable

from .pieces import Piece, Pieces

SENDS = {
    "forward_dynamics": "Pza",
    "forward_dynamics_apart": "fPza",
    "solve_mass_matrix": "Pza",
    "inverse_dynamics": "z",
    "forward_dynamics_and_solve": "Pzayb",
    "step": "PzaS",
    "forward_dynamics_vjp": "B",
    "inverse_dynamics_vjp": "B",
    "mass_matrix": "R",
    "mass_matrix_inverse": "PNDVY",
}
"""Letters by operation."""
INWARD, OUTWARD = "sent", "returned"
"""The array that messages go through, by either name."""
OUTWARD_LETTERS = "abNDVY"
SIZES = {"P": 21, "z": 6, "f": 6, "y": 6, "R": 10, "B": 24, "a": 6, "b": 6, "S": 1}
SHORT_WAYS = ("q", "tangent", "qd", "qdd", "tau")  # arguments whose gradient a piece knows by itself


def shared(operation: str, given: Iterable[str], wrt: Iterable[str] = ()) -> bool:
    """Whether pieces can share the work: backwards only if qdd and lambda are known, and by what belongs to a piece."""
    if not operation.endswith("_vjp"):
        return operation in SENDS
    known = operation == "inverse_dynamics_vjp" or {"qdd", "solved"} <= set(given)
    return known and "body_f" not in given and set(wrt) <= set(SHORT_WAYS)


def way(letter: str) -> str:
    return OUTWARD if letter in OUTWARD_LETTERS else INWARD


def size(letter: str, piece: Piece) -> int:
    """Values of a message."""
    if letter in SIZES:
        return SIZES[letter]
    further = sum(one.weight for one in piece.ancestors)
    whole = further + piece.weight
    return {"N": 6 * whole, "D": piece.weight, "V": whole * piece.weight, "Y": further * piece.weight}[letter]


def slots(operation: str, pieces: Pieces) -> tuple[dict[tuple[str, int], int], int]:
    """Where each message begins, by letter and piece, and the values of all together.

    Long messages outward take the place of what the same tree sent inward and has read by then.
    """
    letters, places, end = SENDS[operation], {}, 0
    groups = ("P", letters[1:]) if "N" in letters else (letters,)
    for root in (piece for piece in pieces.pieces if piece.parent is None):
        tree = [piece for piece in pieces.pieces if root in (piece, *piece.ancestors)]
        start = end
        for group in groups:
            at = start
            for piece in tree:
                for letter in group:
                    if _sends(letter, piece, tree):
                        places[letter, piece.index] = at
                        at += size(letter, piece)
            end = max(end, at)
    return places, end


def _sends(letter: str, piece: Piece, tree: list[Piece]) -> bool:
    if letter == "S":
        return True
    if letter == "Y":
        return any(other.looks_at(piece) for other in tree)
    return bool(piece.children) if letter in OUTWARD_LETTERS else piece.parent is not None
