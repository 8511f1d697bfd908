"""Learned actuators: a small network that gives the torque of a joint, ``ActuatorNetwork``.

Hwangbo et al. 2019, "Learning agile and dynamic motor skills for legged robots", fit such networks to measurements of a
motor: errors of position and rates, now and some time ago, make a torque. Names of arguments are those of Isaac Lab's
``ActuatorNetMLPCfg``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..kernels.actuator_networks import ACTIVATIONS
from .validation import check_number, check_whole

MODULES = {
    "Identity": "identity", "ReLU": "relu", "ELU": "elu", "Softsign": "softsign", "Tanh": "tanh",
    "Softplus": "softplus",
}  # fmt: skip
"""torch's module -> activation."""
CHECKED = 64  # random inputs on which a file and the network that was read from it are compared
MOST_UNITS = 256  # of a layer; all weights are in the text of a kernel
Layers = tuple[tuple[np.ndarray, np.ndarray], ...]


@dataclasses.dataclass(frozen=True, eq=False)
class ActuatorNetwork:
    """A network of dense layers from errors of position and rates of a joint, now and before, to its torque.

    The inputs are ``pos_scale`` times the errors [rad or m], target less coordinate, of each of ``input_idx``, then
    ``vel_scale`` times the rates [rad/s or m/s], or the other way round. The output is the torque over
    ``torque_scale`` [N m or N]. Before the start of an episode errors and rates count as zero.

    Args:
        weights: of each layer [out, in]; the last has one row. biases: of each layer [out].
        activation: after each layer but the last: "relu", "elu", "softsign", "tanh", "softplus" or "identity", with
            torch's default arguments.
        input_idx: how many substeps ago each input is, 0 is now.
        input_order: "pos_vel", errors first, or "vel_pos".
        pos_scale, vel_scale, torque_scale: factors.

    Raises:
        ValueError: layers do not fit to each other or to the inputs, or an argument is none; the message names it.
    """

    weights: Sequence[Any]
    biases: Sequence[Any]
    activation: str = "softsign"
    input_idx: Sequence[int] = (0, 1, 2)
    input_order: str = "pos_vel"
    pos_scale: float = 1.0
    vel_scale: float = 1.0
    torque_scale: float = 1.0

    def __post_init__(self) -> None:
        call = "ActuatorNetwork"
        if self.activation not in ACTIVATIONS:
            raise ValueError(f"{call}: activation is {self.activation!r}; expected one of {', '.join(ACTIVATIONS)}")
        if self.input_order not in ("pos_vel", "vel_pos"):
            raise ValueError(f"{call}: input_order is {self.input_order!r}; expected 'pos_vel' or 'vel_pos'")
        for name in ("pos_scale", "vel_scale", "torque_scale"):
            check_number(call, name, getattr(self, name))
        lags = tuple(check_whole(call, "an entry of input_idx", each, 0, 1000) for each in self.input_idx)
        if not lags or len(set(lags)) != len(lags):
            raise ValueError(f"{call}: input_idx is {self.input_idx!r}; expected different whole numbers")
        object.__setattr__(self, "input_idx", lags)
        weights = tuple(np.array(each, dtype=np.float64) for each in self.weights)
        biases = tuple(np.array(each, dtype=np.float64).ravel() for each in self.biases)
        object.__setattr__(self, "weights", weights)
        object.__setattr__(self, "biases", biases)
        size = 2 * len(lags)
        if not weights or len(weights) != len(biases):
            raise ValueError(f"{call}: {len(weights)} weights and {len(biases)} biases; expected one of each a layer")
        for number, (each, bias) in enumerate(zip(weights, biases, strict=True)):
            outs = 1 if number + 1 == len(weights) else len(bias)
            if each.shape != (outs, size) or bias.shape != (outs,) or not 0 < outs <= MOST_UNITS:
                raise ValueError(
                    f"{call}: layer {number} has weights {each.shape} and biases {bias.shape}; expected ({outs}, "
                    f"{size}) [out, in] and ({outs},): {len(lags)} errors and {len(lags)} rates come in, at most "
                    f"{MOST_UNITS} numbers leave a layer, and the last one gives one torque"
                )
            if not np.isfinite(each).all() or not np.isfinite(bias).all():
                raise ValueError(f"{call}: layer {number} holds NaN or infinity; expected finite numbers")
            size = outs

    @classmethod
    def from_torchscript(cls, file: str | Path, **arguments: Any) -> ActuatorNetwork:
        """Return the network of a TorchScript file: linear layers, with one kind of activation between them.

        Args:
            file: that ``torch.jit.save`` wrote; modules of torch.nn, one after the other.
            arguments: ``input_idx`` and others of the class; ``activation`` is the file's.

        Raises:
            ValueError: the file holds something else; what was read is compared with what the file computes.
            OSError: there is no such file.
        """
        import torch

        Path(file).open("rb").close()
        call = f"ActuatorNetwork.from_torchscript: {str(file)!r}"
        try:
            module = torch.jit.load(str(file), map_location="cpu").double().eval()
        except RuntimeError as error:
            raise ValueError(f"{call} is no TorchScript file ({str(error).splitlines()[0]})") from None
        own = {name.rsplit(".", 1)[0]: "" for name, _ in module.named_parameters()}
        kinds = [each.original_name for each in module.modules()]
        found = list(dict.fromkeys(MODULES[kind] for kind in kinds if kind in MODULES))
        values = dict(module.named_parameters())
        layers: list[Any] = [(values.get(f"{name}.weight"), values.get(f"{name}.bias")) for name in own]
        if not layers or len(found) > 1 or any(w is None or b is None or w.ndim != 2 for w, b in layers):
            raise ValueError(
                f"{call} has {', '.join(sorted(set(kinds)))}; expected Linear layers with biases, and one kind of "
                f"activation of {', '.join(MODULES)}; give other networks as arrays, if they are dense layers"
            )
        weights, biases = ([each[i].detach().numpy() for each in layers] for i in (0, 1))
        made = cls(weights, biases, found[0] if found else "identity", **arguments)
        inputs = torch.randn(CHECKED, weights[0].shape[1], generator=torch.Generator().manual_seed(0)).double()
        with torch.no_grad():
            there, here = module(inputs), made._evaluate(inputs)
        if there.shape not in (here.shape, here.shape[:-1]) or not torch.allclose(there.reshape(here.shape), here):
            raise ValueError(
                f"{call} computes something else than its layers, one after the other; expected Linear layers and "
                "activations alone, such as torch.nn.Sequential has them"
            )
        return made

    @property
    def layers(self) -> Layers:
        """(weights [out, in], biases [out]) of each layer."""
        return tuple(zip(self.weights, self.biases, strict=True))

    @property
    def text(self) -> tuple[Any, ...]:
        """All of it that the text of a kernel depends on, without arrays."""
        layers = tuple((tuple(map(tuple, w.tolist())), tuple(b.tolist())) for w, b in self.layers)
        scales = float(self.pos_scale), float(self.vel_scale), float(self.torque_scale)
        return layers, self.activation, tuple(self.input_idx), self.input_order == "pos_vel", scales

    def torque(self, errors: Any, rates: Any) -> Any:
        """Return the torque, in torch and with gradients: with ``Dynamics.step`` those of a motion by its motors.

        Args:
            errors: target less coordinate [..., len(input_idx)], a torch tensor, in the order of ``input_idx``.
            rates: the same of rates.

        Returns:
            [...], of the dtype of ``errors``, without limits.
        """
        import torch

        parts = [errors * self.pos_scale, rates * self.vel_scale]
        found = self._evaluate(torch.cat(parts if self.input_order == "pos_vel" else parts[::-1], dim=-1))
        return found[..., 0] * self.torque_scale

    def _evaluate(self, inputs: Any) -> Any:
        """Return the outputs [..., 1] of the layers for inputs [..., in], torch tensors."""
        import torch

        functions = {
            "identity": lambda x: x, "relu": torch.relu, "elu": torch.nn.functional.elu, "tanh": torch.tanh,
            "softsign": torch.nn.functional.softsign, "softplus": torch.nn.functional.softplus,
        }  # fmt: skip
        x = inputs
        for number, (w, b) in enumerate(self.layers):
            x = torch.nn.functional.linear(
                x, *(torch.as_tensor(each, dtype=x.dtype, device=x.device) for each in (w, b))
            )
            if number + 1 < len(self.weights):
                x = functions[self.activation](x)
        return x
