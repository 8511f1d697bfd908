"""A package with two tasks, installed by pip into a fresh environment: every command by the names that it registers.

    python -m benchmarks.installed_tasks [--json FILE]

The environment is a virtual one of its own, made in an empty folder. It takes libraries, pip, and this project from
where this process finds them, by a ``.pth`` file; the package itself is built and installed into it by pip. ``tasks``
lists the names; both are trained for two iterations and resumed for one; one draws a film, measures and exports, the
other walks in MuJoCo. The table says what each command returned, and its time. It takes some minutes on two cores.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
import tempfile
import time
from pathlib import Path

import warp_spo

from . import command_line

NAMES = {"my-pole": "cartpole", "my-dog": "go2-flat"}
PROJECT = """\
[build-system]
requires = ["setuptools"]
build-backend = "setuptools.build_meta"

[project]
name = "my-tasks"
version = "0.1"

[tool.setuptools]
packages = ["my_tasks"]

[project.entry-points."warp_spo.tasks"]
my-pole = "my_tasks.my_pole"
my-dog = "my_tasks.my_dog"
"""


def prepare(folder: Path) -> Path:
    """Write the package, install it into a new environment, and return that environment's Python."""
    package = folder / "package"
    (package / "my_tasks").mkdir(parents=True)
    (package / "my_tasks" / "__init__.py").write_text("")
    (package / "pyproject.toml").write_text(PROJECT)
    for name, like in NAMES.items():
        file = package / "my_tasks" / f"{name.replace('-', '_')}.py"
        subprocess.run([sys.executable, "-m", "warp_spo.tasks", "--new", str(file), "--like", like], check=True)
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder / "fresh")], check=True)
    python = folder / "fresh" / "bin" / "python"
    say = "import sysconfig; print(sysconfig.get_paths()['purelib'])"
    site = subprocess.run([str(python), "-c", say], capture_output=True, text=True, check=True).stdout.strip()
    own = Path(warp_spo.__file__).parents[1]
    (Path(site) / "shared.pth").write_text(f"{own}\n{sysconfig.get_paths()['purelib']}\n")
    install = ["-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", str(package)]
    subprocess.run([str(python), *install], check=True)
    return python


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("installed_tasks", __doc__, device=False)
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        python = prepare(folder)
        small = ["--device", "cpu", "--worlds", "16", "--set", "learner.steps=8"]
        commands = {"tasks": ["warp_spo.tasks"]}
        for task in NAMES:
            commands[f"train {task}"] = ["warp_spo.train", task, *small, "--iterations", "2"]
            commands[f"resume {task}"] = ["warp_spo.train", task, *small, "--iterations", "3", "--resume", "latest"]
        last = {task: f"runs/{task}/model_2.pt" for task in NAMES}
        play = ["warp_spo.play", "my-pole", last["my-pole"]]
        commands |= {
            "film": [*play, "--seconds", "0.4"],
            "measure and export": [*play, "--measure", "--worlds", "8", "--export", "exported"],
            "MuJoCo check": ["warp_spo.play", "my-dog", last["my-dog"], "--mujoco"],
        }
        rows = {}
        for what, command in commands.items():
            began = time.perf_counter()
            done = subprocess.run(
                [str(python), "-m", *command], cwd=folder, capture_output=True, text=True, env=dict(os.environ)
            )
            lines = [line for line in done.stdout.strip().splitlines() if not line.startswith(("Module ", "Warp "))]
            rows[what] = {"status": done.returncode, "seconds": round(time.perf_counter() - began, 1)}
            print(f"{what:20} status {done.returncode}  {rows[what]['seconds']:6.1f} s  {lines[-1] if lines else ''}")
            if done.returncode:
                print(done.stderr[-2000:])
            if what == "tasks":
                missing = [task for task in NAMES if task not in done.stdout]
                rows[what]["status"] = rows[what]["status"] or len(missing)
        files = ["runs/my-pole/model_2.gif", "runs/my-pole/model_2.png", "exported.onnx", "exported.pt"]
        absent = [file for file in files if not (folder / file).exists()]
    print(f"files that are missing: {', '.join(absent) or 'none'}")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1))
    return int(bool(absent) or any(row["status"] for row in rows.values()))


if __name__ == "__main__":
    sys.exit(main())
