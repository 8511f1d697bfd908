"""The parts of ``--everything``, in order of importance: which cases, and for how long on one H200 or two CPU cores."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence

from .everything import Part
from .precisions import HEADLINE
from .robots import ROBOTS

BASIC = f"({'|'.join(HEADLINE)})"
MOST = 65536  # largest world count at which kernels are compiled; cases with more worlds use the same kernels
WORLDS, CPU_WORLDS = ("1", "16", "128", "1024", "4096", "65536"), ("1", "128")  # world counts of peers
LONG = "n1023$|n1024$|n4096$|million|4096_worlds"  # cases of the stress suite that take minutes


def ours(name: str, cases: str, seconds: float, *options: str, worlds: Sequence[str] = ()) -> Part:
    """Return a part that runs ``python -m benchmarks``."""

    def command(counts: Sequence[str]) -> list[str]:
        return ["benchmarks", cases, *options, *(["--worlds", *counts] if counts else [])]

    few = list(dict.fromkeys(str(min(MOST, int(count))) for count in worlds))
    return Part(name, command(worlds), [*command(few), "--compile"], seconds)


def peer(
    name: str, scenes: Sequence[str], seconds: float, worlds: Sequence[str], cases: str = "", kind: str = ""
) -> Part:
    """Return a part that runs a peer on some robots; ``kind`` names the part where a peer has several."""
    head = ["benchmarks.peers", cases, "--peers", name, "--scenes", *scenes]
    label = ".".join([name, *scenes[:1], *([kind] if kind else [])]) if len(scenes) == 1 else name
    return Part(label, [*head, "--worlds", *worlds], [*head, "--worlds", "1", "--compile"], seconds)


def newton(robot: str) -> list[Part]:
    """Return Newton's parts for a robot: one for each of its functions, because each compiles for minutes."""
    few = WORLDS[:-1] if robot == "g1" else WORLDS  # a step of G1 at 65536 worlds takes 2.5 s
    return [
        peer("newton", [robot], 30.0, WORLDS, "eval_mass_matrix", "mass"),
        peer("newton", [robot], 90.0, WORLDS, "SolverSteel", "steel"),
        peer("newton", [robot], 60.0, few, r"SolverFeatherstone\.", "featherstone"),
        peer("newton", [robot], 60.0, WORLDS, "tiles", "tiles"),
    ]


def gpu_parts() -> list[Part]:
    """Return all parts for a GPU: the README's rows, our other rows, peers, the stress suite."""
    both, jobs = ("--dtype", "float32", "float64"), str(max(1, (os.cpu_count() or 2) * 3 // 4))
    parts = [
        ours(f"headline.{robot}", rf"^{robot}\.{BASIC}\.", 180.0, *both, worlds=("1", "4096", "65536", "1048576"))
        for robot in ROBOTS
    ]
    parts += [ours(f"operations.{robot}", rf"^{robot}\.(?!{BASIC})", 90.0, *both) for robot in ROBOTS]
    parts += [ours(f"throughput.{robot}", rf"^{robot}\.(phi|phi\.T|psi|mass@v)\.", 60.0, "--dtype", "float32",
                   worlds=("1048576",)) for robot in ROBOTS]  # fmt: skip
    parts += [ours(f"randomised.{robot}", rf"^{robot}\.", 90.0, "--dtype", "randomised", worlds=("4096", "1048576"))
              for robot in ROBOTS]  # fmt: skip
    parts += [ours(f"sweep.{name}", rf"^({scenes})", 90.0, "--sweeps")
              for name, scenes in (("worlds", "arm7|humanoid"), ("shapes", "chain|tree|deep|branching"))]  # fmt: skip
    parts += [ours("others", rf"^(arm7|humanoid)\.{BASIC}\.", 60.0, *both)]
    for robot in ROBOTS:
        parts += [
            ours(f"refined.{robot}", rf"^{robot}\.", 30.0, "--dtype", "refined"),
            ours(f"granularities.{robot}", rf"^{robot}\.{BASIC}", 90.0, *both, "--granularity", "node", "segment",
                 "tree"),
        ]  # fmt: skip
    parts += [Part("capabilities", ["benchmarks.capabilities"], None, 240.0)]
    parts += [Part("stress.node", ["benchmarks.stress", "--granularity", "node"], None, 150.0)]
    for robot in ROBOTS:
        parts += [peer("mujoco_warp", [robot], 40.0, WORLDS), peer("grid", [robot], 60.0, WORLDS)]
        parts += newton(robot)[:3]
        parts += [peer("resolvent", [robot], 40.0, ("1", "128", "4096")), peer("torch", [robot], 80.0, WORLDS)]
    parts += [peer("frax", ["panda"], 80.0, WORLDS)]
    parts += [peer("pinocchio", list(ROBOTS), 150.0, WORLDS)._replace(alone=True)]
    parts += [Part("stress.long", ["benchmarks.stress", LONG, "--slow"], None, 150.0)]
    parts += [newton(robot)[3] for robot in ROBOTS]
    parts += [Part("stress.plan", ["benchmarks.stress", "--check", "--jobs", jobs], None, 240.0)]
    return parts


def cpu_parts() -> list[Part]:
    """Return all parts for a CPU, which are fewer and smaller."""
    both = ("--dtype", "float32", "float64")
    parts = [ours(f"headline.{robot}", rf"^{robot}\.{BASIC}\.", 90.0, *both) for robot in (*ROBOTS, "humanoid")]
    for robot in ROBOTS:
        parts += [peer(name, [robot], 60.0, CPU_WORLDS) for name in ("mujoco", "torch", "resolvent")]
    parts += [peer("pinocchio", list(ROBOTS), 120.0, CPU_WORLDS)]
    parts += [ours("sweep.worlds", "^(arm7|humanoid)", 60.0, "--sweeps")]
    parts += [ours("sweep.shapes", "^(chain|tree|deep|branching)", 120.0, "--sweeps")]
    parts += [Part("stress.node", ["benchmarks.stress", "--granularity", "node"], None, 300.0)]
    return parts


def choose(pattern: str, cuda: bool, device: str) -> list[Part]:
    """Return the parts whose name has a match of the regular expression ``pattern``, for ``device``.

    Raises:
        ValueError: no part has, or ``pattern`` is not a regular expression.
    """
    everything = gpu_parts() if cuda else cpu_parts()
    try:
        chosen = [part for part in everything if re.search(pattern, part.name)]
    except re.error as error:
        raise ValueError(f"benchmarks: filter {pattern!r} is no regular expression: {error}") from None
    if not chosen:
        names = ", ".join(part.name for part in everything)
        raise ValueError(f"benchmarks: no part matches {pattern!r}; expected a regular expression of {names}")
    where = ["--device", device]
    return [part._replace(measure=[*part.measure, *where], compile=part.compile and [*part.compile, *where])
            for part in chosen]  # fmt: skip
