"""Processes of benchmarks that prepare side by side and measure one at a time."""

import os
import time

from benchmarks.table.process_turns import take_turns

TASKS = "first", "second", "fails", "dies", "slow"


def work(task, turn):
    """Name the task; take turns, in which no other process moves; count in between what a process does in a turn."""
    if task == "fails":
        raise ValueError("an error")
    if task == "dies":
        os._exit(3)
    if task == "slow":
        begin = time.monotonic()
        while time.monotonic() - begin < 600.0:
            yield "moved", time.monotonic()
            time.sleep(0.005)
    for turn.after in (0, 2) if task == "first" else (0,):
        with turn:
            begin = time.monotonic()
            time.sleep(0.2)
            end = time.monotonic()
        yield "turn", (begin, end)


def test_others_stand_still_while_a_process_measures():
    """Also those that are busy; an error, a process that dies and one that is too slow hold nobody up.

    The time is ample: processes take seconds to start beside other tests.
    """
    begin, found = time.monotonic(), []
    for task, result in take_turns(TASKS, work, seconds=60.0, jobs=5):
        found.append((task, str(result) if isinstance(result, Exception) else result))
        if {("first", None), ("second", None)} <= set(found) and sum(one[0] == "slow" for one in found) > 9:
            break
    assert time.monotonic() - begin < 60.0
    turns = sorted((*result[1], task) for task, result in found if isinstance(result, tuple) and result[0] == "turn")
    assert sorted(task for *_, task in turns) == ["first", "first", "second"] and turns[-1][2] == "first"
    moved = [result[1] for task, result in found if task == "slow" and result]
    assert len(moved) >= 9
    for start, end, _ in turns:
        assert not any(start + 0.05 < moment < end for moment in moved)
    errors = {task: result for task, result in found if isinstance(result, str)}
    assert "an error" in errors["fails"] and "exit code 3" in errors["dies"]
    assert ("slow", None) not in found


def test_what_is_not_done_in_time_ends():
    begin = time.monotonic()
    found = list(take_turns(["slow"], work, seconds=0.5, jobs=1))
    assert time.monotonic() - begin < 60.0 and ("slow", None) not in found
