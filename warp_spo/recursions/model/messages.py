"""Messages that the pieces of a robot send each other, and the place of each among those of an operation.

Letters: inward P = phi P+ phi*, z and y = phi z+ or a force, f = a force, R = the composite inertia, B = how a sum
changes with the parent's motion, G = how another one changes with what contact points know of the parent, O = with the
ground's origin, U = the flow and momentum of what a link carries, L = its load and pull; outward a and b = alpha, Q =
how a sum changes with P, and for Mass^-1 N = the rates of all pivots further in for each unit force on the last link,
D = the piece's own pivots, V = its columns of Y, Y = the part of them that lies further in. From all to the first
piece, when all is done: S = a status word, E = by how much the last pass of a step with contacts exceeds its laws. From
all to all then: X = the coordinates and the rates of a piece after a step.
"""

from __future__ import annotations

from collections.abc import Collection

from .segments import Piece, Pieces

INWARD, OUTWARD = "sent", "returned"
"""The array that messages go through, by either name."""
OUTWARD_LETTERS = "abQNDVY"
SIZES = {"P": 21, "z": 6, "f": 6, "y": 6, "R": 10, "B": 24, "G": 36, "O": 3, "U": 12, "L": 12, "a": 6, "b": 6, "Q": 21,
         "S": 1, "E": 4}  # fmt: skip
NEEDS = {"U": "qd", "L": "body_f", "O": "ground_origin_later", "X": "poses_out"}
"""The array without which a message is zero, or nobody reads it, and is not sent, by letter."""


def way(letter: str) -> str:
    return OUTWARD if letter in OUTWARD_LETTERS else INWARD


def size(letter: str, piece: Piece) -> int:
    """Values of a message."""
    if letter in SIZES:
        return SIZES[letter]
    if letter == "X":
        return piece.coordinates + piece.weight
    further = sum(one.weight for one in piece.ancestors)
    whole = further + piece.weight
    return {"N": 6 * whole, "D": piece.weight, "V": whole * piece.weight, "Y": further * piece.weight}[letter]


def needed(letters: str, inputs: Collection[str]) -> str:
    """Return those of the letters that are sent where these arrays are read."""
    return "".join(letter for letter in letters if letter not in NEEDS or NEEDS[letter] in inputs)


def slots(letters: str, pieces: Pieces) -> tuple[dict[tuple[str, int], int], int]:
    """Return where each message begins, by letter and piece, and the values of all messages together.

    Long messages outward take the place of what the same tree sent inward and has read by then.
    """
    places: dict[tuple[str, int], int] = {}
    end = 0
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
    if letter in "SEX":
        return True
    if letter == "Y":
        return any(other.looks_at(piece) for other in tree)
    return bool(piece.children) if letter in OUTWARD_LETTERS else piece.parent is not None
