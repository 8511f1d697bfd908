"""Programs at tree granularity: a thread computes one world, in program order."""

from __future__ import annotations

from typing import Any

from ..kernels import couples as couple_points
from ..kernels import pass_loops
from ..kernels.long_results import WARP_SIZE
from ..kernels.straight_line import DIRECT, RELAYED, TILED, KernelLayout
from ..recursions.contact import coupled, pairs
from ..recursions.contact.secant_laws import SECANT
from ..recursions.contact.ties import couples_of
from ..recursions.model.links import Links
from ..recursions.model.tracing import Trace
from ..recursions.step.phases import as_phases
from ..recursions.step.step import GAIN, LOOPED
from ..trace import equal_blocks
from ..trace.emission import C_TYPE, Store, render
from . import staging
from .array_access import make_emitter
from .builder import PASSED, Builder, Job, Program, flatten

PAIR = 2  # warps of a block that share nothing: fewer blocks start sooner


def build(builder: Builder, job: Job, links: Links) -> Program:
    """Return the program in which a thread computes one world."""
    run, plan, dtype = builder.run, builder.plan, builder.dtype
    routine, shapes, more, options = job
    trace = Trace(links, dtype, tuple(shapes))
    links.graph.apart = plan.loops_over_links and not run.scene.contact_pairs
    phases = as_phases(routine.trace(trace, **options))
    stores = [flatten(item, shapes) for item in phases.stores]
    apart = [item for item in stores if item.array in more]  # each straight to memory
    outs = [item for item in stores if item.array == "out"]
    looped = [item for item in stores if item.array in (*PASSED, coupled.TWIST)]
    aggregates = any(item.array == coupled.TWIST for item in stores)
    kept = [Store("ahead", (), x) for x in phases.pass_invariants] if looped else []  # may read what no store needs
    layout = builder.layout(job, outs, phases.prologue + stores + kept)
    once = routine.passes is not None or any(item.array in LOOPED for item in stores)  # may write over what it reads
    layout = layout._replace(retries=not once and not layout.staged and layout.result.way in (DIRECT, TILED, RELAYED))
    placed, table = staging.arrange_stores(outs, layout.result)
    placed += apart
    emitter = make_emitter(dtype, shapes, layout, branches=aggregates)
    regions = [emitter.region(phases.prologue, phases.pass_invariants)] if looped else []
    regions += emitter.branches([looped]) if looped else []
    listings = [*regions, emitter.region(placed)]
    tables: dict[str, Any] = {} if table is None else {"place": table}
    loops = equal_blocks.share(listings, dtype) if links.graph.apart else None
    if loops is not None and loops.kept:
        *before, body = loops.texts
        tables |= {equal_blocks.NUMBERS: loops.numbers or [0.0], equal_blocks.ENTRIES: loops.entries}
    else:
        *before, body = (render(each, dtype) for each in listings)
    tables |= builder.height_tables(emitter.counts["lookup"] > 0)
    if phases.prologue:
        entries = {GAIN: run.scene.dof_count, SECANT: max(1, sum(item.array == SECANT for item in phases.prologue))}
        if not aggregates:
            body = pass_loops.repeat_counted_passes([*before, body], entries, run.dtype)
    elif looped:
        ahead, a_pass = before
        body = pass_loops.repeat_passes(ahead, a_pass, body, LOOPED, run.scene.dof_count, run.dtype)
    if loops is not None and loops.kept:
        body = f"{C_TYPE[dtype]} {equal_blocks.KEPT}[{loops.kept}];\n{body}"
    direct = layout.staged and plan.copies_directly(routine)
    late = direct and routine.hints.waits_late
    block = PAIR * WARP_SIZE if late or (plan.latency_bound and not layout.shared_scalars) else WARP_SIZE
    layout = layout._replace(retries=layout.retries and "farthest" in body, block=block, direct=direct, late=late)
    cuda = cpu = body
    if aggregates:
        found = _couples(links, options, coupled.REPORT in body)
        layout, cuda, cpu = _coupled_step(builder, layout, found, [*before, body], entries)
    return builder.finish(routine, layout, cuda, cpu, tables, emitter.operations)


def _coupled_step(
    builder: Builder, layout: KernelLayout, couples: couple_points.Couples, parts: list[str], entries: dict[str, int]
) -> tuple[KernelLayout, str, str]:
    """Return the layout and the code, for CUDA and for the CPU, of a step in which aggregates couple bodies.

    Where worlds are few, couples have warps of their own.

    Args:
        parts: what a thread does before, in and after a pass. entries: sizes of its arrays.
    """
    plan, T, warps = builder.plan, builder.run.dtype, min(len(couples.pairs), couple_points.MOST_WARPS)
    cpu, shared = couple_points.text(couples, parts, entries, T), sum(couple_points.arrays(couples).values())
    team = layout._replace(block=WARP_SIZE * warps, warps=warps, messages=shared, late=False)
    helps = plan.latency_bound and plan.device.cuda and warps > 1 and not layout.result.slots
    if not helps or not team.fits(T, builder.room(True)):
        return layout, cpu, cpu
    return team, couple_points.text(couples, parts, entries, T, warps), cpu


def _couples(links: Links, options: dict[str, Any], reports: bool) -> couple_points.Couples:
    """Return the pairs of bodies of a scene as their native code needs them."""
    scene, couples = links.scene, couples_of(links)
    signs = dict(one for couple in couples for one in zip(couple.pairs, couple.signs, strict=True))
    points, eps = zip(*((pair.points, pair.eps) for pair in scene.contact_pairs), strict=True)
    looks = bool({"contact_gap", "contact_slip"} & set(options.get("reports", ())))
    return couple_points.Couples(
        tuple(couple.pairs for couple in couples), tuple(signs[i] for i in range(len(points))), points, eps,
        tuple(pairs.inverse_weights(scene)), pairs.solids_of(scene), looks, reports,
    )  # fmt: skip
