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
from typing import TYPE_CHECKING

from ...trace.differentiation import reverse
from ...trace.emission import Store
from ...trace.scalars import Entry, Scalar, Value, cut, is_constant, ordered
from ...trace.spatial import ZERO, total
from .. import newton_euler
from ..articulated_sweeps import NO_TERMS, StepTerms
from ..derivatives import adjoints
from ..derivatives.adjoints import TreeEquations, gradient_stores, rates_along
from ..derivatives.power import Gradients, Power
from .closed_step import ClosedStep
from .clusters import Cluster, Columns
from .embedded import ClosedLoops, Embedding
from .minimal import accelerations, columns_of_all
from .nullspace import NullSpace
from .projection import place_links

if TYPE_CHECKING:
    from ..model.tracing import Trace


class ClosedEquations(TreeEquations):
    """The equations that accelerations solve where loops are embedded.

    Attributes:
        loops: the closed loops.
        fixed: dofs that the closures do not move: the multipliers are solved with the columns of Y of the others alone.
    """

    def __init__(self, trace: Trace, embedding: Embedding, fixed: tuple[int, ...] = ()):
        super().__init__(trace)
        self.loops, self.fixed = ClosedLoops(trace, embedding), fixed

    def solve(self, right: Entry, terms: StepTerms = NO_TERMS) -> Columns:
        """Return X (X* Mass X)^-1 X* ``right``, by dof; Mass with what a time step adds to it, ``terms``."""
        swept = self.loops.sweep(right, moves=False, loads=False, terms=terms)
        return self.loops.outward_accelerations(swept, (ZERO, ZERO))

    def gradient(self, solved: Columns, qdd: Entry, tau: Entry, right: Entry) -> Gradients:
        """Return the gradient of the open tree's equations with the terms of the closures added."""
        trace = self.trace
        power = Power(trace, lambda dof: -solved[dof], qdd)
        for cluster in self.loops.clusters:
            constrained = self.loops.constrain(cluster, self.fixed)
            self.loops.label(cluster, "m")
            mu = constrained.space.multipliers(lambda dof: power.forces[dof] - tau(dof))
            nu = constrained.space.multipliers(lambda dof: right(dof) + power.gradients.get(("qdd", dof), 0.0))
            rates = {dof: cut(qdd(dof)) for dof in cluster.dofs}
            weights = {dof: cut(solved[dof]) for dof in cluster.dofs}
            outputs = constrained.accelerations(trace.places, None, weights.__getitem__)
            outputs += constrained.accelerations(trace.places, velocities(trace), rates.__getitem__)
            stops = _distinct([*rates.values(), *weights.values()])
            leaves = [x for x in ordered(outputs, stops) if x.op == "input"]
            back = reverse(outputs, [*leaves, *stops], [*mu, *(-x for x in nu)])
            found = [(x.args, gradient) for x, gradient in zip(leaves, back, strict=False)]
            found += [
                (("qdd", dof), -(x * y)) for row, y in zip(constrained.rows, nu, strict=True) for dof, x in row.items()
            ]
            for entry, gradient in found:
                power.gradients[entry] = power.gradients.get(entry, 0.0) + gradient
        return power.gradients

    def project_state(self, stores: list[Store]) -> list[Store]:
        """Return a state after a step, projected onto the closures."""
        return ClosedStep(self.trace, self.loops.embedding).project_state(stores)


def velocities(trace: Trace) -> Entry | None:
    """Return the entries of qd; None where velocities are zero."""
    return trace.vector("qd") if "qd" in trace.inputs else None


def forward_dynamics_vjp(trace: Trace, embedding: Embedding, wrt: tuple[str, ...]) -> list[Store]:
    """Return stores of J* cotangent by the arguments ``wrt``, J the Jacobian of forward dynamics with result "qdd"."""
    equations, y = ClosedEquations(trace, embedding), trace.vector("cotangent")
    solved = equations.solve(y)
    found = equations.gradient(solved, trace.vector("qdd"), trace.vector("tau"), y)
    found |= {("tau", dof): value for dof, value in solved.items()}
    return gradient_stores(trace, found, wrt, wrt)


def inverse_dynamics_vjp(trace: Trace, embedding: Embedding, wrt: tuple[str, ...]) -> list[Store]:
    """Return stores of J* cotangent by the arguments ``wrt``, J the Jacobian of inverse dynamics in independent dofs.

    That function is X* (Mass qdd + bias_force) [independent dof], at the qdd = X qdd_independent + k that the closures
    allow. The gradient is the one of the file's docstring with lambda = -X cotangent and with tau and y zero; the
    multipliers mu and nu, solved with the columns of Y of the dependent dofs alone, stand for how X depends on q.
    """
    equations, cotangent = ClosedEquations(trace, embedding, embedding.dofs), trace.vector("cotangent")
    place_links(trace, "qd" in trace.inputs)
    lam = dict.fromkeys(range(trace.links.scene.dof_count), 0.0)  # lambda, by dof
    qdd = accelerations(equations.loops)
    for independent, column in columns_of_all(equations.loops).items():
        for dof, x in column.items():
            lam[dof] = lam[dof] - x * cotangent(embedding.dofs.index(independent))
    zero: Entry = lambda dof: 0.0  # noqa: E731
    gradients = equations.gradient(lam, qdd.__getitem__, tau=zero, right=zero)
    gradients |= {("qdd", dof): 0.0 for dof in qdd if dof not in embedding.dofs}  # qdd of dependent dofs is not read
    return gradient_stores(trace, gradients, wrt, wrt)


def step_vjp(trace: Trace, embedding: Embedding, wrt: tuple[str, ...]) -> list[Store]:
    """J* of a step, as :func:`.adjoints.step_vjp`, and through the projection onto the closures"""
    return adjoints.step_vjp(trace, wrt, ClosedEquations(trace, embedding))


def forward_dynamics_jvp(trace: Trace, embedding: Embedding) -> list[Store]:
    """out = J x of forward dynamics at the accelerations "qdd", x as in :func:`.adjoints.forward_dynamics_jvp`"""
    loops, qdd, push = ClosedLoops(trace, embedding), trace.vector("qdd"), trace.vector("tau_dot")
    place_links(trace, "qd" in trace.inputs)
    still = {dof: qdd(dof) for dof in range(trace.links.scene.dof_count)}
    rates, steps = _rates_at_fixed_accelerations(loops, (), still, trace.vector("tau"))

    def allowed(cluster: Cluster) -> tuple[NullSpace, Columns]:
        return loops.constrain(cluster).space, steps

    swept = loops.sweep(lambda dof: push(dof) - rates[dof], moves=False, loads=False, allowed=allowed)
    return [Store("out", (dof,), x) for dof, x in loops.outward_accelerations(swept, (ZERO, ZERO)).items()]


def inverse_dynamics_jvp(trace: Trace, embedding: Embedding) -> list[Store]:
    """out [independent dof] = J x of inverse dynamics, x as in :func:`.adjoints.inverse_dynamics_jvp`"""
    loops, push = ClosedLoops(trace, embedding), trace.vector("qdd_dot")
    place_links(trace, "qd" in trace.inputs)
    still = {dof: cut(x) for dof, x in accelerations(loops).items()}
    rates, steps = _rates_at_fixed_accelerations(loops, embedding.dofs, still, lambda dof: 0.0)
    X, change = columns_of_all(loops), {dof: steps.get(dof, 0.0) for dof in still}
    for free, column in X.items():
        for dof, x in column.items():
            change[dof] = change[dof] + x * push(free)
    trace.inputs = ("q",)  # at rest, without loads: Mass times the change
    for item in newton_euler.inverse_dynamics(trace, gravity=False, qdd=change.__getitem__):
        rates[item.index[0]] = rates[item.index[0]] + item.value
    return [Store("out", (i,), total(x * rates[k] for k, x in X[dof].items())) for i, dof in enumerate(embedding.dofs)]


def _rates_at_fixed_accelerations(
    loops: ClosedLoops, fixed: tuple[int, ...], qdd: Columns, tau: Entry
) -> tuple[Columns, Columns]:
    """Return the rate of Mass qdd + bias_force - Y* mu at fixed ``qdd`` and mu, and the rate that qdd needs, by dof."""
    trace = loops.trace
    forces = {item.index[0]: item.value for item in newton_euler.inverse_dynamics(trace, qdd=qdd.__getitem__)}
    left, still = dict(forces), [*qdd.values()]
    constrained, demands = [], []
    for cluster in loops.clusters:
        one = loops.constrain(cluster, fixed)
        loops.label(cluster, "m")
        mu = [cut(x) for x in one.space.multipliers(lambda dof: forces[dof] - tau(dof))]
        for dof in cluster.dofs:
            left[dof] = left[dof] - total(row.get(dof, 0.0) * x for row, x in zip(one.rows, mu, strict=True))
        still += mu
        demands += one.accelerations(trace.places, velocities(trace), qdd.__getitem__)
        constrained.append(one)
    pushed = iter(rates_along(trace, [*left.values(), *demands], _distinct(still)))
    rates = {dof: next(pushed) for dof in left}
    steps: Columns = {}
    for one in constrained:
        steps |= one.space.particular([-next(pushed) for _ in one.numbers])
    return rates, steps


def _distinct(values: Iterable[Value]) -> list[Scalar]:
    """Return the scalars among values, each once."""
    return [*{x.key: x for x in values if not is_constant(x)}.values()]
