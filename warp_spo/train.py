"""Train a task, into checkpoints and a learning curve: ``python -m warp_spo.train TASK [--worlds N] [--device D]``.

python -m warp_spo.train go2-flat                         # into runs/go2-flat
python -m warp_spo.train go2-flat --resume runs/go2-flat/model_399.pt --iterations 800
python -m warp_spo.train go2-flat --gpus 4                # one process a GPU, each with --worlds worlds
python -m warp_spo.train cartpole --gpus 2 --device cpu   # two processes on the CPU
"""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

BEGAN = time.time()


def main(arguments: list[str] | None = None) -> int:
    """Train the task that the arguments name."""
    from .command_line import Parser, count, seconds
    from .env.tasks import TASKS, task
    from .env.validation import check_folder

    parser = Parser(
        prog="python -m warp_spo.train", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("task", choices=sorted(TASKS))
    parser.add_argument("--worlds", type=count, help="of each GPU; left out: as the task says")
    parser.add_argument("--device", help="such as cuda:0 or cpu; left out: cuda:0 if there is one")
    parser.add_argument("--gpus", type=count, default=1, help="processes (torchrun), one a GPU, or with --device cpu")
    parser.add_argument("--iterations", type=count, help="in all; left out: as the task says")
    parser.add_argument(
        "--seconds", type=seconds, default=math.inf, help="from the start, after which it stops; one GPU"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="folder; left out: runs/TASK")
    parser.add_argument("--resume", type=Path, help="checkpoint to continue from")
    parser.add_argument("--save-interval", type=count, default=100, help="iterations between checkpoints")
    options = parser.parse_args(arguments)
    folder = options.out or Path("runs") / options.task
    try:
        check_folder(folder, options.resume)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    if options.gpus > 1 and "LOCAL_RANK" not in os.environ:
        if options.device not in (None, "cpu"):
            parser.error(f"--gpus {options.gpus} with --device {options.device}; expected no --device, or cpu")
        if math.isfinite(options.seconds):
            parser.error(f"--gpus {options.gpus} with --seconds; expected --iterations, for all processes to stop at")
        given = sys.argv[1:] if arguments is None else arguments
        run = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={options.gpus}"]
        return subprocess.call([*run, "-m", "warp_spo.train", *given])

    learning = load_learning(parser)
    from .env.training_log import draw_curve

    rank = int(os.environ.get("RANK", 0))
    chosen = task(options.task)
    worlds = options.worlds or chosen.LEARNER.worlds
    try:
        device = learning.pick_device(options.device)
        env = chosen.build(worlds, device, seed=options.seed, first_world=rank * worlds)
        print(f"{options.task}: {worlds} worlds on {device}, {time.time() - BEGAN:.1f} s", flush=True)
        runner, iterations = learning.prepare(
            env, chosen.LEARNER, folder, options.iterations, options.resume, options.seed + rank,
            options.save_interval, began=BEGAN, seconds=options.seconds,
        )  # fmt: skip
    except (ValueError, OSError) as error:
        parser.error(str(error))
    learning.run(runner, iterations)
    if rank == 0:
        print(f"{folder}: checkpoints, progress.jsonl, {draw_curve(folder, options.task).name}")
    learning.leave()
    return 0


def load_learning(parser: Any) -> Any:
    """Return the module that trains; without rsl_rl the parser says what to install."""
    try:
        from .env import learning
    except ImportError as error:
        parser.error(f"{error}; install what learns: pip install -e '.[rl]'")
    return learning


if __name__ == "__main__":
    sys.exit(main())
