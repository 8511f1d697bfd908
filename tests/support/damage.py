"""Damage to XML files: parts are cut, doubled and renamed, and numbers are changed, as editors and merges do it."""

import re

ELEMENT = re.compile(r"<(\w+)\b[^<>]*/>|<(\w+)\b[^<>]*>(?:(?!<\2\b).)*?</\2>", re.S)
ATTRIBUTE = re.compile(r'\s(\w+)\s*=\s*"([^"]*)"')
TAG = re.compile(r"</?(\w+)")
NUMBER = re.compile(r"-?\d+\.?\d*(?:e-?\d+)?")


def _one(rng, pattern, text):
    """Return a random match of a pattern that lies behind the first element's tag."""
    found = list(pattern.finditer(text, text.index(">", text.index("<robot") if "<robot" in text else 0)))
    return found[rng.integers(len(found))]


def _replaced(text, start, stop, new):
    return text[:start] + new + text[stop:]


def cut_bytes(text, rng):
    start = int(rng.integers(len(text)))
    return _replaced(text, start, start + int(rng.integers(1, 60)), "")


def cut_end(text, rng):
    return text[: rng.integers(len(text))]


def cut_element(text, rng):
    return _replaced(text, *_one(rng, ELEMENT, text).span(), "")


def cut_attribute(text, rng):
    return _replaced(text, *_one(rng, ATTRIBUTE, text).span(), "")


def double_element(text, rng):
    found = _one(rng, ELEMENT, text)
    return _replaced(text, *found.span(), found.group() * 2)


def rename_tag(text, rng):
    start, stop = _one(rng, TAG, text).span(1)
    return _replaced(text, start, stop, text[start:stop] + "x")


def rename_element(text, rng):
    found = _one(rng, ELEMENT, text)
    tag = found.group(1) or found.group(2)
    new = re.sub(rf"^<{tag}\b|</{tag}>$", lambda part: part.group().replace(tag, f"{tag}s"), found.group())
    return _replaced(text, *found.span(), new)


def rename_attribute(text, rng):
    start, stop = _one(rng, ATTRIBUTE, text).span(1)
    return _replaced(text, start, stop, text[start:stop] + "x")


def change_value(text, rng):
    """Give an attribute the value of another one."""
    start, stop = _one(rng, ATTRIBUTE, text).span(2)
    return _replaced(text, start, stop, _one(rng, ATTRIBUTE, text).group(2))


def empty_value(text, rng):
    return _replaced(text, *_one(rng, ATTRIBUTE, text).span(2), "")


def change_number(text, rng):
    new = str(rng.choice(["", "-1", "0", "nan", "inf", "1e400", "1,5", "0x10", "1_0", "1 2", "--1", "7.5"]))
    return _replaced(text, *_one(rng, NUMBER, text).span(), new)


def swap_elements(text, rng):
    """Let two elements change places."""
    one, other = sorted((_one(rng, ELEMENT, text), _one(rng, ELEMENT, text)), key=lambda found: found.start())
    if other.start() < one.end():
        return text
    return text[: one.start()] + other.group() + text[one.end() : other.start()] + one.group() + text[other.end() :]


KINDS = (
    cut_bytes,
    cut_end,
    cut_element,
    cut_attribute,
    double_element,
    rename_tag,
    rename_element,
    rename_attribute,
    change_value,
    empty_value,
    change_number,
    swap_elements,
)


def damaged(text, rng):
    """Return the text with one to three damages."""
    for _ in range(int(rng.integers(1, 4))):
        text = KINDS[rng.integers(len(KINDS))](text, rng)
    return text
