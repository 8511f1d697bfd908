"""Scenes of models that Newton's importers built from files."""

from __future__ import annotations

import functools
import warnings
from pathlib import Path

import newton
import numpy as np

from ..scene.scene import Scene
from ..scene.shapes import NONE, Choice, Shape
from .model import from_newton
from .model_contacts import ModelShapes
from .repair import repair_bodies
from .worlds import Worlds


def scene_of(file: Path, builder: newton.ModelBuilder, repair: bool, choice: Choice = NONE) -> Scene:
    """Return the scene of a builder that read a file; errors name the file. Contacts obey Newton's groups and filters.

    Args:
        file: for errors. builder: what an importer made of the file. choice: of shapes that touch the ground.
        repair: replace masses and inertias that no rigid body can have; a warning names the bodies.
    """
    try:
        if repair:
            inertias = [np.array(inertia, dtype=np.float64).reshape(3, 3) for inertia in builder.body_inertia]
            masses, inertias = repair_bodies(builder.body_label, builder.body_mass, inertias, depth=4)
            builder.body_mass[:] = masses
            builder.body_inertia[:] = inertias  # type: ignore[assignment]  # matrices, as Newton's own
        # from_newton checks the topology itself, and it accepts joints outside articulations, which USD files have.
        model = builder.finalize(device="cpu", skip_validation_joints=True, skip_validation_inertia=True)
        scene = from_newton(model)
    except ValueError as error:
        error.args = (f"load: {str(file)!r}: {error}",)
        raise
    call = f"load: {str(file)!r}"

    @functools.cache
    def shapes() -> ModelShapes:
        return ModelShapes(model, Worlds(model), materials=False)

    def touches(shape: Shape, ground: Shape) -> bool:
        return shapes().touches(shape, ground)

    scene, lost = choice.applied(call, scene, lambda: shapes().first(), touches, Shape.on)
    if lost:
        warnings.warn(f"{call}: left out: {', '.join(lost)}", UserWarning, stacklevel=4)
    return scene


def unreadable(file: Path, error: Exception) -> ValueError:
    """Return the error for a file on which an importer failed; importers raise errors of any type for a damaged one."""
    return ValueError(
        f"load: {str(file)!r}: Newton's importer cannot read it ({type(error).__name__}: {error}); correct the file"
    )
