"""Learned actuators in a step of an environment: before each step of the dynamics their networks give torques."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch
import warp as wp

from ...kernels.actuator_networks import ARRAYS, torques
from ...runtime import launches
from .buffers import Buffer, Storage, ring_name
from .memory_layout import AGE

if TYPE_CHECKING:
    from ..actions import ActuatorNet
    from .memory_layout import MemoryLayout

BLOCK = 128  # threads


class ActuatorLaunches:
    """The kernels of learned actuators, one for each action that has some.

    Args:
        parts: actions with a network. layout: of the environment. store: its arrays. decimation: steps of the dynamics
            in a step. device: where they run.
    """

    def __init__(
        self, parts: Sequence[ActuatorNet], layout: MemoryLayout, store: Storage, decimation: int, device: wp.Device
    ):
        self._worlds, self._device, self._decimation = store.worlds, device, decimation
        self._force, self._mean = store.written.get("contact_f") if decimation > 1 else None, None
        scene, limits = layout.scene, "value_joint_effort_limit"
        own = limits in store.buffers
        shared = torch.tensor(scene.values["joint_effort_limit"][0], dtype=torch.float32, device=store.device)
        zero = torch.zeros(1, device=store.device)
        force = Buffer(zero)
        if self._force is not None:
            self._mean = torch.zeros_like(self._force)
            force = store.buffers["contact_f"]
        self._kernels: list[tuple[wp.Kernel, list[Any], int]] = []
        for number, part in enumerate(parts):
            hinges = part.hinges(scene)
            at, dofs = (tuple(int(start[i]) for i in hinges) for start in (scene.q_start, scene.qd_start))
            entries = 0 if self._force is None or number else self._force[0].numel()
            sizes = scene.coord_count, scene.dof_count, scene.dof_count if own else 0
            kernel = torques(*part.network.text, at, dofs, sizes, layout.memory[AGE][0], decimation, entries)
            buffers = {name: store.buffers[name] for name in ("q", "qd", "memory", "tau")}
            buffers |= {"target": store.buffers[part.array], "force": force}
            buffers |= {"limit": store.buffers[limits] if own else Buffer(shared)}
            buffers |= {"mean_force": Buffer(zero if self._mean is None else self._mean)}
            buffers |= {"ring": store.buffers.get(ring_name(number), Buffer(zero))}
            arrays = [buffers[name].warp() for name in ARRAYS[:-1]]
            self._kernels.append((kernel, arrays, len(hinges)))

    def run(self, step: Callable[[], None], scope: Callable[[], Any]) -> None:
        """Take all steps of the dynamics of a step.

        Args:
            step: takes one. scope: returns a context in which Warp launches on torch's stream.
        """
        for substep in range(self._decimation):
            with scope():
                for kernel, arrays, joints in self._kernels:
                    threads = -(-self._worlds * joints // BLOCK) * BLOCK
                    inputs = [self._worlds, *arrays, float(substep)]
                    launches.launch(kernel, threads, inputs, [], device=self._device, block_dim=BLOCK)
            step()
        if self._force is not None and self._mean is not None:
            torch.add(self._mean, self._force, alpha=1.0 / self._decimation, out=self._force)
