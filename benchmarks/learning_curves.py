"""Rewards against seconds of trainings.

    python -m benchmarks.learning_curves PICTURE.svg FOLDER [FOLDER ...]

Folders are those of ``python -m warp_spo.train TASK --seed N --out TASK_N``; those of a task share a panel.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from warp_spo.env.tasks import TASKS
from warp_spo.env.training_log import read_rows
from warp_spo.viewing.charts import OURS, load_pyplot, style

COLUMNS = 3


def draw(picture: Path, folders: list[Path]) -> None:
    """Draw the curves of ``progress.jsonl`` of each folder, a panel for each task."""
    pyplot = load_pyplot("learning_curves")
    found = {name: sorted(each for each in folders if each.name.rsplit("_", 1)[0] == name) for name in TASKS}
    found = {name: those for name, those in found.items() if those}
    if not found:
        names = ", ".join(folder.name for folder in folders)
        raise ValueError(f"learning_curves: none of {names} is named as a task, _ and a seed, such as go2-flat_1")
    rows = -(-len(found) // COLUMNS)
    with style():
        figure, panels = pyplot.subplots(rows, COLUMNS, figsize=(9, 2.2 * rows), layout="constrained", squeeze=False)
        for panel, (name, those) in zip(panels.flat, found.items(), strict=False):
            for folder in those:
                course = read_rows(folder / "progress.jsonl")
                seconds, reward = ([row[key] for row in course] for key in ("seconds", "reward"))
                panel.plot(seconds, reward, lw=1.1, color=OURS, alpha=0.7)
            panel.set(title=name, xlim=(0, None), xlabel="s since the start of the process")
            panel.grid(True)
        for panel in panels[:, 0]:
            panel.set(ylabel="reward of an episode")
        for panel in panels.flat[len(found) :]:
            panel.remove()
        figure.savefig(picture)
        pyplot.close(figure)


def main(argv: list[str] | None = None) -> int:
    p = argparse.ArgumentParser(prog="python -m benchmarks.learning_curves", description=__doc__,
                                formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    p.add_argument("picture", type=Path, metavar="PICTURE")
    p.add_argument("folders", type=Path, nargs="+", metavar="FOLDER")
    options = p.parse_args(argv)
    try:
        draw(options.picture, options.folders)
    except (OSError, ValueError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
