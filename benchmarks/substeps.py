"""Several substeps in one launch beside as many calls: time, and whether every bit is the same.

    python -m benchmarks.substeps [ROBOT ...] [--device cuda:0] [--worlds 4096 16384] [--counts 4 10] [--json FILE]

Robots have drives and the limits of their files, see :mod:`benchmarks.step_parts`; "go2 on a plane" and "g1 on a plane"
have contacts, see :mod:`benchmarks.contact.scenes`. Worlds start at random in and around their limits, dt is 5 ms.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

import warp_spo as spo
from warp_spo.scene.scene import Scene

from . import command_line, step_parts
from .capabilities import SETS, measure_time
from .contact import scenes
from .table import runner
from .table.resources import record_launches, resources

DT = 5e-3
ON_PLANE = " on a plane"
NAMES = ("go2", "g1", "go2 on a plane", "g1 on a plane")
BEYOND = 0.05  # share of the range of a hinge by which random states may lie outside of it


def positions(scene: Scene, worlds: int, rng: np.random.Generator, beyond: float) -> np.ndarray:
    """Return random coordinates in the ranges of the hinges, within half a turn from zero [world, coordinate]."""
    low = np.maximum(scene.values["joint_limit_lower"][0], -np.pi)
    high = np.minimum(scene.values["joint_limit_upper"][0], np.pi)
    q = np.tile(scene.neutral_q, (worlds, 1))
    for hinge, first, dof in zip(scene.hinges, scene.q_start, scene.qd_start, strict=False):
        if hinge.unconstrained:
            turn = rng.normal(size=(worlds, 4))
            q[:, first + 3 : first + 7] = turn / np.linalg.norm(turn, axis=1, keepdims=True)
        elif hinge.dof_count:
            q[:, first] = low[dof] + (high - low)[dof] * rng.uniform(-beyond, 1.0 + beyond, worlds)
    return q


def subject(name: str, worlds: int, device: wp.Device) -> tuple[spo.Dynamics, list[dict[str, wp.array]]]:
    """Return a robot and its sets of arguments of a step."""
    if name.endswith(ON_PLANE):
        dyn, states = scenes.subject(name.removesuffix(ON_PLANE), worlds, device)
        return dyn, [dict(zip(("q", "qd"), state, strict=True)) | {"tau": None} for state in states]
    scene, sets = step_parts.driven_scene(name), []
    rng = np.random.default_rng(0)
    for _ in range(SETS):
        rates = (rng.normal(size=(worlds, scene.dof_count)) for _ in range(2))
        arrays = {"q": positions(scene, worlds, rng, BEYOND), **dict(zip(("qd", "tau"), rates, strict=True))}
        arrays["target_q"] = positions(scene, worlds, rng, -BEYOND)
        sets.append({key: wp.array(array, dtype=wp.float32, device=device) for key, array in arrays.items()})
    return spo.Dynamics(scene, worlds, device), sets


def measure(name: str, worlds: int, device: wp.Device, count: int) -> dict[str, Any]:
    """Return what :func:`prepare` measures."""
    return prepare(name, worlds, device, count)()


def prepare(name: str, worlds: int, device: wp.Device, count: int) -> Callable[[], dict[str, Any]]:
    """Compare all bits, and return what measures ``us`` of one launch and ``calls_us`` of as many calls.

    ``error`` is 0 if all bits agree.

    Raises:
        AssertionError: a result is not finite.
    """
    dyn, sets = subject(name, worlds, device)
    outs = [tuple(wp.empty_like(sets[0][key]) for key in ("q", "qd")) for _ in range(2)]

    def fused(k: int) -> None:
        dyn.step(**sets[k], dt=DT, options=spo.StepOptions(substeps=count), out=outs[0])

    def calls(k: int) -> None:
        given = dict(sets[k])
        for _ in range(count):
            given["q"], given["qd"] = dyn.step(**given, dt=DT, out=outs[1])

    with record_launches() as launched:
        fused(0)
    error = 0.0
    for k in range(SETS):
        for run in (fused, calls):
            run(k)
        for got, wanted in zip(*([x.numpy() for x in out] for out in outs), strict=True):
            assert np.isfinite(wanted).all(), f"{name}: a state is not finite"
            error = max(error, float(np.abs(got.astype(np.float64) - wanted).max()))

    def timed() -> dict[str, Any]:
        row = {"us": measure_time(fused, device), "calls_us": measure_time(calls, device), "error": error}
        return row | resources(launched, device)

    return timed


def main(arguments: list[str] | None = None) -> int:
    """Print a line for each robot, number of worlds and of substeps."""
    parser = command_line.parser("substeps", __doc__)
    parser.add_argument("robots", nargs="*", default=list(NAMES))
    parser.add_argument("--worlds", nargs="+", type=int, default=[4096, 16384])
    parser.add_argument("--counts", nargs="+", type=int, default=[4, 10])
    options = parser.parse_args(arguments)
    rows: list[dict] = []
    run, device = runner.record(rows, options.device), wp.get_device(options.device)
    for name in options.robots:
        for worlds in options.worlds:
            for count in options.counts:
                row = dict(robot=name, worlds=worlds, substeps=count) | measure(name, worlds, device, count)
                rows.append(row)
                times = f"{row['us']:.4g} us, as calls {row['calls_us']:.4g} us"
                print(f"{name}, {worlds} worlds, {count} substeps: {times}, difference {row['error']:.1e}", flush=True)
                if options.json:
                    runner.save(run, options.json)
    return 1 if any(row["error"] for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
