"""How far a point is from the convex hulls of a scene's pairs, for :mod:`.touches`.

A hull is its faces: planes n . x = d about its middle, and the edges that go round each of them. Inside, the nearest
face is the one whose plane is nearest. Outside, the nearest point lies on a face that is seen from there: in it, where
the point is over the face, or on one of its edges. All faces are looked at, in one order, so that a world does the same
among others as alone; of two that are as near, the first counts.

Lines of native text that begin with HULLS are there only in scenes with hulls, and so with other such words.
"""

import re
from typing import Any

import warp as wp

from . import segment_convex as sticks
from .elementary import C_TYPE

EDGE = 7  # numbers of an edge: where it begins, what leads to its end, 1 / length^2


def lines(text: str, there: bool, word: str = "HULLS") -> str:
    """Return native text with its lines for hulls, or for what else they begin with, or without these lines."""
    return text.replace(f"{word} ", "") if there else re.sub(rf"^ *{word} .*\n", "", text, flags=re.MULTILINE)


def native(hulls: Any, T: type, long: bool) -> str:
    """Return the definition of ``hulls`` for scalars of type ``T``; nothing where there are none.

    Each has ``planes``, four numbers a face, and ``edges``, EDGE numbers for each edge of each face. ``long``: some
    pair is of a segment and a box or a hull.
    """
    if not hulls:
        return ""
    number = "f" if T is wp.float32 else ""
    first_face, first_edge = [0], [0]
    for hull in hulls:
        first_face.append(first_face[-1] + len(hull.edges))
        for edges in hull.edges:
            first_edge.append(first_edge[-1] + len(edges) // EDGE)
    reals = {
        "plane": [x for hull in hulls for x in hull.planes],
        "edge": [x for hull in hulls for edges in hull.edges for x in edges],
    }
    integers = {"first_face": first_face, "first_edge": first_edge}
    tables = [_table("int", name, [str(x) for x in row]) for name, row in integers.items()]
    tables += [_table(C_TYPE[T], name, [f"{x!r}{number}" for x in row]) for name, row in reals.items()]
    text = lines(NATIVE, long, "STICKS").replace("OVER_FACE\n", sticks.OVER_FACE)
    text = text.replace("TABLES", "\n    ".join(tables)).replace("REAL", C_TYPE[T]).replace("EDGE", str(EDGE))
    return text.replace("UNROLL\n", "#pragma unroll\n").replace("LOOP\n", "#pragma unroll 1\n")


def _table(c: str, name: str, row: list[str]) -> str:
    """Return a function that gives an entry of a list that lies in memory: hulls are too long to fold."""
    listed = ", ".join(row)
    return (
        f"static CUDA_CALLABLE inline {c} {name}_of(int i) {{ static const {c} all[] = {{{listed}}}; return all[i]; }}"
    )


NATIVE = r"""
struct hulls
{
    TABLES

    static CUDA_CALLABLE inline REAL dot(const REAL* a, const REAL* b)
    {
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    }

    // Returns how far a point is from a hull, less than zero inside, and the unit vector along which that grows.
    static CUDA_CALLABLE inline REAL distance(int hull, const REAL* at, REAL* away)
    {
        const int begin = first_face_of(hull), end = first_face_of(hull + 1);
        REAL most = 0, least = -1, rest[3] = {0, 0, 0};
        LOOP
        for (int face = begin; face < end; ++face) {
            const REAL normal[3] = {plane_of(4 * face), plane_of(4 * face + 1), plane_of(4 * face + 2)};
            const REAL height = dot(normal, at) - plane_of(4 * face + 3);
            if (face == begin || height > most) {
                most = height;
                UNROLL
                for (int c = 0; c < 3; ++c) away[c] = normal[c];
            }
            if (!(height > 0)) continue;
            bool over = true;
            LOOP
            for (int i = first_edge_of(face); i < first_edge_of(face + 1); ++i) {
                REAL from[3], along[3];
                UNROLL
                for (int c = 0; c < 3; ++c) {
                    from[c] = at[c] - edge_of(EDGE * i + c);
                    along[c] = edge_of(EDGE * i + 3 + c);
                }
                const REAL outward[3] = {along[1] * normal[2] - along[2] * normal[1],
                    along[2] * normal[0] - along[0] * normal[2], along[0] * normal[1] - along[1] * normal[0]};
                over = over && dot(from, outward) <= 0;
                REAL share = dot(from, along) * edge_of(EDGE * i + 6);
                share = share < 0 ? 0 : share > 1 ? 1 : share;
                UNROLL
                for (int c = 0; c < 3; ++c) from[c] -= share * along[c];
                const REAL square = dot(from, from);
                if (least < 0 || square < least) {
                    least = square;
                    UNROLL
                    for (int c = 0; c < 3; ++c) rest[c] = from[c];
                }
            }
            if (over) {
                UNROLL
                for (int c = 0; c < 3; ++c) away[c] = normal[c];
                return height;
            }
        }
        if (!(least > 0)) return most;
        least = sqrt(least);
        UNROLL
        for (int c = 0; c < 3; ++c) away[c] = rest[c] / least;
        return least;
    }

    STICKS OVER_FACE
};
"""
