"""The border between the caller's arrays and Warp's: kinds in and out, what is refused and in which words."""

import numpy as np
import pytest
import torch
import warp as wp

from support.allocations import no_warp_allocation
from warp_spo.runtime import arrays
from warp_spo.runtime.arrays import Call

WORLDS, SIZE = 3, 4
VALUES = np.arange(12.0).reshape(WORLDS, SIZE)
DTYPES = {"float32": wp.float32, "float64": wp.float64}


def make(kind, values, device, dtype="float32"):
    if kind == "numpy":
        return np.array(values, dtype)
    if kind == "torch":
        return torch.tensor(values, dtype=getattr(torch, dtype), device=wp.device_to_torch(device))
    return wp.array(np.array(values, dtype), dtype=getattr(wp, dtype), device=device)


def numbers(array):
    return (
        array.cpu().numpy() if isinstance(array, torch.Tensor) else np.asarray(getattr(array, "numpy", lambda: array)())
    )


def copy(x, device, out=None, status=None, dtype="float32", shape=(WORLDS, SIZE)):
    """The smallest call: the result is x, and every status becomes 7."""
    with Call("copy", device, DTYPES[dtype]) as call:
        x = call.read("x", x, shape, "[world, dof]")
        status = call.update("status", status, (WORLDS,), "[world]", dtype=wp.int32)
        y = call.write(out, x.shape, "[world, dof]")
        if y.size:
            wp.copy(y, x)
        if status is not None:
            status.fill_(7)
    return call.result


KINDS = ["numpy", "warp", "torch"]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("kind", KINDS)
def test_result_has_kind_and_dtype_of_the_call(device, kind, dtype):
    x = make(kind, VALUES, device, dtype)
    y = copy(x, device, dtype=dtype)
    assert type(y) is type(x) and y.dtype == x.dtype and y is not x
    np.testing.assert_array_equal(numbers(y), VALUES)


@pytest.mark.parametrize("kind", KINDS)
def test_out_is_filled_and_returned(device, kind):
    out = make(kind, np.full_like(VALUES, np.nan), device)
    assert copy(make(kind, VALUES, device), device, out=out) is out
    np.testing.assert_array_equal(numbers(out), VALUES)


@pytest.mark.parametrize("status_kind", KINDS)
@pytest.mark.parametrize("kind", KINDS)
def test_update_is_written_back_and_kinds_mix(device, kind, status_kind):
    status = make(status_kind, np.zeros(WORLDS), device, "int32")
    y = copy(make(kind, VALUES, device), device, status=status)
    assert type(y) is type(make(kind, VALUES, device))
    np.testing.assert_array_equal(numbers(status), [7, 7, 7])


@pytest.mark.parametrize("dtype", [np.float64, np.float16, np.int64, np.uint8, bool])
def test_numpy_is_cast(device, dtype):
    y = copy((VALUES > 5).astype(dtype), device)
    assert y.dtype == np.float32
    np.testing.assert_array_equal(y, VALUES > 5)


def test_numpy_may_have_strides_and_be_read_only(device):
    x = np.broadcast_to(np.arange(4.0), (WORLDS, SIZE))
    out = np.zeros((WORLDS, 2 * SIZE), np.float32)
    copy(x, device, out=out[:, ::2])
    np.testing.assert_array_equal(out[:, ::2], x)
    np.testing.assert_array_equal(out[:, 1::2], 0)


def test_numpy_input_stays_as_it_was(device):
    x = VALUES.astype(np.float32)
    y = copy(x, device)
    y += 1
    np.testing.assert_array_equal(x, VALUES)


@pytest.mark.parametrize("kind", KINDS)
def test_empty_arrays(device, kind):
    x = make(kind, np.zeros((WORLDS, 0)), device)
    assert tuple(copy(x, device, shape=(WORLDS, 0)).shape) == (WORLDS, 0)
    out = make(kind, np.zeros((WORLDS, 0)), device)
    assert copy(x, device, out=out, shape=(-1, 0)) is out


@pytest.mark.parametrize("kind", ["warp", "torch"])
def test_no_warp_allocation_with_out(device, kind):
    x, out = make(kind, VALUES, device), make(kind, VALUES, device)
    status = make(kind, np.zeros(WORLDS), device, "int32")
    with no_warp_allocation():
        copy(x, device, out=out, status=status)
    with pytest.raises(AssertionError, match="Warp allocated"), no_warp_allocation():
        copy(make("warp", VALUES, device), device)


def test_vectors_and_transforms_are_scalars_with_further_axes(device):
    values = np.random.default_rng(0).normal(size=(WORLDS, 2, 7)).astype(np.float32)
    y = copy(wp.array(values, dtype=wp.transform, device=device), device, shape=(WORLDS, 2, 7))
    np.testing.assert_array_equal(y.numpy(), values)


def test_several_results_and_optional_arguments(device):
    with Call("two", device, wp.float32) as call:
        assert call.read("tau", None, (WORLDS, SIZE), optional=True) is None
        call.read("x", VALUES, (WORLDS, SIZE))
        for value in (1.0, 2.0):
            call.write(None, (WORLDS,)).fill_(value)
    first, second = call.result
    assert (first == 1).all() and (second == 2).all()


def test_torch_version_counter_sees_the_write(device):
    out = make("torch", VALUES, device)
    before = out._version
    copy(make("torch", VALUES, device), device, out=out)
    assert out._version > before


def test_torch_without_grad_mode_is_taken(device):
    x = make("torch", VALUES, device).requires_grad_()
    with torch.no_grad():
        np.testing.assert_array_equal(numbers(copy(x, device)), VALUES)


def test_dtypes_and_devices_by_any_name():
    for dtype in ("float32", np.float32, np.dtype("float32"), torch.float32, wp.float32):
        assert arrays.parse_dtype(dtype) is wp.float32
    assert arrays.parse_dtype("float64") is wp.float64
    for device in ("cpu", torch.device("cpu"), wp.get_device("cpu")):
        assert arrays.parse_device(device) == wp.get_device("cpu")
    for dtype in (float, "half", np.int32, torch.float16, None):
        with pytest.raises(ValueError, match='expected "float32" or "float64"'):
            arrays.parse_dtype(dtype, "Dynamics")


def numpy32(shape=(WORLDS, SIZE)):
    return np.zeros(shape, np.float32)


def shared_torch():
    x = torch.zeros(WORLDS * SIZE + 1)
    return dict(x=x[:-1].view(WORLDS, SIZE), out=x[1:].view(WORLDS, SIZE))


def shared_numpy():
    x = numpy32()
    return dict(x=x, out=x)


def read_only():
    x = numpy32()
    x.flags.writeable = False
    return dict(x=VALUES, out=x)


REFUSED = {
    "list": (lambda: dict(x=VALUES.tolist()), TypeError, "copy: x is of type list; expected a torch tensor"),
    "number": (lambda: dict(x=1.0), TypeError, "x is of type float"),
    "none": (lambda: dict(x=None), TypeError, "x is of type NoneType"),
    "shape": (lambda: dict(x=VALUES.T), ValueError, r"NumPy array \(4, 3\); expected \(3, 4\) \[world, dof\]"),
    "one world": (
        lambda: dict(x=VALUES[0]),
        ValueError,
        r"x is a NumPy array \(4,\); .*shape of one world; stack 3 of",
    ),
    "complex": (lambda: dict(x=VALUES.astype(complex)), ValueError, "complex128.*convert it to float32"),
    "warp dtype": (lambda: dict(x=wp.zeros((3, 4), dtype=wp.float64, device="cpu")), ValueError, "dtype='float64'"),
    "warp strides": (lambda: dict(x=wp.zeros((3, 8), device="cpu")[:, ::2]), ValueError, "expected a C-contiguous"),
    "torch dtype": (
        lambda: dict(x=torch.zeros(3, 4).double()),
        ValueError,
        "torch array float64.*build the object with",
    ),
    "torch strides": (lambda: dict(x=torch.zeros(4, 3).T), ValueError, r"pass x.contiguous\(\)"),
    "torch device": (lambda: dict(x=torch.zeros(3, 4, device="meta")), ValueError, "on meta; expected it on"),
    "torch grad": (lambda: dict(x=torch.zeros(3, 4).requires_grad_()), ValueError, r"derivatives.*x.detach\(\)"),
    "out grad": (
        lambda: dict(x=torch.zeros(3, 4), out=torch.zeros(3, 4).requires_grad_()),
        ValueError,
        "out requires grad",
    ),
    "out kind": (lambda: dict(x=torch.zeros(3, 4), out=numpy32()), TypeError, "the kind of the first array"),
    "out list": (lambda: dict(x=VALUES, out=[0]), TypeError, "out is of type list"),
    "out dtype": (lambda: dict(x=VALUES, out=VALUES.copy()), ValueError, "out is a NumPy array float64"),
    "out shape": (lambda: dict(x=VALUES, out=numpy32((3, 5))), ValueError, r"out.*\(3, 5\); expected \(3, 4\)"),
    "out read-only": (read_only, ValueError, "read-only"),
    "out overlaps": (shared_torch, ValueError, "out overlaps x in memory"),
    "out overlaps, NumPy": (shared_numpy, ValueError, "out overlaps x in memory"),
    "status dtype": (
        lambda: dict(x=VALUES, status=np.zeros(3)),
        ValueError,
        r"status.*expected int32 \(3,\) \[world\]",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused(case):
    arguments, error, words = REFUSED[case]
    with pytest.raises(error, match=words):
        copy(**arguments(), device=wp.get_device("cpu"))


def test_warp_tape_is_refused():
    x = wp.zeros((WORLDS, SIZE), device="cpu", requires_grad=True)
    copy(x, wp.get_device("cpu"))  # nobody records
    with wp.Tape(), pytest.raises(ValueError, match="recorded by"):
        copy(x, wp.get_device("cpu"))


def test_stream_is_torchs_and_is_given_back(device):
    if not device.is_cuda:
        pytest.skip("streams need CUDA")
    before = device.stream
    side = torch.cuda.Stream(wp.device_to_torch(device))
    with torch.cuda.stream(side), Call("stream", device, wp.float32) as call:
        call.read("x", make("torch", VALUES, device), (WORLDS, SIZE))
        assert device.stream.cuda_stream == side.cuda_stream
    assert device.stream == before
    with pytest.raises(ValueError), torch.cuda.stream(side):
        copy(torch.zeros((SIZE, WORLDS), device=wp.device_to_torch(device)).T, device)  # not contiguous
    assert device.stream == before
