"""float32 with residuals in float64: the error of float64, rounded to what the caller's arrays hold."""

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import laws, zoo
from warp_spo.reference.dense import Dense

WORLDS = 3
ROUNDED = 1e-7  # relative, 2-norm: each entry within half a unit in the last place of float32, 6e-8
GAIN = 5e-3  # what one step leaves of the error: where cond is 3e7, 60 worlds have a median of 1e-3, a largest of 1e-2
GRANULARITIES = ("node", "tree", "segment")


def chain(n):
    """Equal bodies on hinges about z and y in turn; the condition of the mass matrix grows as n^4."""
    bodies = [spo.Body(1.0, (0, 0, 0.1), np.diag([0.01, 0.01, 0.002])) for _ in range(n)]
    axes = np.eye(3)[[2, 1]]
    hinges = [spo.Hinge("revolute", k - 1, k, axis=axes[k % 2], parent_pose=(0.05, 0, 0.2, 0, 0, 0, 1))
              for k in range(n)]  # fmt: skip
    return spo.Scene(bodies, hinges)


def dense(scene, arrays, world):
    state = {name: array[world].astype(np.float64) for name, array in arrays.items()}
    mass = Dense(scene, state["q"], world=world)
    return state, mass


@pytest.mark.parametrize("n, least", [(32, 5e5), (90, 3e7)])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_an_ill_conditioned_chain(n, least, dtype, device):
    """Where plain float32 loses digits, one step brings the rounded answer, and float64's in float64 arrays."""
    scene = chain(n)
    arrays = {name: array.astype(np.float32) for name, array in laws.states(scene, WORLDS).items()}
    arrays["q"] *= np.float32(0.1)
    plain = spo.Dynamics(scene, WORLDS, device=device, granularity="node")
    refined = spo.Dynamics(scene, WORLDS, device=device, dtype=dtype, granularity="node", refine=1)
    right = arrays["b"][:, :, 0].copy()
    for got, first, wanted in (
        (refined.forward_dynamics(arrays["q"], arrays["qd"], arrays["tau"]),
         plain.forward_dynamics(arrays["q"], arrays["qd"], arrays["tau"]),
         lambda state, mass: mass.forward_dynamics(state["qd"], state["tau"])),
        (refined.solve_mass_matrix(arrays["q"], right), plain.solve_mass_matrix(arrays["q"], right),
         lambda state, mass: np.linalg.solve(mass.mass_matrix, state["b"][:, 0])),
    ):  # fmt: skip
        for world in range(WORLDS):
            state, mass = dense(scene, arrays, world)
            assert np.linalg.cond(mass.mass_matrix) > least
            exact = wanted(state, mass)
            error = np.linalg.norm(got[world] - exact) / np.linalg.norm(exact)
            before = np.linalg.norm(first[world] - exact) / np.linalg.norm(exact)
            assert error <= (ROUNDED if dtype == "float32" else GAIN * before), f"{error:.1e}, before {before:.1e}"


@pytest.mark.parametrize("granularity", GRANULARITIES)
def test_every_granularity_and_argument(granularity, device):
    """Loads, no velocity, several columns, a mask of nothing; a robot with two limbs on a floating body."""
    scene = zoo.from_parents([-1, 0, 0], ["free", "revolute", "revolute"], 11)
    dyn = spo.Dynamics(scene, WORLDS, device=device, granularity=granularity, refine=1)
    arrays = {name: array.astype(np.float32) for name, array in laws.states(scene, WORLDS).items()}
    status = np.full(WORLDS, -7, np.int32)
    for given in ({}, {"qd"}, {"qd", "tau", "body_f"}):
        got = dyn.forward_dynamics(arrays["q"], **{name: arrays[name] for name in given}, status=status)
        np.testing.assert_array_equal(status, 0)
        for world in range(WORLDS):
            state, mass = dense(scene, arrays, world)
            zero = {name: state[name] * (name in given) for name in ("qd", "tau", "body_f")}
            wanted = mass.forward_dynamics(zero["qd"], zero["tau"], zero["body_f"])
            assert laws.error(got[world], wanted) <= ROUNDED
    got = dyn.solve_mass_matrix(arrays["q"], arrays["b"])
    for world in range(WORLDS):
        state, mass = dense(scene, arrays, world)
        assert laws.error(got[world], np.linalg.solve(mass.mass_matrix, state["b"])) <= ROUNDED


def test_values_that_are_set_reach_both_precisions(device):
    scene = chain(6)
    dyn = spo.Dynamics(scene, WORLDS, device=device, granularity="tree", variable=("body_mass",), refine=1)
    arrays = {name: array.astype(np.float32) for name, array in laws.states(scene, WORLDS).items()}
    for seed in (0, 1):
        mass = zoo.varied(scene, WORLDS, seed).values["body_mass"].astype(np.float32)
        dyn.set(body_mass=wp.array(mass, dtype=wp.float32, device=device))
        now = scene.with_values(body_mass=mass.astype(np.float64))
        got = dyn.forward_dynamics(arrays["q"], arrays["qd"], arrays["tau"])
        for world in range(WORLDS):
            state, exact = dense(now, arrays, world)
            assert laws.error(got[world], exact.forward_dynamics(state["qd"], state["tau"])) <= ROUNDED
    with pytest.warns(UserWarning, match="gravity is folded"):
        dyn.set(gravity=(0.0, 0.0, -1.62))
    got = dyn.forward_dynamics(arrays["q"])
    state, exact = dense(now.with_values(gravity=(0.0, 0.0, -1.62)), arrays, 1)
    assert laws.error(got[1], exact.forward_dynamics(0.0 * state["qd"], 0.0 * state["tau"])) <= ROUNDED


@pytest.mark.parametrize("refine", [-1, 0.5, "once"])
def test_a_number_of_steps_is_asked_for(refine):
    with pytest.raises(ValueError, match=r"Dynamics: refine is .*; expected an integer, 0 or more"):
        spo.Dynamics(chain(1), refine=refine)
