"""List the examples: ``python -m warp_spo.examples``."""

import ast
from pathlib import Path

SHARED = ("__init__", "__main__", "options", "parts")  # files that are no examples


def examples():
    """Return the first line of each example's docstring, by the example's name."""
    files = sorted(file for file in Path(__file__).parent.glob("*.py") if file.stem not in SHARED)
    docstrings = {file.stem: ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) for file in files}
    return {name: text.splitlines()[0] for name, text in docstrings.items() if text}


def main():
    found = examples()
    width = max(map(len, found))
    print("Run one with python -m warp_spo.examples.NAME; --help lists its options, --picture FILE draws its result.\n")
    for name, line in found.items():
        print(f"{name:{width}}  {line}")


if __name__ == "__main__":
    main()
