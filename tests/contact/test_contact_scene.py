"""Contacts as parts of a scene: which points they have, the constants chosen for them, and mistakes by name."""

import pickle

import numpy as np
import pytest

import warp_spo as spo
from support import zoo
from support.contact_cases import box, quadruped
from warp_spo.dynamics.stepping.integrators import CONTACT_STEP
from warp_spo.execution.builder import Builder
from warp_spo.reference.dense import Dense
from warp_spo.scene.contact_values import NeutralPose


def of(body=0, **contact):
    """The points of one contact of a single body."""
    scene = spo.Scene([spo.Body(2.0)], [spo.Hinge("free", -1, 0)], contacts=[spo.Contact(body, **contact)])
    return scene.contact_points


def test_points_of_every_shape():
    assert [p.position for p in of(point=(1, 2, 3))] == [(1.0, 2.0, 3.0)]
    assert [(p.position, p.radius) for p in of(sphere=((1, 2, 3), 0.5))] == [((1.0, 2.0, 3.0), 0.5)]
    for sphere in ((1, 2, 3, 0.5), ([1, 2, 3], 0.5)):
        assert of(sphere=sphere) == of(sphere=((1, 2, 3), 0.5))
    assert of(sphere=0.5) == of(sphere=((0, 0, 0), 0.5))
    assert [(p.position, p.radius) for p in of(capsule=((0, 0, 1), (0, 0, -1), 0.5))] == [
        ((0.0, 0.0, 1.0), 0.5), ((0.0, 0.0, -1.0), 0.5)]  # fmt: skip
    turned = dict(box=((1, 2, 3), (0, 0, 1, 0, 0, np.sqrt(0.5), np.sqrt(0.5))))
    for normal, (x, y, z) in {(0.5, 0.1, -0.8): (..., ..., 3), (0.9, 0.2, 0.2): (-2, ..., ...)}.items():
        corners = {tuple(np.round(p.place(np.array(normal)), 12)) for p in of(**turned)}
        sides = [(-half, half) if at is ... else (at,) for half, at in zip((2, 1, 3), (x, y, z), strict=True)]
        assert corners == {(x, y, 1 + z) for x in sides[0] for y in sides[1] for z in sides[2]}
    cloud = np.concatenate([np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]),
                            0.5 * zoo.unit(np.random.default_rng(0), 40, 3)])  # fmt: skip
    assert {p.position for p in of(hull=cloud)} == {tuple(corner) for corner in cloud[:8]}


def test_a_neutral_stand_is_the_dense_pose():
    scene = zoo.random_tree(9, 4)
    found, dense = NeutralPose(scene), Dense(scene, scene.neutral_q)
    np.testing.assert_allclose(found.places, dense.body_matrix, atol=1e-12)


def values_of(scene):
    """Stiffness and damping of every contact."""
    return scene.values["contact_stiffness"][0], scene.values["contact_damping"][0]


def biped(width):
    """33.3 kg, its centre of mass 0.69 m over two soles of four points each, this far apart across the foot [m]."""
    sole = [(x, y, 0.0) for x in (-0.05, 0.12) for y in (-0.5 * width, 0.5 * width)]
    bodies = [spo.Body(33.3, (0, 0, 0.69)), spo.Body(0.0), spo.Body(0.0)]
    hinges = [spo.Hinge("free", -1, 0), spo.Hinge("fixed", 0, 1), spo.Hinge("fixed", 0, 2)]
    return spo.Scene(bodies, hinges, contacts=[spo.Contact(foot, point=point) for foot in (1, 2) for point in sole])


def test_constants_that_are_chosen():
    """A robot sinks 0.1 mm on four points, less where its sole is narrow; damping is stiffness times 10 ms."""
    mass = quadruped().values["body_mass"].sum()
    for scene, wanted in ((quadruped(), mass * 9.81 / 4e-4), (biped(0.06), 33.3 * 9.81 / 4e-4),
                          (biped(0.03), 33.3 * 9.81 / (4.0 * 0.1 * 0.015**2 / 0.69)),
                          (biped(0.0), 33.3 * 9.81 / 4e-4)):  # fmt: skip
        k, d = values_of(scene)
        np.testing.assert_allclose(k, wanted)
        np.testing.assert_allclose(d, 0.01 * k)
    np.testing.assert_allclose(box(stiffness=1e4, friction=0.2).values["contact_damping"], 100.0)
    np.testing.assert_allclose(box(stiffness=1e4, damping=3.0, friction=0.2).values["contact_damping"], 3.0)


@pytest.mark.parametrize(("size", "sink"), [
    ((0.005, 0.005, 0.005), 5e-5), ((0.5, 0.5, 0.5), 1e-4), ((0.006, 0.03, 0.04), 6e-5),
    ((0.04, 0.006, 0.03), 6e-5), ((2e-4, 0.05, 0.05), 1e-5),
])  # fmt: skip
def test_a_box_sinks_by_a_hundredth_of_half_its_size(size, sink):
    """At most 0.1 mm, at least 0.01 mm, however it lies in its neutral pose."""
    scene = spo.Scene(
        [spo.Body(2.0, inertia=np.eye(3))], [spo.Hinge("free", -1, 0)], contacts=[spo.Contact(0, box=size)]
    )
    np.testing.assert_allclose(values_of(scene)[0], 2.0 * 9.81 / (4.0 * sink))


def test_places_beyond_all_numbers_have_a_stiffness():
    """A decomposition of their widths would not end."""
    contacts = [spo.Contact(0, point=tuple(place)) for place in np.diag([1e308, 1e308, 1e308])]
    scene = spo.Scene([spo.Body(2.0, inertia=np.eye(3))], [spo.Hinge("free", -1, 0)], contacts=contacts)
    np.testing.assert_allclose(values_of(scene)[0], 2.0 * 9.81 / 3e-4)


def test_pairs_carry_what_pairs_connect():
    """A load and what it lies on have the stiffness of both; that of what lies apart is its own, and no tree's is more
    than 1e9 1/s^2 of its mass."""
    bodies = [spo.Body(mass, inertia=mass * np.eye(3)) for mass in (30.0, 1.0, 2.0, 1e-6)]
    at = [dict(body=i, box=(0.1, 0.1, 0.1)) for i in range(4)]
    contacts = [spo.Contact(**at[1]), spo.Contact(**at[2]), spo.Contact(**at[0], other=spo.Contact(**at[1])),
                spo.Contact(**at[0], other=spo.Contact(**at[3]))]  # fmt: skip
    scene = spo.Scene(bodies, [spo.Hinge("free", -1, i) for i in range(4)], contacts=contacts)
    k, d = values_of(scene)
    load = 9.81 * (31.0 + 1e-6)
    np.testing.assert_allclose(k, [*[load / 4e-4] * 4, *[9.81 * 2.0 / 4e-4] * 4, load / 1e-4, 1e3])
    np.testing.assert_allclose(d, 0.01 * k)


def test_pairs_carry_what_prismatic_joints_press():
    """The effort limit of a finger counts, that of a lift that carries both does not."""
    slide = dict(axis=(0, 1, 0))
    hinges = [spo.Hinge("prismatic", -1, 0, **slide, effort_limit=500.0),
              spo.Hinge("prismatic", 0, 1, **slide, effort_limit=20.0),
              spo.Hinge("prismatic", 0, 2, **slide)]  # fmt: skip
    bodies = [spo.Body(1.0, inertia=np.eye(3)) for _ in range(3)]
    pad = dict(box=(0.1, 0.1, 0.1))
    scene = spo.Scene(bodies, hinges, contacts=[spo.Contact(1, **pad, other=spo.Contact(2, **pad))])
    np.testing.assert_allclose(values_of(scene)[0], (3.0 * 9.81 + 20.0) / 1e-4)


def test_contacts_are_told_kept_and_changed():
    scene = pickle.loads(pickle.dumps(quadruped()))
    assert len(scene.contact_points) == 8 and scene.contacts[4].positions.shape == (8, 3)
    line = next(line for line in spo.Dynamics(scene, device="cpu").explain().split("\n") if "contacts" in line)
    assert "8 points of 5 bodies with the Plane" in line and "stiffness 3.53e+05 N/m, damping 3.53e+03 N s/m" in line
    assert scene.with_values(contact_friction=np.full(8, 0.3)).values["contact_friction"][0, 3] == 0.3
    with pytest.raises(ValueError, match=r"contact_stiffness holds -1.0; expected zero or more"):
        scene.with_values(contact_stiffness=np.full(8, -1.0))


@pytest.mark.parametrize("room", [0, None])
def test_explain_says_whether_limbs_have_room(room, monkeypatch):
    """As the kernel says that was built: what limbs tell each other may not fit into shared memory."""
    if room is not None:
        monkeypatch.setattr(Builder, "room", lambda *_, **__: room)
    scene = quadruped()
    dyn = spo.Dynamics(scene, 2, "cpu", granularity="segment")
    assert dyn.explain().split("contacts  ")[1].split("\n")[0].endswith("a warp for each limb")
    shapes = {"q": (2, 19), "qd": (2, 18), "dt": (), "passes": ()}
    dyn.programs.find(CONTACT_STEP, shapes, (2, 18), {"q_out": (2, 19)}, reports=())
    line = dyn.explain().split("contacts  ")[1].split("\n")[0]
    if room is None:
        assert line.endswith("a warp for each limb")
    else:
        assert line.endswith(
            "a thread computes a whole world: what limbs tell each other does not fit in shared memory"
        )


def test_a_scene_without_contacts_has_none():
    scene = zoo.fork()
    assert scene.ground is None and not scene.contact_points and scene.values["contact_friction"].shape == (1, 0)
    assert "contacts     none" in spo.Dynamics(scene, device="cpu").explain()


MISTAKES = {
    "body": (lambda: of(body=3, point=(0, 0, 0)), ValueError, "contact 0 is on body 3; expected one of 1 bodies"),
    "world": (lambda: of(body=-1, point=(0, 0, 0)), ValueError, "contact 0 is on body -1"),
    "kind of body": (lambda: of(body="foot", point=(0, 0, 0)), TypeError, "contact 0 is on body 'foot'"),
    "no shape": (lambda: spo.Contact(0), ValueError, "no shape given; expected one of point, sphere"),
    "two shapes": (lambda: spo.Contact(0, point=(0, 0, 0), box=(1, 1, 1)), ValueError, "point, box given"),
    "NaN": (lambda: spo.Contact(0, point=(0, np.nan, 0)), ValueError, "point .m. is .*expected finite"),
    "sphere": (lambda: spo.Contact(0, sphere=(0, 0, 1)), ValueError, "sphere is .0, 0, 1.; expected"),
    "radius": (lambda: spo.Contact(0, sphere=((0, 0, 0), -1.0)), ValueError, "radius of sphere is -1.0 m"),
    "box": (lambda: spo.Contact(0, box=(1, -1, 1)), ValueError, "half the sizes of box"),
    "hull": (lambda: spo.Contact(0, hull=[1, 2, 3]), ValueError, r"hull has shape \(3,\); expected \(points, 3\)"),
    "friction": (lambda: spo.Contact(0, point=(0, 0, 0), friction=-0.1), ValueError, "friction is -0.1"),
    "eps": (lambda: spo.Contact(0, point=(0, 0, 0), eps=0.0), ValueError, "eps is 0.0; expected a positive"),
    "list": (lambda: spo.Scene([spo.Body(1.0)], [spo.Hinge("free", -1, 0)], contacts=[3]), TypeError, "contacts holds"),
    "ground": (lambda: spo.Scene([spo.Body(1.0)], [spo.Hinge("free", -1, 0)], ground=0.0), TypeError, "ground is of"),
    "field": (lambda: spo.HeightField([[0.0, 1.0], [np.nan, 0.0]], 0.1), ValueError, r"heights\[1, 0\] is nan"),
    "cells": (lambda: spo.HeightField([0.0, 1.0], 0.1), ValueError, r"heights has shape \(2,\)"),
    "rows": (lambda: spo.HeightField([[0.0, 1.0], [2.0]], 0.1), ValueError, "heights has rows of different lengths"),
    "cell": (lambda: spo.HeightField(np.zeros((2, 2)), 0.0), ValueError, "cell is 0.0 m"),
    "normal": (lambda: spo.Plane(normal=(0, 0, 2)), ValueError, "normal is .*expected unit length"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_have_names(mistake):
    make, kind, message = MISTAKES[mistake]
    with pytest.raises(kind, match=message):
        make()


def test_too_few_numbers_for_contacts_and_controls_without_actuators_say_the_way_out():
    """They are not broadcast; and where the scene has no actuators no shape is right."""
    scene = spo.Scene(
        [spo.Body(1.0, inertia=np.eye(3))], [spo.Hinge("free", -1, 0)],
        contacts=[spo.Contact(0, sphere=((x, 0, 0), 0.1)) for x in (0.0, 0.5, 1.0)],
    )  # fmt: skip
    dyn = spo.Dynamics(scene, 4, "cpu", variable=("contact_friction",))
    with pytest.raises(ValueError, match=r"\(4, 1\).*one number for each of the 3 contact points and pairs: repeat it"):
        dyn.set(contact_friction=np.ones((4, 1)))
    with pytest.raises(ValueError, match=r"contact_friction is .*\(4, 2\).*reshape"):
        dyn.set(contact_friction=np.ones((4, 2)))
    q, qd = np.tile(scene.neutral_q, (4, 1)), np.zeros((4, 6))
    with pytest.raises(
        ValueError, match=r"ctrl is .*\(4, 3\).*has no actuators: leave ctrl out; drives follow target_q"
    ):
        dyn.step(q, qd, None, 1e-3, ctrl=np.zeros((4, 3)))


HEAVY = {
    "float32": (1e18, "float32", "contact_stiffness of contact 0 'foot' of body 'cube' is 2.45e\\+22 N/m; .* float32"),
    "float64": (
        1e160,
        "float64",
        "contact_stiffness of contact 0 'foot' of body 'cube' is .* in float64; give a lighter",
    ),
}


@pytest.mark.parametrize("case", HEAVY)
def test_values_beyond_a_dtype_are_an_error(case):
    mass, dtype, words = HEAVY[case]
    scene = spo.Scene([spo.Body(mass, inertia=mass * np.eye(3), label="cube")], [spo.Hinge("free", -1, 0)],
                      contacts=[spo.Contact(0, box=(0.1, 0.1, 0.1), label="foot")])  # fmt: skip
    with pytest.raises(ValueError, match=words):
        spo.Dynamics(scene, device="cpu", dtype=dtype)


def test_contacts_that_sink_far_are_said(recwarn):
    """More than a tenth of their size under what they carry; of a pair under the lighter one's weight."""
    box(stiffness=700.0)  # 17.5 mm on four corners of a cube of 200 mm
    quadruped(stiffness=1e4)
    assert not recwarn
    with pytest.warns(UserWarning, match=r"stiffness of 1 contact\(s\) is too small: .*contact 0 of body .*: 600, "
                                         "needs 6.1e"):  # fmt: skip
        box(stiffness=600.0)
    with pytest.warns(UserWarning, match="stiffness of 4 contact.*sink by more than a tenth"):
        quadruped(stiffness=8e3)  # 4.4 mm on spheres of 40 mm
    at = [dict(body=i, box=(0.1, 0.1, 0.1)) for i in range(2)]
    pair = spo.Contact(**at[1], other=spo.Contact(**at[0]), stiffness=400.0)
    with pytest.warns(UserWarning, match="contact 1 of body"):
        spo.Scene([spo.Body(1.0, inertia=np.eye(3)), spo.Body(9.0, inertia=np.eye(3))],
                  [spo.Hinge("free", -1, i) for i in range(2)], contacts=[spo.Contact(**at[0]), pair])  # fmt: skip
