"""Laws are worth what they catch: each bug is planted in a kernel, and the named law must fail."""

import laws
import numpy as np
import pytest
import zoo
from laws import TOLERANCE
from mutants import mutant

import warp_spo as spo
from warp_spo import blocks, levels

WORLDS = 3


@pytest.fixture
def plant(monkeypatch, tmp_path):
    """``plant(host, file, old, new)``: from here on, ``host`` launches the mutant of that kernel file."""

    def plant(host, file, old, new):
        monkeypatch.setattr(host, file, mutant(tmp_path, file, old, new))

    return plant


def dynamics(device, name="tree20"):
    scene = zoo.SCENES[name]()
    return spo.Dynamics(scene, WORLDS, device=device, dtype="float64", granularity="node"), laws.states(scene, WORLDS)


def resolvent(device):
    rng = np.random.default_rng(0)
    parent = [-1, 0, 0, 1, 1, 2]
    weights = [None] + [rng.normal(size=(WORLDS, 2 + p, 2 + k)) for k, p in enumerate(parent) if p >= 0]
    return spo.BWA(spo.Tree(parent), weights, device=device).resolvent()


def test_a_wrong_adjoint(plant, device):
    """A product that forgets part of each block in one direction only: rows that a transpose reads by columns."""
    laws.adjoint(resolvent(device), WORLDS, 1e-12)
    plant(blocks, "block_sparse", "for k in range(entry[1]):", "for k in range(wp.where(entry[4] == 1, entry[1], 1)):")
    with pytest.raises(AssertionError):
        laws.adjoint(resolvent(device), WORLDS, 1e-12)


def test_an_unwritten_output(plant, device):
    """The first degree of freedom is left as it was."""
    dyn, arrays = dynamics(device)
    laws.every_entry_is_written(dyn, "inverse_dynamics", arrays)
    plant(
        levels,
        "newton_euler",
        "            tau_out[world, dof] = tau",
        "            if dof > 0:\n                tau_out[world, dof] = tau",
    )
    dyn, arrays = dynamics(device)
    with pytest.raises(AssertionError):
        laws.every_entry_is_written(dyn, "inverse_dynamics", arrays)


def test_worlds_that_leak_into_each_other(plant, device):
    dyn, arrays = dynamics(device)
    laws.worlds_do_not_touch_each_other(dyn, "inverse_dynamics", arrays)
    plant(
        levels,
        "kinematics",
        "dw, dv = s.load(acceleration_out, parent, 0, world), ",
        "dw, dv = s.load(acceleration_out, parent, 0, wp.max(world - 1, 0)), ",
    )
    dyn, arrays = dynamics(device)
    with pytest.raises(AssertionError):
        laws.worlds_do_not_touch_each_other(dyn, "inverse_dynamics", arrays)


def test_a_wrong_gyroscopic_sign(plant, device):
    """It does no work and forward dynamics shares it: only an independent bias force sees it."""
    dyn, arrays = dynamics(device, "screw_tree")
    laws.bias_force_is_christoffel(dyn, arrays, 1e-6)
    plant(
        levels,
        "newton_euler",
        "            n += wp.cross(w, inertia * w)\n            f += wp.cross(w, wp.cross(w, moment))",
        "            n -= wp.cross(w, inertia * w)\n            f -= wp.cross(w, wp.cross(w, moment))",
    )
    dyn, arrays = dynamics(device, "screw_tree")
    laws.forward_undoes_inverse_dynamics(dyn, arrays, TOLERANCE["float64"])  # blind, as theory says
    with pytest.raises(AssertionError):
        laws.bias_force_is_christoffel(dyn, arrays, 1e-6)
    with pytest.raises(AssertionError):
        laws.equals_reference(dyn, "bias_force", arrays, TOLERANCE["float64"])


@pytest.mark.parametrize(
    "file, operation",
    [("articulated", "log_det_mass_matrix"), ("newton_euler", "inverse_dynamics"), ("composite", "mass_matrix")],
)
def test_a_missing_child(plant, file, operation, device):
    """A node that gathers from all its children but the last."""
    dyn, arrays = dynamics(device)
    laws.equals_reference(dyn, operation, arrays, TOLERANCE["float64"])
    old = "for c in range(topology.child_start[node], topology.child_start[node + 1]):"
    plant(levels, file, old, old.replace("topology.child_start[node + 1]", "topology.child_start[node + 1] - 1"))
    dyn, arrays = dynamics(device)
    with pytest.raises(AssertionError):
        laws.equals_reference(dyn, operation, arrays, TOLERANCE["float64"])


def test_a_missing_child_of_the_operators(plant, device):
    A = resolvent(device)
    laws.sweep_is_the_dense_resolvent(A, WORLDS, 1e-13)
    plant(
        blocks,
        "block_sparse",
        "for index in range(row[1], row[2]):",
        "for index in range(row[1], wp.min(row[2], row[1] + 1)):",
    )
    with pytest.raises(AssertionError):
        laws.sweep_is_the_dense_resolvent(resolvent(device), WORLDS, 1e-13)
