"""What is known of each machine, gathered from the JSON files of runs: our rows, peers' rows, the stress suite's."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results"
IDENTITY = ("scene", "op", "worlds", "dtype", "granularity", "peer", "variant", "sweep", "group", "name")
"""Keys that tell one measurement from another; a row has some of them."""
RUN = {"rows": list, "machine": dict, "date": str, "commit": str, "versions": dict}
MEASURED = {"name", "scene", "op", "worlds", "dtype"}
ROWS = {
    "ours": MEASURED,
    "peers": MEASURED,
    "stress": {"case", "parameters", "verdict"},
    "capabilities": {"group", "name", "worlds"},
}
"""What the file of a run holds, and every row of a kind."""


class Evidence(NamedTuple):
    """Rows of one machine, each kind from the newest commit that has it (of every peer: its newest).

    Files of one commit complete each other; where they have the same row, the newer one counts.

    Attributes:
        machine: what the newest file says of it, its peaks too.
        rows: ours; ``peers``: with "peer", its name; ``stress``: with "case" and "verdict".
        sources: a line for each file that rows come from: machine, what, commit, date, versions.
        capabilities: with "group", see :mod:`.capabilities`.
    """

    machine: dict
    rows: list[dict]
    peers: list[dict]
    stress: list[dict]
    sources: list[str]
    capabilities: Sequence[dict] = ()

    @property
    def is_gpu(self) -> bool:
        return "device_memory_GiB" in self.machine


def identity(row: dict) -> tuple:
    """What two runs of the same measurement have in common."""
    return tuple(row.get(key) for key in IDENTITY)


def read(path: Path) -> dict:
    """The run in a JSON file.

    Raises:
        ValueError: no such file, or one that no run wrote.
    """
    try:
        data = json.loads(Path(path).read_text())
    except OSError as error:
        raise ValueError(f"benchmarks: cannot read {str(path)!r}: {error.strerror}; expected a run's JSON") from None
    except ValueError:
        data = None
    if not _is_run(data):
        raise ValueError(f"benchmarks: {str(path)!r} is not the JSON of a run, as --json writes it")
    return data


def _is_run(data: Any) -> bool:
    """Whether all is there that tables, pictures and reports look up without asking."""
    if not isinstance(data, dict) or not all(isinstance(data.get(key), kind) for key, kind in RUN.items()):
        return False
    stress = data.get("stress", [])
    if "device" not in data["machine"] or not isinstance(stress, list):
        return False
    return all(isinstance(row, dict) and ROWS[_kind(row)] <= row.keys() for row in [*data["rows"], *stress])


def files(paths: Iterable[Path]) -> list[Path]:
    """The files named, and every JSON file of the folders named.

    Raises:
        ValueError: there is none.
    """
    found = [file for path in paths for file in (sorted(path.glob("*.json")) if path.is_dir() else [path])]
    if not found:
        folders = ", ".join(map(str, paths))
        raise ValueError(f"benchmarks: no JSON in {folders}; python -m benchmarks --json {RESULTS} makes one")
    return found


def gather(runs: Iterable[dict]) -> list[Evidence]:
    """Evidence of every machine among the runs, GPUs first."""
    machines: dict[str, list[dict]] = {}
    for data in sorted(runs, key=lambda data: data["date"], reverse=True):
        machines.setdefault(data["machine"]["device"], []).append(data)
    found = [_of_machine(mine) for mine in machines.values()]
    return sorted(found, key=lambda evidence: not evidence.is_gpu)


def _of_machine(runs: list[dict]) -> Evidence:
    """Evidence of one machine; ``runs`` come newest first."""
    newest: dict[tuple, str] = {}  # kind of rows -> commit that they come from
    rows: dict[str, list[dict]] = {"ours": [], "peers": [], "stress": [], "capabilities": []}
    used: dict[int, dict[str, None]] = {}
    seen: set[tuple] = set()
    for index, data in enumerate(runs):
        for row in [*data["rows"], *data.get("stress", [])]:
            kind = _kind(row)
            of_newest = newest.setdefault((kind, row.get("peer")), data["commit"]) == data["commit"]
            stressed = (row.get("case"), str(row.get("parameters")), row.get("precision"), row.get("granularity"))
            key = stressed if kind == "stress" else identity(row)
            if of_newest and key not in seen:
                seen.add(key)
                rows[kind].append(row)
                used.setdefault(index, {})[row.get("peer") or kind] = None
    machine = {key: value for data in runs[::-1] for key, value in data["machine"].items()}
    lines = [_source(data, list(used[index])) for index, data in enumerate(runs) if index in used]
    sources = list(dict.fromkeys(lines))
    return Evidence(machine, rows["ours"], rows["peers"], rows["stress"], sources, rows["capabilities"])


def _kind(row: dict) -> str:
    if "group" in row:
        return "capabilities"
    return "stress" if "verdict" in row else "peers" if row.get("peer") else "ours"


def _source(data: dict, kinds: list[str]) -> str:
    named = [kind for kind in kinds if kind != "ours"]
    what = "" if "ours" in kinds else f" ({', '.join(named)})"
    versions = ", ".join(f"{name} {version}" for name, version in data["versions"].items())
    return f"{data['machine']['device']}{what}, commit {data['commit'][:12]}, {data['date'][:10]}, {versions}."


def usual_worlds(rows: Iterable[dict]) -> int:
    """The world count that most rows have; 0 without rows."""
    counts = [row["worlds"] for row in rows]
    return max(counts, key=lambda worlds: (counts.count(worlds), worlds), default=0)


def compare(a: dict, b: dict, least: float = 20.0) -> list[tuple[float, dict, dict]]:
    """How far two runs lie apart, largest difference first: (|us_a - us_b| / the smaller, row of a, row of b).

    Rows that only one run has, or that take less than ``least`` us in both, are left out.

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
