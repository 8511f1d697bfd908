"""Checks of the values of contacts: what a dtype cannot carry is an error, what lets a body sink far a warning."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np

from ..errors import shown
from ..reference.field_spheres import REACH
from .contact_defaults import POINTS_AT_REST, NeutralPose
from .ground import HeightField

SOFT = 0.1  # share of its smallest size by which a body that sinks under its load is said
NAMED = 4  # contacts in the message
TRIED = 1.5  # cells to each side of a sphere's centre, at least, in which a field's nearest point is looked for
UNITS = {"contact_stiffness": "N/m", "contact_damping": "N s/m"}


def check_contact_values(call: str, scene: Any, dtype: str) -> None:
    """Raise a ValueError where squares of stiffness or damping, which a step forms, are not finite in a dtype."""
    most = float(np.sqrt(np.finfo(dtype).max))
    for name, unit in UNITS.items():
        large = scene.values[name].max(axis=0, initial=0.0)
        if large.size and large.max() > most:
            row = int(large.argmax())
            way = "dtype='float64', or a lighter body" if dtype == "float32" else "a lighter body"
            raise ValueError(
                f"{call}: {name} of {_words(scene, row)} is {large[row]:.3g} {unit}; expected at most {most:.2g} in "
                f"{dtype}; give {way}, or stiffness= and damping= of spo.Contact"
            )


@contextlib.contextmanager
def unsaid_softness() -> Iterator[None]:
    """Leave out :func:`warn_of_soft_contacts`, where the values of contacts come later than the contacts."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Scene: stiffness of .* too small")
        yield


def warn_of_soft_contacts(call: str, scene: Any, neutral: NeutralPose) -> None:
    """Warn of contacts whose given stiffness lets a body that flies sink by more than SOFT of its size.

    It sinks under the weight of its tree and of the trees that pairs connect with it, on the points that it has at
    rest; in a pair under the weight of the lighter tree.
    """
    found: list[tuple[int, int, float, float]] = []
    points = scene.contact_points
    of_tree = neutral.roots[[point.body for point in points if not point.meets_grid]] if points else np.zeros(0)
    for row, index in enumerate(one.contact for one in (*points, *scene.contact_pairs)):
        contact = scene.contacts[index]
        if contact.stiffness is None or contact.body not in neutral.flying:
            continue
        if row < len(points):
            load = neutral.load(contact.body)[0]
            share = min(POINTS_AT_REST, int((of_tree == neutral.roots[contact.body]).sum()))
        else:
            pair = scene.contact_pairs[row - len(points)]
            bodies = [body for body in (pair.body, pair.other) if body >= 0 and neutral.moves[body]]
            load, share = min(neutral.load(body)[1] for body in bodies) * neutral.gravity, 1
        size, needed = _size(contact), load / (share * SOFT)
        if size > 0.0 and contact.stiffness * size < needed and index not in [each[0] for each in found]:
            found.append((index, row, contact.stiffness, needed / size))
    if found:
        words = [f"{_words(scene, row)}: {k:.3g}, needs {needed:.2g}" for _, row, k, needed in found[:NAMED]]
        more = f"; and {len(found) - NAMED} more" if len(found) > NAMED else ""
        warnings.warn(
            f"{call}: stiffness of {len(found)} contact(s) is too small: at rest they sink by more than a tenth of "
            f"their size under what they carry ({'; '.join(words)}{more} [N/m]); give more, or leave stiffness out",
            UserWarning,
            stacklevel=4,
        )


def warn_of_large_spheres(call: str, scene: Any) -> None:
    """Warn of spheres so large beside a field's cells that the nearest point of its slopes may not be looked at."""
    field, points = scene.ground, scene.contact_points
    if not isinstance(field, HeightField):
        return
    most = TRIED * min(field.cells) / REACH
    large = [row for row, point in enumerate(points) if point.support is None and point.radius > most]
    if not large:
        return
    slopes = [np.abs(np.diff(field.heights, axis=axis - 2)).max() / field.cells[axis] for axis in (0, 1)]
    sine = np.sin(np.arctan(np.hypot(*slopes)))
    large = [row for row in large if sine * points[row].radius > TRIED * min(field.cells)]
    if large:
        words = [f"{_words(scene, row)}: {points[row].radius:.3g} m" for row in large[:NAMED]]
        more = f"; and {len(large) - NAMED} more" if len(large) > NAMED else ""
        warnings.warn(
            f"{call}: {len(large)} sphere(s) are larger than {most:.3g} m, 2.1 cells of the height field, and miss "
            f"what is farther aside ({'; '.join(words)}{more}); give larger cells, or several smaller spheres",
            UserWarning,
            stacklevel=4,
        )


def _size(contact: Any) -> float:
    """Return the smallest size of a contact's points, spheres included [m]; that of a flat sole has no thickness."""
    widths = np.ptp(contact.positions, axis=0)
    widths = widths[widths > 0.0] if contact.radius == 0.0 else widths
    return float(min(widths, default=0.0) + 2.0 * contact.radius)


def _words(scene: Any, row: int) -> str:
    """Return the name of a row's contact and of its body."""
    points = scene.contact_points
    one = points[row] if row < len(points) else scene.contact_pairs[row - len(points)]
    label, body = scene.contacts[one.contact].label, scene.body_labels[one.body]
    return f"contact {one.contact}{f' {shown(label)!r}' if label else ''} of body {shown(body)!r}"
