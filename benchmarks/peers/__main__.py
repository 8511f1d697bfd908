"""Run ``python -m benchmarks.peers [FILTER]``: check and time other libraries on our robots and states."""

import argparse
import importlib
import re
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path

import warp as wp

from warp_spo.__main__ import find_device
from warp_spo.trials.inputs import Inputs

from ..table import runner
from ..table.cases import SCENES
from . import PEERS
from .coordinates import SETS
from .lumped import Unsupported, lump
from .peer import Absent

METRICS = ("us", "evals_per_s", "spread", "error", "compile_s")
WORLDS = (1, 16, 128, 1024, 4096, 65536)
ROBOTS = ("panda", "go2", "g1")


def parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(prog="python -m benchmarks.peers", description=__doc__)
    p.add_argument("filter", nargs="?", default="", help="regular expression of PEER.SCENE.OPERATION.VARIANT.DTYPE")
    p.add_argument("--device", help="Warp device; default: the current one")
    p.add_argument("--worlds", type=int, nargs="+", default=WORLDS, metavar="N", help="world counts")
    p.add_argument(
        "--scenes", nargs="+", default=ROBOTS, choices=SCENES, metavar="NAME", help="robots without armature"
    )
    p.add_argument("--peers", nargs="+", default=list(PEERS), choices=PEERS, metavar="PEER", help=", ".join(PEERS))
    p.add_argument("--compile", action="store_true", help="compile the kernels into the caches, and time nothing")
    p.add_argument("--json", type=Path, metavar="OUT", help="write the run to this file, or by date into this folder")
    return p


def say_skipped(what: str, reason: object) -> None:
    """Print on stderr that something is skipped, and why."""
    print(f"skipped {what}: {reason}", file=sys.stderr, flush=True)


def rows(options: argparse.Namespace) -> Iterator[dict]:
    """Yield a row for each case; a peer that fails is skipped with its traceback, and the others go on."""
    pattern, worlds = re.compile(options.filter), sorted(set(options.worlds))
    present = {}
    for name in options.peers:
        try:
            peer = importlib.import_module(f".{PEERS[name]}", __package__).PEER
            present[name] = peer, peer.version()
        except (Absent, ImportError) as reason:
            say_skipped(name, reason)
    for scene in options.scenes:
        if not present:
            return
        try:
            robot = lump(SCENES[scene]())
        except (ImportError, FileNotFoundError, Unsupported) as reason:
            say_skipped(scene, reason)
            continue
        inputs = [Inputs(robot.scene, worlds[-1], seed) for seed in range(SETS)]
        for name, (kind, version) in present.items():
            for dtype in kind.dtypes:

                def wanted(op: str, variant: str, head: str = f"{name}.{scene}", tail: str = dtype) -> bool:
                    return bool(pattern.search(f"{head}.{op}.{variant}.{tail}"))

                if not any(wanted(*work) for work in kind.works):
                    continue
                try:
                    peer = kind(robot, options.device, dtype)
                    peer.scene, peer.timed = scene, not options.compile
                    for row in peer.rows(inputs, worlds, wanted):
                        yield complete_row(row, scene, robot, f"{kind.name} {version}", kind, dtype)
                except (Absent, Unsupported) as reason:
                    say_skipped(f"{name}.{scene}.{dtype}", reason)
                except Exception:
                    say_skipped(f"{name}.{scene}.{dtype}", "the peer raised the following error")
                    traceback.print_exc()


def complete_row(row: dict, scene: str, robot: object, peer: str, kind: type, dtype: str) -> dict:
    """Return a peer's row with the keys of the benchmark's rows, and ``peer``, ``variant``, ``work``."""
    op, variant = row["op"], row["variant"]
    head = dict(name=f"{scene}.{op}", scene=scene, worlds=row["worlds"], op=op, dtype=dtype, peer=peer, variant=variant)
    row = head | dict(work=kind.works[op, variant], bodies=len(robot.links), dof=len(robot.dofs)) | row
    if "us" in row:
        row["spread"] = (row["p90_us"] - row["p10_us"]) / row["us"]
        row["evals_per_s"] = 1e6 * row["worlds"] / row["us"]
    return row


def case_name(row: dict) -> str:
    """Return a name such as ``mujoco_warp-3.17.0.panda.forward_dynamics.float32.w4096``."""
    variant = f".{row['variant']}".replace(" ", "_") if row["variant"] else ""
    return f"{row['peer'].replace(' ', '-')}.{row['name']}{variant}.{row['dtype']}.w{row['worlds']}"


def main(argv: list[str] | None = None) -> int:
    """Run the command; return 0, or 2 for a mistake in the call."""
    options = parser().parse_args(argv)
    wp.config.log_level = wp.LOG_WARNING
    try:
        find_device(options.device)
        re.compile(options.filter)
    except (ValueError, RuntimeError, re.error) as error:
        print(error, file=sys.stderr)
        return 2
    options.device = str(wp.get_device(options.device))
    found: list[dict] = []
    run, file = runner.record(found, options.device), None
    for row in rows(options):
        found.append(row)
        if "skipped" in row:
            say_skipped(case_name(row), row["skipped"])
        else:
            print("\n".join(f"{case_name(row)}.{m} {row[m]:.4g}" for m in METRICS if m in row), flush=True)
        if options.json:  # after each row: a peer may end the process, or ignore interrupts while it compiles
            file = runner.save(run, options.json)
    if file:
        print(f"wrote {file}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
