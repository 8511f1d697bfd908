"""Frames on bodies: the argument ``frames`` of :meth:`Dynamics.frame_poses`, :meth:`Dynamics.jacobian` and others."""

from __future__ import annotations

import difflib
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import as_integer, refuse_masked
from ..runtime.autograd import check_plain
from .parts import IDENTITY_POSE, real

if TYPE_CHECKING:
    from .scene import Scene

Frame = Any
"""A body (its index, label, or the label's part after the last slash), a site's name, or (one of these, pose in it)."""
EXPECTED = "expected a body (index or label), the name of a site, or (one of these, pose in it)"


def check_frames(scene: Scene, call: str, frames: Sequence[Frame]) -> tuple[tuple[int, tuple[float, ...]], ...]:
    """Return the body of every frame, and the frame's pose in the body frame: x, y, z [m], quaternion xyzw.

    Raises:
        ValueError, TypeError: the list is empty, or an entry is not a frame of the scene.
    """
    if isinstance(frames, str) or not isinstance(frames, Sequence) or len(frames) == 0:
        raise ValueError(
            f"{call}: frames is {frames!r}; expected a list of bodies, names of sites, or "
            "pairs (one of these, pose in it)"
        )
    return tuple(_check_frame(scene, call, frame) for frame in frames)


def _check_frame(scene: Scene, call: str, frame: Frame) -> tuple[int, tuple[float, ...]]:
    """Return the body of one frame, and the frame's pose in the body frame."""
    base, pose = frame if isinstance(frame, tuple | list) and len(frame) == 2 else (frame, IDENTITY_POSE)
    at: tuple[float, ...] = IDENTITY_POSE
    if isinstance(base, str):
        base, at = _find_frame(scene, call, base)
    index = as_integer(base)
    if index is None:
        raise _wrong_frame(call, frame)
    if not 0 <= index < len(scene.bodies):
        raise ValueError(f"{call}: a frame's body is {index}; expected 0 to {len(scene.bodies) - 1}")
    if pose is IDENTITY_POSE:
        return index, at
    checked = _pose(call, frame, pose)
    return index, checked if at is IDENTITY_POSE else _compose(at, checked)


def _find_frame(scene: Scene, call: str, name: str) -> tuple[int, tuple[float, ...]]:
    """Return the body of this label and the identity, or the body of the site of this name and the site's pose."""
    labels = scene.body_labels
    ends = [label.rpartition("/")[2] for label in labels]
    matches = [at for at, label in enumerate(labels) if label == name]
    matches = matches or [at for at, end in enumerate(ends) if end == name]
    if name in scene.sites:
        if matches:
            raise ValueError(
                f"{call}: {name!r} is a body and a site; expected a name that stands for one of them; pass the body's "
                f"index, {matches[0]}, or scene.sites[{name!r}]"
            )
        if scene.sites[name][0] < 0:
            raise ValueError(
                f"{call}: site {name!r} is on no body: it stands still in the inertial frame; expected a site of a "
                f"body; scene.sites[{name!r}] has its pose"
            )
        return scene.sites[name]
    if not matches:
        near = difflib.get_close_matches(name, [*ends, *scene.sites], 3)
        such = f", such as {', '.join(map(repr, near))}" if near else ""
        raise ValueError(
            f"{call}: no body and no site {name!r} in the scene; expected one of scene.body_labels or scene.sites{such}"
        )
    if len(matches) > 1:
        raise ValueError(f"{call}: {len(matches)} bodies have the label {name!r}; expected one; pass the body's index")
    return matches[0], IDENTITY_POSE


def _compose(outer: tuple[float, ...], inner: tuple[float, ...]) -> tuple[float, ...]:
    """Return the pose ``inner``, given in the pose ``outer``."""
    place, turn = np.array(inner[:3]), np.array(inner[3:6])
    axis, w = np.array(outer[3:6]), outer[6]
    across = 2.0 * np.cross(axis, place)
    place = outer[:3] + place + w * across + np.cross(axis, across)
    vector = w * turn + inner[6] * axis + np.cross(axis, turn)
    return *place.tolist(), *vector.tolist(), float(w * inner[6] - axis @ turn)


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
    return TypeError(f"{call}: a frame is {frame!r}; {EXPECTED}")


def pose_matrix(pose: np.ndarray) -> np.ndarray:
    """Return the 4 x 4 matrix of a pose (x, y, z, qx, qy, qz, qw) with a unit quaternion."""
    x, y, z, w = pose[3:]
    axis, found = np.array([x, y, z]), np.eye(4)
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    found[:3, :3] = (w * w - axis @ axis) * np.eye(3) + 2.0 * np.outer(axis, axis) + 2.0 * w * across
    found[:3, 3] = pose[:3]
    return found
