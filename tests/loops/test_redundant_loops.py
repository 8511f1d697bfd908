"""Closures that are redundant in every configuration, in both ways of closing them: cranks, spatial linkages, doors."""

import itertools

import numpy as np
import pytest

import warp_spo as spo
from support import laws
from support.closed_loops import DIFFERENCES, both
from support.mechanisms import Closed
from support.quick import slow_unless
from support.redundant_loops import bennett, cranks, cranks_beside_a_door, door, folded, level, sarrus
from warp_spo.dynamics.loop_analysis import ClosureEvaluator, draw_configurations, embedding, find_usual_rank

FLOAT32 = 1e-5  # ten times what these mechanisms reach
NEARLY = 1e-6  # [rad] by which states are off their closures
LINKAGES = {
    "three cranks": (cranks([1.0, 0.5]), level(3), 3),
    "four cranks": (cranks([1.0, 0.5, 0.25]), level(4), 4),
    "six cranks": (cranks([1.0, 0.2, 0.4, 0.6, 0.8]), level(6), 6),
    "Bennett": (bennett(), None, 2),
    "Sarrus": (sarrus(), folded(), 4),
}
"""Scene, configurations that close it, and the number of rows that count: dofs of the open tree but one."""
SINGLE = {"door": door(), "drawer": door("prismatic", apart=(0.0, 0.5, 0.0)), "ball": door("ball")}


def state(name):
    """The scene, consistent states, three worlds, and Lagrange's accelerations."""
    scene, q, _ = LINKAGES[name]
    if q is None:
        q = ClosureEvaluator(scene).close(draw_configurations(scene, 64))
        q = q[np.argsort(-np.abs(np.sin(q)).min(axis=1))[:3]]  # far from flat
    rng, closed = np.random.default_rng(0), [Closed(scene, row) for row in q]
    qd = np.array([c.consistent(rng.normal(size=scene.dof_count)) for c in closed])
    tau = rng.normal(size=qd.shape)
    return scene, q, qd, tau, np.array([c.forward_dynamics(*row) for c, *row in zip(closed, qd, tau, strict=True)])


@pytest.mark.parametrize(
    ("name", "dtype"),
    slow_unless(
        [("three cranks", "float64"), ("three cranks", "float32"), ("Bennett", "float64"), ("Sarrus", "float64")],
        itertools.product(LINKAGES, ["float64", "float32"]),
    ),
)
def test_redundant_linkages_move_as_lagrange_says(name, dtype, device):
    """Both ways, with status OK, and nearly closed, too, where the rows that are redundant differ by a rounding."""
    scene, q, qd, tau, wanted = state(name)
    assert find_usual_rank(scene) == len(embedding(scene).rows) == LINKAGES[name][2]
    near = q + NEARLY * np.random.default_rng(1).normal(size=q.shape)
    for dyn in both(scene, 3, device, dtype):
        status = np.full(3, -1, dtype=np.int32)
        qdd = dyn.forward_dynamics(q, qd, tau, status=status)
        np.testing.assert_array_equal(status, 0)
        assert laws.error(qdd, wanted) <= (DIFFERENCES if dtype == "float64" else FLOAT32)
        qdd = dyn.forward_dynamics(near, qd, tau, status=status)
        np.testing.assert_array_equal(status, 0)
        assert laws.error(qdd, wanted) <= 100.0 * NEARLY


def test_three_cranks_in_closed_form(device):
    """Of 1 kg bars at one angle: qdd (1, -1, 1, 1) by the equation of the one angle, as cut elsewhere."""
    scene, direction = cranks([1.0, 0.5]), np.array([1.0, -1.0, 1.0, 1.0])
    angle, rate, tau = 0.7, 2.0, np.array([[0.3, 0.0, 0.1, 0.2]])
    for dyn in both(scene, 1, device):
        qdd = dyn.forward_dynamics(level(3, (angle,)), rate * direction[None], tau)
        masses = scene.values["body_mass"][0]
        inertia = scene.values["body_inertia"][0, :, 1, 1]
        # three cranks turn about their feet, the coupler moves on a circle and does not turn
        total = sum(inertia[i] + masses[i] * 0.2**2 for i in (0, 2, 3)) + masses[1] * 0.4**2
        gravity = scene.values["gravity"][0, 2]
        lift = (masses[0] + masses[2] + masses[3]) * 0.2 + masses[1] * 0.4  # of all weights, per sine of the angle
        power = tau[0] @ direction - gravity * lift * np.cos(angle)
        np.testing.assert_allclose(qdd, power / total * direction[None], rtol=1e-12)
        assert abs(qdd[0, 0] - 25.322) < 1e-3


@pytest.mark.parametrize("name", slow_unless(["door"], SINGLE))
def test_what_is_hinged_twice_moves_as_hinged_once(name, device):
    """All rows of the second hinge are rounding in every configuration; before, the rounding counted, status OK."""
    scene, rng = SINGLE[name], np.random.default_rng(0)
    q, qd, tau = rng.normal(size=(3, 3, 1))
    free = spo.Dynamics(scene.without_loops(), 3, device=device, dtype="float64")
    for dyn in both(scene, 3, device):
        status = np.full((2, 3), -1, dtype=np.int32)
        qdd = dyn.forward_dynamics(q, qd, tau, status=status[0])
        assert laws.error(qdd, free.forward_dynamics(q, qd, tau)) <= 1e-13
        for one, other in zip(dyn.step(q, qd, tau, 1e-2, status=status[1]), free.step(q, qd, tau, 1e-2), strict=True):
            assert laws.error(one, other) <= 1e-13
        np.testing.assert_array_equal(status, 0)


def test_a_door_beside_cranks_moves_alone(device):
    """Rows that are rounding count neither for a rank nor for the forces of others."""
    scene, (_, q, qd, tau, wanted) = cranks_beside_a_door(), state("three cranks")
    leaf = spo.Dynamics(door().without_loops(), 3, device=device, dtype="float64")
    own = np.random.default_rng(0).normal(size=(3, 3, 1))
    for dyn in both(scene, 3, device):
        status = np.full(3, -1, dtype=np.int32)
        q_all, qd_all, tau_all = (np.hstack([a, b]) for a, b in zip((q, qd, tau), own, strict=True))
        qdd = dyn.forward_dynamics(q_all, qd_all, tau_all, status=status)
        np.testing.assert_array_equal(status, 0)
        assert laws.error(qdd, np.hstack([wanted, leaf.forward_dynamics(*own)])) <= DIFFERENCES


@pytest.mark.slow
def test_cranks_without_gravity_turn_evenly(device):
    """A second of steps, away from the flat change point, in both ways."""
    scene = cranks([1.0, 0.5, 0.25])
    scene = scene.with_values(gravity=[0.0, 0.0, 0.0])
    q, qd = level(4, (0.9,)), 0.5 * np.array([[1.0, -1.0, 1.0, 1.0, 1.0]])
    for dyn in both(scene, 1, device):
        at, rate, status = q, qd, np.full(1, -1, dtype=np.int32)
        for _ in range(200):
            at, rate = dyn.step(at, rate, None, 5e-3, status=status)
            np.testing.assert_array_equal(status, 0)
        assert np.abs(dyn.closure_error(at)).max() <= 1e-12
        np.testing.assert_allclose(rate, qd, atol=1e-9)
