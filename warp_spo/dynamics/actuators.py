"""Actuators: their forces, and the buffers that delay their controls."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any, NamedTuple

import warp as wp

from ..errors import as_integer
from ..execution.routine import Routine
from ..kernels import actuator_delays
from ..recursions.derivatives import adjoints
from ..recursions.step.actuation import actuator_force as trace_of_force
from ..runtime import launches
from ..runtime.arrays import WARP, AnyArray, ArrayT, Call, kind_of
from .operation import ACTUATION, AS_WRITTEN, CTRL, QD, Derivative, Operation, Q, Result, Trial, required

if TYPE_CHECKING:
    from .dynamics import Dynamics

ACTUATOR_FORCE = Operation(
    "actuator_force",
    arguments=(Q, QD, required(CTRL)),
    results=(Result("force", "world, dof"),),
    routine=Routine("actuator_force", trace_of_force),
    embed=AS_WRITTEN,
    multipliers=AS_WRITTEN,
    derivative=Derivative(
        Routine("actuator_force_vjp", adjoints.actuator_force_vjp),
        by=("q", "qd", "ctrl"),
        state=("q", "qd", "ctrl"),
        values=(*ACTUATION, "joint_effort_limit"),
        embed=AS_WRITTEN,
        multipliers=AS_WRITTEN,
    ),
    trial=Trial(lambda dense, q, qd, ctrl: dense.actuator_force(qd, ctrl)),
)


@ACTUATOR_FORCE.method
def actuator_force(self: Dynamics, q: ArrayT, qd: AnyArray | None, ctrl: AnyArray, out: ArrayT | None = None) -> ArrayT:
    """Compute the forces of the scene's actuators, see :class:`Actuator`: tau for other calls [world, dof].

    The sum of the forces on a hinge is at most its ``joint_effort_limit``. Delays have no part in it: ``ctrl`` acts at
    once. Derivatives by a control or a force beyond its range are zero.

    Args:
        q: coordinates [world, coordinate].
        qd: velocities [world, dof]; None means zero.
        ctrl: controls, in the order of ``scene.actuators`` [world, actuator].
    """
    return self._engine.run(ACTUATOR_FORCE, out, q=q, qd=qd, ctrl=ctrl)


class ActuatorState(NamedTuple):
    """The buffers that delay controls; they are the caller's, and :meth:`Dynamics.step` changes them.

    Attributes:
        ring: the last controls [world, slot, actuator], by step modulo the number of slots.
        count: int32 [world, actuator], steps since the last reset; it stays below twice the number of slots.
    """

    ring: Any
    count: Any


def actuator_state(self: Dynamics, like: Any = None, longest: int | None = None) -> ActuatorState:
    """Return new buffers for delayed controls, for ``step(..., ctrl=, actuator_state=)``.

    A step uses the control that was passed ``delay`` steps before, of each actuator and world; a substep counts as a
    step. Before that many steps since the buffers were made or reset, it uses the first control since then. A scene
    without delays has buffers without slots, which steps leave alone.

    Args:
        like: an array of the kind that the buffers are to have, such as q. None: Warp arrays.
        longest: the longest delay, in steps, that actuator_delay will be set to; necessary where actuator_delay is
            variable. A longer delay makes that control NaN in its world. None: the longest of the scene's values.

    Returns:
        :class:`warp_spo.ActuatorState`: (ring [world, longest + 1, actuator], count [world,
        actuator]). To copy or save a state, copy both arrays.

    Raises:
        ValueError: longest is shorter than a delay of the scene's values, or is None where actuator_delay is variable.
    """
    least = most_delay(self)
    if longest is None and self.scene.actuators and "actuator_delay" in self.variable:
        raise ValueError(
            "Dynamics.actuator_state: longest is None and actuator_delay is variable; expected the steps of the "
            f"longest delay that Dynamics.set will be given; pass longest=, {least} or more"
        )
    steps = least if longest is None else as_integer(longest)
    if steps is None or steps < least:
        raise ValueError(
            f"Dynamics.actuator_state: longest is {longest!r}; expected {least} or more, the steps of the longest "
            f"delay in the scene"
        )
    actuators = len(self.scene.actuators)
    slots = steps + 1 if delays_controls(self) else 0
    name = "Dynamics.actuator_state"
    kind = WARP if like is None else kind_of(like, name, "like")
    with Call(name, self.device, self.dtype, kind=kind, call_order=self.recursions.call_order) as call:
        ring = call.write(None, (self.worlds, slots, actuators))
        count = call.write(None, (self.worlds, actuators), dtype=wp.int32)
        for array in (ring, count):
            launches.fill(array, 0)
    return ActuatorState(*call.result)


def forget_controls(dyn: Dynamics, call: Call, mask: wp.array | None, state: Any) -> None:
    """Launch the reset of the buffers of the worlds under the mask, for a call that has read the mask."""
    _, count = _read(dyn, call, state)
    if mask is None:
        launches.fill(count, 0)
    elif count.size:
        dyn.recursions.launch(actuator_delays.forget, count.shape, [mask], [count])


def most_delay(dyn: Dynamics) -> int:
    """Return the longest delay in the scene's values, in steps."""
    return int(dyn.scene.values["actuator_delay"].max(initial=0.0))


def delays_controls(dyn: Dynamics) -> bool:
    """Return whether some control is delayed, or may be set to be."""
    return bool(dyn.scene.actuators) and ("actuator_delay" in dyn.variable or most_delay(dyn) > 0)


def check_commands(dyn: Dynamics, call: Call, ctrl: Any, state: Any, target_q: Any) -> None:
    """Raise ValueError unless a step has the buffers that its delays need, and no others.

    At the first step with ``target_q`` warn if no drive follows it; later ones do not look again.
    """
    if target_q is not None and dyn._looks_at_targets:
        dyn._looks_at_targets = False
        if "joint_target_ke" not in dyn.variable and not dyn.scene.values["joint_target_ke"].any():
            warnings.warn(
                f"{call.name}: target_q moves nothing, because joint_target_ke of the scene is zero; set gains by "
                "scene.with_values(joint_target_ke=..., joint_target_kd=...); files of robots rarely have them",
                stacklevel=7,
            )
    if ctrl is None and state is not None:
        raise ValueError(f"{call.name}: actuator_state is given and ctrl is None; expected both, or neither")
    if ctrl is not None and state is None and delays_controls(dyn):
        raise ValueError(
            f"{call.name}: actuators of the scene delay ctrl, and actuator_state is None; expected the buffers of "
            f"Dynamics.actuator_state(), the same ones at every step"
        )


def advance_delays(dyn: Dynamics, ctrl: wp.array, state: tuple[wp.array, wp.array]) -> wp.array:
    """Put ctrl [world, actuator] into the delay buffers ``state``, and return the controls that act in this step."""
    ring, count = state
    out = dyn.recursions.array("delayed controls", *ctrl.shape)
    field = dyn.recursions.parameters.field("actuator_delay")
    dyn.recursions.launch(actuator_delays.delay, ctrl.shape, [ctrl, field], [ring, count, out])
    return out


def read_state(dyn: Dynamics, call: Call, state: Any) -> tuple[wp.array, wp.array] | None:
    """Return the Warp arrays of the buffers; None where nothing is delayed."""
    return _read(dyn, call, state) if state is not None and delays_controls(dyn) else None


def _read(dyn: Dynamics, call: Call, state: Any) -> tuple[wp.array, wp.array]:
    """Return the Warp arrays of the buffers, to be changed."""
    if not isinstance(state, tuple | list) or len(state) != 2:
        raise TypeError(
            f"{call.name}: actuator_state is of type {type(state).__name__}; expected what Dynamics.actuator_state() "
            f"returned"
        )
    ring, count = state
    actuators = len(dyn.scene.actuators)
    slots = tuple(getattr(ring, "shape", ()))[1:2]
    least = most_delay(dyn) + 1 if delays_controls(dyn) else 0
    if not slots or slots[0] < least:
        raise ValueError(
            f"{call.name}: actuator_state has {slots[0] if slots else 'no'} slots; expected {least} or more, as "
            f"Dynamics.actuator_state() makes them; longest= makes more"
        )
    shape = (dyn.worlds, slots[0], actuators)
    return (
        call.update("actuator_state.ring", ring, shape, "[world, slot, actuator]"),
        call.update("actuator_state.count", count, (dyn.worlds, actuators), "[world, actuator]", dtype=wp.int32),
    )


def stand_in(dyn: Dynamics, given: dict[str, Any]) -> ActuatorState | None:
    """Return what ``prepare`` passes for the buffers of a call with these arguments."""
    return actuator_state(dyn, longest=most_delay(dyn)) if "ctrl" in given and delays_controls(dyn) else None


def explain(dyn: Dynamics) -> str:
    """Return a line on the scene's actuators."""
    actuators = dyn.scene.actuators
    if not actuators:
        return "none"
    hinges = {hinge for actuator in actuators for hinge in actuator.hinges}
    set_later = "actuator_delay" in dyn.variable
    longest = "as many steps as Dynamics.set says" if set_later else f"up to {most_delay(dyn)} steps"
    late = f"delays of {longest}, in a launch before each step" if delays_controls(dyn) else "no delays"
    return f"{len(actuators)} on {len(hinges)} hinges, in the kernel of a step that is given ctrl; {late}"
