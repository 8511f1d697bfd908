"""The README's Markdown tables, from the JSON file of a run."""

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
    """Where the numbers come from, then a table for each precision and world count: operations by robots.

    A cell is the run time of one evaluation of all worlds [µs]; the last column is the largest error of the line, NaN
    if any is.
    """
    rows = data["rows"]
    found = ", ".join(f"{name} {version}" for name, version in data["versions"].items())
    text = [f"{data['machine']['device']}, commit {data['commit'][:12]}, {data['date'][:10]}, {found}."]
    for dtype, worlds in dict.fromkeys((row["dtype"], row["worlds"]) for row in rows):
        mine = [row for row in rows if (row["dtype"], row["worlds"]) == (dtype, worlds)]
        robots = {row["scene"]: row["dof"] for row in mine}
        names = [f"{robot} ({dof} dof)" for robot, dof in robots.items()]
        heads = [f"µs, {dtype}, {worlds} worlds", *names, "error"]
        text += ["", "| " + " | ".join(heads) + " |", "|---|" + "---:|" * (len(robots) + 1)]
        for op in dict.fromkeys(row["op"] for row in mine):
            line = {row["scene"]: row for row in mine if row["op"] == op}
            errors = [row["error"] for row in line.values()]
            error = max(errors) if all(e == e for e in errors) else float("nan")
            cells = [f"`{op}`", *(_time(line.get(robot)) for robot in robots), f"{error:.1e}"]
            text.append("| " + " | ".join(cells) + " |")
    return "\n".join(text) + "\n"


def _time(row: dict | None) -> str:
    """Three digits, such as 3.17, 21.6 or 1363."""
    if row is None or "us" not in row:
        return "–"
    return f"{row['us']:.{max(0, 3 - len(str(int(row['us']))))}f}"


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
