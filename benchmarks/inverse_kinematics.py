"""Inverse kinematics of two arms: share of targets that are reached and time, beside newton.ik, in one run.

    python -m benchmarks.inverse_kinematics [--device cuda:0] [--targets 4096] [--seeds 16] [--json FILE]

Targets are the tool's poses at random configurations within the limits, so that every one can be reached. A target
counts as reached where the returned configuration, brought within the limits, puts the tool within 1 mm and 0.1 degrees
of it, which is computed apart, in float64. newton.ik minimises position, rotation and joint-limit objectives from the
very same starts; all its starts of a target are problems of one solver, and the best one counts.

On CUDA a call is captured into a graph, which is replayed between two events; on a CPU calls are timed one by one. The
exit code is 1 if ours reaches less than 99 % of the targets at its default number of iterations.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

import warp_spo as spo
from warp_spo.dynamics.inverse_kinematics import ITERATIONS, starts

from . import command_line
from .table import arms, runner

DISTANCE, ANGLE = 1e-3, np.radians(0.1)  # [m, rad] within which a target is reached
ENOUGH = 0.99  # of the targets
OURS = (10, ITERATIONS, 30)  # iterations
THEIRS = (20, 50)
REPEATS, WARM_UP = 15, 0.2
LIMIT_WEIGHT = 10.0  # of newton's objective: with its default of 0.1 more solutions lie beyond the limits


def measure_time(call: Callable[[], Any], device: wp.Device) -> float:
    """Return the median time of a call [us]."""
    call()
    wp.synchronize_device(device)
    if not device.is_cuda:
        took = []
        for _ in range(3):
            begin = time.perf_counter()
            call()
            took.append(time.perf_counter() - begin)
        return 1e6 * float(np.median(took))
    with wp.ScopedCapture(device) as capture:
        call()
    begin = time.perf_counter()
    while time.perf_counter() - begin < WARM_UP:
        wp.capture_launch(capture.graph)
        wp.synchronize_device(device)
    took = []
    for _ in range(REPEATS):
        first, last = (wp.Event(device, enable_timing=True) for _ in range(2))
        device.stream.record_event(first)
        wp.capture_launch(capture.graph)
        device.stream.record_event(last)
        wp.synchronize_device(device)
        took.append(1e3 * wp.get_event_elapsed_time(first, last))
    return float(np.median(took))


class Problem:
    """One arm, targets that it can reach, and what says whether it has."""

    def __init__(self, name: str, targets: int, seeds: int, device: wp.Device):
        self.name, self.seeds, self.device, self.scene = name, seeds, device, arms.scene(name)
        limits = (self.scene.values[f"joint_limit_{side}"][0] for side in ("lower", "upper"))
        self.lower, self.upper = limits
        q = np.random.default_rng(0).uniform(self.lower, self.upper, (targets, len(self.lower)))
        self.frames = [arms.tool(name)]
        self.exact = spo.Dynamics(self.scene, targets, device="cpu", dtype="float64")
        self.targets = self.exact.frame_poses(q, self.frames)

    @property
    def starts(self) -> np.ndarray:
        """Where the search starts, in every world [seed, coordinate]."""
        return self.lower + starts(self.scene, self.seeds) * (self.upper - self.lower)

    def misses(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the distance [m] and the angle [rad] of each world's tool from its target, within the limits."""
        q = np.clip(np.asarray(q, dtype=np.float64), self.lower, self.upper)
        found = self.exact.frame_poses(q, self.frames)[:, 0]
        wanted = self.targets[:, 0]
        u, w, v, s = found[:, 3:6], found[:, 6:], wanted[:, 3:6], wanted[:, 6:]
        sine = np.linalg.norm(s * u - w * v - np.cross(u, v), axis=1)
        return np.linalg.norm(found[:, :3] - wanted[:, :3], axis=1), 2.0 * np.arcsin(np.minimum(sine, 1.0))

    def row(self, library: str, iterations: int, us: float, q: np.ndarray) -> dict[str, Any]:
        """Return what was measured; ``q`` are the returned configurations [world, coordinate]."""
        distance, angle = self.misses(q)
        reached = (distance < DISTANCE) & (angle < ANGLE)
        outside = np.maximum(self.lower - q, q - self.upper).max(axis=1) > 1e-6
        return dict(
            group=f"inverse kinematics, {self.name}",
            name=f"{library}, {iterations} iterations, {100 * reached.mean():.2f} % reached",
            worlds=len(q),
            library=library,
            seeds=self.seeds,
            iterations=iterations,
            us=us,
            reached=float(reached.mean()),
            outside=float(outside.mean()),
            targets_per_s=1e6 * len(q) / us,
        )


def ours(problem: Problem, iterations: int) -> dict[str, Any]:
    """Measure Dynamics.inverse_kinematics in float32."""
    device, worlds = problem.device, len(problem.targets)
    dyn = spo.Dynamics(problem.scene, worlds, device=device)
    targets = wp.array(problem.targets, dtype=wp.float32, device=device)
    out: Any = (
        wp.full((worlds, problem.scene.coord_count), np.nan, dtype=wp.float32, device=device),
        wp.full(worlds, np.nan, dtype=wp.float32, device=device),
    )

    def call() -> None:
        dyn.inverse_kinematics(targets, problem.frames, seeds=problem.seeds, iterations=iterations, out=out)

    us = measure_time(call, device)
    row = problem.row("warp_spo", iterations, us, out[0].numpy())
    said = float((out[1].numpy() < DISTANCE).mean())
    assert abs(said - row["reached"]) <= 2.0 / worlds, f"the error says {said}, the poses say {row['reached']}"
    return row


def newtons(problem: Problem, iterations: int) -> dict[str, Any]:
    """Measure newton.ik.IKSolver: a problem for each target and start, Levenberg-Marquardt, analytic Jacobians."""
    import newton
    from newton import ik

    device, worlds, seeds = problem.device, len(problem.targets), problem.seeds
    with wp.ScopedDevice(device):
        builder = newton.ModelBuilder()
        builder.add_urdf(arms.urdf_text(problem.name), floating=False)
        model = builder.finalize(device=device)
        label, tool = problem.frames[0]
        link = [one.rpartition("/")[2] for one in model.body_label].index(label)
        targets = np.repeat(problem.targets[:, 0], seeds, axis=0).astype(np.float32)
        objectives = [
            ik.IKObjectivePosition(link, wp.vec3(*tool[:3]), wp.array(targets[:, :3].copy(), dtype=wp.vec3)),
            ik.IKObjectiveRotation(link, wp.quat(*tool[3:]), wp.array(targets[:, 3:].copy(), dtype=wp.vec4)),
            ik.IKObjectiveJointLimit(model.joint_limit_lower, model.joint_limit_upper, weight=LIMIT_WEIGHT),
        ]
        solver = ik.IKSolver(model, worlds * seeds, objectives, jacobian_mode=ik.IKJacobianType.ANALYTIC)
        start = wp.array(np.tile(problem.starts, (worlds, 1)), dtype=wp.float32)
        found = wp.empty_like(start)
        us = measure_time(lambda: solver.step(start, found, iterations=iterations), device)
        best = solver.costs.numpy().reshape(worlds, seeds).argmin(axis=1)
        return problem.row("newton.ik", iterations, us, found.numpy().reshape(worlds, seeds, -1)[range(worlds), best])


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("inverse_kinematics", __doc__)
    parser.add_argument("--arms", nargs="+", default=list(arms.ARMS), choices=list(arms.ARMS))
    parser.add_argument("--targets", type=int, default=4096)
    parser.add_argument("--seeds", type=int, default=16)
    parser.add_argument("--without-newton", action="store_true", help="measure ours alone")
    options = parser.parse_args(arguments)
    device = wp.get_device(options.device)
    rows: list[dict] = []
    run, short = runner.record(rows, options.device), []
    libraries = [(ours, OURS), *([] if options.without_newton else [(newtons, THEIRS)])]
    print(
        f"{'arm':6} {'library':10} {'iterations':>10} {'us':>10} {'reached':>9} {'outside':>9} {'10^6 targets/s':>15}"
    )
    for name in options.arms:
        problem = Problem(name, options.targets, options.seeds, device)
        for measure, counts in libraries:
            for iterations in counts:
                row = measure(problem, iterations)
                rows.append(row)
                shares = f"{100 * row['reached']:8.2f}% {100 * row['outside']:8.2f}%"
                rate = 1e-6 * row["targets_per_s"]
                print(
                    f"{name:6} {row['library']:10} {iterations:10} {row['us']:10.1f} {shares} {rate:15.4g}", flush=True
                )
                if measure is ours and iterations == ITERATIONS and row["reached"] < ENOUGH:
                    short.append(name)
                if options.json:
                    runner.save(run, options.json)
    if short:
        print(f"less than {100 * ENOUGH:g} % reached: {', '.join(short)}", file=sys.stderr)
    return 1 if short else 0


if __name__ == "__main__":
    sys.exit(main())
