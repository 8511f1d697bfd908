"""The README's Markdown table, from the JSON file of a run."""

import json
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results"
BEGIN, END = "<!-- benchmarks:begin -->", "<!-- benchmarks:end -->"


def read(path: Path | None = None) -> dict:
    """The run in a JSON file; None: the newest under benchmarks/results.

    Raises:
        ValueError: no such file, or one that no run wrote.
    """
    if path is None:
        found = sorted(RESULTS.glob("*.json"))
        if not found:
            raise ValueError(f"benchmarks: no JSON in {RESULTS}; python -m benchmarks --json {RESULTS} makes one")
        path = found[-1]
    try:
        data = json.loads(Path(path).read_text())
        data["rows"], data["machine"]["device"]
    except OSError as error:
        raise ValueError(f"benchmarks: cannot read {str(path)!r}: {error.strerror}; expected a run's JSON") from None
    except (ValueError, KeyError, TypeError):
        raise ValueError(f"benchmarks: {str(path)!r} is not the JSON of a run, as --json writes it") from None
    return data


def markdown(data: dict) -> str:
    """A heading line, then one table a precision: lines are scenes and operations, columns are world counts."""
    rows = data["rows"]
    machine, found = data["machine"], data["versions"]
    text = [
        f"{machine['device']}, commit {data['commit'][:12]}, {data['date'][:10]}, "
        + ", ".join(f"{name} {version}" for name, version in found.items())
        + ". Run time of one evaluation of all worlds [µs], evaluations per second, and the largest relative error "
        "against dense float64."
    ]
    for dtype in dict.fromkeys(row["dtype"] for row in rows):
        mine = [row for row in rows if row["dtype"] == dtype]
        counts = sorted({row["worlds"] for row in mine})
        heads = ["robot", "dof", "operation", *(f"{count} worlds" for count in counts), "error"]
        text += ["", f"**{dtype}**", "", "| " + " | ".join(heads) + " |"]
        text.append("|---|---:|---|" + "---:|" * (len(counts) + 1))
        for name in dict.fromkeys(row["name"] for row in mine):
            group = {row["worlds"]: row for row in mine if row["name"] == name}
            first = next(iter(group.values()))
            errors = [row["error"] for row in group.values()]
            error = max(errors) if all(e == e for e in errors) else float("nan")
            cells = [first["scene"], str(first["dof"]), f"`{first['op']}`"]
            cells += [_time(group.get(count)) for count in counts] + [f"{error:.1e}"]
            text.append("| " + " | ".join(cells) + " |")
    return "\n".join(text) + "\n"


def _time(row: dict | None) -> str:
    if row is None or "us" not in row:
        return "–"
    rate = row["evals_per_s"]
    power, letter = next(((p, s) for p, s in ((1e9, "G"), (1e6, "M"), (1e3, "k")) if rate >= p), (1.0, ""))
    return f"{row['us']:.{max(0, 2 - len(str(int(row['us']))) + 1)}f} ({rate / power:.3g} {letter}/s)"


def rewrite(readme: Path, data: dict) -> None:
    """Put the table between the two marker comments of ``readme``.

    Raises:
        ValueError: no such file, or not one of each marker, in order.
    """
    if not readme.is_file():
        raise ValueError(f"benchmarks: no file {str(readme)!r}; expected a README with {BEGIN} and {END}")
    text = readme.read_text()
    head, begin, rest = text.partition(BEGIN)
    _, end, tail = rest.partition(END)
    if not (begin and end) or BEGIN in tail or END in tail:
        raise ValueError(f"benchmarks: {str(readme)!r} does not hold {BEGIN} and then {END}, once; put them there")
    readme.write_text(f"{head}{BEGIN}\n{markdown(data)}{END}{tail}")
