"""A Dynamics as a module of torch."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch

from ..errors import as_names
from ..runtime.torch_tensors import DTYPES, torch_device

if TYPE_CHECKING:
    from ..dynamics.dynamics import Dynamics


def _make_method(operation: str) -> Callable[..., Any]:
    """Return a method of :class:`Module` that sets the parameters and calls an operation of Dynamics."""

    def method(self: "Module", *args: Any, **more: Any) -> Any:
        with self.dyn.recursions.call_order.lock:  # no other thread may set values between
            self.dyn.set(**dict(self.named_parameters()))
            return self.dyn._operations[operation].method_of_users(self.dyn, *args, **more)

    method.__name__, method.__qualname__ = operation, f"Module.{operation}"
    method.__doc__ = f"Return :meth:`warp_spo.Dynamics.{operation}` at the parameters."
    return method


class Module(torch.nn.Module):
    """A :class:`warp_spo.Dynamics` whose values are parameters that all worlds share. They are set before each call.

    ::

        robot = Module(spo.Dynamics(scene, worlds, variable=("body_mass", "joint_armature")))
        optimizer = torch.optim.Adam(robot.parameters())
        loss = (robot.forward_dynamics(q, qd, tau) - measured).square().mean()

    Its methods are the operations of Dynamics that have gradients. Calling the module is ``forward_dynamics``.

    Args:
        dyn: The Dynamics.
        names: Names of the values, which must be ``variable`` in ``dyn``. None: all that have gradients. The parameters
            start at the values of the scene, averaged over its worlds.

    Raises:
        TypeError: ``dyn`` is no Dynamics, or ``names`` are no names.
        ValueError: A value is not variable, or has no gradient.
    """

    def __init__(self, dyn: "Dynamics", names: Sequence[str] | None = None):
        super().__init__()
        if not hasattr(dyn, "_operations"):
            raise TypeError(f"Module: dyn is of type {type(dyn).__name__}; expected a Dynamics")
        self.dyn = dyn
        known = dyn._gradients.values
        names = as_names("Module", "names", known if names is None else names, ("body_mass",))
        for name in names:
            if name not in known:
                raise ValueError(
                    f"Module: {name!r} has no gradient here; expected some of {', '.join(known)}; "
                    f"build Dynamics with variable=({name!r},)"
                )
            value = torch.as_tensor(dyn.scene.values[name].mean(0))
            value = value.to(device=torch_device(dyn.device.alias), dtype=DTYPES[dyn.dtype])
            self.register_parameter(name, torch.nn.Parameter(value))

    forward_dynamics: Callable[..., torch.Tensor] = _make_method("forward_dynamics")
    inverse_dynamics: Callable[..., torch.Tensor] = _make_method("inverse_dynamics")
    bias_force: Callable[..., torch.Tensor] = _make_method("bias_force")
    gravity_force: Callable[..., torch.Tensor] = _make_method("gravity_force")
    step: Callable[..., tuple[torch.Tensor, torch.Tensor]] = _make_method("step")
    mass_matrix: Callable[..., torch.Tensor] = _make_method("mass_matrix")
    jacobian: Callable[..., torch.Tensor] = _make_method("jacobian")
    solve_mass_matrix: Callable[..., torch.Tensor] = _make_method("solve_mass_matrix")
    body_poses: Callable[..., torch.Tensor] = _make_method("body_poses")
    body_velocities: Callable[..., torch.Tensor] = _make_method("body_velocities")
    integrate: Callable[..., torch.Tensor] = _make_method("integrate")
    forward = forward_dynamics
