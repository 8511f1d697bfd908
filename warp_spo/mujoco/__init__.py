"""Scenes from MuJoCo's models, and :class:`Coordinates`, which converts states between the two."""

from .coordinates import Coordinates
from .model import from_mujoco

__all__ = ["Coordinates", "from_mujoco"]
