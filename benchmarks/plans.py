"""Check the plan's choice of granularity: time forward dynamics of ten random trees at each, and at the plan's choice.

    python -m benchmarks.plans [--device cuda:0] [--trees 0 1 ...] [--worlds 1 256 4096 65536] [--compile]

A line gives, for one tree and world count, the time at each granularity [us], the plan's choice, and its time over the
shortest. All kernels are compiled first, several at a time. The exit code is 1 if a choice takes more than ``ALLOWED``
times the shortest.
"""

import argparse
import os
import sys
import time
from pathlib import Path

import warp as wp

import warp_spo as spo
from warp_spo.kernels.slots import WARP_SIZE
from warp_spo.trials.operations import OPERATIONS, Inputs
from warp_spo.trials.trial import Subject, Trial

sys.path.append(str(Path(__file__).parent.parent / "tests"))  # the random trees come from the tests
import zoo

OPERATION = "forward_dynamics"
WORLDS = (1, 256, 4096, 65536)
NODE_WORLDS = 256  # largest world count at which granularity "node", one launch for each level, is timed
ALLOWED = 1.1  # largest time of the plan's choice, over the shortest
SAMPLE, REPEATS, WARM_UP, BUDGET = 1, 10, 0.01, 0.1


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="benchmarks.plans", description="Compare the plan's choice with the best.")
    parser.add_argument("--device", help="Warp device, default: the current one")
    parser.add_argument("--trees", nargs="+", type=int, default=list(range(len(zoo.BRANCHED))))
    parser.add_argument("--worlds", nargs="+", type=int, default=WORLDS)
    parser.add_argument(
        "--compile", action="store_true", help="compile the kernels into Warp's cache, and time nothing"
    )
    options = parser.parse_args(arguments)
    start = time.perf_counter()
    scenes = {which: zoo.branched(which) for which in options.trees}
    made = {which: trace_dynamics(scene, options.worlds, options.device) for which, scene in scenes.items()}
    compile_kernels(made)
    print(f"traced and compiled in {time.perf_counter() - start:.0f} s", flush=True)
    if options.compile:
        return 0
    beyond = []
    for which, scene in scenes.items():
        for worlds in options.worlds:
            chosen = OPERATIONS[OPERATION].granularity(spo.Dynamics(scene, worlds, options.device))
            inputs = [Inputs(scene, worlds)]
            times = {}
            for name in ("tree", "segment", *(["node"] if worlds <= NODE_WORLDS else [])):
                dyn = made[which].get((name, worlds)) or spo.Dynamics(scene, worlds, options.device, granularity=name)
                trial = Trial(Subject(dyn, inputs), OPERATIONS[OPERATION], SAMPLE)
                times[name] = 1e6 * trial.measure(REPEATS, WARM_UP, BUDGET)[0].median
            ratio = times[chosen] / min(times.values())
            beyond += [ratio] * (ratio > ALLOWED)
            shown = ", ".join(f"{name} {us:.4g}" for name, us in times.items())
            limbs = sum(not children for children in scene.tree.children)
            print(
                f"tree {which}: {scene.dof_count} dof, depth {scene.tree.depth}, {limbs} leaves, w{worlds}: {shown}; "
                f"plan {chosen}, {ratio:.3f} of the best",
                flush=True,
            )
    print(f"{len(beyond)} of {len(scenes) * len(options.worlds)} choices take more than {ALLOWED} times the best")
    return 1 if beyond else 0


def trace_dynamics(scene: spo.Scene, counts: list[int], device: str | None) -> dict[tuple[str, int], spo.Dynamics]:
    """Return a Dynamics for each granularity and world count, traced but not compiled; equal plans share programs."""
    made, programs = {}, {}
    for name in ("tree", "segment"):
        for worlds in counts:
            made[name, worlds] = dyn = spo.Dynamics(scene, worlds, device, granularity=name)
            key = name, dyn.plan.staged, dyn.plan.few, dyn.plan.apart
            if key in programs:
                dyn.programs._programs = programs[key]
                continue
            rate = (worlds, scene.dof_count)
            dyn.programs.find(
                OPERATIONS[OPERATION].routine, {"q": (worlds, scene.coord_count), "qd": rate, "tau": rate}, rate
            )
            programs[key] = dyn.programs._programs
    return made


def compile_kernels(made: dict) -> None:
    """Compile the kernels of all Dynamics, several at a time."""
    blocks: dict[int, dict] = {}
    device = None
    for dyns in made.values():
        for dyn in dyns.values():
            device = dyn.device
            for program in dyn.programs._programs.values():
                kernel = program.kernel
                blocks.setdefault(program.block if device.is_cuda else WARP_SIZE, {})[kernel.key] = kernel.module
    for block, modules in blocks.items():
        wp.force_load(device, list(modules.values()), block_dim=block, max_workers=os.cpu_count())


if __name__ == "__main__":
    sys.exit(main())
