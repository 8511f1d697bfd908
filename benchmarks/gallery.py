"""Run every example and write docs/gallery.md: its sentences, its picture, and the command that makes them.

    python -m benchmarks.gallery [NAME ...]

With names, only these examples run; the page keeps what it says of the others.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

from warp_spo.examples.__main__ import examples

DOCS = Path(__file__).resolve().parent.parent / "docs"
PAGE, PICTURES = DOCS / "gallery.md", DOCS / "_static" / "gallery"
HEAD = """# Gallery

Every example runs as it stands, on a CPU in a minute at most, and draws its picture with `--picture FILE`.
`python -m warp_spo.examples` lists them. This page was written by `python -m benchmarks.gallery`, with the sentences
that each example printed.
"""
SHOWN = (
    ("A Go2 falls and stands up", "ground.png", "python -m warp_spo go2 --ground --report report"),
    (
        "A trained G1 walks",
        "films/g1_flat.webp",
        "python -m warp_spo.play g1-flat runs/g1-flat/model_1699.pt --command 0.8 0 0 --film webp",
    ),
    (
        "A trained Go2 follows commands",
        "films/go2_flat.webp",
        "python -m warp_spo.play go2-flat runs/go2-flat/model_399.pt --film webp",
    ),
    (
        "A trained Go2 climbs stairs",
        "films/go2_rough.webp",
        'python -m warp_spo.play go2-rough runs/go2-rough/model_1299.pt --trial "stairs of 10 cm" --film webp',
    ),
    (
        "A trained Panda reaches",
        "films/panda_reach.webp",
        "python -m warp_spo.play panda-reach runs/panda-reach/model_119.pt --film webp",
    ),
    ("One tile of each kind of terrain", "terrain.png", "python -m benchmarks.contact.terrain terrain.png"),
)
"""Title, file in ``docs/_static`` and command of pictures that other commands draw."""
MOTIONS = {"ground.png": ("pages/go2_fall.html", "python -m warp_spo.view go2 --html go2_fall.html --seconds 3")}
"""Picture -> the page in ``docs/_static`` with a time slider that a click on it opens, and its command."""
OTHERS = """## Robots, policies, terrain

Policies are trained by `python -m warp_spo.train TASK`: [training](training.md).
"""
ENTRY = re.compile(r"^## (\w+)\n.*?(?=^##? |\Z)", re.MULTILINE | re.DOTALL)


def run(name: str, line: str) -> str:
    """Run an example; return its section of the page."""
    picture = PICTURES / f"{name}.svg"
    command = [sys.executable, "-m", f"warp_spo.examples.{name}", "--picture", str(picture)]
    undated = {**os.environ, "SOURCE_DATE_EPOCH": "0"}  # equal pictures are equal files
    printed = subprocess.run(command, capture_output=True, text=True, check=True, env=undated).stdout
    return (
        f"## {name}\n\n{line}\n\n<!-- not run: benchmarks.gallery ran it -->\n"
        f"```console\npython -m warp_spo.examples.{name}\n```\n\n"
        f"![picture of the example {name}](_static/gallery/{picture.name})\n\n```text\n{printed.strip()}\n```\n"
    )


def main(names: list[str]) -> None:
    """Run the named examples, or all, and write the page."""
    PICTURES.mkdir(exist_ok=True)
    known = examples()
    if unknown := sorted(set(names) - set(known)):
        sys.exit(f"python -m benchmarks.gallery: no example {', '.join(unknown)}; expected some of {', '.join(known)}")
    sections = {found[1]: found[0] for found in ENTRY.finditer(PAGE.read_text())} if PAGE.exists() else {}
    for name, line in known.items():
        if not names or name in names or name not in sections:
            print(name, flush=True)
            sections[name] = run(name, line)
    parts = [HEAD, OTHERS]
    for title, picture, command in SHOWN:
        mark = "<!-- not run: the page that it belongs to says when it was -->"
        shown = f"![{title}](_static/{picture})"
        if picture in MOTIONS:
            page, writes = MOTIONS[picture]
            command, shown = (
                f"{command}\n{writes}",
                f"[{shown}](_static/{page})\n\nA click opens a motion with a time slider.",
            )
        parts.append(f"### {title}\n\n{mark}\n```console\n{command}\n```\n\n{shown}\n")
    PAGE.write_text("\n".join([*parts, *(sections[name].strip() + "\n" for name in known)]))


if __name__ == "__main__":
    main(sys.argv[1:])
