"""Contacts of ``newton.CollisionPipeline`` in SolverSPO: the slots of a scene's contact points that they fill."""

from __future__ import annotations

from typing import Any

import newton
import numpy as np
import warp as wp

from ..dynamics.dynamics import Dynamics
from ..errors import UnsupportedError
from ..kernels import declare
from ..kernels import newton_contact_slots as kernels
from ..scene.collision_shapes import moving_bodies
from ..scene.contact_shapes import SHAPES
from ..scene.contacts import Contact
from ..scene.ground import PLACE, Listed
from ..scene.scene import Scene
from ..status import Status
from .model_contacts import ModelShapes
from .pairs import ModelPairs
from .worlds import WorldRows

SWEPT_SLOTS = 4
"""Slots at most of spheres and capsules, which touch in few points."""
SLOT_VALUES = ("contact_place", "contact_friction", "contact_stiffness", "contact_damping")
"""Values of the scene that the contacts of a step are."""


class ContactSlots:
    """Points of shapes that move, so many for each, whose places and materials a list of contacts gives at every step.

    Args:
        model, worlds: The Newton model and its rows.
        scene: Of the model, without contacts.
        points: Slots of a shape; spheres and capsules have four at most.
        pairs: Of bodies that touch each other, whose materials come after those of slots; None without.

    Attributes:
        scene: With a contact for each slot.
        shape_rows: Index of the shape of each slot [world, slot].

    Raises:
        UnsupportedError: The worlds have different shapes, or no shape moves, or none stands still.
    """

    def __init__(
        self, model: newton.Model, worlds: WorldRows, scene: Scene, points: int, pairs: ModelPairs | None = None
    ):
        self._model, self._device, self._pairs = model, model.device, pairs
        shapes, moving = ModelShapes(model, worlds), moving_bodies(scene)
        contacts: list[Contact] = []
        columns: list[int] = []
        counts: list[int] = []
        for column, shape in enumerate(shapes.first()[: shapes.rows.shape[1]]):
            if shape.body < 0 or not moving[shape.body]:
                continue
            few = shape.kind in SHAPES and SHAPES[shape.kind].swept
            count = min(points, SWEPT_SLOTS) if few else points
            contacts += [Contact(shape.body, point=shape.pose[:3], label=shape.label)] * count
            columns, counts = [*columns, column], [*counts, count]
        still = [shape for shape in shapes.first() if shape.body < 0 or not moving[shape.body]]
        if not contacts or not still:
            what = "stand still" if contacts else "move"
            raise UnsupportedError(
                "SolverSPO", f"contacts of a model without shapes that {what}", "pass contacts='none'"
            )
        self.scene = scene.with_contacts(contacts, Listed())  # type: ignore[arg-type]
        self.shape_rows = np.repeat(shapes.rows[:, columns], counts, axis=1)
        table = np.zeros((model.shape_count, 3), dtype=np.int32)  # world, first slot and slots of each shape
        for column, first, count in zip(columns, np.cumsum([0, *counts]), counts, strict=False):
            rows = shapes.rows[:, column]
            table[rows, 0], table[rows, 1], table[rows, 2] = np.arange(worlds.count), first, count
        size, device = self.shape_rows.shape, self._device
        self._table: Any = wp.array(table, dtype=wp.int32, device=device)
        self._shape: Any = wp.array(self.shape_rows, dtype=wp.int32, device=device)
        self._slot: Any = wp.zeros(size, dtype=wp.int32, device=device)
        self._excess: Any = wp.zeros(worlds.count, dtype=wp.int32, device=device)
        self._place: Any = wp.zeros((*size, PLACE), dtype=wp.float32, device=device)
        wide = size[0], size[1] + (0 if pairs is None else pairs.count)
        self._materials: list[Any] = [wp.zeros(wide, dtype=wp.float32, device=device) for _ in SLOT_VALUES[1:]]
        self._none = newton.Contacts(1, 0, device=device)
        declare(kernels, None)

    def fill(self, contacts: newton.Contacts | None, body_q: Any, role: wp.array, dynamics: Dynamics) -> None:
        """Set the contact values of ``dynamics`` from a list of contacts at the poses ``body_q``, by launches alone."""
        model, device = self._model, self._device
        self._listed = listed = contacts if contacts is not None and contacts.rigid_contact_max else self._none
        self._slot.fill_(int(kernels.EMPTY))
        self._excess.zero_()
        inputs = [
            listed.rigid_contact_count,
            listed.rigid_contact_shape0,
            listed.rigid_contact_shape1,
            role,
            self._table,
        ]
        results = [self._slot, self._excess]
        wp.launch(kernels.fill_slots(), listed.rigid_contact_max, inputs, results, device=device)
        inputs = [self._slot, self._shape, model.shape_body, body_q]
        names = ("shape0", "shape1", "point0", "point1", "margin0", "margin1", "normal")
        inputs += [getattr(listed, f"rigid_contact_{name}") for name in names]
        inputs += [getattr(listed, f"rigid_contact_{name}") for name in ("stiffness", "damping", "friction")]
        inputs += [getattr(model, f"shape_material_{name}") for name in ("ke", "kd", "mu")]
        stiffness, damping, friction = self._materials
        results = [self._place, stiffness, damping, friction]
        wp.launch(kernels.place_points(), self._slot.shape, inputs, results, device=device)
        if self._pairs is not None:
            for name, material in zip(("ke", "kd", "mu"), self._materials, strict=True):
                self._pairs.mean(getattr(model, f"shape_material_{name}"), material)
        place = self._place.reshape((len(self._slot), -1))
        dynamics.set(
            contact_place=place, contact_friction=friction, contact_stiffness=stiffness, contact_damping=damping
        )

    def mark(self, severity: wp.array, status: wp.array) -> None:
        """Set the words of worlds to SLOTS whose contacts exceeded the slots of a shape at the last :meth:`fill`."""
        listed = self._listed
        inputs = [self._excess, listed.rigid_contact_count, listed.rigid_contact_max, int(Status.SLOTS), severity]
        wp.launch(kernels.mark_worlds(), len(self._excess), inputs, [status], device=self._device)
