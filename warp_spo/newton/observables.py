"""Observables of SolverSPO's steps: results beside the state, such as accelerations and contact forces."""

from __future__ import annotations

import dataclasses
from typing import Any

import newton
import warp as wp
from newton.solvers import SolverBase

from ..dynamics.dynamics import Dynamics
from ..runtime.memory import view
from .layout import StateLayouts

OF_CONTACTS = frozenset({"contact_f", "contact_slip"})


@dataclasses.dataclass(eq=False)
class Observables(SolverBase.Observables):
    """Results of a step beside the state."""

    joint_qdd: Any = SolverBase.Observables.field(  # noqa: RUF009
        dtype=wp.float32, frequency=newton.Model.AttributeFrequency.JOINT_DOF
    )
    """(qd after - qd before) / dt [m/s^2, rad/s^2], shape (joint_dof_count,)."""
    status: Any = SolverBase.Observables.field(  # noqa: RUF009
        dtype=wp.int32, frequency=newton.Model.AttributeFrequency.WORLD
    )
    """A :class:`warp_spo.Status` for each world, 0 if the step can be trusted, shape (world_count,)."""
    contact_f: Any = SolverBase.Observables.field(  # noqa: RUF009
        dtype=wp.vec3, frequency=newton.Model.AttributeFrequency.WORLD
    )
    """Force of the ground on each contact point [N], then of the second body of each pair on the first one, world axes,
    shape (world_count, points + pairs), not Newton's by contact. They are ``solver.dynamics.scene.contact_points`` and
    ``contact_pairs``."""
    contact_slip: Any = SolverBase.Observables.field(  # noqa: RUF009
        dtype=wp.float32, frequency=newton.Model.AttributeFrequency.WORLD
    )
    """Speed of each contact point along the ground, and of the bodies of each pair along each other, after the step
    [m/s], shape (world_count, points + pairs)."""


class ObservableArrays:
    """Arrays of the observables of one solver. One kernel serves all steps with observables, whichever are asked for.

    Args:
        dynamics: The solver's dynamics.
        layouts: How Newton's state is laid out.
        substeps: Of a step.

    Attributes:
        status: A word for each world [world], for steps whose caller asks for none.
    """

    SUPPORTED = OF_CONTACTS | {
        "joint_qdd",
        "status",
        SolverBase.ObservableKind.BODY_QDD,
        SolverBase.ObservableKind.BODY_PARENT_F,
    }
    """Names of all observables that some solver has."""

    def __init__(self, dynamics: Dynamics, layouts: StateLayouts, substeps: int):
        self._dynamics, self._layouts, self._substeps = dynamics, layouts, substeps
        worlds, contacts = dynamics.worlds, dynamics.scene.contact_count
        self.status: Any = wp.zeros(worlds, dtype=wp.int32, device=dynamics.device)
        of_contacts: dict[str, tuple[tuple[int, ...], Any]] = {}
        if dynamics.scene.contacts:
            of_contacts = {"contact_f": ((worlds, contacts), wp.vec3), "contact_slip": ((worlds, contacts), wp.float32)}
        self._unasked = {
            name: wp.zeros(shape, dtype=dtype, device=dynamics.device) for name, (shape, dtype) in of_contacts.items()
        }

    @property
    def of_contacts(self) -> bool:
        """Whether steps have contacts."""
        return bool(self._unasked)

    @property
    def supported(self) -> frozenset[str]:
        """Names of the solver's observables, see :attr:`.solver.SolverSPO.supported_observables`."""
        found = self.SUPPORTED - (OF_CONTACTS - self._unasked.keys())
        if self._dynamics.closed or not self._dynamics.scene.dof_count or self.of_contacts:
            found = found - {SolverBase.ObservableKind.BODY_PARENT_F}
        if self._substeps > 1:
            found = found & {"status", *OF_CONTACTS}
        return frozenset(found)

    def allocate(self, observables: Any) -> None:
        """Give the observables of contacts that are asked for their arrays, whose shapes Newton does not know."""
        for name in self._unasked.keys() & observables.kinds:
            setattr(observables, name, wp.zeros_like(self._unasked[name]))

    def contact_arguments(self, observables: Any) -> dict[str, wp.array]:
        """Return the arrays that receive the observables of contacts, by the names of reports of ``Dynamics.step``."""
        given = {}
        for name, unasked in self._unasked.items():
            array = unasked if getattr(observables, name) is None else getattr(observables, name)
            shape = (*array.shape, 3) if name == "contact_f" else array.shape
            given[name] = view(array.ptr, shape, wp.float32, self._dynamics.device.alias)
        return given

    def write(self, observables: Any, q: wp.array, qd: wp.array, qdd: wp.array, body_f: Any) -> None:
        """Compute the observables that follow from the state before the step and its accelerations."""
        kinds, wrenches = SolverBase.ObservableKind, self._layouts.wrenches
        if observables.is_requested("joint_qdd"):
            self._layouts.qd.write(qdd, observables.joint_qdd)
        if observables.is_requested(kinds.BODY_QDD):
            out = wrenches.target(observables.body_qdd, "body_qdd")
            self._dynamics.body_accelerations(q, qd, qdd, out=out)
            wrenches.write(out, observables.body_qdd)
        if observables.is_requested(kinds.BODY_PARENT_F):
            out = wrenches.target(observables.body_parent_f, "body_parent_f")
            self._dynamics.body_reactions(q, qd, qdd, body_f, out=out)
            wrenches.write(out, observables.body_parent_f)
