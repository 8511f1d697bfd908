"""torch goes back through Dynamics: gradients against finite differences."""

import functools
import warnings

import numpy as np
import pytest
import torch

import warp_spo as spo
from support import laws, symbolic, zoo
from support.gradients import (
    DT,
    INERTIAL,
    OPERATIONS,
    VARIABLE,
    WORLDS,
    called,
    check,
    furnished,
    on,
    options,
    restore_values,
    tree_and_state,
)
from warp_spo import torch as spo_torch
from warp_spo.hinges.ball import Ball
from warp_spo.hinges.free import Free
from warp_spo.recursions.derivatives import adjoints


@pytest.fixture(scope="module")
def tree(device):
    return tree_and_state(device)


@pytest.fixture(autouse=True)
def values_restored(tree):
    yield
    restore_values(tree[0])


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
    run = functools.partial(symbolic.run, scene)
    J = np.nan_to_num(run("inverse_dynamics_derivatives", a, state, {"out": (3, n, n)})["out"])[0]
    shapes = {"out": (n,), "qd_bar": (n,), "tau_bar": (n,)}
    got = run("forward_dynamics_vjp", a, (*state, "cotangent"), shapes, wrt=("tangent", "qd", "tau"))
    weights = np.linalg.solve(J[2], a["cotangent"][0])
    for result, wanted in zip(got.values(), (-J[0].T @ weights, -J[1].T @ weights, weights), strict=True):
        assert laws.error(result[0], wanted) <= 1e-11
    moved = run("forward_dynamics_jvp", {**a, **rates}, (*state, *rates), {"out": (n,)})["out"][0]
    q_dot, qd_dot, tau_dot = (rate[0] for rate in rates.values())
    assert laws.error(moved, np.linalg.solve(J[2], tau_dot - J[0] @ q_dot - J[1] @ qd_dot)) <= 1e-11


def squares(function, *args):
    results = function(*args)
    return sum((y * y).sum() for y in (results if isinstance(results, tuple) else (results,)))


@pytest.mark.parametrize("operation", ["forward_dynamics", "step", "integrate", "solve_mass_matrix", "jacobian"])
def test_under_compile(operation, device):
    """Plain, and as a custom op, in one graph: the same gradients, to the bit. The first call is traced, too."""
    torch._dynamo.reset()  # it counts the functions that this test has handed it
    dyn = spo.Dynamics(zoo.fork(), WORLDS, device=device, dtype="float64", granularity="tree")
    tensors = on(dyn, laws.states(dyn.scene, WORLDS), *OPERATIONS[operation][:3])
    plain, op = functools.partial(called, dyn, operation), spo_torch.custom_op(dyn, operation, **options(operation))
    for function, backend in ((plain, "aot_eager"), (plain, "eager"), (op, "aot_eager")):
        compiled = torch.compile(functools.partial(squares, function), backend=backend, fullgraph=True)
        with warnings.catch_warnings():
            warnings.filterwarnings("error", ".*(warp_spo|lru_cache|Dynamo)")
            found = torch.autograd.grad(compiled(*tensors), tensors)
        wanted = torch.autograd.grad(squares(plain, *tensors), tensors)
        for got, right in zip(found, wanted, strict=True):
            assert torch.equal(got, right)


def test_none_for_tau_in_a_custom_op(device):
    """By position and by name, as in the method: the same results and gradients, to the bit."""
    dyn = spo.Dynamics(zoo.fork(), WORLDS, device=device, dtype="float64", granularity="tree")
    q, qd = on(dyn, laws.states(dyn.scene, WORLDS), "q", "qd")
    op = spo_torch.custom_op(dyn, "step", dt=DT)
    wanted = torch.autograd.grad(squares(dyn.step, q, qd, None, DT), (q, qd))
    for call in (lambda q, qd: op(q, qd, None), lambda q, qd: op(q, qd=qd, tau=None)):
        found = torch.autograd.grad(squares(call, q, qd), (q, qd))
        assert all(torch.equal(one, other) for one, other in zip(found, wanted, strict=True))


def test_what_a_graph_fills(device):
    """Arrays that a call writes, and options: numbers that vary, lists, and words."""
    torch._dynamo.reset()
    dyn = spo.Dynamics(zoo.fork(), WORLDS, device=device, dtype="float64", granularity="tree")
    q, qd, tau = on(dyn, laws.states(dyn.scene, WORLDS), "q", "qd", "tau", grad=False)

    def run(dt):
        status, qdd, out = torch.full((WORLDS,), -1, dtype=torch.int32, device=q.device), qd * 0.0, qd * 0.0
        dyn.forward_dynamics(q, qd, status=status, out=out)
        ahead = dyn.step(q, qd, tau, dt=dt, report=spo.StepReport(qdd=qdd), status=status, out=(None, out))
        frames = dyn.frame_poses(q, [(1, (0.1, 0.0, 0.2, 0.0, 0.0, 0.0, 1.0)), 0])
        return (
            *ahead,
            *dyn.step(q, qd, None, dt, options=spo.StepOptions(integrator="midpoint")),
            status,
            qdd,
            out,
            frames,
        )

    compiled = torch.compile(run, backend="aot_eager", fullgraph=True)
    for dt in (0.01, 0.02, 0.03):
        for got, wanted in zip(compiled(dt), run(dt), strict=True):
            assert torch.equal(got, wanted)
    with pytest.raises(Exception, match=r"Dynamics.mass_matrix_inverse: q requires grad; derivatives are not"):
        torch.compile(dyn.mass_matrix_inverse, backend="aot_eager")(q.clone().requires_grad_())
    with pytest.raises(Exception, match=r"q is a torch array float64 \(1, 12\)"):
        torch.compile(dyn.mass_matrix, backend="eager")(q[:1])


BUGS = {
    "the slope of the forces": (adjoints, "step_vjp", "h * total(law.piece", "0.0 * total(law.piece"),
    "what the new velocity moves": (
        adjoints,
        "step_vjp",
        "dict(zip(dofs, back, strict=False))",
        "{dof: pushed[1](dof) for dof in dofs}",
    ),
    "the sign of lambda": (adjoints, "forward_dynamics_vjp", "lambda dof: -solved(dof)", "lambda dof: solved(dof)"),
    "the turn of a quaternion": (Ball, "to_tangent", "cross(u, g_u)", "cross(g_u, u)"),
    "the arm of a free hinge": (Free, "to_tangent", "turn - cross(", "turn + cross("),
}


@pytest.mark.parametrize("bug", BUGS)
def test_a_planted_bug_is_seen(bug, monkeypatch):
    """By the derivative along one direction."""
    owner, name, old, new = BUGS[bug]
    symbolic.plant(monkeypatch, owner, name, old, new)
    if name == "step_vjp":
        scene = furnished(zoo.from_parents([-1, 0], ["revolute", "ball"], 8))
        dyn = spo.Dynamics(scene, 1, device="cpu", dtype="float64", granularity="tree")
        q, qd = on(dyn, laws.states(scene, 1), "q", "qd")
        with pytest.raises(Exception, match="Jacobian mismatch"):
            check(lambda qd: dyn.step(q.detach(), qd, None, DT), [qd])
    else:
        with pytest.raises(AssertionError):
            test_products_are_those_of_the_dense_derivatives("chain_free")
