"""Spheres on a height field: where they touch beside dense sampling, how they roll and slide beside closed forms."""

import numpy as np
import pytest

import warp_spo as spo
from benchmarks.contact import shapes
from support import contact_gradients
from support.contact_cases import box
from support.contact_steps import FIELDS, H, above, assert_is_dense
from warp_spo.reference import field_spheres
from warp_spo.reference.contact import ContactStep
from warp_spo.reference.field_spheres import find_cells, nearest_points


@pytest.mark.parametrize("name", shapes.fields())
def test_spheres_touch_where_the_surface_is_nearest(name):
    """None is missed; normals within 5 degrees, depths within 0.2 mm, but for what asked shares leave."""
    for line in (line for radius in shapes.RADII for line in shapes.spheres_on(name, radius, 12)):
        assert line.holds or line.measured <= 1 / 12, line  # one of twelve is above the shares of 3 and 5 per cent


@pytest.mark.parametrize("radius", [0.04, 0.05])
def test_a_sphere_beside_a_ridge_inside_of_a_cell(radius):
    """At the outer corner of a stair, where places on both sides of the ridge are nearest to those around them."""
    field, _ = shapes.fields()["outer corner of 10 cm"]
    s, t = 0.495, 0.559
    place = np.array([0.05 * s, 0.05 * t, 0.1 * (1.0 - s) * (1.0 - t)])
    normal = np.array([2.0 * (1.0 - t), 2.0 * (1.0 - s), 1.0])
    normal /= np.linalg.norm(normal)
    found, depth = nearest_points(field, place + (radius - 2.5e-3) * normal, radius)[0]
    assert abs(depth - 2.5e-3) < 1e-5 and found @ normal > np.cos(1e-3)


@pytest.mark.parametrize("friction", [0.8, 0.0])
def test_a_ball_on_a_slope(friction):
    """It rolls at 5/7 g sin t, or slides at g sin t and does not spin; no step gains energy."""
    speed, rate, energy = shapes.ball_on_slope(20.0, 5e-3, friction).T
    truth = 9.81 * np.sin(np.radians(20.0)) * (5.0 / 7.0 if friction else 1.0)
    assert abs(speed[-1] / truth - 1.0) < 1e-3
    assert abs(rate[-1] * 0.1 - (speed[-1] if friction else 0.0)) < 1e-3
    assert np.diff(energy).max() < 1e-8


def test_a_sphere_above_a_tip_is_outside(device):
    """Whatever the planes of its steep sides say, and whether gaps are asked for or not: no gap is below -radius."""
    heights, radius, worlds = np.zeros((13, 13)), 0.03, 2000
    heights[6, 6] = 0.15
    ground = spo.HeightField(heights, 0.05, (-0.3, -0.3))
    body = spo.Body(0.01, inertia=4e-6 * np.eye(3))
    scene = spo.Scene(
        [body], [spo.Hinge("free", -1, 0)], contacts=[spo.Contact(0, sphere=((0, 0, 0), radius))], ground=ground
    )
    rng = np.random.default_rng(0)
    q, qd = np.tile(scene.neutral_q, (worlds, 1)), np.zeros((worlds, 6))
    q[:, :2], q[:, 2] = rng.uniform(-0.1, 0.1, (worlds, 2)), rng.uniform(0.1, 0.3, worlds)
    x, y = np.abs(q[:, 0]), np.abs(q[:, 1])
    q = q[q[:, 2] > 0.15 * np.maximum(1.0 - x / 0.05, 0.0) * np.maximum(1.0 - y / 0.05, 0.0)]
    dyn = spo.Dynamics(scene, len(q), device, "float64")
    report = dyn.step_report("contact_gap", like=q)
    asked, free = dyn.step(q, qd[: len(q)], None, 2e-3, report=report), dyn.step(q, qd[: len(q)], None, 2e-3)
    assert report.contact_gap.min() >= -radius and all(np.array_equal(*pair) for pair in zip(asked, free, strict=True))


def rounded(name):
    """A body with a sphere of less than 0.7 cells and a capsule of more."""
    capsule = spo.Contact(0, capsule=((0, 0, -0.1), (0, 0, 0.1), 0.09), friction=0.3)
    sphere = spo.Contact(0, sphere=((0.1, 0.0, -0.1), 0.03), friction=0.3)
    return box(ground=FIELDS[name]).with_contacts([sphere, capsule], FIELDS[name])


@pytest.mark.parametrize("name", FIELDS)
def test_the_recursion_is_the_dense_step(name):
    """Beyond the field's edge, too."""
    scene = rounded(name)
    assert_is_dense(scene, above(scene, 2, 6), 3)  # no foot lies on an edge, where rounding picks the cell


@pytest.mark.parametrize("name", FIELDS)
def test_gradients_are_differences(name):
    """By state and heights, where the nearest point moves over a curved cell, an edge, a wall."""
    scene = rounded(name)
    a = contact_gradients.furnish(scene, above(scene, 3, 3))
    errors = contact_gradients.errors(scene, a, H, 3, names=("q", "ground_heights"))
    for argument, (error, crossed) in errors.items():
        assert error <= 1e-8, (argument, errors)  # 6e-10 measured
        assert crossed <= 1 / 3, (argument, errors)  # one of three states is where the nearest cell changes


def test_rounding_does_not_choose_the_cell(monkeypatch):
    """On a ridge two cells share the nearest point: the one that is found stays for any rounding."""
    heights = np.zeros((5, 5))
    heights[2] = 0.02
    heights[2, 2] = 0.05
    moves = 1e-13 * np.random.default_rng(0).normal(size=(30, 3))

    def counts():
        """How many answers each place has; the first lie beside the ridge along y, the last beside those along x."""
        places = ((0.208, 0.124, 0.06), (0.196, 0.222, 0.06), (0.254, 0.2015, 0.06), (0.145, 0.2016, 0.06))
        size = np.array([0.1, 0.1])
        return [
            len({tuple(find_cells(heights, place + move, size, 1, True)[:3]) for move in moves}) for place in places
        ]

    assert counts() == [1, 1, 1, 1]
    monkeypatch.setattr(field_spheres, "NEARER", 1.0)
    assert max(counts()) > 1


def test_a_tilted_field_is_a_tilted_plane():
    slope = np.array([0.2, -0.1])
    x, y = np.arange(21) * 0.1 - 1.0, np.arange(31) * 0.1 - 1.5
    field = spo.HeightField(slope[0] * x[:, None] + slope[1] * y[None, :], 0.1, (-1.0, -1.5))
    normal = np.array([*-slope, 1.0]) / np.sqrt(1.0 + slope @ slope)
    for centre in np.random.default_rng(0).uniform(-0.2, 0.2, (20, 3)):  # below ground, too
        ((found, depth),) = nearest_points(field, centre, 0.1, both=False)
        np.testing.assert_allclose(found, normal, atol=1e-9)
        assert abs(depth - (0.1 - normal @ centre)) < 1e-9


def test_a_ball_in_a_groove_rests_on_both_sides():
    """A V of 40 degrees: it sinks by m g / (2 k cos^2 40) along z, and stays in the middle."""
    field, _ = shapes.fields()["V of 40 degrees"]
    scene = shapes.ball_on(field, 0.04, friction=0.0, stiffness=1e4)  # friction would let it creep down
    q = [1e-4, 0.01, 0.04 / np.cos(np.radians(40.0)), 0.0, 0.0, 0.0, 1.0]
    states = shapes.rolled(scene, q, np.zeros(6), 5e-3, 0.5)
    sink = 0.04 / np.cos(np.radians(40.0)) - states[-1, 2]
    assert abs(sink / (9.81 / (2e4 * np.cos(np.radians(40.0)) ** 2)) - 1.0) < 1e-2
    assert abs(states[-1, 0]) < 1e-4 and np.abs(states[-1, 7:]).max() < 1e-3


OUTSIDE = {
    "sphere": dict(sphere=((0, 0, 0), 0.05)),
    "large sphere": dict(sphere=((0, 0, 0), 0.09)),
    "cylinder": dict(cylinder=((0, -0.05, 0), (0, 0.05, 0), 0.05)),
    "ellipsoid": dict(ellipsoid=(0.05, 0.05, 0.05)),
    "box": dict(box=(0.05, 0.05, 0.05)),
}


@pytest.mark.parametrize("kind", OUTSIDE)
def test_beyond_the_edge_a_field_is_level_across_it(kind):
    """Of a slope of 20 degrees along x: no force along x beyond both ends, and the whole slope's beside it."""
    slope, size = np.tan(np.radians(20.0)), 0.09 if kind == "large sphere" else 0.05
    field = spo.HeightField(np.repeat(slope * (np.arange(21) - 10.0)[:, None] * 0.1, 21, 1), 0.1, (-1.0, -1.0))
    scene = box().with_contacts([spo.Contact(0, **OUTSIDE[kind])], field)
    places = np.array([[-3.0, 0.0], [3.0, 0.013], [-1.2, 0.0], [3.0, 5.0], [0.013, 2.0]])
    q = np.array([[x, y, slope * np.clip(x, -1, 1) + size - 1e-3, 0, 0, 0, 1.0] for x, y in places])
    q[4, 2] += size * (1.0 / np.cos(np.radians(20.0)) - 1.0) - 1e-3
    a = {"q": q, "qd": np.zeros((5, 6))}
    assert_is_dense(scene, a, 3)
    for one in q:
        points = ContactStep(scene, one, np.zeros(6), H).points
        normals = points.n[points.depth > 0.0]
        assert len(normals)
        wanted = np.array([-slope if one[1] == 2.0 else 0.0, 0.0, 1.0])
        np.testing.assert_allclose(normals, np.tile(wanted / np.linalg.norm(wanted), (len(normals), 1)), atol=1e-9)
        if one[1] != 2.0:
            assert abs(points.depth.max() - 1e-3) < 1e-9


@pytest.mark.parametrize("radius", [0.05, 0.09])
def test_a_sphere_before_the_edge_of_a_field_touches_its_slope(radius, device):
    """The nearest point is on the slope inside: its depth is r - (z cos t - x sin t); in the kernel, too."""
    slope, angle = np.tan(np.radians(20.0)), np.radians(20.0)
    field = spo.HeightField(np.repeat(slope * np.arange(9)[:, None] * 0.1, 9, 1), 0.1, (0.0, -0.4))
    scene = box().with_contacts([spo.Contact(0, sphere=((0, 0, 0), radius))], field)
    x = np.array([-0.005, -0.35, 0.0])
    q = np.array([[at, 0.013, radius - 2e-4, 0.0, 0.0, 0.0, 1.0] for at in x])
    depths = [radius - ((radius - 2e-4) * np.cos(angle) - at * np.sin(angle)) for at in x]
    depths[1] = 2e-4
    found = [ContactStep(scene, one, np.zeros(6), H).points.depth.max() for one in q]
    np.testing.assert_allclose(found[:2], depths[:2], atol=1e-9)
    dyn = spo.Dynamics(scene, worlds=3, dtype="float64", device=device)
    report = dyn.step_report("contact_gap", like=q)
    dyn.step(q, np.zeros((3, 6)), dt=H, report=report)
    np.testing.assert_allclose(-report.contact_gap[:, 0], found, atol=1e-12)


def test_spheres_too_large_for_the_cells_are_a_warning(recwarn):
    """Of 0.22 m on cells of 0.1 m, where the slope's nearest point is 1.5 cells aside; not on a gentle slope."""
    x = np.arange(9)[:, None] * np.ones((1, 9)) * 0.1
    contact = [spo.Contact(0, sphere=((0, 0, 0), 0.22))]
    box().with_contacts(contact, spo.HeightField(0.5 * x, 0.1))
    box().with_contacts([spo.Contact(0, sphere=((0, 0, 0), 0.2))], spo.HeightField(x, 0.1))
    assert not recwarn
    with pytest.warns(UserWarning, match=r"1 sphere\(s\) are larger than 0.211 m, .*contact 0 of body .*: 0.22 m"):
        box().with_contacts(contact, spo.HeightField(x, 0.1))
