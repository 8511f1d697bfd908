"""Does a step keep the energy of what turns freely: bodies alone, and robots in flight?

    python -m benchmarks.spin                                  # a table
    python -m benchmarks.spin --json benchmarks/results/SPIN.json
    python -m benchmarks.spin --of robots --folders FOLDER... --robots T1 H1 Apollo     # files of robots_of_others

Bodies: a rod of 0.4 m that turns at 10 rad/s, a plate and a box at 20 rad/s, about random axes, on a free and on a ball
hinge, for 5 s without gravity; beside MuJoCo's integrators. Robots: limp, with limits, no gravity, the base turning at
3 rad/s and joints at 1 rad/s, for 2 s, 100 m above ground; and held by drives, from rest in their joints. Each row has
the largest rise of the kinetic energy above that of the start at any time and its largest loss, as shares, the worst of
all worlds, and the worst status; of robots also by how much the angular momentum changes within the motion, as a share,
and how far joints are from the rates of steps a fiftieth as long after 0.1 s [rad/s], both in the median of the worlds.

"mean rates": a step of three passes whose velocity terms are taken at the mean of the rates before and after a first
step, as forces: what a step would do that computes them anew after its first pass.
"""

from __future__ import annotations

import itertools
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import warp_spo as spo

from .command_line import parser
from .contact import scenes
from .robots_of_others import ROBOTS, without_meshes

STEPS = 1e-3, 2e-3, 5e-3, 1e-2  # s
SIZES = {"rod": ((0.4, 0.01, 0.01), 10.0), "plate": ((0.4, 0.3, 0.01), 20.0), "box": ((0.1, 0.2, 0.3), 20.0)}
"""Edges [m] and angular velocity [rad/s]; each has 1 kg."""
OPTIONS: dict[str, dict[str, Any]] = {
    "three passes": {},
    "mean rates": {"share": 0.5},
    "rounds=1": {"rounds": 1},
    "four passes": {"passes": 4},
}
FINE, EARLY = 50, 0.1  # steps of the truth in a step; time of its comparison [s]
LOOKS = 500  # at the energy in a motion, at least, where it has so many steps
INTEGRATORS = ("Euler", "implicitfast", "implicit", "RK4")  # of MuJoCo


def moments(edges: tuple[float, ...]) -> np.ndarray:
    """Return the principal moments of inertia of a box of 1 kg [kg m^2]."""
    squares = np.square(edges)
    return (squares.sum() - squares) / 12.0


def spins(rate: float, worlds: int) -> np.ndarray:
    """Return angular velocities of this size about random axes [world, 3]."""
    axes = np.random.default_rng(0).normal(size=(worlds, 3))
    return rate * axes / np.linalg.norm(axes, axis=1)[:, None]


def take(dyn: spo.Dynamics, q: Any, qd: Any, h: float, status: Any = None, share: float = 0.0, **options: Any) -> Any:
    """Return the state after a step; ``share``: its velocity terms are taken at qd and that of what a step changes."""
    force = None
    if share:
        _, after = dyn.step(q, qd, None, h)
        at = (qd + share * (after - qd)).astype(qd.dtype)
        force = dyn.bias_force(q, qd) - dyn.bias_force(q, at)
    return dyn.step(q, qd, force, h, options=spo.StepOptions(**options), status=status)


def follow(scene: spo.Scene, q: Any, qd: Any, h: float, seconds: float, dtype: str, **options: Any) -> dict[str, Any]:
    """Return how the energy changes in steps of ``h``, and the worst status; of robots also momentum and rates."""
    worlds, robot = len(q), scene.dof_count > 6
    dyn, judge = (spo.Dynamics(scene, worlds, "cpu", kind, granularity="tree") for kind in (dtype, "float64"))
    start, rise, loss = judge.kinetic_energy(q, qd), 0.0, 0.0
    momentum, error, wanted = spin_momentum(judge, q, qd) if robot else 0.0, 0.0, rates_early(judge, q, qd, h, robot)
    q, qd, words, worst = q.astype(dtype), qd.astype(dtype), np.zeros(worlds, np.int32), 0
    steps = round(seconds / h)
    for number in range(1, steps + 1):
        q, qd = take(dyn, q, qd, h, words, **options)
        worst = max(worst, int(words.max()))
        if robot and number == round(EARLY / h):
            error = float(np.median(np.abs(qd - wanted)[:, 6:].max(axis=1)))
        if number % max(1, steps // LOOKS):
            continue
        change = judge.kinetic_energy(q.astype(float), qd.astype(float)) / start - 1.0
        rise, loss = max(rise, float(change.max())), max(loss, float(-change.min()))
    found = {"dtype": dtype, "step": h, "rise": rise, "loss": loss, "status": spo.Status(worst).name}
    if robot:
        change = np.linalg.norm(spin_momentum(judge, q, qd) - momentum, axis=1) / np.linalg.norm(momentum, axis=1)
        found |= {"momentum": float(np.median(change)), "rates": error}
    return found


def spin_momentum(dyn: spo.Dynamics, q: Any, qd: Any) -> np.ndarray:
    """Return the angular momentum about the centre of mass [world, 3]."""
    matrix = dyn.centroidal_momentum_matrix(q.astype(float))
    return np.einsum("wij,wj->wi", matrix, qd.astype(float))[:, 3:]


def rates_early(dyn: spo.Dynamics, q: Any, qd: Any, h: float, robot: bool) -> np.ndarray:
    """Return qd after the time EARLY in short steps; of a body alone, which nobody compares, qd."""
    for _ in range(FINE * round(EARLY / h) if robot else 0):
        q, qd = dyn.step(q, qd, None, h / FINE)
    return qd


def of_mujoco(edges: tuple[float, ...], rate: float, kind: str, h: float, integrator: str, worlds: int) -> dict:
    """Return the same of a body in MuJoCo."""
    inertia, size = " ".join(f"{x:.17g}" for x in moments(edges)), "type='free'" if kind == "free" else "type='ball'"
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><option timestep='{h}' gravity='0 0 0' integrator='{integrator}'/><worldbody><body>"
        f"<joint {size}/><inertial pos='0 0 0' mass='1' diaginertia='{inertia}'/></body></worldbody></mujoco>"
    )
    rise = loss = 0.0
    for spin in spins(rate, worlds):
        data = mujoco.MjData(model)
        data.qvel[-3:] = spin
        start = 0.5 * moments(edges) @ spin**2
        for _ in range(LOOKS):
            mujoco.mj_step(model, data, round(5.0 / h) // LOOKS)
            change = 0.5 * moments(edges) @ data.qvel[-3:] ** 2 / start - 1.0
            rise, loss = max(rise, change), max(loss, -change)
    return {"dtype": "float64", "step": h, "rise": rise, "loss": loss, "status": ""}


def bodies(worlds: int, steps: list[float]) -> list[dict]:
    """Return the rows of bodies alone."""
    rows = []
    for name, (edges, rate) in SIZES.items():
        for kind in ("free", "ball"):
            body = spo.Body(1.0, inertia=np.diag(moments(edges)))
            scene = spo.Scene([body], [spo.Hinge(kind, -1, 0)], gravity=(0, 0, 0))
            q, qd = np.tile(scene.neutral_q, (worlds, 1)), np.zeros((worlds, scene.dof_count))
            qd[:, -3:] = spins(rate, worlds)
            for h in steps:
                for dtype in ("float64", "float32"):
                    rows.append({"of": f"{name}, {kind}", "by": "warp_spo", **follow(scene, q, qd, h, 5.0, dtype)})
                for integrator in INTEGRATORS if kind == "free" else ():
                    found = of_mujoco(edges, rate, kind, h, integrator, worlds)
                    rows.append({"of": f"{name}, {kind}", "by": f"MuJoCo {integrator}", **found})
    return rows


def load(name: str, folders: list[Path]) -> spo.Scene:
    """Return the scene of a robot of :mod:`.contact.scenes`, or of a file in one of the folders."""
    if name in ("go2", "g1"):
        return scenes.scene(name)
    file = next(folder / ROBOTS[name] for folder in folders if (folder / ROBOTS[name]).exists())
    with tempfile.TemporaryDirectory() as folder:
        own = Path(folder) / file.name
        own.write_text(without_meshes(file).text)
        return spo.load(own)


def robots(names: list[str], folders: list[Path], worlds: int, steps: list[float], dtypes: list[str]) -> list[dict]:
    """Return the rows of robots in flight."""
    rows = []
    for name in names:
        scene = load(name, folders)
        none = np.zeros(scene.dof_count)
        limp = {f"joint_{law}": none for law in ("target_ke", "target_kd", "damping", "stiffness", "friction")}
        held, rng = scene.with_values(gravity=np.zeros(3)), np.random.default_rng(0)
        scene = held.with_values(**limp)
        q, qd = np.tile(scene.neutral_q, (worlds, 1)), np.zeros((worlds, scene.dof_count))
        low, high = (scene.values[f"joint_limit_{end}"][0, 6:] for end in ("lower", "upper"))
        q[:, 7:] = np.clip(q[:, 7:], low, high)
        q[:, 2] += 100.0
        qd[:, 3:6], qd[:, 6:] = spins(3.0, worlds), rng.normal(size=(worlds, scene.dof_count - 6))
        still = np.where(np.arange(scene.dof_count) < 6, qd, 0.0)
        for kind, one, rates in ((name, scene, qd), (f"{name}, held", held, still)):
            for by, options in (
                OPTIONS.items() if scene.contacts and not scene.contact_pairs else [("three passes", {})]
            ):
                for h, dtype in itertools.product(steps, dtypes):
                    row = {"of": kind, "by": by, **follow(one, q, rates, h, 2.0, dtype, **options)}
                    print(_line(row), flush=True)
                    rows.append(row)
    return rows


def _line(row: dict) -> str:
    figures = (f"{row[name]:.1e}" if name in row else "" for name in ("rise", "loss", "momentum", "rates"))
    return f"| {row['of']} | {row['by']} | {row['dtype']} | {row['step']:g} | {' | '.join(figures)} | {row['status']} |"


def main(arguments: list[str] | None = None) -> int:
    options = parser("spin", __doc__)
    options.add_argument("--of", nargs="+", choices=("bodies", "robots"), default=["bodies", "robots"])
    options.add_argument("--worlds", type=int, default=16)
    options.add_argument("--steps", type=float, nargs="+", default=list(STEPS))
    options.add_argument("--robots", nargs="*", default=["go2", "g1"])
    options.add_argument("--dtypes", nargs="+", default=["float64", "float32"], help="of robots")
    options.add_argument("--folders", type=Path, nargs="+", default=[])
    given = options.parse_args(arguments)
    print("| of | by | dtype | step [s] | rise | loss | momentum | rates | status |\n" + "|---" * 9 + "|")
    rows = bodies(given.worlds, given.steps) if "bodies" in given.of else []
    for row in rows:
        print(_line(row), flush=True)
    if "robots" in given.of:
        rows += robots(given.robots, given.folders, given.worlds, given.steps, given.dtypes)
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
