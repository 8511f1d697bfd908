"""Functions that a custom hinge refuses, and the words of its errors."""

import numpy as np
import pytest

import warp_spo as spo


def flat(q):
    return (q[0], 0.0, 0.0), np.eye(3)


@pytest.mark.parametrize(
    ("pose", "coordinates", "error", "text"),
    [
        (lambda q: (flat(q)[0], np.eye(3) * (1.0 + 1e-6)), 1, ValueError, "R.T R = 1 within 1e-09"),
        (lambda q: (flat(q)[0], -np.eye(3)), 1, ValueError, "det R = 1"),
        (lambda q: ((np.log(q[0]), 0.0, 0.0), np.eye(3)), 1, ValueError, "expected finite numbers"),
        (lambda q: (q[0], np.eye(3)), 1, ValueError, "expected (position (3,), rotation (3, 3))"),
        (lambda q: flat(q)[0], 1, ValueError, "expected (position (3,), rotation (3, 3))"),
        (lambda q: flat(q) if q[0] > 0.0 else None, 1, TypeError, "spo.where(condition, a, b)"),
        (lambda q: ((np.tanh(q[0]), 0.0, 0.0), np.eye(3)), 1, TypeError, "np.tanh does not take an abstract scalar"),
        (lambda q: ((np.sinh(np.array(q))[0], 0.0, 0.0), np.eye(3)), 1, TypeError, "sinh"),
        (lambda q: ((max(q[0], 0.0), 0.0, 0.0), np.eye(3)), 1, TypeError, "a branch (if, and, or, not, min, max"),
        (lambda q: ((float(q[0]), 0.0, 0.0), np.eye(3)), 1, TypeError, "a function of numbers"),
        (lambda q: ((q[0] == 1.0, 0.0, 0.0), np.eye(3)), 1, TypeError, "== does not take"),
        (lambda q: ((q[0].sinc(), 0.0, 0.0), np.eye(3)), 1, TypeError, "sinc does not take"),
        (lambda q: ((q[1], 0.0, 0.0), np.eye(3)), 1, ValueError, "IndexError"),
        (flat, 0, ValueError, "coordinates is 0; expected 1 to 6"),
        (flat, 7, ValueError, "coordinates is 7; expected 1 to 6"),
        (flat, 1.5, ValueError, "coordinates is 1.5; expected 1 to 6"),
        ("flat", 1, ValueError, "expected a function of q"),
    ],
)
def test_what_is_no_pose_is_refused(pose, coordinates, error, text):
    with pytest.raises(error) as raised:
        spo.Hinge.custom(-1, 0, coordinates=coordinates, pose=pose, label="knee")
    assert text in str(raised.value) and "knee" in str(raised.value)


def test_limits_say_where_a_pose_is_looked_at():
    pose = lambda q: ((np.sqrt(q[0]), 0.0, 0.0), np.eye(3))  # noqa: E731
    assert spo.Hinge.custom(-1, 0, coordinates=1, pose=pose, limit_lower=0.1, limit_upper=0.9).dof_count == 1
    with pytest.raises(ValueError, match="limit_lower"):
        spo.Hinge.custom(-1, 0, coordinates=1, pose=pose)


@pytest.mark.parametrize("more", [dict(velocity_limit=3.0), {}])
def test_steps_that_weigh_hinges_at_zero_need_a_regular_pose_there(more):
    """Contacts and velocity limits take scales from the mass matrix at the neutral q, which is infinite here."""
    pose = lambda q: ((np.sqrt(q[0]), 0.0, 0.0), np.eye(3))  # noqa: E731
    hinge = spo.Hinge.custom(-1, 0, coordinates=1, pose=pose, limit_lower=0.1, limit_upper=0.9, label="knee", **more)
    contacts = [] if more else [spo.Contact(0, point=(0, 0, 0))]
    dyn = spo.Dynamics(spo.Scene([spo.Body(1.0)], [hinge], contacts=contacts), worlds=1, dtype="float64", device="cpu")
    text = r"mass matrix at the neutral q, .* is not finite at 'knee.*shift its coordinate"
    with pytest.raises(ValueError, match=text):
        dyn.step(np.full((1, 1), 0.5), np.zeros((1, 1)), None, 1e-3)


def test_other_kinds_take_no_pose():
    with pytest.raises(ValueError, match="belong to a custom hinge"):
        spo.Hinge("revolute", -1, 0, axis=(0, 0, 1), pose=flat)
    with pytest.raises(spo.UnsupportedError, match="a custom hinge that closes a loop"):
        spo.Loop("custom", -1, 0)
