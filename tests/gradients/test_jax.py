"""Operations as JAX functions: under jit, grad and vmap, against the calls themselves, torch and finite differences."""

import functools
import importlib
import pickle
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
import warp as wp
import wrapped

import warp_spo as spo
from support import laws, zoo
from support.border import explained
from warp_spo import jax as spo_jax

WORLDS = 3
GRADIENTS = {
    "forward_dynamics": ("q", "qd", "tau", "body_f"),
    "inverse_dynamics": ("q", "qd", "qdd"),
    "step": ("q", "qd", "tau"),
    "solve_mass_matrix": ("q", "b"),
    "jacobian": ("q",),
    "integrate": ("q", "qd"),
}
SLOW = ("solve_mass_matrix", "jacobian", "integrate")  # one mathematics with the others, kernels of their own
OPTIONS = {"step": {"dt": 2e-3}, "integrate": {"dt": 0.1}, "jacobian": {"frames": [0, 1]}}
DIFFERENCE = 1e-6  # step of central differences in float64; their error is about its square, and 1e-10 of rounding
DIFFERENCES = 2e-7
enable_x64 = jax.enable_x64 if hasattr(jax, "enable_x64") else importlib.import_module("jax.experimental").enable_x64


@pytest.fixture(scope="module", autouse=True)
def float64(device):
    if not device.is_cpu:
        pytest.skip("on the CPU; benchmarks/jax_check.py looks at a GPU")
    with enable_x64(True):
        yield


@functools.cache
def robot(dtype="float64", **options):
    """A ball and a sprung revolute hinge: quaternions, velocity terms, laws in the step."""
    scene = zoo.from_parents([-1, 0], ["ball", "revolute"], 5)
    return spo.Dynamics(scene, WORLDS, "cpu", dtype, granularity="tree", **options)


@functools.cache
def plain():
    """A tree at node granularity, whose kernels all scenes share."""
    return spo.Dynamics(zoo.fork(), WORLDS, "cpu", "float64", granularity="node")


def arrays(dyn, *names, make=jnp.asarray):
    states = laws.states(dyn.scene, WORLDS, dtype=dyn.dtype.__name__)
    return [make(states[name].astype(dyn.dtype.__name__)) for name in names]


def direct(dyn, operation, *given):
    """The result of the method itself, of NumPy arrays."""
    names = {name: np.asarray(x) for name, x in zip(GRADIENTS[operation], given, strict=False)}
    return getattr(dyn, operation)(**names, **OPTIONS.get(operation, {}))


def first(result):
    return result[0] + 0.3 * result[1].sum() if isinstance(result, tuple) else result


def loss_of(f, weights):
    """A number that every entry of every result enters with a weight of its own."""

    def loss(*given):
        found = f(*given)
        return sum((w * x).sum() for w, x in zip(weights, found if isinstance(found, tuple) else (found,), strict=True))

    return loss


def weights_of(result):
    rng = np.random.default_rng(3)
    return [rng.normal(size=x.shape) for x in (result if isinstance(result, tuple) else (result,))]


@pytest.mark.parametrize("operation", [pytest.param(n, marks=[pytest.mark.slow] * (n in SLOW)) for n in GRADIENTS])
def test_under_jit_and_grad(operation):
    """The results are those of the method to the bit; gradients are torch's to the bit, and those of differences."""
    dyn, names = robot(), GRADIENTS[operation]
    given = [x[..., 0] if name == "b" else x for name, x in zip(names, arrays(dyn, *names), strict=True)]
    f = spo_jax.function(dyn, operation, **OPTIONS.get(operation, {}))
    expected = direct(dyn, operation, *given)
    for found in (f(*given), jax.jit(f)(*given)):
        for one, wanted in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            assert one.dtype == jnp.float64
            np.testing.assert_array_equal(one, wanted)

    weights = weights_of(expected)
    loss, by = loss_of(f, weights), tuple(range(len(names)))
    eager, compiled = jax.grad(loss, by)(*given), jax.jit(jax.grad(loss, by))(*given)

    tensors = [torch.tensor(np.asarray(x), requires_grad=True) for x in given]
    in_torch = getattr(dyn, operation)(**dict(zip(names, tensors, strict=True)), **OPTIONS.get(operation, {}))
    loss_of(lambda: in_torch, map(torch.tensor, weights))().backward()

    plainly = loss_of(lambda *x: direct(dyn, operation, *x), weights)
    rng = np.random.default_rng(4)
    for i, (one, other, tensor) in enumerate(zip(eager, compiled, tensors, strict=True)):
        np.testing.assert_array_equal(one, other)
        np.testing.assert_array_equal(one, tensor.grad.numpy())
        along = rng.normal(size=one.shape)
        ends = [[*given[:i], given[i] + sign * DIFFERENCE * along, *given[i + 1 :]] for sign in (1.0, -1.0)]
        slope = (plainly(*ends[0]) - plainly(*ends[1])) / (2.0 * DIFFERENCE)
        scale = np.abs(np.asarray(one) * along).sum() + 1.0
        assert abs((np.asarray(one) * along).sum() - slope) < DIFFERENCES * scale, names[i]


@pytest.mark.slow
def test_several_columns():
    """They go through at once; gradients go through vmap over them."""
    dyn = robot()
    f = spo_jax.function(dyn, "solve_mass_matrix")
    q, b = arrays(dyn, "q", "b")
    expected = dyn.solve_mass_matrix(np.asarray(q), np.asarray(b))
    np.testing.assert_array_equal(f(q, b), expected)
    by_column = jax.vmap(f, in_axes=(None, -1), out_axes=-1)
    np.testing.assert_allclose(by_column(q, b), expected, rtol=1e-12)  # another kernel, of one column
    tensors = [torch.tensor(np.asarray(x), requires_grad=True) for x in (q, b)]
    dyn.solve_mass_matrix(*tensors).square().sum().backward()
    for found, tensor in zip(jax.grad(lambda *x: (by_column(*x) ** 2).sum(), (0, 1))(q, b), tensors, strict=True):
        np.testing.assert_allclose(found, tensor.grad, rtol=1e-12)  # three columns, added in another order
    with explained(ValueError, "solve_mass_matrix", "b has an axis of columns", "expected one column", "jax.vmap"):
        jax.grad(lambda q: f(q, b).sum())(q)


def test_a_wrong_gradient_is_seen(monkeypatch):
    """The planted bug: gradients change places."""
    pull = spo_jax.operations.JaxOperation._pull_back
    monkeypatch.setattr(
        spo_jax.operations.JaxOperation, "_pull_back", lambda *a: (lambda x: (x[0], x[2], x[1], *x[3:]))(pull(*a))
    )
    with pytest.raises(AssertionError):
        test_under_jit_and_grad("forward_dynamics")


def test_vmap_is_the_batch():
    """vmap over worlds is one call; more rows are several, in the rows' order; nested axes count as one."""
    dyn = plain()
    f = spo_jax.function(dyn, "inverse_dynamics")
    q, qd, qdd = arrays(dyn, "q", "qd", "qdd")
    expected = np.asarray(f(q, qd, qdd))
    np.testing.assert_array_equal(jax.vmap(f)(q, qd, qdd), expected)
    np.testing.assert_array_equal(
        jax.jit(jax.vmap(f, in_axes=(0, 1, None)))(q, qd.T, qdd[0]), f(q, qd, qdd[:1] + 0 * qdd)
    )
    slower = jnp.stack([qd, 0.5 * qd])
    for found in (
        jax.vmap(f, in_axes=(None, 0, None))(q, slower, qdd),  # of whole batches
        jax.vmap(jax.vmap(f), in_axes=(None, 0, None))(q, slower, qdd),  # of worlds
    ):
        np.testing.assert_array_equal(found[0], expected)
        np.testing.assert_array_equal(found[1], f(q, 0.5 * qd, qdd))
    mass = dyn.mass_matrix(np.asarray(q))
    found = jax.vmap(jax.jacrev(f, argnums=2))(q, qd, qdd)
    np.testing.assert_allclose(found, mass, rtol=0, atol=1e-13 * np.abs(mass).max())
    with explained(ValueError, "inverse_dynamics", "1 rows", "expected 3", "worlds=1"):
        f(q[1], qd[1], qdd[1])
    with explained(jax.errors.JaxRuntimeError, "inverse_dynamics", "2 rows", "expected 3", "multiple", "worlds=2"):
        jax.vmap(f)(q[:2], qd[:2], qdd[:2]).block_until_ready()


def test_gradients_under_vmap_and_scan():
    dyn = robot()
    f = spo_jax.function(dyn, "forward_dynamics")
    q, qd, tau = arrays(dyn, "q", "qd", "tau")
    loss = lambda *given: (f(*given) ** 2).sum()  # noqa: E731
    np.testing.assert_array_equal(jax.vmap(jax.grad(loss))(q, qd, tau), jax.grad(loss)(q, qd, tau))

    step = spo_jax.function(dyn, "step", dt=2e-3)

    def end(push):
        def body(state, _):
            return step(*state, push), None

        return jax.lax.scan(body, (q, qd), length=3)[0][1].sum()

    found = jax.jit(jax.grad(end))(tau)
    a, b, push = (torch.tensor(np.asarray(x)) for x in (q, qd, tau))
    push.requires_grad_()
    for _ in range(3):
        a, b = dyn.step(a, b, push, 2e-3)
    b.sum().backward()
    np.testing.assert_allclose(found, push.grad, rtol=1e-13)  # torch and XLA add three gradients in another order


def test_substeps():
    """One launch forward; the way back goes through each substep."""
    dyn = robot()
    once, thrice = (spo_jax.function(dyn, "step", dt=2e-3, options=spo.StepOptions(substeps=n)) for n in (1, 3))
    q, qd, tau = arrays(dyn, "q", "qd", "tau")

    def chain(q, qd, tau):
        for _ in range(3):
            q, qd = once(q, qd, tau)
        return q, qd

    for one, other in zip(thrice(q, qd, tau), chain(q, qd, tau), strict=True):
        np.testing.assert_array_equal(one, other)
    gradients = (jax.jit(jax.grad(lambda *x, f=f: (f(*x)[1] ** 2).sum(), (0, 1, 2))) for f in (thrice, chain))
    for one, other in zip(*(gradient(q, qd, tau) for gradient in gradients), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_step_without_tau():
    """None stands for it by position and by name, as in the method; the other arrays have their gradients."""
    dyn = robot()
    f = spo_jax.function(dyn, "step", dt=2e-3)
    q, qd, tau = arrays(dyn, "q", "qd", "tau")
    zero = jnp.zeros_like(tau)
    for found in (f(q, qd, None), f(q=q, qd=qd, tau=None), jax.jit(lambda q, qd: f(q, qd, None))(q, qd)):
        for one, wanted in zip(found, f(q, qd, zero), strict=True):
            np.testing.assert_allclose(one, wanted, atol=1e-13)  # of a state of size 1; another kernel
    one, wanted = (jax.grad(lambda qd, last=last: f(q, qd, last)[0].sum())(qd) for last in (None, zero))
    np.testing.assert_allclose(one, wanted, atol=1e-13)


def test_status():
    """It follows the results, and lets gradients pass."""
    dyn = plain()
    f = spo_jax.function(dyn, "forward_dynamics", status=True)
    q, qd, tau = arrays(dyn, "q", "qd", "tau")
    found, status = jax.jit(f)(q, qd.at[1, 0].set(jnp.nan), tau)
    assert status.dtype == jnp.int32 and status.tolist() == [0, spo.Status.NOT_FINITE, 0]
    np.testing.assert_array_equal(found[::2], spo_jax.function(dyn, "forward_dynamics")(q, qd, tau)[::2])
    assert jax.vmap(f)(q, qd, tau)[1].shape == (WORLDS,)
    with_status, bare = (spo_jax.function(robot(), "forward_dynamics", **more) for more in ({"status": True}, {}))
    q, qd, tau = arrays(robot(), "q", "qd", "tau")
    loss = lambda found: (found**2).sum()  # noqa: E731
    expected = jax.grad(lambda x: loss(bare(q, qd, x)))(tau)
    np.testing.assert_array_equal(jax.grad(lambda x: loss(with_status(q, qd, x)[0]))(tau), expected)
    with explained(TypeError, "status is 1", "expected True"):
        spo_jax.function(dyn, "forward_dynamics", status=1)
    with explained(TypeError, "gravity_force", "status= is no option"):
        spo_jax.function(dyn, "gravity_force", status=True)


def test_a_step_over_arrays_of_another_library():
    dyn = robot()
    q, qd, tau = arrays(dyn, "q", "qd", "tau", make=np.array)
    expected = dyn.step(q, qd, tau, 2e-3)
    state = wrapped.Array(q), wrapped.Array(qd)
    for one, other, wanted in zip(dyn.step(*state, tau, 2e-3, out=state), state, expected, strict=True):
        assert one is other
        np.testing.assert_array_equal(one.inside, wanted)


def test_only_the_gradients_that_are_asked_for_are_computed(monkeypatch):
    dyn = robot()
    asked = []
    pull = type(dyn._gradients).pull_back
    monkeypatch.setattr(type(dyn._gradients), "pull_back", lambda *a: asked.append(a[-1]) or pull(*a))
    f = spo_jax.function(dyn, "forward_dynamics")
    q, qd, tau = arrays(dyn, "q", "qd", "tau")
    jax.jit(jax.grad(lambda x: f(q, qd, x).sum()))(tau)
    assert asked and set(asked) == {("tau",)}


def test_values_that_are_set_later():
    """A compiled function reads what the Dynamics holds when it runs."""
    dyn = spo.Dynamics(zoo.fork(), WORLDS, "cpu", "float64", variable=("gravity",), granularity="node")
    f = jax.jit(spo_jax.function(dyn, "gravity_force"))
    (q,) = arrays(dyn, "q")
    f(q).block_until_ready()
    for gravity in ((1.0, 2.0, 3.0), (0.0, 0.0, 0.0)):
        dyn.set(gravity=np.array(gravity))
        np.testing.assert_array_equal(f(q), dyn.gravity_force(np.asarray(q)))
    with pytest.warns(UserWarning, match="folded"):
        dyn.set(gravity=np.array([0.0, 0.0, -1.0]), body_mass=2.0 * dyn.scene.values["body_mass"][0])
    np.testing.assert_array_equal(f(q), dyn.gravity_force(np.asarray(q)))


def test_rows_whose_world_is_not_known():
    dyn = spo.Dynamics(zoo.fork(), WORLDS, "cpu", "float64", variable=("gravity",), granularity="node")
    f = spo_jax.function(dyn, "gravity_force")
    (q,) = arrays(dyn, "q")
    twice = jnp.stack([q, q])
    np.testing.assert_array_equal(jax.vmap(f)(twice)[1], f(q))  # whole batches: known
    with explained(jax.errors.JaxRuntimeError, "gravity_force", "6 rows for 3 worlds", "[world, ...]", "worlds=6"):
        jax.vmap(jax.vmap(f))(twice).block_until_ready()


def test_float32_and_the_switch():
    single, double = robot("float32"), robot()
    wide = arrays(double, "q", "qd", "qdd")
    q, qd, qdd = arrays(single, "q", "qd", "qdd")
    with enable_x64(False):
        f = spo_jax.function(single, "inverse_dynamics")
        assert f(q, qd, qdd).dtype == jnp.float32
        with explained(ValueError, "float64", "turned off", "expected", "jax_enable_x64", "dtype='float32'"):
            spo_jax.function(double, "inverse_dynamics")
    g = spo_jax.function(double, "inverse_dynamics")
    with enable_x64(False), explained(ValueError, "jax_enable_x64"):
        g(q, qd, qdd)
    with explained(ValueError, "q is float32", "expected float64", "q.astype('float64')", "dtype='float32'"):
        g(q, qd, qdd)
    with enable_x64(False), explained(ValueError, "inverse_dynamics", "float64", "turned off", "jax_enable_x64"):
        double.inverse_dynamics(*wide)  # the call itself
    np.testing.assert_array_equal(g(*map(np.asarray, (q, qd, qdd))), direct(double, "inverse_dynamics", q, qd, qdd))


def test_errors():
    dyn = plain()
    q, qd, qdd = arrays(dyn, "q", "qd", "qdd")
    with explained(TypeError, "warp_spo.jax.function", "dyn is of type Scene", "expected a Dynamics"):
        spo_jax.function(dyn.scene, "step")
    assert spo.jax is spo_jax
    with explained(ValueError, "'fly'", "expected one of forward_dynamics"):
        spo_jax.function(dyn, "fly")
    with explained(TypeError, "step", "dt is missing", "expected dt="):
        spo_jax.function(dyn, "step")
    with explained(TypeError, "step", "actuator_state=", "memory that the call writes"):
        spo_jax.function(dyn, "step", dt=0.1, actuator_state=None)
    with explained(ValueError, "warp_spo.jax.function('jacobian')", "frames is 5", "expected a list"):
        spo_jax.function(dyn, "jacobian", frames=5)
    with explained(TypeError, "warp_spo.jax.function('step')", "dt is 'soon'", "expected a number of seconds"):
        spo_jax.function(dyn, "step", dt="soon")
    with explained(TypeError, "gravity_force", "dt= is no option", "expected none"):
        spo_jax.function(dyn, "gravity_force", dt=0.1)
    f = spo_jax.function(dyn, "body_velocities")
    for wrong in (lambda: f(), lambda: f(q), lambda: f(q, qd, qdd), lambda: f(q, qd, qd=qd), lambda: f(q, speed=qd)):
        with explained(TypeError, "body_velocities", "expected q, qd", "once"):
            wrong()
    with explained(TypeError, "out= is given", "cannot be written", "returns"):
        f(q, qd, out=qd)
    with explained(TypeError, "qd is of type Tensor", "expected a JAX or a NumPy array"):
        f(q, torch.zeros(3, 3))
    with explained(ValueError, "qd has shape (2, 2)", "expected (3, 11) [world, dof]", "one world under vmap"):
        f(q, jnp.zeros((2, 2)))
    with explained(ValueError, "qd has shape", "expected (11,) [dof]", "the first array is of one world"):
        f(q[0], qd)
    with explained(ValueError, "body_states", "no gradient", "expected one of", "stop_gradient"):
        jax.grad(lambda q: spo_jax.function(dyn, "body_states")(q, qd)[0].sum())(q)
    with explained(ValueError, "interpolate", "no gradient by s", "expected gradients by q0, q1", "stop_gradient(s)"):
        between, (start,) = spo_jax.function(robot(), "interpolate"), arrays(robot(), "q")
        jax.grad(lambda s: between(start, 1.1 * start, s).sum())(jnp.full(WORLDS, 0.3))
    slope = jax.grad(lambda qd: (f(q, qd) ** 2).sum())
    with explained(ValueError, "body_velocities", "differentiated once more", "expected first", "finite differences"):
        jax.grad(lambda qd: slope(qd).sum())(qd)
    with explained(TypeError, "jvp"):  # JAX's own words
        jax.jvp(lambda qd: f(q, qd), (qd,), (qd,))
    stopped = spo_jax.function(dyn, "body_states")
    assert not jax.grad(lambda q: jax.lax.stop_gradient(stopped(q, qd)[0]).sum())(q).any()


def test_results_have_the_methods_form():
    dyn = robot()
    q, qd, tau = arrays(dyn, "q", "qd", "tau")
    found = jax.jit(spo_jax.function(dyn, "forward_dynamics_derivatives"))(q, qd, tau)
    expected = dyn.forward_dynamics_derivatives(*map(np.asarray, (q, qd, tau)))
    assert type(found) is type(expected)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)
    alone = spo.Dynamics(dyn.scene, 1, "cpu", "float64", granularity="tree")
    np.testing.assert_array_equal(
        spo_jax.function(alone, "inverse_dynamics")(q[1], qd[1], tau[1]), direct(dyn, "inverse_dynamics", q, qd, tau)[1]
    )


def test_a_call_waits_for_what_jax_still_computes():
    """JAX computes in threads of its own, which wait for their turn at the Dynamics: a caller must not hold it."""
    dyn = plain()
    f = spo_jax.function(dyn, "gravity_force")
    (q,) = arrays(dyn, "q")
    busy = jnp.eye(600) * 0.999
    late = jax.jit(lambda q, x: q + 0.0 * f(q + 0.0 * (x @ x @ x @ x @ x @ x @ x @ x)[0, 0]).sum())
    late(q, busy).block_until_ready()
    pending, found = late(q, busy), []
    assert not pending.is_ready()

    def call():
        with enable_x64(True):
            found.append(dyn.gravity_force(pending))

    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    thread.join(20.0)
    assert found, "the call holds the turn that JAX waits for"
    np.testing.assert_array_equal(found[0], f(q))


def test_a_dynamics_that_jax_uses_still_pickles():
    dyn = robot("float32")
    assert pickle.loads(pickle.dumps(dyn)).dtype is wp.float32


def test_errors_name_ways_that_are_taken():
    """Not a Dynamics with dtype="int32", and no function of what is no operation."""
    dyn = robot()
    q = jnp.zeros((WORLDS, dyn.scene.coord_count), jnp.int32)
    with pytest.raises(ValueError, match=r"q is int32 .*; expected float64; pass q.astype\('float64'\)$"):
        spo_jax.function(dyn, "forward_dynamics")(q)
    with pytest.raises(ValueError, match=r"convert it to float64; in JAX that takes .*jax_enable_x64"):
        dyn.forward_dynamics(q)
    E = spo.BWA(spo.Digraph([(0, 1)]), [np.eye(1)])
    with pytest.raises(TypeError, match=r"traced by JAX.*; call BWA.apply outside of JAX's functions"):
        jax.jit(lambda x: E.apply(x))(jnp.zeros((1, 2)))
