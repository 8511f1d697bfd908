"""The arguments that benchmarks share."""

from __future__ import annotations

import argparse
from pathlib import Path


def parser(name: str, doc: str | None, device: bool = True, json: str = "a file for rows") -> argparse.ArgumentParser:
    """Return the parser of ``python -m benchmarks.NAME`` with --json, and --device if ``device``.

    Args:
        doc: docstring of the module, the description.
        json: help of --json; "" leaves it out.
    """
    found = argparse.ArgumentParser(
        prog=f"python -m benchmarks.{name}", description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    if device:
        found.add_argument("--device", help="Warp device, default: the current one")
    if json:
        found.add_argument("--json", type=Path, help=json)
    return found
