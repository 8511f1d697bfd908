"""Type checkers: a user's program with torch tensors is right in ``mypy --strict``, and mistakes in it are found."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("mypy")
pytest.importorskip("torch")

REPOSITORY = Path(__file__).parents[2]
USER = REPOSITORY / "tests" / "support" / "typing_user.py"


def check(file, folder):
    """Return what ``mypy --strict`` says of a file; of warp_spo it reports nothing, as if that were installed."""
    command = [sys.executable, "-m", "mypy", "--strict", "--follow-imports=silent", "--no-pretty", "--config-file="]
    environment = os.environ | {"MYPYPATH": str(REPOSITORY), "MYPY_CACHE_DIR": str(folder)}
    command += ["--ignore-missing-imports", str(file)]
    return subprocess.run(command, capture_output=True, text=True, cwd=folder, env=environment).stdout


@pytest.mark.slow
def test_a_user_with_torch_tensors_type_checks(tmp_path):
    found = check(USER, tmp_path)
    assert found.startswith("Success"), found


@pytest.mark.slow
def test_mistakes_are_found(tmp_path):
    mistakes = {
        "spo.forward_dynamics": 'Module has no attribute "forward_dynamics"',
        "len(spo.Status.OK.advice.severity)": '"str" has no attribute "severity"',
        "operator @ 3": "Unsupported operand types|No overload variant",
    }
    lines = ["import warp_spo as spo", "def use(operator: spo.Operator) -> None:"] + [f"    {one}" for one in mistakes]
    (tmp_path / "user.py").write_text("\n".join(lines) + "\n")
    found = check(tmp_path / "user.py", tmp_path)
    for line, words in enumerate(mistakes.values(), start=3):
        assert any(f"user.py:{line}: error: " in text and any(w in text for w in words.split("|"))
                   for text in found.splitlines()), found  # fmt: skip
