"""Tree and segment granularity: every traced operation against the dense reference, on scenes with all there is."""

import dataclasses
import functools
import math

import laws
import numpy as np
import pytest
import warp as wp
import warp_machine
import zoo
from robots import ROBOTS

import warp_spo as spo
from warp_spo.execution import plan
from warp_spo.kernels import straight

GRANULARITIES = ("tree", "segment")
DTYPES = ("float32", "float64")
SEGMENTED = ("forward_dynamics", "inverse_dynamics", "solve_mass_matrix", "mass_matrix", "mass_matrix_inverse")
OPERATIONS = (*SEGMENTED, "bias_force", "gravity_force", "log_det_mass_matrix", "body_poses",
              "body_velocities", "jacobian", "operational_inertia_inverse")  # fmt: skip
MANY = 33  # one more than a warp has threads

MEDIAN, WORST = 3e-7, 2e-6  # of an error, relative in the 2-norm: median of all, 99th percentile of qdd


# -- scenes ------------------------------------------------------------------------------------------------------------
def boxes(n, rng, size=1.0):
    """Bodies with diagonal inertias that a box could have."""
    bodies = []
    for _ in range(n):
        sides, mass = rng.uniform(0.1, 0.3, 3) * size, rng.uniform(0.5, 2.0)
        bodies.append(spo.Body(mass, rng.uniform(-0.1, 0.1, 3) * size,
                               mass / 12 * np.diag((sides**2).sum() - sides**2)))  # fmt: skip
    return bodies


def fixed():
    """Fixed bodies before the first hinge, between two, where the tree branches, and at the tips; one stands alone."""
    rng = np.random.default_rng(51)
    parents = [-1, 0, 1, 2, 2, 3, 4, -1, 5]
    kinds = ["fixed", "revolute", "fixed", "prismatic", "revolute", "fixed", "fixed", "fixed", "helical"]
    edges = enumerate(zip(kinds, parents, strict=True))
    hinges = [zoo.random_hinge(rng, kind, parent, k) for k, (kind, parent) in edges]
    return spo.Scene([zoo.random_body(rng) for _ in parents], hinges[::-1], gravity=(1.0, -2.0, -9.0))


def hand():
    """Five fingers of two joints, alike but for their numbers, on a palm that turns."""
    rng = np.random.default_rng(52)
    hinges = [spo.Hinge("universal", -1, 0, axis=[(1, 0, 0), (0, 1, 0)], parent_pose=(0, 0, 0.5, 0, 0, 0, 1))]
    for k in range(10):
        at = (0.07, 0.017 * (k - 4), 0.01) if k % 2 == 0 else (0.041, 0, 0)
        hinges.append(spo.Hinge("revolute", k if k % 2 else 0, k + 1, axis=(0, 0, 1) if k % 2 == 0 else (0, 1, 0),
                                parent_pose=(*at, 0, 0, 0, 1), armature=1e-3))  # fmt: skip
    return spo.Scene(boxes(11, rng, 0.3), hinges)


def deep():
    """Thirty levels of a trunk with aligned axes, in and out of the plane, and a limb at its middle."""
    rng = np.random.default_rng(53)
    parents = [*range(-1, 29), 14, 30]
    hinges = [spo.Hinge("revolute", parent, k, axis=np.eye(3)[2 if k % 5 else 1], armature=0.05,
                        parent_pose=(0.05 * (k > 0), 0, 0, 0, 0, 0, 1))
              for k, parent in enumerate(parents)]  # fmt: skip
    return spo.Scene(boxes(len(parents), rng, 0.5), hinges)


def massless():
    """Links without mass between hinges, as hips and wrists are built from, and one at a tip with armature."""
    rng = np.random.default_rng(54)
    bodies = boxes(7, rng)
    for k in (1, 2, 4, 6):
        bodies[k] = spo.Body(0.0)
    axes = [(0, 0, 1), (1, 0, 0), (0, 1, 0), (0.6, 0, 0.8), (0, 1, 0), (1, 0, 0), (0, 0, 1)]
    parents = [-1, 0, 1, 2, 0, 4, 3]
    hinges = [spo.Hinge("revolute", parent, k, axis=axes[k], parent_pose=(0.1, 0.02 * k, 0.3 * (k == 3), 0, 0, 0, 1),
                        armature=0.1 * (k == 6)) for k, parent in enumerate(parents)]  # fmt: skip
    return spo.Scene(bodies, hinges)


def armature(kind, alike):
    """A ball and a free hinge with three more links, armature the same about every axis or not."""
    rng = np.random.default_rng(55)
    kinds, parents = ["free", "ball", "revolute", kind, "revolute"], [-1, 0, 1, 0, 3]
    hinges = []
    for k, (name, parent) in enumerate(zip(kinds, parents, strict=True)):
        hinge = zoo.random_hinge(rng, name, parent, k)
        values = np.repeat(rng.uniform(0.01, 0.3, 2), 3)[: hinge.dof_count] if alike else hinge.armature
        hinges.append(spo.Hinge(name, parent, k, axis=hinge.axis, parent_pose=hinge.parent_pose,
                                child_pose=hinge.child_pose, armature=values))  # fmt: skip
    return spo.Scene([zoo.random_body(rng) for _ in kinds], hinges)


def unarmed():
    scene = armature("ball", True)
    return scene.with_values(joint_armature=np.zeros(scene.dof_count))


def weightless():
    return hand().with_values(gravity=(0.0, 0.0, 0.0))


SCENES = {
    "every kind": lambda: zoo.random_tree(10, 23),
    "arm": ROBOTS["arm"],
    "fixed": fixed,
    "hand": hand,
    "deep": deep,
    "massless": massless,
    "no armature": unarmed,
    "isotropic armature": lambda: armature("ball", True),
    "anisotropic armature": lambda: armature("free", False),
    "no gravity": weightless,
    "three roots": lambda: zoo.from_parents(
        [-1, 0, -1, 2, -1, 2], ["revolute", "ball", "free", "d6", "planar", "fixed"], 7
    ),
    "two arms": zoo.fork,
    "dancer": zoo.dancer,
    "several robots": zoo.forest,
    "oblique chain": lambda: zoo.chain(4),
}
FEW = {  # operations that a quick run takes of a scene; the others have all
    "deep": ("forward_dynamics", "inverse_dynamics"),
    "no gravity": ("forward_dynamics", "gravity_force"),
    "no armature": SEGMENTED[:1],
    "isotropic armature": ("forward_dynamics", "solve_mass_matrix"),
    "anisotropic armature": ("forward_dynamics", "inverse_dynamics", "mass_matrix"),
    "several robots": ("forward_dynamics", "inverse_dynamics", "mass_matrix"),
    "two arms": ("forward_dynamics", "mass_matrix"),
    "dancer": ("mass_matrix_inverse",),
    "hand": (*SEGMENTED, "bias_force"),
    "arm": (*SEGMENTED, "log_det_mass_matrix", "body_poses"),
    "three roots": (*SEGMENTED, "bias_force", "jacobian"),
}
PRECISION = {"float32": ("every kind", "arm", "hand", "massless", "deep"),
             "float64": ("fixed", "anisotropic armature", "three roots", "dancer")}  # fmt: skip
"""Scenes of which a quick run takes all of those in this precision; in the other one the first two."""


@functools.cache
def scene_of(name, worlds=None):
    return SCENES[name]() if worlds is None else zoo.varied(scene_of(name), worlds)


def dynamics(name, granularity, worlds, dtype, device, varied=False, **options):
    scene = scene_of(name, worlds if varied else None)
    return spo.Dynamics(scene, worlds, device=device, dtype=dtype, granularity=granularity, **options)


def states(dyn, worlds=None):
    """Inputs that differ in every world; ``b`` is one right-hand side, as programs take it."""
    arrays = laws.states(dyn.scene, worlds or dyn.worlds, dtype=dyn.dtype.__name__)
    arrays["b"] = np.ascontiguousarray(arrays["b"][:, :, 0])
    return arrays


def poisoned(dyn, operation, arrays):
    """The result in an array that was full of NaN, in float64."""
    on_device = laws.to_device(dyn, arrays)
    shape = np.shape(laws.expected(dyn, operation, arrays, 0))
    out = wp.full((dyn.worlds, *shape), math.nan, dtype=dyn.dtype, device=dyn.device)
    assert laws.call(dyn, operation, on_device, out=out) is out
    return out.numpy().astype(np.float64)


def equals_reference(dyn, operation, arrays, tolerance, worlds=None):
    """Every world, or those named, and every entry written; log det by its largest value, as it passes zero."""
    got, wanted = poisoned(dyn, operation, arrays), []
    assert np.isfinite(got).all(), f"{operation}: {np.isnan(got).sum()} entries are not written, or lost"
    for world in worlds or range(dyn.worlds):
        want = np.asarray(laws.expected(dyn, operation, arrays, world))
        value = laws.same_quaternion_sign(operation, dyn.scene, got[world], want)
        error = np.abs(value - want).max() if operation.startswith("log") else laws.error(value, want)
        assert error <= tolerance * (dyn.scene.dof_count if operation.startswith("log") else 1), \
            f"{operation}, world {world}: error {error:.1e}"  # fmt: skip
        wanted.append(want)
    return got


def cases():
    """(scene, granularity, dtype, operation), slow where a quick run leaves it out."""
    found = []
    for name in SCENES:
        for granularity in GRANULARITIES:
            for dtype in DTYPES:
                for operation in OPERATIONS if granularity == "tree" else (*SEGMENTED, "bias_force"):
                    quick = operation in FEW.get(name, OPERATIONS)
                    quick = quick and (name in PRECISION[dtype] or operation in SEGMENTED[:2])
                    quick = quick and not (name == "deep" and (dtype == "float64" or granularity == "segment"))
                    marks = [] if quick else [pytest.mark.slow]
                    found.append(pytest.param(name, granularity, dtype, operation, marks=marks))
    return found


# -- against the dense reference ---------------------------------------------------------------------------------------
@pytest.mark.parametrize("name, granularity, dtype, operation", cases())
def test_equals_reference(name, granularity, dtype, operation, device):
    dyn = dynamics(name, granularity, MANY, dtype, device)
    assert dyn.plan.of(operation) == granularity
    arrays = states(dyn)
    equals_reference(dyn, operation, arrays, laws.TOLERANCE[dtype], worlds=(0, 1, MANY // 2, MANY - 1))


@pytest.mark.parametrize("granularity", GRANULARITIES)
def test_a_long_result_that_shared_memory_cannot_hold(granularity, device, monkeypatch):
    """Values that wait in the rows of the result, and parameters with them."""
    texts = warp_machine.recorded(monkeypatch)
    dyn = dynamics("two arms", granularity, MANY, "float64", device, varied=True)
    monkeypatch.setattr(straight, "SHARED_BYTES", 10_000)
    dyn.programs.relays = True
    for operation in ("mass_matrix", "mass_matrix_inverse"):
        equals_reference(dyn, operation, states(dyn), laws.TOLERANCE["float64"])
    assert {text.frame.result.way for text in texts} == {straight.RELAYED}


@pytest.mark.parametrize("way", [straight.MAPPED, straight.RELAYED])
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("granularity", GRANULARITIES)
def test_long_results_that_begin_anywhere(granularity, dtype, way, device, monkeypatch):
    """Of worlds that fill no warp, no tile and no 16 bytes; nothing is written in front of the result or behind it."""
    operation = "mass_matrix" if granularity == "tree" else "mass_matrix_inverse"
    texts = warp_machine.recorded(monkeypatch)
    if way == straight.RELAYED:  # room for a tile, and for what the limbs send, but not for all values
        room = 1_250 if granularity == "tree" else 4_000
        monkeypatch.setattr(straight, "SHARED_BYTES", room * (4 if dtype == "float32" else 8))
    for worlds in (1, 3, 33, 70):
        dyn = dynamics("two arms", granularity, worlds, dtype, device)
        dyn.programs.relays = True
        arrays, size = states(dyn), dyn.scene.dof_count**2 * worlds
        wanted = equals_reference(dyn, operation, arrays, laws.TOLERANCE[dtype])
        q = laws.to_device(dyn, arrays)["q"]
        for at in range(5):
            memory = wp.full(at + size + 5, math.nan, dtype=dyn.dtype, device=device)
            getattr(dyn, operation)(q, out=memory[at : at + size].reshape(wanted.shape))
            np.testing.assert_array_equal(memory[at : at + size].numpy(), wanted.ravel())
            rest = np.concatenate([memory[:at].numpy() if at else [], memory[at + size :].numpy()])
            assert np.isnan(rest).all()
        if granularity == "segment" and worlds == 3:
            by_warps = warp_machine.run(texts[-1], {"q": arrays["q"]}).reshape(wanted.shape)
            assert laws.error(by_warps, wanted) <= laws.TOLERANCE[dtype]
    found = {(text.frame.result.way, text.frame.warps) for text in texts}
    assert found == {(way, 1 if granularity == "tree" else 2)}


@pytest.mark.parametrize("worlds", [1, 3])
@pytest.mark.parametrize("granularity", GRANULARITIES)
def test_equals_reference_where_a_warp_is_not_full(granularity, worlds, device):
    dyn = dynamics("hand", granularity, worlds, "float32", device)
    for operation in FEW["hand"]:
        equals_reference(dyn, operation, states(dyn), laws.TOLERANCE["float32"])


@pytest.mark.parametrize(
    "name, dtype", [("two arms", "float64"), pytest.param("every kind", "float32", marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("granularity", GRANULARITIES)
def test_values_that_differ_between_worlds(granularity, name, dtype, device):
    """Masses, CoMs, inertias, anchors, armature and gravity."""
    dyn = dynamics(name, granularity, 3, dtype, device, varied=True)
    for operation in OPERATIONS:
        equals_reference(dyn, operation, states(dyn), laws.TOLERANCE[dtype])


@pytest.mark.parametrize("granularity", GRANULARITIES)
def test_what_is_not_given_is_zero(granularity, device):
    dyn = dynamics("two arms", granularity, 3, "float64", device)
    arrays = states(dyn)
    zero = {name: np.zeros_like(array) for name, array in arrays.items() if name != "q"} | {"q": arrays["q"]}
    for takes in ((), ("qd",), ("tau",), ("qdd",), ("body_f",)):
        given = zero | {name: arrays[name] for name in takes}
        for operation in ("forward_dynamics", "inverse_dynamics"):
            if set(takes) <= set(laws.OPERATIONS[operation][0]):
                less = {"q": arrays["q"]} | {name: arrays[name] for name in takes}
                got = laws.numpy_call(dyn, operation, less)
                for world in range(3):
                    assert laws.error(got[world], laws.expected(dyn, operation, given, world)) <= 1e-12, takes


@pytest.mark.parametrize("granularity", GRANULARITIES)
@pytest.mark.parametrize("kind", ["torch", "numpy"])
def test_arrays_of_every_kind(kind, granularity, device):
    """The same numbers as with Warp arrays, in ``out`` full of NaN."""
    dyn = dynamics("hand", granularity, 3, "float32", device)
    arrays = states(dyn)
    if kind == "torch":
        torch = pytest.importorskip("torch")
        where = wp.device_to_torch(device)
        made = lambda array: torch.tensor(array, dtype=torch.float32, device=where)  # noqa: E731
    else:
        made = lambda array: array.astype(np.float32)  # noqa: E731
    given = {name: made(array) for name, array in arrays.items()}
    for operation in ("forward_dynamics", "mass_matrix"):
        wanted = laws.numpy_call(dyn, operation, arrays)
        out = made(np.full(wanted.shape, math.nan))
        assert laws.call(dyn, operation, given, out=out) is out
        got = out.cpu().numpy() if kind == "torch" else out
        np.testing.assert_array_equal(got.astype(np.float64), wanted)


# -- values that change ------------------------------------------------------------------------------------------------
VARIABLE = ("body_mass", "body_com", "body_inertia", "joint_armature", "gravity", "joint_X_p", "joint_X_c")


@functools.cache
def small():
    """A floating body with a ball and a screw on it: two limbs, five joints' worth of values."""
    return zoo.from_parents([-1, 0, 0], ["free", "ball", "cylindrical"], 56)


def changed(scene, name, worlds, seed=0):
    """Values of one name [world, ...], other ones than the scene's, different in every world."""
    values = zoo.varied(scene, worlds, seed + 1).values[name]
    return values * 1.5 if name in ("body_mass", "body_inertia", "gravity") else values


@pytest.mark.parametrize("granularity", GRANULARITIES)
@pytest.mark.parametrize("name", VARIABLE)
def test_a_variable_value_set_afterwards(name, granularity, device):
    """Before and after ``set``; a program compiled before reads the new value."""
    scene, worlds = small(), 3
    dyn = spo.Dynamics(scene, worlds, device=device, dtype="float64", granularity=granularity, variable=(name,))
    arrays = states(dyn)
    equals_reference(dyn, "forward_dynamics", arrays, laws.TOLERANCE["float64"])
    programs = dict(dyn.programs._programs)
    value = changed(scene, name, worlds)
    dyn.set(**{name: value})
    now = spo.Dynamics(scene.with_values(**{name: value}), worlds, device=device, dtype="float64", granularity="node")
    got = poisoned(dyn, "forward_dynamics", arrays)
    for world in range(worlds):
        wanted = laws.expected(now, "forward_dynamics", arrays, world)
        assert laws.error(got[world], wanted) <= laws.TOLERANCE["float64"]
    assert dyn.programs._programs == programs


@pytest.mark.parametrize("granularity", GRANULARITIES)
def test_everything_variable(granularity, device):
    scene, worlds = small(), 3
    dyn = spo.Dynamics(scene, worlds, device=device, dtype="float64", granularity=granularity, variable=VARIABLE)
    arrays = states(dyn)
    for seed in (0, 10):
        values = {name: changed(scene, name, worlds, seed) for name in VARIABLE}
        dyn.set(**values)
        now = spo.Dynamics(scene.with_values(**values), worlds, device=device, dtype="float64", granularity="node")
        for operation in OPERATIONS if granularity == "tree" else SEGMENTED:
            got = poisoned(dyn, operation, arrays)
            for world in range(worlds):
                wanted = np.asarray(laws.expected(now, operation, arrays, world))
                value = laws.same_quaternion_sign(operation, scene, got[world], wanted)
                assert laws.error(value, wanted) <= laws.TOLERANCE["float64"], operation


@pytest.mark.parametrize("granularity", GRANULARITIES)
def test_a_folded_value_set_afterwards(granularity, device):
    """Programs that folded the old value are dropped."""
    scene = small()
    dyn = spo.Dynamics(scene, 2, device=device, dtype="float64", granularity=granularity)
    arrays = states(dyn)
    equals_reference(dyn, "mass_matrix", arrays, laws.TOLERANCE["float64"])
    with pytest.warns(UserWarning, match="rebuilt"):
        dyn.set(body_mass=3.0 * scene.values["body_mass"][0])
    equals_reference(dyn, "mass_matrix", arrays, laws.TOLERANCE["float64"])


# -- bits --------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("granularity", GRANULARITIES)
def test_same_bits_at_every_number_and_order_of_worlds(granularity, device):
    many = dynamics("hand", granularity, MANY, "float32", device)
    arrays = states(many)
    order = np.random.default_rng(7).permutation(MANY)
    for operation in FEW["hand"]:
        wanted = laws.numpy_call(many, operation, arrays)
        moved = laws.numpy_call(many, operation, {name: array[order] for name, array in arrays.items()})
        np.testing.assert_array_equal(moved, wanted[order])
        for worlds in (1, 3, 32):
            few = dynamics("hand", granularity, worlds, "float32", device)
            got = laws.numpy_call(few, operation, {name: array[:worlds] for name, array in arrays.items()})
            np.testing.assert_array_equal(got, wanted[:worlds])


@pytest.mark.parametrize("granularity", GRANULARITIES)
@pytest.mark.parametrize("name", ["hand", "massless"])
def test_worlds_do_not_touch_each_other(name, granularity, device):
    dyn = dynamics(name, granularity, MANY, "float32", device)
    for operation in SEGMENTED:
        laws.worlds_do_not_touch_each_other(dyn, operation, states(dyn))


# -- angles far away ---------------------------------------------------------------------------------------------------
def wheels():
    """Two limbs whose angles may be any number: turning, and turning as they slide, slowly enough to stay near."""
    rng = np.random.default_rng(57)
    kinds, parents = ["revolute", "helical", "revolute", "helical"], [-1, 0, 0, 2]
    edges = enumerate(zip(kinds, parents, strict=True))
    hinges = [zoo.random_hinge(rng, kind, parent, k) for k, (kind, parent) in edges]
    for k in (1, 3):
        h = hinges[k]
        hinges[k] = spo.Hinge("helical", h.parent, k, axis=h.axis, pitch=k * 1e-8, parent_pose=h.parent_pose,
                              child_pose=h.child_pose, armature=h.armature)  # fmt: skip
    return spo.Scene([zoo.random_body(rng) for _ in kinds], hinges)


FAR = {"float32": [1e3, 1e6, 1e9], "float64": [1e3, 1e6, 1e9]}


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("granularity", GRANULARITIES)
def test_angles_far_away(granularity, dtype, device):
    """As the reference has it at the angle that is left after rounding, in both directions, in one world of three."""
    scene = wheels()
    dyn = spo.Dynamics(scene, 3, device=device, dtype=dtype, granularity=granularity)
    for size in FAR[dtype]:
        for sign in (1.0, -1.0):
            arrays = states(dyn)
            near = poisoned(dyn, "forward_dynamics", arrays)
            arrays["q"][1] = (sign * size * np.array([1.0, 0.3, 0.7, 1.1])).astype(dtype)
            for operation in ("forward_dynamics", "inverse_dynamics", "mass_matrix"):
                got = equals_reference(dyn, operation, arrays, laws.TOLERANCE[dtype])
                if operation == "forward_dynamics":
                    np.testing.assert_array_equal(got[[0, 2]], near[[0, 2]])


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("granularity", GRANULARITIES)
def test_angles_that_are_not_numbers(granularity, dtype, bad, device):
    dyn = spo.Dynamics(wheels(), 3, device=device, dtype=dtype, granularity=granularity)
    arrays = states(dyn)
    for operation in ("forward_dynamics", "inverse_dynamics", "mass_matrix"):
        clean = laws.numpy_call(dyn, operation, arrays)
        for dof in range(1, 4):
            broken = arrays | {"q": arrays["q"].copy()}
            broken["q"][1, dof] = bad
            got = laws.numpy_call(dyn, operation, broken)
            np.testing.assert_array_equal(got[[0, 2]], clean[[0, 2]])
            assert np.isnan(got[1]).any() and not np.isinf(got[1]).any()


BASE = {"mass_matrix": 1.2e-7, "gravity_force": 2e-7}  # two and three roundings


@pytest.mark.parametrize("granularity", GRANULARITIES)
@pytest.mark.parametrize("operation", BASE)
def test_float32_of_a_free_base_is_better_than_its_rotation(operation, granularity, device):
    """A rotation in float32 is off by up to 6e-7 from its inverse, R m R* from m; in each of 500 states."""
    scene, worlds = ROBOTS["ant"](), 500
    rounded, exact = (
        spo.Dynamics(scene, worlds, device=device, dtype=dtype, granularity=granularity) for dtype in DTYPES
    )
    arrays = laws.states(scene, worlds, dtype="float32")
    got, wanted = (laws.numpy_call(dyn, operation, arrays).reshape(worlds, -1) for dyn in (rounded, exact))
    error = np.linalg.norm(got - wanted, axis=1) / np.linalg.norm(wanted, axis=1)
    assert error.max() <= BASE[operation]


# -- random trees ------------------------------------------------------------------------------------------------------
QUICK = (0, 2)
MISSED = {
    1: "60 dof, 26 levels of oblique, turned and offset hinges: medians of qdd and tau 3.3e-7 and 3.8e-7",
    8: "48 dof, 19 levels: median of tau 3.3e-7",
}
"""Tree -> by how much it misses the line."""


def relative(got, wanted):
    """Errors [world] in the 2-norm."""
    got, wanted = (np.reshape(x, (len(x), -1)) for x in (got, wanted))
    return np.linalg.norm(got - wanted, axis=1) / np.linalg.norm(wanted, axis=1)


def marked(which):
    marks = [] if which in QUICK else [pytest.mark.slow]
    if which in MISSED:
        marks.append(pytest.mark.xfail(strict=True, reason=MISSED[which]))
    return pytest.param(which, marks=marks)


@pytest.mark.parametrize("granularity", GRANULARITIES)
@pytest.mark.parametrize("which", [marked(which) for which in range(len(zoo.BRANCHED))])
def test_random_trees_meet_the_error_line(which, granularity, device):
    """Issue 4: float32 against float64 on the same inputs; float64 against the dense reference in two worlds."""
    scene, worlds = zoo.branched(which), 200
    assert scene.tree.depth <= 30 and len(scene.tree.roots) == zoo.BRANCHED[which][1]
    low = spo.Dynamics(scene, worlds, device=device, dtype="float32", granularity=granularity)
    high = spo.Dynamics(scene, worlds, device=device, dtype="float64", granularity="node")
    arrays = states(low)
    arrays["tau"] *= 10.0
    arrays["q"] = (arrays["q"] / 1.2).astype(np.float32).astype(np.float64)  # angles in (-1, 1)
    for operation in ("forward_dynamics", "inverse_dynamics", "mass_matrix"):
        wanted = laws.numpy_call(high, operation, arrays)
        for world in (0, worlds - 1):
            assert laws.error(wanted[world], laws.expected(high, operation, arrays, world)) <= 1e-10
        error = relative(poisoned(low, operation, arrays), wanted)
        assert np.median(error) <= MEDIAN, f"{operation}: median {np.median(error):.1e}"
        if operation == "forward_dynamics":
            assert np.percentile(error, 99) <= WORST, f"99th percentile {np.percentile(error, 99):.1e}"


@pytest.mark.parametrize("granularity", [None, "node"])
@pytest.mark.parametrize("name", ["fixed", "hand"])
def test_body_states_are_poses_and_velocities(name, granularity, device):
    """Of variable CoMs, too; the rows of the hand's 11 bodies leave through shared memory."""
    scene = SCENES[name]()
    dyn = spo.Dynamics(scene, MANY, device=device, dtype="float64", granularity=granularity, variable=("body_com",))
    a = laws.to_device(dyn, laws.states(scene, MANY))
    shapes = (MANY, scene.body_count, 7), (MANY, scene.body_count, 6)
    out = tuple(wp.full(shape, math.nan, dtype=dyn.dtype, device=device) for shape in shapes)
    assert dyn.body_states(a["q"], a["qd"], out=out) == out
    for got, wanted in zip(out, (dyn.body_poses(a["q"]), dyn.body_velocities(a["q"], a["qd"])), strict=True):
        np.testing.assert_allclose(got.numpy(), wanted.numpy(), rtol=0.0, atol=1e-14)
    with pytest.raises(TypeError, match="expected a pair"):
        dyn.body_states(a["q"], a["qd"], out=out[0])


@pytest.mark.parametrize("granularity", GRANULARITIES)
@pytest.mark.parametrize("name", ["every kind", "fixed", "hand", "massless"])
def test_velocity_terms_first(name, granularity, device):
    """Forward dynamics as the plan has it for many worlds on a GPU: bias forces, then the solution; with loads."""
    scene = SCENES[name]()
    dyn = spo.Dynamics(scene, MANY, device=device, dtype="float64", granularity=granularity)
    dyn.programs.plan = dataclasses.replace(dyn.plan, apart=True)
    arrays = laws.states(scene, MANY)
    laws.equals_reference(dyn, "forward_dynamics", arrays, laws.TOLERANCE["float64"])
    direct = spo.Dynamics(scene, MANY, device=device, dtype="float64", granularity=granularity)
    laws.equals_reference(direct, "forward_dynamics", arrays, laws.TOLERANCE["float64"])
    one, other = (next(iter(each.programs._programs.values())).kernel.key for each in (dyn, direct))
    assert one != other
    back = [
        each.forward_dynamics_vjp(*(arrays[n] for n in ("q", "qd", "tau")), cotangent=arrays["qdd"], wrt=("q", "qd"))
        for each in (dyn, direct)
    ]
    for got, wanted in zip(*(each.values() for each in back), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=0.0, atol=1e-9 * np.abs(wanted).max())


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("name", ["chain_helical", "chain_universal"])
def test_rows_that_begin_anywhere(name, dtype, device, monkeypatch):
    """Rows come in and out 16 bytes at a time where memory allows it; slices begin between such places."""
    for limit in ("FEW_WORLDS", "SHORT_ROWS", "LONG_ROWS"):
        monkeypatch.setattr(plan, limit, 0)
    scene = zoo.SCENES[name]()
    dyn = spo.Dynamics(scene, 70, device=device, dtype=dtype)
    assert dyn.plan.staged or not device.is_cuda
    given = laws.states(scene, 70)

    def beginning(values, at):
        flat = wp.array(np.concatenate([np.full(at, np.nan), np.ravel(values)]), dtype=dyn.dtype, device=device)
        return flat[at:].reshape(values.shape)

    for operation, third in (("forward_dynamics", "tau"), ("inverse_dynamics", "qdd")):
        results = []
        for at in range(5):
            arrays = [beginning(given[key], at) for key in ("q", "qd", third)]
            out = beginning(np.full((70, scene.dof_count), np.nan), at)
            results.append(getattr(dyn, operation)(*arrays, out=out).numpy())
        assert np.isfinite(results[0]).all()
        for result in results[1:]:
            np.testing.assert_array_equal(result, results[0])
