"""Work of several processes side by side, of which one at a time has the machine for itself while it measures.

A process prepares what it needs beside the others. For a measurement it takes its turn: then all other processes stand
still, so that no kernel of theirs runs on the GPU and no compiler on the host. Nobody waits for those that take long,
and what is not done in time is named.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any

LATEST = 30.0  # [s] after which a turn ends, whatever it does
THREADS = (
    "OPENBLAS_NUM_THREADS",
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
)  # of NumPy: those of many processes wait in turns


class Turn:
    """The turn of a process: ``with turn:`` waits until all other processes stand still, and lets them go on after it.

    Attributes:
        after: it begins when so many other turns were taken, or when no other process has one to take.
    """

    def __init__(self, pipe: Connection):
        self._pipe, self._depth, self.after = pipe, 0, 0

    def __enter__(self) -> Turn:
        if self._depth == 0:
            self._pipe.send(("wants", self.after))
            self._pipe.recv()
        self._depth += 1
        return self

    def __exit__(self, *_: object) -> None:
        self._depth -= 1
        if self._depth == 0:
            self._pipe.send(("had", None))


mine: contextlib.AbstractContextManager = contextlib.nullcontext()
"""The turn of this process; one that takes no turns always has its own."""


@dataclasses.dataclass(eq=False)
class _Worker:
    process: Any
    task: Any
    wants: int | None = None  # the turn that it waits for


Work = Callable[[Any, Turn], Iterator[Any]]
"""A function of a module, which yields results of a task and takes turns."""


def take_turns(tasks: Sequence[Any], work: Work, seconds: float, jobs: int | None = None) -> Iterator[tuple[Any, Any]]:
    """Yield (task, result) as results come, and (task, None) when a task is over.

    An exception that ``work`` raises is a result. A task that is not over in time ends without a word. A process that
    is done with a task takes another one.

    Args:
        tasks: those that take longest first.
        work: yields the results of a task.
        seconds: time for all of it.
        jobs: processes that work at the same time, those that wait for their turn not counted; default: as many as
            there are cores.
    """
    end, context, rest = time.monotonic() + seconds, multiprocessing.get_context("spawn"), collections.deque(tasks)
    workers: dict[Connection, _Worker] = {}
    taken, jobs = 0, jobs or os.cpu_count() or 1  # turns

    def start() -> None:
        mine, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(work, theirs), daemon=True)
        process.start()
        theirs.close()
        workers[mine] = _Worker(process, rest.popleft())
        mine.send(workers[mine].task)

    for name in THREADS:
        os.environ.setdefault(name, "1")  # of the processes that start now
    before = signal.signal(signal.SIGTERM, _leave)
    try:
        while (rest or workers) and time.monotonic() < end:
            while rest and sum(worker.wants is None for worker in workers.values()) < jobs:
                start()
            for pipe in wait(list(workers), timeout=0.0 if _next(workers, taken, rest) else 0.2):
                assert isinstance(pipe, Connection)
                yield from _heard(workers, pipe, rest)
            following = _next(workers, taken, rest)
            if following is None:
                continue
            with _stop_others(workers, following):
                yield from _turn(workers, following, rest, min(LATEST, end - time.monotonic()))
            taken += 1
    finally:
        signal.signal(signal.SIGTERM, before)
        for worker in workers.values():
            worker.process.kill()


def _leave(*_: object) -> None:
    raise SystemExit(1)


def _next(workers: dict[Connection, _Worker], taken: int, rest: Sequence[Any]) -> Connection | None:
    """Return whose turn it is."""
    wanting = [(worker.wants, pipe) for pipe, worker in workers.items() if worker.wants is not None]
    if not wanting:
        return None
    after, pipe = min(wanting, key=lambda one: one[0])
    return pipe if after <= taken or (len(wanting) == len(workers) and not rest) else None


def _heard(workers: dict[Connection, _Worker], pipe: Connection, rest: collections.deque) -> Iterator[tuple[Any, Any]]:
    """Read what a process says, and give it the next task if it is done with one."""
    worker = workers[pipe]
    task = worker.task
    try:
        word, value = pipe.recv()
    except (EOFError, OSError):  # the process has died
        del workers[pipe]
        worker.process.join()
        yield task, RuntimeError(f"the process ended with exit code {worker.process.exitcode}")
        yield task, None
        return
    if word == "wants":
        worker.wants = value
    elif word == "result":
        yield task, value
    elif word == "over":
        if rest:
            worker.task = rest.popleft()
            pipe.send(worker.task)
        else:
            del workers[pipe]
            pipe.close()
        yield task, None


@contextlib.contextmanager
def _stop_others(workers: dict[Connection, _Worker], pipe: Connection) -> Iterator[None]:
    """Let all processes but one stand still."""
    others = [worker.process.pid for at, worker in workers.items() if at is not pipe and worker.process.is_alive()]
    for process in others:
        os.kill(process, signal.SIGSTOP)
    try:
        yield
    finally:
        for process in others:
            os.kill(process, signal.SIGCONT)


def _turn(
    workers: dict[Connection, _Worker], pipe: Connection, rest: collections.deque[Any], seconds: float
) -> Iterator[tuple[Any, Any]]:
    """Let a process have its turn, and end it after so many seconds."""
    worker = workers[pipe]
    worker.wants = None
    pipe.send("go")
    if not pipe.poll(max(0.0, seconds)):
        worker.process.kill()
        yield worker.task, TimeoutError(f"a measurement was not done in {seconds:.0f} s")
    yield from _heard(workers, pipe, rest)


def _serve(work: Work, pipe: Connection) -> None:
    """Do tasks in a process of its own."""
    global mine
    with contextlib.suppress(EOFError):  # no more tasks
        while True:
            task = pipe.recv()
            mine = turn = Turn(pipe)
            try:
                for result in work(task, turn):
                    pipe.send(("result", result))
            except Exception as error:
                pipe.send(("result", RuntimeError(f"{type(error).__name__}: {str(error)[:300]}")))
            pipe.send(("over", None))
