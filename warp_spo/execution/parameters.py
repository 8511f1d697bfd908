"""A scene's values on a device: Newton's values in float64, and arrays for kernels that are derived from them.

Values that all worlds share are stored once; kernels read them through a world axis of stride zero, as if every world
had its own. A ``variable`` value has one row a world, and launches alone refresh the arrays that depend on it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import warp as wp

from ..kernels import parameters as kernels
from ..kernels.height_field import list_corners
from ..kernels.spatial import POSE, RIGID
from ..kernels.topology import Topology
from ..recursions.contact.ground import CORNERS
from ..runtime import launches
from ..runtime.memory import broadcast_worlds, empty, size_in_bytes
from ..scene.actuators import ACTUATOR_VALUES
from ..scene.contact_values import CONTACT_VALUES
from ..scene.ground import GROUND_VALUES, HEIGHTS
from ..scene.scene import Scene
from .node.functions import node_functions
from .row_copies import as_rows, copy_rows

VARIABLE = (
    "body_mass",
    "body_com",
    "body_inertia",
    "body_gravcomp",
    "joint_armature",
    "joint_damping",
    "joint_stiffness",
    "joint_friction",
    "joint_target_ke",
    "joint_target_kd",
    "joint_limit_lower",
    "joint_limit_upper",
    "joint_limit_ke",
    "joint_limit_kd",
    "joint_effort_limit",
    "joint_velocity_limit",
    "joint_rest_q",
    "joint_X_p",
    "joint_X_c",
    "gravity",
    *ACTUATOR_VALUES,
    *CONTACT_VALUES,
    *GROUND_VALUES,
)
SHARED = (HEIGHTS,)
"""Values that all worlds share even where they are variable."""
RIGID_VALUES = ("body_mass", "body_com", "body_inertia", "joint_X_p", "joint_X_c")


class DerivedArrays(NamedTuple):
    """Arrays that are computed from some of a scene's values.

    Attributes:
        arrays: the arrays.
        sources: the names of the values.
        fill: computes the arrays, by launches alone.
        always: ``fill`` runs at every request, because a graph that was captured before the arrays existed may change
            the values without computing the arrays.
    """

    arrays: list[wp.array]
    sources: Sequence[str]
    fill: Callable[[], None]
    always: bool = False


class Parameters:
    """The values of ``scene`` for ``worlds`` worlds, and arrays derived from them, computed at the first request.

    Attributes:
        hinge_of: the hinge of each node [node].
    """

    def __init__(
        self, scene: Scene, topology: Topology, worlds: int, device: wp.Device, dtype: type, variable: tuple[str, ...]
    ):
        self.scene, self.worlds, self.device, self.dtype = scene, worlds, device, dtype
        self.variable = variable
        self._topology = topology
        self.hinge_of: Any = wp.array(scene.hinge_of, dtype=int, device=device)
        self._derived: dict[str, DerivedArrays] = {}
        self._captured = False
        self._version = 0
        self._sharers: list[Parameters] = []
        self._values: dict[str, wp.array] = {}
        for name, value in scene.values.items():
            own: Any = wp.array(value, dtype=wp.float64, device=device)
            if name in variable and name not in SHARED:
                shared, own = own, wp.empty((worlds, *value.shape[1:]), dtype=wp.float64, device=device)
                launches.copy(own, broadcast_worlds(shared, 0, worlds))
            self._values[name] = own

    @property
    def version(self) -> int | None:
        """A number that is equal as long as no value has changed; None if a captured graph may change values."""
        return None if self._captured else self._version

    @property
    def bytes_per_world(self) -> int:
        """Bytes of a world's own values, and of what has been derived from them."""
        own = [self._values[name] for name in self.variable if name not in SHARED]
        derived = (known.arrays for known in self._derived.values() if set(known.sources).isdisjoint(SHARED))
        own += [array for arrays in derived for array in arrays if 0 not in array.strides]  # else worlds share it
        return sum(map(size_in_bytes, own)) // self.worlds

    def derived_arrays(self, key: str, build: Callable[[], DerivedArrays]) -> list[wp.array]:
        """Return the derived arrays of this name; ``build()`` allocates them at the first request."""
        known = self._derived.get(key)
        if known is None:
            known = self._derived[key] = build()._replace(always=self._captured)
            known.fill()
        elif known.always:
            known.fill()
        return known.arrays

    def rows(self, names: Iterable[str]) -> int:
        """Return 1 if all worlds share these values, else the number of worlds."""
        return max((self._values[name].shape[0] for name in names), default=1)

    def entries(self, name: str, worlds: int) -> wp.array:
        """Return Newton's values of this name as [entry, world], float64, without a copy."""
        value = self._values[name]
        flat = value.reshape((value.shape[0], math.prod(value.shape[1:])))
        return broadcast_worlds(flat.transpose(), 1, worlds)

    def _bodies(self) -> list[wp.array]:
        """Return tree, anchor, com and rigid of :mod:`warp_spo.kernels.parameters`, [node, component, world]."""

        def build() -> DerivedArrays:
            scene, worlds = self.scene, self.rows(RIGID_VALUES)
            values = [broadcast_worlds(self._values[name], 0, worlds) for name in RIGID_VALUES]
            own: list[wp.array] = [
                empty((scene.body_count, components, worlds), self.dtype, self.device)
                for components in (POSE, POSE, 3, RIGID)
            ]
            inputs, dim = [self._topology, self.hinge_of, *values], (scene.body_count, worlds)
            kernel = kernels.derive(node_functions(self.dtype))
            fill = lambda: launches.launch(kernel, dim, inputs, own, device=self.device)  # noqa: E731
            return DerivedArrays([broadcast_worlds(array, 2, self.worlds) for array in own], RIGID_VALUES, fill)

        return self.derived_arrays("bodies", build)

    @property
    def tree(self) -> wp.array:
        """Pose of the hinge's parent anchor in the parent's node frame [node, 12, world]."""
        return self._bodies()[0]

    @property
    def anchor(self) -> wp.array:
        """Pose of the node frame in the body frame [node, 12, world]."""
        return self._bodies()[1]

    @property
    def com(self) -> wp.array:
        """CoM in the node frame [node, 3, world], [m]."""
        return self._bodies()[2]

    @property
    def rigid(self) -> wp.array:
        """Rigid inertia in the axes and about the origin of the node frame [node, 10, world]."""
        return self._bodies()[3]

    def field(self, name: str) -> wp.array:
        """Return the value of this name, rounded, with the world axis last: [dof, coordinate or component, world].

        Values of several entries for each actuator are flat.
        """

        def build() -> DerivedArrays:
            value = self._values[name]
            flat = value.reshape((value.shape[0], math.prod(value.shape[1:])))
            own: Any = empty(flat.shape[::-1], self.dtype, self.device)
            kernel = kernels.transpose(node_functions(self.dtype))
            fill = lambda: launches.launch(kernel, own.shape, [flat], [own], device=self.device)  # noqa: E731
            return DerivedArrays([broadcast_worlds(own, 1, self.worlds)], (name,), fill)

        return self.derived_arrays(name, build)[0]

    @property
    def ground_heights(self) -> wp.array:
        """Heights of all of the ground's fields in the dtype of kernels, row after row, field after field [height]."""

        def build() -> DerivedArrays:
            value = self._values[HEIGHTS]
            own: Any = wp.empty((value.size, 1), dtype=self.dtype, device=self.device)
            inputs, kernel = [value.reshape((1, value.size))], kernels.transpose(node_functions(self.dtype))
            fill = lambda: launches.launch(kernel, own.shape, inputs, [own], device=self.device)  # noqa: E731
            return DerivedArrays([own.reshape(value.size)], (HEIGHTS,), fill)

        return self.derived_arrays("heights of the ground", build)[0]

    @property
    def ground_cells(self) -> wp.array:
        """Table of the cells of a height field [height, 4], rounded, see :func:`recursions.contact.ground.by_cell`."""

        def build() -> DerivedArrays:
            value = self._values[HEIGHTS]
            own: Any = wp.empty((value.size, CORNERS), dtype=self.dtype, device=self.device)
            inputs: Any = [value.flatten(), *value.shape[-2:]]
            kernel = list_corners(self.dtype)
            fill = lambda: launches.launch(kernel, value.size, inputs, [own], device=self.device)  # noqa: E731
            return DerivedArrays([own], (HEIGHTS,), fill)

        return self.derived_arrays("cells of the ground", build)[0]

    @property
    def gravity(self) -> wp.array | None:
        """Gravity [3, world], [m/s^2]; None where it is zero and not variable."""
        if "gravity" not in self.variable and not self.scene.values["gravity"].any():
            return None
        return self.field("gravity")

    def value(self, name: str) -> wp.array:
        """Return Newton's value of this name [1 or worlds, ...], float64, without a copy."""
        return self._values[name]

    def set(self, values: Mapping[str, wp.array], chosen: wp.array | None = None) -> None:
        """Set variable values from arrays [world, ...] or [...] in one launch, and what depends on them.

        Values that all worlds share take a launch of their own.

        Args:
            values: by name, of the type of this object. chosen: the worlds whose values change [world]; None is all.
        """
        own = {name: self._values[name] for name, array in values.items() if array.size}
        for worlds, names in ((self.worlds, own.keys() - set(SHARED)), (1, own.keys() & set(SHARED))):
            sources = [as_rows(values[name], own[name].shape[1:]) for name in own if name in names]
            targets = [as_rows(array, array.shape[1:]) for name, array in own.items() if name in names]
            if sources:
                copy_rows(sources, targets, worlds, chosen)
        if own:
            self.refresh(values)

    def adopt_variable(self, other: Parameters) -> None:
        """Copy the variable values of ``other``."""
        for name in self.variable:
            launches.copy(self._values[name], other._values[name])
        self._version = other._version
        self.refresh(self.variable)

    def share(self, other: Parameters) -> None:
        """Use the memory of ``other``'s values from now on; :meth:`refresh` of ``other`` also refreshes this object."""
        self._values = other._values
        self._derived.clear()
        other._sharers.append(self)

    def refresh(self, names: Iterable[str]) -> None:
        """Compute again the arrays that depend on the named values, the transposed ones in one launch.

        That is not left to the next request: calls that were recorded, and graphs, read the arrays without one.
        """
        for sharer in self._sharers:
            sharer.refresh(names)
        self._captured |= bool(self.device.is_capturing)
        self._version += 1
        changed, fields = set(names), []
        for key, known in self._derived.items():
            if changed.isdisjoint(known.sources):
                continue
            if key in self._values:
                fields.append(key)
            else:
                known.fill()
        if fields:
            own = [self._derived[name].arrays[0] for name in fields]
            values = (self._values[name] for name in fields)
            copy_rows([as_rows(value, value.shape[1:]) for value in values], own, self.worlds, transposed=True)
