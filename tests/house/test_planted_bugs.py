"""Laws are worth what they catch: each bug is planted in a kernel, and the named law must fail."""

import numpy as np
import pytest

import warp_spo as spo
from support import laws, symbolic, warp_machine, zoo
from support.laws import TOLERANCE
from support.mutants import mutant
from support.routines import ROUTINES
from warp_spo.execution.node import functions as node_functions
from warp_spo.execution.node import sweeps
from warp_spo.execution.segment import schedule, shared_code, warp_specialized
from warp_spo.graph import blocks
from warp_spo.kernels import straight_line
from warp_spo.recursions import articulated, articulated_sweeps, mass_matrix_inverse, newton_euler
from warp_spo.recursions.model import links, messages, segments
from warp_spo.trace import scalars, spatial

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
        sweeps,
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
        sweeps,
        "kinematics",
        "alpha = s.load_motion(acceleration_out, parent, world)",
        "alpha = s.load_motion(acceleration_out, parent, wp.max(world - 1, 0))",
    )
    dyn, arrays = dynamics(device)
    with pytest.raises(AssertionError):
        laws.worlds_do_not_touch_each_other(dyn, "inverse_dynamics", arrays)


def test_a_wrong_gyroscopic_sign(monkeypatch, device):
    """It does no work and forward dynamics shares it: only an independent bias force sees it."""
    dyn, arrays = dynamics(device, "screw_tree")
    laws.bias_force_is_christoffel(dyn, arrays, 1e-6)
    symbolic.plant(monkeypatch, newton_euler, "body_force", "+ cross(motion.spin", "- cross(motion.spin")
    monkeypatch.setattr(sweeps, "node_functions", node_functions.NodeFunctions)
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
    plant(sweeps, file, old, old.replace("topology.child_start[node + 1]", "topology.child_start[node + 1] - 1"))
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


# -- the traced path ---------------------------------------------------------------------------------------------------
def traced_error(operation, given, name="screw_tree", scale=1.0):
    """Of an operation's trace, evaluated by NumPy, against the dense reference."""
    scene = zoo.SCENES[name]()
    arrays = laws.states(scene, WORLDS)
    zero = {key: value if key in ("q", *given) else np.zeros_like(value) for key, value in arrays.items()}
    zero["b"] = zero["b"][:, :, 0]
    wanted = np.array([np.asarray(laws.OPERATIONS[operation][1](spo.reference.Dense(scene, zero["q"][w]), {
        key: value[w] for key, value in zero.items()})) for w in range(WORLDS)])  # fmt: skip
    got = symbolic.run(scene, operation, zero, ("q", *given), {"out": wanted.shape[1:]})["out"]
    return laws.error(np.nan_to_num(got, nan=0.0 if operation == "mass_matrix" else np.nan), wanted)


MUTANTS = {
    "gyroscopic moment": (newton_euler, "body_force", "+ cross(motion.spin", "- cross(motion.spin",
                          "inverse_dynamics", ("qd", "qdd")),
    "gyroscopic moment of qdd": (articulated, "gyroscopic", "*cross(motion.spin, inertia.inertia @ motion.spin)",
                                 "*(-cross(motion.spin, inertia.inertia @ motion.spin))", "forward_dynamics", ("qd",)),
    "mirror of P": (spatial.Articulated, "entry", "self.C[j][i - 3]", "self.C[i - 3][j]", "forward_dynamics", ("tau",)),
    "mirror of the output": (articulated_sweeps, "mirror", "place, value)",
                             "place, value if place == (i, j) else -value)", "mass_matrix", ()),
    "mirror of a symmetric matrix": (links, "symmetric", "[xz, yz, zz]", "[yz, xz, zz]", "inverse_dynamics", ("qd",)),
    "turn the wrong way": (spatial.Pose, "to_child", "c * v[1] - s * v[0]", "c * v[1] + s * v[0]",
                           "inverse_dynamics", ("qdd",)),
    "a sign lost in folding": (scalars, "multiply", "!= (y.op", "and (y.op", "inverse_dynamics", ("qd", "qdd")),
    "a pivot out of order": (articulated, "reduce_link", "given[::-1]", "given", "forward_dynamics", ("tau",)),
}  # fmt: skip


@pytest.mark.parametrize("bug", MUTANTS)
def test_a_wrong_step(bug, monkeypatch):
    owner, name, old, new, operation, given = MUTANTS[bug]
    scene = "tree10"  # hinges of every kind
    assert traced_error(operation, given, scene) <= TOLERANCE["float64"]
    symbolic.plant(monkeypatch, owner, name, old, new)
    assert not traced_error(operation, given, scene) <= TOLERANCE["float64"]


def team_error(monkeypatch, operation="forward_dynamics", name="star"):
    """Of the CUDA text of a scene's warps, against the dense reference; raises Race."""
    texts = warp_machine.recorded(monkeypatch)
    monkeypatch.setattr(straight_line, "SHARED_BYTES", 1 << 20)
    scene = zoo.SCENES[name]()
    dyn = spo.Dynamics(scene, WORLDS, device="cpu", dtype="float64", granularity="segment")
    arrays = laws.states(scene, WORLDS)
    given = {"forward_dynamics": ("q", "qd", "tau"), "mass_matrix_inverse": ("q",)}.get(operation, ("q", "qd", "qdd"))
    arrays["body_f"][:] = 0.0
    wanted = np.array([laws.expected(dyn, operation, arrays, w) for w in range(WORLDS)])
    dyn.programs.find(ROUTINES[operation], {name: arrays[name].shape for name in given}, wanted.shape)
    assert texts[-1].frame.warps > 1
    return laws.error(warp_machine.run(texts[-1], arrays).reshape(wanted.shape), wanted)


TEAM_MUTANTS = {
    "a slot too near": (messages, "offsets", "at += size(letter, segment)", "at += size(letter, segment) - 1"),
    "no barrier before the trunk": (schedule.Schedule, "_hand_over",
                                    "inward[child.index] + (warp[child.index] != warp[segment.index])",
                                    "inward[child.index]"),
    "no barrier after the trunk": (schedule.Schedule, "_outward_stages",
                                   "stages[above.index] + (self._warp[segment.index] != self._warp[above.index])",
                                   "stages[above.index]"),
    "another limb's entries": (shared_code.SharedCode, "_distances", "who * {step}", "who * {step + 1}"),
    "another limb's constants": (shared_code.SharedCode, "merge", "zip(*constants.columns, strict=True)",
                                 "[*zip(*constants.columns, strict=True)][::-1]"),
}  # fmt: skip


@pytest.mark.parametrize("bug", TEAM_MUTANTS)
def test_a_wrong_team(bug, monkeypatch):
    """Bugs in what warps exchange: the wrong value, the wrong time, the wrong limb's numbers."""
    for name in ("star", "fork"):
        assert team_error(monkeypatch, name=name) <= TOLERANCE["float64"]
    symbolic.plant(monkeypatch, *TEAM_MUTANTS[bug])
    seen = []
    for name in ("star", "fork"):
        try:
            seen.append(not team_error(monkeypatch, name=name) <= TOLERANCE["float64"])
        except warp_machine.Race:
            seen.append(True)
    assert any(seen)


INVERSE_MUTANTS = {
    "another column": (
        mass_matrix_inverse.Inverse,
        "_meet",
        "sent[length * at : length * at + common]",
        "sent[:common]",
    ),
    "what lies further in": (
        mass_matrix_inverse.Inverse,
        "_come_back",
        "[dot(row, force) for row in N]",
        "[0.0 for row in N]",
    ),
    "parted too early": (
        segments.Segment,
        "common_ancestor",
        "(other, *other.ancestors)",
        "reversed((other, *other.ancestors))",
    ),
    "no barrier before they meet": (warp_specialized.WarpSpecializedKernel, "cuda", "BARRIER,\n", ""),
    "another limb's turns": (shared_code.SharedCode, "take_turns", "initial=0", "initial=1"),
    "a turn too few": (
        shared_code.SharedCode,
        "take_turns",
        "counts.values())}; ++each",
        "[n - 1 for n in counts.values()])}; ++each",
    ),
}


@pytest.mark.parametrize("bug", INVERSE_MUTANTS)
def test_a_wrong_inverse(bug, monkeypatch):
    """Branches that meet where limbs part, and part again, in loops."""
    monkeypatch.setattr(shared_code, "CACHED", 0)
    assert team_error(monkeypatch, "mass_matrix_inverse", "dancer") <= TOLERANCE["float64"]
    symbolic.plant(monkeypatch, *INVERSE_MUTANTS[bug])
    try:
        assert not team_error(monkeypatch, "mass_matrix_inverse", "dancer") <= TOLERANCE["float64"]
    except (warp_machine.Race, IndexError):  # beyond the tables
        pass
