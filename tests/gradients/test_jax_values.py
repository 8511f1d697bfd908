"""Values of the scene as arguments of JAX functions: results, gradients, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import warp_spo as spo
from support.contact_cases import box
from support.contact_steps import FIELDS, above
from support.hopping_leg import VARIABLE, H, leg, loss
from warp_spo import jax as spo_jax

DIFFERENCES = 1e-6  # of the largest entry, central differences in float64; 1e-8 measured


@pytest.fixture(autouse=True)
def float64(device):
    if not device.is_cpu:
        pytest.skip("on the CPU")
    with jax.enable_x64(True):
        yield


def as_jax(tensors):
    return {name: jnp.asarray(tensor.detach().numpy()) for name, tensor in tensors.items()}


@pytest.mark.slow
@pytest.mark.parametrize("substeps", [1, 2])
def test_gradients_by_values_are_those_of_torch(substeps):
    """By masses, gains, friction and materials; the values that the object has stay as they are."""
    dyn, tensors = leg("float64", "cpu")
    loss(dyn, tensors, substeps=substeps).sum().backward()
    given = as_jax(tensors)
    values = {name: given.pop(name) for name in VARIABLE}
    before = {name: 1.5 * dyn.recursions.parameters.value(name).numpy() for name in VARIABLE}
    dyn.set(**before)
    step = spo_jax.function(dyn, "step", dt=H, options=spo.StepOptions(substeps=substeps), values=VARIABLE)

    @jax.jit
    def number(values, q, qd, tau, target_q):
        after, rate = step(q, qd, tau, target_q=target_q, **values)
        return (after * after).sum() + (rate * rate).sum()

    found = jax.grad(number)(values, **given)
    for name in VARIABLE:
        np.testing.assert_array_equal(np.asarray(found[name]), tensors[name].grad.numpy(), err_msg=name)
        np.testing.assert_array_equal(dyn.recursions.parameters.value(name).numpy(), before[name])
    many = jax.vmap(number, in_axes=(0, None, None, None, None))(
        {name: jnp.stack([x, 1.1 * x]) for name, x in values.items()}, *given.values()
    )
    np.testing.assert_array_equal(many[0], number(values, **given))
    assert many[0] != many[1]


@pytest.mark.slow
def test_gradients_by_heights():
    """Through three steps of cubes on two fields, against differences; under vmap of several fields, too."""
    field, rng = FIELDS["stairs"], np.random.default_rng(0)
    heights = field.heights + 1e-3 * rng.normal(size=(2, *field.heights.shape))  # no two corners are equally low
    scene = box(ground=spo.HeightField(heights, field.cell, field.origin), friction=0.3)
    scene = scene.with_values(ground_field=np.arange(8)[:, None] % 2)
    a, weights = above(scene, 1, 8), jnp.asarray(rng.normal(size=(8, 6)))
    dyn = spo.Dynamics(scene, 8, "cpu", "float64", variable=("ground_heights",))
    step = spo_jax.function(dyn, "step", dt=H, values=("ground_heights",))

    @jax.jit
    def end(heights):
        q, qd = (jnp.asarray(a[name]) for name in ("q", "qd"))
        for _ in range(3):
            q, qd = step(q, qd, None, ground_heights=heights)
        return (qd * weights).sum()

    mine = np.asarray(jax.grad(end)(jnp.asarray(heights)))
    touched = np.argwhere(mine)
    assert mine.shape == heights.shape and len(touched) >= 20
    nudges = np.zeros((2, len(touched[::8]), *heights.shape))
    for at, place in enumerate(touched[::8]):
        nudges[(slice(None), at, *place)] = 1e-7, -1e-7
    ends = jax.vmap(jax.vmap(end))(heights + nudges)
    wanted, found = (ends[0] - ends[1]) / 2e-7, mine[tuple(touched[::8].T)]
    np.testing.assert_allclose(found, wanted, atol=DIFFERENCES * abs(mine).max())


def test_what_is_refused():
    scene = box(ground=FIELDS["rough"])
    dyn = spo.Dynamics(scene, 2, "cpu", "float64", variable=("ground_heights", "body_mass"))
    with pytest.raises(ValueError, match="values names 'gravity'; expected values that are variable: ground_heights"):
        spo_jax.function(dyn, "step", dt=H, values="gravity")
    with pytest.raises(ValueError, match="values with capture=True"):
        spo_jax.function(dyn, "step", dt=H, values="body_mass", capture=True)
    step = spo_jax.function(dyn, "step", dt=H, values=("ground_heights", "body_mass"))
    q, qd, mass, heights = jnp.zeros((2, 7)), jnp.zeros((2, 6)), jnp.ones((2, 1)), jnp.zeros((30, 20))
    with pytest.raises(TypeError, match="body_mass is missing"):
        step(q, qd, None, ground_heights=heights)
    with pytest.raises(ValueError, match=r"ground_heights has shape .*; expected"):
        step(q, qd, None, ground_heights=heights[:3], body_mass=mass)
    with pytest.raises(ValueError, match="ground_heights is given with arrays of one world"):
        step(q[0], qd[0], None, ground_heights=heights, body_mass=mass[0])
