"""Gradients of steps with contacts: every pass against differences away from switches, and through torch."""

import functools
import itertools

import newton
import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import contact_gradients, geared, symbolic, zoo
from support.contact_cases import EFFORT, box, everywhere, quadruped, touching
from support.contact_steps import FIELDS, above
from support.hopping_leg import leg, loss
from support.quick import slow_unless
from support.solver_grounds import SIDE, boxes, plane
from support.step_scenes import furnished, states
from warp_spo.env import robots
from warp_spo.examples import hop
from warp_spo.newton import SolverSPO
from warp_spo.recursions.contact import law
from warp_spo.recursions.derivatives.contact import PassAdjoint, PassGradient, PassSolve

torch = pytest.importorskip("torch")
H, WORLDS = 5e-3, 4
LARGEST = {"tau": 1e-6, "body_f": 1e-6}
"""Error of a gradient by forces over the largest entry; 1e-7 measured. By anything else:"""
LARGEST_ELSE = 1e-4  # 2e-5 measured, of gains that hardly matter


def without_friction(scene):
    """The scene without dry friction in its hinges, whose creep differences of this size do not resolve."""
    return scene.with_values(joint_friction=np.zeros(scene.dof_count))


@functools.cache
def case(name):
    """A scene with states in which points stick, slide, close and open, and drives are saturated."""
    if name in FIELDS:
        field = FIELDS[name]
        uneven = field.heights + 1e-3 * np.random.default_rng(0).normal(size=field.heights.shape)
        scene = box(ground=spo.HeightField(uneven, field.cell, field.origin), friction=0.3)  # no two corners as low
        a = above(scene, 1, 2 * WORLDS)
    elif name in ("stick", "slide"):
        friction, fast = {"stick": (0.8, 1.0), "slide": (0.2, 3.0)}[name]
        scene = without_friction(quadruped(EFFORT, friction=friction))
        q, qd, tau = touching(scene, 4, WORLDS)
        a = {"q": q, "qd": fast * qd, "tau": tau}
    else:
        tree = furnished(zoo.random_tree(6, 1)) if name == "tree" else geared.geared_tree("full")
        scene = everywhere(without_friction(tree), 1)
        a = states(scene, WORLDS)
        a |= {"qd": np.random.default_rng(0).normal(size=a["qd"].shape)}
        if name == "geared":
            a = {argument: a[argument] for argument in ("q", "qd", "tau")}
    return scene, contact_gradients.furnish(scene, a)


def go2(ground):
    """Go2 with its servos, standing in several ways, and ranges of control that some exceed."""
    robot, rng = robots.load("go2", ground), np.random.default_rng(2)
    q = np.tile(robot.q, (WORLDS, 1))
    q[:, 7:] += 0.2 * rng.normal(size=(WORLDS, 12))
    q[:, :3] += rng.normal(size=(WORLDS, 3)) * [0.2, 0.2, 0.02]
    a = {"q": q, "qd": 0.5 * rng.normal(size=(WORLDS, 18)), "tau": rng.normal(size=(WORLDS, 18))}
    return robot.scene, a | {"ctrl": robot.ctrl + 0.3 * rng.normal(size=(WORLDS, 12))}


@pytest.mark.slow
@pytest.mark.parametrize("ground", [None, FIELDS["rough"]], ids=["plane", "rough"])
def test_gradients_of_go2_are_differences(ground):
    scene, a = go2(ground)
    names = ("q", "qd", "tau", "ctrl", "contact_friction", "contact_stiffness", "contact_damping", "ground_origin",
             *([] if ground is None else ["ground_heights"]))  # fmt: skip
    errors = contact_gradients.errors(scene, contact_gradients.furnish(scene, a), H, 3, names=names)
    for argument, (error, crossed) in errors.items():
        assert error <= LARGEST.get(argument, LARGEST_ELSE), (argument, errors)
        assert crossed <= 0.05, (argument, errors)


SLOW = ("stick", "slide", "tree", "geared")


@pytest.mark.parametrize("name", slow_unless(FIELDS, [*SLOW, *FIELDS]))
def test_gradients_are_differences(name):
    """By state, forces, targets, gains and the contacts' values; hardly any difference crosses a switch."""
    scene, a = case(name)
    errors = contact_gradients.errors(scene, a, H, 3)
    for argument, (error, crossed) in errors.items():
        assert error <= LARGEST.get(argument, LARGEST_ELSE), (argument, errors)
        assert crossed <= 0.02, (argument, errors)  # one of 72 of a gain in "stick"


BY = ("q", "qd", "contact_friction")


@pytest.mark.parametrize("passes", [1, 4])
def test_any_number_of_passes_is_differentiated(passes):
    scene, a = case("rough")
    errors = contact_gradients.errors(scene, a, H, passes, names=BY)
    assert max(error for error, _ in errors.values()) <= LARGEST_ELSE


BUGS = {
    "earlier passes frozen": (PassAdjoint, "_results", "self._of_later(COTANGENT, self._dofs + x.index[0])", "0.0"),
    "what passes begin with": (PassGradient, "stores", "select(pass_variables.first, gradient, 0.0)", "0.0"),
    "a load held": (PassGradient, "stores", "seeds += [1.0,", "seeds += [0.0,"),
    "a load held before": (PassSolve, "stores", "[*seeds, 1.0]", "[*seeds, 0.0]"),
    "dampers left out": (PassSolve, "stores", "terms=terms", "terms=type(terms)(force=pushes)"),
    "points that do not press": (PassSolve, "stores", "Vector(wrenches[6 * at", "0.0 * Vector(wrenches[6 * at"),
}


@functools.cache
def wanted_in_case_rough():
    """Differences of three passes by name; no bug is planted in what they call."""
    scene, a = case("rough")
    cotangents = contact_gradients.draw_cotangents(a, seed=0)
    return {name: contact_gradients.differences(scene, a, H, 3, cotangents, name) for name in BY}


@pytest.mark.parametrize("bug", BUGS)
def test_planted_bugs(bug, monkeypatch):
    wanted = wanted_in_case_rough()
    symbolic.plant(monkeypatch, *BUGS[bug])
    scene, a = case("rough")
    errors = contact_gradients.errors(scene, a, H, 3, names=BY, wanted=wanted)
    assert max(error for error, _ in errors.values()) >= 1e-3, errors


def test_a_cube_at_rest_has_a_gradient(monkeypatch):
    """The length of no slip would have an infinite slope."""
    scene = box()
    q = np.tile([0.0, 0, 0.0995, 0, 0, 0, 1], (2, 1))
    a = contact_gradients.furnish(scene, {"q": q, "qd": np.zeros((2, 6)), "tau": np.zeros((2, 6))})
    cotangents = [np.ones((2, 7)), np.ones((2, 6))]
    found = contact_gradients.gradient(scene, a, H, 3, cotangents, ("q", "qd", "tau"))
    assert all(np.isfinite(x).all() for x in found.values())
    monkeypatch.setattr(law, "TINY", 0.0)
    with np.errstate(all="ignore"):
        found = contact_gradients.gradient(scene, a, H, 3, cotangents, ("qd",))
    assert np.isnan(found["qd"]).all()


# -- through torch -----------------------------------------------------------------------------------------------------


def test_torch_differentiates_the_step(device):
    """Every input and value, by differences of the compiled step; substeps; float32 beside float64."""
    dyn, tensors = leg("float64", device)
    for more in ({"substeps": 3}, {"passes": 4}):
        for tensor in tensors.values():
            tensor.grad = None
        loss(dyn, tensors, **more).sum().backward()
        for name, tensor in tensors.items():
            wanted, still = torch.zeros_like(tensor), {n: t.detach() for n, t in tensors.items()}
            for at in range(tensor.shape[1]):
                by = torch.zeros_like(tensor)
                by[:, at] = 1e-6 * torch.clamp(abs(tensor[:, at].detach()), 1.0)
                ends = [loss(dyn, still | {name: still[name] + sign * by}, **more) for sign in (1.0, -1.0)]
                wanted[:, at] = (ends[0] - ends[1]) / (2.0 * by[:, at])
            error = abs(tensor.grad - wanted).amax() / abs(wanted).amax()
            assert error <= 1e-5, (name, more, error)  # 6e-7 measured: differences of second order
    last = {name: tensor.grad for name, tensor in tensors.items()}
    dyn, tensors = leg("float32", device)
    loss(dyn, tensors, passes=4).sum().backward()
    for name, tensor in tensors.items():
        error = abs(tensor.grad - last[name]).amax() / abs(last[name]).amax()
        assert error <= 1e-3, (name, error)  # 1e-4 measured: a depth of 0.5 mm is rounded to 6e-5 of itself


def test_worlds_are_apart(device):
    """NaN stays in its world, and the other worlds' gradients have the bits that they have among other worlds."""
    found = []
    for order in ([0, 1, 2, 3], [3, 1, 0, 2]):
        dyn, tensors = leg("float64", device)
        mixed = {name: tensor.detach()[order].clone().requires_grad_() for name, tensor in tensors.items()}
        with torch.no_grad():
            mixed["q"][order.index(1), 1] = torch.nan
        loss(dyn, mixed).sum().backward()
        back = [order.index(world) for world in range(WORLDS)]
        found.append({name: tensor.grad[back] for name, tensor in mixed.items()})
    for name, first in found[0].items():
        assert torch.isfinite(first[[0, 2, 3]]).all() and torch.equal(first[[0, 2, 3]], found[1][name][[0, 2, 3]]), name
    assert torch.isnan(found[0]["q"][1]).any() and torch.isnan(found[0]["qd"][1]).any()


@pytest.mark.slow
def test_a_rollout_is_differentiated():
    """Torques of the hopping leg, through 100 steps in which its foot lands and lifts off."""
    dyn, rng = spo.Dynamics(hop.scene(), WORLDS, "cpu", "float64"), np.random.default_rng(0)
    q0, qd0 = hop.start(dyn)
    torques = torch.tensor(12.0 * rng.normal(size=(4, WORLDS, 2)), requires_grad=True)
    force, touched = torch.zeros((WORLDS, 1, 3), dtype=torch.float64), []

    def end(torques):
        q, qd = q0, qd0
        for at in range(hop.STEPS):
            tau = torch.nn.functional.pad(torques[4 * at // hop.STEPS], (1, 0))
            q, qd = dyn.step(q, qd, tau, hop.DT, target_q=q0, report=spo.StepReport(contact_f=force))
            touched.append(force[:, 0, 2] > 0.0)
        return (q * q).sum(1) + 0.1 * (qd * qd).sum(1)

    end(torques).sum().backward()
    closed = torch.stack(touched)
    assert (closed[1:] != closed[:-1]).any(0).sum() >= 2
    with torch.no_grad():
        for knot, dof in np.ndindex(4, 2):
            by = torch.zeros_like(torques)
            by[knot, :, dof] = 1e-6
            wanted, found = (end(torques + by) - end(torques - by)) / 2e-6, torques.grad[knot, :, dof]
            assert (abs(found - wanted) <= 1e-5 * abs(torques.grad).amax((0, 2))).all()  # 1e-7 measured


def test_gradients_that_do_not_exist_have_names(device):
    dyn, tensors = leg("float64", device)
    force = torch.zeros((WORLDS, 1, 3), dtype=torch.float64, device=tensors["q"].device)
    with pytest.raises(ValueError, match="contact_f is given with substeps and an input requires grad"):
        loss(dyn, tensors, contact_f=force, substeps=2)
    with pytest.raises(ValueError, match="contact_f requires grad and an input requires grad"):
        loss(dyn, tensors, contact_f=torch.zeros_like(force, requires_grad=True))
    loss(dyn, tensors, contact_f=force)
    assert (force[:, 0, 2] > 0.0).any()


def test_values_without_entries_have_gradients_without_entries(device):
    """Friction of contacts that a scene does not have comes first among the values, and the next one is right."""
    kind = dict(dtype=torch.float64, device=str(device).replace("cuda:0", "cuda"))
    hinge = spo.Hinge("revolute", -1, 0, axis=(1, 0, 0), damping=1.0)
    scene = spo.Scene([spo.Body(1.0, inertia=np.eye(3))], [hinge])
    dyn = spo.Dynamics(scene, 2, device, "float64", variable=("contact_friction", "joint_damping"))
    friction, damping = torch.zeros((2, 0), **kind, requires_grad=True), torch.ones((2, 1), **kind, requires_grad=True)
    dyn.set(contact_friction=friction, joint_damping=damping)
    dyn.step(torch.zeros((2, 1), **kind), torch.ones((2, 1), **kind), None, 0.1)[1].sum().backward()
    assert friction.grad.shape == (2, 0)
    assert torch.allclose(damping.grad, torch.full((2, 1), -0.1 / 1.1**2, **kind))  # qd' = qd / (1 + h d / I)


# -- through wp.Tape and JAX -------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_a_tape_differentiates_the_solver():
    """Cubes that slide: by the first state and by the friction of shapes, of which each point has a mean."""
    model = boxes(plane(0.1), plane(0.105))
    for name in ("joint_q", "joint_qd", "shape_material_mu"):
        getattr(model, name).requires_grad = True
    solver, steps = SolverSPO(model, passes=4), 3
    first = model.state(requires_grad=True)
    q, qd = first.joint_q.numpy().reshape(2, 7), np.tile([1.0, 0.3, 0.0, 0.0, 0.0, 0.5], (2, 1)).astype(np.float32)
    q[:, 2] = [SIDE / 2 + 0.0995, SIDE / 2 + 0.1045]
    first.joint_q.assign(q.ravel())
    first.joint_qd.assign(qd.ravel())
    states, tape = [first, *(model.state(requires_grad=True) for _ in range(steps))], wp.Tape()
    with tape:
        for before, after in itertools.pairwise(states):
            solver.step(before, after, None, None, H)
    seeds = np.random.default_rng(0).normal(size=(2, 6)).astype(np.float32)
    tape.backward(grads={states[-1].joint_qd: wp.array(seeds.ravel(), device="cpu")})

    scene = spo.from_newton(model, contacts="ground")
    dyn = spo.Dynamics(scene, 2, "cpu", "float64", variable=("contact_friction",))
    mu = np.array(np.broadcast_to(scene.values["contact_friction"], (2, scene.contact_count)), dtype=float)

    def last(q, qd, mu):
        dyn.set(contact_friction=mu)
        for _ in range(steps):
            q, qd = dyn.step(q, qd, None, H, options=spo.StepOptions(passes=4))
        return (qd * seeds).sum(axis=1)

    nudge = 1e-6
    by_mu = (last(q, qd, mu + nudge) - last(q, qd, mu - nudge)) / (2.0 * nudge)
    cubes = [shape for shape, body in enumerate(model.shape_body.numpy()) if body >= 0]
    found = model.shape_material_mu.grad.numpy()
    np.testing.assert_allclose(found[cubes], 0.5 * by_mu, rtol=1e-3)
    np.testing.assert_allclose(found.sum(), by_mu.sum(), rtol=1e-3)
    for axis in range(6):
        unit = nudge * np.eye(6)[axis]
        wanted = (last(q, qd + unit, mu) - last(q, qd - unit, mu)) / (2.0 * nudge)
        found = first.joint_qd.grad.numpy().reshape(2, 6)
        np.testing.assert_allclose(found[:, axis], wanted, atol=2e-3 * np.abs(found).max())


@pytest.mark.slow
def test_a_tape_of_a_solver_with_slots():
    """Steps without a list of contacts are differentiated, whatever lists other steps get; with one they refuse."""
    found = {}
    for contacts in ("none", "pipeline"):
        builder = newton.ModelBuilder()
        pole = builder.add_link(mass=1.0, inertia=wp.mat33(np.eye(3)))
        builder.add_shape_sphere(pole, radius=0.1)
        builder.add_articulation([builder.add_joint_revolute(-1, pole, axis=(0, 1, 0))])
        builder.add_shape_box(-1, xform=wp.transform((0.0, 0.0, -1.0), wp.quat_identity()), hx=0.2, hy=0.2, hz=0.2)
        model = builder.finalize(device="cpu", requires_grad=True)
        solver, first, last, tape = SolverSPO(model, contacts=contacts), model.state(), model.state(), wp.Tape()
        first.joint_qd.fill_(0.5)
        with tape:
            solver.step(first, last, None, None, H)
        if contacts == "pipeline":
            listed = newton.Contacts(4, 0, device="cpu")
            listed.rigid_contact_count.fill_(1)
            listed.rigid_contact_shape0.fill_(0)
            listed.rigid_contact_shape1.fill_(1)
            listed.rigid_contact_normal.fill_(wp.vec3(0.0, 0.0, -1.0))
            solver.step(model.state(), model.state(), None, listed, H)
            with wp.Tape(), pytest.raises(spo.UnsupportedError, match="contacts of a pipeline"):
                solver.step(first, model.state(), None, listed, H)
        tape.backward(grads={last.joint_qd: wp.ones(1, dtype=float, device="cpu")})
        found[contacts] = [first.joint_qd.grad.numpy(), model.body_mass.grad.numpy()]
    for mine, wanted in zip(found["pipeline"], found["none"], strict=True):
        np.testing.assert_allclose(mine, wanted, rtol=1e-5, atol=1e-7)


@pytest.mark.slow
def test_jax_differentiates_the_step(device):
    if not device.is_cpu:
        pytest.skip("on the CPU; benchmarks/jax_check.py looks at a GPU")
    jax = pytest.importorskip("jax")
    spo_jax = pytest.importorskip("warp_spo.jax")
    dyn, tensors = leg("float64", device)
    q, qd, tau, targets = (tensors[name] for name in ("q", "qd", "tau", "target_q"))
    wanted = torch.autograd.grad(loss(dyn, {n: t if n in ("q", "qd", "tau", "target_q") else t.detach()
                                            for n, t in tensors.items()}, substeps=2).sum(), (q, qd, tau))  # fmt: skip
    with jax.enable_x64(True):
        step = spo_jax.function(dyn, "step", dt=H, options=spo.StepOptions(substeps=2))

        def number(q, qd, tau):
            after, rate = step(q, qd, tau, target_q=targets.detach().numpy())
            return (after * after).sum() + (rate * rate).sum()

        arrays = [jax.numpy.asarray(x.detach().numpy()) for x in (q, qd, tau)]
        found = jax.jit(jax.grad(number, argnums=(0, 1, 2)))(*arrays)
    for mine, theirs in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(np.asarray(mine), theirs.numpy())


@pytest.mark.slow
def test_jumps_are_not_seen_and_dissipation_has_none():
    """The picture of the documentation: without jumps the mean of the gradients is the slope."""
    from benchmarks.contact import gradients as pictured

    mean, slope = pictured.slopes(**pictured.DAMPERS["damping=70"])
    assert abs(mean / slope - 0.69) <= 0.02
    mean, slope = pictured.slopes(**pictured.DAMPERS["dissipation=0.2"])
    assert abs(mean / slope - 1.0) <= 5e-3
