"""benchmarks.fuzz: a short run of each format without findings, and planted faults, all of which it finds."""

import collections
import json

import pytest

import warp_spo as spo
from benchmarks import fuzz
from support import fuzz_faults

PLANTED = {
    "read": "read",
    "refused": "refused",
    "key": "KeyError: \"'key'\"",
    "nameless": "a message that does not name the call and the file",
    "bell": "a message that does not print",
    "nan": "NaN in body_mass",
}
WORDS = ("crash", "read", "hang", "refused", "key")


@pytest.mark.parametrize("name", fuzz.FORMATS)
def test_a_few_damaged_files_are_read_or_refused(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its log
    kind, found = fuzz.FORMATS[name], collections.Counter()
    texts, file = kind.texts(), tmp_path / f"robot{kind.suffix}"
    for seed in range(40):
        text, options = fuzz.damaged(texts, seed)
        file.write_bytes(text)
        what, place = fuzz.judge(spo.load, file, options)
        assert what in ("read", "refused"), (seed, what, place)
        found[what] += 1
    assert min(found["read"], found["refused"]) >= 3


@pytest.mark.parametrize("word", PLANTED)
def test_faults_are_findings(word, tmp_path):
    file = tmp_path / "robot.txt"
    file.write_text(word)
    what, place = fuzz.judge(fuzz_faults.load, file, {})
    assert what.startswith(PLANTED[word])
    assert place.startswith("fuzz_faults.py") or word not in ("key", "nameless")


def test_a_seed_gives_the_same_file():
    texts = fuzz.FORMATS["urdf"].texts()
    assert fuzz.damaged(texts, 5) == fuzz.damaged(texts, 5) != fuzz.damaged(texts, 6)


def planted():
    return [f"{word} ".encode() * 30 for word in WORDS]


def test_a_row_of_results_is_written_for_each_format(tmp_path, monkeypatch):
    """A finding ends the command with 1; a run without any with 0, and rows of other formats stay."""
    file, finding = tmp_path / "fuzz.json", fuzz.Finding(7, "KeyError", "load.py:3")
    for name, found in (("urdf", [finding]), ("mjcf", [])):

        def search(kind, seeds, seconds, counts, found=found):
            counts.update(files=3, read=2, refused=1 - len(found))
            return iter(found)

        monkeypatch.setattr(fuzz, "search", search)
        with pytest.raises(SystemExit) as ended:
            fuzz.main([name, "--first", "5", "--json", str(file)])
        assert ended.value.code == len(found)
    rows = json.loads(file.read_text())["formats"]
    assert rows["urdf"] == {"first": 5, "files": 3, "read": 2, "refused": 0, "findings": [finding._asdict()]}
    assert rows["mjcf"] == {"first": 5, "files": 3, "read": 2, "refused": 1, "findings": []}


@pytest.mark.slow
def test_a_process_that_hangs_or_ends_is_a_finding():
    """And another process reads the files after it."""
    kind, counts = fuzz.Format(".txt", planted, "support.fuzz_faults.load"), collections.Counter()
    first_words = {seed: fuzz.damaged(planted(), seed)[0].split()[0].decode(errors="replace") for seed in range(200)}
    seeds = [next(seed for seed, found in first_words.items() if found == word) for word in WORDS]
    findings = list(fuzz.search(kind, seeds, 3.0, counts))
    assert [finding.seed for finding in findings] == [seeds[0], seeds[2], seeds[4]]
    assert findings[0].what == "the process ended with code -6" and findings[1].what == "no answer within 3 s"
    assert findings[2].what.startswith("KeyError") and findings[2].place.startswith("fuzz_faults.py")
    assert counts == {"files": 5, "read": 1, "refused": 1}
