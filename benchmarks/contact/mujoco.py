"""G1 on the ground beside MuJoCo: standing with the same stiffness, and error against run time when it is pushed.

    python -m benchmarks.contact.mujoco [--json FILE] [--picture FILE.svg]

Both have the same bodies, drives and four spheres of 1 cm at each sole. MuJoCo takes elliptic cones, impratio 10,
position servos and the integrator "implicitfast". "Mapped": solref = -(k, d) (1 - imp) A for a contact's stiffness k
and damping d, with A = body_invweight0 and imp = 0.9, which gives the same depth at rest. "Default": MuJoCo's own
solref and solimp.
"""

from __future__ import annotations

import json
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

import warp_spo as spo
from warp_spo.viewing import charts

from .. import command_line
from ..table import robots
from .motions import BENT
from .scenes import SOLE

KP, KD, RADIUS, IMP = 500.0, 15.0, 0.01, 0.9
FEET = ("left_ankle_roll_link", "right_ankle_roll_link")
PUSH, BEGIN, END, SECONDS = 40.0, 0.3, 0.4, 1.5  # [N], [s]
STEPS = (5e-4, 1e-3, 2e-3, 5e-3, 1e-2)
WORLDS = 64  # of ours in one call, to measure the time of one


def models() -> tuple[Any, spo.Scene]:
    """Return G1 as MuJoCo's model and as our scene, on a plane."""
    import mujoco

    text = robots.urdf_text("g1")
    name = text.split('<robot name="')[1].split('"')[0]
    more = '<mujoco><compiler fusestatic="false" boundmass="0" boundinertia="0"/></mujoco><link name="world"/>'
    more += '<joint name="root" type="floating"><parent link="world"/><child link="pelvis"/></joint>'
    spec = mujoco.MjSpec.from_string(text.replace(f'<robot name="{name}">', f'<robot name="{name}">{more}', 1))
    kinds, friction = mujoco.mjtGeom, [0.8, 0, 0]
    spec.worldbody.add_geom(type=kinds.mjGEOM_PLANE, size=[5, 5, 1], friction=friction, condim=3, priority=1)
    for foot in FEET:
        for x, y, z in SOLE:
            spec.body(foot).add_geom(type=kinds.mjGEOM_SPHERE, size=[RADIUS, 0, 0], pos=[x, y, z + RADIUS], condim=3,
                                     friction=friction, mass=0.0, conaffinity=0)  # fmt: skip
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_HINGE:
            joint.armature = 0.01
            actuator = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            actuator.set_to_position(kp=KP, kv=KD)
    spec.option.cone, spec.option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 10.0
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model = spec.compile()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        scene = spo.from_mujoco(model)
    bodies = [next(i for i, label in enumerate(scene.body_labels) if label.endswith(foot)) for foot in FEET]
    contacts = [spo.Contact(body, sphere=((x, y, z + RADIUS), RADIUS)) for body in bodies for x, y, z in SOLE]
    return model, scene.with_contacts(contacts, spo.Plane())


def map_stiffness(model: Any, scene: spo.Scene) -> None:
    """Give the feet's contacts the stiffness and damping of the scene's."""
    import mujoco

    k, d = scene.values["contact_stiffness"][0, 0], scene.values["contact_damping"][0, 0]
    foot = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, FEET[0])
    scale = (1.0 - IMP) * model.body_invweight0[foot, 0]
    model.geom_solref[:], model.geom_solimp[:] = (-k * scale, -d * scale), (IMP, IMP, 1e-3, 0.5, 2.0)


def stand(model: Any, scene: spo.Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return q with bent knees, the soles at height zero, and controls of the actuators."""
    q = scene.neutral_q.copy()
    names = [label.split("/")[-1] for label in scene.joint_labels]
    for side in ("left", "right"):
        for part, angle in BENT.items():
            joint = next(i for i, label in enumerate(names) if label.startswith(f"{side}_{part}"))
            q[scene.q_start[joint]] = angle
    at = spo.Dynamics(scene, 1, dtype="float64")
    gap = np.zeros((1, len(scene.contact_points)))
    at.step(q[None], np.zeros((1, scene.dof_count)), None, 1e-4, report=spo.StepReport(contact_gap=gap))
    q[2] -= gap.min()
    ctrl = np.array([q[scene.q_start[actuator.hinges[0]]] for actuator in scene.actuators])
    return q, ctrl


def ours(scene: spo.Scene, q0: np.ndarray, ctrl: np.ndarray, dt: float, passes: int = 3, push: float = PUSH,
         worlds: int = 1, seconds: float = SECONDS) -> dict[str, Any]:  # fmt: skip
    """Return base positions and centres of pressure every 10 ms, and the time of a second of one world [s]."""
    dyn = spo.Dynamics(scene, worlds, dtype="float64")
    q, qd, controls = np.tile(q0, (worlds, 1)), np.zeros((worlds, scene.dof_count)), np.tile(ctrl, (worlds, 1))
    force, every = np.zeros((worlds, len(scene.contact_points), 3)), round(1e-2 / dt)
    body_f = np.zeros((worlds, len(scene.bodies), 6))
    base = next(i for i, label in enumerate(scene.body_labels) if label.endswith("pelvis"))
    at = np.array([point.position for point in scene.contact_points])
    places, pressures, spent = [], [], 0.0
    more: dict[str, Any] = dict(options=spo.StepOptions(passes=passes), report=spo.StepReport(contact_f=force))
    dyn.step(q, qd, None, dt, ctrl=controls, body_f=body_f, **more)
    for period in range(round(seconds / 1e-2)):
        body_f[:, base, 0] = push * (BEGIN - 1e-9 <= period * 1e-2 < END - 1e-9)
        began = time.perf_counter()
        for _ in range(every):
            before = q
            q, qd = dyn.step(q, qd, None, dt, ctrl=controls, body_f=body_f, **more)
        spent += time.perf_counter() - began
        places.append(q[0, :3].copy())
        poses = dyn.body_poses(before)[0]
        x = np.array([_place(poses[point.body], p) for point, p in zip(scene.contact_points, at, strict=True)])
        weights = force[0, :, 2]
        pressures.append((weights @ x[:, :2]) / max(weights.sum(), 1e-9))
    return {"base": np.array(places), "cop": np.array(pressures), "seconds": spent / seconds / worlds}


def _place(pose: np.ndarray, point: np.ndarray) -> np.ndarray:
    across = np.cross(pose[3:6], point)
    return pose[:3] + point + 2.0 * (pose[6] * across + np.cross(pose[3:6], across))


def theirs(model: Any, scene: spo.Scene, q0: np.ndarray, ctrl: np.ndarray, dt: float, push: float = PUSH,
           seconds: float = SECONDS) -> dict[str, Any]:  # fmt: skip
    """The same of MuJoCo on one core."""
    import mujoco

    model.opt.timestep, data = dt, mujoco.MjData(model)
    coordinates = spo.mujoco.Coordinates(scene, model, 1, "cpu", "float64")
    data.qpos[:], data.ctrl[:] = coordinates.qpos(q0[None])[0], ctrl
    base = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "pelvis")
    every, places, pressures, spent, wrench = round(1e-2 / dt), [], [], 0.0, np.zeros(6)
    for period in range(round(seconds / 1e-2)):
        data.xfrc_applied[base, 0] = push * (BEGIN - 1e-9 <= period * 1e-2 < END - 1e-9)
        began = time.perf_counter()
        mujoco.mj_step(model, data, every)
        spent += time.perf_counter() - began
        places.append(coordinates.q(data.qpos[None].copy())[0, :3].copy())
        moment, total = np.zeros(2), 0.0
        for i in range(data.ncon):
            mujoco.mj_contactForce(model, data, i, wrench)
            moment, total = moment + wrench[0] * data.contact[i].pos[:2], total + wrench[0]
        pressures.append(moment / max(total, 1e-9))
    return {"base": np.array(places), "cop": np.array(pressures), "seconds": spent / seconds}


def rms(found: dict, wanted: dict, name: str) -> float:
    """Return how far two runs are apart [mm], root mean square over time."""
    return 1e3 * float(np.sqrt(((found[name] - wanted[name]) ** 2).sum(axis=1).mean()))


def measure() -> dict[str, Any]:
    """Return the differences in standing, and rows of the push: method, dt, error [mm], seconds a simulated second."""
    model, scene = models()
    q, ctrl = stand(model, scene)
    default, rows = model.__copy__(), []
    map_stiffness(model, scene)
    rest = dict(push=0.0, seconds=4.0)
    still = ours(scene, q, ctrl, 2e-4, **rest), theirs(model, scene, q, ctrl, 2e-4, **rest)
    found: dict[str, Any] = {"standing": {}, "pushed": {}}
    for name, key in (("position", "base"), ("centre of pressure", "cop")):
        found["standing"][f"{name} [mm]"] = rms(*still, key)
        found["standing"][f"{name}, last [mm]"] = 1e3 * float(np.linalg.norm(still[0][key][-1] - still[1][key][-1]))
    fine = {"ours": ours(scene, q, ctrl, 1e-4), "mapped": theirs(model, scene, q, ctrl, 1e-4),
            "default": theirs(default, scene, q, ctrl, 1e-4)}  # fmt: skip
    for name in ("mapped", "default"):
        found["pushed"][f"{name} at 0.1 ms beside ours [mm]"] = rms(fine[name], fine["ours"], "base")
    print(found, flush=True)

    def keep(method: str, dt: float, run: dict, wanted: str) -> None:
        rows.append({"method": method, "dt": dt, "error": rms(run, fine[wanted], "base"), "seconds": run["seconds"]})
        print(rows[-1], flush=True)

    for dt in STEPS:
        for passes in (1, 2, 3, 4):
            keep(f"warp_spo, {passes} passes", dt, ours(scene, q, ctrl, dt, passes, worlds=WORLDS), "ours")
        for name, one in (("mapped", model), ("default", default)):
            keep(f"MuJoCo C, {name}", dt, theirs(one, scene, q, ctrl, dt), name)
    return found | {"rows": rows}


def draw(found: dict[str, Any], path: Path) -> None:
    """Draw error against run time, a line for each method."""
    pyplot = charts.load_pyplot("--picture")
    rows = [row for row in found["rows"] if row["method"] not in ("warp_spo, 1 passes", "warp_spo, 4 passes")]
    with charts.style():
        figure, axes = pyplot.subplots(figsize=(7.2, 4.2))
        charts.log_axis(axes.xaxis, [1e6 * row["seconds"] for row in rows], charts.time_text)
        charts.log_axis(axes.yaxis, [row["error"] for row in rows], charts.power_text)
        points = []
        for method in dict.fromkeys(row["method"] for row in rows):
            line = [row for row in rows if row["method"] == method]
            peer = None if method.startswith("warp_spo") else "MuJoCo C"
            hue = charts.OURS_DARK if method == "warp_spo, 2 passes" else charts.color(peer)
            x, y = [1e6 * row["seconds"] for row in line], [row["error"] for row in line]
            dashes = "--" if method.endswith("default") else "-"
            axes.plot(x, y, dashes, color=hue, marker="o", markersize=4, label=method)
            names = [f"{1e3 * row['dt']:g} ms" for row in line]
            points += [charts.ChartPoint(*place, hue) for place in zip(x, y, names, strict=True)]
        axes.set(xlabel="run time of a simulated second of one robot, one CPU core", ylabel="error of the base [mm]")
        axes.set_title("G1 pushed by 4 N s: error against its own run at 0.1 ms")
        axes.legend(loc="upper right")
        figure.tight_layout()
        figure.canvas.draw()
        charts.label_points(axes, points, 7.5)
    path.write_text(charts.svg(figure))
    pyplot.close(figure)


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("contact.mujoco", __doc__, device=False)
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--draw", type=Path, metavar="FILE.json", help="draw results that were measured before")
    options = parser.parse_args(arguments)
    found = json.loads(options.draw.read_text()) if options.draw else measure()
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n")
    if options.picture:
        draw(found, options.picture)
    return 0


if __name__ == "__main__":
    sys.exit(main())
