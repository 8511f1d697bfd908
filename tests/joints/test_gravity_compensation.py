"""Gravity compensation: against MuJoCo's, the dense reference, and the step under the same force as tau."""

import mujoco
import numpy as np
import pytest

import warp_spo as spo
from support import laws, mechanisms, symbolic, zoo
from support.step_scenes import held
from warp_spo.dynamics.stepping.integrators import INTEGRATORS
from warp_spo.reference.dense import Dense

H = 2e-3
ROUNDED = 1e-13  # of forces up to 40 N m
MJCF = """<mujoco><option gravity="1 -2 -9.81"/><worldbody><body pos="0 0 1" gravcomp="1.2"><joint axis="0 1 0"/>
<inertial pos=".1 .02 .3" mass="2" diaginertia=".1 .2 .15"/><body pos=".2 0 .5"><joint axis="1 0 0"/>
<inertial pos="0 .1 .2" mass="1.5" diaginertia=".1 .2 .15"/><body pos="0 .3 .4" gravcomp=".7">
<joint type="slide" axis="0 0 1"/><joint axis="0 0 1"/><inertial pos=".3 0 .1" mass=".8" diaginertia=".1 .2 .15"/>
</body></body></body></worldbody></mujoco>"""


def passive(scene, q, dtype="float64"):
    return symbolic.run(scene, "passive_force", {"q": q}, ("q",), {"out": (scene.dof_count,)}, dtype)["out"]


def test_mujocos_force():
    inertia = np.diag([0.1, 0.2, 0.15])
    bodies = [
        spo.Body(2.0, (0.1, 0.02, 0.3), inertia, gravcomp=1.2),
        spo.Body(1.5, (0.0, 0.1, 0.2), inertia),
        spo.Body(0.8, (0.3, 0.0, 0.1), inertia, gravcomp=0.7),
    ]
    hinges = [
        spo.Hinge("revolute", -1, 0, axis=(0, 1, 0), parent_pose=(0, 0, 1, 0, 0, 0, 1)),
        spo.Hinge("revolute", 0, 1, axis=(1, 0, 0), parent_pose=(0.2, 0, 0.5, 0, 0, 0, 1)),
        spo.Hinge("cylindrical", 1, 2, axis=(0, 0, 1), parent_pose=(0, 0.3, 0.4, 0, 0, 0, 1)),
    ]
    scene = spo.Scene(bodies, hinges, gravity=(1, -2, -9.81))
    model = mujoco.MjModel.from_xml_string(MJCF)
    data = mujoco.MjData(model)
    q = np.random.default_rng(0).uniform(-2.0, 2.0, (5, 4))
    for one, force in zip(q, passive(scene, q), strict=True):
        data.qpos[:] = one
        mujoco.mj_forward(model, data)
        assert np.abs(data.qfrc_gravcomp).max() > 1.0
        np.testing.assert_allclose(force, data.qfrc_gravcomp, atol=ROUNDED)


@pytest.mark.parametrize("name", ["fork", "forest"])
def test_passive_force_is_the_reference(name):
    scene = held(zoo.SCENES[name]())
    q = laws.states(scene, 3)["q"]
    wanted = [Dense(scene, one).passive_force(np.zeros(scene.dof_count)) for one in q]
    np.testing.assert_allclose(passive(scene, q), wanted, atol=1e-12)


def test_a_body_that_is_held_up_floats(device):
    """A free body at rest stays where it is; springs, and calls that contain no forces of hinges, do not see it."""
    body = spo.Body(3.0, (0.1, 0.2, 0.3), np.eye(3), gravcomp=1.0)
    dyn = spo.Dynamics(spo.Scene([body], [spo.Hinge("free", -1, 0)]), 1, device=device, dtype="float64")
    q = np.array([[1.0, 2.0, 3.0, 0.0, 0.6, 0.0, 0.8]])
    q_after, qd_after = dyn.step(q, np.zeros((1, 6)), None, 0.1)
    np.testing.assert_allclose(qd_after, 0.0, atol=1e-15)
    np.testing.assert_allclose(q_after, q, atol=1e-15)
    np.testing.assert_allclose(dyn.gravity_force(q), dyn.passive_force(q), atol=1e-13)
    np.testing.assert_allclose(dyn.forward_dynamics(q)[0, 2], -9.81)


# -- steps -------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_step_is_that_under_the_same_force(integrator, device):
    """The force at the point where the integrator evaluates the others; a value that is set later, too."""
    plain = zoo.chain(3)
    dyn = spo.Dynamics(plain, 3, device=device, dtype="float64", granularity="tree", variable=("body_gravcomp",))
    share = np.array([0.5, 1.5, -0.4])
    dyn.set(body_gravcomp=share)
    a = laws.states(plain, 3)
    got = dyn.step(a["q"], a["qd"], a["tau"], H, options=spo.StepOptions(integrator=integrator))
    without = spo.Dynamics(plain, 3, device=device, dtype="float64", granularity="tree")
    body_f = np.zeros((3, 3, 6))
    body_f[..., :3] = -(share * plain.values["body_mass"][0])[:, None] * plain.values["gravity"][0]
    wanted = without.step(a["q"], a["qd"], a["tau"], H, body_f=body_f, options=spo.StepOptions(integrator=integrator))
    for x, y in zip(got, wanted, strict=True):
        np.testing.assert_allclose(x, y, atol=1e-12)
    assert (
        np.abs(
            got[1] - without.step(a["q"], a["qd"], a["tau"], H, options=spo.StepOptions(integrator=integrator))[1]
        ).max()
        > 1e-3
    )


def of_loops(name):
    """A mechanism with compensation and without it, its embedding, a state, and the force of the compensation."""
    scene, how, s, _ = mechanisms.case(name)
    arrays = {key: getattr(s, key) for key in ("q", "qd", "tau")}
    return held(scene), scene, how, arrays, passive(held(scene), s.q) - passive(scene, s.q)


@pytest.mark.parametrize("name", ["fourbar", "far_loop"])
def test_a_step_with_embedded_loops(name):
    scene, plain, how, a, force = of_loops(name)
    got = symbolic.advance(scene, a, H, embedding=how)
    wanted = symbolic.advance(plain, a | {"tau": a["tau"] + force}, H, embedding=how)
    assert np.abs(force).max() > 0.1
    for x, y in zip(got[:2], wanted[:2], strict=True):
        np.testing.assert_allclose(x, y, atol=1e-12)


def test_a_step_with_multipliers(device):
    """Passive forces are those of the open tree, in all dofs."""
    scene, plain, _, a, force = of_loops("fourbar")
    dyn, without = (
        spo.Dynamics(one, len(a["q"]), device=device, dtype="float64", loops="multipliers") for one in (scene, plain)
    )
    got = dyn.step(a["q"], a["qd"], a["tau"], H)
    for x, y in zip(got, without.step(a["q"], a["qd"], a["tau"] + force, H), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-12)


@pytest.mark.slow
def test_a_step_by_limbs(device):
    scene = held(zoo.fork())
    a = laws.states(scene, 3)
    steps = [
        spo.Dynamics(scene, 3, device=device, dtype="float64", granularity=granularity).step(
            a["q"], a["qd"], a["tau"], H, body_f=a["body_f"]
        )
        for granularity in ("tree", "segment")
    ]
    for x, y in zip(*steps, strict=True):
        np.testing.assert_allclose(x, y, atol=1e-12)
