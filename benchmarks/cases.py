"""Benchmark cases are data: a scene, an operation, a number of worlds and a precision."""

import functools
import re
from typing import Any

import numpy as np

import warp_spo as spo
from warp_spo.operations import OPERATIONS

WORLDS = (4096,)
DTYPES = ("float32", "float64")


def arm() -> spo.Scene:
    """A 7-dof arm from code: links of 0.25 m and 2 kg on revolute hinges about z and y in turn, each with armature."""
    inertia, up = np.diag([0.012, 0.012, 0.002]), (0.0, 0.0, 0.25, 0.0, 0.0, 0.0, 1.0)
    bodies = [spo.Body(2.0, (0.0, 0.0, 0.125), inertia, label=f"link_{k}") for k in range(7)]
    axes = np.eye(3)[[2, 1]]
    hinges = [spo.Hinge("revolute", k - 1, k, axis=axes[k % 2], parent_pose=up, armature=0.01) for k in range(7)]
    return spo.Scene(bodies, hinges)


def _shipped(name: str, floating: bool | None = None) -> spo.Scene:
    from warp_spo.newton import shipped

    return spo.load(shipped(name), floating=floating)


SCENES = {
    "cartpole": functools.partial(_shipped, "cartpole"),
    "arm7": arm,
    "ant": functools.partial(_shipped, "ant"),
    "quadruped": functools.partial(_shipped, "quadruped", floating=True),
    "humanoid": functools.partial(_shipped, "humanoid"),
}
"""Name -> scene factory."""


def cases(pattern: str = "", worlds: Any = WORLDS, dtypes: Any = DTYPES) -> list[dict]:
    """Cases of all scenes and operations whose ``case_name`` holds a match of the regular expression ``pattern``.

    Raises:
        ValueError: no case does, naming what there is; or a world count below one.
    """
    if min(worlds) < 1:
        raise ValueError(f"benchmarks: --worlds has {min(worlds)}; expected one or more")
    every = [
        dict(name=f"{scene}.{op}", scene=scene, worlds=count, op=op, dtype=dtype)
        for scene in SCENES
        for count in worlds
        for dtype in dtypes
        for op in OPERATIONS
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


def case_name(case: dict) -> str:
    """Such as ``humanoid.forward_dynamics.float32.w4096``."""
    return f"{case['name']}.{case['dtype']}.w{case['worlds']}"
