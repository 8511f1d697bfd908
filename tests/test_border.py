"""Every operation of Dynamics x every kind of array: right numbers in the right kind, or an error that explains."""

import functools
import re
from fractions import Fraction

import laws
import numpy as np
import pytest
import torch
import warp as wp
import zoo
from laws import OPERATIONS, TOLERANCE
from torch.autograd import forward_ad

import warp_spo as spo
from warp_spo import reference
from warp_spo.adjoints import ARGUMENTS

WORLDS = 3
KINDS = ["torch", "warp", "numpy"]
INPUTS = [
    (operation, name)
    for operation, (takes, _) in OPERATIONS.items()
    for name in ("q", *takes)
    if name not in ("frames", "dt")
]
SAME = {"float32": 2e-6, "float64": 4e-15}  # two calls that differ in the length of a quaternion: its rounding alone


@functools.cache
def scene():
    return zoo.fork()


@functools.cache
def _dynamics(device, dtype):
    return spo.Dynamics(scene(), WORLDS, device=device, dtype=dtype)


def dynamics(device, dtype="float64"):
    return _dynamics(device.alias, dtype)


def made(kind, values, dyn):
    """``values`` as an array of a kind that ``dyn`` takes."""
    dtype = dyn.dtype.__name__
    if kind == "torch":
        return torch.tensor(values, dtype=getattr(torch, dtype), device=wp.device_to_torch(dyn.device))
    if kind == "warp":
        return wp.array(values, dtype=dyn.dtype, device=dyn.device)
    return np.array(values, dtype)


def numbers(array):
    array = array.detach().cpu() if isinstance(array, torch.Tensor) else array
    return np.asarray(array.numpy() if hasattr(array, "numpy") else array, dtype=np.float64)


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


# -- right numbers, right kind -----------------------------------------------------------------------------------------
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("operation", OPERATIONS)
def test_result_is_the_reference_in_the_kind_and_dtype_of_the_input(operation, kind, dtype, device):
    dyn = dynamics(device, dtype)
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


# -- what is refused, in every operation and argument ------------------------------------------------------------------
@pytest.mark.parametrize(("operation", "name"), INPUTS)
def test_refused_in_words(operation, name, device):
    dyn = dynamics(device, "float32")
    call = f"Dynamics.{operation}"

    def run(kind, value):
        return laws.call(dyn, operation, given(kind, dyn) | {name: value})

    for kind, title in (("torch", "torch"), ("warp", "Warp"), ("numpy", "NumPy")):
        good = laws.states(dyn.scene, WORLDS)[name]
        what = f"{name} is a {title} array"
        one = good.shape[1:2] if name == "b" else good.shape[1:]
        for shape in ((WORLDS + 1, *good.shape[1:]), (1, *good.shape[1:]), (WORLDS, good.shape[1] + 1), one):
            with explained(ValueError, call, what, str(shape), "expected float32", "[world, ", f"reshape {name}"):
                run(kind, made(kind, np.zeros(shape), dyn))
    double = dynamics(device, "float64")
    for kind in ("torch", "warp"):
        with explained(ValueError, call, f"{name} is a", "float64", "expected float32", "convert", "dtype='float64'"):
            run(kind, given(kind, double)[name])
    with explained(ValueError, call, f"{name} is a NumPy array complex128", "expected float32", "convert"):
        run("numpy", good.astype(complex))
    with explained(ValueError, call, f"{name} is a torch array", "on meta", f"expected it on {device}", "move it"):
        run("torch", torch.zeros(good.shape, device="meta"))
    if device.is_cuda:
        with explained(ValueError, call, f"{name} is a", "on cpu", f"expected it on {device}", "move it there"):
            run("torch", torch.zeros(good.shape))
    strided = made("torch", np.zeros((*good.shape[:-1], 2 * good.shape[-1])), dyn)[..., ::2]
    with explained(ValueError, call, f"{name} is a torch array", "C-contiguous", f"{name}.contiguous()"):
        run("torch", strided)
    for value, what in ((good.tolist(), "list"), (tuple(good.tolist()), "tuple"), (1.0, "float"), ("text", "str")):
        with explained(TypeError, call, f"{name} is of type {what}", "expected a torch tensor"):
            run("numpy", value)
    if name in ARGUMENTS.get(operation, ()):
        assert run("torch", given("torch", dyn)[name].requires_grad_()).requires_grad
    else:
        with explained(ValueError, call, f"{name} requires grad", "derivatives", f"{name}.detach()", "torch.no_grad()"):
            run("torch", given("torch", dyn)[name].requires_grad_())
    if name == "q" or (operation, name) in (("body_velocities", "qd"), ("integrate", "qd"), ("solve_mass_matrix", "b")):
        with explained(TypeError, call, f"{name} is of type NoneType"):
            run("numpy", None)


@pytest.mark.parametrize("operation", OPERATIONS)
def test_out_is_refused_in_words(operation, device):
    dyn = dynamics(device, "float32")
    call = f"Dynamics.{operation}"
    shape = tuple(laws.call(dyn, operation, given("numpy", dyn)).shape)
    for kind, other in (("torch", "numpy"), ("warp", "torch"), ("numpy", "warp")):
        arrays = given(kind, dyn)
        run = functools.partial(laws.call, dyn, operation, arrays)
        with explained(TypeError, call, "out is a", "the kind of the first array"):
            run(out=made(other, np.zeros(shape), dyn))
        with explained(TypeError, call, "out is of type list"):
            run(out=[0.0])
        with explained(ValueError, call, "out is a", str((*shape[:-1], shape[-1] + 1)), "expected float32"):
            run(out=made(kind, np.zeros((*shape[:-1], shape[-1] + 1)), dyn))
        with explained(ValueError, call, "out is a", "float64", "expected float32"):
            run(out=made(kind, np.zeros(shape), dynamics(device, "float64")))
        if kind != "numpy":  # memory of an input, big enough for both
            size = max(int(np.prod(shape)), int(np.prod(arrays["q"].shape)))
            memory = made(kind, np.zeros(size), dyn)
            q = memory[: int(np.prod(arrays["q"].shape))].reshape(tuple(arrays["q"].shape))
            out = memory[: int(np.prod(shape))].reshape(shape)
            with explained(ValueError, call, "out overlaps q in memory", "apart", "fresh array"):
                laws.call(dyn, operation, arrays | {"q": q}, out=out)
    with explained(ValueError, call, "out requires grad"):
        laws.call(dyn, operation, given("torch", dyn), out=made("torch", np.zeros(shape), dyn).requires_grad_())
    frozen = np.zeros(shape, np.float32)
    frozen.flags.writeable = False
    with explained(ValueError, call, "out is a read-only NumPy array", "copy"):
        laws.call(dyn, operation, given("numpy", dyn), out=frozen)
    if not device.is_cuda:
        run = functools.partial(laws.call, dyn, operation, given("torch", dyn))
        with explained(ValueError, call, "out is a torch array", "on meta", "expected it on cpu"):
            run(out=torch.zeros(shape, device="meta"))


@pytest.mark.parametrize("operation", OPERATIONS)
def test_a_tensor_that_requires_grad_is_taken_without_grad_mode_only(operation, device):
    dyn = dynamics(device)
    arrays = {name: array.requires_grad_() for name, array in given("torch", dyn).items()}
    with torch.no_grad():
        result = laws.call(dyn, operation, arrays)
    assert not result.requires_grad
    assert_right(dyn, operation, result)
    if operation in ARGUMENTS:
        assert laws.call(dyn, operation, arrays).requires_grad
    else:
        with pytest.raises(ValueError, match="requires grad"):
            laws.call(dyn, operation, arrays)


def test_a_lazy_negative_view_is_refused(device):
    """Its memory holds the numbers with the other sign: read as it is, the result would be of another state."""
    dyn = dynamics(device)
    q = given("torch", dyn)["q"]
    negative = torch.complex(torch.zeros_like(q), -q).conj().imag
    assert negative.is_neg() and torch.equal(negative, q)
    with explained(ValueError, "Dynamics.gravity_force", "q is a", "q.resolve_neg()"):
        dyn.gravity_force(negative.contiguous() if negative.is_contiguous() else torch._neg_view(-q))
    np.testing.assert_array_equal(
        numbers(dyn.gravity_force(negative.resolve_neg().contiguous())), numbers(dyn.gravity_force(q))
    )


def test_a_lazy_zero_tensor_is_refused(device):
    """It has numbers and no memory: read at its address, the interpreter would end."""
    dyn = dynamics(device)
    q = given("torch", dyn)["q"]
    zero = torch._efficientzerotensor(q.shape, dtype=q.dtype, device=q.device)
    words = "holds no memory", "expected numbers in memory", ".clone()"
    with explained(ValueError, "Dynamics.gravity_force: q", *words):
        dyn.gravity_force(zero)
    with explained(ValueError, "Dynamics.bias_force: qd", *words):
        dyn.bias_force(q, torch._efficientzerotensor((WORLDS, dyn.scene.dof_count), dtype=q.dtype))
    np.testing.assert_array_equal(numbers(dyn.gravity_force(zero.clone())), numbers(dyn.gravity_force(0.0 * q)))


@pytest.mark.filterwarnings("ignore:.*torch.jit.script")  # of torch itself, in forward mode
def test_a_forward_mode_tangent_is_never_dropped(device):
    """Nothing of a dual tensor says so: its requires_grad is False, and its memory holds the primal alone."""
    dyn = spo.Dynamics(scene(), WORLDS, device=device, dtype="float64", variable=("body_mass",))
    a = given("torch", dyn)
    mass = made("torch", dyn.scene.values["body_mass"][0], dyn)
    with forward_ad.dual_level():
        dual = {name: forward_ad.make_dual(a[name], torch.ones_like(a[name])) for name in ("q", "qd", "tau")}
        seconds = forward_ad.make_dual(torch.tensor(0.01), torch.tensor(1.0))
        pose = forward_ad.make_dual(torch.tensor(POSE), torch.ones(7))
        calls = {
            "Dynamics.gravity_force: q": lambda: dyn.gravity_force(dual["q"]),
            "Dynamics.forward_dynamics: tau": lambda: dyn.forward_dynamics(a["q"], a["qd"], dual["tau"]),
            "Dynamics.mass_matrix_inverse: q": lambda: dyn.mass_matrix_inverse(dual["q"]),
            "Dynamics.bias_force: qd": lambda: dyn.bias_force(a["q"].clone().requires_grad_(), dual["qd"]),
            "Dynamics.bias_force: out": lambda: dyn.bias_force(a["q"], a["qd"], out=dual["tau"]),
            "Dynamics.set: body_mass": lambda: dyn.set(body_mass=forward_ad.make_dual(mass, mass)),
            "Dynamics.step: dt": lambda: dyn.step(a["q"], a["qd"], None, seconds),
            "Dynamics.jacobian: a frame's pose": lambda: dyn.jacobian(a["q"], [(0, pose)]),
        }
        for name, call in calls.items():
            with explained(ValueError, name, "has a forward-mode tangent", "backward", "_jvp", "unpack_dual"):
                call()
        primal = forward_ad.unpack_dual(dual["q"]).primal
        np.testing.assert_array_equal(numbers(dyn.gravity_force(primal)), numbers(dyn.gravity_force(a["q"])))
    np.testing.assert_array_equal(numbers(dyn.gravity_force(a["q"])), numbers(dynamics(device).gravity_force(a["q"])))


@pytest.mark.filterwarnings("ignore:.*torch.jit.script")  # of torch itself, in forward mode
def test_transforms_of_torch_are_refused_by_name(device):
    """They hand in wrappers without memory: of the arguments, or of the cotangents on the way back."""
    dyn = dynamics(device)
    a = given("torch", dyn)
    q, one = a["q"], a["q"].clone().requires_grad_()
    force, inverse = dyn.gravity_force, dyn.mass_matrix_inverse
    result = force(one)
    functional = torch.autograd.functional.jacobian
    calls = {
        "gravity_force: q is": [
            lambda: torch.func.vmap(force)(torch.stack([q, q])),
            lambda: torch.func.jvp(force, (q,), (q,)),
            lambda: torch.func.jacfwd(force)(q),
            lambda: torch.func.grad(lambda x: force(x).sum())(q),
        ],
        "mass_matrix_inverse: q is": [lambda: torch.func.vmap(inverse)(torch.stack([q, q]))],
        "inverse_dynamics_vjp: cotangent is": [
            lambda: functional(force, q, vectorize=True),
            lambda: torch.autograd.grad(result, one, torch.stack([result, result]).detach(), is_grads_batched=True),
        ],
    }
    for name, those in calls.items():
        for call in those:
            with explained(ValueError, f"Dynamics.{name}", "wrapped by a transform", "vectorize=False"):
                call()
    assert functional(force, q).shape == (*result.shape, *q.shape)


BAD_SECONDS = [
    None, "soon", "1e-3", b"1e-3", True, np.True_, np.array(True), torch.tensor(True), 1j, np.complex64(1e-3),
    torch.tensor(1j), np.array("0.001"), np.array("0.001", object), 10**400, torch.zeros((), device="meta"), [0.25],
    np.full(WORLDS, 0.25), torch.full((1,), 0.25), wp.zeros(1, device="cpu"),
]  # fmt: skip


def test_dt_is_one_number_and_is_never_detached(device):
    dyn = dynamics(device)
    a = laws.states(dyn.scene, WORLDS)
    wanted = dyn.integrate(a["q"], a["qd"], 0.25)
    for dt in (np.float32(0.25), np.float64(0.25), np.array(0.25), torch.tensor(0.25), Fraction(1, 4)):
        np.testing.assert_array_equal(dyn.integrate(a["q"], a["qd"], dt), wanted)
    wanted = dyn.integrate(a["q"], a["qd"], 1.0)
    for dt in (1, np.int8(1), np.array(1, np.uint8), torch.tensor(1)):
        np.testing.assert_array_equal(dyn.integrate(a["q"], a["qd"], dt), wanted)
    for dt in BAD_SECONDS:
        with explained(TypeError, "Dynamics.integrate", "dt is", "expected a number of seconds"):
            dyn.integrate(a["q"], a["qd"], dt)
    with explained(ValueError, "Dynamics.integrate", "dt requires grad", "float(dt)"):
        dyn.integrate(a["q"], a["qd"], torch.tensor(0.25, requires_grad=True))
    far = dyn.integrate(a["q"], a["qd"], 1e6)
    assert np.isfinite(far).all()
    for hinge, start in zip(dyn.scene.hinges, dyn.scene.q_start, strict=False):
        if hinge.kind in ("ball", "free"):
            end = start + hinge.coord_count
            assert np.abs(np.linalg.norm(far[:, end - 4 : end], axis=1) - 1.0).max() <= SAME["float64"]


BAD_DT = [np.nan, np.inf, 1e-60, 1e60]


@pytest.mark.parametrize("operation", ["step", "integrate"])
def test_dt_is_a_number_that_the_dtype_holds(operation, device):
    """Rounded to zero or infinity it would be a step of another length, or NaN in all worlds."""
    dyn = dynamics(device, "float32")
    a = laws.states(dyn.scene, WORLDS)
    arguments = (a["q"], a["qd"], a["tau"])[: 3 if operation == "step" else 2]
    for dt in BAD_DT:
        with explained(ValueError, f"Dynamics.{operation}", f"dt is {dt} s", "float32", "finite"):
            getattr(dyn, operation)(*arguments, dt)
    for dt in BAD_SECONDS:
        with explained(TypeError, f"Dynamics.{operation}", f"dt is {dt!r}", "expected a number of seconds"):
            getattr(dyn, operation)(*arguments, dt)


# -- arrays that are not what they seem --------------------------------------------------------------------------------
def test_a_masked_array_is_refused_wherever_an_array_goes(device):
    """What is under its mask would be taken for numbers."""
    dyn = spo.Dynamics(scene(), WORLDS, device=device, dtype="float64", variable=("body_mass",))
    hide = lambda x: np.ma.masked_array(x, mask=np.arange(np.size(x)).reshape(np.shape(x)) == 0)  # noqa: E731
    q, mass = laws.states(dyn.scene, WORLDS)["q"], dyn.scene.values["body_mass"][0]
    shape = (WORLDS, dyn.scene.dof_count)
    calls = {
        "q": lambda: dyn.gravity_force(hide(q)),
        "tau": lambda: dyn.forward_dynamics(q, tau=hide(np.zeros(shape))),
        "out": lambda: dyn.gravity_force(q, out=hide(np.zeros(shape))),
        "status": lambda: dyn.forward_dynamics(q, status=hide(np.zeros(WORLDS, np.int32))),
        "prescribed": lambda: dyn.hybrid_dynamics(q, prescribed=hide(np.zeros(shape[1], bool))),
        "body_mass": lambda: dyn.set(body_mass=hide(mass)),
        "joint_damping": lambda: dyn.set(joint_damping=hide(np.ones(shape[1]))),
        "gravity": lambda: dyn.scene.with_values(gravity=hide(np.ones(3))),
        "com": lambda: spo.Body(1.0, hide(np.ones(3)), np.eye(3)),
        "axis": lambda: spo.Hinge("revolute", -1, 0, axis=hide(np.eye(3)[0])),
        "a frame's pose": lambda: dyn.jacobian(q, [(0, hide(np.array(POSE)))]),
    }
    for name, call in calls.items():
        with explained(TypeError, f"{name}", "is a masked array", "expected a plain NumPy array", ".filled(number)"):
            call()
    np.testing.assert_array_equal(dyn.gravity_force(hide(q).data), dyn.gravity_force(q))


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


def test_numpy_arrays_to_be_filled_have_the_dtype_of_what_fills_them(device):
    """A status of bools or a qdd of integers would lose what is written."""
    dyn = dynamics(device)
    a = laws.states(dyn.scene, WORLDS)
    for dtype in (bool, np.int8, np.int64, np.float64):
        for call in (lambda s: dyn.forward_dynamics(a["q"], status=s),
                     lambda s: dyn.step(a["q"], a["qd"], None, 1e-3, status=s)):  # fmt: skip
            with explained(ValueError, "status is a NumPy array", np.dtype(dtype).name, "expected int32", "convert it"):
                call(np.zeros(WORLDS, dtype))
    for dtype in (int, np.float32):
        with explained(ValueError, "Dynamics.step: qdd is a NumPy array", "expected float64", "convert it"):
            dyn.step(a["q"], a["qd"], None, 1e-3, qdd=np.zeros(a["qd"].shape, dtype))


def test_masks_are_bools_and_tensors_are_dense(device):
    dyn = dynamics(device)
    q = laws.states(dyn.scene, WORLDS)["q"]
    shape = (WORLDS, dyn.scene.dof_count)
    for mask in (np.zeros(shape, int), np.zeros(shape, np.uint8), np.zeros(shape)):
        with explained(ValueError, "prescribed is a NumPy array", "expected bool", "convert it to bool"):
            dyn.hybrid_dynamics(q, prescribed=mask)
    with explained(ValueError, "prescribed is [[True], [True, False]]; expected bools"):
        dyn.hybrid_dynamics(q, prescribed=[[True], [True, False]])
    sparse = given("torch", dyn)["q"].to_sparse()
    with explained(ValueError, "Dynamics.gravity_force", "q is a torch array", "expected a dense one", "q.to_dense()"):
        dyn.gravity_force(sparse)


BAD_RESULTS = {
    "unknown": (dict(out={"q": None, "mass": None}), ValueError, "out has 'mass'; expected names out of wrt: q, qd, "),
    "not asked for": (dict(wrt=("q",), out={"qd": None}), ValueError, "out has 'qd'; expected names out of wrt: q"),
    "a list": (dict(out=[None, None, None]), TypeError, "out is of type list; expected a dict"),
    "an array": (dict(out=np.zeros(3)), TypeError, "out is of type ndarray; expected a dict"),
    "no wrt": (dict(wrt=()), ValueError, "wrt is (); expected one name or more, each once"),
    "twice": (dict(wrt=("q", "q")), ValueError, "wrt is ('q', 'q'); expected one name or more, each once"),
    "a number": (dict(wrt=3), TypeError, "wrt is 3; expected names"),
    "no names": (dict(wrt=[["q"]]), TypeError, "wrt is [['q']]; expected names"),
    "0-d": (dict(wrt=np.array("q")), TypeError, "wrt is array('q', dtype='<U1'); expected names"),
}


@pytest.mark.parametrize("case", BAD_RESULTS)
@pytest.mark.parametrize("operation", ["forward_dynamics_vjp", "inverse_dynamics_vjp"])
def test_results_by_name_are_those_that_were_asked_for(operation, case, device):
    options, error, words = BAD_RESULTS[case]
    a = laws.states(dynamics(device).scene, WORLDS)
    with explained(error, f"Dynamics.{operation}: {words}"):
        getattr(dynamics(device), operation)(a["q"], a["qd"], a["qd"], cotangent=a["qd"], **options)


# -- quaternions -------------------------------------------------------------------------------------------------------
def turned_scene():
    return zoo.random_tree(12, 3)  # a free and a ball hinge, free ones inside the tree too


@pytest.mark.parametrize("operation", OPERATIONS)
def test_quaternions_of_any_length_are_normalised_when_read(operation, device):
    for dtype in ("float32", "float64"):
        dyn = _turned(device.alias, dtype)
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
    dyn = _turned(device.alias, "float32")
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
def _turned(device, dtype):
    return spo.Dynamics(turned_scene(), WORLDS, device=device, dtype=dtype)


def _quaternions(scene):
    ends = [e for hinge, e in zip(scene.hinges, scene.q_start[1:], strict=True) if hinge.kind in ("ball", "free")]
    return [slice(int(end) - 4, int(end)) for end in ends]


# -- frames ------------------------------------------------------------------------------------------------------------
POSE = (0.1, -0.2, 0.3, 0.0, 0.6, 0.0, 0.8)


@pytest.mark.parametrize("operation", ["jacobian", "operational_inertia_inverse"])
def test_frames_by_label_index_and_pose_are_the_same(operation, device):
    bodies = [spo.Body(1.0, (0.1, 0, 0), np.eye(3), label=label) for label in ("thigh", "shin")]
    hinges = [spo.Hinge("revolute", k - 1, k, axis=np.eye(3)[k], armature=0.1) for k in range(2)]
    dyn = spo.Dynamics(spo.Scene(bodies, hinges), WORLDS, device=device, dtype="float64")
    q = laws.states(dyn.scene, WORLDS)["q"]
    run = functools.partial(getattr(dyn, operation), q)
    wanted = run([1, (0, POSE)])
    dense = np.stack([getattr(reference.Dense(dyn.scene, row), operation)([1, (0, POSE)]) for row in q])
    assert laws.error(wanted, dense) <= TOLERANCE["float64"]
    pose = np.array(POSE, np.float32)
    for frames in (["shin", ("thigh", POSE)], (np.int64(1), [0, list(POSE)]), [1, (0, wp.transform(*POSE))],
                   [1, (0, torch.tensor(POSE))], [1, (0, [torch.tensor(x) for x in POSE])]):  # fmt: skip
        assert laws.error(run(frames), wanted) <= 1e-7  # POSE in float32
    assert laws.error(run([1, (0, pose)]), wanted) <= 1e-7
    np.testing.assert_array_equal(run(range(2)), run([0, 1]))


def test_a_frame_by_the_end_of_its_label(device):
    """Importers put paths before what a file calls a body."""
    labels = "robot/arm", "robot/left/hand", "robot/right/hand"
    bodies = [spo.Body(1.0, inertia=np.eye(3), label=label) for label in labels]
    hinges = [spo.Hinge("revolute", parent, child, axis=(1, 0, 0)) for child, parent in enumerate((-1, 0, 0))]
    dyn = spo.Dynamics(spo.Scene(bodies, hinges), 1, device=device)
    q = np.ones((1, 3), np.float32)
    np.testing.assert_array_equal(dyn.jacobian(q, ["arm"]), dyn.jacobian(q, [0]))
    for label, words in (("hand", "2 bodies have the label 'hand'"), ("arn", "such as 'arm'")):
        with pytest.raises(ValueError, match=words):
            dyn.jacobian(q, [label])


BAD_FRAMES = {
    "none": (None, ValueError, "frames is None; expected a list of bodies"),
    "empty": ([], ValueError, "frames is []; expected a list of bodies"),
    "a number": (0, ValueError, "frames is 0; expected a list of bodies"),
    "a label": ("body_0", ValueError, "frames is 'body_0'; expected a list of bodies"),
    "no such label": (["nobody"], ValueError, "no body 'nobody' in the scene; expected one of scene.body_labels"),
    "beyond": ([5], ValueError, "a frame's body is 5; expected 0 to 4"),
    "negative": ([-1], ValueError, "a frame's body is -1; expected 0 to 4"),
    "yes": ([True], TypeError, "a frame is True; expected a body (index or label) or (body, pose in the body)"),
    "half": ([0.5], TypeError, "a frame is 0.5; expected a body (index or label) or (body, pose in the body)"),
    "a point": ([(0, (0, 0, 0))], ValueError, "expected x, y, z and a unit quaternion"),
    "long quaternion": ([(0, (0, 0, 0, 0, 0, 0, 2))], ValueError, "expected x, y, z and a unit quaternion"),
    "nan": ([(0, (np.nan, 0, 0, 0, 0, 0, 1))], ValueError, "expected x, y, z and a unit quaternion"),
    "text": ([(0, "here")], TypeError, "expected a body (index or label) or (body, pose in the body)"),
    "texts": ([(0, ["0"] * 6 + ["1"])], TypeError, "expected a body (index or label) or (body, pose in the body)"),
    "complex": ([(0, np.ones(7) * 1j)], TypeError, "expected a body (index or label) or (body, pose in the body)"),
    "huge": ([(0, (10**400, 0, 0, 0, 0, 0, 1))], TypeError, "expected a body (index or label) or (body, pose"),
    "one number": ([(0, 1.0)], TypeError, "expected a body (index or label) or (body, pose in the body)"),
    "gradient": ([(0, torch.ones(7, requires_grad=True))], ValueError, "a frame's pose requires grad; derivatives"),
    "a truth": ([torch.tensor(True)], TypeError, "a frame is tensor(True); expected a body (index or label)"),
}


@pytest.mark.parametrize("case", BAD_FRAMES)
@pytest.mark.parametrize("operation", ["jacobian", "operational_inertia_inverse"])
def test_bad_frames_are_refused_in_words(operation, case, device):
    frames, error, words = BAD_FRAMES[case]
    dyn = dynamics(device)
    with explained(error, f"Dynamics.{operation}", words):
        getattr(dyn, operation)(laws.states(dyn.scene, WORLDS)["q"], frames)


def test_a_label_of_two_bodies_names_none(device):
    bodies = [spo.Body(1.0, (0.1, 0, 0), np.eye(3), label="link") for _ in range(2)]
    hinges = [spo.Hinge("revolute", k - 1, k, axis=(0, 0, 1)) for k in range(2)]
    dyn = spo.Dynamics(spo.Scene(bodies, hinges), 1, device=device)
    with explained(ValueError, "Dynamics.jacobian", "2 bodies have the label 'link'", "index"):
        dyn.jacobian(np.zeros((1, 2)), ["link"])


# -- construction and prepare ------------------------------------------------------------------------------------------
BAD_ARGUMENTS: dict = {
    "granularity": [("leaf", ValueError), (1, ValueError), ([], ValueError)],
    "loops": [("open", ValueError), (None, ValueError), ([], ValueError)],
    "variable": [(("mass",), ValueError), ("mass", ValueError), ((3,), TypeError), (3, TypeError), (None, TypeError),
                 ([["gravity"]], TypeError), (np.array("gravity"), TypeError), (b"gravity", TypeError)],
    "dtype": [("float16", ValueError), (float, ValueError), (None, ValueError), (torch.float16, ValueError)],
    "worlds": [(0, ValueError), (-1, ValueError), (2.5, TypeError), ("3", TypeError), (True, TypeError),
               (torch.tensor(True), TypeError), (torch.tensor([3]), TypeError), (np.array(3.0), TypeError),
               (torch.zeros((), dtype=torch.int64, device="meta"), TypeError)],
    "refine": [(-1, ValueError), (True, ValueError), ("1", ValueError), (1.0, ValueError),
               (np.array(True), ValueError)],
    "device": [(name, ValueError) for name in ("gpu", [], "cuda:99", torch.device("meta"), 3)],
}


@pytest.mark.parametrize(("name", "value", "error"), [(n, *c) for n, cs in BAD_ARGUMENTS.items() for c in cs])
def test_bad_arguments_are_refused_in_words(name, value, error, device):
    arguments = {"worlds": WORLDS, "device": device} | {name: value}
    with explained(error, "Dynamics: ", name, "expected"):
        spo.Dynamics(scene(), **arguments)


def test_whole_numbers_and_names_of_any_kind(device):
    for worlds in (np.int8(WORLDS), np.array(WORLDS), torch.tensor(WORLDS)):
        assert type(spo.Dynamics(scene(), worlds, device=device).worlds) is int
    dyn = spo.Dynamics(scene(), WORLDS, device=device, dtype="float64", variable=np.array(["gravity"]))
    assert dyn.variable == ("gravity",) and type(dyn.variable[0]) is str
    dyn.prepare("solve_mass_matrix", columns=np.int64(2))
    a = laws.states(dyn.scene, WORLDS)
    found = dyn.inverse_dynamics_vjp(a["q"], a["qd"], a["qdd"], cotangent=a["qd"], wrt=np.array(["q", "tau"])[:1])
    assert [type(name) for name in found] == [str]


def test_set_takes_numbers_alone(device):
    dyn = spo.Dynamics(scene(), WORLDS, device=device, dtype="float64", variable=("body_mass",))
    mass = dyn.scene.values["body_mass"][0]
    q = laws.states(dyn.scene, WORLDS)["q"]
    light, heavy = dyn.gravity_force(q), None
    for value in ((2.0 * mass).tolist(), [torch.tensor(2.0 * m) for m in mass], [Fraction(2.0 * m) for m in mass]):
        dyn.set(body_mass=mass)
        np.testing.assert_array_equal(dyn.gravity_force(q), light)
        dyn.set(body_mass=value)
        heavy = dyn.gravity_force(q) if heavy is None else heavy
        np.testing.assert_array_equal(dyn.gravity_force(q), heavy)
    bad = None, "heavy", ["1"] * len(mass), [None] * len(mass), [1j] * len(mass), [10**400] * len(mass), [[1.0], 2.0]
    for value in (*bad, [torch.tensor(m, requires_grad=True) for m in mass], [torch.zeros((), device="meta")]):
        with explained(TypeError, "Dynamics.set: body_mass is", "expected an array of numbers"):
            dyn.set(body_mass=value)
    np.testing.assert_array_equal(dyn.gravity_force(q), heavy)


def test_an_unoffered_granularity_is_a_value_error_that_names_it(device):
    for name in ("segment", "tree"):
        try:
            dyn = spo.Dynamics(scene(), WORLDS, device=device, granularity=name, dtype="float64")
        except spo.UnsupportedError as error:
            assert name in error.what
        else:
            assert_right(dyn, "forward_dynamics", laws.call(dyn, "forward_dynamics", given("numpy", dyn)))


def test_flexible_bodies_and_rotors_are_refused_by_name():
    with pytest.raises(spo.UnsupportedError) as caught:
        spo.Body(1.0, (0, 0, 0), np.eye(3), modes=object())
    assert "modes" in caught.value.what and "rigid" in str(caught.value)
    with pytest.raises(spo.UnsupportedError) as caught:
        spo.Hinge("revolute", -1, 0, axis=(0, 0, 1), rotor=object())
    assert "rotor" in caught.value.what and "armature" in str(caught.value)


def test_worlds_of_a_scene_and_of_dynamics_must_agree(device):
    varied = zoo.varied(scene(), WORLDS)
    assert spo.Dynamics(varied, device=device).worlds == WORLDS
    for worlds in (1, WORLDS + 1):
        with explained(ValueError, "Dynamics: worlds is", f"expected {WORLDS}, for which the scene holds values"):
            spo.Dynamics(varied, worlds, device=device)


def test_scene_must_be_a_scene(device):
    for value in (None, "humanoid.xml", scene().tree):
        with explained(TypeError, "Dynamics: scene is of type", "expected a Scene"):
            spo.Dynamics(value, device=device)


def test_loop_joints_are_refused_or_cut(device):
    one = zoo.chain(2)
    loop = spo.Loop("revolute", -1, 1, axis=(0, 0, 1), label="closing")
    closed = spo.Scene(one.bodies, one.hinges, gravity=one.values["gravity"][0], loops=[loop])
    with explained(ValueError, "Dynamics: the scene has 1 loop joint(s): closing", "loops='cut'"):
        spo.Dynamics(closed, device=device)
    dyn, open_ = (spo.Dynamics(s, 1, device=device, loops="cut", dtype="float64") for s in (closed, one))
    q = zoo.random_state(one).q
    np.testing.assert_array_equal(dyn.forward_dynamics(q), open_.forward_dynamics(q))
    assert "1 loop joint(s), 0 coupling(s) left open" in dyn.explain()


def test_couplings_are_refused_or_cut(device):
    """A mimic that is dropped in silence would be a wrong answer: with a loop joint and without."""
    one = zoo.from_parents([-1, 0, 1], ["revolute"] * 3, 3)
    own = dict(gravity=one.values["gravity"][0], couplings=[spo.Coupling(2, 1, 0.5)])
    make = lambda **more: spo.Scene(one.bodies, one.hinges, **own, **more)  # noqa: E731
    follows = f"1 coupling(s): {one.joint_labels[2]} follows {one.joint_labels[1]}"
    with explained(ValueError, f"Dynamics: the scene has {follows}; expected a tree", "loops='cut'", "'embed'"):
        spo.Dynamics(make(), device=device)
    both = make(loops=[spo.Loop("ball", -1, 2, label="pin")])
    with explained(ValueError, f"the scene has 1 loop joint(s): pin and {follows}"):
        spo.Dynamics(both, device=device)
    dyn, open_ = (spo.Dynamics(s, 1, device=device, loops="cut", dtype="float64") for s in (make(), one))
    q = zoo.random_state(one).q
    np.testing.assert_array_equal(dyn.forward_dynamics(q), open_.forward_dynamics(q))
    assert "0 loop joint(s), 1 coupling(s) left open" in dyn.explain()


BAD_PREPARE = {
    "no operation": (dict(operation="acceleration"), "no operation 'acceleration'; expected one of forward_dynamics"),
    "not a name": (dict(operation=None), "no operation None; expected one of forward_dynamics"),
    "no option": (dict(operation="mass_matrix", frames=[0]), "mass_matrix has no option frames"),
    "body_f": (dict(operation="mass_matrix", body_f=True), "mass_matrix has no option body_f"),
    "status": (dict(operation="inverse_dynamics", status=True), "inverse_dynamics has no option status"),
    "columns": (dict(operation="solve_mass_matrix", columns="many"), "columns is 'many'"),
    "negative": (dict(operation="solve_mass_matrix", columns=-1), "columns is -1"),
    "true columns": (dict(operation="solve_mass_matrix", columns=True), "columns is True"),
    "a list": (dict(operation=["step"]), "no operation ['step']; expected one of forward_dynamics"),
    "along": (dict(operation="forward_dynamics_jvp", along=("dx",)), "along names 'dx'", "some of dq, dqd"),
}


@pytest.mark.parametrize("case", BAD_PREPARE)
def test_bad_prepare_is_refused_in_words(case, device):
    arguments, *words = BAD_PREPARE[case]
    with explained(ValueError, "Dynamics.prepare", *words):
        dynamics(device).prepare(**arguments)


# -- scenes are what they were when they were checked ------------------------------------------------------------------
def test_a_scene_does_not_follow_the_callers_arrays():
    com, inertia, gravity, pose = np.zeros(3), np.eye(3), np.array([0, 0, -9.0]), np.array([0, 0, 0, 0, 0, 0, 1.0])
    body = spo.Body(1.0, com, inertia)
    built = spo.Scene([body], [spo.Hinge("free", -1, 0, parent_pose=pose)], gravity=gravity)
    for array in (com, inertia, gravity, pose):
        array[...] = 7.0
    np.testing.assert_array_equal(body.com, np.zeros(3))
    np.testing.assert_array_equal(built.values["body_inertia"][0, 0], np.eye(3))
    np.testing.assert_array_equal(built.values["gravity"], [[0, 0, -9.0]])
    np.testing.assert_array_equal(built.values["joint_X_p"][0, 0], [0, 0, 0, 0, 0, 0, 1.0])


def test_a_checked_value_cannot_be_changed_in_place():
    for built in (scene(), scene().with_values(gravity=(0, 0, 1.0))):
        for name, array in built.values.items():
            with pytest.raises(ValueError, match="read-only"):
                array[...] = np.nan
            assert np.isfinite(array).all(), name
    for array in (scene().bodies[0].com, scene().bodies[0].inertia, scene().hinges[0].parent_pose):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = np.nan


BODY, FIXED = spo.Body(1.0, (0, 0, 0), np.eye(3)), spo.Hinge("fixed", -1, 0)
BAD_SCENES = {
    "not bodies": (lambda: spo.Scene(["box"], [FIXED]), TypeError, "Scene: bodies holds str; expected a list"),
    "one body": (lambda: spo.Scene(BODY, [FIXED]), TypeError, "Scene: bodies holds Body; expected a list of Body"),
    "nothing": (lambda: spo.Scene(None, None), TypeError, "Scene: bodies holds NoneType"),
    "not hinges": (lambda: spo.Scene([BODY], ["fixed"]), TypeError, "hinges holds str; expected a list of Hinge"),
    "a loop": (lambda: spo.Scene([BODY], [spo.Loop("fixed", -1, 0)]), TypeError, "Scene: hinges holds Loop"),
    "a pair": (lambda: spo.Scene([BODY], [FIXED], couplings=[(0, 0)]), TypeError, "Scene: couplings holds tuple"),
    "child 0.0": (lambda: spo.Scene([BODY], [spo.Hinge("fixed", -1, 0.0)]), TypeError, "body 0.0; expected integers"),
    "pitch": (lambda: spo.Hinge("helical", -1, 0, axis=(0, 0, 1), pitch=np.nan), ValueError, "pitch [m/rad] is nan"),
    "axis": (lambda: spo.Hinge("revolute", -1, 0, axis="z"), ValueError, "Hinge('revolute'): axis is 'z'; expected"),
    "kind": (lambda: spo.Hinge(["fixed"], -1, 0), ValueError, "unknown kind; expected one of fixed"),
    "armature": (lambda: spo.Hinge("ball", -1, 0, armature="much"), ValueError, "armature is 'much'; expected"),
    "complex": (lambda: scene().with_values(gravity=np.ones(3) * 1j), ValueError, "gravity is array([0.+1.j, "),
    "text": (lambda: spo.Body("1"), ValueError, "Body: mass [kg] is '1'; expected numbers"),
    "complex mass": (lambda: spo.Body(1 + 1j), ValueError, "Body: mass [kg] is (1+1j); expected numbers"),
    "ratio": (
        lambda: spo.Scene(scene().bodies, scene().hinges, couplings=[spo.Coupling(0, 1, np.nan)]),
        ValueError, "Scene: a coupling's ratio is nan; expected finite numbers",
    ),
    "coupling": (
        lambda: spo.Scene(scene().bodies, scene().hinges, couplings=[spo.Coupling(0.0, 1)]),
        TypeError, "Scene: a coupling names hinge 0.0; expected an integer",
    ),
    "huge": (lambda: spo.Body(10**400), ValueError, "Body: mass [kg] is 1000"),
    "nothing there": (lambda: scene().with_values(gravity=[0, None, 0]), ValueError, "gravity is [0, None, 0]"),
    "meta": (lambda: spo.Body(torch.ones((), device="meta")), ValueError, "Body: mass [kg] is tensor(..., device="),
    "gradients": (
        lambda: scene().with_values(gravity=[torch.ones((), requires_grad=True)] * 3),
        ValueError, "Scene.with_values: gravity is [tensor(1., requires_grad=True), ",
    ),
    "value": (lambda: scene().with_values(gravity="down"), ValueError, "Scene.with_values: gravity is 'down'"),
    "text in an object array": (
        lambda: scene().with_values(gravity=np.array(["0", "0", "1"], dtype=object)),
        ValueError, "Scene.with_values: gravity is array(['0', '0', '1']",
    ),
    "gradient": (
        lambda: scene().with_values(gravity=pytest.importorskip("torch").ones(3, requires_grad=True)),
        ValueError, "Scene.with_values: gravity is tensor([1., 1., 1.], requires_grad=True); expected numbers",
    ),
}


@pytest.mark.parametrize("case", BAD_SCENES)
def test_bad_scenes_are_refused_in_words(case):
    build, error, words = BAD_SCENES[case]
    with explained(error, words):
        build()


def test_tensors_are_numbers(recwarn):
    """Without NumPy's warning of arrays that cannot be asked not to copy."""
    body = spo.Body(torch.tensor(2.0), torch.tensor([1.0, 2.0, 3.0]), torch.eye(3))
    np.testing.assert_array_equal(body.com, [1.0, 2.0, 3.0])
    held = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    changed = scene().with_values(gravity=held)
    held.zero_()
    np.testing.assert_array_equal(changed.values["gravity"], [[0.0, 0.0, 1.0]])
    assert body.mass == 2.0 and not recwarn.list


def test_hinges_listed_child_first_and_forests(device):
    """Any numbering: the reference reads the same scene by its own walk."""
    for built in (zoo.from_parents([1, 2, -1], ["revolute", "ball", "free"], 5), zoo.forest()):
        dyn = spo.Dynamics(built, WORLDS, device=device, dtype="float64")
        for operation in OPERATIONS:
            laws.equals_reference(dyn, operation, laws.states(built, WORLDS), TOLERANCE["float64"])
