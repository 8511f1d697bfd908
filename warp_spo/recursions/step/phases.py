"""The stores of a computation that is repeated in passes, or in which segments wait for each other, phase by phase."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from ...trace.emission import Store
from ...trace.scalars import Value


class StepPhases(NamedTuple):
    """The stores of one evaluation, in the order of execution. Where there are no passes, ``sweep`` runs once.

    Attributes:
        prologue: before the passes: variables that they read, and messages.
        pass_invariants: values that are formed once, before the passes, and used in each pass.
        laws: the laws of joints at their guesses, before each sweep; groups of equal code are emitted as one loop.
        sweep: one pass.
        checks: whether the guesses of a pass were right, in groups as ``laws``, or in one.
        epilogue: after the last pass: the state, reports, the status.
        final_messages: to other segments, after the epilogue.
        final_stores: what a segment stores after it has received the final messages of all others, in such groups.
    """

    prologue: list[Store]
    pass_invariants: list[Value]
    laws: list[list[Store]]
    sweep: list[Store]
    checks: list[list[Store]]
    epilogue: list[Store]
    final_messages: list[Store]
    final_stores: list[list[Store]]

    @property
    def stores(self) -> list[Store]:
        """The stores of a pass, and those after the last one."""
        return [*self.sweep, *self.epilogue]

    @property
    def everything(self) -> list[Store]:
        """All stores."""
        groups = (*self.laws, *self.checks, *self.final_stores)
        last = (*self.epilogue, *self.final_messages)
        return [*self.prologue, *self.sweep, *last, *(item for group in groups for item in group)]


class PhaseBuilder:
    """Collects the stores of phases; adding is the only change."""

    def __init__(self) -> None:
        self._phases = StepPhases([], [], [], [], [], [], [], [])

    def add_prologue(self, stores: Iterable[Store]) -> None:
        self._phases.prologue.extend(stores)

    def add_invariants(self, values: Iterable[Value]) -> None:
        self._phases.pass_invariants.extend(values)

    def add_law(self, group: list[Store]) -> None:
        self._phases.laws.append(group)

    def add_sweep(self, stores: Iterable[Store]) -> None:
        self._phases.sweep.extend(stores)

    def add_check(self, group: list[Store]) -> None:
        self._phases.checks.append(group)

    def add_epilogue(self, stores: Iterable[Store]) -> None:
        self._phases.epilogue.extend(stores)

    def add_final_messages(self, stores: Iterable[Store]) -> None:
        self._phases.final_messages.extend(stores)

    def add_final_stores(self, group: list[Store]) -> None:
        self._phases.final_stores.append(group)

    @property
    def phases(self) -> StepPhases:
        """The stores that were added, by phase."""
        return self._phases


def as_phases(stores: list[Store] | StepPhases) -> StepPhases:
    """Return what a recursion has returned as phases: a list of stores is one sweep."""
    return stores if isinstance(stores, StepPhases) else StepPhases([], [], [], stores, [], [], [], [])
