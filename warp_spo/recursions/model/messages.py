"""Messages that the segments of a robot send each other, and the offset of each among those of an operation.

A message has a letter. "Inward" goes to the parent, "outward" to all segments further out, "first" to the first segment
when all others are done, "all" to all segments, after the state of the step is known.

======  =========  ==================  ========================================================================
letter  direction  values              meaning
======  =========  ==================  ========================================================================
P       inward     21                  articulated inertia phi P+ phi*
z, y    inward     6                   articulated bias force phi z+, or another force on the parent
f       inward     6                   force on the parent
R       inward     10                  composite inertia
B       inward     24                  how a sum changes with the parent's motion
G       inward     36                  how another sum changes with what contact points know of the parent
O       inward     3                   how it changes with the ground's origin
U, L    inward     12                  flow and momentum of what a link carries; its load and pull
a, b    outward    6                   acceleration alpha of the last link
Q       outward    21                  how a sum changes with P
N       outward    6 pivots            for Mass^-1: rates of all pivots further in per unit force on the last link
D       outward    dofs                the segment's own pivots
V, Y    outward    dofs times pivots   the segment's columns of Y = D^-1 [I - H psi K]; the part of them further in
S       first      1                   status word
E       first      4                   by how much the last pass of a step with contacts exceeds its laws
X       all        coordinates + dofs  q and qd of a segment after a step
======  =========  ==================  ========================================================================
"""

from __future__ import annotations

from collections.abc import Collection

from .segments import Segment, Segments

INWARD, OUTWARD = "sent", "returned"
"""The array that messages go through, by either name."""
OUTWARD_LETTERS = "abQNDVY"
SIZES = {"P": 21, "z": 6, "f": 6, "y": 6, "R": 10, "B": 24, "G": 36, "O": 3, "U": 12, "L": 12, "a": 6, "b": 6, "Q": 21,
         "S": 1, "E": 4}  # fmt: skip
NEEDS = {"U": "qd", "L": "body_f", "O": "ground_origin_later", "X": "poses_out"}
"""The array without which a message is zero, or nobody reads it, and is not sent, by letter."""


def channel(letter: str) -> str:
    """Return the name of the array that a message goes through."""
    return OUTWARD if letter in OUTWARD_LETTERS else INWARD


def size(letter: str, segment: Segment) -> int:
    """Return how many values a message of a segment has."""
    if letter in SIZES:
        return SIZES[letter]
    if letter == "X":
        return segment.coord_count + segment.dof_count
    further = sum(one.dof_count for one in segment.ancestors)
    whole = further + segment.dof_count
    return {"N": 6 * whole, "D": segment.dof_count, "V": whole * segment.dof_count, "Y": further * segment.dof_count}[
        letter
    ]


def select_sent(letters: str, inputs: Collection[str]) -> str:
    """Return those of the letters that are sent where these arrays are read."""
    return "".join(letter for letter in letters if letter not in NEEDS or NEEDS[letter] in inputs)


def offsets(letters: str, segments: Segments) -> tuple[dict[tuple[str, int], int], int]:
    """Return where each message begins, by letter and segment, and the values of all messages together.

    Long messages outward take the place of what the same tree sent inward and has read by then.
    """
    places: dict[tuple[str, int], int] = {}
    end = 0
    groups = ("P", letters[1:]) if "N" in letters else (letters,)
    for root in (segment for segment in segments.all if segment.parent is None):
        tree = [segment for segment in segments.all if root in (segment, *segment.ancestors)]
        start = end
        for group in groups:
            at = start
            for segment in tree:
                for letter in group:
                    if _sends(letter, segment, tree):
                        places[letter, segment.index] = at
                        at += size(letter, segment)
            end = max(end, at)
    return places, end


def _sends(letter: str, segment: Segment, tree: list[Segment]) -> bool:
    if letter in "SEX":
        return True
    if letter == "Y":
        return any(other.computes_shared_entries_with(segment) for other in tree)
    return bool(segment.children) if letter in OUTWARD_LETTERS else segment.parent is not None
