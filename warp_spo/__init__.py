"""Spatial operators of multibody dynamics for thousands of worlds at once.

The graph layer: :class:`Tree`, :class:`Digraph`, :class:`BWA` and its resolvent. Scenes: :class:`Scene` by hand,
:func:`load` from a robot file, :func:`from_newton`, :func:`from_mujoco`. Dynamics: :class:`Dynamics`.
"""

from typing import TYPE_CHECKING, Any

from .dynamics.actuators import ActuatorState
from .dynamics.dynamics import Dynamics
from .dynamics.stepping.options import StepOptions, StepReport
from .errors import DirectedLoopError, UnsupportedError
from .execution.tuned import Tuned
from .graph.factorization import Factorization
from .graph.operators import BWA, Blocks, Identity, Operator
from .scene import terrain
from .scene.actuators import Actuator, Keyframe
from .scene.contacts import Contact
from .scene.flexible.beams import beam_modes
from .scene.flexible.modes import MassPoints, Modes
from .scene.flexible.normal_modes import normal_modes
from .scene.flexible.sections import Material, Section
from .scene.gears import Rotor
from .scene.ground import HeightField, Plane
from .scene.parts import Body, Coupling, Hinge, Loop
from .scene.scene import Scene
from .scene.tree import Digraph, Tree
from .status import Status
from .trace.functions import clip, spline, where

if TYPE_CHECKING:
    from . import jax as jax
    from . import mujoco as mujoco
    from . import newton as newton
    from . import torch as torch
    from .mujoco import from_mujoco
    from .newton import from_newton, load
    from .viewing.robot_view import view

    __version__: str

__all__ = [
    "BWA",
    "Actuator",
    "ActuatorState",
    "Blocks",
    "Body",
    "Contact",
    "Coupling",
    "Digraph",
    "DirectedLoopError",
    "Dynamics",
    "Factorization",
    "HeightField",
    "Hinge",
    "Identity",
    "Keyframe",
    "Loop",
    "MassPoints",
    "Material",
    "Modes",
    "Operator",
    "Plane",
    "Rotor",
    "Scene",
    "Section",
    "Status",
    "StepOptions",
    "StepReport",
    "Tree",
    "Tuned",
    "UnsupportedError",
    "__version__",
    "beam_modes",
    "clip",
    "from_mujoco",
    "from_newton",
    "load",
    "normal_modes",
    "spline",
    "terrain",
    "view",
    "where",
]


if not TYPE_CHECKING:  # or every misspelled name would pass a type checker

    def __getattr__(name: str) -> Any:
        import importlib

        if name in ("load", "from_newton"):  # these import newton
            return getattr(importlib.import_module(".newton", __name__), name)
        if name == "view":
            return importlib.import_module(".viewing.robot_view", __name__).view
        if name == "from_mujoco":
            return importlib.import_module(".mujoco", __name__).from_mujoco
        if name in ("jax", "mujoco", "newton", "torch"):
            return importlib.import_module(f".{name}", __name__)
        if name == "__version__":
            from importlib.metadata import PackageNotFoundError, version

            try:
                return version(__name__)
            except PackageNotFoundError:
                return "0+checkout"  # of a checkout that was never installed
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
