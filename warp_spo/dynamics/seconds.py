"""Lengths of time that callers pass, checked."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ..runtime.arrays import Call
from ..errors import is_bool
from ..runtime.autograd import check_plain
from ..scene.parts import real

STAND_IN = 1e-3  # [s], of steps that only compile
LIMITS: dict[type, tuple[float, float]] = {
    dtype: (float(numbers.tiny), float(numbers.max))
    for dtype, numbers in ((wp.float32, np.finfo(np.float32)), (wp.float64, np.finfo(np.float64)))
}
"""Least and largest normal number of each dtype."""


def seconds(call: Call, dt: Any) -> float:
    """Return ``dt`` [s] as a float.

    Raises:
        TypeError: not a number. ValueError: it requires grad, is not finite, or the dtype does not hold it.
    """
    name = call.name
    if isinstance(dt, float):
        found = float(dt)
    elif getattr(dt, "requires_grad", False):
        raise ValueError(f"{name}: dt requires grad; derivatives are not available through this call; pass float(dt)")
    else:
        check_plain(name, "dt", dt)
        try:
            number = real(dt)
            if number.ndim or is_bool(dt):
                raise TypeError
        except (TypeError, ValueError):
            raise TypeError(f"{name}: dt is {dt!r}; expected a number of seconds, the same in all worlds") from None
        found = float(number)
    least, most = LIMITS[call.dtype]
    if found != 0.0 and not least <= abs(found) <= most:
        raise ValueError(f"{name}: dt is {found} s; expected a number that {call.dtype.__name__} holds, finite")
    return found
