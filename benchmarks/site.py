"""Build the documentation as strangers get it: run its blocks, build its pages, check its links. Without network.

    python -m benchmarks.site [--no-blocks] [FOLDER]          # FOLDER is docs/_build unless given

Blocks run by :mod:`benchmarks.blocks`; Sphinx's warnings are errors. Then every link, picture, script and style sheet
of every page must lead to a file of the folder, and to a place in it where the link names one, so that the site works
from ``file://``. Links to other hosts are counted and not followed.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

from .blocks import ROOT


class Page(HTMLParser):
    """Places of an HTML page that links can lead to, and the links that it has."""

    def __init__(self, path: Path):
        super().__init__()
        self.places: set[str] = set()
        self.links: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Keep an element's id or name, and what it refers to."""
        for name, value in attrs:
            if value and (name == "id" or (tag == "a" and name == "name")):
                self.places.add(value)
            if value and (name == "src" or (name == "href" and tag in ("a", "link"))):
                self.links.append(value)


def broken_links(folder: Path) -> tuple[list[str], int, int]:
    """Return a sentence for each link that leads nowhere, and how many links lead to the folder and to other hosts."""
    paths = sorted(path for path in folder.rglob("*.html") if "_static" not in path.parts)  # where templates lie
    pages = {path: Page(path) for path in paths}
    broken, inside, outside = [], 0, 0
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme in ("http", "https", "mailto"):
                outside += 1
                continue
            if parts.scheme == "data":
                continue
            inside += 1
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            where = f"{path.relative_to(folder)}: {link}"
            if parts.scheme or link.startswith("/") or folder not in target.parents:
                broken.append(f"{where} leads out of the site")
            elif not target.is_file():
                broken.append(f"{where} leads to no file")
            elif parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].places:
                broken.append(f"{where} leads to no place of that page")
    return broken, inside, outside


def main() -> None:
    """Run, build, check; the first that fails ends it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default=ROOT / "docs" / "_build")
    parser.add_argument("--no-blocks", action="store_true", help="the tests have run them")
    arguments = parser.parse_args()
    folder = arguments.folder.resolve()
    if not arguments.no_blocks:
        if failed := subprocess.run([sys.executable, "-m", "benchmarks.blocks"], cwd=ROOT).returncode:
            sys.exit(failed)
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "-E", "-b", "html", "docs", str(folder)]
    if failed := subprocess.run(command, cwd=ROOT).returncode:
        sys.exit(failed)
    broken, inside, outside = broken_links(folder)
    print(f"{inside} links within {folder}, {len(broken)} broken; {outside} to other hosts, not followed")
    sys.exit("\n".join(broken) if broken else 0)


if __name__ == "__main__":
    main()
