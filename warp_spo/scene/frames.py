"""Frames on bodies: what :meth:`Dynamics.jacobian` and its kin take, check_frames."""

from __future__ import annotations

import difflib
import math
from collections.abc import Sequence
from typing import Any

from ..arrays import check_plain
from ..errors import as_integer, refuse_masked
from .parts import IDENTITY_POSE, real
from .scene import Scene

Frame = Any  # a body (index, label, or what is behind a label's last slash), or (body, pose in the body)


def check_frames(scene: Scene, call: str, frames: Sequence[Frame]) -> tuple[tuple[int, tuple[float, ...]], ...]:
    """Body and origin in the body frame of every frame.

    Raises:
        ValueError, TypeError: an empty list, or an entry that is no frame of the scene.
    """
    if isinstance(frames, str) or not isinstance(frames, Sequence) or len(frames) == 0:
        raise ValueError(f"{call}: frames is {frames!r}; expected a list of bodies or of (body, pose in the body)")
    return tuple(_check_frame(scene, call, frame) for frame in frames)


def _check_frame(scene: Scene, call: str, frame: Frame) -> tuple[int, tuple[float, ...]]:
    body, pose = frame if isinstance(frame, tuple | list) and len(frame) == 2 else (frame, IDENTITY_POSE)
    labels = scene.body_labels
    if isinstance(body, str):
        found = [at for at, label in enumerate(labels) if label == body]
        found = found or [at for at, label in enumerate(labels) if label.rpartition("/")[2] == body]
        if not found:
            near = difflib.get_close_matches(body, [label.rpartition("/")[2] for label in labels], 3)
            such = f", such as {', '.join(map(repr, near))}" if near else ""
            raise ValueError(f"{call}: no body {body!r} in the scene; expected one of scene.body_labels{such}")
        if len(found) > 1:
            raise ValueError(
                f"{call}: {len(found)} bodies have the label {body!r}; expected one; pass the body's index"
            )
        body = found[0]
    index = as_integer(body)
    if index is None:
        raise _wrong(call, frame)
    if not 0 <= index < len(labels):
        raise ValueError(f"{call}: a frame's body is {index}; expected 0 to {len(labels) - 1}")
    return index, IDENTITY_POSE[:3] if pose is IDENTITY_POSE else _origin(call, frame, pose)


def _origin(call: str, frame: Frame, pose: Any) -> tuple[float, ...]:
    refuse_masked(call, "a frame's pose", pose)
    check_plain(call, "a frame's pose", pose)
    if getattr(pose, "requires_grad", False):
        raise ValueError(
            f"{call}: a frame's pose requires grad; derivatives are not available by it; pass the pose's detach()"
        )
    try:
        given = real(pose)
    except (TypeError, ValueError):
        raise _wrong(call, frame) from None
    if given.ndim != 1:
        raise _wrong(call, frame)
    numbers = tuple(given.tolist())
    unit = len(numbers) == 7 and abs(math.hypot(*numbers[3:]) - 1.0) < 1e-5  # float32 poses are unit to 1e-7
    if not unit or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{call}: a frame's pose is {numbers}; expected x, y, z and a unit quaternion xyzw")
    return numbers[:3]


def _wrong(call: str, frame: Frame) -> TypeError:
    return TypeError(f"{call}: a frame is {frame!r}; expected a body (index or label) or (body, pose in the body)")
