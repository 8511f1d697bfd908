"""Tree and segment granularity: every traced operation against the dense reference, on scenes with all there is."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import laws
from support.granularity_scenes import (
    DTYPES,
    GRANULARITIES,
    MANY,
    OPERATIONS,
    QUICK,
    SCENES,
    SEGMENTED,
    dynamics,
    equals_reference,
    states,
)
from support.quick import slow_unless
from support.routines import ROUTINES

WHOLE = ("every kind", "arm", "fixed", "hand", "massless", "three roots")
"""Scenes that a quick run takes by whole trees, too: every hinge, a robot, fixed and massless links, several roots."""


def cases():
    """(scene, granularity, dtype, operation), slow where a quick run leaves it out."""
    found = []
    for name in SCENES:
        for granularity in GRANULARITIES:
            for dtype in DTYPES:
                for operation in OPERATIONS if granularity == "tree" else (*SEGMENTED, "bias_force"):
                    quick = dtype == QUICK[name][0] and operation in QUICK[name][1]
                    quick &= granularity == "segment" or name in WHOLE
                    marks = [] if quick else [pytest.mark.slow]
                    found.append(pytest.param(name, granularity, dtype, operation, marks=marks))
    return found


@pytest.mark.parametrize("name, granularity, dtype, operation", cases())
def test_equals_reference(name, granularity, dtype, operation, device):
    dyn = dynamics(name, granularity, MANY, dtype, device)
    assert dyn.plan.of(ROUTINES[operation]) == granularity
    arrays = states(dyn)
    equals_reference(dyn, operation, arrays, laws.TOLERANCE[dtype], worlds=(0, 1, MANY // 2, MANY - 1))


@pytest.mark.parametrize("worlds", [1, 3])
@pytest.mark.parametrize("granularity", GRANULARITIES)
def test_equals_reference_where_a_warp_is_not_full(granularity, worlds, device):
    dyn = dynamics("hand", granularity, worlds, "float32", device)
    for operation in ("forward_dynamics", "mass_matrix_inverse"):
        equals_reference(dyn, operation, states(dyn), laws.TOLERANCE["float32"])


@pytest.mark.parametrize(
    "name, dtype", [("two arms", "float64"), pytest.param("every kind", "float32", marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("granularity", GRANULARITIES)
def test_values_that_differ_between_worlds(granularity, name, dtype, device):
    """Masses, CoMs, inertias, anchors, armature and gravity."""
    dyn = dynamics(name, granularity, 3, dtype, device, varied=True)
    for operation in OPERATIONS if granularity == "tree" else SEGMENTED:
        equals_reference(dyn, operation, states(dyn), laws.TOLERANCE[dtype])


@pytest.mark.parametrize("granularity", ["node", *GRANULARITIES])
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


@pytest.mark.parametrize("granularity", ["node", *GRANULARITIES])
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


@pytest.mark.parametrize("granularity", GRANULARITIES)
def test_same_bits_at_every_number_and_order_of_worlds(granularity, device):
    """Of a vector and a matrix; test_bits.py has every operation on a GPU, whose kernels depend on that number."""
    many = dynamics("hand", granularity, MANY, "float32", device)
    arrays = states(many)
    order = np.random.default_rng(7).permutation(MANY)
    for operation in ("forward_dynamics", "mass_matrix_inverse"):
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


@pytest.mark.parametrize(
    ("name", "granularity"),
    slow_unless(
        [("fixed", "tree"), ("fixed", "segment"), ("massless", "segment")],
        itertools.product(["every kind", "fixed", "hand", "massless"], GRANULARITIES),
    ),
)
def test_velocity_terms_first(name, granularity, device):
    """Forward dynamics as the plan has it for many worlds on a GPU: bias forces, then the solution; with loads."""
    scene = SCENES[name]()
    dyn = spo.Dynamics(scene, MANY, device=device, dtype="float64", granularity=granularity)
    dyn.programs.builder.plan = dataclasses.replace(dyn.plan, bias_first=True)
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
