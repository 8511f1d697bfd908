"""Spill registers to shared memory: straight-line code that keeps a value there while nothing uses it.

A compiler keeps every value that is used later in a register, and takes local memory where registers do not suffice.
Fewer registers let more warps run at once, and shared memory has room for the values that their threads spill.
"""

from __future__ import annotations

import heapq
import re
from collections.abc import Iterator
from typing import NamedTuple

LEAST = 250  # statements between two uses, below which a value stays in its register; 100 stores more and gains nothing
AHEAD = 8  # statements before the use at which a value is read back; the read then waits for nothing
WORD = re.compile(r"\b[A-Za-z_]\w*\b")
PAIR = re.compile(r"(?:on::sincos\w*\((.*), |float |double )(\w+), (\w+)(?:\)|);")  # as :mod:`.emission` defines two


class LiveGap(NamedTuple):
    """The statements ``begin`` and ``end`` that use a value, or define it, and none between them does."""

    begin: int
    end: int
    name: str


def spill_registers(text: str, dtype: str, places: int) -> str:
    """Return statements that keep values in ``ASIDE(place)`` while nothing uses them, longest gaps first.

    Args:
        text: the statements of one thread, with the names in full.
        dtype: C++ name of their type.
        places: the number of values of a thread that are aside at the same time.
    """
    lines = text.split("\n")
    scopes = _find_scopes(lines)
    gaps = sorted(_find_gaps(lines, scopes, dtype), key=lambda gap: gap.begin - gap.end)
    stores: dict[int, list[tuple[str, int]]] = {}  # by the statement after which they follow
    reads: dict[int, list[tuple[LiveGap, int]]] = {}  # by the statement before which they come
    for gap, place in _assign_places(_choose(gaps, places, len(lines)), places):
        stores.setdefault(gap.begin, []).append((gap.name, place))
        at = gap.end
        while at > max(gap.begin + 1, gap.end - AHEAD) and scopes[at - 1] == scopes[gap.end]:
            at -= 1
        reads.setdefault(at, []).append((gap, place))
    found: list[str] = []
    coming: dict[int, list[tuple[str, str]]] = {}  # by the statement that is the first to use them
    now: dict[str, str] = {}  # the names under which values have been read back
    for at, line in enumerate(lines):
        for gap, place in reads.get(at, ()):
            name = f"{gap.name}_from_{gap.begin}"
            found.append(f"const {dtype} {name} = ASIDE({place});")
            coming.setdefault(gap.end, []).append((gap.name, name))
        now.update(coming.get(at, ()))
        if now and _definitions(line, dtype)[1]:
            now = {name: other for name, other in now.items() if name not in _definitions(line, dtype)[1]}
        found.append(_rename(line, now) if now else line)
        found += [f"ASIDE({place}) = {now.get(name, name)};" for name, place in stores.get(at, ())]
    return "\n".join(found)


def _rename(line: str, names: dict[str, str]) -> str:
    return WORD.sub(lambda match: names.get(match[0], match[0]), line)


def _definitions(line: str, dtype: str) -> tuple[str, tuple[str, ...]]:
    """Return the part of a statement that uses values, and the names of those that it defines."""
    pair = PAIR.match(line)
    if pair:
        return pair[1] or "", (pair[2], pair[3])
    start = f"const {dtype} "
    if line.startswith(start) and " = " in line:
        name, _, used = line[len(start) :].partition(" = ")
        return used, (name,)
    return line, ()


def _find_scopes(lines: list[str]) -> list[int]:
    """Return for each line the number of the innermost braces around it."""
    inside, count, found = [0], 0, []
    for line in lines:
        found.append(inside[-1])
        for brace in re.findall(r"[{}]", line):
            count += 1
            if brace == "{":
                inside.append(count)
            else:
                inside.pop()
    return found


def _find_gaps(lines: list[str], scopes: list[int], dtype: str) -> Iterator[LiveGap]:
    """Yield the gaps that are long enough, with both ends inside the same braces as the definition, of every value."""
    latest: dict[str, int] = {}  # the last statement that defines or uses a value
    home: dict[str, int] = {}
    for at, line in enumerate(lines):
        if line.startswith(("//", "#")):
            continue
        used, defined = _definitions(line, dtype)
        for name in set(WORD.findall(used)) & latest.keys():
            if at - latest[name] > LEAST and home[name] == scopes[at] == scopes[latest[name]]:
                yield LiveGap(latest[name], at, name)
            latest[name] = at
        latest.update(dict.fromkeys(defined, at))
        home.update(dict.fromkeys(defined, scopes[at]))


def _choose(gaps: list[LiveGap], places: int, statements: int) -> list[LiveGap]:
    """Return the gaps of which at most ``places`` meet at any statement, the first of ``gaps`` before later ones."""
    taken, chosen = [0] * statements, []
    for gap in gaps:
        if max(taken[gap.begin : gap.end + 1]) < places:
            chosen.append(gap)
            for at in range(gap.begin, gap.end + 1):
                taken[at] += 1
    return sorted(chosen)


def _assign_places(gaps: list[LiveGap], places: int) -> Iterator[tuple[LiveGap, int]]:
    """Yield each gap, in order, with a place that no other gap has at the same time."""
    free, busy = list(range(places)), []  # type: list[int], list[tuple[int, int]]
    for gap in gaps:
        while busy and busy[0][0] < gap.begin:
            heapq.heappush(free, heapq.heappop(busy)[1])
        place = heapq.heappop(free)
        heapq.heappush(busy, (gap.end, place))
        yield gap, place
