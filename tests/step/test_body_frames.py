"""Bodies that a walk along the tree finds after a step: poses and velocities against those by statements."""

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import zoo
from support.granularity_scenes import hand
from support.step_scenes import FORCES, H, furnished, states
from warp_spo.execution.segment import body_frames, body_kinematics
from warp_spo.recursions.model.links import Links

WORLDS = 3
SIZES = dict(poses=7, velocities=6)
ROUNDING = 1e-12  # m, rad, m/s; measured 2e-14 at rates of 10 rad/s


@pytest.fixture(autouse=True)
def one_text(monkeypatch):
    """However few dofs a scene has."""
    monkeypatch.setattr(body_frames, "BY_STATEMENTS", 0)


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
        *(pytest.param(x, (), marks=pytest.mark.slow) for x in ("fork", "dancer", "screw_tree", "star", "forest")),
    ],
)
def test_equal_those_of_statements(name, variable, device):
    """With centres of mass that differ between worlds; nobody reads what the arrays held before."""
    scene = scene_of(name)
    assert body_frames.is_supported(Links(scene, variable))
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype="float64", granularity="segment", variable=variable)
    alone = spo.Dynamics(scene, WORLDS, device="cpu", dtype="float64", granularity="tree", variable=variable)
    if "body_com" in variable:
        com = scene.values["body_com"] + np.random.default_rng(5).uniform(-0.1, 0.1, (WORLDS, scene.body_count, 3))
        dyn.set(body_com=com)
        alone.set(body_com=com)
    a = states(scene, WORLDS)
    bodies = {n: np.full((WORLDS, scene.body_count, k), np.nan) for n, k in SIZES.items()}
    after = dyn.step(a["q"], a["qd"], a["tau"], H, **{n: a[n] for n in FORCES[1:]}, report=spo.StepReport(**bodies))
    for got, wanted in zip(bodies.values(), alone.body_states(*after), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=0.0, atol=ROUNDING)
    assert sum("body_states" in line for line in dyn.programs.describe()) == 1


def test_warps_take_several_walks(monkeypatch, device):
    """Where there are more segments than warps."""
    monkeypatch.setattr(body_kinematics, "MOST_WARPS", 2)
    test_equal_those_of_statements("walker", (), device)


def test_a_scene_with_a_body_that_does_not_move():
    assert not body_frames.is_supported(Links(zoo.SCENES["one_fixed_then_revolute"]()))


def test_values_that_vary():
    """Anchors, and centres of mass in bodies whose frames are not those of their hinges."""
    assert not body_frames.is_supported(Links(scene_of("walker"), ("joint_X_p",)))
    assert not body_frames.is_supported(Links(scene_of("fork"), ("body_com",)))


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_world_does_not_depend_on_their_number(dtype, device):
    """Lanes without a world write nowhere: the last world has the bits that it has among more."""
    scene, found, count = scene_of("walker"), {}, 33
    a = states(scene, count, dtype)
    for worlds in (count, 1, 31, 32, *((1000, 4096, 16384, 65536) if device.is_cuda else ())):
        dyn = spo.Dynamics(scene, worlds, device=device, dtype=dtype, granularity="segment")
        rows = {name: np.resize(a[name], (worlds, *a[name].shape[1:])) for name in ("q", "qd", *FORCES)}
        given = {name: wp.array(each, dtype=dyn.dtype, device=device) for name, each in rows.items()}
        bodies = {n: wp.full((worlds, scene.body_count, k), np.nan, dyn.dtype, device) for n, k in SIZES.items()}
        after = dyn.step(**given, dt=H, report=spo.StepReport(**bodies))
        found[worlds] = [array.numpy() for array in (*after, *bodies.values())]
        for one, more in zip(found[worlds], found[count], strict=True):
            assert np.isfinite(one).all()
            np.testing.assert_array_equal(one, np.resize(more, one.shape))
