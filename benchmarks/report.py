"""All rows as one HTML page: pictures, tables, and the stress suite with law and verdict."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from warp_spo.trials import report as pages

from . import pictures
from .evidence import Evidence
from .table import time

FILE = "report.html"
COLUMNS = {
    # head -> (key of a row, format)
    "scene": ("scene", ""), "operation": ("op", ""), "worlds": ("worlds", ""), "precision": ("dtype", ""),
    "library or granularity": ("", ""), "µs": ("us", ""), "eager µs": ("eager_us", ".3g"),
    "torch µs": ("torch_us", ".3g"),
    "spread": ("spread", ".1%"), "evals/s": ("evals_per_s", ".3g"), "flops": ("flops", ""), "bytes": ("bytes", ""),
    "of the roof": ("roof", ".2%"), "error": ("error", ".1e"), "median": ("error_median", ".1e"),
    "p99": ("error_p99", ".1e"), "backward": ("backward_error", ".1e"), "reference": ("reference", ""),
    "first call s": ("compile_s", ".2g"), "MiB": ("memory_MiB", ".4g"), "launches": ("launches", ""),
    "registers": ("registers", ""), "local B": ("local_bytes", ""),
}  # fmt: skip
STRESS = {
    "case": ("case", ""), "precision": ("precision", ""), "granularity": ("granularity", ""),
    "largest error": ("max_error", ".1e"), "median": ("median_error", ".1e"), "law": ("law", ".1e"),
    "error / law": ("ratio", ".2g"),
    "backward": ("backward_error", ".1e"), "µs for a world": ("us", ".3g"), "verdict": ("verdict", ""),
    "formula of the law": ("formula", ""), "section": ("source", ""), "reference": ("reference", ""),
}  # fmt: skip
NOTES = (
    "Times are those of one evaluation of all worlds. On a GPU a CUDA graph of many evaluations with changing "
    "inputs is replayed, and the median time is divided by their number; on a CPU calls are timed. Eager and torch "
    "are times of a single call, until its result is there. Errors are |y - y64| / |y64| of a sample of worlds; "
    "backward errors are |A x - b| / (|A| |x| + |b|). The roof is the larger of two times: the counted operations "
    "at the measured peak, and the caller's arrays at the measured copy bandwidth; its share is that time over the "
    "run time. NaN marks a result that is not finite."
)


def write(pyplot: Any, everything: Sequence[Evidence], folder: Path) -> Path:
    """Write the page of all machines into ``folder`` and return its file."""
    parts = [pages.paragraph(NOTES)]
    for evidence in everything:
        parts += _machine(pyplot, evidence)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / FILE
    path.write_text(pages.page("warp_spo: error and run time", parts))
    return path


def _machine(pyplot: Any, evidence: Evidence) -> list[str]:
    found = evidence.machine
    parts = [pages.heading(found["device"]), *(pages.paragraph(line) for line in evidence.sources)]
    if "copy_GBps" in found:
        peaks = ", ".join(f"{name} {peak:.4g} GFLOP/s" for name, peak in found["peak_GFLOPs"].items())
        parts.append(pages.paragraph(f"Measured: {peaks}; copy {found['copy_GBps']:.4g} GB/s read and written."))
    parts.append(embed_picture(pyplot, pictures.scaling(pyplot, evidence), "run time against size"))
    rows = [*evidence.rows, *evidence.peers]
    for operation in dict.fromkeys(row["op"] for row in rows):
        for worlds in pictures.world_counts(evidence):
            figure = pictures.error_time(pyplot, evidence, operation, worlds)
            parts.append(embed_picture(pyplot, figure, f"{operation}: error against run time"))
    if rows:
        heads = [head for head, (key, _) in COLUMNS.items() if not key or any(key in row for row in rows)]
        lines = [[_cell(row, *COLUMNS[head]) for head in heads] for row in rows]
        parts.append(pages.details(f"All {len(rows)} rows", pages.table(heads, lines)))
    if evidence.stress:
        parts.append(pages.heading("Stress suite"))
        failed = [row for row in evidence.stress if row["verdict"] == "FAILS"]
        judged = sum(row["verdict"] in ("ok", "FAILS") for row in evidence.stress)
        parts.append(pages.paragraph(f"{judged - len(failed)} of {judged} errors are within 10 times their law."))
        causes = {row["case"]: row.get("why") or "the cause is not known" for row in failed}
        parts += [pages.paragraph(f"{case} misses its law: {cause}.") for case, cause in causes.items()]
        lines = [[_stress_cell(row, *column) for column in STRESS.values()] for row in evidence.stress]
        parts.append(pages.table(list(STRESS), lines))
    return parts


def embed_picture(pyplot: Any, figure: Any, title: str) -> str:
    """Return the HTML of a figure under its title, and close the figure; "" for None."""
    if figure is None:
        return ""
    text = pages.heading(title, 3) + pages.image(figure)
    pyplot.close(figure)
    return text


def _cell(row: dict, key: str, form: str) -> str:
    if not key:
        return pictures.series_name(row)
    if key == "us":
        return time(row)
    value = row.get(key)
    return "" if value is None else f"{value:{form}}"


def _stress_cell(row: dict, key: str, form: str) -> str:
    if key == "case":
        return " ".join([row["case"], *(f"{name}={value:g}" for name, value in row["parameters"].items())])
    value = row.get(key)
    if key in ("law", "ratio") and value != value:  # not judged
        return ""
    return "" if value is None else f"{value:{form}}"
