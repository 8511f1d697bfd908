"""Traces evaluated by NumPy: what an operation's kernel computes, without compiling it; and bugs planted in them."""

import inspect
import textwrap

import numpy as np

from warp_spo.recursions.applications import Applications
from warp_spo.recursions.links import Links
from warp_spo.trace.evaluate import evaluate


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


def plant(monkeypatch, owner, name, old, new):
    """Change ``old``, found once, to ``new`` in the source of a function or method of a module or class."""
    original = getattr(owner, name)
    source = textwrap.dedent(inspect.getsource(original))
    assert source.count(old) == 1, f"{name} holds {source.count(old)} times: {old}"
    space = dict(original.__globals__)
    exec("from __future__ import annotations\n" + source.replace(old, new), space)
    monkeypatch.setattr(owner, name, space[name])
