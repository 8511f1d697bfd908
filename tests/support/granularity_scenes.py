"""Scenes for tree and segment granularity, and the comparison of an operation with the dense reference."""

import functools
import math

import numpy as np
import warp as wp

import warp_spo as spo

from . import laws, zoo
from .robots import ROBOTS

GRANULARITIES = ("tree", "segment")
DTYPES = ("float32", "float64")
SEGMENTED = ("forward_dynamics", "inverse_dynamics", "solve_mass_matrix", "mass_matrix", "mass_matrix_inverse")
OPERATIONS = (*SEGMENTED, "bias_force", "gravity_force", "log_det_mass_matrix", "body_poses",
              "body_velocities", "jacobian", "operational_inertia_inverse")  # fmt: skip
MANY = 33  # one more than a warp has threads

MEDIAN, WORST = 3e-7, 2e-6  # of an error, relative in the 2-norm: median of all, 99th percentile of qdd


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


def mirrored():
    """Four legs around a trunk, whose frames and bodies mirror each other: zeros and signs differ from leg to leg."""
    rng = np.random.default_rng(56)
    bodies, hinges = boxes(9, rng), [spo.Hinge("free", -1, 0)]
    for k, turn in enumerate((0.5 * math.pi, -0.5 * math.pi, math.pi, 0.6)):
        at = (0.2, 0.1 * (k - 1.5), 0.0, math.sin(0.5 * turn), 0.0, 0.0, math.cos(0.5 * turn))
        side = (1.0, -1.0, 0.0, 1.0)[k]
        for j, (axis, pose) in enumerate((((0, 0, 1), at), ((1, 0, 0), (0, 0, -0.2, 0, 0, 0, 1)))):
            body = 1 + 2 * k + j
            bodies[body] = spo.Body(1.0, (0.02 * side, 0.0, -0.1), np.diag([0.01, 0.02, 0.015]))
            armature = 0.01 * (k + 1)
            hinges.append(spo.Hinge("revolute", j * (body - 1), body, axis=axis, parent_pose=pose, armature=armature))
    return spo.Scene(bodies, hinges)


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
    "mirrored": mirrored,
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
FORWARD = ("forward_dynamics",)
OF_HAND = (*SEGMENTED, "bias_force")
QUICK = {
    "every kind": (
        "float32", (*FORWARD, "mass_matrix_inverse", "body_velocities", "jacobian", "operational_inertia_inverse")
    ),
    "arm": ("float32", (*FORWARD, "log_det_mass_matrix")),
    "fixed": ("float64", OPERATIONS),
    "hand": ("float32", OF_HAND),
    "mirrored": ("float32", FORWARD),
    "deep": ("float32", ()),  # seconds
    "massless": ("float32", FORWARD),
    "no armature": ("float64", FORWARD),
    "isotropic armature": ("float64", (*FORWARD, "solve_mass_matrix")),
    "anisotropic armature": ("float64", (*FORWARD, "mass_matrix")),
    "no gravity": ("float32", (*FORWARD, "gravity_force")),
    "three roots": ("float64", (*FORWARD, "inverse_dynamics", "jacobian")),
    "two arms": ("float64", (*FORWARD, "mass_matrix")),
    "dancer": ("float64", ("mass_matrix_inverse",)),
    "several robots": ("float64", (*FORWARD, "inverse_dynamics")),
    "oblique chain": ("float64", FORWARD),
}  # fmt: skip
"""Precision and operations that a quick run takes of a scene, at each granularity."""


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
