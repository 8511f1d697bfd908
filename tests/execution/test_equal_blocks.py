"""Kernels of many links that are alike hold the statements of these links once, and compute what they computed."""

import numpy as np
import pytest

import warp_spo as spo
from warp_spo.execution import builder, plan

WORLDS, DT = 3, 1e-3


def hub(rods, **values):
    """Return rods on revolute and ball hinges, by turns, around a free body."""
    bodies, hinges = [spo.Body(20.0, inertia=2.0 * np.eye(3))], [spo.Hinge("free", -1, 0)]
    for k, angle in enumerate(0.1 + 2.0 * np.pi * np.arange(rods) / rods, 1):
        bodies.append(spo.Body(0.5, com=(0.0, 0.0, -0.2), inertia=np.diag([0.01, 0.012, 0.003])))
        seat = np.array([np.cos(angle), np.sin(angle), 0.0, 0.0, 0.0, 0.0, 1.0])
        more = dict(axis=(-np.sin(angle), np.cos(angle), 0.0)) if k % 2 else {}
        hinges.append(spo.Hinge("revolute" if k % 2 else "ball", 0, k, parent_pose=seat, **more))
    return spo.Scene(bodies, hinges, **values)


def state(scene, seed=0):
    """Return q, qd and tau away from rest."""
    rng = np.random.default_rng(seed)
    qd, tau = 0.3 * rng.normal(size=(2, WORLDS, scene.dof_count))
    q = spo.Dynamics(scene, WORLDS, "cpu", "float64", granularity="node").integrate(
        np.tile(scene.neutral_q, (WORLDS, 1)), qd, dt=1.0
    )
    return q, qd, 0.1 * tau


def kernel_texts(monkeypatch):
    """Return a list that receives the text of every generated kernel."""
    texts, make = [], builder.native.kernel

    def record(name, text, *args, **options):
        texts.append(text)
        return make(name, text, *args, **options)

    monkeypatch.setattr(builder.native, "kernel", record)
    return texts


@pytest.mark.slow
@pytest.mark.parametrize("dtype, tolerance", [("float64", 1e-11), ("float32", 1e-3)])  # of 1e2 rad/s^2
def test_a_step_of_300_rods(dtype, tolerance, monkeypatch):
    """The acceleration of a step without joint laws is that of forward dynamics, which sweeps level by level."""
    scene, texts = hub(300), kernel_texts(monkeypatch)
    q, qd, tau = state(scene)
    _, after = spo.Dynamics(scene, WORLDS, "cpu", dtype).step(q, qd, tau, DT)
    expected = spo.Dynamics(scene, WORLDS, "cpu", "float64", granularity="node").forward_dynamics(q, qd, tau)
    assert np.abs((after - qd) / DT - expected).max() < tolerance * np.abs(expected).max()
    step = max(texts, key=len)
    assert len(step) < 1e6  # written out for each rod it has 5e6 characters


@pytest.mark.slow
def test_passes_over_joint_laws_are_those_of_code_for_each_rod(monkeypatch):
    """Friction and limits take passes, whose values go through the array that loops share."""
    scene = hub(9)
    arms = np.r_[np.zeros(6), np.ones(scene.dof_count - 6)]
    scene = scene.with_values(joint_friction=0.05 * arms, joint_damping=0.02 * arms)
    q, qd, tau = state(scene, 1)
    found = []
    for most, loops in ((20, True), (128, False)):
        monkeypatch.setattr(plan, "MOST_DOFS", most)
        texts = kernel_texts(monkeypatch)
        found.append(spo.Dynamics(scene, WORLDS, "cpu", "float64").step(q, qd, tau, DT))
        assert ("kept[" in max(texts, key=len)) == loops
    for with_loops, without in zip(*found, strict=True):
        assert np.allclose(with_loops, without, rtol=0.0, atol=1e-13)


def test_more_rods_add_little_code(monkeypatch):
    """Twice the rods add less than a quarter of the characters; nothing is compiled."""
    monkeypatch.setattr(plan, "MOST_DOFS", 20)
    texts = kernel_texts(monkeypatch)
    monkeypatch.setattr("warp_spo.execution.programs.Programs.launch", lambda *_: None)
    for rods in (12, 24):
        scene = hub(rods)
        q, qd = np.tile(scene.neutral_q, (1, 1)), np.zeros((1, scene.dof_count))
        spo.Dynamics(scene, 1, "cpu", "float64").step(q, qd, dt=DT)
    fewer, more = map(len, texts)
    assert more < 1.25 * fewer
