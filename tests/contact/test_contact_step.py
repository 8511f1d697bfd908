"""Steps with contacts against the dense step, in every world; what they report; and calls that have no kernel."""

import dataclasses
import functools

import numpy as np
import pytest

import warp_spo as spo
from support import actuated, symbolic, zoo
from support.contact_cases import box, everywhere, quadruped, touching
from support.contact_steps import FIELDS, H, above, assert_is_dense, by_point
from support.step_calls import bundled
from support.step_scenes import furnished, states
from warp_spo.dynamics.stepping import contact_options
from warp_spo.recursions.contact import dampers, ground, law, points, secant_laws, step, velocity_kicks
from warp_spo.recursions.step.step import Step
from warp_spo.reference.contact import ContactStep

WORLDS = 4
TOLERANCE = {"float64": (1e-10, 1e-10), "float32": (2e-4, 5e-4)}
"""Of velocities, over the largest one, and of forces, over the weight; in float32 1.2e-4 measured on a cube that begins
20 mm deep in a field, 5e-5 of forces on G1."""
SIZES = {"contact_f": (3,), "contact_gap": (), "contact_slip": ()}


def trees():
    yield "fork", everywhere(furnished(zoo.fork()), 0)
    yield "tree", everywhere(furnished(zoo.random_tree(8, 1)), 1)


TREES = dict(trees())


@pytest.mark.parametrize(("name", "passes"), [("fork", 1), ("fork", 4), ("tree", 2), ("tree", 3)])
def test_the_recursion_is_the_dense_step(name, passes):
    """Random trees of every hinge, with every law, contacts anywhere."""
    scene = TREES[name]
    assert_is_dense(scene, states(scene, WORLDS), passes)


def test_without_ground_passes_settle_on_the_exact_step():
    """Drives, limits and actuators: dampers that give the bound end where the step without contacts is."""
    rng, far = np.random.default_rng(1), [spo.Contact(0, point=(0.0, 0.0, 0.0))]
    motors, fork = actuated.everything(), furnished(zoo.fork())
    fork = fork.with_values(joint_friction=np.zeros(11), joint_velocity_limit=np.full(11, 1e6))
    given = {name: rng.normal(size=(8, 3)) for name in ("q", "qd", "tau")}
    given["ctrl"] = 3.0 * rng.normal(size=(8, len(motors.actuators)))
    for scene, a, three in ((fork, states(fork, WORLDS), 1e-5), (motors, given, 2e-3)):
        _, wanted, _ = symbolic.advance(scene, a, H)
        below = scene.with_contacts(far, spo.Plane(-1e3))
        for passes, tolerance in ((3, three), (12, 1e-10)):
            found = symbolic.contact_step(below, a, H, passes)["out"]
            np.testing.assert_allclose(found, wanted, atol=tolerance * np.abs(wanted).max())


def test_damping_that_grows_with_depth():
    """Hunt and Crossley: of points in the ground, points above it, and all that lies in between."""
    scene = TREES["tree"]
    contacts = [dataclasses.replace(one, damping=None, dissipation=0.4) for one in scene.contacts]
    scene = scene.with_contacts(contacts, scene.ground)
    assert_is_dense(scene, states(scene, WORLDS), 3)


TELLING = (148, 173, 186, 193, 253, 329, 502, 579)
"""Seeds of throws in which points open and close between passes: found as those whose step a planted bug changes."""


def test_a_cube_that_is_thrown():
    scene, a = box(friction=0.3, stiffness=1e6, damping=300.0), {"q": [], "qd": []}
    for seed in TELLING:
        rng = np.random.default_rng(seed)
        turn = np.append(0.1 * rng.normal(size=3), 1.0)
        q = np.concatenate([np.zeros(3), turn / np.linalg.norm(turn)])
        depth = ContactStep(scene, q, np.zeros(6), H).points.depth.max()
        q[2] = depth - np.random.default_rng([seed]).uniform(-1e-3, 4e-3)
        a["q"].append(q)
        a["qd"].append(rng.normal(size=6) * np.repeat([1.0, 6.0], 3))
    assert_is_dense(scene, {name: np.array(rows) for name, rows in a.items()}, 3)


@pytest.mark.parametrize("name", FIELDS)
def test_a_height_field(name):
    scene = box(ground=FIELDS[name])
    a = above(scene, 1, 12)
    assert_is_dense(scene, a, 3)
    touched = [ContactStep(scene, *(a[part][w] for part in ("q", "qd")), H) for w in range(12)]
    assert any(len(at.numbers) > 8 for at in touched) == (name == "stairs")  # walls


def test_a_riser_is_seen_before_a_point_is_in_it():
    """A cube whose front is 3 mm from a riser: it slides 7.5 mm towards it, away from it, past it, and not at all."""
    scene = box(ground=FIELDS["stairs"])
    q = np.tile([-0.603, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], (4, 1))
    qd = np.zeros((4, 6))
    qd[:, :2] = [[1.5, 0.2], [-1.5, 0.2], [0.0, 1.5], [0.0, 0.0]]
    q[:, 2] += ContactStep(scene, q[0], qd[0], H).points.depth[:8].max()
    assert_is_dense(scene, {"q": q, "qd": qd}, 3)
    at = [ContactStep(scene, q[w], qd[w], H) for w in range(4)]
    walls = [one.points.depth[one.points.n[:, 2] < 0.5] for one in at]
    assert [len(depth) for depth in walls] == [2, 0, 0, 0] and walls[0].max() < 0.0
    assert (at[0].run()[1].f[at[0].points.n[:, 2] < 0.5, 0] < -50.0).all()  # they push it back within the step


def test_a_tilted_field_is_a_tilted_plane():
    slope = np.array([0.2, -0.1])
    x, y = np.arange(21) * 0.1 - 1.0, np.arange(31) * 0.1 - 1.5
    field = spo.HeightField(slope[0] * x[:, None] + slope[1] * y[None, :], 0.1, (-1.0, -1.5))
    normal = np.array([*-slope, 1.0]) / np.sqrt(1.0 + slope @ slope)
    a = above(box(ground=field), 2, 6)
    a = {name: rows[:-1] for name, rows in a.items()}
    found, wanted = (symbolic.contact_step(box(ground=g), a, H) for g in (field, spo.Plane(normal=normal)))
    np.testing.assert_allclose(found["out"], wanted["out"], atol=1e-9)
    np.testing.assert_allclose(found["contact_f"].sum(axis=1), wanted["contact_f"].sum(axis=1), atol=1e-9)
    corners = found["contact_gap"][:, :4]  # of the face that looks down along z; rows of the grid follow
    np.testing.assert_allclose(corners.min(axis=1), wanted["contact_gap"].min(axis=1), atol=1e-9)


def test_the_kernel_of_a_height_field(device):
    ball = spo.Contact(0, sphere=((0.1, 0.0, 0.0), 0.05))
    scene = box(ground=FIELDS["stairs"]).with_contacts([ball], FIELDS["stairs"])
    a = above(scene, 3, WORLDS)
    dyn = spo.Dynamics(scene, WORLDS, device=device)
    force = np.full((WORLDS, 1, 3), np.nan, np.float32)
    q, qd = dyn.step(
        a["q"].astype(np.float32), a["qd"].astype(np.float32), None, H, report=spo.StepReport(contact_f=force)
    )
    weight, (velocity, pushed) = 5.0 * 9.81, TOLERANCE["float32"]
    for w in range(WORLDS):
        at = ContactStep(scene, a["q"][w], a["qd"][w], H)
        after, wanted = at.run()
        np.testing.assert_allclose(qd[w], wanted.v, atol=velocity * np.abs(wanted.v).max())
        np.testing.assert_allclose(q[w], after, atol=velocity)
        np.testing.assert_allclose(
            force[w], by_point(at, wanted.f)[0], atol=pushed * max(weight, np.abs(wanted.f).max())
        )


def grounds():
    """A plane, and a set of two fields, one with walls; each world's is moved, and worlds stand on different fields."""
    sets = spo.HeightField(np.stack([FIELDS["stairs"].heights, 0.05 * np.random.default_rng(1).normal(size=(30, 20))]),
                           (0.05, 0.08), FIELDS["stairs"].origin)  # fmt: skip
    yield "plane", spo.Plane(0.1, np.array([0.6, 0.0, 0.8])), {}
    yield "set", sets, {"ground_field": np.array([[0.0], [1.0], [1.0], [0.0]])}


def on_grounds(ground, values):
    """Return a scene whose worlds have grounds of their own, and states near them."""
    scene = box(ground=ground)
    moved = np.random.default_rng(4).uniform(-0.1, 0.1, (WORLDS, 3))
    scene = scene.with_values(ground_origin=np.float64(np.float32(moved)), **values)
    rng, q, qd = (
        np.random.default_rng(5),
        np.zeros((WORLDS, 7)),
        0.3 * np.random.default_rng(6).normal(size=(WORLDS, 6)),
    )
    q[:, :2], q[:, 3:] = rng.uniform(-0.3, 0.3, (WORLDS, 2)), [0.1, 0.2, 0.0, 0.9]
    for world in range(WORLDS):
        for _ in range(6):  # until it is 5 mm deep
            q[world, 2] += ContactStep(scene, q[world], qd[world], H, world=world).points.depth.max() - 5e-3
    return scene, {"q": np.float64(np.float32(q)), "qd": np.float64(np.float32(qd))}


@pytest.mark.parametrize("name, ground, values", list(grounds()))
def test_grounds_of_worlds(name, ground, values, device):
    """Each world's is where its values say: the kernel against the dense step, values folded or set at run time."""
    scene, a = on_grounds(ground, values)
    given = {part: scene.values[part] for part in ("ground_origin", *values)}
    later = spo.Dynamics(box(ground=ground), WORLDS, device, variable=tuple(given))
    later.set(**{part: np.float32(value) for part, value in given.items()})
    for dyn in (spo.Dynamics(scene, WORLDS, device), later):
        force = np.full((WORLDS, len(scene.contact_points), 3), np.nan, np.float32)
        _, qd = dyn.step(np.float32(a["q"]), np.float32(a["qd"]), None, H, report=spo.StepReport(contact_f=force))
        assert (np.abs(force).sum(axis=(1, 2)) > 1.0).all()
        for w in range(WORLDS):
            at = ContactStep(scene, a["q"][w], a["qd"][w], H, world=w)
            _, wanted = at.run()
            np.testing.assert_allclose(qd[w], wanted.v, atol=2e-4 * np.abs(wanted.v).max())
            np.testing.assert_allclose(force[w], by_point(at, wanted.f)[0], atol=1e-3 * np.abs(wanted.f).max())


def test_a_ground_that_is_nowhere_leaves_other_worlds_alone(device):
    """Origins that are NaN make that world NaN, and so do numbers of fields that are NaN or beyond the set's end."""
    _, ground, values = list(grounds())[1]
    scene, a = on_grounds(ground, values)
    dyn = spo.Dynamics(scene, WORLDS, device, variable=("ground_origin", "ground_field"))
    q, qd = np.float32(a["q"]), np.float32(a["qd"])
    _, before = dyn.step(q, qd, None, H)
    field, status = np.float32(scene.values["ground_field"]), np.zeros(WORLDS, np.int32)
    field[2], field[3] = 7.0, np.nan
    for axis in range(3):
        moved = np.float32(scene.values["ground_origin"])
        moved[1, axis] = np.nan
        dyn.set(ground_origin=moved, ground_field=field)
        _, after = dyn.step(q, qd, None, H, status=status)
        assert np.isnan(after[1:]).all() and (status[1:] == spo.Status.NOT_FINITE).all()
        assert (after[0] == before[0]).all() and np.isfinite(after[0]).all() and status[0] == spo.Status.OK


@pytest.mark.parametrize("values, words", [
    (dict(ground_field=[2.0]), r"ground_field holds 2 to 2; expected integers below 2"),
    (dict(ground_field=[0.5]), r"expected integers below 2"),
    (dict(ground_origin=[0.0, np.nan, 0.0]), r"ground_origin holds NaN or infinity"),
    (dict(ground_origin=[0.0, 0.0]), r"ground_origin has shape \(2,\); expected \(3,\)"),
])  # fmt: skip
def test_a_ground_that_is_not_there_is_an_error(values, words):
    scene = box(ground=list(grounds())[1][1])
    with pytest.raises(ValueError, match=words):
        scene.with_values(**values)


BUGS = {
    "active set": (secant_laws.SecantLaw, "_share", "bound * reciprocal(size), 1.0", "0.0, 1.0"),
    "candidates frozen": (law, "finish_point", "select(state.candidate, state.candidate, reached)",
                          "state.candidate"),
    "dampers above ground": (law, "finish_point", "candidate * pushes", "pushes"),
    "last pass opens": (law, "finish_point", "closing * state.closed", "0.0"),
    "wrong lever": (dampers, "_mass", "r * weight", "r * (2.0 * weight)"),
    "riser unseen": (ground, "surfaces", "_cell(next_x, rows)[0]", "i"),
    "velocity terms of the path alone": (velocity_kicks, "_kick", "forces.__getitem__", "zero"),
    "rates of the last round": (velocity_kicks, "final_kick",
                                     "2.0 * (kick[dof] - previous_kick(dof))", "0.0"),
    "points along other rates": (points, "place_points", "w, v = mine.travel", "w, v = mine.twist"),
    "forces at the start": (Step, "__init__", 'del trace.substitutes["q"]', "pass"),
    "points half way": (points, "place_points", "depth + (0.5 * h)", "depth + (0.4 * h)"),
    "weights of the neutral pose": (step.ContactStepTrace, "_step_over_inertia", "not in single_dofs",
                                    "in single_dofs"),
    "straight paths": (points, "place_points", "(0.5 * h) * speed_gained", "0.0"),
    "damper of straight paths": (points, "place_points", "k * depth_after - damping * speed_gained", "k * depth_after"),
    "damping that does not grow": (points, "place_points", "d * (k * select(less(0.0, depth), depth, 0.0))", "d"),
    "tangent friction": (law, "friction_damper", "inverse_root(w * w + point.eps * point.eps)",
                         "inverse_root(w * w + point.eps * point.eps) * inverse_root(w * w + point.eps * point.eps)"
                         " * point.eps"),
}  # fmt: skip


@pytest.mark.parametrize("bug", BUGS)
def test_a_planted_bug_is_seen(monkeypatch, bug):
    owner, name, old, new = BUGS[bug]
    symbolic.plant(monkeypatch, owner, name, old, new)
    with pytest.raises(AssertionError):
        test_a_cube_that_is_thrown()
        test_the_recursion_is_the_dense_step("fork", 4)
        test_damping_that_grows_with_depth()
        test_a_riser_is_seen_before_a_point_is_in_it()


@functools.cache
def dynamics(device, dtype, granularity=None):
    options = dict(device=device, dtype=dtype, granularity=granularity)
    return spo.Dynamics(quadruped(), WORLDS, variable=("contact_friction",), **options)


def stepped(dyn, state, passes=None, **more):
    """One step with all reports, which begin as NaN."""
    count, dtype = len(dyn.scene.contact_points), dyn.dtype.__name__
    found = {name: np.full((WORLDS, count, *size), np.nan, dtype) for name, size in SIZES.items()}
    found |= {"contact_excess": np.full((WORLDS, 3), np.nan, dtype), "status": np.full(WORLDS, -1, np.int32)}
    q, qd, tau = (x.astype(dtype) for x in state)
    found["q"], found["qd"] = dyn.step(q, qd, tau, H, **bundled(passes=passes, **found, **more))
    return found


@pytest.mark.parametrize("granularity", ["tree", "segment"])
@pytest.mark.parametrize("dtype", ["float32", pytest.param("float64", marks=pytest.mark.slow)])
def test_a_quadruped_that_lands(device, dtype, granularity):
    """All that a step reports, with another friction in each world."""
    dyn, state = dynamics(str(device), dtype, granularity), touching(quadruped(), 3, WORLDS)
    friction = np.linspace(0.1, 0.9, WORLDS)[:, None] * np.ones((1, 8))
    dyn.set(contact_friction=friction.astype(dtype))
    scene = dyn.scene.with_values(contact_friction=friction)
    weight, (velocity, force) = 9.81 * scene.values["body_mass"].sum(), TOLERANCE[dtype]
    for passes in (None, 1):
        found = stepped(dyn, state, passes)
        for w in range(WORLDS):
            at = ContactStep(scene, state[0][w], state[1][w], H, world=w)
            q, wanted = at.run(state[2][w], passes=passes or 3)
            np.testing.assert_allclose(found["qd"][w], wanted.v, atol=velocity * np.abs(wanted.v).max())
            np.testing.assert_allclose(found["q"][w], q, atol=velocity)
            np.testing.assert_allclose(found["contact_f"][w], wanted.f, atol=force * weight)
            np.testing.assert_allclose(found["contact_gap"][w], -at.points.depth, atol=1e-6)
            np.testing.assert_allclose(found["contact_excess"][w], wanted.excess, atol=force * weight)
            v = np.einsum("pai,i->pa", at.points.J, wanted.v)
            slip = np.linalg.norm(v[:, :2], axis=1)
            np.testing.assert_allclose(found["contact_slip"][w], slip, atol=velocity * np.abs(wanted.v).max())
            push = at.points.k * at.points.depth - (at.points.k * H + at.points.d) * v[:, 2]
            lacking = ((v[:, 2] * H < at.points.depth) & ~wanted.on) * push
            over = (np.append(wanted.excess, lacking.max()) > 0.1 * np.array([weight, weight, 33.0, weight])).any()
            assert found["status"][w] == (spo.Status.CONTACT if over else spo.Status.OK)
    assert (found["status"] == spo.Status.CONTACT).any()  # of one pass
    assert all(f"contact_step  {granularity}" in line for line in dyn.programs.describe())


def test_what_starts_deep_comes_out_slowly(device):
    """Half a metre below ground: out at 1 m/s, as the dense step says, joints below 50 rad/s, and flagged."""
    dyn, (q, qd, tau) = dynamics(str(device), "float32", "segment"), touching(quadruped(), 3, WORLDS)
    dyn.set(contact_friction=np.full((WORLDS, 8), 0.8, np.float32))
    q[1:, 2] -= 0.5
    assert_is_dense(quadruped(), {"q": q[2:], "qd": qd[2:], "tau": tau[2:]}, 3)
    found = stepped(dyn, (q, 0.0 * qd, tau))
    for _ in range(20):
        assert (found["status"][1:] == spo.Status.CONTACT).all() and np.abs(found["qd"]).max() < 50.0
        before, found = found, stepped(dyn, (found["q"], found["qd"], 0.0 * tau))
        risen = (found["contact_gap"] - before["contact_gap"])[before["contact_gap"] < -0.05] / H
        # limbs fold while the trunk rises, so that some points are faster than that: 1.14 in the middle
        assert 0.8 < np.median(risen) < 1.2 and found["status"][0] == spo.Status.OK


def test_nan_stays_in_its_world(device):
    dyn, state = dynamics(str(device), "float32", "segment"), touching(quadruped(), 3, WORLDS)
    friction = np.full((WORLDS, 8), 0.5, np.float32)
    dyn.set(contact_friction=friction)
    clean = stepped(dyn, state)
    friction[1, 3], q = np.nan, state[0].copy()
    q[2, 9] = np.nan
    dyn.set(contact_friction=friction)
    found = stepped(dyn, (q, *state[1:]))
    assert found["status"].tolist()[1:3] == [spo.Status.NOT_FINITE] * 2 and np.isnan(found["qd"][1:3]).any(axis=1).all()
    for name in ("q", "qd", "contact_f", "status"):
        np.testing.assert_array_equal(found[name][[0, 3]], clean[name][[0, 3]])


def test_substeps_report_the_mean_force(device):
    """To the bit the state that as many calls compute; gap, slip and excess of the last."""
    dyn, (q, qd, tau) = dynamics(str(device), "float32", "tree"), touching(quadruped(), 3, WORLDS)
    dyn.set(contact_friction=np.full((WORLDS, 8), 0.8, np.float32))
    found, forces, state = stepped(dyn, (q, qd, tau), substeps=3), [], (q, qd, tau)
    for _ in range(3):
        one = stepped(dyn, state)
        forces.append(one["contact_f"])
        state = one["q"], one["qd"], tau
    for name in ("q", "qd", "contact_gap", "contact_slip", "contact_excess"):
        np.testing.assert_array_equal(found[name], one[name])
    np.testing.assert_allclose(found["contact_f"], np.mean(forces, axis=0), rtol=1e-5, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("granularity", ["tree", "segment"])
def test_points_are_switched_off_in_some_worlds(device, granularity):
    """A point without stiffness and damping is as one that is not there, and returns when it has them again."""
    scene = quadruped()
    q, qd, tau = touching(scene, 3, WORLDS)
    options = dict(worlds=WORLDS, device=device, dtype="float64", granularity=granularity)
    dyn = spo.Dynamics(scene, variable=("contact_stiffness", "contact_damping"), **options)
    trunk = spo.Dynamics(scene.with_contacts(scene.contacts[4:]).with_values(**{
        name: scene.values[name][:, 4:] for name in ("contact_stiffness", "contact_damping")
    }), **options)  # fmt: skip
    off, no_feet = np.arange(WORLDS) % 2 == 0, np.where(np.arange(8) < 4, 0.0, 1.0)
    found, force = [], np.full((WORLDS, 8, 3), np.nan)
    for factor in (None, no_feet, 1.0):
        if factor is not None:
            dyn.set(worlds=off, **{name: factor * scene.values[name][0] for name in dyn.variable})
        found.append(dyn.step(q, qd, tau, H, report=spo.StepReport(contact_f=force))[1])
        assert force[~off, :4].any() and force[off, :4].any() == (factor is not no_feet)
    np.testing.assert_array_equal(found[1][~off], found[0][~off])
    np.testing.assert_array_equal(found[2], found[0])
    np.testing.assert_allclose(found[1][off], trunk.step(q, qd, tau, H)[1][off], rtol=0.0, atol=1e-10 * abs(qd).max())


@pytest.mark.slow
def test_impulse_is_the_change_of_momentum(device):
    """Of a quadruped that falls on its feet and trunk: sum of forces and weight, times dt."""
    dyn, (q, qd, tau) = dynamics(str(device), "float64"), touching(quadruped(), 5, WORLDS)
    dyn.set(contact_friction=np.full((WORLDS, 8), 0.8))
    found = stepped(dyn, (q, qd, np.zeros_like(tau)))
    matrices = dyn.centroidal_momentum_matrix(q)[:, :3]  # at the pose at which the step solves
    bias = np.array(
        [ContactStep(dyn.scene, q[w], qd[w], H).dense.centroidal_momentum_bias()[:3] for w in range(WORLDS)]
    )
    change = np.einsum("wij,wj->wi", matrices, found["qd"] - qd) / H + bias
    weight = np.array([0.0, 0.0, -9.81 * dyn.scene.values["body_mass"].sum()])
    np.testing.assert_allclose(change, found["contact_f"].sum(axis=1) + weight, atol=1e-8)


REFUSALS = {
    "integrator": (dict(integrator="rk4"), spo.UnsupportedError, "integrator='rk4' with contacts"),
    "passes": (dict(passes=0), ValueError, "passes is 0; expected an integer, 1 or more"),
    "shape": (dict(contact_f=np.zeros((WORLDS, 3, 3), np.float32)), ValueError, "contact_f"),
}


@pytest.mark.parametrize("mistake", REFUSALS)
def test_calls_without_a_kernel_have_names(device, mistake):
    more, kind, message = REFUSALS[mistake]
    q, qd = np.tile(quadruped().neutral_q, (WORLDS, 1)).astype(np.float32), np.zeros((WORLDS, 18), np.float32)
    with pytest.raises(kind, match=message):
        dynamics(str(device), "float32", "tree").step(q, qd, None, H, **bundled(**more))


def test_scenes_without_a_kernel_have_names(device, monkeypatch):
    q, qd = np.array([[0, 0, 1, 0, 0, 0, 1]], np.float32), np.zeros((1, 6), np.float32)
    with pytest.raises(spo.UnsupportedError, match="granularity='node' with contacts"):
        spo.Dynamics(box(), device=device, granularity="node").step(q, qd, None, H)
    monkeypatch.setitem(contact_options.MOST_HEIGHTS, "float32", 600)
    with pytest.raises(spo.UnsupportedError, match="a HeightField of 600 points in float32"):
        spo.Dynamics(box(ground=FIELDS["stairs"]), device=device).step(q, qd, None, H)
    bare = spo.Dynamics(box().with_contacts([]), device=device)
    for name, value in (("passes", 3), ("contact_gap", np.zeros((1, 0), np.float32))):
        with pytest.raises(ValueError, match=f"{name} is given, and the scene has no contacts"):
            bare.step(q, qd, None, H, **bundled(**{name: value}))
    post = spo.Scene([spo.Body(1.0)], [spo.Hinge("fixed", -1, 0)], contacts=[spo.Contact(0, point=(0, 0, 0))])
    none, gap = np.zeros((1, 0), np.float32), np.full((1, 1), np.nan, np.float32)
    with pytest.raises(spo.UnsupportedError, match="contact_gap of a scene in which nothing can move"):
        spo.Dynamics(post, device=device).step(none, none, None, H, report=spo.StepReport(contact_gap=gap))
