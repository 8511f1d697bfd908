"""The benchmark of a boom beside Exudyn: our part of it, its choice of settings, its picture. Exudyn is not needed."""

import sys

import numpy as np
import pytest

from benchmarks import boom, flexible_peers
from benchmarks.table import evidence
from support.rendering import assert_is_whole
from warp_spo.viewing import charts

PAGE = evidence.ROOT / "docs" / "flexible.md"
ROUNDED = 2e-2  # of an error: the file keeps places of the tip to 1 um, and compilers differ in rounding


@pytest.fixture(scope="module")
def rows():
    (file,) = evidence.RESULTS.glob("*flexible-peers.json")
    return evidence.read(file)["rows"]


def test_our_boom_lies_as_far_from_the_truth_as_the_results_say(rows):
    truth = 1e-6 * np.array(rows[0]["tip_um"])
    (row,) = [row for row in rows if row["name"] == "warp_spo: 1 body, 2 modes, 5 ms" and row["worlds"] == 1]
    simulate = boom.ours(boom.scene(1, "clamped", 2), 5e-3)
    path = simulate()
    assert path.shape == truth.shape == (1 + boom.SAMPLES, 2)
    assert boom.error(path, truth) == pytest.approx(row["error"], rel=ROUNDED)
    np.testing.assert_array_equal(simulate(), path)  # starts anew
    assert boom.error(np.roll(path, 1, axis=0), truth) > 0.05


def test_the_truth_is_confirmed_by_our_fine_chain_and_our_floating_frame_is_exudyns(rows):
    """As measured; the boom is 2 m long."""
    assert max(rows[0]["from_truth"].values()) < 3e-6 and len(rows[0]["from_truth"]) == 3
    assert rows[0]["floating_frames"] < 3e-5


def test_the_fastest_of_the_close_settings_is_taken(monkeypatch):
    truth = np.zeros((1 + boom.SAMPLES, 2))
    made = {1: (1.00, 3.0), 2: (1.04, 2.0), 3: (1.06, 1.0), 4: (np.nan, 0.5), 5: (None, 0.5)}  # error, seconds

    def run(prepare, repeats, dt, order):
        wrong, seconds = made[order]
        if wrong is None:
            raise RuntimeError("SolveDynamic terminated")
        path = truth.copy()
        path[1:, 0] = wrong
        return path, seconds, 0.1

    monkeypatch.setattr(flexible_peers, "run", run)
    row = flexible_peers.measure(None, {"order": tuple(made)}, 0.01, truth)
    assert row["settings"] == {"order": 2}
    assert (row["ms"], row["us_a_step"]) == (pytest.approx(2e3), pytest.approx(1e4))
    assert flexible_peers.measure(None, {"order": (4, 5)}, 0.01, truth) is None


def test_without_exudyn_it_says_how_to_install_it(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "exudyn", None)
    boom.exudyn.cache_clear()
    assert flexible_peers.main([]) == 2
    assert "pip install --target FOLDER exudyn scipy, then PYTHONPATH=FOLDER" in capsys.readouterr().err


def test_steps_divide_the_time_between_two_places_of_the_tip():
    assert boom.steps_of_a_sample(5e-3) == 4
    for dt in (3e-3, 0.04):
        with pytest.raises(ValueError, match=r"dt is .* expected an integer part of 0\.02 s"):
            boom.steps_of_a_sample(dt)


def test_the_picture_has_all_families_and_is_committed(rows):
    text, committed = charts.svg(flexible_peers.picture(rows)), flexible_peers.PICTURE.read_text()
    assert_is_whole(text)
    assert_is_whole(committed)
    for family in flexible_peers.FAMILIES:
        assert f"<!-- {family} -->" in text and f"<!-- {family} -->" in committed
    assert f"_static/{flexible_peers.PICTURE.name}" in PAGE.read_text()
