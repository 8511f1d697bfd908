"""Traces evaluated by NumPy: what an operation's kernel computes, without compiling it; and bugs planted in them."""

import inspect
import textwrap

import numpy as np

from warp_spo.recursions.applications import Applications
from warp_spo.recursions.links import Links
from warp_spo.recursions.step import LOOPED, MISSED
from warp_spo.trace.evaluation import evaluate
from warp_spo.trace.scalars import ordered as ordered


def run(scene, operation, arrays, given, shapes, dtype="float64", trace=Applications, **options):
    """Results by name, [world, ...] of ``shapes``, NaN where nothing is stored.

    Args:
        arrays: inputs [world, ...] by name. given: those of them that the operation gets.
        trace: the class that has the operation.
    """
    stores = getattr(trace(Links(scene), dtype, tuple(given)), operation)(**options)
    values = evaluate([item.value for item in stores], lambda name, at: arrays[name][(slice(None), *at)], dtype)
    results = {name: np.full((len(arrays["q"]), *shape), np.nan) for name, shape in shapes.items()}
    for item, value in zip(stores, values, strict=True):
        assert np.isnan(results[item.array][(slice(None), *item.index)]).all(), f"{item.array}{item.index} stored twice"
        results[item.array][(slice(None), *item.index)] = value
    return results


def advance(scene, arrays, h, dtype="float64", most=16, trace=Applications, **options):
    """One step: q', qd' [world, ...] and in how many passes each world's pieces held, ``most`` + 1 if they never did.

    Args:
        arrays: q, qd and what else the step gets, [world, ...] by name.
        trace: the class that has the step.
    """
    trace = trace(Links(scene), dtype, tuple(arrays))
    stores = trace.step(**options)
    worlds = len(arrays["q"])
    known = arrays | {"dt": np.full((worlds, 1), h)}
    known |= {name: np.zeros((worlds, scene.dof_count)) for name in LOOPED}

    def stored(some):
        values = evaluate([item.value for item in some], lambda name, at: known[name][(slice(None), *at)], dtype)
        found = {
            name: known.get(name, np.zeros((worlds, scene.coord_count))).astype(dtype)
            for name in {item.array for item in some}
        }
        for item, value in zip(some, values, strict=True):
            found[item.array][:, item.index[0] if item.index else 0] = value
        return found

    passes, looped = np.ones(worlds, dtype=int), [item for item in stores if item.array in LOOPED]
    for _ in range(most if looped else 0):
        known |= stored(looped)
        passes += known[MISSED][:, 0] > 0.0
        if not known[MISSED][:, 0].any():
            break
    known["out"] = np.zeros((worlds, scene.dof_count))
    done = stored([item for item in stores if item.array not in LOOPED])
    return done["q_out"], done["out"], passes


def plant(monkeypatch, owner, name, old, new):
    """Change ``old``, found once, to ``new`` in the source of a function or method of a module or class."""
    original = getattr(owner, name)
    source = textwrap.dedent(inspect.getsource(original))
    assert source.count(old) == 1, f"{name} holds {source.count(old)} times: {old}"
    space = dict(original.__globals__)
    exec("from __future__ import annotations\n" + source.replace(old, new), space)
    monkeypatch.setattr(owner, name, space[name])
