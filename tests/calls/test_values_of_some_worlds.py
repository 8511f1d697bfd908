"""Values and states that change in some worlds alone; limits, efforts, rates and rest positions that are variable."""

import functools

import numpy as np
import pytest
import torch
import warp as wp

import warp_spo as spo
from support import implicit, laws, zoo
from support.allocations import no_warp_allocation
from support.border import made
from support.gradients import check
from support.step_scenes import TOLERANCE, H
from support.value_scenes import KINDS
from warp_spo.kernels import row_copies
from warp_spo.reference.dense import Dense

WORLDS = 3
MASK = np.array([True, False, True])
NAMES = ("body_mass", "joint_damping", "joint_rest_q")  # in the table of links, a field, and one laid out as q
LIMITS = ("joint_friction", "joint_limit_lower", "joint_limit_upper", "joint_limit_ke", "joint_limit_kd",
          "joint_effort_limit", "joint_velocity_limit", "joint_rest_q")  # fmt: skip


@functools.cache
def scene():
    """A screw, a ball and a slide: springs on all, drives."""
    plain = zoo.from_parents([-1, 0, 1], ["revolute", "ball", "prismatic"], 3)
    n = plain.dof_count
    return plain.with_values(joint_stiffness=np.linspace(1.0, 3.0, n), joint_target_ke=np.full(n, 40.0))


def drawn(name, seed):
    value = scene().values[name][0]
    return value + np.random.default_rng(seed).uniform(0.1, 0.5, (WORLDS, *value.shape))


def mask_of(kind, dyn):
    if kind == "torch":
        return torch.tensor(MASK, device=wp.device_to_torch(dyn.device))
    return MASK.copy() if kind == "numpy" else wp.array(MASK, dtype=wp.bool, device=dyn.device)


# -- values of some worlds ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize("granularity", ["tree", "node"])
def test_other_worlds_keep_their_values(granularity, device):
    """Masks and values of every kind, per world and shared, against the dense reference of each world."""
    more = {"granularity": granularity, "dtype": "float64", "device": device}
    dyn = spo.Dynamics(scene(), WORLDS, variable=NAMES, **more)
    a = laws.states(scene(), WORLDS)
    for seed, kind in enumerate(KINDS):
        start, new = ({name: drawn(name, [seed, i]) for name in NAMES} for i in range(2))
        new["joint_damping"] = new["joint_damping"][0]
        dyn.set(**start)
        mask = mask_of(kind, dyn)
        dyn.set(worlds=mask, **{name: made(kind, value, dyn) for name, value in new.items()})
        chosen = {n: np.where(MASK.reshape((-1,) + (1,) * (start[n].ndim - 1)), new[n], start[n]) for n in NAMES}
        mass, force = dyn.mass_matrix(a["q"]), dyn.passive_force(a["q"], a["qd"])
        for w in range(WORLDS):
            dense = Dense(scene().with_values(**{name: value[w] for name, value in chosen.items()}), a["q"][w])
            np.testing.assert_allclose(mass[w], dense.mass_matrix, atol=1e-12)
            np.testing.assert_allclose(force[w], dense.passive_force(a["qd"][w]), atol=1e-12)


def test_no_world_and_a_list(device):
    dyn = spo.Dynamics(scene(), WORLDS, device=device, dtype="float64", variable=("body_mass",))
    q = laws.states(scene(), WORLDS)["q"]
    before = dyn.mass_matrix(q)
    dyn.set(worlds=[False] * WORLDS, body_mass=drawn("body_mass", 1))
    np.testing.assert_array_equal(dyn.mass_matrix(q), before)
    dyn.set(worlds=[False, True, False], body_mass=drawn("body_mass", 1))
    assert (np.abs(dyn.mass_matrix(q) - before).max(axis=(1, 2)) > 1e-3).tolist() == [False, True, False]


def test_worlds_whose_table_would_crowd_the_cache(device):
    """Rows of 1 KiB, which lie further apart on a CPU."""
    worlds = 128
    dyn = spo.Dynamics(scene(), worlds, device=device, dtype="float64", granularity="tree", variable=("body_mass",))
    mass = scene().values["body_mass"] * np.random.default_rng(0).uniform(0.5, 2.0, (worlds, 1))
    dyn.set(body_mass=mass)
    q = np.tile(laws.states(scene(), 1)["q"], (worlds, 1))
    got = dyn.mass_matrix(q)
    for w in (0, 1, 64, 127):
        wanted = Dense(scene().with_values(body_mass=mass[w]), q[w]).mass_matrix
        np.testing.assert_allclose(got[w], wanted, atol=1e-12)


def grown(shape):
    return torch.ones(shape, dtype=torch.float64, requires_grad=True)


REFUSED = {
    "folded": (dict(worlds=MASK, gravity=np.zeros(3)), r"worlds= with gravity, which is folded.*variable=\('gravity'"),
    "grad": (dict(worlds=MASK, body_mass=grown(3)), "worlds= with body_mass, whose tensor requires grad.*torch.where"),
    "numbers": (dict(worlds=MASK * 1.0, body_mass=np.ones(3)), r"worlds is .*float64.*expected bool \(3,\) \[world\]"),
    "too many": (dict(worlds=np.ones(4, bool), body_mass=np.ones(3)), r"worlds is .*\(4,\); expected \(3,\)"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_in_words_and_nothing_is_set(case):
    dyn = spo.Dynamics(scene(), WORLDS, device="cpu", dtype="float64", variable=("body_mass",))
    given, words = REFUSED[case]
    before = dyn.recursions.parameters.value("body_mass").numpy().copy()
    with pytest.raises(ValueError, match="(?s)Dynamics.set: " + words):
        dyn.set(**given)
    np.testing.assert_array_equal(dyn.recursions.parameters.value("body_mass").numpy(), before)


def test_numbers_below_zero_are_refused_in_worlds_that_change():
    """Of NumPy arrays and lists; the worlds that a mask leaves alone may hold anything."""
    ball = spo.Scene(
        [spo.Body(1.0, inertia=np.eye(3))], [spo.Hinge("free", -1, 0)], contacts=[spo.Contact(0, point=(0, 0, 0))]
    )
    names = ("contact_friction", "contact_stiffness", "contact_damping")
    dyn = spo.Dynamics(ball, WORLDS, device="cpu", variable=names)
    held = dyn.recursions.parameters.value
    for name in names:
        value = np.where(MASK, 2.0, -1.0)[:, None]
        dyn.set(worlds=MASK, **{name: value})
        assert (held(name).numpy()[MASK] == 2.0).all() and (held(name).numpy() >= 0.0).all()
        for bad in (dict(worlds=MASK, **{name: -value}), {name: value}, {name: [-1.0]}):
            with pytest.raises(ValueError, match=f"Dynamics.set: {name} holds -[12].0; expected zero or more"):
                dyn.set(**bad)
        dyn.set(worlds=MASK, **{name: np.where(MASK, 2.0, -1.0).astype(np.float32)[:, None]})
        assert (held(name).numpy()[MASK] == 2.0).all()


def test_a_tensor_with_gradient_is_not_overwritten_in_some_worlds():
    """Its gradient would be that of worlds that no longer have its value."""
    dyn = spo.Dynamics(scene(), WORLDS, device="cpu", dtype="float64", variable=("body_mass",))
    dyn.set(body_mass=grown(3))
    with pytest.raises(ValueError, match="worlds= with body_mass, whose tensor requires grad"):
        dyn.set(worlds=MASK, body_mass=np.ones(3))


@pytest.mark.parametrize("transposed", [False, True])
def test_what_a_thread_copies_on_cuda(transposed, monkeypatch):
    """An entry of each array, run on the CPU: all worlds, some of them, and rows that all worlds share."""
    name = "TRANSPOSED" if transposed else "AS_THEY_ARE"
    monkeypatch.setattr(row_copies, name, getattr(row_copies, name).replace("defined(__CUDA_ARCH__)", "1"))
    types = (wp.float64, wp.float32) if transposed else (wp.float32, wp.float64)
    kernel, rng = row_copies.copy.__wrapped__(*types, 2, transposed), np.random.default_rng(0)
    given = [rng.normal(size=(WORLDS, 7)).astype(np.float32), rng.normal(size=(1, 2)).astype(np.float32)]
    sources = [wp.array(x, dtype=types[0], device="cpu") for x in given]
    for mask in (None, MASK):
        shapes = [(x.shape[1], WORLDS) if transposed else (WORLDS, x.shape[1]) for x in given]
        targets = [wp.full(shape, 9.0, dtype=types[1], device="cpu") for shape in shapes]
        chosen = None if mask is None else wp.array(mask, dtype=wp.bool, device="cpu")
        wp.launch(kernel, 7 * WORLDS, [WORLDS, chosen, *sources], targets, device="cpu")
        for x, target in zip(given, targets, strict=True):
            wanted = np.where(True if mask is None else mask[:, None], x, 9.0)
            wanted = np.broadcast_to(wanted, (WORLDS, x.shape[1]))
            np.testing.assert_array_equal(target.numpy().T if transposed else target.numpy(), wanted)


# -- states of some worlds ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shared", [False, True])
def test_reset(kind, shared, device):
    dyn = spo.Dynamics(scene(), WORLDS, device=device)
    rng = np.random.default_rng(0)
    q, q_from = rng.normal(size=(2, WORLDS, scene().coord_count))
    qd, qd_from = rng.normal(size=(2, WORLDS, scene().dof_count))
    q_from, qd_from = (x[0] if shared else x for x in (q_from, qd_from))
    arrays = [mask_of(kind, dyn), *(made(kind, x, dyn) for x in (q, qd, q_from, qd_from))]
    got = dyn.reset(*arrays)
    assert got[0] is arrays[1] and got[1] is arrays[2]
    for before, new, x in zip((q, qd), (q_from, qd_from), got, strict=True):
        x = x.cpu().numpy() if kind == "torch" else x.numpy() if kind == "warp" else x
        np.testing.assert_array_equal(x, np.where(MASK[:, None], new, before).astype(x.dtype))
    if kind != "numpy":
        with no_warp_allocation():
            dyn.reset(*arrays)
    with pytest.raises(ValueError, match=r"Dynamics.reset: q.* overlaps"):
        dyn.reset(arrays[0], arrays[1], arrays[2], arrays[1], arrays[4])


def test_both_inside_a_graph(device):
    if not device.is_cuda:
        pytest.skip("a graph needs CUDA: run with --device cuda:0")
    dyn = spo.Dynamics(scene(), WORLDS, device=device, dtype="float64", variable=NAMES)
    a = laws.to_device(dyn, laws.states(scene(), WORLDS))
    mask = mask_of("warp", dyn)
    values = {name: made("warp", drawn(name, 1), dyn) for name in NAMES}
    q, qd = wp.clone(a["q"]), wp.clone(a["qd"])
    out = dyn.mass_matrix(q)

    def work():
        dyn.set(worlds=mask, **values)
        dyn.reset(mask, q, qd, a["q"], a["qd"])
        dyn.mass_matrix(q, out=out)

    work()
    with wp.ScopedCapture(device) as capture:
        work()
    mask.assign(~MASK)
    values["body_mass"].assign(drawn("body_mass", 7))
    q.fill_(0.3)
    wp.capture_launch(capture.graph)
    got = out.numpy()
    work()
    np.testing.assert_array_equal(got, out.numpy())


# -- limits that vary --------------------------------------------------------------------------------------------------
def various():
    """Values of LIMITS by world: bounds that hold, bounds that are nowhere near, and none."""
    n, rng = scene().dof_count, np.random.default_rng(4)
    ball = np.array([hinge.kind == "ball" for hinge in scene().hinges]).repeat([h.dof_count for h in scene().hinges])
    inside = lambda low, high, none: np.where(ball, none, rng.uniform(low, high, (WORLDS, n)))  # noqa: E731
    values = {
        "joint_friction": rng.uniform(0.0, 1.0, (WORLDS, n)),
        "joint_limit_lower": inside(-0.3, 0.3, -1e10),
        "joint_limit_upper": inside(0.4, 0.8, 1e10),
        "joint_limit_ke": rng.uniform(1e2, 1e4, (WORLDS, n)),
        "joint_limit_kd": rng.uniform(1.0, 10.0, (WORLDS, n)),
        "joint_effort_limit": rng.uniform(1.0, 20.0, (WORLDS, n)),
        "joint_velocity_limit": rng.uniform(0.5, 1.5, (WORLDS, n)),
        "joint_rest_q": drawn("joint_rest_q", 3),
    }
    for name, none in (("effort_limit", 1e6), ("velocity_limit", 2e6), ("limit_lower", -1e10), ("limit_upper", 1e10)):
        values[f"joint_{name}"][1] = none
    return values


@functools.cache
def _limited(device):
    return spo.Dynamics(scene(), WORLDS, device=device, dtype="float64", granularity="tree", variable=LIMITS)


def limited(device):
    return _limited(device.alias)


def test_a_step_with_variable_limits_is_the_dense_equation(device):
    dyn, values = limited(device), various()
    dyn.set(**values)
    a = laws.states(scene(), WORLDS)
    a["tau"] *= 5.0
    q, qd = dyn.step(a["q"], a["qd"], a["tau"], H, target_q=a["q"][::-1].copy())
    for w in range(WORLDS):
        one = scene().with_values(**{name: value[w] for name, value in values.items()})
        given = [a[name][w] for name in ("q", "qd", "tau")]
        wanted = implicit.step(one, 0, H, *given, target_q=a["q"][::-1][w])
        np.testing.assert_allclose(qd[w], wanted[1], atol=TOLERANCE["float64"])
        np.testing.assert_allclose(q[w], wanted[0], atol=TOLERANCE["float64"])


def test_a_step_has_gradients_by_variable_limits(device):
    dyn, values = limited(device), various()
    a = laws.states(scene(), WORLDS)
    place = dict(dtype=torch.float64, device=wp.device_to_torch(device))
    q, qd, tau, target = (torch.tensor(x, **place) for x in (a["q"], a["qd"], 5.0 * a["tau"], a["q"][::-1].copy()))

    def run(*tensors):
        dyn.set(**dict(zip(LIMITS, tensors, strict=True)))
        return dyn.step(q, qd, tau, H, target_q=target)

    tensors = [torch.tensor(values[name][0], **place).requires_grad_() for name in LIMITS]
    assert check(run, tensors)
    gradients = torch.autograd.grad(sum(x.sum() for x in run(*tensors)), tensors)
    assert all(gradient.abs().max() > 0.0 for gradient in gradients)
    dyn.set(**{name: scene().values[name][0] for name in LIMITS})


def test_the_energy_of_springs_has_a_gradient_by_their_rest(device):
    dyn, q = limited(device), laws.states(scene(), WORLDS)["q"]
    place = dict(dtype=torch.float64, device=wp.device_to_torch(device))
    rest = torch.tensor(various()["joint_rest_q"], **place).requires_grad_()

    def run(rest):
        dyn.set(joint_rest_q=rest)
        return dyn.potential_energy(torch.tensor(q, **place))

    assert check(run, [rest])
    assert torch.autograd.grad(run(rest).sum(), rest)[0].abs().max() > 0.1
    dyn.set(joint_rest_q=scene().values["joint_rest_q"][0])


def test_rk4_refuses_friction_and_rates_that_may_come(device):
    dyn = limited(device)
    a = laws.states(scene(), WORLDS)
    with pytest.raises(spo.UnsupportedError, match="friction or velocity limits"):
        dyn.step(a["q"], a["qd"], None, H, options=spo.StepOptions(integrator="rk4"))
