"""Arrays of other libraries in all calls, through DLPack: the same numbers, no copy, and errors that explain."""

import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
import warp as wp
import wrapped

import warp_spo as spo
from support import laws
from support.border import WORLDS, dynamics, explained, scene

MAKE = {"JAX": jnp.asarray, "wrapped": wrapped.Array}


def numbers(array):
    return np.from_dlpack(array)


def states(make):
    s = laws.states(scene(), WORLDS, dtype="float32")
    return {name: make(array.astype(np.float32)) for name, array in s.items()}


@pytest.fixture(scope="module")
def dyn(device):
    if not device.is_cpu:
        pytest.skip("on the CPU; benchmarks/jax_check.py looks at a GPU")
    return dynamics(device, "float32", "node")


@pytest.mark.parametrize("library", MAKE)
@pytest.mark.parametrize(
    "operation", ["inverse_dynamics", "mass_matrix", "solve_mass_matrix", "body_poses", "integrate"]
)
def test_the_like_comes_back(dyn, library, operation):
    plain, given = states(np.asarray), states(MAKE[library])
    expected = laws.call(dyn, operation, plain)
    found = laws.call(dyn, operation, given)
    assert type(found) is type(given["q"]) and found.dtype == np.float32
    np.testing.assert_array_equal(numbers(found), expected)
    np.testing.assert_array_equal(numbers(given["q"]), plain["q"])  # the input is as it was


def test_nothing_is_copied(dyn, monkeypatch):
    """Kernels read and write the memory of the library itself."""
    given = states(wrapped.Array)
    out = wrapped.Array(np.full((WORLDS, dyn.scene.dof_count), np.nan, np.float32))
    seen = {}
    launch = type(dyn._engine).launch
    monkeypatch.setattr(type(dyn._engine), "launch", lambda *a, **k: seen.update(k, out=a[2]) or launch(*a, **k))
    assert dyn.inverse_dynamics(given["q"], given["qd"], given["qdd"], out=out) is out
    for name, array in (("q", given["q"]), ("qdd", given["qdd"]), ("out", out)):
        assert seen[name].ptr == array.inside.ctypes.data
    plain = states(np.asarray)
    np.testing.assert_array_equal(out.inside, dyn.inverse_dynamics(plain["q"], plain["qd"], plain["qdd"]))


def test_several_results_and_kinds_in_one_call(dyn):
    """The first array's kind is the result's, whatever the others are."""
    s, given = states(np.asarray), states(jnp.asarray)
    expected = dyn.body_states(s["q"], s["qd"])
    mixed = dyn.body_states(given["q"], torch.tensor(s["qd"]))
    assert all(isinstance(one, jax.Array) for one in mixed)
    out = tuple(wrapped.Array(np.full_like(one, np.nan)) for one in expected)
    assert dyn.body_states(wrapped.Array(s["q"]), given["qd"], out=out) == out
    for one, other, wanted in zip(mixed, out, expected, strict=True):
        np.testing.assert_array_equal(one, wanted)
        np.testing.assert_array_equal(other.inside, wanted)
    status = np.full(WORLDS, 77, np.int32)
    qdd = dyn.forward_dynamics(given["q"], given["qd"], wrapped.Array(s["tau"]), status=status)
    np.testing.assert_array_equal(qdd, dyn.forward_dynamics(s["q"], s["qd"], s["tau"]))
    assert not status.any()


def test_operators_and_values(device):
    if device.is_cuda:
        pytest.skip("on the CPU; benchmarks/jax_check.py looks at a GPU")
    rng = np.random.default_rng(0)
    weights = [None, *(rng.normal(size=(WORLDS, 2, 2)) for _ in range(2))]
    x = rng.normal(size=(WORLDS, 6))
    wanted = spo.BWA(spo.Tree([-1, 0, 1]), weights, dims=[2, 2, 2]).resolvent() @ x
    like = [None if one is None else wrapped.Array(one) for one in weights]
    found = spo.BWA(spo.Tree([-1, 0, 1]), like, dims=[2, 2, 2]).resolvent() @ wrapped.Array(x)
    np.testing.assert_array_equal(found.inside, wanted)
    single = spo.BWA(spo.Tree([-1, 0, 1]), [jnp.asarray(w) if w is not None else w for w in weights], dims=[2, 2, 2])
    assert single.dtype is wp.float32 and isinstance(single.resolvent().dense(), jax.Array)
    np.testing.assert_allclose(jnp.asarray(x) @ single.resolvent().T, wanted, rtol=2e-6, atol=1e-5)  # float32 of 3 sums

    changing = spo.Dynamics(scene(), WORLDS, "cpu", variable=("body_mass",), granularity="node")
    mass = np.linspace(0.5, 1.5, WORLDS * scene().body_count, dtype=np.float32).reshape(WORLDS, -1)
    s = states(np.asarray)
    changing.set(body_mass=mass)
    wanted = changing.gravity_force(s["q"])
    changing.set(body_mass=np.ones_like(mass))
    changing.set(body_mass=jnp.asarray(mass))
    with explained(TypeError, "Dynamics.set: body_mass is traced by JAX", "outside of JAX", r"values=('body_mass',)"):
        jax.grad(lambda mass: changing.set(body_mass=mass))(mass)
    np.testing.assert_array_equal(changing.gravity_force(s["q"]), wanted)


def test_what_jax_cannot_be_asked_for(dyn):
    given = states(jnp.asarray)
    out = jnp.zeros((WORLDS, dyn.scene.dof_count))
    with explained(ValueError, "inverse_dynamics", "out is a JAX array", "nobody can write", "expected", "out= away"):
        dyn.inverse_dynamics(given["q"], out=out)
    with explained(ValueError, "status is a JAX array", "expected", "pass a NumPy"):
        dyn.forward_dynamics(given["q"], status=jnp.zeros(WORLDS, jnp.int32))
    with explained(TypeError, "q is traced by JAX", "expected", "warp_spo.jax.function(dyn, 'gravity_force')"):
        jax.jit(dyn.gravity_force)(given["q"])
    lost = jnp.array(given["q"])
    lost.delete()
    with explained(ValueError, "gravity_force", "q is a JAX array", "hand over", "deleted", "expected", "copy"):
        dyn.gravity_force(lost)


def test_errors(dyn):
    given = states(wrapped.Array)
    shape = given["tau"].shape
    fixed = np.zeros(shape, np.float32)
    fixed.flags.writeable = False
    with explained(ValueError, "gravity_force", "out is a read-only wrapped array", "expected", "copy"):
        dyn.gravity_force(given["q"], out=wrapped.Array(fixed))
    assert not numbers(dyn.bias_force(given["q"], wrapped.Array(fixed))).size == 0  # it may be read
    with explained(ValueError, "qd is a wrapped array float64", "expected float32", "convert it to float32"):
        dyn.bias_force(given["q"], wrapped.Array(np.zeros(shape)))
    with explained(ValueError, "qd is a wrapped array float32", "expected float32", "[world, dof]", "reshape"):
        dyn.bias_force(given["q"], wrapped.Array(np.zeros((2, 2), np.float32)))
    with explained(ValueError, "q is a wrapped array", "strides", "expected a C-contiguous", "copy"):
        dyn.gravity_force(wrapped.Array(np.asfortranarray(given["q"].inside)))
    with explained(ValueError, "q is a wrapped array", "expected it on cpu", "move it there"):
        dyn.gravity_force(wrapped.Array(given["q"].inside, device=(2, 0)))
    with explained(ValueError, "q is a wrapped array", "hand over", "expected"):
        dyn.gravity_force(wrapped.Array(given["q"].inside.astype("f4,f4")))
    with explained(TypeError, "gravity_force", "out", "wrapped", "expected a NumPy array"):
        dyn.gravity_force(given["q"].inside, out=given["tau"])
    with explained(ValueError, "out overlaps qd", "expected", "fresh array"):
        dyn.bias_force(given["q"], given["qd"], out=given["qd"])
    with explained(TypeError, "q is of type str", "expected", "__dlpack__"):
        dyn.gravity_force("q")


def test_a_library_that_takes_no_arrays(dyn, monkeypatch):
    given = states(wrapped.Array)
    monkeypatch.delattr(wrapped, "from_dlpack")
    with explained(TypeError, "gravity_force", "wrapped has no from_dlpack", "expected", "out="):
        dyn.gravity_force(given["q"])
    out = wrapped.Array(np.full(given["tau"].shape, np.nan, np.float32))
    assert dyn.gravity_force(given["q"], out=out) is out and np.isfinite(out.inside).all()


def test_results_keep_their_memory(dyn):
    """A result lives on when all of ours is gone."""
    given, s = states(jnp.asarray), states(np.asarray)
    found = [dyn.mass_matrix(given["q"]) for _ in range(20)]
    wanted = dyn.mass_matrix(s["q"])
    for one in found:
        np.testing.assert_array_equal(one, wanted)


def test_cupy_runs_on_its_own_stream(monkeypatch):
    """With a stand-in for CuPy: its stream is asked for on the device, and its memory is its own."""
    from warp_spo.runtime import dlpack

    asked = []

    class Device:
        def __init__(self, number):
            self.number = number

        def __enter__(self):
            asked.append(self.number)

        def __exit__(self, *error):
            pass

    cuda = types.SimpleNamespace(Device=Device, get_current_stream=lambda: types.SimpleNamespace(ptr=1234))
    monkeypatch.setitem(sys.modules, "cupy", types.SimpleNamespace(cuda=cuda))
    monkeypatch.setattr(wp, "Stream", lambda device, cuda_stream: (device, cuda_stream))
    monkeypatch.setattr(dlpack, "_streams", {})
    gpu = types.SimpleNamespace(ordinal=3, alias="cuda:3")
    assert dlpack.stream(gpu) == (gpu, 1234) and asked == [3]
    assert dlpack.stream(gpu) is dlpack.stream(gpu)
    kind = type("ndarray", (), {"__module__": "cupy", "__dlpack__": None, "__dlpack_device__": None})
    assert dlpack.library_of(kind()).has_stream and not dlpack.library_of(jnp.zeros(1)).has_stream
