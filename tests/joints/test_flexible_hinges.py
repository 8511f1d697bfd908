"""Flexible hinges: closed forms, the dense reference, chains of two hinges, and what is refused."""

import dataclasses
import pickle

import mujoco
import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import geared, implicit, laws, symbolic, zoo
from support.step_scenes import FORCES, H, furnished
from support.step_scenes import states as step_states
from warp_spo.reference.dense import Dense

WORLDS = 3
EXACT = 1e-12  # float64 on scenes of few bodies
AGREE = 1e-11  # the same mechanism written in two ways, and nonlinear steps
RESONANCE = 1e-6  # relative, of a frequency, as promised; Runge-Kutta's own error here is 1e-9


def close(got, wanted, tolerance):
    assert laws.error(np.asarray(got), np.asarray(wanted)) <= tolerance, laws.error(np.asarray(got), np.asarray(wanted))


# -- a harmonic drive --------------------------------------------------------------------------------------------------
MOTOR, ARM, STIFFNESS = 0.35, 0.5 * 0.8**2 / 3.0, 900.0  # inertias [kg m^2], spring [N m/rad]


def drive(flexible=(STIFFNESS, 0.0), armature=MOTOR, **more):
    """A rod of 0.5 kg and 0.8 m on a flexible hinge, without gravity."""
    hinge = spo.Hinge("revolute", -1, 0, axis=(0, 0, 1), armature=armature, flexible=flexible, **more)
    return spo.Scene([zoo.rod(0.5, 0.8)], [hinge], gravity=(0, 0, 0))


def test_a_harmonic_drive_rings_at_its_closed_form(device):
    """Jm qm'' = k d, Ja (qm'' + d'') = -k d: omega^2 = k (1/Jm + 1/Ja) of a motor that nothing holds."""
    dyn = spo.Dynamics(drive(), 1, device, "float64")
    omega, dt, steps = np.sqrt(STIFFNESS * (1.0 / MOTOR + 1.0 / ARM)), 2e-4, 1000
    mode = np.array([[-ARM / (MOTOR + ARM), 1.0]])  # the motor against the arm: no momentum
    q, qd = 0.01 * mode, np.zeros((1, 2))
    for _ in range(steps):
        q, qd = dyn.step(q, qd, None, dt, options=spo.StepOptions(integrator="rk4"))
    turns = np.round(omega * dt * steps / (2.0 * np.pi))
    phase = np.arctan2(-qd[0, 1] / omega, q[0, 1])
    phase += 2.0 * np.pi * np.round((omega * dt * steps - phase) / (2.0 * np.pi))
    assert turns > 2 and abs(phase / (dt * steps) / omega - 1.0) <= RESONANCE
    close(q, 0.01 * np.cos(omega * dt * steps) * mode, 1e-6)


def test_the_motor_is_an_inertia_behind_a_spring(device):
    dyn = spo.Dynamics(drive((STIFFNESS, 0.7), damping=0.2), 1, device, "float64", granularity="node")
    q, qd = np.array([[0.3, -0.02]]), np.array([[1.5, -0.4]])
    close(dyn.mass_matrix(q)[0], [[MOTOR + ARM, ARM], [ARM, ARM]], EXACT)
    passive = dyn.passive_force(q, qd)
    close(passive[0], [-0.2 * 1.5, 0.02 * STIFFNESS + 0.7 * 0.4], EXACT)
    qdd = dyn.forward_dynamics(q, qd, passive)[0]
    close([MOTOR * qdd[0], ARM * qdd.sum()], [passive[0, 0] - passive[0, 1], passive[0, 1]], EXACT)


def test_a_step_is_implicit_in_the_deflection(device):
    """Any stiffness and any step: the deflection of a stiff gear settles instead of growing."""
    dyn = spo.Dynamics(drive((1e9, 0.0)), 1, device, "float64", granularity="node")
    q, qd = np.array([[0.0, 1e-3]]), np.zeros((1, 2))
    for _ in range(20):
        q, qd = dyn.step(q, qd, None, 0.01)
    assert abs(q[0, 1]) < 1e-6 and np.isfinite(qd).all()


@pytest.mark.parametrize("granularity", ["node", "tree"])
def test_a_motor_without_inertia_raises_a_status(granularity, device):
    dyn = spo.Dynamics(drive(armature=0.0), 1, device, "float64", granularity=granularity)
    status = wp.full(1, -1, dtype=wp.int32, device=device)
    assert np.isnan(dyn.forward_dynamics(np.zeros((1, 2)), None, np.ones((1, 2)), status=status)).any()
    assert status.numpy().tolist() == [spo.Status.PIVOT]


# -- the dense reference, and two hinges about one axis ----------------------------------------------------------------
@pytest.mark.parametrize("name", laws.OPERATIONS)
@pytest.mark.parametrize(
    "granularity", ["node", *(pytest.param(x, marks=pytest.mark.slow) for x in ("segment", "tree"))]
)
def test_every_operation_equals_the_dense_reference(name, granularity, device):
    scene = geared.flexible_tree()
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype="float64", granularity=granularity)
    laws.equals_reference(dyn, name, laws.states(scene, WORLDS), laws.TOLERANCE["float64"])


def written_out(scene):
    """The scene with every flexible hinge as a d6 of two equal axes, and its laws as values of two dofs."""

    def as_chain(hinge):
        if hinge.flexible is None or hinge.kind == "helical":
            return hinge
        axis, turns, _ = hinge.screws[0]
        return dataclasses.replace(hinge, kind="d6", flexible=None, axis=None,
                                   **{"linear": None, "angular" if turns else "linear": [axis, axis]})  # fmt: skip

    return spo.Scene(scene.bodies, [as_chain(hinge) for hinge in scene.hinges], gravity=scene.values["gravity"][0])


@pytest.mark.parametrize(
    ("name", "given", "results", "options"),
    [
        ("inverse_dynamics_derivatives", "q qd qdd body_f", {"out": "3nn"}, {}),
        ("mass_matrix_derivative", "q", {"out": "nnn"}, {}),
        ("forward_dynamics_vjp", "q qd tau cotangent", {"out": "c", "qd_bar": "n"}, {"wrt": ("q", "qd")}),
        ("step_vjp", "q qd tau qdd dt q_cotangent qd_cotangent", {"out": "c", "qd_bar": "n"}, {"wrt": ("q", "qd")}),
        ("hybrid_dynamics", "q qd tau qdd prescribed", {"out": "n", "tau_out": "n"}, {}),
        ("body_reactions", "q qd qdd", {"out": "b6"}, {}),
    ],
)
def test_equals_two_hinges_about_one_axis(name, given, results, options):
    scene = geared.flexible_tree()
    twin, a, rng = written_out(scene), laws.states(scene, WORLDS), np.random.default_rng(3)
    a |= {"dt": np.full((WORLDS, 1), 0.01), "prescribed": np.tile(np.arange(scene.dof_count) % 2.0, (WORLDS, 1))}
    a |= {"cotangent": a["tau"], "q_cotangent": rng.normal(size=a["q"].shape), "qd_cotangent": a["qdd"]}
    size = {"n": scene.dof_count, "c": scene.coord_count, "b": scene.body_count}
    shapes = {key: tuple(size.get(x) or int(x) for x in text) for key, text in results.items()}
    wanted, found = (symbolic.run(s, name, a, given.split(), shapes, **options) for s in (twin, scene))
    for key in results:
        close(np.nan_to_num(found[key]), np.nan_to_num(wanted[key]), AGREE)


def test_a_step_equals_the_dense_nonlinear_equation():
    scene = furnished(geared.flexible_tree())
    a = step_states(scene, 2)
    q, qd, _ = symbolic.advance(scene, a, H)
    wanted = implicit.step(scene, 0, H, *(a[name][0] for name in ("q", "qd", *FORCES)))
    close(q[0], wanted[0], AGREE)
    close(qd[0], wanted[1], AGREE)


# -- what names a hinge means its motor --------------------------------------------------------------------------------
def test_labels_values_and_pickles():
    hinge = spo.Hinge("revolute", -1, 0, axis=(0, 0, 1), armature=0.1, stiffness=2.0, friction=0.3, effort_limit=5.0,
                      limit_upper=1.0, rest=0.2, flexible=(40.0, 0.5), label="wrist")  # fmt: skip
    scene = spo.Scene([zoo.rod(1.0, 1.0)], [hinge])
    assert scene.dof_labels == ["wrist:motor", "wrist:deflection"] and scene.deflections == (1,)
    wanted = dict(armature=[0.1, 0.0], stiffness=[2.0, 40.0], damping=[0.0, 0.5], friction=[0.3, 0.0],
                  effort_limit=[5.0, 1e6], limit_upper=[1.0, 1e10])  # fmt: skip
    again = pickle.loads(pickle.dumps(scene))
    for one in (scene, again, spo.Scene(scene.bodies, [dataclasses.replace(hinge, label="other")])):
        for name, values in wanted.items():
            assert one.values[f"joint_{name}"][0].tolist() == values, name
        assert one.values["joint_rest_q"][0].tolist() == [0.2, 0.0] and one.hinges[0].flexible == (40.0, 0.5)


def test_actuators_and_couplings_act_on_motors(device):
    rng = np.random.default_rng(5)
    hinges = [geared.flexible(rng, "revolute", -1, 0), geared.flexible(rng, "revolute", 0, 1)]
    servo = spo.Actuator([1, 0], gear=(2.0, 3.0), gain=5.0, bias=(0.0, -5.0, -0.5))
    bodies = [zoo.random_body(rng) for _ in range(2)]
    scene = spo.Scene(bodies, hinges, actuators=[servo], couplings=[spo.Coupling(1, 0, -0.5, 0.1)])
    a, ctrl = laws.states(scene, WORLDS), rng.normal(size=(WORLDS, 1))
    dyn = spo.Dynamics(scene, WORLDS, device, "float64", loops="embed")
    length, rate = (2.0 * a[x][:, 2] + 3.0 * a[x][:, 0] for x in ("q", "qd"))
    force = 5.0 * ctrl[:, 0] - 5.0 * length - 0.5 * rate
    close(
        dyn.actuator_force(a["q"], a["qd"], ctrl), np.stack([3.0 * force, 0 * force, 2.0 * force, 0 * force], 1), EXACT
    )
    close(dyn.closure_error(a["q"])[:, 0], a["q"][:, 2] + 0.5 * a["q"][:, 0] - 0.1, EXACT)


def test_inverse_kinematics_leaves_deflections_at_zero(device):
    links = [spo.Hinge("revolute", k - 1, k, axis=(0, 0, 1), parent_pose=(0.5 * (k > 0), 0, 0, 0, 0, 0, 1),
                       armature=0.1, flexible=(50.0, 0.0)) for k in range(2)]  # fmt: skip
    dyn = spo.Dynamics(spo.Scene([zoo.rod(1.0, 0.5)] * 2, links), 1, device, "float64")
    tip = [(1, (0.5, 0, 0, 0, 0, 0, 1))]
    target = dyn.frame_poses(np.array([[0.4, 0.0, 0.9, 0.0]]), tip)
    q, error = dyn.inverse_kinematics(target, tip, np.array([[0.2, 0.3, 0.6, -0.2]]), iterations=50)
    assert error[0] < 1e-9 and (q[0, [1, 3]] == 0.0).all()
    close(q[0, [0, 2]], [0.4, 0.9], 1e-8)


# -- what is refused ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (dict(kind="ball"), "a ball hinge here has no axis"),
        (dict(kind="fixed"), "a fixed hinge here has no axis"),
        (dict(kind="universal", axis=((1, 0, 0), (0, 1, 0))), "a universal hinge here has 2 axes"),
        (dict(kind="d6", angular=np.eye(3)), "a d6 hinge here has 3 axes"),
        (dict(kind="revolute", axis=(0, 0, 1), flexible=5.0), "flexible (stiffness, damping) has shape ()"),
        (dict(kind="revolute", axis=(0, 0, 1), flexible=(5.0, -1.0)), "expected a stiffness and a damping of zero"),
        (dict(kind="revolute", axis=(0, 0, 1), flexible=(5.0, np.nan)), "expected finite numbers"),
        (dict(kind="revolute", axis=(0, 0, 1), stiffness=(1.0, 4.0)), "flexible= says 5.0 for the deflection"),
    ],
)
def test_what_makes_no_sense_is_refused(arguments, expected):
    with pytest.raises(ValueError, match="Hinge") as error:
        spo.Hinge(parent=-1, child=0, **{"flexible": (5.0, 0.0), **arguments})
    assert expected in str(error.value)


def test_a_flexible_custom_hinge_is_refused():
    with pytest.raises(spo.UnsupportedError, match="two coordinates"):
        spo.Hinge.custom(-1, 0, coordinates=1, pose=lambda q: ((q[0], 0, 0), np.eye(3)), flexible=(1.0, 0.0))


def test_coordinates_of_mujoco_refuse_a_joint_that_they_do_not_have():
    xml = "<mujoco><worldbody><body><joint axis='0 0 1'/><geom size='.1'/></body></worldbody></mujoco>"
    with pytest.raises(ValueError, match="joint 0 revolute of 2 degrees of freedom; expected revolute"):
        spo.mujoco.Coordinates(drive(), mujoco.MjModel.from_xml_string(xml), 1, "cpu")


def test_the_reference_places_bodies_by_the_sum():
    scene = drive()
    one, two = (Dense(scene, q).body_poses for q in ([0.5, 0.25], [0.75, 0.0]))
    np.testing.assert_allclose(one, two, atol=EXACT)
