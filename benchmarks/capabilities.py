"""Time steps, derivatives, inverses and closed loops, and other libraries that compute the same, on one device.

    python -m benchmarks.capabilities [PATTERN] [--device cuda:0] [--worlds 4096 65536] [--json FILE]

* steps: a step of SolverSPO and of Newton's SolverMuJoCo, SolverSteel and SolverFeatherstone, on Newton's model of
  the Panda with drives and the limits of its file; each world starts at a random state and is driven to another;
* derivatives: forward dynamics, its dense derivatives, and its vector-Jacobian product;
* operational: the inverse operational-space inertia of G1's two feet; in mujoco_warp the two Jacobians and twelve
  columns of M^-1 that are needed for it;
* inverse: the whole of M^-1;
* loops: forward dynamics of a biped with closed ankles, with its loops embedded, and with its loops cut.

Several calls in a row are captured into a CUDA graph, which is replayed; processes prepare cases side by side, and one
at a time is timed while the others stand still. On a CPU one process times calls one by one. A line has the time
of one call, or the reason why it cannot run. Derivatives and inverses are compared with their references; the other
results are checked to be finite.
"""

from __future__ import annotations

import functools
import gc
import re
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import warp as wp

import warp_spo as spo
from warp_spo.trials.inputs import APPLICATIONS, OPERATIONS, TOLERANCE, Inputs
from warp_spo.trials.trial import Subject, TrialRun, all_finite

from . import command_line
from .table import process_turns, robots, runner

DT = 2e-3  # [s]
SETS = 4
CALLS = 48  # calls in one graph, whose launch takes 8 us
REPEATS = 15
SAMPLE = 2  # worlds that are compared; the reference of G1's derivatives takes a second for each
WARM_UP = 0.2  # [s] that an idle GPU needs until its clocks have risen
KE, KD = 200.0, 20.0  # drives [N m/rad, N m s/rad]


def measure_time(run: Callable[[int], Any], device: wp.Device) -> float:
    """Return the median time of ``run(index)`` [us], where the index cycles through the sets of inputs."""
    for index in range(SETS):
        run(index)
    wp.synchronize_device(device)
    if not device.is_cuda:
        return 1e6 * float(np.median([_wall(run, index % SETS) for index in range(2 * SETS)]))
    with wp.ScopedCapture(device) as capture:
        for index in range(CALLS):
            run(index % SETS)
    return 1e3 * median_replay(capture.graph, device) / CALLS


def median_replay(graph: Any, device: wp.Device) -> float:
    """Return the median time of replays of a graph [ms], in a turn of this process and with clocks that have risen."""
    events = [[wp.Event(device, enable_timing=True) for _ in range(2)] for _ in range(REPEATS)]
    with process_turns.mine:
        begin = time.perf_counter()
        while time.perf_counter() - begin < WARM_UP:
            wp.capture_launch(graph)
            wp.synchronize_device(device)
        for start, end in events:
            device.stream.record_event(start)
            wp.capture_launch(graph)
            device.stream.record_event(end)
        wp.synchronize_device(device)
    return float(np.median([wp.get_event_elapsed_time(start, end) for start, end in events]))


def _wall(run: Callable[[int], Any], index: int) -> float:
    start = time.perf_counter()
    run(index)
    return time.perf_counter() - start


# -- steps -------------------------------------------------------------------------------------------------------------
def steps(worlds: int, device: wp.Device) -> Iterator[tuple[str, Callable[[], dict]]]:
    """Yield the cases of steps: name, and the function that measures it."""
    import newton

    from warp_spo.newton import SolverSPO

    def model() -> Any:
        one = newton.ModelBuilder()
        one.add_urdf(robots.urdf_text("panda"), floating=False)
        one.joint_target_ke[:] = [KE] * len(one.joint_target_ke)
        one.joint_target_kd[:] = [KD] * len(one.joint_target_kd)
        one.joint_target_mode[:] = [int(newton.JointTargetMode.POSITION)] * len(one.joint_target_mode)
        many = newton.ModelBuilder()
        many.replicate(one, worlds)
        return many.finalize(device=device)

    shared: list[Any] = []

    def step(name: str, **options: Any) -> dict:
        if not shared:
            shared.append(model())
        its = shared[0]
        solver = SolverSPO(its) if name == "SolverSPO" else getattr(newton.solvers, name)(its, **options)
        now, after, control = its.state(), its.state(), its.control()
        low, high = its.joint_limit_lower.numpy(), its.joint_limit_upper.numpy()
        anywhere = low + (high - low) * np.random.default_rng(0).uniform(0.05, 0.95, (2, len(low)))
        start, target = (wp.array(q, dtype=wp.float32, device=device) for q in anywhere)
        wp.copy(now.joint_q, start)
        control.joint_target_q = target

        def run(index: int) -> None:
            before, then = (now, after) if index % 2 == 0 else (after, now)
            solver.step(before, then, control, None, DT)

        us = measure_time(run, device)
        assert np.isfinite(now.joint_qd.numpy()).all(), f"{name}: the velocities are not finite"
        return dict(us=us)

    yield "SolverSPO.step", lambda: step("SolverSPO")
    yield "SolverSteel.step", lambda: step("SolverSteel", enable_joint_limits=True)
    yield "SolverMuJoCo.step", lambda: step("SolverMuJoCo", disable_contacts=True)
    if worlds <= 4096:
        yield "SolverFeatherstone.step", lambda: step("SolverFeatherstone")


# -- ours --------------------------------------------------------------------------------------------------------------
def inputs(scene: spo.Scene, worlds: int) -> list[Inputs]:
    """Return SETS sets of random inputs."""
    return [Inputs(scene, worlds, seed) for seed in range(SETS)]


def operation_cases(*names: str) -> Callable[..., Iterator[tuple[str, Callable[[], dict]]]]:
    """Return a group: a case for each robot and operation in ``names``, which is compared with its reference."""

    def cases(worlds: int, device: wp.Device) -> Iterator[tuple[str, Callable[[], dict]]]:
        for robot in robots.ROBOTS:
            scene = robots.scene(robot)
            subject = functools.cache(lambda scene=scene: Subject(spo.Dynamics(scene, worlds, device),
                                                                  inputs(scene, worlds)))  # fmt: skip
            for name in names:
                yield f"{robot} {name}", lambda name=name, subject=subject: measure_operation(subject(), name)

    return cases


def measure_operation(subject: Subject, name: str) -> dict:
    """Return ``us`` and ``error`` of an operation; an error beyond the tolerance raises AssertionError."""
    trial = TrialRun(subject, (OPERATIONS | APPLICATIONS)[name], SAMPLE)
    checked = trial.check()
    with process_turns.mine:
        timing, left = trial.measure(REPEATS)
    error, tolerance = float(np.max([checked, left])), TOLERANCE["float32"]
    assert error <= tolerance, f"error {error:.1e} exceeds the tolerance {tolerance:.0e}"
    return dict(us=1e6 * timing.median, error=error)


class Ours:
    """A Dynamics of one scene, with inputs on its device."""

    def __init__(self, scene: spo.Scene, worlds: int, device: wp.Device, **options: Any):
        self.dyn, self.scene, self.device = spo.Dynamics(scene, worlds, device, **options), scene, device
        self.sets = [
            {name: wp.array(each.array(name), dtype=wp.float32, device=device) for name in ("q", "qd", "tau")}
            for each in inputs(scene, worlds)
        ]

    def time(self, call: Callable[[spo.Dynamics, dict, wp.array], Any], *shape: int) -> dict:
        """Return ``us`` of ``call(dyn, inputs, out)``, where ``out`` is a result [world, *shape]."""
        out = wp.empty((self.dyn.worlds, *shape), dtype=wp.float32, device=self.device)
        us = measure_time(lambda index: call(self.dyn, self.sets[index], out), self.device)
        assert all_finite(out), "the result is not finite"
        return dict(us=us)


def operational(worlds: int, device: wp.Device) -> Iterator[tuple[str, Callable[[], dict]]]:
    """Yield the cases of operational-space inertia: name, and the function that measures it."""
    scene = robots.scene("g1")
    feet = [label for label in scene.body_labels if label.endswith("ankle_roll_link")]

    def ours() -> dict:
        def call(dyn: spo.Dynamics, x: dict, out: wp.array) -> None:
            dyn.operational_inertia_inverse(x["q"], feet, out=out)

        return Ours(scene, worlds, device).time(call, 12, 12)

    def mujoco() -> dict:
        from .peers.coordinates import States
        from .peers.lumped import lump
        from .peers.mujoco_gpu import MujocoWarp

        peer = MujocoWarp(lump(scene), device, "float32")
        states = States(peer.coordinates, inputs(scene, worlds), "float32")
        peer.prepare("forward_dynamics", "", states, worlds)
        mjw, m, d, nv = peer.mjw, peer.model, peer.data, peer.host.nv
        owners = [at for at, link in enumerate(peer.robot.links) for _ in range(6 if link.kind == "free" else 1)]
        bodies = [1 + owners[at] for at, dof in enumerate(peer.robot.dofs) if "ankle_roll" in scene.dof_labels[dof]]
        assert len(bodies) == 2, f"G1 has {len(bodies)} feet; expected 2"
        J = [[wp.zeros((worlds, 3, nv), dtype=wp.float32, device=device) for _ in range(2)] for _ in bodies]
        x = wp.empty((worlds, nv), dtype=wp.float32, device=device)
        columns = [part[:, row].contiguous() for pair in J for part in pair for row in range(3)]
        points = [wp.zeros(worlds, dtype=wp.vec3, device=device) for _ in bodies]
        which = [wp.full(worlds, body, dtype=int, device=device) for body in bodies]

        def run(index: int) -> None:
            d.qpos = peer.sets[index]["q"]
            mjw.kinematics(m, d)
            mjw.com_pos(m, d)
            mjw.crb(m, d)
            mjw.factor_m(m, d)
            for (jacp, jacr), point, body in zip(J, points, which, strict=True):
                mjw.jac(m, d, jacp, jacr, point, body)
            for column in columns:
                mjw.solve_m(m, d, x, column)

        with wp.ScopedDevice(device):
            return dict(us=measure_time(run, device))

    yield "g1 operational_inertia_inverse of two feet", ours
    yield "g1 mujoco_warp kinematics, com_pos, crb, factor_m, 2 jac, 12 solve_m", mujoco


def loops(worlds: int, device: wp.Device) -> Iterator[tuple[str, Callable[[], dict]]]:
    """Yield the cases of closed loops: name, and the function that measures it."""
    from warp_spo.examples.biped import scene as biped

    def ours(how: str) -> dict:
        one = Ours(biped(), worlds, device, loops=how, granularity="tree")
        q = one.dyn.project(np.tile(one.scene.neutral_q, (worlds, 1))) if how == "embed" else one.sets[0]["q"]
        q = wp.array(q, dtype=wp.float32, device=device) if isinstance(q, np.ndarray) else q
        for each in one.sets:
            each["q"] = q

        def call(dyn: spo.Dynamics, x: dict, out: wp.array) -> None:
            dyn.forward_dynamics(x["q"], x["qd"], x["tau"], out=out)

        return one.time(call, one.scene.dof_count)

    yield "biped forward_dynamics, loops cut", lambda: ours("cut")
    yield "biped forward_dynamics, loops embedded", lambda: ours("embed")


GROUPS = dict(
    steps=steps,
    derivatives=operation_cases("forward_dynamics", "forward_dynamics_derivatives", "forward_dynamics_vjp"),
    inverse=operation_cases("mass_matrix_inverse"),
    operational=operational,
    loops=loops,
)


def _measure(task: tuple[str, str, int, str], turn: process_turns.Turn | None = None) -> Iterator[dict]:
    """Yield the row of a case."""
    group, name, worlds, device = task
    wp.config.log_level = wp.LOG_WARNING
    row: dict[str, Any] = dict(group=group, name=name, worlds=worlds)
    try:
        row |= dict(GROUPS[group](worlds, wp.get_device(device)))[name]()
    except Exception as error:  # the other cases go on
        row["skipped"] = f"{type(error).__name__}: {error}"
    yield row
    gc.collect()


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("capabilities", __doc__)
    parser.add_argument("pattern", nargs="?", default="", help="regular expression on 'group name'")
    parser.add_argument("--worlds", nargs="+", type=int, default=[4096, 65536])
    parser.add_argument("--jobs", type=int, help="processes that prepare; default: the number of cores")
    parser.add_argument("--seconds", type=float, default=3600.0, help="time for all of it, default: 3600")
    options = parser.parse_args(arguments)
    device = wp.get_device(options.device)
    run = runner.record([], options.device)
    rows: dict[tuple, dict | None] = {
        (group, name, worlds, str(device)): None
        for group, cases in GROUPS.items()
        for worlds in options.worlds
        for name, _ in cases(worlds, device)
        if re.search(options.pattern, f"{group} {name}")
    }
    found = process_turns.take_turns(list(rows), _measure, options.seconds, options.jobs)
    if device.is_cpu:
        found = ((case, row) for case in rows for row in _measure(case))
    for case, row in found:
        if row is None:
            continue
        group, name, worlds, _ = case
        row = row if isinstance(row, dict) else dict(group=group, name=name, worlds=worlds, skipped=str(row))
        us = row.get("us")
        text = f"{us:.4g} us, {worlds / us:.4g} 10^6/s" if us else f"skipped: {row['skipped'][:300]}"
        print(f"{group} {name}, {worlds} worlds: {text}", flush=True)
        rows[case] = row
        if options.json:
            runner.save(run | {"rows": [one for one in rows.values() if one is not None]}, options.json)
    left = [f"{name}, {worlds} worlds" for (_, name, worlds, _), row in rows.items() if row is None]
    if left:
        print(f"not done in {options.seconds:.0f} s: {'; '.join(left)}")
    return 0 if any(row is not None and "us" in row for row in rows.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
