"""Motions of robots on the ground: every figure that contacts promise, as asked and as measured, in float64 on the CPU.

    python -m benchmarks.contact.motions [NAME ...] [--json FILE]

Errors are root mean squares over the run against the same motion in steps of 0.2 ms. Targets of the drives and pushes
change every 10 ms, whatever the step is. G1 has four points at each sole and drives of 500 N m/rad, 15 N m s/rad with
the effort limits of its file, Go2 four spheres and the corners of its trunk, 60 N m/rad and 2 N m s/rad.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

import warp_spo as spo
from warp_spo.reference.contact import ContactStep

from .. import command_line
from ..table import robots
from . import scenes
from .courses import courses

FINE, CONTROL = 2e-4, 1e-2  # the step of the reference, and the time between changes of targets and pushes [s]
STEPS = (2e-3, 5e-3, 1e-2)
SOLE = 8  # contact points of G1's feet, which come first
BENT = {"hip_pitch": -0.312, "knee": 0.669, "ankle_pitch": -0.357}


class Line(NamedTuple):
    """One figure: of which motion, at which dt [s], measured, and the bound that was asked for, None where none was."""

    motion: str
    figure: str
    dt: float | None
    measured: float
    asked: float | None = None

    @property
    def holds(self) -> bool | None:
        return None if self.asked is None else bool(self.measured <= self.asked)

    def __str__(self) -> str:
        dt = "" if self.dt is None else f"{1e3 * self.dt:g} ms"
        verdict = "" if self.asked is None else f"asked {self.asked:.3g}  {'ok' if self.holds else 'MISSED'}"
        return f"{self.motion:34s} {self.figure:34s} {dt:>7s}  {self.measured:10.3g}  {verdict}"


def record(
    dyn: spo.Dynamics,
    q: np.ndarray,
    qd: np.ndarray,
    dt: float,
    seconds: float,
    target: Callable[[float], np.ndarray],
    push: Callable[[float], np.ndarray] | None = None,
    passes: int | None = None,
) -> dict[str, np.ndarray]:
    """Return what happens, by name, [control period, world, ...]: q and qd at its end, the mean of forces ``f``, the
    largest ``excess`` and the spread of the force's sum, ``jitter``; and ``gap``, ``slip`` at the end."""
    worlds, points = len(q), len(dyn.scene.contact_points)
    force, excess = np.zeros((worlds, points, 3)), np.zeros((worlds, 3))
    gap, slip = np.zeros((worlds, points)), np.zeros((worlds, points))
    options = spo.StepOptions(passes=passes)
    report = spo.StepReport(contact_f=force, contact_excess=excess, contact_gap=gap, contact_slip=slip)
    every = max(1, round(CONTROL / dt))
    found: dict[str, list] = {name: [] for name in ("q", "qd", "f", "excess", "jitter")}
    for period in range(round(seconds / CONTROL)):
        wanted, given = target(period * CONTROL), {} if push is None else {"body_f": push(period * CONTROL)}
        sums, worst, totals = np.zeros_like(force), np.zeros_like(excess), []
        for _ in range(every):
            q, qd = dyn.step(q, qd, None, dt, target_q=wanted, options=options, report=report, **given)
            sums += force / every
            worst = np.maximum(worst, excess)
            totals.append(force.sum(axis=1)[:, 2])
        for name, value in (("q", q), ("qd", qd), ("f", sums), ("excess", worst), ("jitter", np.ptp(totals, axis=0))):
            found[name].append(np.array(value))
    return {name: np.array(rows) for name, rows in found.items()} | {"gap": gap.copy(), "slip": slip.copy()}


def rms(found: dict, fine: dict, world: int, columns: Any = slice(0, 3)) -> float:
    """Return by how much the base's position differs [mm], root mean square over the run."""
    difference = found["q"][:, world, columns] - fine["q"][:, world, columns]
    return 1e3 * float(np.sqrt((difference.reshape(len(difference), -1) ** 2).sum(axis=1).mean()))


# -- G1 ----------------------------------------------------------------------------------------------------------------
def g1() -> spo.Scene:
    """Return G1 with 18 points, stiffer drives than for timing, and its file's effort limits."""
    drive = np.r_[np.zeros(6), np.ones(29)]
    gains = dict(joint_target_ke=500.0 * drive, joint_target_kd=15.0 * drive, joint_armature=0.01 * drive,
                 joint_effort_limit=robots.scene("g1").values["joint_effort_limit"])  # fmt: skip
    return scenes.scene("g1").with_values(**gains)


def entry(scene: spo.Scene, name: str) -> int:
    """Return the coordinate of a hinge with one dof of a floating robot."""
    return 1 + next(i for i, label in enumerate(scene.dof_labels) if label.endswith(f"{name}_joint"))


def touch_down(scene: spo.Scene, q: np.ndarray, feet: int) -> np.ndarray:
    """Return q with the base as high as the lowest of the first points, the feet's, wants it."""
    q = q.copy()
    q[2] += ContactStep(scene, q, np.zeros(scene.dof_count), CONTROL).points.depth[:feet].max()
    return q


def bent(scene: spo.Scene, knee: float = 1.0, lean: float = 0.0) -> np.ndarray:
    """Return q of G1 with bent knees and flat feet, the rest turned back by ``lean`` [rad] at the ankles."""
    q = scene.neutral_q.copy()
    for side in ("left", "right"):
        for name, angle in BENT.items():
            q[entry(scene, f"{side}_{name}")] = knee * angle + lean * (name == "ankle_pitch")
    q[3:7] = 0.0, -np.sin(0.5 * lean), 0.0, np.cos(0.5 * lean)
    return touch_down(scene, q, SOLE)


def on_one_leg(scene: spo.Scene) -> np.ndarray:
    """Return q of G1 on its left leg, which is straight, the centre of mass above the line along the sole's middle."""
    at = spo.Dynamics(scene, 1, dtype="float64")
    foot = next(i for i, label in enumerate(scene.body_labels) if label.endswith("left_ankle_roll_link"))
    q, roll = bent(scene, 0.0), 0.0
    q[entry(scene, "right_hip_pitch")], q[entry(scene, "right_knee")] = -0.5, 1.2
    for _ in range(20):  # the leg is 0.7 m long
        q[entry(scene, "left_hip_roll")], q[entry(scene, "left_ankle_roll")] = roll, -roll
        roll += (at.com(q[None])[0] - at.body_poses(q[None])[0, foot, :3])[1] / 0.7
    return touch_down(scene, q, SOLE)


def upheld(scene: spo.Scene, q: np.ndarray, ke: np.ndarray) -> np.ndarray:
    """Return the targets at which drives of stiffness ``ke`` hold G1 at q on its left leg."""
    at = spo.Dynamics(scene, 1, dtype="float64")
    foot = next(i for i, label in enumerate(scene.body_labels) if label.endswith("left_ankle_roll_link"))
    place, com = at.body_poses(q[None])[0, foot], at.com(q[None])[0]
    under = (com[0] - place[0], com[1] - place[1], -0.03)  # the sole is level
    J = at.jacobian(q[None], [(foot, (*under, 0.0, 0.0, 0.0, 1.0))])[0, 0, :3]
    torque = at.gravity_force(q[None])[0] - J.T @ (0.0, 0.0, 9.81 * scene.values["body_mass"].sum())
    target = q.copy()
    target[7:] += torque[6:] / ke[6:]
    return target


MOTIONS = ("stand", "slope", "drop", "drop, straight legs", "push forward", "push sideways", "one leg", "light foot",
           "trunk x10", "march")  # fmt: skip
"""Of G1, one a world."""
ASKED = {
    ("position", "push forward"): 3.0, ("position", "push sideways"): 5.0, ("position", "one leg"): 0.1,
    **{("height", name, dt): bound for name in ("drop", "drop, straight legs")
       for dt, bound in ((5e-3, 1.5), (1e-2, 3.0))},
    ("creep", "stand"): 0.02, ("creep", "slope"): 0.52,
    **{(name, motion): bound for motion in ("stand", "slope") for name, bound in (("weight", 1e-3), ("jitter", 2e-4))},
    **{("cone", motion): 0.02 for motion in ("drop", "drop, straight legs")},
}  # fmt: skip


def march_target(scene: spo.Scene, stand: np.ndarray, t: float) -> np.ndarray:
    """Return q that lifts one foot after the other, 0.4 s each."""
    q, phase = stand.copy(), t / 0.4
    side, lift = ("left", "right")[int(phase) % 2], np.sin(np.pi * (phase % 1.0)) ** 2 * min(1.0, t / 0.4)
    for name, angle in BENT.items():
        q[entry(scene, f"{side}_{name}")] += 0.8 * lift * angle
    return q


def g1_worlds(scene: spo.Scene) -> tuple[spo.Dynamics, np.ndarray, np.ndarray, np.ndarray]:
    """Return dynamics of all motions, the states in which they begin and that the drives hold, and the masses."""
    worlds = len(MOTIONS)
    at = {name: i for i, name in enumerate(MOTIONS)}
    names = ("gravity", "joint_target_ke", "joint_target_kd", "joint_armature", "body_mass", "body_inertia",
             "contact_stiffness", "contact_damping")  # fmt: skip
    values = {name: np.repeat(scene.values[name][:1], worlds, axis=0) for name in names}
    tilt = np.radians(20.0)
    values["gravity"][at["slope"]] = 9.81 * np.array([np.sin(tilt), 0.0, -np.cos(tilt)])
    values["joint_target_ke"][at["one leg"]] *= 6.0
    values["joint_target_kd"][at["one leg"]] *= 3.0
    feet = [i for i, label in enumerate(scene.body_labels) if "ankle_roll" in label]
    light = 0.068 / values["body_mass"][0, feet].mean()
    values["body_mass"][at["light foot"], feet] *= light
    values["body_inertia"][at["light foot"], feet] *= light
    values["joint_armature"][at["light foot"]] = 0.0
    trunk = next(i for i, label in enumerate(scene.body_labels) if label.endswith("torso_link"))
    for name in ("body_mass", "body_inertia"):
        values[name][at["trunk x10"], trunk] *= 10.0
    for name in ("joint_target_ke", "joint_target_kd", "contact_stiffness", "contact_damping"):
        values[name][at["trunk x10"]] *= 10.0
    values["joint_target_ke"][at["march"], [0, 1, 3, 4, 5]] = 2000.0  # holds the base but for its height
    values["joint_target_kd"][at["march"], [0, 1, 3, 4, 5]] = 200.0
    stand = np.repeat(bent(scene)[None], worlds, axis=0)
    stand[at["drop, straight legs"]] = bent(scene, 0.3)
    stand[at["slope"]] = bent(scene, lean=tilt)
    stand[at["one leg"]] = on_one_leg(scene)
    q = stand.copy()
    stand[at["one leg"]] = upheld(scene, q[at["one leg"]], values["joint_target_ke"][at["one leg"]])
    for name in ("drop", "drop, straight legs"):
        q[at[name], 2] += 0.3
    dyn = spo.Dynamics(scene, worlds, dtype="float64", variable=names)
    dyn.set(**values)
    settled = record(dyn, q, np.zeros((worlds, 35)), 5e-3, 30.0, lambda t: stand)["q"][-1]
    q[at["one leg"]] = settled[at["one leg"]]  # a sole tilts slowly until it carries the robot
    return dyn, q, stand, values["body_mass"].sum(axis=1)


def g1_lines(field: spo.HeightField | None = None) -> Iterator[Line]:
    """Yield G1's figures; on a height field those of standing and marching alone."""
    scene = g1() if field is None else g1().with_contacts(g1().contacts, field)
    dyn, q, stand, masses = g1_worlds(scene)
    if field is not None:
        q = stand = np.stack([touch_down(scene, one, SOLE) for one in stand])
    march, weights = MOTIONS.index("march"), 9.81 * masses
    up = np.where(np.array(MOTIONS) == "slope", np.cos(np.radians(20.0)), 1.0)
    effort = scene.values["joint_effort_limit"][0, 6:].min()

    def target(t: float) -> np.ndarray:
        wanted = stand.copy()
        wanted[march] = march_target(scene, stand[march], t)
        return wanted

    def push(t: float) -> np.ndarray:
        force = np.zeros((len(MOTIONS), len(scene.bodies), 6))
        if 1.0 <= t + 1e-9 < 1.1:
            force[MOTIONS.index("push forward"), 0, 0] = 40.0
            force[MOTIONS.index("push sideways"), 0, 1] = 120.0
        return force

    runs = {dt: record(dyn, q, np.zeros((len(q), 35)), dt, 4.0, target, push) for dt in (FINE, *STEPS)}
    ground = "" if field is None else ", height field of 2 cm"
    for world, motion in enumerate(MOTIONS):
        if field is not None and motion not in ("stand", "march"):
            continue
        name = f"G1 {motion}{ground}"
        standing = runs[FINE]["q"][-1, world, 2] > 0.6
        yield Line(name, "reference falls", FINE, float(not standing), None if motion[:4] == "drop" else 0.0)
        for dt in STEPS:
            found, seconds = runs[dt], round(1.0 / CONTROL)
            last = found["f"][-1, world].sum(axis=0)[2]
            steady = {"position": rms(found, runs[FINE], world), "height": rms(found, runs[FINE], world, 2)}
            if motion in ("stand", "slope", "one leg", "trunk x10", "light foot"):
                steady["weight"] = abs(last / weights[world] / up[world] - 1.0)
                ends = found["f"][-seconds:, world].sum(axis=1)[:, 2]
                steady["jitter"] = max(np.ptp(ends[-10:]), found["jitter"][-1, world]) / weights[world]
                steady["creep"] = 1e3 * found["slip"][world, :SOLE].max()
            steady["cone"] = found["excess"][:, world, 0].max() / weights[world]
            steady["adhesion"] = found["excess"][:, world, 1].max() / weights[world]
            steady["effort p95"] = 1e2 * np.percentile(found["excess"][:, world, 2], 95) / effort
            for figure, value in steady.items():
                asked = ASKED.get((figure, motion, dt), ASKED.get((figure, motion)))
                asked = 1.0 if figure == "effort p95" else asked
                if field is not None and figure in ("position", "creep"):
                    asked = 2.0 if figure == "position" else None
                yield Line(name, f"{figure} [{UNITS[figure]}]", dt, float(value), asked)


UNITS = {"position": "mm", "height": "mm", "weight": "of m g", "jitter": "m g", "creep": "mm/s", "cone": "m g",
         "adhesion": "m g", "effort p95": "%"}  # fmt: skip


# -- Go2 ---------------------------------------------------------------------------------------------------------------
def trot_target(scene: spo.Scene, stand: np.ndarray, t: float) -> np.ndarray:
    """Return q whose diagonal feet lift in turn, twice a second."""
    q, phase = stand.copy(), 2.0 * t
    for leg, offset in (("FL", 0.0), ("RR", 0.0), ("FR", 0.5), ("RL", 0.5)):
        lift = max(0.0, np.sin(2.0 * np.pi * (phase + offset)))
        q[entry(scene, f"{leg}_thigh")] += 0.25 * lift + 0.1 * np.cos(2.0 * np.pi * (phase + offset))
        q[entry(scene, f"{leg}_calf")] -= 0.5 * lift
    return q


def go2_lines() -> Iterator[Line]:
    """Yield Go2's figures: standing on flat and tilted ground, a trot in an open loop, a landing at 3 m/s."""
    motions, scene = ("stand", "slope", "trot", "landing"), scenes.scene("go2")
    stand = scene.neutral_q.copy()
    stand[7:] = scenes.GO2_STAND
    stand = np.repeat(touch_down(scene, stand, 4)[None], 4, axis=0)
    tilt, weight = np.radians(20.0), 9.81 * scene.values["body_mass"].sum()
    gravity = np.repeat(scene.values["gravity"][:1], 4, axis=0)
    gravity[1] = 9.81 * np.array([np.sin(tilt), 0.0, -np.cos(tilt)])
    dyn = spo.Dynamics(scene, 4, dtype="float64", variable=("gravity",))
    dyn.set(gravity=gravity)
    qd = np.zeros((4, 18))
    qd[3, 0], qd[3, 2] = 0.5, -3.0

    def target(t: float) -> np.ndarray:
        wanted = stand.copy()
        wanted[2] = trot_target(scene, stand[2], t)
        return wanted

    runs = {dt: record(dyn, stand, qd, dt, 3.0, target) for dt in (FINE, *STEPS)}
    for dt in STEPS:
        found = runs[dt]
        for world, (motion, creep) in enumerate((("stand", 0.3), ("slope", 1.0))):
            yield Line(f"Go2 {motion}", "creep [mm/s]", dt, 1e3 * float(found["slip"][world, :4].max()), creep)
            last = found["f"][-1, world].sum(axis=0)[2] / weight / (np.cos(tilt) if world else 1.0)
            yield Line(f"Go2 {motion}", "weight [of m g]", dt, abs(float(last) - 1.0))
        for world, asked in ((2, 1.5), (3, 13.0)):
            bound = asked if dt == 5e-3 else None
            yield Line(f"Go2 {motions[world]}", "height [mm]", dt, rms(found, runs[FINE], world, 2), bound)
            cone = float(found["excess"][:, world, 0].max()) / weight
            yield Line(f"Go2 {motions[world]}", "cone [m g]", dt, cone, 0.1 if world == 3 else None)


def field_lines() -> Iterator[Line]:
    yield from g1_lines(spo.terrain.rough((8.0, 8.0), 0.2, 0.02, seed=3))


LINES: dict[str, Callable[[], Iterator[Line]]] = {"g1": g1_lines, "field": field_lines, "go2": go2_lines}


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("contact.motions", __doc__, device=False)
    every = LINES | {name: (lambda f=f: (Line(*row) for row in f())) for name, f in courses().items()}
    parser.add_argument("names", nargs="*", help=f"among {', '.join(every)}; all if there are none")
    options = parser.parse_args(arguments)
    unknown = [name for name in options.names if name not in every]
    if unknown:
        parser.error(f"there is no motion {', '.join(unknown)}; expected some of {', '.join(every)}")
    rows = []
    for name in options.names or every:
        began = time.perf_counter()
        for line in every[name]():
            rows.append(line)
            print(line, flush=True)
        print(f"-- {name}: {time.perf_counter() - began:.0f} s", flush=True)
        if options.json:
            options.json.write_text(json.dumps([row._asdict() | {"holds": row.holds} for row in rows], indent=1) + "\n")
    missed = [row for row in rows if row.holds is False]
    print(f"{sum(row.asked is not None for row in rows)} figures were asked for, {len(missed)} were missed")
    return 0


if __name__ == "__main__":
    sys.exit(main())
