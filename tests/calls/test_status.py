"""spo.Status: a number means the same in every file; each has advice; the more severe of two states is reported."""

import importlib
import pkgutil

import numpy as np
import pytest

import warp_spo as spo
from support import mechanisms, zoo
from support.mechanisms import MECHANISMS
from warp_spo import kernels

NUMBERS = dict(
    OK=0, PIVOT=1, NOT_FINITE=2, DIGITS=3, RANGE=4, NOT_SETTLED=5, LOOPS=6, OPEN=7, CONTACT=8, SLOTS=9, UNSUPPORTED=10,
    QUATERNION=11,
)  # fmt: skip


def test_numbers_are_what_users_have_stored():
    assert {state.name: state.value for state in spo.Status} == NUMBERS


def test_kernels_hold_the_same_numbers():
    """Kernels import nothing from the package above them, so they repeat the numbers that they write."""
    found = []
    for module in pkgutil.iter_modules(kernels.__path__):
        module = importlib.import_module(f"{kernels.__name__}.{module.name}")
        for state in spo.Status:
            if hasattr(module, state.name):
                found.append((module.__name__, state.name))
                assert getattr(module, state.name) == state, (
                    f"{module.__name__}.{state.name} is not Status.{state.name}"
                )
    assert {name for _, name in found} >= {
        "OK",
        "PIVOT",
        "NOT_FINITE",
        "DIGITS",
        "RANGE",
        "NOT_SETTLED",
        "LOOPS",
        "OPEN",
        "QUATERNION",
    }


def test_every_state_has_advice_and_a_severity_of_its_own():
    assert all(len(state.advice) > 20 and state.advice.endswith(".") for state in spo.Status)
    assert sorted(state.severity for state in spo.Status) == list(range(len(spo.Status)))
    assert spo.Status.OPEN.advice.startswith("Dynamics.project")
    order = sorted(spo.Status, key=lambda state: -state.severity)
    assert ", ".join(state.name for state in order) in " ".join(spo.Status.__doc__.split())


@pytest.mark.parametrize("granularity", ["node", "tree"])
def test_the_most_severe_state_is_reported(granularity):
    """World 0 has neither inertia nor armature, world 1 has a NaN as well, world 2 is as the scene says."""
    values = {"body_mass": 2, "body_inertia": 4, "joint_armature": 2}  # and how many axes each has
    dyn = spo.Dynamics(zoo.fork(), 3, "cpu", variable=tuple(values), granularity=granularity)
    for name, axes in values.items():
        value = np.tile(dyn.scene.values[name][:1], (3,) + (1,) * (axes - 1))
        value[:2] = 0.0
        dyn.set(**{name: value})
    q, status = np.tile(dyn.scene.neutral_q, (3, 1)), np.full(3, -1, np.int32)
    tau = np.ones((3, dyn.scene.dof_count))
    tau[1, 0] = np.nan
    dyn.forward_dynamics(q, None, tau, status=status)
    assert [spo.Status(number) for number in status] == [spo.Status.PIVOT, spo.Status.NOT_FINITE, spo.Status.OK]


VALUES = ("body_mass", "gravity", "joint_target_kd", "joint_limit_upper", "actuator_gain")


def words_of_bad_values(scene, q, name, device, **options):
    """Return the words of forward dynamics and of steps: a value is NaN in world 1, infinite in 2, fine in 0 and 3."""
    dyn = spo.Dynamics(scene, 4, device, variable=(name,), **options)
    value = np.tile(scene.values[name][:1], (4,) + (1,) * (scene.values[name].ndim - 1))
    value[1].flat[-1], value[2].flat[-1] = np.nan, np.inf
    dyn.set(**{name: value})
    q, rates = np.tile(q, (4, 1)), np.zeros((4, scene.dof_count))
    found = np.full((3, 4), -1, np.int32)
    dyn.forward_dynamics(q, rates, rates, status=found[0])
    for word, count in zip(found[1:], (1, 3), strict=True):
        ctrl, options = np.zeros((4, len(scene.actuators))), spo.StepOptions(substeps=count)
        dyn.step(q, rates, rates, 1e-3, ctrl=ctrl, options=options, status=word)
    return found


def driven_fork():
    """A fork with a motor at each hinge of one coordinate."""
    scene = zoo.fork()
    motors = [spo.Actuator(number) for number, hinge in enumerate(scene.hinges) if hinge.coord_count == 1]
    return spo.Scene(scene.bodies, scene.hinges, actuators=motors)


@pytest.mark.slow
@pytest.mark.parametrize("granularity", ["tree", "segment"])
@pytest.mark.parametrize("name", VALUES)
def test_values_that_are_not_finite_are_named(name, granularity, device):
    """NOT_FINITE in their worlds alone; an infinite bound is none, and forward dynamics read bodies and hinges."""
    scene = driven_fork()
    forward, step, steps = words_of_bad_values(scene, scene.neutral_q, name, device, granularity=granularity)
    worse = [0, 2, 0 if name == "joint_limit_upper" else 2, 0]
    assert step.tolist() == steps.tolist() == worse
    assert forward.tolist() == (worse if name in ("body_mass", "gravity") else [0, 0, 0, 0])


@pytest.mark.slow
@pytest.mark.parametrize("loops", ["embed", "multipliers"])
def test_a_mass_that_is_nan_is_named_in_closed_loops(loops, device):
    """NOT_FINITE, not LOOPS or PIVOT, in forward dynamics and in steps."""
    scene = MECHANISMS["fourbar"]()
    (q,) = mechanisms.states(scene, 1).q
    for words in words_of_bad_values(scene, q, "body_mass", device, loops=loops):
        assert words[[0, 3]].max() <= 0 and words[[1, 2]].tolist() == [2, 2]
