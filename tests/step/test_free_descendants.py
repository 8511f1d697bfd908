"""A free hinge below a parent that moves: the body keeps its inertial velocity, as it does without the parent."""

import numpy as np
import pytest
import torch
import warp as wp

import warp_spo as spo
from support import laws, zoo
from warp_spo.reference.dense import Dense
from warp_spo.reference.rotations import homogeneous, pose7

DT = 1e-2
FAR = spo.Contact(0, sphere=((0.0, 0.0, 0.0), 0.01))  # of the parent: one of the body would keep its rates


def carried(parent, contacts=()):
    """A body on a free hinge that is placed askew on a body on a hinge of kind ``parent``; state, the body at rest."""
    rng = np.random.default_rng(3)
    axis = dict(axis=(0.36, 0.48, 0.8)) if parent == "revolute" else {}
    poses = [dict(parent_pose=zoo.random_pose(rng), child_pose=zoo.random_pose(rng)) for _ in range(2)]
    hinges = [spo.Hinge(parent, -1, 0, **axis, **poses[0]), spo.Hinge("free", 0, 1, **poses[1])]
    scene = spo.Scene([zoo.random_body(rng), zoo.random_body(rng)], hinges, gravity=(0, 0, 0), contacts=contacts)
    q, qd = zoo.random_state(scene, 1, 4).q[0], np.zeros(scene.dof_count)
    first = scene.qd_start[1]
    qd[:first] = 3.0 * rng.normal(size=first)
    if parent == "free" and contacts:
        q[2] += 100.0  # the ground is out of reach
    J = Dense(scene, q).jacobian([1])[0]
    qd[first:] = -np.linalg.solve(J[:, first:], J[:, :first] @ qd[:first])
    return scene, q, qd


@pytest.mark.parametrize("variable", [(), ("joint_damping",)], ids=["constant", "variable"])
@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize(("parent", "contacts"), [("revolute", ()), ("free", ()), ("ball", ()), ("free", (FAR,))])
def test_a_body_at_rest_stays_at_rest(parent, contacts, dtype, variable, device):
    """Whatever its parent does, to rounding; before, its speed was up to 4e-3 of the parent's after a step of 10 ms."""
    scene, q, qd = carried(parent, contacts)
    dyn = spo.Dynamics(scene, 1, device=device, dtype=dtype, variable=variable)
    after, rates = dyn.step(q[None], qd[None], None, DT)
    dense = Dense(scene, np.float64(after[0]))
    parent_speed = np.abs(dense.jacobian([0])[0] @ np.float64(rates[0])).max()
    rounding = 100.0 * np.finfo(dtype).eps * (100.0 if contacts else 1.0)
    assert np.abs(dense.jacobian([1])[0] @ np.float64(rates[0])).max() <= rounding * max(parent_speed, 1.0)
    assert np.abs(dense.body_matrix[1] - Dense(scene, q).body_matrix[1]).max() <= rounding


@pytest.mark.parametrize("parent", ["revolute", "free"])
def test_it_moves_as_without_its_parent(parent, device):
    """Under gravity and a wrench, as on a free hinge of the inertial frame: ten steps, to rounding."""
    scene, q, qd = carried(parent)
    rng, first, at = np.random.default_rng(5), scene.qd_start[1], scene.q_start[1]
    qd[first:] = rng.normal(size=6)
    gravity = (1.0, -2.0, 3.0)
    scene = scene.with_values(gravity=gravity)
    force = rng.normal(size=6)
    body_f = np.zeros((1, 2, 6))
    body_f[0, 1] = force
    dense = Dense(scene, q)
    alone = spo.Scene(
        [scene.bodies[1]], [spo.Hinge("free", -1, 0, child_pose=scene.hinges[1].child_pose)], gravity=gravity
    )
    inner = homogeneous(scene.hinges[1].child_pose)
    own_q = pose7(dense.body_matrix[1] @ inner)[None]
    own_qd = np.linalg.solve(Dense(alone, own_q[0]).jacobian([0])[0], dense.jacobian([1])[0] @ qd)[None]
    one, other = (spo.Dynamics(each, 1, device=device, dtype="float64") for each in (scene, alone))
    q, qd = q[None], qd[None]
    for _ in range(10):
        q, qd = one.step(q, qd, None, DT, body_f=body_f)
        own_q, own_qd = other.step(own_q, own_qd, None, DT, body_f=body_f[:, 1:])
    assert at == len(q[0]) - 7
    both = Dense(scene, q[0]), Dense(alone, own_q[0])
    assert laws.error(both[0].body_matrix[1], both[1].body_matrix[0]) <= 1e-12
    assert laws.error(both[0].jacobian([1])[0] @ qd[0], both[1].jacobian([0])[0] @ own_qd[0]) <= 1e-12


def test_gradients_know_how_it_is_carried(device):
    """Those of a step, by differences of it along tau and qd."""
    scene, q, qd = carried("revolute")
    dyn, rng = spo.Dynamics(scene, 1, device=device, dtype="float64"), np.random.default_rng(6)
    weight = rng.normal(size=(2, len(q)))
    state = {"qd": qd[None], "tau": rng.normal(size=(1, scene.dof_count))}

    def value(**given):
        after, rates = dyn.step(q[None], given["qd"], given["tau"], DT)
        return after @ weight[0] + rates @ weight[1, : scene.dof_count]

    on = dict(device=wp.device_to_torch(device))
    given = {name: torch.tensor(array, requires_grad=True, **on) for name, array in state.items()}
    after, rates = dyn.step(torch.tensor(q[None], **on), given["qd"], given["tau"], DT)
    (after @ torch.tensor(weight[0], **on) + rates @ torch.tensor(weight[1, : scene.dof_count], **on)).sum().backward()
    for name, array in state.items():
        along, h = rng.normal(size=array.shape), 1e-5
        slope = (value(**{**state, name: array + h * along}) - value(**{**state, name: array - h * along})) / (2.0 * h)
        assert laws.error((given[name].grad.cpu().numpy() * along).sum(), slope[0]) <= 1e-8


@pytest.mark.parametrize("variable", [(), ("joint_stiffness", "joint_damping")], ids=["constant", "variable"])
@pytest.mark.parametrize("law", [dict(stiffness=1e6, damping=1e3), dict(target_ke=1e6, target_kd=1e3)])
def test_stiff_laws_of_its_hinge_hold_it(law, variable, device):
    """On a fast turntable, w h = 0.3, a spring's deflection is that of the centrifugal force, m r w^2 / k."""
    mass, radius, speed = 1.0, 0.5, 30.0
    bodies = [spo.Body(mass, inertia=0.01 * np.eye(3)) for _ in range(2)]
    hinges = [
        spo.Hinge("revolute", -1, 0, axis=(0, 0, 1), armature=1e6),
        spo.Hinge("free", 0, 1, parent_pose=(radius, 0, 0, 0, 0, 0, 1), **law),
    ]
    scene = spo.Scene(bodies, hinges, gravity=(0, 0, 0))
    given = {name: scene.values[name] for name in variable}
    bare = scene.with_values(**{name: np.zeros(scene.dof_count) for name in variable})  # laws that come later
    dyn = spo.Dynamics(bare, 1, device=device, dtype="float64", variable=variable)
    if variable:
        dyn.set(**given)
    q, qd = scene.neutral_q[None], np.eye(1, scene.dof_count) * speed
    for _ in range(100):
        q, qd = dyn.step(q, qd, None, DT)
    np.testing.assert_allclose(
        q[0, 1:4], [mass * radius * speed**2 / 1e6, 0.0, 0.0], atol=5e-6
    )  # it turns by w h a step
