"""The public class :class:`Dynamics` and its operations."""

from .dynamics import Dynamics

__all__ = ["Dynamics"]
