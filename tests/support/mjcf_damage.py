"""Damaged XML: a cut, or a change of one element, attribute or number, by the seed."""

import copy
import xml.etree.ElementTree as ET

VALUES = ("", "nan", "inf", "-1", "0", "1e300", "1e-300", "x", "1 2", "1 2 3 4 5 6 7 8", "true", "-0.5 0.5")


def damaged(text, rng):
    """Return (a damaged copy of XML text, what was done to it)."""
    change = rng.choice(list(CHANGES))
    if change == "cut":
        at = int(rng.integers(1, len(text)))
        return text[:at], f"cut at {at}"
    root = ET.fromstring(text)
    parents = [(parent, child) for parent in root.iter() for child in parent]
    parent, child = parents[int(rng.integers(len(parents)))]
    detail = CHANGES[change](parent, child, rng, [element for _, element in parents])
    return ET.tostring(root, encoding="unicode"), f"{change} <{child.tag}>: {detail}"


def _remove(parent, child, rng, elements):
    parent.remove(child)
    return child.attrib


def _duplicate(parent, child, rng, elements):
    parent.append(copy.deepcopy(child))
    return child.attrib


def _move(parent, child, rng, elements):
    """Into another element, which may be itself."""
    other = elements[int(rng.integers(len(elements)))]
    parent.remove(child)
    other.append(copy.deepcopy(child))
    return f"to <{other.tag}>"


def _rename(parent, child, rng, elements):
    child.tag = elements[int(rng.integers(len(elements)))].tag if rng.random() < 0.7 else child.tag + "s"
    return f"to {child.tag}"


def _rename_attribute(parent, child, rng, elements):
    if not child.attrib:
        return "no attribute"
    name = rng.choice(list(child.attrib))
    other = elements[int(rng.integers(len(elements)))].attrib
    new = rng.choice(list(other)) if other and rng.random() < 0.7 else name + "s"
    child.set(str(new), child.attrib.pop(name))
    return f"{name} to {new}"


def _remove_attribute(parent, child, rng, elements):
    return child.attrib.pop(rng.choice(list(child.attrib))) if child.attrib else "no attribute"


def _change_value(parent, child, rng, elements):
    """Of an attribute, or of one number in it."""
    if not child.attrib:
        return "no attribute"
    name = str(rng.choice(list(child.attrib)))
    words, value = child.attrib[name].split(), str(rng.choice(VALUES))
    if words and rng.random() < 0.7:
        words[int(rng.integers(len(words)))] = value
        value = " ".join(words)
    child.set(name, value)
    return f"{name}={value!r}"


def _swap_values(parent, child, rng, elements):
    """Give an attribute the value that the same attribute has elsewhere, a name included."""
    if not child.attrib:
        return "no attribute"
    name = str(rng.choice(list(child.attrib)))
    others = [element.get(name) for element in elements if name in element.attrib]
    child.set(name, others[int(rng.integers(len(others)))])
    return f"{name}={child.get(name)!r}"


CHANGES = {
    "cut": None,
    "remove": _remove,
    "duplicate": _duplicate,
    "move": _move,
    "rename": _rename,
    "rename attribute": _rename_attribute,
    "remove attribute": _remove_attribute,
    "change value": _change_value,
    "swap values": _swap_values,
}
"""Kinds of damage to a file."""
