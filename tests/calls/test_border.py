"""Every operation of Dynamics x every kind of array: right numbers in the right kind."""

import functools
import itertools

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import laws, zoo
from support.border import SAME, WORLDS, assert_right, dynamics, explained, given, made
from support.granularities import of_random_scenes
from support.laws import OPERATIONS, TOLERANCE, numbers
from support.quick import slow_unless

AS_PLANNED = ("inverse_dynamics", "body_poses", "integrate")  # others read the same quaternions, at node granularity
KINDS = ["torch", "warp", "numpy"]


@pytest.mark.parametrize(
    ("operation", "kind", "dtype", "granularity"),
    slow_unless(  # kinds of arrays know nothing of precision and granularity
        [
            *itertools.product(OPERATIONS, KINDS, ["float64"], [None]),
            *itertools.product(OPERATIONS, ["torch"], ["float32"], ["node"]),
        ],
        itertools.product(OPERATIONS, KINDS, ["float32", "float64"], [None, "node"]),
    ),
)
def test_result_is_the_reference_in_the_kind_and_dtype_of_the_input(operation, kind, dtype, granularity, device):
    dyn = dynamics(device, dtype, granularity)
    arrays = given(kind, dyn)
    result = laws.call(dyn, operation, arrays)
    assert type(result) is type(arrays["q"]) and result.dtype == arrays["q"].dtype
    assert_right(dyn, operation, result)
    out = made(kind, np.full(tuple(result.shape), np.nan), dyn)
    assert laws.call(dyn, operation, arrays, out=out) is out
    np.testing.assert_array_equal(numbers(out), numbers(result))


@pytest.mark.parametrize("operation", OPERATIONS)
def test_inputs_stay_as_they_were(operation, device):
    dyn = dynamics(device)
    for kind in KINDS:
        arrays = given(kind, dyn)
        laws.call(dyn, operation, arrays)
        for name, before in laws.states(dyn.scene, WORLDS).items():
            np.testing.assert_array_equal(numbers(arrays[name]), before, err_msg=f"{kind} {name}")


@pytest.mark.parametrize("first", KINDS)
def test_kinds_mix_and_the_first_decides(first, device):
    dyn = dynamics(device)
    others = [kind for kind in KINDS if kind != first]
    arrays = given(first, dyn) | {name: given(others[0], dyn)[name] for name in ("tau", "qdd", "b")}
    arrays["body_f"] = given(others[1], dyn)["body_f"]
    for operation in ("forward_dynamics", "inverse_dynamics", "bias_force", "solve_mass_matrix"):
        result = laws.call(dyn, operation, arrays)
        assert type(result) is type(arrays["q"])
        assert_right(dyn, operation, result)


def test_numpy_is_cast_from_what_holds_real_numbers(device):
    dyn = dynamics(device, "float32")
    q = laws.states(dyn.scene, WORLDS, dtype="float32")["q"]
    wanted = dyn.gravity_force(q.astype(np.float32))
    for array in (q, np.asfortranarray(q), q.astype(">f8"), np.repeat(q, 2, axis=1)[:, ::2]):
        got = dyn.gravity_force(array)
        assert got.dtype == np.float32
        np.testing.assert_array_equal(got, wanted)
    for dtype in (np.int64, np.uint8, bool):
        np.testing.assert_array_equal(
            dyn.gravity_force(np.ones(q.shape, dtype)), dyn.gravity_force(np.ones(q.shape, np.float32))
        )


def test_float64_keeps_what_float32_would_lose(device):
    dyn = dynamics(device)
    arrays = laws.states(dyn.scene, WORLDS)
    qdd = laws.call(dyn, "forward_dynamics", arrays)
    assert qdd.dtype == np.float64
    moved = arrays | {"tau": arrays["tau"] * (1.0 + 1e-12)}
    change = laws.call(dyn, "forward_dynamics", moved) - qdd
    assert 0.0 < np.abs(change).max() < 1e-9


def test_a_whole_numpy_slice_of_a_longer_history(device):
    """[world, dof] cut out of [world, time, dof] has strides: NumPy is copied, a tensor is refused."""
    dyn = dynamics(device)
    q = laws.states(dyn.scene, WORLDS)["q"]
    history = np.stack([q + 1.0, q, q - 1.0], axis=1)
    np.testing.assert_array_equal(dyn.gravity_force(history[:, 1]), dyn.gravity_force(q))
    with explained(ValueError, "Dynamics.gravity_force", "q is a torch array", "C-contiguous", "q.contiguous()"):
        dyn.gravity_force(made("torch", history, dyn)[:, 1])
    with explained(ValueError, "Dynamics.gravity_force", "q is a Warp array", "C-contiguous", "q.contiguous()"):
        dyn.gravity_force(made("warp", history, dyn)[:, 1])


def test_nothing_given_is_zero_in_every_kind(device):
    dyn = dynamics(device)
    zero = np.zeros((WORLDS, dyn.scene.dof_count))
    for kind in KINDS:
        q, none = given(kind, dyn)["q"], made(kind, zero, dyn)
        for name in ("forward_dynamics", "inverse_dynamics"):
            got, wanted = getattr(dyn, name)(q, None, None), getattr(dyn, name)(q, none, none)
            assert laws.error(numbers(got), numbers(wanted)) <= TOLERANCE["float64"]
            assert type(got) is type(q)


def test_vectors_are_scalars_with_a_further_axis(device):
    dyn = dynamics(device, "float32")
    arrays = given("warp", dyn)
    wrench = wp.array(arrays["body_f"].numpy(), dtype=wp.spatial_vectorf, device=device)
    got = dyn.bias_force(arrays["q"], arrays["qd"], wrench)
    np.testing.assert_array_equal(got.numpy(), laws.call(dyn, "bias_force", arrays).numpy())
    out = wp.zeros((WORLDS, dyn.scene.body_count), dtype=wp.transformf, device=device)
    assert dyn.body_poses(arrays["q"], out=out) is out
    np.testing.assert_array_equal(out.numpy(), dyn.body_poses(arrays["q"]).numpy())


def test_results_in_arrays_with_strides(device):
    """NumPy's are filled; of a tensor a contiguous copy is no way out: it would be filled in its place."""
    dyn = dynamics(device)
    q = laws.states(dyn.scene, WORLDS)["q"]
    wanted, dofs = dyn.gravity_force(q), dyn.scene.dof_count
    for out in (np.full((WORLDS, 2 * dofs), np.nan)[:, ::2], np.full((dofs, WORLDS), np.nan).T,
                np.full((WORLDS, dofs), np.nan)[::-1, ::-1], np.full((WORLDS, dofs), np.nan, ">f8")):  # fmt: skip
        assert dyn.gravity_force(q, out=out) is out
        np.testing.assert_array_equal(out, wanted)
    words = np.full(2 * WORLDS, -1, np.int32)
    dyn.forward_dynamics(q, status=words[::2])
    np.testing.assert_array_equal(words, [0, -1] * WORLDS)
    for kind, title in (("torch", "torch"), ("warp", "Warp")):
        out = made(kind, np.zeros((WORLDS, 2 * dofs)), dyn)[:, ::2]
        way = "copy it into out: out.contiguous() is not out"
        with explained(ValueError, "Dynamics.gravity_force", f"out is a {title} array", "C-contiguous", way):
            dyn.gravity_force(made(kind, q, dyn), out=out)
    shared = np.lib.stride_tricks.as_strided(np.zeros(dofs), (WORLDS, dofs), (0, 8))
    with explained(ValueError, "Dynamics.gravity_force", "out is a NumPy array", "share memory", "fresh array"):
        dyn.gravity_force(q, out=shared)


def turned_scene():
    return zoo.random_tree(12, 3)  # a free and a ball hinge, free ones inside the tree too


@pytest.mark.parametrize("operation", OPERATIONS)
def test_quaternions_of_any_length_are_normalised_when_read(operation, device):
    for dtype in ("float32", "float64"):
        dyn = _turned(operation, device.alias, dtype)
        arrays = laws.states(dyn.scene, WORLDS, dtype=dtype)
        wanted = laws.numpy_call(dyn, operation, arrays)
        for scale in (3.0, -0.5, 1e12, 1e-12):
            q = arrays["q"].copy()
            for entries in _quaternions(dyn.scene):
                q[:, entries] *= scale
            got = laws.numpy_call(dyn, operation, arrays | {"q": q})
            for world in range(WORLDS):
                signed = laws.same_quaternion_sign(operation, dyn.scene, got[world], wanted[world])
                assert laws.error(signed, wanted[world]) <= SAME[dtype], f"{scale}, world {world}"


@pytest.mark.parametrize("operation", OPERATIONS)
def test_a_zero_quaternion_is_nan_in_its_world(operation, device):
    dyn = _turned(operation, device.alias, "float32")
    arrays = laws.states(dyn.scene, WORLDS, dtype="float32")
    clean = laws.numpy_call(dyn, operation, arrays)
    for entries in _quaternions(dyn.scene):
        q = arrays["q"].copy()
        q[1, entries] = 0.0
        got = laws.numpy_call(dyn, operation, arrays | {"q": q})
        np.testing.assert_array_equal(got[[0, 2]], clean[[0, 2]])
        if operation == "passive_force":  # a force of the hinge alone
            hinge = next(h for h, e in enumerate(dyn.scene.q_start[1:]) if e == entries.stop)
            assert np.isnan(got[1, dyn.scene.qd_start[hinge + 1] - 3 : dyn.scene.qd_start[hinge + 1]]).all()
        elif operation != "jacobian" or not np.array_equal(got[1], clean[1]):  # the hinge may carry no frame
            assert np.isnan(got[1]).any()


@functools.cache
def _turned(operation, device, dtype):
    granularity = None if operation in AS_PLANNED else of_random_scenes()
    return spo.Dynamics(turned_scene(), WORLDS, device=device, dtype=dtype, granularity=granularity)


def _quaternions(scene):
    ends = [e for hinge, e in zip(scene.hinges, scene.q_start[1:], strict=True) if hinge.kind in ("ball", "free")]
    return [slice(int(end) - 4, int(end)) for end in ends]
