"""Long results: the values that a block worked out become rows, 16 bytes at a time.

A matrix has far fewer different values than entries. They wait in shared memory, [world, slot]; a table says where the
entries of a row are. Rows of 32 worlds are one stretch of memory that begins at a multiple of 16 bytes, and after a
``period`` of worlds each entry again lies as far from such a multiple. So a thread looks up a group of neighbouring
entries once and writes it for each period, in one store.

Where the values of 32 worlds do not fit, those of each TILE worlds wait in these worlds' rows, which have room for
them. A block fetches a tile after the other and writes its rows over it: what waits is in the L2 cache.
"""

import math
from typing import NamedTuple

import warp as wp

from .elementary import C_TYPE

WARP = 32
TILE = 16  # worlds of a tile that is fetched; a multiple of 8, whose entries fill a sector of 32 bytes
BATCH = 8  # reads of a thread that are on their way together
LOOKUPS = 4  # likewise, of the table
STORE = "__stcs"  # what goes out leaves the cache to what comes back
VECTORS = {"float": ("float4", "int4", "xyzw"), "double": ("double2", "int2", "xy")}  # 16 bytes, their places, parts


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
        return (self.slots + 1) | 1 if self.worlds == WARP else (self.slots + 8) // 8 * 8 + WARP // self.worlds

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

    def rows(self, stage: str, team: int, T) -> str:
        """Write the rows of the worlds from ``first + done`` on, whose values are at ``stage``; ``present`` in all."""
        c = C_TYPE[T]
        vector, places, parts = VECTORS[c]
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
{c}* rows = out.data + (first + done) * {self.entries};
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

    def tiles(self, stage: str, team: int, sync: str, T) -> str:
        """Fetch the values of a tile's worlds from their rows, write these rows, and so on."""
        c, wide = C_TYPE[T], _wide(T)
        vector, _, parts = VECTORS[c]
        of_slot, count = self.worlds // wide, self.slots * self.worlds // wide
        batch = min(BATCH, -(-count // team))
        store = " ".join(f"to[{j * self.pitch}] = v[u].{x};" for j, x in enumerate(parts))
        return f"""for (int done = 0; done < present; done += {self.worlds}) {{
const int width = present - done < {self.worlds} ? present - done : {self.worlds};
const {c}* from = out.data + (first + done) * {self.entries};
{sync}
if (member < {self.worlds}) {stage}[member * {self.pitch} + {self.slots}] = 0;
if (width == {self.worlds} && (size_t)from % 16 == 0) {{
    for (int start = member; start < {count}; start += {batch * team}) {{
        {vector} v[{batch}];
        #pragma unroll
        for (int u = 0; u < {batch}; ++u) {{
            const int part = start + {team} * u;
            if (part < {count}) v[u] = ((const {vector}*)from)[part];
        }}
        #pragma unroll
        for (int u = 0; u < {batch}; ++u) {{
            const int part = start + {team} * u;
            if (part >= {count}) break;
            {c}* to = {stage} + part % {of_slot} * {wide * self.pitch} + part / {of_slot};
            {store}
        }}
    }}
}} else for (int i = member; i < {self.slots} * width; i += {team}) {{
    {stage}[i % width * {self.pitch} + i / width] = from[i];
}}
{sync}
{self.rows(stage, team, T)}
}}"""

    def relay(self, T) -> str:
        """RELAY(slot): where in its tile's rows a world's value waits, [slot, world of the tile]."""
        c, tile = C_TYPE[T], self.worlds
        return f"""const int own = mine ? lane : present - 1;  // of the world that an idle lane works out too
const int tile = own / {tile} * {tile};
const int width = present - tile < {tile} ? present - tile : {tile};
{c}* relayed = out.data + (first + tile) * {self.entries} + own % {tile};
#define RELAY(i) relayed[(i) * width]"""


def _wide(T) -> int:
    """Scalars in 16 bytes."""
    return 16 // wp.types.type_size_in_bytes(T)
