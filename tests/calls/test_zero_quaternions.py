"""A quaternion of zeros in q has a word of its own, wherever status words are formed."""

import numpy as np
import pytest

import warp_spo as spo
from support import mechanisms, zoo
from support.mechanisms import MECHANISMS

KINDS = ("free", "revolute", "ball", "revolute", "ball", "revolute")
OK, NAN, ZERO = spo.Status.OK, spo.Status.NOT_FINITE, spo.Status.QUATERNION


def chain(contacts=False):
    """A chain of 15 dofs, which steps by limbs take apart."""
    scene = zoo.from_parents([*range(-1, 5)], list(KINDS), 3)
    return scene.with_contacts([spo.Contact(0, sphere=0.1)], spo.Plane(height=-50.0)) if contacts else scene


def states(scene, q, dtype):
    """q [world] with: nothing; zeros in the first quaternion, in the last; NaN; infinity; zeros beside NaN in qd; a
    long quaternion; one whose square leaves float32, then float64."""
    q = np.tile(q, (9, 1))
    at = [
        int(first) + hinge.coord_count - 4
        for hinge, first in zip(scene.hinges, scene.q_start, strict=False)
        if hinge.kind in ("free", "ball")
    ]
    q[[1, 5], at[0] : at[0] + 4] = 0.0
    q[2, at[-1] : at[-1] + 4] = 0.0
    q[3, at[0]], q[4, at[0]] = np.nan, np.inf
    q[6, at[0] : at[0] + 4] *= 3.0
    for world, size in ((7, 1e-20), (8, 1e-160)):
        q[world, at[0] : at[0] + 4] *= size
    qd = np.zeros((9, scene.dof_count))
    qd[5, 0] = np.nan
    tiny = [ZERO if dtype == "float32" else OK, ZERO]
    return q.astype(dtype), qd.astype(dtype), [OK, ZERO, ZERO, NAN, NAN, ZERO, OK, *tiny]


def words(dyn, q, qd, **more):
    """Words of forward dynamics, of a step, and of three substeps."""
    found = np.full((3, len(q)), -1, np.int32)
    dyn.forward_dynamics(q, qd, None, status=found[0])
    for word, count in zip(found[1:], (1, 3), strict=True):
        dyn.step(q, qd, None, 1e-3, options=spo.StepOptions(substeps=count, **more), status=word)
    return found.tolist()


@pytest.mark.parametrize(
    ("granularity", "dtype"), [("tree", "float64"), ("segment", "float32"), ("node", "float32"), ("node", "float64")]
)
def test_every_granularity_names_them(granularity, dtype, device):
    scene = chain()
    q, qd, expected = states(scene, scene.neutral_q, dtype)
    dyn = spo.Dynamics(scene, len(q), device, dtype, granularity=granularity)
    assert words(dyn, q, qd) == [expected] * 3


@pytest.mark.parametrize(
    ("granularity", "passes"), [("tree", 3), pytest.param("tree", 4, marks=pytest.mark.slow), ("segment", 3)]
)
def test_steps_with_contacts_name_them(granularity, passes, device):
    scene = chain(contacts=True)
    q, qd, expected = states(scene, scene.neutral_q, "float32")
    dyn = spo.Dynamics(scene, len(q), device, granularity=granularity)
    assert words(dyn, q, qd, passes=passes) == [expected] * 3


@pytest.mark.parametrize("loops", ["embed", pytest.param("multipliers", marks=pytest.mark.slow)])
def test_closed_loops_name_them(loops, device):
    """The free base of a loop; q is on its closures but for the quaternion."""
    scene = MECHANISMS["far_loop"]()
    (start,) = mechanisms.states(scene, 1).q
    q, qd, expected = states(scene, start, "float64")
    dyn = spo.Dynamics(scene, len(q), device, "float64", loops=loops)
    for found in words(dyn, q, qd):
        named = [word if word in (ZERO, NAN) else OK for word in found]
        assert named == [word if word in (ZERO, NAN) else OK for word in expected]


def test_refined_forward_dynamics_names_them(device):
    scene = chain()
    q, qd, expected = states(scene, scene.neutral_q, "float64")
    dyn, found = spo.Dynamics(scene, len(q), device, "float64", refine=1), np.full(len(q), -1, np.int32)
    dyn.forward_dynamics(q, qd, None, status=found)
    assert found.tolist()[:7] == expected[:7]


def test_the_advice_names_the_quaternion():
    assert "quaternion" in ZERO.advice and "scene.neutral_q" in ZERO.advice and "armature" not in ZERO.advice
