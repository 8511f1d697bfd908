"""Scenes from Newton's models and from robot files, and :class:`SolverSPO`, which steps a Newton model."""

import newton as _newton

LOWEST = "1.8"  # version of Newton, as in pyproject.toml
_version = [int(word) for word in _newton.__version__.split(".")[:2] if word.isdigit()]
if len(_version) == 2 and _version < [int(word) for word in LOWEST.split(".")]:
    raise ImportError(
        f"warp_spo.newton: Newton {_newton.__version__} is installed; expected {LOWEST} or newer: pip install "
        f"'newton>={LOWEST}'"
    )

from .files.load import SHIPPED, load, shipped  # noqa: E402
from .model import from_newton  # noqa: E402
from .solver import SolverSPO  # noqa: E402

__all__ = ["SHIPPED", "SolverSPO", "from_newton", "load", "shipped"]
