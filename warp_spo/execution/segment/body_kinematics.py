"""Kinematics of bodies in one loop over steps along the tree: warps go from its roots to the bodies of each segment.

Steps that differ in numbers alone share a text. So little code stays in the instruction cache, and needs few registers.
"""

from __future__ import annotations

from ...recursions.model.links import Links
from ...trace.emission import C_TYPE, Emitter, Listing, Store, render
from ..array_access import make_emitter
from ..builder import Builder, Job, Program, flatten
from ..plan import MOST_WARPS
from . import body_frames
from .shared_code import SharedCode


def build(builder: Builder, job: Job, links: Links) -> Program | None:
    """Return the program of a job that stores the states of bodies; None if there is no room for them."""
    traversals, dtype = _assign_to_warps(body_frames.traversals(links)), builder.dtype
    stores = {step: _step_stores(links, job, *step) for step in sorted({step for each in traversals for step in each})}
    everything = [item for some in stores.values() for item in some]
    whole = [item for item in everything if item.array == "out"]
    layout = builder.layout(job, whole, everything, warps=len(traversals))
    if not layout.further_staged:
        return None
    emitters: list[Emitter] = []
    listings = {}
    for step, some in stores.items():
        emitters.append(make_emitter(dtype, job.shapes, layout, True))
        listings[step] = emitters[-1].region(some)
    shared = SharedCode(dtype, near=True)
    cuda = _cuda(shared, traversals, listings)
    declared = f"{C_TYPE[dtype]} {body_frames.FRAME}_row[{body_frames.SIZE}];"
    steps = [listings[step] for traversal in traversals for step in traversal]
    cpu = "\n".join([declared, *(f"{{\n{render(listing, dtype)}\n}}" for listing in steps)])
    lists = {"table": shared.table, "shifts": shared.shifts, body_frames.GEOMETRY: body_frames.geometry(links.scene)}
    tables = {name: values for name, values in lists.items() if values}
    layout = layout._replace(near=(("shifts", len(shared.shifts)),))
    assert job.routine.segments is not None
    if not layout.fits(builder.run.dtype, builder.room(job.routine.segments.wide)):
        return None
    name = body_frames.GEOMETRY.upper()
    cuda = f"#define {name}(i) __ldg(geometry.data + i)\n{declared}\n{cuda}\n#undef {name}"
    cpu = f"#define {name}(i) geometry.data[i]\n{cpu}\n#undef {name}"
    return builder.finish(job.routine, layout, cuda, cpu, tables, sum(each.operations for each in emitters))


def _assign_to_warps(traversals: list[list]) -> list[list]:
    """Return the steps of each warp: those of its traversals, one after the other.

    The longest traversals come first, each to the warp that has least to do.
    """
    found: list[list] = [[] for _ in traversals[:MOST_WARPS]]
    for traversal in sorted(traversals, key=len, reverse=True):
        min(found, key=len).extend(traversal)
    return found


def _step_stores(links: Links, job: Job, moves: bool, number: int) -> list[Store]:
    """Return the stores of a step of a traversal: to link ``number``, or of the state of body ``number``."""
    if moves:
        return body_frames.move_to_link(links, number)
    return [
        item if item.array == body_frames.FRAME else flatten(item, job.shapes)
        for item in body_frames.store_body(links, number)
    ]


def _cuda(shared: SharedCode, traversals: list[list], listings: dict[tuple[bool, int], Listing]) -> str:
    """Return the loop of a warp over the steps of its traversal; a table says the text and the place of each."""
    kinds: dict[str, list[tuple[bool, int]]] = {}
    for step, listing in listings.items():
        kinds.setdefault(listing.text, []).append(step)
    branches: list[str] = []
    known: dict[tuple[bool, int], tuple[int, int]] = {}
    for kind, steps in enumerate(kinds.values()):
        known |= {step: (kind, who) for who, step in enumerate(steps)}
        head, (text,) = shared.merge([[listings[step] for step in steps]], "", f"k{kind}_", "who")
        branches += [f"{'else ' if kind else ''}if (kind == {kind}) {{", head, text, "}"]
    first, begin = len(shared.shifts), [0]
    for traversal in traversals:
        begin.append(begin[-1] + len(traversal))
    shared.shifts += begin
    table = len(shared.shifts)
    shared.shifts += [x for traversal in traversals for step in traversal for x in known[step]]
    return "\n".join(
        [
            f"const int last = {shared.integer(f'{first + 1} + warp')};",
            "#pragma unroll 1",
            f"for (int at = {shared.integer(f'{first} + warp')}; at < last; ++at) {{",
            f"const int kind = {shared.integer(f'{table} + 2 * at')};",
            f"const int who = {shared.integer(f'{table + 1} + 2 * at')};",
            *branches,
            "}",
        ]
    )
