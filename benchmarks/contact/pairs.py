"""Steps of bodies that touch each other: time of a step with pairs and without them, and errors against float64.

    python -m benchmarks.contact.pairs [--device cuda:0] [--worlds 4096 65536] [--cases "nine cubes"] [--json FILE]

Cases: a Panda whose two pads hold a cube (:mod:`warp_spo.examples.grasp`), with two pairs of boxes, with eight pairs of
points and a box, with the cube out of reach, and without pairs; three and nine cubes on each other; a Go2 with a pair
between each two calves, which cross in half of the worlds. dt is 5 ms; steps with pairs take four passes, others three.
"""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import warp as wp

import warp_spo as spo
from warp_spo.examples import grasp
from warp_spo.reference.body_contact import PairStep
from warp_spo.reference.contact import ContactStep

from .. import command_line
from ..capabilities import SETS, measure_time
from . import scenes

SAMPLE = 4  # worlds that are compared with the dense step
DIFFERENT = 64  # states of a set of inputs; worlds beyond repeat them
ARM = np.array([0.0, 0.55, 0.0, -2.13, 0.0, 2.69, 0.785])
CUBE = 0.1  # half the size of a cube that stands on others [m]
CALF = dict(capsule=((0, 0, 0), (0, 0, -0.2), 0.02), stiffness=2e4)


class Case(NamedTuple):
    """A scene, and a function of it and a random generator that returns q, qd and tau of ``DIFFERENT`` worlds."""

    scene: spo.Scene
    states: Callable[[spo.Scene, np.random.Generator], tuple[np.ndarray, np.ndarray, np.ndarray]]


def gripper(kind: str) -> Case:
    """Return a Panda that presses a cube; ``kind``: "boxes", "points", "apart" or "bare"."""
    one = grasp.scene()
    cube, ground = one.body_count - 1, one.contacts[:1]
    if kind == "bare":
        one = one.with_contacts(ground)
    elif kind == "points":
        box = spo.Contact(cube, box=(grasp.CUBE,) * 3)
        places = itertools.product((7, 8), (-0.01, 0.01), (0.035, 0.055))
        one = one.with_contacts([*ground, *(spo.Contact(f, point=(x, 0.0, z), other=box) for f, x, z in places)])

    def states(scene: spo.Scene, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        q = np.tile(scene.neutral_q, (DIFFERENT, 1))
        q[:, :7], q[:, 7:9] = ARM + 0.1 * rng.normal(size=(DIFFERENT, 7)), grasp.CUBE - 1e-4
        q[:, 9:16] = spo.Dynamics(scene, DIFFERENT, "cpu", "float64").frame_poses(q, [grasp.TIP])[:, 0]
        q[:, 11] += 0.3 if kind == "apart" else 0.0
        tau = np.zeros((DIFFERENT, scene.dof_count))
        tau[:, 7:9] = -grasp.FORCE
        return q, 0.02 * rng.normal(size=tau.shape), tau

    return Case(one, states)


def stack(count: int) -> Case:
    """Return so many cubes on each other."""
    half = (CUBE,) * 3
    bodies = [spo.Body(5.0, inertia=5.0 * (2.0 * CUBE) ** 2 / 6.0 * np.eye(3)) for _ in range(count)]
    contacts = [spo.Contact(0, box=half, stiffness=1e5, damping=1e3)]
    contacts += [spo.Contact(i, box=half, other=spo.Contact(i - 1, box=half)) for i in range(1, count)]
    one = spo.Scene(bodies, [spo.Hinge("free", -1, i) for i in range(count)], contacts=contacts)

    def states(scene: spo.Scene, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        q = np.tile(scene.neutral_q, (DIFFERENT, 1)).reshape(DIFFERENT, count, 7)
        q[..., :2] = 0.004 * rng.normal(size=(DIFFERENT, count, 2))
        q[..., 2] = CUBE + (2.0 * CUBE - 1e-4) * np.arange(count)
        qd = 0.01 * rng.normal(size=(DIFFERENT, scene.dof_count))
        return q.reshape(DIFFERENT, -1), qd, np.zeros_like(qd)

    return Case(one, states)


def calves() -> Case:
    """Return a Go2 with a pair between each two calves; in half of the worlds the front ones cross."""
    bare = scenes.scene("go2")
    labels = [label.split("/")[-1] for label in bare.body_labels]
    legs = [labels.index(f"{leg}_calf") for leg in ("FL", "FR", "RL", "RR")]
    both = [spo.Contact(a, other=spo.Contact(b, **CALF), **CALF) for b, a in itertools.combinations(legs, 2)]

    def states(scene: spo.Scene, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        q, qd = scenes.states(scene, DIFFERENT, int(rng.integers(2**31)))
        q[::2, 7], q[::2, 10] = -0.45, 0.45
        return q, qd, np.zeros_like(qd)

    return Case(bare.with_contacts([*bare.contacts, *both]), states)


CASES: dict[str, Callable[[], Case]] = {
    "gripper, two pairs": lambda: gripper("boxes"),
    "gripper, eight pairs": lambda: gripper("points"),
    "gripper, cube out of reach": lambda: gripper("apart"),
    "gripper, no pairs": lambda: gripper("bare"),
    "three cubes": lambda: stack(3),
    "nine cubes": lambda: stack(9),
    "go2, six pairs": calves,
}


def measure(name: str, worlds: int, device: wp.Device, passes: int | None = None) -> dict[str, Any]:
    """Return ``us`` of a step, its kernel, and the error of velocities of the first step against the dense step."""
    (one, states), rng = CASES[name](), np.random.default_rng(0)
    dyn, kept = spo.Dynamics(one, worlds, device, "float32"), [states(one, rng) for _ in range(SETS)]
    sets = [[np.resize(x.astype(np.float32), (worlds, x.shape[1])) for x in each] for each in kept]
    given = [[wp.array(x, dtype=wp.float32, device=device) for x in each] for each in sets]
    out = tuple(wp.zeros_like(x) for x in given[0][:2])

    def step(index: int) -> None:
        dyn.step(*given[index], scenes.DT, options=spo.StepOptions(passes=passes), out=out)

    step(0)
    after, errors = out[1].numpy(), []
    for world in range(0, min(worlds, DIFFERENT), DIFFERENT // SAMPLE):
        q, qd, tau = (x[world].astype(np.float64) for x in sets[0])
        dense = PairStep if one.contact_pairs else ContactStep
        wanted = dense(one, q, qd, scenes.DT).run(tau, passes=passes or (4 if one.contact_pairs else 3))[1].v
        errors.append(np.abs(after[world] - wanted).max() / np.abs(wanted).max())
    same = (after == np.resize(after[:DIFFERENT], after.shape)).all()
    return {"us": measure_time(step, device), "error": float(max(errors)), "repeated worlds equal": bool(same),
            "kernel": dyn.programs.describe()[0]}  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("contact.pairs", __doc__)
    parser.add_argument("--worlds", type=int, nargs="+", default=[4096, 65536])
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    options = parser.parse_args(arguments)
    device, results = wp.get_device(options.device), {}
    runs = [(name, worlds, None) for name, worlds in itertools.product(options.cases, options.worlds)]
    if "gripper, no pairs" in options.cases:  # as many passes as steps with pairs take
        runs += [("gripper, no pairs", worlds, 4) for worlds in options.worlds]
    for name, worlds, passes in runs:
        label = f"{name}, {worlds} worlds" + (f", {passes} passes" if passes else "")
        results[label] = found = measure(name, worlds, device, passes)
        figures = (f"{key} {format(x, '.3g') if isinstance(x, float) else x}" for key, x in found.items())
        print(label, "  ".join(figures), flush=True)
        if options.json:
            options.json.write_text(json.dumps(results, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
