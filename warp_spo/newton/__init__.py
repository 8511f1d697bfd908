"""Newton's side of the border: scenes from its models and files, and time steps as one of its solvers."""

from .files import SHIPPED, load, shipped
from .model import from_newton
from .solver import SolverSPO

__all__ = ["SHIPPED", "SolverSPO", "from_newton", "load", "shipped"]
