"""Long results: a block writes the rows of a matrix from its distinct values, 16 bytes at a time.

A matrix has far fewer distinct values than entries. Each distinct value of a world has a slot in shared memory,
[world, slot], and a table gives the slot of every entry of a row. The rows of 32 worlds are contiguous in memory and
begin at a multiple of 16 bytes; after a ``period`` of worlds, the alignment of the entries repeats. A thread therefore
looks up the slots of a group of neighbouring entries once, and writes the group with one store in every period.

Where shared memory has no room for the values of 32 worlds, the values of every RELAY_WORLDS worlds, a tile, wait in
the rows of these worlds in the result, which have room for them. The block fetches one tile after the other, from the
L2 cache, and writes the rows of the tile over it.
"""

import math
from typing import NamedTuple

import warp as wp

from .elementary import C_TYPE

WARP_SIZE = 32  # threads in a warp
RELAY_WORLDS = 16  # worlds in a tile of a RELAYED result; a multiple of 8, so that a slot fills sectors of 32 bytes
READS_IN_FLIGHT = 8  # values that a thread reads at the same time
LOOKUPS_IN_FLIGHT = 4  # entries of the table that a thread reads at the same time
STREAMING_STORE = "__stcs"  # a store that leaves the cache to the values that are still read
VECTORS = {
    "float": ("float4", "int4", "xyzw"),
    "double": ("double2", "int2", "xy"),
}  # vectors of 16 bytes: the type, the type of its slots, its components


class SlotLayout(NamedTuple):
    """How the distinct values of worlds lie in shared memory, and the C++ that writes rows from them.

    Attributes:
        entries: the number of entries in a row.
        slots: the number of distinct values of a world, zero not counted.
        worlds: the number of worlds whose values are in shared memory at the same time.
    """

    entries: int
    slots: int
    worlds: int = WARP_SIZE

    @property
    def pitch(self) -> int:
        """The distance of worlds in shared memory; a zero follows the values of each world.

        It is odd where each lane writes one world; for tiles, it is such that no two lanes use the same memory bank.
        """
        return (
            (self.slots + 1) | 1 if self.worlds == WARP_SIZE else (self.slots + 8) // 8 * 8 + WARP_SIZE // self.worlds
        )

    @property
    def scalars(self) -> int:
        """The number of scalars of shared memory."""
        return self.worlds * self.pitch

    def period(self, T: type) -> int:
        """Return the number of worlds after which the alignment of the entries repeats."""
        return _scalars_in_16_bytes(T) // math.gcd(self.entries, _scalars_in_16_bytes(T))

    def table(self, slots: list[int], T: type) -> list[int]:
        """Return the place in shared memory of every entry of a period of worlds.

        ``slots`` gives the slot of each entry; -1 stands for the value zero.
        """
        row = [self.slots if slot < 0 else slot for slot in slots]
        return [world * self.pitch + slot for world in range(self.period(T)) for slot in row]

    def write_rows(self, stage: str, team: int, T: type) -> str:
        """Return code in which ``team`` threads write the rows of the worlds from ``first + done`` on.

        Their values are at ``stage``. ``present`` worlds exist from ``first`` on.
        """
        c = C_TYPE[T]
        vector, places, parts = VECTORS[c]
        groups, turns = self.period(T) * self.entries // _scalars_in_16_bytes(T), self.worlds // self.period(T)
        step, row = self.period(T) * self.pitch, groups * _scalars_in_16_bytes(T)
        shares = [n for n in range(1, turns + 1) if turns % n == 0]  # ways to divide the periods among threads
        share = min(shares, key=lambda n: -(-groups * n // team) * (turns / n + 1))
        units, turns = groups * share, turns // share
        lookups = min(LOOKUPS_IN_FLIGHT, -(-units // team))
        group = "unit" if share == 1 else f"unit % {groups}"
        begin = "0" if share == 1 else f"unit / {groups} * {turns}"
        whole = ", ".join(f"from[k * {step} + at[u].{x}]" for x in parts)
        wide = _scalars_in_16_bytes(T)
        limit = f"left < {units * wide} ? (left + {wide - 1}) / {wide} : {units}" if share == 1 else units
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
        const int turn = {begin}, place_of = turn * {row} + ({group}) * {_scalars_in_16_bytes(T)};
        const {c}* from = {stage} + turn * {step};
        {c}* to = rows + place_of;
        if (whole) {{
            #pragma unroll 8
            for (int k = 0; k < {turns}; ++k) {STREAMING_STORE}(({vector}*)(to + k * {row}), make_{vector}({whole}));
        }} else for (int k = 0; k < {turns} && place_of + k * {row} < left; ++k) {{
{some}
        }}
    }}
}}
}}"""

    def write_tiles(self, stage: str, team: int, sync: str, T: type) -> str:
        """Return code that, tile after tile, fetches the values of a tile from its rows and writes these rows."""
        c, wide = C_TYPE[T], _scalars_in_16_bytes(T)
        vector, _, parts = VECTORS[c]
        of_slot, count = self.worlds // wide, self.slots * self.worlds // wide
        batch = min(READS_IN_FLIGHT, -(-count // team))
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
{self.write_rows(stage, team, T)}
}}"""

    def define_relay(self, T: type) -> str:
        """Return the definition of RELAY(slot), the place in the rows of a tile where a world's value waits.

        The values of a tile are [slot, world of the tile].
        """
        c, tile = C_TYPE[T], self.worlds
        return f"""const int own = mine ? lane : present - 1;  // of the world that an idle lane works out too
const int tile = own / {tile} * {tile};
const int width = present - tile < {tile} ? present - tile : {tile};
{c}* relayed = out.data + (first + tile) * {self.entries} + own % {tile};
#define RELAY(i) relayed[(i) * width]"""


def _scalars_in_16_bytes(T: type) -> int:
    return 16 // wp.types.type_size_in_bytes(T)
