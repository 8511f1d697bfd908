"""Contacts in calls of SolverSPO, which computes none: an error, or inside a graph capture a status word a world."""

from __future__ import annotations

from typing import Any

import newton
import numpy as np
import warp as wp

from ..errors import UnsupportedError
from ..kernels import contacts as kernels
from ..kernels import declare
from ..status import Status


class StatusWords:
    """The most severe status of each world since its last reset.

    Args:
        model: The Newton model.
        worlds: The number of worlds.

    Attributes:
        kept: int32 [world].
    """

    def __init__(self, model: newton.Model, worlds: int):
        self._model, self._device = model, model.device
        severity = [Status(number).severity for number in range(len(Status))]
        self._severity: Any = wp.array(np.array(severity), dtype=wp.int32, device=self._device)
        self.kept: Any = wp.zeros(worlds, dtype=wp.int32, device=self._device)
        declare(kernels, None)

    def find(self, contacts: Any) -> newton.Contacts | None:
        """Return contacts whose number only the device can know, because a graph capture cannot read it.

        Raises:
            TypeError: They are no contacts.
            UnsupportedError: There are some, outside of a capture.
        """
        if contacts is not None and not hasattr(contacts, "rigid_contact_max"):
            raise TypeError(
                f"SolverSPO.step: contacts is of type {type(contacts).__name__}; expected newton.Contacts or None"
            )
        if contacts is None or not contacts.rigid_contact_max:
            return None  # soft contacts are those of particles, which the solver refuses
        if self._device.is_capturing:
            return contacts
        count = int(contacts.rigid_contact_count.numpy()[0])
        if count:
            raise UnsupportedError(
                "SolverSPO.step", f"{count} contacts", "pass contacts=None; bodies then pass through each other"
            )
        return None

    def mark(self, contacts: newton.Contacts, status: wp.array) -> None:
        """Set the words of worlds with contacts to UNSUPPORTED, by launches alone."""
        model = self._model
        inputs = [contacts.rigid_contact_count, contacts.rigid_contact_shape0, contacts.rigid_contact_shape1]
        inputs += [model.shape_world, model.shape_body, self._severity]
        wp.launch(kernels.mark_contacts(), contacts.rigid_contact_max, inputs, [status], device=self._device)

    def keep(self, status: wp.array) -> None:
        """Keep the words of a step where they are more severe than those of steps before."""
        inputs = [status, self._severity]
        wp.launch(kernels.keep_most_severe(), len(self.kept), inputs, [self.kept], device=self._device)

    def clear(self, mask: wp.array | None) -> None:
        """Forget the words of the worlds in ``mask``, or of all."""
        wp.launch(kernels.clear(), len(self.kept), [mask], [self.kept], device=self._device)
