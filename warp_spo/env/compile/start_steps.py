"""Reports of the state in which worlds start anew that only a step can give: a step from there that leads nowhere.

Reports that follow from the state itself are traced into the stage that starts worlds, see :mod:`.starts`.
"""

from __future__ import annotations

from typing import Any

import torch

from ...dynamics.stepping.options import StepOptions, StepReport


class StartSteps:
    """Steps of an environment that fill gaps of pairs, and accelerations, where worlds have started anew.

    An acceleration is that of one step of the dynamics with the contacts of the state and the controls of action 0.
    On a GPU all worlds take the step, because a CUDA graph holds it.

    Args:
        env: the environment; its arrays exist. longest: of the delays of its actuators, in steps; 0: there are none.
        pairs, accelerations: whether observations read gaps of pairs of bodies, and accelerations.
    """

    def __init__(self, env: Any, longest: int, pairs: bool, accelerations: bool):
        self.env, self.pairs, self.accelerations = env, pairs, accelerations
        self.needed = pairs or accelerations
        if not self.needed:
            return
        self._state = torch.zeros_like(env.q), torch.zeros_like(env.qd)  # where the steps lead
        names = [name for name, reads in (("contact_gap", pairs), ("qdd", accelerations)) if reads]
        self._found = {name: torch.zeros_like(env._tensors[name]) for name in names}
        self._delayed = env.dyn.actuator_state(like=env.q, longest=longest) if longest and accelerations else None

    def run(self) -> None:
        """Take the steps, and store what they report of the chosen worlds."""
        env = self.env
        if not self.needed or not (env.warp_device.is_cuda or bool(env.chosen.any())):
            return
        if self.pairs:
            self._step({}, 1, "contact_gap", len(env.scene.contact_points))
        if self.accelerations:
            if self._delayed is not None:
                env.dyn.reset_actuator_state(None, self._delayed)
            self._step(env._controls, env._passes, "qdd", 0)

    def _step(self, controls: dict[str, torch.Tensor], passes: int | None, name: str, first: int) -> None:
        """Take a step, and store the entries from ``first`` on of the report ``name``."""
        env, found, report = self.env, self._found[name], self.env._tensors[name]
        env.dyn.step(
            env.q,
            env.qd,
            controls.get("tau"),
            env.dt,
            ctrl=controls.get("ctrl"),
            target_q=controls.get("target_q"),
            actuator_state=self._delayed if "ctrl" in controls else None,
            options=StepOptions(passes=passes),
            report=StepReport(**{name: found}),
            out=self._state,
        )
        report[:, first:] = torch.where(env.chosen[:, None], found[:, first:], report[:, first:])
