"""The options of ``Dynamics.step``, and its report: the arrays that a step fills for its caller.

Both are bundles of arguments of the operation, see :class:`..operation.Bundle`: a call passes their members on by name.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

from ..operation import Argument, Bundle
from . import contact_options, integrators

REPORTS = (
    Argument("qdd", "world, dof", optional=True, asked=True, written=True),
    *(Argument(name, axes, optional=True, asked=True, written=True) for name, axes in integrators.BODIES.items()),
    *contact_options.ARGUMENTS,
)
"""The arrays of a report."""
NAMES = tuple(one.name for one in REPORTS)


@dataclasses.dataclass(frozen=True)
class StepOptions:
    """How :meth:`Dynamics.step` computes a step, the same in all worlds. Objects with equal options are equal.

    Args:
        integrator: "semi_implicit": order 1. "midpoint": implicit midpoint, order 2; the forces of hinges are implicit,
            and the velocity terms take six fixed-point iterations, which diverge where a link turns by much of a radian
            in a step. "rk4": order 4, all explicit: stable only while (damping dt + stiffness dt^2) / inertia stays
            below 2, and only for scenes without friction and velocity limits. Scenes with contacts, ``status=``, the
            report "qdd" and gradients need "semi_implicit".
        substeps: how many steps of ``dt`` to take, with the same forces, targets and controls: to the bit what as many
            calls compute, each on the state that the one before returned. The time that passes is substeps dt. One
            launch takes up to 1024 of them, and holds the state meanwhile; their number is no constant of the kernel.
            Other integrators, loops="multipliers", pairs of bodies that touch, passes=4 and delays of actuators take
            launches for each substep, see :meth:`Dynamics.explain`. Delays count substeps. With a tensor that requires
            grad, every substep is recorded.
        passes: of a scene with contacts, see :doc:`/contacts`; None: 3, or 4 where bodies touch each other. One is
            stable and coarse. From 4 on, where no bodies touch each other, energy hardly ever rises; that is three
            times the work of three.
        rounds: how often a "semi_implicit" step is repeated with velocity terms at its middle, see :doc:`/contacts`.
            0: never; these terms are those at the start of the step. 1: robots that tumble keep their energy; about
            twice the work. None: with contacts 2 from 4 passes on, else 0; 0 where bodies touch each other, too. Where
            bodies touch each other or loops are closed there is no other; without contacts such a step has no
            gradients.
    """

    integrator: str = "semi_implicit"
    substeps: int = 1
    passes: int | None = None
    rounds: int | None = None


class StepReport(Mapping[str, Any]):
    """Arrays that :meth:`Dynamics.step` fills, by name: ``report.contact_f`` and ``report["contact_f"]``.

    :meth:`Dynamics.step_report` makes the arrays. ``StepReport(contact_f=array)`` takes arrays of one's own, of any
    kind that calls take. Steps may share a report: each overwrites what the one before has written.

    Args:
        arrays: arrays by name; None leaves a name out. With substeps all but ``contact_f`` are of the last substep.

            * ``qdd``: (qd' - qd) / dt [world, dof], before it is rounded into qd' and before the projection onto the
              closures. Of the semi-implicit step; of a free joint on a body that moves, at the parent's axes of its
              start.
            * ``poses``, ``velocities``: :meth:`Dynamics.body_poses` [world, body, 7] and
              :meth:`Dynamics.body_velocities` [world, body, 6] of the state after the step. With a warp for each of a
              quadruped's limbs, see :meth:`Dynamics.explain`, one kernel does both.
            * ``contact_f``: force of the ground on each contact point [world, contact, 3] [N], inertial axes, the mean
              over substeps. The points are ``scene.contact_points``; after them, for each of ``scene.contact_pairs``,
              comes the force of the other body on the first one.
            * ``contact_gap``: distance of each point from the ground [world, contact] [m], negative inside, at the q
              that the step starts from; of a pair at its deepest point, infinite where no faces meet, and in joint
              space where the two are not near each other.
            * ``contact_slip``: speed of each point along the ground after the step [world, contact] [m/s]; of a pair
              that of its deepest point along the other body.
            * ``contact_excess``: what the last pass leaves [world, 3]: the largest friction force beyond its cone and
              the largest pull of a contact [N], and the largest force of a drive beyond its effort limit [N m or N].
            * ``contact_moment``: of a scene with torsional or rolling friction, its moment on the body of each contact
              point [world, contact, 3] [N m], inertial axes; zero for pairs.

    Raises:
        ValueError: there is no such report.
    """

    def __init__(self, **arrays: Any):
        check_names("StepReport", tuple(arrays))
        self._arrays = {name: array for name, array in arrays.items() if array is not None}

    def __getitem__(self, name: str) -> Any:
        return self._arrays[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._arrays)

    def __len__(self) -> int:
        return len(self._arrays)

    def __getattr__(self, name: str) -> Any:
        arrays = vars(self).get("_arrays", {})  # {}: while it is unpickled
        if name in arrays:
            return arrays[name]
        known = ", ".join(arrays) or "nothing"
        raise AttributeError(f"StepReport has no {name!r}; it has {known}; ask for dyn.step_report({name!r})")

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self._arrays]

    def __repr__(self) -> str:
        return f"StepReport({', '.join(self)})"

    __eq__ = object.__eq__  # arrays do not compare to one bool
    __hash__ = object.__hash__

    def by_name(self) -> dict[str, Any]:
        """Return the arrays by name."""
        return self._arrays


def check_names(call: str, names: tuple[str, ...]) -> None:
    """Raise ValueError unless all names are of reports."""
    for name in names:
        if name not in NAMES:
            raise ValueError(f"{call}: there is no report {name!r}; expected some of {', '.join(NAMES)}")


_DEFAULTS = vars(StepOptions())


def _expand_options(call: str, options: Any) -> dict[str, Any]:
    """Return the options that differ from their defaults."""
    if not isinstance(options, StepOptions):
        raise TypeError(f"{call}: options is {options!r}; expected a StepOptions, such as StepOptions(substeps=4)")
    found = {}
    for name, default in _DEFAULTS.items():
        value = getattr(options, name)
        if value is not default and (type(value) is not type(default) or value != default):
            found[name] = value
    return found


def _expand_report(call: str, report: Any) -> dict[str, Any]:
    """Return the arrays of a report."""
    if isinstance(report, StepReport):
        return report.by_name()
    if report is None:
        return {}
    raise TypeError(
        f"{call}: report is of type {type(report).__name__}; expected a StepReport, such as "
        f"dyn.step_report('contact_f'), or None"
    )


OPTIONS = Bundle("options", tuple(_DEFAULTS), _expand_options, "options=StepOptions({name}=...)")
REPORT = Bundle("report", NAMES, _expand_report, "report=dyn.step_report({name!r})", written=True)
