"""A scene pays for what it has: operations, arrays and kernel arguments of its programs, counted."""

import itertools

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from benchmarks.table import cases
from support import laws, zoo
from support.quick import slow_unless
from support.routines import ROUTINES
from warp_spo.execution.parameters import VARIABLE
from warp_spo.recursions.model.links import MOTION_VALUES

GIVEN = {"forward_dynamics": ("qd", "tau"), "inverse_dynamics": ("qd", "qdd"), "solve_mass_matrix": ("b",),
         "mass_matrix": (), "mass_matrix_inverse": (), "log_det_mass_matrix": ()}  # fmt: skip
ALIGNED, PLANAR = 0.55, 0.20  # of the operations of the same arm with skewed axes


def program(scene, operation, given=None, granularity="tree", worlds=1, **options):
    """The program of an operation, traced but not compiled."""
    dyn = spo.Dynamics(scene, worlds, device="cpu", granularity=granularity, **options)
    rate = (worlds, scene.dof_count)
    shapes = {name: rate for name in (GIVEN[operation] if given is None else given)}
    shapes |= {"body_f": (worlds, scene.body_count, 6)} if "body_f" in shapes else {}
    out = {"log_det_mass_matrix": (worlds,), "mass_matrix": (*rate, rate[1]), "mass_matrix_inverse": (*rate, rate[1])}
    return dyn.programs.find(ROUTINES[operation], {"q": (worlds, scene.coord_count)} | shapes, out.get(operation, rate))


def count(scene, operation, *given, **options):
    return program(scene, operation, *given, **options).operations


# -- what a scene does not have ----------------------------------------------------------------------------------------
FULL = np.array([[0.012, 0.001, -0.002], [0.001, 0.013, 0.0015], [-0.002, 0.0015, 0.004]])
SKEWED = zoo.unit(np.random.default_rng(0), 7, 3)


def arm(n=7, axes=SKEWED, inertia=FULL, com=(0.01, -0.02, 0.125), offset=(0.01, 0.03, 0.25), gravity=(0.1, 0.2, -9.8),
        armature=0.01):  # fmt: skip
    hinges = [spo.Hinge("revolute", k - 1, k, axis=axes[k % len(axes)], parent_pose=(*offset, 0, 0, 0, 1),
                        armature=armature) for k in range(n)]  # fmt: skip
    return spo.Scene([spo.Body(2.0, com, inertia) for _ in range(n)], hinges, gravity=gravity)


def of_arm7(axes):
    """The arm of the benchmarks about other axes."""
    return arm(axes=axes, inertia=np.diag([0.012, 0.012, 0.002]), com=(0, 0, 0.125), offset=(0, 0, 0.25),
               gravity=(0, 0, -9.81))  # fmt: skip


LESS = {
    "planar": dict(axes=np.eye(3)[[1]]),
    "aligned axes": dict(axes=np.eye(3)[[2, 1]]),
    "no gravity": dict(gravity=(0, 0, 0)),
    "no armature": dict(armature=0.0),
    "diagonal inertias": dict(inertia=np.diag(np.diag(FULL)), com=(0, 0, 0)),
    "no offset of the CoM": dict(com=(0, 0, 0)),
    "no offset of the anchors": dict(offset=(0, 0, 0)),
}
ONLY = {"no gravity": ("forward_dynamics", "inverse_dynamics"), "no armature": ("inverse_dynamics", "mass_matrix")}


@pytest.mark.parametrize(
    ("less", "granularity"),
    slow_unless(
        [*itertools.product(LESS, ["tree"]), ("aligned axes", "segment")], itertools.product(LESS, ["tree", "segment"])
    ),
)
def test_less_costs_less(less, granularity):
    """Of two arms side by side on aligned axes, so that nothing else hides what is saved; every operation counts."""
    generic = dict(axes=np.eye(3)[[2, 1]]) if less == "diagonal inertias" else {}

    def pair(**options):
        one = arm(4, **options)
        bodies, first = [*one.bodies, *one.bodies], list(one.hinges)
        second = [spo.Hinge("revolute", 4 + k - 1 if k else -1, 4 + k, axis=hinge.axis, parent_pose=hinge.parent_pose,
                            armature=hinge.armature) for k, hinge in enumerate(first)]  # fmt: skip
        return spo.Scene(bodies, first + second, gravity=one.values["gravity"][0])

    for operation in ONLY.get(less, GIVEN):
        scenes = pair(**generic), pair(**(generic | LESS[less]))
        before, after = (count(scene, operation, granularity=granularity) for scene in scenes)
        assert after < before, f"{operation}: {after} operations, {before} without saving"


def test_an_arm_with_armature_pays_for_it_alone():
    """An addition for each hinge in the mass matrix, a multiplication too in inverse dynamics; some fold."""
    for operation, each in (("mass_matrix", 1), ("inverse_dynamics", 2)):
        assert 4 * each < count(arm(), operation) - count(arm(armature=0.0), operation) <= 7 * each


def test_what_is_not_given_costs_nothing():
    scene = arm()
    everything, still = count(scene, "forward_dynamics", ("qd", "tau", "body_f")), {}
    for given in ((), ("qd",), ("tau",), ("qd", "tau"), ("body_f",)):
        found = program(scene, "forward_dynamics", given)
        assert set(found.rows) == {"q", *given}  # no kernel argument either
        still[given] = found.operations
    assert still[()] < still["qd",] < still["qd", "tau"] < everything
    assert still["qd", "tau"] - still["qd",] == 7  # a difference at each hinge
    assert still["tau",] < still["qd",]
    gravity = count(scene, "inverse_dynamics", ())
    assert gravity < 0.6 * count(scene, "inverse_dynamics", ("qd",)) < count(scene, "inverse_dynamics", ("qd", "qdd"))


def test_nothing_at_all():
    """Without gravity, velocity and force nothing moves, and nothing is computed."""
    for operation in ("forward_dynamics", "inverse_dynamics"):
        found = program(arm(gravity=(0, 0, 0)), operation, ())
        assert found.operations == 0 and found.rows == () and found.fields == ()


@pytest.mark.parametrize(
    "operation", ["forward_dynamics", "inverse_dynamics", "mass_matrix", "solve_mass_matrix", "log_det_mass_matrix"]
)
def test_an_arm_whose_axes_are_aligned(operation):
    skewed = count(of_arm7(SKEWED), operation)
    aligned, planar = (count(of_arm7(np.eye(3)[axes]), operation) for axes in ([2, 1], [1]))
    assert aligned <= ALIGNED * skewed, f"{aligned / skewed:.1%}"
    assert planar <= PLANAR * skewed, f"{planar / skewed:.1%}"


def test_bodies_that_do_not_move_cost_nothing():
    """A fixed body before the arm, between its links and at its tip, whose inertia adds to a link's."""
    scene, turned = arm(3), (0.1, 0.2, 0.3, 0.5, 0.5, 0.5, 0.5)
    bodies = [*scene.bodies, *(spo.Body(1.0, (0.1, 0.2, 0.3), FULL) for _ in range(3))]
    moved = [spo.Hinge("revolute", (3, 0, 4)[k], k, axis=h.axis, parent_pose=h.parent_pose, armature=h.armature)
             for k, h in enumerate(scene.hinges)]  # fmt: skip
    fixed = [spo.Hinge("fixed", parent, child, parent_pose=turned) for child, parent in ((3, -1), (4, 1), (5, 2))]
    more = spo.Scene(bodies, moved + fixed, gravity=scene.values["gravity"][0])
    for operation in GIVEN:
        assert count(more, operation) <= count(scene, operation)
    several = [spo.Hinge("fixed", 2, 3 + k) for k in range(3)]
    assert count(spo.Scene(bodies, [*scene.hinges, *several]), "mass_matrix") == count(scene, "mass_matrix")


# -- arrays and arguments ----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", VARIABLE)
def test_what_varies_is_an_argument_and_nothing_else(name):
    found = program(arm(), "forward_dynamics", variable=(name,))
    assert found.fields == (("value",) if name in MOTION_VALUES else ())
    arguments = [argument.label for argument in found.kernel.adj.args]
    assert set(arguments) == {"worlds", "q", "qd", "tau", "out", *found.fields}


def test_nothing_that_varies_is_no_argument():
    assert program(arm(), "forward_dynamics").fields == ()


def test_what_differs_between_worlds_is_an_argument_and_nothing_else():
    scene = arm()
    masses = scene.with_values(body_mass=np.linspace(1, 2, 21).reshape(3, 7))
    assert program(masses, "forward_dynamics", worlds=3).fields == ("value",)
    assert program(masses, "inverse_dynamics", (), worlds=3).rows == ("q",)
    gravity = scene.with_values(gravity=np.linspace(-9, -8, 9).reshape(3, 3))
    assert program(gravity, "forward_dynamics", worlds=3).fields == ("value",)
    assert program(gravity, "mass_matrix", worlds=3).fields == ()


def test_kernels_of_a_scene_leave_no_workspace(device):
    """Nothing of node granularity is allocated where every operation has a program."""
    scene = arm(2)
    dyn = spo.Dynamics(scene, 3, device=device, granularity="tree")
    arrays = laws.states(scene, 3)
    arrays["b"] = arrays["b"][:, :, 0].copy()
    for operation in GIVEN:
        laws.equals_reference(dyn, operation, arrays, laws.TOLERANCE["float32"])
    assert dyn.recursions.workspace_bytes == 0


def test_nothing_at_all_is_zero(device):
    dyn = spo.Dynamics(arm(2, gravity=(0, 0, 0)), 3, device=device, granularity="tree")
    out = wp.full((3, 2), float("nan"), dtype=wp.float32, device=device)
    dyn.forward_dynamics(wp.zeros((3, 2), dtype=wp.float32, device=device), out=out)
    np.testing.assert_array_equal(out.numpy(), np.zeros((3, 2)))


# -- regressions -------------------------------------------------------------------------------------------------------
PINNED = {
    "arm7": (1456, 401, 277, 895, 1179, 665),
    "quadruped": (4111, 1773, 1565, 2778, 4984, 1901),
    "humanoid": (8146, 2617, 4090, 6254, 13520, 4618),
}
"""Scene of the benchmarks -> operations of one world, in the order of ORDER; 7 with a free base are for accuracy."""
ORDER = ("forward_dynamics", "inverse_dynamics", "mass_matrix", "solve_mass_matrix", "mass_matrix_inverse",
         "log_det_mass_matrix")  # fmt: skip


@pytest.mark.parametrize("name", PINNED)
def test_operations_are_no_more_than_they_were(name):
    """More needs a reason. Who saves operations may write the smaller numbers down."""
    scene = cases.SCENES[name]()
    found = np.array([count(scene, operation) for operation in ORDER])
    pinned = np.array(PINNED[name])
    assert (found <= pinned).all(), f"{dict(zip(ORDER, found - pinned, strict=True))} more than pinned"
