"""Scenes from MuJoCo's models, and :class:`Coordinates`, which converts states between the two."""

try:
    import mujoco  # noqa: F401
except ImportError as error:
    raise ImportError(
        f"warp_spo.mujoco: the package mujoco is missing ({error}); expected version 3.11 or newer; "
        "pip install warp_spo[mujoco]"
    ) from error

from .coordinates import Coordinates
from .model import from_mujoco

__all__ = ["Coordinates", "from_mujoco"]
