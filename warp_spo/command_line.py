"""Command lines: a parser whose errors are one line, and the kinds of its numbers."""

from __future__ import annotations

import argparse
import math
from typing import NoReturn


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line on stderr; the exit code is then 2."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}; see --help\n")


def count(text: str) -> int:
    """Return an integer, 1 or more."""
    try:
        number = int(text)
    except ValueError:
        number = 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text!r} given; expected an integer, 1 or more")
    return number


def seconds(text: str) -> float:
    """Return a time above zero [s]."""
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not 0.0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} given; expected seconds, more than zero")
    return number
