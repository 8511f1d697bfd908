"""Shapes on points and lines of a field's grid: beside dense sampling, the dense step, differences."""

import numpy as np
import pytest

import warp_spo as spo
from benchmarks.contact import shapes, uneven
from support import contact_gradients
from support.contact_cases import box
from support.contact_steps import FIELDS, H, assert_is_dense
from warp_spo.reference.contact import ContactStep
from warp_spo.reference.rotations import rotation

POSE = (0.02, -0.03, 0.01, 0.02, 0.05, 0.1, np.sqrt(1.0 - 0.0129))
CLOUD = np.array([[x, y, z] for x in (-0.16, 0.16) for y in (-0.1, 0.1) for z in (-0.03, 0.02)])
CLOUD = np.concatenate([CLOUD, [[0.2, 0.0, -0.02], [-0.2, 0.01, 0.0], [0.02, 0.0, 0.05]]])
CONTACTS = {
    "box": dict(box=((0.16, 0.1, 0.03), POSE)),
    "capsule": dict(capsule=((-0.2, 0.0, 0.0), (0.2, 0.05, 0.01), 0.05)),
    "hull": dict(hull=CLOUD),
    "disc": dict(cylinder=((0.0, 0.01, -0.03), (0.02, 0.0, 0.03), 0.15)),
    "roller": dict(cylinder=((-0.2, 0.0, 0.0), (0.2, 0.05, 0.01), 0.05)),
}


def scene_of(*kinds, ground="rough", **values):
    contacts = [spo.Contact(0, friction=0.3, **CONTACTS[kind], **values) for kind in kinds]
    return box().with_contacts(contacts, FIELDS[ground])


def leaning(scene, seed, worlds):
    """States of a body that leans little, whose deepest point is a row of the grid, in the field or just above."""
    rng, found = np.random.default_rng(seed), []
    grid = np.array([point.meets_grid for point in scene.contact_points])
    while len(found) < worlds:
        q, qd = np.array([0.0, 0.0, 1.0, *(0.1 * rng.normal(size=3)), 1.0]), rng.normal(size=6)
        q[:2], q[3:] = rng.uniform(-0.4, 0.4, 2), q[3:] / np.linalg.norm(q[3:])
        at = ContactStep(scene, q, qd, H)
        q[2] += at.points.depth.max() + rng.uniform(-0.01, 2e-3)
        at = ContactStep(scene, q, qd, H)
        if grid[at.numbers[at.points.depth.argmax()]]:
            found.append((q, qd))
    return {
        name: np.float64(np.float32(rows))
        for name, rows in zip(("q", "qd"), map(np.array, zip(*found, strict=True)), strict=True)
    }


QUICK = ("box", "capsule")


def places():
    """Yield a case of each shape on each field."""
    for kind in uneven.SHAPES:
        for name in shapes.fields():
            yield pytest.param(kind, name, marks=[pytest.mark.slow] * (kind not in QUICK))


@pytest.mark.parametrize(("kind", "name"), places())
def test_none_is_missed(kind, name):
    """True depths of 0.5 to 3 mm, within 1 mm but for one of eight, which is above the share of 5 per cent."""
    field, width = shapes.fields()[name]
    poses, depths = uneven.placed(field, width, uneven.SHAPES[kind], uneven.LEAN, 8, seed=1)
    scene = box().with_contacts([spo.Contact(0, **uneven.SHAPES[kind].contact)], field)
    found = np.array([ContactStep(scene, pose, np.zeros(6), 1e-3).points.depth.max() for pose in poses])
    assert (found[depths >= uneven.SEEN] > 0.0).all()
    assert (abs(found - depths) > uneven.CLOSE).sum() <= 1, (found, depths)


def test_a_tip_under_a_face_that_looks_aside():
    """The outer corner of a stair 2.3 mm inside of a box, whose face there leads 62 degrees away from down."""
    field, _ = shapes.fields()["outer corner of 10 cm"]
    turn = np.array([0.18927052, 0.47894735, 0.4993311, 0.69674569])
    pose = np.r_[0.02396194, -0.02592651, 0.10580132, turn / np.linalg.norm(turn)]
    q = rotation(pose[3:]).T @ (np.array([0.0, 0.0, 0.1]) - pose[:3])
    true = uneven.SHAPES["box"].inside(q[None]).max()
    scene = box().with_contacts([spo.Contact(0, **uneven.SHAPES["box"].contact)], field)
    assert abs(true - 2.3e-3) < 1e-4
    assert abs(ContactStep(scene, pose, np.zeros(6), 1e-3).points.depth.max() - true) < 1e-9
    assert abs(uneven.found_depths(field, uneven.SHAPES["box"], pose[None])[0] - true) < 1e-9


@pytest.mark.parametrize("kind", CONTACTS)
@pytest.mark.parametrize("ground", FIELDS)
def test_the_recursion_is_the_dense_step(kind, ground):
    scene = scene_of(kind, ground=ground)
    assert_is_dense(scene, leaning(scene, 2, 4), 3)


@pytest.mark.parametrize("kinds", [("box",), pytest.param(tuple(CONTACTS), marks=pytest.mark.slow)])
def test_the_kernel_is_the_dense_step(kinds, device):
    """Native searches find what those of the specification do; all shapes on one body, too."""
    scene = scene_of(*kinds, ground="rough" if len(kinds) == 1 else "stairs")
    a = leaning(scene, 3, 24)
    dyn = spo.Dynamics(scene, worlds=24, dtype="float64", device=device)
    found = dyn.step(a["q"], a["qd"], dt=H)[1]
    for q, qd, rates in zip(a["q"], a["qd"], found, strict=True):
        wanted = ContactStep(scene, q, qd, H).run()[1].v
        np.testing.assert_allclose(rates, wanted, atol=1e-9 * np.abs(wanted).max())


@pytest.mark.parametrize("kind", CONTACTS)
def test_gradients_are_differences(kind):
    """By state and heights, where what is found stays."""
    scene = scene_of(kind)
    a = contact_gradients.furnish(scene, leaning(scene, 4, 2))
    for argument, (error, crossed) in contact_gradients.errors(scene, a, H, 3, names=("q", "ground_heights")).items():
        assert error <= 1e-8 and crossed <= 0.3, (argument, error, crossed)


def test_rows_and_values():
    """A box has four rows of its own and then one a quadrant, a capsule two and one a half; values are a plane's."""
    scene = scene_of("box", "capsule")
    assert [point.meets_grid for point in scene.contact_points] == [*[False] * 4, *[True] * 4, *[False] * 2, True, True]
    flat = scene.with_contacts(scene.contacts, spo.Plane())
    assert np.ptp(scene.values["contact_stiffness"]) == 0.0
    assert scene.values["contact_stiffness"][0, 0] == flat.values["contact_stiffness"][0, 0]
    assert not any(point.walls for point in scene.contact_points if point.meets_grid)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_foot_on_a_stair_stays_flat(dtype):
    """Three quarters of it on the tread; with corners alone it pitched by 26 degrees."""
    start = [0.05 - uneven.HALF[0], 0.013, uneven.HALF[2], 0.0, 0.0, 0.0, 1.0]
    pose = uneven.resting(uneven.stair(), start, 5e-3, dtype, box=uneven.HALF)
    assert uneven.pitch(pose) < 0.05 and abs(pose[2] - uneven.HALF[2]) < 2e-4


@pytest.mark.parametrize("kind", ["box", "capsule"])
def test_what_lies_across_a_ridge_rests_on_it(kind):
    contact, low = (dict(box=(0.2, 0.05, 0.03)), 0.03) if kind == "box" else (uneven.SHAPES[kind].contact, 0.04)
    start = [0.0, 0.011, 0.1 + low, 0.0, 0.0, np.sin(0.15), np.cos(0.15)]
    pose = uneven.resting(uneven.ridge(), start, 5e-3, "float64", 1.0, **contact)
    assert 0.0 < 0.1 + low - pose[2] < 3e-4


@pytest.mark.parametrize(
    ("name", "pose"),
    [
        ("V of 40 degrees", (-0.0056, 0.0941, 0.1076, -0.0866, -0.0829, -0.8333, 0.5397)),
        ("roof of 40 degrees", (0.0678, -0.1237, 0.0362, 0.009, 0.0029, -0.8489, 0.5284)),
    ],
)
def test_rims_of_a_roller_touch(name, pose):
    """In a fold by the wall that is not under its middle, on a ridge across the end; each was missed by some mm."""
    roller, field = uneven.SHAPES["roller"], shapes.fields()[name][0]
    pose = np.array(pose)
    pose[3:] /= np.linalg.norm(pose[3:])
    scene = box().with_contacts([spo.Contact(0, **roller.contact)], field)
    found = ContactStep(scene, pose, np.zeros(6), 1e-3).points.depth.max()
    depth = uneven.true_depth(field, roller, rotation(pose[3:]), pose[:3])
    assert depth > uneven.SEEN and abs(found - depth) < uneven.CLOSE, (found, depth)
