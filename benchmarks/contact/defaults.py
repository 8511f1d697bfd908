"""Contacts with their default values: bodies that rest, stand, are held, creep, and leave the ground.

    python -m benchmarks.contact.defaults [CASE...] [--dtype float32 float64] [--steps 1 2 5 10] [--mjlab FOLDER]
        [--json FILE]

A case is one of those of ``CASES``; none: all. Each figure is printed beside the one that is asked for, and the command
fails if one misses. ``mjlab`` is a folder with that package unpacked (``pip install --no-deps --target FOLDER
mjlab==1.6.0``), whose G1 has points on a line at its soles; without it that case is left out, which is printed.
"""

from __future__ import annotations

import itertools
import json
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import warp_spo as spo

from .. import command_line
from ..robots_of_others import ROBOTS, without_meshes
from . import scenes, throws
from .courses import solid

G = 9.81
TILTS = (0.01, 0.5, 0.8)  # of the tilt at which a box falls over
GRIP = 20.0  # force of each finger [N]


class Figure(NamedTuple):
    """A measured number and the most that is asked for; None: nothing is."""

    name: str
    value: float
    asked: float | None = None


def free(mass: float, *half: float) -> spo.Body:
    """Return a homogeneous box."""
    return spo.Body(mass, inertia=solid(mass, *(2.0 * x for x in half)))


def column(masses: tuple[float, ...], halves: list[tuple[float, ...]]) -> spo.Scene:
    """Return boxes, the first one on the ground, each further one on the one before it."""
    shape = [dict(body=i, box=half) for i, half in enumerate(halves)]
    contacts = [spo.Contact(**shape[0])]
    contacts += [spo.Contact(**a, other=spo.Contact(**b)) for b, a in itertools.pairwise(shape)]
    bodies = [free(mass, *half) for mass, half in zip(masses, halves, strict=True)]
    return spo.Scene(bodies, [spo.Hinge("free", -1, i) for i in range(len(masses))], contacts=contacts)


class Rollout(NamedTuple):
    """The end of a motion, and over its second half the largest change of q; the words of the last tenth."""

    q: np.ndarray
    qd: np.ndarray
    drift: np.ndarray
    words: int
    lowest: np.ndarray


def roll(dyn: spo.Dynamics, q: Any, dt: float, seconds: float, tau: Any = None, target: Any = None) -> Rollout:
    """Return what a motion from rest comes to."""
    dtype = np.dtype(dyn.dtype.__name__)
    q = np.array(q, dtype)
    tau = None if tau is None else np.tile(np.array(tau, dtype), (len(q), 1))
    qd, count, words = np.zeros((len(q), dyn.scene.dof_count), dtype), round(seconds / dt), 0
    middle = drift = lowest = None
    status = np.zeros(len(q), np.int32)
    for i in range(count):
        q, qd = dyn.step(q, qd, tau, dt, target_q=target, status=status)
        words |= int(np.bitwise_or.reduce(status)) if i >= 0.9 * count else 0
        lowest = q.copy() if lowest is None else np.minimum(lowest, q)
        if i == count // 2:
            middle, drift = q.copy(), np.zeros_like(q)
        elif middle is not None:
            drift = np.maximum(drift, np.abs(q - middle))
    return Rollout(q, qd, drift, words, lowest)


def cubes(dt: float, make: Callable) -> Iterator[Figure]:
    """Cubes of 1 g to 100 t at rest, and dropped from 0.2 m or five of their sizes."""
    for mass, half in ((1e-3, 0.005), (0.1, 0.02), (10.0, 0.1), (1e3, 0.25), (1e5, 1.0)):
        dyn = make(column((mass,), [(half,) * 3]), 2)
        fall = min(0.2, 10.0 * half)
        found = roll(dyn, [[0, 0, half + up, 0, 0, 0, 1] for up in (0.0, fall)], dt, 1.5)
        sunk = half - found.q[:, 2]
        yield Figure(f"{mass:g} kg: sink [mm]", 1e3 * np.abs(sunk).max(), 0.2)
        yield Figure(f"{mass:g} kg: sink over half its size", np.abs(sunk).max() / half, 0.02)
        yield Figure(f"{mass:g} kg: deepest of the drop over half its size", (half - found.lowest[1, 2]) / half)
        yield Figure(f"{mass:g} kg: status at rest", found.words, 0)


def five(dt: float, make: Callable) -> Iterator[Figure]:
    """Five boxes of 5 kg, each shifted by 5 mm and turned by 0.05 rad: 5 s."""
    dyn = make(column((5.0,) * 5, [(0.1,) * 3] * 5), 1)
    q = [[0.005 * i, 0, 0.1 + 0.2 * i, 0, 0, np.sin(0.025 * i), np.cos(0.025 * i)] for i in range(5)]
    found = roll(dyn, np.reshape(q, (1, -1)), dt, 5.0)
    yield Figure("top sinks [mm]", 1e3 * (0.9 - found.q[0, 30]), 1.0)
    yield Figure("drift in the last 2.5 s [mm]", 1e3 * found.drift.reshape(5, 7)[:, :3].max(), 0.05)
    yield Figure("status", found.words, 0)


def thin(dt: float, make: Callable) -> Iterator[Figure]:
    """Boxes on their narrow face, tilted by shares of the tilt at which they fall."""
    for half in ((0.006, 0.03, 0.04), (0.004, 0.03, 0.035)):
        dyn, tilts = make(column((0.2,), [half]), len(TILTS)), np.arctan2(half[0], half[2]) * np.array(TILTS)
        q = np.zeros((len(TILTS), 7))
        q[:, 2] = half[2] * np.cos(tilts) + half[0] * np.sin(tilts)
        q[:, 4], q[:, 6] = np.sin(tilts / 2.0), np.cos(tilts / 2.0)
        found, name = roll(dyn, q, dt, 5.0), f"{2e3 * half[0]:.0f} mm wide"
        yield Figure(f"{name}: tilt at the end [rad]", 2.0 * np.abs(found.q[:, 3:6]).max(), 0.01)
        yield Figure(f"{name}: drift in the last 2.5 s [mm]", 1e3 * found.drift[:, :3].max(), 0.05)


def loads(dt: float, make: Callable) -> Iterator[Figure]:
    """A load on something light."""
    for name, masses, halves in (
        ("30 kg on a plank of 1 kg", (1.0, 30.0), [(0.3, 0.1, 0.01), (0.1, 0.1, 0.1)]),
        ("1 t on 1 kg", (1.0, 1000.0), [(0.1, 0.1, 0.1), (0.25, 0.25, 0.25)]),
        ("1 kg on 1 t", (1000.0, 1.0), [(0.25, 0.25, 0.25), (0.1, 0.1, 0.1)]),
    ):
        bottom, top = (half[2] for half in halves)
        q = [[0, 0, bottom, 0, 0, 0, 1, 0, 0, 2.0 * bottom + top, 0, 0, 0, 1]]
        found = roll(make(column(masses, halves), 1), q, dt, 2.0)
        sunk = bottom - found.q[0, 2], 2.0 * bottom + top - found.q[0, 9]
        yield Figure(f"{name}: lower one sinks [mm]", 1e3 * abs(sunk[0]), 0.3)
        yield Figure(f"{name}: upper one sinks [mm]", 1e3 * abs(sunk[1]), 0.6)
        yield Figure(f"{name}: status", found.words, 0)


def gripper(mass: float, limited: bool, drives: bool) -> spo.Scene:
    """Return two fingers of 0.1 kg that slide, and a cube of 50 mm; ``limited``: their effort limit is known."""
    half, law = 0.025, dict(effort_limit=GRIP) if limited else {}
    law |= dict(target_ke=1e4, target_kd=200.0) if drives else {}
    bodies = [free(0.1, 0.01, 0.004, 0.01), free(0.1, 0.01, 0.004, 0.01), free(mass, half, half, half)]
    hinges = [spo.Hinge("prismatic", -1, i, axis=(0, way, 0), **law) for i, way in ((0, 1), (1, -1))]
    pad, cube = (0.01, 0.004, 0.01), spo.Contact(2, box=(half, half, half))
    contacts = [spo.Contact(i, box=(pad, (0, way * 0.004, 0, 0, 0, 0, 1)), other=cube) for i, way in ((0, 1), (1, -1))]
    return spo.Scene(bodies, [*hinges, spo.Hinge("free", -1, 2)], contacts=contacts)


def grips(dt: float, make: Callable) -> Iterator[Figure]:
    """Two fingers hold a cube with 20 N each: as a force, with and without an effort limit, and as drives at it."""
    half = 0.025
    for mass in (0.01, 0.05, 0.5, 2.0):
        for name, limited, drives in (
            ("force", True, False),
            ("drives", True, True),
            ("force, no limit", False, False),
        ):
            if name != "force" and mass not in (0.05, 0.5):
                continue
            dyn, tau = make(gripper(mass, limited, drives), 1), None if drives else [-GRIP, -GRIP, 0, 0, 0, 0, 0, 0]
            target = np.array([[half - 0.008] * 2 + [0.0] * 6 + [1.0]], np.dtype(dyn.dtype.__name__))
            found = roll(dyn, [[half, half, 0, 0, 0, 0, 0, 0, 1]], dt, 1.0, tau, target if drives else None)
            yield Figure(f"{mass:g} kg, {name}: pads sink [mm]", 1e3 * (half - found.q[0, :2]).max(), 0.3)
            yield Figure(f"{mass:g} kg, {name}: creep [mm/s]", 2e3 * found.drift[0, 4], 0.8)


def creep(dt: float, make: Callable) -> Iterator[Figure]:
    """A box on a slope of 20 degrees whose friction is a little more than it needs."""
    slope, ratios = np.radians(20.0), (1.01, 1.05, 1.5)
    scene = column((5.0,), [(0.1, 0.1, 0.1)]).with_values(gravity=[G * np.sin(slope), 0.0, -G * np.cos(slope)])
    friction = np.array(ratios)[:, None] * np.tan(slope) * np.ones((1, scene.contact_count))
    found = roll(make(scene.with_values(contact_friction=friction), 3), [[0, 0, 0.1, 0, 0, 0, 1]] * 3, dt, 2.0)
    for ratio, speed, asked in zip(ratios, np.linalg.norm(found.qd[:, :2], axis=1), (0.8, 0.5, 0.1), strict=True):
        yield Figure(f"friction {ratio:g} times what it needs: creep [mm/s]", 1e3 * speed, asked)


def deep(dt: float, make: Callable) -> Iterator[Figure]:
    """G1 in its neutral pose, its feet 0.7 m below ground: until it is out."""
    dyn, scene = make(driven := scenes.scene("g1"), 1), driven
    dtype, status = np.dtype(dyn.dtype.__name__), np.zeros(1, np.int32)
    q, qd = scene.neutral_q.astype(dtype)[None], np.zeros((1, scene.dof_count), dtype)
    gap, spins, rises, flagged = dyn.step_report("contact_gap", like=q), [], [], []
    for _ in range(round(1.2 / dt)):
        q, qd = dyn.step(q, qd, None, dt, status=status, report=gap)
        if gap.contact_gap.min() < -0.02:
            spins.append(np.abs(qd[0, 6:]).max())
            rises.append(qd[0, 2])
            flagged.append(int(status[0]) == int(spo.Status.CONTACT))
    yield Figure("fastest joint [rad/s]", max(spins), 50.0)
    yield Figure("fastest base upward [m/s]", max(rises), 1.1)
    yield Figure("steps deeper than 20 mm without a status", flagged.count(False), 0)
    yield Figure("not finite", float(not np.isfinite(q).all()), 0)


def limp(scene: spo.Scene) -> spo.Scene:
    """Return a robot without drives, friction, damping and armature."""
    names = ("target_ke", "target_kd", "armature", "damping", "friction")
    return scene.with_values(**{f"joint_{name}": np.zeros(scene.dof_count) for name in names})


def throw(scene: spo.Scene, dt: float, worlds: int, name: str, lost: float | None) -> Iterator[Figure]:
    """Throw a robot for a second, in float32, see :mod:`.throws`."""
    before, throws.DT = throws.DT, dt
    found = throws.throw(scene, worlds, 3, "cpu", 0)
    throws.DT = before
    yield Figure(f"{name}: worlds lost of {worlds}", found["not finite"], lost)
    yield Figure(f"{name}: lost without a status", found["not finite without status"], 0)
    yield Figure(f"{name}: CONTACT, of 1000 steps", 1e3 * found["steps with status CONTACT"] / found["steps"])
    for bound in throws.BOUNDS:
        yield Figure(
            f"{name}: rises > {bound:g} E0, of 1000 steps", 1e3 * found[f"steps above {bound:g} E0"] / found["steps"]
        )
    yield Figure(f"{name}: worst rise [E0]", found["worst rise"])


def throws_of_g1(dt: float, make: Callable) -> Iterator[Figure]:
    """G1 with 18 points, limp and with drives."""
    driven = scenes.scene("g1")
    zero = np.zeros(driven.dof_count)
    yield from throw(driven.with_values(joint_target_ke=zero, joint_target_kd=zero), dt, 64, "limp", 0)
    yield from throw(driven, dt, 64, "drives", 0)


def throws_of_mjlab(dt: float, make: Callable, folder: Path | None = None) -> Iterator[Figure]:
    """mjlab's G1 with all its shapes, without armature and damping, thrown for a second."""
    if folder is None:
        print("mjlab: left out, no --mjlab")
        return
    with tempfile.TemporaryDirectory() as place, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        own = Path(place) / "g1.xml"
        own.write_text(without_meshes(folder / ROBOTS["G1"]).text)
        robot = spo.load(own, contacts="ground", ground=spo.Plane())
    yield from throw(limp(robot), dt, 16, "limp", 0)


CASES: dict[str, Callable] = {
    "cubes": cubes, "five": five, "thin": thin, "loads": loads, "grips": grips, "creep": creep, "deep": deep,
    "g1": throws_of_g1, "mjlab": throws_of_mjlab,
}  # fmt: skip
SINGLE = ("g1", "mjlab")  # cases in float32 alone


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("contact.defaults", __doc__, device=False)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"of {', '.join(CASES)}")
    parser.add_argument("--dtype", nargs="+", default=["float32"], choices=["float32", "float64"])
    parser.add_argument("--steps", nargs="+", type=float, default=[1.0, 2.0, 5.0, 10.0], help="lengths [ms]")
    parser.add_argument("--mjlab", type=Path, help="a folder with the unpacked package mjlab")
    options = parser.parse_args(arguments)
    rows, missed = [], 0
    for name in options.cases or CASES:
        for dtype in options.dtype if name not in SINGLE else ["float32"]:
            made: dict[tuple, spo.Dynamics] = {}

            def make(scene: spo.Scene, worlds: int, dtype: str = dtype, made: dict = made) -> spo.Dynamics:
                key = tuple(array.tobytes() for array in scene.values.values()), worlds
                return made.setdefault(key, spo.Dynamics(scene, worlds, device="cpu", dtype=dtype))

            more = {"folder": options.mjlab} if name == "mjlab" else {}
            for step in options.steps:
                for figure in CASES[name](1e-3 * step, make, **more):
                    miss = figure.asked is not None and not figure.value <= figure.asked
                    missed += miss
                    rows.append(dict(case=name, dtype=dtype, dt=step, missed=miss, **figure._asdict()))
                    asked = "" if figure.asked is None else f"  asked {figure.asked:g}{', MISSED' if miss else ''}"
                    print(f"{name:6} {dtype} {step:4g} ms  {figure.name}: {figure.value:.3g}{asked}", flush=True)
                    if options.json:
                        options.json.write_text(json.dumps(rows, indent=1) + "\n")
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
