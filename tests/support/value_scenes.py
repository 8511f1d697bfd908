"""Values of a scene drawn at random, and the comparison of operations with a scene that was built with them."""

import contextlib
import functools
import warnings

import numpy as np

from . import laws, zoo
from .laws import OPERATIONS, TOLERANCE

WORLDS = 3
KINDS = ["torch", "warp", "numpy"]
NAMES = (
    "body_mass",
    "body_com",
    "body_inertia",
    "body_gravcomp",
    "joint_armature",
    "joint_damping",
    "joint_stiffness",
    "joint_X_p",
    "joint_X_c",
    "gravity",
)
TELLING = ("mass_matrix", "gravity_force", "passive_force", "body_poses")  # every value is in one of them
FLOAT32_VALUES = 6e-5  # values rounded to float32, then the error of float32: twice TOLERANCE["float32"]


@functools.cache
def scene():
    return zoo.random_tree(12, 23)  # every hinge kind, in any numbering


def drawn(name, worlds, seed=0):
    """Values of one name [worlds, ...], all different; each a value that a scene may have."""
    rng = np.random.default_rng([seed, NAMES.index(name)])
    value = np.repeat(scene().values[name][:1], worlds, axis=0)
    if name in ("body_mass", "body_inertia"):
        scale = rng.uniform(0.5, 2.0, (worlds, scene().body_count))
        return value * scale.reshape(scale.shape + (1,) * (value.ndim - 2))
    if name in ("joint_X_p", "joint_X_c"):
        value += rng.uniform(-0.1, 0.1, value.shape)
        value[..., 3:] /= np.linalg.norm(value[..., 3:], axis=-1, keepdims=True)
        return value
    if name in ("body_com", "gravity"):
        return value + rng.uniform(-0.2, 0.2, value.shape)
    return value + rng.uniform(0.0, 1.0, value.shape)


def assert_equals(dyn, expected_scene, operations=OPERATIONS, tolerance=None):
    """Every operation of ``dyn`` is the reference of ``expected_scene``, world by world."""
    arrays = laws.states(expected_scene, dyn.worlds, dtype=dyn.dtype.__name__)
    results = {operation: laws.numpy_call(dyn, operation, arrays) for operation in operations}
    for world in range(dyn.worlds):
        state = {name: array[world] for name, array in arrays.items()} | {"frames": laws.frames_of(expected_scene)}
        dense = laws.dense(expected_scene, state["q"], world)
        for operation in operations:
            wanted = np.asarray(OPERATIONS[operation][1](dense, state))
            value = laws.same_quaternion_sign(operation, expected_scene, results[operation][world], wanted)
            error = laws.error(value, wanted)
            assert error <= (tolerance or TOLERANCE[dyn.dtype.__name__]), f"{operation}, world {world}: {error:.1e}"


@contextlib.contextmanager
def no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield
