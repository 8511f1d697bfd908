"""Results of benchmarks as the runner writes them, made by hand."""

from benchmarks.table import evidence

NODE = ("node",)  # compiles nothing for a scene; other granularities have tests of their own
REFINED = ("float32", "refined", "float64")
ROOF = 1.2  # share that no measurement passes: the roof itself is measured to some per cent


def _row(scene, op, dtype, us, error, worlds=4096, **more):
    row = dict(name=f"{scene}.{op}", scene=scene, op=op, worlds=worlds, dtype=dtype, granularity="node", chosen=True)
    return row | dict(dof=14, depth=3, us=us, evals_per_s=1e6 * worlds / us, error=error) | more


def _data(**more):
    rows = []
    for worlds in (64, 4096):
        for dtype, error in (("float32", 2e-7), ("float64", 3e-15)):
            rows.append(_row("ant", "phi", dtype, 0.25 * worlds, error * worlds, worlds, roof=0.0123))
    versions = {"python": "3.11.7", "warp-lang": "1.19.0"}
    machine = dict(device="GPU X", device_memory_GiB=1.0)
    return dict(commit="0123456789abcdef", date="2026-01-02T03:04:05+00:00", machine=machine, versions=versions,
                rows=rows) | more  # fmt: skip


def _gathered(*runs):
    return evidence.gather(runs)


RUN = dict(rows=[], machine=dict(device="x"), date="2026", commit="c", versions={})
