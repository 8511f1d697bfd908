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


def test_constants_that_are_chosen():
    """A quadruped sinks 1.7 mm on four feet; a biped of 33 kg with its centre of mass 0.69 m up stands on one foot."""
    k, d = (quadruped().values[f"contact_{name}"][0] for name in ("stiffness", "damping"))
    mass = quadruped().values["body_mass"].sum()
    np.testing.assert_allclose(k, mass * 9.81 / (4 * 1.7e-3))
    np.testing.assert_allclose(d[:4], 0.5 * np.sqrt(k[0] * mass / 4.0))
    sole = [(x, y, 0.0) for x in (-0.05, 0.12) for y in (-0.03, 0.03)]
    bodies = [spo.Body(33.3, (0, 0, 0.69)), spo.Body(0.0), spo.Body(0.0)]
    hinges = [spo.Hinge("free", -1, 0), spo.Hinge("fixed", 0, 1), spo.Hinge("fixed", 0, 2)]
    feet = [spo.Contact(foot, point=point) for foot in (1, 2) for point in sole]
    scene = spo.Scene(bodies, hinges, contacts=feet)
    k, tips = scene.values["contact_stiffness"][0], 33.3 * 9.81 * 0.69
    np.testing.assert_allclose(4 * k * 0.03**2, 1.6 * tips)
    np.testing.assert_allclose(scene.values["contact_damping"][0], 0.5 * np.sqrt(k * 33.3 / 8.0))
    np.testing.assert_allclose(box(stiffness=1e4, damping=3.0, friction=0.2).values["contact_damping"], 3.0)


def test_contacts_are_told_kept_and_changed():
    scene = pickle.loads(pickle.dumps(quadruped()))
    assert len(scene.contact_points) == 8 and scene.contacts[4].positions.shape == (8, 3)
    line = next(line for line in spo.Dynamics(scene, device="cpu").explain().split("\n") if "contacts" in line)
    assert "8 points of 5 bodies with the Plane" in line and "stiffness 2.08e+04 N/m" in line
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
