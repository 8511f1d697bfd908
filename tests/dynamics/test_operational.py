"""Operational space, momentum, the determinant's gradient and quasi-velocities against independent formulas."""

import itertools

import numpy as np
import pinocchio as pin
import pytest
import warp as wp

import warp_spo as spo
from support import laws, oracles, robots, symbolic, zoo
from support.allocations import no_warp_allocation
from support.quick import slow_unless
from warp_spo.dynamics import quasi_velocities as quasi
from warp_spo.examples import estimation
from warp_spo.recursions import (
    articulated_sweeps,
    determinant,
    kinematics,
    momentum,
    newton_euler,
    operational,
    quasi_velocities,
)
from warp_spo.reference.dense import Dense
from warp_spo.trials.inputs import APPLICATIONS, Inputs
from warp_spo.trials.trial import Subject, TrialRun

WORLDS = 3
TOLERANCE = {"float64": 1e-12, "float32": 3e-5}  # cond(M) of the worst scene is 1e4
DIFFERENCES = 1e-10  # the gradient of log det, and C of quasi-velocities: rounding over a step of 0.01 or less
LARGE = ("tree20", "trees25", "screw_tree", "every_d6", "floating_tree", "star")  # seconds
SCENES = slow_unless([name for name in zoo.FEW if name not in LARGE], zoo.SCENES)

# name -> (arrays it takes after q, shape of the result, the reference's value for one world)
OPERATIONS = {
    "jacobian_bias": (("qd",), lambda s: (2, 6), lambda d, a: d.jacobian_bias(a["qd"], laws.frames_of(d.scene))),
    "frame_accelerations": (
        ("qd", "qdd"),
        lambda s: (2, 6),
        lambda d, a: d.jacobian(laws.frames_of(d.scene)) @ a["qdd"] + d.jacobian_bias(a["qd"], laws.frames_of(d.scene)),
    ),
    "operational_inertia_inverse_product": (
        ("x",),
        lambda s: (2, 6),
        lambda d, a: (d.operational_inertia_inverse(laws.frames_of(d.scene)) @ a["x"]).reshape(2, 6),
    ),
    "com_jacobian": ((), lambda s: (3, s.dof_count), lambda d, a: d.com_jacobian),
    "centroidal_momentum_matrix": ((), lambda s: (6, s.dof_count), lambda d, a: d.centroidal_momentum_matrix),
    "centroidal_momentum_bias": (("qd",), lambda s: (6,), lambda d, a: d.centroidal_momentum_bias(a["qd"])),
    "quasi_velocities": (("qd",), lambda s: (s.dof_count,), lambda d, a: d.quasi_velocities(a["qd"])),
    "generalized_velocities": (("nu",), lambda s: (s.dof_count,), lambda d, a: quasi.dense_velocities(d, a["nu"])),
    "quasi_velocity_force": (("tau",), lambda s: (s.dof_count,), lambda d, a: quasi.dense_force(d, a["tau"])),
    "quasi_velocity_coriolis": (("nu",), lambda s: (s.dof_count,), lambda d, a: quasi.dense_coriolis(d, a["nu"])),
    "log_det_mass_matrix_gradient": ((), lambda s: (s.dof_count,), lambda d, a: d.log_det_gradient),
    "mass_matrix_packed": ((), lambda s: (len(pattern(s)[0]),), lambda d, a: d.mass_matrix[pattern(d.scene)]),
    "mass_matrix_inverse_packed": (
        (),
        lambda s: (len(trees(s)[0]),),
        lambda d, a: np.linalg.inv(d.mass_matrix)[trees(d.scene)],
    ),
}


FRAMED = ("jacobian_bias", "frame_accelerations", "operational_inertia_inverse_product")


def states(scene, worlds, **more):
    """As in laws, quasi-velocities nu, and wrenches x on two frames."""
    known = laws.states(scene, worlds, **more)
    return known | {"nu": known["qdd"], "x": np.random.default_rng(5).normal(size=(worlds, 12))}


def pattern(scene):
    """Where a mass matrix may have entries: from the reference's Jacobians, whose columns say what a dof moves."""
    moves = np.array([J.any(axis=0) for J in Dense(scene, zoo.random_state(scene).q[0])._node_jacobian])
    return np.nonzero(np.tril((moves[:, :, None] & moves[:, None, :]).any(axis=0)))


def trees(scene):
    """Where its inverse may have some: dofs that the mass matrix ties, one after another."""
    met = np.zeros((scene.dof_count, scene.dof_count), dtype=int)
    met[pattern(scene)] = 1
    return np.nonzero(np.tril(np.linalg.matrix_power(met + met.T + np.eye(len(met), dtype=int) > 0, len(met))))


def where(scene):
    return tuple((f, (0.0, 0.0, 0.0)) if isinstance(f, int) else (f[0], f[1][:3]) for f in laws.frames_of(scene))


def traced(scene, operation, a, dtype="float64"):
    takes, shape, _ = OPERATIONS[operation]
    options = {"frames": where(scene)} if operation in FRAMED else {}
    return symbolic.run(scene, operation, a, ("q", *takes), {"out": shape(scene)}, dtype, **options)["out"]


def wanted(scene, operation, a):
    worlds = range(len(a["q"]))
    at = [{name: array[w] for name, array in a.items()} for w in worlds]
    return np.array([OPERATIONS[operation][2](Dense(scene, a["q"][w], world=w), at[w]) for w in worlds])


def traced_error(scene, operation, a):
    got, right = traced(scene, operation, a), wanted(scene, operation, a)
    if "velocit" in operation or operation.startswith("log_det") or "momentum" in operation:
        got, right = np.nan_to_num(got, nan=np.inf), right  # every entry is stored
    if operation in ("com_jacobian", "centroidal_momentum_matrix", "mass_matrix_packed"):
        got = np.nan_to_num(got)  # what is not stored is zero
    if operation == "quasi_velocity_coriolis":
        return laws.error(got, right) * (1e-12 / DIFFERENCES)
    if operation.startswith("log_det"):
        return np.abs(got - right).max(initial=0.0) / max(1.0, np.abs(right).max(initial=0.0)) * (1e-12 / DIFFERENCES)
    return laws.error(got, right) / (10.0 if "inverse" in operation else 1.0)  # cond(M)


@pytest.mark.parametrize("name", SCENES)
def test_equals_reference(name):
    scene = zoo.SCENES[name]()
    a = states(scene, WORLDS - 1)
    for operation in OPERATIONS:
        assert traced_error(scene, operation, a) <= TOLERANCE["float64"], operation


@pytest.mark.parametrize("armature", [0.0, 0.05])
def test_the_gradient_where_balls_are_eliminated_in_their_own_axes(armature):
    scene = zoo.forest()
    scene = scene.with_values(joint_armature=np.full(scene.dof_count, armature))
    for operation in ("log_det_mass_matrix_gradient", "quasi_velocities"):
        assert traced_error(scene, operation, states(scene, 2)) <= TOLERANCE["float64"]


# -- laws --------------------------------------------------------------------------------------------------------------
def test_biases_are_rates():
    """Of the reference's own Jacobian and momentum matrix along the motion, which finite differences see."""
    scene, h = zoo.SCENES["tree10"](), 1e-5
    q, qd, _ = zoo.random_state(scene)
    dense, frames = Dense(scene, q[0]), laws.frames_of(scene)
    ahead, behind = (Dense(scene, dense.integrate(qd[0], sign * h)) for sign in (1, -1))
    rate = (ahead.jacobian(frames) - behind.jacobian(frames)) @ qd[0] / (2 * h)
    assert laws.error(dense.jacobian_bias(qd[0], frames), rate) <= 1e-8
    rate = (ahead.centroidal_momentum_matrix - behind.centroidal_momentum_matrix) @ qd[0] / (2 * h)
    assert laws.error(dense.centroidal_momentum_bias(qd[0]), rate) <= 1e-8
    velocity = (ahead.center_of_mass - behind.center_of_mass) / (2 * h)
    assert laws.error(dense.com_jacobian @ qd[0], velocity) <= 1e-8


def test_quasi_velocities_are_the_kinetic_energy():
    scene = zoo.SCENES["floating_tree"]()
    a = states(scene, 2)
    nu = traced(scene, "quasi_velocities", a)
    for w in range(2):
        energy = a["qd"][w] @ Dense(scene, a["q"][w]).mass_matrix @ a["qd"][w]
        assert nu[w] @ nu[w] == pytest.approx(energy, rel=1e-13)


def test_the_mass_matrix_is_a_covariance():
    """Of what noise with the bodies' inertias does to the hinges; D is that of the filter's innovations (example)."""
    samples = 4000
    assert max(estimation.main(samples)) <= 5.0 / np.sqrt(samples)  # five standard deviations or so


def test_packed_matrices_are_the_full_ones(device):
    """A forest, one tree of which hangs on a body that stands still and carries two arms: what is left out is zero."""
    bodies = [spo.Body(1.0, (0.1, 0.2, 0.0), np.eye(3))] * 6
    parents, kinds = [-1, 0, 0, 1, -1, 4], ["fixed", "revolute", "prismatic", "universal", "ball", "revolute"]
    hinges = [
        spo.Hinge(
            kind,
            parent,
            body,
            **({} if kind in ("fixed", "ball") else dict(axis=np.eye(3)[:2] if kind == "universal" else (0, 1, 0))),
        )
        for body, (parent, kind) in enumerate(zip(parents, kinds, strict=True))
    ]
    scene = spo.Scene(bodies, hinges)
    dyn, q = spo.Dynamics(scene, 2, device=device, dtype="float64"), states(scene, 2)["q"]
    for packed, full, (rows, columns) in (
        (dyn.mass_matrix_packed, dyn.mass_matrix, dyn.mass_matrix_pattern),
        (dyn.mass_matrix_inverse_packed, dyn.mass_matrix_inverse, dyn.mass_matrix_inverse_pattern),
    ):
        wanted, found = full(q), np.zeros((2, 8, 8))
        found[:, rows, columns] = found[:, columns, rows] = packed(q)
        np.testing.assert_allclose(found, wanted, rtol=1e-13, atol=1e-13)
        assert len(rows) == 6 + 1 + 10


def test_a_root_hinge_does_not_change_the_determinant():
    scene = zoo.SCENES["fork"]().with_values(joint_armature=np.zeros(11))
    gradient = traced(scene, "log_det_mass_matrix_gradient", states(scene, 2))
    root = [hinge.kind for hinge in scene.hinges].index("free")
    dofs = slice(scene.qd_start[root], scene.qd_start[root + 1])
    np.testing.assert_array_equal(gradient[:, dofs], 0.0)
    assert np.abs(gradient).max() > 0.01


def test_momentum_far_from_the_origin():
    """10 km away, float32 keeps its digits: nothing is measured from there."""
    scene = zoo.SCENES["fork"]()
    a = states(scene, 2, dtype="float32")
    first = scene.q_start[[hinge.kind for hinge in scene.hinges].index("free")]
    a["q"][:, first : first + 3] += 8192.0  # a float32 number, and exactly that far
    a["q"] = a["q"].astype(np.float32).astype(np.float64)
    for operation in ("centroidal_momentum_matrix", "centroidal_momentum_bias"):
        got = np.nan_to_num(traced(scene, operation, a, "float32"))
        assert laws.error(got, wanted(scene, operation, a)) <= 3e-6


# -- Pinocchio ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", slow_unless(["tree10"], ["tree10", "floating_tree", "one_fixed_then_revolute"]))
def test_equals_pinocchio(name):
    scene = zoo.SCENES[name]()
    a = states(scene, 2)
    got = {operation: np.nan_to_num(traced(scene, operation, a)) for operation in OPERATIONS}
    oracle = oracles.PinocchioModel(scene)
    model = oracle.model
    added = []
    for body, origin in where(scene):
        pose = oracle.in_joint[body] * pin.SE3(np.eye(3), np.array(origin))
        added.append(model.addFrame(pin.Frame(f"frame {len(added)}", oracle.joint[body], pose, pin.FrameType.OP_FRAME)))
    data, axes = model.createData(), pin.LOCAL_WORLD_ALIGNED
    for w in range(2):
        q = oracle.q_of(a["q"][w])
        T, rate = oracle._maps(a["q"][w], a["qd"][w])
        pin.forwardKinematics(model, data, q, T @ a["qd"][w], rate)
        pin.updateFramePlacements(model, data)
        bias = [np.array(pin.getFrameClassicalAcceleration(model, data, frame, axes)) for frame in added]
        assert laws.error(got["jacobian_bias"][w], np.array(bias)) <= TOLERANCE["float64"]
        momenta = pin.computeCentroidalMap(model, data, q).reshape(6, -1) @ T
        assert laws.error(got["centroidal_momentum_matrix"][w], momenta) <= TOLERANCE["float64"]
        pin.computeCentroidalMomentumTimeVariation(model, data, q, T @ a["qd"][w], rate)
        assert laws.error(got["centroidal_momentum_bias"][w], np.array(data.dhg)) <= TOLERANCE["float64"]
        velocity = pin.jacobianCenterOfMass(model, data, q).reshape(3, -1) @ T
        assert laws.error(got["com_jacobian"][w], velocity) <= TOLERANCE["float64"]


# -- planted bugs ------------------------------------------------------------------------------------------------------
BUGS = {
    "jacobian_bias": (kinematics, "accelerations_of_frames", "+ trace.motions[id(link)].whirl @ arm", ""),
    "frame_accelerations": (kinematics, "accelerations_of_frames", "cross(w, arm)", "cross(arm, w)"),
    "operational_inertia_inverse_product": (operational, "wrenches_on_links", "cross(arm, f)", "cross(f, arm)"),
    "com_jacobian": (momentum, "center_of_mass", "mass = mass + body.mass", "mass = body.mass"),
    "centroidal_momentum_matrix": (momentum, "center_of_mass", " + origins[id(link)] * body.mass", ""),
    "centroidal_momentum_bias": (newton_euler, "body_force", "cross(motion.spin, in", "-cross(motion.spin, in"),
    "quasi_velocities": (quasi_velocities, "_scale", "V = V + pivot", "V = pivot"),
    "generalized_velocities": (quasi_velocities, "_unscale", "V = V + pivot", "V = pivot"),
    "quasi_velocity_force": (quasi_velocities, "_accelerate", "z = z + forces", "z = forces"),
    "quasi_velocity_coriolis": (
        quasi_velocities,
        "_change",
        "qd.__getitem__)\n    seeds",
        "lambda dof: 0.0)\n    seeds",
    ),
    "log_det_mass_matrix_gradient": (determinant, "upsilon", "dot(g, y) + pivot.inverse", "dot(g, y)"),
    "mass_matrix_packed": (articulated_sweeps, "pack", ">= item.index[1]", "<= item.index[1]"),
    "mass_matrix_inverse_packed": (articulated_sweeps, "pack", "sorted(entries)", "entries"),
}


@pytest.mark.parametrize("operation", OPERATIONS)
def test_a_planted_bug_is_seen(operation, monkeypatch):
    scene = zoo.SCENES["forest"]()
    a = states(scene, 2)
    symbolic.plant(monkeypatch, *BUGS[operation])
    assert traced_error(scene, operation, a) > 1e-4


# -- as users call them ------------------------------------------------------------------------------------------------
def call(dyn, operation, a, **more):
    frames = [laws.frames_of(dyn.scene)] if operation in FRAMED else []
    return getattr(dyn, operation)(a["q"], *[a[name] for name in OPERATIONS[operation][0]], *frames, **more)


@pytest.mark.parametrize("dtype", ["float64", pytest.param("float32", marks=pytest.mark.slow)])
def test_kernels_equal_the_reference(dtype, device):
    """Every value of the scene differs in every world; results are written entirely; a NaN stays in its world."""
    scene = zoo.varied(zoo.fork(), WORLDS)
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype=dtype)
    a = states(scene, WORLDS, dtype=dtype)
    on, spoiled = laws.to_device(dyn, a), {name: array.copy() for name, array in a.items()}
    spoiled["q"][1] = np.nan
    spoiled = laws.to_device(dyn, spoiled)
    for operation in OPERATIONS:
        first = call(dyn, operation, on)
        out = wp.full(first.shape, float("nan"), dtype=dyn.dtype, device=device)
        with no_warp_allocation():
            assert call(dyn, operation, on, out=out) is out
        np.testing.assert_array_equal(out.numpy(), first.numpy())
        tolerance = max(TOLERANCE[dtype], DIFFERENCES)
        assert laws.error(out.numpy(), wanted(scene, operation, a)) <= tolerance, operation
        call(dyn, operation, spoiled, out=out)
        np.testing.assert_array_equal(out.numpy()[[0, 2]], first.numpy()[[0, 2]])
        assert np.isnan(out.numpy()[1]).any()


@pytest.mark.parametrize("worlds", slow_unless([65], [1, 2, 65]))
def test_any_number_of_worlds(worlds, device):
    """Less than a warp, more than two: each world has the bits that it has alone; the last row is not the end."""
    scene = zoo.SCENES["tree10"]()
    a = states(scene, 65, dtype="float32")
    some, one = (spo.Dynamics(scene, count, device=device) for count in (worlds, 1))
    for operation in FRAMED:
        out = np.full((worlds, 2, 6), np.nan, dtype=np.float32)
        call(some, operation, {name: array[:worlds] for name, array in a.items()}, out=out)
        for w in {0, worlds // 2, worlds - 1}:
            alone = call(one, operation, {name: array[w : w + 1] for name, array in a.items()})
            np.testing.assert_array_equal(out[w], alone[0])
        right = wanted(scene, operation, {name: array[worlds - 1 : worlds] for name, array in a.items()})
        assert laws.error(out[-1:], right) <= TOLERANCE["float32"]


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("name", ["humanoid", "arm"])
def test_robots(name, dtype, device):
    """As the main job runs them, and the packed mass matrix and the gradient besides."""
    scene = robots.ROBOTS[name]()
    dyn = spo.Dynamics(scene, 256, device=device, dtype=dtype)
    for operation in APPLICATIONS.values():
        error = TrialRun(Subject(dyn, [Inputs(scene, 256)]), operation, sample=2).check()
        assert error <= (1e-4 if dtype == "float32" else 1e-10), operation.name
    q = states(scene, 256, dtype=dtype)["q"]
    dense = Dense(scene, q[7])
    assert laws.error(dyn.mass_matrix_packed(q)[7], dense.mass_matrix[dyn.mass_matrix_pattern]) <= TOLERANCE[dtype]
    np.testing.assert_allclose(dyn.fixman_torque(q), -0.5 * dyn.log_det_mass_matrix_gradient(q), rtol=1e-6)


def test_prepare_leaves_nothing_to_compile(device):
    dyn = spo.Dynamics(zoo.single_body("revolute"), 2, device=device)
    for operation in (*OPERATIONS, "fixman_torque", "hybrid_dynamics", "operational_inertia"):
        options = {"frames": [0]} if operation in (*FRAMED, "operational_inertia") else {}
        dyn.prepare(operation, **options)
    assert len(dyn.explain().splitlines()) >= 16


def test_a_scene_that_cannot_move(device):
    scene = spo.Scene([spo.Body(1.0)], [spo.Hinge("fixed", -1, 0)])
    dyn, nothing = spo.Dynamics(scene, 2, device=device), np.zeros((2, 0))
    assert dyn.com_jacobian(nothing).shape == (2, 3, 0)
    for operation in (dyn.mass_matrix_packed, dyn.mass_matrix_inverse_packed, dyn.fixman_torque):
        assert operation(nothing).shape == (2, 0)
    np.testing.assert_array_equal(dyn.jacobian_bias(nothing, nothing, [0]), np.zeros((2, 1, 6)))
    np.testing.assert_array_equal(dyn.centroidal_momentum_bias(nothing, nothing), np.zeros((2, 6)))
    assert np.isnan(dyn.operational_inertia(nothing, [0])).all()


# -- operational inertia -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("name", "dtype"),
    slow_unless(
        [("floating_tree", "float64"), ("chain7", "float32")],
        itertools.product(["tree20", "floating_tree", "chain7"], ["float64", "float32"]),
    ),
)
def test_operational_inertia(name, dtype, device):
    scene = zoo.SCENES[name]()
    frames = {"tree20": laws.frames_of(scene), "floating_tree": [0], "chain7": [6]}[name]
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype=dtype, granularity="node")
    q = laws.states(scene, WORLDS, dtype=dtype)["q"]
    got = dyn.operational_inertia(q, frames)
    np.testing.assert_array_equal(got, got.transpose(0, 2, 1))
    oracle = oracles.PinocchioModel(scene)
    for w in range(WORLDS):
        dense = Dense(scene, q[w])
        right, compliance = dense.operational_inertia(frames), dense.operational_inertia_inverse(frames)
        scale = np.sqrt(np.diag(compliance))
        tolerance = TOLERANCE[dtype] * np.linalg.cond(compliance / np.outer(scale, scale))
        assert laws.error(got[w], right) <= tolerance
        J = dense.jacobian(frames).reshape(-1, scene.dof_count)
        right = np.linalg.inv(J @ np.linalg.solve(oracle.mass_matrix(q[w]), J.T))
        assert laws.error(got[w], right) <= tolerance


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_singular_operational_inertia_is_nan(dtype, device):
    """Too few dofs, one frame twice, and the wrist of a gantry whose axes line up in one world."""
    for dofs in (1, 3, 5):
        for seed in range(4):
            scene = zoo.chain(dofs, seed=seed)
            dyn = spo.Dynamics(scene, 16, device=device, dtype=dtype, granularity="node")
            assert np.isnan(dyn.operational_inertia(laws.states(scene, 16)["q"], [dofs - 1])).all(), (dofs, seed)
    scene = zoo.SCENES["floating_tree"]()
    dyn = spo.Dynamics(scene, 16, device=device, dtype=dtype, granularity="node")
    last, pose = scene.body_count - 1, (0.3, -0.2, 0.1, 0.0, 0.0, 0.0, 1.0)
    assert np.isnan(dyn.operational_inertia(laws.states(scene, 16)["q"], [last, (last, pose)])).all()
    axes = np.eye(3)
    body = spo.Body(1.0, (0.1, 0.2, 0.3), np.diag([0.2, 0.3, 0.4]))
    hinges = [spo.Hinge("prismatic", k - 1, k, axis=axes[k]) for k in range(3)]
    hinges += [spo.Hinge("revolute", k - 1, k, axis=axes[j]) for k, j in ((3, 2), (4, 1), (5, 2))]
    dyn = spo.Dynamics(spo.Scene([body] * 6, hinges), 3, device=device, dtype=dtype, granularity="node")
    q = np.full((3, 6), 0.4)
    q[1, 4] = 0.0
    assert np.isnan(dyn.operational_inertia(q, [5])).any(axis=(1, 2)).tolist() == [False, True, False]


def test_a_planted_bug_in_the_inverse_is_seen(monkeypatch, tmp_path, device):
    from support.mutants import mutant
    from warp_spo.dynamics import operational

    old = "weight -= A[world, k, i] * out[world, i, j]"
    monkeypatch.setattr(operational, "cholesky", mutant(tmp_path, "cholesky", old, old.replace("-=", "+=")))
    dyn = spo.Dynamics(zoo.SCENES["fork"](), 1, device=device, dtype="float64", granularity="node")
    q = laws.states(dyn.scene, 1)["q"]
    assert laws.error(dyn.operational_inertia(q, [0])[0], Dense(dyn.scene, q[0]).operational_inertia([0])) > 1e-4
