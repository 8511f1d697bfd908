"""Products with Jacobians of the dynamics, J* y and J x, where loops are embedded, as traces.

No basis is gone back through, only what accelerations solve: with multipliers mu of the closures that count,

    Mass qdd + bias_force = tau + Y* mu,  Y qdd + Y' qd = 0.

With lambda and nu that solve the same for a cotangent y, Mass lambda + Y* nu = y, Y lambda = 0, the gradient is lambda
for tau, and that of lambda . (tau - Mass qdd - bias_force) + mu . Y lambda - nu . (Y qdd + Y' qd) for everything else,
lambda, mu, nu and qdd staying as they are. The same solve gives J x. Both hold off the closures, too, and where a basis
of X has a jump. Inverse dynamics in independent dofs has the same form, with columns of Y for the other dofs alone.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from ...trace.differentiation import reverse
from ...trace.emission import Store
from ...trace.scalars import Scalar, Value, cut, is_constant, ordered
from ...trace.spatial import ZERO, total
from ..derivatives.adjoints import Adjoints
from ..derivatives.power import Entry, Power, Ways
from .closed_step import ClosedStep
from .clusters import Cluster, Columns
from .embedded import Embedding
from .minimal import Minimal
from .nullspace import NullSpace


class EmbeddedAdjoints(Adjoints, Minimal):
    """The operations of :class:`.adjoints.Adjoints` and :class:`Minimal`, and products with Jacobians of the latter.

    Attributes:
        how: the embedding, where an operation has its loops embedded. held: dofs that closures do not move there.
    """

    how: Any = None
    held: tuple[int, ...] = ()

    @property
    def rates(self) -> Entry | None:
        return self.vector("qd") if "qd" in self.given else None

    # -- backwards -------------------------------------------------------------------------------------------------
    def embedded_forward_dynamics_vjp(self, how: Embedding, wrt: tuple[str, ...]) -> list[Store]:
        """J* cotangent of forward dynamics, whose result is "qdd", for the arguments ``wrt``"""
        self.how, y = how, self.vector("cotangent")
        solved = self.solved(y)
        found = self.ways(solved, self.vector("qdd"), self.vector("tau"), y)
        found |= {("tau", dof): value for dof, value in solved.items()}
        return self._named_stores(found, wrt, wrt)

    def embedded_inverse_dynamics_vjp(self, how: Embedding, wrt: tuple[str, ...]) -> list[Store]:
        """J* cotangent [independent dof] of inverse dynamics: lambda = -X cotangent, which lets independent dofs be"""
        self.how, self.held, y = how, how.dofs, self.vector("cotangent")
        self.place_links("qd" in self.given)
        solved, qdd = dict.fromkeys(range(self.links.scene.dof_count), 0.0), self.minimal_accelerations(how)
        for free, column in self.minimal_columns(how).items():
            for dof, x in column.items():
                solved[dof] = solved[dof] - x * y(how.dofs.index(free))
        found = self.ways(solved, qdd.__getitem__, lambda dof: 0.0, lambda dof: 0.0)
        found |= {("qdd", dof): 0.0 for dof in qdd if dof not in how.dofs}
        return self._named_stores(found, wrt, wrt)

    def embedded_step_vjp(self, how: Embedding, wrt: tuple[str, ...]) -> list[Store]:
        """As step_vjp, and through the way back onto the closures"""
        self.how = how
        return self.step_vjp(wrt)

    def put_back(self, stores: list[Store]) -> list[Store]:
        return stores if self.how is None else ClosedStep(self, self.how).put_back(stores)

    def solved(self, right: str | Entry) -> Columns:
        if self.how is None:
            return super().solved(right)
        entry = self.vector(right) if isinstance(right, str) else right
        return self.outward_accelerations(self.sweep(self.how, entry, moves=False, loads=False), (ZERO, ZERO))

    def ways(self, solved: Columns, qdd: Entry, tau: Entry, right: Entry) -> Ways:
        """Those of the tree, and what the closures add."""
        if self.how is None:
            return super().ways(solved, qdd, tau, right)
        power = Power(self, lambda dof: -solved[dof], qdd)
        for cluster in self.clusters:
            tied = self.tied(cluster, self.how, self.held)
            self.at_cluster(cluster, "m")
            mu = tied.space.multipliers(lambda dof: power.forces[dof] - tau(dof))
            nu = tied.space.multipliers(lambda dof: right(dof) + power.ways.get(("qdd", dof), 0.0))
            rates = {dof: cut(qdd(dof)) for dof in cluster.dofs}
            weights = {dof: cut(solved[dof]) for dof in cluster.dofs}
            outputs = tied.accelerations(self.places, None, weights.__getitem__)
            outputs += tied.accelerations(self.places, self.rates, rates.__getitem__)
            stops = _apart([*rates.values(), *weights.values()])
            leaves = [x for x in ordered(outputs, stops) if x.op == "input"]
            back = reverse(outputs, [*leaves, *stops], [*mu, *(-x for x in nu)])
            found = [(x.args, way) for x, way in zip(leaves, back, strict=False)]
            found += [(("qdd", dof), -(x * y)) for row, y in zip(tied.rows, nu, strict=True) for dof, x in row.items()]
            for entry, way in found:
                power.ways[entry] = power.ways.get(entry, 0.0) + way
        return power.ways

    # -- forwards --------------------------------------------------------------------------------------------------
    def embedded_forward_dynamics_jvp(self, how: Embedding) -> list[Store]:
        """out = J x of forward dynamics at the accelerations "qdd", x as in :meth:`forward_dynamics_jvp`"""
        self.how, qdd, push = how, self.vector("qdd"), self.vector("tau_dot")
        self.place_links("qd" in self.given)
        still = {dof: qdd(dof) for dof in range(self.links.scene.dof_count)}
        rates, steps = self._pushed_apart(still, self.vector("tau"))

        def allowed(cluster: Cluster) -> tuple[NullSpace, Columns]:
            return self.tied(cluster, how).space, steps

        swept = self.sweep(how, lambda dof: push(dof) - rates[dof], moves=False, loads=False, allowed=allowed)
        return [Store("out", (dof,), x) for dof, x in self.outward_accelerations(swept, (ZERO, ZERO)).items()]

    def embedded_inverse_dynamics_jvp(self, how: Embedding) -> list[Store]:
        """out [independent dof] = J x of inverse dynamics, x as in :meth:`inverse_dynamics_jvp`"""
        self.how, self.held, push = how, how.dofs, self.vector("qdd_dot")
        self.place_links("qd" in self.given)
        still = {dof: cut(x) for dof, x in self.minimal_accelerations(how).items()}
        rates, steps = self._pushed_apart(still, lambda dof: 0.0)
        X, change = self.minimal_columns(how), {dof: steps.get(dof, 0.0) for dof in still}
        for free, column in X.items():
            for dof, x in column.items():
                change[dof] = change[dof] + x * push(free)
        self.given = ("q",)  # at rest, without loads: Mass times the change
        for item in self.inverse_dynamics(gravity=False, qdd=change.__getitem__):
            rates[item.index[0]] = rates[item.index[0]] + item.value
        return [
            Store("out", (i,), total(x * rates[dof] for dof, x in X[free].items())) for i, free in enumerate(how.dofs)
        ]

    def _pushed_apart(self, qdd: Columns, tau: Entry) -> tuple[Columns, Columns]:
        """By dof, while ``qdd`` and mu stay: how Mass qdd + bias_force - Y* mu changes; what qdd has to change by."""
        forces = {item.index[0]: item.value for item in self.inverse_dynamics(qdd=qdd.__getitem__)}
        left, still = dict(forces), [*qdd.values()]
        tied, demands = [], []
        for cluster in self.clusters:
            one = self.tied(cluster, self.how, self.held)
            self.at_cluster(cluster, "m")
            mu = [cut(x) for x in one.space.multipliers(lambda dof: forces[dof] - tau(dof))]
            for dof in cluster.dofs:
                left[dof] = left[dof] - total(row.get(dof, 0.0) * x for row, x in zip(one.rows, mu, strict=True))
            still += mu
            demands += one.accelerations(self.places, self.rates, qdd.__getitem__)
            tied.append(one)
        pushed = iter(self.along([*left.values(), *demands], _apart(still)))
        rates = {dof: next(pushed) for dof in left}
        steps: Columns = {}
        for one in tied:
            steps |= one.space.particular([-next(pushed) for _ in one.numbers])
        return rates, steps


def _apart(values: Iterable[Value]) -> list[Scalar]:
    """The scalars among values, each once."""
    return [*{x.key: x for x in values if not is_constant(x)}.values()]
