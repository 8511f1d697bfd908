"""The directive ``messages``: every error and warning of the package, read from its source when the site is built."""

import ast
import html
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent / "warp_spo"
GAP = "…"
ROOMS = {
    "scene": "Scenes, contacts, terrain",
    "newton": "Robot files, Newton, SolverSPO",
    "mujoco": "MuJoCo and MJCF",
    "dynamics": "Calls of Dynamics",
    "execution": "Plans and values",
    "runtime": "Arrays",
    "torch": "torch",
    "jax": "JAX",
    "env": "Environments and training",
    "viewing": "Films and pictures",
    "graph": "Trees and operators",
    "hinges": "Hinges and custom joints",
}
"""Folder or module -> heading, in the order of the page; all other rooms come last."""


def template(node: ast.expr) -> str | None:
    """Return a message with ``…`` for what is filled in, or None if it is no text."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(str(part.value) if isinstance(part, ast.Constant) else GAP for part in node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        left, right = template(node.left), template(node.right)
        return None if left is None and right is None else (left or GAP) + (right or GAP)
    return None


def messages(path: Path) -> list[tuple[str, str]]:
    """Return (kind, message) of each error that a file raises and each warning that it gives."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        raised = node.exc if isinstance(node, ast.Raise) else node
        if not isinstance(raised, ast.Call) or not raised.args:
            continue
        name = raised.func.attr if isinstance(raised.func, ast.Attribute) else getattr(raised.func, "id", "")
        if not (isinstance(node, ast.Raise) or name == "warn") or name in ("AttributeError", "SystemExit"):
            continue
        texts = [template(argument) or GAP for argument in raised.args]
        if name == "UnsupportedError":  # call, what, way out
            call, what, *way_out = [*texts, GAP][: max(2, len(texts))]
            texts = ["; ".join([f"{call}: {what} is not supported", *way_out])]
        text = " ".join(texts[0].split())
        if sum(letter.isalpha() for letter in text) > 12:
            found.append(("warning" if name == "warn" else name, text))
    return found


def rooms() -> dict[str, list[tuple[str, str]]]:
    """Return the messages (kind, message) of each room of the package, by its heading, in alphabetical order."""
    found: dict[str, set] = {title: set() for title in [*ROOMS.values(), "Elsewhere"]}
    for path in PACKAGE.rglob("*.py"):
        parts = path.relative_to(PACKAGE).parts
        if "kernels" not in parts and "examples" not in parts:
            found[ROOMS.get(parts[0].removesuffix(".py"), "Elsewhere")].update(messages(path))
    return {title: sorted(rows, key=lambda row: (row[1].lower(), row[0])) for title, rows in found.items()}


def setup(app):
    """Give Sphinx the directive."""
    from docutils import nodes
    from docutils.parsers.rst import Directive

    class Messages(Directive):
        """Insert a section for each room of the package, with its messages."""

        def run(self):
            sections = []
            for title, rows in rooms().items():
                section = nodes.section("", nodes.title("", title), ids=["messages-" + "-".join(title.lower().split())])
                items = "".join(f"<li>{html.escape(text)} <em>{kind}</em></li>" for kind, text in rows)
                section += nodes.raw("", f'<ul class="messages">{items}</ul>', format="html")
                sections.append(section)
            return sections

    app.add_directive("messages", Messages)
    return {"parallel_read_safe": True}
