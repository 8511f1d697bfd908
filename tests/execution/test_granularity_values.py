"""Tree and segment granularity: values that are variable, folded, or set later."""

import functools
import itertools

import numpy as np
import pytest

import warp_spo as spo
from support import laws, zoo
from support.granularity_scenes import GRANULARITIES, OPERATIONS, SEGMENTED, equals_reference, poisoned, states
from support.quick import slow_unless

VARIABLE = ("body_mass", "body_com", "body_inertia", "joint_armature", "gravity", "joint_X_p", "joint_X_c")


@functools.cache
def small():
    """A floating body with a ball and a screw on it: two limbs, five joints' worth of values."""
    return zoo.from_parents([-1, 0, 0], ["free", "ball", "cylindrical"], 56)


def changed(scene, name, worlds, seed=0):
    """Values of one name [world, ...], other ones than the scene's, different in every world."""
    values = zoo.varied(scene, worlds, seed + 1).values[name]
    return values * 1.5 if name in ("body_mass", "body_inertia", "gravity") else values


@pytest.mark.parametrize(
    ("name", "granularity"),
    slow_unless(
        [*itertools.product(VARIABLE, ["tree"]), ("body_mass", "segment"), ("joint_X_p", "segment")],
        itertools.product(VARIABLE, GRANULARITIES),
    ),
)
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
