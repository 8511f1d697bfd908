"""Values of the scene, and states of some worlds, which callers change between calls."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..execution.parameters import SHARED, VARIABLE
from ..execution.row_copies import as_rows, copy_rows
from ..runtime.arrays import AnyArray, ArrayT, Call, shape_of
from ..runtime.autograd import records_gradient
from ..runtime.dlpack import settle
from ..scene.actuators import check_actuator_value
from ..scene.contact_values import CONTACT_VALUES
from ..scene.parts import real
from ..scene.scene import refuse_negative
from . import actuators
from .operation import DIFFERENTIABLE
from .refinement import Refinement

if TYPE_CHECKING:
    from .dynamics import Dynamics


def set_values(self: Dynamics, *, worlds: AnyArray | None = None, **values: Any) -> None:
    """Change values of the scene, in Newton's names and layouts, [world, ...] or [...] for all worlds.

    All worlds share "ground_heights", which has no world axis.

    Names in ``variable`` are copied by launches, one for all names and one or two for what kernels derive from them,
    which a graph may capture. Their numbers are not inspected, but for delays and values of contacts in NumPy arrays.
    Any other name rebuilds the kernels' data that was derived from it, with a warning, and is checked as a scene's
    values are.

    Args:
        worlds: bool [world]; only worlds where it is True change. None: all change.
        values: arrays by name. An actuator_delay on a device must be whole steps, 0 or more, and no longer than the
            buffers of :meth:`actuator_state`; controls with another one are NaN.

    Raises:
        ValueError: unknown name, wrong shape, dtype or device; a NumPy array with a value of contacts below zero,
            or with a delay that is not whole; a name that is not variable inside a graph capture or with
            ``worlds``; a tensor that requires grad, now or in an earlier call, with ``worlds``.
    """
    folded: dict[str, Any] = {}
    settle((worlds, *values.values()))
    with Call("Dynamics.set", self.device, self.dtype, call_order=self.recursions.call_order) as call:
        variable: dict[str, Any] = {}
        chosen = None if worlds is None else read_mask(call, "worlds", worlds, self.worlds)
        for name, value in values.items():
            value, array = _read(self, call, name, value)
            if name in self.variable:
                _inspect(name, value, worlds, self.scene.values[name].ndim)
                variable[name] = array
            else:
                folded[name] = value if isinstance(value, np.ndarray) else array
        if chosen is not None:
            _refuse_with_mask(self, values, folded)
        if folded and self.device.is_capturing:
            raise ValueError(
                f"Dynamics.set: {', '.join(folded)} inside a graph capture; expected variable values only; build "
                f"Dynamics with variable=({', '.join(map(repr, folded))},)"
            )
        host = {name: value if isinstance(value, np.ndarray) else value.numpy() for name, value in folded.items()}
        checked = {name: self.scene.check_value("Dynamics.set", name, value) for name, value in host.items()}
        parameters = self.recursions.parameters
        call.order()
        parameters.set(variable, chosen)
        for name in variable:
            self.values.set(name, values[name])
        if folded:
            for name in folded:
                self.values.set(name, None)
            _rebuild(self, checked)


def _read(dyn: Dynamics, call: Call, name: str, value: Any) -> tuple[Any, Any]:
    """Return what was given for a value, an array, and the Warp array that has its numbers; errors by name."""
    if name not in VARIABLE:
        raise ValueError(f"Dynamics.set: unknown value {name!r}; expected one of {', '.join(VARIABLE)}")
    if not hasattr(value, "shape"):
        try:
            value = real(value)
        except (TypeError, ValueError):
            raise TypeError(f"Dynamics.set: {name} is {value!r}; expected an array of numbers") from None
    _refuse_lost_gradient(dyn, name, value)
    shape = dyn.scene.values[name].shape[1:]
    if len(shape_of(value)) > len(shape) and name not in SHARED:
        shape = (dyn.worlds, *shape)
    followed = name in dyn._gradients.values and records_gradient((value,))
    meaning = "[...], because all worlds share it" if name in SHARED else "[world, ...] or [...] as Newton has it"
    return value, call.read(name, value.detach() if followed else value, shape, meaning)


def _refuse_lost_gradient(dyn: Dynamics, name: str, value: Any) -> None:
    """Raise ValueError for a tensor that requires grad and a value that is folded; warn of such an array of Warp's."""
    if name in DIFFERENTIABLE and name not in dyn.variable and records_gradient((value,)):
        raise ValueError(
            f"Dynamics.set: {name} requires grad and is folded into the kernels, which have no gradient by it; "
            f"expected a variable value; build Dynamics with variable=({name!r},), or pass {name}.detach()"
        )
    if isinstance(value, wp.array) and value.requires_grad:
        warnings.warn(
            f"Dynamics.set: {name} is a Warp array that requires grad; its gradient stays zero, because wp.Tape sees "
            f"no call of Dynamics; expected a torch tensor, of a Dynamics with variable=({name!r},), or SolverSPO in "
            "the tape, or an array without gradient",
            stacklevel=4,
        )


def reset(
    self: Dynamics,
    mask: AnyArray,
    q: ArrayT,
    qd: AnyArray,
    q_from: AnyArray,
    qd_from: AnyArray,
    actuator_state: actuators.ActuatorState | None = None,
) -> tuple[ArrayT, AnyArray]:
    """Write q_from, qd_from into q, qd in the worlds where ``mask`` is True; by one launch, which a graph may capture.

    Args:
        mask: bool [world].
        q: coordinates [world, coordinate], changed in place.
        qd: velocities [world, dof], changed in place.
        q_from: q that these worlds get, [world, coordinate], or [coordinate] for all of them.
        qd_from: qd that these worlds get, [world, dof], or [dof] for all of them.
        actuator_state: buffers of :meth:`actuator_state`, in which these worlds forget their controls, as in
            :meth:`reset_actuator_state`; by one launch more.

    Returns:
        q, qd.

    Raises:
        TypeError, ValueError: as every call; q, qd must not overlap the other arrays.
    """
    settle((mask, q, qd, q_from, qd_from))
    with Call("Dynamics.reset", self.device, self.dtype, call_order=self.recursions.call_order) as call:
        chosen = read_mask(call, "mask", mask, self.worlds)
        sizes = (self.scene.coord_count, "coordinate"), (self.scene.dof_count, "dof")
        targets = [
            call.update(name, array, (self.worlds, size), f"[world, {axis}]", optional=False)
            for name, array, (size, axis) in zip(("q", "qd"), (q, qd), sizes, strict=True)
        ]
        sources = []
        for name, array, (size, axis) in zip(("q_from", "qd_from"), (q_from, qd_from), sizes, strict=True):
            shape = (size,) if len(getattr(array, "shape", ())) == 1 else (self.worlds, size)
            sources.append(call.read(name, array, shape, f"[world, {axis}] or [{axis}]"))
        call.order()
        pairs = [(as_rows(a, b.shape[1:]), b) for a, b in zip(sources, targets, strict=True) if b.size]
        if pairs:
            copy_rows([a for a, _ in pairs], [b for _, b in pairs], self.worlds, chosen)
        if actuator_state is not None:
            actuators.forget_controls(self, call, chosen, actuator_state)
    return q, qd


def reset_actuator_state(self: Dynamics, mask: AnyArray | None, state: actuators.ActuatorState) -> None:
    """Forget the controls that delays hold back, in the worlds where ``mask`` is True; a graph may capture it.

    Args:
        mask: bool [world]. None: all worlds.
        state: buffers of :meth:`actuator_state`; changed in place.
    """
    settle((mask,))
    with Call("Dynamics.reset_actuator_state", self.device, self.dtype, call_order=self.recursions.call_order) as call:
        chosen = None if mask is None else read_mask(call, "mask", mask, self.worlds)
        call.order()
        actuators.forget_controls(self, call, chosen, state)


def read_mask(call: Call, name: str, mask: Any, worlds: int) -> wp.array:
    """Return a mask of worlds, an array or a list of bools, as a Warp array [world]."""
    if not hasattr(mask, "shape"):
        mask = np.asarray(mask)
    return call.read(name, mask, (worlds,), "[world]", dtype=wp.bool)


def _inspect(name: str, value: Any, worlds: Any, axes: int) -> None:
    """Raise ValueError where a NumPy array holds what a variable value cannot be, in the worlds that change.

    Nothing is read back from a device: with a mask there, values that differ between worlds are not inspected.

    Args:
        value: as the caller gave it. worlds: mask of worlds, or None. axes: of the value with that of worlds.
    """
    if not isinstance(value, np.ndarray):
        return
    if worlds is not None and value.ndim == axes:
        if hasattr(worlds, "shape") and not isinstance(worlds, np.ndarray):
            return
        value = value[np.asarray(worlds)]
    if name == "actuator_delay":
        check_actuator_value("Dynamics.set", name, value)
    if name in CONTACT_VALUES:  # status= names the worlds of negative masses; others may lie a difference below zero
        refuse_negative("Dynamics.set", name, value[np.isfinite(value)])


def _refuse_with_mask(dyn: Dynamics, values: dict[str, Any], folded: dict[str, Any]) -> None:
    """Raise ValueError where values cannot change in some worlds alone."""
    for name in values:
        if name in SHARED:
            raise ValueError(
                f"Dynamics.set: worlds= with {name}, which all worlds share; expected no worlds=; set it for all worlds"
            )
    if folded:
        raise ValueError(
            f"Dynamics.set: worlds= with {', '.join(folded)}, which is folded into the kernels; expected variable "
            f"values only; build Dynamics with variable=({', '.join(map(repr, folded))},)"
        )
    for name, value in values.items():
        if name in dyn.values.tensors or records_gradient((value,)):
            raise ValueError(
                f"Dynamics.set: worlds= with {name}, whose tensor requires grad; expected tensors without grad; set it "
                f"for all worlds, to torch.where of the mask, the new and the old tensor"
            )


def _rebuild(dyn: Dynamics, folded: dict[str, np.ndarray]) -> None:
    warnings.warn(
        f"Dynamics.set: {', '.join(folded)} is folded into the kernels' data, which is rebuilt; graphs captured "
        f"before are out of date; name it in variable= to set it without rebuilding",
        stacklevel=3,
    )
    dyn.scene = dyn.scene.with_values(**folded)
    dyn.recursions.replace_values(dyn.scene)
    dyn.programs.forget()
    dyn._replays.forget()
    dyn._gradients.forget()
    dyn._refinement = Refinement(dyn, dyn.refine) if dyn.refine else None
    vars(dyn).pop("_joint_space", None)  # made anew when a step needs it
