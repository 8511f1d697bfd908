"""States of some worlds for whoever looks at a training, without a wait: ``StateCopies``."""

from __future__ import annotations

import time

import numpy as np
import torch

from .environment import Env


class StateCopies:
    """Copies the coordinates of an environment's first worlds into pinned memory, between its steps, while asked to.

    The copy lies on the stream of the steps, so that the host goes on at once; :meth:`take` looks whether it is done.
    Nothing is copied, and no memory is read, while ``wanted`` is false.

    Args:
        env: whose worlds are copied. worlds: how many, the first ones. interval: between two copies [s].

    Attributes:
        wanted: whether somebody looks. count: copies that have been made.
    """

    def __init__(self, env: Env, worlds: int = 64, interval: float = 0.05):
        self.env, self.interval, self.wanted, self.count = env, interval, False, 0
        self.worlds = min(worlds, env.num_envs)
        cuda = env.device.type == "cuda"
        self._host = torch.zeros((self.worlds, env.scene.coord_count), pin_memory=cuda)
        self._done = torch.cuda.Event() if cuda else None
        self._waits, self._due = False, 0.0

    def copy(self) -> None:
        """Copy where worlds are, where that is asked for and the last copy has been taken."""
        if self.wanted and not self._waits and time.perf_counter() >= self._due:
            self._due = time.perf_counter() + self.interval
            self._host.copy_(self.env.q[: self.worlds], non_blocking=True)
            if self._done is not None:
                self._done.record()
            self.count, self._waits = self.count + 1, True

    def take(self) -> np.ndarray | None:
        """Return the coordinates of the last copy [world, coordinate]; None where there is no new one."""
        if not self._waits or (self._done is not None and not self._done.query()):
            return None
        found = self._host.numpy().copy()
        self._waits = False
        return found
