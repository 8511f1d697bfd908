"""Operations on trial: the inputs of each, how it is called, and its result by the dense float64 reference.

The main job, the benchmarks and their tests iterate over :data:`OPERATIONS`. Operations of Dynamics are listed by their
declarations, see :mod:`warp_spo.dynamics.operation`; operators of a scene are listed here.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from ..dynamics.dynamics import OPERATIONS as DECLARED
from ..dynamics.dynamics import Dynamics
from ..dynamics.operation import Operation
from ..dynamics.spatial_operators import EXPRESSION
from ..dynamics.trial_inputs import DT, FRAME_POSE, every_other, rotations, two_frames
from ..execution.routine import Routine
from ..reference.dense import Dense
from ..scene.scene import Scene

__all__ = ["APPLICATIONS", "DT", "FRAME_POSE", "INPUTS", "OPERATIONS", "TOLERANCE", "Inputs", "Operation"]
__all__ += ["every_other", "rotations", "two_frames"]
TOLERANCE = {
    # Largest error of an operation that counts as correct. Rounding grows with depth and with the condition of the mass
    # matrix; Newton's robots reach 3e-6 and 1e-14. A wrong result, not a rounded one, is off by 1e-2 or more.
    "float32": 1e-4,
    "float64": 1e-10,
}
INPUTS = ("q", "qd", "qdd", "tau", "b", "x", "wrenches", "q_after", "share", "parameters", "ctrl")

Shape = Callable[[Scene], tuple[int, ...]]


@dataclasses.dataclass(frozen=True)
class TrialCase:
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
        routine: the kernel that it is about; None: it calls several.
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
    routine: Routine | None = None

    def granularity(self, dyn: Dynamics) -> str:
        """Return the granularity at which a Dynamics runs it."""
        return dyn.granularity if self.routine is None else dyn.plan.of(self.routine)

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

    q: angles and lengths U(-1, 1) [rad, m], rotations uniform; q_after: as q;
    qd, qdd, b, x, wrenches, share, parameters, ctrl: N(0, 1); tau: 10 N(0, 1).

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
            if name in ("q", "q_after"):
                array = rng.uniform(-1.0, 1.0, (self.worlds, scene.coord_count))
                for first in rotations(scene):
                    turn = rng.standard_normal((self.worlds, 4))
                    array[:, first : first + 4] = turn / np.linalg.norm(turn, axis=1, keepdims=True)
            else:
                size = {
                    "x": sum(scene.node_sizes),
                    "wrenches": 12,
                    "share": 0,
                    "ctrl": len(scene.actuators),
                    "parameters": 10 * scene.body_count,
                }.get(name, scene.dof_count)
                shape = (self.worlds,) if name == "share" else (self.worlds, size)
                array = rng.standard_normal(shape, dtype=np.float32)
                array *= 10.0 if name == "tau" else 1.0
            self._arrays[name] = array.astype(np.float32)
        return self._arrays[name]

    def dense(self, world: int) -> Dense:
        """The reference at q of one world; what it computed is kept."""
        if world not in self._dense:
            self._dense[world] = self.reference(self.scene, self.array("q")[world], world=world)
        return self._dense[world]

    def expected(self, operation: TrialCase, at: Inputs, world: int) -> tuple[np.ndarray, float]:
        """What ``operation`` gives in one world for these inputs at q of ``at``; kept, for every precision to meet."""
        key = operation.name, operation.reference, at.seed, world
        if key not in self._expected:
            inputs = [self.array(name)[world] for name in operation.reads]
            self._expected[key] = operation.expected(at.dense(world), inputs)
        return self._expected[key]


def _dof(scene: Scene) -> tuple[int, ...]:
    return (scene.dof_count,)


def _nodes(scene: Scene) -> tuple[int, ...]:
    return (sum(scene.node_sizes),)


def _size(axis: str, scene: Scene) -> int:
    """Return the length of an axis of a result, for trials: of the open tree, with two frames."""
    frames = len(two_frames(scene))
    if axis.isdigit():
        return int(axis)
    if axis.endswith(" frames"):
        return int(axis.split()[0]) * frames
    dofs = scene.dof_count
    if axis.endswith(" bodies"):
        return int(axis.split()[0]) * scene.body_count
    sizes = {"coordinate": scene.coord_count, "dof": dofs, "independent dof": dofs, "body": scene.body_count}
    return {**sizes, "frame": frames}[axis]


def trial_case(operation: Operation) -> TrialCase:
    """Return a declared operation of Dynamics for trials."""
    trial, first = operation.trial, operation.results[0] if operation.results else None
    assert trial is not None
    arrays = [one for one in operation.arrays if not (one.asked or one.direction)]
    reads = trial.reads or tuple(one.sample or one.name for one in arrays)
    samples = {one.name: one.sample for one in operation.options if one.sample is not None}
    others = len(operation.results) - 1

    def call(subject: Any, *inputs: Any, out: Any) -> None:
        dyn = subject.dyn
        if trial.call is not None:
            trial.call(dyn, *inputs, out=out)
            return
        given = {one.name: array for one, array in zip(arrays, inputs, strict=True)}
        given |= {name: sample(dyn.scene) for name, sample in samples.items()}
        more = [dyn.recursions.array(f"trial of {operation.name} {i}", *out.shape) for i in range(others)]
        operation.entry(dyn, **given, out=(out, *more) if more else out)

    def reference(dense: Dense, *inputs: Any) -> Any:
        return trial.dense(dense, *inputs, *(sample(dense.scene) for sample in samples.values()))

    def shape(scene: Scene) -> tuple[int, ...]:
        axes = "world, dof" if first is None else first.axes
        return tuple(_size(axis, scene) for axis in axes.split(", ")[1:])

    more: dict[str, Any] = {} if trial.scale is None else {"scale": trial.scale}
    more |= {} if first is None else {"quaternions": first.quaternions}
    routine = operation.routine
    return TrialCase(operation.name, reads, shape, call, reference, **more, solves=trial.solves, routine=routine)


def _operator(
    name: str, of: Callable[[Any], Any], reference: Callable[..., Any], reads: str = "x", shape: Shape = _nodes
) -> TrialCase:
    """An operator of the scene, ``of(subject)``, applied to a vector over the nodes or another."""

    def call(subject: Any, x: Any, out: Any) -> None:
        of(subject).apply(x, out=out)

    return TrialCase(name, (reads,), shape, call, reference, at_first_q=True, routine=EXPRESSION)


_OPERATORS = (
    _operator("phi", lambda subject: subject.operators.phi, lambda d, x: d.phi @ x),
    _operator("phi.T", lambda subject: subject.operators.phi.T, lambda d, x: d.phi.T @ x),
    _operator("psi", lambda subject: subject.operators.psi, lambda d, x: d.psi @ x),
    _operator("mass@v", lambda subject: subject.mass, lambda d, v: d.mass_matrix @ v, "b", _dof),
    TrialCase(
        "operators.update",
        ("q", "x"),
        _nodes,
        lambda subject, q, x, out: subject.operators.update(q),
        lambda d, q, x: d.psi @ x,
        reveal=lambda subject, q, x, out: subject.operators.psi.apply(x, out=out),
        routine=EXPRESSION,
    ),
)
_MAIN = {name: trial_case(one) for name, one in DECLARED.items() if one.trial is not None and one.trial.main}
OPERATIONS = {operation.name: operation for operation in _OPERATORS} | _MAIN
"""Name -> operation, in the order of the tables that show them: operators of a scene, then calls of Dynamics."""
APPLICATIONS = {name: trial_case(one) for name, one in DECLARED.items() if one.trial is not None and name not in _MAIN}
"""The other operations of Dynamics that have a dense reference, for the same tables; each compiles a kernel."""
