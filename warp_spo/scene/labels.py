"""Labels of parts that have none of their own."""

from __future__ import annotations

from collections.abc import Iterable


def unused_label(wanted: str, taken: set[str]) -> str:
    """Return a label that is not taken, and take it: ``wanted``, or with ``_2``, ``_3`` and so on behind it."""
    label, number = wanted, 2
    while label in taken:
        label, number = f"{wanted}_{number}", number + 1
    taken.add(label)
    return label


def fill_labels(labels: Iterable[str], kind: str) -> list[str]:
    """Return labels, of which those that are empty become ``kind_k`` by their place, or another that none has."""
    given = list(labels)
    taken = set(given)
    return [label or unused_label(f"{kind}_{place}", taken) for place, label in enumerate(given)]
