"""The guard between worlds and a learner: numbers that are not finite, or beyond their bounds, end a world.

Each stage looks at what it makes: "act" at actions, "judge" at the state and at rewards, "observe" and "final" at
observations. Other stages leave what they find as a code in the array "found", and "judge" ends the world: in the
same step, or in the next one for an observation, whose numbers are zero until then. It counts the first cause.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from ...trace.functions import AbstractScalar, Condition, where
from ...trace.scalars import Value, absolute, branch, less
from .vectors import Vector, as_value, vector

if TYPE_CHECKING:
    from ..world import World

NOT_FINITE, BEYOND = "not finite", "beyond bounds"  # ends, and the counts of their causes
LARGEST = 1e30  # numbers beyond it count as not finite


def within(values: Any, limit: Any) -> Condition:
    """Return whether sizes of numbers add up to less than ``limit``; of limits, whether each is less than its own.

    It is false where a number is NaN.
    """
    sizes = [absolute(as_value(x)) for x in values]
    limits = [limit] if isinstance(limit, float) else limit
    if isinstance(limit, float):
        total: Value = 0.0
        for size in sizes:
            total = total + size
        sizes = [total]
    fine: Value = 1.0
    for size, most in zip(sizes, limits, strict=True):
        fine = fine * less(size, min(most, LARGEST))
    return Condition(fine)


class Check(NamedTuple):
    """Numbers of one place that the guard looks at.

    Attributes:
        fine: whether all is within bounds. code: where it is not, the number that is counted, see :class:`Guard`.
    """

    fine: Condition
    code: Any


def first(checks: Sequence[Check], name: str) -> Any:
    """Return the code of the first check that is not fine, or 0; it is worked out only where there is one."""
    fine: Value = 1.0
    code: Any = 0.0
    for check in checks:
        fine = fine * check.fine.value
    for check in reversed(checks):
        code = where(check.fine, code, check.code)
    return AbstractScalar(branch((~Condition(fine)).value, as_value(code), 0.0, name))


class Guard:
    """The checks that end worlds, and the names by which they are counted.

    Codes of causes: 1, 2, ... where numbers are not finite; as many more where they are finite and beyond bounds.

    Args:
        limits: bounds by cause, see ``Bounds.limits``.

    Attributes:
        names: of what is counted, in the order of codes, such as "not finite/reward/alive".
        places: entries of the array "found" by name.
        apart: causes of observations whose rows have threads of their own, each with two entries.
    """

    def __init__(self, limits: Mapping[str, Any]):
        self.limits = dict(limits)
        self.names = [f"{kind}/{cause}" for kind in (NOT_FINITE, BEYOND) for cause in limits]
        self.places: dict[str, int] = {}
        self.apart: list[str] = []

    def check(self, cause: str, values: Any) -> Check:
        """Return whether all numbers are within the bound of a cause, and the code of what ends the world if not."""
        code = 1.0 + [*self.limits].index(cause)
        finite = within(values, LARGEST)
        return Check(within(values, self.limits[cause]), where(finite, code + len(self.limits), code))

    def admit(self, cause: str, values: Any, checks: list[Check]) -> Vector:
        """Return numbers as a learner may see them, zeros if they are not fine; add what was found to ``checks``."""
        checks.append(self.check(cause, values))
        return vector(where(checks[-1].fine, x, 0.0) for x in values)

    def check_state(self, w: World) -> list[Check]:
        """Return the checks of the state after a step of the dynamics."""
        parts = {"state/coordinates": w.q, "state/speeds": w.qd}
        if "state/accelerations" in self.limits:
            parts["state/accelerations"] = w.read("qdd", w.scene.dof_count)
        return [self.check(cause, values) for cause, values in parts.items()]

    # -- worlds that end ---------------------------------------------------------------------------------------------
    def finite_end(self, w: World, state: Sequence[Check]) -> World:
        """Return a copy of a world with a finite state, which reset events read as ``w.before`` when its episode ends.

        It has the world's q and qd, or default_q and zeros where a check of ``state`` is not fine.
        """
        ended, fine = copy.copy(w), Condition(1.0)
        for check in state:
            fine = fine & check.fine
        ended.__dict__["q"] = vector(where(fine, x, float(y)) for x, y in zip(w.q, w.default_q, strict=True))
        ended.__dict__["qd"] = vector(where(fine, x, 0.0) for x in w.qd)
        return ended

    def hold(self, w: World, names: Sequence[str], bad: Condition) -> None:
        """Leave memory that resets leave alone as it was in worlds that are ``bad``."""
        for name in names:
            if w._layout.memory[name][2] is None:
                pairs = zip(w.stored_memory(name), w.kept[name], strict=True)
                w.keep_own(name, [where(bad, old, new) for old, new in pairs])

    # -- what other stages find --------------------------------------------------------------------------------------
    def leave(self, w: World, name: str, checks: Sequence[Check], goes: Condition | None = None) -> Any:
        """Leave the code of the first check that is not fine for "judge", or 0, and return it.

        Args:
            w: the world. name: of what is found. checks: in turn. goes: where it counts; None: everywhere.
        """
        code = first(checks, name)
        left = code if goes is None else where(goes, code, -1.0)
        w._stage.store("found", self._place(name), as_value(left))
        return code

    def leave_row(self, w: World, kind: str, cause: str, check: Check, number: int, goes: Condition | None) -> None:
        """Leave what a thread finds at its row ``number`` of an observation; all threads of a world write the same."""
        beyond = check.code > len(self.limits) + 0.5
        for what, found in ((NOT_FINITE, ~check.fine & ~beyond), (BEYOND, ~check.fine & beyond)):
            due = found if goes is None else found & goes
            place = self._place(f"{kind}{cause} {what}")
            w._stage.store_of_row("found", place, number, as_value(where(due, 1.0, -1.0)))

    def read(self, w: World, name: str) -> Check:
        """Return what :meth:`leave` left under a name."""
        code = w._scalar("found", self._place(name))
        return Check(code < 0.5, code)

    def read_observations(self, w: World, kind: str) -> list[Check]:
        """Return what observations of the step before left, or with the ``kind`` "final " those of this step."""
        checks = [self.read(w, f"{kind}observations")]
        for cause in self.apart:
            code = 1.0 + [*self.limits].index(cause)
            lost, beyond = (w._scalar("found", self._place(f"{kind}{cause} {what}")) for what in (NOT_FINITE, BEYOND))
            checks.append(Check(lost + beyond < 0.5, where(lost > 0.5, code, code + len(self.limits))))
        return checks

    def clear(self, w: World, done: Condition) -> None:
        """Forget what was found in worlds that start anew."""
        for place in self.places.values():
            w._stage.store("found", place, as_value(where(done, 0.0, -1.0)))

    def _place(self, name: str) -> int:
        return self.places.setdefault(name, len(self.places))

    def ends(self, code: Any) -> dict[str, Condition]:
        """Return, by kind of fault, whether a code is one of that kind."""
        count = len(self.limits) + 0.5
        return {NOT_FINITE: (code > 0.5) & (code < count), BEYOND: code > count}
