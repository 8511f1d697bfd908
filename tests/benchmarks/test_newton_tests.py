"""Newton's own solver tests with SolverSPO in the solver's place: what the script counts, and what its results say."""

import json
import unittest
import warnings

import newton
import numpy as np
import pytest

from benchmarks import newton_tests
from benchmarks.newton_judgements import JUDGEMENTS
from support.newton_models import arm
from warp_spo import Status
from warp_spo.newton import SolverSPO

RESULTS = newton_tests.RESULTS


def test_every_failure_of_the_results_is_judged_and_none_is_ours():
    found = json.loads(RESULTS.read_text())
    faults = [row for row in found["rows"] if row["outcome"] in ("failed", "slow")]
    assert newton_tests.judged([dict(row) for row in faults]) == faults
    assert {row["whose"] for row in faults} == {"not ours"}
    assert sum(found["counts"].values()) == len(found["rows"]) > 100
    names = [row["test"] for row in found["rows"]]
    assert len({*names}) == len(names)
    unused = [pattern for pattern, *_ in JUDGEMENTS if not any(newton_tests.applies(pattern, row) for row in faults)]
    assert unused == []


@pytest.fixture
def injected(monkeypatch):
    for name in newton_tests.SOLVERS:
        monkeypatch.setattr(newton.solvers, name, getattr(newton.solvers, name))
    made, solvers = [], []
    newton_tests.inject(made, solvers)
    return made, solvers


def test_stand_ins_are_the_solver_under_newtons_names(injected):
    """Tests ask with isinstance, and for helpers of the class; other attributes of instances are missing."""
    theirs = newton.solvers.SolverMuJoCo
    solver = theirs(arm().finalize(device="cpu"), use_mujoco_cpu=True, disable_contacts=True)
    assert isinstance(solver, SolverSPO) and isinstance(solver, newton.solvers.SolverMuJoCo)
    assert not isinstance(solver, newton.solvers.SolverXPBD) and injected == (["SolverMuJoCo"], [solver])
    assert not newton_tests.leaves_out(solver)
    solver.status.fill_(int(Status.UNSUPPORTED))
    assert newton_tests.leaves_out(solver)
    theirs.register_custom_attributes(newton.ModelBuilder())
    with pytest.raises(AttributeError):
        _ = solver.mj_model


def test_outcomes():
    class Tried(unittest.TestCase):
        def test_passes(self):
            warnings.warn("nobody hears it", stacklevel=1)

        def test_fails(self):
            np.testing.assert_allclose(1.0, 2.0)

        def test_is_refused(self):
            SolverSPO(arm().finalize(device="cpu"), contacts="ground", integrator="rk4")

        def test_asks(self):
            raise AttributeError("'SolverMuJoCo' object has no attribute 'mj_model'")

        def test_skips(self):
            self.skipTest("no GPU")

        def test_sleeps(self):
            while True:
                pass

    tests = newton_tests.flat(unittest.defaultTestLoader.loadTestsFromTestCase(Tried))
    found = {test.id().rpartition("_")[2]: newton_tests.run_one(test, 1)[:2] for test in tests}
    assert {name: outcome for name, (outcome, _) in found.items()} == {
        "passes": "passed",
        "fails": "failed",
        "refused": "refused",
        "asks": "internals",
        "skips": "skipped",
        "sleeps": "slow",
    }
    assert "AssertionError" in found["fails"][1] and "SolverSPO" in found["refused"][1]
