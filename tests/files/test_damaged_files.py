"""Damaged URDFs: each is read as Pinocchio reads it, or refused by an error of ours that names the file."""

import re
import warnings

import numpy as np
import pinocchio
import pytest

from benchmarks.robot_files import compare_urdf, urdf_files
from support import damage
from warp_spo.newton import load

ROBOTS = (
    "double_pendulum.urdf",
    "z1.urdf",
    "panda.urdf",
    "talos_left_arm.urdf",
    "kinova.urdf",
    "cartpole.urdf",
    "finger_edu.urdf",
    "baxter.urdf",
    "go2.urdf",
)
FILES = {file.name: file for file in urdf_files()}


def text_of(name):
    """Return the text of a URDF without comments and visual shapes, so that damage hits what is read."""
    return re.sub(r"<!--.*?-->|<visual\b.*?</visual>", "", FILES[name].read_text(), flags=re.S)


def outcome(path, text):
    """Return "refused", "agrees" or "not comparable" of a damaged text; fail if it is read wrongly."""
    path.write_text(text)
    for repair in (True, False):
        try:
            load(path, floating=True, repair=repair)
        except ValueError as error:
            assert str(error).startswith(f"load: {str(path)!r}"), error
            if not repair:
                return "refused"
    try:
        pinocchio.buildModelFromXML(text)
    except ValueError:
        return "not comparable"
    row = compare_urdf(path, text)
    assert row.agrees, (row, text)
    return "agrees"


def outcomes(folder, seeds):
    texts = [text_of(name) for name in ROBOTS]
    found = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for seed in seeds:
            text = damage.damaged(texts[seed % len(texts)], np.random.default_rng(seed))
            found.append(outcome(folder / f"{seed}.urdf", text))
    return found


def test_damaged_urdfs_are_refused_or_read_as_by_pinocchio(tmp_path):
    found = outcomes(tmp_path, range(18))
    assert {"refused", "agrees"} <= set(found)


@pytest.mark.slow
def test_a_hundred_damaged_urdfs_are_refused_or_read_as_by_pinocchio(tmp_path):
    found = outcomes(tmp_path, range(100, 200))
    assert found.count("agrees") >= 10


@pytest.mark.parametrize("kind", damage.KINDS, ids=lambda kind: kind.__name__)
def test_one_damage_of_each_kind(kind, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for seed in range(2):
            outcome(tmp_path / f"{seed}.urdf", kind(text_of("z1.urdf"), np.random.default_rng(seed)))
