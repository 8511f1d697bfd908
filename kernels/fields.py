"""Fields: arrays of the scene's values, which generated code reads as ``FIELD(name, entry)``.

Newton's values are [entry, world]. The tables of links are [tile, entry, world of the tile], with 32 worlds in a tile:
what a warp reads lies together, at distances that the compiler knows. An array that all worlds share has a stride of
zero along its worlds or tiles.
"""

from collections.abc import Sequence

from .long_results import WARP_SIZE

TILED = ("value", "node_value", "lost_value")
"""Names of the tables of links: what links are made of; what bodies by themselves are, for the operators; whether some
value is not finite."""


def axes(name: str) -> int:
    """Return the number of axes of a field."""
    return 3 if name in TILED else 2


def define_fields(names: list[str], c: str, cached: Sequence[Sequence[int]] = ()) -> list[str]:
    """Return the definition of FIELD for fields in global memory, whose scalars have the C type ``c``.

    FIELD takes an entry, or the place of an entry among the ``cached`` ones, by field, if they are given.
    """
    if not names:
        return []
    text = []
    for name, entries in zip(names, cached, strict=False):
        text += [f"static const int {name}_entry[] = {{{', '.join(map(str, entries))}}};"]
    return [
        *text,
        "#if defined(__CUDA_ARCH__)",
        "#define FIELD(name, entry) __ldg(name##_at + (entry) * name##_part)",
        "#else",
        f"#define FIELD(name, entry) name##_at[{'name##_entry[entry]' if text else '(entry)'} * name##_part]",
        "#endif",
        *(f"const {c}* {name}_at = (const {c}*)({_first(name, c)});\n{_part(name, c)}" for name in names),
    ]


def copy_cached_fields(names: list[str], cached: Sequence[Sequence[int]], at: int, c: str) -> list[str]:
    """Return the definition of FIELD for cached entries, and code with which each thread copies those of its world.

    The entries of 32 worlds lie in shared memory from the scalar ``at`` of a group on.
    """
    text = ["#define FIELD(name, place) name##_at[(place) * 32]"]
    for name, entries in zip(names, cached, strict=True):
        text += [
            f"{c}* {name}_at = stage + {at} + lane;",
            f"const {c}* {name}_from = (const {c}*)({_first(name, c)});\n{_part(name, c)}",
        ]
        for place, entry in enumerate(entries):
            text += [f"ON_ITS_WAY({name}_at + {WARP_SIZE * place}, {name}_from + {entry} * {name}_part);"]
        at += WARP_SIZE * len(entries)
    return text


def place_in_tile(entry: str, entries: int) -> str:
    """Return C++ for the place of an entry of the thread's world in a contiguous table of so many entries."""
    return f"(world >> 5) * {WARP_SIZE * entries}ll + ({entry}) * {WARP_SIZE} + (world & 31)"


def _first(name: str, c: str) -> str:
    """Return C++ for the address of the first entry of the thread's world, in bytes."""
    if name in TILED:
        return f"(const char*){name}.data + (world >> 5) * {name}.strides[0] + (world & 31) * sizeof({c})"
    return f"(const char*){name}.data + world * {name}.strides[1]"


def _part(name: str, c: str) -> str:
    """Return the declaration of the distance from one entry of a world to the next."""
    if name in TILED:
        return f"const int {name}_part = {WARP_SIZE};"
    return f"const long long {name}_part = {name}.strides[0] / (int)sizeof({c});"
