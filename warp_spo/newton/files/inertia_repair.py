"""Masses and inertias that no rigid body can have, and the values that take their place.

The rule is that of Newton's ``finalize``, in float64 and with the names of the bodies. A negative mass becomes zero,
and a massless body has no inertia. All principal moments grow by the same amount until the least is positive, and
again until none exceeds the sum of the other two. Newton's smallest moments are in kg m^2, so that it replaces those of
every body of a few grams; here they shrink with the largest moment of a body where that is below ``SMALL``.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from ..worlds import quote_labels

LEAST_SHARE = 1e-6  # least principal moment as a share of the largest; Newton's figure, as are all below
LEAST = 1e-10  # least moment of a body that has none [kg m^2]; also the excess over the triangle inequality that counts
# as rounding
ADDED = 1e-6  # what a replaced inertia gets beyond the least that it needs [kg m^2]
ROUNDING = 1.2e-7  # relative excess over the triangle inequality that counts as rounding
SMALL = 1e-3  # largest moment below which LEAST and ADDED shrink in proportion [kg m^2]: ADDED is 1/1000 of it


def repair_body(mass: float, inertia: np.ndarray) -> tuple[float, np.ndarray]:
    """Return a body's mass [kg] and inertia [kg m^2, 3 x 3], replaced if no rigid body can have them."""
    if not (np.isfinite(mass) and np.isfinite(inertia).all() and mass > 0.0):
        return 0.0, np.zeros((3, 3))
    moments = np.linalg.eigvalsh(0.5 * (inertia + inertia.T))
    share = min(1.0, moments[2] / SMALL) if moments[2] > 0.0 else 1.0
    least = LEAST_SHARE * moments[2] if moments[2] > 0.0 else LEAST
    growth = least - moments[0] + share * ADDED if moments[0] < least else 0.0
    low, middle, high = moments + growth
    if low + middle < high - max(ROUNDING * high, share * LEAST):
        growth += high - low - middle + share * ADDED
    return mass, 0.5 * (inertia + inertia.T) + growth * np.eye(3) if growth else inertia


def repair_bodies(
    labels: Sequence[str], masses: Sequence[float], inertias: Sequence[np.ndarray], depth: int
) -> tuple[list[float], list[np.ndarray]]:
    """Return the masses and inertias of bodies, repaired. A warning names the bodies whose values were replaced.

    ``depth`` is the number of calls from the user's to this one; the warning names the user's line.
    """
    values = [repair_body(mass, inertia) for mass, inertia in zip(masses, inertias, strict=True)]
    replaced = [
        label
        for label, mass, inertia, (new_mass, new_inertia) in zip(labels, masses, inertias, values, strict=True)
        if mass != new_mass or not np.array_equal(inertia, new_inertia)
    ]
    if replaced:
        warnings.warn(
            f"load: replaced the mass or inertia of {quote_labels(replaced)}: the file's values are those of no rigid "
            "body (negative, a mass without inertia or an inertia without mass, or one principal moment exceeds the "
            "sum of the others); correct the file, or keep its values with load(path, repair=False)",
            UserWarning,
            stacklevel=depth + 1,
        )
    return [mass for mass, _ in values], [inertia for _, inertia in values]
