"""The parts of the table of results: which cases, at which precisions and numbers of worlds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from .precisions import HEADLINE
from .robots import ROBOTS

BASIC = f"({'|'.join(HEADLINE)})"
MOST = 65536  # largest world count at which kernels are compiled; cases with more worlds use the same kernels


class Part(NamedTuple):
    """Cases that arguments of ``python -m benchmarks`` select.

    Attributes:
        name: name of the part.
        measure: arguments that select the cases.
        compile: the same with as few worlds as select all kernels.
    """

    name: str
    measure: Sequence[str]
    compile: Sequence[str]


def part(name: str, cases: str, *options: str, worlds: Sequence[str] = ()) -> Part:
    """Return a part of the cases that match a regular expression, at some numbers of worlds."""

    def arguments(counts: Sequence[str]) -> list[str]:
        return [cases, *options, *(["--worlds", *counts] if counts else [])]

    few = list(dict.fromkeys(str(min(MOST, int(count))) for count in worlds))
    return Part(name, arguments(worlds), arguments(few))


def gpu_parts() -> list[Part]:
    """Return all parts for a GPU: the README's rows first, then all other rows of this library."""
    both = ("--dtype", "float32", "float64")
    parts = [
        part(f"headline.{robot}", rf"^{robot}\.{BASIC}\.", *both, worlds=("1", "4096", "65536", "1048576"))
        for robot in ROBOTS
    ]
    parts += [part(f"operations.{robot}", rf"^{robot}\.(?!{BASIC})", *both) for robot in ROBOTS]
    parts += [part(f"throughput.{robot}", rf"^{robot}\.(phi|phi\.T|psi|mass@v)\.", "--dtype", "float32",
                   worlds=("1048576",)) for robot in ROBOTS]  # fmt: skip
    parts += [part(f"randomised.{robot}", rf"^{robot}\.", "--dtype", "randomised", worlds=("4096", "1048576"))
              for robot in ROBOTS]  # fmt: skip
    parts += [part(f"sweep.{name}", rf"^({scenes})", "--sweeps")
              for name, scenes in (("worlds", "arm7|humanoid"), ("shapes", "chain|tree|deep|branching"))]  # fmt: skip
    parts += [part("others", rf"^(arm7|humanoid)\.{BASIC}\.", *both)]
    for robot in ROBOTS:
        parts += [
            part(f"refined.{robot}", rf"^{robot}\.", "--dtype", "refined"),
            part(f"granularities.{robot}", rf"^{robot}\.{BASIC}", *both, "--granularity", "node", "segment", "tree"),
        ]
    return parts
