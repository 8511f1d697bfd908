"""Limits of MJCF joints: how deep a limb rests beyond its limit here, as a share of MuJoCo's depth, for many limits.

    python -m benchmarks.joint_limits                 # a table
    python -m benchmarks.joint_limits --json FILE     # and a file of results

An arm on a hinge, or on a slide, falls onto its limit, under its own weight and under a hundredth to ten times of that,
with each ``solreflimit`` and ``solimplimit`` of ``REFERENCES`` and ``IMPEDANCES``. MuJoCo is stepped until the arm
rests, and so are we, in float64. The command fails if a depth under the arm's own weight is off by more than ``SHARE``,
or, with the default ``solimplimit``, a depth under another load by more than a factor of ``FACTOR``.
"""

from __future__ import annotations

import itertools
import json
import sys
import warnings
from importlib import metadata
from typing import Any

import mujoco
import numpy as np

import warp_spo as spo

from .command_line import parser

SHARE, FACTOR = 0.25, 2.5
DEFAULT = ".9 .95 .001 .5 2"
LOADS = (0.01, 0.1, 1.0, 10.0)  # times the weight of the arm
JOINTS = {
    "hinge": 'axis="0 1 0" pos=".02 0 .03" range="-30 40" ref="10"',
    "slide": 'type="slide" axis="0 .6 .8" range="-.1 .2"',
}
REFERENCES = {".02 1": 1e-3, ".001 1": 2.5e-4, ".05 .7": 1e-3, ".1 2": 1e-3, "-300 -20": 1e-3, "-5000 -100": 1e-3}
"""Values of ``solreflimit``, and the timestep [s]: in steps of 1 ms MuJoCo's arm on the second never rests."""
IMPEDANCES = (DEFAULT, ".99 .99 .01", ".95 .99 .001", "0 .99 .1", ".5 .9 .01 .3 4", ".95 .5 .05")
ARM = """<mujoco><option timestep="{dt}" gravity="0 0 {gravity}"/><worldbody><body euler="10 20 30"><joint {joint}
 limited="true" solreflimit="{ref}" solimplimit="{imp}" armature=".01"/>
 <geom type="capsule" size=".03" fromto=".1 .2 0 .6 .2 .1"/></body></worldbody></mujoco>"""
STEPS = 80_000  # of MuJoCo at most
AT_REST = 1e-7  # [rad/s or m/s]


def arm(joint: str, ref: str, imp: str, load: float = 1.0) -> mujoco.MjModel:
    """Return an arm whose gravity is ``load`` times 9.81 m/s^2."""
    text = ARM.format(joint=JOINTS[joint], ref=ref, imp=imp, dt=REFERENCES[ref], gravity=-9.81 * load)
    return mujoco.MjModel.from_xml_string(text)


def depth(model: mujoco.MjModel, q: Any) -> Any:
    """Return how far beyond its nearer limit a joint is [rad or m]."""
    low, high = model.jnt_range[0]
    return np.maximum(low - q, q - high)


def depth_in_mujoco(model: mujoco.MjModel) -> float:
    """Return the depth at which MuJoCo's arm rests, NaN if it does not rest."""
    data = mujoco.MjData(model)
    data.qpos[0] = model.jnt_range[0, 0]  # the limit onto which the arm falls
    for _ in range(STEPS):
        mujoco.mj_step(model, data)
        if abs(data.qvel[0]) < AT_REST and abs(data.qacc[0]) < AT_REST:
            break
    return float(depth(model, data.qpos[0])) if abs(data.qvel[0]) < 10.0 * AT_REST else float("nan")


def depths_here(joint: str, laws: list[tuple[str, str]]) -> np.ndarray:
    """Return the depths at which our arms rest, by law and load; each scene is that of the arm under its own weight."""
    models = [arm(joint, *law) for law in laws]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of the contacts of the arm
        scenes = [spo.from_mujoco(model) for model in models for _ in LOADS]
    gains = {name: np.stack([one.values[name][0] for one in scenes]) for name in ("joint_limit_ke", "joint_limit_kd")}
    gravity = np.tile([[0.0, 0.0, -9.81 * load] for load in LOADS], (len(laws), 1))
    worlds = len(scenes)
    dyn = spo.Dynamics(scenes[0].with_values(**gains, gravity=gravity), worlds, device="cpu", dtype="float64")
    q, qd = np.full((worlds, 1), models[0].jnt_range[0, 0]), np.zeros((worlds, 1))
    for _ in range(2000):
        q, qd = dyn.step(q, qd, dt=2e-2)  # implicit: soon at rest
    assert abs(qd).max() < AT_REST
    return depth(models[0], q[:, 0]).reshape(len(laws), len(LOADS))


def rows() -> list[dict[str, Any]]:
    """Return a row for each joint and law: MuJoCo's depths by load, and ours as shares of them."""
    found, laws = [], list(itertools.product(REFERENCES, IMPEDANCES))
    for joint in JOINTS:
        for (ref, imp), ours in zip(laws, depths_here(joint, laws), strict=True):
            theirs = np.array([depth_in_mujoco(arm(joint, ref, imp, load)) for load in LOADS])
            found.append({
                "joint": joint, "solreflimit": ref, "solimplimit": imp,
                "depth in MuJoCo": [float(f"{x:.4g}") for x in theirs],
                "share": [float(f"{x:.4g}") for x in ours / theirs],
            })  # fmt: skip
    return found


def fault(row: dict[str, Any]) -> str:
    """Return what is wrong with a row in words, "" if nothing is."""
    shares, own = np.array(row["share"]), LOADS.index(1.0)
    if not abs(shares[own] - 1.0) <= SHARE:
        return "its own weight"
    within = np.all((shares > 1.0 / FACTOR) & (shares < FACTOR))
    return "" if within or row["solimplimit"] != DEFAULT else "other loads"


def main(arguments: list[str] | None = None) -> int:
    """Print the table, and write the rows if asked; return 1 if a depth is too far from MuJoCo's."""
    options = parser("joint_limits", __doc__, device=False, json="a file for the rows").parse_args(arguments)
    found = rows()
    print("| joint | `solreflimit` | `solimplimit` |" + "".join(f" {load:g} |" for load in LOADS) + " |")
    print("|---" * (4 + len(LOADS)) + "|")
    for row in found:
        shares = "".join(f" {share:.2g} |" for share in row["share"])
        print(f"| {row['joint']} | `{row['solreflimit']}` | `{row['solimplimit']}` |{shares} {fault(row)} |")
    if options.json:
        versions = {package: metadata.version(package) for package in ("mujoco", "warp-lang", "numpy")}
        options.json.write_text(json.dumps({"versions": versions, "loads": LOADS, "rows": found}, indent=1) + "\n")
    return int(any(fault(row) for row in found))


if __name__ == "__main__":
    sys.exit(main())
