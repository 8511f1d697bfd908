"""Python blocks of README.md and of the documentation's pages, run as a reader would run them."""

import inspect
import re
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from warp_spo.execution import plan

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted(
    page.relative_to(ROOT).as_posix()
    for page in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("**/*.md")]
    if "_build" not in page.parts
)
ENTRY = re.compile(r"^\.\. auto(?:class|method|attribute|function):: ([\w.]+)$", re.MULTILINE)
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(text):
    """Return (first line, code) of every Python block of a page."""
    return [(text[: found.start(1)].count("\n"), found[1]) for found in BLOCK.finditer(text)]


@pytest.mark.parametrize("page", [page for page in PAGES if BLOCK.search((ROOT / page).read_text())])
def test_blocks_of_a_page_run_one_after_the_other(page, request, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # a reader does not stand in the repository
    monkeypatch.setattr(plan, "DEFAULT", None)  # nor chooses a granularity
    names = {"__name__": page}
    with wp.ScopedDevice(request.config.getoption("--device")), np.errstate(all="raise", under="ignore"):
        for line, code in blocks((ROOT / page).read_text()):
            exec(compile("\n" * line + code, page, "exec"), names)  # errors name the page and its line


def test_every_public_call_has_its_entry_in_the_reference():
    text = "\n".join(page.read_text() for page in sorted((ROOT / "docs" / "api").glob("*.md")))
    entries = [entry.removeprefix("warp_spo.") for entry in ENTRY.findall(text)]
    assert len(entries) == len(set(entries))
    modules = {name for name in spo.__all__ if inspect.ismodule(getattr(spo, name))}
    public = {name for name in spo.__all__ if not name.startswith("_")} - modules
    for name in modules:
        module = getattr(spo, name)
        own = (each for each, value in vars(module).items() if getattr(value, "__module__", None) == module.__name__)
        public |= {f"{module.__name__}.{each}".removeprefix("warp_spo.") for each in own if not each.startswith("_")}
    calls = {f"Dynamics.{name}" for name, _ in inspect.getmembers(spo.Dynamics) if not name.startswith("_")}
    missing = (public | calls) - set(entries)
    assert not missing, f"without an entry in docs/api: {', '.join(sorted(missing))}"
    for entry in entries:
        if entry.startswith("Dynamics."):
            assert inspect.getdoc(inspect.getattr_static(spo.Dynamics, entry.partition(".")[2])), entry
