"""Times of an iteration of a training: without a page, with a page, and while a browser looks at it.

    python -m benchmarks.watched_training --device cuda:0 --json watched.json

The three take turns on one environment; at most 0.5 % and 3 % are asked for.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from pathlib import Path

from warp_spo.env import learning
from warp_spo.env.state_copies import StateCopies
from warp_spo.env.tasks import task
from warp_spo.viewing.training_view import TrainingView

LIMITS = {"page": 0.005, "looked at": 0.03}  # by how much an iteration may be longer


def main(arguments: list[str] | None = None) -> int:
    """Measure, print a table, and return 1 where a limit is passed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="go2-flat")
    parser.add_argument("--worlds", type=int, default=4096)
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--iterations", type=int, default=20, help="of a turn")
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    chosen = task(options.task)
    env = chosen.build(options.worlds, options.device, seed=0)
    copies = StateCopies(env)
    total = options.iterations * (3 * options.turns + 1)
    with tempfile.TemporaryDirectory() as folder:
        runner, _ = learning.prepare(env, chosen.LEARNER, folder, total, save_interval=10**6, loggers=())
        runner.watchers.append(copies.copy)
        times: dict[str, list[float]] = {"none": [], "page": [], "looked at": []}
        runner.learn(options.iterations)  # compiles and warms up
        for _ in range(options.turns):
            for state, rows in times.items():
                view = None
                if state != "none":
                    view = TrainingView(env.scene, copies, lambda: [], env.default_q)
                    if state == "looked at":
                        view.page.record()  # as a browser that looks
                    view.start()
                    time.sleep(1.0)
                began = time.perf_counter()
                runner.learn(options.iterations)
                env.q.sum().item()  # waits for the device
                rows.append((time.perf_counter() - began) / options.iterations)
                if view is not None:
                    view.page._recorded = None
                    view.close()
    medians = {state: statistics.median(rows) for state, rows in times.items()}
    more = {state: medians[state] / medians["none"] - 1.0 for state in LIMITS}
    for state, seconds in medians.items():
        print(f"{state:10} {1e3 * seconds:8.2f} ms an iteration {100 * more.get(state, 0.0):+6.2f} %")
    print(f"copies: {copies.count}")
    if options.json:
        options.json.write_text(json.dumps({"seconds": medians, "longer": more, "worlds": options.worlds}, indent=1))
    return int(any(more[state] > limit for state, limit in LIMITS.items()))


if __name__ == "__main__":
    raise SystemExit(main())
