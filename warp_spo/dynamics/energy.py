"""Kinetic and potential energy."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..errors import UnsupportedError
from ..execution.node import operations as node_operations
from ..execution.routine import Routine
from ..recursions import energy as recursion
from ..recursions.derivatives import adjoints
from ..recursions.model.links import MOTION_VALUES, Links
from ..runtime.arrays import AnyArray, ArrayT
from ..trace.scalars import is_constant
from .operation import AS_WRITTEN, KINEMATIC, QD, Derivative, Operation, Q, Result, Trial, required

if TYPE_CHECKING:
    from .dynamics import Dynamics

INERTIAL = tuple(name for name in MOTION_VALUES if name != "gravity")

KINETIC_ENERGY = Operation(
    "kinetic_energy",
    arguments=(Q, required(QD)),
    results=(Result("energy", "world"),),
    routine=Routine("kinetic_energy", recursion.kinetic_energy, node_operations.kinetic_energy),
    embed=AS_WRITTEN,
    multipliers=AS_WRITTEN,
    derivative=Derivative(
        Routine("kinetic_energy_vjp", adjoints.kinetic_energy_vjp),
        by=("q", "qd"),
        values=INERTIAL,
        embed=AS_WRITTEN,
        multipliers=AS_WRITTEN,
    ),
    trial=Trial(lambda dense, q, qd: 0.5 * qd @ dense.mass_matrix @ qd),
)


@KINETIC_ENERGY.method
def kinetic_energy(self: Dynamics, q: ArrayT, qd: AnyArray, out: ArrayT | None = None) -> ArrayT:
    """Compute the kinetic energy of all bodies, armature included: qd* Mass qd / 2 [world] [J].

    qd is that of all dofs, whatever ties them.
    """
    return self._engine.run(KINETIC_ENERGY, out, q=q, qd=qd)


def _lacks_fixed_ground(links: Links) -> str:
    """Say what the gradient lacks: bodies that no hinge moves are no links, whose values have gradients."""
    still = [links.nodes[body].rigid for body, placement in links.placements.items() if placement.link is None]
    constant = all(is_constant(x) for rigid in still for x in rigid.packed)
    return (
        "" if constant else "the gradient of the energy of bodies that do not move; keep body_mass and body_com folded"
    )


POTENTIAL_ENERGY = Operation(
    "potential_energy",
    arguments=(Q,),
    results=(Result("energy", "world"),),
    routine=Routine("potential_energy", recursion.potential_energy),
    embed=AS_WRITTEN,
    multipliers=AS_WRITTEN,
    derivative=Derivative(
        Routine("potential_energy_vjp", adjoints.potential_energy_vjp),
        by=("q",),
        values=("body_mass", *KINEMATIC, "gravity", "joint_stiffness", "joint_rest_q"),
        embed=AS_WRITTEN,
        multipliers=AS_WRITTEN,
        lacking=_lacks_fixed_ground,
    ),
    trial=Trial(lambda dense, q: dense.potential_energy),
)


@POTENTIAL_ENERGY.method
def potential_energy(self: Dynamics, q: ArrayT, out: ArrayT | None = None) -> ArrayT:
    """Compute the potential energy of gravity and of the hinges' springs [world] [J].

    Gravity: -m g* c summed over all bodies, those included that do not move; it is zero at the origin of the inertial
    frame. Springs: stiffness (q - rest)^2 / 2, where q - rest is that of :meth:`passive_force`. Drives and limits do
    not count.

    The slope of the energy along a dof is :meth:`gravity_force` - :meth:`passive_force` (at qd = 0, without gravity
    compensation), except for springs of ball hinges whose stiffness differs from axis to axis and of free hinges, whose
    forces have no potential.

    Raises:
        UnsupportedError: a scene that cannot move.
    """
    engine = self._engine
    with engine.call(POTENTIAL_ENERGY) as call:
        given = engine.read(call, POTENTIAL_ENERGY, q=q)
        if self.scene.dof_count == 0:
            raise UnsupportedError(call.name, "a scene that cannot move", "add up the weights of its bodies")
        (energy,) = engine.write(call, POTENTIAL_ENERGY, (out,), given)
        engine.launch(POTENTIAL_ENERGY, energy, **given)
    return call.result
