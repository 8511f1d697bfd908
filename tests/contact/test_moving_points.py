"""Boxes and round shapes: points that move over them, beside supports, differences, the dense step; wheels."""

import numpy as np
import pytest

import warp_spo as spo
from benchmarks.contact import shapes
from support import contact_gradients
from support.contact_cases import box
from support.contact_steps import FIELDS, H, above, assert_is_dense
from warp_spo.reference.contact import ContactStep
from warp_spo.scene.frames import pose_matrix

POSE = (0.02, -0.03, 0.01, 0.1, 0.7, 0.1, np.sqrt(0.49))
ROUND = {
    "cylinder": dict(cylinder=((0.1, 0.0, -0.05), (0.05, 0.02, 0.05), 0.06)),
    "cone": dict(cone=((0.1, 0.0, -0.05), (0.05, 0.02, 0.05), 0.06)),
    "ellipsoid": dict(ellipsoid=((0.1, 0.06, 0.03), POSE)),
}
STONE = np.random.default_rng(3).normal(size=(60, 3))
STONE = STONE / np.linalg.norm(STONE, axis=1)[:, None] * (0.1, 0.06, 0.03)  # all of them on the hull
TILTED = spo.Plane(0.1, (0.6, 0.0, 0.8))


def scene_of(kind, ground=TILTED, **values):
    return box().with_contacts([spo.Contact(0, **ROUND[kind], **values)], ground)


def samples(kind):
    """Return points all over a shape, in the body frame [point, 3]."""
    angles = np.linspace(0.0, 2.0 * np.pi, 2001)
    if kind == "ellipsoid":
        z = np.linspace(-1.0, 1.0, 401)[:, None]
        r, half = np.sqrt(1.0 - z * z), np.array(ROUND[kind]["ellipsoid"][0])
        unit = np.stack([r * np.cos(angles), r * np.sin(angles), z + 0.0 * angles], axis=-1).reshape(-1, 3)
        place = pose_matrix(np.array(POSE))
        return (half * unit) @ place[:3, :3].T + place[:3, 3]
    start, end, radius = ROUND[kind][kind]
    axis = np.subtract(end, start) / np.linalg.norm(np.subtract(end, start))
    first = np.cross(axis, [0.0, 1.0, 0.0]) / np.linalg.norm(np.cross(axis, [0.0, 1.0, 0.0]))
    ring = radius * (np.outer(np.cos(angles), first) + np.outer(np.sin(angles), np.cross(axis, first)))
    return np.concatenate([ring + start, (ring if kind == "cylinder" else 0.0 * ring) + end])


@pytest.mark.parametrize("kind", ROUND)
def test_the_lowest_point_is_that_of_the_shape(kind):
    """In 20 directions; points are on the surface. Samples of 2001 angles miss a rim's lowest point by 1e-6 of it."""
    contact, cloud = scene_of(kind).contact_points, samples(kind)
    for normal in np.random.default_rng(0).normal(size=(20, 3)):
        normal /= np.linalg.norm(normal)
        places = np.array([point.place(normal) for point in contact])
        assert abs((places @ normal).min() - (cloud @ normal).min()) < 2e-6
        assert max(np.linalg.norm(cloud - place, axis=1).min() for place in places) < 2e-3  # between samples


def test_a_box_has_the_corners_of_the_face_that_looks_down():
    """Of all eight the lowest are among them, in 50 directions; and those of one face, along the normal's largest
    part."""
    scene = box().with_contacts([spo.Contact(0, box=((0.1, 0.06, 0.03), POSE))], spo.Plane())
    corners, turn = scene.contacts[0].positions, pose_matrix(np.array(POSE))[:3, :3]
    assert len(corners) == 8 and len(scene.contact_points) == 4
    assert len(scene.with_contacts(scene.contacts, FIELDS["rough"]).contact_points) == 8  # and four on the grid
    for normal in np.random.default_rng(0).normal(size=(50, 3)):
        normal /= np.linalg.norm(normal)
        places = np.array([point.place(normal) for point in scene.contact_points])
        assert abs((places @ normal).min() - (corners @ normal).min()) < 1e-12
        along = (places - POSE[:3]) @ turn
        face = np.abs(normal @ turn).argmax()
        assert np.ptp(along[:, face]) < 1e-12 and len(np.unique(np.round(along, 9), axis=0)) == 4


def test_a_hull_has_eight_corners_at_most():
    """The lowest is the first; of those that lean by up to 2 degrees the lowest is among them; none twice."""
    scene = box().with_contacts([spo.Contact(0, hull=STONE)], TILTED)
    assert len(scene.contact_points) == 8 and len(scene.contacts[0].positions) == len(STONE)
    ways = np.array([[np.cos(a), np.sin(a), 0.0] for a in 2.0 * np.pi * np.arange(7) / 7.0])
    for normal in np.random.default_rng(0).normal(size=(50, 3)):
        normal /= np.linalg.norm(normal)
        there = [point.support.is_there(normal) for point in scene.contact_points]
        places = np.array([point.place(normal) for point in scene.contact_points])
        assert abs((places @ normal).min() - (STONE @ normal).min()) < 2e-6 and np.argmin(places @ normal) == 0
        assert len(np.unique(np.round(places[there], 9), axis=0)) == sum(there)
        across = ways - np.outer(ways @ normal, normal)
        for way in normal + 0.01 * across:
            assert (places[there] @ way).min() <= (STONE @ way).min() + 2e-3


@pytest.mark.parametrize("ground", ["plane", *FIELDS])
def test_the_recursion_of_a_hull_is_the_dense_step(ground):
    scene = box().with_contacts(
        [spo.Contact(0, hull=STONE, friction=0.4)], TILTED if ground == "plane" else FIELDS[ground]
    )
    a = above(scene, 4, 6)
    a = {name: rows[:-1] for name, rows in a.items()} if ground == "plane" else a
    assert_is_dense(scene, a, 3)


@pytest.mark.parametrize("ground", ["plane", "stairs"])
def test_the_kernel_of_a_hull_is_the_dense_step(ground, device):
    ground = TILTED if ground == "plane" else FIELDS[ground]
    scene = box().with_contacts([spo.Contact(0, hull=STONE, friction=0.4)], ground)
    a = {name: rows[:-1] for name, rows in above(scene, 5, 9).items()}
    dyn = spo.Dynamics(scene, worlds=8, dtype="float64", device=device)
    for q, qd, rates in zip(a["q"], a["qd"], dyn.step(a["q"], a["qd"], dt=H)[1], strict=True):
        wanted = ContactStep(scene, q, qd, H).run()[1].v
        np.testing.assert_allclose(rates, wanted, atol=1e-9 * np.abs(wanted).max())


@pytest.mark.parametrize("kind", ROUND)
def test_paths_bend_as_heights_do(kind):
    """Acceleration at which a point rises at rates that stay: second differences of its height."""
    scene, t = scene_of(kind), 1e-4
    for state in np.random.default_rng(1).normal(size=(6, 13)):
        q, qd = np.concatenate([state[:3], state[3:7] / np.linalg.norm(state[3:7])]), 5.0 * state[7:]
        here = ContactStep(scene, q, qd, H)
        after, before = (ContactStep(scene, here.dense.integrate(qd, step), qd, H) for step in (t, -t))
        lowest = here.points.depth.argmax()
        depths = [one.points.depth[lowest] for one in (before, here, after)]
        found = -(depths[0] - 2.0 * depths[1] + depths[2]) / t**2
        if kind == "ellipsoid":
            assert abs(found - here.points.bend[lowest]) < 1e-5 * 125.0  # of squares of rates times sizes
        else:  # a rim's point also goes round as the axis tilts, which is left out unless the axis lies or tilts alone
            assert abs(depths[2] - depths[0]) / (2.0 * t) < 30.0


def test_a_wheel_that_rolls_and_yaws_has_a_straight_path():
    """A wheel on its rims: neither its spin nor its yaw lifts its middle, and what tilts its axis does by r w^2."""
    scene = box().with_contacts([spo.Contact(0, cylinder=((0, -0.02, 0), (0, 0.02, 0), 0.1))], spo.Plane())
    q = np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0])
    for rates, bend in (((0.0, 9.0, 4.0), 0.0), ((3.0, 9.0, 0.0), 0.1 * 9.0)):
        points = ContactStep(scene, q, np.array([0.9, 0.0, 0.0, *rates]), H).points
        assert abs(points.bend[:2].mean() - bend) < 1e-12


@pytest.mark.parametrize("kind", ROUND)
@pytest.mark.parametrize("ground", ["plane", *FIELDS])
def test_the_recursion_is_the_dense_step(kind, ground):
    """With a margin as files have them."""
    scene = scene_of(kind, TILTED if ground == "plane" else FIELDS[ground], friction=0.4)
    a = above(scene, 4, 6)
    a = {name: rows[:-1] for name, rows in a.items()} if ground == "plane" else a
    for passes in (3, 4) if (kind, ground) == ("ellipsoid", "plane") else (3,):  # the midpoint's gaps of sides are not
        assert_is_dense(scene, a, passes)


@pytest.mark.parametrize("kind", ROUND)
def test_gradients_are_differences(kind):
    scene = scene_of(kind, friction=0.4)
    a = contact_gradients.furnish(scene, {name: rows[:2] for name, rows in above(scene, 4, 3).items()})
    errors = contact_gradients.errors(scene, a, H, 3, names=("q", "qd"))
    for argument, (error, crossed) in errors.items():
        assert error <= 1e-5 and crossed <= 0.2, (argument, errors)


def test_a_wheel_rolls():
    """1 m/s stays 1 m/s for a second: the issue of points on a polygon, which made it stop."""
    states = shapes.rolled_wheel(5e-3)
    assert states[-1, 7] >= 0.999 and abs(states[-1, 0] - 1.0) < 2e-3 and np.abs(states[:, 8:10]).max() < 0.05


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_hull_of_many_corners_rests_on_a_sloping_cell(dtype, device):
    """A prism of twelve corners that lies flat on slopes of 3 to 20 degrees sinks by m g cos t / (n k) at most."""
    turns, angles = np.arange(6) * np.pi / 3.0, np.radians([3.0, 10.0, 20.0])
    prism = np.array([(0.1 * np.cos(a), 0.1 * np.sin(a), z) for z in (-0.05, 0.05) for a in turns])
    x = (np.arange(9) - 4.0) * 0.3
    fields = spo.HeightField(np.stack([np.repeat((np.tan(t) * x)[:, None], 9, 1) for t in angles]), 0.3, (-1.2, -1.2))
    scene = box().with_contacts([spo.Contact(0, hull=prism, friction=1.0)], fields)
    scene = scene.with_values(ground_field=np.arange(3)[:, None])
    q = np.zeros((3, 7))
    for one, t in zip(q, angles, strict=True):
        one[:3] = np.array([0.1, 0.13, 0.1 * np.tan(t)]) + 0.0501 * np.array([-np.sin(t), 0.0, np.cos(t)])
        one[3:] = 0.0, -np.sin(0.5 * t), 0.0, np.cos(0.5 * t)
    dyn = spo.Dynamics(scene, worlds=3, dtype=dtype, device=device)
    qd = np.zeros((3, 6))
    for _ in range(60):
        q, qd = dyn.step(q, qd, dt=H)
        for one, t in zip(q, angles, strict=True):
            normal = np.array([-np.sin(t), 0.0, np.cos(t)])
            places = pose_matrix(np.float64(one))[:3, :3] @ prism.T + np.float64(one[:3])[:, None]
            assert (normal @ places).min() > -3e-4, t  # 0.1 mm at rest; it was 3.5 to 60 mm
    for one, t, rate in zip(q, angles, qd, strict=True):
        assert abs(2.0 * np.arcsin(-one[4]) - t) < 2e-3 and np.abs(rate).max() < 5e-3, (one, rate)
