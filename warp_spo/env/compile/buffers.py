"""The arrays of an environment, as torch tensors and as kernels see them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch

from .fused_kernel import COLUMN, COUNT, FOUND, INT, LONG, MASK, ROW, SHARED, Buffer
from .memory_layout import NET_TARGETS, MemoryLayout

CONTACT_ARRAYS = {"contact_f": 3, "contact_gap": 1, "contact_slip": 1}  # entries of each point, and of each pair
FAULT = "fault"  # the guard's code of what has ended a world in this step; no part of a state
LINE = 32  # scalars of a line of the caches


def ring_name(number: int) -> str:
    """Return the name of the array in which the errors and rates of a learned actuator are kept."""
    return f"actuator net {number}"


class Storage:
    """The arrays of an environment.

    Args:
        layout: what the stages agreed on. worlds: number of worlds. device: torch device.
        read: names of the arrays that stages read. results: entries of each result, in order.
        apart: names of results that several kernels write, whose rows begin at whole lines of the caches.
        tables: which all worlds share, besides those of the layout, by name.

    Attributes:
        tensors: by name. buffers: the same memory as kernels see it.
        controls: tensors that actions set, by name. written: tensors that a step of the dynamics writes besides the
            state, by name. values: the scene's values that events change [world, ...], by name.
        out: all results, one after the other. places: (start, entries, distance of rows) of each result in it.
    """

    def __init__(
        self,
        layout: MemoryLayout,
        worlds: int,
        device: torch.device,
        read: set[str],
        results: list[tuple[str, int]],
        apart: set[str],
        tables: Mapping[str, torch.Tensor],
    ):
        self.worlds, self.device, self._output = worlds, device, layout.output
        self.tensors: dict[str, torch.Tensor] = {}
        self.buffers: dict[str, Buffer] = {}
        self.controls: dict[str, torch.Tensor] = {}
        self.written: dict[str, torch.Tensor] = {}
        self.values: dict[str, torch.Tensor] = {}
        self._initial: dict[str, torch.Tensor] = {}  # of a world, before the first step; others are zeros
        self._add_state(layout)
        self._add_controls(layout, read)
        self._add_measured(layout, read)
        self._add_tables_and_values(layout, tables)
        self._add_results(results, apart)
        self.clear()

    def clear(self) -> None:
        """Set all that steps change to what it is before the first: default coordinates, the scene's values, zeros."""
        for tensor in (*self.changing().values(), *self.written.values()):
            tensor.zero_()
        for name, first in self._initial.items():
            self.tensors[name].copy_(first)

    def part(self, out: torch.Tensor, name: str) -> torch.Tensor:
        """Return a result in a copy of ``out`` [world, entries]."""
        _, size, _ = self.places[name]
        return self._rows(out, name)[:, :size]

    def _rows(self, out: torch.Tensor, name: str) -> torch.Tensor:
        start, _, pitch = self.places[name]
        return out[start : start + self.worlds * pitch].view(self.worlds, pitch)

    def changing(self) -> dict[str, torch.Tensor]:
        """Return the tensors that steps change, by name; "out" holds all results."""
        results = {self._output(name) for name in self.places}
        own = {name for name, buffer in self.buffers.items() if buffer.kind != SHARED} | {"key"}
        own -= {FAULT}
        return {name: x for name, x in self.tensors.items() if name in own - results} | {"out": self.out}

    def worlds_of(self) -> dict[str, tuple[torch.Tensor, int]]:
        """Return the tensors of worlds that steps change and read again, each with its axis of worlds, by name."""
        own = {name: buffer for name, buffer in self.buffers.items() if buffer.kind != SHARED}
        results = {self._output(name) for name in self.places}
        columns = (COLUMN, COUNT, FOUND)
        return {n: (self.tensors[n], int(b.kind in columns)) for n, b in own.items() if n not in results}

    @property
    def bytes_per_world(self) -> int:
        """Bytes that a world takes, without what all worlds share."""
        own = (buffer.tensor.nbytes for buffer in self.buffers.values() if buffer.kind != SHARED)
        return sum(own) // self.worlds

    # -- inside ----------------------------------------------------------------------------------------------------
    def _zeros(self, *shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        return torch.zeros(shape, dtype=dtype, device=self.device)

    def _add(self, name: str, tensor: torch.Tensor, kind: str = ROW) -> torch.Tensor:
        self.tensors[name] = tensor
        self.buffers[name] = Buffer(tensor.view(self.worlds, -1) if kind == ROW else tensor, kind)
        return tensor

    def _add_state(self, layout: MemoryLayout) -> None:
        worlds, scene = self.worlds, layout.scene
        self._initial["q"] = torch.tensor(layout.default_q, dtype=torch.float32, device=self.device)
        self._add("q", self._zeros(worlds, scene.coord_count))
        self._add("qd", self._zeros(worlds, scene.dof_count))
        self._add("actions", self._zeros(worlds, layout.action_count))
        self._add("memory", self._zeros(max(1, layout.memory_size), worlds), COLUMN)
        self._add("faults", self._zeros(len(layout.guard.names), worlds), COUNT)
        self._add("found", self._zeros(len(layout.guard.places), worlds), FOUND)
        self._add("tick", self._zeros(worlds, dtype=torch.int32), INT)
        self._add("key", self._zeros(3, dtype=torch.int32), SHARED)
        self._add("advance", self._zeros(1) + 1.0, SHARED)
        self._add("episode_length", self._zeros(worlds, dtype=torch.int64), LONG)
        self._add("chosen", self._zeros(worlds, dtype=torch.bool), MASK)
        if layout.keeps_failures:
            self._add(FAULT, self._zeros(worlds, dtype=torch.int32), INT)

    def _add_controls(self, layout: MemoryLayout, read: set[str]) -> None:
        for name in sorted(layout.action_arrays):
            self.controls[name] = self._add(name, self._zeros(self.worlds, layout.control_sizes[name]))
        for name in {"target_q", NET_TARGETS} & self.controls.keys():
            self._initial[name] = self._initial["q"]
        for number, (joints, slots) in enumerate(layout.networks):
            if slots:
                self._add(ring_name(number), self._zeros(2 * slots * joints, self.worlds), COLUMN)
        if "actuator_force" in read:
            self._add("actuator_force", self._zeros(self.worlds, layout.scene.dof_count))

    def _add_measured(self, layout: MemoryLayout, read: set[str]) -> None:
        """Add what the dynamics write: contacts, frames."""
        worlds, points, frames = self.worlds, layout.scene.contact_count, len(layout.frames)
        for name, each in CONTACT_ARRAYS.items():
            if name in read:
                shape = (worlds, points, 3) if each == 3 else (worlds, points)
                self.written[name] = self._add(name, self._zeros(*shape))
        if frames:
            self._add("frame_pose", self._zeros(worlds, frames, 7))
            self._add("frame_velocity", self._zeros(worlds, frames, 6))
        if layout.jacobians:
            size = len(layout.jacobians)
            self._add("frame_jacobian", self._zeros(worlds, size, 6, layout.scene.dof_count))
        if read & {"frame_acceleration", "qdd"}:
            self.written["qdd"] = self._add("qdd", self._zeros(worlds, layout.scene.dof_count))
        if "frame_acceleration" in read:
            self._add("frame_acceleration", self._zeros(worlds, frames, 6))

    def _add_tables_and_values(self, layout: MemoryLayout, tables: Mapping[str, torch.Tensor]) -> None:
        """Add tables that all worlds share, values of the scene by world, and what users compute in torch.

        Values are those that events change, then those that differ between worlds of the scene itself; none is both.
        """
        for name, table in tables.items():
            self._add(name, table.reshape(-1), SHARED)
        for name, numbers in layout.tables.items():
            flat = torch.tensor(np.asarray(numbers), dtype=torch.float32, device=self.device).reshape(-1)
            self._add(name, flat, SHARED)
        for name in layout.values:
            initial = torch.tensor(layout.scene.values[name][0], dtype=torch.float32, device=self.device)
            self._initial[f"value_{name}"] = initial
            self.values[name] = self._add(f"value_{name}", self._zeros(self.worlds, *initial.shape))
        for name in sorted(layout.unequal):
            by_world = torch.tensor(layout.scene.values[name], dtype=torch.float32, device=self.device)
            self._initial[f"value_{name}"] = self._add(f"value_{name}", by_world).clone()
        if layout.users:
            self._add("user", self._zeros(self.worlds, layout.user_size))

    def _add_results(self, results: list[tuple[str, int]], apart: set[str]) -> None:
        self.places: dict[str, tuple[int, int, int]] = {}
        at = 0
        for name, size in results:
            pitch = -(-size // LINE) * LINE if name in apart else size
            self.places[name] = at, size, pitch
            at += -(-self.worlds * pitch // LINE) * LINE
        self.out = self._zeros(at)
        for name in self.places:
            rows, held = self._rows(self.out, name), self._output(name)
            whole = name == "done"
            self._add(held, rows.view(-1).view(torch.int32) if whole else rows, INT if whole else ROW)
            self.buffers[held] = self.buffers[held]._replace(bypasses_caches=name in apart)
