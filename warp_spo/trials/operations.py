"""Every operation once: what it reads, how it is called, and what the dense float64 reference says about it.

The main job, the benchmarks and their tests iterate over :data:`OPERATIONS`; a new operation is one line there.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from ..recursions.derivatives.adjoints import inverse_dynamics_jvp
from ..recursions.links import Links
from ..recursions.tracing import Trace
from ..reference import Dense
from ..scene.scene import Scene
from ..trace.evaluation import evaluate

DT = 0.01  # time step of integrate [s]
FRAME_POSE = (0.1, -0.05, 0.2, 0.0, 0.0, 0.0, 1.0)  # of the second of the two frames, in its body [m]
WEIGHT_FLOOR = 1e-2  # gravity cannot act on some hinges: compare with at least this share of the weight, at 1 m
TOLERANCE = {
    # Largest error of an operation that counts as correct. Rounding grows with depth and with the condition of the mass
    # matrix; Newton's robots reach 3e-6 and 1e-14. What is wrong, and not rounded, is off by 1e-2 or more.
    "float32": 1e-4,
    "float64": 1e-10,
}
INPUTS = ("q", "qd", "qdd", "tau", "b", "x", "wrenches")

Shape = Callable[[Scene], tuple[int, ...]]


@dataclasses.dataclass(frozen=True)
class Operation:
    """One operation on a :class:`warp_spo.trials.trial.Subject`.

    Attributes:
        name: as users write it.
        reads: names of its inputs, see :class:`Inputs`.
        shape: of the result in one world.
        call: ``call(subject, *inputs, out)`` launches it; inputs and out are Warp arrays [world, ...].
        reference: ``reference(dense, *inputs)``, the result in one world, of that world's inputs.
        at_first_q: it is applied at the configuration of the first set of inputs (vector time).
        reveal: ``reveal(subject, *inputs, out)`` writes a result that shows what ``call`` did, where that is not out.
        quaternions: first entry of each quaternion of a flat result; q and -q are the same rotation.
        scale: ``scale(dense, expected)``, what the error is divided by: the 2-norm of the expected result unless given.
        solves: ``solves(dense, *inputs)``, the matrix A and right-hand side b of the equation A x = b that the result
            solves, if it solves one.
    """

    name: str
    reads: tuple[str, ...]
    shape: Shape
    call: Callable[..., Any]
    reference: Callable[..., Any]
    at_first_q: bool = False
    reveal: Callable[..., Any] | None = None
    quaternions: Callable[[Scene], list[int]] = lambda scene: []
    scale: Callable[[Dense, np.ndarray], float] = lambda dense, expected: float(np.linalg.norm(expected))
    solves: Callable[..., tuple[np.ndarray, np.ndarray]] | None = None

    def expected(self, dense: Dense, inputs: list[np.ndarray]) -> tuple[np.ndarray, float]:
        """The result in one world, flat, and what an error is divided by; NaN if the reference cannot compute it."""
        try:
            expected = np.ravel(self.reference(dense, *inputs))
            return expected, self.scale(dense, expected)
        except np.linalg.LinAlgError:  # a hinge that moves no inertia
            return np.full(1, np.nan), float("nan")

    def error(
        self,
        dense: Dense,
        inputs: list[np.ndarray],
        result: np.ndarray,
        expected: tuple[np.ndarray, float] | None = None,
    ) -> float:
        """``|result - expected| / |expected|`` in one world, 2-norms; NaN if the reference cannot be computed.

        ``expected``: what :meth:`expected` returns, where it is known already.
        """
        wanted, scale = expected or self.expected(dense, inputs)
        if not np.isfinite(scale):
            return float("nan")
        result = result.astype(np.float64).ravel()
        for first in self.quaternions(dense.scene):
            if result[first : first + 4] @ wanted[first : first + 4] < 0.0:
                result[first : first + 4] *= -1.0
        return float(np.linalg.norm(result - wanted) / (scale if scale > 0.0 else 1.0))

    def backward_error(self, dense: Dense, inputs: list[np.ndarray], result: np.ndarray) -> float:
        """``|A x - b| / (|A| |x| + |b|)`` in one world, in float64: 2-norms, Frobenius where x is a matrix.

        How much the equation would have to change for the result to be exact; it does not grow with the condition of A.
        """
        assert self.solves is not None, f"{self.name} solves no equation"
        A, b = self.solves(dense, *inputs)
        if not len(A):
            return 0.0
        x, b = result.astype(np.float64).reshape(len(A), -1), b.reshape(len(A), -1)
        size = np.linalg.norm(A, 2) * np.linalg.norm(x) + np.linalg.norm(b)
        return float(np.linalg.norm(A @ x - b) / (size if size > 0.0 else 1.0))


class Inputs:
    """Random inputs in all worlds, and the reference at them. They are float32 numbers: exact in either precision.

    q: angles and lengths U(-1, 1) [rad, m], rotations uniform; qd, qdd, b, x, wrenches: N(0, 1); tau: 10 N(0, 1).

    Args:
        scene: whose inputs.
        worlds: how many.
        seed: equal seeds, equal inputs; each input has its own stream.
        reference: ``reference(scene, q, world=world)``, the reference at q of one world.
    """

    def __init__(self, scene: Scene, worlds: int, seed: int = 0, reference: Callable[..., Any] = Dense):
        self.scene, self.worlds, self.seed, self.reference = scene, worlds, seed, reference
        self._arrays: dict[str, np.ndarray] = {}
        self._dense: dict[int, Dense] = {}
        self._expected: dict[tuple, tuple[np.ndarray, float]] = {}

    def array(self, name: str) -> np.ndarray:
        """Input ``name`` [world, n], float32."""
        if name not in self._arrays:
            scene, rng = self.scene, np.random.default_rng([self.seed, INPUTS.index(name)])
            array: np.ndarray
            if name == "q":
                array = rng.uniform(-1.0, 1.0, (self.worlds, scene.coord_count))
                for first in rotations(scene):
                    turn = rng.standard_normal((self.worlds, 4))
                    array[:, first : first + 4] = turn / np.linalg.norm(turn, axis=1, keepdims=True)
            else:
                size = {"x": sum(scene.node_sizes), "wrenches": 12}.get(name, scene.dof_count)
                array = rng.standard_normal((self.worlds, size), dtype=np.float32)
                array *= 10.0 if name == "tau" else 1.0
            self._arrays[name] = array.astype(np.float32)
        return self._arrays[name]

    def dense(self, world: int) -> Dense:
        """The reference at q of one world; what it computed is kept."""
        if world not in self._dense:
            self._dense[world] = self.reference(self.scene, self.array("q")[world], world=world)
        return self._dense[world]

    def expected(self, operation: Operation, at: Inputs, world: int) -> tuple[np.ndarray, float]:
        """What ``operation`` gives in one world for these inputs at q of ``at``; kept, for every precision to meet."""
        key = operation.name, operation.reference, at.seed, world
        if key not in self._expected:
            inputs = [self.array(name)[world] for name in operation.reads]
            self._expected[key] = operation.expected(at.dense(world), inputs)
        return self._expected[key]


def rotations(scene: Scene) -> list[int]:
    """First entry in q of every quaternion."""
    starts = zip(scene.hinges, scene.q_start, strict=False)
    return [int(start) + first for hinge, start in starts for first in hinge.quaternions]


def two_frames(scene: Any) -> list:
    """Two frames for Jacobians: a tip's body frame, and one off the body frame of another tip, or of another body."""
    parents = {hinge.parent for hinge in scene.hinges}
    bodies = sorted(range(len(scene.hinges)), key=lambda body: (body in parents, body))[:2]
    return [bodies[0], (bodies[-1], FRAME_POSE)]


def _dof(scene: Scene) -> tuple[int, ...]:
    return (scene.dof_count,)


def _square(scene: Scene) -> tuple[int, ...]:
    return scene.dof_count, scene.dof_count


def _nodes(scene: Scene) -> tuple[int, ...]:
    return (sum(scene.node_sizes),)


def _weight_floor(dense: Dense, expected: np.ndarray) -> float:
    weight = float(np.sum(dense.value("body_mass")) * np.linalg.norm(dense.value("gravity")))
    return max(float(np.linalg.norm(expected)), WEIGHT_FLOOR * weight)


def _method(name: str, reads: str, shape: Shape, reference: Callable[..., Any], *extra: Any, **more: Any) -> Operation:
    """An operation of Dynamics; ``extra`` are further arguments, a function of the scene if callable."""

    def call(subject: Any, *inputs: Any, out: Any) -> None:
        given = [value(subject.dyn.scene) if callable(value) else value for value in extra]
        getattr(subject.dyn, name)(*inputs, *given, out=out)

    return Operation(name, tuple(reads.split()), shape, call, reference, **more)


def _operator(
    name: str, of: Callable[[Any], Any], reference: Callable[..., Any], reads: str = "x", shape: Shape = _nodes
) -> Operation:
    """An operator of the scene, ``of(subject)``, applied to a vector over the nodes or another."""

    def call(subject: Any, x: Any, out: Any) -> None:
        of(subject).apply(x, out=out)

    return Operation(name, (reads,), shape, call, reference, at_first_q=True)


_TABLE = (
    _operator("phi", lambda subject: subject.operators.phi, lambda d, x: d.phi @ x),
    _operator("phi.T", lambda subject: subject.operators.phi.T, lambda d, x: d.phi.T @ x),
    _operator("psi", lambda subject: subject.operators.psi, lambda d, x: d.psi @ x),
    _operator("mass@v", lambda subject: subject.mass, lambda d, v: d.mass_matrix @ v, "b", _dof),
    Operation(
        "operators.update",
        ("q", "x"),
        _nodes,
        lambda subject, q, x, out: subject.operators.update(q),
        lambda d, q, x: d.psi @ x,
        reveal=lambda subject, q, x, out: subject.operators.psi.apply(x, out=out),
    ),
    _method(
        "forward_dynamics",
        "q qd tau",
        _dof,
        lambda d, q, qd, tau: d.forward_dynamics(qd, tau),
        solves=lambda d, q, qd, tau: (d.mass_matrix, tau - d.bias_force(qd)),
    ),
    _method("inverse_dynamics", "q qd qdd", _dof, lambda d, q, qd, qdd: d.inverse_dynamics(qd, qdd)),
    _method("mass_matrix", "q", _square, lambda d, q: d.mass_matrix),
    _method(
        "mass_matrix_inverse",
        "q",
        _square,
        lambda d, q: np.linalg.inv(d.mass_matrix),
        solves=lambda d, q: (d.mass_matrix, np.eye(len(d.mass_matrix))),
    ),
    _method(
        "solve_mass_matrix",
        "q b",
        _dof,
        lambda d, q, b: np.linalg.solve(d.mass_matrix, b),
        solves=lambda d, q, b: (d.mass_matrix, b),
    ),
    _method("bias_force", "q qd", _dof, lambda d, q, qd: d.bias_force(qd), scale=_weight_floor),
    _method("gravity_force", "q", _dof, lambda d, q: d.gravity_force, scale=_weight_floor),
    _method("passive_force", "q qd", _dof, lambda d, q, qd: d.passive_force(qd)),
    # absolute: the relative error of the determinant
    _method("log_det_mass_matrix", "q", lambda scene: (), lambda d, q: d.log_det, scale=lambda d, expected: 1.0),
    _method(
        "body_poses",
        "q",
        lambda scene: (scene.body_count, 7),
        lambda d, q: d.body_poses,
        quaternions=lambda scene: [7 * body + 3 for body in range(len(scene.hinges))],
    ),
    _method("body_velocities", "q qd", lambda scene: (scene.body_count, 6), lambda d, q, qd: d.body_velocities(qd)),
    _method(
        "jacobian",
        "q",
        lambda scene: (2, 6, scene.dof_count),
        lambda d, q: d.jacobian(two_frames(d.scene)),
        two_frames,
    ),
    _method(
        "operational_inertia_inverse",
        "q",
        lambda scene: (12, 12),
        lambda d, q: d.operational_inertia_inverse(two_frames(d.scene)),
        two_frames,
    ),
    _method(
        "integrate",
        "q qd",
        lambda scene: (scene.coord_count,),
        lambda d, q, qd: d.integrate(qd, DT),
        DT,
        quaternions=rotations,
    ),
)
OPERATIONS = {operation.name: operation for operation in _TABLE}
"""Name -> operation, in the order of the tables that show them."""


def every_other(scene: Scene) -> np.ndarray:
    """The mask of hybrid_dynamics in trials: dofs 1, 3, 5 ... are prescribed."""
    return np.arange(scene.dof_count) % 2 == 1


def _hybrid(subject: Any, q: Any, qd: Any, tau: Any, qdd: Any, out: Any) -> None:
    dyn = subject.dyn
    forces = dyn.recursions.array("trial of hybrid_dynamics", dyn.worlds, dyn.scene.dof_count)
    dyn.hybrid_dynamics(q, qd, tau, qdd, prescribed=every_other(dyn.scene), out=(out, forces))


def _inverse_derivatives(dense: Dense, qd: np.ndarray, qdd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """d tau / d q along tangent coordinates and d tau / d qd: Newton-Euler's trace differentiated step by step.

    Not the recursion that the operation runs, which takes the dense reference too long to difference.
    """
    scene, n = dense.scene, dense.scene.dof_count
    one = scene.with_values(**{name: value[dense.world : dense.world + 1] for name, value in scene.values.items()
                               if value.shape[0] > 1})  # fmt: skip
    arrays = {"q": dense.q, "qd": qd, "qdd": qdd}
    directions = {"q_dot": np.eye(2 * n, n), "qd_dot": np.eye(2 * n, n, -n)}  # [direction, dof]
    stores = inverse_dynamics_jvp(Trace(Links(one), "float64", (*arrays, *directions)))
    values = evaluate(
        [item.value for item in stores],
        lambda name, at: directions[name][:, at[0]] if name in directions else float(arrays[name][at[0]]),
    )
    J = np.zeros((n, 2 * n))
    for item, value in zip(stores, values, strict=True):
        J[item.index[0]] = value
    return J[:, :n], J[:, n:]


def _forward_derivative(dense: Dense, q: np.ndarray, qd: np.ndarray, tau: np.ndarray) -> np.ndarray:
    by_q, _ = _inverse_derivatives(dense, qd, dense.forward_dynamics(qd, tau))
    return -np.linalg.solve(dense.mass_matrix, by_q)


def _derivatives(name: str) -> Callable[..., None]:
    """Call an operation with three results, of which the one by q is looked at."""

    def call(subject: Any, *inputs: Any, out: Any) -> None:
        dyn = subject.dyn
        others = (dyn.recursions.array(f"trial of {name} {i}", *out.shape) for i in range(2))
        getattr(dyn, name)(*inputs, out=(out, *others))

    return call


def _pulled_back(subject: Any, q: Any, qd: Any, tau: Any, b: Any, out: Any) -> None:
    dyn = subject.dyn
    others = {name: dyn.recursions.array(f"trial of vjp {name}", *tau.shape) for name in ("qd", "tau")}
    dyn.forward_dynamics_vjp(q, qd, tau, cotangent=b, wrt=("tangent", *others), out={"tangent": out, **others})


_APPLICATIONS = (
    Operation(
        "hybrid_dynamics",
        ("q", "qd", "tau", "qdd"),
        _dof,
        _hybrid,
        lambda d, q, qd, tau, qdd: d.hybrid_dynamics(qd, tau, qdd, every_other(d.scene))[0],
    ),
    _method(
        "jacobian_bias",
        "q qd",
        lambda scene: (2, 6),
        lambda d, q, qd: d.jacobian_bias(qd, two_frames(d.scene)),
        two_frames,
    ),
    _method(
        "frame_accelerations",
        "q qd qdd",
        lambda scene: (2, 6),
        lambda d, q, qd, qdd: d.jacobian(two_frames(d.scene)) @ qdd + d.jacobian_bias(qd, two_frames(d.scene)),
        two_frames,
    ),
    _method(
        "operational_inertia_inverse_product",
        "q wrenches",
        lambda scene: (2, 6),
        lambda d, q, x: d.operational_inertia_inverse(two_frames(d.scene)) @ x,
        two_frames,
    ),
    _method("com_jacobian", "q", lambda scene: (3, scene.dof_count), lambda d, q: d.com_jacobian),
    _method(
        "centroidal_momentum_matrix",
        "q",
        lambda scene: (6, scene.dof_count),
        lambda d, q: d.centroidal_momentum_matrix,
    ),
    _method("centroidal_momentum_bias", "q qd", lambda scene: (6,), lambda d, q, qd: d.centroidal_momentum_bias(qd)),
    _method("quasi_velocities", "q qd", _dof, lambda d, q, qd: d.quasi_velocities(qd)),
    Operation(
        "inverse_dynamics_derivatives",
        ("q", "qd", "qdd"),
        _square,
        _derivatives("inverse_dynamics_derivatives"),
        lambda d, q, qd, qdd: _inverse_derivatives(d, qd, qdd)[0],
    ),
    Operation(
        "forward_dynamics_derivatives",
        ("q", "qd", "tau"),
        _square,
        _derivatives("forward_dynamics_derivatives"),
        _forward_derivative,
    ),
    Operation(
        "forward_dynamics_vjp",
        ("q", "qd", "tau", "b"),
        _dof,
        _pulled_back,
        lambda d, q, qd, tau, b: _forward_derivative(d, q, qd, tau).T @ b,
    ),
    _method("fixman_torque", "q", _dof, lambda d, q: d.fixman_torque, scale=lambda d, e: max(1.0, np.linalg.norm(e))),
)
APPLICATIONS = {operation.name: operation for operation in _APPLICATIONS}
"""The operations of ``dynamics.applications`` that every scene has, for the same tables; each compiles a kernel."""
