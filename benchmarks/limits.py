"""What :mod:`benchmarks.speed` times, the limits that figures should keep, and lines and pages of what it found."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

from . import step_parts, substeps

SOLVER_STEP = "SolverSPO.step"  # with drives and limits, of benchmarks.step_parts
LEAN_STEP = "SolverSPO.step of joints alone"  # without the bodies' poses, and without forces on bodies
STEPS = (SOLVER_STEP, LEAN_STEP)
FEW, SOME, MANY, MOST = 4096, 16384, 65536, 1 << 20
INERTIAS = ("body_mass", "body_com", "body_inertia")
ON_PLANE, ON_FIELD = "contact_step", "contact_step on a height field"
SUBSTEPS = 4
FUSED = {f"step of {SUBSTEPS} substeps": "", f"contact_step of {SUBSTEPS} substeps": substeps.ON_PLANE}
FIRST_STEP = "first call of a step"  # with drives and limits; kernels are traced and compiled


@dataclasses.dataclass(frozen=True)
class Call:
    """A call that is timed: an operation of a robot, how many worlds, and options of Dynamics."""

    robot: str
    operation: str
    worlds: int
    dtype: str = "float32"
    variable: tuple[str, ...] = ()

    def __str__(self) -> str:
        more = [self.dtype] * (self.dtype != "float32") + ["variable inertias"] * bool(self.variable)
        return ", ".join([f"{self.robot} {self.operation}", f"{self.worlds} worlds", *more])


@dataclasses.dataclass(frozen=True)
class Line:
    """A call, and the limit of a figure: "us", "s", "ratio" (its time over that of ``beside``), or "rate" (at least).

    The ratio of a call of several substeps is its time over that of as many calls.
    """

    call: Call
    kind: str
    limit: float
    beside: Call | None = None

    def figure(self, time: Callable[[Call], dict]) -> float:
        """Return the figure; ``time`` gives the times of a call [us]."""
        us = time(self.call)["us"]
        if self.kind == "ratio":
            return us / (time(self.call)["calls_us"] if self.beside is None else time(self.beside)["us"])
        return {"rate": 1e-3 * self.call.worlds / us, "s": 1e-6 * us, "us": us}[self.kind]

    def keeps(self, figure: float) -> bool:
        """Return whether the figure keeps the limit."""
        return figure >= self.limit if self.kind == "rate" else figure <= self.limit


def _over_float32(robot: str, operation: str, worlds: int, limit: float) -> Line:
    call = Call(robot, operation, worlds, "float64")
    return Line(call, "ratio", limit, dataclasses.replace(call, dtype="float32"))


def _step_over_forward_dynamics(robot: str, step: str, worlds: int, limit: float) -> Line:
    return Line(Call(robot, step, worlds), "ratio", limit, Call(robot, "forward_dynamics", worlds))


def _ratio_to_folded(robot: str, limit: float) -> Line:
    call = Call(robot, "forward_dynamics", MOST, variable=INERTIAS)
    return Line(call, "ratio", limit, dataclasses.replace(call, variable=()))


LINES = (
    *(_step_over_forward_dynamics(robot, step, FEW, 2.5) for robot in step_parts.NAMES for step in STEPS),
    *(_step_over_forward_dynamics(robot, SOLVER_STEP, SOME, 2.0) for robot in ("go2", "b1_z1", "centauro")),
    Line(Call("centauro", FIRST_STEP, FEW), "s", 10.0),
    *(_over_float32("centauro", "forward_dynamics", worlds, 3.0) for worlds in (FEW, MANY)),
    Line(Call("centauro", "forward_dynamics", MOST), "rate", 0.8),
    Line(Call("g1", "forward_dynamics", MOST), "rate", 1.6),
    Line(Call("go2", "forward_dynamics", MANY), "us", 12.5),
    Line(Call("go2", "inverse_dynamics", MANY), "us", 7.0),
    Line(Call("g1", "forward_dynamics_derivatives", FEW), "us", 150.0),
    Line(Call("g1", "forward_dynamics_derivatives", MANY), "us", 1500.0),
    Line(Call("g1", "mass_matrix_inverse", FEW, "float64"), "us", 60.0),
    *(_over_float32(robot, name, FEW, 2.5) for robot in ("go2", "g1") for name in ("phi", "phi.T", "psi")),
    *(_ratio_to_folded(robot, 1.4) for robot in ("panda", "go2", "g1")),
    *(Line(Call("go2", ON_PLANE, worlds), "us", limit) for worlds, limit in ((FEW, 25.0), (MANY, 150.0))),
    *(Line(Call("g1", ON_PLANE, worlds), "us", limit) for worlds, limit in ((FEW, 70.0), (MANY, 500.0))),
    Line(Call("go2", ON_FIELD, MANY), "ratio", 1.15, Call("go2", ON_PLANE, MANY)),
    *(Line(Call(robot, name, FEW), "ratio", limit) for name in FUSED for robot, limit in (("go2", 0.85), ("g1", 1.05))),
)


def describe(line: Line, rows: dict[Call, dict]) -> str:
    """Return the line in words, with its figure."""
    timed = rows.__getitem__
    figure, row = line.figure(timed), rows[line.call]
    unit = {"us": "us", "s": "s", "rate": "1e9/s", "ratio": "times"}[line.kind]
    limit = f"{'at least' if line.kind == 'rate' else 'at most'} {line.limit:g}"
    beside = f" of {line.beside}, {timed(line.beside)['us']:.4g} us" if line.beside else ""
    if line.call.operation in FUSED:
        beside = f" of {SUBSTEPS} calls, {row['calls_us']:.4g} us"
    word, own = "kept" if line.keeps(figure) else "MISSED", f"{row['us']:.4g} us, error {row['error']:.1e}"
    return f"{line.call!s}: {own}; {figure:.4g} {unit}{beside}; {limit}: {word}"


def page(file: Path) -> str:
    """Return the lines of a saved run as a page in Markdown."""
    run, keys = json.loads(file.read_text()), [field.name for field in dataclasses.fields(Call)]
    rows = {Call(**{key: row[key] for key in keys} | {"variable": tuple(row["variable"])}): row for row in run["rows"]}
    text = [
        "# Times beside limits",
        "",
        f"One run of `python -m benchmarks.speed` on one {run['machine']['device']}, commit {run['commit'][:12]}, "
        f"{run['date'][:16].replace('T', ' ')} UTC. A time is that of one call of all worlds, replayed in a CUDA",
        "graph while all other processes stand still. The error is of the same run, against float64; that of a step of",
        "several substeps is against as many calls. The figure is the time, a rate, or a ratio to the time of another",
        "call, and has a limit. One call was timed at the beginning, in the middle and at the end:",
        f"{', '.join(f'{us:.2f}' for us in run['reference_us'])} µs. Calls took {run['sets']} sets of inputs in turn.",
        "",
        "| call | worlds | µs | error | figure | limit | |",
        "|---|---:|---:|---:|---:|---:|---|",
    ]
    for line in [line for line in LINES if {line.call, line.beside or line.call} <= rows.keys()]:
        row, figure = rows[line.call], line.figure(rows.__getitem__)
        unit = {"us": "µs", "s": "s", "rate": "10⁹/s"}.get(line.kind) or f"× {_beside(line)}"
        name = str(dataclasses.replace(line.call, worlds=0)).replace(", 0 worlds", "")
        limit = f"{'≥' if line.kind == 'rate' else '≤'} {line.limit:g}"
        word = "" if line.keeps(figure) else "missed"
        text.append(
            f"| {name} | {line.call.worlds:,} | {row['us']:.4g} | {row['error']:.1e} | {figure:.4g} {unit} "
            f"| {limit} | {word} |"
        )
    return "\n".join(text) + "\n"


def _beside(line: Line) -> str:
    """Return what the call of a ratio is compared with."""
    if line.beside is None:
        return f"{SUBSTEPS} calls"
    if line.call.variable:
        return "folded"
    return line.beside.dtype if line.beside.dtype != line.call.dtype else line.beside.operation
