"""Sphinx configuration: ``python -m sphinx -W -b html docs docs/_build``, without network."""

import inspect
import re
import sys
from pathlib import Path

import warp as wp

wp.config.log_level = wp.LOG_WARNING  # before newton is imported

import warp_spo  # noqa: E402

project = "warp_spo"
author = "the warp_spo developers"
release = warp_spo.__version__

sys.path.insert(0, str(Path(__file__).parent))  # messages.py
extensions = ["sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon", "myst_parser", "messages"]
exclude_patterns = ["_build"]
myst_heading_anchors = 3
autosummary_generate = False  # tables alone; every call has its entry on the page below them
autodoc_typehints = "none"  # docstrings give kinds, shapes and units
autodoc_member_order = "bysource"
nitpicky = True  # a reference to nothing is a warning
smartquotes = False  # primes are derivatives
napoleon_use_rtype = False
# a list within the entry of the class, several names a line
napoleon_custom_sections = [("Attributes", "params_style")]
python_maximum_signature_line_length = 100

html_theme = "pydata_sphinx_theme"
html_title = f"warp_spo {release}"
html_theme_options = {
    "navbar_align": "left",
    "show_nav_level": 2,
    "show_toc_level": 2,
    "show_prev_next": False,
    "footer_start": ["copyright"],
    "footer_end": [],
}
PROJECT = ("project", "contributing", "measured_facts", "changelog")  # pages that list each other
html_sidebars = {page.stem: [] for page in Path(__file__).parent.glob("*.md") if page.stem not in PROJECT}
html_static_path = ["_static"]
html_css_files = ["page.css"]
html_show_sourcelink = False
copyright = "the warp_spo developers, Apache-2.0"

HOMES = ("warp_spo.", "warp_spo.Dynamics.")


def find_reference(app, env, node, content):
    """Return the link for a name that a docstring gives without its class, quoted in a table or another module."""
    if node.get("refdomain") != "py":
        return None
    domain = env.get_domain("py")
    for home in HOMES:
        name = home + node["reftarget"]
        if found := domain.resolve_xref(env, node["refdoc"], app.builder, node["reftype"], name, node, content):
            return found
    return None


def split_arguments(app, what, name, obj, options, lines):
    """Give each argument a line of its own, where a docstring names several in one: ``rate: first. target: second.``"""
    if "Args:" not in lines:
        return
    start = lines.index("Args:") + 1
    stop = next((i for i in range(start, len(lines)) if not lines[i].startswith(" ")), len(lines))
    taken = inspect.signature(obj).parameters if callable(obj) else {}
    entries: list[str] = []
    for line in lines[start:stop]:
        if line.startswith("     ") and entries:
            entries[-1] += " " + line.strip()
        else:
            entries.append(line)
    apart = []
    for entry in entries:
        parts = re.split(r"(?<=[.;\])]) (?=\w+(?:, \w+)*: )", entry)
        apart.append(parts[0])
        for part in parts[1:]:
            if re.split(r"[,:]", part)[0] in taken:
                apart.append("    " + part)
            else:
                apart[-1] += " " + part
    lines[start:stop] = apart


def setup(app):
    """Add what this file does to Sphinx."""
    app.connect("missing-reference", find_reference)
    app.connect("autodoc-process-docstring", split_arguments, priority=400)  # before napoleon, at 500
