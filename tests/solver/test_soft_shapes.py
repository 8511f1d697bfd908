"""The warning of shapes whose ke cannot carry their body: where they come to rest is the truth."""

import re
import warnings

import newton
import numpy as np
import pytest
import warp as wp

from warp_spo.newton import SolverSPO

SIZES = {"sphere": 0.4, "capsule": 0.3, "box": 0.2, "cylinder": 0.4}  # the smallest of each [m]


def heavy(masses):
    """Return bodies of one shape each, of Newton's default ke, on the plane z = 0; and the heights of their origins."""
    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    lying = wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), np.pi / 2)
    heights = [0.5 * SIZES[kind] for kind in masses]
    for i, (kind, mass) in enumerate(masses.items()):
        at = wp.transform((2.0 * i, 0.0, heights[i]), lying if kind == "capsule" else wp.quat_identity())
        body = builder.add_body(xform=at, label=kind)
        own = {"cfg": newton.ModelBuilder.ShapeConfig(density=0.0, kd=0.0), "label": kind}
        if kind == "sphere":
            builder.add_shape_sphere(body, radius=0.2, **own)
        elif kind == "capsule":
            builder.add_shape_capsule(body, radius=0.15, half_height=0.3, **own)
        elif kind == "box":
            builder.add_shape_box(body, hx=0.3, hy=0.2, hz=0.1, **own)
        else:
            builder.add_shape_cylinder(body, radius=0.3, half_height=0.2, **own)
        builder.body_mass[body], builder.body_inv_mass[body] = mass, 1.0 / mass
        builder.body_inertia[body] = wp.mat33(0.05 * mass * np.eye(3))
    return builder.finalize(device="cpu"), np.array(heights)


def depths(model, solver, heights, contacts):
    """Return how deep bodies lie after a while [m], damped by long implicit steps."""
    state, pipeline = model.state(), newton.CollisionPipeline(model) if contacts == "pipeline" else None
    found = None if pipeline is None else pipeline.contacts()
    for _ in range(80):
        if pipeline is not None:
            pipeline.collide(state, found)
        solver.step(state, state, None, found, 0.02)
    return heights - state.body_q.numpy()[:, 2]


def make_solver(model, contacts):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        solver = SolverSPO(model, variable=("shape_material_ke",), contacts=contacts, pairs=[])  # kernels for all ke
    return solver, [str(each.message) for each in caught if "ke of" in str(each.message)]


@pytest.mark.parametrize("contacts", ["ground", "pipeline"])
def test_shapes_that_sink_are_named_with_the_value_that_carries_them(contacts):
    kinds = ("sphere", "cylinder") if contacts == "ground" else ("capsule", "box")
    masses = dict.fromkeys(kinds, 1000.0)
    model, heights = heavy(masses)
    solver, (message,) = make_solver(model, contacts)
    assert message.startswith(f"SolverSPO: ke of {len(masses)} shape(s) is too small")
    sunk = depths(model, solver, heights, contacts)
    limits = np.array([0.1 * SIZES[kind] for kind in masses])
    assert (sunk > limits).all()
    needed = {
        kind: float(x)
        for kind, x in re.findall(r"\w+ '(\w+)' of body '\w+', 1e\+03 kg: 2.5e\+03, needs ([\d.e+]+)", message)
    }
    assert needed.keys() == masses.keys()
    ground = max(needed.values())
    model.shape_material_ke.assign(np.array([ground, *(2.0 * needed[kind] - ground for kind in masses)]))  # the means
    solver, messages = make_solver(model, contacts)
    rest = depths(model, solver, heights, contacts)
    assert messages == []
    np.testing.assert_array_less(rest, limits)
    np.testing.assert_array_less(0.9 * limits, rest)  # no more than two digits too much


def test_who_is_not_named():
    """Bodies that ke carries, that a joint carries, that nothing pulls, or that touch nothing; worlds count each."""
    masses = {"sphere": 1.0, "box": 15.0}
    _, messages = make_solver(heavy(masses)[0], "ground")
    assert messages == []
    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    link = builder.add_link(label="arm")
    builder.add_shape_box(link, hx=0.1, hy=0.1, hz=0.1, cfg=newton.ModelBuilder.ShapeConfig(density=1e6))
    builder.add_articulation([builder.add_joint_revolute(-1, link)])
    assert make_solver(builder.finalize(device="cpu"), "ground")[1] == []
    masses["box"] = 1000.0
    model, _ = heavy(masses)
    assert make_solver(model, "none")[1] == []
    worlds = newton.ModelBuilder()
    for _ in range(2):
        worlds.add_world(box_builder())
    model = worlds.finalize(device="cpu")
    model.body_mass.assign([1.0, 1000.0])
    ((message),) = make_solver(model, "ground")[1]
    assert "ke of 1 shape(s)" in message and "1e+03 kg" in message
    model.set_gravity((0.0, 0.0, 0.0))
    assert make_solver(model, "ground")[1] == []


def box_builder():
    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    body = builder.add_body(mass=1.0, inertia=wp.mat33(np.eye(3)), label="body\nof a world")
    builder.add_shape_box(body, hx=0.1, hy=0.1, hz=0.1, cfg=newton.ModelBuilder.ShapeConfig(density=0.0))
    return builder


def test_pairs_count_and_a_rebuilt_solver_is_silent():
    builder = newton.ModelBuilder()
    for i, mass in enumerate([1.0, 1000.0]):
        body = builder.add_body(xform=wp.transform((0.0, 0.0, 0.5 * i), wp.quat_identity()), mass=mass, label=f"b{i}")
        builder.add_shape_sphere(body, radius=0.2, cfg=newton.ModelBuilder.ShapeConfig(density=0.0))
    model = builder.finalize(device="cpu")
    with pytest.warns(UserWarning, match=r"ke of 1 shape.*of body 'b1', 1e\+03 kg: 2.5e\+03, needs 2.5e\+05") as caught:
        solver = SolverSPO(model, variable=(), contacts="none", pairs="all")
    assert caught[0].filename == __file__
    model.body_mass.assign([2.0, 1000.0])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        solver.notify_model_changed(newton.ModelFlags.BODY_INERTIAL_PROPERTIES)
    assert len(caught) == 1 and "rebuilt" in str(caught[0].message)
