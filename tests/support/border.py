"""One scene, its arrays as torch, Warp and NumPy arrays, and the errors that must explain: for tests of the border."""

import functools
import re

import numpy as np
import pytest
import torch
import warp as wp

import warp_spo as spo

from . import laws, zoo
from .laws import TOLERANCE, numbers

WORLDS = 3
POSE = (0.1, -0.2, 0.3, 0.0, 0.6, 0.0, 0.8)
SAME = {"float32": 2e-6, "float64": 4e-15}  # two calls that differ in the length of a quaternion: its rounding alone


@functools.cache
def scene():
    return zoo.fork()


@functools.cache
def _dynamics(device, dtype, granularity):
    return spo.Dynamics(scene(), WORLDS, device=device, dtype=dtype, granularity=granularity)


def dynamics(device, dtype="float64", granularity=None):
    return _dynamics(device.alias, dtype, granularity)


def made(kind, values, dyn):
    """``values`` as an array of a kind that ``dyn`` takes."""
    dtype = dyn.dtype.__name__
    if kind == "torch":
        return torch.tensor(values, dtype=getattr(torch, dtype), device=wp.device_to_torch(dyn.device))
    if kind == "warp":
        return wp.array(values, dtype=dyn.dtype, device=dyn.device)
    return np.array(values, dtype)


def given(kind, dyn):
    states = laws.states(dyn.scene, WORLDS, dtype=dyn.dtype.__name__)
    return {name: made(kind, array, dyn) for name, array in states.items()}


def assert_right(dyn, operation, result):
    arrays = laws.states(dyn.scene, WORLDS, dtype=dyn.dtype.__name__)
    for world in range(WORLDS):
        wanted = np.asarray(laws.expected(dyn, operation, arrays, world))
        got = laws.same_quaternion_sign(operation, dyn.scene, numbers(result)[world], wanted)
        assert laws.error(got, wanted) <= TOLERANCE[dyn.dtype.__name__], f"{operation}, world {world}"


def explained(error, *words):
    """The error names each of ``words``, in this order: the call, the argument, what came, what was expected."""
    return pytest.raises(error, match="(?s)" + ".*".join(map(re.escape, words)))
