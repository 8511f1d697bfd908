"""URDF with attributes at random: each is Pinocchio's, or MuJoCo's, or named; planted misreadings are found."""

import collections
from unittest import mock

import numpy as np
import pytest

from support.urdf_attributes import ATTRIBUTES, misreadings, random_files, text
from warp_spo.newton.files import urdf, urdf_shapes

OFTEN = 10  # files of each attribute


def read_files(folder, files, seed=0):
    wrong, counts, file = [], collections.Counter(), folder / "robot.urdf"
    for number, (rng, chosen) in enumerate(random_files(seed, files)):
        drawn = [one.drawn(rng) for one in chosen]
        file.write_text(text(rng, drawn))
        wrong += [f"{number}: {words}" for words in misreadings(file, drawn)]
        counts.update((one.element, one.name) for one in chosen)
    return wrong, counts


def test_each_attribute_is_right_or_named(tmp_path):
    assert not read_files(tmp_path, 2)[0]


@pytest.mark.slow
def test_each_attribute_is_right_or_named_in_ten_files(tmp_path):
    wrong, counts = read_files(tmp_path, 2 * OFTEN, seed=1)
    assert not wrong and min(counts.values()) >= OFTEN and len(counts) == len(ATTRIBUTES)


def changed(module, name, change):
    """A patch of a function of a module: ``change`` of what it returns."""
    was = getattr(module, name)
    return mock.patch.object(module, name, lambda *arguments: change(was(*arguments)))


def without(name):
    return lambda values: {key: value for key, value in values.items() if key != name}


PLANTED = {
    "damping": lambda: changed(urdf, "_resistances", without("damping")),
    "friction": lambda: changed(urdf, "_resistances", without("friction")),
    "effort": lambda: changed(urdf, "_limits", without("effort_limit")),
    "velocity": lambda: changed(urdf, "_limits", without("velocity_limit")),
    "lower": lambda: changed(urdf, "_limits", without("limit_lower")),
    "axis": lambda: changed(urdf, "_axis", lambda axis: np.roll(axis, 1)),
    "order of turns": lambda: changed(urdf, "origin_of", lambda pose: (pose[0], pose[1] * [-1, 1, 1, 1])),
    "frame of an inertia": lambda: changed(urdf, "_rotation", lambda turn: turn.T),
    "mimics": lambda: changed(urdf, "read_mimics", lambda mimics: mimics._replace(couplings=[
        one.__class__(one.hinge, one.reference, one.ratio, 0.0) for one in mimics.couplings])),
    "friction of contacts": lambda: changed(urdf_shapes, "_urdf_frictions", lambda found: {"friction": None}),
    "nothing is named": lambda: mock.patch.object(urdf, "_warn_of_limits", lambda joints, held: None),
}  # fmt: skip


@pytest.mark.parametrize("name", PLANTED)
def test_planted_misreadings_are_found(name, tmp_path):
    with PLANTED[name]():
        assert read_files(tmp_path, 2)[0]
