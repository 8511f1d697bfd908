"""The arrays of a Newton model that SolverSPO uses, and which of them each flag of ``notify_model_changed`` names."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import newton
import numpy as np
import warp as wp
from newton import ModelFlags

from ..dynamics.dynamics import Dynamics
from ..dynamics.operation import DIFFERENTIABLE
from ..scene.parts import DOF_VALUES
from .contacts import VALUES, Materials
from .elevations import Elevations
from .layout import FlatLayout, StateLayouts, lay_out
from .model_contacts import TURNING_MATERIALS, turns
from .worlds import WorldRows, to_numpy

FORCE_VALUES = tuple(name for name in DOF_VALUES if name != "joint_armature")
FLAGS = {
    ModelFlags.BODY_INERTIAL_PROPERTIES: ("body_mass", "body_com", "body_inertia"),
    ModelFlags.JOINT_DOF_INERTIAL_PROPERTIES: ("joint_armature",),
    ModelFlags.JOINT_DOF_FORCE_PROPERTIES: (*FORCE_VALUES, "joint_target_mode"),
    ModelFlags.JOINT_REFERENCE_POSE_PROPERTIES: ("joint_rest_q",),
    ModelFlags.JOINT_DOF_PROPERTIES: (*DOF_VALUES, "joint_target_mode", "joint_rest_q"),
    ModelFlags.JOINT_PROPERTIES: ("joint_X_p", "joint_X_c", "joint_axis"),
    ModelFlags.CONSTRAINT_PROPERTIES: ("joint_mimic_coeffs",),
    ModelFlags.MODEL_PROPERTIES: ("gravity",),
}
"""Arrays of the model that each flag names. A step depends on no array that another flag would name, but for shapes."""
WATCHED = tuple(dict.fromkeys(name for names in FLAGS.values() for name in names))
SHAPES = (*VALUES, *(f"shape_{name}" for name in ("transform", "scale", "margin", "flags", "collision_group")))
"""Arrays of shapes, on which steps of a solver depend that computes contacts."""
TURNING = tuple(f"shape_material_{name}" for name, _ in TURNING_MATERIALS.values())
"""The same where shapes have torsional or rolling friction."""


class ModelArrays:
    """Copies of the model's arrays as the solver uses them, so that changes of the model can be found.

    Args:
        model: The Newton model.
        worlds: The rows of its worlds.
        state: How its state is laid out.
        factors: 1 or 0 for each dof [dof], for the gains that count only in some modes of a drive.
        sources: Functions that turn arrays of the model into values of the contacts that the solver computes, by
            name; {} if it computes none.

    Attributes:
        used: The copies by name.
        flags: The arrays of the model that each flag names, as far as a step depends on them.
        stamp: A number that changes when copies are renewed.
    """

    def __init__(
        self,
        model: newton.Model,
        worlds: WorldRows,
        state: StateLayouts,
        factors: Mapping[str, wp.array],
        sources: Mapping[str, Materials | Elevations],
    ):
        self.model, self._factors, self._sources = model, factors, sources
        self._layouts = _layouts_of_values(model, worlds, state)
        shapes = (*SHAPES, *TURNING) if turns(model) else SHAPES
        shape_flags = {ModelFlags.SHAPE_PROPERTIES: shapes}
        self.flags: Mapping[ModelFlags, Sequence[str]] = {**FLAGS, **shape_flags} if sources else FLAGS
        watched = (*WATCHED, *shapes) if sources else WATCHED
        self.used = {name: wp.clone(getattr(model, name)) for name in watched}
        self.stamp = 0

    def copy(self, names: Iterable[str]) -> None:
        """Copy arrays of the model; launches only."""
        self.stamp += 1
        for name in names:
            wp.copy(self.used[name], getattr(self.model, name))

    def set(self, dynamics: Dynamics, names: Iterable[str]) -> None:
        """Set the values of ``dynamics`` to the copies of arrays of these names; launches only."""
        for name in names:
            if name in VALUES:
                dynamics.set(**{VALUES[name]: self._sources[name].read(self.used[name])})
                continue
            layout = self._layouts[name]
            value = layout.read(self.used[name], name)
            if name in self._factors:
                value = layout.scale(value, self._factors[name], "driven")
            dynamics.set(**{name: value})

    def has_source(self, name: str) -> bool:
        """Return whether a value of the scene comes from an array of the model."""
        return name not in VALUES.values() or self.source(name) in self._sources

    def source(self, name: str) -> str:
        """Return the name of the model's array that a value of the scene comes from."""
        return next((array for array, value in VALUES.items() if value == name), name)

    def differentiable(self) -> list[str]:
        """Return the names of the model's arrays that have gradients where they are variable."""
        joints = [name for name in self._layouts if name in DIFFERENTIABLE]
        return [*joints, *(VALUES if self._sources else ())]

    def gradient(self, name: str) -> wp.array:
        """Return an array [world, ...] for the gradient by a value, see :meth:`add`."""
        if name in VALUES.values():
            return self._sources[self.source(name)].gradient(name)
        return self._layouts[name].buffer(f"{name} gradient")

    def add(self, name: str, gradient: wp.array, flat: wp.array) -> None:
        """Add a gradient by a value of the scene [world, ...] to ``flat``, the gradient by the model's array."""
        if name in VALUES.values():
            self._sources[self.source(name)].add(gradient, flat)
            return
        layout = self._layouts[name]
        if name in self._factors:
            gradient = layout.scale(gradient, self._factors[name], "driven gradient")
        layout.add(gradient, flat)

    def differences(self, names: Iterable[str]) -> dict[str, str]:
        """Return by name a sentence about the first entry in which the model differs from its copy; reads back."""
        found = {name: self._difference(name) for name in names}
        return {name: difference for name, difference in found.items() if difference}

    def _difference(self, name: str) -> str:
        used, now = self.used[name].numpy(), getattr(self.model, name).numpy()
        differs = used != now
        if used.dtype.kind == "f":
            differs &= ~(np.isnan(used) & np.isnan(now))
        places = np.argwhere(differs)
        if not len(places):
            return ""
        at = tuple(places[0].tolist())
        return f"is {now[at]} at {list(at)} where the solver uses {used[at]}"

    def names_of_flags(self, flags: int) -> list[str]:
        """Return the names of the arrays that ``flags`` name."""
        return list(dict.fromkeys(name for flag, names in self.flags.items() if flags & int(flag) for name in names))

    def flag_of_name(self, name: str) -> ModelFlags:
        """Return the first flag that names an array."""
        return next(flag for flag, names in self.flags.items() if name in names)

    def check_flags_in_capture(self, flags: int, variable: Sequence[str]) -> None:
        """Raise ValueError if a flag names only arrays that are not variable: a capture cannot rebuild the solver."""
        for flag, names in self.flags.items():
            if flags & int(flag) and not set(names) & set(variable):
                raise ValueError(
                    f"SolverSPO.notify_model_changed: {flag.name} inside a graph capture; expected flags of "
                    f"variable arrays; build the solver with variable=({', '.join(map(repr, names))})"
                )


def _layouts_of_values(model: newton.Model, worlds: WorldRows, state: StateLayouts) -> dict[str, FlatLayout]:
    """Return how the model's array is laid out, for each name that Dynamics may have as a variable value."""
    vectors = len(to_numpy(model, "gravity"))  # one for each world, or a last one for a model without worlds
    gravity = np.arange(worlds.count) if worlds.declared else np.full(worlds.count, vectors - 1)
    return {
        **{name: state.qd for name in DOF_VALUES},
        "joint_rest_q": state.q,
        "joint_X_p": state.anchors,
        "joint_X_c": state.anchors,
        "body_mass": lay_out(model, "body_mass", worlds.bodies),
        "body_com": lay_out(model, "body_com", worlds.bodies, (3,)),
        "body_inertia": lay_out(model, "body_inertia", worlds.bodies, (3, 3)),
        "gravity": FlatLayout(gravity[:, None], (3,), model.device, model.gravity),
    }
