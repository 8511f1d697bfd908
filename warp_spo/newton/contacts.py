"""Contacts in SolverSPO: which of a model's it computes, and status words of worlds with others."""

from __future__ import annotations

import warnings
from typing import Any

import newton
import numpy as np
import warp as wp
from newton import ShapeFlags

from ..errors import UnsupportedError
from ..kernels import declare
from ..kernels import newton_contacts as kernels
from ..scene.collision_shapes import GROUND, ShapeSelection, moving_bodies
from ..scene.ground import HEIGHTS
from ..scene.scene import Scene
from ..status import Status
from .elevations import Elevations
from .model_contacts import CONTACT_MATERIALS, ModelContacts, model_contacts, turns
from .pairs import ModelPairs, refuse_still
from .slots import ContactSlots
from .worlds import WorldRows, to_numpy

MODES = ("auto", "ground", "pipeline", "none")
ELEVATIONS = "heightfield_elevations"
VALUES = {f"shape_material_{material}": name for name, material in CONTACT_MATERIALS.items()} | {ELEVATIONS: HEIGHTS}
"""Values of a scene by the model's array that they come from."""


def find_contacts(
    model: newton.Model,
    worlds: WorldRows,
    scene: Scene,
    pairs: ModelPairs | None,
    mode: str,
    points: int,
    lacking: str,
    apart: bool,
) -> ModelContacts | ContactSlots | None:
    """Return the contacts of a model's shapes with its ground, or slots for a list of contacts, None for neither.

    Args:
        pairs: of bodies that touch each other, None without.
        mode: "none" for neither; "ground" or "pipeline" for one of them, or an error; "auto" for the ground if that
            leaves no shape out that stands still, and no kind of shape; else for slots, if a shape stands still.
        points: of a hull at most, or slots of a shape. lacking: why the solver's steps have no contacts, "" if they do.
        apart: each height field is one of its own, see :func:`.model_contacts.model_contacts`.

    Raises:
        UnsupportedError: with "ground", the model has no ground, or shapes that no contact represents; with "ground" or
            "pipeline", the worlds have different shapes, or steps have no contacts.
    """
    if mode == "none":
        return None
    if mode == "auto" and lacking:
        warn_of_contacts_left_out(model, f"steps with {lacking} have no contacts")
        return None
    if lacking:
        raise UnsupportedError("SolverSPO", f"contacts={mode!r} with {lacking}", "leave out one of them")
    if mode == "pipeline":
        if pairs is not None and pairs.still:
            refuse_still(model, worlds, scene, frozenset(), "contacts='pipeline'")
        return ContactSlots(model, worlds, scene, points, pairs)
    named = frozenset() if pairs is None else pairs.still
    found = _on_ground(model, worlds, scene, mode, points, apart, named)
    if found is not None or mode == "ground" or not model.shape_count:
        return found
    if named:
        refuse_still(model, worlds, scene, named, "shapes in no pair")
        return None
    try:
        return ContactSlots(model, worlds, scene, points, pairs)
    except UnsupportedError as error:
        warn_of_contacts_left_out(model, str(error))
        return None


def warn_of_turning_left_out(
    model: newton.Model, touching: ModelContacts | ContactSlots | None, pairs: ModelPairs | None
) -> None:
    """Warn if a model has torsional or rolling friction that contacts of a list, or pairs of bodies, do not have."""
    both = ("contacts of a list", isinstance(touching, ContactSlots)), ("pairs of bodies", pairs is not None)
    kinds = [words for words, there in both if there]
    if kinds and turns(model):
        warnings.warn(
            f"SolverSPO: {' and '.join(kinds)} have no torsional and no rolling friction, which shapes of the model "
            "ask for by a condim of 4 or 6; contacts with the ground have both where contacts='ground' takes them",
            UserWarning,
            stacklevel=3,
        )


def warn_of_contacts_left_out(model: newton.Model, why: str, depth: int = 6) -> None:
    """Warn that bodies pass through shapes that stand still, if the model has shapes of both kinds that collide."""
    if not model.shape_count:
        return
    flags, groups, bodies = (to_numpy(model, f"shape_{name}") for name in ("flags", "collision_group", "body"))
    solid = (flags & int(ShapeFlags.COLLIDE_SHAPES) != 0) & (groups != 0)
    if (solid & (bodies < 0)).any() and (solid & (bodies >= 0)).any():
        warnings.warn(
            f"SolverSPO: bodies pass through shapes that stand still, such as the ground: {why}; contacts='none' says "
            "that they may",
            UserWarning,
            stacklevel=depth,
        )


def _on_ground(
    model: newton.Model,
    worlds: WorldRows,
    scene: Scene,
    mode: str,
    points: int,
    apart: bool,
    named: frozenset[int],
) -> ModelContacts | None:
    """Return the contacts of a model's shapes with its ground, None if it has none that fit.

    ``named``: indices of shapes that stand still and that pairs have.
    """
    try:
        made = model_contacts(model, worlds, scene, ShapeSelection(GROUND, None, points), apart, named)
    except UnsupportedError:
        if mode == "ground":
            raise
        return None
    problem = f"left out: {', '.join(made.selected.left_out)}" if made.selected.left_out else ""
    if made.selected.ground_shape is None:
        problem = "a model whose ground is no level plane and no height field"
    if problem and mode == "ground":
        raise UnsupportedError("SolverSPO", f"contacts='ground': {problem}", "remove them, or pass contacts='none'")
    return None if problem or not made.scene.contacts else made


class Materials:
    """Materials of contacts: the means of those of their shapes and of the ground, or of both shapes of a pair.

    Args:
        made: the contacts of the model with its ground, None without. pairs: of bodies, None without.
        worlds: how many. device: of the model.
    """

    _rows: Any = None

    def __init__(self, made: ModelContacts | None, pairs: ModelPairs | None, worlds: int, device: wp.Device):
        self._pairs = pairs
        self._gradients: dict[str, wp.array] = {}
        count = 0 if pairs is None else pairs.count
        if made is not None:
            self._read_points(made, device)
            count += self._rows.shape[1]
        self._mean: Any = wp.empty((worlds, count), dtype=wp.float32, device=device)

    def _read_points(self, made: ModelContacts, device: wp.Device) -> None:
        """Read the shapes of all points, and which points each shape has."""
        rows, ground_rows = made.point_rows, made.ground_rows
        assert ground_rows is not None
        self._rows = wp.array(rows, dtype=wp.int32, device=device)
        self._ground_rows: Any = wp.array(ground_rows, dtype=wp.int32, device=device)
        touched = np.concatenate([rows.ravel(), np.repeat(ground_rows, rows.shape[1])])
        point = np.tile(np.arange(rows.size), 2)[np.argsort(touched, kind="stable")]
        shapes, counts = np.unique(touched, return_counts=True)
        lists = (shapes, np.append(0, np.cumsum(counts)), point)
        self._lists: list = [wp.array(x.astype(np.int32), dtype=wp.int32, device=device) for x in lists]

    def gradient(self, name: str) -> wp.array:
        """Return a buffer for the gradient by the means of a material [world, point], see :meth:`add`.

        Steps with pairs have no gradients.
        """
        if name not in self._gradients:
            self._gradients[name] = wp.empty_like(self._mean)
        return self._gradients[name]

    def add(self, gradient: wp.array, flat: wp.array) -> None:
        """Add a gradient by means to ``flat``, the gradient by the material of each shape."""
        shapes, first, points = self._lists
        inputs = [shapes, first, points, gradient.flatten()]
        wp.launch(kernels.add_to_shapes(), len(shapes), inputs, [flat], device=flat.device)

    def read(self, flat: wp.array) -> wp.array:
        """Return the means of a material [world, contact], in a buffer that the next call overwrites."""
        if self._rows is not None:
            inputs, device = [self._rows, self._ground_rows, flat], self._mean.device
            wp.launch(kernels.mean_materials(), self._rows.shape, inputs, [self._mean], device=device)
        if self._pairs is not None:
            self._pairs.mean(flat, self._mean)
        return self._mean


def sources_of(
    model: newton.Model,
    worlds: WorldRows,
    made: ModelContacts | ContactSlots | None,
    pairs: ModelPairs | None,
    heights: bool,
) -> dict[str, Materials | Elevations]:
    """Return what turns arrays of the model into values of contacts, by the names of VALUES; {} without contacts.

    Slots read materials themselves. ``heights``: elevations, too, if a height field is the ground.
    """
    if isinstance(made, ContactSlots) or (made is None and pairs is None):
        return {}
    materials = Materials(made, pairs, worlds.count, model.device)
    found: dict[str, Materials | Elevations] = dict.fromkeys((name for name in VALUES if name != ELEVATIONS), materials)
    rows = made.field_rows if heights and made is not None else None
    if made is None or rows is None:
        return found
    return found | {ELEVATIONS: Elevations(model, rows, made.scene.values[HEIGHTS].shape[1:])}


class StatusWords:
    """The most severe status of each world since its last reset.

    Args:
        model: The Newton model.
        worlds: The rows of its worlds.
        made: The contacts with the ground that the solver computes, None if it computes none.
        pairs: Of bodies that touch each other, None without.

    Attributes:
        kept: int32 [world].
        severity: of each status, int32. role: of each shape, int32, see :mod:`warp_spo.kernels.newton_contacts`.
    """

    def __init__(
        self,
        model: newton.Model,
        worlds: WorldRows,
        made: ModelContacts | ContactSlots | None,
        pairs: ModelPairs | None,
    ):
        self._model, self._device, self._made = model, model.device, made
        partners = None if pairs is None else pairs.partners()
        self._partner: Any = None if partners is None else wp.array(partners, dtype=wp.int32, device=self._device)
        self._computes = made is not None or pairs is not None
        severity = [Status(number).severity for number in range(len(Status))]
        self.severity: Any = wp.array(np.array(severity), dtype=wp.int32, device=self._device)
        self.role: Any = wp.array(_roles(model, worlds, made), dtype=wp.int32, device=self._device)
        self.kept: Any = wp.zeros(worlds.count, dtype=wp.int32, device=self._device)
        declare(kernels, None)

    def find(self, contacts: Any) -> newton.Contacts | None:
        """Return contacts of which only the device can know how many there are, and whether the solver takes them.

        A solver that computes none reads their number back, except in a graph capture.

        Raises:
            TypeError: They are no contacts.
            UnsupportedError: There are some, outside of a capture, and the solver computes none.
        """
        if contacts is not None and not hasattr(contacts, "rigid_contact_max"):
            raise TypeError(
                f"SolverSPO.step: contacts is of type {type(contacts).__name__}; expected newton.Contacts or None"
            )
        if contacts is None or not contacts.rigid_contact_max:
            return None  # soft contacts are those of particles, which the solver refuses
        if self._device.is_capturing or self._computes:
            return contacts
        count = int(contacts.rigid_contact_count.numpy()[0])
        if count:
            raise UnsupportedError(
                "SolverSPO.step",
                f"{count} contacts",
                "pass contacts=None; bodies then pass through each other; SolverSPO(model, contacts='ground') says why "
                "it computes none, and pairs= says which bodies touch each other",
            )
        return None

    def mark(self, contacts: newton.Contacts, status: wp.array, body_q: wp.array | None) -> None:
        """Set the words of worlds with contacts that the solver leaves out, by launches alone.

        They are UNSUPPORTED, and SLOTS where there are more of them than slots. If the solver computes contacts, those
        that are open at the poses ``body_q`` do not count.
        """
        slots = self._made if isinstance(self._made, ContactSlots) else None
        inputs = [contacts.rigid_contact_count, contacts.rigid_contact_shape0, contacts.rigid_contact_shape1]
        inputs += [self._model.shape_world, self.role, self._model.shape_body, self._partner]
        inputs.append(body_q if self._computes else None)
        names = ("point0", "point1", "margin0", "margin1", "normal", "surface_velocity")
        inputs += [getattr(contacts, f"rigid_contact_{name}") for name in names]
        inputs += [0 if slots else 1, self.severity]
        wp.launch(kernels.mark_contacts(), contacts.rigid_contact_max, inputs, [status], device=self._device)
        if slots is not None:
            slots.mark(self.severity, status)

    def keep(self, status: wp.array) -> None:
        """Keep the words of a step where they are more severe than those of steps before."""
        inputs = [status, self.severity]
        wp.launch(kernels.keep_most_severe(), len(self.kept), inputs, [self.kept], device=self._device)

    def clear(self, mask: wp.array | None) -> None:
        """Forget the words of the worlds in ``mask``, or of all."""
        wp.launch(kernels.clear(), len(self.kept), [mask], [self.kept], device=self._device)


def _roles(model: newton.Model, worlds: WorldRows, made: ModelContacts | ContactSlots | None) -> np.ndarray:
    """Return what each shape is: STILL, GROUND, TOUCHING (its contacts with the ground are computed) or MOVING."""
    bodies = to_numpy(model, "shape_body") if model.shape_count else np.zeros(0, dtype=int)
    if made is None:
        return np.where(bodies >= 0, kernels.MOVING, kernels.STILL)
    moving = np.append(moving_bodies(made.scene), False)  # the last entry is the inertial frame's
    roles = np.where(moving[np.where(bodies >= 0, worlds.body_slot[bodies], -1)], kernels.MOVING, kernels.STILL)
    if isinstance(made, ContactSlots):
        roles[roles == kernels.STILL] = kernels.GROUND
        roles[made.shape_rows.ravel()] = kernels.TOUCHING
        return roles
    roles[made.point_rows.ravel()] = kernels.TOUCHING
    roles[made.ground_rows] = kernels.GROUND
    return roles
