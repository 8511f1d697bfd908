"""Scenes, Dynamics and the torch module come out of pickle and copy as they went in: the same numbers, to the bit."""

import concurrent.futures
import copy
import inspect
import multiprocessing
import pickle
import types

import mujoco
import numpy as np
import pytest
import torch
import warp as wp

import warp_spo as spo
from support import custom_hinges, laws, mechanisms, zoo
from support.border import explained
from support.solver_models import turned_model
from warp_spo.dynamics import pickling
from warp_spo.torch import Module

WORLDS = 3
WAYS = {"pickle": lambda one: pickle.loads(pickle.dumps(one)), "deepcopy": copy.deepcopy, "copy": copy.copy}


def furnished():
    """A scene with all that a scene can hold beside its tree."""
    tree = zoo.fork()
    return spo.Scene(
        tree.bodies,
        tree.hinges,
        gravity=(0.1, 0.2, -9.0),
        actuators=[spo.Actuator(2, gear=2.0, delay=1)],
        sites={"tip": (2, (0.1, 0.2, 0.3, 0.0, 0.6, 0.0, 0.8))},
        keyframes={"home": spo.Keyframe(tree.neutral_q, np.ones(tree.dof_count), np.array([0.5]))},
    )


SCENES = {
    "furnished": furnished,
    "custom hinges": custom_hinges.skeleton,
    "loops": mechanisms.MECHANISMS["far_loop"],
    "two worlds": lambda: zoo.varied(zoo.dancer(), 2),
}


def leaves(value):
    """Return all arrays, numbers and names in a value, in a fixed order."""
    if isinstance(value, dict | types.MappingProxyType):
        return [leaf for name in sorted(value) for leaf in (name, *leaves(value[name]))]
    if isinstance(value, tuple | list):
        return [leaf for one in value for leaf in leaves(one)]
    return leaves(vars(value)) if type(value).__module__.startswith("warp_spo") else [value]


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", SCENES)
def test_a_scene_keeps_every_number_and_nobody_can_write_it(name, way):
    scene = SCENES[name]()
    copied = WAYS[way](scene)
    assert copied is not scene and type(copied) is spo.Scene
    before, after = leaves(scene), leaves(copied)
    assert len(before) == len(after) > 100
    for one, other in zip(before, after, strict=True):
        assert type(one) is type(other)
        np.testing.assert_array_equal(one, other)
    assert not any(array.flags.writeable for array in copied.values.values())
    for mapping in (copied.values, copied.sites, copied.keyframes):
        with pytest.raises(TypeError):
            mapping["body_mass"] = None
    if way == "pickle":
        assert not copied.bodies[0].inertia.flags.writeable and not copied.hinges[0].parent_pose.flags.writeable
    assert copied.with_values(gravity=(0.0, 0.0, -1.0)).values["gravity"][0, 2] == -1.0


def test_a_pose_that_pickle_cannot_store():
    hinge = spo.Hinge.custom(-1, 0, coordinates=1, pose=lambda q: ((q[0], 0.0, 0.0), np.eye(3)), label="knee")
    scene = spo.Scene([spo.Body(1.0)], [hinge])
    words = "Hinge('knee')", "pose is <function", "<lambda>", "expected", "import", "top level of a module"
    with explained(pickle.PicklingError, *words):
        pickle.dumps(scene)
    assert copy.deepcopy(scene).hinges[0].pose is hinge.pose  # the same process can call it


def tensors(dyn, *names):
    s = laws.states(dyn.scene, WORLDS, dtype=dyn.dtype.__name__)
    return [torch.tensor(s[name], dtype=getattr(torch, dyn.dtype.__name__)) for name in names]


@pytest.fixture
def changed():
    """A Dynamics whose values are no longer those of its scene."""
    dyn = spo.Dynamics(zoo.fork(), WORLDS, "cpu", "float64", variable=("body_mass", "gravity"), granularity="node")
    dyn.set(body_mass=np.linspace(0.1, 2.0, WORLDS * 5).reshape(WORLDS, 5) / 3.0, gravity=np.array([0.0, 1.0, -7.0]))
    with pytest.warns(UserWarning, match="folded"):
        dyn.set(joint_armature=np.full(dyn.scene.dof_count, 0.7))
    return dyn


@pytest.mark.parametrize("way", WAYS)
def test_dynamics_keeps_its_values(changed, way):
    copied = WAYS[way](changed)
    q, qd, qdd = tensors(changed, "q", "qd", "qdd")
    expected = changed.inverse_dynamics(q, qd, qdd)
    assert torch.equal(copied.inverse_dynamics(q, qd, qdd), expected)
    assert copied.variable == changed.variable and copied.granularity == "node" and copied.worlds == WORLDS
    copied.set(gravity=np.zeros(3))  # it has memory of its own
    assert torch.equal(changed.inverse_dynamics(q, qd, qdd), expected)
    assert not torch.equal(copied.inverse_dynamics(q, qd, qdd), expected)


def test_a_value_that_is_lost_is_seen(changed):
    """The planted bug: the values are those of the scene alone."""
    build, (kind, scene, options, _, *more) = changed.__reduce__()
    lost = build(kind, scene, options, {}, *more)
    q, qd, qdd = tensors(changed, "q", "qd", "qdd")
    assert not torch.equal(lost.inverse_dynamics(q, qd, qdd), changed.inverse_dynamics(q, qd, qdd))


def test_dynamics_keeps_its_options():
    scene = mechanisms.MECHANISMS["fourbar"]()
    dyn = spo.Dynamics(scene, 2, "cpu", loops="embed")
    copied = copy.deepcopy(dyn)
    assert copied.loops == "embed" and copied.independent_dofs.tolist() == dyn.independent_dofs.tolist()
    refined = pickle.loads(pickle.dumps(spo.Dynamics(zoo.fork(), 2, "cpu", refine=1, granularity="node")))
    assert refined.refine == 1 and refined.dtype is wp.float32

    arguments = set(inspect.signature(spo.Dynamics).parameters) - {"scene"}
    assert arguments == set(refined._options), "an argument of Dynamics that a copy would not have"

    class Own(spo.Dynamics):
        pass

    assert type(copy.copy(Own(zoo.fork(), 2, "cpu", granularity="node"))) is Own


def test_a_device_that_is_not_here(changed):
    build, arguments = changed.__reduce__()
    assert build is pickling.build
    arguments[2]["device"] = "cuda:77"
    with explained(ValueError, "Dynamics", "'cuda:77'", "expected", "'cpu'", "device="):
        build(*arguments)


@pytest.mark.parametrize("way", ["pickle", "deepcopy"])
def test_the_module_keeps_its_parameters_and_gradients(way):
    robot = Module(spo.Dynamics(zoo.fork(), WORLDS, "cpu", variable=("body_mass",), granularity="node"))
    with torch.no_grad():
        robot.body_mass.mul_(1.5)
    q, qd, tau = tensors(robot.dyn, "q", "qd", "tau")
    expected = robot(q, qd, tau)  # the Dynamics now holds the parameter itself
    copied = WAYS[way](robot)
    assert copied.body_mass is not robot.body_mass and copied.dyn is not robot.dyn
    assert copied.dyn.values.tensors["body_mass"] is copied.body_mass
    found = copied(q, qd, tau)
    assert torch.equal(found, expected)
    for result in (expected, found):
        result.square().sum().backward()
    assert torch.equal(copied.body_mass.grad, robot.body_mass.grad) and robot.body_mass.grad.abs().min() > 0.0


def test_a_solver_says_that_it_cannot():
    _, solver = turned_model()
    for way in WAYS.values():
        with explained(TypeError, "SolverSPO", "newton.Model", "solver.dynamics"):
            way(solver)


def test_what_holds_memory_says_what_to_store(changed):
    """Operators and coordinates, which ended in words of ctypes."""
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint/><geom size="0.1"/></body></worldbody></mujoco>'
    )
    q = np.tile(changed.scene.neutral_q, (WORLDS, 1))
    operators, weights = changed.operators(q), [np.eye(2), None, np.eye(2)]
    held = {
        "Operator: .*memory of a device; store op.dense()": [
            operators.H @ operators.phi,
            spo.BWA(spo.Tree([1, -1, 1]), weights, dims=[2, 2, 2]).resolvent(),
        ],
        "operators of a scene: .*call dyn.operators": [operators],
        "Coordinates: .*store the scene and the MjModel": [spo.mujoco.Coordinates(spo.from_mujoco(model), model)],
    }
    for words, things in held.items():
        for thing in things:
            for way in WAYS.values():
                with pytest.raises(TypeError, match=words):
                    way(thing)


def test_a_spawned_worker(changed):
    """A process that shares nothing with this one: the method goes there, a result comes back."""
    q, qd, qdd = (x.numpy() for x in tensors(changed, "q", "qd", "qdd"))
    spawn = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(1, mp_context=spawn) as pool:
        found = pool.submit(changed.inverse_dynamics, q, qd, qdd).result(timeout=300)
    np.testing.assert_array_equal(found, changed.inverse_dynamics(q, qd, qdd))
