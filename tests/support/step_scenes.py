"""Scenes with every law that a step knows, and sliders that each law alone moves."""

import numpy as np

import warp_spo as spo
from warp_spo.scene.parts import SCREWS

from . import laws, symbolic

H = 2e-3
TOLERANCE = {
    "float64": 1e-12,  # of velocities of the order of 1, up to 30
    "float32": 2e-5,
}
SETTLED = 3e-5  # relative, of velocities in float32: NOISE * HOLD roundings of a velocity limit, and some to spare
SMOOTH = ("damping", "stiffness", "target_ke", "target_kd", "armature")
FORCES = ("tau", "body_f", "target_q", "target_qd")


def furnished(scene, seed=0):
    """Every law somewhere, at random."""
    rng, n = np.random.default_rng(seed), scene.dof_count
    screw = np.repeat([hinge.motion == SCREWS for hinge in scene.hinges], [hinge.dof_count for hinge in scene.hinges])
    some = lambda low, high, none: np.where(rng.random(n) < 0.5, rng.uniform(low, high, n), none)  # noqa: E731
    return scene.with_values(
        joint_friction=some(0.0, 1.0, 0.0),
        joint_target_ke=some(1.0, 100.0, 0.0),
        joint_target_kd=some(0.0, 5.0, 0.0),
        joint_effort_limit=some(1.0, 20.0, 1e6),
        joint_velocity_limit=some(0.5, 1.5, 1e6),
        joint_limit_lower=np.where(screw, rng.uniform(-1.0, -0.2, n), -1e10),
        joint_limit_upper=np.where(screw, rng.uniform(0.2, 1.0, n), 1e10),
    )


def held(scene, seed=0):
    """The scene with gravity compensation of any size on every body but the first."""
    share = np.random.default_rng(seed).uniform(-0.5, 1.5, scene.body_count)
    return scene.with_values(body_gravcomp=np.where(np.arange(scene.body_count) > 0, share, 0.0))


def smooth(scene, seed=0):
    """The scene with the laws whose forces have no kink, on every dof."""
    rng, n = np.random.default_rng(seed), scene.dof_count
    return scene.with_values(**{f"joint_{name}": rng.uniform(0.5, 20.0, n) for name in SMOOTH})


def states(scene, worlds, dtype="float64"):
    a = laws.states(scene, worlds, dtype=dtype)
    a |= {"target_q": a["q"][::-1].copy(), "target_qd": a["qdd"]}
    a["qd"][1] = 0.0
    return {name: a[name] for name in ("q", "qd", *FORCES)}


def slider(**values):
    """A mass of 2 kg on rails, without gravity."""
    hinge = spo.Hinge("prismatic", -1, 0, axis=(1, 0, 0), **values)
    return spo.Scene([spo.Body(2.0, inertia=np.eye(3))], [hinge], gravity=(0, 0, 0))


def slide(scene, q, qd, tau=0.0, h=H, dtype="float64", **more):
    """q', qd' of sliders, one a world."""
    given = {"q": q, "qd": qd, "tau": tau, **more}
    arrays = {name: np.atleast_1d(x).astype(float)[:, None] for name, x in given.items()}
    worlds = max(map(len, arrays.values()))
    arrays = {name: np.broadcast_to(x, (worlds, 1)) for name, x in arrays.items()}
    q_after, qd_after, passes = symbolic.advance(scene, arrays, h, dtype)
    assert (passes <= 3).all()  # of one dof
    return q_after[:, 0], qd_after[:, 0]
