"""Values of the scene that differ between the worlds of an environment: ``WorldValues``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch


class WorldValues(Mapping[str, torch.Tensor]):
    """Values of the scene by name, tensors [world, ...], that may be written in place by torch.

    ``values[name] = x`` writes x into the tensor, because kernels hold its memory. Terms read the memory itself; the
    dynamics have a copy, so that what is written must be copied to them before the next step.
    """

    def __init__(self, tensors: Mapping[str, torch.Tensor]):
        self._tensors, self._seen = dict(tensors), [0] * len(tensors)
        self.were_written()

    def __getitem__(self, name: str) -> torch.Tensor:
        return self._tensors[name]

    def __setitem__(self, name: str, value: Any) -> None:
        held = self._tensors[name]
        held.copy_(torch.as_tensor(value, dtype=held.dtype, device=held.device))

    def __iter__(self) -> Iterator[str]:
        return iter(self._tensors)

    def __len__(self) -> int:
        return len(self._tensors)

    def __repr__(self) -> str:
        return f"WorldValues({self._tensors!r})"

    def were_written(self) -> bool:
        """Return whether torch has written a tensor, or a view of one, since the last call; kernels do not count."""
        before, self._seen = self._seen, [tensor._version for tensor in self._tensors.values()]
        return before != self._seen
