"""Native code that finds the wrenches with which pairs of bodies push each other in a pass of a step.

Of the points of a pair with relative twist T v, with dampers G and loads f0, the sums K = sum phi* G phi = L L* and f0
are collected at the pair's reference point. All pairs of a world that touch are solved together,

    W = T A0^-1 T*;  S = 1 + h L* W L;  y = S^-1 L* (T x0 + h W f0);  f = f0 - L y,

where A0 and x0 are matrix and solution of the pass without pairs. More than EXACT pairs are solved one after the other
in SWEEPS rounds, which begin with the forces of the pass before. f acts on one body and -f on the other.

Twists are (v; omega), wrenches (f; n), of the bodies' origins in inertial axes. :mod:`.touches` gives the points.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import warp as wp

from . import coupling_matrices, coupling_passes, coupling_points
from . import hull_distance as hulls
from . import narrow_phase as touches
from .elementary import C_TYPE
from .narrow_phase import AWAY, HEADER, POINT

EXACT, SWEEPS, FEW, BLOCK = 8, 16, 2, 64
VALUES, REPORTS, EXCESS = 3, 5, 4
"""Entries of a pair's values: stiffness, damping, friction; of its reports: force, gap, slip; and of a world's excess:
beyond the friction cones, pull, lacking push, and the change of forces in the last of SWEEPS rounds."""


class CoupledPairs(NamedTuple):
    """The pairs of a scene.

    Attributes:
        bodies: of each pair, numbers among those that move; -1 stands still. points: of each pair at most.
        eps, weight: of each pair: speed below which friction is a damper; inverse weight that predicts slip.
        blocks: first entry of each block of the bodies' response, by body and body not before it; -1 is zero.
        solids: their shapes, with ``size``, ``lists`` and ``reals``.
    """

    bodies: tuple[tuple[int, int], ...]
    points: tuple[int, ...]
    eps: tuple[float, ...]
    weight: tuple[float, ...]
    blocks: tuple[tuple[int, ...], ...]
    solids: Any


def entries(points: Sequence[int]) -> tuple[int, ...]:
    """Return the first entry of each pair in the array of touches, and the total, for so many points of each."""
    found = [0]
    for count in points:
        found.append(found[-1] + HEADER + POINT * count)
    return tuple(found)


def declare(couples: CoupledPairs, T: type) -> str:
    """Return the definition of ``coupling`` and of the thread's arrays that its passes share."""
    c, pairs, bodies = C_TYPE[T], len(couples.bodies), len(couples.blocks)
    number = "f" if T is wp.float32 else ""
    first = [0]
    for count in couples.points:
        first.append(first[-1] + count)
    together, apart = min(pairs, EXACT), pairs > EXACT
    lists = {
        "FIRST_BODY": [pair[0] for pair in couples.bodies], "SECOND_BODY": [pair[1] for pair in couples.bodies],
        "POINTS": couples.points, "FIRST_POINT": first[:-1], "ENTRY": entries(couples.points)[:-1],
        "BLOCK": [entry for row in couples.blocks for entry in row] or [-1],
    }  # fmt: skip
    lists |= {name.upper(): row for name, row in couples.solids.lists.items()}
    reals = {"EPS": couples.eps, "WEIGHT": couples.weight}
    reals |= {name.upper(): tuple(row) for name, row in couples.solids.reals.items()}
    tables = [table("int", f"{name.lower()}_of", [str(x) for x in row], pairs <= FEW) for name, row in lists.items()]
    tables += [
        table(c, f"{name.lower()}_of", [f"{x!r}{number}" for x in row], pairs <= FEW) for name, row in reals.items()
    ]
    sizes = {
        "PAIRS": pairs, "BODIES": bodies, "ROWS": 6 * together, "LARGEST": EXACT, "SWEEPS": SWEEPS,
        "HEADER": HEADER, "POINT": POINT, "ALONE": pairs if apart else 1, "FEW": int(pairs <= FEW),
    }  # fmt: skip
    text = hulls.lines(NATIVE, bool(couples.solids.hulls))
    text = text.replace("REAL", c).replace("FUSED", f"FUSED_{c}").replace("TABLES", "\n    ".join(tables))
    text = (
        text.replace("NOTHING", f"1e-24{number}")
        .replace("TINY", "1e-6f" if T is wp.float32 else "1e-13")
        .replace("AWAY", f"{AWAY!r}{number}")
    )
    each = "#pragma unroll" if pairs <= FEW else "#pragma unroll 1"
    for word, pragma in (("UNROLL", "#pragma unroll"), ("EACH", each), ("LOOP", "#pragma unroll 1")):
        text = text.replace(f"{word}\n", f"{pragma}\n")
    constants = ", ".join(f"{name} = {value}" for name, value in sizes.items())
    own = {"across": first[-1], "closed": first[-1], "candidate": first[-1], "force": 6 * pairs, "arm": 7 * pairs}
    arrays = [f"{c} pair_{name}_row[{count}] = {{}};" for name, count in own.items()]
    return "\n".join([COLUMN, touches.native(T, *couples.solids.met), text.replace("CONSTANTS", constants), *arrays])


def shared_arrays(couples: CoupledPairs) -> dict[str, int]:
    """Return the sizes of the thread's arrays that statements around ``coupling`` write and read, by name."""
    pairs, bodies = len(couples.bodies), len(couples.blocks)
    response = 1 + max((entry for row in couples.blocks for entry in row), default=0)
    sizes = {"value": VALUES * pairs + 1, "response": response + 35, "report": REPORTS * pairs + EXCESS}
    sizes |= {
        "place": couples.solids.size,
        "start": max(6 * bodies, 1),
        "twist": 6 * bodies + 1,
        "wrench": max(6 * bodies, 1),
    }
    return {f"pair_{name}": size for name, size in sizes.items()}


def table(c: str, name: str, row: list[str], few: bool) -> str:
    """Return a function that gives an entry of a list; of a short list without memory, so that a compiler folds it."""
    if few:
        body = "".join(f"i == {i} ? {x} : " for i, x in enumerate(row[:-1])) + row[-1]
        return f"static CUDA_CALLABLE inline {c} {name}(int i) {{ return {body}; }}"
    listed = ", ".join(row)
    return f"static CUDA_CALLABLE inline {c} {name}(int i) {{ static const {c} all[] = {{{listed}}}; return all[i]; }}"


COLUMN = """
#if defined(__CUDA_ARCH__)
const long long column = start + lane;  // lanes without a world have columns of their own
#else
const long long column = world;
#endif
"""
"""Native code that says which column of the array of touches is the thread's; there are :func:`columns`."""


def columns(worlds: int) -> int:
    """Return how many columns the array of touches has for so many worlds."""
    return -(-worlds // BLOCK) * BLOCK


BEGIN = """
coupling::begin(pair_value_row, pair_start_row, pair_place_row, touches.data + column, touches.shape[1], dt_row[0],
    pair_arm_row, pair_across_row, pair_closed_row, pair_candidate_row);
"""
PASS = """
coupling::pass(pair_value_row, pair_twist_row, pair_response_row, touches.data + column, touches.shape[1], dt_row[0],
    pair_twist_row[6 * BODIES] > 0, pair_arm_row, pair_across_row, pair_closed_row, pair_candidate_row,
    pair_force_row, pair_wrench_row, pair_report_row);
"""
NATIVE = coupling_passes.NATIVE.replace("POINTS", coupling_points.NATIVE + "\n").replace(
    "MATRICES", coupling_matrices.NATIVE.strip()
)
