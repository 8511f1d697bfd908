"""Bodies that a step places by chains: poses and velocities against those by statements of their own, in float64."""

import itertools

import numpy as np
import pytest
import zoo
from granularity_scenes import hand
from step_scenes import FORCES, H, furnished, states

import warp_spo as spo
from warp_spo.recursions import body_chains
from warp_spo.recursions.links import Links

WORLDS = 3
ROUNDING = 1e-12  # m, rad, m/s; measured 2e-14 at rates of 10 rad/s


def walker():
    """The fingers on a palm that flies, the anchor of whose hinge is turned."""
    scene = hand()
    free = spo.Hinge("free", -1, 0, parent_pose=(0.1, -0.2, 0.3, 0.0, 0.6, 0.0, 0.8))
    return spo.Scene(scene.bodies, [free, *scene.hinges[1:]])


def scene_of(name):
    return furnished(walker() if name == "walker" else zoo.SCENES[name]())


@pytest.mark.parametrize(
    ("name", "variable"),
    [
        ("walker", ("body_mass", "body_com", "joint_armature")),
        *(pytest.param(name, (), marks=pytest.mark.slow) for name in ("fork", "dancer", "screw_tree", "star")),
    ],
)
def test_equal_those_of_statements(name, variable, device):
    """With centres of mass that differ between worlds; nobody reads what the arrays held before."""
    scene = scene_of(name)
    assert body_chains.suits(Links(scene, variable))
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype="float64", granularity="segment", variable=variable)
    alone = spo.Dynamics(scene, WORLDS, device="cpu", dtype="float64", granularity="tree", variable=variable)
    if "body_com" in variable:
        com = scene.values["body_com"] + np.random.default_rng(5).uniform(-0.1, 0.1, (WORLDS, scene.body_count, 3))
        dyn.set(body_com=com)
        alone.set(body_com=com)
    a = states(scene, WORLDS)
    bodies = {n: np.full((WORLDS, scene.body_count, k), np.nan) for n, k in (("poses", 7), ("velocities", 6))}
    after = dyn.step(a["q"], a["qd"], a["tau"], H, *(a[name] for name in FORCES[1:]), **bodies)
    for got, wanted in zip(bodies.values(), alone.body_states(*after), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=0.0, atol=ROUNDING)
    assert all("body_states" not in line for line in dyn.programs.described())


@pytest.mark.parametrize("name", ["chain_ball", "forest", "one_fixed_then_revolute"])
def test_scenes_without_chains(name):
    """Balls inside of a tree, and bodies that do not move."""
    assert not body_chains.suits(Links(zoo.SCENES[name]()))


def test_a_body_is_in_one_chain():
    """Each turn that places a link follows those of the links that it moves on."""
    for name in ("fork", "dancer", "star", "screw_tree"):
        scene = scene_of(name)
        found = body_chains.chains(scene)
        placed = [station.body for chain in found.stations.values() for station in chain if station.body is not None]
        assert sorted(placed) == list(range(scene.body_count))
        parents = {link.dofs[0]: link.parent for link in Links(scene).links if link.dofs}
        for chain in found.stations.values():
            dofs = [station.dof for station in chain if station.dof is not None]
            assert all(parents[b].dofs[-1] == a for a, b in itertools.pairwise(dofs))
        assert len(found.numbers) == body_chains.RECORD * sum(map(len, found.stations.values()))


def test_values_without_chains():
    """Anchors that vary, and centres of mass that vary in bodies whose frames are not those of their hinges."""
    assert not body_chains.suits(Links(scene_of("walker"), ("joint_X_p",)))
    assert not body_chains.suits(Links(scene_of("fork"), ("body_com",)))
