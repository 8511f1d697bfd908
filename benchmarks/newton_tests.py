"""Newton's own solver tests with SolverSPO in their solver's place, their assertions untouched.

    python -m benchmarks.newton_tests --json benchmarks/results/files/NEWTON_TESTS.json     # all, on a CPU
    python -m benchmarks.newton_tests test_joint_drive --match free                     # some

``newton.solvers.SolverFeatherstone``, ``SolverMuJoCo``, ``SolverSemiImplicit`` and ``SolverXPBD`` become SolverSPO
while a file of tests is read and run, without the options that only they have. Every test counts that made such
a solver; one that Newton runs with several solvers counts once, in the order of these names. The outcomes:

    passed      -
    refused     an error says what SolverSPO does not do, such as UnsupportedError; or the test fails beside a solver
                whose status is UNSUPPORTED, the word for contacts that it leaves out
    internals   the test asks its solver for what only that solver has, such as MuJoCo's arrays
    failed      anything else; each has its judgement in ``newton_judgements``
    slow        it did not end within --seconds
    skipped     by the test itself
"""

from __future__ import annotations

import argparse
import functools
import importlib
import json
import re
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import unittest
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import warp as wp

RESULTS = Path(__file__).parent / "results" / "files" / "2026-11-29-cpu-newton-tests.json"
SOLVERS = ("SolverFeatherstone", "SolverMuJoCo", "SolverSemiImplicit", "SolverXPBD")
SUFFIX = re.compile(r"_(featherstone|mujoco(_cpu|_warp|_c)?|semi_implicit|xpbd)(?=_|$)")
OTHERS = re.compile(r"_(steel|kamino|lox|vbd|admm|mpm|steel_colored)(_|$)")
"""Variants of tests that run with other solvers, whose place nothing takes."""
REFUSED = "|".join(
    (
        "UnsupportedError",
        "does not support solver observable",
        "no configuration was found that closes",
        "from_newton: the model has no bodies",
        "from_newton: got ModelView",
    )
)
"""Expression of errors by which SolverSPO refuses a model or a request."""
FILES = (
    "test_anymal_reset",
    "test_body_force",
    "test_body_velocity",
    "test_control_force",
    "test_conveyor_forces",
    "test_equality_connect_constraint_with_sim_step",
    "test_equality_constraints",
    "test_joint_controllers",
    "test_joint_damping",
    "test_joint_drive",
    "test_joint_springs",
    "test_kinematic_links",
    "test_multiworld_body_properties",
    "test_parent_force",
    "test_pendulum_revolute_vs_d6",
    "test_physics_verification",
    "test_rigid_contact",
    "test_rigid_friction_ramp",
    "test_robot_composer",
    "test_runtime_gravity",
    "test_sensor_contact",
    "test_shapes_no_bounce",
    "test_solver_mimic",
    "test_solver_observables",
    "test_up_axis",
    "test_inverse_dynamics",
    "featherstone.test_notify_model_changed",
    "determinism.test_solver_determinism",
)


class OutOfTime(BaseException):
    """A test took longer than its time; no test catches it, but unittest does."""


def inject(made: list[str], solvers: list[Any]) -> None:
    """Put SolverSPO in the place of Newton's solvers.

    ``made`` gets the name of each that a test constructs, ``solvers`` those that were not refused.
    """
    import newton.solvers

    from warp_spo.newton import SolverSPO

    for name in SOLVERS:
        setattr(newton.solvers, name, stand_in(name, getattr(newton.solvers, name), SolverSPO, made, solvers))


def stand_in(name: str, theirs: Any, base: Any, made: list[str], solvers: list[Any]) -> Any:
    """Return SolverSPO as a class of one of Newton's names, with the class's own helpers such as custom attributes."""

    from warp_spo.errors import UnsupportedError

    class Helpers(type(base)):  # type: ignore[misc]
        def __getattr__(cls, word: str) -> Any:
            return getattr(theirs, word)

    def start(self: Any, model: Any, *_: Any, disable_contacts: bool = False, **__: Any) -> None:
        made.append(name)
        options = {"contacts": "none" if disable_contacts else "auto"}
        try:
            base.__init__(self, model, **options)
        except (UnsupportedError, ValueError) as error:
            if "loops='" not in str(error):
                raise
            base.__init__(self, model, **options, loops="embed")  # a way out that the error names
        solvers.append(self)

    own = {"__init__": start, "register_custom_attributes": theirs.register_custom_attributes}
    return Helpers(name, (base,), own)


def run_file(file: str, match: str, seconds: int, optimized: bool) -> list[dict[str, Any]]:
    """Run the tests of a file whose names match, and return a row for each that made a solver."""
    made: list[str] = []
    solvers: list[Any] = []
    wp.config.quiet = True
    if not optimized:
        compile_quickly()
    inject(made, solvers)
    module = importlib.import_module(f"newton.tests.{file}")
    rows: list[dict[str, Any]] = []
    seen: set[str] = set()
    every = flat(unittest.defaultTestLoader.loadTestsFromModule(module))
    tests = [test for test in every if re.search(match, test.id()) and not OTHERS.search(test.id())]
    for test in sorted(tests, key=lambda one: [SUFFIX.search(one.id()) is not None, order(one.id())]):
        name = ".".join(test.id().split(".")[-2:])
        key = SUFFIX.sub("", name)
        if key in seen:
            continue
        made.clear(), solvers.clear()
        outcome, why, spent = run_one(test, seconds)
        if outcome == "failed" and any(map(leaves_out, solvers)):
            outcome, why = "refused", f"status UNSUPPORTED, {why}"
        if made or outcome == "slow":
            seen.add(key)
            rows.append({"test": f"{file}.{key}", "in_place_of": sorted({*made}), "outcome": outcome, "why": why})
            print(f"{outcome:10} {file}.{key} {spent:.1f} s {why[:150]}", flush=True)
    return rows


def leaves_out(solver: Any) -> bool:
    """Whether the status of a world says that a solver left contacts out."""
    from warp_spo import Status

    return bool((solver.status.numpy() == Status.UNSUPPORTED).any())


def order(name: str) -> int:
    """Return the place of a test's solver among those of Newton's names."""
    found = SUFFIX.search(name)
    words = ("featherstone", "mujoco", "semi_implicit", "xpbd")
    return next((i for i, word in enumerate(words) if found and found[1].startswith(word)), 0)


def flat(suite: Any) -> list[Any]:
    """Return the tests of a suite."""
    return [test for each in suite for test in flat(each)] if isinstance(suite, unittest.TestSuite) else [suite]


def run_one(test: Any, seconds: int) -> tuple[str, str, float]:
    """Return the outcome of a test, why, and the seconds it took."""
    found = unittest.TestResult()
    start = time.perf_counter()

    def stop(*_: Any) -> None:
        raise OutOfTime

    signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            type(test).setUpClass()
            test.run(found)
    except BaseException:
        found.errors.append((test, traceback.format_exc()))
    finally:
        signal.alarm(0)
    spent = time.perf_counter() - start
    faults = found.failures + found.errors
    if not faults:
        return ("skipped", found.skipped[0][1], spent) if found.skipped else ("passed", "", spent)
    text = faults[0][1].strip()
    return kind_of(text), last_words(text), spent


def kind_of(text: str) -> str:
    """Return the outcome that a traceback stands for."""
    if "OutOfTime" in text:
        return "slow"
    if re.search(REFUSED, text):
        return "refused"
    own = [rf"'{name}' object has no attribute|type object '{name}' has no" for name in SOLVERS]
    own.append("type object 'ObservableKind' has no attribute")
    return "internals" if re.search("|".join(own), text) else "failed"


def last_words(text: str) -> str:
    """Return the error of a traceback in a line, and the line of the test that it comes from."""
    lines = text.splitlines()
    error = next((line for line in lines if re.match(r"^[\w.]*(Error|Exception|Warning)\b", line)), lines[-1])
    places = [line for line in lines if "newton/tests/" in line]
    where = re.sub(r'.*newton/tests/(.*)", line (\d+).*', r"\1:\2", places[-1]) if places else ""
    return f"{where} {error}"[:400].strip()


def compile_quickly() -> None:
    """Compile kernels without optimization, to the same bits, as the tests of this library do."""
    from warp_spo.kernels import native

    make = native.kernel

    @functools.wraps(make)
    def unoptimized(*arguments: Any, **options: Any) -> Any:
        kernel = make(*arguments, **options)
        kernel.module.options["optimization_level"] = 0
        return kernel

    native.kernel = unoptimized


def judged(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows with whose fault each failure is, and why; the first judgement that applies counts."""
    from .newton_judgements import JUDGEMENTS

    for row in rows:
        if row["outcome"] in ("failed", "slow"):
            found = [(whose, why) for pattern, whose, why in JUDGEMENTS if applies(pattern, row)]
            row["whose"], row["judgement"] = found[0] if found else ("not judged", "")
    return rows


def applies(pattern: str, row: dict[str, Any]) -> bool:
    """Return whether a judgement's pattern is found in the name of a test, or in its outcome and error."""
    return re.search(pattern, f"{row['test']} {row['outcome']} {row['why']}") is not None


def table(rows: list[dict[str, Any]]) -> str:
    """Return counts by outcome, and the failures with their judgements, in Markdown."""
    counts = Counter(row["outcome"] for row in rows)
    lines = [f"{len(rows)} tests: " + ", ".join(f"{count} {name}" for name, count in counts.most_common())]
    lines += ["", "| test | whose | why |", "|---|---|---|"]
    lines += [
        f"| `{row['test']}` | {row['whose']} | {row['judgement'] or row['why']} |" for row in rows if "whose" in row
    ]
    return "\n".join(lines)


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", help="files of newton/tests; none: all that are listed here")
    parser.add_argument("--match", default="", help="regular expression of tests")
    parser.add_argument("--seconds", type=int, default=300, help="of a test at most")
    parser.add_argument("--optimized", action="store_true", help="compile kernels as users do")
    parser.add_argument("--json", type=Path, help="file of results; rows of other files in it are kept")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        rows = run_file(options.files[0], options.match, options.seconds, options.optimized)
        options.json.write_text(json.dumps(rows))
        return
    rows = []
    for file in options.files or FILES:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "rows.json"
            command = [sys.executable, "-m", "benchmarks.newton_tests", file, "--one", "--json", str(path)]
            command += ["--match", options.match, "--seconds", str(options.seconds)]
            subprocess.run(command + ["--optimized"] * options.optimized, check=False, stderr=subprocess.DEVNULL)
            rows += json.loads(path.read_text()) if path.exists() else [crashed(file)]
        if options.json:
            write(options.json, rows, whole=not options.match)
    print(table(judged(rows)))


def crashed(file: str) -> dict[str, Any]:
    """Return the row of a file whose process ended early."""
    return {"test": file, "in_place_of": [], "outcome": "failed", "why": "the process ended"}


def write(path: Path, rows: list[dict[str, Any]], whole: bool) -> None:
    """Write rows into a file of results, in the place of those of the same tests, or of the same ``whole`` files."""
    import newton

    kept = json.loads(path.read_text())["rows"] if path.exists() else []
    named = lambda row: row["test"].split(".Test")[0] if whole else row["test"]  # noqa: E731
    new = {named(row) for row in rows}
    every = judged(sorted([*(row for row in kept if named(row) not in new), *rows], key=lambda row: row["test"]))
    counts = dict(Counter(row["outcome"] for row in every).most_common())
    path.write_text(json.dumps({"newton": newton.__version__, "counts": counts, "rows": every}, indent=1) + "\n")


if __name__ == "__main__":
    main()
