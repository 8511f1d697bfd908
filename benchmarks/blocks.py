"""Run the code of README, CONTRIBUTING and the documentation's pages, and write what it printed beneath it.

    python -m benchmarks.blocks [PAGE ...]             # runs the pages' blocks; fails where a page shows other words
    python -m benchmarks.blocks --write [PAGE ...]     # puts what they printed and drew into the pages

Fences of a page say what they hold. ``python`` runs, one block after the other in one namespace, in an empty folder.
``text`` stands below a block and is what that block printed. ``console`` holds commands and ``none`` formulas, which do
not run. A picture that a block saves as ``name.svg`` is the page's ``_static/name.svg``. Comments above a fence:

* ``<!-- not run: REASON -->`` says why commands are not run by a test, or where they are.
* ``<!-- varies: REASON -->`` says why the page does not show what a block prints.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import re
import shutil
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import NamedTuple

import warp as wp

wp.config.log_level = wp.LOG_WARNING  # which kernels are compiled is not what a page shows
ROOT = Path(__file__).resolve().parent.parent
STATIC = ROOT / "docs" / "_static"
FENCE = re.compile(
    r"^(?P<mark><!-- (?:not run|varies): [^\n]* -->\n)?```(?P<kind>[^\n`]*)\n(?P<body>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)
KINDS = ("python", "text", "console", "none")
INDENTED = re.compile(r"(?<=\n\n)    \S.*")
NUMBER = re.compile(r"(?<![\w.])[+-]?\d+\.?\d*(?:e[+-]?\d+)?")
CLOSE, NOTHING = 0.02, 1e-9  # relative difference of numbers that count as equal; numbers that count as zero


class Block(NamedTuple):
    """A fence of a page: what it holds, the comment above it, its text, and the line of the page before its first."""

    kind: str
    mark: str
    body: str
    line: int
    start: int
    end: int


def pages() -> list[Path]:
    """Return all pages of the documentation, and those outside of docs/ that they include."""
    results = ROOT / "benchmarks" / "results"
    included = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"]
    included += [results / "README.md"]
    return included + sorted(page for page in (ROOT / "docs").glob("**/*.md") if "_build" not in page.parts)


def blocks(text: str) -> list[Block]:
    """Return the fences of a page but for MyST's own, such as ``{toctree}``."""
    return [
        Block(f["kind"], f["mark"] or "", f["body"], text[: f.start("body")].count("\n"), f.start(), f.end())
        for f in FENCE.finditer(text)
        if not f["kind"].startswith("{")
    ]


def unmarked(page: Path) -> list[str]:
    """Return a sentence for each piece of code on a page that neither runs nor says why it does not."""
    text = page.read_text()
    where = page.relative_to(ROOT).as_posix()
    found, before = [], None
    for block in blocks(text):
        line = f"{where}, line {block.line}"
        if block.kind not in KINDS:
            found.append(f"{line}: ```{block.kind}; expected one of {', '.join(KINDS)}")
        if block.kind == "console" and not block.mark.startswith("<!-- not run"):
            found.append(f"{line}: commands without <!-- not run: REASON --> above them")
        if block.kind == "text" and (before is None or before.kind not in ("python", "console")):
            found.append(f"{line}: ```text that is no output; formulas stand in ```none")
        before = block
    outside = FENCE.sub(lambda fence: "\n" * fence[0].count("\n"), text)
    if page.name != "README.md":  # .ci/run reads its test command there
        found += [f"{where}: indented code: {code[0].strip()}" for code in INDENTED.finditer(outside)]
    return found


def run(page: Path) -> list[tuple[Block, str]]:
    """Run the Python blocks of a page in the current folder; return each with what it printed."""
    os.environ.setdefault("MPLBACKEND", "Agg")
    os.environ.setdefault("SOURCE_DATE_EPOCH", "0")  # pictures carry no date
    name = page.relative_to(ROOT).as_posix()
    names: dict = {"__name__": name}
    found = []
    for block in blocks(page.read_text()):
        if block.kind == "python":
            with contextlib.redirect_stdout(io.StringIO()) as out:
                exec(compile("\n" * block.line + block.body, name, "exec"), names)  # errors name the page and its line
            found.append((block, out.getvalue()))
    return found


def shown_output(text: str, block: Block) -> str | None:
    """Return the ``text`` fence right below a block, or None."""
    below = FENCE.match(text, block.end + 2)
    return below["body"] if below and below["kind"] == "text" else None


def agree(shown: str, printed: str) -> bool:
    """Return whether two outputs have the same words, and numbers within 2 %."""
    if NUMBER.sub("0", shown).split() != NUMBER.sub("0", printed).split():
        return False
    pairs = zip(map(float, NUMBER.findall(shown)), map(float, NUMBER.findall(printed)), strict=True)
    return all(abs(a - b) <= CLOSE * max(abs(a), abs(b)) + NOTHING for a, b in pairs)


def differences(page: Path, outputs: list[tuple[Block, str]]) -> list[str]:
    """Return a sentence for each block of the site whose page shows other words than the block printed."""
    text, found = page.read_text(), []
    for block, printed in outputs:
        shown, where = shown_output(text, block), f"{page.relative_to(ROOT)}, line {block.line}"
        if shown is None:
            if printed.strip() and ROOT / "docs" in page.parents and not block.mark:
                found.append(
                    f"{where}: the page does not show what the block prints; run python -m benchmarks.blocks --write"
                )
        elif not agree(shown, printed):
            found.append(f"{where}: the page shows\n{shown}\nand the block prints\n{printed}")
    return found


def rewrite(page: Path, outputs: list[tuple[Block, str]]) -> None:
    """Write what the blocks printed beneath them, where words or numbers are others than the page shows."""
    text = page.read_text()
    for block, printed in reversed(outputs):
        if block.mark or not printed.strip():
            continue
        shown = shown_output(text, block)
        if shown is not None and agree(shown, printed):
            continue
        below = FENCE.match(text, block.end + 2) if shown is not None else None
        lines = "\n".join(line.rstrip() for line in printed.strip("\n").splitlines())
        text = f"{text[: block.end]}\n\n```text\n{lines}\n```{text[below.end() if below else block.end :]}"
    page.write_text(text)


def keep_pictures(page: Path, folder: Path) -> None:
    """Copy pictures that the blocks saved, and that the page shows, to ``docs/_static``."""
    text = page.read_text()
    for picture in [*folder.glob("*.svg"), *folder.glob("*.png")]:
        if f"_static/{picture.name}" in text:
            shutil.copy(picture, STATIC / picture.name)


def main() -> None:
    """Run the pages that are named, or all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pages", nargs="*", type=Path)
    parser.add_argument("--write", action="store_true", help="put what blocks print and draw into the pages")
    arguments = parser.parse_args()
    home, wrong = Path.cwd(), []
    for page in [page.resolve() for page in arguments.pages] or pages():
        if not any(block.kind == "python" for block in blocks(page.read_text())):
            continue
        began = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                os.chdir(folder)  # a reader does not stand in the repository
                outputs = run(page)
            finally:
                os.chdir(home)
            if arguments.write and ROOT / "docs" in page.parents:
                rewrite(page, outputs)
                keep_pictures(page, Path(folder))
        if not arguments.write:
            wrong += differences(page, outputs)
        print(f"{time.perf_counter() - began:6.1f} s  {page.relative_to(ROOT)}", flush=True)
    sys.exit("\n".join(wrong) if wrong else 0)


if __name__ == "__main__":
    main()
