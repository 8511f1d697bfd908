"""Benchmark cases are data: a scene, an operation, a number of worlds, a precision and a granularity."""

import dataclasses
import functools
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

import warp_spo as spo
from warp_spo.trials.inputs import OPERATIONS

from . import robots
from .precisions import PRECISIONS
from .shapes import SHAPES

WORLDS = (4096,)
CPU_WORLDS = (1024,)  # fewer: one core computes them one after the other
DTYPES = ("float32", "float64")
GRANULARITIES = (None, "node", "segment", "tree")  # None: the plan's choice


def arm() -> spo.Scene:
    """Return a 7-dof arm: links of 0.25 m and 2 kg on revolute hinges about z and y in turn, each with armature."""
    inertia, up = np.diag([0.012, 0.012, 0.002]), (0.0, 0.0, 0.25, 0.0, 0.0, 0.0, 1.0)
    bodies = [spo.Body(2.0, (0.0, 0.0, 0.125), inertia, label=f"link_{k}") for k in range(7)]
    axes = np.eye(3)[[2, 1]]
    hinges = [spo.Hinge("revolute", k - 1, k, axis=axes[k % 2], parent_pose=up, armature=0.01) for k in range(7)]
    return spo.Scene(bodies, hinges)


def _newton_robot(name: str, floating: bool | None = None) -> spo.Scene:
    from warp_spo.newton import shipped

    return spo.load(shipped(name), floating=floating)


SCENES = {
    "cartpole": functools.partial(_newton_robot, "cartpole"),
    "arm7": arm,
    "ant": functools.partial(_newton_robot, "ant"),
    "quadruped": functools.partial(_newton_robot, "quadruped", floating=True),
    "humanoid": functools.partial(_newton_robot, "humanoid"),
} | {name: functools.partial(robots.scene, name) for name in robots.ROBOTS}
"""Name -> function that makes the scene; released robots raise ImportError without the extra ``robots``."""


FACTORIES = SCENES | SHAPES


@dataclasses.dataclass(frozen=True)
class Sweep:
    """Cases in float32 whose scene or world count grows.

    Attributes:
        name: name of the quantity that grows.
        scenes: names of the scenes.
        worlds: world counts on a GPU.
        cpu_worlds: world counts on a CPU.
        granularity: granularity of all cases; None: the plan's choice.
    """

    name: str
    scenes: Sequence[str]
    worlds: Sequence[int]
    cpu_worlds: Sequence[int]
    granularity: str | None = None


def _family(name: str) -> list[str]:
    return [scene for scene in SHAPES if scene.startswith(f"{name}_")]


SWEEPS = (
    Sweep("worlds", ("arm7", "humanoid"), [4**k for k in range(11)], [4**k for k in range(7)]),
    # Only granularity "node" compiles nothing for a scene; the others would take minutes for the largest scenes.
    *(Sweep(name, _family(name), (1024,), (4,), "node") for name in ("chain", "tree", "deep", "branching")),
)
SWEPT = ("forward_dynamics", "inverse_dynamics")
SAMPLE, FEWER = 16, 4  # worlds of each set of inputs that are compared with the reference; FEWER in sweeps, and
MANY = 4096  # where a case has more worlds than this


def cases(
    pattern: str = "",
    worlds: Any = WORLDS,
    dtypes: Any = DTYPES,
    granularities: Any = (None,),
    sweeps: bool = False,
    cuda: bool = True,
) -> list[dict]:
    """Return the cases whose ``case_name`` has a match of the regular expression ``pattern``.

    Args:
        pattern: a released robot that is not available is left out unless ``pattern`` names it.
        worlds, dtypes, granularities: values of which all combinations are cases.
        sweeps: return cases of :data:`SWEEPS` instead.
        cuda: whether sweeps have the sizes for a GPU, or those for a CPU.

    Raises:
        ValueError: no case matches, or a world count is below one.
    """
    if min(worlds) < 1:
        raise ValueError(f"benchmarks: --worlds has {min(worlds)}; expected one or more")
    every = [
        _case(scene, count, op, dtype, granularity, FEWER if count > MANY else SAMPLE)
        for scene in SCENES
        if scene not in robots.ROBOTS or scene in pattern or robots.is_available(scene)
        for count in worlds
        for dtype in dtypes
        for granularity in granularities
        for op in PRECISIONS[dtype].operations
    ]
    if sweeps:
        every = [
            _case(scene, count, op, "float32", sweep.granularity, FEWER) | dict(sweep=sweep.name)
            for sweep in SWEEPS
            for scene in sweep.scenes
            for count in (sweep.worlds if cuda else sweep.cpu_worlds)
            for op in SWEPT
        ]
    try:
        chosen = [case for case in every if re.search(pattern, case_name(case))]
    except re.error as error:
        raise ValueError(f"benchmarks: filter {pattern!r} is no regular expression: {error}") from None
    if not chosen:
        raise ValueError(
            f"benchmarks: no case matches {pattern!r}; expected a regular expression that matches part of "
            f"SCENE.OPERATION.DTYPE.wWORLDS with\n  scene      {', '.join(SCENES)}\n  operation  "
            f"{', '.join(OPERATIONS)}\n  dtype      {', '.join(dtypes)}\n  worlds     {', '.join(map(str, worlds))}"
        )
    return chosen


def _case(scene: str, worlds: int, op: str, dtype: str, granularity: str | None, sample: int) -> dict:
    case = dict(name=f"{scene}.{op}", scene=scene, worlds=worlds, op=op, dtype=dtype, granularity=granularity)
    return case | dict(sample=sample)


def case_name(case: dict) -> str:
    """Return a name such as ``humanoid.forward_dynamics.float32.w4096``, with ``.node`` if the case asks for it."""
    asked = case.get("granularity") and not case.get("chosen")
    return f"{case['name']}.{case['dtype']}.w{case['worlds']}" + (f".{case['granularity']}" if asked else "")
