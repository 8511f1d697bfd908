"""Several processes of a training on one machine: started together and ended together."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Sequence
from typing import Any

LAUNCHER = "WARP_SPO_LAUNCHER"  # environment variable: the process that started this one
GRACE = 5.0  # that processes have to end once one of them has failed [s]
POLL = 0.05  # [s]


def launch(command: Sequence[str], count: int) -> int:
    """Run a command in ``count`` processes, with the environment variables that torchrun sets; return the exit status.

    Ctrl-C and SIGTERM are passed on to all. When one fails, the others get SIGTERM, and SIGKILL after ``GRACE``: what
    they do together can no longer be done. The status is that of the first that failed; 128 and the number of the
    signal that killed it.
    """
    from torch.distributed import TCPStore

    store = TCPStore("localhost", 0, is_master=True, wait_for_workers=False)  # where the processes find each other
    common = {**os.environ, "WORLD_SIZE": str(count), "LOCAL_WORLD_SIZE": str(count), "MASTER_ADDR": "localhost",
              "MASTER_PORT": str(store.port), "TORCHELASTIC_USE_AGENT_STORE": "True",
              LAUNCHER: str(os.getpid())}  # fmt: skip
    common.setdefault("OMP_NUM_THREADS", "1")
    processes: list[subprocess.Popen] = []

    def pass_on(number: int, _: Any) -> None:
        for each in processes:
            with contextlib.suppress(OSError):  # it has ended
                each.send_signal(number)

    before = {number: signal.signal(number, pass_on) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        for rank in range(count):  # in sessions of their own: a terminal's Ctrl-C comes through here, once
            own = common | {"RANK": str(rank), "LOCAL_RANK": str(rank)}
            processes.append(subprocess.Popen(command, env=own, start_new_session=True))
        return _wait(processes)
    finally:
        for each in processes:
            if each.poll() is None:
                each.kill()
                each.wait()
        for number, handler in before.items():
            signal.signal(number, handler)


def is_orphan() -> bool:
    """Return whether the process that launched this one has ended."""
    launcher = os.environ.get(LAUNCHER)
    return launcher is not None and int(launcher) != os.getppid()


def _wait(processes: Sequence[subprocess.Popen]) -> int:
    """Wait for all, end the others where one has failed, and return the status of the first that failed."""
    status, ends = 0, float("inf")
    while True:
        codes = [each.poll() for each in processes]
        failed = [code for code in codes if code]
        if failed and not status:
            status = failed[0]
            if status not in (128 + signal.SIGINT, 128 + signal.SIGTERM):  # which others will end with, too
                ends = time.monotonic() + GRACE
                for each in processes:
                    each.terminate()
        if None not in codes:
            return 128 - status if status < 0 else status
        if time.monotonic() > ends:
            for each in processes:
                each.kill()
        time.sleep(POLL)
