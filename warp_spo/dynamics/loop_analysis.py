"""Facts about the loops of a scene, found once on the host: which rows and which dofs are independent.

Random configurations are moved onto the closures by damped least squares in float64. The Jacobians of the closures at
these samples give the rank and the independent dofs. The random numbers are the same every time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import UnsupportedError, as_integer, shown
from ..recursions.loops.closures import closures, one_world
from ..recursions.loops.clusters import clusters
from ..recursions.loops.embedded import Embedding
from ..recursions.loops.projection import closure_error, closure_jacobian, move
from ..recursions.model.links import Links
from ..recursions.model.tracing import Trace
from ..scene.parts import UNLIMITED
from ..scene.scene import Scene
from ..trace.evaluation import evaluate

SAMPLES = 64
STEPS = 60
CLOSED = 1e-9  # largest g of a configuration that counts as closed [m, rad]
RANK = 1e-7  # singular values below this share of the largest are zero: the rows are redundant
MARGIN = 100.0  # by which the square of a singular value that counts is above the error that the closures are left with
WORST = 0.1  # share of the draws that a choice may serve worse than it is said to
NEARLY = 0.3  # share of the best choice's hold that an earlier dof must have
NAMED = 6  # bodies that an error lists
MOST_DOFS = 32  # of a cluster: its D costs their cube, in straight-line code


class ClosureEvaluator:
    """The closures of a scene in one world, evaluated by NumPy at many configurations.

    Attributes:
        clusters: the sets of links that loops and couplings tie.
        size: rows of all closures.
    """

    def __init__(self, scene: Scene):
        self.scene = one_world(scene)
        trace = Trace(Links(self.scene), "float64", ("q", "step"))
        constraints = closures(trace.links)
        self.clusters = clusters(trace.links, constraints)
        self.size = sum(constraint.rows for constraint in constraints)
        self._error, self._jacobian = closure_error(trace), closure_jacobian(trace)
        self._sizes = [size for constraint in constraints for size in constraint.sizes(trace.places)]
        step = trace.vector("step")
        self._moved = [
            (link.coordinate + i, value)
            for link in trace.links.leaders
            for i, value in enumerate(move(trace, link, [step(dof) for dof in link.dofs]))
        ]

    def at(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return g [sample, row] and Y [sample, row, dof] at q [sample, coordinate]."""
        stores = self._error + self._jacobian
        values = evaluate([item.value for item in stores], lambda _, index: q[:, index[0]])
        g, Y = np.zeros((len(q), self.size)), np.zeros((len(q), self.size, self.scene.dof_count))
        for item, value in zip(stores, values, strict=True):
            into: Any = g if len(item.index) == 1 else Y
            into[(slice(None), *item.index)] = value
        return g, Y

    def sizes(self, q: np.ndarray) -> np.ndarray:
        """Return the size of each row [sample, row]: the root of the sum of squares that the row is a projection of."""
        values = evaluate(self._sizes, lambda _, index: q[:, index[0]])
        sizes = np.stack(np.broadcast_arrays(np.zeros(len(q)), *values), axis=1)[:, 1:]
        return np.sqrt(np.maximum(sizes, np.finfo(float).tiny))

    def move(self, q: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Return a copy of q [sample, coordinate], moved by ``step`` [sample, dof] along its tangent coordinates."""
        arrays = {"q": q, "step": step}
        values = evaluate([value for _, value in self._moved], lambda name, index: arrays[name][:, index[0]])
        new = q.copy()
        for (coordinate, _), value in zip(self._moved, values, strict=True):
            new[:, coordinate] = value
        return new

    def close(self, q: np.ndarray) -> np.ndarray:
        """Move configurations [sample, coordinate] onto the closures, and return those for which this succeeded.

        Each sample takes STEPS steps of damped least squares (Levenberg-Marquardt): a step that makes |g| smaller is
        kept and lowers the damping, any other is dropped and raises it.
        """
        damping = np.full(len(q), 1e-3)
        g, Y = self.at(q)
        for _ in range(STEPS):
            damped = Y @ Y.transpose(0, 2, 1) + damping[:, None, None] * np.eye(self.size)
            step = -(Y.transpose(0, 2, 1) @ np.linalg.solve(damped, g[..., None]))[..., 0]
            tried = self.move(q, step)
            g_tried, Y_tried = self.at(tried)
            better = np.linalg.norm(g_tried, axis=1) < np.linalg.norm(g, axis=1)
            q, g = np.where(better[:, None], tried, q), np.where(better[:, None], g_tried, g)
            Y = np.where(better[:, None, None], Y_tried, Y)
            damping = np.maximum(np.where(better, 0.1 * damping, 10.0 * damping), 1e-12)
        return q[np.abs(g).max(axis=1, initial=0.0) < CLOSED]


def draw_configurations(scene: Scene, count: int, seed: int = 0) -> np.ndarray:
    """Return random samples of the configuration [sample, coordinate], the same for equal arguments.

    Coordinates are uniform within their limits, no further than 3.2 from zero where the limits allow it, or in
    (-1.5, 1.5) where a limit is missing [rad, m]. Quaternions are uniform over all rotations; the other coordinates of
    their hinges stay neutral. Every other sample is then shrunk to a tenth of its distance from the neutral
    configuration, in which robots are usually modelled. Shrunk quaternions are not normalised.
    """
    rng = np.random.default_rng(seed)
    q = np.tile(scene.neutral_q, (count, 1))
    lower, upper = (scene.values[f"joint_limit_{side}"][0] for side in ("lower", "upper"))
    for hinge, coordinate, dof in zip(scene.hinges, scene.q_start, scene.qd_start, strict=False):
        for first in coordinate + np.array(hinge.quaternions, dtype=int):
            turn = rng.normal(size=(count, 4))
            q[:, first : first + 4] = turn / np.linalg.norm(turn, axis=1, keepdims=True)
        if hinge.quaternions:
            continue
        for i in range(hinge.dof_count):
            bounded = lower[dof + i] > -UNLIMITED and upper[dof + i] < UNLIMITED and lower[dof + i] < upper[dof + i]
            low, high = (lower[dof + i], upper[dof + i]) if bounded else (-1.5, 1.5)
            near = max(low, -3.2), min(high, 3.2)
            q[:, coordinate + i] = rng.uniform(*(near if near[0] <= near[1] else (low, high)), count)
    near_neutral = q[::2]
    q[::2] = scene.neutral_q + 0.1 * (near_neutral - scene.neutral_q)
    return q


def find_usual_rank(scene: Scene) -> int:
    """Return how many rows are independent where the loops close, other than at change points (singular postures).

    The result is -1 if no closed configuration was found.
    """
    closing = ClosureEvaluator(scene)
    q = closing.close(draw_configurations(scene, SAMPLES))
    if len(q) == 0:
        return -1
    return sum(int(ranks.max()) for ranks in _generic_ranks(closing, q))


def _generic_ranks(closing: ClosureEvaluator, q: np.ndarray) -> list[np.ndarray]:
    """Return, for each cluster, the number of independent rows at each sample [sample]; -1 where it is undecided.

    Rows are scaled by their sizes, so that units do not matter. Where the closures are left with an error g, a singular
    value s that is zero at the closed configuration nearby reads up to |g| / t, t the smallest that is not: near a
    change point t is small, and rows that are redundant for good seem to count. Those with s^2 > MARGIN |g| count: by
    Kantorovich's theorem a closed configuration is nearby in which they are independent. A sample decides where all
    others are within MARGIN |g| / t. If none does, as for a mechanism whose only configuration is a change point, all
    do, and RANK divides them.
    """
    (g, Y), sizes, found = closing.at(q), closing.sizes(q), []
    for cluster in closing.clusters:
        rows = cluster.rows
        scaled = Y[:, rows][:, :, cluster.dofs] / sizes[:, rows, None]
        error = np.abs(g[:, rows] / sizes[:, rows]).max(axis=1, initial=0.0) + np.finfo(float).eps
        singular = np.linalg.svd(scaled, compute_uv=False)
        counts = singular > np.sqrt(MARGIN * error)[:, None]
        smallest = np.where(counts, singular, 1.0).min(axis=1, initial=1.0)
        left = np.where(counts, 0.0, singular).max(axis=1, initial=0.0)
        decided = left * smallest <= MARGIN * error
        ranks = np.where(decided, counts.sum(axis=1), -1)
        found.append(ranks if decided.any() else (singular > RANK * singular[:, :1]).sum(axis=1))
    return found


def embedding(scene: Scene, asked: Sequence[int | str] | None = None, call: str = "Dynamics") -> Embedding:
    """Return the rows that count and the independent dofs: those ``asked`` for, or the first that move all others well.

    Raises:
        ValueError: no configuration was found that closes all loops, or the dofs asked for do not move all others.
        UnsupportedError: more dofs in a cluster than straight-line code is good for.
    """
    wanted = None if asked is None else _numbers(scene, asked, call)
    closing = ClosureEvaluator(scene)
    clusters = closing.clusters
    for cluster in clusters:
        if len(cluster.dofs) > MOST_DOFS:
            names = [shown(scene.body_labels[node]) for node in dict.fromkeys(link.node for link in cluster.links)]
            tied = ", ".join(names[:NAMED]) + (f" and {len(names) - NAMED} more" if len(names) > NAMED else "")
            raise UnsupportedError(
                call,
                f"embedding {len(cluster.dofs)} dof that move together ({tied}; up to {MOST_DOFS} are)",
                "use loops='multipliers'",
            )
    q = closing.close(draw_configurations(scene, SAMPLES))
    if len(q) == 0:
        raise ValueError(
            f"{call}: no configuration was found that closes {scene.constraint_summary}; expected anchors that can "
            f"meet; loops='cut' leaves them open"
        )
    Y = closing.at(q)[1]
    rows: list[int] = []
    free = set(range(scene.dof_count))
    for cluster, ranks in zip(clusters, _generic_ranks(closing, q), strict=True):
        numbers, dofs = np.array(cluster.rows, dtype=int), np.array(cluster.dofs, dtype=int)
        kept, X = _choose_rows(Y[:, numbers][:, :, dofs], ranks)
        rows += numbers[kept].tolist()
        if wanted is None:
            independent = _choose_independent(X)
        else:
            independent = [i for i, dof in enumerate(dofs.tolist()) if dof in wanted]
            if len(independent) != X.shape[2] or not (_rate_dofs(X, independent) > RANK).any():
                labels = [scene.dof_labels[dof] for dof in dofs]
                still = [label for label, size in zip(labels, _mobility(X), strict=True) if size == 0.0]
                raise ValueError(
                    f"{call}: independent names {[labels[i] for i in independent]} of the dofs that move "
                    f"together, {labels}; expected {X.shape[2]} that move all of them"
                    + (f"; the closures do not let {still} move" if still else "")
                )
        free -= set(dofs.tolist()) - set(dofs[independent].tolist())
    if wanted is not None and free != wanted:
        missing = [scene.dof_labels[dof] for dof in sorted(free - wanted)]
        raise ValueError(f"{call}: independent leaves out {missing}, which no loop ties; expected them too")
    return Embedding(tuple(sorted(rows)), tuple(sorted(free)))


def _numbers(scene: Scene, asked: Sequence[int | str], call: str) -> set[int]:
    labels, found = scene.dof_labels, set()
    if not isinstance(asked, Sequence | np.ndarray) or isinstance(asked, str):
        raise TypeError(f"{call}: independent is {asked!r}; expected a list of dofs, indices or labels")
    for dof in asked:
        number = labels.index(dof) if isinstance(dof, str) and dof in labels else as_integer(dof)
        if number is None or not 0 <= number < scene.dof_count:
            raise ValueError(
                f"{call}: independent names {dof!r}; expected dofs, 0 to {scene.dof_count - 1}, or labels "
                f"among {', '.join(map(shown, labels))}"
            )
        found.add(number)
    return found


def _choose_rows(Y: np.ndarray, ranks: np.ndarray) -> tuple[list[int], np.ndarray]:
    """Return rows that span all of them, of Y [draw, row, column] of ``ranks`` [draw], where those are largest.

    With them come orthonormal X [draw, column, free] with Y X = 0.
    """
    rank = int(ranks.max(initial=0))
    if rank == 0:
        return [], np.tile(np.eye(Y.shape[2]), (len(Y), 1, 1))
    Y = Y[ranks == rank]
    best = np.linalg.svd(Y, compute_uv=False)[:, rank - 1]
    measure = lambda rows: np.quantile(np.linalg.svd(Y[:, rows], compute_uv=False)[:, -1] / best, WORST)  # noqa: E731
    rows = list(max(sorted({tuple(_pivots(y, rank)) for y in Y}), key=lambda rows: float(measure(list(rows)))))
    return rows, np.linalg.svd(Y[:, rows])[2][:, rank:].transpose(0, 2, 1)


def _rate_dofs(X: np.ndarray, dofs: list[int]) -> np.ndarray:
    """Return how well some dofs determine the others [draw]: 0 where they do not. Units of dofs do not matter."""
    if not dofs:
        return np.ones(len(X))
    scale = _mobility(X)
    if not scale[dofs].all():
        return np.zeros(len(X))
    return np.linalg.svd(X[:, dofs] / scale[dofs][:, None], compute_uv=False)[:, -1]


def _mobility(X: np.ndarray) -> np.ndarray:
    """Return how far each dof moves, over all draws [column]; zero where only rounding moves it, as in a truss."""
    size = np.sqrt((X**2).sum(axis=2).mean(axis=0))
    return np.where(size > RANK * size.max(initial=0.0), size, 0.0)


def _choose_independent(X: np.ndarray) -> list[int]:
    """Return the first dofs that determine the others nearly as well as any, in the worst tenth of the draws."""
    count = X.shape[2]
    measure = lambda dofs: float(np.quantile(_rate_dofs(X, list(dofs)), WORST))  # noqa: E731
    subsets = {tuple(_pivots(x, count)) for x in X}
    for least in (0.3, 0.1, 0.03):
        greedy: list[int] = []
        for dof in range(X.shape[1]):
            if len(greedy) < count and measure([*greedy, dof]) > least:
                greedy.append(dof)
        if len(greedy) == count:
            subsets.add(tuple(greedy))
    best = max(map(measure, subsets))
    return list(min(subset for subset in subsets if measure(subset) >= NEARLY * best))


def _pivots(A: np.ndarray, count: int) -> list[int]:
    """Return the rows of A that span the most: each the longest beyond those before it, the first of equals."""
    left, found = A.copy(), []
    for _ in range(count):
        lengths = np.linalg.norm(left, axis=1)
        row = int(np.argmax(lengths > lengths.max() * (1.0 - 1e-9)))
        found.append(row)
        unit = left[row] / lengths[row]
        left = left - np.outer(left @ unit, unit)
    return sorted(found)
