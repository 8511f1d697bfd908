"""torch goes back through Dynamics: gradients against finite differences, and what is refused, in words."""

import functools
import sys
from pathlib import Path

import laws
import numpy as np
import pytest
import symbolic
import torch
import warp as wp
import zoo
from torch.autograd import forward_ad, gradcheck

import warp_spo as spo
from warp_spo import torch as spo_torch
from warp_spo.execution.plan import MOST_DOFS
from warp_spo.execution.staging import read_before
from warp_spo.recursions.derivatives.adjoints import Adjoints

sys.path.append(str(Path(__file__).parent.parent))  # benchmarks/ is not installed; behind an installed warp_spo

WORLDS = 2
DT = 0.01
INERTIAL = ("body_mass", "body_com", "body_inertia", "joint_armature", "gravity", "joint_X_p", "joint_X_c")
GAINS = ("joint_damping", "joint_stiffness", "joint_friction", "joint_target_ke", "joint_target_kd")
VARIABLE = INERTIAL + GAINS
check = functools.partial(gradcheck, atol=1e-5, rtol=1e-4)  # of torch: central differences with a step of 1e-6


def furnished(scene):
    """Drives, and friction that is nowhere zero, where its force has a kink."""
    n = scene.dof_count
    return scene.with_values(joint_friction=np.linspace(0.2, 1.0, n), joint_target_ke=np.linspace(2.0, 30.0, n),
                             joint_target_kd=np.linspace(2.0, 3.0, n))  # fmt: skip


def on(dyn, arrays, *names, grad=True):
    kind = torch.float64 if dyn.dtype is wp.float64 else torch.float32
    place = wp.device_to_torch(dyn.device)
    return [torch.tensor(arrays[n], dtype=kind, device=place, requires_grad=grad) for n in names]


@pytest.fixture(scope="module")
def tree(device):
    """A floating tree with every value variable, and its state."""
    scene = furnished(zoo.fork())
    a = laws.states(scene, WORLDS)
    a |= {"target_q": a["q"][::-1].copy(), "target_qd": a["qdd"]}
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype="float64", variable=VARIABLE, granularity="tree")
    return dyn, a


@pytest.fixture(autouse=True)
def forgotten(tree):
    yield
    dyn = tree[0]
    dyn.set(**{name: dyn.scene.values[name][0] for name in VARIABLE})


OPERATIONS = {
    "forward_dynamics": ("q", "qd", "tau", "body_f"),
    "inverse_dynamics": ("q", "qd", "qdd", "body_f"),
    "bias_force": ("q", "qd"),
    "gravity_force": ("q",),
    "solve_mass_matrix": ("q", "b"),
    "mass_matrix": ("q",),
    "jacobian": ("q",),
    "body_velocities": ("q", "qd"),
    "integrate": ("q", "qd"),
    "step": ("q", "qd", "tau", "body_f", "target_q", "target_qd"),
}


def called(dyn, operation, *args):
    if operation == "step":
        q, qd, tau, *more = args
        return dyn.step(q, qd, tau, DT, *more)
    return getattr(dyn, operation)(*args, **options(operation))


def options(operation):
    some = {"dt": DT} if operation in ("step", "integrate") else {}
    return some | ({"frames": [0, (2, (0.3, -0.2, 0.1, 0, 0, 0, 1))]} if operation == "jacobian" else {})


# -- gradients ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("operation", OPERATIONS)
def test_gradients_by_arguments(tree, operation):
    dyn, a = tree
    assert check(functools.partial(called, dyn, operation), on(dyn, a, *OPERATIONS[operation]))


@pytest.mark.parametrize(
    "operation", ["forward_dynamics", "inverse_dynamics", "step", "body_velocities", "mass_matrix", "jacobian"]
)
def test_gradients_by_values(tree, operation):
    """Of tensors that all worlds share, and of one that differs from world to world."""
    dyn, a = tree
    names = VARIABLE if operation == "step" else INERTIAL
    start = {name: dyn.scene.values[name][0] for name in names}
    start["body_mass"] = np.linspace(0.8, 1.2, WORLDS)[:, None] * start["body_mass"]
    arguments = on(dyn, a, *OPERATIONS[operation], grad=False)

    def run(*values):
        dyn.set(**dict(zip(names, values, strict=True)))
        return called(dyn, operation, *arguments)

    assert check(run, on(dyn, start, *names))


def test_gradient_of_poses(device):
    scene = zoo.fork()
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype="float64", granularity="tree", variable=("body_com",))
    a = laws.states(scene, WORLDS)
    assert check(dyn.body_poses, on(dyn, a, "q"))


@pytest.mark.parametrize("name", ["forest", "chain_free", "chain_helical", "every_d6"])
def test_products_are_those_of_the_dense_derivatives(name):
    """J* y and J x of the traces against the dense J of another trace, along tangent coordinates."""
    scene = zoo.SCENES[name]()
    n, a = scene.dof_count, laws.states(scene, 1)
    a["cotangent"] = np.random.default_rng(1).normal(size=(1, n))
    rates = {"q_dot": a["b"][..., 0], "qd_dot": a["b"][..., 1], "tau_dot": a["b"][..., 2]}
    state = ("q", "qd", "qdd", "body_f")
    run = functools.partial(symbolic.run, scene, trace=Adjoints)
    J = np.nan_to_num(run("inverse_dynamics_derivatives", a, state, {"out": (3, n, n)})["out"])[0]
    shapes = {"out": (n,), "qd_bar": (n,), "tau_bar": (n,)}
    got = run("forward_dynamics_vjp", a, (*state, "cotangent"), shapes, wrt=("tangent", "qd", "tau"))
    weights = np.linalg.solve(J[2], a["cotangent"][0])
    for result, wanted in zip(got.values(), (-J[0].T @ weights, -J[1].T @ weights, weights), strict=True):
        assert laws.error(result[0], wanted) <= 1e-11
    moved = run("forward_dynamics_jvp", {**a, **rates}, (*state, *rates), {"out": (n,)})["out"][0]
    q_dot, qd_dot, tau_dot = (rate[0] for rate in rates.values())
    assert laws.error(moved, np.linalg.solve(J[2], tau_dot - J[0] @ q_dot - J[1] @ qd_dot)) <= 1e-11


# -- rollouts ----------------------------------------------------------------------------------------------------------
TOLERANCE = {("float64", 50): 1e-6, ("float64", 500): 1e-6, ("float32", 50): 1e-3, ("float32", 500): 1e-2}
"""Of each gradient, 2-norm, against float64: differences of the loss along it where that is float64 itself."""
ROLLED = ("body_mass", "joint_armature", "joint_damping", "joint_target_ke", "joint_target_kd")
H = 2e-3
LEGS = [-1] + [over for leg in range(4) for over in (0, 3 * leg + 1, 3 * leg + 2)]


def damped_arm():
    n = np.arange(3.0)
    return zoo.from_parents([-1, 0, 1], ["revolute"] * 3, 8).with_values(
        joint_damping=0.5 - 0.15 * n, joint_target_ke=3.0 - n, joint_target_kd=0.1 + 0.1 * n
    )


def floating_quadruped():
    """A free body with four legs of three hinges, whose drives hold them; nothing touches the ground."""
    legs = np.concatenate([np.zeros(6), np.tile([1.0, 0.8, 0.6], 4)])
    return zoo.from_parents(LEGS, ["free"] + ["revolute"] * 12, 8).with_values(
        joint_damping=0.3 * legs, joint_target_ke=20.0 * legs, joint_target_kd=0.5 * legs
    )


ROBOTS = [damped_arm, floating_quadruped]


@functools.cache
def rolling(robot, device, dtype):
    return spo.Dynamics(robot(), 1, device=device, dtype=dtype, variable=ROLLED, granularity="tree")


def loss(dyn, steps, q, qd, control, *values):
    dyn.set(**dict(zip(ROLLED, values, strict=True)))
    total = 0.0
    for k in range(steps):
        q, qd = dyn.step(q, qd, control[k * len(control) // steps], H)
        total = total + (q * q).sum() * (1.0 / steps)
    return total + (qd * qd).sum()


def start(dyn):
    """The state, torques for a tenth of the way each, and the values: all that a rollout depends on."""
    rng, dofs = np.random.default_rng(5), dyn.scene.dof_count
    values = {name: dyn.scene.values[name][0] for name in ROLLED}
    values |= {"q": zoo.random_state(dyn.scene).q, "qd": rng.normal(size=(1, dofs))}
    values["control"] = rng.normal(size=(10, 1, dofs))
    return {name: values[name] for name in ("q", "qd", "control", *ROLLED)}


@functools.cache
def gradients(robot, device, dtype, steps):
    dyn = rolling(robot, device, dtype)
    tensors = on(dyn, start(dyn), *start(dyn))
    return [g.cpu().double() for g in torch.autograd.grad(loss(dyn, steps, *tensors), tensors)]


@pytest.mark.parametrize("steps", [50, 500])
@pytest.mark.parametrize("robot", ROBOTS)
def test_gradient_of_a_rollout_is_the_difference(robot, device, steps):
    """Along each gradient and a random direction at once, by four points: what is left is rounding."""
    dyn = rolling(robot, device.alias, "float64")
    points = on(dyn, start(dyn), *start(dyn), grad=False)
    found = gradients(robot, device.alias, "float64", steps)
    h, rng = 1e-4, np.random.default_rng(7)
    for i, (name, gradient) in enumerate(zip(start(dyn), found, strict=True)):
        chance = torch.as_tensor(rng.normal(size=tuple(gradient.shape)))
        along = (gradient / gradient.norm() + chance / chance.norm()).to(points[i])
        moved = lambda x, i=i, along=along: loss(dyn, steps, *points[:i], points[i] + x * along, *points[i + 1 :])  # noqa: E731
        ends = [moved(x * h).item() for x in (2, 1, -1, -2)]
        slope = (8.0 * (ends[1] - ends[2]) - (ends[0] - ends[3])) / (12 * h)
        wanted = (gradient.to(along) * along).sum().item()
        assert abs(slope - wanted) <= TOLERANCE["float64", steps] * abs(slope), name


@pytest.mark.parametrize("steps", [50, 500])
@pytest.mark.parametrize("robot", ROBOTS)
def test_gradient_of_a_rollout_in_float32(robot, device, steps):
    single, double = (gradients(robot, device.alias, dtype, steps) for dtype in ("float32", "float64"))
    for name, got, wanted in zip(start(rolling(robot, device.alias, "float64")), single, double, strict=True):
        assert (got - wanted).norm() <= TOLERANCE["float32", steps] * wanted.norm(), name


@pytest.mark.slow
def test_featherstone_beside_it():
    """20 steps of 10 ms, each solver against differences of its own loss: Newton's tape reads what was written over."""
    from benchmarks import gradients as beside

    found = {name: row[0].max() for name, row in beside.table(0.01, (20,)).items()}
    assert found["warp_spo, float64"] <= 1e-8 and found["warp_spo, float32"] <= 1e-3
    assert found["a SolverFeatherstone for each step"] <= 1e-3
    assert found["SolverFeatherstone"] > 0.1, "0.24 in Newton 1.8; mended? then say so in the benchmark"


def test_masses_are_found_again(device):
    """System identification with the module."""
    dyn = rolling(damped_arm, device.alias, "float64")
    q, qd, tau = (torch.tensor(np.random.default_rng(6).normal(size=(1, 3)), device=wp.device_to_torch(device))
                  for _ in range(3))  # fmt: skip
    robot = spo_torch.Module(dyn, ["body_mass"])
    assert [name for name, _ in robot.named_parameters()] == ["body_mass"]
    with torch.no_grad():
        wanted = robot(q, qd, tau)
        robot.body_mass *= 1.2
    optimizer = torch.optim.Adam(robot.parameters(), lr=0.02)
    errors = []
    for _ in range(60):
        optimizer.zero_grad()
        error = (robot.forward_dynamics(q, qd, tau) - wanted).square().mean()
        error.backward()
        optimizer.step()
        errors.append(error.item())
    assert errors[-1] < 1e-2 * errors[0]


@pytest.mark.parametrize("operation", ["forward_dynamics", "step", "integrate", "solve_mass_matrix", "jacobian"])
def test_under_compile(operation, device):
    """As a custom op in one graph: the same gradients, to the bit."""
    torch._dynamo.reset()  # it counts the ops that this test has handed it
    scene = zoo.fork()
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype="float64", granularity="tree")
    op = spo_torch.custom_op(dyn, operation, **options(operation))
    tensors = on(dyn, laws.states(scene, WORLDS), *OPERATIONS[operation][:3])

    def squares(function, *args):
        results = function(*args)
        return sum((y * y).sum() for y in (results if isinstance(results, tuple) else (results,)))

    wanted = torch.autograd.grad(squares(functools.partial(called, dyn, operation), *tensors), tensors)
    for backend in ("eager", "aot_eager"):
        compiled = torch.compile(functools.partial(squares, op), backend=backend, fullgraph=True)
        for got, right in zip(torch.autograd.grad(compiled(*tensors), tensors), wanted, strict=True):
            assert torch.equal(got, right)


# -- what is refused ---------------------------------------------------------------------------------------------------
def test_prepared_ahead_nothing_is_compiled(device, monkeypatch):
    """What prepare makes is what products, and torch on its way back, look for."""
    scene = zoo.from_parents([-1, 0, 1], ["ball", "revolute", "revolute"], 3)
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype="float64", granularity="tree", variable=("body_mass",))
    for operation, arguments in OPERATIONS.items():
        loaded = {"body_f": True} if operation in ("forward_dynamics", "inverse_dynamics", "step") else {}
        driven = {"target_q": True, "target_qd": True} if operation == "step" else {}
        frames = {"frames": options(operation)["frames"]} if operation == "jacobian" else {}
        dyn.prepare(operation, **loaded, **driven, **frames, **({"qdd": True} if operation == "step" else {}))
        mass = () if operation in ("integrate", "jacobian", "body_velocities") else ("body_mass",)
        dyn.prepare(f"{operation}_vjp", wrt=(*arguments, *mass), **frames)
    for product in ("forward_dynamics", "inverse_dynamics"):
        dyn.prepare(f"{product}_jvp", along=("dq", "dqd"))
    with pytest.raises(ValueError, match="step_vjp has no option colour"):
        dyn.prepare("step_vjp", colour=True)
    with pytest.raises(ValueError, match=r"Dynamics.step, backwards: wrt names 'joint_armature', which is folded"):
        dyn.prepare("step_vjp", wrt=("q", "joint_armature"))
    monkeypatch.setattr(dyn.programs, "_build", lambda *_: pytest.fail("compiled after all"))
    a = laws.states(scene, WORLDS)
    a |= {"target_q": a["q"][::-1].copy(), "target_qd": a["qdd"], "mass": scene.values["body_mass"][0]}
    (mass,) = on(dyn, a, "mass")
    dyn.set(body_mass=mass)
    for operation, arguments in OPERATIONS.items():
        found = called(dyn, operation, *on(dyn, a, *arguments))
        sum(y.square().sum() for y in (found if isinstance(found, tuple) else (found,))).backward()
    assert mass.grad.isfinite().all()
    with torch.no_grad():
        state = on(dyn, a, "q", "qd", "tau", grad=False)
        for product in ("forward_dynamics", "inverse_dynamics"):
            getattr(dyn, f"{product}_jvp")(*state, dq=state[2], dqd=state[2])


def test_a_second_backward_pass_is_explained(tree):
    dyn, a = tree
    q, qd = on(dyn, a, "q", "qd")
    (first,) = torch.autograd.grad(dyn.forward_dynamics(q, qd).sum(), q, create_graph=True)
    with pytest.raises(RuntimeError, match=r"Dynamics.forward_dynamics: its gradient is differentiated once more"):
        first.sum().backward()


def test_out_is_refused(tree):
    dyn, a = tree
    (q,) = on(dyn, a, "q")
    out = torch.zeros(WORLDS, dyn.scene.dof_count, dtype=q.dtype, device=q.device)
    with pytest.raises(ValueError, match=r"Dynamics.gravity_force: out is given and an input requires grad"):
        dyn.gravity_force(q, out=out)
    with pytest.raises(ValueError, match="out requires grad"):
        dyn.gravity_force(q.detach(), out=out.clone().requires_grad_())
    with torch.no_grad():
        assert dyn.gravity_force(q, out=out) is out


def test_kinds_do_not_mix(tree):
    dyn, a = tree
    (q,) = on(dyn, a, "q")
    with pytest.raises(TypeError, match=r"q requires grad and qd is of type ndarray; expected torch tensors only"):
        dyn.forward_dynamics(q, a["qd"])


def test_a_change_in_place_is_seen(tree):
    dyn, a = tree
    (q,) = on(dyn, a, "q", grad=False)
    qd = on(dyn, a, "qd")[0]
    y = dyn.forward_dynamics(q, qd).sum()
    q += 1.0
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        y.backward()


def test_values_set_since(tree):
    """What was on record is put back for the backward pass, and back again; anything else is an error."""
    dyn, a = tree
    q, qd, tau = on(dyn, a, "q", "qd", "tau", grad=False)
    (mass,) = on(dyn, {"m": dyn.scene.values["body_mass"][0]}, "m")
    dyn.set(body_mass=mass)
    y = dyn.forward_dynamics(q, qd, tau).square().sum()
    (wanted,) = torch.autograd.grad(y, mass, retain_graph=True)
    dyn.set(body_mass=2.0 * mass.detach())
    with torch.no_grad():
        heavy = dyn.forward_dynamics(q, qd, tau)
    (got,) = torch.autograd.grad(y, mass, retain_graph=True)
    assert torch.equal(got, wanted)
    assert torch.equal(dyn.forward_dynamics(q, qd, tau), heavy)
    dyn.set(gravity=(0.0, 0.0, -1.0))
    with pytest.raises(RuntimeError, match=r"gravity was set between this call and its backward pass"):
        y.backward()


def test_scenes_without_gradients_say_so_at_once(device):
    chain = spo.Dynamics(zoo.chain(MOST_DOFS + 1), 1, device=device)
    q = torch.zeros(1, MOST_DOFS + 1, requires_grad=True, device=wp.device_to_torch(device))
    with pytest.raises(spo.UnsupportedError, match="gravity_force, backwards: a scene of"):
        chain.gravity_force(q)
    scene = zoo.fork()
    moving = spo.Dynamics(scene, WORLDS, device=device, dtype="float64", variable=("joint_X_p",))
    with pytest.raises(spo.UnsupportedError, match="the gradient of poses where anchors vary"):
        moving.body_poses(*on(moving, laws.states(scene, WORLDS), "q"))


def test_a_result_is_not_written_over_what_is_read_later():
    """In shared memory on CUDA: lambda is known before the other arguments are read."""
    scene = zoo.fork()
    rate = (1, scene.dof_count)
    dyn = spo.Dynamics(scene, 1, device="cpu", granularity="tree")
    shapes = {"q": (1, scene.coord_count), "qd": rate, "qdd": rate, "cotangent": rate, "out": rate}
    trace = Adjoints(dyn.programs.links.opened(), "float32", tuple(shapes))
    stores = trace.forward_dynamics_vjp(("tau", "q"))
    first = [item for item in stores if item.array == "out"]
    free = {name: read_before(first, stores, name) for name in ("cotangent", "qd", "qdd")}
    del first, stores  # which pytest would write out
    assert free == {"cotangent": True, "qd": False, "qdd": False}


def test_what_has_no_gradient_says_so(tree):
    dyn, a = tree
    q, qd = on(dyn, a, "q", "qd", grad=False)
    dyn.set(body_mass=on(dyn, {"m": dyn.scene.values["body_mass"][0]}, "m")[0])
    with pytest.raises(ValueError, match=r"Dynamics.mass_matrix_inverse: body_mass was set to a tensor that"):
        dyn.mass_matrix_inverse(q)
    with pytest.raises(ValueError, match=r"expected integrator='semi_implicit'"):
        dyn.step(q, qd, None, DT, integrator="rk4")
    assert not dyn.integrate(q, qd, DT).requires_grad or "body_mass" in dyn.entering("integrate")
    with pytest.raises(ValueError, match=r"'joint_limit_lower' has no gradient"):
        spo_torch.Module(dyn, ["joint_limit_lower"])
    folded = spo.Dynamics(dyn.scene, WORLDS, device=dyn.device, dtype="float64", granularity="tree")
    with pytest.raises(ValueError, match=r"wrt names 'body_mass', which is folded"):
        folded.forward_dynamics_vjp(q, qd, cotangent=qd, wrt=("body_mass",))
    with pytest.raises(ValueError, match=r"wrt names 'qd', which is None; pass zeros"):
        folded.forward_dynamics_vjp(q, cotangent=qd)
    with pytest.raises(ValueError, match=r"wrt names 'colour'; expected some of q, tangent, qd, tau, body_f"):
        folded.forward_dynamics_vjp(q, qd, cotangent=qd, wrt="colour")


BAD_OPS = {
    "no Dynamics": (lambda dyn: spo_torch.custom_op(3, "step"), "custom_op: dyn is of type int; expected a Dynamics"),
    "no option": (lambda dyn: spo_torch.custom_op(dyn, "step", dt=DT, colour=3), "colour=3 is no option; expected dt="),
    "filled": (lambda dyn: spo_torch.custom_op(dyn, "step", dt=DT, status=0), "status=0 is no option"),
    "integrator": (lambda dyn: spo_torch.custom_op(dyn, "step", dt=DT, integrator="rk4"), "'rk4' is no option"),
    "no dt": (lambda dyn: spo_torch.custom_op(dyn, "step"), "dt is missing; expected dt="),
    "no frames": (lambda dyn: spo_torch.custom_op(dyn, "jacobian"), "frames is missing; expected frames="),
    "too many": (lambda dyn: spo_torch.custom_op(dyn, "gravity_force")(None, None), "2 tensors .*; expected q, each"),
    "twice": (lambda dyn: spo_torch.custom_op(dyn, "gravity_force")(None, q=None), "1 tensors .* q by name; expect"),
    "no tensor": (lambda dyn: spo_torch.custom_op(dyn, "gravity_force")(np.ones(3)), "q is of type ndarray; expected"),
    "no module": (lambda dyn: spo_torch.Module(3), "Module: dyn is of type int; expected a Dynamics"),
    "no names": (lambda dyn: spo_torch.Module(dyn, 3), "Module: names is 3; expected names, such as"),
}


@pytest.mark.parametrize("case", BAD_OPS)
def test_bad_ops_and_modules_are_refused_in_words(tree, case):
    make, words = BAD_OPS[case]
    with pytest.raises(TypeError, match=words):
        make(tree[0])
    assert len(list(spo_torch.Module(tree[0], "body_mass").parameters())) == 1


@pytest.mark.filterwarnings("ignore:.*torch.jit.script")  # of torch itself, in forward mode
def test_transforms_of_torch_are_refused_by_custom_ops_too(tree):
    """Forward mode would give zeros: what torch makes of an op has no tangent."""
    dyn, a = tree
    op = spo_torch.custom_op(dyn, "gravity_force")
    (q,) = on(dyn, a, "q", grad=False)
    for call in (lambda: torch.func.jvp(op, (q,), (q,)), lambda: torch.func.grad(lambda x: op(x).sum())(q),
                 lambda: torch.func.vmap(op)(torch.stack([q, q]))):  # fmt: skip
        with pytest.raises(ValueError, match=r"custom_op\('gravity_force'\): q is wrapped by a transform of torch"):
            call()
    with forward_ad.dual_level(), pytest.raises(ValueError, match="q has a forward-mode tangent"):
        op(forward_ad.make_dual(q, q))


# -- planted bugs ------------------------------------------------------------------------------------------------------
BUGS = {
    "the slope of the forces": ("step_vjp", "h * total(law.piece", "0.0 * total(law.piece"),
    "what the new velocity moves": (
        "step_vjp",
        "dict(zip(dofs, back, strict=False))",
        "{dof: pushed[1](dof) for dof in dofs}",
    ),
    "the sign of lambda": ("forward_dynamics_vjp", "lambda dof: -solved(dof)", "lambda dof: solved(dof)"),
    "the turn of a quaternion": ("tangent", "cross(u, g_u)", "cross(g_u, u)"),
    "the arm of a free hinge": ("tangent", "turn - cross(", "turn + cross("),
}


@pytest.mark.parametrize("bug", BUGS)
def test_a_planted_bug_is_seen(bug, monkeypatch):
    """By the derivative along one direction."""
    name, old, new = BUGS[bug]
    symbolic.plant(monkeypatch, Adjoints, name, old, new)
    if name == "step_vjp":
        scene = furnished(zoo.from_parents([-1, 0], ["revolute", "ball"], 8))
        dyn = spo.Dynamics(scene, 1, device="cpu", dtype="float64", granularity="tree")
        q, qd = on(dyn, laws.states(scene, 1), "q", "qd")
        with pytest.raises(Exception, match="Jacobian mismatch"):
            check(lambda qd: dyn.step(q.detach(), qd, None, DT), [qd])
    else:
        with pytest.raises(AssertionError):
            test_products_are_those_of_the_dense_derivatives("chain_free")
