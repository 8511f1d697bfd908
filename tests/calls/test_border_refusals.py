"""Arrays that an operation of Dynamics refuses: each raises an error that names call, argument and remedy."""

import functools
from fractions import Fraction

import numpy as np
import pytest
import torch
import warp as wp
from torch.autograd import forward_ad

import warp_spo as spo
from support import laws
from support.border import POSE, SAME, WORLDS, assert_right, dynamics, explained, given, made, scene
from support.laws import OPERATIONS, TOLERANCE, numbers
from warp_spo.dynamics.dynamics import OPERATIONS as DECLARED

INPUTS = [
    (operation, x) for operation, (takes, _) in OPERATIONS.items() for x in ("q", *takes) if x not in ("frames", "dt")
]


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
        dtype = "" if kind == "numpy" else "float32 "  # NumPy arrays are cast: their dtype is not at fault
        for shape in ((WORLDS + 1, *good.shape[1:]), (1, *good.shape[1:]), (WORLDS, good.shape[1] + 1), one):
            way = f"stack {WORLDS} of them" if shape == one else f"reshape {name}"
            with explained(ValueError, call, f"{what} {dtype}{shape}", f"expected {dtype}(", "[world, ", way):
                run(kind, made(kind, np.zeros(shape), dyn))
    double = dynamics(device, "float64")
    for kind in ("torch", "warp"):
        with explained(ValueError, call, f"{name} is a", "float64", "expected float32", "convert", "dtype='float64'"):
            run(kind, given(kind, double)[name])
    with explained(ValueError, call, f"{name} is a NumPy array complex128", "expected float32", "convert"):
        run("numpy", good.astype(complex))
    with explained(
        ValueError, call, f"{name} is a torch array", "on meta", f"expected it on {device}", "torch.zeros_like("
    ):
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
    derivative = DECLARED[operation].derivative
    if derivative is not None and name in derivative.by:
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
        with explained(ValueError, call, "out is a", str((*shape[:-1], shape[-1] + 1)), "expected "):
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
    if DECLARED[operation].derivative is not None:
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
        dyn.bias_force(q, torch._efficientzerotensor((WORLDS, dyn.scene.dof_count), dtype=q.dtype, device=q.device))
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
    folded = numbers(dynamics(device).gravity_force(a["q"]))  # other code, which a GPU rounds in its own way
    assert laws.error(numbers(dyn.gravity_force(a["q"])), folded) <= TOLERANCE["float64"]


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


def test_a_masked_array_is_refused_wherever_an_array_goes(device):
    """Entries under the mask would be read as numbers."""
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
            dyn.step(a["q"], a["qd"], None, 1e-3, report=spo.StepReport(qdd=np.zeros(a["qd"].shape, dtype)))


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
