"""XML files as trees whose elements know their file and line, so that errors can name them."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from ...errors import shown


class XmlElement(ET.Element):
    """An XML element with its file and line. Its methods raise ValueError that names both.

    Attributes:
        file: the file that holds the element.
        line: line of its tag, from 1.
    """

    file: Path
    line: int

    def error(self, what: str) -> ValueError:
        """Return an error about the element; ``what`` says what came, what was expected and what to do."""
        name = f" name='{shown(self.get('name', ''))}'" if self.get("name") else ""
        return ValueError(f"load: {str(self.file)!r}, line {self.line}, <{self.tag}{name}>: {what}")

    def child(self, tag: str) -> XmlElement | None:
        """Return the only child of that tag, or None if there is none."""
        found: list[Any] = self.findall(tag)
        if len(found) > 1:
            name = shown(self.get("name", ""))
            raise found[1].error(f"a second one in <{self.tag}> '{name}'; expected one; remove it")
        return found[0] if found else None

    def needed(self, name: str) -> str:
        """Return an attribute that must be there."""
        value = self.get(name)
        if value is None:
            raise self.error(f"no attribute {name!r}; expected one; write it")
        if not value:
            raise self.error(f"attribute {name!r} is empty; expected a value; write it")
        return value

    def number(self, name: str, default: float | None = None, least: float = -np.inf, infinite: bool = False) -> float:
        """Return an attribute that is one number; without a default it must be there.

        ``least`` is the least that it may be. ``infinite`` says whether infinity is a number, too.
        """
        value = float(self.numbers(name, 1, None if default is None else (default,), infinite)[0])
        if value < least:
            raise self.error(f"{name} is {value:g}; expected {least:g} or more")
        return value

    def numbers(self, name: str, count: int, default: Any = None, infinite: bool = False) -> np.ndarray:
        """Return an attribute that is ``count`` numbers [count]; without a default it must be there."""
        if self.get(name) is None and default is not None:
            return np.array(default, dtype=np.float64)
        given = self.get(name)
        text = self.needed(name) if given is None else given
        try:
            values = np.array([float(word) for word in text.split()])
        except ValueError:
            values = np.array([np.nan])
        wrong = np.isnan(values) if infinite else ~np.isfinite(values)
        if len(values) != count or wrong.any() or "_" in text:  # Python reads 1_000
            way_out = "" if text.strip() or default is None else "; write them, or remove the attribute"
            raise self.error(f"{name} is '{shown(text)}'; expected {count} finite number{'s' * (count > 1)}{way_out}")
        return values


def read_xml(file: Path) -> XmlElement:
    """Return the root element of an XML file. Namespaces are not resolved: prefixes stay in the tags.

    Raises:
        ET.ParseError: The file is not XML; the message names the line.
    """
    parser = expat.ParserCreate()

    def element(tag: str, attributes: dict[str, str]) -> XmlElement:
        made = XmlElement(tag, attributes)
        made.file, made.line = file, parser.CurrentLineNumber
        return made

    builder = ET.TreeBuilder(element_factory=element)
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(file.read_bytes(), True)
    except (expat.ExpatError, ValueError, LookupError) as error:  # the last two: of an encoding
        raise ET.ParseError(str(error)) from None
    root: Any = builder.close()
    return root
