"""Pages of the documentation: their code runs and prints what they show, every public name has its entry, links of a
site are checked, messages on the page of questions stand in the code."""

import importlib
import inspect
import re

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from benchmarks import site
from benchmarks.blocks import ROOT, agree, blocks, differences, pages, rewrite, run, unmarked
from warp_spo.examples.__main__ import examples
from warp_spo.execution import plan

PAGES = {page.relative_to(ROOT).as_posix().removeprefix("docs/").replace("/", "."): page for page in pages()}
CODE = [name for name, page in PAGES.items() if any(block.kind == "python" for block in blocks(page.read_text()))]
ENTRY = re.compile(r"^\.\. auto(class|method|attribute|function|module):: ([\w.]+)$", re.MULTILINE)
COMMAND = re.compile(r"python -m ((?:warp_spo|benchmarks)[\w.]*)([^\n`#&]*)")
OPTIONS = {  # that commands share
    "warp_spo.examples": (ROOT / "warp_spo" / "examples" / "options.py").read_text(),
    "benchmarks": (ROOT / "benchmarks" / "command_line.py").read_text(),
}
PUBLIC = {
    "warp_spo.newton": ("SolverSPO", "shipped"),
    "warp_spo.mujoco": ("Coordinates",),
    "warp_spo.torch": ("Module", "custom_op"),
    "warp_spo.jax": ("function",),
}
LEARNING = {
    "warp_spo.env": ("Env", "World", "Observation", "TorchTerm", "make", "gymnasium", "skrl"),
    "warp_spo.env.learning": ("Learner", "train", "policy_of"),
    "warp_spo.env.export": ("save",),
    "warp_spo.env.robots": ("load",),
}
"""Names that are public besides those of ``warp_spo`` itself: of the borders, of the environments."""


@pytest.mark.parametrize("page", CODE)
def test_blocks_of_a_page_run_and_print_what_it_shows(page, request, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # a reader does not stand in the repository
    monkeypatch.setattr(plan, "DEFAULT", None)  # nor chooses a granularity
    with wp.ScopedDevice(request.config.getoption("--device")), np.errstate(all="raise", under="ignore"):
        outputs = run(PAGES[page])
    assert not differences(PAGES[page], outputs)


def test_all_code_of_all_pages_runs_or_says_why_not():
    assert len(CODE) > 20
    assert not [sentence for page in PAGES.values() for sentence in unmarked(page)]


def test_code_that_neither_runs_nor_says_why_is_found(monkeypatch, tmp_path):
    monkeypatch.setattr("benchmarks.blocks.ROOT", tmp_path)
    page = tmp_path / "page.md"
    fences = [
        "```console\nls\n```",
        "    ls",
        "```c\n1;\n```",
        "```text\n2\n```",
        "<!-- not run: no -->\n```console\nls\n```",
    ]
    page.write_text("\n\n".join(fences) + "\n")
    found = unmarked(page)
    assert [line.split(":")[0] for line in found[:3]] == [f"page.md, line {n}" for n in (1, 7, 11)] and len(found) == 4


def test_what_blocks_print_is_written_beneath_them(monkeypatch, tmp_path):
    monkeypatch.setattr("benchmarks.blocks.ROOT", tmp_path)
    (tmp_path / "docs").mkdir()
    page = tmp_path / "docs" / "page.md"
    page.write_text('```python\nx = 3.0\nprint("x is", x)\n```\n\n<!-- varies: so -->\n```python\nprint(x)\n```\n')
    assert len(differences(page, run(page))) == 1
    rewrite(page, run(page))
    assert '```python\nx = 3.0\nprint("x is", x)\n```\n\n```text\nx is 3.0\n```\n\n<!-- varies' in page.read_text()
    assert not differences(page, run(page))
    page.write_text(page.read_text().replace("x is 3.0", "x is 3.1"))
    assert len(differences(page, run(page))) == 1
    rewrite(page, run(page))
    assert not differences(page, run(page)) and page.read_text().count("```text") == 1


@pytest.mark.parametrize(
    ("shown", "printed", "same"),
    [
        ("a 1.00 b", "a 1.01  b", True),
        ("a 1.00", "a 1.03", False),
        ("a 1", "b 1", False),
        ("1e-16", "-3e-14", True),
        ("[1. 2.]", "[1. 2. 3.]", False),
        ("v2 x", "v3 x", False),
    ],
)
def test_outputs_agree_in_words_and_numbers(shown, printed, same):
    assert agree(shown, printed) == same


def test_commands_of_all_pages_exist():
    seen = set()
    for page in PAGES.values():
        for module, rest in COMMAND.findall(page.read_text()):
            module = module.rstrip(".")
            path = ROOT / module.replace(".", "/")
            files = sorted(path.glob("*.py")) if path.is_dir() else [path.with_suffix(".py")]
            assert (path / "__main__.py" if path.is_dir() else files[0]).exists(), f"{page.name}: python -m {module}"
            text = '"--help"' + "".join(file.read_text() for file in files) + OPTIONS.get(module.rpartition(".")[0], "")
            for option in re.findall(r"(?<!\S)--[a-z][a-z-]*", rest):
                seen.add((module, option))
                assert f'"{option}"' in text, f"{page.name}: python -m {module} {option}"
    assert len(seen) > 20


def resolve(name):
    """Return the object of a dotted name."""
    parts = name.split(".")
    found = importlib.import_module(parts[0])
    for k, part in enumerate(parts[1:], 2):
        if inspect.ismodule(found) and not hasattr(found, part):
            importlib.import_module(".".join(parts[:k]))
        found = inspect.getattr_static(found, part) if inspect.isclass(found) else getattr(found, part)
    return found


def members(found):
    """Yield (name, object) of the public functions, classes and properties that a class or module defines itself."""
    for name, value in vars(found).items():
        home = getattr(value, "__module__", None) if inspect.ismodule(found) else found.__name__
        kinds = (property, classmethod, staticmethod)
        if (
            name[0] != "_"
            and home == found.__name__
            and (inspect.isroutine(value) or isinstance(value, (type, *kinds)))
        ):
            yield name, value


def public_names(learns):
    """Return the public names of the environments, or all others."""
    if learns:
        return {f"{home}.{name}" for home, names in LEARNING.items() for name in names}
    names = {f"warp_spo.{name}" for name in spo.__all__ if not name.startswith("_")}
    for name in {name for name in names if inspect.ismodule(resolve(name))}:
        names |= {f"{name}.{own}" for own, _ in members(resolve(name))}
        names.remove(name)
    names |= {f"warp_spo.Dynamics.{name}" for name, _ in inspect.getmembers(spo.Dynamics) if not name.startswith("_")}
    return names | {f"{home}.{name}" for home, names in PUBLIC.items() for name in names}


@pytest.mark.parametrize("learns", [False, pytest.param(True, marks=pytest.mark.slow)])  # imports torch, rsl_rl, skrl
def test_every_public_name_has_its_entry_in_the_reference(learns):
    entries, module = {}, "warp_spo"
    for page in sorted((ROOT / "docs" / "api").glob("*.md")):
        for line in page.read_text().splitlines() if (page.stem == "env") == learns else ():
            if line.startswith(".. currentmodule:: "):
                module = line.split()[-1]
            if found := ENTRY.match(line):
                name = found[2] if found[2].startswith("warp_spo.") else f"{module}.{found[2]}"
                assert name not in entries, name
                entries[name] = resolve(name)
    listed = {id(entry) for entry in entries.values()}
    missing = {name for name in public_names(learns) if name not in entries and id(resolve(name)) not in listed}
    assert not missing, f"without an entry in docs/api: {', '.join(sorted(missing))}"
    objects = list(entries.items())
    for name, found in entries.items():
        if inspect.isclass(found) or inspect.ismodule(found):
            words = set(re.findall(r"\w+", inspect.getdoc(found) or ""))  # "Attributes:" names those without own text
            objects += [(f"{name}.{own}", value) for own, value in members(found) if own not in words]
    without = [name for name, found in objects if not inspect.getdoc(found)]
    assert not without, f"without a docstring: {', '.join(without)}"
    assert len(objects) > (100 if learns else 250)


def test_the_gallery_shows_every_example_and_every_picture_is_shown():
    text = {name: page.read_text() for name, page in PAGES.items()}
    headings = set(re.findall(r"^## (\w+)$", text["gallery.md"], re.MULTILINE))
    assert headings == set(examples())
    folder = ROOT / "docs" / "_static"
    shown = {path for page in text.values() for path in re.findall(r"_static/([\w./-]+)\)", page)}
    kept = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.suffix not in ("", ".css")}
    assert shown == kept


def test_messages_on_the_page_of_questions_stand_in_the_code(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    messages = importlib.import_module("messages")
    known = [text for rows in messages.rooms().values() for _, text in rows]
    known += [
        (ROOT / "warp_spo" / "errors.py").read_text(),
        (ROOT / "warp_spo" / "newton" / "files" / "load.py").read_text(),
    ]
    assert len(known) > 400
    text = (ROOT / "docs" / "questions.md").read_text().partition("## Errors")[2]
    shown = re.findall(r"^\| `([^|]+)` \|", text, re.MULTILINE)
    assert len(shown) > 15
    for message in shown:
        pattern = re.compile(".*".join(map(re.escape, message.split("…"))), re.DOTALL)
        assert any(pattern.search(each) for each in known), message


def test_broken_links_are_found(tmp_path):
    (tmp_path / "other.html").write_text('<p id="here"></p>')
    good = (
        '<a href="other.html#here">a</a><img src="data:x"><a href="https://a.org/x">b</a><a href="#top" id="top">c</a>'
    )
    page = tmp_path / "page.html"
    page.write_text(good)
    assert site.broken_links(tmp_path) == ([], 2, 1)
    page.write_text(
        good + '<a href="none.html">d</a><img src="none.svg"><a href="other.html#x">e</a><a href="/x.html">f</a>'
    )
    assert len(site.broken_links(tmp_path)[0]) == 4


def test_links_between_files_of_the_repository_lead_somewhere():
    for page in PAGES.values():
        for link in re.findall(r"\]\(([^)#:\s]+)(?:#[\w-]*)?\)", page.read_text()):
            assert (page.parent / link).exists(), f"{page.relative_to(ROOT)}: {link}"
