"""Drives of a Newton model's joints: which gains count, and the targets of a control as arguments of a step."""

from __future__ import annotations

from typing import Any

import newton
import numpy as np
import warp as wp
from newton import JointTargetMode

from ..errors import UnsupportedError
from ..scene.scene import Scene
from .layout import FlatLayout
from .worlds import to_numpy

GAINS = ("joint_target_ke", "joint_target_kd")


class Drives:
    """The drives of a model's joints by ``joint_target_mode``.

    POSITION uses both gains and a target velocity of zero, VELOCITY uses ``joint_target_kd``, POSITION_VELOCITY uses
    both gains and both targets, NONE and EFFORT use no gain.

    Args:
        model: The Newton model.
        scene: Its scene.

    Attributes:
        any: Whether a dof has a drive.
        tracks_rates: Whether a drive has a target velocity.
        factors: 1 or 0 for each dof, by name of a gain or target, for those that count only in some modes.

    Raises:
        UnsupportedError: A dof has different modes in different worlds.
    """

    def __init__(self, model: newton.Model, scene: Scene):
        modes = to_numpy(model, "joint_target_mode")[scene.dof_index]
        if (modes != modes[:1]).any():
            raise UnsupportedError(
                "SolverSPO",
                "joint_target_mode that differs between worlds",
                "use one mode and set gains to zero in the worlds that have no drive",
            )
        self._position = np.isin(modes[0], (JointTargetMode.POSITION, JointTargetMode.POSITION_VELOCITY))
        rate = np.isin(modes[0], (JointTargetMode.VELOCITY, JointTargetMode.POSITION_VELOCITY))
        self._driven = self._position | rate
        self.any, self.tracks_rates = bool(self._driven.any()), bool(rate.any())
        masks = {"joint_target_ke": self._position, "joint_target_kd": self._driven, "joint_target_qd": rate}
        self.factors: dict[str, Any] = {
            name: wp.array(mask, dtype=wp.float32, device=model.device) for name, mask in masks.items()
        }

    def apply(self, scene: Scene) -> Scene:
        """Return the scene with the gains that count.

        A dof without a drive gets an effort limit of zero, so that no code is generated for a drive.
        """
        values = scene.values
        return scene.with_values(
            joint_target_ke=np.where(self._position, values["joint_target_ke"], 0.0),
            joint_target_kd=np.where(self._driven, values["joint_target_kd"], 0.0),
            joint_effort_limit=np.where(self._driven, values["joint_effort_limit"], 0.0),
        )

    def targets(self, control: newton.Control, q: FlatLayout, qd: FlatLayout) -> dict[str, wp.array]:
        """Return the targets as arguments of ``Dynamics.step``.

        Args:
            control: Newton's control with the targets.
            q: Layout of joint_q.
            qd: Layout of joint_qd.
        """
        if not self.any:
            return {}
        return self.read(control.joint_target_q, control.joint_target_qd if self.tracks_rates else None, q, qd)

    def read(self, target_q: Any, target_qd: Any, q: FlatLayout, qd: FlatLayout) -> dict[str, wp.array]:
        """Return Newton's targets as arguments of ``Dynamics.step``; None leaves the target velocities out."""
        found = {"target_q": q.read(target_q, "joint_target_q")}
        if target_qd is not None:
            rates = qd.read(target_qd, "joint_target_qd")
            found["target_qd"] = qd.scale(rates, self.factors["joint_target_qd"], "target_qd")
        return found
