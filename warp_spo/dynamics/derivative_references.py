"""References of derivatives in one world: the trace of Newton-Euler differentiated step by step, in float64.

This is not the recursion that the operations run; the dense reference would take too long to difference.
"""

from __future__ import annotations

import numpy as np

from ..recursions.derivatives import adjoints
from ..recursions.model.links import Links
from ..recursions.model.tracing import Trace
from ..reference.dense import Dense
from ..trace.evaluation import evaluate


def inverse_dynamics_rates(dense: Dense, qd: np.ndarray, qdd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return d tau / d q along tangent coordinates and d tau / d qd [dof, dof]."""
    scene, n = dense.scene, dense.scene.dof_count
    one = scene.with_values(**{name: value[dense.world : dense.world + 1] for name, value in scene.values.items()
                               if value.shape[0] > 1})  # fmt: skip
    arrays = {"q": dense.q, "qd": qd, "qdd": qdd}
    directions = {"q_dot": np.eye(2 * n, n), "qd_dot": np.eye(2 * n, n, -n)}  # [direction, dof]
    stores = adjoints.inverse_dynamics_jvp(Trace(Links(one), "float64", (*arrays, *directions)))
    values = evaluate(
        [item.value for item in stores],
        lambda name, at: directions[name][:, at[0]] if name in directions else float(arrays[name][at[0]]),
    )
    J = np.zeros((n, 2 * n))
    for item, value in zip(stores, values, strict=True):
        J[item.index[0]] = value
    return J[:, :n], J[:, n:]


def forward_dynamics_by_q(dense: Dense, q: np.ndarray, qd: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Return d qdd / d q along tangent coordinates [dof, dof]."""
    by_q, _ = inverse_dynamics_rates(dense, qd, dense.forward_dynamics(qd, tau))
    return -np.linalg.solve(dense.mass_matrix, by_q)
