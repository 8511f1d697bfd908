"""Reverse mode of velocity terms in the middle of a step, see :mod:`..contact.middle`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...trace.differentiation import reverse
from ...trace.emission import Store
from ...trace.scalars import ordered
from ..contact.middle import MEAN, middle_bias
from .adjoints import gradient_stores

if TYPE_CHECKING:
    from ..tracing import Trace


def middle_bias_vjp(trace: Trace, wrt: tuple[str, ...]) -> list[Store]:
    """J* (cotangent; mean_cotangent) of what a round leaves for the step, for the arguments ``wrt``"""
    stores = middle_bias(trace)
    names = {"out": "cotangent", f"{MEAN}_out": f"{MEAN}_cotangent"}
    seeds = [trace.graph.input(names[item.array], *item.index) for item in stores]
    results = [item.value for item in stores]
    inputs = [x for x in ordered(results) if x.op == "input"]
    found = dict(zip((x.args for x in inputs), reverse(results, inputs, seeds), strict=True))
    return gradient_stores(trace, found, wrt, wrt)
