"""MJCF with attributes at random: each is right beside MuJoCo, refused or named; planted misreadings are found."""

import collections
import dataclasses
import re
from unittest import mock

import mujoco
import numpy as np
import pytest

import warp_spo as spo
from support.mjcf_attributes import ATTRIBUTES, REFUSED, RIGHT, WARNED, random_files, text
from support.mjcf_misreadings import misreadings

MANY, OFTEN = 60, 10  # named attributes; files of each
OFF = ("actuatorgroupdisable",)
UNSEEN = {
    ("compiler", "alignfree"),
    ("compiler", "fusestatic"),
    ("compiler", "balanceinertia"),
    ("flag", "refsafe"),
    ("trunk geom", "priority"),
    ("trunk geom", "condim"),
    ("turn body", "childclass"),
    ("turn", "actuatorfrcrange"),
    ("turn geom", "friction"),
    ("turn geom", "contype"),
    ("turn geom", "margin"),
    ("slide", "pos"),
    ("slide", "class"),
    ("slide geom", "conaffinity"),
    ("slide geom", "contype"),
    ("group geom", "gap"),
    ("inertial", "quat"),
    ("floor", "contype"),
    ("by fromto", "size"),
    ("any", "gaintype"),
}
"""Attributes of ``RIGHT`` whose loss the comparison does not show: drawn without effect (a slide's ``pos``), or
hidden by others."""


def read(folder, rng, chosen, without=None):
    """The misreadings of a file; the reader gets it without the attribute ``without``, MuJoCo with it."""
    drawn = [one.drawn(rng) for one in chosen]
    file = folder / "robot.xml"
    file.write_text(text(rng, drawn))
    model = mujoco.MjModel.from_xml_path(str(file))
    if without is not None:
        file.write_text(text(rng, [one for one in drawn if (one.element, one.name) != (without.element, without.name)]))
    wrong, said = misreadings(file, model)
    missing = [one for one in chosen if one.outcome == "warned" and not re.search(one.words, said)]
    return wrong + [f"{one.named} of {one.element} is not named" for one in missing]


def together():
    """The attributes but those that switch others off."""
    return [one for one in [*RIGHT, *WARNED] if one.element != "flag" and one.name not in ("active", *OFF)]


def seen(folder, one):
    """Whether it is found that a reader skips an attribute, alone, among the others, or where friction is not off."""
    others = [other for other in together() if other is not one]
    for chosen in ([one], [*others, one], [*(other for other in others if other.name != "condim"), one]):
        try:
            if read(folder, np.random.default_rng(0), chosen, one):
                return True
        except (ValueError, KeyError):  # the reader finds what is missing, or the scene has another joint
            return True
    return False


def read_files(folder, files, seed=0):
    wrong, counts = [], collections.Counter()
    for number, (rng, chosen) in enumerate(random_files(seed, files)):
        wrong += [f"{number}: {words}" for words in read(folder, rng, chosen)]
        counts.update((one.element, one.name) for one in chosen)
    return wrong, counts


def refusals(folder, repeats, seed=0):
    """Attributes that are not refused by their words."""
    wrong, rng, file = [], np.random.default_rng(seed), folder / "robot.xml"
    for one in REFUSED * repeats:
        file.write_text(text(rng, [one]))
        mujoco.MjModel.from_xml_path(str(file))
        with pytest.raises(spo.UnsupportedError) as caught:
            spo.load(file)
        wrong += [] if one.words in str(caught.value) else [f"{one.named}: {caught.value}"]
    return wrong


def test_the_attributes_are_many():
    """The page counts them."""
    assert len({one.named for one in ATTRIBUTES}) >= MANY


def test_each_attribute_is_right_or_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its log
    assert not read_files(tmp_path, 2)[0]


def test_each_other_attribute_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert not refusals(tmp_path, 1)


@pytest.mark.slow
def test_each_attribute_is_right_or_named_in_ten_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    wrong, counts = read_files(tmp_path, 80, seed=1)
    assert not wrong and min(counts.values()) >= OFTEN and not refusals(tmp_path, OFTEN, seed=1)


@pytest.mark.slow
def test_each_attribute_that_a_reader_skips_is_found(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    missed = [one for one in RIGHT if (one.element, one.name) not in UNSEEN and not seen(tmp_path, one)]
    assert not missed, [(one.element, one.name) for one in missed]


def changed(module, name, change):
    """A patch of a function of a module: ``change`` of what it returns."""
    was = getattr(module, name)
    return mock.patch.object(module, name, lambda *arguments: change(was(*arguments)))


def scaled(field):
    """A patch of hinges: a value of all of them is a tenth larger."""
    return lambda values: values | {field: values[field] * 1.1}


PLANTED = {
    "armature": lambda m: changed(m["mechanism"].Mechanism, "_dof_values", scaled("armature")),
    "damping": lambda m: changed(m["mechanism"].Mechanism, "_dof_values", scaled("damping")),
    "friction": lambda m: changed(m["mechanism"].Mechanism, "_dof_values", scaled("friction")),
    "stiffness": lambda m: changed(m["mechanism"].Mechanism, "_dof_values", scaled("stiffness")),
    "limits too soft": lambda m: changed(
        m["joint_limits"].JointLimits, "gains", lambda gains: (gains[0] / 3, gains[1])
    ),
    "axes of an inertia": lambda m: changed(m["mechanism"], "rotation", lambda axes: axes.T),
    "places of sites": lambda m: changed(m["model"], "xyzw", lambda turn: turn * [1, 1, 1, -1]),
    "bias of actuators": lambda m: changed(m["actuators"], "_gain_and_bias", lambda both: (both[0], (0.0, 0.0, 0.0))),
    "friction of contacts": lambda m: changed(
        m["collision_shapes"], "_frictions", lambda found: found | {"friction": found["friction"] + 0.1}
    ),
    "softness is not said": lambda m: mock.patch.object(m["model"], "_softness", lambda source: []),
    "offset of a coupling": lambda m: changed(
        m["equality_constraints"], "_coupling", lambda one: dataclasses.replace(one, offset=one.offset + 0.1)
    ),
}


@pytest.mark.parametrize("name", PLANTED)
def test_planted_misreadings_are_found(name, tmp_path, monkeypatch):
    import warp_spo.mujoco as package
    from warp_spo.mujoco import actuators, collision_shapes, equality_constraints, joint_limits, mechanism, model

    monkeypatch.chdir(tmp_path)
    modules = (actuators, collision_shapes, equality_constraints, joint_limits, mechanism, model)
    with PLANTED[name]({module.__name__.removeprefix(package.__name__ + "."): module for module in modules}):
        assert read(tmp_path, np.random.default_rng(0), together())
