"""Scenes from Newton's models and from robot files, and :class:`SolverSPO`, which steps a Newton model."""

from .files.load import SHIPPED, load, shipped
from .model import from_newton
from .solver import SolverSPO

__all__ = ["SHIPPED", "SolverSPO", "from_newton", "load", "shipped"]
