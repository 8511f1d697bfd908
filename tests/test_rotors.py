"""Rotors: the machine with the rotor as a body of its own, MuJoCo's armature, and what is refused."""

import pickle

import geared
import mujoco
import numpy as np
import pytest
import zoo

import warp_spo as spo
from warp_spo.reference import Dense

EXACT = 1e-12  # float64, two bodies
SPIN = 1e-4  # of the rotors [kg m^2]
RATIOS = (1.0, 10.0, 100.0, 1000.0, 10000.0)


# -- reflected ---------------------------------------------------------------------------------------------------------
def test_a_reflected_rotor_is_armature():
    scene = geared.arm(30.0, SPIN, "reflected")
    assert scene.values["joint_armature"].tolist() == [[0.01, 0.01 + 900.0 * SPIN]]
    assert scene.hinges[1].armature.tolist() == [0.01]  # as given
    assert pickle.loads(pickle.dumps(scene)).hinges[1].rotor.ratio == 30.0
    flexible = geared.arm(30.0, SPIN, "reflected", flexible=(100.0, 0.0))
    assert flexible.values["joint_armature"].tolist() == [[0.01, 0.01 + 900.0 * SPIN, 0.0]]


def test_a_reflected_rotor_equals_the_armature_of_mujoco(device):
    xml = """<mujoco><option gravity="0 0 0"/><compiler inertiafromgeom="false"/><worldbody>
      <body><inertial pos=".4 0 0" mass=".5" diaginertia=".005 .02666666666666667 .02666666666666667"/>
        <joint axis="0 0 1" armature=".01"/>
        <body pos=".8 0 0"><inertial pos=".4 0 0" mass=".5" diaginertia=".005 .02666666666666667 .02666666666666667"/>
          <joint axis="0 1 0" armature="{}"/></body></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml.format(0.01 + 30.0**2 * SPIN))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.qfrc_applied[:] = (0.3, -0.7), (1.1, 0.4), (0.5, -0.2)
    mujoco.mj_forward(model, data)
    scene = geared.arm(30.0, SPIN, "reflected", axes=((0, 0, 1), (0, 1, 0)))
    bodies = [spo.Body(b.mass, b.com, np.diag([0.005, *b.inertia.diagonal()[1:]])) for b in scene.bodies]
    dyn = spo.Dynamics(spo.Scene(bodies, scene.hinges, gravity=(0, 0, 0)), 1, device, "float64", granularity="node")
    q, qd, tau = (x[None].copy() for x in (data.qpos, data.qvel, data.qfrc_applied))
    np.testing.assert_allclose(dyn.forward_dynamics(q, qd, tau)[0], data.qacc, rtol=1e-11)


def reflected_error(ratio, qd):
    """Error of accelerations over the largest of them, over ratio J / D; D is that of the rotor's hinge."""
    scene, q, tau = geared.arm(ratio, SPIN, "reflected"), np.array([0.3, -0.7]), np.array([0.5, -0.2])
    found, wanted = Dense(scene, q), geared.DenseTwin(scene, q).forward_dynamics(qd, tau)
    return np.abs(found.forward_dynamics(qd, tau) - wanted).max() / np.abs(wanted).max() / (
        ratio * SPIN / found.D[1, 1]
    )  # fmt: skip


@pytest.mark.parametrize("ratio", RATIOS)
def test_the_error_of_a_reflected_rotor_is_what_its_docstring_says(ratio):
    for qd in (np.zeros(2), np.array([1.1, 0.4])):
        assert 0.9 <= reflected_error(ratio, qd) <= 1.6  # 1.0 to 1.53 here


def test_a_reflected_rotor_on_the_ground_is_exact():
    """So it is where its axis keeps its direction and its parent does not turn about it."""
    axes = ((0, 0, 1), (0, 1, 0))
    q, qd, tau = np.array([0.3, -0.7]), np.array([1.1, 0.0]), np.array([0.5, -0.2])
    rotor = spo.Rotor(SPIN, 50.0, model="reflected")
    hinge = spo.Hinge("revolute", -1, 0, axis=(0, 0, 1), rotor=rotor)
    ground = spo.Scene([zoo.random_body(np.random.default_rng(0))], [hinge])
    for scene, state in ((ground, (q[:1], qd[:1], tau[:1])), (geared.arm(50.0, SPIN, "reflected", axes), (q, qd, tau))):
        wanted = geared.DenseTwin(scene, state[0]).forward_dynamics(*state[1:])
        np.testing.assert_allclose(Dense(scene, state[0]).forward_dynamics(*state[1:]), wanted, rtol=EXACT)


# -- what is refused ---------------------------------------------------------------------------------------------------
AXIS = dict(axis=(0, 0, 1))
ROUND = np.diag([2.0, 2.0, 1.0])


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: spo.Rotor(1.0, 10.0, model="exact"), "model is 'exact'; expected one of full, reduced, reflected"),
        (lambda: spo.Rotor(-1.0, 10.0), "expected zero or more"),
        (lambda: spo.Rotor(1.0, np.inf), "expected finite numbers"),
        (lambda: spo.Rotor(np.eye(2), 10.0), "expected (3, 3)"),
        (lambda: spo.Rotor(1.0, 10.0, axis=(0, 0, 2)), "expected unit length"),
        (lambda: spo.Rotor(spo.Body(1.0, gravcomp=1.0), 10.0), "expected a rigid one without"),
        (lambda: spo.Rotor(ROUND, 10.0, model="reflected"), "knows the moment of inertia about the axis alone"),
        (lambda: spo.Hinge("ball", -1, 0, rotor=spo.Rotor(1.0, 2.0)), "a ball hinge here has another number"),
        (lambda: spo.Hinge("fixed", -1, 0, rotor=spo.Rotor(1.0, 2.0)), "a fixed hinge here has another number"),
        (lambda: spo.Hinge("revolute", -1, 0, axis=(0, 1, 0), rotor=spo.Rotor(ROUND, 2.0)), "not symmetric about"),
    ],
)
def test_what_makes_no_sense_is_refused(make, expected):
    with pytest.raises(ValueError, match=r"Rotor|Hinge") as error:
        make()
    assert expected in str(error.value)


def test_something_else_than_a_rotor_is_refused():
    with pytest.raises(TypeError, match="rotor is of type float; expected a Rotor"):
        spo.Hinge("revolute", -1, 0, **AXIS, rotor=1e-4)
