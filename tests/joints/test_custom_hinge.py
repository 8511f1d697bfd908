"""Hinges whose pose is the user's function: closed forms, the dense reference, built-in hinges, and what is refused."""

import dataclasses
import functools

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import custom_hinges, implicit, laws, symbolic, zoo
from support.custom_hinges import RADIUS
from support.hinge_twins import AGREE, QUICK, SAME, WORLDS, difference, more_states, shapes, states
from support.quick import slow_unless
from support.step_scenes import FORCES, H, furnished
from support.step_scenes import states as step_states
from warp_spo.dynamics.loop_analysis import embedding
from warp_spo.examples import fourbar
from warp_spo.recursions.model.links import Links
from warp_spo.reference.dense import Dense
from warp_spo.trace.evaluation import evaluate

EXACT = 1e-13  # closed forms in float64, of one body
DIFFERENCES = 1e-9  # what differences of order 8 leave; third derivatives of a pose, and conditioning


def run(scene, operation, a, given, shapes, **options):
    found = symbolic.run(scene, operation, a, given.split(), shapes, **options)
    return {name: np.nan_to_num(value) for name, value in found.items()}  # entries of other trees


def close(got, wanted, tolerance):
    assert laws.error(np.asarray(got), np.asarray(wanted)) <= tolerance, laws.error(np.asarray(got), np.asarray(wanted))


# -- closed forms ------------------------------------------------------------------------------------------------------
def rolling(mass=2.0, com=(0.03, -0.2, 0.0), inertia=0.05, gravity=9.81):
    """A condyle on a plane with gravity along -y, and its M, dM/dq and potential's slope by q."""
    body = spo.Body(mass, com, np.diag([0.1, 0.1, inertia]))
    hinge = spo.Hinge.custom(-1, 0, coordinates=1, pose=custom_hinges.rolling_knee)
    (x, y, _), r = com, RADIUS

    def mass_matrix(q):
        return inertia + mass * (r**2 + x**2 + y**2 + 2.0 * r * (np.sin(q) * x + np.cos(q) * y))

    def slope(q):
        return 2.0 * mass * r * (np.cos(q) * x - np.sin(q) * y)

    def pull(q):
        return mass * gravity * (np.cos(q) * x - np.sin(q) * y)

    return spo.Scene([body], [hinge], gravity=(0.0, -gravity, 0.0)), mass_matrix, slope, pull


def test_a_rolling_knee_equals_its_closed_form():
    scene, mass_matrix, slope, pull = rolling()
    a = states(scene)
    q, qd, qdd, tau = (a[name] for name in ("q", "qd", "qdd", "tau"))
    out = {"out": (1,)}
    wanted = mass_matrix(q) * qdd + 0.5 * slope(q) * qd**2 + pull(q)
    close(run(scene, "inverse_dynamics", a, "q qd qdd", out)["out"], wanted, EXACT)
    wanted = (tau - 0.5 * slope(q) * qd**2 - pull(q)) / mass_matrix(q)
    close(run(scene, "forward_dynamics", a, "q qd tau", out)["out"], wanted, EXACT)
    close(run(scene, "mass_matrix", a, "q", {"out": (1, 1)})["out"][:, 0], mass_matrix(q), EXACT)
    close(run(scene, "mass_matrix_derivative", a, "q", {"out": (1, 1, 1)})["out"][:, 0, 0], slope(q), EXACT)


def test_a_rolling_knee_has_the_columns_of_its_closed_form():
    """omega = z, v = R* (-r, 0, 0); its velocity is constant in the parent, so that R* p'' = 0 and v' = -omega x v."""
    scene, *_ = rolling()
    link = Links(scene).links[0]
    place = link.hinge.transform(link, lambda i: link_input(link, i))
    ((w, v),) = link.hinge.columns(place)
    rates = [link_input(link, 1)]
    bias = link.hinge.own_bias(place, rates)
    ((change,),) = link.hinge.column_changes(place)
    q, qd = 0.7, -1.3
    values = evaluate([*w, *v, *bias[0], *bias[1], *change[0], *change[1]], lambda name, at: (q, qd)[at[0]])
    found = np.array([float(x) for x in values]).reshape(6, 3)
    column = -RADIUS * np.array([np.cos(q), -np.sin(q), 0.0])
    rate = -RADIUS * np.array([-np.sin(q), -np.cos(q), 0.0])
    np.testing.assert_allclose(found, [[0, 0, 1], column, [0] * 3, [0] * 3, [0] * 3, rate], atol=EXACT)


@functools.cache
def graph_of(link):
    from warp_spo.trace.scalars import Graph

    return Graph()


def link_input(link, i):
    return graph_of(link).input("x", i)


def test_a_spline_knee_has_the_columns_of_central_differences():
    body = zoo.random_body(np.random.default_rng(3))
    scene = spo.Scene([body], [spo.Hinge.custom(-1, 0, coordinates=1, pose=custom_hinges.spline_knee)])
    frame, h = ((0, (0.1, 0.2, 0.3)),), 1e-5
    point = np.array([0.1, 0.2, 0.3])

    def at(q):
        position, R = (np.array(x, dtype=float) for x in custom_hinges.spline_knee([q]))
        return position + R @ point, R

    for q in (-1.9, -0.65, 0.1, 0.4, 1.2, 1.8):
        J = run(scene, "jacobian", {"q": np.array([[q]])}, "q", {"out": (1, 6, 1)}, frames=frame)["out"][0, 0, :, 0]
        (ahead, R_ahead), (behind, R_behind) = at(q + h), at(q - h)
        turn = (R_ahead - R_behind) / (2.0 * h) @ at(q)[1].T
        np.testing.assert_allclose(J[:3], (ahead - behind) / (2.0 * h), atol=1e-8)
        np.testing.assert_allclose(J[3:], (turn[2, 1], turn[0, 2], turn[1, 0]), atol=1e-8)
        bias = run(scene, "jacobian_bias", {"q": np.array([[q]]), "qd": np.array([[2.0]])}, "q qd", {"out": (1, 6)},
                   frames=frame)["out"][0, 0]  # fmt: skip
        np.testing.assert_allclose(bias[:3], 4.0 * (ahead - 2.0 * at(q)[0] + behind) / h**2, atol=1e-4)


# -- the dense reference, which differentiates by jets -----------------------------------------------------------------
@pytest.mark.parametrize("name", laws.OPERATIONS)
@pytest.mark.parametrize(
    ("granularity", "dtype"),
    [
        ("node", "float64"),
        ("tree", "float32"),
        *(
            pytest.param(granularity, dtype, marks=pytest.mark.slow)
            for granularity in ("node", "segment", "tree")
            for dtype in ("float32", "float64")
            if (granularity, dtype) not in (("node", "float64"), ("tree", "float32"))
        ),
    ],
)
def test_every_operation_equals_the_dense_reference(name, granularity, dtype, device):
    if (granularity, dtype) == ("tree", "float32") and name not in ("forward_dynamics", "body_poses", "integrate"):
        pytest.skip("compiles a kernel each; among the slow ones")
    scene = custom_hinges.skeleton()
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype=dtype, granularity=granularity)
    laws.equals_reference(dyn, name, laws.states(scene, WORLDS, dtype=dtype), laws.TOLERANCE[dtype])


TRACED = {  # arrays, shape of one world, the reference
    "forward_dynamics_bias_first": (
        "q qd tau body_f", "n", lambda d, s: d.forward_dynamics(s["qd"], s["tau"], s["body_f"])
    ),
    "quasi_velocities": ("q qd", "n", lambda d, s: d.quasi_velocities(s["qd"])),
    "com_jacobian": ("q", "3n", lambda d, s: d.com_jacobian),
    "centroidal_momentum_matrix": ("q", "6n", lambda d, s: d.centroidal_momentum_matrix),
    "centroidal_momentum_bias": ("q qd", "6", lambda d, s: d.centroidal_momentum_bias(s["qd"])),
    "log_det_mass_matrix_gradient": ("q", "n", lambda d, s: d.log_det_gradient),
}  # fmt: skip


@pytest.mark.parametrize("name", slow_unless([n for n in TRACED if n != "log_det_mass_matrix_gradient"], TRACED))
def test_every_trace_equals_the_dense_reference(name):
    scene = custom_hinges.skeleton(names=("rolling_knee", "ellipsoid_shoulder", "many_functions"))
    a, (given, shape, reference) = states(scene), TRACED[name]
    shape = tuple(scene.dof_count if c == "n" else int(c) for c in shape)
    found = run(scene, name, a, given, {"out": shape})["out"]
    wanted = [reference(Dense(scene, a["q"][w]), {key: x[w] for key, x in a.items()}) for w in range(WORLDS)]
    if name == "quasi_velocities":  # up to the sign, and to the order of a hinge's dofs
        found, wanted = (found**2).sum(1), (np.array(wanted) ** 2).sum(1)
    close(found, wanted, DIFFERENCES)


def test_derivatives_equal_central_differences():
    scene = custom_hinges.skeleton(names=("ellipsoid_shoulder", "many_functions"))
    a, n = states(scene), scene.dof_count
    found = run(scene, "inverse_dynamics_derivatives", a, "q qd qdd body_f", {"out": (3, n, n)})["out"]
    changes = run(scene, "mass_matrix_derivative", a, "q", {"out": (n, n, n)})["out"]
    a["cotangent"] = np.random.default_rng(5).normal(size=(WORLDS, n))
    wrt = ("tangent", "qd")
    pulled = run(scene, "inverse_dynamics_vjp", a, "q qd qdd body_f cotangent", {"out": (n,), "qd_bar": (n,)}, wrt=wrt)
    directions = {f"{key}_dot": np.random.default_rng(6).normal(size=(WORLDS, n)) for key in ("q", "qd")}
    pushed = run(scene, "inverse_dynamics_jvp", a | directions, "q qd qdd body_f q_dot qd_dot", {"out": (n,)})["out"]
    for w in range(1):  # the reference takes a second a column
        dense = Dense(scene, a["q"][w])
        along_q = lambda unit, h, dense=dense: n if unit is None else Dense(scene, dense.integrate(unit, h))  # noqa: E731
        along_qd = lambda unit, h, w=w: n if unit is None else a["qd"][w] + h * unit  # noqa: E731
        force = lambda d, w=w: d.inverse_dynamics(a["qd"][w], a["qdd"][w], a["body_f"][w])  # noqa: E731
        by_q = difference(force, along_q)
        by_qd = difference(lambda qd, d=dense, w=w: d.inverse_dynamics(qd, a["qdd"][w], a["body_f"][w]), along_qd)
        close(found[w, 0], by_q, DIFFERENCES)
        close(found[w, 1], by_qd, DIFFERENCES)
        close(found[w, 2], dense.mass_matrix, AGREE)
        close(changes[w], difference(lambda d: d.mass_matrix, along_q), DIFFERENCES)
        close(pulled["out"][w], a["cotangent"][w] @ by_q, DIFFERENCES)
        close(pulled["qd_bar"][w], a["cotangent"][w] @ by_qd, DIFFERENCES)
        close(pushed[w], by_q @ directions["q_dot"][w] + by_qd @ directions["qd_dot"][w], DIFFERENCES)


# -- built-in hinges written as functions ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", slow_unless(QUICK, SAME))
def test_equals_built_in_hinges(name):
    scene, twin = custom_hinges.twins()
    given, results, options = SAME[name]
    sized, a = shapes(scene), more_states(scene)
    wide = {"jacobian_vjp": "f6n", "body_poses_vjp": "b7", "integrate_vjp": "c"}.get(name, "n")
    a["cotangent"] = np.random.default_rng(9).normal(size=(WORLDS, *sized(wide)))
    if name == "body_poses_vjp":
        a["cotangent"][..., 3:] = 0.0  # a quaternion and its negative are one rotation
    wanted, found = (
        run(s, name, a, given, {k: sized(x) for k, x in results.items()}, **options) for s in (scene, twin)
    )
    for result in results:
        close(found[result], wanted[result], AGREE)


def test_body_poses_equal_those_of_built_in_hinges():
    scene, twin = custom_hinges.twins()
    a = states(scene)
    wanted, found = (run(s, "body_poses", a, "q", {"out": (scene.body_count, 7)})["out"] for s in (scene, twin))
    for w in range(WORLDS):
        close(laws.same_quaternion_sign("body_poses", scene, found[w], wanted[w]), wanted[w], AGREE)


@pytest.mark.parametrize("letters", slow_unless(["phi", "psi", "G"], ["phi", "H", "psi", "D_inverse", "G", "P"]))
def test_operators_equal_those_of_built_in_hinges(letters):
    scene, twin = custom_hinges.twins()
    a = {"q": states(scene)["q"]}
    expression = ("resolvent", f"E_{letters}") if letters in ("phi", "psi") else letters
    for transposed in (False, True):
        form = ("transpose", expression) if transposed else expression
        rows, columns = ({"H": "hb", "G": "bh", "D_inverse": "hh"}.get(letters, "bb"))[:: -1 if transposed else 1]
        size = {"h": scene.dof_count, "b": 6 * scene.body_count}
        a["x"] = np.random.default_rng(1).normal(size=(WORLDS, size[columns]))
        out = {"out": (size[rows],)}
        wanted, found = (run(s, "expression", a, "q x", out, expression=form)["out"] for s in (scene, twin))
        close(found, wanted, AGREE)


def test_a_step_with_springs_drives_limits_and_friction_equals_that_of_built_in_hinges():
    scene, _ = custom_hinges.twins()
    laws_of = dict(friction=0.3, target_ke=4.0, target_kd=0.2, limit_lower=-0.8, limit_upper=0.8, effort_limit=3.0)
    hinges = [h if h.quaternions else dataclasses.replace(h, **laws_of) for h in scene.hinges]
    scene = spo.Scene(scene.bodies, hinges)
    twin = spo.Scene(scene.bodies, [h if h.quaternions else custom_hinges.written_out(h) for h in hinges])
    a = {name: states(scene)[name] for name in ("q", "qd", "tau")}
    (q, qd, _), (q_twin, qd_twin, _) = (symbolic.advance(s, a, 0.01) for s in (scene, twin))
    close(q_twin, q, AGREE)
    close(qd_twin, qd, AGREE)


def test_a_step_equals_the_dense_nonlinear_equation():
    scene = furnished(custom_hinges.skeleton(names=("rolling_knee", "ellipsoid_shoulder")))
    a = step_states(scene, 2)
    q, qd, _ = symbolic.advance(scene, a, H)
    for w in range(2):
        wanted = implicit.step(scene, w, H, *(a[name][w] for name in ("q", "qd", *FORCES)))
        close(q[w], wanted[0], AGREE)
        close(qd[w], wanted[1], AGREE)


def test_a_closed_loop_of_custom_hinges_equals_that_of_built_in_ones():
    scene = fourbar.scene()
    hinges = [custom_hinges.written_out(hinge) for hinge in scene.hinges]
    twin = spo.Scene(scene.bodies, hinges, loops=scene.loops)
    a, q = states(scene), np.tile([0.3, -1.1, 2.0], (WORLDS, 1))
    a["q"] = q
    n, how = {"out": (scene.dof_count,)}, embedding(scene)
    assert embedding(twin).rows == how.rows and embedding(twin).dofs == how.dofs
    wanted = run(scene, "embedded_forward_dynamics", a, "q qd tau", n, embedding=how)["out"]
    close(run(twin, "embedded_forward_dynamics", a, "q qd tau", n, embedding=how)["out"], wanted, AGREE)
    a["cotangent"], back = a["tau"], {"out": (3,), "qd_bar": (3,)}
    name, given, wrt = "embedded_forward_dynamics_vjp", "q qd tau cotangent", ("q", "qd")
    wanted, found = (run(s, name, a, given, back, embedding=how, wrt=wrt) for s in (scene, twin))
    for result in back:
        close(found[result], wanted[result], AGREE)
    error = {"out": (5,)}
    close(run(twin, "closure_error", a, "q", error)["out"], run(scene, "closure_error", a, "q", error)["out"], AGREE)


# -- as users call it --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("granularity", ["node", pytest.param("tree", marks=pytest.mark.slow)])
def test_variable_parameters(granularity, device):
    scene = custom_hinges.skeleton(names=("spline_knee",))
    a, rng = laws.states(scene, WORLDS), np.random.default_rng(2)
    mass = rng.uniform(0.5, 2.0, (WORLDS, scene.body_count))
    pose = np.tile(scene.values["joint_X_p"], (WORLDS, 1, 1))
    pose[..., :3] += rng.uniform(-0.1, 0.1, (WORLDS, len(scene.hinges), 3))
    variable = ("body_mass", "joint_X_p")
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype="float64", variable=variable, granularity=granularity)
    dyn.set(body_mass=mass, joint_X_p=pose)
    found = laws.numpy_call(dyn, "forward_dynamics", a)
    other = scene.with_values(body_mass=mass, joint_X_p=pose)
    for w in range(WORLDS):
        close(
            found[w],
            Dense(other, a["q"][w], world=w).forward_dynamics(*(a[x][w] for x in ("qd", "tau", "body_f"))),
            AGREE,
        )


def three_angles(q):
    about = custom_hinges.about
    return np.zeros(3), about(2, q[0]) @ about(1, q[1]) @ about(2, q[2])


@pytest.mark.parametrize("granularity", ["node", "segment", "tree"])
def test_columns_that_lose_rank_raise_a_status(granularity, device):
    """A cam at its dead centre, and a shoulder of three angles in gimbal lock: those worlds alone."""
    cam = spo.Hinge.custom(-1, 0, coordinates=1, pose=lambda q: ((0.1 * np.cos(q[0]), 0.0, 0.0), np.eye(3)))
    angles = spo.Hinge.custom(-1, 0, coordinates=3, pose=three_angles)
    rng = np.random.default_rng(4)
    for hinge, lost in ((cam, [0.0]), (angles, [0.4, 0.0, -0.9])):
        scene = spo.Scene([zoo.random_body(rng)], [hinge])
        q = np.array([[0.5, 0.6, 0.7], lost + [0.0] * 2, [1.0, -0.8, 0.3]], dtype=object)
        q = np.array([row[: scene.dof_count] for row in q.tolist()], dtype=float)
        dyn = spo.Dynamics(scene, WORLDS, device=device, dtype="float64", granularity=granularity)
        status = wp.full(WORLDS, -1, dtype=wp.int32, device=device)
        out = dyn.forward_dynamics(q, 0.0 * q, 0.0 * q + 1.0, status=status)
        assert status.numpy().tolist() == [spo.Status.OK, spo.Status.PIVOT, spo.Status.OK]
        assert np.isfinite(out[[0, 2]]).all() and np.isnan(out[1]).any()
