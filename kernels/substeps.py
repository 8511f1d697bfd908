"""Substeps: the statements of a step in a loop. A substep writes the state where the next one reads it.

On CUDA the state of a world is in shared memory while the loop runs, or in the registers of the world's own thread; on
the CPU it is in the rows of the result. All other rows stay as they are, and are read again.
"""

from typing import NamedTuple

from .shared_rows import SharedRow

SUBSTEPS = "substeps"  # the name of the number of substeps
# without it the compiler holds rows that stay in registers from substep to substep, and spills others
FENCE = 'asm volatile("" ::: "memory");'
SYNC = "__syncthreads();"
WAIT = "WAIT;"
STATE = {"q": "q_out", "qd": "out"}  # the rows of the state, and the results that take their place


class Before(NamedTuple):
    """Code that writes ``tau_row`` before each substep.

    On CUDA ``workers`` warps of a team run it, ``worker`` is the number of one, and rows of tau are in shared memory.
    Where there are ``helpers``, they are the workers, and run it beside the others, which wait for it where they read
    ``tau_row``; otherwise all warps are. At WAIT workers wait for each other. A warp has 32 worlds, the thread
    ``world``; ``own`` is shared memory.

    Attributes:
        define: texts of structures that the code uses.
        start: before the first substep. each: the code. beside: for the next substep, while this one runs; without
            helpers ahead of ``each``.
        cpu: all of it for the CPU, where ``tau_row`` is that of the caller's array.
        scalars: of shared memory.
    """

    define: tuple[str, ...]
    start: str
    beside: str
    each: str
    cpu: str
    scalars: int


def repeat_substeps(statements: str) -> str:
    """Return the statements of a step in a loop over substeps, in which ``substep`` counts from zero."""
    return f"for (int substep = 0; substep < (int){SUBSTEPS}_row[0]; ++substep) {{\n{statements}\n}}"


def repeat_on_cuda(statements: str, team: bool) -> str:
    """Return the same for CUDA; in a team, other warps read what this one wrote."""
    return "\n".join(["#pragma unroll 1", repeat_substeps("\n".join([FENCE, statements, *[SYNC] * team]))])


def hold_state(row: SharedRow, c: str) -> str:
    """Return the declaration of ``name_row``, a copy of a row of the state in the thread."""
    read = f"{row.name}_row[i] = {row.name}.data[world * {row.entries} + i];"
    return f"{c} {row.name}_row[{row.entries}];\n#pragma unroll\nfor (int i = 0; i < {row.entries}; ++i) {read}"


def write_state(row: SharedRow, c: str) -> str:
    """Return code that writes the copy of a row of the state to the result."""
    write = f"{STATE[row.name]}.data[world * {row.entries} + i] = {row.name}_row[i];"
    return f"if (mine) {{\n#pragma unroll\nfor (int i = 0; i < {row.entries}; ++i) {write}\n}}"


def move_state(row: SharedRow, c: str) -> str:
    """Return the declaration of ``name_row``, the row of the result, to which the state is copied before the loop."""
    name, at = row.name, f"world * {row.entries}"
    copy = f"for (int i = 0; i < {row.entries}; ++i) {name}_row[i] = {name}.data[{at} + i];"
    return f"{c}* {name}_row = {STATE[name]}.data + {at};\nif ({name}_row != {name}.data + {at}) {copy}"


def replace_state(row: SharedRow, c: str) -> str:
    """Return the declaration of the result's row in the place of the state's."""
    result = STATE[row.name]
    return f"{c}* {'result' if result == 'out' else result}_row = {row.name}_row;"
