"""Laws of the equations of motion nu' + C(q, nu) = eps; test_operational.py compares with the reference."""

import numpy as np
import pytest

import warp_spo as spo
from support import custom_hinges, laws, symbolic, zoo
from support.flexible_scenes import Traced
from support.flexible_trees import TREES
from support.flexible_trees import states as flexible_states
from support.flexible_trees import tree as flexible_tree
from support.quick import slow_unless
from warp_spo.examples import quasi_velocities as example
from warp_spo.reference.dense import Dense

NAMES = ["chain7", "fork", "every_d6", "forest", "floating_tree"]
CUSTOM = ("rolling_knee", "ellipsoid_shoulder", "many_functions")
SCENES = {name: zoo.SCENES[name] for name in NAMES} | {"custom": lambda: custom_hinges.skeleton(names=CUSTOM)}
ROUNDING = 1e-12  # relative to the largest entry; cond(M) of the worst scene is 1e4
DIFFERENCES = 1e-9  # of order 8, with rounding over a step of 0.001 s or more
WEIGHTS = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}  # of central differences over so many steps


def run(scene, operation, a, given):
    return symbolic.run(scene, operation, a, given.split(), {"out": (scene.dof_count,)})["out"]


def nu_of(scene, q, qd):
    return run(scene, "quasi_velocities", {"q": q, "qd": qd}, "q qd")


@pytest.mark.parametrize("name", SCENES)
def test_the_way_back(name):
    scene = SCENES[name]()
    a = laws.states(scene, 2)
    nu = nu_of(scene, a["q"], a["qd"])
    assert laws.error(run(scene, "generalized_velocities", a | {"nu": nu}, "q nu"), a["qd"]) <= ROUNDING


@pytest.mark.parametrize("name", SCENES)
def test_coriolis_forces_do_no_work_and_are_quadratic(name):
    scene = SCENES[name]()
    a = laws.states(scene, 3)
    nu = nu_of(scene, a["q"], a["qd"])
    C = run(scene, "quasi_velocity_coriolis", a | {"nu": nu}, "q nu")
    work = np.einsum("wi,wi->w", nu, C)
    assert np.abs(work).max() <= ROUNDING * np.linalg.norm(nu, axis=1).max() * np.linalg.norm(C, axis=1).max()
    np.testing.assert_array_equal(run(scene, "quasi_velocity_coriolis", a | {"nu": -2.0 * nu}, "q nu"), 4.0 * C)
    assert np.abs(C).max() > 0.1


@pytest.mark.parametrize("name", SCENES)
def test_forces_have_the_power_of_what_exerts_them(name):
    """eps . nu = tau . qd, with the power of gravity and of wrenches on bodies."""
    scene = SCENES[name]()
    a = laws.states(scene, 2)
    nu = nu_of(scene, a["q"], a["qd"])
    eps = run(scene, "quasi_velocity_force", a, "q tau body_f")
    for w in range(2):
        force = a["tau"][w] - Dense(scene, a["q"][w]).bias_force(np.zeros(scene.dof_count), a["body_f"][w])
        assert eps[w] @ nu[w] == pytest.approx(force @ a["qd"][w], rel=1e-11)


@pytest.mark.parametrize("name", ["chain7", "fork", "forest", "custom"])
def test_the_rate_of_nu_along_a_motion(name):
    """eps - C equals finite differences of nu while forward dynamics moves q and qd, to the order that they need."""
    scene = SCENES[name]()
    a = {key: array[0] for key, array in laws.states(scene, 1).items()}
    dense = Dense(scene, a["q"])
    qdd = dense.forward_dynamics(a["qd"], a["tau"], a["body_f"])
    h = 0.01 / max(1.0, np.abs(a["qd"]).max())
    times = h * np.array([sign * step for step in WEIGHTS for sign in (1, -1)])
    q = np.array([dense.integrate(a["qd"], t) for t in times])  # to first order in t; so is what the rate sees
    nu = nu_of(scene, q, a["qd"] + times[:, None] * qdd)
    rate = sum(weight * (nu[2 * i] - nu[2 * i + 1]) for i, weight in enumerate(WEIGHTS.values())) / h
    worlds = {key: array[None] for key, array in a.items()}
    worlds["nu"] = nu_of(scene, worlds["q"], worlds["qd"])
    eps = run(scene, "quasi_velocity_force", worlds, "q tau body_f")
    C = run(scene, "quasi_velocity_coriolis", worlds, "q nu")
    assert laws.error((eps - C)[0], rate) <= DIFFERENCES


def test_quaternions_of_any_length():
    scene = zoo.SCENES["forest"]()
    a = laws.states(scene, 2)
    longer = a["q"].copy()
    for hinge, start in zip(scene.hinges, scene.q_start, strict=False):
        for first in hinge.quaternions:
            longer[:, start + first : start + first + 4] *= 1.7
    assert not np.array_equal(longer, a["q"])
    C = run(scene, "quasi_velocity_coriolis", a | {"nu": a["qdd"]}, "q nu")
    again = run(scene, "quasi_velocity_coriolis", a | {"nu": a["qdd"], "q": longer}, "q nu")
    assert laws.error(again, C) <= ROUNDING


def test_a_dof_that_moves_nothing_is_nan(device):
    hinges = [spo.Hinge("revolute", body - 1, body, axis=(0, 0, 1)) for body in (0, 1)]
    scene = spo.Scene([spo.Body(1.0, (0.1, 0.0, 0.0), np.eye(3)), spo.Body(0.0)], hinges)
    dyn, v = spo.Dynamics(scene, 1, device=device, dtype="float64"), np.ones((1, 2))
    for name in ("quasi_velocities", "generalized_velocities", "quasi_velocity_force", "quasi_velocity_coriolis"):
        assert np.isnan(getattr(dyn, name)(v, v)).any(), name


def test_the_example_keeps_the_energy(device, tmp_path):
    """Integrated in nu, to what the iterations leave; integrated in qd, to the rule's second order."""
    worst = example.main(seconds=0.2, worlds=2, device=device, picture=tmp_path / "nu.svg")
    assert worst["nu"] <= 1e-13 and 1e-8 <= worst["qd"] <= 1e-3
    assert "in nu, all 2 worlds" in (tmp_path / "nu.svg").read_text()


@pytest.mark.parametrize("name", slow_unless(["free"], TREES))
def test_flexible_trees(name):
    """Energy, the way back, no work, and the rate of nu along forward dynamics, where links share modal coordinates."""
    scene = flexible_tree(name)
    traced, (q, qd) = Traced(scene), flexible_states(scene, 1)
    nu = nu_of(scene, q, qd)
    assert laws.error((nu**2).sum(1), 2.0 * traced("kinetic_energy", q=q, qd=qd)) <= ROUNDING
    assert laws.error(run(scene, "generalized_velocities", {"q": q, "nu": nu}, "q nu"), qd) <= ROUNDING
    C = run(scene, "quasi_velocity_coriolis", {"q": q, "nu": nu}, "q nu")
    eps = run(scene, "quasi_velocity_force", {"q": q}, "q")
    assert np.abs((nu * C).sum()) <= ROUNDING * np.linalg.norm(nu) * np.linalg.norm(C)
    qdd, h = traced("forward_dynamics", q=q, qd=qd), 0.003 / max(1.0, np.abs(qd).max())
    at = lambda t: nu_of(scene, traced("integrate", q=q, qd=qd, dt=np.full((1, 1), t)), qd + t * qdd)  # noqa: E731
    rate = sum(weight * (at(i * h) - at(-i * h)) for i, weight in WEIGHTS.items()) / h
    assert laws.error(eps - C, rate) <= DIFFERENCES
