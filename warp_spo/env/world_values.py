"""Values of the scene that differ between the worlds of an environment: ``WorldValues``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch

from .arguments import check_written


class WorldValues(Mapping[str, torch.Tensor]):
    """Values of the scene by name, tensors [world, ...], that may be written in place by torch.

    ``values[name] = x`` writes x into the tensor, because kernels hold its memory. Terms read the memory itself; the
    dynamics have a copy, so that what is written must be copied to them before the next step.
    """

    def __init__(self, tensors: Mapping[str, torch.Tensor]):
        self._tensors, self._seen = dict(tensors), [0] * len(tensors)
        self.were_written()

    def __getitem__(self, name: str) -> torch.Tensor:
        if name not in self._tensors:
            raise KeyError(
                f"env.values: no event changes {name!r}; expected one of [{', '.join(self)}], or an event that does, "
                "such as events.randomise"
            )
        return self._tensors[name]

    def __setitem__(self, name: str, value: Any) -> None:
        held = self[name]
        held.copy_(check_written(f"env.values[{name!r}]", value, held))

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
