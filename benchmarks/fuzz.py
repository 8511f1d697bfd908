"""Feed torn and mutated robot files to spo.load, and report each that is neither read nor refused as documented.

    python -m benchmarks.fuzz urdf --minutes 10
    python -m benchmarks.fuzz mjcf --minutes 10 --first 100000
    python -m benchmarks.fuzz usd --minutes 10                  # texts, .usda
    python -m benchmarks.fuzz mjcf --seed 812 --keep FOLDER     # one file again; it is written into the folder
    python -m benchmarks.fuzz urdf --json benchmarks/results/files/FUZZ.json        # and a row in a file of results

A seed chooses an installed file of the format, damages it in one to three places and chooses the options of the call. A
file is read if no value of the scene is NaN, and refused if the error is a ValueError or FileNotFoundError that begins
with the call, names the file and prints. Everything else is a finding, printed with its seed: another exception, a
message that does not print, a value that is NaN, no answer within ``--seconds``, a process that ends. Files are
read in a process of their own with ``MEMORY`` bytes at most. The command fails if there are findings. ``--seconds`` are
those of a clock: on a busy machine give more.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import importlib
import json
import multiprocessing
import os
import re
import resource
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import warp_spo as spo

from .robot_files import mjcf_files, urdf_files, usd_files

MEMORY = 8 << 30  # [bytes] of the process that reads
LARGEST = 40_000  # [bytes] of a file that is damaged; larger ones take long to read
LONGEST_MESSAGE = 4000  # characters
NUMBER = re.compile(rb"(?<![\w.])-?\d+\.?\d*(?:[eE][-+]?\d+)?")
QUOTED = re.compile(rb'"[^"]*"')
ELEMENT = re.compile(
    rb"<(\w+)[^<>]*/>|<(\w+)[^<>]*>(?:(?!<\2\b).)*?</\2>"  # of XML
    rb"|\b(?:def|over|class) [^{}]*\{[^{}]*\}",  # a prim of USD without children
    re.S,
)
ATTRIBUTE = re.compile(
    rb'\s[\w:]+\s*=\s*"[^"]*"|\n[ \t]*(?:(?:uniform|custom|prepend) )*[\w\[\]]+ [\w:.]+ = [^\n]*'  # of XML, of USD
)
WORD = re.compile(rb"[A-Za-z_]\w+")
NUMBERS = b"0 -0 -1 2 nan inf -inf 1e-320 1e30 1e200 1e308 1e999 99999999999 1_000 0x10 1.2.3 - 1,5".split()
STRINGS = (
    *(b"", b"..", b"/etc/hostname", b"../../../a.stl", b"http://203.0.113.1/a.stl", b"x" * 70_000, b"{}%s%n", b"*"),
    *(b"a\nb", b"a&#10;b", b"&#x202e;", b"\xe2\x80\xa8", b"\xff\xfe", b"'", b"\\", b"1 2 3 4 5 6 7 8 9", b"true"),
)


class Format(NamedTuple):
    """A format of robot files.

    Attributes:
        suffix: of its files. texts: returns the files that are damaged. load: reads one, with the options of
            :func:`warp_spo.load`; a function of a module, which the process that reads imports.
    """

    suffix: str
    texts: Callable[[], list[bytes]]
    load: str = "warp_spo.load"


class Finding(NamedTuple):
    """A file that was neither read nor refused: what happened, and where in the library."""

    seed: int
    what: str
    place: str = ""


def small(files: Iterable[Path], without: bytes = b"\0") -> list[bytes]:
    """Return the texts of files that are not too large, less those with ``without`` in them."""
    texts = [file.read_bytes() for file in files if file.stat().st_size <= LARGEST]
    return [text for text in texts if without not in text]


OWN = Path(spo.__file__).parent / "env" / "robots"  # MJCF files of the tasks
FORMATS = {
    "urdf": Format(".urdf", lambda: small(urdf_files())),
    "mjcf": Format(".xml", lambda: small((*(file for _, file in mjcf_files()), *OWN.glob("*.xml")), b"<include")),
    "usd": Format(".usda", lambda: small(file for file in usd_files() if file.suffix == ".usda")),
}


# -- damage ------------------------------------------------------------------------------------------------------------
def damaged(texts: list[bytes], seed: int) -> tuple[bytes, dict[str, Any]]:
    """Return a damaged copy of one of the texts, and options of the call, by the seed."""
    rng = np.random.default_rng(seed)
    text, other = (texts[rng.integers(len(texts))] for _ in range(2))
    for _ in range(rng.integers(1, 4)):
        text = DAMAGES[rng.integers(len(DAMAGES))](text, other, rng)
    options = {"floating": (None, True, False), "contacts": (None, None, None, True, "*"), "repair": (True, False)}
    return text, {name: values[rng.integers(len(values))] for name, values in options.items()}


def _find_place(pattern: re.Pattern[bytes], text: bytes, rng: np.random.Generator) -> tuple[int, int]:
    """Return where one of the matches of a pattern is, or a random place without any."""
    start = int(rng.integers(len(text) + 1))
    match = pattern.search(text, start) or pattern.search(text)
    return match.span() if match else (start, start)


def _put(
    pattern: re.Pattern[bytes], choices: tuple[bytes, ...] | list[bytes], quotes: bytes = b""
) -> Callable[..., bytes]:
    def put(text: bytes, other: bytes, rng: np.random.Generator) -> bytes:
        start, stop = _find_place(pattern, text, rng)
        return text[:start] + quotes + choices[rng.integers(len(choices))] + quotes + text[stop:]

    return put


def _from(pattern: re.Pattern[bytes], whose: str) -> Callable[..., bytes]:
    """Put a match of a pattern in place of another, elements also beside it: names meet, and elements move."""

    def put(text: bytes, other: bytes, rng: np.random.Generator) -> bytes:
        source = text if whose == "own" else other
        first, last = _find_place(pattern, source, rng)
        start, stop = _find_place(pattern, text, rng)
        return text[:start] + source[first:last] + text[start if pattern is ELEMENT and rng.random() < 0.5 else stop :]

    return put


def _cut(pattern: re.Pattern[bytes]) -> Callable[..., bytes]:
    def cut(text: bytes, other: bytes, rng: np.random.Generator) -> bytes:
        start, stop = _find_place(pattern, text, rng)
        return text[:start] + text[stop:]

    return cut


def _tear(text: bytes, other: bytes, rng: np.random.Generator) -> bytes:
    return text[: rng.integers(len(text) + 1)] if rng.random() < 0.3 else text


def _cut_bytes(text: bytes, other: bytes, rng: np.random.Generator) -> bytes:
    start = int(rng.integers(len(text) + 1))
    return text[:start] + text[start + int(rng.integers(1, 60)) :]


def _flip(text: bytes, other: bytes, rng: np.random.Generator) -> bytes:
    if not text:
        return text
    at = int(rng.integers(len(text)))
    return text[:at] + bytes([text[at] ^ (1 << int(rng.integers(8)))]) + text[at + 1 :]


def _repeat(text: bytes, other: bytes, rng: np.random.Generator) -> bytes:
    start, stop = _find_place(ELEMENT, text, rng)
    return text[:start] + text[start:stop] * int(rng.integers(2, 20)) + text[stop:]


def _encode(text: bytes, other: bytes, rng: np.random.Generator) -> bytes:
    return text.decode("utf-8", "replace").encode("utf-16") if rng.random() < 0.1 else text


DAMAGES: tuple[Callable[[bytes, bytes, np.random.Generator], bytes], ...] = (
    *(_put(NUMBER, NUMBERS), _put(NUMBER, NUMBERS), _put(QUOTED, STRINGS, b'"'), _put(QUOTED, NUMBERS, b'"')),
    *(_from(NUMBER, "own"), _from(NUMBER, "other"), _from(QUOTED, "own"), _from(WORD, "own")),
    *(_from(ELEMENT, "own"), _from(ELEMENT, "own"), _from(ELEMENT, "other"), _cut(ELEMENT), _cut(NUMBER)),
    *(_cut(ATTRIBUTE), _cut(WORD), _tear, _cut_bytes, _flip, _repeat, _encode),
)


# -- one file ----------------------------------------------------------------------------------------------------------
def judge(load: Callable[..., Any], file: Path, options: dict[str, Any]) -> tuple[str, str]:
    """Return ("read" or "refused", ""), or (what is wrong, where)."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            scene = load(file, **options)
        except (ValueError, FileNotFoundError) as error:
            message = str(error)
            if not message.startswith("load") or str(file) not in message:
                return f"a message that does not name the call and the file: {_short(error)}", _place(error)
            return _printing([message]) or "refused", ""
        except BaseException as error:  # of a library in C++, too
            return _short(error), _place(error)
    words = _printing([str(warning.message) for warning in caught if warning.category is UserWarning])
    if words:
        return words, ""
    wrong = [name for name, value in getattr(scene, "values", {}).items() if np.isnan(value).any()]
    return (f"NaN in {', '.join(wrong)}", "") if wrong else ("read", "")


def _printing(messages: list[str]) -> str:
    for message in messages:
        if len(message) > LONGEST_MESSAGE:
            return f"a message of {len(message)} characters: {message[:200]!r}"
        if not all(letter.isprintable() for letter in message):
            return f"a message that does not print: {message!r}"
    return ""


def _short(error: BaseException) -> str:
    return f"{type(error).__name__}: {str(error)!r}"[:400]


def _place(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if "warp_spo" in frame.filename] or frames
    return f"{Path(own[-1].filename).name}:{own[-1].lineno}" if own else ""


def named(path: str) -> Callable[..., Any]:
    module, _, name = path.rpartition(".")
    return getattr(importlib.import_module(module), name)


# -- many files, in a process of their own -----------------------------------------------------------------------------
def _read_files(suffix: str, load_path: str, texts: list[bytes], connection: Any) -> None:
    """Judge the files whose seeds come through a connection, until None comes."""
    load = named(load_path)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    silence = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silence, 1), os.dup2(silence, 2)  # MuJoCo and OpenUSD print
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)  # where MuJoCo writes its log
        connection.send(None)
        while (seed := connection.recv()) is not None:
            text, options = damaged(texts, seed)
            file = Path(folder) / f"robot{suffix}"
            file.write_bytes(text)
            connection.send(judge(load, file, options))


class Reader:
    """A process that reads damaged files; it is started anew after it hangs or ends."""

    _process: Any = None

    def __init__(self, kind: Format):
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(["warp_spo.newton.files.load", "warp_spo.mujoco.mjcf"])
        self._given = kind.suffix, kind.load, kind.texts()

    def judge(self, seed: int, seconds: float) -> tuple[str, str]:
        """Return what :func:`judge` says of the file of a seed, or that there was no answer."""
        if self._process is None:
            self._connection, other = self._context.Pipe()
            process = self._context.Process(target=_read_files, args=(*self._given, other), daemon=True)
            process.start()
            self._process = process
            other.close()
            self._connection.recv()
        self._connection.send(seed)
        try:
            if self._connection.poll(seconds):
                return self._connection.recv()
            what = f"no answer within {seconds:g} s"
        except (EOFError, ConnectionError):
            self._process.join(10.0)
            what = f"the process ended with code {self._process.exitcode}"
        self.close()
        return what, ""

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._process = None


def search(kind: Format, seeds: Iterable[int], seconds: float, counts: collections.Counter[str]) -> Iterator[Finding]:
    """Yield the findings among the files of some seeds; ``counts`` says how many were read and refused."""
    with contextlib.closing(Reader(kind)) as reader:
        for seed in seeds:
            what, place = reader.judge(seed, seconds)
            counts["files"] += 1
            if what in ("read", "refused"):
                counts[what] += 1
            else:
                yield Finding(seed, what, place)


def until(end: float, first: int) -> Iterator[int]:
    """Yield seeds from ``first`` on, until the time of the clock ``time.monotonic``."""
    seed = first
    while time.monotonic() < end:
        yield seed
        seed += 1


def main(arguments: list[str] | None = None) -> None:
    """Run the command; exit with 1 if there are findings."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("format", choices=FORMATS)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--seconds", type=float, default=20.0, help="time for one file")
    parser.add_argument("--seed", type=int, help="read the file of this seed alone")
    parser.add_argument("--keep", type=Path, help="write the files of findings, or that of --seed, into this folder")
    parser.add_argument("--json", type=Path, help="file of results, which keeps the rows of other formats")
    given = parser.parse_args(arguments)
    kind, counts = FORMATS[given.format], collections.Counter[str]()
    seeds = until(time.monotonic() + 60.0 * given.minutes, given.first) if given.seed is None else [given.seed]
    known, findings = collections.Counter[str](), []
    for finding in search(kind, seeds, given.seconds, counts):
        findings.append(finding)
        known[finding.place or finding.what[:60]] += 1
        if known[finding.place or finding.what[:60]] <= 3:  # of one kind
            print(f"seed {finding.seed}: {finding.what} {finding.place}".rstrip(), flush=True)
            _keep(kind, finding.seed, given.keep)
    if given.seed is not None:
        _keep(kind, given.seed, given.keep)
    found = counts["files"] - counts["read"] - counts["refused"]
    print(f"{counts['files']} files: {counts['read']} read, {counts['refused']} refused, {found} findings of "
          f"{len(known)} kinds")  # fmt: skip
    if given.json:
        record(given.json, given.format, given.first if given.seed is None else given.seed, counts, findings)
    sys.exit(1 if found else 0)


def record(path: Path, name: str, first: int, counts: dict[str, int], findings: list[Finding]) -> None:
    """Write the row of a format into a file of results: its first seed, counts of files, and findings."""
    rows = json.loads(path.read_text())["formats"] if path.exists() else {}
    rows[name] = {
        "first": first,
        **{key: counts.get(key, 0) for key in ("files", "read", "refused")},
        "findings": [finding._asdict() for finding in findings],
    }
    versions = {package: metadata.version(package) for package in ("mujoco", "newton", "usd-core")}
    path.write_text(json.dumps({"versions": versions, "formats": rows}, indent=1) + "\n")


def _keep(kind: Format, seed: int, folder: Path | None) -> None:
    if folder is not None:
        text, options = damaged(kind.texts(), seed)
        (folder / f"{seed}{kind.suffix}").write_bytes(text)
        print(f"    {folder / f'{seed}{kind.suffix}'}, read with {options}")


if __name__ == "__main__":
    main()
