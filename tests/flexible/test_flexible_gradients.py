"""Calls on a scene with modes: gradients by torch, copies, arrays of every kind, status words, and refusals by name."""

import copy
import functools
import pickle

import numpy as np
import pytest
import torch
import warp as wp
from torch.autograd import gradcheck

import warp_spo as spo

WORLDS, DT = 2, 0.01
VALUES = ("joint_stiffness", "joint_damping")
H, DIFFERENCED = 1e-6, 1e-6  # step; error of central differences beside the largest entry, 1e-8 here
check = functools.partial(gradcheck, atol=1e-5, rtol=1e-4)  # accelerations are large: rounding over the step is 1e-7


def scene():
    """A beam with two modes on a hinge, and a load on a second hinge at its tip."""
    beam = spo.beam_modes(1.0, spo.Section.rectangle(0.01, 0.02), spo.Material(2700.0, 7e7), count={"y": 1, "z": 1},
                          points=3, rotary=False, damping_ratio=0.05)  # fmt: skip
    hinges = [
        spo.Hinge("revolute", -1, 0, axis=(0, 0, 1), damping=0.1, armature=0.1),
        spo.Hinge("revolute", 0, 1, axis=(0, 1, 0), parent_pose=(1.0, 0, 0, 0, 0, 0, 1)),
    ]
    load = spo.Body(0.2, (0.1, 0, 0), 1e-3 * np.eye(3), label="load")
    return spo.Scene([spo.Body(*beam.rigid, modes=beam, label="beam"), load], hinges)


def state():
    rng = np.random.default_rng(3)
    return tuple(scale * rng.normal(size=(WORLDS, 4)) for scale in (0.05, 0.3, 0.5))


@pytest.fixture(scope="module")
def dyn(device):
    return spo.Dynamics(scene(), WORLDS, device, "float64", variable=VALUES)


def leaf(dyn, *arrays):
    return [torch.tensor(x, device=wp.device_to_torch(dyn.device), requires_grad=True) for x in arrays]


def test_gradients_by_modal_stiffness_and_damping(dyn):
    """Of each world's own values, through two steps."""
    given = leaf(dyn, *(np.tile(dyn.scene.values[name], (WORLDS, 1)) for name in VALUES))
    q, qd, tau = (x.detach() for x in leaf(dyn, *state()))

    def run(stiffness, damping):
        dyn.set(joint_stiffness=stiffness, joint_damping=damping)
        ends = dyn.step(*dyn.step(q, qd, tau, DT), tau, DT)
        return torch.cat(ends, 1)

    found = torch.autograd.functional.jacobian(run, tuple(given))
    for k, rows in enumerate(found):
        for world, dof in np.ndindex(WORLDS, 4):
            ends = []
            for sign in (1.0, -1.0):
                moved = [x.detach().clone() for x in given]
                moved[k][world, dof] += sign * H
                ends.append(run(*moved))
            wanted = (ends[0] - ends[1]) / (2.0 * H)
            assert (rows[..., world, dof] - wanted).abs().max() <= DIFFERENCED * wanted.abs().max()
    dyn.set(**{name: dyn.scene.values[name][0] for name in VALUES})


def test_gradients_by_arguments(dyn):
    assert check(lambda q, qd, tau: dyn.forward_dynamics(q, qd, tau), leaf(dyn, *state()))
    assert check(lambda q, qd, tau: dyn.step(q, qd, tau, DT), leaf(dyn, *state()))


def test_copies_compute_the_same(dyn):
    wanted = dyn.forward_dynamics(*state())
    for made in (copy.deepcopy(dyn.scene), pickle.loads(pickle.dumps(dyn.scene))):
        other = spo.Dynamics(made, WORLDS, dyn.device, "float64", variable=VALUES)
        np.testing.assert_array_equal(other.forward_dynamics(*state()), wanted)
        np.testing.assert_array_equal(made.bodies[0].modes.stiffness, dyn.scene.bodies[0].modes.stiffness)


def test_arrays_of_every_kind_and_own_results(dyn):
    wanted = dyn.forward_dynamics(*state())
    tensors = [x.detach() for x in leaf(dyn, *state())]
    np.testing.assert_array_equal(dyn.forward_dynamics(*tensors).cpu().numpy(), wanted)
    arrays = [wp.array(x, dtype=wp.float64, device=dyn.device) for x in state()]
    empty = wp.full((WORLDS, 4), np.nan, wp.float64, device=dyn.device)
    for like, given in ((empty, arrays), (torch.full_like(tensors[0], np.nan), tensors)):
        assert dyn.forward_dynamics(*given, out=like) is like
        np.testing.assert_array_equal(like.numpy() if like is empty else like.cpu().numpy(), wanted)
    own = np.full((WORLDS, 4), np.nan)
    assert dyn.forward_dynamics(*state(), out=own) is own
    np.testing.assert_array_equal(own, wanted)


def test_status_of_a_world_that_is_not_finite(dyn):
    q, qd, tau = state()
    q[1, 2] = np.nan  # an amplitude
    status = wp.full(WORLDS, -1, dtype=wp.int32, device=dyn.device)
    found = dyn.forward_dynamics(q, qd, tau, status=status)
    assert status.numpy().tolist() == [spo.Status.OK, spo.Status.NOT_FINITE]
    assert np.isfinite(found[0]).all() and np.isnan(found[1]).all()


@pytest.mark.parametrize("granularity", ["node", "segment"])
def test_other_granularities_are_refused_by_name(granularity):
    with pytest.raises(spo.UnsupportedError, match=granularity) as error:
        spo.Dynamics(scene(), WORLDS, "cpu", "float64", granularity=granularity)
    assert "tree" in str(error.value)


def modes(**values):
    given = dict(mass=np.eye(2), stiffness=[1.0, 2.0], coupling=np.zeros((6, 2)))
    return spo.Modes(**given | values)


@pytest.mark.parametrize(
    ("values", "parts"),
    [
        (dict(coupling=np.zeros((3, 2))), ("Modes", "coupling", "(3, 2)", "(6, 2)")),
        (dict(mass=np.ones((2, 3))), ("Modes", "mass", "(2, 3)")),
        (dict(mass=None), ("Modes", "mass", "points=MassPoints")),
        (dict(mass=[[1.0, 0.5], [0.0, 1.0]]), ("Modes", "mass", "symmetric")),
        (dict(stiffness=None), ("Modes", "stiffness is missing", "(n,)")),
        (dict(stiffness=[[1.0, 0.1], [0.1, 2.0]]), ("Modes", "stiffness", "diagonal")),
        (dict(damping=[1.0, 2.0, 3.0]), ("Modes", "damping", "(3,)")),
        (dict(slopes={"load": np.zeros((3, 2))}), ("Modes", "slopes", "load", "(3, 2)", "(6, 2)")),
    ],
)
def test_mistaken_modes_are_named(values, parts):
    with pytest.raises(ValueError) as error:
        modes(**values)
    assert all(part in str(error.value) for part in (*parts, "expected")), error.value


@pytest.mark.parametrize(
    ("values", "parts"),
    [
        (dict(slopes={"lod": np.zeros((6, 2)), "load": np.zeros((6, 2))}), ("'lod'", "no child and no site", "'load'")),
        (dict(), ("'load'", "has no slopes", "Modes(slopes=")),
        (dict(mass=-np.eye(2), slopes={"load": np.zeros((6, 2))}), ("'beam'", "eigenvalue", "correct mass")),
    ],
)
def test_modes_that_do_not_suit_their_body_are_named(values, parts):
    bodies = [spo.Body(1.0, inertia=np.eye(3), modes=modes(**values), label="beam"), spo.Body(1.0, label="load")]
    with pytest.raises(ValueError) as error:
        spo.Scene(bodies, [spo.Hinge("revolute", k - 1, k, axis=(0, 0, 1)) for k in range(2)])
    assert all(part in str(error.value) for part in (*parts, "expected")), error.value
