"""A scene's values on a device: kept in float64 as Newton names them, derived for the kernels and rounded once.

What every world shares is stored once and read through an axis of stride zero, so that kernels never ask. What is
``variable`` owns one row a world and is refreshed by launches alone.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

from .kernels import parameters as kernels
from .kernels.spatial import POSE, RIGID
from .kernels.topology import Topology
from .scene import Scene

VARIABLE = (
    "body_mass",
    "body_com",
    "body_inertia",
    "joint_armature",
    "joint_damping",
    "joint_stiffness",
    "joint_friction",
    "joint_target_ke",
    "joint_target_kd",
    "joint_X_p",
    "joint_X_c",
    "gravity",
)
RIGID_VALUES = ("body_mass", "body_com", "body_inertia", "joint_X_p", "joint_X_c")


def spread(array: wp.array, axis: int, worlds: int) -> wp.array:
    """``array`` with its world axis, of length 1 or ``worlds``, seen as ``worlds`` long; no copy."""
    if array.shape[axis] == worlds:
        return array
    shape, strides = list(array.shape), list(array.strides)
    shape[axis], strides[axis] = worlds, 0
    place = {"ptr": array.ptr, "shape": tuple(shape), "strides": tuple(strides)}
    view: Any = wp.array(**place, dtype=array.dtype, device=array.device)
    view._ref = array  # keeps the memory
    return view


class Parameters:
    """The values of ``scene`` for ``worlds`` worlds, as the kernels read them.

    Attributes:
        tree, anchor, com, rigid: see :mod:`warp_spo.kernels.parameters`, [node, component, world].
    """

    def __init__(self, scene: Scene, topology: Topology, worlds: int, device: wp.Device, dtype: type, variable: tuple):
        self.scene, self.worlds, self.device, self.dtype = scene, worlds, device, dtype
        self.variable = variable
        self._topology = topology
        self._hinge_of: Any = wp.array(scene.hinge_of, dtype=int, device=device)
        self._fields: dict[str, tuple[wp.array, wp.array]] = {}  # by dof, coordinate or component: (own, spread)
        self._values: dict[str, wp.array] = {}
        for name, value in scene.values.items():
            if name in variable:
                value = np.broadcast_to(value, (worlds, *value.shape[1:]))
            self._values[name] = wp.array(np.ascontiguousarray(value), dtype=wp.float64, device=device)
        rigid_worlds = max(self._values[name].shape[0] for name in RIGID_VALUES)
        self._rigid_values = [spread(self._values[name], 0, rigid_worlds) for name in RIGID_VALUES]
        self._rigid_out = [
            wp.empty((scene.body_count, components, rigid_worlds), dtype=dtype, device=device)
            for components in (POSE, POSE, 3, RIGID)
        ]
        self.tree, self.anchor, self.com, self.rigid = (spread(array, 2, worlds) for array in self._rigid_out)
        self._derive()

    def _derive(self) -> None:
        wp.launch(
            kernels.derive(self.dtype),
            dim=(self.scene.body_count, self._rigid_out[0].shape[2]),
            inputs=[self._topology, self._hinge_of, *self._rigid_values],
            outputs=self._rigid_out,
            device=self.device,
        )

    def array(self, name: str) -> wp.array:
        """tree, anchor, com, rigid or a field, as [item, component, world]."""
        if name in ("tree", "anchor", "com", "rigid"):
            return getattr(self, name)
        field = self.field(name)
        return field.reshape((field.shape[0], 1, field.shape[1]))

    def field(self, name: str) -> wp.array:
        """``values[name]`` as [dof, coordinate or component, world], rounded; made at the first request."""
        if name not in self._fields:
            value = self._values[name]
            own = wp.empty(value.shape[::-1], dtype=self.dtype, device=self.device)
            self._fields[name] = (own, spread(own, 1, self.worlds))
            self._refresh_field(name)
        return self._fields[name][1]

    def _refresh_field(self, name: str) -> None:
        own = self._fields[name][0]
        wp.launch(
            kernels.transpose(self.dtype), dim=own.shape, inputs=[self._values[name]], outputs=[own], device=self.device
        )

    @property
    def gravity(self) -> wp.array | None:
        """[3, world], or None where it is zero and stays so."""
        if "gravity" not in self.variable and not self.scene.values["gravity"].any():
            return None
        return self.field("gravity")

    def copy_in(self, name: str, value: wp.array) -> None:
        """Copy a variable value [world, ...] or [...] into place; launches only."""
        own = self._values[name]
        size = math.prod(own.shape[1:])
        if value.ndim == own.ndim:
            flat = value.reshape((self.worlds, size))
        else:
            flat = spread(value.reshape((1, size)), 0, self.worlds)
        wp.launch(
            kernels.widen(self.dtype),
            dim=(self.worlds, size),
            inputs=[flat],
            outputs=[own.reshape((self.worlds, size))],
            device=self.device,
        )

    def adopt_variable(self, other: Parameters) -> None:
        """Take over the variable values of ``other``."""
        for name in self.variable:
            wp.copy(self._values[name], other._values[name])
        self.refresh(self.variable)

    def refresh(self, names: Any) -> None:
        """Derive anew what depends on the named values."""
        if any(name in RIGID_VALUES for name in names):
            self._derive()
        for name in names:
            if name in self._fields:
                self._refresh_field(name)
