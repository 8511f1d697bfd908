"""Learned actuators in a step of an environment: before each step of the dynamics their networks give torques."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch
import warp as wp

from ...dynamics.stepping.integrators import STEP, contact_routine, several_launches
from ...kernels.actuator_networks import ARRAYS, OWN, Joints, before_substep, torques
from ...kernels.substeps import Before
from ...runtime import launches
from . import tensor_weights
from .buffers import Buffer, Storage, ring_name
from .memory_layout import AGE

if TYPE_CHECKING:
    from ...dynamics.dynamics import Dynamics
    from ..actions import ActuatorNet
    from .memory_layout import MemoryLayout

BLOCK = 128  # threads
JOINED_ON = ("cuda",)  # kinds of devices on which the kernel of the step evaluates networks; on a CPU nothing is gained
MOST_JOINED = 4096  # products of a network whose weights stand in the text of the step's kernel; more is much code
TENSOR_CORES = True  # layers of networks with bounded activations, on GPUs
TOGETHER = 3  # joints whose layers a warp evaluates side by side in the kernel of the step


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
        self._joints: list[Joints] = []
        self._before: list[tuple[Before, dict[str, wp.array]]] = []
        for number, part in enumerate(parts):
            hinges = part.hinges(scene)
            at, dofs = (tuple(int(start[i]) for i in hinges) for start in (scene.q_start, scene.qd_start))
            entries = 0 if self._force is None or number else self._force[0].numel()
            sizes = scene.coord_count, scene.dof_count, scene.dof_count if own else 0
            half = tensor_weights.shape_of(part.network) if TENSOR_CORES and _has_tensor_cores(device) else None
            weights = zero if half is None else torch.tensor(tensor_weights.pack(part.network, half))
            layers, activation, lags, error_first, scales = part.network.text
            joints = Joints(
                layers=() if half else layers,
                activation=activation,
                lags=lags,
                error_first=error_first,
                scales=scales,
                coordinates=at,
                dofs=dofs,
                sizes=sizes,
                age=layout.memory[AGE][0],
                decimation=decimation,
                half=half,
            )
            buffers = {name: store.buffers[name] for name in ("q", "qd", "memory", "tau")}
            buffers |= {"target": store.buffers[part.array], "force": force}
            buffers |= {"limit": store.buffers[limits] if own else Buffer(shared)}
            buffers |= {"mean_force": Buffer(zero if self._mean is None else self._mean)}
            buffers |= {"ring": store.buffers.get(ring_name(number), Buffer(zero))}
            buffers |= {"weights": Buffer(weights.to(store.device))}
            arrays = {name: buffers[name].warp() for name in ARRAYS[:-1]}
            self._kernels.append((torques(joints, entries, BLOCK), list(arrays.values()), len(hinges)))
            self._joints.append(joints)
            code = before_substep(joints, number, TOGETHER)
            self._before.append((code, {f"{name}_{number}": arrays[name] for name in OWN}))

    def join(self, dyn: Dynamics, acts: bool, delays: bool, passes: int | None) -> bool:
        """Let the kernel of the step evaluate the networks before each substep, if one takes all substeps.

        Args:
            dyn: of the step. acts: it has controls. delays: some are delayed. passes: of contacts.

        Returns:
            Whether it does; then :meth:`run` is not called.
        """
        kind = "cuda" if self._device.is_cuda else "cpu"
        routine = contact_routine(dyn) if dyn.scene.contacts else STEP
        if kind not in JOINED_ON or self._decimation == 1 or dyn.plan.of(routine) != "segment":
            return False
        if max(joints.products for joints in self._joints) > MOST_JOINED:
            return False
        if several_launches(dyn, "semi_implicit", acts, delays, passes):
            return False
        dyn.programs.builder.before = self._before
        return True

    def run(self, step: Callable[[], None], scope: Callable[[], Any]) -> None:
        """Take all steps of the dynamics of a step.

        Args:
            step: takes one. scope: returns a context in which Warp launches on torch's stream.
        """
        for substep in range(self._decimation):
            with scope():
                for kernel, arrays, joints in self._kernels:
                    threads = -(-(-(-self._worlds // 32) * 32 * joints) // BLOCK) * BLOCK
                    inputs = [self._worlds, *arrays, float(substep)]
                    launches.launch(kernel, threads, inputs, [], device=self._device, block_dim=BLOCK)
            step()
        if self._force is not None and self._mean is not None:
            torch.add(self._mean, self._force, alpha=1.0 / self._decimation, out=self._force)


def _has_tensor_cores(device: wp.Device) -> bool:
    """Return whether a device multiplies TF32."""
    return device.is_cuda and device.arch >= 80
