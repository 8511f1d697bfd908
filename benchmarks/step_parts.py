"""A step of SolverSPO and its parts beside forward dynamics alone, for four floating robots with drives and limits.

    python -m benchmarks.step_parts [ROBOT ...] [--device cuda:0] [--worlds 4096 16384] [--json FILE]

For each robot and number of worlds, in microseconds: SolverSPO.step of states that drives hold near their targets, of
states of joints alone, without bodies and forces on them, and of random states, some of them outside of their limits;
Dynamics.step, with and without forces on bodies, and Dynamics.body_states, whose results the solver's step has, too;
forward dynamics of the same robot without laws. A line also has the ratio to forward dynamics, the number of launches,
registers and stack of a thread, the seconds in which the solver was built, kernels included, and the largest error of a
step from random states against float64 on the CPU.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any

import newton
import numpy as np
import warp as wp

import warp_spo as spo
from warp_spo.newton import SolverSPO, from_newton
from warp_spo.newton.drives import Drives
from warp_spo.trials.trial import Timing

from . import command_line
from .capabilities import DT, KD, KE, SETS, inputs, measure_time
from .table import robots, runner
from .table.resources import record_launches, resources

NAMES = ("go2", "g1", "b1_z1", "centauro")
SAMPLE = 64  # worlds that are compared with float64
TOLERANCE = 1e-4  # of the change of velocities in a step; measured 3e-7 to 9e-7
BODY_TOLERANCE = 1e-3  # m, m/s, rad/s; measured 3e-5 at rates of 70 rad/s
BEYOND = 0.1  # share of the range of a hinge by which random states may lie outside of it


def driven_model(name: str, worlds: int, device: Any) -> newton.Model:
    """Return a robot with drives on all hinges but the floating one, and the limits of its file."""
    one = newton.ModelBuilder()
    one.add_urdf(robots.urdf_text(name), floating=robots.ALL[name].floating)
    first = 6 if robots.ALL[name].floating else 0
    count = len(one.joint_target_ke) - first
    one.joint_target_ke[first:] = [KE] * count
    one.joint_target_kd[first:] = [KD] * count
    one.joint_target_mode[first:] = [int(newton.JointTargetMode.POSITION)] * count
    many = newton.ModelBuilder()
    many.replicate(one, worlds)
    return many.finalize(device=device)


def driven_scene(name: str) -> spo.Scene:
    """Return the same robot as a scene of one world."""
    model = driven_model(name, 1, "cpu")
    scene = from_newton(model)
    return Drives(model, scene).apply(scene)


class SolverTrial:
    """Steps of a robot in many worlds: a solver, states and controls.

    Attributes:
        seconds: in which the solver was built.
        lean: measured states have joints alone.
    """

    def __init__(self, name: str, worlds: int, device: wp.Device):
        self.name, self.worlds, self.device, self.lean = name, worlds, device, False
        self.model = driven_model(name, worlds, device)
        begin = time.perf_counter()
        self.solver = SolverSPO(self.model)
        wp.synchronize_device(device)
        self.seconds = time.perf_counter() - begin
        self.dyn, self.control = self.solver.dynamics, self.model.control()
        rng = np.random.default_rng(0)
        self.start, self.target = (self._positions(rng, 0.05, 0.95) for _ in range(2))
        self.random = [self._positions(rng, -BEYOND, 1.0 + BEYOND) for _ in range(SETS)]
        self.rates = [self._array(rng.normal(size=(worlds, self.dyn.scene.dof_count))) for _ in range(SETS)]
        self.control.joint_target_q = self.target.flatten()

    def _array(self, values: np.ndarray) -> wp.array:
        return wp.array(values, dtype=wp.float32, device=self.device)

    def _positions(self, rng: np.random.Generator, least: float, most: float) -> wp.array:
        """Return random coordinates between these shares of each hinge's range, within half a turn from zero."""
        scene = self.dyn.scene
        low = np.maximum(scene.values["joint_limit_lower"][0], -np.pi)
        high = np.minimum(scene.values["joint_limit_upper"][0], np.pi)
        q = np.tile(scene.neutral_q, (self.worlds, 1))
        for hinge, first, dof in zip(scene.hinges, scene.q_start, scene.qd_start, strict=False):
            if hinge.unconstrained:
                turn = rng.normal(size=(self.worlds, 4))
                q[:, first + 3 : first + 7] = turn / np.linalg.norm(turn, axis=1, keepdims=True)
            elif hinge.dof_count:  # all others of these robots turn
                q[:, first] = low[dof] + (high - low)[dof] * rng.uniform(least, most, self.worlds)
        return self._array(q)

    def state(self, q: wp.array | None = None, qd: wp.array | None = None, lean: bool | None = None) -> Any:
        """Return a state of the model, with these coordinates and rates.

        ``lean``: it has joints alone, no bodies and no forces on them; None: as the trial has states.
        """
        found = self.model.state()
        if self.lean if lean is None else lean:
            found.body_q = found.body_qd = found.body_f = None
        if q is not None:
            wp.copy(found.joint_q, q.flatten())
        if qd is not None:
            wp.copy(found.joint_qd, qd.flatten())
        return found

    def driven(self, lean: bool | None = None) -> Callable[[int], None]:
        """Return steps of a simulation, which drives soon hold near their targets; ``lean`` as of :meth:`state`."""
        states = [self.state(self.start, lean=lean), self.state(lean=lean)]

        def run(index: int) -> None:
            before, then = states if index % 2 == 0 else states[::-1]
            self.solver.step(before, then, self.control, None, DT)

        return run

    def scattered(self) -> Callable[[int], None]:
        """Return single steps from random states."""
        befores, after = [self.state(q, qd) for q, qd in zip(self.random, self.rates, strict=True)], self.state()
        return lambda index: self.solver.step(befores[index], after, self.control, None, DT)

    def arguments(self) -> dict[str, Any]:
        """Return forces and targets as the solver passes them to Dynamics.step."""
        scene, worlds = self.dyn.scene, self.worlds
        tau = wp.zeros((worlds, scene.dof_count), dtype=wp.float32, device=self.device)
        body_f = wp.zeros((worlds, scene.body_count, 6), dtype=wp.float32, device=self.device)
        return dict(tau=tau, body_f=body_f, target_q=self.target)

    def evaluate(self, index: int) -> None:
        """Take a step from a random state."""
        self.scattered()(index)

    def check(self) -> float:
        """Return the largest error of qd' - qd in a world, relative to the world's largest entry.

        Raises:
            AssertionError: the bodies' states are wrong.
        """
        before, after = self.state(self.random[0], self.rates[0]), self.state()
        self.solver.step(before, after, self.control, None, DT)
        exact, (qd, expected) = self._exact
        found = [
            x.numpy().reshape(self.worlds, -1)[: exact.worlds].astype(float) for x in (after.joint_q, after.joint_qd)
        ]
        for mine, right in zip((after.body_q, after.body_qd), exact.body_states(*found), strict=True):
            if mine is not None:
                off = np.abs(mine.numpy().reshape(self.worlds, *right.shape[1:])[: exact.worlds] - right).max()
                assert off <= BODY_TOLERANCE, f"{self.name}: error {off:.1e} of the bodies' states"
        return float((np.abs(found[1] - expected).max(axis=1) / np.abs(expected - qd).max(axis=1)).max())

    @functools.cached_property
    def _exact(self) -> tuple[spo.Dynamics, tuple[np.ndarray, np.ndarray]]:
        """Dynamics of a sample in float64 on the CPU, and velocities before and after a step from the first state."""
        count = min(SAMPLE, self.worlds)
        exact = spo.Dynamics(driven_scene(self.name), count, "cpu", "float64")
        q, qd, target = (x.numpy()[:count].astype(float) for x in (self.random[0], self.rates[0], self.target))
        return exact, (qd, exact.step(q, qd, None, DT, target_q=target)[1])

    def measure(self, *_: Any) -> tuple[Timing, float]:
        """Return the time of a step of driven states [s], and the error; see ``TrialRun.measure``."""
        seconds = 1e-6 * measure_time(self.driven(), self.device)
        return Timing(seconds, seconds, seconds), 0.0


def measure(name: str, worlds: int, device: wp.Device) -> dict[str, Any]:
    """Return the row of a robot."""
    trial = SolverTrial(name, worlds, device)
    scene = trial.dyn.scene
    row: dict[str, Any] = dict(robot=name, worlds=worlds, dofs=scene.dof_count, first_call_s=trial.seconds)
    driven = trial.driven()
    with record_launches() as found:
        driven(0)
    row |= resources(found, device) | {"error": trial.check()}
    assert row["error"] <= TOLERANCE, f"{name}: error {row['error']:.1e} of a step exceeds {TOLERANCE:.0e}"
    dyn, given, still = trial.dyn, trial.arguments(), wp.zeros_like(trial.rates[0])
    free = {key: value for key, value in given.items() if key != "body_f"}
    after = wp.empty_like(trial.start), wp.empty_like(still)
    bodies = tuple(wp.empty((worlds, scene.body_count, n), dtype=wp.float32, device=device) for n in (7, 6))
    alone = spo.Dynamics(robots.scene(name), worlds, device)
    own = [
        {key: wp.array(each.array(key), dtype=wp.float32, device=device) for key in ("q", "qd", "tau")}
        for each in inputs(alone.scene, worlds)
    ]
    calls: dict[str, Callable[[int], Any]] = {
        "solver_step": driven,
        "solver_lean": trial.driven(lean=True),
        "solver_random": trial.scattered(),
        "step": lambda i: dyn.step(trial.target, still, dt=DT, out=after, **given),
        "step_random": lambda i: dyn.step(trial.random[i], trial.rates[i], dt=DT, out=after, **given),
        "step_no_body_f": lambda i: dyn.step(trial.target, still, dt=DT, out=after, **free),
        "body_states": lambda i: dyn.body_states(trial.random[i], trial.rates[i], out=bodies),
        "forward_dynamics": lambda i: alone.forward_dynamics(own[i]["q"], own[i]["qd"], own[i]["tau"], out=after[1]),
    }
    row |= {key: measure_time(call, device) for key, call in calls.items()}
    return row | {"ratio": row["solver_step"] / row["forward_dynamics"]}


def describe(row: dict[str, Any]) -> str:
    """Return the row as a line."""
    first = list(row).index("solver_step")
    text = " ".join(f"{key} {value:.4g}" for key, value in list(row.items())[first:])
    used = f"registers {row.get('registers')}, stack {row.get('local_bytes')}, launches {row.get('launches')}"
    seconds = f"built in {row['first_call_s']:.3g} s"
    return f"{row['robot']} {row['worlds']}: {text}; {used}; {seconds}; error {row['error']:.1e}"


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("step_parts", __doc__)
    parser.add_argument("robots", nargs="*", default=list(NAMES))
    parser.add_argument("--worlds", nargs="+", type=int, default=[4096, 16384])
    options = parser.parse_args(arguments)
    rows: list[dict] = []
    run, device = runner.record(rows, options.device), wp.get_device(options.device)
    for name in options.robots:
        for worlds in options.worlds:
            rows.append(measure(name, worlds, device))
            print(describe(rows[-1]), flush=True)
            if options.json:
                runner.save(run, options.json)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
