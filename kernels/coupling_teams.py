"""Native code by which a team of warps couples pairs of bodies through shared memory, for steps by limbs side by side.

Pairs with the same two bodies are one couple. Each body is on a limb; limbs sit on one link, the base, or stand for
themselves. Of a body, its limb leaves the response to wrenches on it and the twist it would have if the base did not
accelerate; with alpha, the base's acceleration, the relative twist of a couple is u + h B alpha + h W f. So

    S = 1 + h L* W L = C C*;  r = C^-1 L* u;  E = C^-1 L* B;  y = C^-* (r + h E alpha);  f = f0 - L y,

where K = L L* and f0 are as in :mod:`.coupling` and u contains the effect of f0. The base gets the inertia h E* E and
the force -E* r, and the sweep goes on. S has a block only where two couples share a limb, or elimination fills it.

A value of a world is ``s[i * STRIDE]``: a thread works on a world, and warps share what there is to do for it.
"""

from collections.abc import Sequence
from typing import Any

import warp as wp

from . import coupling_blocks, coupling_matrices, coupling_points, coupling_shared
from . import hull_distance as hulls
from . import narrow_phase as touches
from .coupling import COLUMN, FEW, entries, table
from .elementary import C_TYPE
from .narrow_phase import AWAY, HEADER, POINT

BASE = 27  # values that the base gets: an inertia and a force


def declare(team: Any, T: type, local: bool = False) -> str:
    """Return the definition of ``team_coupling``."""
    c, couples, bodies = C_TYPE[T], len(team.pairs), len(team.limbs)
    number, few = "f" if T is wp.float32 else "", couples <= FEW
    order = [pair for _, pairs in team.pairs for pair in pairs]
    couple_of, first_pair = {}, [0]
    for at, (_, pairs) in enumerate(team.pairs):
        couple_of |= dict.fromkeys(pairs, at)
        first_pair.append(first_pair[-1] + len(pairs))
    first_point = [sum(team.points[:pair]) for pair in range(len(team.points))]
    blocks = sorted(team.blocks)
    lists: dict[str, Sequence[int]] = {
        "first_body": [bodies[0] for bodies, _ in team.pairs], "second_body": [bodies[1] for bodies, _ in team.pairs],
        "first_pair": first_pair, "pair": order, "points": team.points, "first_point": first_point,
        "entry": entries(team.points)[:-1], "row": [row for row, _ in blocks], "column": [q for _, q in blocks],
        "matrix": [team.matrix(p, q) for p in range(couples) for q in range(couples)],
        "side": [team.side(p, side) for p in range(couples) for side in range(2)], "warp": team.warps or [0],
        "right": [team.side(p, team.leads(p)) for p in range(couples)], "lead": [team.leads(p) for p in range(couples)],
        "skipped": [team.skipped(p, side) for p in range(couples) for side in range(2)],
        "limb": team.limbs or [0], "dofs": team.dofs or [0], "seated": [int(x) for x in team.seated] or [0],
    }  # fmt: skip
    lists |= team.solids.lists
    tables = [table("int", f"{name}_of", [str(x) for x in row], few) for name, row in lists.items()]
    reals = {"eps": team.eps, "weight": team.weight} | team.solids.reals
    tables += [table(c, f"{name}_of", [f"{x!r}{number}" for x in row], few) for name, row in reals.items()]
    places = {f"AT_{name.upper()}": at for name, at in team.layout.items()}
    sizes = places | {
        "PAIRS": len(team.points), "COUPLES": couples, "BODIES": bodies, "ITEMS": len(blocks), "ALPHA": team.alpha,
        "RIGHT": team.right, "BASE": BASE, "HEADER": HEADER, "POINT": POINT,
    }  # fmt: skip
    text = coupling_shared.NATIVE.replace("MATRICES", coupling_matrices.NATIVE.strip())
    text = text.replace("BLOCKS", coupling_blocks.NATIVE).replace("SHAPES", coupling_points.NATIVE)
    text = hulls.lines(text, bool(team.solids.hulls))
    text = text.replace("REAL", c).replace("FUSED", f"FUSED_{c}").replace("TABLES", "\n    ".join(tables))
    text = (
        text.replace("NOTHING", f"1e-24{number}")
        .replace("TINY", "1e-6f" if T is wp.float32 else "1e-13")
        .replace("AWAY", f"{AWAY!r}{number}")
    )
    each = "#pragma unroll" if few else "#pragma unroll 1"
    for word, pragma in (("UNROLL", "#pragma unroll"), ("EACH", each), ("LOOP", "#pragma unroll 1")):
        text = text.replace(f"{word}\n", f"{pragma}\n")
    if local:
        text = text.replace("__noinline__", "inline").replace("STRIDE = 32", "STRIDE = 1")
    constants = ", ".join(f"{name} = {value}" for name, value in sizes.items())
    return COLUMN + touches.native(T, *team.solids.met) + text.replace("CONSTANTS", constants)
