"""Which way pairs of bodies are solved, where a caller asks for one."""

import pickle

import numpy as np
import pytest

import warp_spo as spo
from support.border import explained

SIZE, TURN = 0.02, np.sin(np.pi / 8)  # half the width of rails and of the bar [m]; of a turn by 45 degrees


def bar_on_rails():
    """A bar that lies with an edge on the upper edges of two rails, turned by 45 degrees about their axes."""
    turned = np.cos(np.pi / 8)
    rails = [spo.Contact(-1, box=((0.3, SIZE, SIZE), (0.0, y, 0.0, TURN, 0.0, 0.0, turned))) for y in (-0.15, 0.15)]
    bar = dict(body=0, box=((SIZE, 0.3, SIZE), (0.0, 0.0, 0.0, 0.0, TURN, 0.0, turned)), stiffness=2e4, damping=40.0)
    body = spo.Body(1.0, inertia=np.diag([0.03, 3e-4, 0.03]))
    contacts = [spo.Contact(other=rail, **bar) for rail in rails]
    scene = spo.Scene([body], [spo.Hinge("free", -1, 0)], contacts=contacts)
    return scene, np.array([[0.0, 0.0, 2.0 * np.sqrt(2.0) * SIZE, 0.0, 0.0, 0.0, 1.0]])


def test_edges_rest_on_edges_in_joint_space():
    """Generated code, the choice for few pairs, has no point there, and the bar falls between the rails."""
    scene, q = bar_on_rails()
    dyn = spo.Dynamics(scene, 1, "cpu", "float64", pair_solver="joint space")
    assert "joint space" in dyn.explain() and "joint space" not in spo.Dynamics(scene, 1, "cpu", "float64").explain()
    assert pickle.loads(pickle.dumps(dyn)).pair_solver == "joint space"
    start, qd = q[0, 2], np.zeros((1, 6))
    for _ in range(60):
        q, qd = dyn.step(q, qd, None, 5e-3)
    sink = 9.81 / 2.0 / 2e4  # of each edge
    assert abs(start - q[0, 2] - sink) < 0.5 * sink and np.abs(qd).max() < 1e-3


def test_other_solvers_are_refused():
    scene, _ = bar_on_rails()
    with explained(ValueError, "Dynamics", "'fast'", "'joint space'"):
        spo.Dynamics(scene, 1, "cpu", pair_solver="fast")


@pytest.mark.slow
def test_generated_code_misses_the_edges():
    """If it finds them one day, the choice of a solver can go."""
    scene, q = bar_on_rails()
    dyn, start, qd = spo.Dynamics(scene, 1, "cpu", "float64"), q[0, 2], np.zeros((1, 6))
    for _ in range(60):
        q, qd = dyn.step(q, qd, None, 5e-3)
    assert q[0, 2] < start - SIZE
