"""Check that the loop joints of a Newton model are constraints without forces of their own."""

from __future__ import annotations

import newton
import numpy as np
from newton import JointTargetMode

from ..errors import UnsupportedError
from ..recursions.step.joint_laws import DEFAULT_BOUND
from ..scene.parts import UNLIMITED


def check_loop_joints(model: newton.Model, joints: np.ndarray) -> None:
    """Raise UnsupportedError if a loop joint has springs, drives, friction, limits or armature.

    Args:
        model: The Newton model.
        joints: Rows of its loop joints [world, joint].
    """
    read = lambda name: getattr(model, f"joint_{name}").numpy()  # noqa: E731
    driven = np.isin(read("target_mode"), (JointTargetMode.NONE, JointTargetMode.EFFORT), invert=True)
    in_use = {name: read(name) != 0.0 for name in ("damping", "stiffness", "friction", "armature")}
    in_use |= {name: (read(name) != 0.0) & driven for name in ("target_ke", "target_kd")}
    bounds = {"limit_lower": UNLIMITED, "limit_upper": UNLIMITED, "velocity_limit": DEFAULT_BOUND}
    in_use |= {name: np.abs(read(name)) < none for name, none in bounds.items()}
    start = read("qd_start")
    for joint in joints.ravel():
        for name, mask in in_use.items():
            if mask[start[joint] : start[joint + 1]].any():
                raise UnsupportedError(
                    "SolverSPO",
                    f"joint_{name} of loop joint {model.joint_label[joint]!r}, which can only be a constraint,",
                    "make it a joint of the articulation and close the loop at another joint",
                )
