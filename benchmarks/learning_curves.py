"""Rewards against seconds of trainings: ``python -m benchmarks.learning_curves PICTURE FOLDER...``.

Folders are those of ``python -m warp_spo.train TASK --seed N --out TASK_N``; those of a task share a panel.
"""

from __future__ import annotations

import sys
from pathlib import Path

from warp_spo.env.course import read_rows
from warp_spo.env.tasks import TASKS
from warp_spo.trials.drawing import OURS, load_pyplot, style

COLUMNS = 3


def draw(picture: Path, folders: list[Path]) -> None:
    """Draw the curves of ``progress.jsonl`` of each folder, a panel for each task."""
    pyplot = load_pyplot("learning_curves")
    found = {name: sorted(each for each in folders if each.name.rsplit("_", 1)[0] == name) for name in TASKS}
    found = {name: those for name, those in found.items() if those}
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


if __name__ == "__main__":
    draw(Path(sys.argv[1]), [Path(folder) for folder in sys.argv[2:]])
