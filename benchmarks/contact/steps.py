"""Steps of Go2, G1 and an ant on a plane and on a height field: time of a step, and errors against float64.

    python -m benchmarks.contact.steps [--device cuda:0] [--worlds 4096 65536] [--robots go2 g1]
                                       [--granularity tree segment] [--dtype float32 float64]
                                       [--ground plane field none] [--passes 3 4] [--json FILE]

Robots are those of :mod:`.scenes`; worlds stand on the ground in different states, dt is 5 ms.
"""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

import warp_spo as spo
from warp_spo.reference.contact import ContactStep

from .. import command_line
from ..capabilities import measure_time
from .scenes import DT, force_array, subject

SAMPLE = 4  # worlds that are compared with the dense step
GROUNDS: dict[str, dict] = {"plane": {}, "field": {"field": True}, "none": {"contacts": False}}


def measure(*given: Any, **options: Any) -> dict[str, Any]:
    """Return what :func:`prepare` measures."""
    return prepare(*given, **options)()


def prepare(
    robot: str,
    worlds: int,
    device: wp.Device,
    field: bool = False,
    contacts: bool = True,
    passes: int | None = None,
    **more: Any,
) -> Callable[[], dict[str, Any]]:
    """Take a step; return what measures ``us`` and errors against the dense step: of velocities, of forces over weight.

    ``contacts``: False measures the time of the step without ground, where drives and limits settle in passes.
    """
    dyn, sets = subject(robot, worlds, device, field, contacts, **more)
    out, (q, qd) = tuple(wp.empty_like(x) for x in sets[0]), sets[0]
    force, options = force_array(dyn) if contacts else None, spo.StepOptions(passes=passes)
    report = spo.StepReport(contact_f=force)

    def step(index: int) -> None:
        dyn.step(*sets[index], None, DT, options=options, out=out)

    step(0)
    if force is not None:
        dyn.step(q, qd, None, DT, options=options, report=report)

    def run() -> dict[str, Any]:
        found: dict[str, Any] = {"us": measure_time(step, device), "kernel": dyn.programs.describe()[0]}
        if force is None:
            return found
        after = dyn.step(q, qd, None, DT, options=options, report=report)[1].numpy()
        weight, start = 9.81 * dyn.scene.values["body_mass"].sum(), [x.numpy().astype(np.float64) for x in (q, qd)]
        errors = []
        for w in range(0, worlds, max(1, worlds // SAMPLE)):
            at = ContactStep(dyn.scene, start[0][w], start[1][w], DT)
            wanted, forces = at.run(passes=passes or 3)[1], np.zeros(force.shape[1:])
            np.add.at(forces, at.numbers, wanted.f)
            errors.append((np.abs(after[w] - wanted.v).max() / np.abs(wanted.v).max(),
                           np.abs(force.numpy()[w] - forces).max() / weight))  # fmt: skip
        found["error"], found["force error"] = np.max(errors, axis=0).tolist()
        return found

    return run


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("contact.steps", __doc__)
    parser.add_argument("--worlds", type=int, nargs="+", default=[4096, 65536])
    parser.add_argument("--robots", nargs="+", default=["go2", "g1"], help="go2, g1, ant, go2_boxes, g1_boxes")
    parser.add_argument("--granularity", nargs="+", default=["planned"], help="planned, tree, segment")
    parser.add_argument("--dtype", nargs="+", default=["float32"])
    parser.add_argument("--ground", nargs="+", choices=GROUNDS, default=["plane", "field"])
    parser.add_argument("--passes", type=int, nargs="+", default=[3])
    options = parser.parse_args(arguments)
    device, results = wp.get_device(options.device), {}
    for dtype, robot, worlds, form, ground, passes in itertools.product(
        options.dtype, options.robots, options.worlds, options.granularity, options.ground, options.passes
    ):
        if ground == "none" and passes != options.passes[0]:
            continue  # passes are of steps with contacts
        name = f"{robot}, {worlds} worlds, ground: {ground}, {form}, {dtype}"
        asked: dict[str, Any] = dict(granularity=None if form == "planned" else form, dtype=dtype)
        if ground != "none":
            name, asked["passes"] = f"{name}, {passes} passes", passes
        results[name] = found = measure(robot, worlds, device, **GROUNDS[ground], **asked)
        figures = (f"{key} {value if isinstance(value, str) else format(value, '.3g')}" for key, value in found.items())
        print(name, "  ".join(figures), flush=True)
        if options.json:
            options.json.write_text(json.dumps(results, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
