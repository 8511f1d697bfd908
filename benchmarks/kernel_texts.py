"""Texts of the kernels that a set of scenes generates, so that a refactoring can show that it changed none.

    python -m benchmarks.kernel_texts FOLDER            # write one file for each kernel text, and index.json
    python -m benchmarks.kernel_texts --compare A B     # name the cases whose texts differ; exit code 1 if any do

Nothing is compiled or launched, and no GPU is needed: plans are made as for a GPU, and the generated C++ is recorded. A
case is scene, precision, worlds, loops and call. Texts are named by their hash. Comments are left out. ``--limit
PATTERN`` keeps the cases that match a regular expression.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import re
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import warp as wp

import warp_spo as spo
from warp_spo.dynamics import dynamics
from warp_spo.dynamics.stepping.options import REPORT
from warp_spo.examples import biped, fivebar, fourbar, slider_crank, stewart
from warp_spo.execution.device_facts import MEASURED
from warp_spo.kernels import native
from warp_spo.runtime import launches
from warp_spo.scene.contact_values import TURNING_VALUES

from .contact import scenes
from .table import robots, shapes

WORLDS = (1, 4096, 65536)
MANY_WORLDS = 1 << 18  # beyond every world count at which a plan changes
MOST_ENTRIES = 1 << 30  # of a result, which takes memory though nothing is launched
FRAMES = {"frames": [0, (0, (0.1, -0.05, 0.2, 0.0, 0.0, 0.0, 1.0))]}
GIVEN = ("body_f", "status", "qdd", "target_q", "target_qd")


def every_hinge() -> spo.Scene:
    """A floating tree with one hinge of every kind, skewed anchors and every law of a joint."""
    rng = np.random.default_rng(7)
    kinds: list[tuple[str, dict]] = [
        ("free", {}), ("revolute", dict(axis=(0, 0, 1))), ("ball", {}), ("prismatic", dict(axis=(0.6, 0.0, 0.8))),
        ("helical", dict(axis=(0, 1, 0), pitch=0.2)), ("universal", dict(axis=((1, 0, 0), (0, 1, 0)))),
        ("cylindrical", dict(axis=(1, 0, 0))), ("planar", dict(axis=(0, 0, 1))), ("fixed", {}),
        ("d6", dict(linear=[(1, 0, 0)], angular=[(0, 0.6, 0.8), (0, -0.8, 0.6)])), ("free", {}),
    ]  # fmt: skip
    parents = [-1, 0, 1, 0, 3, 4, 2, 2, 7, 6, 8]
    bodies, hinges = [], []
    for k, ((kind, axes), parent) in enumerate(zip(kinds, parents, strict=True)):
        bodies.append(spo.Body(1.0 + 0.1 * k, rng.uniform(-0.1, 0.1, 3), np.diag(rng.uniform(0.01, 0.015, 3))))
        turn = rng.normal(size=4)
        where = (*rng.uniform(-0.3, 0.3, 3), *(turn / np.linalg.norm(turn)))
        laws: dict[str, Any] = dict(armature=0.01 * (k % 3), damping=0.1, stiffness=0.5 * (k % 2))
        if kind not in ("free", "ball", "fixed"):
            laws |= dict(friction=0.05 * (k % 2), target_ke=3.0, target_kd=0.2, limit_lower=-1.0, limit_upper=1.0)
            laws |= dict(effort_limit=5.0, velocity_limit=9.0)
        hinges.append(spo.Hinge(kind, parent, k, **axes, parent_pose=where, **laws))
    return spo.Scene(bodies, hinges)


def tower() -> spo.Scene:
    """Three cubes on each other and on the ground."""
    cube, count = (0.05, 0.05, 0.05), 3
    bodies = [spo.Body(1.0, inertia=0.0017 * np.eye(3)) for _ in range(count)]
    pairs = [spo.Contact(i, box=cube, other=spo.Contact(i - 1, box=cube)) for i in range(1, count)]
    hinges = [spo.Hinge("free", -1, i) for i in range(count)]
    return spo.Scene(bodies, hinges, contacts=[spo.Contact(0, box=cube), *pairs])


SCENES: dict[str, Callable[[], spo.Scene]] = {
    **{name: (lambda name=name: robots.scene(name)) for name in robots.ROBOTS if robots.is_available(name)},
    "arm": lambda: shapes.chain(7),
    "tree": lambda: shapes.random_tree(32),
    "hinges": every_hinge,
    "tower": tower,
    **{
        f"{name}_on_ground": (lambda name=name: scenes.scene(name))
        for name in ("go2", "g1")
        if robots.is_available(name)
    },
    **{file.__name__.rpartition(".")[2]: file.scene for file in (biped, fivebar, fourbar, slider_crank, stewart)},
}
VARIABLE = ("body_mass", "body_com", "body_inertia", "joint_X_p", "joint_X_c", "joint_armature", "joint_damping",
            "joint_stiffness", "joint_friction", "joint_target_ke", "joint_target_kd", "gravity")  # fmt: skip


class Recorder:
    """Texts by case; ``case`` names what is being generated."""

    def __init__(self) -> None:
        self.case = ""
        self.texts: dict[str, str] = {}
        self.cases: dict[str, list[str]] = {}

    def add(self, *parts: Any) -> None:
        text = "\n".join(line for line in "\n".join(map(str, parts)).split("\n") if not line.startswith("// "))
        key = hashlib.sha256(text.encode()).hexdigest()[:20]
        self.texts[key] = text
        self.cases.setdefault(self.case, []).append(key)


@contextlib.contextmanager
def recording(recorder: Recorder) -> Iterator[None]:
    """Plan as for a GPU; record kernels instead of making them, and launch nothing."""
    choose = dynamics.plans.choose

    def as_for_cuda(scene: Any, worlds: int, device: Any, *more: Any) -> Any:
        return choose(scene, worlds, MEASURED, *more)

    def record(
        name: str, native: str, arrays: list, T: type, registers: Any = None, wide: tuple = (), **more: Any
    ) -> Any:
        recorder.add(name, arrays, registers, wide, *more.values(), native)
        return None

    empty = wp.empty
    with (
        mock.patch.object(dynamics.plans, "choose", as_for_cuda),
        mock.patch.object(native, "kernel", record),
        mock.patch.object(wp, "launch", lambda *args, **more: None),
        mock.patch.object(wp, "zeros", lambda shape, **more: empty(shape, **more)),
        mock.patch.object(launches, "compile_side_by_side", contextlib.nullcontext),
    ):
        yield


def dynamics_of(scene: spo.Scene, worlds: int, **options: Any) -> spo.Dynamics:
    """A Dynamics whose results would leave as they do on a GPU."""
    dyn = spo.Dynamics(scene, worlds, device="cpu", **options)
    dyn.programs.builder.relays = True
    return dyn


def subjects() -> Iterator[tuple[str, Callable[[], spo.Dynamics]]]:
    """Name of each Dynamics, and what makes it."""
    for name, make in SCENES.items():
        scene = make()
        closed = bool(scene.loops or scene.couplings)
        for dtype in ("float32", "float64"):
            for worlds in (*WORLDS, *(() if closed else (MANY_WORLDS,))):
                for loops in ("embed", "multipliers", "cut") if closed else ("raise",):
                    if closed and worlds != 4096:
                        continue
                    options: dict[str, Any] = dict(worlds=worlds, dtype=dtype, loops=loops)
                    title = f"{name}.{dtype}.w{worlds}" + (f".{loops}" if closed else "")
                    yield title, lambda scene=scene, options=options: dynamics_of(scene, **options)
                    if name in ("arm", "hinges", "go2", "fourbar") and worlds in (4096, 65536):
                        options = options | dict(variable=VARIABLE)
                        yield f"{title}.variable", lambda scene=scene, options=options: dynamics_of(scene, **options)


def calls(dyn: spo.Dynamics) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Every call that generates kernels."""
    dofs, bodies = dyn.scene.dof_count, dyn.scene.body_count
    entries = {"mass_matrix_derivative": 4 * dofs**3, "inverse_dynamics_regressor": 10 * dofs * bodies}
    declared = {name: one for name, one in dynamics.OPERATIONS.items() if one.results}
    for operation in (name for name, one in declared.items() if not one.product):
        more = FRAMES if "frames" in (option.name for option in declared[operation].options) else {}
        if dyn.worlds * entries.get(operation, 0) > MOST_ENTRIES:
            continue
        yield operation, lambda operation=operation, more=more: dyn.prepare(operation, **more)
        asked = [one for one in declared[operation].arrays if one.asked and _is_there(one.name, dyn.scene)]
        reports = tuple(one.name for one in asked if one.name in REPORT.members) if operation == "step" else ()
        optional: dict[str, Any] = {one.name: True for one in asked if one.name not in reports}
        optional |= {"report": reports} if reports else {}
        if optional:
            yield f"{operation}+", lambda operation=operation, more=more | optional: dyn.prepare(operation, **more)
    backwards = {f"{name}_vjp": one.derivative for name, one in declared.items() if one.derivative is not None}
    for product in (*backwards, *(name for name, one in declared.items() if one.product)):
        yield product, lambda product=product: dyn.prepare(product)
    values = dyn._gradients.values
    if values:
        for product, own in (
            ("forward_dynamics_vjp", ("q", "qd", "tau")),
            ("inverse_dynamics_vjp", ("q", "qd", "qdd")),
        ):
            wrt = (*own, *(name for name in values if name in backwards[product].values))
            yield f"{product} {' '.join(wrt)}", lambda product=product, wrt=wrt: dyn.prepare(product, wrt=wrt)
    yield "forward_dynamics_vjp tangent", lambda: dyn.prepare("forward_dynamics_vjp", wrt=("tangent", "qd"))
    yield "step midpoint", lambda: dyn.prepare("step", options=spo.StepOptions(integrator="midpoint"))
    yield "operators", lambda: expressions(dyn)


def _is_there(name: str, scene: spo.Scene) -> bool:
    """Return whether the scene has what a result of its contacts is about."""
    if name == "contact_moment":
        return any(scene.values[friction].any() for friction in TURNING_VALUES)
    return not name.startswith("contact_") or bool(scene.contacts)


def expressions(dyn: spo.Dynamics) -> None:
    """Operators and what is composed of them, applied."""
    o = dyn.operators(wp.zeros((dyn.worlds, dyn.scene.coord_count), dtype=dyn.dtype, device=dyn.device))
    mass = o.H @ o.phi @ o.M @ o.phi.T @ o.H.T + o.Delta
    factor = o.H @ o.psi @ o.K
    for operator in (o.phi, o.phi.T, o.psi, o.psi.T, o.H, o.G, o.K, o.D_inverse, o.P, o.E_psi, mass, factor):
        x = wp.zeros((dyn.worlds, operator.shape[1]), dtype=dyn.dtype, device=dyn.device)
        operator.apply(x, out=wp.zeros((dyn.worlds, operator.shape[0]), dtype=dyn.dtype, device=dyn.device))


def collect(pattern: str) -> Recorder:
    """The texts of all cases that match."""
    recorder = Recorder()
    with recording(recorder), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for title, make in subjects():
            dyn = None
            for name, call in _calls_of(make, pattern, title):
                recorder.case = f"{title}.{name}"
                recorder.cases.setdefault(recorder.case, [])
                try:
                    call()
                except (ValueError, TypeError) as error:
                    recorder.cases[recorder.case].append(f"refused: {type(error).__name__}")
            del dyn
    return recorder


def _calls_of(make: Callable[[], spo.Dynamics], pattern: str, title: str) -> Iterator[tuple[str, Callable[[], Any]]]:
    dyn = make()
    for name, call in calls(dyn):
        if re.search(pattern, f"{title}.{name}"):
            yield name, call


def compare(first: Path, second: Path) -> list[str]:
    """Names of cases that are in both folders and differ, and of those that are in one."""
    a, b = (json.loads((folder / "index.json").read_text()) for folder in (first, second))
    return [case for case in sorted({*a, *b}) if a.get(case) != b.get(case)]


def main(argv: list[str] | None = None) -> int:
    p = argparse.ArgumentParser(prog="python -m benchmarks.kernel_texts", description=__doc__,
                                formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    p.add_argument("folder", nargs="?", type=Path, help="where the texts go")
    p.add_argument("--limit", default="", metavar="PATTERN", help="regular expression of the cases to take")
    p.add_argument("--compare", nargs=2, type=Path, metavar=("A", "B"), help="folders that were written before")
    options = p.parse_args(argv)
    if options.compare:
        different = compare(*options.compare)
        print("\n".join(different) or "all texts are equal")
        return 1 if different else 0
    if options.folder is None:
        p.error("expected a folder, or --compare A B")
    recorder = collect(options.limit)
    options.folder.mkdir(parents=True, exist_ok=True)
    for key, text in recorder.texts.items():
        (options.folder / f"{key}.txt").write_text(text)
    (options.folder / "index.json").write_text(json.dumps(recorder.cases, indent=1, sort_keys=True))
    print(f"{len(recorder.cases)} cases, {len(recorder.texts)} texts")
    return 0


if __name__ == "__main__":
    sys.exit(main())
