"""Steps with contacts: the comparison with the dense step, height fields, and states of bodies on them."""

import numpy as np

import warp_spo as spo
from warp_spo.reference.contact import MIDPOINT_PASSES, ContactStep

from . import symbolic

H = 5e-3
PARABOLA = 2e-5  # of gaps [m] that a parabola finds from half way; 1.0e-5 measured, along 28 rad/s


def by_point(at, forces):
    """Return force and gap of each point: of a wall and a floor the sum, and the nearer one."""
    count = len(at.scene.contact_points)
    force, gap = np.zeros((count, 3)), np.full(count, np.inf)
    np.add.at(force, at.numbers, forces)
    np.minimum.at(gap, at.numbers, -at.points.depth)
    return force, gap


def with_turning(scene, seed=0, torsional=0.02, rolling=0.01):
    """The scene with torsional and rolling friction, of each point another one, and one point without any."""
    rng, count = np.random.default_rng(seed), len(scene.contact_points)
    both = {"torsional": torsional * rng.uniform(0.5, 2.0, count), "rolling": rolling * rng.uniform(0.5, 2.0, count)}
    for values in both.values():
        values[-1] = 0.0
    return scene.with_values(**{f"contact_{name}_friction": values for name, values in both.items()})


def assert_is_dense(scene, a, passes):
    """The recursion, evaluated without compiling, is the dense step in every world."""
    compute = symbolic.contact_step if passes < MIDPOINT_PASSES else symbolic.midpoint_contact_step
    found = compute(scene, a, H, passes)
    for w in range(len(a["q"])):
        given = {name: a[name][w] for name in a}
        at = ContactStep(scene, given["q"], given["qd"], H, given.get("target_q"), given.get("target_qd"))
        q, wanted = at.run(given.get("tau"), given.get("body_f"), passes)
        np.testing.assert_allclose(found["out"][w], wanted.v, atol=1e-10 * np.abs(wanted.v).max())
        np.testing.assert_allclose(found["q_out"][w], q, atol=1e-10)
        force, gap = by_point(at, wanted.f)
        np.testing.assert_allclose(found["contact_f"][w], force, atol=1e-10 * max(1.0, np.abs(wanted.f).max()))
        moment, _ = by_point(at, wanted.moment)
        np.testing.assert_allclose(found["contact_moment"][w], moment, atol=1e-10 * max(1.0, np.abs(wanted.f).max()))
        np.testing.assert_allclose(found["contact_gap"][w], gap, atol=1e-12 if passes < MIDPOINT_PASSES else PARABOLA)
        np.testing.assert_allclose(found["contact_excess"][w], wanted.excess, atol=1e-9 * np.abs(wanted.f).max() + 1e-9)


def steps(cell=0.05):
    """Risers of 10 cm every quarter of a metre along x, which climb to y."""
    rise = 0.1 * np.floor(np.arange(30) * cell / 0.25)
    return spo.HeightField(rise[:, None] + 0.02 * np.arange(20)[None, :] * cell, cell, (-0.7, -0.5, 0.02))


FIELDS = {
    "rough": spo.HeightField(0.01 * np.random.default_rng(0).normal(size=(30, 20)), 0.1, (-1.5, -1.0)),
    "stairs": steps(),
}


def above(scene, seed, worlds):
    """Return states of a body whose lowest point is just above or in a field, beyond its edge in the last world."""
    rng = np.random.default_rng(seed)
    q, qd = np.zeros((worlds, 7)), rng.normal(size=(worlds, 6))
    turns = np.concatenate([0.5 * rng.normal(size=(worlds, 3)), np.ones((worlds, 1))], axis=1)
    q[:, 3:] = turns / np.linalg.norm(turns, axis=1)[:, None]
    q[:, :2] = rng.uniform(-0.4, 0.4, (worlds, 2))
    q[-1, :2] = 5.0
    for world in range(worlds):
        q[world, 2] = 1.0
        depth = ContactStep(scene, q[world], qd[world], H).points.depth.max()
        q[world, 2] += depth + rng.uniform(-0.02, 5e-3)
    return {"q": np.float64(np.float32(q)), "qd": np.float64(np.float32(qd))}
