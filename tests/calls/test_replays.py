"""Calls that are repeated from a recording: their numbers, what they refuse, and threads that share a Dynamics."""

import functools
import itertools
import threading

import numpy as np
import pytest
import torch
import warp as wp
from torch._subclasses.fake_tensor import FakeTensorMode

import warp_spo as spo
from support import actuated, laws, zoo
from support.border import explained, made
from support.laws import numbers
from support.mechanisms import MECHANISMS
from support.quick import slow_unless
from warp_spo.dynamics.operation import Argument
from warp_spo.runtime import launches

WORLDS = 3
UNRECORDED = ("hybrid_dynamics", "operators")  # takes a NumPy mask; makes an object

STRIDED = ("forward_dynamics_derivatives", "embed")  # copies rows into the caller's array


@functools.cache
def dynamics(device, name="fork", granularity=None, loops="raise", refine=0):
    scene = actuated.driven(zoo.fork() if name == "fork" else MECHANISMS[name]())
    return spo.Dynamics(scene, WORLDS, device, "float64", ("body_mass",), granularity, loops, refine=refine)


def given(dyn, operation, seed, kind):
    """Arguments of any declared operation by name, different in every world."""
    rng, found = np.random.default_rng(seed), {}
    for one in operation.arguments:
        if not isinstance(one, Argument):
            found |= {} if one.sample is None else {one.name: one.sample(dyn.scene)}
        elif not one.written:
            values = rng.normal(size=dyn._engine.shape(one.axes, 2)[0])
            state = one.axes == "world, coordinate" and not one.direction
            found[one.name] = made(kind, dyn.scene.neutral_q + 0.3 * values if state else values, dyn)
    return found


def leaves(result):
    if isinstance(result, dict):
        return list(result.values())
    return list(result) if isinstance(result, tuple) else [result]


def replayed(dyn, name, *args, **more):
    """The result of a call, which must be a repetition."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(dyn._replays), "run", lambda *_: pytest.fail(f"{name} was not repeated"))
        return getattr(dyn, name)(*args, **more)


def agree(got, wanted):
    for one, other in zip(leaves(got), leaves(wanted), strict=True):
        np.testing.assert_array_equal(numbers(one), numbers(other))


CASES = [
    ("fork", None, "raise"),
    ("fork", "node", "raise"),
    ("fourbar", None, "embed"),
    ("fourbar", None, "multipliers"),
]


@pytest.mark.parametrize(
    ("kind", "case"),
    slow_unless(
        [("warp", CASES[1]), ("torch", CASES[2]), ("torch", CASES[3])], itertools.product(["torch", "warp"], CASES)
    ),
    ids=str,
)
def test_every_operation_repeated_is_itself(kind, case, device):
    """Of new arrays, the bits of NumPy's call, which nobody records; results are kept, and made anew."""
    dyn, seen = dynamics(device.alias, *case), 0
    for name, operation in dyn._operations.items():
        if name in UNRECORDED or (name, case[2]) == STRIDED:
            continue
        try:
            for seed in range(2):
                getattr(dyn, name)(**given(dyn, operation, seed, kind))
        except spo.UnsupportedError:
            continue
        before = replayed(dyn, name, **given(dyn, operation, 2, kind))
        copies = [numbers(one).copy() for one in leaves(before)]
        after = replayed(dyn, name, **given(dyn, operation, 3, kind))
        for got, seed in ((before, 2), (after, 3)):
            agree(got, getattr(dyn, name)(**given(dyn, operation, seed, "numpy")))
        agree(tuple(leaves(before)), tuple(copies))
        seen += 1
    assert seen > 10


@pytest.mark.parametrize("kind", ["torch", "warp"])
def test_in_place_and_out_of_place(kind, device):
    """The same arguments by the same names, but other memory: each is recorded apart."""
    dyn = dynamics(device.alias)
    operation = dyn._operations["step"]
    for name in ("q", "both", "neither", "q", "both", "neither", "q", "both", "neither"):
        for seed in range(2):
            a = {n: x for n, x in given(dyn, operation, seed, kind).items() if n in ("q", "qd", "tau", "dt")}
            a |= {"dt": 0.01, "out": tuple(made(kind, np.full(tuple(a[n].shape), np.nan), dyn) for n in ("q", "qd"))}
            wanted = dyn.step(**{n: numbers(x) if n in ("q", "qd", "tau") else x for n, x in a.items() if n != "out"})
            a["out"] = {"q": (a["q"], a["out"][1]), "both": (a["q"], a["qd"]), "neither": a["out"]}[name]
            got = dyn.step(**a)
            assert got[0] is a["out"][0] and got[1] is a["out"][1]
            agree(got, wanted)


def test_arrays_side_by_side_in_one_tensor(device):
    """Results and arguments that touch in memory: addresses count, not objects."""
    dyn = dynamics(device.alias)
    n, dofs = WORLDS * dyn.scene.coord_count, WORLDS * dyn.scene.dof_count
    long = torch.full((n + 4 * dofs,), 7.0, dtype=torch.float64, device=wp.device_to_torch(device))
    for seed in range(4):
        a = given(dyn, dyn._operations["bias_force"], seed, "torch")
        q, qd, out = long[dofs : dofs + n], long[dofs + n : 2 * dofs + n], long[2 * dofs + n : 3 * dofs + n]
        q.copy_(a["q"].ravel()), qd.copy_(a["qd"].ravel())
        out = out.view(WORLDS, -1)
        assert dyn.bias_force(q.view(WORLDS, -1), qd.view(WORLDS, -1), out=out) is out
        agree(out, dyn.bias_force(numbers(a["q"]), numbers(a["qd"])))
    assert (long[:dofs] == 7.0).all() and (long[-dofs:] == 7.0).all()


BAD = {
    "shape": (lambda x: x[:2], "q is a torch array float64 (2, "),
    "dtype": (lambda x: x.float(), "q is a torch array float32"),
    "strides": (lambda x: torch.stack([x, x], 1)[:, 0], "q is a torch array", "with strides"),
    "grad": (lambda x: x.clone().requires_grad_(), "out is given and an input requires grad"),
    "negative": (lambda x: torch._neg_view(x), "q is a lazy negative view"),
    "zeros": (lambda x: torch._efficientzerotensor(x.shape, dtype=x.dtype, device=x.device), "q holds no memory"),
    "sparse": (lambda x: x.to_sparse(), "q is a torch array", "expected a dense one"),
    "class": (lambda x: x.cpu().numpy().tolist(), "q is of type list"),
    "complex": (lambda x: x.to(torch.complex128), "q is a torch array complex128"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_refused_after_a_recording_too(case, device):
    spoil, *words = BAD[case]
    dyn = dynamics(device.alias)
    q = given(dyn, dyn._operations["gravity_force"], 0, "torch")["q"]
    out = torch.zeros(WORLDS, dyn.scene.dof_count, dtype=q.dtype, device=q.device)
    for _ in range(3):
        dyn.gravity_force(q, out=out)
    with explained((ValueError, TypeError), "Dynamics.gravity_force", *words):
        dyn.gravity_force(spoil(q), out=out)
    for _ in range(3):
        dyn.bias_force(q, out.clone(), out=out)
    with explained(ValueError, "Dynamics.bias_force", "out overlaps qd in memory"):
        dyn.bias_force(q, out, out=out)
    version = out._version
    replayed(dyn, "gravity_force", q, out=out)
    assert out._version > version  # so that a backward pass that saved it raises


def test_tensors_in_place_of_numbers_are_read_in_every_call(device):
    """dt, a body and its pose in frames: the numbers that the tensors hold are none of the recording's."""
    dyn = dynamics(device.alias)
    a, pose = given(dyn, dyn._operations["integrate"], 0, "torch"), [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    grown = a["q"].clone().requires_grad_()
    for i in range(4):
        dt, body, moved = 0.01 * (i + 1), i % 2, [float(i), *pose[1:]]
        agree(dyn.integrate(a["q"], a["qd"], torch.tensor(dt, dtype=torch.float64)), dyn.integrate(a["q"], a["qd"], dt))
        agree(dyn.jacobian(a["q"], [torch.tensor(body)]), dyn.jacobian(a["q"], [body]))
        agree(dyn.jacobian(a["q"], [(0, torch.tensor(moved))]), dyn.jacobian(a["q"], [(0, moved)]))
        results = [dyn.integrate(grown, a["qd"], x) for x in (torch.tensor(dt, dtype=torch.float64), dt)]
        agree(*[torch.autograd.grad(x.square().sum(), grown) for x in results])


def test_options_that_change_before_the_backward_pass(device):
    """The way back is that of the call: of the frames that its list held, and of the dt."""
    dyn = dynamics(device.alias)
    a = given(dyn, dyn._operations["integrate"], 0, "torch")
    q, qd = a["q"].requires_grad_(), a["qd"].requires_grad_()
    for _ in range(3):
        frames, dt = [0], torch.tensor(0.01, dtype=torch.float64)
        results = dyn.jacobian(q, frames), dyn.integrate(q, qd, dt)
        wanted = dyn.jacobian(q, [0]), dyn.integrate(q, qd, 0.01)
        frames[0] = 1
        dt.fill_(0.5)
        for result, other in zip(results, wanted, strict=True):
            x = qd if other is wanted[1] else q
            agree(*[torch.autograd.grad(y.square().sum(), x) for y in (result, other)])


def test_one_array_twice_then_another(device):
    """Arguments that were the same tensor in the recorded call are looked at one by one in the next."""
    dyn = dynamics(device.alias)
    a = given(dyn, dyn._operations["bias_force"], 0, "torch")
    wanted = dyn.step(numbers(a["q"]), numbers(a["qd"]), None, 0.01)
    for out in ((0, 1), (0, None), (None, None)):
        for _ in range(4):
            q, qd = a["q"].clone(), a["qd"].clone()
            agree(dyn.step(q, qd, None, 0.01, out=(q, qd)), wanted)
        q, qd = a["q"].clone(), a["qd"].clone()
        agree(dyn.step(q, qd, None, 0.01, out=tuple(None if i is None else (q, qd)[i] for i in out)), wanted)
    q = a["q"].clone().requires_grad_()
    for _ in range(3):
        dyn.inverse_dynamics(q, a["qd"], a["qd"])
    agree(dyn.inverse_dynamics(q, a["qd"], None).detach(), dyn.inverse_dynamics(a["q"], a["qd"], None))
    for _ in range(3):
        dyn.inverse_dynamics(q, a["qd"], a["qd"])
    with explained(TypeError, "Dynamics.inverse_dynamics", "qdd is of type ndarray"):
        dyn.inverse_dynamics(q, a["qd"], numbers(a["qd"]))


def test_sparse_tensors_that_require_grad_are_refused_alike_each_time(device):
    dyn = dynamics(device.alias)
    a = given(dyn, dyn._operations["bias_force"], 0, "torch")
    q = a["q"].to_sparse().requires_grad_()
    for _ in range(3):
        with explained(ValueError, "Dynamics.bias_force", "q is a torch array", "expected a dense one"):
            dyn.bias_force(q, a["qd"])


def test_results_have_memory_inside_transforms_and_modes_of_torch(device):
    """The first call, which nothing repeats, gives what later ones do; fake tensors have no memory to write to."""
    dyn = spo.Dynamics(zoo.fork(), WORLDS, device, "float64", granularity="node")
    a = given(dyn, dyn._operations["inverse_dynamics"], 0, "torch")
    q, qd = a["q"], a["qd"]
    weights = torch.ones_like(qd)
    for _ in range(4):
        found = torch.func.grad(lambda z: (dyn.inverse_dynamics(q, qd) * z).sum())(weights)
        with FakeTensorMode(allow_non_fake_inputs=True):
            inside = dyn.inverse_dynamics(q, qd)
        assert torch.equal(found, dyn.inverse_dynamics(q, qd)) and torch.equal(found, inside)


def test_a_tape_and_a_tensor_of_values_are_seen(device):
    dyn = dynamics(device.alias)
    q = wp.array(given(dyn, dyn._operations["gravity_force"], 0, "numpy")["q"], dtype=wp.float64, device=device)
    for _ in range(3):
        dyn.log_det_mass_matrix(q)
    q.requires_grad = True
    with wp.Tape(), explained(ValueError, "Dynamics.log_det_mass_matrix", "q is recorded by wp.Tape"):
        dyn.log_det_mass_matrix(q)
    mass = torch.tensor(dyn.scene.values["body_mass"][0], device=wp.device_to_torch(device), requires_grad=True)
    dyn.set(body_mass=mass)
    with explained(ValueError, "Dynamics.log_det_mass_matrix", "body_mass was set to a tensor that requires grad"):
        dyn.log_det_mass_matrix(q)
    dyn.set(body_mass=mass.detach())


@pytest.mark.parametrize("granularity", ["tree", "node"])
def test_values_that_were_set_since(granularity, device):
    dyn = spo.Dynamics(zoo.fork(), WORLDS, device, "float64", ("body_mass",), granularity)
    q, masses = given(dyn, dyn._operations["gravity_force"], 0, "torch")["q"], dyn.scene.values["body_mass"][0]
    for factor in (1.0, 1.0, 1.0, 2.0, 3.0):
        dyn.set(body_mass=factor * masses)
        wanted = spo.Dynamics(dyn.scene.with_values(body_mass=factor * masses), WORLDS, device, "float64")
        assert laws.error(numbers(dyn.gravity_force(q)), wanted.gravity_force(numbers(q))) <= 1e-14
    with pytest.warns(UserWarning, match="gravity is folded"):
        dyn.set(gravity=(0.0, 0.0, 0.0))
    assert not numbers(dyn.gravity_force(q)).any()


# -- threads -----------------------------------------------------------------------------------------------------------
THREADED = ("forward_dynamics", "mass_matrix_inverse", "body_poses", "step", "inverse_dynamics")


def wrong_calls(dyn, threads, calls, kind):
    """How many calls from several threads differ from the same call alone; and streams differ, on CUDA."""
    a = [{name: given(dyn, dyn._operations[name], seed, kind) for name in THREADED} for seed in range(threads)]
    wanted = [{name: leaves(getattr(dyn, name)(**one[name])) for name in THREADED} for one in a]
    wanted = [{name: [numbers(x).copy() for x in found] for name, found in one.items()} for one in wanted]
    wrong, errors, start = [], [], threading.Barrier(threads)

    def work(number):
        try:
            start.wait()
            for i in range(calls):
                name = THREADED[(i + number) % len(THREADED)]
                found = leaves(getattr(dyn, name)(**a[number][name]))
                with dyn._replays.call_order.lock:  # reading a Warp array changes the current stream
                    got = [numbers(x) for x in found]
                same = [np.array_equal(x, y) for x, y in zip(got, wanted[number][name], strict=True)]
                wrong.extend([] if all(same) else [name])
        except Exception as error:
            errors.append(error)

    def on_a_stream(number):
        if dyn.device.is_cpu:
            return work(number)
        with torch.cuda.stream(torch.cuda.Stream(wp.device_to_torch(dyn.device))):
            return work(number)

    workers = [threading.Thread(target=on_a_stream, args=(number,)) for number in range(threads)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert not errors, errors
    return wrong


@pytest.mark.parametrize("granularity", ["tree", "node"])
def test_threads_share_a_dynamics(granularity, device):
    assert not wrong_calls(dynamics(device.alias, "fork", granularity), 4, 60, "torch")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["torch", "warp", "numpy"])
@pytest.mark.parametrize("granularity", ["tree", "segment", "node"])
def test_eight_threads_of_a_thousand_calls(granularity, kind, device):
    assert not wrong_calls(dynamics(device.alias, "fork", granularity), 8, 1000, kind)


def test_work_waits_until_all_kernels_are_compiled(device):
    """Work in the block is done at its end, in order, and nothing is repeated from a call that did nothing yet."""
    dyn = spo.Dynamics(zoo.fork(), WORLDS, device, "float64")
    rng, scene = np.random.default_rng(5), dyn.scene
    sizes = scene.coord_count, scene.dof_count, scene.dof_count
    q, qd, tau = (wp.array(rng.normal(size=(WORLDS, n)), dtype=dyn.dtype, device=dyn.device) for n in sizes)
    expected = dyn.forward_dynamics(q, qd, tau).numpy()
    arrays = [wp.zeros(expected.shape, dtype=dyn.dtype, device=dyn.device) for _ in range(3)]
    first, second, third = arrays
    with launches.compile_side_by_side():
        for _ in range(4):
            dyn.forward_dynamics(q, qd, tau, out=first)
        launches.copy(second, first)
        launches.fill(first, 2.0)
        with launches.compile_side_by_side():
            launches.copy(third, first)
        assert not any(array.numpy().any() for array in arrays)
    np.testing.assert_array_equal(second.numpy(), expected)
    assert (first.numpy() == 2.0).all() and (third.numpy() == 2.0).all()
    for _ in range(4):
        first.zero_()
        dyn.forward_dynamics(q, qd, tau, out=first)
        np.testing.assert_array_equal(first.numpy(), expected)


def test_nothing_of_a_block_that_fails_is_done(device):
    array = wp.zeros(3, device=device)
    with pytest.raises(ZeroDivisionError), launches.compile_side_by_side():
        launches.fill(array, 2.0)
        raise ZeroDivisionError
    assert not array.numpy().any()
    launches.fill(array, 3.0)
    assert (array.numpy() == 3.0).all()
