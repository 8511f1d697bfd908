"""Mass and bias force of a system of few dofs, formed once and solved for many diagonals: Mass + Delta = U D U*.

The sweeps give the same factors, [I + H phi K] D [I + H phi K]*, in O(dof), but start from the links each time. Where
only Delta changes from solve to solve and dofs are few, factoring the entries of Mass takes less work. Elimination from
the leaves fills in no entry that the tree leaves zero; with another numbering of the dofs it fills in a few.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from ...trace.scalars import Value, nan_unless_above, reciprocal
from ..composite import mass_matrix
from ..newton_euler import inverse_dynamics

if TYPE_CHECKING:
    from ..model.tracing import Trace

Entries = dict[tuple[int, int], Value]  # (row, column), row <= column


class JointSpace:
    """Mass, and bias force less the loads, at the state of a trace; without velocity terms if not ``moves``.

    Attributes:
        mass: entries of the upper triangle that the tree allows. bias: by dof.
    """

    def __init__(self, trace: Trace, moves: bool = True):
        self.trace, self.dofs = trace, range(trace.links.scene.dof_count)
        self.mass: Entries = {
            (item.index[0], item.index[1]): item.value for item in mass_matrix(trace) if item.index[0] <= item.index[1]
        }
        self.bias = {item.index[0]: item.value for item in inverse_dynamics(trace, qdd=lambda dof: 0.0, moves=moves)}

    def solve(self, delta: Callable[[int], Value], b: Callable[[int], Value]) -> list[Value]:
        """Return (Mass + diag(delta))^-1 (b - bias), by dof; NaN where a pivot is not positive beyond rounding."""
        U, x = dict(self.mass), [b(dof) - self.bias[dof] for dof in self.dofs]
        inverse: dict[int, Value] = {}
        for k in self.dofs:
            U[k, k] = U[k, k] + delta(k)
        sizes = {k: U[k, k] for k in self.dofs}
        for k in reversed(self.dofs):
            self.trace.graph.step = f"dof {k}|D"
            inverse[k] = reciprocal(nan_unless_above(U[k, k], 4.0 * self.trace.epsilon * sizes[k]))
            above = [i for i in self.dofs[:k] if (i, k) in U]
            column = {i: U[i, k] * inverse[k] for i in above}
            for i in above:
                x[i] = x[i] - column[i] * x[k]
                for j in above:
                    if i <= j:
                        U[i, j] = U.get((i, j), 0.0) - column[i] * U[j, k]
            U |= {(i, k): column[i] for i in above}
        for k in self.dofs:
            self.trace.graph.step = f"dof {k}|u"
            x[k] = x[k] * inverse[k]
            for i in self.dofs[:k]:
                if (i, k) in U:
                    x[k] = x[k] - U[i, k] * x[i]
        return x
