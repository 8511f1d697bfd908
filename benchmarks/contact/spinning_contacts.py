"""Torsional and rolling friction of spheres on the ground, beside closed forms and MuJoCo: slowing, standing, rolling.

    python -m benchmarks.contact.spinning_contacts --json FILE

Solid spheres of three sizes spin on a point, roll on a plane, stand on slopes below the ratio of rolling friction and
radius, roll down steeper ones, and do the same without these frictions. Values of contacts are the defaults but for
the coefficients. MuJoCo takes its defaults but for elliptic cones, and an impratio of 100. Minutes on a CPU.
"""

from __future__ import annotations

import itertools
import json
import sys
from importlib import metadata
from typing import Any, NamedTuple

import mujoco
import numpy as np

import warp_spo as spo
from warp_spo.scene.contact_values import TURNING_VALUES

from ..command_line import parser

G, DENSITY, SECONDS = 9.81, 240.0, 3.0
RADII = (0.02, 0.1, 0.5)  # [m]
STEPS = (1e-3, 2e-3, 5e-3, 1e-2)  # [s]
DTYPES = ("float32", "float64")
RATIOS = (1, 100)
SPIN, ROLL = 0.05, 0.02  # coefficients, in radii
WITHIN = 5e-3  # of a slowing or a gain, and of a rate that nothing changes; the secants of three passes, 3e-3 at 10 ms
LEFT = 1e-3  # of the first rate, after twice the time in which a sphere stops
XML = """<mujoco><option timestep="{h}" cone="elliptic" impratio="{ratio}" gravity="{gx} 0 {gz}"/><worldbody>
<geom type="plane" size="99 99 1" condim="1" friction="0.8 0 0"/>
<body pos="0 0 {r}"><freejoint/>
<geom type="sphere" size="{r}" mass="{m}" condim="6" friction="0.8 {spin} {roll}"/></body></worldbody></mujoco>"""


class Case(NamedTuple):
    """The motion of a sphere on the ground.

    Attributes:
        spin, roll: coefficients, in radii. slope: of the ground. share: of the ratio of rolling friction that the slope
            is. start: what turns before the first step: "spins", "rolls" or "rests".
    """

    name: str
    spin: float
    roll: float
    slope: float
    start: str


CASES = (
    Case("spins", SPIN, 0.0, 0.0, "spins"),
    Case("spins, no torsional friction", 0.0, ROLL, 0.0, "spins"),
    Case("rolls", 0.0, ROLL, 0.0, "rolls"),
    Case("rolls, no rolling friction", SPIN, 0.0, 0.0, "rolls"),
    Case("stands, half of the bound", 0.0, ROLL, 0.5 * ROLL, "rests"),
    Case("stands, 0.9 of the bound", 0.0, ROLL, 0.9 * ROLL, "rests"),
    Case("rolls down, 1.5 times the bound", 0.0, ROLL, 1.5 * ROLL, "rests"),
    Case("rolls down, 3 times the bound", 0.0, ROLL, 3.0 * ROLL, "rests"),
)


def mass(r: float) -> float:
    """Return the mass of a sphere of this radius [kg]."""
    return 4.0 / 3.0 * np.pi * r**3 * DENSITY


def wanted(case: Case, r: float) -> float:
    """Return the rate of change of what turns, about the normal or across it [rad/s^2], of a rigid sphere."""
    tilt = np.arctan(case.slope)
    if case.start == "spins":
        return -case.spin * r * G / (0.4 * r * r)
    down, bound = np.sin(tilt), case.roll * np.cos(tilt)
    if case.start == "rests":
        return 5.0 / 7.0 * G / r * max(0.0, down - bound)
    return -5.0 / 7.0 * G / r * bound


def rates_of(case: Case, r: float) -> np.ndarray:
    """Return qd before the first step [6], so that frictions stop a sphere after a third of the time."""
    rate = SECONDS / 3.0 * abs(wanted(CASES[0] if case.start == "spins" else CASES[2], r))
    rate = min(rate, 20.0 if case.start == "spins" else 0.5 / r)
    return np.array({
        "spins": [0, 0, 0, 0, 0, rate], "rolls": [rate * r, 0, 0, 0, rate, 0], "rests": np.zeros(6),
    }[case.start])  # fmt: skip


def turns_here(r: float, h: float, dtype: str) -> np.ndarray:
    """Return how our spheres turn after each step [step, case]."""
    m, count = mass(r), len(CASES)
    body = spo.Body(m, inertia=0.4 * m * r * r * np.eye(3))
    scene = spo.Scene([body], [spo.Hinge("free", -1, 0)], contacts=[spo.Contact(0, sphere=r)])
    dyn = spo.Dynamics(scene, count, "cpu", dtype, variable=("gravity", *TURNING_VALUES))
    tilt = np.arctan([case.slope for case in CASES])
    gravity = G * np.stack([np.sin(tilt), 0.0 * tilt, -np.cos(tilt)], axis=1)
    coefficients = [[getattr(case, name) * r for case in CASES] for name in ("spin", "roll")]
    values = dict(zip(TURNING_VALUES, np.array(coefficients, dtype)[:, :, None], strict=True))
    dyn.set(gravity=gravity.astype(dtype), **values)
    q = np.tile([0.0, 0.0, r, 0.0, 0.0, 0.0, 1.0], (count, 1))
    q[:, 2] += m * gravity[:, 2] / scene.values["contact_stiffness"][0, 0]
    q, qd = q.astype(dtype), np.array([rates_of(case, r) for case in CASES], dtype)
    status, found = np.zeros(count, np.int32), []
    for _ in range(round(SECONDS / h)):
        q, qd = dyn.step(q, qd, dt=h, status=status)
        found.append(turning(qd))
        assert not status.any(), (r, h, dtype, status)
    return np.array(found, dtype=np.float64)


def turns_in_mujoco(r: float, h: float, ratio: float) -> np.ndarray:
    """Return how MuJoCo's spheres turn after each step [step, case]."""
    found = []
    for case in CASES:
        tilt, values = np.arctan(case.slope), dict(spin=case.spin * r, roll=case.roll * r)
        model = mujoco.MjModel.from_xml_string(
            XML.format(h=h, r=r, m=mass(r), ratio=ratio, gx=G * np.sin(tilt), gz=-G * np.cos(tilt), **values)
        )
        data, rows = mujoco.MjData(model), []
        data.qvel[:] = rates_of(case, r)
        for _ in range(round(SECONDS / h)):
            mujoco.mj_step(model, data)
            rows.append(data.qvel.copy())
        found.append(turning(np.array(rows))[:, CASES.index(case)])
    return np.array(found).T


def turning(qd: np.ndarray) -> np.ndarray:
    """Return what turns about the normal or across it in each case [..., case]."""
    about = [5 if case.start == "spins" else 4 for case in CASES]
    return qd[np.arange(len(CASES)), about] if len(qd) == len(CASES) else qd[:, about]


def figures(turned: np.ndarray, r: float, h: float) -> dict[str, float]:
    """Return a figure for each case of what turned [step, case].

    The error of the slowing or the gain, over a span in which nothing stops; what is left of a rate that stops, "left";
    the share of a rate that is lost where nothing slows it; the speed at the end of a sphere that should stand [m/s].
    """
    found: dict[str, float] = {}
    for case, rates in zip(CASES, turned.T, strict=True):
        true, start = wanted(case, r), np.abs(rates_of(case, r)[3:]).max()
        if case.start == "rests" and true == 0.0:
            found[case.name] = abs(rates[-1]) * r
        elif true == 0.0:
            found[case.name] = abs(rates[-1] / start - 1.0)
        else:
            stops = abs(start / true) if case.start != "rests" else SECONDS
            first, last = round(0.2 * stops / h), round(0.7 * stops / h)
            found[case.name] = abs((rates[last] - rates[first]) / ((last - first) * h) / true - 1.0)
            if case.start != "rests":
                found[f"{case.name}, left"] = abs(rates[round(2.0 * stops / h)]) / start
    return {name: float(f"{value:.2g}") for name, value in found.items()}


def rows(radii: Any = RADII, steps: Any = STEPS, dtypes: Any = DTYPES) -> list[dict[str, Any]]:
    """Return a row for each size, step and solver."""
    found = []
    for r, h in itertools.product(radii, steps):
        for dtype in dtypes:
            row = {"radius": r, "step": h, "solver": f"here, {dtype}"}
            found.append(row | figures(turns_here(r, h, dtype), r, h))
        for ratio in RATIOS:
            row = {"radius": r, "step": h, "solver": f"MuJoCo, impratio {ratio}"}
            found.append(row | figures(turns_in_mujoco(r, h, ratio), r, h))
    return found


def fault(row: dict[str, Any]) -> str:
    """Return which figure of one of our rows is beyond what is promised, "" if none is."""
    for case in CASES:
        if case.name.startswith("stands"):
            rho = case.slope / case.roll
            length = np.sqrt(0.4) * row["radius"]
            creep = spo.Contact(0, point=(0, 0, 0)).eps / length * rho / np.sqrt(1.0 - rho**2) * row["radius"]
            if row[case.name] > 1.05 * creep:
                return case.name
        elif not row[case.name] <= WITHIN:
            return case.name
        if row.get(f"{case.name}, left", 0.0) > LEFT:
            return f"{case.name}, left"
    return ""


def main(arguments: list[str] | None = None) -> int:
    """Print the table, and write the rows if asked; return 1 if a figure of ours is beyond what is promised."""
    options = parser("contact.spinning_contacts", __doc__, device=False).parse_args(arguments)
    found = rows()
    names = [name for name in found[0] if name not in ("radius", "step", "solver")]
    print(f"| radius | step | solver | {' | '.join(names)} |\n{'|---' * (3 + len(names))}|")
    for row in found:
        print(f"| {row['radius']:g} | {row['step']:g} | {row['solver']} | {' | '.join(str(row[n]) for n in names)} |")
    if options.json:
        versions = {package: metadata.version(package) for package in ("mujoco", "warp-lang", "numpy")}
        options.json.write_text(json.dumps({"versions": versions, "rows": found}, indent=1) + "\n")
    return int(any(fault(row) for row in found if row["solver"].startswith("here")))


if __name__ == "__main__":
    sys.exit(main())
