"""Rotors: the machine with the rotor as a body of its own, formulas by hand, MuJoCo's armature, refusals."""

import dataclasses
import functools
import pickle

import mujoco
import numpy as np
import pytest
import torch
import warp as wp

import warp_spo as spo
from support import geared, implicit, laws, symbolic, zoo
from support.hinge_twins import AGREE, QUICK, SAME, difference, more_states, shapes
from support.quick import slow_unless
from support.step_scenes import FORCES, H, furnished
from support.step_scenes import states as step_states
from warp_spo.dynamics.loop_analysis import embedding
from warp_spo.examples import fourbar
from warp_spo.reference.dense import Dense
from warp_spo.trials.inputs import DECLARED, Inputs, trial_case
from warp_spo.trials.trial import Subject, TrialRun

EXACT = 1e-12  # float64, two bodies
SPIN = 1e-4  # of the rotors [kg m^2]
RATIOS = (1.0, 10.0, 100.0, 1000.0, 10000.0)


# -- reflected ---------------------------------------------------------------------------------------------------------
def test_a_reflected_rotor_is_armature():
    scene = geared.arm(30.0, SPIN, "reflected")
    assert scene.values["joint_armature"].tolist() == [[0.01, 0.01 + 900.0 * SPIN]]
    assert scene.hinges[1].armature.tolist() == [0.01]  # as given
    assert pickle.loads(pickle.dumps(scene)).hinges[1].rotor.ratio == 30.0
    flexible = geared.arm(30.0, SPIN, "reflected", flexible=(100.0, 0.0))
    assert flexible.values["joint_armature"].tolist() == [[0.01, 0.01 + 900.0 * SPIN, 0.0]]


def test_a_reflected_rotor_equals_the_armature_of_mujoco(device):
    xml = """<mujoco><option gravity="0 0 0"/><compiler inertiafromgeom="false"/><worldbody>
      <body><inertial pos=".4 0 0" mass=".5" diaginertia=".005 .02666666666666667 .02666666666666667"/>
        <joint axis="0 0 1" armature=".01"/>
        <body pos=".8 0 0"><inertial pos=".4 0 0" mass=".5" diaginertia=".005 .02666666666666667 .02666666666666667"/>
          <joint axis="0 1 0" armature="{}"/></body></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml.format(0.01 + 30.0**2 * SPIN))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.qfrc_applied[:] = (0.3, -0.7), (1.1, 0.4), (0.5, -0.2)
    mujoco.mj_forward(model, data)
    scene = geared.arm(30.0, SPIN, "reflected", axes=((0, 0, 1), (0, 1, 0)))
    bodies = [spo.Body(b.mass, b.com, np.diag([0.005, *b.inertia.diagonal()[1:]])) for b in scene.bodies]
    dyn = spo.Dynamics(spo.Scene(bodies, scene.hinges, gravity=(0, 0, 0)), 1, device, "float64", granularity="node")
    q, qd, tau = (x[None].copy() for x in (data.qpos, data.qvel, data.qfrc_applied))
    np.testing.assert_allclose(dyn.forward_dynamics(q, qd, tau)[0], data.qacc, rtol=1e-11)


@pytest.mark.parametrize("ratio", RATIOS)
def test_the_error_of_a_reflected_rotor_is_what_its_docstring_says(ratio):
    """Of the accelerations under a unit force at each hinge, as a share of the largest one."""
    for angle in (-0.7, 0.0, 1.0, 2.0):
        scene, q = geared.arm(ratio, SPIN, "reflected"), np.array([0.3, angle])
        found, twin = Dense(scene, q).mass_matrix, geared.DenseTwin(scene, q).mass_matrix
        x, exact = np.linalg.inv(found), np.linalg.inv(twin)
        first, own = np.abs(x - exact).max(axis=0) / np.abs(exact).max(axis=0)
        assert 0.96 <= first / (ratio * SPIN / found[1, 1]) <= 2.2 and first <= 0.018
        if ratio in (100.0, 1000.0):
            assert 0.99 <= own / (ratio * SPIN / found[0, 0]) <= 1.2
            low, high = {100.0: (0.01, 0.03), 1000.0: (0.11, 0.25)}[ratio]
            assert low <= own <= high


def test_a_reflected_rotor_on_the_ground_is_exact():
    """So it is where its axis keeps its direction and its parent does not turn about it."""
    axes = ((0, 0, 1), (0, 1, 0))
    q, qd, tau = np.array([0.3, -0.7]), np.array([1.1, 0.0]), np.array([0.5, -0.2])
    rotor = spo.Rotor(SPIN, 50.0, model="reflected")
    hinge = spo.Hinge("revolute", -1, 0, axis=(0, 0, 1), rotor=rotor)
    ground = spo.Scene([zoo.random_body(np.random.default_rng(0))], [hinge])
    for scene, state in ((ground, (q[:1], qd[:1], tau[:1])), (geared.arm(50.0, SPIN, "reflected", axes), (q, qd, tau))):
        wanted = geared.DenseTwin(scene, state[0]).forward_dynamics(*state[1:])
        np.testing.assert_allclose(Dense(scene, state[0]).forward_dynamics(*state[1:]), wanted, rtol=EXACT)


# -- what is refused ---------------------------------------------------------------------------------------------------
AXIS = dict(axis=(0, 0, 1))
ROUND = np.diag([2.0, 2.0, 1.0])


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: spo.Rotor(1.0, 10.0, model="exact"), "model is 'exact'; expected one of full, reduced, reflected"),
        (lambda: spo.Rotor(-1.0, 10.0), "expected zero or more"),
        (lambda: spo.Rotor(1.0, np.inf), "expected finite numbers"),
        (lambda: spo.Rotor(np.eye(2), 10.0), "expected (3, 3)"),
        (lambda: spo.Rotor(1.0, 10.0, axis=(0, 0, 2)), "expected unit length"),
        (lambda: spo.Rotor(spo.Body(1.0, gravcomp=1.0), 10.0), "expected a rigid one without"),
        (lambda: spo.Rotor(ROUND, 10.0, model="reflected"), "knows the moment of inertia about the axis alone"),
        (lambda: spo.Hinge("ball", -1, 0, rotor=spo.Rotor(1.0, 2.0)), "a ball hinge here has another number"),
        (lambda: spo.Hinge("fixed", -1, 0, rotor=spo.Rotor(1.0, 2.0)), "a fixed hinge here has another number"),
        (lambda: spo.Hinge("revolute", -1, 0, axis=(0, 1, 0), rotor=spo.Rotor(ROUND, 2.0)), "not symmetric about"),
    ],
)
def test_what_makes_no_sense_is_refused(make, expected):
    with pytest.raises(ValueError, match=r"Rotor|Hinge") as error:
        make()
    assert expected in str(error.value)


def test_something_else_than_a_rotor_is_refused():
    with pytest.raises(TypeError, match="rotor is of type float; expected a Rotor"):
        spo.Hinge("revolute", -1, 0, **AXIS, rotor=1e-4)


# -- full and reduced --------------------------------------------------------------------------------------------------
WORLDS = 2
DIFFERENCES = 1e-9  # what differences of order 8 leave
EXACT_MODELS = ("full", "reduced")


def close(got, wanted, tolerance=EXACT):
    assert laws.error(np.asarray(got), np.asarray(wanted)) <= tolerance, laws.error(np.asarray(got), np.asarray(wanted))


@functools.cache
def tree(model):
    return geared.geared_tree(model)


def run(model, name, a, given, shape, **options):
    return np.nan_to_num(symbolic.run(tree(model), name, a, given.split(), {"out": shape}, **options)["out"])


def test_the_reference_equals_rotors_that_are_bodies():
    a = laws.states(tree("full"), WORLDS)
    for q, qd, qdd, tau in zip(*(a[name] for name in ("q", "qd", "qdd", "tau")), strict=True):
        found, twin = Dense(tree("full"), q), geared.DenseTwin(tree("full"), q)
        close(found.mass_matrix, twin.mass_matrix)
        close(found.inverse_dynamics(qd, qdd), twin.inverse_dynamics(qd, qdd))
        close(found.forward_dynamics(qd, tau), twin.forward_dynamics(qd, tau))


@pytest.mark.parametrize("model", EXACT_MODELS)
@pytest.mark.parametrize(
    ("name", "given", "shape", "wanted"),
    [
        ("forward_dynamics", "q qd tau body_f", "n", lambda d, s: d.forward_dynamics(s["qd"], s["tau"], s["body_f"])),
        ("inverse_dynamics", "q qd qdd body_f", "n", lambda d, s: d.inverse_dynamics(s["qd"], s["qdd"], s["body_f"])),
        ("mass_matrix", "q", "nn", lambda d, s: d.mass_matrix),
        ("mass_matrix_inverse", "q", "nn", lambda d, s: np.linalg.inv(d.mass_matrix)),
        ("log_det_mass_matrix", "q", "", lambda d, s: d.log_det),
        ("com", "q", "3", lambda d, s: d.center_of_mass),
        ("centroidal_momentum_matrix", "q", "6n", lambda d, s: d.centroidal_momentum_matrix),
        ("centroidal_momentum_bias", "q qd", "6", lambda d, s: d.centroidal_momentum_bias(s["qd"])),
        ("potential_energy", "q", "", lambda d, s: d.potential_energy),
        ("kinetic_energy", "q qd", "", lambda d, s: 0.5 * s["qd"] @ d.mass_matrix @ s["qd"]),
    ],
)
def test_every_trace_equals_the_dense_reference(model, name, given, shape, wanted):
    scene = tree(model)
    a, n = laws.states(scene, WORLDS), scene.dof_count
    found = run(model, name, a, given, tuple(n if c == "n" else int(c) for c in shape))
    for w in range(WORLDS):
        close(found[w], wanted(Dense(scene, a["q"][w]), {key: x[w] for key, x in a.items()}))


@pytest.mark.parametrize("name", slow_unless(QUICK, SAME))
def test_full_and_reduced_rotors_agree(name):
    scene, (given, results, options) = tree("full"), SAME[name]
    sized, a = shapes(scene), more_states(scene)
    wide = {"jacobian_vjp": "f6n", "body_poses_vjp": "b7", "integrate_vjp": "c"}.get(name, "n")
    a["cotangent"] = np.random.default_rng(9).normal(size=(len(a["q"]), *sized(wide)))
    wanted, found = (
        symbolic.run(tree(m), name, a, given.split(), {k: sized(x) for k, x in results.items()}, **options)
        for m in EXACT_MODELS
    )
    for result in results:
        close(np.nan_to_num(found[result]), np.nan_to_num(wanted[result]))


@pytest.mark.parametrize("model", EXACT_MODELS)
def test_rotors_equal_bodies_that_couplings_tie(model):
    scene = tree(model)
    twin, a, n = geared.with_bodies(scene), laws.states(scene, WORLDS), scene.dof_count
    turns = np.einsum("ij,wj->wi", geared.columns(scene)[n:], a["qd"])
    at = np.stack(
        [[h.rotor.ratio * q[scene.q_start[i]] for i, h in enumerate(scene.hinges) if h.rotor] for q in a["q"]]
    )
    wide = {"q": np.concatenate([a["q"], at], 1), "qd": np.concatenate([a["qd"], turns], 1)}
    wide["tau"] = np.concatenate([a["tau"], 0.0 * turns], 1)
    how = embedding(twin, range(n))
    found = symbolic.run(twin, "embedded_forward_dynamics", wide, ["q", "qd", "tau"],
                         {"out": (twin.dof_count,)}, embedding=how)["out"][:, :n]  # fmt: skip
    close(run(model, "forward_dynamics", a, "q qd tau", (n,)), found, AGREE)


def skew_arm():
    return geared.arm(30.0, np.diag([2e-4, 1e-4, 2e-4]), "reduced", axes=((0.6, 0, 0.8), (0, 1, 0)))


@pytest.mark.parametrize("scene", [skew_arm, pytest.param(lambda: tree("full"), marks=pytest.mark.slow)])
def test_derivatives_equal_central_differences(scene):
    scene = scene()
    a, n = laws.states(scene, 1), scene.dof_count
    run = lambda name, given, shape: symbolic.run(scene, name, a, given.split(), {"out": shape})["out"][0]  # noqa: E731
    found, slopes = (
        run("inverse_dynamics_derivatives", "q qd qdd", (3, n, n)),
        run("mass_matrix_derivative", "q", (n,) * 3),
    )
    found, slopes = np.nan_to_num(found), np.nan_to_num(slopes)
    dense, (qd, qdd) = Dense(scene, a["q"][0]), (a[name][0] for name in ("qd", "qdd"))
    along = lambda unit, h: n if unit is None else Dense(scene, dense.integrate(unit, h))  # noqa: E731
    close(found[0], difference(lambda d: d.inverse_dynamics(qd, qdd), along), DIFFERENCES)
    rates = lambda unit, h: n if unit is None else qd + h * unit  # noqa: E731
    close(found[1], difference(lambda qd: dense.inverse_dynamics(qd, qdd), rates), DIFFERENCES)
    close(slopes, difference(lambda d: d.mass_matrix, along), DIFFERENCES)


@pytest.mark.parametrize("model", ["reduced", pytest.param("full", marks=pytest.mark.slow)])
def test_a_step_equals_the_dense_nonlinear_equation(model):
    scene = furnished(tree(model))
    a = step_states(scene, 2)
    q, qd, _ = symbolic.advance(scene, a, H)
    wanted = implicit.step(scene, 0, H, *(a[name][0] for name in ("q", "qd", *FORCES)))
    close(q[0], wanted[0], AGREE)
    close(qd[0], wanted[1], AGREE)


# -- as users call it --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("model", EXACT_MODELS)
def test_operators_are_those_of_geared_hinges(model, device):
    """The recursion of theory 2.13 B, by hand: D = H P H* + ratio^2 J, K D = phi P H* + ratio phi J u."""
    scene = geared.arm(30.0, SPIN, model, axes=((0, 0, 1), (0.6, 0.0, 0.8)))
    rotor, q = scene.hinges[1].rotor, np.array([[0.3, -0.7]])
    plain = Dense(spo.Scene(scene.bodies, [dataclasses.replace(h, rotor=None) for h in scene.hinges]), q[0])
    phi, H, M = plain.E_phi[:6, 6:], plain.H, plain.M
    D2 = H[1, 6:] @ M[6:, 6:] @ H[1, 6:] + 0.01 + rotor.ratio**2 * SPIN
    u = np.array([*rotor.axis, 0.0, 0.0, 0.0])  # of the couple J u, in the axes of the first node
    KD = phi @ M[6:, 6:] @ H[1, 6:] + rotor.ratio * SPIN * u
    P1 = M[:6, :6] + SPIN * np.outer(u, u) + phi @ M[6:, 6:] @ phi.T - np.outer(KD, KD) / D2
    dyn = spo.Dynamics(scene, 1, device, "float64")
    ops = dyn.operators(q)
    assert scene.node_sizes == (6, {"full": 12, "reduced": 7}[model])
    close(np.diag(np.asarray(ops.D.dense())[0]), [H[0, :6] @ P1 @ H[0, :6] + 0.01, D2])
    mass = ops.H @ ops.phi @ ops.M @ ops.phi.T @ ops.H.T + ops.Delta
    close(np.asarray(mass.dense())[0], Dense(scene, q[0]).mass_matrix)


@pytest.mark.parametrize("name", laws.OPERATIONS)
@pytest.mark.parametrize("model", EXACT_MODELS)
@pytest.mark.slow
def test_every_operation_equals_the_dense_reference(name, model, device):
    dyn = spo.Dynamics(tree(model), WORLDS, device=device, dtype="float64")
    laws.equals_reference(dyn, name, laws.states(tree(model), WORLDS), laws.TOLERANCE["float64"])


def test_variable_values_granularities_and_pickles(device):
    scene = pickle.loads(pickle.dumps(geared.arm(30.0, SPIN, "reduced")))
    dyn = spo.Dynamics(scene, WORLDS, device, "float64", variable=("body_mass", "joint_armature"))
    mass, armature = np.array([[0.4, 0.6], [0.7, 0.2]]), np.array([[0.1, 0.2], [0.3, 0.4]])
    dyn.set(body_mass=mass, joint_armature=armature)
    a, other = laws.states(scene, WORLDS), scene.with_values(body_mass=mass, joint_armature=armature)
    found = dyn.forward_dynamics(a["q"], a["qd"], a["tau"])
    for w in range(WORLDS):
        close(found[w], Dense(other, a["q"][w], world=w).forward_dynamics(a["qd"][w], a["tau"][w]))
    assert "links share dofs" in dyn.explain()
    for granularity in ("node", "segment"):
        with pytest.raises(spo.UnsupportedError, match="rotors"):
            spo.Dynamics(scene, 1, device, granularity=granularity)


@pytest.mark.parametrize("model", EXACT_MODELS)
def test_a_rotor_in_a_closed_loop_equals_a_body_that_a_coupling_ties(model):
    plain = fourbar.scene()
    hinges = list(plain.hinges)
    hinges[1] = dataclasses.replace(hinges[1], rotor=spo.Rotor(SPIN, 30.0, model=model))
    scene = spo.Scene(plain.bodies, hinges, loops=plain.loops)
    twin = geared.with_bodies(scene)
    twin = spo.Scene(twin.bodies, twin.hinges, loops=plain.loops, couplings=twin.couplings)
    q = spo.Dynamics(plain, 1, "cpu", "float64", loops="embed").project(np.array([[0.3, -1.1, 2.0]]), iterations=20)
    a = {"q": q, "qd": np.array([[0.4, -0.3, 0.2]]), "tau": np.array([[0.5, -0.2, 0.1]])}
    found = symbolic.run(scene, "embedded_forward_dynamics", a, ["q", "qd", "tau"], {"out": (3,)},
                         embedding=embedding(scene))["out"]  # fmt: skip
    wide = {name: np.append(x, [[0.0 if name == "tau" else 30.0 * x[0, 1]]], axis=1) for name, x in a.items()}
    wanted = symbolic.run(twin, "embedded_forward_dynamics", wide, ["q", "qd", "tau"],
                          {"out": (4,)}, embedding=embedding(twin))["out"]  # fmt: skip
    close(found, wanted[:, :3], AGREE)


@pytest.mark.slow
@pytest.mark.parametrize("model", EXACT_MODELS)
def test_every_declared_operation_equals_the_reference_or_is_refused_by_name(model, device):
    scene = geared.arm(30.0, SPIN, model, axes=((0, 0, 1), (0.6, 0.0, 0.8)), flexible=(50.0, 0.5))
    subject, refused = Subject(spo.Dynamics(scene, WORLDS, device, "float64"), [Inputs(scene, WORLDS)]), []
    for declared in (d for d in DECLARED.values() if d.trial is not None):
        try:
            assert TrialRun(subject, trial_case(declared)).check() <= 1e-11, declared.name
        except spo.UnsupportedError as error:
            assert "rotors" in str(error)
            refused.append(declared.name)
    assert all(name.startswith("inverse_dynamics_regressor") for name in refused)


@pytest.mark.slow
@pytest.mark.parametrize("model", [*EXACT_MODELS, "reflected"])
def test_gradients_of_a_step_by_values_equal_differences(model, device):
    scene = geared.arm(30.0, SPIN, model, axes=((0, 0, 1), (0.6, 0.0, 0.8)), flexible=(50.0, 0.5))
    names = ("body_mass", "joint_stiffness", "joint_damping", "joint_armature")
    dyn = spo.Dynamics(scene, 1, device, "float64", variable=names)
    a, place = laws.states(scene, 1), wp.device_to_torch(dyn.device)
    q, qd, tau = (torch.as_tensor(a[name], device=place) for name in ("q", "qd", "tau"))

    def loss(values):
        dyn.set(**values)
        after, rate = dyn.step(q.clone(), qd.clone(), tau, 0.01)
        return (after.sin() + rate).sum()

    values = {name: torch.tensor(scene.values[name], device=place, requires_grad=True) for name in names}
    loss(values).backward()
    for name, value in values.items():
        for i in np.ndindex(*value.shape):
            ends = []
            for h in (1e-5, -1e-5):
                moved = {key: x.detach().clone() for key, x in values.items()}
                moved[name][i] += h
                ends.append(float(loss(moved)))
            assert abs((ends[0] - ends[1]) / 2e-5 - float(value.grad[i])) <= 1e-6 * max(1.0, abs(float(value.grad[i])))


def on_a_flexible_body(model):
    """A body with two bending modes on a turn; at its tip a body with a rotor on the flexible one."""
    rng = np.random.default_rng(3)
    momenta, slopes = np.zeros((2, 6, 2))
    momenta[4, 0], momenta[5, 1], momenta[2, 0], momenta[1, 1] = 0.3, 0.3, 0.2, -0.2
    slopes[4, 0], slopes[5, 1], slopes[2, 0], slopes[1, 1] = 1.0, 1.0, 1.2, -1.2
    modes = spo.Modes(np.eye(2), (50.0, 80.0), None, momenta, slopes={1: slopes})
    root = spo.Body(1.0, (0.5, 0.0, 0.0), np.diag([0.02, 0.1, 0.1]), modes=modes)
    axis, u = zoo.unit(rng, 2, 3)
    rotor = spo.Rotor(geared.round_body(rng, u), 20.0, u, model)
    tip = spo.Hinge("revolute", 0, 1, axis=axis, parent_pose=(1.0, 0, 0, 0, 0, 0, 1), rotor=rotor)
    return spo.Scene([root, zoo.random_body(rng)], [spo.Hinge("revolute", -1, 0, **AXIS), tip])


@pytest.mark.slow
def test_rotors_on_flexible_bodies_agree_with_each_other_and_with_the_operators(device):
    found = []
    for model in EXACT_MODELS:
        scene = on_a_flexible_body(model)
        a, n = laws.states(scene, WORLDS), scene.dof_count
        mass = symbolic.run(scene, "mass_matrix", a, ["q"], {"out": (n, n)})["out"]
        found.append((mass, symbolic.run(scene, "forward_dynamics", a, ["q", "qd", "tau"], {"out": (n,)})["out"]))
        assert scene.node_sizes == (8, {"full": 12, "reduced": 7}[model])
        ops = spo.Dynamics(scene, WORLDS, device, "float64").operators(a["q"])
        close(np.asarray((ops.H @ ops.phi @ ops.M @ ops.phi.T @ ops.H.T + ops.Delta).dense()), mass)
    for full, reduced in zip(*found, strict=True):
        close(reduced, full)
