"""How the statements of a kernel read and write arrays, messages between warps, and what a thread keeps."""

from __future__ import annotations

from ..kernels import straight_line
from ..kernels.straight_line import DIRECT, RELAYED, TILED, KernelLayout
from ..kernels.substeps import SUBSTEPS
from ..recursions.contact import coupled
from ..recursions.contact.secant_laws import SECANT
from ..recursions.model.messages import INWARD, OUTWARD
from ..recursions.step.step import FORCE, GUESS, LOOPED, MISSED, RESISTANCE
from ..status import Status
from ..trace.emission import C_TYPE, PREFIX, Emitter, RangeReduction
from . import staging
from .segment.body_frames import FRAME, GEOMETRY
from .segment.warp_specialized import HELD
from .staging import FIELDS

_LATER = [word for word in Status if word != Status.QUATERNION]  # which a substep leaves of unit length, or NaN
_SEVERITIES = hex(sum(word.severity << (4 * word) for word in _LATER)) + "ull"
_SEVERITY = f"({_SEVERITIES} >> 4 * {{}} & 15)".format
_IS_WORSE = (  # as kernels.combination.worst: a state that an earlier substep lost is no input that is not finite
    f"!substep || ({_SEVERITY('word')} > {_SEVERITY('status_row[0]')} && "
    f"(word != {Status.NOT_FINITE:d} || !status_row[0]))"
)


def make_emitter(
    dtype: str, shapes: dict, layout: KernelLayout, segments: bool = False, branches: bool = False
) -> Emitter:
    """Return an emitter of statements for a kernel of this layout.

    Args:
        dtype: "float32" or "float64".
        shapes: of the arrays that the kernel reads and writes, [world, ...], by name.
        layout: how it reads and writes them.
        segments: the statements are those of a segment, whose names have a prefix.
        branches: CUDA branches, too; slower on an H200 but where a branch leaves out much.
    """
    result = layout.result
    segments = segments or layout.warps > 1
    angles = RangeReduction.AGAIN if layout.retries else RangeReduction.FIRST
    angles = RangeReduction.IN_PLACE if layout.staged else angles
    guard = "if (mine) " if result.way == DIRECT else ""

    def load(array: str, entry: str) -> str:
        if array in (INWARD, OUTWARD):
            return f"SENT({entry})"
        if array in (HELD, FORCE, RESISTANCE) or (array in (*LOOPED, SECANT) and segments):
            return f"{'' if array == MISSED else PREFIX}{array}_row[{entry}]"
        if array == GEOMETRY:
            return f"{GEOMETRY.upper()}({entry})"
        if array in FIELDS:
            return f"FIELD({array}, {entry})"
        return f"{array}_row[{entry}]"

    def store(array: str, entry: str, value: str) -> str:
        if array in (INWARD, OUTWARD):
            return f"SENT({entry}) = {value};"
        if array == "out" and result.way == RELAYED:
            return f"RELAY({entry}) = {value};"
        if array in (HELD, SECANT, FORCE, RESISTANCE, FRAME, *coupled.ARRAYS):
            return f"{load(array, entry)} = {value};"
        if array == MISSED and segments:
            return f"missed_row[0] += {value};"
        if array in LOOPED and segments:
            return f"{'if (open) ' if array == GUESS else ''}{load(array, entry)} = {value};"
        if array == "out" and result.way == TILED:
            return f"if (mine) result_row[({entry}) * {straight_line.TILE}] = {value};"
        if layout.repeats and array == "status":
            return f"if (mine) {{ const int word = {value}; if ({_IS_WORSE}) status_row[0] = word; }}"
        if layout.repeats and array == "contact_f":  # the mean over substeps
            before, share = f"substep ? {array}_row[{entry}] : 0", f"1 / {SUBSTEPS}_row[0]"
            return f"if (mine) {array}_row[{entry}] = FUSED_{C_TYPE[dtype]}({value}, {share}, {before});"
        if array == "out":
            return f"{guard}result_row[{entry}] = {value};"
        return f"if (mine) {array}_row[{entry}] = {value};"

    places = {
        name: {entry: place for place, entry in enumerate(entries)}
        for name, entries in zip(layout.fields, layout.cached, strict=False)
    }

    def flat(array: str, index: tuple) -> int:
        if array in places:
            return places[array][index[0]]
        return index[0] if len(index) == 1 else staging.flat_index(index, shapes[array][1:])

    return Emitter(dtype, load, store, flat, angles, FIELDS, fuses=True, branches=branches)
