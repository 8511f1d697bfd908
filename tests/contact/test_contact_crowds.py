"""Points of one link that cost a look where none of them can touch: every bit is as if all were computed always."""

import re

import numpy as np
import pytest

import warp_spo as spo
from support import symbolic
from support.contact_cases import box, quadruped
from support.step_calls import bundled
from warp_spo.kernels import native
from warp_spo.recursions.contact import contact_culling
from warp_spo.recursions.model import shared_constants
from warp_spo.scene.contact_shapes import CORNERS

SKIP = re.compile(r"if \(\w+ != 0\) \{")
REPORTS = {"contact_f": 3, "contact_gap": 1, "contact_slip": 1}


def shins():
    """The quadruped with blocks on thighs and shins, eight points each, and on its trunk."""
    scene = quadruped()
    blocks = [
        spo.Contact(b, hull=CORNERS * (0.02, 0.03, 0.1) - (0, 0, 0.11))
        for leg in range(4)
        for b in (3 * leg + 2, 3 * leg + 3)
    ]
    trunk = spo.Contact(0, hull=CORNERS * scene.contacts[-1].shape.half)
    return spo.Scene(scene.bodies, scene.hinges, contacts=[*blocks, trunk])


def thrown(scene, worlds, seed=0):
    """States from deep in the ground to far above it, some fast: lying, landing, flying, spinning."""
    rng = np.random.default_rng(seed)
    q = np.tile(scene.neutral_q, (worlds, 1))
    q[:, 2] = rng.uniform(-0.1, 0.6, worlds)
    turn = rng.normal(size=(worlds, 4))
    q[:, 3:7] = turn / np.linalg.norm(turn, axis=1)[:, None]
    q[:, 7:] = rng.uniform(-1.0, 1.0, (worlds, q.shape[1] - 7))
    qd = rng.normal(size=(worlds, scene.dof_count)) * 10.0 ** rng.uniform(-2.0, 1.0, (worlds, 1))
    qd[:, 3:6] *= 10.0 ** rng.uniform(-1.0, 1.0, (worlds, 1))
    return q, qd


def run(monkeypatch, device, scene, always, dtype, steps, worlds=256):
    """Return states and reports after each of some steps; ``always``: code computes all points in every pass."""
    with monkeypatch.context() as patch:
        if always:
            kernel = native.kernel
            text = lambda name, code, *more, **options: kernel(name, SKIP.sub("if (true) {", code), *more, **options)  # noqa: E731
            patch.setattr(native, "kernel", text)
        dyn = spo.Dynamics(scene, worlds, device=device, dtype=dtype)
        q, qd = (x.astype(dtype) for x in thrown(scene, worlds))
        count, found = len(scene.contact_points), []
        for _ in range(steps):
            more = {name: np.full((worlds, count, n)[: 2 + (n > 1)], np.nan, dtype) for name, n in REPORTS.items()}
            more |= {"contact_excess": np.full((worlds, 3), np.nan, dtype), "status": np.full(worlds, -1, np.int32)}
            q, qd = dyn.step(q, qd, None, 5e-3, **bundled(**more))
            found.append({"q": q.copy(), "qd": qd.copy(), **more})
    return found


def assert_same(first, second):
    for step, (one, other) in enumerate(zip(first, second, strict=True)):
        for name, array in one.items():
            np.testing.assert_array_equal(array, other[name], err_msg=f"{name} after step {step}")


def assert_no_bit_changes(monkeypatch, device, scene, dtype, steps=12):
    some, every = (run(monkeypatch, device, scene, always, dtype, steps) for always in (False, True))
    forces = np.array([one["contact_f"] for one in every])
    touched = forces.any(axis=(2, 3))
    assert 0.1 < touched.mean() < 0.9  # worlds that touch, and worlds that do not
    assert_same(some, every)


def test_a_cube_that_is_thrown(monkeypatch, device):
    scene = box().with_contacts([spo.Contact(0, hull=0.1 * CORNERS)])
    assert_no_bit_changes(monkeypatch, device, scene, "float32")


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_robot_that_is_thrown(monkeypatch, device, dtype):
    assert_no_bit_changes(monkeypatch, device, shins(), dtype)


BUGS = {
    "turning forgotten": (contact_culling.CullGroup, "may_touch", "(v + self.reach * w)", "v"),
    "points forgotten": (
        contact_culling,
        "group_points",
        "depth for point in on_link",
        "depth for point in on_link[:1]",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("bug", BUGS)
def test_a_planted_bug_is_seen(monkeypatch, device, bug):
    """A limb that another one's landing turns reaches the ground in a later pass."""
    symbolic.plant(monkeypatch, *BUGS[bug])
    with pytest.raises(AssertionError, match="after step"):
        assert_no_bit_changes(monkeypatch, device, shins(), "float32")


def test_values_that_are_no_numbers_are_seen(device):
    """Friction that is NaN makes its world NaN, however far the ground is; neighbours keep every bit."""
    scene, worlds = box(), 4
    dyn = spo.Dynamics(scene, worlds, device=device, dtype="float32", variable=("contact_friction",))
    q = np.tile(scene.neutral_q, (worlds, 1)).astype("float32")
    q[:, 2], qd = 5.0, np.zeros((worlds, 6), "float32")
    friction, status = np.full((worlds, 4), 0.5, "float32"), np.zeros(worlds, np.int32)
    right = dyn.step(q, qd, None, 5e-3)[1]
    friction[2, 3] = np.nan
    dyn.set(contact_friction=friction)
    wrong = dyn.step(q, qd, None, 5e-3, status=status)[1]
    assert status[2] == spo.Status.NOT_FINITE and np.isnan(wrong[2]).any()
    np.testing.assert_array_equal(np.delete(wrong, 2, axis=0), np.delete(right, 2, axis=0))


def two_limbs(kind, **axes):
    """A trunk with a limb on either side, one turned about: numbers that are 0 or 1 in one differ in the other."""
    bodies, hinges = [spo.Body(3.0, inertia=0.05 * np.eye(3))], [spo.Hinge("free", -1, 0)]
    for side, turn in ((1.0, (0.0, 0.0, 0.0, 1.0)), (-1.0, (0.0, 0.0, 1.0, 0.0))):
        b = len(bodies)
        bodies += [
            spo.Body(1.0, (0.05 * side, 0.02, -0.05), 0.01 * np.eye(3)),
            spo.Body(0.5, (0, 0, -0.1), 5e-3 * np.eye(3)),
        ]
        hinges += [
            spo.Hinge(kind, 0, b, parent_pose=(0.1, 0.2 * side, 0.0, *turn), armature=0.01, damping=0.1, **axes),
            spo.Hinge("revolute", b, b + 1, axis=(0, 1, 0), parent_pose=(0, 0, -0.2, 0, 0, 0, 1), armature=0.01),
        ]
    shapes = [spo.Contact(b, box=((0.03, 0.02, 0.05), (0, 0, -0.1, 0, 0, 0, 1))) for b in (2, 4)]
    shapes += [spo.Contact(b, sphere=((0, 0, -0.1), 0.03)) for b in (1, 3)]
    return spo.Scene(bodies, hinges, contacts=[*shapes, spo.Contact(0, box=(0.1, 0.1, 0.05))])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "axes"), [("ball", {}), ("d6", dict(linear=[(1, 0, 0)], angular=[(0, 0.6, 0.8), (0, -0.8, 0.6)]))]
)
def test_limbs_of_one_make(monkeypatch, device, kind, axes):
    """Limbs whose numbers differ share a text, and take the step of the whole tree."""
    scene, found, texts = two_limbs(kind, **axes), [], []
    q, qd = thrown(scene, 16)
    q[:, 7:], q[:, 2] = np.tile(scene.neutral_q[7:], (16, 1)), q[:, 2] * 0.5
    differing = shared_constants.find_differing
    monkeypatch.setattr(shared_constants, "find_differing", lambda *given: texts.append(differing(*given)) or texts[-1])
    for granularity in ("tree", "segment"):
        dyn = spo.Dynamics(scene, 16, device=device, dtype="float64", granularity=granularity)
        force = np.zeros((16, len(scene.contact_points), 3))
        found.append((*dyn.step(q, qd, None, 5e-3, report=spo.StepReport(contact_f=force)), force))
    assert texts and any(texts[0]) and found[0][2].any()
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-10 * max(1.0, np.abs(one).max()))
