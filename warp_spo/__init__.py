"""Spatial operators of multibody dynamics for thousands of worlds at once.

The graph layer: :class:`Tree`, :class:`Digraph`, :class:`BWA` and its resolvent. Scenes: :class:`Scene` by hand,
:func:`load` from a robot file, :func:`from_newton`. Dynamics: :class:`Dynamics`.
"""

from typing import TYPE_CHECKING, Any

from .dynamics.dynamics import Dynamics
from .errors import DirectedLoopError, UnsupportedError
from .graph.factorization import Factorization
from .graph.operators import BWA, Blocks, Identity, Operator
from .scene.parts import Body, Coupling, Hinge, Loop
from .scene.scene import Scene
from .scene.tree import Digraph, Tree

if TYPE_CHECKING:
    from .newton import from_newton, load

__all__ = [
    "BWA",
    "Blocks",
    "Body",
    "Coupling",
    "Digraph",
    "DirectedLoopError",
    "Dynamics",
    "Factorization",
    "Hinge",
    "Identity",
    "Loop",
    "Operator",
    "Scene",
    "Tree",
    "UnsupportedError",
    "from_newton",
    "load",
]


def __getattr__(name: str) -> Any:
    if name in ("load", "from_newton"):  # these import newton
        from . import newton

        return getattr(newton, name)
    if name in ("torch", "newton"):
        import importlib

        return importlib.import_module(f".{name}", __name__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
