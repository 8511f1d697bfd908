"""Fused kernels: the work of an environment on one world as one traced kernel, or on each of many rows of numbers."""

from __future__ import annotations

from typing import Any, NamedTuple

import warp as wp

from ...kernels import field_grid, hull_corners, native, philox, row_chunks
from ...kernels.elementary import C_TYPE
from ...kernels.elementary import NATIVE as ELEMENTARY
from ...runtime import launches
from ...trace.emission import Emitter, Listing, RangeReduction, Store, render, replaces
from ...trace.scalars import BRANCHES, Graph, Scalar, ordered

ROW, COLUMN, INT, LONG, MASK, SHARED = "row", "column", "int", "long", "chosen", "shared"
COUNT, FOUND = "count", "found"
DRAW = "draw"  # random numbers of the thread's own
ROW_NUMBER = "row_number"  # of the thread, where a world has many
ROWS_AT_ONCE = 4  # of a thread, which share what is the same for all
BLOCK, BLOCK_OF_ROWS = 64, 128  # threads
MOST_ENTRIES = 2**31 - 1  # of an axis of a Warp array
WIDE = 8  # entries of a row that the threads of a warp write together


class Buffer(NamedTuple):
    """An array of the environment as kernels see it.

    Attributes:
        tensor: torch tensor; its memory is the array's.
        kind: ROW: float32 [world, entry]. COLUMN: float32 [entry, world],
            which neighbouring threads read side by side.
            SHARED: float32 [entry], the same for all worlds. INT: int32 [world]. LONG: int64 [world]. MASK: bool
            [world]. COUNT: float32 [entry, world]; the value that a kernel stores is the number of the entry to which
            one is added, counted from 1, and 0 for none. FOUND: float32 [entry, world]; a value below zero leaves the
            entry as it is. It is stored last.
        bypasses_caches: it is large, and no kernel reads it: it shall not displace from the caches what others read.
    """

    tensor: Any
    kind: str = ROW
    bypasses_caches: bool = False

    @property
    def set(self) -> str:
        """C++ macro that stores an entry, see ``kernels.row_chunks``."""
        return "SET_PASSING" if self.bypasses_caches else "SET"

    def place(self, name: str, entry: str) -> str:
        """Return C++ for an entry in the thread's world."""
        entries = self.tensor.shape[-1] if self.kind == ROW else 0
        return {
            ROW: f"{name}.data[world * {entries} + {entry}]",
            COLUMN: f"{name}.data[(long long)({entry}) * worlds + world]",
            FOUND: f"{name}.data[({entry}) * (long long)worlds + world]",
            COUNT: f"{name}.data[((long long)({entry}) - 1) * worlds + world]",
            SHARED: f"{name}.data[{entry}]",
            INT: f"((int*){name}.data)[world]",
            LONG: f"((long long*){name}.data)[world]",
            MASK: f"{name}.data[world]",
        }[self.kind]

    def load(self, name: str, entry: str) -> str:
        """Return C++ that reads an entry as float."""
        place = self.place(name, entry)
        return place if self.kind in (ROW, COLUMN, SHARED, FOUND) else f"(float)({place})"

    def store(self, name: str, entry: str, value: str) -> str:
        """Return C++ that writes an entry of the thread's world; the kinds COUNT and FOUND have rules of their own.

        COUNT adds one to entry ``value`` - 1, whatever ``entry`` is, and does nothing for 0. FOUND does nothing for
        a value below zero.
        """
        if self.bypasses_caches:
            return f"{self.set}({self.place(name, entry)}, {value});"
        if self.kind == COUNT:
            return f"if ({value} != 0) {self.place(name, value)} += 1;"
        if self.kind == FOUND:
            return f"if ({value} >= 0) {self.place(name, entry)} = {value};"
        cast = {INT: "(int)", LONG: "(long long)", MASK: "0 != "}.get(self.kind, "")
        return f"{self.place(name, entry)} = {cast}({value});"

    def warp(self) -> Any:
        """Return the flat Warp array over the same memory."""
        import torch

        flat = self.tensor.reshape(-1)[:MOST_ENTRIES]  # kernels take its address alone
        if self.kind == MASK:
            return wp.from_torch(flat, dtype=wp.bool)
        return wp.from_torch(flat.view(torch.float32), dtype=wp.float32)


class FusedKernel:
    """One kernel, a thread a world or a row of a world, made of the values that terms store.

    Args:
        name: of the kernel.
        stream: number that tells this stage's random numbers from those of others.
        rows: of a world, of which a thread takes up to ROWS_AT_ONCE, ``threads`` apart; entry k of the input ROW_NUMBER
            is the number of the thread's row k. 0: one thread does all of a world.

    Attributes:
        graph: of the trace.
        stores: what the kernel writes, in order; with rows, what a thread does for its first, for its second and so on.
        of_rows: the stores of each row of a thread; a thread with fewer rows than others skips its last list.
        at_once: rows of a thread. threads: of a world, where it has rows.
        draws: how many random numbers it uses.
        ticks: C++ of how many steps it counts when it ends, after which all random numbers are new ones; "" for none.
        late: C++ of how many of these steps its own random numbers do not know of, because others counted them early.
    """

    def __init__(self, name: str, stream: int, rows: int = 0):
        self.name, self.stream, self.rows = name, stream, rows
        self.threads = -(-rows // ROWS_AT_ONCE)
        self.at_once = -(-rows // self.threads) if rows else 0
        self.graph = Graph()
        self.graph.step = name
        self.stores: list[Store] = []
        self.of_rows: list[list[Store]] = [[] for _ in range(self.at_once)]
        self.draws = 0
        self.ticks, self.late = "", ""

    def draw(self) -> Scalar:
        """Return a new random number, uniform in [0, 1)."""
        self.draws += 1
        return self.graph.input(DRAW, self.draws - 1)

    def store(self, array: str, entry: int, value: Any) -> None:
        """Write a value to an entry of an array of the environment."""
        self.stores.append(Store(array, (entry,), value))

    def store_of_row(self, array: str, entry: int, number: int, value: Any) -> None:
        """Write a value that the thread's row ``number`` gives to an entry of a world's array."""
        self.store(array, entry, value)
        self.of_rows[number].append(self.stores[-1])

    def store_row(self, array: str, first: int, number: int, value: Any) -> None:
        """Write a value of the thread's row ``number`` to an array in which row 0 has the entry ``first``."""
        self.store(array, first + number * self.threads, value)
        self.of_rows[number].append(self.stores[-1])

    def read_arrays(self) -> set[str]:
        """Return the names of the arrays that the stored values depend on."""
        return {scalar.args[0] for scalar in ordered(item.value for item in self.stores) if scalar.op == "input"}

    def overwrites(self, other: FusedKernel) -> bool:
        """Return whether it writes an entry that another stage reads."""
        read = {scalar.args for scalar in ordered(item.value for item in other.stores) if scalar.op == "input"}
        return any((item.array, *item.index) in read for item in self.stores)

    def read_tables(self) -> set[str]:
        """Return the names of the tables that the stored values depend on."""
        read = {scalar.args[0] for scalar in ordered(item.value for item in self.stores)
                if scalar.op in ("lookup", "search")}  # fmt: skip
        return read - {""}

    def _wide(self, buffers: dict[str, Buffer]) -> dict[str, list[tuple[int, int]]]:
        """Return the (first, count) of entries that a warp writes together, by array: stretches that nothing reads."""
        read = self.read_arrays()
        stored: dict[str, set[int]] = {}
        for item in self.stores:
            if buffers[item.array].kind == ROW and item.array not in read and not self.rows:
                stored.setdefault(item.array, set()).add(item.index[0])
        found = {}
        for name, entries in stored.items():
            firsts = sorted(entry for entry in entries if entry - 1 not in entries)
            lasts = sorted(entry for entry in entries if entry + 1 not in entries)
            whole = [(first, last + 1 - first) for first, last in zip(firsts, lasts, strict=True)]
            if all(count >= WIDE for _, count in whole):
                found[name] = whole
        return found

    def build(self, buffers: dict[str, Buffer], device: wp.Device) -> Launch | None:
        """Return the launch of the kernel; None if it writes nothing.

        Args:
            buffers: arrays of the environment by name; ``tick`` counts the steps of each world, ``key`` holds the seed
                in two words and the number of world 0 in the whole run.
            device: where it runs.
        """
        if not self.stores:
            return None
        wide, more = self._wide(buffers), " + row" if self.rows else ""

        def load(array: str, entry: str) -> str:
            own = {DRAW: f"DRAW({entry})", ROW_NUMBER: f"(float)(row + ({entry}) * {self.threads})"}
            return own.get(array) or buffers[array].load(array, entry)

        def store(array: str, entry: str, value: str) -> str:
            if array in wide:
                return f"PUT({array}, {buffers[array].tensor.shape[-1]}, {entry}, {value})"
            own = more if buffers[array].kind == ROW else ""
            return f"{'if (mine) ' if wide else ''}{buffers[array].store(array, entry + own, value)}"

        emitter = Emitter(
            "float32", load, store, lambda array, index: index[0], RangeReduction.FIRST, late=(DRAW,), fuses=True
        )
        listings, parts = self._emit(emitter, wide, buffers)
        touched = {array for listing in listings for array, _ in listing.indices} - {DRAW, ROW_NUMBER}
        touched |= self.read_tables()
        words = [f"((unsigned int*)key.data)[{i}]" for i in range(3)]
        world, step = f"{words[2]} + (unsigned int)world", "((unsigned int*)tick.data)[world]"
        count = f"{step} += {self.ticks};" if self.ticks else ""
        step += f" - ({self.late})" if self.late else ""
        first = f"row * {-(-self.draws // 4)}" if self.rows else "0"
        rare = any(x.op in BRANCHES for x in ordered(item.value for item in self.stores))
        random = philox.draws(self.draws, (words[0], words[1]), self.stream, world, step, first, rare)
        touched |= {"key"} if self.draws else set()
        touched |= {"tick"} if self.draws or self.ticks else set()
        words_read = self.ticks + (self.late if self.draws else "")
        touched |= {name for name in ("advance", "chosen") if name in words_read}
        names = sorted(touched)
        if wide:
            head = [row_chunks.define(BLOCK), "const bool mine = thread < worlds;"]
            head += ["const long long world = mine ? thread : worlds - 1;"]
            tail = [f"if (mine) {{ {count} }}" if count else "", row_chunks.UNDEFINE]
        elif self.rows:
            head = [f"if (thread >= (long long)worlds * {self.threads}) return;"]
            whole = f"thread < 1ll << 32 ? (unsigned int)thread / {self.threads}u : thread / {self.threads}"
            head += [f"const long long world = {whole};", f"const int row = (int)(thread - world * {self.threads});"]
            tail = []
        else:
            head = ["if (thread >= worlds) return;", "const long long world = thread;"]
            tail = [count]
        if wide or any(buffers[name].bypasses_caches for name in names):
            head, tail = [row_chunks.STORES, *head], [*tail, row_chunks.END_STORES]
        tail += [philox.UNDEFINE] if self.draws else []
        found = "".join(parts)
        searches = field_grid.definitions(found, wp.float32) + hull_corners.definitions(found, wp.float32)
        text = "\n".join([ELEMENTARY[C_TYPE[wp.float32]], *searches, *head, random, *parts, *tail, ""])
        kernel = native.kernel(f"env_{self.name}", text, [(name, 1) for name in names], wp.float32)
        frames = "frame_pose" in touched or "frame_velocity" in touched
        arrays, accelerations = [buffers[name].warp() for name in names], "frame_acceleration" in touched
        jacobians = "frame_jacobian" in touched
        return Launch(kernel, arrays, emitter.operations, device, self.threads, frames, accelerations, jacobians)

    def _emit(
        self, emitter: Emitter, wide: dict[str, list[tuple[int, int]]], buffers: dict[str, Buffer]
    ) -> tuple[list[Listing], list[str]]:
        """Return the listings of all statements, and their texts with what belongs between them."""
        read = self.read_arrays()
        at_once = lambda item: item.array not in read or (not wide and replaces(item))  # noqa: E731
        found = [item for item in self.stores if buffers[item.array].kind == FOUND]  # depend on all others
        others = [item for item in self.stores if buffers[item.array].kind != FOUND]
        late = [item for item in others if not at_once(item)]  # after all reads of what they overwrite
        early = [item for item in others if at_once(item) and item.array not in wide]
        if self.rows:
            listings = [emitter.region(items) for items in self.of_rows]
            *parts, closing = (render(listing, "float32") for listing in listings)
            over = f"if (row + {(self.at_once - 1) * self.threads} < {self.rows})"  # the last ones may be too many
            return listings, [*parts, over + " {", closing, "}"]
        listings = [emitter.region(early, [item.value for item in late])]
        parts = [render(listings[0], "float32")]
        for name, stretches in wide.items():
            entries = buffers[name].tensor.shape[-1]
            for first, count in stretches:
                for start in range(first, first + count, row_chunks.CHUNK):
                    part = min(row_chunks.CHUNK, first + count - start)
                    inside = [x for x in self.stores if x.array == name and start <= x.index[0] < start + part]
                    listings.append(emitter.region(inside))
                    parts += [f"BEGIN({start})", render(listings[-1], "float32")]
                    parts.append(f"FLUSH({name}, {entries}, {start}, {part}, {buffers[name].set})")
        listings.append(emitter.region([*late, *found]))
        return listings, [*parts, render(listings[-1], "float32")]


class Launch(NamedTuple):
    """A kernel with its arguments.

    Attributes:
        operations: of one thread. threads: of a world that has rows; 0: one.
        reads_frames, reads_accelerations, reads_jacobians: whether it reads frames, and what is said of them.
    """

    kernel: wp.Kernel
    arrays: list[wp.array]
    operations: int
    device: wp.Device
    threads: int
    reads_frames: bool
    reads_accelerations: bool
    reads_jacobians: bool

    def __call__(self, worlds: int) -> None:
        """Launch the kernel on Warp's current stream."""
        block, threads = (BLOCK_OF_ROWS, worlds * self.threads) if self.threads else (BLOCK, worlds)
        threads = -(-threads // block) * block if self.device.is_cuda else threads
        launches.launch(self.kernel, threads, [worlds, *self.arrays], [], device=self.device, block_dim=block)
