"""USD files with attributes at random: each arrives, or is named; planted misreadings are found."""

import re
from unittest import mock

import pytest

from support.random_usd import ATTRIBUTES, misreadings, random_files, random_text

pytest.importorskip("pxr")
pytest.importorskip("newton_usd_schemas")
pytestmark = pytest.mark.filterwarnings("ignore::newton.NewtonWarning")


def read_files(folder, files, seed=0):
    """The misreadings of some random files."""
    wrong = []
    for number, (rng, chosen) in enumerate(random_files(seed, files)):
        file = folder / f"{number}.usda"
        file.write_text(random_text(rng, chosen))
        wrong += [f"{number}: {words}" for words in misreadings(file, chosen)]
    return wrong


def test_the_attributes_are_many():
    assert len({attribute.name for attribute in ATTRIBUTES}) >= 60


def test_each_attribute_arrives_or_is_named(tmp_path):
    assert not read_files(tmp_path, 2)


@pytest.mark.slow
def test_each_attribute_arrives_or_is_named_in_ten_files(tmp_path):
    """Half of twenty files."""
    assert not read_files(tmp_path, 20, seed=1)


def without(table, name):
    return {key: value for key, value in table.items() if key != name}


PLANTED = {
    "a value of vendors is not read": lambda usd, values, stage: mock.patch.object(
        values.VendorAttributes,
        "mapping",
        {kind: without(table, "armature") for kind, table in values.VendorAttributes.mapping.items()},
    ),
    "a unit is not converted": lambda usd, values, stage: mock.patch.object(
        usd, "DIMENSIONS", without(usd.DIMENSIONS, "joint_friction")
    ),
    "weights are not held up": lambda usd, values, stage: mock.patch.object(usd, "weights_held_up", lambda stage: {}),
    "nothing is named": lambda usd, values, stage: mock.patch.object(usd, "left_out", lambda *arguments: []),
    "an attribute counts as read": lambda usd, values, stage: mock.patch.object(
        stage, "PHYSICS", re.compile("(physics|drive|limit|state|mjc|newton):")
    ),
    "axes stay locked": lambda usd, values, stage: mock.patch.object(
        stage, "_free_axes_without_limits", lambda *a: None
    ),
}


@pytest.mark.parametrize("name", PLANTED)
def test_planted_misreadings_are_found(name, tmp_path):
    from warp_spo.newton.files import usd, usd_stage, usd_values

    with PLANTED[name](usd, usd_values, usd_stage):
        assert read_files(tmp_path, 2)
