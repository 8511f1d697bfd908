"""Newton's own examples with SolverSPO in place of their solver, judged by their own tests; headless, on the CPU.

Examples are listed that need no download and whose scene is articulations alone, or named with the reason why they
cannot run.
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
from warp_spo.newton import SolverSPO

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore:from_newton", "ignore:.*:UserWarning")


def made(model, stiffness=None, **options):
    """Return the solver of a model whose materials have this stiffness [N/m], the model's own if it is None."""
    if stiffness is not None:
        model.shape_material_ke.fill_(stiffness)
        model.shape_material_kd.fill_(0.02 * stiffness)
    return SolverSPO(model, points=4, **options)


def run(name, solver, frames, worlds=2, stiffness=None, folder=None, pairs=None, loops="raise", **options):
    """Run an example with SolverSPO where it makes the solver of that name; return the example.

    Errors that its own test finds are raised.
    """
    module = importlib.import_module(f"newton.examples.{folder or name.split('_')[0]}.example_{name}")
    theirs = getattr(newton.solvers, solver)
    stand_in = mock.Mock(side_effect=lambda model, **_: made(model, stiffness, pairs=pairs, loops=loops))
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
    "robot_cartpole": ("SolverMuJoCo", 100, {}),
    "basic_pendulum": ("SolverXPBD", 100, {}),
    "basic_dzhanibekov": ("SolverMuJoCo", 230, {}),
    "basic_heightfield": ("SolverXPBD", 150, {}),  # spheres on a height field
    # Materials of 2500 N/m let the robots, of 27 kg, sink by 11 mm, and their test allows 10.
    "basic_urdf": ("SolverXPBD", 150, {"worlds": 1, "stiffness": 1e5}),
    "selection_cartpole": ("SolverMuJoCo", 10, {}),
    "selection_articulations": ("SolverMuJoCo", 10, {}),  # as many frames as Newton's tests
    "selection_multiple": ("SolverMuJoCo", 10, {}),
    "selection_materials": ("SolverMuJoCo", 10, {}),  # friction changes between frames
    "basic_joints": ("SolverXPBD", 500, {}),  # its slider is at rest after 8 s
    "basic_mimic_joint": ("SolverXPBD", 120, {"loops": "embed", "pitch": 1.2}),
    "newton_cradle": ("SolverXPBD", 100, {"folder": "contacts", "pairs": "all"}),  # ten pairs of five balls
}
"""Examples that pass their own test with no word of any world: the solver that they make, frames, and options."""
REFUSED = {
    "basic_plotting": ("SolverMuJoCo", AttributeError, "mj_model"),  # it plots the iterations of MuJoCo's solver
}
"""Examples that cannot run, and how they end."""


@pytest.mark.slow
@pytest.mark.parametrize("name", RUN)
def test_passes_its_own_test(name):
    solver, frames, options = RUN[name]
    word = Status.UNSUPPORTED if name == "basic_heightfield" else Status.OK  # its balls roll against each other
    assert set(run(name, solver, frames, **options).solver.status.numpy()) == {word}


@pytest.mark.slow
@pytest.mark.parametrize("name", REFUSED)
def test_ends_with_its_reason(name):
    solver, error, words = REFUSED[name]
    with pytest.raises(error, match=words):
        run(name, solver, 2)
