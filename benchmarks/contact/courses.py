"""Courses for the table of :mod:`.motions`: inclines, stairs, landings, and Newton's ant and humanoid.

Energy is kinetic, that of gravity, of the drives up to their effort limits, of position limits, and k p^2 / 2 of
contacts. Each course yields (motion, figure, dt, measured, asked).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator

import numpy as np

import warp_spo as spo
from warp_spo.reference.contact import ContactStep

from . import scenes

STEPS = (2e-3, 5e-3, 1e-2)
Row = tuple[str, str, float | None, float, float | None]


def solid(mass: float, x: float, y: float, z: float) -> np.ndarray:
    """Return the inertia of a box of these sizes [m]."""
    return np.diag([y * y + z * z, x * x + z * z, x * x + y * y]) * mass / 12.0


def free_body(contact: list[spo.Contact], ground: object = None, mass: float = 5.0) -> spo.Scene:
    """Return a body of 0.2 m with some contacts."""
    body = spo.Body(mass, inertia=solid(mass, 0.2, 0.2, 0.2))
    return spo.Scene([body], [spo.Hinge("free", -1, 0)], contacts=contact, ground=ground)


def springs(scene: spo.Scene, q: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the energy of drives, whose force ends at the effort limit, and of position limits [world]."""
    value = {name: scene.values[f"joint_{name}"][0, 6:] for name in
             ("target_ke", "effort_limit", "limit_lower", "limit_upper", "limit_ke")}  # fmt: skip
    ke, effort = value["target_ke"], value["effort_limit"]
    error = np.abs(q[:, 7:] - target[:, 7:])
    ends = np.divide(effort, ke, out=np.full(len(ke), 1e6), where=ke > 0.0)
    drives = np.where(error <= ends, 0.5 * ke * error**2, effort * error - 0.5 * effort * np.minimum(ends, 1e6))
    over = np.maximum(0.0, np.maximum(value["limit_lower"] - q[:, 7:], q[:, 7:] - value["limit_upper"]))
    return drives.sum(axis=1) + 0.5 * (np.minimum(value["limit_ke"], 1e10) * over**2).sum(axis=1)


def run(
    dyn: spo.Dynamics,
    q: np.ndarray,
    qd: np.ndarray,
    dt: float,
    seconds: float,
    k: np.ndarray | None = None,
    passes: int | None = None,
) -> dict:
    """Return energies [step, world] and gaps before each step, and the last state; drives hold the first q."""
    worlds, points, scene = len(q), len(dyn.scene.contact_points), dyn.scene
    gap, target = np.zeros((worlds, points)), q.copy()
    k = scene.values["contact_stiffness"] if k is None else k
    energies, gaps = [], []
    options, report = spo.StepOptions(passes=passes), spo.StepReport(contact_gap=gap)
    for _ in range(round(seconds / dt)):
        after = dyn.step(q, qd, None, dt, target_q=target, options=options, report=report)
        energy = dyn.kinetic_energy(q, qd) + dyn.potential_energy(q)
        energy = energy + 0.5 * (k * np.maximum(-gap, 0.0) ** 2).sum(axis=1)
        energies.append(energy + (springs(scene, q, target) if scene.dof_count > 6 else 0.0))
        gaps.append(gap.copy())
        q, qd = after
    return {"energy": np.array(energies), "gap": np.array(gaps), "q": q, "qd": qd}


def incline() -> Iterator[Row]:
    """A cube that slides down 30 degrees, friction 0.5, and one that sticks at 20 degrees, friction 0.8."""
    for dt in STEPS:
        for degrees, friction in ((30.0, 0.5), (20.0, 0.8)):
            angle = np.radians(degrees)
            scene = free_body([spo.Contact(0, box=(0.1, 0.1, 0.1), friction=friction)])
            scene = scene.with_values(gravity=9.81 * np.array([np.sin(angle), 0.0, -np.cos(angle)]))
            dyn, qd = spo.Dynamics(scene, 1, dtype="float64"), np.zeros((1, 6))
            q, speeds = np.array([[0.0, 0.0, 0.0999, 0.0, 0.0, 0.0, 1.0]]), []
            for _ in range(round(1.0 / dt)):
                q, qd = dyn.step(q, qd, None, dt)
                speeds.append(qd[0, 0])
            if degrees == 30.0:
                wanted = 9.81 * (np.sin(angle) - friction * np.cos(angle))
                found = (speeds[-1] - speeds[len(speeds) // 2]) / dt / (len(speeds) - 1 - len(speeds) // 2)
                yield "box, 30 degrees", "acceleration, relative", dt, abs(found / wanted - 1.0), 1e-3
            else:
                yield "box, 20 degrees", "creep [mm/s]", dt, 1e3 * abs(speeds[-1]), 0.52


def risers(cell: float, corner: str = "") -> spo.HeightField:
    """Return a step of 0.1 m at x = 0; ``corner``: "inner" where two risers close in on x, y < 0, "outer" a block."""
    x = np.arange(-1.0, 1.0 + 0.5 * cell, cell)
    high = np.broadcast_to((x > -0.5 * cell)[:, None], (len(x), len(x)))
    if corner:
        high = high | high.T if corner == "inner" else high & high.T
    return spo.HeightField(0.1 * high, cell, (-1.0, -1.0))


def throw(field: spo.HeightField, q: np.ndarray, qd: np.ndarray, dt: float, seconds: float, **contact: object) -> dict:
    ball = free_body([spo.Contact(0, sphere=0.03, stiffness=2e4, damping=100.0, friction=0.6, **contact)], field, 1.0)
    return run(spo.Dynamics(ball, len(q), dtype="float64"), q, qd, dt, seconds)


def stairs() -> Iterator[Row]:
    """Feet and boxes at a riser of 10 cm, cells of 2 and 5 cm, 5 ms."""
    dt, upright = 5e-3, [0.0, 0.0, 0.0, 1.0]
    for cell in (0.02, 0.05):
        name, field = f"riser, cells of {100 * cell:g} cm", risers(cell)
        heights = np.linspace(0.035, 0.125, 10)
        q = np.array([[-0.1 - cell, 0.3, z, *upright] for z in heights])
        qd = np.array([[0.7, 0.05, -0.3, 0.0, 0.0, 0.0]] * len(q))
        found = throw(field, q, qd, dt, 1.0)
        yield name, "feet swing in: rise [J]", dt, float(np.diff(found["energy"], axis=0).max()), 0.1
        q = np.array([[-0.1 - cell - x, 0.3, 0.0295, *upright] for x in np.linspace(0.0, 7.5e-3, 10)])
        found = throw(field, q, np.array([[1.5, 0.0, 0.0, 0.0, 0.0, 0.0]] * len(q)), dt, 0.5)
        yield name, "feet slide in: rise [J]", dt, float(np.diff(found["energy"], axis=0).max()), 0.1
        stiff = spo.Contact(0, box=(0.1, 0.1, 0.1), friction=0.1, stiffness=1e5)  # 1.5 sqrt(m / k) in a wall of 2 cm
        corners = free_body([stiff], field)
        q = np.array(
            [[-0.3, y, 0.0995, 0.0, 0.0, np.sin(0.5 * a), np.cos(0.5 * a)] for a in (0, 0.2, 0.7) for y in (0.0, 0.03)]
        )
        qd = np.array([[1.5, 0.0, 0.0, 0.0, 0.0, 0.0]] * len(q))
        found = run(spo.Dynamics(corners, len(q), dtype="float64"), q, qd, dt, 1.0)
        yield name, "box slides in: rise [J]", dt, float(np.diff(found["energy"], axis=0).max()), 0.1
        yield name, "box slides in: depth, deepest [mm]", dt, -1e3 * float(found["gap"].min()), None
        q = np.array([[-0.3, 0.0, 0.1 + 0.03 + 0.012 + 9.81 * 0.02, *upright]])
        flying = throw(field, q, np.array([[1.5, 0.0, 0.0, 0.0, 0.0, 0.0]]), dt, 0.2)
        yield name, "flight 12 mm over: loss of speed [m/s]", dt, 1.5 - float(flying["qd"][0, 0]), 1e-9
        legs = [spo.Contact(0, point=(x, y, -0.1 if x > 0 else -0.2)) for x in (-0.15, 0.15) for y in (-0.1, 0.1)]
        across = free_body(legs, field)
        found = run(
            spo.Dynamics(across, 1, dtype="float64"),
            np.array([[0.0, 0.0, 0.1995, *upright]]),
            np.zeros((1, 6)),
            dt,
            2.0,
        )
        yield name, "stands across: speed after 2 s [m/s]", dt, float(np.abs(found["qd"]).max()), 1e-3
        yield name, "stands across: rise [J]", dt, float(np.diff(found["energy"], axis=0).max()), 1e-4
        for corner in ("inner", "outer"):
            q = np.array([[-0.2, -0.2 + s, z, *upright] for s in (0.0, 0.01, 0.05, 0.1) for z in (0.029, 0.06, 0.1)])
            qd = np.array([[1.06, 1.06, 0.0, 0.0, 0.0, 0.0]] * len(q))
            found = throw(risers(cell, corner), q, qd, dt, 1.0)
            title = f"{corner} corner, cells of {100 * cell:g} cm"
            yield title, "feet slide in: rise [J]", dt, float(np.diff(found["energy"], axis=0).max()), None
            yield title, "depth, deepest [mm]", dt, -1e3 * float(found["gap"].min()), None


def landings() -> Iterator[Row]:
    """Go2 at 1.5 m/s, stiffness 1e4 to 1e7, friction 0 to 1.5, the trunk's mass times 1 to 100."""
    bare = scenes.scene("go2")
    base = next(i for i, label in enumerate(bare.body_labels) if label.endswith("base"))
    for trunk in (1.0, 10.0, 100.0):
        heavier = np.where(np.arange(len(bare.bodies)) == base, trunk, 1.0)
        scene = bare.with_values(body_mass=bare.values["body_mass"] * heavier,
                                 body_inertia=bare.values["body_inertia"] * heavier[:, None, None])  # fmt: skip
        points = len(scene.contact_points)
        k = np.repeat(np.logspace(4, 7, 6), 11)[:, None] * np.ones((1, points))
        mu = np.tile(np.linspace(0.0, 1.5, 11), 6)[:, None] * np.ones((1, points))
        damping = 0.5 * np.sqrt(k * scene.values["body_mass"].sum() / 4.0)
        q, qd = np.repeat(scene.neutral_q[None], 66, axis=0), np.zeros((66, 18))
        q[:, 7:] = scenes.GO2_STAND
        q[:, 2] += ContactStep(scene, q[0], np.zeros(18), 5e-3).points.depth.max()
        qd[:, 0], qd[:, 2] = 0.5, -1.5
        dyn = spo.Dynamics(
            scene, 66, dtype="float64", variable=("contact_stiffness", "contact_friction", "contact_damping")
        )
        dyn.set(contact_stiffness=k, contact_friction=mu, contact_damping=damping)
        for dt, passes in itertools.product(STEPS, (3, 4)):
            found = run(dyn, q, qd, dt, 1.0, k, passes)
            rises = np.diff(found["energy"], axis=0) / found["energy"][0]
            name = f"66 landings of Go2, trunk x{trunk:g}" + (", four passes" if passes == 4 else "")
            yield name, "steps that gain 1e-5 E0", dt, float((rises > 1e-5).sum()), 0.0
            yield name, "largest rise [E0]", dt, float(rises.max()), 1e-5
            yield name, "worlds not finite", dt, float((~np.isfinite(found["qd"])).any(axis=1).sum()), 0.0


def models() -> Iterator[Row]:
    """Newton's ant and humanoid, whose drives are off, dropped in ten attitudes."""
    from warp_spo.newton import shipped

    for name in ("ant", "humanoid"):
        scene = spo.load(shipped(name), contacts="ground")
        n, rng = scene.dof_count, np.random.default_rng(0)
        q, qd = np.repeat(scene.neutral_q[None], 10, axis=0), rng.normal(size=(10, n))
        turns = np.concatenate([0.5 * rng.normal(size=(10, 3)), np.ones((10, 1))], axis=1)
        q[:, 3:7] = turns / np.linalg.norm(turns, axis=1)[:, None]
        q[:, 2] = 1.5
        off = scene.with_values(joint_target_ke=np.zeros(n), joint_target_kd=np.zeros(n))
        dyn = spo.Dynamics(off, 10, dtype="float64")
        for dt in (2e-4, *STEPS):
            found = run(dyn, q, qd, dt, 1.5)
            rises = np.diff(found["energy"], axis=0) / found["energy"][0]
            yield f"Newton's {name} dropped", "largest rise [E0]", dt, float(rises.max()), 1e-5
            yield (
                f"Newton's {name} dropped",
                "worlds not finite",
                dt,
                float((~np.isfinite(found["qd"])).any(axis=1).sum()),
                0.0,
            )


def courses() -> dict[str, Callable[[], Iterator[Row]]]:
    """Return the courses by name."""
    return {"incline": incline, "stairs": stairs, "landings": landings, "models": models}
