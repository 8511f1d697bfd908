"""Scenes from USD files, read by Newton's importer."""

from __future__ import annotations

from pathlib import Path

import newton

from ..scene.scene import Scene
from .imported import scene_of


def read_usd(file: Path, floating: bool | None, repair: bool) -> Scene:
    """Return the scene of a USD file."""
    builder = newton.ModelBuilder()
    builder.add_usd(str(file), floating=floating, load_visual_shapes=False, skip_mesh_approximation=True)
    return scene_of(builder, repair)
