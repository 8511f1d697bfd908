"""Newton's own examples with SolverSPO in place of their solver, judged by their own tests; headless, on the CPU.

All examples are listed that need no download and whose scene is articulations alone. Most of them stand on the ground:
they run as far as their robots are in the air, or are named here with the reason why they cannot run.
"""

import importlib
import types
from unittest import mock

import newton
import newton.examples
import pytest
import warp as wp
from newton.viewer import ViewerNull

from warp_spo import Status
from warp_spo.errors import UnsupportedError
from warp_spo.newton import SolverSPO

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore:from_newton", "ignore:.*:UserWarning")


def granularity(model):
    return "node" if model.body_count > 60 else None


def run(name, solver, frames, worlds=2, **options):
    """Run an example with SolverSPO where it makes the solver of that name; return the example.

    Robots of many bodies run at node granularity, whose kernels all scenes share.

    What its own test finds wrong is raised.
    """
    module = importlib.import_module(f"newton.examples.{name.split('_')[0]}.example_{name}")
    theirs = getattr(newton.solvers, solver)
    stand_in = mock.Mock(side_effect=lambda model, **_: SolverSPO(model, granularity=granularity(model)))
    stand_in.register_custom_attributes = getattr(theirs, "register_custom_attributes", None)
    types_of = isinstance
    args = types.SimpleNamespace(world_count=worlds, solver=solver.removeprefix("Solver").lower(), test=True,
                                 max_worlds=None, **options)  # fmt: skip

    def is_instance(thing, kind):
        return False if kind is stand_in else types_of(thing, kind)

    with (
        mock.patch.object(newton.solvers, solver, stand_in),
        mock.patch.object(module, "isinstance", is_instance, create=True),  # a stand-in is no type
        wp.ScopedDevice("cpu"),
    ):
        example = module.Example(ViewerNull(num_frames=frames), args)
        assert types_of(example.solver, SolverSPO)
        newton.examples.run(example, args)
    return example


RUN = {
    "robot_cartpole": ("SolverMuJoCo", 100, Status.OK),
    "basic_pendulum": ("SolverXPBD", 100, Status.OK),
    "basic_dzhanibekov": ("SolverMuJoCo", 230, Status.OK),
    "selection_cartpole": ("SolverMuJoCo", 10, Status.OK),
    "selection_articulations": ("SolverMuJoCo", 10, Status.OK),  # in the air; as many frames as Newton's tests
    "selection_multiple": ("SolverMuJoCo", 10, Status.OK),
    "selection_materials": ("SolverMuJoCo", 10, Status.UNSUPPORTED),  # ants that start near the ground
}
"""Examples that pass their own test: the solver that they make, frames, and the status of every world at the end."""
REFUSED = {
    "robot_omniwheel": ("SolverMuJoCo", UnsupportedError, r"SolverSPO.step: \d+ contacts"),  # wheels on the ground
    "basic_plotting": ("SolverMuJoCo", AttributeError, "mj_model"),  # it plots the iterations of MuJoCo's solver
}
"""Examples that cannot run, and how they end."""


@pytest.mark.parametrize("name", ["robot_cartpole", *(pytest.param(name, marks=pytest.mark.slow) for name in RUN
                                                      if name != "robot_cartpole")])  # fmt: skip
def test_passes_its_own_test(name):
    solver, frames, status = RUN[name]
    assert set(run(name, solver, frames).solver.status.numpy()) == {status}


@pytest.mark.slow
@pytest.mark.parametrize("name", REFUSED)
def test_ends_with_its_reason(name):
    solver, error, words = REFUSED[name]
    with pytest.raises(error, match=words):
        run(name, solver, 2)


@pytest.mark.slow
def test_quadrupeds_that_reach_the_ground_get_a_status_word():
    """basic_urdf: its own test wants robots that stand; its graph finds contacts after 0.2 s of fall."""
    with mock.patch.object(newton.examples, "test_body_state", lambda *_, **__: None):
        assert run("basic_urdf", "SolverXPBD", 40).solver.status.numpy().tolist() == [Status.UNSUPPORTED] * 2
