"""Times of a page on the CPU: a frame of many robots at which somebody looks, and the first picture after the command.

    python -m benchmarks.page_times --json page.json

A frame is poses of the bodies, their way to the server, and what the server's thread makes of them for one reader (see
``page_client``): CPU time of the process, without steps of the environment. The first picture is that of
``python -m warp_spo.view ROBOT``, from the command until a reader has the bodies' triangles: CPU time of the command,
which does not depend on what else the machine does, and time on the clock. The cache of kernels is warm. At most 4 ms
for 16 robots, 15 ms for 1,024, and 8 s are asked for.
"""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

from warp_spo.env import robots
from warp_spo.env.tasks import task
from warp_spo.newton import SHIPPED

from .page_client import looking, read

FRAMES = {16: 4e-3, 1024: 15e-3}  # robots -> the longest frame [s]
FIRST = 8.0  # the longest time until the first picture [s]
ROUNDS, COUNT = 5, 40  # of which the least counts, and frames of a round
PAUSE = 0.01  # between frames, in which the server sends [s]


def time_frames(worlds: int) -> float:
    """Return the CPU time of a frame of so many Go2 [s]."""
    from warp_spo.viewing.appearance import file_appearance
    from warp_spo.viewing.policy_view import PolicyView

    env = task("go2-flat").build(worlds, "cpu", seed=0)
    look = file_appearance(robots.FILES / "go2.xml", env.scene)
    view = PolicyView(env, lambda observed: None, appearance=look)
    view.numbers["worlds shown"].value = worlds
    view.pause()
    times = []
    with looking(view.page):
        for _ in range(ROUNDS):
            began = time.process_time()
            for _ in range(COUNT):
                env.q[:, 0] += 1e-3
                view.tick(0.0)
                time.sleep(PAUSE)
            view.page.server.flush()
            times.append((time.process_time() - began) / COUNT)
    view.close()
    return min(times)


def time_first(robot: str) -> tuple[float, float]:
    """Return the CPU time of the command until its page has been read, and the time on the clock [s]."""
    began = time.perf_counter()
    command = [sys.executable, "-m", "warp_spo.view", robot, "--port", "18700"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        url = process.stdout.readline().split()[1]
        read(url, least=1)
        wall = time.perf_counter() - began
        ticks = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()[11:13]
        process.send_signal(signal.SIGINT)
    return sum(map(int, ticks)) / 100.0, wall


def main(arguments: list[str] | None = None) -> int:
    """Measure, print a table, and return 1 where a limit is passed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    good, rows = True, []
    for worlds, limit in FRAMES.items():
        found = time_frames(worlds)
        good &= found <= limit
        rows.append({"robots": worlds, "frame": found})
        print(f"{worlds:5} robots  {1e3 * found:6.2f} ms a frame (limit {1e3 * limit:.0f})", flush=True)
    for robot in ("go2", *SHIPPED):
        time_first(robot)  # warms the cache
        found, wall = time_first(robot)
        good &= found <= FIRST
        rows.append({"robot": robot, "CPU": found, "clock": wall})
        print(f"{robot:12} {found:6.2f} s of CPU, {wall:.2f} s on the clock (limit {FIRST:.0f})", flush=True)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
