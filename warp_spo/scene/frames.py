"""Frames on bodies: the argument ``frames`` of :meth:`Dynamics.frame_poses`, :meth:`Dynamics.jacobian` and others."""

from __future__ import annotations

import difflib
import math
from collections.abc import Sequence
from typing import Any

from ..errors import as_integer, refuse_masked
from ..gradients import check_plain
from .parts import IDENTITY_POSE, real
from .scene import Scene

Frame = Any  # a body (its index, label, or the label's part after the last slash), (body, pose in it), or a site's name


def check_frames(scene: Scene, call: str, frames: Sequence[Frame]) -> tuple[tuple[int, tuple[float, ...]], ...]:
    """Return the body of every frame, and the frame's pose in the body frame: x, y, z [m], quaternion xyzw.

    Raises:
        ValueError, TypeError: the list is empty, or an entry is not a frame of the scene.
    """
    if isinstance(frames, str) or not isinstance(frames, Sequence) or len(frames) == 0:
        raise ValueError(f"{call}: frames is {frames!r}; expected a list of bodies or of (body, pose in the body)")
    return tuple(_check_frame(scene, call, frame) for frame in frames)


def _check_frame(scene: Scene, call: str, frame: Frame) -> tuple[int, tuple[float, ...]]:
    """Return the body of one frame, and the frame's pose in the body frame."""
    labels = scene.body_labels
    if isinstance(frame, str) and frame in scene.sites and frame not in labels:
        frame = scene.sites[frame]
    body, pose = frame if isinstance(frame, tuple | list) and len(frame) == 2 else (frame, IDENTITY_POSE)
    if isinstance(body, str):
        matches = [at for at, label in enumerate(labels) if label == body]
        matches = matches or [at for at, label in enumerate(labels) if label.rpartition("/")[2] == body]
        if not matches:
            near = difflib.get_close_matches(body, [label.rpartition("/")[2] for label in labels], 3)
            such = f", such as {', '.join(map(repr, near))}" if near else ""
            raise ValueError(f"{call}: no body {body!r} in the scene; expected one of scene.body_labels{such}")
        if len(matches) > 1:
            raise ValueError(
                f"{call}: {len(matches)} bodies have the label {body!r}; expected one; pass the body's index"
            )
        body = matches[0]
    index = as_integer(body)
    if index is None:
        raise _wrong_frame(call, frame)
    if not 0 <= index < len(labels):
        raise ValueError(f"{call}: a frame's body is {index}; expected 0 to {len(labels) - 1}")
    return index, IDENTITY_POSE if pose is IDENTITY_POSE else _pose(call, frame, pose)


def origins(frames: Sequence[tuple[int, tuple[float, ...]]]) -> tuple[tuple[int, tuple[float, ...]], ...]:
    """Return the body and the origin in the body frame [m] of every checked frame, for what depends on no more."""
    return tuple((body, pose[:3]) for body, pose in frames)


def _pose(call: str, frame: Frame, pose: Any) -> tuple[float, ...]:
    """Return the numbers of a checked pose, its quaternion of unit length."""
    refuse_masked(call, "a frame's pose", pose)
    check_plain(call, "a frame's pose", pose)
    if getattr(pose, "requires_grad", False):
        raise ValueError(
            f"{call}: a frame's pose requires grad; derivatives are not available by it; pass the pose's detach()"
        )
    try:
        array = real(pose)
    except (TypeError, ValueError):
        raise _wrong_frame(call, frame) from None
    if array.ndim != 1:
        raise _wrong_frame(call, frame)
    numbers = tuple(array.tolist())
    unit = len(numbers) == 7 and abs(math.hypot(*numbers[3:]) - 1.0) < 1e-5  # float32 poses are unit to 1e-7
    if not unit or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{call}: a frame's pose is {numbers}; expected x, y, z and a unit quaternion xyzw")
    return *numbers[:3], *(x / math.hypot(*numbers[3:]) for x in numbers[3:])


def _wrong_frame(call: str, frame: Frame) -> TypeError:
    return TypeError(f"{call}: a frame is {frame!r}; expected a body (index or label) or (body, pose in the body)")
