"""Operations in the independent dofs of closed loops, against Lagrange's equations."""

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import laws, mechanisms, symbolic, zoo
from support.allocations import no_warp_allocation
from support.closed_loops import run_embedded, traced
from support.mechanisms import MECHANISMS, Closed
from warp_spo.dynamics import inertia
from warp_spo.dynamics.loop_analysis import ClosureEvaluator, embedding
from warp_spo.recursions.loops import minimal

DIFFERENCES = 1e-9  # what differences of order 8 leave of second derivatives; conditioning of the draws
TOLERANCE = {"float64": 10.0 * DIFFERENCES, "float32": 3e-5}
WRENCHES = np.random.default_rng(3).normal(size=(3, 18))
LARGE = ("stewart", "biped", "tilted, a weld", "tilted, a ball", "parallelogram", "slider_crank")  # or like another
ALL = [pytest.param(name, marks=pytest.mark.slow) if name in LARGE else name for name in MECHANISMS]


def frames_of(scene):
    """The first body, one in the middle, and one off the last."""
    return [0, scene.body_count // 2, (scene.body_count - 1, laws.FRAMES[1][1])]


def where(scene):
    return tuple((f, (0.0, 0.0, 0.0)) if isinstance(f, int) else (f[0], f[1][:3]) for f in frames_of(scene))


# name -> (arrays it takes after q, its shape for n independent dofs, the reference's value in one world)
CLOSED = {
    "operational_inertia_inverse": (
        (),
        lambda n: (18, 18),
        lambda c, s, free: c.operational_inertia_inverse(frames_of(c.scene)),
    ),
    "operational_inertia_inverse_product": (
        ("x",),
        lambda n: (3, 6),
        lambda c, s, free: (c.operational_inertia_inverse(frames_of(c.scene)) @ s["x"]).reshape(3, 6),
    ),
    "log_det_mass_matrix": ((), lambda n: (), lambda c, s, free: np.linalg.slogdet(c.mass_matrix(free))[1]),
    "jacobian": ((), lambda n: (3, 6, n), lambda c, s, free: c.dense.jacobian(frames_of(c.scene)) @ c.columns(free)),
    "jacobian_bias": (
        ("qd",),
        lambda n: (3, 6),
        lambda c, s, free: (
            c.dense.jacobian_bias(s["qd"], frames_of(c.scene))
            + c.dense.jacobian(frames_of(c.scene)) @ demanded(c, s, free)
        ),
    ),
    "com_jacobian": ((), lambda n: (3, n), lambda c, s, free: c.dense.com_jacobian @ c.columns(free)),
    "centroidal_momentum_matrix": (
        (),
        lambda n: (6, n),
        lambda c, s, free: c.dense.centroidal_momentum_matrix @ c.columns(free),
    ),
    "centroidal_momentum_bias": (
        ("qd",),
        lambda n: (6,),
        lambda c, s, free: (
            c.dense.centroidal_momentum_bias(s["qd"]) + c.dense.centroidal_momentum_matrix @ demanded(c, s, free)
        ),
    ),
}


def demanded(closed, state, free):
    return closed.accelerations(state["qd"], np.zeros_like(state["qd"]), free)


def arrays_of(s):
    return {**s._asdict(), "x": WRENCHES}


def traced_error(name, operation):
    """Of the trace in float64, the largest over the worlds."""
    scene, how, s, closed = mechanisms.case(name)
    takes, shape, reference = CLOSED[operation]
    options = {"frames": where(scene)} if "jacobian" in operation[:9] or "operational" in operation else {}
    got = run_embedded(scene, how, operation, arrays_of(s), ("q", *takes), shape(len(how.dofs)), **options)
    states = [{key: array[w] for key, array in arrays_of(s).items()} for w in range(3)]
    return max(laws.error(got[w], np.asarray(reference(c, states[w], how.dofs))) for w, c in enumerate(closed))


@pytest.mark.parametrize("name", ALL)
def test_equals_lagrange(name):
    for operation in CLOSED:
        assert traced_error(name, operation) <= TOLERANCE["float64"], operation


def test_a_tight_loop_holds_the_frames_it_ties():
    """The tip of a welded four-bar stands still, whatever pushes: its rows vanish; the crank's do not."""
    scene, how, s, _ = mechanisms.case("tilted, a weld")
    tip = (scene.body_count - 1, scene.loops[0].child_pose[:3])
    frames = (0, (0.3, 0.1, 0.2)), tip
    got = run_embedded(scene, how, "operational_inertia_inverse", s._asdict(), ("q",), (12, 12), frames=frames)
    assert np.abs(got[:, 6:]).max() <= 1e-10 * np.abs(got).max()


def test_dead_points_pass():
    """A rocker as the independent dof, next to where it loses its hold on the crank: what needs no X has no trouble."""
    scene = MECHANISMS["fourbar"]()
    how, closing = embedding(scene, asked=[2]), ClosureEvaluator(scene)  # relative angle between coupler and rocker
    crank = np.linspace(0.0, 2.0 * np.pi, 1000)
    q = closing.close(np.stack([crank, -1.0 - crank, np.full(1000, 2.0)], axis=1))
    X = np.linalg.svd(closing.at(q)[1][:, how.rows])[2][:, 2]
    worst = int(np.argmin(np.abs(X[:, 2])))
    assert np.abs(X[worst, 2]) < 1e-2
    s = mechanisms.states(scene, 1, q=q[[worst]])
    got = run_embedded(scene, how, "operational_inertia_inverse", s._asdict(), ("q",), (18, 18), frames=where(scene))
    assert laws.error(got[0], Closed(scene, s.q[0]).operational_inertia_inverse(frames_of(scene))) <= DIFFERENCES


def hybrid_error(name, held):
    """``held``: which of the independent dofs."""
    scene, how, s, closed = mechanisms.case(name)
    mask = np.zeros(scene.dof_count, dtype=bool)
    mask[np.array(how.dofs)[held]] = True
    shapes = {name: (scene.dof_count,) for name in ("out", "tau_out")}
    given, held_dofs = ("q", "qd", "tau", "qdd", "body_f"), tuple(mask.tolist())
    got = traced(scene, "embedded_hybrid_dynamics", s._asdict(), given, shapes, embedding=how, mask=held_dofs)
    errors = []
    for w, c in enumerate(closed):
        right = c.hybrid_dynamics(s.qd[w], s.tau[w], s.qdd[w], mask, how.dofs, s.body_f[w])
        errors += [laws.error(got["out"][w], right[0]), laws.error(got["tau_out"][w], right[1])]
    np.testing.assert_array_equal(got["out"][:, mask], s.qdd[:, mask])
    np.testing.assert_array_equal(got["tau_out"][:, ~mask], s.tau[:, ~mask])
    return max(errors)


@pytest.mark.parametrize("name", ["fivebar", "cassie_leg", "far_loop", "ancestors", "gripper"])
def test_hybrid_dynamics(name):
    """None, the first, every other and all of the independent dofs follow given accelerations."""
    count = len(mechanisms.case(name).how.dofs)
    for held in ([], [0], list(range(0, count, 2)), list(range(count))):
        assert hybrid_error(name, np.array(held, dtype=int)) <= TOLERANCE["float64"], held


def run(dyn, operation, on, **more):
    frames = [frames_of(dyn.scene)] if "jacobian" in operation[:9] or "operational" in operation else []
    return getattr(dyn, operation)(on["q"], *[on[name] for name in CLOSED[operation][0]], *frames, **more)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_kernels_do_what_traces_do(dtype, device):
    """Each world has masses of its own; every entry is written; a NaN stays in its world; nothing is allocated."""
    scene, how, s, _ = mechanisms.case("far_loop")
    varied = zoo.varied(scene, 3, seed=1).values
    names = ("body_mass", "body_com", "body_inertia", "gravity", "joint_armature")
    scene = scene.with_values(**{name: varied[name] for name in names})
    closed = [Closed(scene, q, world=w) for w, q in enumerate(s.q)]
    dyn = spo.Dynamics(scene, 3, device=device, dtype=dtype, loops="embed")
    arrays = {name: array.astype(dtype).astype(np.float64) for name, array in arrays_of(s).items()}
    spoiled = {name: array.copy() for name, array in arrays.items()}
    spoiled["q"][1] = np.nan
    on, bad = laws.to_device(dyn, arrays), laws.to_device(dyn, spoiled)
    for operation, (_, _, reference) in CLOSED.items():
        first = run(dyn, operation, on)
        out = wp.full(first.shape, float("nan"), dtype=dyn.dtype, device=device)
        with no_warp_allocation():
            assert run(dyn, operation, on, out=out) is out
        np.testing.assert_array_equal(out.numpy(), first.numpy())
        for w, c in enumerate(closed):
            wanted = reference(c, {name: array[w] for name, array in arrays.items()}, how.dofs)
            assert laws.error(first.numpy()[w], np.asarray(wanted)) <= TOLERANCE[dtype], operation
        run(dyn, operation, bad, out=out)
        np.testing.assert_array_equal(out.numpy()[[0, 2]], first.numpy()[[0, 2]])
        assert np.isnan(out.numpy()[1]).any(), operation


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize(
    ("name", "frames"), [("cassie_leg", [11]), pytest.param("biped", [3, 10], marks=pytest.mark.slow)]
)
def test_operational_inertia_of_feet_that_rods_drive(name, frames, dtype, device):
    """Operational inertia of feet equals the one by multipliers in float64, and exceeds the open leg's."""
    scene, _, s, closed = mechanisms.case(name)
    dyn, cut = (spo.Dynamics(scene, 3, device=device, dtype=dtype, loops=loops) for loops in ("embed", "cut"))
    got, mobility = dyn.operational_inertia(s.q, frames), dyn.operational_inertia_inverse(s.q, frames)
    np.testing.assert_array_equal(got, got.transpose(0, 2, 1))
    free = cut.operational_inertia_inverse(s.q, frames)
    for w, c in enumerate(closed):
        wanted = c.operational_inertia_inverse(frames)
        scale = np.sqrt(np.diag(wanted))
        condition = np.linalg.cond(wanted / np.outer(scale, scale))
        assert laws.error(mobility[w], wanted) <= TOLERANCE[dtype]
        assert laws.error(got[w], np.linalg.inv(wanted)) <= TOLERANCE[dtype] * condition
        assert np.linalg.eigvalsh(free[w] - mobility[w]).min() >= -TOLERANCE[dtype] * scale.max() ** 2
        assert laws.error(free[w], wanted) > 0.01


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_solve_mass_matrix_with_several_columns(dtype, device):
    """None, one, as many as a kernel takes, and more, in turns: each column as by itself."""
    scene, how, s, closed = mechanisms.case("far_loop")
    dyn, size = spo.Dynamics(scene, 3, device=device, dtype=dtype, loops="embed"), len(how.dofs)
    q = wp.array(s.q, dtype=dyn.dtype, device=device)
    for columns in (0, 1, inertia.COLUMNS, 2 * inertia.COLUMNS + 1):
        b = np.random.default_rng(columns).normal(size=(3, size, columns)).astype(dtype)
        on, out = (wp.array(x, dtype=dyn.dtype, device=device) for x in (b, np.full_like(b, np.nan)))
        dyn.prepare("solve_mass_matrix", columns=columns)
        with no_warp_allocation():
            assert dyn.solve_mass_matrix(q, on, out=out) is out
        for w, c in enumerate(closed):
            assert laws.error(out.numpy()[w], np.linalg.solve(c.mass_matrix(how.dofs), b[w])) <= TOLERANCE[dtype]


def test_a_planted_bug_in_the_columns_is_seen(monkeypatch):
    first = "place[dof], *(0 for _ in column))"
    symbolic.plant(monkeypatch, minimal, "solve_mass_matrix", "place[dof], *column)", first)
    scene, how, s, _ = mechanisms.case("fivebar")
    b = np.random.default_rng(0).normal(size=(3, len(how.dofs), 2))
    solve, arrays = (scene, how, "solve_mass_matrix"), s._asdict()
    both = run_embedded(*solve, arrays | {"b": b}, ("q", "b"), b.shape[1:], columns=2)
    second = run_embedded(*solve, arrays | {"b": b[:, :, 1]}, ("q", "b"), b.shape[1:2])
    assert laws.error(both[:, :, 1], second) > 0.1


def test_hybrid_dynamics_as_users_call_it(device):
    """A motor follows a motion; what it takes, as a force, makes the same motion."""
    scene = MECHANISMS["fivebar"]()
    motors = ["left motor", "right motor"]
    dyn = spo.Dynamics(scene, 3, device=device, dtype="float64", loops="embed", independent=motors)
    s = mechanisms.states(scene)
    left, right = dyn.independent_dofs
    held = np.arange(scene.dof_count) == left
    qdd, tau = dyn.hybrid_dynamics(s.q, s.qd, s.tau, s.qdd, prescribed=held, body_f=s.body_f)
    np.testing.assert_array_equal(qdd[:, left], s.qdd[:, left])
    np.testing.assert_allclose(dyn.forward_dynamics(s.q, s.qd, tau, s.body_f), qdd, rtol=1e-9, atol=1e-9)
    with pytest.raises(spo.UnsupportedError, match=r"prescribing .*which the loops.*Dynamics\(independent="):
        dyn.hybrid_dynamics(s.q, prescribed=[dof not in (left, right) for dof in range(scene.dof_count)])
    with pytest.raises(spo.UnsupportedError, match=r"one for each world.*pass a list"):
        dyn.hybrid_dynamics(s.q, prescribed=np.tile(held, (3, 1)))


def test_what_speaks_of_independent_dofs_fits_what_speaks_of_all(device):
    """Frames accelerate, and momentum changes, as Jacobians and biases say of what forward dynamics finds."""
    scene = MECHANISMS["fivebar"]()
    dyn = spo.Dynamics(scene, 3, device=device, dtype="float64", loops="embed")
    s, frames, free = mechanisms.states(scene), frames_of(scene), dyn.independent_dofs
    qdd = dyn.forward_dynamics(s.q, s.qd, s.tau)
    tau, full = dyn.inverse_dynamics(s.q, s.qd, qdd), np.zeros_like(s.tau)
    full[:, free] = tau
    np.testing.assert_allclose(dyn.forward_dynamics(s.q, s.qd, full), qdd, rtol=1e-9, atol=1e-9)
    with pytest.raises(
        ValueError, match=r"tau \(3, 2\) .*independent_dofs alone; expected \(3, 4\).*full\[:, dyn.inde"
    ):
        dyn.forward_dynamics(s.q, s.qd, tau)
    rate = np.einsum("wfij,wj->wfi", dyn.jacobian(s.q, frames), qdd[:, free]) + dyn.jacobian_bias(s.q, s.qd, frames)
    np.testing.assert_allclose(dyn.frame_accelerations(s.q, s.qd, qdd, frames), rate, rtol=1e-9, atol=1e-9)
    moves = dyn.body_accelerations(s.q, s.qd, qdd)[..., :3]
    force = np.einsum("wij,wj->wi", dyn.centroidal_momentum_matrix(s.q), qdd[:, free])
    force += dyn.centroidal_momentum_bias(s.q, s.qd)
    np.testing.assert_allclose(np.einsum("b,wbi->wi", scene.values["body_mass"][0], moves), force[:, :3], atol=1e-8)


BUGS = [
    (
        "operational_inertia_inverse",
        "_eliminate_cluster",
        "force = force + column * rate",
        "force = force - column * rate",
    ),
    ("operational_inertia_inverse", "_eliminate_cluster", "{id(link): force}", "{id(cluster.links[0]): force}"),
    (
        "operational_inertia_inverse_product",
        "operational_inertia_inverse_product",
        "wrenches=operational.wrenches_on_links(trace, frames)",
        "wrenches={}",
    ),
    ("log_det_mass_matrix", "log_det_mass_matrix", ", allowed=allowed)", ")"),
    ("jacobian", "_times_columns", "if dof in row)", "if dof in row and dof == free)"),
    ("jacobian_bias", "loop_accelerations", "cluster, loops.embedding.dofs", "cluster"),
    ("centroidal_momentum_bias", "centroidal_momentum_bias", "trace, loop_accelerations(loops).__getitem__", "trace"),
]


@pytest.mark.parametrize(("operation", "name", "old", "new"), BUGS)
def test_a_planted_bug_is_seen(monkeypatch, operation, name, old, new):
    symbolic.plant(monkeypatch, minimal, name, old, new)
    assert not traced_error("cassie_leg", operation) <= 1e-4


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("if not mask[dof]]", "]"),
        ("tau(i)) for i, x", "0.0) for i, x"),
        ("loads=True", "loads=False"),
        ("ClosedLoops(trace, embedding, alone)", "ClosedLoops(trace, embedding)"),
    ],
)
def test_a_planted_bug_in_hybrid_dynamics_is_seen(monkeypatch, old, new):
    count = len(mechanisms.case("cassie_leg").how.dofs)
    symbolic.plant(monkeypatch, minimal, "hybrid_dynamics", old, new)
    try:
        error = hybrid_error("cassie_leg", np.arange(0, count, 2))
    except AssertionError:  # a given acceleration does not come out as it was given
        return
    assert not error <= 1e-4
