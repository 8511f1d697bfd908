"""Gradients of steps with contacts: their time beside the step's, their errors in float32, and the price of switches.

    python -m benchmarks.contact.gradients [ROBOT ...] [--device cuda:0] [--worlds 4096] [--ground rough] [--json FILE]
                                           [--passes 3 4] [--heights]
    python -m benchmarks.contact.gradients --picture FILE.svg

Robots stand on the ground as in `benchmarks.contact.steps`, and gradients are by q, qd and tau. The picture: a point is
thrown along the ground, and how far it has slid is drawn over the height from which it fell, with the tangents that
gradients say. Every jump is where the first touch moves to another step.
"""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import warp_spo as spo
from warp_spo.dynamics.operation import derivative_of
from warp_spo.dynamics.stepping.step import STEP
from warp_spo.scene.ground import HEIGHTS
from warp_spo.viewing.charts import OTHER, OURS

from .. import command_line
from ..capabilities import SETS, measure_time
from . import scenes

DT = scenes.DT
WRT = ("q", "qd", "tau")
SAMPLE = 256  # worlds whose gradients are compared with those in float64
THROWN = dict(dt=5e-3, steps=100, speed=1.0, friction=0.5, stiffness=2e4)
FALLS = (0.25, 0.33)  # from which points fall [m]
DAMPERS = {"damping=70": dict(damping=70.0), "dissipation=0.2": dict(dissipation=0.2)}
"""By title: half of sqrt(k m), the share that contacts get without damping=, and the law of Hunt and Crossley."""


# -- time and errors ---------------------------------------------------------------------------------------------------
def measure(
    robot: str, worlds: int, device: wp.Device, field: bool = False, passes: int = 3, heights: bool = False
) -> dict[str, float]:
    """Return ``us`` of a step, ``gradient_us``, and ``error``: of gradients in float32, over the largest of the world.

    Args:
        field: rough ground of 2 cm in place of a plane. heights: gradients by its heights, too, without their error.
    """
    variable, wrt = ((HEIGHTS,), (*WRT, HEIGHTS)) if heights else ((), WRT)
    dyn, sets = scenes.subject(robot, worlds, device, field, variable=variable)
    rng = np.random.default_rng(9)
    given = [_random_inputs(dyn, q, qd, rng) for q, qd in sets]
    out = tuple(wp.empty_like(x) for x in sets[0])
    outs = [wp.empty(dyn._gradients.shape_of(STEP, name), dtype=dyn.dtype, device=device) for name in wrt]

    def step(i: int) -> None:
        one, options = given[i], spo.StepOptions(passes=passes)
        dyn.step(one["q"], one["qd"], one["tau"], DT, report=spo.StepReport(qdd=one["qdd"]), options=options, out=out)

    def back(i: int) -> None:
        dyn._gradients.launch(derivative_of(STEP), wrt, outs, {**given[i], "dt": DT, "passes": passes})

    found = {"us": measure_time(step, device)}
    for i in range(SETS):
        step(i)  # fills qdd
    found["gradient_us"] = measure_time(back, device)
    back(0)
    few = min(worlds, SAMPLE)
    exact = spo.Dynamics(dyn.scene, few, "cpu", "float64")
    twin = {name: wp.array(x.numpy()[:few], dtype=wp.float64, device="cpu") for name, x in given[0].items()}
    exact.step(
        twin["q"],
        twin["qd"],
        twin["tau"],
        DT,
        report=spo.StepReport(qdd=twin["qdd"]),
        options=spo.StepOptions(passes=passes),
    )
    wanted = [wp.empty_like(twin[name]) for name in WRT]
    exact._gradients.launch(derivative_of(STEP), WRT, wanted, {**twin, "dt": DT, "passes": passes})
    errors = []
    for mine, best in zip(outs, wanted, strict=False):
        a, b = mine.numpy()[:few].astype(float), best.numpy()
        errors.append(np.abs(a - b).max(axis=1) / np.abs(b).max(axis=1))
    return found | {"error_median": float(np.median(errors)), "error_99": float(np.quantile(errors, 0.99))}


def _random_inputs(dyn: spo.Dynamics, q: wp.array, qd: wp.array, rng: np.random.Generator) -> dict[str, Any]:
    """Return a state, forces and cotangents by name, and an array for qdd."""

    def random(like: wp.array) -> wp.array:
        return wp.array(rng.normal(size=like.shape), dtype=like.dtype, device=like.device)

    cotangents = {"q_cotangent": random(q), "qd_cotangent": random(qd)}
    return {"q": q, "qd": qd, "tau": random(qd), "qdd": wp.zeros_like(qd), **cotangents}


# -- the picture -------------------------------------------------------------------------------------------------------
def slide_of_throw(heights: np.ndarray, **damper: float) -> tuple[np.ndarray, np.ndarray]:
    """Return how far points slide that fall from ``heights`` [m], and the gradient of that by the height."""
    import torch

    contact = spo.Contact(1, point=(0, 0, 0), friction=THROWN["friction"], stiffness=THROWN["stiffness"], **damper)
    rails = [spo.Hinge("prismatic", k - 1, k, axis=axis) for k, axis in enumerate([(1, 0, 0), (0, 0, 1)])]
    bodies = [spo.Body(1e-3, inertia=1e-6 * np.eye(3)), spo.Body(1.0, inertia=0.01 * np.eye(3))]
    scene = spo.Scene(bodies, rails, contacts=[contact], ground=spo.Plane())
    dyn = spo.Dynamics(scene, len(heights), "cpu", "float64")
    z = torch.tensor(heights, dtype=torch.float64, requires_grad=True)
    q, qd = torch.stack([torch.zeros_like(z), z], 1), torch.zeros((len(heights), 2), dtype=torch.float64)
    qd[:, 0] = THROWN["speed"]
    for _ in range(int(THROWN["steps"])):
        q, qd = dyn.step(q, qd, None, THROWN["dt"])
    (slope,) = torch.autograd.grad(q[:, 0].sum(), z)
    return q[:, 0].detach().numpy(), slope.numpy()


def slopes(**damper: float) -> tuple[float, float]:
    """Return the mean gradient over FALLS, and the slope of the distance from one end of them to the other."""
    heights = np.linspace(*FALLS, 801)
    x, slope = slide_of_throw(heights, **damper)
    return float(slope.mean()), float((x[-1] - x[0]) / (heights[-1] - heights[0]))


def draw(path: Path) -> None:
    """Draw the distance over the height with tangents, a panel for each damper."""
    from warp_spo.examples.options import drawing

    heights = np.linspace(*FALLS, 801)
    with drawing(path, *(f"A point that touches with {title}" for title in DAMPERS)) as panels:
        for axes, damper in zip(panels, DAMPERS.values(), strict=True):
            x, slope = slide_of_throw(heights, **damper)
            edges = np.flatnonzero(np.abs(np.diff(x)) > 4.0 * np.abs(slope[1:] * np.diff(heights)))
            parts = zip(np.split(1e2 * heights, edges + 1), np.split(1e2 * x, edges + 1), strict=True)
            for number, (z, part) in enumerate(parts):
                axes.plot(z, part, color=OURS, label="distance after 0.5 s" if number == 0 else None)
            reach = 0.006
            for number, at in enumerate(range(80, 800, 128)):
                ends = np.array([-reach, reach])
                axes.plot(1e2 * (heights[at] + ends), 1e2 * (x[at] + slope[at] * ends), color=OTHER, linewidth=1.2,
                          label="slope that the gradient says" if number == 0 else None)  # fmt: skip
            axes.set(xlabel="height of the fall [cm]", ylabel="distance [cm]")


def main() -> None:
    parser = command_line.parser("contact.gradients", __doc__)
    parser.add_argument("robots", nargs="*", default=["go2"], help="go2, g1, ant")
    parser.add_argument("--worlds", type=int, nargs="+", default=[4096])
    parser.add_argument("--ground", choices=["plane", "rough"], nargs="+", default=["plane", "rough"])
    parser.add_argument("--passes", type=int, nargs="+", default=[3])
    parser.add_argument("--heights", action="store_true", help="gradients by the heights of the rough ground, too")
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    if options.picture:
        draw(options.picture)
        for title, damper in DAMPERS.items():
            print("{}: gradients of {:.3f} on average, a slope of {:.3f}".format(title, *slopes(**damper)))
        return
    device, rows = wp.get_device(options.device), []
    for robot in options.robots:
        for worlds in options.worlds:
            for ground, passes in itertools.product(options.ground, options.passes):
                field = ground == "rough"
                found = measure(robot, worlds, device, field, passes, options.heights and field)
                rows.append({"robot": robot, "worlds": worlds, "ground": ground, "passes": passes, **found})
                print(json.dumps(rows[-1]), flush=True)
                if options.json:
                    options.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
