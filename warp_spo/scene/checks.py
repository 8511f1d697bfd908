"""Checks of the numbers that a scene is made of, float64 copies that nobody changes."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..errors import refuse_masked
from ..runtime.dlpack import is_traced

SYMMETRY = 1e-6  # relative: what a float32 file or importer leaves of a symmetric inertia, a unit axis or quaternion


def checked_array(call: str, name: str, value: Any, shape: tuple[int, ...], finite: bool = True) -> np.ndarray:
    refuse_masked(call, name, value)
    try:
        array = real(value)
    except (TypeError, ValueError):
        refuse_gradient(call, name, value)
        raise ValueError(f"{call}: {name} is {value!r}; expected numbers of shape {shape}") from None
    if array.shape != shape:
        raise ValueError(f"{call}: {name} has shape {array.shape}; expected {shape}")
    if finite and not np.isfinite(array).all():
        raise ValueError(f"{call}: {name} is {array.tolist()}; expected finite numbers")
    return read_only(array)


def refuse_gradient(call: str, name: str, value: Any, variable: str = "") -> None:
    """Raise ValueError if torch or JAX takes derivatives by ``value``, because none passes through a scene.

    ``variable`` is the name among the scene's values, if there is one.
    """
    listed = value if isinstance(value, list | tuple) else (value,)
    if any(getattr(one, "requires_grad", False) or is_traced(one) for one in listed):
        named = f"({variable!r},)" if variable else "(...), the names of values"
        raise ValueError(
            f"{call}: {name} requires grad, and a scene holds plain numbers, through which no derivative passes; "
            f"expected numbers; pass them detached; for gradients build Dynamics with variable={named} and give the "
            "tensor to Dynamics.set, or in JAX to a function with values="
        )


def real(value: Any) -> np.ndarray:
    """Return a copy of an array in float64, which later changes of the caller's array do not affect.

    Raises:
        TypeError: ``value`` is or contains text, None, complex numbers, integers beyond float64, or torch tensors that
            require grad, because no derivative passes through a copy.
    """
    try:
        array = np.asarray(value.cpu() if hasattr(value, "cpu") else value)
        for one in (value, *array.flat) if array.dtype == object else (value,):
            if one is None or isinstance(one, str | bytes) or getattr(one, "requires_grad", False):
                raise TypeError
        if array.dtype.kind not in "biufO":
            raise TypeError
        return array.astype(np.float64)
    except (OverflowError, RuntimeError):  # what torch raises of tensors that NumPy cannot see
        raise TypeError from None


def read_only(array: np.ndarray) -> np.ndarray:
    array.flags.writeable = False
    return array


def checked_unit(call: str, name: str, vector: np.ndarray) -> np.ndarray:
    norm = np.linalg.norm(vector, axis=-1, keepdims=True)
    if np.any(np.abs(norm - 1.0) > SYMMETRY):
        raise ValueError(f"{call}: {name} is {vector.tolist()}; expected unit length, got {norm.ravel().tolist()}")
    return vector / norm


def checked_inertia(call: str, inertia: np.ndarray, any_inertia: Any = False) -> np.ndarray:
    """Return ``inertia`` [..., 3, 3] made exactly symmetric; see :class:`Body` for what it may be.

    ``any_inertia``, [...] or one bool, says whose eigenvalues may be negative.

    Raises:
        ValueError: the inertia is not symmetric up to rounding, or has a negative eigenvalue.
    """
    scale = np.abs(inertia).max(axis=(-1, -2))
    skew = np.abs(inertia - np.swapaxes(inertia, -1, -2)).max(axis=(-1, -2))
    if np.any(skew > SYMMETRY * scale):
        raise ValueError(f"{call}: inertia is not symmetric, by {skew.max():.3g} kg m^2; expected I = I.T")
    symmetric = 0.5 * (inertia + np.swapaxes(inertia, -1, -2))
    lowest = np.linalg.eigvalsh(symmetric)[..., 0]
    negative = (lowest < -SYMMETRY * scale) & ~np.asarray(any_inertia)
    if np.any(negative):
        raise ValueError(
            f"{call}: inertia has the eigenvalue {lowest[negative].min():.3g} kg m^2; expected none below zero; "
            "correct it, or accept it with Body(..., any_inertia=True)"
        )
    return symmetric
