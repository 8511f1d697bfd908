"""Check and time forward dynamics and its dense derivatives of a crane with a flexible mast, boom and jib.

    python -m benchmarks.flexible [--device cuda:0] [--worlds 4096 65536] [--points 5] [--json FILE]
    python -m benchmarks.flexible --device cpu --worlds 8 --modes few      # compiles in seconds

Each of the three bodies has six modes: two of bending in each plane, one of twist, one of stretch. Results of a few
worlds are compared in float64 with a dense solution of Mass qdd = tau - bias_force, and derivatives with its central
differences; the exit code is 1 if one differs by more than its tolerance. Times are medians over replays of a CUDA
graph of many calls on sets of inputs in turn, see ``benchmarks.capabilities``.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

import warp_spo as spo
from warp_spo.examples import crane

from . import command_line
from .capabilities import SETS, measure_time
from .table import runner
from .table.resources import record_launches, resources

SIX = ({"y": 2, "z": 2, "torsion": 1, "axial": 1},) * 3
MODES = {"six": SIX, "few": crane.COUNTS}
OPERATIONS = ("forward_dynamics", "forward_dynamics_derivatives")
TARGETS = {"forward_dynamics": 200e6, "forward_dynamics_derivatives": 10e6}  # evaluations a second asked of an H200
SAMPLE, H = 4, 1e-6  # worlds that are checked; step of differences
TOLERANCE = {"float32": 2e-3, "float64": 1e-6}  # of the largest entry; differences of 1e-6 leave 1e-8
AMPLITUDE = 0.05  # of modes [m, rad]; hinges turn by a radian


def inputs(scene: spo.Scene, worlds: int, seed: int) -> list[np.ndarray]:
    """Return q, qd and tau [world, dof] in float32."""
    rng, n = np.random.default_rng(seed), scene.dof_count
    size = np.array([AMPLITUDE if "modes" in label else 1.0 for label in scene.dof_labels])
    q, qd = size * rng.uniform(-1.0, 1.0, (worlds, n)), size * rng.normal(size=(worlds, n))
    return [x.astype(np.float32) for x in (q, qd, 1e3 * rng.normal(size=(worlds, n)))]


def dense(exact: spo.Dynamics, q: np.ndarray, qd: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Return accelerations by a dense solution in float64."""
    return np.linalg.solve(exact.mass_matrix(q), (tau - exact.bias_force(q, qd))[..., None])[..., 0]


def expected(exact: spo.Dynamics, operation: str, given: list[np.ndarray]) -> list[np.ndarray]:
    """Return the results of an operation: qdd, or its derivatives by q, qd and tau [world, dof, dof]."""
    if operation == "forward_dynamics":
        return [dense(exact, *given)]
    found = []
    for k, array in enumerate(given):
        steps = max(1.0, float(np.abs(array).max())) * H * np.eye(array.shape[1])
        ends = [[dense(exact, *given[:k], array + sign * step, *given[k + 1 :]) for step in steps] for sign in (1, -1)]
        found.append(np.stack([(a - b) / (2.0 * steps[0, 0]) for a, b in zip(*ends, strict=True)], axis=-1))
    return found


def measure(scene: spo.Scene, operation: str, worlds: int, dtype: str, device: wp.Device) -> dict[str, Any]:
    """Return times of an operation, its error, and what its kernels take."""
    dyn, exact = spo.Dynamics(scene, worlds, device, dtype), spo.Dynamics(scene, min(SAMPLE, worlds), "cpu", "float64")
    sets = [inputs(scene, worlds, seed) for seed in range(SETS)]
    on = [[wp.array(array, dtype=dyn.dtype, device=device) for array in arrays] for arrays in sets]
    call: Callable[..., Any] = getattr(dyn, operation)
    begin = time.perf_counter()
    out = call(*on[0])
    wp.synchronize_device(device)
    first = time.perf_counter() - begin
    outs = list(out) if isinstance(out, tuple) else [out]
    with record_launches() as launched:
        call(*on[0], out=out)
    us, error = measure_time(lambda k: call(*on[k], out=out), device), 0.0
    for arrays, given in zip(on, sets, strict=True):
        for array in outs:
            array.fill_(float("nan"))
        call(*arrays, out=out)
        some = [array[:SAMPLE].astype(np.float64) for array in given]
        for got, wanted in zip(outs, expected(exact, operation, some), strict=True):
            wrong = np.abs(got.numpy()[:SAMPLE] - wanted).max() / np.abs(wanted).max()
            error = max(error, float(wrong)) if np.isfinite(wrong) else float("nan")
    counts = sum(dyn.operation_counts.values())
    row = dict(us=us, evals_per_s=1e6 * worlds / us, error=error, compile_s=first, flops=counts)
    return row | resources(launched, device)


def main(arguments: list[str] | None = None) -> int:
    """Print a row for each operation and world count."""
    parser = command_line.parser("flexible", __doc__, json="file or folder for the rows")
    parser.add_argument("--worlds", nargs="+", type=int, default=[4096, 65536])
    parser.add_argument("--operations", nargs="+", default=OPERATIONS, choices=OPERATIONS)
    parser.add_argument("--modes", default="six", choices=MODES)
    parser.add_argument("--points", type=int, default=5, help="that carry the mass of each beam")
    parser.add_argument("--dtype", default="float32", choices=TOLERANCE)
    options = parser.parse_args(arguments)
    device, scene = wp.get_device(options.device), crane.scene(MODES[options.modes], options.points)
    rows: list[dict] = []
    print(f"{scene!r}, {device.name}, {options.dtype}")
    print(f"{'operation':30} {'worlds':>7} {'us':>9} {'10^6/s':>8} {'error':>8} {'operations':>10} {'compile':>8}")
    for operation in options.operations:
        for worlds in options.worlds:
            row = measure(scene, operation, worlds, options.dtype, device)
            more = dict(modes=options.modes, points=options.points, dtype=options.dtype)
            rows.append(dict(group="a crane that bends", name=operation, worlds=worlds, **more, **row))
            print(f"{operation:30} {worlds:7} {row['us']:9.1f} {1e-6 * row['evals_per_s']:8.2f} {row['error']:8.1e} "
                  f"{row['flops']:10} {row['compile_s']:7.1f}s", flush=True)  # fmt: skip
            if "registers" in row:
                print(f"{'':30} {row['registers']} registers, {row['local_bytes']} bytes of local memory a thread")
    for name in options.operations if options.modes == "six" and device.is_cuda else ():
        best = max(row["evals_per_s"] for row in rows if row["name"] == name)
        print(f"{name}: {1e-6 * best:.1f} of {1e-6 * TARGETS[name]:.0f} million a second that are asked of an H200")
    if options.json:
        print(f"wrote {runner.save(runner.record(rows, options.device), options.json)}")
    return 0 if all(row["error"] <= TOLERANCE[options.dtype] for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
