"""Simulate released robots that move freely under gravity, and report divergence and energy errors.

    python -m benchmarks.stability so100 z1 --seconds 10 --peers

Each robot starts at random joint positions between its limits. A fixed robot starts at rest, a floating one with moving
joints. Limits, damping and friction are those of the robot's file, or Newton's defaults. The energy is the sum, in
float64, of kinetic energy, gravity, springs, and the springs of exceeded limits. The largest rise of the energy above
its start is reported as a share of the energy that has been exchanged between motion and height.

Without friction and without limits of position and velocity, the first half second is also compared with MuJoCo at a
step of 0.1 ms, which then has the same equations. The semi-implicit step is MuJoCo's own scheme. At 2 ms both therefore
have the same error of first order, and differ from each other by rounding. Where that error exceeds a percent, only a
step of higher order is more accurate.
"""

from __future__ import annotations

import argparse
import tempfile
import time
import warnings
import xml.etree.ElementTree as ET
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import warp as wp

import warp_spo as spo

from .table.robots import INSTALLED, PACKAGE, remove_shapes

STEPS = (2e-3, 5e-3)  # [s]
FINE, COMPARED = 1e-4, 0.5  # MuJoCo's step, and the simulated time that is compared with it [s]
SPAN = 0.5  # a joint starts in the middle of its range, within this share of it
FREE_RANGE = 0.5  # a joint without limits starts within this distance of zero [rad, m]
GIVE_UP = 20.0  # wall time after which a slow solver is stopped [s]


class Robot(NamedTuple):
    path: str
    floating: bool = False


ROBOTS = {
    "so100": Robot("so_arm_description/urdf/so100.urdf"),
    "so101": Robot("so_arm_description/urdf/so101.urdf"),
    "z1": Robot("z1_description/urdf/z1.urdf"),
    "panda": Robot("panda_description/urdf/panda.urdf"),
    "ur5": Robot("ur_description/urdf/ur5_robot.urdf"),
    "g1": Robot("g1_description/urdf/g1_29dof_rev_1_0.urdf", True),
    "talos": Robot("talos_data/robots/talos_full_v2.urdf", True),
    "go2": Robot("go2_description/urdf/go2.urdf", True),
    "anymal": Robot("anymal_c_simple_description/urdf/anymal.urdf", True),
}


def strip_urdf(text: str) -> str:
    """Return a URDF without shapes, with mimic joints fixed at zero; damping and friction stay."""
    root = ET.fromstring(text)
    remove_shapes(root)
    for joint in root.findall("joint"):
        for mimic in joint.findall("mimic"):
            joint.remove(mimic)
            joint.set("type", "fixed")
    return ET.tostring(root, encoding="unicode") + "\n"


def model(name: str) -> Any:
    """Return a robot as Newton's model of one world on the CPU."""
    import newton

    robot = ROBOTS[name]
    source = Path(str(metadata.distribution(PACKAGE).locate_file(f"{INSTALLED}/{robot.path}")))
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        file = Path(folder) / f"{name}.urdf"
        file.write_text(strip_urdf(source.read_text()))
        builder = newton.ModelBuilder()
        builder.add_urdf(str(file), floating=robot.floating)
        return builder.finalize(device="cpu")


def start(scene: spo.Scene, seed: int = 0) -> np.ndarray:
    """Return random coordinates [coordinate] inside the limits, with a floating base at the origin."""
    rng, q = np.random.default_rng(seed), scene.neutral_q
    lower, upper = scene.values["joint_limit_lower"][0], scene.values["joint_limit_upper"][0]
    for hinge, first, dof in zip(scene.hinges, scene.q_start, scene.qd_start, strict=False):
        for i in range(hinge.dof_count if hinge.coord_count == hinge.dof_count else 0):
            low, high = lower[dof + i], upper[dof + i]
            if high - low > 2.0 * np.pi:
                low, high = -FREE_RANGE, FREE_RANGE
            q[first + i] = 0.5 * (low + high) + SPAN * (high - low) * (rng.random() - 0.5)
    return q


def start_rates(scene: spo.Scene, seed: int = 0) -> np.ndarray:
    """Return velocities [dof]: zero for a fixed base, else N(0, 1) for the joints and zero for the floating base."""
    qd = np.random.default_rng(seed).normal(size=scene.dof_count)
    qd[:6] = 0.0
    return qd if scene.hinges[0].kind == "free" else 0.0 * qd


def energies(scene: spo.Scene, q: np.ndarray, qd: np.ndarray, limits: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Return the kinetic energy with armature, and the energy of gravity, springs and exceeded limits [n] [J].

    Args:
        scene: the robot.
        q, qd: n states.
        limits: whether the solver's limits are springs; SolverSteel's are not.
    """
    dyn = spo.Dynamics(scene, len(q), "cpu", "float64")
    values = {name: array[0] for name, array in scene.values.items()}
    kinetic, potential = dyn.kinetic_energy(q, qd), dyn.potential_energy(q)
    screws = [(c + i, d + i) for h, c, d in zip(scene.hinges, scene.q_start, scene.qd_start, strict=False)
              if h.coord_count == h.dof_count for i in range(h.dof_count)]  # fmt: skip
    for coordinate, dof in screws:
        at = q[:, coordinate]
        outside = np.maximum(values["joint_limit_lower"][dof] - at, 0.0)
        outside = outside + np.maximum(at - values["joint_limit_upper"][dof], 0.0)
        potential += 0.5 * limits * values["joint_limit_ke"][dof] * outside**2
    return kinetic, potential


def excess(kinetic: np.ndarray, potential: np.ndarray) -> float:
    """Return the largest rise of the energy above its start, over the sum of changes of kinetic energy until then."""
    turned = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(kinetic)))])
    rise = kinetic + potential - (kinetic + potential)[0]
    return max(0.0, float((rise[1:] / np.maximum(turned[1:], 1e-12)).max()))


class Run(NamedTuple):
    """A trajectory [step, ...], the time at which it diverged [s] or None, and whether it ran to its end."""

    q: np.ndarray
    qd: np.ndarray
    diverged: float | None
    finished: bool


def run(solver: Any, q: np.ndarray, qd: np.ndarray, dt: float, seconds: float) -> Run:
    """Simulate a model for some seconds without control forces."""
    import newton

    state = solver.model.state()
    state.joint_q.assign(q.astype(np.float32))
    state.joint_qd.assign(qd.astype(np.float32))
    newton.eval_fk(solver.model, state.joint_q, state.joint_qd, state)
    other, control, began = solver.model.state(), solver.model.control(), time.perf_counter()
    qs, qds = [state.joint_q.numpy().copy()], [state.joint_qd.numpy().copy()]
    for step in range(round(seconds / dt)):
        solver.step(state, other, control, None, dt)
        state, other = other, state
        qs.append(state.joint_q.numpy().copy())
        qds.append(state.joint_qd.numpy().copy())
        if not np.isfinite(qds[-1]).all() or np.abs(qds[-1]).max() > 1e6:
            return Run(np.array(qs), np.array(qds), (step + 1) * dt, True)
        if time.perf_counter() - began > GIVE_UP:
            return Run(np.array(qs), np.array(qds), None, False)
    return Run(np.array(qs), np.array(qds), None, True)


def mujoco_errors(scene: spo.Scene, q: np.ndarray, qd: np.ndarray) -> dict[tuple[str, float], float]:
    """Return distances between q's after COMPARED seconds without limits and friction, over the distance travelled.

    Returns:
        (name, dt) -> distance from MuJoCo at the step FINE, of "MuJoCo" and of our "semi_implicit" and "midpoint" in
        float64. ("apart", dt) is the distance of the semi-implicit step from MuJoCo at the same dt.
    """
    import mujoco

    from .peers.lumped import lump
    from .peers.mujoco_model import model as mujoco_model

    dofs = scene.dof_count
    free = scene.with_values(joint_limit_lower=np.full(dofs, -1e10), joint_limit_upper=np.full(dofs, 1e10),
                             joint_velocity_limit=np.full(dofs, 1e6), joint_friction=np.zeros(dofs))  # fmt: skip
    robot = lump(free)
    theirs = mujoco_model(robot)
    theirs.dof_damping[:] = free.values["joint_damping"][0][robot.dofs]
    theirs.dof_armature[:] = free.values["joint_armature"][0][robot.dofs]
    order = np.array(robot.coords)
    if robot.floating:
        order[3:7] = order[[6, 3, 4, 5]]  # wxyz

    def mujoco_after(dt: float) -> np.ndarray:
        theirs.opt.timestep, data = dt, mujoco.MjData(theirs)
        data.qpos[:], data.qvel[:] = q[order], qd[robot.dofs]
        for _ in range(round(COMPARED / dt)):
            mujoco.mj_step(theirs, data)
        return data.qpos.copy()

    dyn = spo.Dynamics(free, 1, "cpu", "float64")

    def after(dt: float, integrator: str) -> np.ndarray:
        ours, rate = (wp.array(x[None], dtype=wp.float64, device="cpu") for x in (q, qd))
        for _ in range(round(COMPARED / dt)):
            dyn.step(ours, rate, None, dt, options=spo.StepOptions(integrator=integrator), out=(ours, rate))
        return ours.numpy()[0][order]

    wanted = mujoco_after(FINE)

    def distance(mine: np.ndarray, other: np.ndarray = wanted) -> float:
        if robot.floating and mine[3:7] @ other[3:7] < 0.0:
            other = np.concatenate([other[:3], -other[3:7], other[7:]])
        return float(np.linalg.norm(mine - other) / np.linalg.norm(wanted - q[order]))

    errors = {("MuJoCo", 0.5 * FINE): distance(mujoco_after(0.5 * FINE))}
    for dt in (FINE, 0.5 * STEPS[0], *STEPS):
        peer, ours = mujoco_after(dt), after(dt, "semi_implicit")
        errors |= {("MuJoCo", dt): distance(peer), ("semi_implicit", dt): distance(ours)}
        errors["apart", dt] = distance(ours, peer)
        if dt in STEPS:
            errors["midpoint", dt] = distance(after(dt, "midpoint"))
    return errors


def observed_order(errors: dict[tuple[str, float], float]) -> float:
    """Return the power of dt with which the semi-implicit step's distance from MuJoCo at FINE decreases."""
    dt = STEPS[0]
    return float(np.log2(errors["semi_implicit", dt] / errors["semi_implicit", 0.5 * dt]))


def row(name: str, seconds: float, peers: bool) -> dict[str, str]:
    """Return a line of the table: head -> text."""
    from newton.solvers import SolverFeatherstone, SolverSteel

    from warp_spo.newton import SolverSPO, from_newton

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        robot = model(name)
        scene = from_newton(robot)
        q, qd = start(scene), start_rates(scene)
        cells = {"robot": f"{name} ({scene.dof_count})"}
        solver = SolverSPO(robot)
        for dt in STEPS:
            done = run(solver, q, qd, dt, seconds)
            if done.diverged is None:
                cells[f"{dt * 1e3:g} ms"] = f"{100 * excess(*energies(scene, done.q, done.qd)):.2f} %"
            else:
                cells[f"{dt * 1e3:g} ms"] = f"NaN at {done.diverged:.3g} s"
        errors = mujoco_errors(scene, q, qd)
        percent = {way: f"{100 * error:.2g} %" for way, error in errors.items()}
        cells["MuJoCo at half its step"] = percent["MuJoCo", 0.5 * FINE]
        cells["ours at its step"] = percent["semi_implicit", FINE]
        for dt in STEPS:
            who = " / ".join(percent[way, dt] for way in ("MuJoCo", "semi_implicit", "midpoint"))
            cells[f"from MuJoCo, {dt * 1e3:g} ms: itself / ours / midpoint"] = who
        cells[f"ours from MuJoCo, both at {STEPS[0] * 1e3:g} ms"] = percent["apart", STEPS[0]]
        cells["order"] = f"{observed_order(errors):.2f}"
        for other in (SolverFeatherstone, SolverSteel) if peers else ():
            for dt in STEPS:
                peer = other(robot)
                done = run(peer, q, qd, dt, seconds)
                said = "finite" if done.finished else f"finite, stopped at {len(done.q) * dt:.2g} s"
                if done.diverged is not None:
                    said = f"diverges at {done.diverged:.3g} s"
                elif done.finished:
                    said = f"{100 * excess(*energies(scene, done.q, done.qd, other is SolverFeatherstone)):.3g} %"
                cells[f"{other.__name__.removeprefix('Solver')}, {dt * 1e3:g} ms"] = said
    return cells


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("robots", nargs="*", default=list(ROBOTS), help=f"some of {', '.join(ROBOTS)}")
    parser.add_argument("--seconds", type=float, default=10.0, help="simulated time")
    parser.add_argument("--peers", action="store_true", help="SolverFeatherstone and SolverSteel beside it")
    options = parser.parse_args()
    header: list[str] = []
    for name in options.robots or ROBOTS:
        cells = row(name, options.seconds, options.peers)
        if not header:
            header = list(cells)
            print("| " + " | ".join(header) + " |\n|" + "---|" * len(header), flush=True)
        print("| " + " | ".join(cells.values()) + " |", flush=True)


if __name__ == "__main__":
    main()
