"""What users call: :class:`Dynamics`."""

from .dynamics import Dynamics

__all__ = ["Dynamics"]
