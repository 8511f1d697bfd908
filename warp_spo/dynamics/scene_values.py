"""Values of the scene that callers change: variable ones by launches, folded ones by building anew."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import numpy as np

from ..arrays import Call, shape_of
from ..dlpack import settle
from ..execution.parameters import VARIABLE
from ..gradients import records_gradient
from ..scene.parts import real
from .refinement import Refinement

if TYPE_CHECKING:
    from .dynamics import Dynamics


def set_values(self: Dynamics, **values: Any) -> None:
    """Change values of the scene, in Newton's names and layouts, [world, ...] or [...] for all worlds.

    A name in ``variable`` is copied by launches, which a graph may capture; its numbers are not inspected. Any other
    name rebuilds the kernels' data that was derived from it, with a warning, and is checked as a scene's values are.

    Raises:
        ValueError: unknown name, wrong shape, dtype or device; a name that is not variable inside a graph capture.
    """
    folded: dict[str, Any] = {}
    settle(values.values())
    with Call("Dynamics.set", self.device, self.dtype, turn=self.recursions.turn) as call:
        variable: dict[str, Any] = {}
        for name, value in values.items():
            if name not in VARIABLE:
                raise ValueError(f"Dynamics.set: unknown value {name!r}; expected one of {', '.join(VARIABLE)}")
            if not hasattr(value, "shape"):
                try:
                    value = real(value)
                except (TypeError, ValueError):
                    raise TypeError(f"Dynamics.set: {name} is {value!r}; expected an array of numbers") from None
            shape = self.scene.values[name].shape[1:]
            if len(shape_of(value)) > len(shape):
                shape = (self.worlds, *shape)
            followed = name in self._gradients.values and records_gradient((value,))
            plain = value.detach() if followed else value
            array = call.read(name, plain, shape, "[world, ...] or [...] as Newton has it")
            if name in self.variable:
                variable[name] = array
            else:
                folded[name] = value if isinstance(value, np.ndarray) else array
        if folded and self.device.is_capturing:
            raise ValueError(
                f"Dynamics.set: {', '.join(folded)} inside a graph capture; expected variable values only; build "
                f"Dynamics with variable=({', '.join(map(repr, folded))},)"
            )
        host = {name: value if isinstance(value, np.ndarray) else value.numpy() for name, value in folded.items()}
        checked = {name: self.scene.check_value("Dynamics.set", name, value) for name, value in host.items()}
        parameters = self.recursions.parameters
        call.order()
        for name, array in variable.items():
            parameters.copy_in(name, array)
            self.values.set(name, values[name])
        parameters.refresh(variable)
        if folded:
            for name in folded:
                self.values.set(name, None)
            _rebuild(self, checked)


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
