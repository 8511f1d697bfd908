"""Rows of each machine, gathered from the JSON files of runs: ours, the peers' and the stress suite's."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks" / "results"
IDENTITY = ("scene", "op", "worlds", "dtype", "granularity", "peer", "variant", "sweep", "group", "name")
"""Keys that tell one measurement from another; each row has some of them."""
RUN = {"rows": list, "machine": dict, "date": str, "commit": str, "versions": dict}
MEASURED = {"name", "scene", "op", "worlds", "dtype"}
ROWS = {
    "ours": MEASURED,
    "peers": MEASURED,
    "stress": {"case", "parameters", "verdict"},
    "capabilities": {"group", "name", "worlds"},
}
"""Kind of rows -> keys that every row of the kind has."""


class Evidence(NamedTuple):
    """Rows of one machine, each kind of row (each peer, each group) from the newest commit that has measured it.

    All files of that commit are used; where two have the same row, the newer file counts.

    Attributes:
        machine: names, memory and peaks of the machine, from the newest file that has each.
        rows: our rows.
        peers: rows of other libraries; "peer" is the library's name.
        stress: rows of the stress suite, with "case" and "verdict".
        sources: a line for each file that rows come from: machine, kinds of rows, commit, date, versions.
        capabilities: rows with "group", of :mod:`.capabilities` and of the benchmarks of one topic.
        dates: kind of rows, "ours" or the name of a peer or a group -> date and time of the newest file that has some.
    """

    machine: dict
    rows: list[dict]
    peers: list[dict]
    stress: list[dict]
    sources: list[str]
    capabilities: Sequence[dict]
    dates: dict[str, str]

    @property
    def is_gpu(self) -> bool:
        """Whether the machine is a GPU."""
        return "device_memory_GiB" in self.machine


def identity(row: dict) -> tuple:
    """Return the values by which two rows are the same measurement."""
    return tuple(row.get(key) for key in IDENTITY)


def read(path: Path) -> dict:
    """Return the run in a JSON file.

    Raises:
        ValueError: there is no such file, or it is not the file of a run.
    """
    try:
        data = json.loads(Path(path).read_text())
    except OSError as error:
        raise ValueError(
            f"benchmarks: cannot read {str(path)!r}: {error.strerror}; expected the JSON of a run"
        ) from None
    except ValueError:
        data = None
    if not _is_run(data):
        raise ValueError(f"benchmarks: {str(path)!r} is not the JSON of a run, as --json writes it")
    return data


def _is_run(data: Any) -> bool:
    """Return whether ``data`` has the keys that tables, pictures and reports need."""
    if not isinstance(data, dict) or not all(isinstance(data.get(key), kind) for key, kind in RUN.items()):
        return False
    stress = data.get("stress", [])
    if "device" not in data["machine"] or not isinstance(stress, list):
        return False
    return all(isinstance(row, dict) and ROWS[_kind(row)] <= row.keys() for row in [*data["rows"], *stress])


def files(paths: Iterable[Path]) -> list[Path]:
    """Return the files among ``paths``, and every JSON file of the folders among them.

    Raises:
        ValueError: there is no file.
    """
    found = [file for path in paths for file in (sorted(path.glob("*.json")) if path.is_dir() else [path])]
    if not found:
        folders = ", ".join(map(str, paths))
        raise ValueError(f"benchmarks: no JSON in {folders}; python -m benchmarks --json {RESULTS} makes one")
    return found


def gather(runs: Iterable[dict]) -> list[Evidence]:
    """Return the evidence of every machine among the runs, GPUs first."""
    machines: dict[str, list[dict]] = {}
    for data in sorted(runs, key=lambda data: data["date"], reverse=True):
        machines.setdefault(data["machine"]["device"], []).append(data)
    found = [_gather_machine(mine) for mine in machines.values()]
    return sorted(found, key=lambda evidence: not evidence.is_gpu)


def _gather_machine(runs: list[dict]) -> Evidence:
    """Return the evidence of one machine; ``runs`` are its runs, newest first."""
    newest: dict[tuple, str] = {}  # kind of rows, and peer or group -> commit that they come from
    rows: dict[str, list[dict]] = {"ours": [], "peers": [], "stress": [], "capabilities": []}
    used: dict[int, dict[str, None]] = {}
    seen: set[tuple] = set()
    for index, data in enumerate(runs):
        for row in [*data["rows"], *data.get("stress", [])]:
            kind = _kind(row)
            part = kind, row.get("peer") or row.get("group")
            of_newest = newest.setdefault(part, data["commit"]) == data["commit"]
            stressed = (row.get("case"), str(row.get("parameters")), row.get("precision"), row.get("granularity"))
            key = stressed if kind == "stress" else identity(row)
            if of_newest and key not in seen:
                seen.add(key)
                rows[kind].append(row)
                used.setdefault(index, {})[row.get("peer") or row.get("group") or kind] = None
    machine = {key: value for data in runs[::-1] for key, value in data["machine"].items()}
    lines = [_source_line(data, list(used[index])) for index, data in enumerate(runs) if index in used]
    sources = list(dict.fromkeys(lines))
    dates = {kind: runs[index]["date"] for index in sorted(used, reverse=True) for kind in used[index]}
    return Evidence(machine, rows["ours"], rows["peers"], rows["stress"], sources, rows["capabilities"], dates)


def _kind(row: dict) -> str:
    if "group" in row:
        return "capabilities"
    return "stress" if "verdict" in row else "peers" if row.get("peer") else "ours"


def _source_line(data: dict, kinds: list[str]) -> str:
    named = [kind for kind in kinds if kind != "ours"]
    what = "" if "ours" in kinds else f" ({', '.join(named)})"
    versions = ", ".join(f"{name} {version}" for name, version in data["versions"].items())
    return f"{data['machine']['device']}{what}, commit {data['commit'][:12]}, {data['date'][:10]}, {versions}."


def usual_worlds(rows: Iterable[dict]) -> int:
    """Return the world count that most rows have; 0 without rows."""
    counts = [row["worlds"] for row in rows]
    return max(counts, key=lambda worlds: (counts.count(worlds), worlds), default=0)


def compare(a: dict, b: dict, least: float = 20.0) -> list[tuple[float, dict, dict]]:
    """Return (|us_a - us_b| / the smaller, row of a, row of b) of each row that both runs have, largest first.

    Rows that take less than ``least`` µs in both are left out.

    Raises:
        ValueError: no row is left.
    """
    others = {identity(row): row for row in b["rows"] if "us" in row}
    pairs = [(row, others[identity(row)]) for row in a["rows"] if "us" in row and identity(row) in others]
    pairs = [(x, y) for x, y in pairs if max(x["us"], y["us"]) >= least]
    if not pairs:
        raise ValueError(f"benchmarks: the two runs have no timed case of {least:g} us or more in common")
    found = [(abs(x["us"] - y["us"]) / min(x["us"], y["us"]), x, y) for x, y in pairs]
    return sorted(found, key=lambda one: one[0], reverse=True)
