"""Frames on bodies: what :meth:`Dynamics.jacobian` and its kin take, checked and put on the device once."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from .parts import IDENTITY_POSE
from .scene import Scene

Frame = Any  # a body (index or label), or (body, pose in the body)


class Frames:
    """Device tables of the lists of frames that a scene has been asked for."""

    def __init__(self, scene: Scene, device: wp.Device, dtype: type):
        self._scene, self._device, self._dtype = scene, device, dtype
        self._tables: dict[tuple, tuple[wp.array, wp.array]] = {}

    def tables(self, call: str, frames: Sequence[Frame]) -> tuple[wp.array, wp.array]:
        """Bodies [frame] and origins in the body frame [frame, 3]; the same arrays for an equal list.

        Raises:
            ValueError, TypeError: an empty list, or an entry that is no frame of the scene.
        """
        if isinstance(frames, str) or not isinstance(frames, Sequence) or len(frames) == 0:
            raise ValueError(f"{call}: frames is {frames!r}; expected a list of bodies or of (body, pose in the body)")
        key = tuple(self._checked(call, frame) for frame in frames)
        if key not in self._tables:
            bodies: Any = wp.array([body for body, _ in key], dtype=int, device=self._device)
            origins: Any = wp.array(np.array([origin for _, origin in key]), dtype=self._dtype, device=self._device)
            self._tables[key] = (bodies, origins)
        return self._tables[key]

    def _checked(self, call: str, frame: Frame) -> tuple[int, tuple[float, ...]]:
        body, pose = frame if isinstance(frame, tuple | list) and len(frame) == 2 else (frame, IDENTITY_POSE)
        labels = self._scene.body_labels
        if isinstance(body, str):
            if body not in labels:
                raise ValueError(f"{call}: no body {body!r} in the scene; expected one of scene.body_labels")
            if labels.count(body) > 1:
                raise ValueError(
                    f"{call}: {labels.count(body)} bodies have the label {body!r}; expected one; pass the body's index"
                )
            body = labels.index(body)
        try:
            body, pose = operator.index(body), tuple(float(number) for number in pose)
        except (TypeError, ValueError):
            raise TypeError(
                f"{call}: a frame is {frame!r}; expected a body (index or label) or (body, pose in the body)"
            ) from None
        if not 0 <= body < len(labels):
            raise ValueError(f"{call}: a frame's body is {body}; expected 0 to {len(labels) - 1}")
        unit = len(pose) == 7 and abs(math.hypot(*pose[3:]) - 1.0) < 1e-5  # float32 poses are unit to 1e-7
        if not unit or not all(map(math.isfinite, pose)):
            raise ValueError(f"{call}: a frame's pose is {pose}; expected x, y, z and a unit quaternion xyzw")
        return body, pose[:3]
