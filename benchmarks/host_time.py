"""Measure how long calls occupy the host, beside torch's own ``add``, and check their results in the same run.

    python -m benchmarks.host_time [--device cuda:0] [--scene go2] [--worlds 4096] [--json FILE]

A figure is the median over batches of calls in a row, of the wall time from the first call to the return of the last,
without the synchronisation between batches; a batch is too short to fill the device's queue. ``done`` includes the
synchronisation: where it is much more than ``host``, the device takes longer than the host. Results of repeated calls
are compared with those of NumPy arrays, which are never repeated from a recording. The exit code is 1 if one differs by
more than rounding, or if a call under torch.compile broke the graph, warned, or failed.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp

import warp_spo as spo

from . import command_line
from .table import robots, runner
from .table.cases import SCENES

GROUP = "called from Python,"  # of the rows, before the name of the scene
BATCH, BATCHES, WARM_UP = 20, 100, 5
TOLERANCE = 1e-4  # of float32 results against the same kernels on NumPy arrays: gradients sum over worlds nowhere
TARGETS = {  # [us], on an H200 machine with Go2 in 4096 worlds
    "forward_dynamics, out=": 15.0,
    "forward_dynamics": 20.0,
    "forward_dynamics, forward and backward": 120.0,
}


class Empty(torch.autograd.Function):
    """Three inputs, one result and three gradients that nobody computes: the least that torch asks of such a call."""

    @staticmethod
    def forward(ctx: Any, q: torch.Tensor, qd: torch.Tensor, tau: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(q, qd, tau)
        return torch.empty_like(qd)

    @staticmethod
    def backward(ctx: Any, *cotangents: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return tuple(torch.empty_like(x) for x in ctx.saved_tensors)


class Row(NamedTuple):
    """One call: its name, what is timed, and two functions whose results agree (None: nothing to compare)."""

    name: str
    call: Callable[[], Any]
    wanted: Callable[[], Any] | None = None


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("host_time", __doc__)
    parser.add_argument("--scene", default="go2", choices=SCENES)
    parser.add_argument("--worlds", type=int, default=4096)
    parser.add_argument("--granularity", help="default: the plan's choice")
    parser.add_argument("--backend", default="inductor", help="of torch.compile")
    parser.add_argument("--only", default="", help="rows whose name has this text")
    options = parser.parse_args(arguments)
    device = wp.get_device(options.device)
    scene = SCENES[options.scene]()
    compiled, complaints = compiled_row(scene, options, device)
    rows = [*torch_rows(scene, options, device), compiled, *warp_rows(scene, options, device)]
    found: list[dict] = []
    run = runner.record(found, options.device)
    run["versions"]["torch"] = torch.__version__
    print(f"{options.scene}, {options.worlds} worlds, {device.name}, torch {torch.__version__}, microseconds a call")
    print(f"{'call':56} {'host':>8} {'done':>8} {'error':>8}")
    for row in rows:
        if options.only in row.name:
            found.append(dict(group=f"{GROUP} {options.scene}", worlds=options.worlds, **measure(row, device)))
            print("{name:56} {us:8.2f} {done_us:8.2f} {error:8.1e}".format(**found[-1]), flush=True)
    for complaint in complaints:
        print(f"torch.compile: {complaint}")
    over = [r for r in found if r["us"] > TARGETS.get(r["name"].removeprefix("torch: "), np.inf)]
    for row in over:
        print(f"over the target of {TARGETS[row['name'].removeprefix('torch: ')]} us: {row['name']}")
    if options.json:
        runner.save(run, options.json)
    return 0 if not complaints and all(row["error"] <= TOLERANCE for row in found) else 1


def measure(row: Row, device: wp.Device) -> dict[str, Any]:
    """Return the times of a call [us], and the largest relative error of its results, before and after timing."""
    for _ in range(WARM_UP):
        row.call()
    errors, host, done = [error(row)], [], []
    for _ in range(BATCHES):
        wp.synchronize_device(device)
        start = time.perf_counter()
        for _ in range(BATCH):
            row.call()
        host.append(time.perf_counter() - start)
        wp.synchronize_device(device)
        done.append(time.perf_counter() - start)
    errors.append(error(row))
    medians = [1e6 * statistics.median(times) / BATCH for times in (host, done)]
    low = 1e6 * min(host) / BATCH
    return dict(name=row.name, us=medians[0], least_us=low, done_us=medians[1], error=max(errors))


def error(row: Row) -> float:
    if row.wanted is None:
        return 0.0
    pairs = zip(leaves(row.call()), leaves(row.wanted()), strict=True)
    return max(float(np.abs(x - y).max() / np.abs(y).max()) for x, y in pairs)


def leaves(result: Any) -> list[np.ndarray]:
    """Return the arrays of a result of any kind, as NumPy arrays."""
    if isinstance(result, dict):
        result = tuple(result.values())
    return [as_numpy(x) for x in (result if isinstance(result, tuple | list) else (result,))]


def as_numpy(array: Any) -> np.ndarray:
    if isinstance(array, torch.Tensor):
        return array.detach().cpu().numpy().copy()
    return array.numpy().copy() if isinstance(array, wp.array) else array


def state(scene: spo.Scene, worlds: int) -> dict[str, np.ndarray]:
    """Return random arrays by name [world, ...]."""
    rng = np.random.default_rng(0)
    rates = {name: rng.normal(size=(worlds, scene.dof_count)) for name in ("qd", "qdd", "tau", "bar")}
    q = scene.neutral_q + 0.3 * rng.normal(size=(worlds, scene.coord_count))
    return {name: array.astype(np.float32) for name, array in {"q": q, **rates}.items()}


def torch_rows(scene: spo.Scene, options: argparse.Namespace, device: wp.Device) -> list[Row]:
    dyn = spo.Dynamics(scene, options.worlds, device, granularity=options.granularity)
    n, dt = state(scene, options.worlds), 1e-3
    t = {name: torch.tensor(array, device=wp.device_to_torch(device)) for name, array in n.items()}
    q, qd, qdd, tau, bar = (t[name] for name in ("q", "qd", "qdd", "tau", "bar"))
    out, mass = torch.empty_like(qd), torch.empty(options.worlds, *2 * (qd.shape[1],), device=qd.device)
    ahead = torch.empty_like(q), torch.empty_like(qd)
    leaf = [x.clone().requires_grad_() for x in (q, qd, tau)]

    def backward(function: Callable[..., torch.Tensor], inputs: list[torch.Tensor]) -> Any:
        return torch.autograd.grad(function(*inputs), inputs, grad_outputs=bar)

    forward = lambda: dyn.forward_dynamics(n["q"], n["qd"], n["tau"])  # noqa: E731
    inverse = lambda: dyn.inverse_dynamics(n["q"], n["qd"], n["qdd"])  # noqa: E731
    step = lambda: dyn.step(n["q"], n["qd"], n["tau"], dt)  # noqa: E731
    pulled = lambda: dyn.forward_dynamics_vjp(n["q"], n["qd"], n["tau"], cotangent=n["bar"])  # noqa: E731
    rows = [
        Row("add, out=", lambda: torch.add(qd, tau, out=out), lambda: n["qd"] + n["tau"]),
        Row("add", lambda: torch.add(qd, tau), lambda: n["qd"] + n["tau"]),
        Row("add, forward and backward", lambda: backward(torch.add, leaf[1:]), lambda: [n["bar"], n["bar"]]),
        Row("an empty autograd.Function, forward and backward", lambda: backward(Empty.apply, leaf)),
        Row("forward_dynamics, out=", lambda: dyn.forward_dynamics(q, qd, tau, out=out), forward),
        Row("forward_dynamics", lambda: dyn.forward_dynamics(q, qd, tau), forward),
        Row("inverse_dynamics, out=", lambda: dyn.inverse_dynamics(q, qd, qdd, out=out), inverse),
        Row("inverse_dynamics", lambda: dyn.inverse_dynamics(q, qd, qdd), inverse),
        Row("mass_matrix, out=", lambda: dyn.mass_matrix(q, out=mass), lambda: dyn.mass_matrix(n["q"])),
        Row("mass_matrix", lambda: dyn.mass_matrix(q), lambda: dyn.mass_matrix(n["q"])),
        Row("step, out=", lambda: dyn.step(q, qd, tau, dt, out=ahead), step),
        Row("step", lambda: dyn.step(q, qd, tau, dt), step),
        Row("forward_dynamics_vjp", lambda: dyn.forward_dynamics_vjp(q, qd, tau, cotangent=bar), pulled),
        Row("forward_dynamics, forward and backward", lambda: backward(dyn.forward_dynamics, leaf), pulled),
    ]
    return [row._replace(name=f"torch: {row.name}") for row in rows]


def compiled_row(scene: spo.Scene, options: argparse.Namespace, device: wp.Device) -> tuple[Row, list[str]]:
    """Return the plain call under torch.compile, whose first call is that of its Dynamics, and what was wrong in it."""
    dyn = spo.Dynamics(scene, options.worlds, device, granularity=options.granularity)
    n = state(scene, options.worlds)
    given = [torch.tensor(n[name], device=wp.device_to_torch(device)) for name in ("q", "qd", "tau")]

    @torch.compile(fullgraph=True, backend=options.backend)
    def call(q: torch.Tensor, qd: torch.Tensor, tau: torch.Tensor) -> torch.Tensor:
        return dyn.forward_dynamics(q, qd, tau)

    complaints = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            call(*given)
        except Exception as problem:
            complaints.append(f"{type(problem).__name__}: {str(problem).splitlines()[0]}")
    ours = [str(w.message) for w in caught if "warp_spo" in f"{w.filename} {w.message}"]
    wanted = lambda: dyn.forward_dynamics(n["q"], n["qd"], n["tau"])  # noqa: E731
    timed = (lambda: call(*given)) if not complaints else wanted
    return Row("torch: forward_dynamics, compiled", timed, wanted), [*complaints, *ours]


def warp_rows(scene: spo.Scene, options: argparse.Namespace, device: wp.Device) -> list[Row]:
    dyn = spo.Dynamics(scene, options.worlds, device, granularity=options.granularity)
    n, dt = state(scene, options.worlds), 1e-3
    a = {name: wp.array(array, dtype=wp.float32, device=device) for name, array in n.items()}
    q, qd, qdd, tau = (a[name] for name in ("q", "qd", "qdd", "tau"))
    out, ahead = wp.empty_like(qd), (wp.empty_like(q), wp.empty_like(qd))
    forward = lambda: dyn.forward_dynamics(n["q"], n["qd"], n["tau"])  # noqa: E731
    inverse = lambda: dyn.inverse_dynamics(n["q"], n["qd"], n["qdd"])  # noqa: E731
    step = lambda: dyn.step(n["q"], n["qd"], n["tau"], dt)  # noqa: E731
    rows = [
        Row("forward_dynamics, out=", lambda: dyn.forward_dynamics(q, qd, tau, out=out), forward),
        Row("forward_dynamics", lambda: dyn.forward_dynamics(q, qd, tau), forward),
        Row("inverse_dynamics, out=", lambda: dyn.inverse_dynamics(q, qd, qdd, out=out), inverse),
        Row("mass_matrix", lambda: dyn.mass_matrix(q), lambda: dyn.mass_matrix(n["q"])),
        Row("step, out=", lambda: dyn.step(q, qd, tau, dt, out=ahead), step),
        Row("step", lambda: dyn.step(q, qd, tau, dt), step),
    ]
    return [r._replace(name=f"Warp: {r.name}") for r in [*rows, solver_row(options.scene, options.worlds, device)]]


def solver_row(name: str, worlds: int, device: wp.Device) -> Row:
    """Return a step of SolverSPO, of a released robot or Newton's cartpole; the host time is nearly the same."""
    import newton

    from warp_spo.newton import SolverSPO, shipped

    one, many = newton.ModelBuilder(), newton.ModelBuilder()
    robot = robots.ROBOTS.get(name)
    if robot is None:
        one.add_urdf(str(shipped("cartpole")))
    else:
        one.add_urdf(robots.urdf_text(name), floating=robot.floating)
    many.replicate(one, worlds)
    model = many.finalize(device=device)
    solver, first, second, control = SolverSPO(model), model.state(), model.state(), model.control()
    return Row("SolverSPO.step", lambda: solver.step(first, second, control, None, 1e-3))


if __name__ == "__main__":
    sys.exit(main())
