"""Check operations in JAX and on CuPy's arrays against the dense float64 reference, and measure what a call takes.

    python -m benchmarks.jax_check [--device cuda:0] [--scene humanoid] [--worlds 4096] [--json FILE]

An error is the largest difference from the reference in three worlds, over the largest entry; gradients are compared
with central differences of the reference. ``call`` is the median time of a call in a row of calls that are awaited
together, ``host`` that until the last one returns. The exit code is 1 if an error is above its bound.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # Warp and CuPy need memory, too

import jax
import jax.numpy as jnp
import numpy as np
import warp as wp

import warp_spo as spo
from warp_spo.reference.dense import Dense

from .table import runner
from .table.cases import SCENES

BATCH, BATCHES, WARM_UP, STEPS, DT = 20, 30, 3, 50, 1e-3
SINGLE = 2e-5  # of float32 results: rounding, times the condition of a humanoid's mass matrix, as the trials allow
GRADIENT = 2e-4  # of float32 gradients, which the inverse mass matrix enters twice
DOUBLE = 1e-10
WORLDS = (0, 1, -1)


class Row(NamedTuple):
    """One call, what its result is compared with, and the bound of the error; None: it is timed alone."""

    name: str
    call: Callable[[], Any]
    error: Callable[[Any], float] | None = None
    bound: float = SINGLE
    per_call: int = 1


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="benchmarks.jax_check", description="Operations in JAX and on CuPy's arrays.")
    parser.add_argument("--device", help="Warp device, default: the current one; JAX must have it, too")
    parser.add_argument("--scene", default="humanoid", choices=SCENES)
    parser.add_argument("--worlds", type=int, default=4096)
    parser.add_argument("--only", default="", help="rows whose name has this text")
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args(arguments)
    device = wp.get_device(options.device)
    place = jax.devices("gpu")[device.ordinal] if device.is_cuda else jax.devices("cpu")[0]
    scene, found = SCENES[options.scene](), []
    run = runner.record(found, options.device)
    run["versions"]["jax"] = jax.__version__
    print(f"{options.scene}, {options.worlds} worlds, {device.name}, JAX {jax.__version__}, microseconds")
    print(f"{'':44} {'host':>9} {'call':>9} {'error':>9} {'bound':>9}")
    with jax.default_device(place):
        for row in rows(scene, options.worlds, device):
            if options.only in row.name:
                found.append(
                    dict(group=f"called from JAX, {options.scene}", worlds=options.worlds, **measure(row, device))
                )
                print("{name:44} {us:9.1f} {done_us:9.1f} {error:9.1e} {bound:9.1e}".format(**found[-1]), flush=True)
    wrong = [row["name"] for row in found if not row["error"] <= row["bound"]]
    for name in wrong:
        print(f"WRONG: {name}")
    if options.json:
        runner.save(run, options.json)
    return 1 if wrong else 0


def measure(row: Row, device: wp.Device) -> dict[str, Any]:
    """Return the times of a call [us], and its error before and after timing."""

    def error() -> float:
        result = row.call()
        wait(result, device)  # CuPy's arrays may still be written on their stream
        return row.error(result) if row.error is not None else 0.0

    for _ in range(WARM_UP):
        wait(row.call(), device)
    errors, host, done = [error()], [], []
    for _ in range(BATCHES if row.per_call == 1 else 3):
        start = time.perf_counter()
        for _ in range(BATCH):
            last = row.call()
        host.append(time.perf_counter() - start)
        wait(last, device)
        done.append(time.perf_counter() - start)
    errors.append(error())
    medians = [1e6 * statistics.median(times) / (BATCH * row.per_call) for times in (host, done)]
    return dict(name=row.name, us=medians[0], done_us=medians[1], error=max(errors), bound=row.bound)


def wait(result: Any, device: wp.Device) -> None:
    jax.block_until_ready(jax.tree.leaves(result))
    wp.synchronize_device(device)


def difference(found: Any, wanted: Any) -> float:
    """Return the largest difference over the largest entry, of arrays of any library or tuples of them."""
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True)
    errors = [np.abs(as_numpy(x) - y).max() / np.abs(y).max() for x, y in pairs]
    return float(np.max(errors)) if np.isfinite(errors).all() else np.inf


def as_numpy(array: Any) -> np.ndarray:
    return np.asarray(array.get() if hasattr(array, "get") else array, dtype=np.float64)


def rows(scene: spo.Scene, worlds: int, device: wp.Device) -> list[Row]:
    rng = np.random.default_rng(0)
    n = {name: rng.normal(size=(worlds, scene.dof_count)) for name in ("qd", "qdd", "tau", "weight")}
    n["q"] = scene.neutral_q + 0.3 * rng.normal(size=(worlds, scene.coord_count))
    n = {name: array.astype(np.float32) for name, array in n.items()}
    dyn = spo.Dynamics(scene, worlds, device)
    a = {name: jnp.asarray(array) for name, array in n.items()}
    q, qd, qdd, tau, weight = (a[name] for name in ("q", "qd", "qdd", "tau", "weight"))
    wide = {name: array.astype(np.float64) for name, array in n.items()}
    dense = [Dense(scene, wide["q"][w], qd=wide["qd"][w], world=0) for w in WORLDS]
    after = spo.Dynamics(scene, len(WORLDS), "cpu", "float64", granularity="node").step(
        *(wide[name][list(WORLDS)] for name in ("q", "qd", "tau")), DT
    )

    def some(result: Any) -> Any:
        return jax.tree.map(lambda x: as_numpy(x)[list(WORLDS)], result)

    forward = [d.forward_dynamics(tau=wide["tau"][w]) for d, w in zip(dense, WORLDS, strict=True)]
    inverse = [d.inverse_dynamics(wide["qd"][w], wide["qdd"][w]) for d, w in zip(dense, WORLDS, strict=True)]
    of_forward, of_inverse, of_step = (
        lambda x, y=y: difference(some(x), y) for y in (np.array(forward), np.array(inverse), tuple(after))
    )
    slopes = gradients(scene, *(wide[name][0] for name in ("q", "qd", "tau", "weight")))

    make = spo.jax.function
    f, step = make(dyn, "forward_dynamics"), make(dyn, "step", dt=DT)
    captured, captured_step = make(dyn, "forward_dynamics", capture=True), make(dyn, "step", dt=DT, capture=True)
    loss = jax.jit(jax.grad(lambda *x: (weight * f(*x)).sum(), (0, 1, 2)))
    lone = jax.jit(jax.vmap(jax.grad(lambda q, qd, tau, w: (w * f(q, qd, tau)).sum(), (0, 1, 2))))
    of_loss = lambda x: difference(tuple(one[0] for one in x), slopes)  # noqa: E731

    def scan(step: Any) -> Callable[..., Any]:
        body = lambda s, _: (step(*s, tau), None)  # noqa: E731
        return jax.jit(lambda q, qd: jax.lax.scan(body, (q, qd), length=STEPS)[0])

    jitted = {g: jax.jit(g) for g in (f, captured, step, captured_step)}
    plain, graph = scan(step), scan(captured_step)
    twice = jax.jit(jax.vmap(f, in_axes=(None, None, 0)))
    inverse_jit, batched = jax.jit(make(dyn, "inverse_dynamics")), jax.jit(jax.vmap(f))
    given = [
        Row("call, JAX: forward_dynamics", lambda: dyn.forward_dynamics(q, qd, tau), of_forward),
        Row("call, JAX: step", lambda: dyn.step(q, qd, tau, DT), of_step),
        Row("eager: forward_dynamics", lambda: f(q, qd, tau), of_forward),
        Row("jit: forward_dynamics", lambda: jitted[f](q, qd, tau), of_forward),
        Row("jit, capture: forward_dynamics", lambda: jitted[captured](q, qd, tau), of_forward),
        Row("jit: inverse_dynamics", lambda: inverse_jit(q, qd, qdd), of_inverse),
        Row("jit: step", lambda: jitted[step](q, qd, tau), of_step),
        Row("jit, capture: step", lambda: jitted[captured_step](q, qd, tau), of_step),
        Row("jit, vmap: forward_dynamics", lambda: batched(q, qd, tau), of_forward),
        Row("jit, vmap over 2 tau", lambda: twice(q, qd, jnp.stack([qdd, tau]))[1], of_forward),
        Row("jit, grad: forward_dynamics", lambda: loss(q, qd, tau), of_loss, GRADIENT),
        Row("jit, vmap, grad: forward_dynamics", lambda: lone(q, qd, tau, weight), of_loss, GRADIENT),
        Row(f"jit, scan of {STEPS} steps, a step", lambda: plain(q, qd), None, SINGLE, STEPS),
        Row(f"jit, capture, scan of {STEPS} steps, a step", lambda: graph(q, qd), lambda x: difference(
            x, jax.tree.map(as_numpy, plain(q, qd))), 0.0, STEPS),
        double_row(scene, wide, device, of_forward),
    ]  # fmt: skip
    return [*given, *cupy_rows(dyn, n, of_forward, of_step)]


def double_row(scene: spo.Scene, wide: dict[str, np.ndarray], device: wp.Device, error: Any) -> Row:
    """Return the row in float64, for which JAX's float64 is turned on."""
    few = len(wide["q"])
    dyn = spo.Dynamics(scene, few, device, "float64", granularity="node")

    def call() -> Any:
        with jax.enable_x64(True):
            f = functions.setdefault("f", spo.jax.function(dyn, "forward_dynamics"))
            return f(*(jnp.asarray(wide[name]) for name in ("q", "qd", "tau")))

    functions: dict[str, Any] = {}
    return Row("eager, float64, arrays from the host", call, error, DOUBLE)


def cupy_rows(dyn: spo.Dynamics, n: dict[str, np.ndarray], of_forward: Any, of_step: Any) -> list[Row]:
    """Return calls with CuPy's arrays, on a stream of their own; none without CuPy or a GPU."""
    try:
        import cupy
    except ImportError:
        print("CuPy is not installed; left out")
        return []
    if not dyn.device.is_cuda:
        return []
    stream = cupy.cuda.Stream(non_blocking=True)

    def on_stream(work: Callable[..., Any], names: tuple[str, ...]) -> Callable[[], Any]:
        arrays = [cupy.asarray(n[name]) for name in names]
        cupy.cuda.Device().synchronize()

        def call() -> Any:
            with stream:
                given = [x + 0 for x in arrays]  # pending on the stream, and freed after the call
                return work(*given)

        return call

    def in_place(q: Any, qd: Any, tau: Any) -> Any:
        dyn.step(q, qd, tau, DT, out=(q, qd))
        return q + 0, qd + 0  # reads what the call wrote, on the stream

    state = ("q", "qd", "tau")
    return [
        Row("call, CuPy: forward_dynamics", on_stream(dyn.forward_dynamics, state), of_forward),
        Row("call, CuPy: step, in place", on_stream(in_place, state), of_step),
    ]


def gradients(scene: spo.Scene, q: np.ndarray, qd: np.ndarray, tau: np.ndarray, weight: np.ndarray) -> tuple:
    """Return the gradients of weight . qdd by q, qd and tau, from central differences of the reference."""

    def value(*given: np.ndarray) -> float:
        return float(weight @ Dense(scene, given[0], qd=given[1]).forward_dynamics(tau=given[2]))

    found, step = [], 1e-6
    for i, array in enumerate((q, qd, tau)):
        slope = np.empty_like(array)
        for k in range(len(array)):
            moved = np.zeros_like(array)
            moved[k] = step
            ends = [[*(q, qd, tau)[:i], array + sign * moved, *(q, qd, tau)[i + 1 :]] for sign in (1.0, -1.0)]
            slope[k] = (value(*ends[0]) - value(*ends[1])) / (2.0 * step)
        found.append(slope)
    return tuple(found)


if __name__ == "__main__":
    sys.exit(main())
