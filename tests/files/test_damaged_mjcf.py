"""Damaged MJCF: each file is read as MuJoCo reads it, or refused by an error that names it."""

import warnings

import mujoco
import numpy as np
import pytest

import warp_spo as spo
from benchmarks.mjcf_files import Agreement, full_mass
from benchmarks.robot_files import mjcf_files
from support.mjcf_damage import damaged
from support.mjcf_texts import ACTUATORS, EMPTY, EQUALITY, EXACT, FREE, KEYS, TIES
from support.random_mjcf import random_mjcf
from warp_spo.mujoco.mjcf import compiled

SHIPPED = ("nv_ant.xml", "nv_humanoid.xml", "mjcf_exclude_test.xml", "testdata/model.xml")
ROUNDING = 1e-14  # relative error of an acceleration for each unit of the mass matrix's condition number


def texts():
    """Return the texts that are damaged: files that ship with packages, and models with every feature that is read."""
    found = [path.read_text() for name, path in mjcf_files() if name.endswith(SHIPPED)]
    models = [{"world": TIES, "more": EQUALITY}, {"world": TIES, "more": ACTUATORS}, {"root": "<site/>", "more": KEYS}]
    return [*found, *(FREE.format(**EMPTY | model) for model in models), random_mjcf(0, 6)]


def outcome(file):
    """Return "refused" or "agrees" of a file, or "no numbers" where MuJoCo's mass matrix is not finite."""
    try:
        scene = spo.load(file)
    except ValueError as error:
        assert str(error).startswith(f"load: {str(file)!r}"), error
        return "refused"
    model, *_ = compiled(file)
    if model.nv == 0:
        return "agrees"
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    if not np.isfinite(full_mass(model, data)).all():
        return "no numbers"
    both = Agreement(model, scene, granularity="node")
    errors = both.errors()
    assert max(errors[name] for name in ("poses", "mass", "bias")) <= EXACT, errors
    assert errors["acceleration"] <= max(EXACT, ROUNDING * errors["condition"]), errors
    assert both.passive_error() <= EXACT
    if model.nu:
        assert both.actuator_error(np.random.default_rng(0).normal(size=(3, model.nu))) <= EXACT
    return "agrees"


def outcomes(folder, seeds):
    found, originals = [], texts()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        for seed in seeds:
            text, what = damaged(originals[seed % len(originals)], np.random.default_rng(seed))
            file = folder / "robot.xml"
            file.write_text(text)
            try:
                found.append(outcome(file))
            except Exception as error:
                raise AssertionError(f"seed {seed}, {what}: {error!r}") from error
    return found


def test_damaged_files_are_refused_or_read_as_by_mujoco(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its log
    assert {"refused", "agrees"} <= set(outcomes(tmp_path, range(24)))


@pytest.mark.slow
def test_a_hundred_damaged_files_are_refused_or_read_as_by_mujoco(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert outcomes(tmp_path, range(1000, 1100)).count("agrees") >= 20
