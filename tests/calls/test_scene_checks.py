"""Values that a scene refuses, by a message that names the body or the dof and the way out."""

import numpy as np
import pytest

import warp_spo as spo

THIN = np.diag([0.1, 0.1, 0.3])  # 0.1 + 0.1 < 0.3: no rigid body
NEGATIVE = np.diag([-0.1, 0.2, 0.2])


BALL = np.eye(3)


def scene(inertia=BALL, any_inertia=False, **hinge):
    body = spo.Body(1.0, inertia=inertia, label="plate", any_inertia=any_inertia)
    return spo.Scene([body], [spo.Hinge("revolute", -1, 0, axis=(0, 0, 1), label="turn", **hinge)])


def test_inertias_that_no_rigid_body_has():
    with pytest.raises(ValueError, match=r"Scene: body 0 'plate' has the principal moments .* any_inertia=True"):
        scene(THIN)
    with pytest.raises(ValueError, match=r"Body\('plate'\): inertia has the eigenvalue -0.1 .* any_inertia=True"):
        scene(NEGATIVE)
    for inertia in (THIN, NEGATIVE):
        np.testing.assert_array_equal(scene(inertia, any_inertia=True).values["body_inertia"], [[inertia]])
    scene(np.diag([0.1, 0.2, 0.3]))  # a plate; equality is allowed


def test_inertias_that_are_set_later():
    told, untold = scene(any_inertia=True), scene()
    worlds = np.array([[np.eye(3)], [THIN]])
    np.testing.assert_array_equal(told.with_values(body_inertia=worlds).values["body_inertia"], worlds)
    with pytest.raises(ValueError, match=r"Scene.with_values: body 0 'plate'"):
        untold.with_values(body_inertia=worlds)


def test_a_turned_plate_is_no_error():
    """Rounding may put the largest moment of a plate or a rod above the sum of the others."""
    rng = np.random.default_rng(5)
    for moments in ((0.1, 0.2, 0.3), (0.0, 0.2, 0.2), (0.0, 0.0, 0.0), (1e-9, 1e-3, 1e-3 + 1e-9)):
        for _ in range(20):
            turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
            scene(turn @ np.diag(moments) @ turn.T)


@pytest.mark.parametrize("name", ["damping", "target_ke", "target_kd", "limit_ke", "limit_kd", "friction"])
def test_negative_resistances(name):
    with pytest.raises(ValueError, match=f"Scene: joint_{name} holds -1.0; expected zero or more"):
        scene(**{name: -1.0})
    with pytest.raises(ValueError, match=f"Scene.with_values: joint_{name} holds -1.0"):
        scene().with_values(**{f"joint_{name}": [-1.0]})


def test_crossed_limits():
    with pytest.raises(ValueError, match=r"Scene: joint_limit_lower of dof 0 'turn' is 2, above joint_limit_upper 1;"):
        scene(limit_lower=2.0, limit_upper=1.0)
    with pytest.raises(ValueError, match=r"Scene.with_values: joint_limit_lower .* is 2, above joint_limit_upper 1;"):
        scene(limit_upper=1.0).with_values(joint_limit_lower=[[0.0], [2.0]])
    scene(limit_lower=1.0, limit_upper=1.0)
