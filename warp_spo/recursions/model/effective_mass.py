"""Effective masses of hinges and points at the neutral configuration of world 0, from which steps choose scales."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ...scene.scene import Scene
from ...trace.evaluation import evaluate
from ..composite import mass_matrix
from ..kinematics import jacobian
from .links import Links
from .scene_cache import cached_by_scene
from .tracing import Trace


@cached_by_scene
def masses(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return the mass matrix and its pseudo-inverse [dof, dof].

    Raises:
        ValueError: the matrix is not finite there; the message names the hinge.
    """
    mass = _evaluate(scene, mass_matrix, (scene.dof_count, scene.dof_count))
    lost = ~np.isfinite(mass)
    if lost.any():
        dof = int(np.argmax(np.where(np.diagonal(lost), 2, lost.any(axis=0))))
        raise ValueError(
            "Dynamics.step: the mass matrix at the neutral q, which scales velocity limits and contacts, is not finite "
            f"at {scene.dof_labels[dof]!r}; expected a custom hinge whose pose has finite derivatives there; "
            "shift its coordinate, so that zero is regular"
        )
    return mass, np.linalg.pinv(mass)


def inverse_weights(scene: Scene, frames: tuple[tuple[int, Any], ...], turning: bool = False) -> np.ndarray:
    """Return the sum of J Mass^-1 J* over three directions, of each point given by its body and place [1/kg].

    ``turning``: of the body's turning, in place of the point's motion [1/(kg m^2)].
    """
    rows = slice(3, 6) if turning else slice(3)
    J = _evaluate(scene, lambda trace: jacobian(trace, frames), (len(frames), 6, scene.dof_count))[:, rows]
    return np.einsum("pai,ij,paj->p", J, masses(scene)[1], J)


def _evaluate(scene: Scene, trace: Callable, shape: tuple[int, ...]) -> np.ndarray:
    one = scene.with_values(**{name: array[:1] for name, array in scene.values.items()})
    stores, found = trace(Trace(Links(one), "float64", ("q",))), np.zeros(shape)
    with np.errstate(all="ignore"):
        values = evaluate([item.value for item in stores], lambda array, index: scene.neutral_q[index[0]])
    for item, value in zip(stores, values, strict=True):
        found[item.index] = value
    return found
