"""The parts of ``--everything``, in order of importance: which cases, for how long. Seconds are of an H200, of 2 cores."""

from __future__ import annotations

import re
from collections.abc import Sequence

from .everything import Part

ROBOTS = ("panda", "go2", "g1")
HEADLINE = "(forward_dynamics|inverse_dynamics|mass_matrix|solve_mass_matrix)"
PEERS_WORLDS = ("1", "16", "128", "1024", "4096", "65536")
PEERS_CPU_WORLDS = ("1", "128")


def ours(name: str, cases: str, seconds: float, *options: str, worlds: Sequence[str] = ()) -> Part:
    """A part of ``python -m benchmarks``; ``worlds``: those that it measures, of which 65536 stand for more."""
    head = ["benchmarks", cases, *options]
    few = list(dict.fromkeys(str(min(65536, int(count))) for count in worlds))
    return Part(name, [*head, *(["--worlds", *worlds] if worlds else [])],
                [*head, *(["--worlds", *few] if few else []), "--compile"], seconds)  # fmt: skip


def peer(name: str, scene: str, seconds: float, worlds: Sequence[str], cases: str = "", label: str = "") -> Part:
    """A part of ``python -m benchmarks.peers``: a peer with one robot."""
    head = ["benchmarks.peers", cases, "--peers", name, "--scenes", scene]
    return Part(f"{name}.{scene}{label}", [*head, "--worlds", *worlds], [*head, "--worlds", "1", "--compile"], seconds)


def newton(scene: str, seconds: float) -> list[Part]:
    """Newton's are cut by what they compile: the solver in tiles takes minutes for many dof."""
    kinds = dict(mass="eval_mass_matrix", featherstone=r"SolverFeatherstone\.", steel="SolverSteel", tiles="tiles")
    return [peer("newton", scene, seconds, PEERS_WORLDS, case, f".{kind}") for kind, case in kinds.items()]


def on_gpu() -> list[Part]:
    parts: list[Part] = []
    for robot in ROBOTS:
        parts.append(ours(f"headline.{robot}", rf"^{robot}\.{HEADLINE}\.", 60, "--dtype", "float32", "float64",
                          worlds=("1", "4096", "65536", "1048576")))  # fmt: skip
    parts += [part for robot in ROBOTS for part in newton(robot, 60)]
    for robot in ROBOTS:
        parts += [peer(name, robot, 40, PEERS_WORLDS) for name in ("mujoco_warp", "grid", "torch")]
    parts += [peer("frax", "panda", 20, PEERS_WORLDS)]
    parts += [peer("pinocchio", robot, 60, PEERS_WORLDS) for robot in ROBOTS]
    return parts


def on_cpu() -> list[Part]:
    parts = [ours(f"headline.{robot}", rf"^{robot}\.{HEADLINE}\.", 60, "--dtype", "float32", "float64")
             for robot in (*ROBOTS, "humanoid")]  # fmt: skip
    return parts


def choose(pattern: str, cuda: bool, device: str) -> list[Part]:
    """Parts whose name holds a match of the regular expression, on ``device``.

    Raises:
        ValueError: none does.
    """
    everything = on_gpu() if cuda else on_cpu()
    chosen = [part for part in everything if re.search(pattern, part.name)]
    if not chosen:
        names = ", ".join(part.name for part in everything)
        raise ValueError(f"benchmarks: no part matches {pattern!r}; expected a regular expression of {names}")
    where = ["--device", device]
    return [part._replace(measure=[*part.measure, *where], compile=part.compile and [*part.compile, *where])
            for part in chosen]  # fmt: skip
