"""A scene's values on a device: kept in float64 as Newton names them, derived for the kernels and rounded once.

What every world shares is stored once and read through an axis of stride zero, so that kernels never ask. What is
``variable`` owns one row a world and is refreshed by launches alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import warp as wp

from ..arrays import broadcast_worlds
from ..kernels import parameters as kernels
from ..kernels.spatial import POSE, RIGID
from ..kernels.topology import Topology
from ..scene.scene import Scene
from .node_functions import node_functions

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


class Derived(NamedTuple):
    """Arrays that ``fill()``, launches alone, makes of the values ``of`` these names.

    Attributes:
        each_time: at every request, as graphs that set values were captured before it was made.
    """

    arrays: list[wp.array]
    of: Sequence[str]
    fill: Callable[[], None]
    each_time: bool = False


class Parameters:
    """The values of ``scene`` for ``worlds`` worlds, and what is made of them at the first request."""

    def __init__(self, scene: Scene, topology: Topology, worlds: int, device: wp.Device, dtype: type, variable: tuple):
        self.scene, self.worlds, self.device, self.dtype = scene, worlds, device, dtype
        self.variable = variable
        self._topology = topology
        self._hinge_of: Any = wp.array(scene.hinge_of, dtype=int, device=device)
        self._derived: dict[str, Derived] = {}
        self._captured = False
        self._version = 0
        self._sharers: list[Parameters] = []
        self._values: dict[str, wp.array] = {}
        for name, value in scene.values.items():
            own: Any = wp.array(value, dtype=wp.float64, device=device)
            if name in variable:
                shared, own = own, wp.empty((worlds, *value.shape[1:]), dtype=wp.float64, device=device)
                wp.copy(own, broadcast_worlds(shared, 0, worlds))
            self._values[name] = own

    @property
    def version(self) -> int | None:
        """Equal as long as no value has changed; None if a graph may change them unseen."""
        return None if self._captured else self._version

    def derived(self, key: str, build: Callable[[], Derived]) -> list[wp.array]:
        """The arrays of that name; ``build()`` allocates them at the first request."""
        found = self._derived.get(key)
        if found is None:
            found = self._derived[key] = build()._replace(each_time=self._captured)
            found.fill()
        elif found.each_time:
            found.fill()
        return found.arrays

    def rows(self, names: Iterable[str]) -> int:
        """1 if all worlds share these values, else the number of worlds."""
        return max((self._values[name].shape[0] for name in names), default=1)

    def entries(self, name: str, worlds: int) -> wp.array:
        """Newton's numbers as [entry, world], float64; no copy."""
        value = self._values[name]
        flat = value.reshape((value.shape[0], math.prod(value.shape[1:])))
        return broadcast_worlds(flat.transpose(), 1, worlds)

    def _bodies(self) -> list:
        """tree, anchor, com, rigid: see :mod:`warp_spo.kernels.parameters`, [node, component, world]."""

        def build() -> Derived:
            scene, worlds = self.scene, self.rows(RIGID_VALUES)
            values = [broadcast_worlds(self._values[name], 0, worlds) for name in RIGID_VALUES]
            own: list = [
                wp.empty((scene.body_count, components, worlds), dtype=self.dtype, device=self.device)
                for components in (POSE, POSE, 3, RIGID)
            ]
            inputs, dim = [self._topology, self._hinge_of, *values], (scene.body_count, worlds)
            fill = lambda: wp.launch(kernels.derive(node_functions(self.dtype)), dim, inputs, own, device=self.device)  # noqa: E731
            return Derived([broadcast_worlds(array, 2, self.worlds) for array in own], RIGID_VALUES, fill)

        return self.derived("bodies", build)

    @property
    def tree(self) -> wp.array:
        return self._bodies()[0]

    @property
    def anchor(self) -> wp.array:
        return self._bodies()[1]

    @property
    def com(self) -> wp.array:
        return self._bodies()[2]

    @property
    def rigid(self) -> wp.array:
        return self._bodies()[3]

    def field(self, name: str) -> wp.array:
        """``values[name]`` as [dof, coordinate or component, world], rounded."""

        def build() -> Derived:
            value = self._values[name]
            own: Any = wp.empty(value.shape[::-1], dtype=self.dtype, device=self.device)
            kernel = kernels.transpose(node_functions(self.dtype))
            fill = lambda: wp.launch(kernel, own.shape, [value], [own], device=self.device)  # noqa: E731
            return Derived([broadcast_worlds(own, 1, self.worlds)], (name,), fill)

        return self.derived(name, build)[0]

    @property
    def gravity(self) -> wp.array | None:
        """[3, world], or None where it is zero and stays so."""
        if "gravity" not in self.variable and not self.scene.values["gravity"].any():
            return None
        return self.field("gravity")

    def value(self, name: str) -> wp.array:
        """Newton's numbers as they are kept [1 or worlds, ...], float64."""
        return self._values[name]

    def copy_in(self, name: str, value: wp.array) -> None:
        """Copy a variable value [world, ...] or [...] into place; launches only."""
        own = self._values[name]
        size = math.prod(own.shape[1:])
        if value.ndim == own.ndim:
            flat = value.reshape((self.worlds, size))
        else:
            flat = broadcast_worlds(value.reshape((1, size)), 0, self.worlds)
        wp.launch(
            kernels.widen(node_functions(self.dtype)),
            dim=(self.worlds, size),
            inputs=[flat],
            outputs=[own.reshape((self.worlds, size))],
            device=self.device,
        )

    def adopt_variable(self, other: Parameters) -> None:
        """Take over the variable values of ``other``."""
        for name in self.variable:
            wp.copy(self._values[name], other._values[name])
        self._version = other._version
        self.refresh(self.variable)

    def share(self, other: Parameters) -> None:
        """Have the values of ``other``, from here on the same memory, and follow its :meth:`refresh`."""
        self._values = other._values
        self._derived.clear()
        other._sharers.append(self)

    def refresh(self, names: Iterable[str]) -> None:
        """Derive anew what depends on the named values."""
        for sharer in self._sharers:
            sharer.refresh(names)
        self._captured |= bool(self.device.is_capturing)
        self._version += 1
        for found in self._derived.values():
            if any(name in found.of for name in names):
                found.fill()
