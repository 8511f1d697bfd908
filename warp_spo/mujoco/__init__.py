"""Scenes from MuJoCo's models, and :class:`Coordinates`, which converts states between the two."""

OLDEST = (3, 11)
"""Version of MuJoCo that has every field that is read without asking for it."""

try:
    import mujoco
except ImportError as error:
    raise ImportError(
        f"warp_spo.mujoco: the package mujoco is missing ({error}); expected version 3.11 or newer; "
        "pip install warp_spo[mujoco]"
    ) from error
if tuple(int(part) for part in mujoco.__version__.split(".")[:2]) < OLDEST:
    raise ImportError(
        f"warp_spo.mujoco: the package mujoco is {mujoco.__version__}; expected 3.11 or newer; "
        "pip install warp_spo[mujoco]"
    )

from .coordinates import Coordinates  # noqa: E402
from .model import from_mujoco  # noqa: E402

__all__ = ["Coordinates", "from_mujoco"]
