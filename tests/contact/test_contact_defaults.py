"""Default values of contacts, through the steps of the benchmark that measures them all."""

import numpy as np
import pytest

import warp_spo as spo
from benchmarks.contact import defaults, walkers
from warp_spo.env import robots


def figures(case, dt, device, dtype="float32"):
    """The figures of a case that miss what is asked for."""
    make = lambda scene, worlds: spo.Dynamics(scene, worlds, device=device, dtype=dtype)  # noqa: E731
    found = list(defaults.CASES[case](dt, make))
    assert found and all(np.isfinite(one.value) for one in found)
    return [one for one in found if one.asked is not None and not one.value <= one.asked]


def test_a_box_that_sticks_hardly_creeps(device):
    """On a slope of 20 degrees, friction 1.01, 1.05 and 1.5 times what it needs, in float32."""
    assert not figures("creep", 5e-3, device)


@pytest.mark.slow
@pytest.mark.parametrize("dt", [2e-3, 1e-2])
@pytest.mark.parametrize("case", ["cubes", "five", "thin", "loads", "deep"])
def test_what_rests_and_stands(case, dt, device):
    assert not figures(case, dt, device)


@pytest.mark.slow
@pytest.mark.parametrize("dt", [5e-3, 1e-2])
def test_what_is_held(dt, device):
    """All but light fingers of 0.1 kg that press with a force nobody knows of, 10 times their weight and the load's."""
    missed = figures("grips", dt, device)
    assert [one.name for one in missed] == ["0.05 kg, force, no limit: pads sink [mm]"]


@pytest.mark.slow
def test_a_walker_is_not_lost_and_stands_as_in_mujoco(device):
    """The short form of ``benchmarks.contact.walkers``, whose robots come from packages, with a Go2 that ships here."""
    walker = walkers.read(robots.FILES / "go2.xml", "go2")
    for way in walkers.WAYS:
        dyn = spo.Dynamics(walker.scenes[way], 16, device)
        for dt in (5e-3, 1e-2):
            assert all(one.value == 0.0 for one in walkers.throw(walker, way, dt, dyn)), (way, dt)
        if way == "drives":
            ours = list(walkers.at_rest(walker, 5e-3, 1.0, dyn))
    for found in (ours, list(walkers.at_rest_in_mujoco(walker, 1.0, 2))):
        assert [one.value for one in found if one.name.endswith("stands, share")] == [1.0]
