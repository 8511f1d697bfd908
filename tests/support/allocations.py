"""A check that Warp allocates no memory while a block runs."""

import contextlib

import warp as wp


@contextlib.contextmanager
def no_warp_allocation():
    """Fail if Warp allocates memory on any device within the block."""
    reports = []
    with wp.ScopedMemoryTracker("test", report_func=reports.append) as tracker:
        tracker.clear()  # totals are Warp's own, not this tracker's
        yield
    totals = reports[-1].split("Total allocations:")[1].split("Peak usage:")[0]
    assert not totals.strip(), f"Warp allocated:{totals}"
