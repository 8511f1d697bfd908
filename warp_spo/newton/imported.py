"""Scenes of models that Newton's importers built from files."""

from __future__ import annotations

import warnings

import newton
import numpy as np

from ..scene.scene import Scene
from .model import from_newton
from .worlds import quote_labels, to_numpy

REPAIR = 1e-5  # relative change of a mass or inertia above which finalize() repaired it; float32 rounds by less


def scene_of(builder: newton.ModelBuilder) -> Scene:
    """Return the scene of a builder that read a file. A warning names the bodies whose inertia Newton replaced."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Inertia validation corrected", category=newton.NewtonWarning)
        # from_newton checks the topology itself, and it accepts joints outside articulations, which USD files have.
        model = builder.finalize(device="cpu", skip_validation_joints=True)
    if builder.body_count == 0:
        return from_newton(model)
    before, after = np.array(builder.body_inertia, dtype=np.float64).reshape(-1, 3, 3), to_numpy(model, "body_inertia")
    scale = np.maximum(np.abs(before).max(axis=(1, 2)), np.finfo(np.float32).tiny)
    moved = np.abs(after - before).max(axis=(1, 2)) > REPAIR * scale
    moved |= ~np.isclose(builder.body_mass, to_numpy(model, "body_mass"), rtol=REPAIR, atol=0.0)
    if moved.any():
        names = quote_labels([builder.body_label[body] for body in np.flatnonzero(moved)])
        warnings.warn(
            f"load: Newton replaced the mass or inertia of {names}: the file's values are those of no rigid body "
            "(negative, or one principal moment exceeds the sum of the others); correct the file",
            UserWarning,
            stacklevel=4,
        )
    return from_newton(model)
