"""Does a step keep the energy of what turns freely: bodies alone, and robots in flight?

    python -m benchmarks.spin                                  # a table
    python -m benchmarks.spin --json benchmarks/results/SPIN.json
    python -m benchmarks.spin --folders FOLDER... --robots T1 H1 Apollo      # files of benchmarks.robots_of_others

Bodies: a rod of 0.4 m that turns at 10 rad/s, a plate and a box at 20 rad/s, about random axes, on a free and on a ball
hinge, for 5 s without gravity; beside MuJoCo's integrators. Robots: limp, with limits, no gravity, the base turning at
3 rad/s and joints at 1 rad/s, for 2 s, 100 m above ground. Each row has the largest rise of the kinetic energy above
that of the start at any time and its largest loss, as shares, the worst of all worlds, and the worst status.
"""

from __future__ import annotations

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
OPTIONS = {"three passes": {}, "rounds=1": {"rounds": 1}, "four passes": {"passes": 4}}
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


def follow(scene: spo.Scene, q: Any, qd: Any, h: float, seconds: float, dtype: str, **options: Any) -> dict[str, Any]:
    """Return how the energy changes in steps of ``h``, and the worst status."""
    worlds = len(q)
    dyn, judge = (spo.Dynamics(scene, worlds, "cpu", kind, granularity="tree") for kind in (dtype, "float64"))
    start, rise, loss = judge.kinetic_energy(q, qd), 0.0, 0.0
    q, qd, words, worst = q.astype(dtype), qd.astype(dtype), np.zeros(worlds, np.int32), 0
    steps = round(seconds / h)
    for number in range(1, steps + 1):
        q, qd = dyn.step(q, qd, None, h, options=spo.StepOptions(**options), status=words)
        worst = max(worst, int(words.max()))
        if number % max(1, steps // LOOKS):
            continue
        change = judge.kinetic_energy(q.astype(float), qd.astype(float)) / start - 1.0
        rise, loss = max(rise, float(change.max())), max(loss, float(-change.min()))
    return {"dtype": dtype, "step": h, "rise": rise, "loss": loss, "status": spo.Status(worst).name}


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
        scene, rng = scene.with_values(gravity=np.zeros(3), **limp), np.random.default_rng(0)
        q, qd = np.tile(scene.neutral_q, (worlds, 1)), np.zeros((worlds, scene.dof_count))
        low, high = (scene.values[f"joint_limit_{end}"][0, 6:] for end in ("lower", "upper"))
        q[:, 7:] = np.clip(q[:, 7:], low, high)
        q[:, 2] += 100.0
        qd[:, 3:6], qd[:, 6:] = spins(3.0, worlds), rng.normal(size=(worlds, scene.dof_count - 6))
        for by, options in OPTIONS.items() if scene.contacts and not scene.contact_pairs else [("three passes", {})]:
            for h in steps:
                for dtype in dtypes:
                    row = {"of": name, "by": by, **follow(scene, q, qd, h, 2.0, dtype, **options)}
                    print(_line(row), flush=True)
                    rows.append(row)
    return rows


def _line(row: dict) -> str:
    return (
        f"| {row['of']} | {row['by']} | {row['dtype']} | {row['step']:g} | {row['rise']:.1e} | {row['loss']:.1e} | "
        f"{row['status']} |"
    )


def main(arguments: list[str] | None = None) -> int:
    options = parser("spin", __doc__)
    options.add_argument("--worlds", type=int, default=16)
    options.add_argument("--steps", type=float, nargs="+", default=list(STEPS))
    options.add_argument("--robots", nargs="*", default=["go2", "g1"])
    options.add_argument("--dtypes", nargs="+", default=["float64", "float32"], help="of robots")
    options.add_argument("--folders", type=Path, nargs="+", default=[])
    given = options.parse_args(arguments)
    print("| of | by | dtype | step [s] | rise | loss | status |\n|---|---|---|---|---|---|---|")
    rows = bodies(given.worlds, given.steps)
    print(*map(_line, rows), sep="\n", flush=True)
    rows += robots(given.robots, given.folders, given.worlds, given.steps, given.dtypes)
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
