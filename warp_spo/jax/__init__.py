"""Operations of Dynamics as functions that JAX traces: :func:`function`.

Only this package imports JAX. Calls of :class:`warp_spo.Dynamics` itself take JAX arrays that hold numbers.
"""

from .functions import Function, function

__all__ = ["Function", "function"]
