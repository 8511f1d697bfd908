"""Measure one stress case in one precision: errors, law, status word and run time."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

import warp_spo as spo

from . import contrast
from .cases import ALLOWED, CAUSES, EPS32, EPS64, Case
from .exact import Sweep
from .scenes import Problem

PRECISIONS = ("float32", "refined", "float64")  # refined: float32, then one step with a float64 residual
EPS = {"float32": EPS32, "float64": EPS64}
MP_BODIES = 32  # scenes with more bodies are compared with extended precision, whose eps is 1/2048 of float64's
POWER_STEPS = 8  # steps of the power iteration for the norm of the mass matrix


class Subject:
    """A problem on a device, in float32 and float64.

    Args:
        problem: scene and states.
        device: Warp device; None: the current one.
        granularity: of the library's recursions; None: what the plan chooses.
    """

    def __init__(self, problem: Problem, device: Any = None, granularity: str | None = None):
        self.problem = problem
        self._make = functools.partial(spo.Dynamics, problem.scene, problem.worlds, device, granularity=granularity)
        self.dyn = {name: self._make(dtype=name) for name in EPS}
        self._refined: dict[int, spo.Dynamics] = {}
        self.device, self.granularity = self.dyn["float32"].device, self.dyn["float32"].granularity
        self._inputs: dict[str, tuple] = {}

    def inputs(self, dtype: str) -> tuple:
        """Return q, qd and tau as arrays on the device."""
        if dtype not in self._inputs:
            p = self.problem
            self._inputs[dtype] = tuple(
                None if x is None else wp.array(x, dtype=getattr(wp, dtype), device=self.device)
                for x in (p.q, p.qd, p.tau)
            )
        return self._inputs[dtype]

    @functools.cached_property
    def status(self) -> wp.array:
        """Status words of the last forward dynamics [world]."""
        return wp.zeros(self.problem.worlds, dtype=wp.int32, device=self.device)

    def forward(self, dtype: str, steps: int = 0) -> wp.array:
        """Return qdd [world, dof]; with ``steps`` refined from float32, in a float64 array."""
        if steps and steps not in self._refined:
            self._refined[steps] = self._make(dtype="float64", refine=steps)
        dyn = self._refined[steps] if steps else self.dyn[dtype]
        return dyn.forward_dynamics(*self.inputs(dyn.dtype.__name__), status=self.status)

    def pivots(self, dtype: str) -> np.ndarray:
        """Return D [world, dof] of the last forward dynamics in that precision."""
        return self.dyn[dtype].recursions.array("pivot").numpy().T

    def value(self, quantity: str, dtype: str, steps: int) -> np.ndarray:
        """Return the quantity of a case, [world, ...]."""
        qdd = self.forward(dtype, steps).numpy()
        if quantity in ("pivots", "root_pivot"):
            D = self.pivots(dtype)
            return D if quantity == "pivots" else D[:, :1]
        if quantity == "log_det":
            return self.dyn[dtype].log_det_mass_matrix(self.inputs(dtype)[0]).numpy()[:, None]
        if quantity == "dense":
            q, qd, tau = self.problem.q, self.problem.qd, self.problem.tau
            dyn = self.dyn[dtype]
            return contrast.cholesky(dyn.mass_matrix(q), tau - dyn.bias_force(q, qd), np.dtype(dtype))
        return qdd

    def mass_norm(self) -> np.ndarray:
        """Return a lower bound of the 2-norm of the mass matrix [world, 1], without forming it."""
        dyn = self.dyn["float64"]
        x = np.random.default_rng(0).normal(size=(self.problem.worlds, self.problem.scene.dof_count))
        still = dyn.gravity_force(self.problem.q)
        for _ in range(POWER_STEPS):
            x /= np.linalg.norm(x, axis=1, keepdims=True)
            x = dyn.inverse_dynamics(self.problem.q, None, x) - still
        return np.linalg.norm(x, axis=1, keepdims=True)

    def backward_error(self, qdd: np.ndarray) -> np.ndarray:
        """Return |tau - inverse dynamics| / (|Mass| |qdd| + |tau| + |bias|) [world], computed in float64."""
        p, dyn = self.problem, self.dyn["float64"]
        tau = np.zeros_like(qdd, dtype=np.float64) if p.tau is None else p.tau
        norm = functools.partial(np.linalg.norm, axis=1, keepdims=True)
        force, bias = dyn.inverse_dynamics(p.q, p.qd, qdd.astype(np.float64)), dyn.bias_force(p.q, p.qd)
        with np.errstate(invalid="ignore"):
            return (norm(tau - force) / (self.mass_norm() * norm(qdd) + norm(tau) + norm(bias)))[:, 0]

    def microseconds(self, run: Callable, budget: float = 0.1) -> float:
        """Return the median run time per world [µs] of at least 3 runs after a first one."""
        run()
        times: list[float] = []
        while len(times) < 3 or (sum(times) < budget and len(times) < 50):
            wp.synchronize_device(self.device)
            start = time.perf_counter()
            run()
            wp.synchronize_device(self.device)
            times.append(time.perf_counter() - start)
        return 1e6 * float(np.median(times)) / self.problem.worlds


@functools.lru_cache(maxsize=16)
def exact(case: Case) -> tuple[Sweep, np.ndarray]:
    """Return the case's sweep in 50 digits or extended precision, and the case's quantity from it, [world, ...]."""
    p = case.problem
    sweep = Sweep(p.scene, p.q, "mp50" if p.scene.body_count <= MP_BODIES else "extended")
    if case.quantity in ("pivots", "root_pivot"):
        return sweep, sweep.D if case.quantity == "pivots" else sweep.D[:, :1]
    return sweep, sweep.log_det()[:, None] if case.quantity == "log_det" else sweep.forward(p.tau, p.qd)


def distance(case: Case, value: np.ndarray) -> np.ndarray:
    """Return the error by world in the case's metric; infinite where the value is not finite."""
    sweep, wanted = exact(case)
    finite = np.isfinite(value.astype(np.float64)).all(1)
    difference = (sweep.arithmetic.number(np.where(np.isfinite(value), value, 0.0)) - wanted).astype(np.float64)
    size = wanted.astype(np.float64)
    if case.metric == "norm":
        error = np.linalg.norm(difference, axis=1) / np.linalg.norm(size, axis=1)
    else:
        error = np.abs(difference if case.metric == "absolute" else difference / size).max(1)
    return np.where(finite, error, 1.0 if case.quantity == "dense" else np.inf)


def law_of(case: Case, eps: float) -> np.ndarray:
    """Return the error by world that the law allows."""
    given = dict(cond=lambda: _cond(case), D_cond=lambda: exact(case)[0].D_cond)
    return np.broadcast_to(case.law(eps=eps, **given, **case.parameters), case.problem.worlds)


@functools.lru_cache(maxsize=64)
def _cond(case: Case) -> np.ndarray:
    p = case.problem
    return np.linalg.cond(spo.Dynamics(p.scene, p.worlds, "cpu", "float64", granularity="node").mass_matrix(p.q))


def row(case: Case, subject: Subject, precision: str, timed: bool = False) -> dict:
    """Return a row of the table: a case measured in a precision of ``PRECISIONS``.

    The verdict is "FAILS" where the error exceeds ALLOWED times the law, and where a status word is not expected.
    With ``timed`` the row has ``us`` and ``ns``, the run time of forward dynamics for one world.
    """
    dtype = "float64" if precision == "float64" else "float32"
    steps = case.steps if precision != "refined" else max(1, case.steps)
    value = subject.value(case.quantity, dtype, steps)
    status, error = subject.status.numpy(), distance(case, value)
    sweep = exact(case)[0]
    judged = precision in case.precisions
    law = law_of(case, EPS[dtype])
    ratio = float((error / law).max()) if judged else float("nan")
    found = dict(
        case=case.name,
        parameters=case.parameters,
        precision=precision,
        quantity=case.quantity,
        metric=case.metric,
        reference=sweep.arithmetic.name,
        max_error=float(error.max()),
        granularity=subject.granularity,
        median_error=float(np.median(error)),
        law=float(law[np.argmax(error / law)]) if judged else None,
        formula=case.formula,
        source=case.source,
        ratio=ratio,
        pivot=float((np.abs(sweep.D) / sweep.P_trace).astype(np.float64).min()),
        status=sorted({int(word) for word in status}),
        flagged=int((status != 0).sum()),
        misjudged=int((~case.expects(status, dtype, law)).sum()),
    )
    found["verdict"] = "" if not judged else "ok" if ratio <= ALLOWED and not found["misjudged"] else "FAILS"
    if found["verdict"] == "FAILS" and case.name in CAUSES:
        found["why"] = CAUSES[case.name]
    qdd = value if case.quantity in ("qdd", "dense") else subject.forward(dtype, steps).numpy()
    found["backward_error"] = float(subject.backward_error(qdd).max())
    if timed:
        found["us"] = subject.microseconds(lambda: subject.forward(dtype, steps))
        found["ns"] = 1e3 * found["us"]
    return found


def contrasts(case: Case) -> list[dict]:
    """Return a row for each form of forward dynamics that the case names for contrast."""
    found, p = [], case.problem
    for name in case.contrast:
        with np.errstate(all="ignore"):
            qdd, D = contrast.FORMS[name](p.scene, p.q, p.tau)
            log_det = np.add.accumulate(np.log(D), axis=1)[:, -1:]  # added one by one in D's precision
        value = {"qdd": qdd, "pivots": D, "root_pivot": D[:, :1], "log_det": log_det}[case.quantity]
        error = distance(case, value)
        found.append(
            dict(
                case=case.name,
                parameters=case.parameters,
                precision=name,
                quantity=case.quantity,
                max_error=float(error.max()),
                median_error=float(np.median(error)),
                verdict="contrast",
            )
        )
    return found
