"""Bounds of the elements that an MJCF file expands to, checked before MuJoCo compiles it.

A short file may ask for billions of elements, or attach itself without end; MuJoCo's compiler then runs for hours, or
ends the process. So it does where the name of a class that is not there holds a format of C's printf (MuJoCo 4.0.0).
Such files are refused.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from pathlib import Path

from ..errors import quoted, shown

MOST_ELEMENTS = 1_000_000
MOST_ENTRIES = 100_000_000  # of a height field or a texture; of values that <size> reserves
COPIED = ("replicate", "composite", "flexcomp")  # elements that stand for ``count`` copies of what is in them
ENTRIES = {"hfield": ("nrow", "ncol"), "texture": ("width", "height")}
RESERVED = ("nkey", "nuserdata", "nuser_")  # sizes, and beginnings of their names
PARTS = ("include", "model")  # elements that name another file of this kind


def check_expansion(file: Path) -> str:
    """Return the tag of an MJCF file's root element; check that the file does not expand without bounds.

    Files that it includes or attaches, and that lie where it says, are looked at, too.

    Raises:
        ET.ParseError: the file is not XML.
        ValueError: the file is UTF-16, expands to more than ``MOST_ELEMENTS`` elements or ``MOST_ENTRIES`` entries,
            includes or attaches itself, or names a class with %.
    """
    if file.read_bytes()[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise ValueError(f"load: {str(file)!r} is UTF-16; MuJoCo reads UTF-8; save it as UTF-8")
    root = ET.parse(file).getroot()
    _check(file, root, [file.resolve()], {})
    return root.tag


def _check(file: Path, root: ET.Element, above: list[Path], seen: dict[Path, int]) -> int:
    """Return the number of elements that a file expands to.

    ``above`` are the files that lead to it, itself last; ``seen`` are the numbers of files that were looked at.
    """
    total, open_elements = 0, [(root, 1)]
    while open_elements:
        element, copies = open_elements.pop()
        if "%" in element.get("class", ""):
            _refuse(file, element, f"class '{shown(element.get('class', ''))}' has %; MuJoCo takes it for a format")
        copies *= _copies(element)
        total += copies * (1 if element.tag not in PARTS else _part(file, element, above, seen))
        if total > MOST_ELEMENTS:
            _refuse(file, element, f"it expands to more than {MOST_ELEMENTS:,} elements")
        entries = math.prod(_number(element, name) for name in ENTRIES.get(element.tag, ()))
        if element.tag == "size":
            names = [name for name in element.keys() if name.startswith(RESERVED)]
            entries = max((_number(element, name) for name in names), default=1)
        if entries > MOST_ENTRIES:
            _refuse(file, element, f"it has more than {MOST_ENTRIES:,} entries")
        open_elements += [(child, copies) for child in element]
    return total


def _part(file: Path, element: ET.Element, above: list[Path], seen: dict[Path, int]) -> int:
    """Return the number of elements of a file that an element names, 1 where it cannot be read; MuJoCo says why."""
    part = file.parent / element.get("file", "")
    try:
        place = part.resolve()
        if place in above:
            _refuse(file, element, f"{quoted(part.name)} leads to itself")
        if place not in seen and part.is_file():
            seen[place] = _check(part, ET.parse(part).getroot(), [*above, place], seen)
        return seen.get(place, 1)
    except (OSError, ET.ParseError):
        return 1


def _copies(element: ET.Element) -> int:
    counts = element.get("count", "1").split() if element.tag in COPIED else []
    return math.prod(max(_whole(word), 1) for word in counts)


def _number(element: ET.Element, name: str) -> int:
    return max(_whole(element.get(name, "1")), 1)


def _whole(word: str) -> int:
    """Return a number as an integer, at most a little more than any bound here; 1 for text that is none."""
    try:
        return int(min(max(float(word), 0.0), 1e12))
    except ValueError:  # NaN, too
        return 1


def _refuse(file: Path, element: ET.Element, why: str) -> None:
    raise ValueError(f"load: {str(file)!r}, <{shown(element.tag)}>: {why}; correct the file")
