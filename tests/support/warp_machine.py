"""A machine that runs the CUDA text of a kernel's teams, so that what only a GPU would show shows without one.

Statements become Python's, over all worlds at once in float64; each warp is a generator that stops at its barriers. The
memory that warps share remembers who touched what between which barriers: reading what nobody has written, or what
another warp writes between the same two barriers, is an error, as it is a matter of luck on a GPU.
"""

import functools
import re
from typing import NamedTuple

import numpy as np

import warp_spo as spo
from warp_spo.execution.builder import Builder
from warp_spo.execution.segment.warp_specialized import BARRIER
from warp_spo.kernels.straight_line import BY_TABLE, IN_PLACE, TILED, KernelLayout
from warp_spo.kernels.substeps import FENCE, SYNC
from warp_spo.trace import evaluation

NOBODY = (-1, -1)


class Race(AssertionError):
    pass


class Text(NamedTuple):
    """One kernel: its operation, its layout, its texts and its tables."""

    operation: str
    frame: KernelLayout
    cuda: str
    cpu: str
    tables: dict
    operations: int


def recorded(monkeypatch):
    """A list that from here on receives the :class:`Text` of every kernel that is built."""
    texts, finished = [], Builder.finish

    def record(self, operation, frame, cuda, cpu, tables, operations, *more):
        held = {name: np.array(values) for name, values in tables.items()}
        texts.append(Text(operation, frame, cuda, cpu, held, operations))
        return finished(self, operation, frame, cuda, cpu, tables, operations, *more)

    monkeypatch.setattr(Builder, "finish", record)
    return texts


class Shared:
    """Entries that warps share, [entry] of [world]; given ones are there before the first barrier."""

    def __init__(self, name, given=()):
        self.name, self.values = name, dict(enumerate(given))
        self.writer, self.readers = {}, {}  # entry -> (stretch between barriers, warp); stretch, {warps}
        self.now = (0, 0)

    def __getitem__(self, entry):
        if entry not in self.values:
            raise Race(f"{self.name}[{entry}] is read before it is written")
        stretch, warp = self.writer.get(entry, NOBODY)
        if stretch == self.now[0] and warp != self.now[1]:
            raise Race(f"{self.name}[{entry}]: warp {self.now[1]} reads what warp {warp} writes, no barrier between")
        self.readers.setdefault((self.now[0], entry), set()).add(self.now[1])
        return self.values[entry]

    def __setitem__(self, entry, value):
        stretch, warp = self.writer.get(entry, NOBODY)
        if stretch == self.now[0] and np.array_equal(self.values[entry], value):
            return  # a constant that several warps write
        others = self.readers.get((self.now[0], entry), set()) - {self.now[1]}
        if others or (stretch == self.now[0] and warp != self.now[1]):
            raise Race(f"{self.name}[{entry}]: warps {others or warp} and {self.now[1]} meet, no barrier between")
        self.values[entry], self.writer[entry] = value, self.now


def run(text, arrays, backwards=False, further=None, over=None):
    """The result of a kernel, [world, entry].

    Args:
        text: of the kernel.
        arrays: by name: the callers' [world, ...], the tables of what the links are made of [entry, world].
        backwards: between barriers the last warp goes first.
        further: receives the other results, by name.
        over: results that are written over an array that is read, by name.
    """
    frame, over = text.frame, over or {}
    worlds = len(next(array for name, array in arrays.items() if name not in (*frame.fields, *frame.numbers)))
    rows = {f"{row.name}_row": Shared(row.name, arrays[row.name].reshape(worlds, -1).T) for row in frame.rows}
    rows |= {f"{x.name}_row": rows[f"{over[x.name]}_row"] if x.name in over else Shared(x.name) for x in frame.further}
    result = rows[f"{frame.result.row}_row"] if frame.result.way == IN_PLACE else Shared("result")
    result, sent = rows[f"{over['out']}_row"] if "out" in over else result, Shared("sent")
    fields = {name: arrays[name] for name in frame.fields}
    space = FUNCTIONS | rows | fields | {"result_row": result, "sent": sent}
    space |= {f"{name}_row": [arrays[name]] for name in frame.numbers}
    space |= {name: text.tables.get(name) for name in ("table", "shifts", "ground", "geometry")}
    space |= {"worlds": np.arange(worlds)}
    exec(translated(text.cuda), space)
    stretch, going, ayes = 0, {warp: space["work"](warp) for warp in range(frame.warps)}, None
    while going:
        stopped, votes = set(), []
        for warp in sorted(going, reverse=backwards):
            for memory in (*rows.values(), result, sent):
                memory.now = (stretch, warp)
            try:
                votes.append(going[warp].send(ayes))
            except StopIteration:
                stopped.add(warp)
        if None in votes and votes.count(None) < len(votes):
            raise Race(f"after {stretch} barriers some warps vote and others do not")
        ayes = None if None in votes else any(votes)
        if stopped and stopped != set(going):
            raise Race(f"warps {sorted(stopped)} of {sorted(going)} end after {stretch} barriers, the others do not")
        going = {} if stopped else going
        stretch += 1
    for row in frame.further:
        further[row.name] = np.full((worlds, row.entries), np.nan)
        for entry, value in rows[f"{row.name}_row"].values.items():
            further[row.name][:, entry] = value
    whole = np.zeros((frame.result.array.entries, worlds))
    places = text.tables["place"] if frame.result.way in (*BY_TABLE, TILED) else range(len(whole))
    for entry, slot in enumerate(places):
        whole[entry] = 0.0 if slot < 0 else result.values.get(slot, np.nan)
    return whole.T


class Looked:
    """Entries of a table from a place of each world on."""

    def __init__(self, table, first):
        self.table, self.first = np.ravel(table), first

    def __getitem__(self, i):
        return self.table[self.first + i]


def _sincos(x):
    return np.sin(x), np.cos(x)


def _worst(substep, status, word):
    """The most severe word; a state that an earlier substep lost is no input that is not finite."""
    rank = np.array([spo.Status(one).severity for one in range(len(spo.Status))])
    before, word = (np.asarray(status[0] if substep else word, int), np.asarray(word, int))
    return np.where((rank[word] > rank[before]) & ((word != 2) | (before == 0)), word, before)


def _searched(shape, cells, asked, worlds):
    """Numbers that a search finds, each [world]: in a field's grid, or of the corners of a hull without ``cells``."""
    numbers = np.stack([x + 0.0 * worlds for x in asked], axis=-1)
    return list(evaluation._search(shape, None if cells is None else np.ravel(cells), numbers).T)


FUNCTIONS = {
    "worst": _worst, "searched": _searched,
    "where": np.where, "nan": np.nan, "infinity": np.inf, "reciprocal": lambda x: 1.0 / x, "sqrt": np.sqrt,
    "absolute": np.abs, "reduced": lambda x: x, "within_reach": lambda x: x,
    "FUSED_float": lambda a, b, c: a * b + c, "FUSED_double": lambda a, b, c: a * b + c,
    "log": np.log, "sincos": _sincos, "sincos_any": _sincos, "mine": True, "again": False,
    "arctangent": np.arctan2, "sin": np.sin, "cos": np.cos, "inverse_root": lambda x: 1.0 / np.sqrt(x),
    "floor": np.floor, "int64": np.int64, "Looked": Looked,
}  # fmt: skip


FORMS = [
    (r"^const int going = __syncthreads_or\((.*)\);$", r"going = yield bool((\1).any())"),
    (r"^(?:const )?bool (\w+) = true;$", r"\1 = worlds == worlds"),
    (r"^if \(open\) (\w+_row\[[^\]]*(?:\[\d+\])?\]) = (.*);$", r"\1 = where(open, \2, \1)"),
    (r"^if \(!going\) break;$", "if not going: break"),
    (r"^const int going = (.*);$", r"going = (\1).any()"),
    (r"^(?:const )?(?:float|double) (\w+)\[(\d+)\] = \{\};$", r"\1 = [0.0 * worlds] * \2"),
    (r"^const (?:float|double) pass_row\[1\] = \{(.*)\};$", r"pass_row = [\1 + 0.0 * worlds]"),
    (r"^(?:static )?const (?:float|double) (\w+_(?:asked|of))\[\d+\] = \{(.*)\};$", r"\1 = [\2]"),
    (r"^(?:float|double) (\w+_row)\[(\d+)\];$", r"\1 = [0.0 * worlds] * \2"),
    (r"^grid_search::(\w+)\((\w+)\.data, (\w+), (\w+)\);$", r"\4 = searched('\1', \2, \3, worlds)"),
    (r"^grid_search::(\w+)\((\w+)\.data, (\w+), (\w+), \d+, (\w+)\);$", r"\5 = searched('\1', \2, \3 + \4, worlds)"),
    (r"^hull_corners::(\w+)\((\w+), (\w+), \d+, (\w+)\);$", r"\4 = searched('\1', None, \2 + \3, worlds)"),
    (r"^const int (now) = (.*);$", r"\1 = \2"),
    (r"^const \w+\* (\w+) = table\.data \+ (.*);$", r"\1 = \2"),
    (
        r"^const \w+\* (\w+) = \(const \w+\*\)__builtin_assume_aligned\((\w+)\.data \+ (\d+)ll \* \(int\)(\w+), 16\);$",
        r"\1 = Looked(\2, \3 * int64(\4))",
    ),
    (r"^int (\w+)\[\d+\];$", r"\1 = {}"),
    (r"^on::(sincos\w*)\((\w+), (\w+), (\w+)\);$", r"\3, \4 = \1(\2)"),
    (r"^if \(mine\) \{ const int word = (\w+); .* \}$", r"status_row[0] = worst(substep, status_row, \1)"),
    (r"^if \(mine\) (.*);$", r"\1"),
    (r"^(?:const )?(?:float|double) (\w+) = (.*) (>|!=|<) (.*) \? (.*) : (.*);$", r"\1 = where(\2 \3 \4, \5, \6)"),
    (r"^(?:const )?(?:float|double) (\w+ = .*);$", r"\1"),
    (r"^(?:float|double) [\w, ]+;$", "pass"),
    (r"^(.*);$", r"\1"),
]


def translated(cuda):
    """``def work(warp)``: the statements for CUDA in Python."""
    lines, depth, mask = ["def work(warp):"], 1, ""  # of a branch of some worlds
    for line in map(str.strip, cuda.split("\n")):
        if not line or line.startswith(("//", "#", 'asm("" :')) or line == FENCE:
            continue
        if line == "}":
            depth, mask = depth - 1, ""
            continue
        if line in (BARRIER, SYNC):
            lines.append("    " * depth + "yield")
            continue
        loop = re.match(r"^for \(int (\w+) = 0; \w+ < (.*); \+\+\w+\) \{$", line)
        if loop:
            count = re.sub(r"^\(int\)(.*)$", r"int(\1)", _chosen(loop[2]))
            lines.append("    " * depth + f"for {loop[1]} in range({count}):")
            depth += 1
            continue
        some = re.match(r"^if \((\w+) != 0\) \{$", line)
        if some:
            mask = some[1]
            lines.append("    " * depth + "if True:")
            depth += 1
            continue
        if mask:
            line = re.sub(r"^(\w+(?:\[\d+\])?) = (.*);$", rf"\1 = where({mask} != 0, \2, \1);", line)
        branch = re.match(r"^(else )?(?:if \((.*)\) )?\{$", line)
        if branch:
            condition = "False" if "reach" in (branch[2] or "") else (branch[2] or "").replace("||", "or")
            word = f"{'el' if branch[1] else ''}if {condition}" if branch[2] else "else" if branch[1] else "if True"
            lines += ["    " * depth + f"{word}:", "    " * (depth + 1) + "pass"]
            depth += 1
            continue
        lines.append("    " * depth + _statement(line))
    assert depth == 1, "a brace is missing"
    return "\n".join([*lines, "    if False:", "        yield"])


@functools.lru_cache(1 << 17)  # of kernels that are nearly alike
def _statement(line):
    if "farthest" in line:
        return "pass"  # turns are not taken off here
    who = re.match(r"^const int (\w*(?:who|first)) = (.*);$", line)
    if who:
        return f"{who[1]} = {_chosen(who[2])}"
    for form, python in FORMS:
        if re.match(form, line):
            line = re.sub(form, python, line)
            break
    line = re.sub(r"\bsubstep \? (.*) : 0\)", r"\1 if substep else 0)", line)
    line = re.sub(r"\((?:float|double)\)", "", line).replace("on::", "")
    line = re.sub(r"(?<![\w.])(\d+\.?\d*(?:e[-+]?\d+)?)f\b", r"\1", line)
    line = re.sub(r"ground\.data\[\(int\)(\w+) \+ (\d+)\]", r"ground[int64(\1) + \2]", line).replace("::", "")
    line = re.sub(r"GEOMETRY\(([^()]*)\)", r"geometry[\1]", line)
    line = re.sub(r"FIELD\((\w+), ([^()]*)\)", r"\1[\2]", line)
    line = re.sub(r"__ldg\(shifts\.data \+ (.*?)\)", r"int(shifts[\1])", line)
    line = re.sub(r"__ldg\((\w+ \+ \d+)\)", r"table[\1]", line)
    return _sent(line)


def _chosen(number):
    return re.sub(r"warp == (\d+) \? (\d+) : ", r"\2 if warp == \1 else ", number)


def _sent(line):
    line = re.sub(r"result_row\[\(([^()]*)\) \* \d+\]", r"result_row[\1]", line)
    line = re.sub(r"RELAY\(([^()]*)\)", r"result_row[\1]", line)
    return re.sub(r"SENT\(([^()]*)\)", r"sent[\1]", line)
