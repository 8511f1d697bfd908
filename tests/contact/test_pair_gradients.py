"""Gradients of steps in which bodies touch each other: beside differences, through torch and JAX."""

import functools

import numpy as np
import pytest

import warp_spo as spo
from support import pair_gradients, pair_scenes
from support.pair_gradients import H, finger, outcome, tensors, touching
from support.quick import slow_unless
from warp_spo.dynamics.stepping import joint_space_gradients
from warp_spo.kernels import joint_adjoint, near_pairs_adjoint

torch = pytest.importorskip("torch")
WORLDS = 2
LARGEST = 1e-6  # error of a gradient over the world's largest entry; 1e-7 measured by forces, 1e-8 by all else
FLOAT32 = 2e-3  # the same in float32, of one step, beside float64
WAYS = {"stick": (0.8, 0.05), "slide": (0.05, 0.5)}  # friction, and speed of the finger [rad/s]


def fingers(shape, way, **more):
    """A finger that pushes a cube, which sticks to both or slides on both; q and arguments of a step."""
    friction, speed = WAYS[way]
    scene = finger(shape, friction, friction, **more)
    q, qd, tau = touching(scene, WORLDS, speed)
    return scene, q, {"qd": qd, "tau": tau}


def arms(scene, states):
    """Arms with drives at their limits, dry friction and actuators, amid bodies; forces on these."""
    rng = np.random.default_rng(1)
    q, qd = states(0, 3)
    motors = [spo.Actuator(0, -0.5, 9.0, (0.1, -9.0, -0.2), force_range=(-0.6, 0.4)),
              spo.Actuator((0, 1), (0.3, -0.2), 2.0, (0.0, -2.0, -0.1)),
              spo.Actuator(1, -3.0, ctrl_range=(-0.8, 0.5), force_range=(-0.6, 1.0))]  # fmt: skip
    more = dict(contacts=scene.contacts, ground=scene.ground, actuators=motors)
    scene = spo.Scene(scene.bodies, scene.hinges, **more)
    a = {"qd": qd, "tau": rng.normal(size=qd.shape), "body_f": 0.3 * rng.normal(size=(3, scene.body_count, 6))}
    a |= {"target_q": q.copy(), "target_qd": 0.1 * rng.normal(size=qd.shape), "ctrl": rng.normal(size=(3, 3))}
    return scene, q, a


def at_limits():
    """A finger whose first joint is beyond its limit, and whose second one reaches it in the step."""
    scene, q, a = fingers("sphere", "stick", limit_ke=200.0, limit_kd=1.0, target_ke=20.0, effort_limit=0.1)
    limits = scene.values["joint_limit_lower"].copy(), scene.values["joint_limit_upper"].copy()
    limits[0][0, :2] = q[0, 0] + 2e-3, q[0, 1] - 1e-5
    limits[1][0, :2] = q[0, 0] + 1.0, q[0, 1] + 1.0
    a["tau"][:, 1] -= 5.0
    return scene.with_values(joint_limit_lower=limits[0], joint_limit_upper=limits[1]), q, a


CASES = {f"{shape} {way}": functools.partial(fingers, shape, way) for shape in pair_gradients.SHAPES for way in WAYS}
CASES |= {
    "limits": at_limits,
    "every kind": lambda: arms(pair_scenes.mixed(), pair_scenes.mixed_states),
    "hand": lambda: arms(pair_scenes.hand(), pair_scenes.hand_states),
    "shelf": lambda: shelf(),
}


def shelf():
    """Cubes on each other and on a shelf of the inertial frame, turned a little: aligned ones are at a kink."""
    q, qd = pair_scenes.shelf_states(0, WORLDS)
    turns = 0.01 * np.random.default_rng(0).normal(size=(WORLDS, 2, 3))
    q.reshape(WORLDS, 2, 7)[:, :, 3:] = [*np.zeros(3), 1.0]
    q.reshape(WORLDS, 2, 7)[:, :, 3:6] += turns
    q.reshape(WORLDS, 2, 7)[:, :, 6] = np.sqrt(1.0 - (turns * turns).sum(axis=2))
    return pair_scenes.shelf(-1), q, {"qd": qd, "tau": np.zeros_like(qd)}


@pytest.mark.parametrize("name", slow_unless(["sphere slide"], list(CASES)))
def test_gradients_are_differences(name):
    """By state, forces, targets and controls; hardly any difference crosses a switch."""
    scene, q, a = CASES[name]()
    dyn = spo.Dynamics(scene, len(q), "cpu", "float64")
    for argument, (error, crossed) in pair_gradients.errors(dyn, q, a).items():
        assert error <= LARGEST, (argument, error)
        assert crossed <= 0.05, (argument, crossed)


@pytest.mark.slow
@pytest.mark.parametrize("passes", [1, 2, 6])
def test_any_number_of_passes_is_differentiated(passes):
    scene, q, a = fingers("sphere", "slide")
    dyn = spo.Dynamics(scene, len(q), "cpu", "float64")
    errors = pair_gradients.errors(dyn, q, a, 2, spo.StepOptions(passes=passes))
    assert max(error for error, _ in errors.values()) <= LARGEST, errors


def test_ten_steps_of_a_pushed_cube_pass_gradcheck():
    scene = finger("sphere", 0.4, 0.3)
    q, qd, tau = touching(scene, 1, 0.2)
    tau[:, :2] = -3.0, 0.5
    dyn, pushed = spo.Dynamics(scene, 1, "cpu", "float64"), []
    q, a = torch.tensor(q), tensors(dyn, {"x": np.zeros((1, scene.dof_count)), "qd": qd, "tau": tau})

    def end(*given):
        state, qd, tau = dyn.integrate(q, given[0], 1.0), *given[1:]
        for _ in range(10):
            report = dyn.step_report("contact_f", like=q)
            state, qd = dyn.step(state, qd, tau, H, report=report)
            pushed.append(report.contact_f[0, -1].norm())
        return state, qd

    after = end(*a.values())
    assert torch.autograd.gradcheck(end, tuple(a.values()), eps=1e-7, atol=1e-5, rtol=1e-5)
    assert sum(force > 1.0 for force in pushed[:10]) >= 8 and after[0][0, 2] > q[0, 2] + 1e-3, pushed[:10]


BUGS = {
    "earlier passes frozen": (joint_adjoint, "BACK", "across_b[at] = before_b;", "across_b[at] = 0;"),
    "Jacobians held": (joint_adjoint, "RESULTS", "const REAL each = sign * J_b", "const REAL each = 0 * J_b"),
    "normals held": (joint_adjoint, "RESULTS", "joint_space::cross(tilt, axes, to + 3);", "tilt[0] = 0;"),
    "pushes held": (joint_adjoint, "BACK", "push_b = pushes ? fn_b : 0;", "push_b = 0;"),
    "velocities before held": (joint_adjoint, "BACK", "u0_b[3 * at] -= h * kd * pushed[0];", "u0_b[3 * at] -= 0;"),
    "places held": (
        near_pairs_adjoint,
        "PAIR_BACK",
        "(up[i * POINT + c] - down",
        "(c > 2) * (up[i * POINT + c] - down",
    ),
    "poses held": (near_pairs_adjoint, "SUMS", "to[c] = f[c];", "to[c] = 0;"),
}


@pytest.mark.slow
@pytest.mark.parametrize("bug", BUGS)
def test_planted_bugs(bug, monkeypatch):
    file, name, old, new = BUGS[bug]
    text = getattr(file, name)
    if isinstance(text, dict):
        assert any(old in part for part in text.values())
        planted = {key: part.replace(old, new) for key, part in text.items()}
    else:
        assert old in text
        planted = text.replace(old, new)
    made = joint_adjoint.adjoint, near_pairs_adjoint.narrow_phase_back, near_pairs_adjoint.poses_back
    monkeypatch.setattr(file, name, planted)
    for one in made:
        one.cache_clear()
    try:
        scene, q, a = fingers("sphere", "slide")
        dyn = spo.Dynamics(scene, len(q), "cpu", "float64")
        errors = pair_gradients.errors(dyn, q, a)
    finally:
        for one in made:
            one.cache_clear()
    assert max(error for error, _ in errors.values()) >= 1e-3, errors


@pytest.mark.slow
def test_values_of_contacts_have_gradients():
    """Friction, stiffness and damping of a pair and of the ground's points."""
    scene, q, a = fingers("box", "slide")
    dyn = spo.Dynamics(scene, WORLDS, "cpu", "float64", variable=joint_space_gradients.VALUES)
    rng, still = np.random.default_rng(0), {name: torch.tensor(x) for name, x in a.items()}
    still["x"] = torch.zeros((WORLDS, scene.dof_count), dtype=torch.float64)
    cotangents = [torch.tensor(rng.normal(size=(WORLDS, n))) for n in (scene.coord_count, scene.dof_count)]
    values = {name: torch.tensor(np.tile(scene.values[name], (WORLDS, 1)), requires_grad=True) for name in dyn.variable}

    def end(values):
        dyn.set(**values)
        return outcome(dyn, torch.tensor(q), still, cotangents, 3)

    end(values).sum().backward()
    for name, value in values.items():
        wanted = torch.zeros_like(value)
        for at in range(value.shape[1]):
            step = 1e-5 * value[:, at].detach()
            for share, weight in pair_gradients.FOURTH:
                moved = {n: x.detach().clone() for n, x in values.items()}
                moved[name][:, at] += share * step
                moved[name].requires_grad_()
                wanted[:, at] += weight * end(moved).detach() / (12.0 * step)
        assert (abs(value.grad - wanted) <= LARGEST * abs(wanted).amax()).all(), name  # 6e-8 measured
        assert (value.grad[:, -1] != 0.0).all()


def test_steps_with_gradients_are_the_steps_without():
    """Generated code solves such a scene where no gradient is asked for, to the same numbers but for rounding."""
    scene, q, a = fingers("sphere", "slide")
    dyn = spo.Dynamics(scene, WORLDS, "cpu", "float64")
    q, qd, tau = (torch.tensor(x) for x in (q, a["qd"], a["tau"]))
    plain = dyn.step(q, qd, tau, H)
    recorded = dyn.step(q, qd.requires_grad_(), tau, H)
    for mine, wanted in zip(recorded, plain, strict=True):
        assert mine.requires_grad and not wanted.requires_grad
        assert torch.allclose(mine, wanted, rtol=0.0, atol=1e-10)


def test_worlds_are_apart():
    """NaN stays in its world, and the other worlds' gradients have the bits that they have among other worlds."""
    scene, q, a = fingers("sphere", "slide")
    q, a = np.tile(q, (2, 1)), {"x": np.zeros((4, scene.dof_count))} | {n: np.tile(x, (2, 1)) for n, x in a.items()}
    dyn, found = spo.Dynamics(scene, 4, "cpu", "float64"), []
    ones = [torch.ones((4, n), dtype=torch.float64) for n in (scene.coord_count, scene.dof_count)]
    for order in ([0, 1, 2, 3], [3, 1, 0, 2]):
        mixed = tensors(dyn, {name: x[order] for name, x in a.items()})
        with torch.no_grad():
            mixed["qd"][order.index(1), 1] = torch.nan
        outcome(dyn, torch.tensor(q[order]), mixed, ones).sum().backward()
        back = [order.index(world) for world in range(4)]
        found.append({name: tensor.grad[back] for name, tensor in mixed.items()})
    for name, first in found[0].items():
        kept = first[[0, 2, 3]]
        assert torch.isfinite(kept).all() and torch.equal(kept, found[1][name][[0, 2, 3]]), name
    assert torch.isnan(found[0]["qd"][1]).any()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sphere slide", "box stick", "every kind"])
def test_float32_is_near_float64(name):
    scene, q, a = CASES[name]()
    rng, found = np.random.default_rng(0), []
    seeds = [rng.normal(size=(len(q), n)) for n in (scene.coord_count, scene.dof_count)]
    given = {name: np.float32(x) for name, x in a.items()}
    for dtype in (torch.float64, torch.float32):
        dyn = spo.Dynamics(scene, len(q), "cpu", str(dtype).removeprefix("torch."))
        x = torch.zeros((len(q), scene.dof_count), dtype=dtype)
        mine = {n: torch.tensor(t, dtype=dtype, requires_grad=True) for n, t in {"x": x.numpy(), **given}.items()}
        weights = [torch.tensor(seed, dtype=dtype) for seed in seeds]
        outcome(dyn, torch.tensor(np.float32(q), dtype=dtype), mine, weights).sum().backward()
        found.append({n: tensor.grad for n, tensor in mine.items()})
    for name, exact in found[0].items():
        error = abs(found[1][name] - exact).flatten(1).amax(1) / abs(exact).flatten(1).amax(1)
        assert (error <= FLOAT32).all(), (name, error)


def test_gradients_that_do_not_exist_have_names():
    scene, q, a = fingers("sphere", "stick")
    dyn = spo.Dynamics(scene, WORLDS, "cpu", "float64", variable=("body_mass",))
    mass = torch.tensor(np.tile(scene.values["body_mass"], (WORLDS, 1)), requires_grad=True)
    dyn.set(body_mass=mass)
    with pytest.raises(ValueError, match="body_mass requires grad where bodies touch each other"):
        dyn.step(torch.tensor(q), torch.tensor(a["qd"]), None, H)
    balls = [spo.Contact(body, sphere=0.1, other=other, torsional_friction=0.01 * (body == 0))
             for body, other in ((0, None), (1, 0))]  # fmt: skip
    bodies = [spo.Body(1.0, inertia=0.01 * np.eye(3)) for _ in range(2)]
    pair = spo.Scene(bodies, [spo.Hinge("free", -1, body) for body in range(2)], contacts=balls, ground=spo.Plane())
    q = torch.tensor(pair.neutral_q[None], dtype=torch.float32, requires_grad=True)
    with pytest.raises(
        spo.UnsupportedError, match=r"contact between bodies \(.*\) is not supported; leave out contacts"
    ):
        spo.Dynamics(pair, 1, "cpu").step(q, torch.zeros((1, 12)), None, H)


@pytest.mark.slow
def test_jax_differentiates_the_step():
    jax = pytest.importorskip("jax")
    spo_jax = pytest.importorskip("warp_spo.jax")
    scene, q, a = fingers("sphere", "slide")
    dyn = spo.Dynamics(scene, WORLDS, "cpu", "float64")
    mine = tensors(dyn, {"q": q, **a})
    after, rate = dyn.step(mine["q"], mine["qd"], mine["tau"], H)
    wanted = torch.autograd.grad((after * after).sum() + (rate * rate).sum(), list(mine.values()))
    heavy = spo.Dynamics(scene, WORLDS, "cpu", "float64", variable=("body_mass",))
    with jax.enable_x64(True):
        by_mass = spo_jax.function(heavy, "step", dt=H, values=("body_mass",))
        with pytest.raises(spo.UnsupportedError, match="gradients by arguments of the step, and of values by contact_"):
            jax.grad(lambda mass: by_mass(q, a["qd"], a["tau"], body_mass=mass)[1].sum())(
                np.tile(scene.values["body_mass"], (WORLDS, 1))
            )
        step = spo_jax.function(dyn, "step", dt=H)

        def number(q, qd, tau):
            after, rate = step(q, qd, tau)
            return (after * after).sum() + (rate * rate).sum()

        arrays = [jax.numpy.asarray(x.detach().numpy()) for x in mine.values()]
        found = jax.jit(jax.grad(number, argnums=(0, 1, 2)))(*arrays)
    for one, theirs in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(np.asarray(one), theirs.numpy())


def test_the_way_back_is_prepared_and_repeated():
    """Calls that repeat what was launched have the bits of the first one."""
    scene, q, a = fingers("sphere", "slide")
    dyn = spo.Dynamics(scene, WORLDS, "cpu", "float64")
    dyn.prepare("step_vjp", wrt=("q", "qd", "tau"))
    mine, found = tensors(dyn, {"q": q, **a}), []
    for _ in range(4):
        after, rate = dyn.step(mine["q"], mine["qd"], mine["tau"], H)
        found.append(torch.autograd.grad(after.sum() + rate.sum(), list(mine.values())))
    for later in found[1:]:
        assert all(torch.equal(x, y) for x, y in zip(found[0], later, strict=True))
