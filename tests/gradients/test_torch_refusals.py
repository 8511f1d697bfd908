"""Calls that torch cannot differentiate, or not twice, raise an error that explains; nothing compiles late."""

import re

import numpy as np
import pytest
import torch
import warp as wp
from torch.autograd import forward_ad

import warp_spo as spo
from support import laws, zoo
from support.gradients import DT, OPERATIONS, WORLDS, called, on, options, restore_values, tree_and_state
from warp_spo import torch as spo_torch
from warp_spo.dynamics.stepping.step import INTEGRATE
from warp_spo.execution.plan import MOST_DOFS
from warp_spo.execution.staging import is_read_before_written
from warp_spo.recursions.derivatives.adjoints import forward_dynamics_vjp
from warp_spo.recursions.model.tracing import Trace


@pytest.fixture(scope="module")
def tree(device):
    return tree_and_state(device)


@pytest.fixture(autouse=True)
def values_restored(tree):
    yield
    restore_values(tree[0])


@pytest.mark.slow
def test_prepared_ahead_nothing_is_compiled(device, monkeypatch):
    """``prepare`` compiles every kernel that products and torch's backward pass use."""
    scene = zoo.from_parents([-1, 0, 1], ["ball", "revolute", "revolute"], 3)
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype="float64", granularity="tree", variable=("body_mass",))
    for operation, arguments in OPERATIONS.items():
        loaded = {"body_f": True} if operation in ("forward_dynamics", "inverse_dynamics", "step") else {}
        driven = {"target_q": True, "target_qd": True} if operation == "step" else {}
        frames = {"frames": options(operation)["frames"]} if operation == "jacobian" else {}
        dyn.prepare(operation, **loaded, **driven, **frames, **({"report": ("qdd",)} if operation == "step" else {}))
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


def test_data_that_was_replaced_is_seen(tree):
    """torch does not count it. Numbers that are changed in place through ``.data`` nobody can see."""
    dyn, a = tree
    (q,) = on(dyn, a, "q")
    y = dyn.gravity_force(q).sum()
    q.data = q.data + 1.0
    with pytest.raises(RuntimeError, match=r"Dynamics.gravity_force: q.data was replaced between this call and its"):
        y.backward()
    with torch.autograd.graph.saved_tensors_hooks(lambda x: x.clone(), lambda x: x):  # memory of its own
        y = dyn.gravity_force(q).sum()
    q.data = q.data + 1.0
    y.backward()


def test_values_set_since(tree):
    """Values that were recorded are restored for the backward pass, and set back after it; other changes raise."""
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
    trace = Trace(dyn.programs.links.with_tables(), "float32", tuple(shapes))
    stores = forward_dynamics_vjp(trace, ("tau", "q"))
    first = [item for item in stores if item.array == "out"]
    free = {name: is_read_before_written(first, stores, name) for name in ("cotangent", "qd", "qdd")}
    del first, stores  # which pytest would write out
    assert free == {"cotangent": True, "qd": False, "qdd": False}


def test_what_has_no_gradient_says_so(tree):
    dyn, a = tree
    q, qd = on(dyn, a, "q", "qd", grad=False)
    dyn.set(body_mass=on(dyn, {"m": dyn.scene.values["body_mass"][0]}, "m")[0])
    with pytest.raises(ValueError, match=r"Dynamics.mass_matrix_inverse: body_mass was set to a tensor that"):
        dyn.mass_matrix_inverse(q)
    with pytest.raises(ValueError, match=r"expected integrator='semi_implicit'"):
        dyn.step(q, qd, None, DT, options=spo.StepOptions(integrator="rk4"))
    assert not dyn.integrate(q, qd, DT).requires_grad or "body_mass" in INTEGRATE.derivative.values
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
    "integrator": (
        lambda dyn: spo_torch.custom_op(dyn, "step", dt=DT, options=spo.StepOptions(integrator="rk4")),
        "'rk4' is no option",
    ),
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


def test_a_gradient_that_no_call_gives_is_refused_by_variable(device):
    """Where a tensor becomes a constant of a scene or of kernels an error names variable=; before, ranges lost it."""
    scene = zoo.from_parents([-1], ["revolute"], 3)
    dyn = spo.Dynamics(scene, 1, device=device, dtype="float64")
    one = torch.ones(1, dtype=torch.float64, device=str(dyn.device), requires_grad=True)
    wide = torch.stack([-one[0], one[0]])
    named = {
        "joint_stiffness": [lambda: dyn.set(joint_stiffness=one), lambda: scene.with_values(joint_stiffness=one)],
        "...": [lambda: spo.Body(one[0]), lambda: spo.Actuator(0, force_range=wide),
                lambda: spo.Actuator(0, ctrl_range=(0.0, one[0])), lambda: spo.Actuator(0, torque_speed=wide.abs())],
        "ground_heights": [lambda: spo.HeightField(one * torch.ones_like(one)[:, None].expand(2, 2), 1.0)],
    }  # fmt: skip
    for name, calls in named.items():
        for call in calls:
            with pytest.raises(ValueError, match=rf"requires grad.*variable=\('?{re.escape(name)}"):
                call()
    with torch.no_grad(), pytest.warns(UserWarning, match="folded into the kernels' data"):
        dyn.set(joint_stiffness=one)


def test_a_warp_array_that_requires_grad_is_named_when_it_is_set(device):
    dyn = spo.Dynamics(zoo.from_parents([-1], ["revolute"], 3), 1, device=device, variable=("joint_stiffness",))
    stiffness = wp.ones((1, 1), dtype=float, device=dyn.device, requires_grad=True)
    with pytest.warns(UserWarning, match="its gradient stays zero, because wp.Tape.*SolverSPO") as caught:
        dyn.set(joint_stiffness=stiffness)
    assert caught[0].filename == __file__
