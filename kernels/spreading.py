"""Long results: the values that a block worked out become rows, 16 bytes at a time.

A matrix has far fewer different values than entries. They wait in shared memory, [world, slot]; a table says where the
entries of a row are. Rows of 32 worlds are one stretch of memory that begins at a multiple of 16 bytes, and after a
``period`` of worlds each entry again lies as far from such a multiple. So a thread looks up a group of neighbouring
entries once and writes it for each period, in one store.

Where the values of 32 worlds do not fit, they go through memory: ``relay`` [seat, slot, 32 worlds], from where TILE
worlds at a time come back. A block takes a seat of its multiprocessor's and leaves it to a later one, so that all that
memory is small and stays in the L2 cache.
"""

import math
from typing import NamedTuple

import warp as wp

WARP = 32
TILE = 8  # worlds of a tile: an entry of theirs fills a sector of 32 bytes
BATCH = 8  # reads of a thread that are on their way together
LOOKUPS = 4  # likewise, of the table
SEATS = 8  # of a multiprocessor, at most 31; a block that finds none waits for one
STORE = "__stcs"  # what goes out leaves the cache to what comes back
TAKE = f"""\
__shared__ int seat;
if (threadIdx.x == 0) {{
    unsigned int processor;
    asm volatile("mov.u32 %0, %%smid;" : "=r"(processor));
    processor %= seats.shape[0];
    int free;
    do {{
        free = __ffs(~*(volatile int*)(seats.data + processor) & {(1 << SEATS) - 1});
    }} while (free == 0 || atomicOr(seats.data + processor, 1 << (free - 1)) >> (free - 1) & 1);
    seat = processor * {SEATS} + free - 1;
}}
__syncthreads();"""
LEAVE = f"""\
__syncthreads();
if (threadIdx.x == 0) atomicAnd(seats.data + seat / {SEATS}, ~(1 << seat % {SEATS}));"""
VECTORS: dict[type, tuple[str, str]] = {wp.float32: ("float4", "int4"), wp.float64: ("double2", "int2")}  # and places


class Spread(NamedTuple):
    """How values in shared memory lie and leave.

    Attributes:
        entries: of a row. slots: different values of a world, besides zero.
        worlds: that are in shared memory at a time.
    """

    entries: int
    slots: int
    worlds: int = WARP

    @property
    def pitch(self) -> int:
        """Distance of worlds in shared memory, behind whose values lies a zero.

        Odd where each lane writes a world; where they come as tiles, such that these meet in no bank.
        """
        return (self.slots + 1) | 1 if self.worlds == WARP else (self.slots + 4) // 8 * 8 + 4

    @property
    def scalars(self) -> int:
        """Of shared memory."""
        return self.worlds * self.pitch

    def period(self, T) -> int:
        """Worlds after which entries lie as they did."""
        return _wide(T) // math.gcd(self.entries, _wide(T))

    def table(self, slots: list[int], T) -> list[int]:
        """Where in shared memory the entries of a period of worlds are; ``slots`` by entry, -1 being zero."""
        row = [self.slots if slot < 0 else slot for slot in slots]
        return [world * self.pitch + slot for world in range(self.period(T)) for slot in row]

    def rows(self, out: str, stage: str, team: int, T) -> str:
        """Write the rows of the worlds from ``first + done`` on that are in shared memory, ``present`` in all."""
        c, (vector, places), parts = _c(T), VECTORS[T], "xyzw"[: _wide(T)]
        groups, turns = self.period(T) * self.entries // _wide(T), self.worlds // self.period(T)
        step, row = self.period(T) * self.pitch, groups * _wide(T)
        shares = [n for n in range(1, turns + 1) if turns % n == 0]  # of a group's turns, to a thread each
        share = min(shares, key=lambda n: -(-groups * n // team) * (turns / n + 1))
        units, turns = groups * share, turns // share
        lookups = min(LOOKUPS, -(-units // team))
        group = "unit" if share == 1 else f"unit % {groups}"
        begin = "0" if share == 1 else f"unit / {groups} * {turns}"
        whole = ", ".join(f"from[k * {step} + at[u].{x}]" for x in parts)
        limit = f"left < {units * _wide(T)} ? (left + {_wide(T) - 1}) / {_wide(T)} : {units}" if share == 1 else units
        some = "\n".join(
            f"            if (place_of + k * {row} + {i} < left) to[k * {row} + {i}] = from[k * {step} + at[u].{x}];"
            for i, x in enumerate(parts)
        )
        return f"""{{
const int left = (present - done < {self.worlds} ? present - done : {self.worlds}) * {self.entries};
{c}* rows = {out}.data + (first + done) * {self.entries};
const bool whole = left == {self.worlds * self.entries} && (size_t)rows % 16 == 0;
const int limit = {limit};
for (int start = member; start < limit; start += {lookups * team}) {{
    {places} at[{lookups}];
    #pragma unroll
    for (int u = 0; u < {lookups}; ++u) {{
        const int unit = start + {team} * u;
        if (unit < limit) at[u] = __ldg((const {places}*)place.data + {group});
    }}
    #pragma unroll
    for (int u = 0; u < {lookups}; ++u) {{
        const int unit = start + {team} * u;
        if (unit >= limit) break;
        const int turn = {begin}, place_of = turn * {row} + ({group}) * {_wide(T)};
        const {c}* from = {stage} + turn * {step};
        {c}* to = rows + place_of;
        if (whole) {{
            #pragma unroll 8
            for (int k = 0; k < {turns}; ++k) {STORE}(({vector}*)(to + k * {row}), make_{vector}({whole}));
        }} else for (int k = 0; k < {turns} && place_of + k * {row} < left; ++k) {{
{some}
        }}
    }}
}}
}}"""

    def tiles(self, relay: str, stage: str, team: int, sync: str, T) -> str:
        """Fetch a tile of values, [slot, 32 worlds] from ``relay`` on, write its rows, and so on."""
        vector, wide, parts = VECTORS[T][0], _wide(T), "xyzw"[: _wide(T)]
        of_slot, count = TILE // wide, self.slots * TILE // wide
        source = f"{relay} + done + part / {of_slot} * {WARP} + part % {of_slot} * {wide}"
        batch = min(BATCH, -(-count // team))
        store = " ".join(f"to[{j * self.pitch}] = v[u].{x};" for j, x in enumerate(parts))
        return f"""for (int done = 0; done < present; done += {TILE}) {{
{sync}
if (member < {TILE}) {stage}[member * {self.pitch} + {self.slots}] = 0;
for (int start = member; start < {count}; start += {batch * team}) {{
    {vector} v[{batch}];
    #pragma unroll
    for (int u = 0; u < {batch}; ++u) {{
        const int part = start + {team} * u;
        if (part < {count}) v[u] = *(const {vector}*)({source});
    }}
    #pragma unroll
    for (int u = 0; u < {batch}; ++u) {{
        const int part = start + {team} * u;
        if (part >= {count}) break;
        {_c(T)}* to = {stage} + part % {of_slot} * {wide * self.pitch} + part / {of_slot};
        {store}
    }}
}}
{sync}
{self.rows("out", stage, team, T)}
}}
{LEAVE}"""


def _c(T) -> str:
    return "float" if T is wp.float32 else "double"


def _wide(T) -> int:
    """Scalars in 16 bytes."""
    return 16 // wp.types.type_size_in_bytes(T)
