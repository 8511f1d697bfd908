"""Pickling of a Dynamics: as its arguments and the numbers of its variable values, which build it anew."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..execution.tuned import Tuned
from ..runtime import launches
from ..scene.scene import Scene
from . import tuning

if TYPE_CHECKING:
    from .dynamics import Dynamics


def reduce(self: Dynamics) -> tuple[Callable[..., Dynamics], tuple[Any, ...]]:
    """Return how pickle and ``copy`` build this object again: with its arguments, at the values that it has now.

    Kernels, memory and captured graphs are not stored. A tensor that a value was set to, and that requires grad, goes
    along, so that results of the copy have gradients by the tensor's copy.
    """
    options = dict(self._options)
    if self.embedding is not None:  # chosen for the values that the scene had when this object was made
        options["independent"] = tuple(int(dof) for dof in self.independent_dofs)
    values = {name: self.recursions.parameters.value(name).numpy() for name in self.variable}
    return build, (type(self), self.scene, options, values, dict(self.values.tensors), dict(self.plan.tuned))


def build(
    kind: type[Dynamics],
    scene: Scene,
    options: dict[str, Any],
    values: dict[str, np.ndarray],
    tensors: dict[str, Any],
    tuned: dict[str, Tuned],
) -> Dynamics:
    device = options["device"]
    try:
        wp.get_device(device)
    except ValueError:
        raise ValueError(
            f"Dynamics: it was stored on device {device!r}, which this machine lacks; expected one of "
            f"{', '.join(repr(known.alias) for known in wp.get_devices())}; store its scene, and build "
            f"Dynamics(scene, device=...) here"
        ) from None
    dyn = kind(scene, **options)
    for name, choice in tuned.items():
        tuning.use(dyn, name, choice)
    parameters = dyn.recursions.parameters
    for name, value in values.items():
        launches.copy(parameters.value(name), wp.array(value, dtype=wp.float64, device=dyn.device))
    parameters.refresh(values)
    for name, tensor in tensors.items():
        dyn.values.set(name, tensor)
    return dyn
