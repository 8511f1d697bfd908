"""Steps on the ground beside mujoco_warp and Newton's solvers: time of a step, and error against own steps of 0.1 ms.

    python -m benchmarks.contact.peers [--device cuda:0] [--worlds 4096 16384] [--json FILE] [--seconds 120]

Two groups. "file": the robots of the environments, one MJCF file for both sides, drives that hold the standing pose.
"model": a Newton model of robots that come with Newton, stepped by Newton's solvers with the settings of Newton's own
examples, and by SolverSPO. All take the same dt and start standing or just above the ground, pushed differently in
each world. A time is that of a step among steps that are replayed in a CUDA graph, from a state after 0.5 s.
Processes prepare side by side; one at a time measures (:mod:`benchmarks.table.process_turns`).
The error is the root mean square, over worlds, of how far the base is after 0.5 s from where the same solver puts it
with steps of 0.1 ms.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import warp as wp

import warp_spo as spo
from warp_spo.env import robots

from .. import command_line
from ..capabilities import median_replay
from ..table import process_turns

DT, FINE, SECONDS = 5e-3, 1e-4, 0.5
SAMPLE = 64  # worlds of a run for the error
STEPS = 20  # in a graph
FILES = ("ant", "go2", "g1")
MODELS = ("ant", "humanoid", "quadruped")
OWN: dict[str, dict[str, Any]] = {
    "SolverSPO": {},
    "SolverSPO, tuned": dict(tune=True),
    "SolverSPO, tuned, values folded": dict(tune=True, variable=()),
    "SolverSPO, tuned, values folded, 4 points": dict(tune=True, variable=(), points=4),
}
"""Options of this library's solver; ``points`` are those of a cylinder at most, and count for the quadruped alone."""
PEERS = ("SolverMuJoCo", "SolverSteel")


class Stepper(NamedTuple):
    """A simulation under way.

    Attributes:
        step: takes one step of a length that was given when it was made. base: returns the base's places [world, 3].
        state: arrays that hold the state, which a replay changes. said: settings, and contacts found.
    """

    step: Callable[[], None]
    base: Callable[[], np.ndarray]
    state: list[wp.array]
    said: Callable[[], str]


def pushes(worlds: int) -> np.ndarray:
    """Return velocities of the bases along x and y [world, 2], [m/s]."""
    return np.random.default_rng(0).uniform(-0.3, 0.3, (worlds, 2))


# -- one file ----------------------------------------------------------------------------------------------------------
def file_spo(name: str, worlds: int, dt: float, device: wp.Device) -> Stepper:
    """Return steps of this library."""
    robot = robots.load(name)
    dyn = spo.Dynamics(robot.scene, worlds, device)
    q, qd = np.tile(robot.q, (worlds, 1)), np.zeros((worlds, robot.scene.dof_count))
    qd[:, :2] = pushes(worlds)
    q, qd, ctrl = (wp.array(x, dtype=wp.float32, device=device) for x in (q, qd, np.tile(robot.ctrl, (worlds, 1))))
    state = dict(actuator_state=dyn.actuator_state()) if any(a.delay for a in robot.scene.actuators) else {}
    points = len(robot.scene.contact_points)
    return Stepper(
        lambda: dyn.step(q, qd, None, dt, ctrl=ctrl, out=(q, qd), **state) and None,
        lambda: q.numpy()[:, :3],
        [q, qd],
        lambda: f"{points} points, 3 passes",
    )


def file_mujoco_warp(name: str, worlds: int, dt: float, device: wp.Device) -> Stepper:
    """Return steps of mujoco_warp with the file's own options."""
    import mujoco
    import mujoco_warp as mjw

    spec = mujoco.MjSpec.from_file(str(robots.FILES / f"{name}.xml"))
    plane = dict(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], friction=[0.8, 0.02, 0.01])
    spec.worldbody.add_geom(**plane, contype=1, conaffinity=0)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    model.opt.timestep = dt
    mujoco.mj_forward(model, data)
    with wp.ScopedDevice(device):
        m = mjw.put_model(model)
        d = mjw.put_data(model, data, nworld=worlds, nconmax=64, njmax=256)
        qvel = d.qvel.numpy()
        qvel[:, :2] = pushes(worlds)
        d.qvel.assign(qvel)

    def said() -> str:
        active = int(d.nacon.numpy()[0]) / worlds
        return f"iterations {model.opt.iterations}, ls {model.opt.ls_iterations}, {active:.1f} contacts a world"

    def step() -> None:
        with wp.ScopedDevice(device):
            mjw.step(m, d)

    return Stepper(step, lambda: d.qpos.numpy()[:, :3], [d.qpos, d.qvel, d.qacc_warmstart], said)


# -- a model of Newton -------------------------------------------------------------------------------------------------
def newton_model(name: str, worlds: int, device: wp.Device) -> Any:
    """Return a robot that comes with Newton on a plane, built as Newton's examples build it."""
    import newton
    import newton.examples

    one = newton.ModelBuilder()
    if name == "quadruped":  # as examples/basic/example_basic_urdf.py
        one.default_body_armature = 0.01
        one.default_joint_cfg.armature = 0.01
        one.default_joint_cfg.target_ke, one.default_joint_cfg.target_kd = 2000.0, 1.0
        one.default_shape_cfg.ke, one.default_shape_cfg.kd = 1.0e4, 1.0e2
        one.default_shape_cfg.kf, one.default_shape_cfg.mu = 1.0e2, 1.0
        one.add_urdf(newton.examples.get_asset("quadruped.urdf"), xform=wp.transform(wp.vec3(0.0, 0.0, 0.7)),
                     floating=True, enable_self_collisions=False, ignore_inertial_definitions=True)  # fmt: skip
        for body in range(one.body_count):
            one.body_inertia[body] = wp.mat33(np.asarray(one.body_inertia[body]).reshape(3, 3) + 0.01 * np.eye(3))
        one.joint_q[-12:] = [0.2, 0.4, -0.6, -0.2, -0.4, 0.6, -0.2, 0.4, -0.6, 0.2, -0.4, 0.6]
        one.joint_target_q[-12:] = one.joint_q[-12:]
    else:  # as examples/selection/example_selection_articulations.py
        one.default_shape_cfg.ke, one.default_shape_cfg.gap = 1.0e4, 0.0
        options = dict(parse_sites=False) if name == "humanoid" else {}
        one.add_mjcf(newton.examples.get_asset(f"nv_{name}.xml"), ignore_names=["floor", "ground"],
                     xform=wp.transform((0.0, 0.0, {"ant": -0.15, "humanoid": 1.35}[name])), **options)  # fmt: skip
        low, high = (np.asarray(x[6:]) for x in (one.joint_limit_lower, one.joint_limit_upper))
        one.joint_q[7:] = np.clip(one.joint_q[7:], low, high).tolist()  # zero is outside of the ankles' limits
    many = newton.ModelBuilder()
    many.default_shape_cfg = one.default_shape_cfg
    many.add_ground_plane()
    many.replicate(one, worlds)
    with wp.ScopedDevice(device):
        return many.finalize()


def model_steps(solver: str) -> Callable[[str, int, float, wp.Device], Stepper]:
    """Return the function that makes steps of one of Newton's solvers, or of SolverSPO."""

    def make(name: str, worlds: int, dt: float, device: wp.Device) -> Stepper:
        import newton

        from warp_spo.newton import SolverSPO

        model, pipeline = newton_model(name, worlds, device), None
        with wp.ScopedDevice(device):
            if solver == "SolverMuJoCo":
                sizes = dict(ant=(50, 50), humanoid=(200, 50), quadruped=(200, 50))[name]  # those of the examples
                taken: Any = newton.solvers.SolverMuJoCo(model, njmax=sizes[0], nconmax=sizes[1])
            elif solver == "SolverSteel":
                taken, pipeline = (
                    newton.solvers.SolverSteel(model, enable_joint_limits=True),
                    newton.CollisionPipeline(model),
                )
            else:
                taken = SolverSPO(model, **OWN[solver])
            states, control = [model.state(), model.state()], model.control()
            contacts = pipeline.contacts() if pipeline else None
            qd = states[0].joint_qd.numpy().reshape(worlds, -1)
            qd[:, :2] = pushes(worlds)
            states[0].joint_qd.assign(qd.ravel())
            newton.eval_fk(model, states[0].joint_q, states[0].joint_qd, states[0])

        def step() -> None:
            with wp.ScopedDevice(device):
                for before, after in (states, states[::-1]):  # two, so that the state is where it was
                    if pipeline:
                        before.clear_forces()
                        pipeline.collide(before, contacts)
                    taken.step(before, after, control, contacts, dt)

        def said() -> str:
            if solver == "SolverMuJoCo":
                option = taken.mjw_model.opt
                found = taken.mjw_data.nacon.numpy()[0] / worlds
                return f"iterations {option.iterations}, ls {option.ls_iterations}, {found:.1f} contacts a world"
            if contacts:
                return f"{contacts.rigid_contact_count.numpy()[0] / worlds:.1f} contacts a world"
            kernel = [x for x in taken.dynamics.programs.describe() if x.startswith("contact_step")][-1]
            return f"{len(taken.dynamics.scene.contact_points)} points, {kernel}"

        arrays = [x for x in (states[0].joint_q, states[0].joint_qd, states[0].body_q, states[0].body_qd)]
        return Stepper(step, lambda: states[0].joint_q.numpy().reshape(worlds, -1)[:, :3], arrays, said)

    return make


GROUPS: dict[str, tuple[tuple[str, ...], dict[str, tuple[Callable[..., Stepper], int]]]] = {
    "file": (FILES, {"warp_spo": (file_spo, 1), "mujoco_warp": (file_mujoco_warp, 1)}),
    "model": (MODELS, {name: (model_steps(name), 2) for name in (*OWN, *PEERS)}),
}
"""Robots, and the makers of steps with how many steps one call takes."""


def advance(stepper: Stepper, count: int, device: wp.Device) -> None:
    """Take ``count`` calls of a stepper, in graphs on a GPU."""
    stepper.step()
    count -= 1
    if device.is_cuda and count > STEPS:
        with wp.ScopedCapture(device) as capture:
            for _ in range(STEPS):
                stepper.step()
        for _ in range(count // STEPS):
            wp.capture_launch(capture.graph)
            wp.synchronize_device(device)  # a process that is stopped for another one's turn leaves little to do
        count %= STEPS
    for _ in range(count):
        stepper.step()
    wp.synchronize_device(device)


def error(make: Callable[..., Stepper], each: int, name: str, device: wp.Device) -> float:
    """Return the distance of bases after SECONDS with DT from those with FINE, root mean square over worlds [m]."""
    places = []
    for dt in (DT, FINE):
        stepper = make(name, SAMPLE, dt, device)
        advance(stepper, round(SECONDS / dt / each), device)
        places.append(stepper.base())
    return float(np.sqrt(np.square(places[0] - places[1]).sum(1).mean()))


def measure(make: Callable[..., Stepper], each: int, name: str, worlds: int, device: wp.Device) -> dict[str, Any]:
    """Return the time of a step [us] from a state after SECONDS, and what the stepper says of itself."""
    stepper = make(name, worlds, DT, device)
    advance(stepper, round(SECONDS / DT / each), device)
    said, finite = stepper.said(), float(np.isfinite(stepper.base()).all(1).mean())
    if not device.is_cuda:
        with process_turns.mine:
            begin = time.perf_counter()
            for _ in range(4):
                stepper.step()
            return dict(us=1e6 * (time.perf_counter() - begin) / 4 / each, said=said, finite=finite)
    kept = [wp.clone(x) for x in stepper.state]
    with wp.ScopedCapture(device) as capture:
        for now, before in zip(stepper.state, kept, strict=True):
            wp.copy(now, before)
        for _ in range(STEPS // each):
            stepper.step()
    return dict(us=1e3 * median_replay(capture.graph, device) / STEPS, said=said, finite=finite)


class Task(NamedTuple):
    """A measurement by one process: the error where ``worlds`` is None, else the time of a step of so many worlds."""

    device: str
    group: str
    robot: str
    solver: str
    worlds: int | None


def work(task: Task, turn: process_turns.Turn) -> Iterator[dict[str, Any]]:
    """Yield a part of the row of a robot and a solver."""
    warnings.simplefilter("ignore")
    (make, each), device = GROUPS[task.group][1][task.solver], wp.get_device(task.device)
    if task.worlds is None:
        yield {"error m": error(make, each, task.robot, device)}
        return
    found = measure(make, each, task.robot, task.worlds, device)
    yield {f"us {task.worlds}": found["us"], "finite": found["finite"], "settings": found["said"]}


def tasks_of(options: argparse.Namespace) -> list[Task]:
    """Return what the options ask for, the most worlds first."""
    wanted: list[int | None] = [*sorted(options.worlds, reverse=True), *([] if options.no_errors else [None])]
    device = wp.get_device(options.device).alias
    return [
        Task(device, group, robot, solver, worlds)
        for worlds in wanted
        for group in options.groups
        for robot in GROUPS[group][0]
        if not options.robots or robot in options.robots
        for solver in GROUPS[group][1]
        if not options.solvers or solver in options.solvers
    ]


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("contact.peers", __doc__)
    parser.add_argument("--worlds", type=int, nargs="+", default=[4096, 16384])
    parser.add_argument("--groups", nargs="+", choices=GROUPS, default=list(GROUPS))
    parser.add_argument("--robots", nargs="+", choices=sorted({*FILES, *MODELS}), help="left out: all of a group")
    parser.add_argument("--solvers", nargs="+", help="some of the solvers")
    parser.add_argument("--no-errors", action="store_true", help="times only")
    parser.add_argument("--seconds", type=float, default=3600.0, help="after which rows that are left are not measured")
    parser.add_argument("--jobs", type=int, help="processes side by side; left out: one for each core")
    options = parser.parse_args(arguments)
    tasks = tasks_of(options)
    rows: dict[tuple[str, str, str], dict[str, Any]] = {}
    for task in tasks:
        rows[task[1:4]] = dict(zip(("group", "robot", "solver"), task[1:4], strict=True))
    for task, found in process_turns.take_turns(tasks, work, options.seconds, options.jobs):
        row = rows[task[1:4]]
        if isinstance(found, Exception):  # a peer that cannot run is a row that says why
            row["refused"] = str(found)
        elif found is None:
            print(row, flush=True)
        else:
            row |= found
        if options.json:
            options.json.write_text(json.dumps(list(rows.values()), indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
