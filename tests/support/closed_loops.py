"""Forward dynamics of closed loops three ways: by traces of the embedding, of the multipliers, and by Lagrange."""

import numpy as np
import pytest

import warp_spo as spo
from warp_spo.dynamics.loop_analysis import ClosureEvaluator
from warp_spo.recursions.model.links import Links
from warp_spo.recursions.model.tracing import Trace
from warp_spo.trace.evaluation import evaluate

from . import symbolic
from .mechanisms import MECHANISMS, Closed

DIFFERENCES = 1e-9  # what differences of order 8 leave of second derivatives; conditioning of the draws
AGREE = 1e-10  # embedding and multipliers, float64, away from change points
FLOAT32 = 1e-5  # ten times what open trees of this depth reach, 2e-7 to 1e-6
LOADED = ("q", "qd", "tau", "body_f")


def traced(scene, operation, arrays, given, shapes, dtype="float64", **options):
    """Results by name, as symbolic.run, of a scene with closed loops."""
    trace = Trace(Links(scene), dtype, tuple(given))
    stores = [item for item in symbolic.function(operation)(trace, **options) if item.array in shapes]
    values = evaluate([item.value for item in stores], lambda name, index: arrays[name][(slice(None), *index)], dtype)
    worlds = len(arrays["q"])
    results = {name: np.zeros((worlds, *shape)) for name, shape in shapes.items()}  # kernels write zeros too
    for item, value in zip(stores, values, strict=True):
        results[item.array][(slice(None), *item.index)] = value
    return results


def run_embedded(scene, how, operation, arrays, given, shape, dtype="float64", **options):
    """The result "out" of an operation with loops embedded."""
    return traced(scene, f"embedded_{operation}", arrays, given, {"out": shape}, dtype, embedding=how, **options)["out"]


def by_embedding(scene, how, s, given=LOADED, dtype="float64"):
    return run_embedded(scene, how, "forward_dynamics", s._asdict(), given, (scene.dof_count,), dtype)


def by_multipliers(scene, s, given=LOADED):
    """The kernel between both traces is NumPy's pseudo-inverse here."""
    size = ClosureEvaluator(scene).size
    shapes = {"out": (size, size), "right": (size,)}
    system = traced(scene, "loop_system", s._asdict(), given, shapes)
    found = -np.einsum("wij,wj->wi", np.linalg.pinv(system["out"], rcond=1e-11, hermitian=True), system["right"])
    arrays = {**s._asdict(), "multipliers": found}
    return traced(scene, "loop_forward_dynamics", arrays, (*given, "multipliers"), {"out": (scene.dof_count,)})["out"]


def lagrange(scene, s, closed=None):
    closed = closed or [Closed(scene, q) for q in s.q]
    return np.array([c.forward_dynamics(*row) for c, *row in zip(closed, s.qd, s.tau, s.body_f, strict=True)])


LARGE = ("stewart", "biped")
ALL_BUT_LARGE = [pytest.param(name, marks=pytest.mark.slow) if name in LARGE else name for name in MECHANISMS]


def flat(angles):
    """The parallelogram at crank angles, the coupler level."""
    return np.stack([angles, -angles, np.pi + angles], axis=1)


def both(scene, worlds, device, dtype="float64", **more):
    return [spo.Dynamics(scene, worlds, device=device, dtype=dtype, loops=x, **more) for x in ("embed", "multipliers")]
