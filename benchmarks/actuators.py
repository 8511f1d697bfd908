"""Time a step with actuators, beside a step without them and a step with the same gains as drives.

    python -m benchmarks.actuators [--device cuda:0] [--scenes go2] [--worlds 4096 65536] [--json FILE]

Each row is a step of a scene with one actuator at each of its hinges of one coordinate. Results of a few worlds are
compared with a step in float64 on the CPU; the exit code is 1 if one differs by more than rounding. Times are medians
of captured steps from one state, see ``benchmarks.capabilities``; a row with substeps gives the time of all.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

import warp_spo as spo
from warp_spo.dynamics.trial_inputs import rotations

from . import command_line
from .capabilities import SETS, measure_time
from .table import runner
from .table.cases import SCENES

DT = 2e-3  # [s]
KP, KD, MOST = 60.0, 2.0, 20.0  # gains and bound of the servos and drives [N m/rad, N m s/rad, N m]
SAMPLE = 8  # worlds that are checked
TOLERANCE = 2e-3  # of qd' - qd in float32, relative; a force that is missing or of the wrong hinge changes it by 0.1
DELAY = 3  # steps
SERVO: dict[str, Any] = dict(gain=KP, bias=(0.0, -KP, -KD))


def with_actuators(scene: spo.Scene, make: Callable[[int], list[spo.Actuator]]) -> spo.Scene:
    """Return the scene without drives, with ``make(hinge)`` at every hinge of one coordinate."""
    joints = [index for index, hinge in enumerate(scene.hinges) if hinge.coord_count == 1]
    found = spo.Scene(scene.bodies, scene.hinges, actuators=[one for joint in joints for one in make(joint)])
    kept = {name: value for name, value in scene.values.items() if not name.startswith("actuator_")}
    zero = np.zeros(scene.dof_count)
    return found.with_values(**kept | {"joint_target_ke": zero, "joint_target_kd": zero})


def drives(scene: spo.Scene) -> spo.Scene:
    """Return the scene with a drive where the others have a servo."""
    one = np.concatenate([np.full(hinge.dof_count, float(hinge.coord_count == 1)) for hinge in scene.hinges])
    return scene.with_values(
        joint_target_ke=KP * one, joint_target_kd=KD * one, joint_effort_limit=np.where(one > 0.0, MOST, 1e6)
    )


ROWS: dict[str, tuple[Callable[[int], list[spo.Actuator]], dict[str, Any]]] = {
    "no actuators": (lambda joint: [], {}),
    "drives": (lambda joint: [], {"drives": True}),
    "motors": (lambda joint: [spo.Actuator(joint, force_range=(-MOST, MOST))], {}),
    "motors with curves": (lambda joint: [spo.Actuator(joint, 2.0, torque_speed=(MOST, 30.0))], {}),
    "servos": (lambda joint: [spo.Actuator(joint, **SERVO)], {}),
    "servos with ranges": (lambda joint: [spo.Actuator(joint, force_range=(-MOST, MOST), **SERVO)], {}),
    "servos, gains variable": (
        lambda joint: [spo.Actuator(joint, **SERVO)],
        {"variable": ("actuator_gain", "actuator_bias", "actuator_strength")},
    ),
    "motors, delayed": (lambda joint: [spo.Actuator(joint, delay=DELAY)], {}),
    "motors, 4 substeps": (lambda joint: [spo.Actuator(joint)], {"substeps": 4}),
    "motors, delayed, 4 substeps": (lambda joint: [spo.Actuator(joint, delay=DELAY)], {"substeps": 4}),
}
"""Name -> actuators of a hinge, and options."""


def measure(scene: spo.Scene, row: str, worlds: int, device: wp.Device) -> dict[str, Any]:
    """Return the time of a step [us] and its error."""
    make, options = ROWS[row]
    scene = with_actuators(scene, make)
    scene = drives(scene) if options.get("drives") else scene
    substeps, variable = options.get("substeps", 1), options.get("variable", ())
    dyn = spo.Dynamics(scene, worlds, device, variable=variable)
    exact = spo.Dynamics(scene, SAMPLE, "cpu", "float64", variable)
    rng, sets = np.random.default_rng(0), []
    for _ in range(SETS):
        q = np.tile(scene.neutral_q, (worlds, 1)) + 0.3 * rng.normal(size=(worlds, scene.coord_count))
        for first in rotations(scene):
            q[:, first : first + 4] /= np.linalg.norm(q[:, first : first + 4], axis=1, keepdims=True)
        ctrl = rng.normal(size=(worlds, len(scene.actuators)))
        arrays = [array.astype(np.float32) for array in (q, rng.normal(size=(worlds, scene.dof_count)), ctrl, q)]
        sets.append(arrays)
    on = [[wp.array(array, dtype=dyn.dtype, device=device) for array in arrays] for arrays in sets]
    out = [(wp.empty_like(q), wp.empty_like(qd)) for q, qd, *_ in on]
    names = ("target_q",) if options.get("drives") else ("ctrl",) if scene.actuators else ()

    def given(arrays: list, buffers: Any) -> dict[str, Any]:
        more: dict[str, Any] = {name: arrays[3] if name == "target_q" else arrays[2] for name in names}
        more |= {"options": spo.StepOptions(substeps=substeps)}
        return more | ({"actuator_state": buffers} if buffers is not None else {})

    late = any(actuator.delay for actuator in scene.actuators)
    buffers, twin = (one.actuator_state(like) if late else None for one, like in ((dyn, on[0][0]), (exact, sets[0][0])))
    us = measure_time(lambda k: dyn.step(*on[k][:2], None, DT, out=out[k], **given(on[k], buffers)), device)
    if buffers is not None:
        dyn.reset_actuator_state(None, buffers)
    error = 0.0
    for k, arrays in enumerate(sets):
        some = [array[:SAMPLE].astype(np.float64) for array in arrays]
        wanted = exact.step(*some[:2], None, DT, **given(some, twin))[1] - some[1]
        got = dyn.step(*on[k][:2], None, DT, **given(on[k], buffers))[1].numpy()[:SAMPLE] - arrays[1][:SAMPLE]
        error = max(error, float(np.linalg.norm(got - wanted) / np.linalg.norm(wanted)))
    return {"us": us, "error": error}


def main(arguments: list[str] | None = None) -> int:
    """Print the rows of all scenes and world counts."""
    parser = command_line.parser("actuators", __doc__)
    parser.add_argument("--scenes", nargs="+", default=["go2"], choices=SCENES)
    parser.add_argument("--worlds", nargs="+", type=int, default=[4096, 65536])
    parser.add_argument("--only", default="", help="rows whose name has this text")
    options = parser.parse_args(arguments)
    device, worst = wp.get_device(options.device), 0.0
    found: list[dict] = []
    run = runner.record(found, options.device)
    for name in options.scenes:
        scene = SCENES[name]()
        for worlds in options.worlds:
            for row in ROWS:
                if options.only in row:
                    figures = measure(scene, row, worlds, device)
                    found.append(dict(group=f"a step with actuators, {name}", name=row, worlds=worlds, **figures))
                    worst = max(worst, figures["error"])
                    print(
                        f"{name}.w{worlds} {row:28} {figures['us']:9.4g} us  error {figures['error']:.1e}", flush=True
                    )
    if options.json:
        runner.save(run, options.json)
    return 0 if worst <= TOLERANCE else 1


if __name__ == "__main__":
    sys.exit(main())
