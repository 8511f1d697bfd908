"""Derivatives where loops are embedded, against differences: of the function in every entry, off the closures too, and
of Lagrange's equations along what the closures allow. J* y against J x; torch, through rollouts."""

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import mechanisms, symbolic
from support.mechanisms import FIRST, MECHANISMS
from support.step_scenes import furnished, held, smooth
from warp_spo.dynamics.loop_analysis import ClosureEvaluator
from warp_spo.errors import UnsupportedError
from warp_spo.recursions.derivatives import adjoints, power
from warp_spo.recursions.loops import embedded_adjoints
from warp_spo.recursions.loops.nullspace import NullSpace
from warp_spo.trace.differentiation import reverse
from warp_spo.trace.evaluation import evaluate
from warp_spo.trace.scalars import Graph, absolute

SCENES = ["fourbar", "tilted", "ancestors", "far_loop"]  # planar, redundant rows, couplings, a free hinge and a ball
H = 5e-3
ROUNDED = 1e-6  # of differences of order 2; measured 4e-8, through 20 steps 3e-9
TOLERANCE = 1e-10  # of differences of order 8; measured 8e-13
ADJOINT = 1e-12
STEP = 1e-2  # [s]
SINGLE = 1e-5  # float32 beside float64; measured 8e-7


def arrays_of(name, seed=0):
    """A state off the closures, and what acts on it; a cotangent y of each dof, "minimal" of the independent ones."""
    _, how, s, _ = mechanisms.case(name)
    rng = np.random.default_rng(seed)
    q, qd = s.q + 0.03 * rng.normal(size=s.q.shape), rng.normal(size=s.qd.shape)
    y, minimal = rng.normal(size=qd.shape), rng.normal(size=(len(q), len(how.dofs)))
    return dict(q=q, qd=qd, tau=s.tau, qdd=s.qdd, body_f=s.body_f, y=y, minimal=minimal)


def run(scene, operation, arrays, shapes, **options):
    return symbolic.run(scene, operation, arrays, tuple(arrays), shapes, **options)


def product(scene, operation, arrays, wrt, **options):
    """J* cotangent by name."""
    shape = {name: (scene.dof_count,) if name == "tangent" else arrays[name].shape[1:] for name in wrt}
    shapes = {"out" if name == wrt[0] else f"{name}_bar": shape[name] for name in wrt}
    return dict(zip(wrt, run(scene, operation, arrays, shapes, wrt=wrt, **options).values(), strict=True))


def difference(f, arrays, name):
    """How the sum f [world] changes with each entry of an array; all entries and steps are worlds of one call."""
    x = arrays[name]
    worlds, size = len(x), x[0].size
    moved = []
    for k in FIRST:
        for sign in (1.0, -1.0):
            for entry in np.eye(size).reshape(size, *x.shape[1:]):
                moved.append(x + sign * k * H * entry)
    count = len(moved)
    given = {key: np.concatenate([value] * count) for key, value in arrays.items()}
    given[name] = np.concatenate(moved)
    values = f(given).reshape(len(FIRST), 2, size, worlds)
    weights = np.array([*FIRST.values()])
    return (np.einsum("k,kew->we", weights, values[:, 0] - values[:, 1]) / H).reshape(x.shape)


def largest(got, wanted):
    return np.abs(got - wanted).max() / max(np.abs(wanted).max(), 1.0)


# -- forward dynamics --------------------------------------------------------------------------------------------------
def forward_dynamics_error(name, given=("q", "qd", "tau", "body_f")):
    scene, how, _, _ = mechanisms.case(name)
    a = arrays_of(name)
    state, n = {key: a[key] for key in given}, (scene.dof_count,)

    def qdd(arrays):
        return run(scene, "embedded_forward_dynamics", arrays, {"out": n}, embedding=how)["out"]

    def power_of(arrays):
        return (qdd(arrays) * np.tile(a["y"], (len(arrays["q"]) // len(a["y"]), 1))).sum(1)

    known = {**state, "qdd": qdd(state), "cotangent": a["y"]}
    found = product(scene, "embedded_forward_dynamics_vjp", known, given, embedding=how)
    return max(largest(found[key], difference(power_of, state, key)) for key in given)


@pytest.mark.parametrize("name", SCENES)
def test_forward_dynamics_is_the_difference(name):
    assert forward_dynamics_error(name) <= TOLERANCE


@pytest.mark.parametrize("given", [("q",), ("q", "tau"), ("q", "qd")])
def test_what_is_not_given_is_zero(given):
    assert forward_dynamics_error("tilted", given) <= TOLERANCE


BUGS = [
    (embedded_adjoints.ClosedEquations, "gradient", "velocities(trace), rates", "None, rates"),
    (embedded_adjoints.ClosedEquations, "gradient", "- tau(dof)", ""),
    (embedded_adjoints.ClosedEquations, "gradient", "[*mu, *(-x for x in nu)]", "[*mu, *nu]"),
    (NullSpace, "multipliers", "reversed(self._steps)", "self._steps"),
    (power.Power, "_pull_to_parent", "0.0) + bar + f", "0.0) + bar"),
]


@pytest.mark.parametrize(("owner", "name", "old", "new"), BUGS)
def test_a_planted_bug_is_seen(monkeypatch, owner, name, old, new):
    case = mechanisms.case("tilted")
    monkeypatch.setattr(mechanisms, "case", lambda _: case._replace(scene=MECHANISMS["tilted"](armature=0.3)))
    assert forward_dynamics_error("tilted") <= TOLERANCE
    symbolic.plant(monkeypatch, owner, name, old, new)
    assert not forward_dynamics_error("tilted") <= 1e-3


@pytest.mark.parametrize("name", [*SCENES, "geared"])
def test_both_ways_agree(name):
    """y . (J x) = x . (J* y), of forward dynamics and of inverse dynamics in independent dofs."""
    scene, how, _, _ = mechanisms.case(name)
    a, rng = arrays_of(name), np.random.default_rng(3)
    for operation, third, y in (("forward_dynamics", "tau", "y"), ("inverse_dynamics", "qdd", "minimal")):
        given = ("q", "qd", third, "body_f")
        state = {key: a[key] for key in (*given, "tau", "qdd")}
        if operation == "inverse_dynamics":
            del state["tau"]
        along = {f"{key}_dot": rng.normal(size=a["qd" if key == "q" else key].shape) for key in given}
        pushed = run(scene, f"embedded_{operation}_jvp", {**state, **along}, {"out": a[y].shape[1:]}, embedding=how)[
            "out"
        ]
        wrt = ("tangent", "qd", third, "body_f")
        back = product(scene, f"embedded_{operation}_vjp", {**state, "cotangent": a[y]}, wrt, embedding=how)
        one = (a[y] * pushed).sum(1)
        parts = [(back[key] * x).reshape(len(one), -1) for key, x in zip(wrt, along.values(), strict=True)]
        size = sum(np.abs(part).sum(1) for part in parts)
        assert (np.abs(one - sum(part.sum(1) for part in parts)) <= ADJOINT * size).all(), operation


def test_lagrange_along_what_closures_allow():
    """A curve of consistent states: the reference's accelerations change along it as J x says."""
    scene, how, s, _ = mechanisms.case("fourbar")
    closing, h = ClosureEvaluator(scene), 1e-3
    v = s.qd

    def states(t):
        q = closing.close(s.q + t * v)
        return q, np.array([mechanisms.Closed(scene, x).consistent(rate) for x, rate in zip(q, s.qd, strict=True)])

    ends = {k: states(k * h) for way in FIRST for k in (way, -way)}
    slope = lambda f: sum(c * (f(k) - f(-k)) for k, c in FIRST.items()) / h  # noqa: E731
    dq, dqd = slope(lambda k: ends[k][0]), slope(lambda k: ends[k][1])

    def reference(k):
        return np.array(
            [mechanisms.Closed(scene, q).forward_dynamics(qd, tau) for q, qd, tau in zip(*ends[k], s.tau, strict=True)]
        )

    state = dict(q=s.q, qd=s.qd, tau=s.tau)
    qdd = run(scene, "embedded_forward_dynamics", state, {"out": (3,)}, embedding=how)["out"]
    along = dict(q_dot=dq, qd_dot=dqd, qdd=qdd)
    got = run(scene, "embedded_forward_dynamics_jvp", state | along, {"out": (3,)}, embedding=how)["out"]
    assert largest(got, slope(reference)) <= 1e-6  # the reference's own differences


# -- inverse dynamics --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", [*SCENES[:3], "geared"])
def test_inverse_dynamics_is_the_difference(name):
    scene, how, _, _ = mechanisms.case(name)
    a, m = arrays_of(name), (len(how.dofs),)

    def power_of(arrays):
        tau = run(scene, "embedded_inverse_dynamics", arrays, {"out": m}, embedding=how)["out"]
        return (tau * np.tile(a["minimal"], (len(tau) // len(a["minimal"]), 1))).sum(1)

    for given in (("q", "qd", "qdd", "body_f"), ("q", "qd"), ("q",)):
        state = {key: a[key] for key in given}

        found = product(
            scene, "embedded_inverse_dynamics_vjp", {**state, "cotangent": a["minimal"]}, given, embedding=how
        )
        for key in given:
            assert largest(found[key], difference(power_of, state, key)) <= TOLERANCE, (given, key)


# -- kernels, and torch ------------------------------------------------------------------------------------------------
STATE = ("q", "qd", "tau", "body_f")


def built(scene, worlds, device, dtype="float64", **more):
    torch = pytest.importorskip("torch")
    dyn = spo.Dynamics(scene, worlds, device=device, dtype=dtype, loops="embed", **more)
    kind = dict(dtype=getattr(torch, dtype), device=wp.device_to_torch(device))
    return torch, dyn, lambda x, grad=True: torch.tensor(x, **kind).requires_grad_(grad)


def slopes(f, x, h):
    """Differences of f [world] by each entry of a tensor [world, ...], of order 2."""
    found = x.detach().clone()
    for entry in np.ndindex(tuple(x.shape[1:])):
        ends = []
        for sign in (1.0, -1.0):
            moved = x.detach().clone()
            moved[(slice(None), *entry)] += sign * h
            ends.append(f(moved))
        found[(slice(None), *entry)] = (ends[0] - ends[1]) / (2.0 * h)
    return found


def step_error(name, device, change):
    """Of the gradient of a step, by all that it takes."""
    _, _, s, _ = mechanisms.case(name)
    torch, dyn, tensor = built(change(MECHANISMS[name]()), 3, device)
    rng = np.random.default_rng(5)
    arrays = {key: getattr(s, key) for key in STATE} | dict(target_q=s.q[::-1].copy(), target_qd=s.qdd)
    a = {key: tensor(x) for key, x in arrays.items()}
    y = [tensor(rng.normal(size=x.shape), False) for x in (s.q, s.qd)]

    def total(**changed):
        after = dyn.step(**{**a, **changed}, dt=STEP)
        return sum((one * x).sum(1) for one, x in zip(y, after, strict=True))

    total().sum().backward()
    with torch.no_grad():
        wanted = {key: slopes(lambda x, key=key: total(**{key: x}), x, 1e-5) for key, x in a.items()}
    return max(largest(a[key].grad.cpu().numpy(), x.cpu().numpy()) for key, x in wanted.items())


@pytest.mark.parametrize("name", ["fourbar", "far_loop"])
def test_a_step_is_the_difference(name, device):
    """Drives, limits, friction, velocity limits and gravity compensation, in the pieces that held."""
    assert step_error(name, device, lambda scene: held(furnished(scene))) <= ROUNDED


STEP_BUGS = [
    (
        embedded_adjoints.ClosedEquations,
        "project_state",
        "ClosedStep(self.trace, self.loops.embedding).project_state(stores)",
        "stores",
    ),
    (adjoints, "step_vjp", "- stiff[dof] * solved[dof]", ""),
    (adjoints, "step_vjp", "tau(dof) + forces[dof]", "tau(dof)"),
]


@pytest.mark.parametrize(("owner", "name", "old", "new"), STEP_BUGS)
def test_a_bug_in_the_way_back_of_a_step_is_seen(monkeypatch, owner, name, old, new):
    symbolic.plant(monkeypatch, owner, name, old, new)
    assert not step_error("fourbar", "cpu", smooth) <= 10.0 * ROUNDED


def test_gradcheck(device):
    _, _, s, _ = mechanisms.case("fourbar")
    torch, dyn, tensor = built(MECHANISMS["fourbar"](), 3, device)
    state = [tensor(getattr(s, key)) for key in STATE[:3]]
    for run in (dyn.forward_dynamics, lambda *x: dyn.step(*x, 1e-2), lambda q, qd, _: dyn.bias_force(q, qd),
                dyn.inverse_dynamics, dyn.gravity_force):  # fmt: skip
        inputs = state[:1] if run == dyn.gravity_force else state
        assert torch.autograd.gradcheck(run, inputs, eps=1e-6, atol=1e-6, rtol=1e-6)


def test_a_rollout_is_the_difference(device):
    """20 steps of a driven four-bar, from states off the closures too: the way back onto them is part of a step."""
    _, _, s, _ = mechanisms.case("fourbar")
    torch, dyn, tensor = built(smooth(MECHANISMS["fourbar"]()), 3, device)
    a = [tensor(x) for x in (s.q + 1e-3, s.qd, 10.0 * s.tau)]

    def last(q, qd, tau):
        for _ in range(20):
            q, qd = dyn.step(q, qd, tau, 1e-2)
        return (q * q).sum(1) + qd.sum(1)

    last(*a).sum().backward()
    with torch.no_grad():
        for i, x in enumerate(a):
            wanted = slopes(lambda x, i=i: last(*a[:i], x, *a[i + 1 :]), x, 1e-5)
            assert largest(x.grad.cpu().numpy(), wanted.cpu().numpy()) <= ROUNDED


def test_float32_and_what_is_written(device):
    """Results are written over poison, in float32 as in float64, made on the way or with qdd given; prepared ahead."""
    _, _, s, _ = mechanisms.case("fourbar")
    wrt, rng, found = ("tangent", "qd", "tau", "q"), np.random.default_rng(2), {}
    y = rng.normal(size=s.qd.shape)
    for dtype in ("float64", "float32"):
        dyn = spo.Dynamics(MECHANISMS["fourbar"](), 3, device=device, dtype=dtype, loops="embed")
        for product in ("forward_dynamics_vjp", "forward_dynamics_jvp", "step_vjp", "inverse_dynamics_jvp"):
            dyn.prepare(product)
        state = [wp.array(x, dtype=dyn.dtype, device=device) for x in (s.q, s.qd, s.tau, y)]
        out = {name: wp.full((3, 3), float("nan"), dtype=dyn.dtype, device=device) for name in wrt}
        dyn.forward_dynamics_vjp(*state[:3], cotangent=state[3], wrt=wrt, out=out)
        found[dtype] = {name: array.numpy() for name, array in out.items()}
        qdd = dyn.forward_dynamics(*state[:3])
        again = dyn.forward_dynamics_vjp(*state[:3], cotangent=state[3], qdd=qdd, wrt=wrt)
        for name in wrt:
            np.testing.assert_array_equal(again[name].numpy(), found[dtype][name])
    for name, x in found["float64"].items():
        assert largest(found["float32"][name], x) <= SINGLE
    dense = spo.Dynamics(MECHANISMS["fourbar"](), 3, device=device, dtype="float64", loops="embed")
    J = dense.forward_dynamics_derivatives(s.q, s.qd, s.tau)
    for name, D in zip(wrt, J, strict=False):
        assert largest(np.einsum("wij,wi->wj", D, y), found["float64"][name]) <= ADJOINT


def test_a_singular_world_is_nan_alone(device):
    """A flat parallelogram, where it may fold: its closures lose a row; and a world with a NaN."""
    scene = MECHANISMS["parallelogram"]()
    s = mechanisms.states(scene, 1, q=ClosureEvaluator(scene).close(np.array([[0.5, -0.5, 0.5]])))
    q = np.concatenate([s.q, np.zeros((1, 3)), s.q])
    qd, tau, y = (np.repeat(x, 3, 0) for x in (s.qd, s.tau, s.qdd))
    tau[2] = np.nan
    dyn = spo.Dynamics(scene, 3, device=device, dtype="float64", loops="embed")
    one = spo.Dynamics(scene, 1, device=device, dtype="float64", loops="embed")
    found = dyn.forward_dynamics_vjp(q, qd, tau, cotangent=y)
    alone = one.forward_dynamics_vjp(s.q, s.qd, s.tau, cotangent=s.qdd)
    for name, gradient in found.items():
        np.testing.assert_array_equal(gradient[0], alone[name][0])
        assert np.isnan(gradient[1]).all()
    assert np.isnan(found["q"][2]).any()
    tensor = built(scene, 3, device)[2]
    a = [tensor(x) for x in (q, qd, tau)]
    sum(x.sum() for x in dyn.step(*a, STEP)).backward()
    gradients = [x.grad.cpu().numpy() for x in a]
    assert all(np.isfinite(x[0]).all() and np.isnan(x[1]).all() for x in gradients)


def test_values_that_vary(device):
    """Gradients by values of the scene, those that closures see too, are the differences."""
    _, _, s, _ = mechanisms.case("fourbar")
    names = ("body_mass", "joint_X_p", "joint_damping")
    torch, dyn, tensor = built(smooth(MECHANISMS["fourbar"]()), 3, device, variable=names)
    state = [tensor(getattr(s, key), False) for key in STATE[:3]]
    values = {name: tensor(np.repeat(dyn.scene.values[name], 3, 0)) for name in names}
    y = tensor(s.qdd, False)

    def total(run, **changed):
        dyn.set(**{**values, **changed})
        return (y * run()).sum(1)

    for run in (lambda: dyn.forward_dynamics(*state), lambda: dyn.step(*state, STEP)[1]):
        gradients = torch.autograd.grad(total(run).sum(), [*values.values()], allow_unused=True)
        for (name, x), got in zip(values.items(), gradients, strict=True):
            if got is None:
                assert name == "joint_damping"  # which forward dynamics does not know
                continue
            with torch.no_grad():
                wanted = slopes(lambda x, run=run, name=name: total(run, **{name: x}), x, 1e-5)
            assert largest(got.cpu().numpy(), wanted.cpu().numpy()) <= ROUNDED, name


def test_what_sees_no_loops_and_what_is_refused(device):
    """Gradients of the open tree's kinematics serve closed ones too; what has none names a way out."""
    _, _, s, _ = mechanisms.case("fourbar")
    torch, _, tensor = built(MECHANISMS["fourbar"](), 3, device)
    dyns = [spo.Dynamics(MECHANISMS["fourbar"](), 3, device=device, dtype="float64", loops=loops)
            for loops in ("cut", "embed", "multipliers")]  # fmt: skip
    q, qd = tensor(s.q), tensor(s.qd)
    for results in (lambda dyn: dyn.body_poses(q), lambda dyn: dyn.body_velocities(q, qd),
                    lambda dyn: dyn.integrate(q, qd, 0.1)):  # fmt: skip
        wanted, *found = (torch.autograd.grad(results(dyn).square().sum(), q)[0] for dyn in dyns)
        assert all(torch.equal(wanted, each) for each in found)
    refused = {
        r"a derivative with closed loops.*loops='cut'": (
            lambda dyn: dyn.mass_matrix(q), lambda dyn: dyn.solve_mass_matrix(q, q[:, : len(dyn.independent_dofs)]),
            lambda dyn: dyn.inverse_dynamics_derivatives(s.q), lambda dyn: dyn.mass_matrix_derivative(s.q),
        ),
        r"a derivative with closed loops.*use loops='embed'": (
            lambda dyn: dyn.forward_dynamics(q), lambda dyn: dyn.step(q, qd, None, STEP),
            lambda dyn: dyn.forward_dynamics_derivatives(s.q), lambda dyn: dyn.forward_dynamics_jvp(s.q, dq=s.qd),
        ),
    }  # fmt: skip
    for message, calls in refused.items():
        for dyn in dyns[1 if "cut" in message else 2 :]:
            for call in calls:
                with pytest.raises(UnsupportedError, match=message):
                    call(dyn)


def test_a_size_has_a_slope_at_zero_too():
    """Householder's signs: the side of a kink that the value was computed on, never NaN."""
    x = Graph().input("x", 0)
    (slope,) = reverse([absolute(x)], [x], [1.0])
    for value, side in ((2.0, 1.0), (-2.0, -1.0), (0.0, -1.0)):
        assert evaluate([slope], lambda *_, value=value: value)[0] == side
