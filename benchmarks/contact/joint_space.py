"""Steps of touching bodies solved in joint space: time of each part, errors against float64, today's step beside it.

    python -m benchmarks.contact.joint_space [--device cuda:0] [--worlds 4096 16384] [--cases hand] [--json FILE]

Cases: ``hand``, four fingers of four hinges around a cube, 24 pairs; ``gripper``, a Panda whose two pads hold a cube;
``apart``, the same with the cube out of reach; ``cubes``, nine on each other and on a plate. Parts are ``system`` (mass
matrix, bias force, poses), ``points`` (near pairs and their points), ``solve`` (all passes) and ``step``, with the
coordinates. dt is 5 ms, passes are four. ``--lanes`` are threads of a world.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import warp as wp

import warp_spo as spo
from warp_spo.dynamics.stepping.joint_space import JointSpaceStep
from warp_spo.kernels import joint_space
from warp_spo.reference.body_contact import PairStep

from .. import command_line
from ..capabilities import measure_time
from . import pairs

DIFFERENT, SAMPLE, DT = 64, 4, 5e-3
ROOM = {"hand": (24, 32), "gripper": (4, 16), "apart": (4, 16), "cubes": (10, 40)}
"""Pairs at most that are near in a world, and slots."""


def hand() -> spo.Scene:
    """Return four fingers around a cube on a palm that stands still."""
    bodies, hinges, contacts, law = [], [], [], dict(stiffness=2e4, damping=40.0)
    drive = dict(armature=2e-3, target_ke=3.0, target_kd=0.1, effort_limit=0.9)
    cube = dict(box=(0.035, 0.035, 0.035))
    links: list[list[int]] = []
    for x, y in ((-0.045, 0.075), (0.0, 0.075), (0.045, 0.075), (0.0, -0.075)):
        parent, place, side = -1, (x, y, 0.0), 1.0 if y > 0 else -1.0
        links.append([])
        for axis, length in (((0, 1, 0), 0.0), ((1, 0, 0), 0.045), ((1, 0, 0), 0.035), ((1, 0, 0), 0.03)):
            along = tuple(side * np.array(axis, dtype=float)) if axis[0] else axis
            hinges.append(spo.Hinge("revolute", parent, len(bodies), axis=along, parent_pose=(*place, 0, 0, 0, 1),
                                    limit_lower=-0.6, limit_upper=1.8, **drive))  # fmt: skip
            parent, place = len(bodies), (0.0, 0.0, length)
            mass = 0.02 if length == 0.0 else 0.035
            bodies.append(spo.Body(mass, (0, 0, 0.5 * length), 1.5e-5 * np.eye(3)))
            links[-1].append(parent)
    free = len(bodies)
    bodies.append(spo.Body(0.1, inertia=0.1 * 0.07**2 / 6.0 * np.eye(3)))
    hinges.append(spo.Hinge("free", -1, free))
    rod = lambda body, length: dict(body=body, capsule=((0, 0, 0.005), (0, 0, length), 0.009))  # noqa: E731
    tip = lambda body: dict(body=body, capsule=((0, 0, 0.01), (0, 0, 0.022), 0.01))  # noqa: E731
    palm = dict(body=-1, box=((0.06, 0.05, 0.01), (0, 0, -0.01, 0, 0, 0, 1)))
    meet = lambda one, other: contacts.append(spo.Contact(**one, other=spo.Contact(**other), **law))  # noqa: E731
    meet(dict(body=free, **cube), palm)
    for finger in links:
        for one in (tip(finger[3]), rod(finger[2], 0.03), rod(finger[1], 0.04)):
            meet(one, dict(body=free, **cube))
    for a, b in itertools.combinations(links, 2):
        meet(tip(a[3]), tip(b[3]))
    for a, b in ((0, 1), (1, 2)):
        meet(rod(links[a][2], 0.03), rod(links[b][2], 0.03))
    for finger in links[:3]:
        meet(tip(finger[3]), palm)
    return spo.Scene(bodies, hinges, contacts=contacts)


def case(name: str) -> tuple[spo.Scene, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return a scene, and q, qd, tau, target_q of ``DIFFERENT`` worlds."""
    rng = np.random.default_rng(0)
    if name == "hand":
        scene = hand()
        q = np.tile(scene.neutral_q, (DIFFERENT, 1))
        target = q.copy()
        q[:, :16] = 0.1 * rng.normal(size=(DIFFERENT, 16))
        q[:, 16:19] = [0.0, 0.0, 0.0349] + 0.002 * rng.normal(size=(DIFFERENT, 3)) * [1, 1, 0]
        target[:, :16] = np.tile([0.0, 0.2, 0.6, 0.6], 4) + 0.2 * rng.normal(size=(DIFFERENT, 16))
        q, qd = settle(scene, q, target, 60)
        return scene, q, qd, np.zeros_like(qd), target
    if name == "cubes":
        one = pairs.stack(9)
        plate = spo.Contact(-1, box=((2.0, 2.0, 0.5), (0, 0, -0.5, 0, 0, 0, 1)))
        half = (pairs.CUBE,) * 3
        scene = one.scene.with_contacts([spo.Contact(0, box=half, other=plate), *one.scene.contacts[1:]])
        q, qd, tau = one.states(scene, rng)
        q.reshape(DIFFERENT, 9, 7)[..., 2] -= 1e-4
    else:
        one = pairs.gripper({"gripper": "boxes", "apart": "apart"}[name])
        q, qd, tau = one.states(one.scene, rng)
        scene = one.scene.with_contacts(one.scene.contacts[1:])
    return scene, q, qd, tau, np.tile(scene.neutral_q, (DIFFERENT, 1))


def settle(scene: spo.Scene, q: np.ndarray, target: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the state after some steps towards ``target``."""
    dyn = spo.Dynamics(scene, len(q), "cpu", "float64")
    solver, array = JointSpaceStep(dyn, 24, 64), lambda x: wp.array(x, dtype=wp.float64, device="cpu")
    state, rates, aim = array(q), array(np.zeros((len(q), scene.dof_count))), array(target)
    after = wp.zeros_like(state)
    for _ in range(steps):
        solver.step(state, rates, None, (aim, None), DT, after=(after, rates))
        wp.copy(state, after)
    return state.numpy(), rates.numpy()


class StepAtPoints(PairStep):
    """A dense step whose pairs share the points that a solver has found, by number of the pair."""

    def __init__(self, found: dict[int, list], *args: Any):
        self.found = found
        super().__init__(*args)

    def points_of(self, number: int, first: Any, second: Any) -> list:
        return self.found.get(number, [])


class Case:
    """A scene with states of ``DIFFERENT`` worlds, and what a step does to them in float64 on the CPU."""

    def __init__(self, name: str):
        self.name = name
        self.scene, *states = case(name)
        self.states = [x.astype(np.float32) for x in states]
        q, qd, tau, target = (x.astype(np.float64) for x in self.states)
        array = lambda x: wp.array(x, dtype=wp.float64, device="cpu")  # noqa: E731
        solver = JointSpaceStep(spo.Dynamics(self.scene, DIFFERENT, "cpu", "float64"), 24, 128)
        self.wanted = solver.step(array(q), array(qd), array(tau), (array(target), None), DT).numpy().copy()
        near, touches = solver.near.numpy().reshape(DIFFERENT, -1), solver.touches.numpy().reshape(DIFFERENT, 24, 8, 7)
        points = [{solver.tables.pairs[row[1 + k]]: [(x[:3], x[3:6], x[6]) for x in touches[w, k, : row[25 + k]]]
                   for k in range(min(row[0], 24)) if row[1 + k] >= 0} for w, row in enumerate(near)]  # fmt: skip
        errors, closed = [], []
        for world in range(0, DIFFERENT, DIFFERENT // SAMPLE):
            dense = StepAtPoints(points[world], self.scene, q[world], qd[world], DT, target[world])
            found = dense.run(tau[world], passes=4)[1]
            errors.append(np.abs(found.v - self.wanted[world]).max() / np.abs(found.v).max())
            closed.append(int(found.on.sum()))
        self.contents = {
            "near pairs": float(near[:, 0].mean()),
            "points": sum(len(own) for found in points for own in found.values()) / DIFFERENT,
            "closed": closed, "float64 against the dense step": float(max(errors)),
        }  # fmt: skip


class Run:
    """A case for so many worlds, which repeat its states."""

    def __init__(self, one: Case, worlds: int, device: wp.Device):
        self.one, self.scene, self.worlds, self.device = one, one.scene, worlds, device
        states = [np.resize(x, (worlds, x.shape[1])) for x in one.states]
        self.q, self.qd, self.tau, self.target = (wp.array(x, dtype=wp.float32, device=device) for x in states)
        self.dyn = spo.Dynamics(one.scene, worlds, device, "float32")

    def errors(self, found: np.ndarray) -> dict[str, float]:
        """Return errors of rates over the largest one of a world."""
        error = np.abs(found[:DIFFERENT] - self.one.wanted).max(axis=1) / np.abs(self.one.wanted).max(axis=1)
        return {"error median": float(np.median(error)), "error worst": float(error.max())}

    def solver(self, lanes: int, refine: int, registers: int | None) -> JointSpaceStep:
        return JointSpaceStep(self.dyn, *ROOM[self.one.name], lanes=lanes, refine=refine, registers=registers)

    def measure(self, lanes: int, refine: int, registers: int | None) -> dict[str, Any]:
        """Return times of the parts of a step [us], and its errors."""
        solver = self.solver(lanes, refine, registers)
        q, qd, tau, aim, after = (
            self.q,
            self.qd,
            self.tau,
            (self.target, None),
            (wp.zeros_like(self.q), wp.zeros_like(self.qd)),
        )
        solver.step(q, qd, tau, aim, DT, after=after)
        found = solver.qd_out.numpy()
        parts = {
            "system": lambda _: solver.find_system(q, qd, DT),
            "points": lambda _: solver.find_points(DT),
            "solve": lambda _: solver.solve(q, qd, tau, aim, DT),
            "step": lambda _: solver.step(q, qd, tau, aim, DT, after=after),
        }
        sizes = solver.tables.sizes
        return {
            "case": self.one.name, "worlds": self.worlds, "lanes": lanes, "refine": refine, "registers": registers,
            "us": {part: measure_time(run, self.device) for part, run in parts.items()}, **self.errors(found),
            "repeated worlds equal": bool((found == np.resize(found[:DIFFERENT], found.shape)).all()),
            "status": int(solver.status.numpy().max()), "bytes a world": joint_space.world_bytes(sizes, wp.float32),
            "digest": hashlib.sha256(found[:DIFFERENT].tobytes()).hexdigest()[:12], "sizes": sizes._asdict(),
        }  # fmt: skip

    def today(self) -> dict[str, Any]:
        """Return time and errors of the step of Dynamics."""
        out = wp.zeros_like(self.q), wp.zeros_like(self.qd)
        run = lambda _: self.dyn.step(self.q, self.qd, self.tau, DT, target_q=self.target, out=out)  # noqa: E731
        run(0)
        return {"today": True, "case": self.one.name, "worlds": self.worlds,
                "us": {"step": measure_time(run, self.device)}, **self.errors(out[1].numpy())}  # fmt: skip


def compile_solvers(runs: list[Run], variants: list[tuple[int, int, int | None]], device: wp.Device) -> float:
    """Compile the solvers side by side; return the seconds that it took."""
    start = time.perf_counter()
    solvers = {part for run in runs for each in variants for part in run.solver(*each).solvers}
    with ThreadPoolExecutor() as pool:
        list(pool.map(lambda part: part[0].module.load(device, block_dim=part[2]), solvers))
    return time.perf_counter() - start


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("contact.joint_space", __doc__)
    parser.add_argument("--worlds", type=int, nargs="+", default=[4096, 16384])
    parser.add_argument("--cases", nargs="+", choices=ROOM, default=list(ROOM))
    parser.add_argument("--lanes", type=int, nargs="+", default=[8, 16, 32], choices=[8, 16, 32])
    parser.add_argument("--refine", type=int, nargs="+", default=[1])
    parser.add_argument("--registers", type=int, nargs="+", default=[0], help="of a thread at most; 0: no limit")
    parser.add_argument("--today", nargs="*", choices=ROOM, default=["gripper", "cubes"], help="beside today's step")
    options = parser.parse_args(arguments)
    device, results = wp.get_device(options.device), []
    variants = list(itertools.product(options.lanes, options.refine, [x or None for x in options.registers]))

    def keep(found: dict[str, Any]) -> None:
        results.append(found)
        times = "  ".join(f"{part} {us:8.1f}" for part, us in found["us"].items())
        what = (
            "today"
            if found.get("today")
            else f"lanes {found['lanes']:2d} refine {found['refine']} registers {found['registers']}"
        )
        print(f"{found['case']:8s} {found['worlds']:6d}  {what:32s} {times}  error {found['error median']:.1e} "
              f"{found['error worst']:.1e}  status {found.get('status')} {found.get('repeated worlds equal')} "
              f"{found.get('digest', '')}", flush=True)  # fmt: skip
        if options.json:
            options.json.write_text(json.dumps(results, indent=1))

    cases = [Case(name) for name in options.cases]
    for one in cases:
        print(one.name, one.contents, flush=True)
    runs = [Run(one, worlds, device) for one in cases for worlds in options.worlds]
    print(f"compiled all solvers in {compile_solvers(runs, variants, device):.1f} s", flush=True)
    for run in runs:
        for each in variants:
            try:
                keep(run.measure(*each))
            except Exception as error:  # a variant that does not fit is no reason to lose the others
                print(f"{run.one.name} {run.worlds} {each}: {type(error).__name__}: {error}", flush=True)
    for run in runs:
        if run.one.name in options.today:
            keep(run.today())
    return 0


if __name__ == "__main__":
    sys.exit(main())
